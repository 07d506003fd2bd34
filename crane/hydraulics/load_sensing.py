"""Which swings of a load a pump with load sensing feeds: where its admittance is active."""

import math

import numpy as np

from crane.hydraulics.sources import Supply


def driven_swings(supply: Supply, bulk_modulus: float) -> tuple[float, float] | None:
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

    which is so at all frequencies from T = `least_sensing` response on. A passive load on a
    passive admittance cannot swing up.

    Args:
        supply: The pump.
        bulk_modulus: Of the oil [Pa].

    Returns:
        The lowest and the highest of them [Hz]; None if there are none.
    """
    if supply.control != "load-sensing" or not supply.response:
        return None
    a, late = 1.0 / supply.response, supply.sensing_time
    square = _stiffness(supply, bulk_modulus) * a * a
    rest = square * square * late**2 - square + a * a + a * square * late
    slope = 1.0 + (a * a - 2.0 * square) * late**2
    if not late:
        return (0.0, math.sqrt(-rest) / (2.0 * math.pi)) if rest < 0 else None
    root = slope * slope - 4.0 * late**2 * rest
    if root <= 0:
        return None
    ends = [(-slope + sign * math.sqrt(root)) / (2.0 * late**2) for sign in (-1.0, 1.0)]
    if ends[1] <= 0:
        return None
    low, high = (math.sqrt(max(end, 0.0)) / (2.0 * math.pi) for end in ends)
    return low, high


def least_sensing(supply: Supply, bulk_modulus: float) -> float:
    """Time constant of the load-sensing line over `response`, from which on no swing is driven.

    With r of it, (1 - r)^2 (1 + r) = 4 r^3 (w response)^2; see `driven_swings`.
    """
    stiffness = _stiffness(supply, bulk_modulus)
    if stiffness <= 1.0:
        return 0.0
    roots = np.roots([1.0 - 4.0 * stiffness, -1.0, -1.0, 1.0])
    return float(min(x.real for x in roots if abs(x.imag) < 1e-9 and x.real > 0))


def _stiffness(supply: Supply, bulk_modulus: float) -> float:
    """(w response)^2, rise of the line's pressure within the response, of all flow, over droop."""
    return bulk_modulus * supply.flow * supply.response / (supply.volume * supply.droop)
