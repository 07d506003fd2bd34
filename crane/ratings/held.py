"""What the drives of a machine exert to hold its rated loads, and the margins to buckling then."""

from typing import TYPE_CHECKING

import numpy as np

from crane.common.samples import Array
from crane.dynamics.buckling import Buckling
from crane.dynamics.statics import Statics
from crane.motion.workspaces.section import upwards

if TYPE_CHECKING:
    from crane.ratings.lifting import Capacity


def held(chart: "Capacity") -> tuple[Array, Array]:
    """Forces of the active joints under the rated loads, at rest, at the places that have some.

    Returns:
        (N, n) as if the slope leaned along no drive, and by how much more or less they are at most
        as it leans to any side [N], [N m].
    """
    machine, up = chart.machine, upwards(chart.machine)
    here = np.isfinite(chart.loads)
    q = machine.closure.solve(np.ascontiguousarray(chart.q_a[here]))
    at = Statics(machine, chart.frame).at(q)
    weight = float(np.linalg.norm(machine.model.gravity.linear))
    moved = at.slopes + chart.loads[here][:, None, None] * at.ways
    rises = np.einsum("nix,i->nx", moved, up)
    level = weight * np.cos(chart.slope) * rises - at.passive
    aside = np.linalg.norm(moved - rises[:, None] * up[:, None], axis=1)
    return level, weight * np.sin(chart.slope) * aside


def buckling_margins(chart: "Capacity") -> dict[str, Array]:
    """How many times the force that presses a cylinder buckles it, under the rated loads.

    On a slope, as it leans to the worst side.

    Args:
        chart: See `crane.capacity`.

    Returns:
        By cylinder (s, b, a), of those that `crane.Buckling` counts: infinite where it is pulled,
        NaN where there is no load, or no end to it. Empty without a circuit.
    """
    machine, here = chart.machine, np.isfinite(chart.loads)
    if machine.hydraulics is None:
        return {}
    buckling = Buckling(machine)
    forces, leans = held(chart)
    for joint, column in buckling.columns.items():
        i = machine.active.index(joint)
        forces[:, i] += column.pushes * leans[:, i]
    found = buckling.margins(chart.q_a[here], forces)
    out = {}
    for joint, margins in zip(buckling.columns, found.T, strict=True):
        out[joint] = np.full(chart.loads.shape, np.nan)
        out[joint][here] = margins
    return out
