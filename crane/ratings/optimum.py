"""The posture of the largest force, exactly."""

from typing import Any

import numpy as np
from scipy.optimize import minimize

from crane.common.samples import Array
from crane.dynamics.statics import AtRest
from crane.motion.workspaces.patch import last_closed
from crane.ratings.causes import Causes
from crane.ratings.strokes import Strokes


def strongest(strokes: Strokes, causes: Causes, q: Array, moved: list[int]) -> Array:
    """The posture of the largest force near a posture, within the limits of some strokes.

    The least of what all causes let is largest where

        max x   with   a_k(q_A) + b_k(q_A) x <= 0,   lower <= q_A <= upper,

    over the bounds k of `Causes`: smooth, though the least is not. Solved by sequential quadratic
    programming (SLSQP) with exact slopes.

    Args:
        strokes: Of the frame.
        causes: On level ground.
        q: (nq,) closed posture to start from.
        moved: Indices of the active joints that move.

    Returns:
        (nq,) closed posture; the start where nothing better is found.
    """
    machine, statics, active = strokes.machine, strokes.statics, strokes.machine.closure.active
    low, span = strokes.low[moved], (strokes.high - strokes.low)[moved]

    def least(at: AtRest) -> float:
        return float(causes.largest(at)[0].min())

    def unit(at: AtRest) -> Array:
        return causes.action.unit(at, np.zeros(1))

    start = statics.at(q[None])
    first = least(start)
    if not 0 < first < np.inf:
        return q
    begun = [causes.terms(bound, start, unit(start)) for bound in causes.bounds]
    size = np.array([abs(a[0]) + abs(b[0]) * first for a, b, *_ in begun])
    kept: dict[bytes, tuple[Array, AtRest, AtRest]] = {}

    def at(y: Array) -> tuple[Array, AtRest, AtRest]:
        key = y[:-1].tobytes()
        if key not in kept:
            kept.clear()
            target = q[active].copy()
            target[moved] = low + np.clip(y[:-1], 0, 1) * span
            there = last_closed(machine, q, target)[0]
            kept[key] = there, statics.at(there[None]), statics.derivatives(there[None])
        return kept[key]

    def left(y: Any) -> Any:
        _, here, _ = at(y)
        terms = [causes.terms(bound, here, unit(here)) for bound in causes.bounds]
        return -np.array([a[0] + b[0] * first * y[-1] for a, b, *_ in terms]) / size

    def slopes(y: Any) -> Any:
        _, here, by = at(y)
        rows = np.empty((len(causes.bounds), len(y)))
        for row, bound in zip(rows, causes.bounds, strict=True):
            for k, i in enumerate(moved):
                one = AtRest(*(part[..., i] for part in by))
                a, b, *_ = causes.changes(bound, here, one)
                row[k] = (a[0] + b[0] * first * y[-1]) * span[k]
            row[-1] = causes.terms(bound, here, unit(here))[1][0] * first
        return -rows / size[:, None]

    def cost(y: Any) -> tuple[float, Any]:
        return -float(y[-1]), -np.eye(len(y))[-1]

    constraints: Any = {"type": "ineq", "fun": left, "jac": slopes}
    bounds: Any = [*[(0.0, 1.0)] * len(moved), (0.0, None)]
    found = minimize(
        cost, np.r_[(q[active][moved] - low) / span, 1.0], jac=True, bounds=bounds,
        constraints=[constraints], method="SLSQP", options={"ftol": 1e-14, "maxiter": 200},
    )  # fmt: skip
    there, here, _ = at(np.asarray(found.x))
    return there if least(here) > first else q
