"""How far a workspace reaches."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.optimize import minimize

from crane.errors import ClosureError
from crane.samples import Array
from crane.workspaces.probe import Probe
from crane.workspaces.result import Curve, Extreme

_BARRED = 1e6  # [m] cost where the loops do not close


def extremes(
    probe: Probe, q: Array, places: Array, ends: tuple[Array, Array], curves: Sequence[Curve]
) -> tuple[Extreme, ...]:
    """Least and largest coordinates of a section.

    The best posture of a grid, improved within the limits by a quasi-Newton method with bounds
    (L-BFGS-B) on the slopes of the section, or a point of a singular curve if that is better.

    Args:
        probe: The machine and the section.
        q: (N, nq) postures.
        places: (N, 2) theirs.
        ends: Limits (n,) of the active coordinates.
        curves: Singular curves.
    """
    active = probe.machine.closure.active
    found = []
    for axis, name in enumerate(probe.section.names):
        for sign, word in ((1.0, "least"), (-1.0, "largest")):
            best = int((sign * places[:, axis]).argmin())
            value, q_a = float(places[best, axis]), q[best][active]
            better = _descend(probe, q[best], axis, sign, ends)
            if sign * better[0] < sign * value:
                value, q_a = better
            for curve in curves:
                k = int((sign * curve.places[:, axis]).argmin())
                if sign * curve.places[k, axis] < sign * value:
                    value, q_a = float(curve.places[k, axis]), curve.q_a[k]
            found.append(Extreme(f"{word} {name}", value, q_a))
    return tuple(found)


def _descend(
    probe: Probe, q: Array, axis: int, sign: float, ends: tuple[Array, Array]
) -> tuple[float, Array]:
    """Coordinate and active coordinates at the nearest extreme, from a posture (nq,)."""
    closure, strokes = probe.machine.closure, probe.strokes
    low, span = ends[0][strokes], (ends[1] - ends[0])[strokes]
    rest = q[closure.active]

    def active_at(share: Array) -> Array:
        q_a = rest.copy()
        q_a[strokes] = low + share * span
        return q_a

    def cost(share: Any) -> tuple[float, Any]:
        try:
            posture = closure.solve(active_at(share), guess=q)[None]
            gamma = closure.gamma(posture)
        except ClosureError:
            return _BARRED, np.zeros(len(strokes))
        tips = probe.tips(posture)
        slopes = probe.slopes(posture, tips, gamma)[0, axis] / probe.scale_of_strokes
        return sign * float(probe.section.coordinates(tips)[0, axis]), sign * slopes * span

    share = (rest[strokes] - low) / span
    result = minimize(
        cost, share, jac=True, bounds=[(0.0, 1.0)] * len(strokes), method="L-BFGS-B",
        options={"ftol": 1e-15, "gtol": 1e-12},
    )  # fmt: skip
    return sign * float(result.fun), active_at(result.x)
