"""Pumps, engine, lines, accumulators and elements of a circuit, and checks of parameters."""

import itertools
from collections.abc import Collection
from dataclasses import MISSING, dataclass, field, fields
from typing import Any

from crane.common.errors import InputError, suggest_names
from crane.common.plausible_ranges import suggested_units_text
from crane.common.samples import as_number

_MIN_POSITIVE = 1e-50  # least value of a positive parameter: one over its square is finite


class CircuitParameterError(InputError):
    """An invalid parameter of a component, or one that does not fit the rest of the circuit.

    Args:
        path: Keys that lead to the parameter in the machine file, from where its value is read.
        message: See `CraneError`.
    """

    def __init__(self, path: tuple[str, ...], message: str):
        super().__init__(message)
        self.path = path


def parameter_names(component_type: type) -> list[str]:
    """Names of the numeric parameters of a type of component."""
    return [entry.name for entry in fields(component_type) if entry.type in (float, "float")]


def check_parameters(component: object, label: str) -> None:
    """Check the numeric parameters of a component.

    The metadata of a field says what it accepts: "positive", "signed" (any finite value), or, by
    default, values of at least 0.

    Raises:
        CircuitParameterError: A parameter is not finite, or negative or zero where it must not.
    """
    for entry in fields(component):  # type: ignore[arg-type]
        if entry.type not in (float, "float"):
            continue
        value = as_number(getattr(component, entry.name), f"{entry.name} of {label}", "")
        positive = bool(entry.metadata.get("positive"))
        if entry.metadata.get("signed") or value >= (_MIN_POSITIVE if positive else 0.0):
            continue
        requirement = "must be positive" if positive else "must not be < 0"
        if value > 0:
            requirement = f"must be at least {_MIN_POSITIVE:g}"
        raise CircuitParameterError(
            (entry.name,), f"{entry.name} of {label} is {value:g}, it {requirement}"
        )


def check_conditions(*conditions: tuple[bool, str, str]) -> None:
    """Raise for the first of some conditions that holds.

    Args:
        conditions: A condition, the name of the parameter that violates it, and the message.

    Raises:
        CircuitParameterError: One of them holds.
    """
    for holds, key, message in conditions:
        if holds:
            raise CircuitParameterError((key,), message)


def check_reference(
    path: tuple[str, ...], name: str, names: Collection[str], problem: str
) -> None:
    """Check that what a component names is there.

    Args:
        path: See `CircuitParameterError`.
        name: The name.
        names: Those that are there.
        problem: What is wrong if it is not; the names that are meant are appended.

    Raises:
        CircuitParameterError: It is not.
    """
    if name not in names:
        raise CircuitParameterError(path, f"{problem}, {suggest_names(names, name)}")


def positive_field(default: Any = MISSING) -> Any:
    """A field that must be positive, required without a default."""
    return field(default=default, metadata={"positive": True})


def signed_field(default: float) -> float:
    """A field with a default that may have either sign."""
    return field(default=default, metadata={"signed": True})


PUMP_CONTROLS = ("pressure", "load-sensing", "negative", "positive", "fixed")
OPEN_CENTRE_CONTROLS = ("fixed", "negative", "positive")  # their flow passes to the throttle
MAIN_PUMP = "supply"  # name of the first pump's node
TANK_NODE = "tank"


@dataclass(frozen=True)
class Supply:
    """A pump with its regulator and its line; the first pump of a circuit also has the tank.

    The regulator requests the share e of the largest flow, from 0 to 1:

        pressure:      (pressure - p) / droop,
        load-sensing:  (min(max(p_LS + margin, standby), pressure) - p) / droop,
        negative:      (signal - (p_N - p_tank)) / signal,
        positive:      sum of |y| over its valves, times their `demand`,
        fixed:         1,

    where p_LS is the highest load pressure of its open valves, as the load-sensing line transmits
    it, and p_N the pressure before the throttle at the end of the open centre (the throttle exists
    even if no valve has an open centre). The share is at least `least`. It is at most
    (pressure - p) / droop (cut-off, except for a fixed pump) and power / (flow (p - p_tank)), a
    hyperbola with its corner at power / flow. If `summed` names pumps, the power limit uses their
    mean pressure weighted by their powers, so that together they take at most the sum of their
    powers. The share follows the request with the time constant `response`. The line receives
    e flow n - slip (p - p_tank), where n is the speed of the engine divided by its set speed.

    Attributes:
        pressure: Set pressure of the pump, or its cut-off pressure [Pa].
        tank: Pressure of the return line [Pa].
        flow: Largest flow [m3/s]; 0 for an unlimited flow.
        droop: Decrease of the pressure from zero to full flow [Pa].
        volume: Volume of the line between pump and valves [m3].
        margin: Pressure margin of load sensing above the highest load [Pa].
        standby: Least set pressure of load sensing [Pa].
        signal: Pressure before the throttle at which a negative control delivers no flow [Pa].
        throttle: Coefficient of the throttle behind the open centre [m3/(s Pa^0.5)]; 0 for none.
        least: Least share of the flow.
        response: Time constant of the displacement [s]; 0 for none.
        sensing: Time constant of the load-sensing line with its damping orifice, divided by
            `response`; 0 for none.
        power: Largest power at the set speed [W]; 0 for no limit.
        relief: Absolute pressure at which the relief valve of the line opens to the tank [Pa]; 0
            for no relief valve.
        relief_gain: Flow of the relief valve per pressure above `relief` [m3/(s Pa)].
        slip: Leakage of the pump [m3/(s Pa)].
        friction: Further share of the torque that is lost.
        drag: Power of the unloaded pump at the set speed [W].
        control: One of `PUMP_CONTROLS`.
        summed: Names of the pumps whose mean pressure limits the power; empty for its own
            pressure.
    """

    pressure: float
    tank: float = 1.0e5
    flow: float = 0.0
    droop: float = positive_field(2.0e5)
    volume: float = positive_field(2.0e-3)
    margin: float = 0.0
    standby: float = 0.0
    signal: float = 0.0
    throttle: float = 0.0
    least: float = 0.0
    response: float = 0.0
    sensing: float = 0.3
    power: float = 0.0
    relief: float = 0.0
    relief_gain: float = positive_field(1.0e-8)
    slip: float = 0.0
    friction: float = 0.0
    drag: float = 0.0
    control: str = "pressure"
    summed: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_parameters(self, "the supply")
        p, tank, control, relief = self.pressure, self.tank, self.control, self.relief
        pressure_hint, relief_hint = (
            suggested_units_text("pressure", p) or ", give a little more for a pump that rests",
            suggested_units_text("relief", relief) or ", give a higher one",
        )
        check_conditions(
            (
                control not in PUMP_CONTROLS,
                "control",
                f"control '{control}' is unknown, {suggest_names(PUMP_CONTROLS, control)}",
            ),
            (
                p <= tank,
                "pressure",
                f"pressure of the supply is {p:g} Pa, not above the tank's {tank:g} Pa, so that "
                f"nothing would flow{pressure_hint}",
            ),
            (
                not self.flow and (control != "pressure" or self.power > 0 or self.response > 0),
                "flow",
                "a regulated pump has no 'flow', give the most that it delivers",
            ),
            (
                control == "load-sensing" and not self.margin,
                "margin",
                "a load-sensing pump has no 'margin', give it [Pa]",
            ),
            (
                control == "negative" and not self.signal,
                "signal",
                "a negative pump has no 'signal', give it [Pa]",
            ),
            (
                control == "negative" and not self.throttle,
                "throttle",
                "a pump with negative control has no 'throttle', give it",
            ),
            (
                control in OPEN_CENTRE_CONTROLS and not relief,
                "relief",
                f"a pump of {control} flow has no 'relief', give it [Pa]",
            ),
            (
                control == "fixed" and self.power > 0,
                "power",
                "nothing limits the power of a fixed pump, leave it out",
            ),
            (
                bool(self.summed) and not self.power,
                "summed",
                "a pump with 'summed' has no 'power', give its own",
            ),
            *(
                (value >= 1, key, f"{key} of the supply is {value:g}, give below 1")
                for key, value in (("least", self.least), ("friction", self.friction))
            ),
            (
                0 < relief <= tank,
                "relief",
                f"relief of the supply is {relief:g} Pa, not above the tank's {tank:g} Pa, so "
                f"that it would never close{relief_hint}",
            ),
        )

    @property
    def sensing_time(self) -> float:
        """Time constant of the load-sensing line [s]; 0 for none."""
        return self.sensing * self.response if self.control == "load-sensing" else 0.0

    def idle_pressure(self, tank_pressure: float) -> float:
        """Pressure of the line while nothing moves, for a given tank pressure [Pa]."""
        if self.control == "load-sensing":
            return min(max(tank_pressure + self.margin, self.standby), self.pressure)
        return self.pressure if self.control == "pressure" else tank_pressure


@dataclass(frozen=True)
class Engine:
    """The engine that drives the pumps: J w' = T - sum of the pump torques.

    The governor sets T = torque (speed + speed_droop - w) / speed_droop, between 0 and `torque`.
    The pumps deliver their `flow` at `speed`, where the engine has its full torque; without load
    the engine runs at speed + speed_droop.

    Attributes:
        speed: Set speed [rad/s].
        torque: Largest torque [N m].
        inertia: Moment of inertia of engine and pumps [kg m2].
        speed_droop: Decrease of the speed from zero to full torque [rad/s].
        fuel: Fuel consumption [kg/J]; 0 if unknown.
        idle: Fuel consumption without load [kg/s].
    """

    speed: float = positive_field()
    torque: float = positive_field()
    inertia: float = positive_field()
    speed_droop: float = positive_field(10.0)
    fuel: float = 0.0
    idle: float = 0.0

    def __post_init__(self) -> None:
        check_parameters(self, "the engine")


def check_summed_pumps(supplies: dict[str, Supply]) -> None:
    """Check that the pumps in `summed` exist and have a power limit.

    Raises:
        CircuitParameterError: One does not.
    """
    limited = [name for name, supply in supplies.items() if supply.power]
    for name, other in ((name, x) for name, supply in supplies.items() for x in supply.summed):
        problem = f"'summed' of '{name}' names '{other}', give pumps with a power"
        check_reference((*_supply_path(name), "summed"), other, limited, problem)


def check_pump_pressures(supplies: dict[str, Supply]) -> None:
    """Check that the pressures of all pumps are above that of the tank.

    Raises:
        CircuitParameterError: One is not.
    """
    tank = supplies[MAIN_PUMP].tank
    for name, key in itertools.product(supplies, ("pressure", "relief")):
        pressure = getattr(supplies[name], key)
        if 0 < pressure <= tank:
            raise CircuitParameterError(
                (*_supply_path(name), key),
                f"{key} of '{name}' is {pressure:g} Pa, not above the tank's {tank:g} Pa, give a "
                "higher one",
            )


def _supply_path(name: str) -> tuple[str, ...]:
    """Keys of a pump in the machine file."""
    return (MAIN_PUMP,) if name == MAIN_PUMP else ("supplies", name)


ELEMENT_KINDS = ("orifice", "check", "relief", "leak")
OPENING_SIDES = ("both", "out", "back")


@dataclass(frozen=True)
class CircuitLine:
    """A node with a constant volume of oil: a hose, a block, a pipe.

    Attributes:
        volume: Volume [m3].
        pressure: Initial pressure [Pa]; 0 for the pressure of the tank.
    """

    volume: float = positive_field()
    pressure: float = 0.0

    def __post_init__(self) -> None:
        check_parameters(self, "the line")


@dataclass(frozen=True)
class Accumulator:
    """A node with a gas volume behind a diaphragm or piston.

    Above the precharge p_0 the gas has the volume V_g = volume - oil. With a time constant T of
    the heat exchange with the wall,

        p' = exponent p Q / V_g - (p - p_0 volume / V_g) / T,

    which is adiabatic for fast and isothermal for slow changes; without T, p V_g^exponent is
    constant.

    Attributes:
        volume: Volume of the gas at the precharge [m3].
        precharge: p_0, absolute [Pa].
        exponent: Polytropic exponent of the gas; 1.4 adiabatic, 1 isothermal.
        time_constant: T [s]; 0 for none.
        line: Volume of oil at the port [m3].
        pressure: Initial pressure [Pa]; 0 for the precharge.
    """

    volume: float = positive_field()
    precharge: float = positive_field()
    exponent: float = positive_field(1.4)
    time_constant: float = 0.0
    line: float = positive_field(1.0e-4)
    pressure: float = 0.0

    def __post_init__(self) -> None:
        check_parameters(self, "the accumulator")
        check_conditions(
            (
                not 1.0 <= self.exponent < 2.0 or (self.time_constant > 0 and self.exponent <= 1),
                "exponent",
                f"exponent of the accumulator is {self.exponent:g}, give 1 to 1.7, above 1 with a "
                "time constant",
            ),
        )


@dataclass(frozen=True)
class CircuitElement:
    """A connection with the flow Q from one node to another.

        orifice: c w root(p_1 - p_2)             both directions
        check:   c w root(p_1 - p_2 - pressure)  forwards only
        relief:  gain w (p_1 - p_2 - pressure)   forwards only
        leak:    gain w (p_1 - p_2)              both directions

    w is 1, or the largest opening of the valves of `joints`: in both directions of their motion,
    or only where they move their joint `out` or `back`. An orifice between two pumps also connects
    their load-sensing lines, as a merge and divide valve does.

    Attributes:
        kind: One of `ELEMENT_KINDS`.
        source: Node 1.
        target: Node 2.
        coefficient: c [m3/(s Pa^0.5)].
        gain: Flow per pressure [m3/(s Pa)].
        pressure: Opening pressure [Pa].
        joints: Joints whose valves open the element; empty if it is always open.
        side: One of `OPENING_SIDES`.
    """

    kind: str
    source: str
    target: str
    coefficient: float = 0.0
    gain: float = 0.0
    pressure: float = 0.0
    joints: tuple[str, ...] = ()
    side: str = "both"

    def __post_init__(self) -> None:
        check_parameters(self, "the element")
        key = "coefficient" if self.kind in ("orifice", "check") else "gain"
        check_conditions(
            (
                self.kind not in ELEMENT_KINDS,
                "type",
                f"element '{self.kind}' is unknown, {suggest_names(ELEMENT_KINDS, self.kind)}",
            ),
            (
                self.side not in OPENING_SIDES,
                "side",
                f"side '{self.side}' is unknown, {suggest_names(OPENING_SIDES, self.side)}",
            ),
            (
                self.side != "both" and not self.joints,
                "side",
                f"side '{self.side}' is that of valves, give their 'joints'",
            ),
            (not getattr(self, key), key, f"a {self.kind} has no '{key}', give it"),
            (
                self.pressure > 0 and self.kind in ("orifice", "leak"),
                "pressure",
                f"nothing holds a {self.kind} closed, leave 'pressure' out",
            ),
            (
                self.source == self.target,
                "to",
                f"it leads from '{self.source}' to itself, give two nodes",
            ),
        )
