"""The pressures that hold a rated load."""

from typing import TYPE_CHECKING

import numpy as np

from crane.common.samples import Array
from crane.dynamics.statics import Statics
from crane.ratings.causes import Causes
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
    statics = Statics(machine, chart.frame)
    causes = Causes(
        statics, strengths(machine, chart.raising, chart.friction), chart.rule, chart.slope
    )
    here = np.isfinite(chart.loads)
    load = chart.loads[here]
    out: dict[str, Array] = {}
    at = statics.at(machine.closure.solve(np.ascontiguousarray(chart.q_a[here])))
    for bound in causes.bounds:
        drive = bound.drive
        if drive is None or not drive.pressures or machine.hydraulics is None:
            continue
        a, b, c, d = causes.terms(bound, at)
        beyond = a + b * load + np.linalg.norm(c + d * load[:, None], axis=1)  # F above the end
        side = 0 if bound.sign > 0 else 1
        pressure = drive.pressures[side] + beyond / drive.areas[side]
        shape = (*chart.loads.shape, 2)
        both = out.setdefault(drive.joint, np.full(shape, np.nan))
        both[here, side] = np.maximum(pressure, machine.hydraulics.supply.tank)
    return out
