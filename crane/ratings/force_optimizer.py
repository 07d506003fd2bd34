"""The posture of the largest force, exactly."""

from typing import Any

import numpy as np
from scipy.optimize import minimize

from crane.common.samples import Array
from crane.dynamics.statics import StaticQuantities
from crane.motion.workspaces.workspace_patch import last_closed_configuration
from crane.ratings.limiting_factors import LoadLimits
from crane.ratings.strokes import Strokes


def maximize_force(strokes: Strokes, load_limits: LoadLimits, q: Array, moved: list[int]) -> Array:
    """The posture of the largest force near a posture, within the limits of some strokes.

    The least of what all causes let is largest where

        max x   with   a_k(q_A) + b_k(q_A) x <= 0,   lower <= q_A <= upper,

    over the bounds k of `LoadLimits`: smooth, though the least is not. Solved by sequential
    quadratic programming (SLSQP) with exact slopes.

    Args:
        strokes: Of the frame.
        load_limits: On level ground.
        q: (nq,) closed posture to start from.
        moved: Indices of the active joints that move.

    Returns:
        (nq,) closed posture; the start where nothing better is found.
    """
    machine, statics, active = strokes.machine, strokes.statics, strokes.machine.closure.active
    lower, stroke_lengths = strokes.low[moved], (strokes.high - strokes.low)[moved]

    def smallest_force(at: StaticQuantities) -> float:
        return float(load_limits.max_magnitudes(at)[0].min())

    def unit(at: StaticQuantities) -> Array:
        return load_limits.action.unit_vectors(at, np.zeros(1))

    start = statics.evaluate(q[None])
    initial_force = smallest_force(start)
    if not 0 < initial_force < np.inf:
        return q
    initial_coefficients = [
        load_limits.bound_coefficients(bound, start, unit(start)) for bound in load_limits.bounds
    ]
    constraint_scales = np.array(
        [abs(a[0]) + abs(b[0]) * initial_force for a, b, *_ in initial_coefficients]
    )
    cache: dict[bytes, tuple[Array, StaticQuantities, StaticQuantities]] = {}

    def evaluate(y: Array) -> tuple[Array, StaticQuantities, StaticQuantities]:
        key = y[:-1].tobytes()
        if key not in cache:
            cache.clear()
            target = q[active].copy()
            target[moved] = lower + np.clip(y[:-1], 0, 1) * stroke_lengths
            there = last_closed_configuration(machine, q, target)[0]
            cache[key] = (
                there,
                statics.evaluate(there[None]),
                statics.coordinate_derivatives(there[None]),
            )
        return cache[key]

    def constraint_values(y: Any) -> Any:
        _, here, _ = evaluate(y)
        terms = [
            load_limits.bound_coefficients(bound, here, unit(here)) for bound in load_limits.bounds
        ]
        return (
            -np.array([a[0] + b[0] * initial_force * y[-1] for a, b, *_ in terms])
            / constraint_scales
        )

    def constraint_jacobian(y: Any) -> Any:
        _, here, derivatives = evaluate(y)
        jacobian = np.empty((len(load_limits.bounds), len(y)))
        for row, bound in zip(jacobian, load_limits.bounds, strict=True):
            for k, i in enumerate(moved):
                stroke_derivatives = StaticQuantities(*(part[..., i] for part in derivatives))
                a, b, *_ = load_limits.coefficient_derivatives(bound, here, stroke_derivatives)
                row[k] = (a[0] + b[0] * initial_force * y[-1]) * stroke_lengths[k]
            row[-1] = load_limits.bound_coefficients(bound, here, unit(here))[1][0] * initial_force
        return -jacobian / constraint_scales[:, None]

    def cost(y: Any) -> tuple[float, Any]:
        return -float(y[-1]), -np.eye(len(y))[-1]

    constraints: Any = {"type": "ineq", "fun": constraint_values, "jac": constraint_jacobian}
    bounds: Any = [*[(0.0, 1.0)] * len(moved), (0.0, None)]
    result = minimize(
        cost, np.r_[(q[active][moved] - lower) / stroke_lengths, 1.0], jac=True, bounds=bounds,
        constraints=[constraints], method="SLSQP", options={"ftol": 1e-14, "maxiter": 200},
    )  # fmt: skip
    configuration, statics_values, _ = evaluate(np.asarray(result.x))
    return configuration if smallest_force(statics_values) > initial_force else q
