"""The pressures that hold a rated load."""

from typing import TYPE_CHECKING

import numpy as np

from crane.common.samples import Array
from crane.ratings.drive_force_limits import drive_force_limits
from crane.ratings.holding_forces import holding_forces

if TYPE_CHECKING:
    from crane.ratings.lifting_capacity import Capacity


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
    has_load = np.isfinite(chart.loads)
    tank, (forces, slope_forces) = machine.hydraulics.supply.tank, holding_forces(chart)
    out = {}
    for drive in drive_force_limits(machine, chart.raising_joints, chart.with_friction):
        if not drive.chamber_pressures:
            continue
        level_force, slope_force = (
            forces[:, drive.active_index],
            slope_forces[:, drive.active_index],
        )
        force_differences = (
            level_force + slope_force - drive.max_force,
            drive.min_force - level_force + slope_force,
        )
        pressures = np.full((*chart.loads.shape, 2), np.nan)
        for chamber in (0, 1):
            pressure = (
                drive.chamber_pressures[chamber]
                + force_differences[chamber] / drive.chamber_areas[chamber]
            )
            pressures[has_load, chamber] = np.maximum(pressure, tank)
        out[drive.joint] = pressures
    return out
