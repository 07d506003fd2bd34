"""Equations of a pump with its regulator, and the stability of load sensing."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from crane.codegen.symbolic import Scalar, apply_function, maximum, minimum
from crane.hydraulics.circuit_elements import OPEN_CENTRE_CONTROLS, TANK_NODE, Supply
from crane.hydraulics.flow_equations import Flow, clip, signed_square_root
from crane.hydraulics.valve_cylinder_equations import ValveCylinderEquations

_MIN_LIMITING_PRESSURE = 1.0e4  # pressure below which power is not limited [Pa]
_CLOSED_COEFFICIENT_SQUARED = 1.0e-40  # square of the coefficient of a closed open centre


class PumpEquations:
    """A pump at an instant, see `Supply`.

    Args:
        name: Name of its node.
        supply: Its description.
        constants: Its constants.
        pressures: Pressures of all nodes [Pa].
        highest_load: Highest load pressure of its valves [Pa].
        power_limiting_pressure: Pressure that determines the power limit [Pa].
        cylinders: Cylinders that it feeds, with their valves.
        speed: Speed of the engine over its set speed.
        share: Share of the displacement, where the pump has a response time; else None.
        sensed_load: Pressure of the load-sensing line [Pa], where that has a time constant; else
            None.

    Attributes:
        flows: Flow into the line, slip, and flows through the relief valve and open centres.
        share: Share of the displacement.
        state_rates: Rates of the displacement and of the sensed load, where these are states.
        shaft_power: Power at the shaft [W].
        torque: Torque at the shaft times the set speed [W].
        lost_power: Power lost in the pump, slip apart [W].
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
        self._name, self._supply, self._constants = name, supply, constants
        self._cylinders = cylinders
        self._pressure, self._tank_pressure = pressures[name], pressures[TANK_NODE]
        self.flows: list[Flow] = []
        throttle_pressure = self._add_bypass_flow()
        self.state_rates: list[Scalar] = []
        if sensed_load is not None:
            self.state_rates = [(highest_load - sensed_load) * constants["per_sensing"]]
            highest_load = sensed_load
        requested_share = self._requested_share(
            highest_load, power_limiting_pressure, throttle_pressure
        )
        self.share = requested_share if share is None else share
        if share is not None:
            self.state_rates = [
                (requested_share - share) * constants["per_response"],
                *self.state_rates,
            ]
        gauge_pressure = self._pressure - self._tank_pressure
        delivered = self.share * constants["flow"] * speed
        self.flows.append(Flow(TANK_NODE, name, delivered, "pump"))
        if supply.slip > 0:
            self.flows.append(Flow(name, TANK_NODE, constants["slip"] * gauge_pressure, "slip"))
        if supply.relief > 0:
            excess = maximum(self._pressure - constants["relief"], 0.0)
            self.flows.append(Flow(name, TANK_NODE, constants["relief_gain"] * excess, "relief"))
        hydraulic_torque = self.share * constants["flow"] * gauge_pressure
        # the absolute value holds also where the line drives the pump
        friction_torque = constants["friction"] * apply_function("abs", hydraulic_torque)
        self.torque = hydraulic_torque + friction_torque + constants["drag"] * speed
        self.lost_power = friction_torque * speed + constants["drag"] * speed * speed
        self.shaft_power = delivered * gauge_pressure + self.lost_power

    def _add_bypass_flow(self) -> Scalar:
        """Add the flow through the open centres, throttles in series: 1 / c^2 = sum of 1 / c_i^2.

        Returns:
            Pressure before the throttle behind the open centres, relative to the tank [Pa].
        """
        centres = [
            cylinder.open_centre_coefficient()
            for cylinder in self._cylinders
            if cylinder.valve.centre > 0
        ]
        supply, throttle = self._supply, self._constants["throttle"]
        if not centres and not (supply.throttle > 0 and supply.control in OPEN_CENTRE_CONTROLS):
            return 0.0
        total_resistance: Scalar = 0.0
        for c in centres:
            total_resistance = total_resistance + 1.0 / (c * c + _CLOSED_COEFFICIENT_SQUARED)
        throttle_resistance = 1.0 / (throttle * throttle) if supply.throttle > 0 else 0.0
        total_resistance = total_resistance + throttle_resistance
        drop = self._pressure - self._tank_pressure
        rate = signed_square_root(drop) / apply_function("sqrt", total_resistance)
        self.flows.append(Flow(self._name, TANK_NODE, rate, "bypass"))
        return drop * throttle_resistance / total_resistance

    def _requested_share(
        self, highest_load: Scalar, power_limiting_pressure: Scalar, throttle_pressure: Scalar
    ) -> Scalar:
        """Share of the displacement that the regulator requests."""
        constants, control, p = self._constants, self._supply.control, self._pressure
        if control == "fixed":
            return 1.0
        cut_off = (constants["pressure"] - p) * constants["per_droop"]
        share: Scalar = cut_off
        if control == "load-sensing":
            set_pressure = maximum(highest_load + constants["margin"], constants["standby"])
            set_pressure = minimum(set_pressure, constants["pressure"])
            share = (set_pressure - p) * constants["per_droop"]
        if control == "negative":
            share = minimum(1.0 - throttle_pressure / constants["signal"], cut_off)
        if control == "positive":
            share = minimum(
                sum((cylinder.pump_demand for cylinder in self._cylinders), 0.0), cut_off
            )
        if self._supply.power > 0:
            full_flow_power = constants["flow"] * maximum(
                power_limiting_pressure - self._tank_pressure, _MIN_LIMITING_PRESSURE
            )
            share = minimum(share, constants["power"] / full_flow_power)
        return clip(share, constants["least"], 1.0)


def unstable_frequency_range(supply: Supply, bulk_modulus: float) -> tuple[float, float] | None:
    r"""Frequencies at which a load-sensing pump and an open valve amplify oscillations of a load.

    Between the pump and a load with the pressure p_L is an orifice with the conductance
    g = dQ / d(p_S - p_L); a compensated valve behaves like one while the pump does not reach its
    margin. With a = 1 / response, T = `sensing_time`, b = bulk_modulus / volume and
    w^2 = b flow a / droop, the linear equations

        e' = a ((p_T + margin - p_S) / droop - e),  T p_T' = p_L - p_T,
        p_S' = b (flow e - g (p_S - p_L))

    give the admittance of the flow into the load,

        Q / p_L = -g (s (s + a) + w^2 T s / (1 + T s)) / (s^2 + (a + b g) s + w^2 + a b g).

    Where its real part is positive, the pump feeds the oscillation. For all g it is at most zero
    where, with u = frequency^2,

        T^2 u^2 + (1 + a^2 T^2 - 2 w^2 T^2) u + w^4 T^2 - w^2 + a^2 + a w^2 T >= 0,

    which holds at all frequencies from T = `least_sensing_ratio` response on. A passive load at a
    passive admittance is stable.

    Args:
        supply: The pump.
        bulk_modulus: Bulk modulus of the oil [Pa].

    Returns:
        The lowest and the highest frequency [Hz]; None if there are none.
    """
    if supply.control != "load-sensing" or not supply.response:
        return None
    a, sensing_time = 1.0 / supply.response, supply.sensing_time
    squared_frequency = _squared_response_ratio(supply, bulk_modulus) * a * a
    constant_term = (
        squared_frequency * squared_frequency * sensing_time**2
        - squared_frequency
        + a * a
        + a * squared_frequency * sensing_time
    )
    linear_coefficient = 1.0 + (a * a - 2.0 * squared_frequency) * sensing_time**2
    roots = np.roots([sensing_time**2, linear_coefficient, constant_term])
    if np.iscomplex(roots).any() or roots.max() <= 0:
        return None
    low = max(roots.min(), 0.0) if sensing_time else 0.0
    return math.sqrt(low) / (2.0 * math.pi), math.sqrt(roots.max()) / (2.0 * math.pi)


def least_sensing_ratio(supply: Supply, bulk_modulus: float) -> float:
    """Least stable ratio of the time constant of the load-sensing line to `response`.

    It is the root r of (1 - r)^2 (1 + r) = 4 r^3 (w response)^2; see `unstable_frequency_range`.
    """
    stiffness = _squared_response_ratio(supply, bulk_modulus)
    if stiffness <= 1.0:
        return 0.0
    roots = np.roots([1.0 - 4.0 * stiffness, -1.0, -1.0, 1.0])
    return float(min(x.real for x in roots if abs(x.imag) < 1e-9 and x.real > 0))


def _squared_response_ratio(supply: Supply, bulk_modulus: float) -> float:
    """(w response)^2: pressure rise of the line by full flow during the response, over droop."""
    return bulk_modulus * supply.flow * supply.response / (supply.volume * supply.droop)
