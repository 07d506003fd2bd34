"""The pressures that hold a rated load."""

from typing import TYPE_CHECKING

import numpy as np

from crane.common.samples import Array
from crane.ratings.held import held
from crane.ratings.strength import strengths

if TYPE_CHECKING:
    from crane.ratings.lifting import Capacity


def chamber_pressures(chart: "Capacity") -> dict[str, Array]:
    """Pressures of the chambers at every place, under its rated load, at rest.

    A force F of a cylinder comes from one chamber, while the other is at the tank's p_T:

        p_A = max(p_T, (F + p_T B) / A),    p_B = max(p_T, (p_T A - F) / B).

    On a slope each is that of the worst side; with friction, that of drives that raise is what
    sets them in motion.

    Args:
        chart: See `crane.capacity`.

    Returns:
        By joint (s, b, a, 2) of chambers A and B [Pa]; NaN where there is no load, or no end to
        it.
    """
    machine = chart.machine
    if machine.hydraulics is None:
        return {}
    here = np.isfinite(chart.loads)
    tank, (forces, sides) = machine.hydraulics.supply.tank, held(chart)
    out = {}
    for drive in strengths(machine, chart.raising, chart.friction):
        if not drive.pressures:
            continue
        level, leans = forces[:, drive.column], sides[:, drive.column]
        beyond = level + leans - drive.most, drive.least - level + leans
        both = np.full((*chart.loads.shape, 2), np.nan)
        for side in (0, 1):
            pressure = drive.pressures[side] + beyond[side] / drive.areas[side]
            both[here, side] = np.maximum(pressure, tank)
        out[drive.joint] = both
    return out
