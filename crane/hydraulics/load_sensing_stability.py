"""Which swings of a load a pump with load sensing feeds: where its admittance is active."""

import math

import numpy as np

from crane.hydraulics.supply_and_engine import Supply


def unstable_frequency_range(supply: Supply, bulk_modulus: float) -> tuple[float, float] | None:
    r"""Frequencies at which a load-sensing pump and an open valve drive a swinging load.

    Between pump and load with the pressure p_L stands an orifice with the conductance
    g = dQ / d(p_S - p_L), as which compensated valves act, too, while the pump is short of their
    margin. With a = 1 / response, T = `sensing_time`, b = bulk_modulus / volume and
    w^2 = b flow a / droop, the linear equations

        e' = a ((p_T + margin - p_S) / droop - e),  T p_T' = p_L - p_T,
        p_S' = b (flow e - g (p_S - p_L))

    make the flow into the load answer its pressure by

        Q / p_L = -g (s (s + a) + w^2 T s / (1 + T s)) / (s^2 + (a + b g) s + w^2 + a b g).

    Where the real part of that is positive, the pump feeds the swing. For all g it is at most zero
    where, with u = frequency^2,

        T^2 u^2 + (1 + a^2 T^2 - 2 w^2 T^2) u + w^4 T^2 - w^2 + a^2 + a w^2 T >= 0,

    which is so at all frequencies from T = `least_sensing_ratio` response on. A passive load on a
    passive admittance cannot swing up.

    Args:
        supply: The pump.
        bulk_modulus: Of the oil [Pa].

    Returns:
        The lowest and the highest of them [Hz]; None if there are none.
    """
    if supply.control != "load-sensing" or not supply.response:
        return None
    a, sensing_time = 1.0 / supply.response, supply.sensing_time
    natural_frequency_squared = _squared_response_ratio(supply, bulk_modulus) * a * a
    constant_term = (
        natural_frequency_squared * natural_frequency_squared * sensing_time**2
        - natural_frequency_squared
        + a * a
        + a * natural_frequency_squared * sensing_time
    )
    linear_coefficient = 1.0 + (a * a - 2.0 * natural_frequency_squared) * sensing_time**2
    if not sensing_time:
        return (0.0, math.sqrt(-constant_term) / (2.0 * math.pi)) if constant_term < 0 else None
    discriminant = linear_coefficient * linear_coefficient - 4.0 * sensing_time**2 * constant_term
    if discriminant <= 0:
        return None
    frequencies_squared = [
        (-linear_coefficient + sign * math.sqrt(discriminant)) / (2.0 * sensing_time**2)
        for sign in (-1.0, 1.0)
    ]
    if frequencies_squared[1] <= 0:
        return None
    low, high = (math.sqrt(max(end, 0.0)) / (2.0 * math.pi) for end in frequencies_squared)
    return low, high


def least_sensing_ratio(supply: Supply, bulk_modulus: float) -> float:
    """Time constant of the load-sensing line over `response`, from which on no swing is driven.

    With r of it, (1 - r)^2 (1 + r) = 4 r^3 (w response)^2; see `unstable_frequency_range`.
    """
    stiffness = _squared_response_ratio(supply, bulk_modulus)
    if stiffness <= 1.0:
        return 0.0
    roots = np.roots([1.0 - 4.0 * stiffness, -1.0, -1.0, 1.0])
    return float(min(x.real for x in roots if abs(x.imag) < 1e-9 and x.real > 0))


def _squared_response_ratio(supply: Supply, bulk_modulus: float) -> float:
    """(w response)^2, rise of the line's pressure within the response, of all flow, over droop."""
    return bulk_modulus * supply.flow * supply.response / (supply.volume * supply.droop)
