"""A pump with its regulator as formulas."""

from collections.abc import Mapping, Sequence

from crane.codegen import Scalar, maximum
from crane.codegen.symbolic import apply_function, minimum
from crane.hydraulics.orifice_flow import Flow, clip, signed_square_root
from crane.hydraulics.supply_and_engine import TANK_NODE, Supply
from crane.hydraulics.valve_cylinder_equations import ValveCylinderEquations

_MIN_LIMITING_PRESSURE = 1.0e4  # [Pa], below which power limits nothing
_OPEN_CENTRE_CONTROLS = (
    "fixed",
    "negative",
    "positive",
)  # whose flow goes on to the throttle without valves
_CLOSED_COEFFICIENT_SQUARED = 1.0e-40  # square of a coefficient that lets nothing pass


class PumpEquations:
    """A pump at an instant, see `Supply`.

    Args:
        name: Of its node.
        supply: What it is.
        constants: Its numbers.
        pressures: Of all nodes [Pa].
        highest_load: Highest of its valves [Pa].
        power_limiting_pressure: Pressure that its power is divided by [Pa].
        cylinders: What it feeds.
        speed: Of the engine over its set speed.
        share: Of its displacement, where that takes time.
        sensed_load: What its load-sensing line tells it [Pa], where that takes time.

    Attributes:
        flows: Into its line, and out of it past the pump, the relief valve and open centres.
        requested_share: Share of the displacement that the regulator asks for.
        share: Share that it has.
        state_rates: Those of the share and of what it senses, where they take time.
        shaft_power: Power that turns the pump [W].
        torque: The same over the speed's share [W].
        lost_power: What is lost in it beside its slip [W].
    """

    def __init__(
        self,
        name: str,
        supply: Supply,
        constants: Mapping[str, Scalar],
        pressures: Mapping[str, Scalar],
        highest_load: Scalar,
        power_limiting_pressure: Scalar,
        cylinders: Sequence[ValveCylinderEquations],
        speed: Scalar,
        share: Scalar | None,
        sensed_load: Scalar | None,
    ):
        self._name, self._supply, self._constants, self._cylinders = (
            name,
            supply,
            constants,
            cylinders,
        )
        self._pressure, self._tank_pressure = pressures[name], pressures[TANK_NODE]
        self.flows: list[Flow] = []
        throttle_pressure = self._add_bypass_flow()
        sensing_rates: list[Scalar] = []
        if sensed_load is not None:
            sensing_rates, highest_load = (
                [(highest_load - sensed_load) * constants["per_sensing"]],
                sensed_load,
            )
        self.asked = self._requested_share(
            highest_load, power_limiting_pressure, throttle_pressure
        )
        self.share = self.asked if share is None else share
        self.state_rates = sensing_rates
        if share is not None:
            self.state_rates = [(self.asked - share) * constants["per_response"], *sensing_rates]
        gauge_pressure = self._pressure - self._tank_pressure
        delivered = self.share * constants["flow"] * speed
        self.flows.append(Flow(TANK_NODE, name, delivered, "pump"))
        if supply.slip > 0:
            self.flows.append(Flow(name, TANK_NODE, constants["slip"] * gauge_pressure, "slip"))
        if supply.relief > 0:
            over = maximum(self._pressure - constants["relief"], 0.0)
            self.flows.append(Flow(name, TANK_NODE, constants["relief_gain"] * over, "relief"))
        hydraulic_torque = self.share * constants["flow"] * gauge_pressure
        friction_torque = constants["friction"] * apply_function(
            "abs", hydraulic_torque
        )  # also where the line drives the pump
        self.torque = hydraulic_torque + friction_torque + constants["drag"] * speed
        self.lost_power = friction_torque * speed + constants["drag"] * speed * speed
        self.shaft_power = delivered * gauge_pressure + self.lost_power

    def _add_bypass_flow(self) -> Scalar:
        """Pressure over the tank's before the throttle behind its open centres [Pa].

        Throttles in series: 1 / c^2 = sum of 1 / c_i^2, and each has its share of the drop.
        """
        centres = [
            one.open_centre_coefficient() for one in self._cylinders if one.valve.centre > 0
        ]
        supply = self._supply
        if not centres and not (supply.throttle > 0 and supply.control in _OPEN_CENTRE_CONTROLS):
            return 0.0
        total_resistance: Scalar = 0.0
        for c in centres:
            total_resistance = total_resistance + 1.0 / (c * c + _CLOSED_COEFFICIENT_SQUARED)
        throttle_resistance: Scalar = 0.0
        if supply.throttle > 0:
            throttle_resistance = 1.0 / (self._constants["throttle"] * self._constants["throttle"])
        total_resistance = total_resistance + throttle_resistance
        drop = self._pressure - self._tank_pressure
        rate = signed_square_root(drop) / apply_function("sqrt", total_resistance)
        self.flows.append(Flow(self._name, TANK_NODE, rate, "bypass"))
        return drop * throttle_resistance / total_resistance

    def _requested_share(
        self, highest_load: Scalar, power_limiting_pressure: Scalar, throttle_pressure: Scalar
    ) -> Scalar:
        """The share that the regulator asks for."""
        numbers, control, p = self._constants, self._supply.control, self._pressure
        if control == "fixed":
            return 1.0
        cut_off = (numbers["pressure"] - p) * numbers["per_droop"]
        requested_share: Scalar = cut_off
        if control == "load-sensing":
            set_pressure = maximum(highest_load + numbers["margin"], numbers["standby"])
            requested_share = (minimum(set_pressure, numbers["pressure"]) - p) * numbers[
                "per_droop"
            ]
        elif control == "negative":
            requested_share = minimum(1.0 - throttle_pressure / numbers["signal"], cut_off)
        elif control == "positive":
            requested_share = minimum(
                sum((one.pump_demand for one in self._cylinders), 0.0), cut_off
            )
        if self._supply.power > 0:
            full_flow_power = numbers["flow"] * maximum(
                power_limiting_pressure - self._tank_pressure, _MIN_LIMITING_PRESSURE
            )
            requested_share = minimum(requested_share, numbers["power"] / full_flow_power)
        return clip(requested_share, numbers["least"], 1.0)
