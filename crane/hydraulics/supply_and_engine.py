"""What a circuit is fed by: pumps with their regulators, and the engine that turns them."""

from dataclasses import dataclass

from crane.common.errors import suggest_names
from crane.common.plausible_ranges import suggested_units_text
from crane.hydraulics.parameter_checks import (
    CircuitPathError,
    ComponentParameterError,
    check_parameters,
    positive_field,
    positive_field_with_default,
)

PUMP_CONTROLS = ("pressure", "load-sensing", "negative", "positive", "fixed")
MAIN_PUMP = "supply"  # name of the first pump's node
TANK_NODE = "tank"


@dataclass(frozen=True)
class Supply:
    """A pump, its regulator and the line behind it; of the first one the tank, too.

    The regulator asks for the share e of the pump's flow, 0 to 1,

        pressure:      (pressure - p) / droop,
        load-sensing:  (min(max(p_LS + margin, standby), pressure) - p) / droop,
        negative:      (signal - (p_N - p_tank)) / signal,
        positive:      sum of |y| over its valves, times their `demand`,
        fixed:         1,

    with p_LS the highest load of its open valves, as the load-sensing line tells it, and p_N the
    pressure before the throttle that ends its open centre, which stands there even if no valve has
    one. It is at least `least`, and
    at most (pressure - p) / droop (cut-off; not of a fixed pump) and power / (flow (p - p_tank)),
    a hyperbola with its corner at power / flow; where `summed` names pumps, of their mean p,
    weighted by their power: together they take up no more than the sum of it, whatever their
    pressures are. The share follows within `response`, and the line gets
    e flow n - slip (p - p_tank), n the engine's speed over its set speed.

    Attributes:
        pressure: That the pump keeps, or its cut-off [Pa].
        tank: Pressure of the return line [Pa].
        flow: The most that the pump delivers [m3/s]; 0 for as much as is asked for.
        droop: By how much the pressure falls from no flow to all of it [Pa].
        volume: Of the line between pump and valves [m3].
        margin: Above the highest load [Pa], of load sensing.
        standby: Least pressure that load sensing sets [Pa].
        signal: Pressure before the throttle at which a negative control gives nothing [Pa].
        throttle: Coefficient of the throttle behind the open centre [m3/(s Pa^0.5)]; 0 for none.
        least: Share of its flow that it always gives.
        response: Time constant of the displacement [s]; 0 for none.
        sensing: Time constant of the load-sensing line, behind its damping orifice, over
            `response`; 0 for none.
        power: The most that it takes up at the set speed [W]; 0 for no limit.
        relief: Pressure above the vacuum at which the line is relieved to the tank [Pa]; 0 for no
            relief valve.
        relief_gain: Its flow per pressure above it [m3/(s Pa)].
        slip: Leakage of the pump [m3/(s Pa)].
        friction: Share of its torque that is lost besides.
        drag: Power that turns it without load, at the set speed [W].
        control: One of `PUMP_CONTROLS`.
        summed: Names of the pumps whose mean pressure limits its power; its own if empty.
    """

    pressure: float
    tank: float = 1.0e5
    flow: float = 0.0
    droop: float = positive_field_with_default(2.0e5)
    volume: float = positive_field_with_default(2.0e-3)
    margin: float = 0.0
    standby: float = 0.0
    signal: float = 0.0
    throttle: float = 0.0
    least: float = 0.0
    response: float = 0.0
    sensing: float = 0.3
    power: float = 0.0
    relief: float = 0.0
    relief_gain: float = positive_field_with_default(1.0e-8)
    slip: float = 0.0
    friction: float = 0.0
    drag: float = 0.0
    control: str = "pressure"
    summed: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_parameters(self, "the supply")
        if self.pressure <= self.tank:
            raise ComponentParameterError(
                "pressure",
                f"pressure of the supply is {self.pressure:g} Pa, not above the tank's "
                f"{self.tank:g} Pa, so that nothing would flow"
                + (
                    suggested_units_text("pressure", self.pressure)
                    or ", give a little more for a pump that rests"
                ),
            )
        if self.control not in PUMP_CONTROLS:
            hint = suggest_names(PUMP_CONTROLS, self.control)
            raise ComponentParameterError(
                "control", f"control '{self.control}' is unknown, {hint}"
            )
        if not self.flow and (self.control != "pressure" or self.power or self.response):
            raise ComponentParameterError(
                "flow", "a regulated pump has no 'flow', give the most that it delivers"
            )
        for key, control in (("margin", "load-sensing"), ("signal", "negative")):
            if self.control == control and not getattr(self, key):
                raise ComponentParameterError(
                    key, f"a {control} pump has no '{key}', give it [Pa]"
                )
        if self.control == "negative" and not self.throttle:
            raise ComponentParameterError(
                "throttle", "a pump with negative control has no 'throttle', give it"
            )
        if self.control in ("fixed", "negative", "positive") and not self.relief:
            raise ComponentParameterError(
                "relief", f"a pump of {self.control} flow has no 'relief', give it [Pa]"
            )
        if self.control == "fixed" and self.power:
            raise ComponentParameterError(
                "power", "nothing limits the power of a fixed pump, leave it out"
            )
        if self.summed and not self.power:
            raise ComponentParameterError(
                "summed", "a pump with 'summed' has no 'power', give its own"
            )
        for key in ("least", "friction"):
            if getattr(self, key) >= 1:
                raise ComponentParameterError(
                    key, f"{key} of the supply is {getattr(self, key):g}, give below 1"
                )
        if 0 < self.relief <= self.tank:
            hint = suggested_units_text("relief", self.relief) or ", give a higher one"
            raise ComponentParameterError(
                "relief",
                f"relief of the supply is {self.relief:g} Pa, not above the tank's "
                f"{self.tank:g} Pa, so that it would never close{hint}",
            )

    @property
    def sensing_time(self) -> float:
        """Time constant of its load-sensing line [s]; 0 for none."""
        return self.sensing * self.response if self.control == "load-sensing" else 0.0

    def idle_pressure(self, tank_pressure: float) -> float:
        """Pressure of its line while nothing moves, over a tank's [Pa]."""
        if self.control == "load-sensing":
            return min(max(tank_pressure + self.margin, self.standby), self.pressure)
        return self.pressure if self.control == "pressure" else tank_pressure


@dataclass(frozen=True)
class Engine:
    """What turns the pumps: J w' = T - sum of their torques.

    The governor gives T = torque (speed + speed_droop - w) / speed_droop, held within 0 and
    `torque`. Pumps deliver `flow` at `speed`, where it gives full torque; unloaded it turns at
    speed + speed_droop.

    Attributes:
        speed: Set speed [rad/s].
        torque: The most that it gives [N m].
        inertia: Of engine and pumps [kg m2].
        speed_droop: Of the governor, from no to full torque [rad/s].
        fuel: Consumption [kg/J]; 0 if it is not known.
        idle: Consumption without load [kg/s].
    """

    speed: float = positive_field()
    torque: float = positive_field()
    inertia: float = positive_field()
    speed_droop: float = positive_field_with_default(10.0)
    fuel: float = 0.0
    idle: float = 0.0

    def __post_init__(self) -> None:
        check_parameters(self, "the engine")


def check_summed_pumps(supplies: dict[str, Supply]) -> None:
    """Raise where a pump's power is limited by the pressure of one that is not there.

    Raises:
        InputError: With both names.
    """
    for name, supply in supplies.items():
        for other in supply.summed:
            if other not in supplies or not supplies[other].power:
                hint = suggest_names((x for x, y in supplies.items() if y.power), other)
                raise CircuitPathError(
                    (*_supply_path(name), "summed"),
                    f"'summed' of '{name}' names '{other}', give pumps with a power, {hint}",
                )


def check_pump_pressures(supplies: dict[str, Supply]) -> None:
    """Raise where a further pump's pressures are not above the tank's, the first one's.

    Raises:
        PlacedError: With its name.
    """
    tank = supplies[MAIN_PUMP].tank
    for name, supply in supplies.items():
        for key in ("pressure", "relief"):
            if 0 < getattr(supply, key) <= tank:
                raise CircuitPathError(
                    (*_supply_path(name), key),
                    f"{key} of '{name}' is {getattr(supply, key):g} Pa, not above the tank's "
                    f"{tank:g} Pa, give a higher one",
                )


def _supply_path(name: str) -> tuple[str, ...]:
    """Where a pump stands in a circuit."""
    return (MAIN_PUMP,) if name == MAIN_PUMP else ("supplies", name)
