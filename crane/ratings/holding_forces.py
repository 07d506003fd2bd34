"""What the drives of a machine exert to hold its rated loads, and the margins to buckling then."""

from typing import TYPE_CHECKING

import numpy as np

from crane.common.samples import Array
from crane.dynamics.buckling import Buckling
from crane.dynamics.statics import StaticsEvaluator
from crane.motion.workspaces.workspace_section import up_direction

if TYPE_CHECKING:
    from crane.ratings.lifting_capacity import Capacity


def holding_forces(chart: "Capacity") -> tuple[Array, Array]:
    """Forces of the active joints under the rated loads, at rest, at the places that have some.

    Returns:
        (N, n) as if the slope leaned along no drive, and by how much more or less they are at most
        as it leans to any side [N], [N m].
    """
    machine, up = chart.machine, up_direction(chart.machine)
    has_load = np.isfinite(chart.loads)
    q = machine.closure.solve(np.ascontiguousarray(chart.q_a[has_load]))
    statics = StaticsEvaluator(machine, chart.frame).evaluate(q)
    gravity = float(np.linalg.norm(machine.model.gravity.linear))
    moment_jacobian = (
        statics.moment_jacobian + chart.loads[has_load][:, None, None] * statics.tip_jacobian
    )
    vertical_parts = np.einsum("nix,i->nx", moment_jacobian, up)
    level_forces = gravity * np.cos(chart.ground_slope) * vertical_parts - statics.passive_forces
    lateral_parts = np.linalg.norm(moment_jacobian - vertical_parts[:, None] * up[:, None], axis=1)
    return level_forces, gravity * np.sin(chart.ground_slope) * lateral_parts


def buckling_margins(chart: "Capacity") -> dict[str, Array]:
    """How many times the force that presses a cylinder buckles it, under the rated loads.

    On a slope, as it leans to the worst side.

    Args:
        chart: See `crane.capacity`.

    Returns:
        By cylinder (s, b, a), of those that `crane.Buckling` counts: infinite where it is pulled,
        NaN where there is no load, or no end to it. Empty without a circuit.
    """
    machine, has_load = chart.machine, np.isfinite(chart.loads)
    if machine.hydraulics is None:
        return {}
    buckling = Buckling(machine)
    forces, slope_forces = holding_forces(chart)
    for joint, column in buckling.columns.items():
        i = machine.active.index(joint)
        forces[:, i] += column.compression_sign * slope_forces[:, i]
    margin_rows = buckling.buckling_margins(chart.q_a[has_load], forces)
    out = {}
    for joint, margins in zip(buckling.columns, margin_rows.T, strict=True):
        out[joint] = np.full(chart.loads.shape, np.nan)
        out[joint][has_load] = margins
    return out
