"""The pressures that hold a rated load."""

from typing import TYPE_CHECKING

import numpy as np

from crane.common.samples import Array
from crane.dynamics.statics import Statics
from crane.motion.workspaces.section import upwards
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
    machine, up = chart.machine, upwards(chart.machine)
    if machine.hydraulics is None:
        return {}
    here = np.isfinite(chart.loads)
    load, tank = chart.loads[here], machine.hydraulics.supply.tank
    q = machine.closure.solve(np.ascontiguousarray(chart.q_a[here]))
    at = Statics(machine, chart.frame).at(q)
    weight = float(np.linalg.norm(machine.model.gravity.linear))
    out = {}
    for drive in strengths(machine, chart.raising, chart.friction):
        if not drive.pressures:
            continue
        i = drive.column
        moved = at.slopes[:, :, i] + load[:, None] * at.ways[:, :, i]
        rises = moved @ up
        level = weight * np.cos(chart.slope) * rises - at.passive[:, i]
        aside = np.linalg.norm(moved - rises[:, None] * up, axis=1)
        leans = weight * np.sin(chart.slope) * aside
        beyond = level + leans - drive.most, drive.least - level + leans
        both = np.full((*chart.loads.shape, 2), np.nan)
        for side in (0, 1):
            pressure = drive.pressures[side] + beyond[side] / drive.areas[side]
            both[here, side] = np.maximum(pressure, tank)
        out[drive.joint] = both
    return out
