"""Extreme positions of a workspace by constrained optimization on the assembly branch."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.optimize import minimize

from crane.common.samples import Array
from crane.machine.machine import Machine
from crane.motion.workspaces.workspace_patch import last_closed_configuration
from crane.motion.workspaces.workspace_result import SingularCurve, WorkspaceExtreme
from crane.motion.workspaces.workspace_section import WorkspaceKinematics

Objective = Callable[[Array], tuple[float, Array]]
ObjectiveConstraint = tuple[str, Objective]  # "eq": value = 0, "ineq": value >= 0

# in rad and relative to the characteristic length
_DIFFERENCE_STEP = 1e-6  # step of differences of a determinant
_CLOSURE_TOLERANCE = 1e-9  # residual of the loops at an extreme
_CONSTRAINT_TOLERANCE = 1e-9  # of a constraint
# points on the path to a singular configuration, Newton steps at each
_CONTINUATION_POINTS, _NEWTON_ITERATIONS = 8, 6
_MAX_CHORD_DEVIATION = 0.3  # distance from the chord, per length of the path


def workspace_extremes(
    kinematics: WorkspaceKinematics,
    q: Array,
    section_positions: Array,
    limits: tuple[Array, Array],
    curves: Sequence[SingularCurve],
) -> tuple[WorkspaceExtreme, ...]:
    """Least and largest coordinates of the section.

    The best configuration of the grid or of a singular curve is improved by `maximize_on_branch`.

    Args:
        kinematics: The machine and the section.
        q: (N, nq) configurations.
        section_positions: (N, 2) their section positions [m].
        limits: Limits (n,) of the active coordinates.
        curves: Singular curves.
    """
    curve_positions = np.concatenate([np.empty((0, 2)), *(x.section_positions for x in curves)])
    curve_q_a = [q_a for curve in curves for q_a in curve.q_a]
    results, signs = [], ((1.0, "least"), (-1.0, "largest"))
    names = enumerate(kinematics.section.coordinate_names)
    for (axis, name), (sign, adjective) in itertools.product(names, signs):

        def objective(
            configuration: Array, axis: int = axis, sign: float = sign
        ) -> tuple[float, Array]:
            tips = kinematics.tip_positions(configuration[None])
            tree = kinematics.kinematics.tree_jacobian(configuration)[None]
            gradient = kinematics.section.section_jacobian(tips, tree)[0, axis]
            return -sign * float(kinematics.section.coordinates(tips)[0, axis]), -sign * gradient

        value, configuration = maximize_on_branch(
            kinematics.machine,
            q[int((sign * section_positions[:, axis]).argmin())],
            kinematics.strokes,
            limits,
            objective,
        )
        value, q_a = -sign * value, configuration[kinematics.machine.closure.active]
        coordinates = np.array([value, *curve_positions[:, axis]])
        k = int((sign * coordinates).argmin())
        results.append(
            WorkspaceExtreme(f"{adjective} {name}", float(coordinates[k]), [q_a, *curve_q_a][k])
        )
    return tuple(results)


def maximize_on_branch(
    machine: Machine,
    q: Array,
    strokes: Sequence[int],
    limits: tuple[Array, Array],
    objective: Objective,
    constraints: Sequence[ObjectiveConstraint] = (),
) -> tuple[float, Array]:
    """Maximize an objective on the branch of a configuration within the limits.

    Passive joints are unknowns beside the strokes, so that the problem is smooth at the end of the
    branch, too:

        max g(q)   with   phi(q) = 0,   d_k(q) d_k(home) >= 0,   lower <= q_A <= upper,

    with the determinants d_k of the blocks of J_P, one of which is zero at the end of a branch. It
    is solved by sequential quadratic programming (SLSQP); a solution is accepted if the branch
    leads to it.

    Args:
        machine: The machine.
        q: (nq,) closed configuration to start from.
        strokes: Indices of the active joints that are varied.
        limits: Lower and upper limits (n,) of the active coordinates.
        objective: Function q (nq,) -> value, and its gradient (nv,).
        constraints: Further constraints as functions like the objective, scaled to the order of
            one.

    Returns:
        The value and its configuration (nq,); those of the start if nothing better is found, with
        -inf if the start violates the constraints.
    """
    closure = machine.closure
    moving = closure.active[list(strokes)]
    free = np.concatenate([moving, closure.passive])
    low, stroke_lengths = limits[0][list(strokes)], (limits[1] - limits[0])[list(strokes)]
    units = np.concatenate([stroke_lengths, closure.units[closure.passive]])
    initial_value = objective(q)[0]
    is_initially_feasible = _satisfies_constraints(constraints, q)
    # makes the tolerance of the solver a relative one
    objective_scale = max(abs(initial_value), 1e-3 * closure.characteristic_length)

    def configuration(x: Array) -> Array:
        out = q.copy()
        out[free] = x * units
        return out

    def cost(x: Any) -> tuple[float, Any]:
        value, slope = objective(configuration(x))
        return -value / objective_scale, -slope[free] * units / objective_scale

    other_constraints: Any = [
        {
            "type": kind,
            "fun": lambda x, demand=demand: demand(configuration(x))[0],
            "jac": lambda x, demand=demand: demand(configuration(x))[1][free] * units,
        }
        for kind, demand in constraints
    ]
    bounds = [
        *zip(low / stroke_lengths, (low + stroke_lengths) / stroke_lengths, strict=True),
        *[(None, None)] * len(closure.passive),
    ]
    rows, evaluate = closure.structure.independent_rows, closure.equations.evaluate_scaled
    closed_loops: Any = {
        "type": "eq",
        "fun": lambda x: evaluate(configuration(x))[0][rows],
        "jac": lambda x: (evaluate(configuration(x))[1][rows] / closure.units)[:, free] * units,
    }
    same_branch: Any = {
        "type": "ineq",
        "fun": lambda x: _relative_determinants(machine, configuration(x)),
        "jac": lambda x: _determinant_derivatives(machine, configuration(x), free) * units,
    }
    # few extremes are at the end of a branch, whose derivatives are expensive
    for loop_constraints in ([closed_loops], [closed_loops, same_branch]) if len(rows) else ([],):
        result = minimize(
            cost,
            q[free] / units,
            jac=True,
            bounds=bounds,
            constraints=[*loop_constraints, *other_constraints],
            method="SLSQP",
            options={"ftol": 1e-13, "maxiter": 200},
        )
        if (
            loop_constraints
            and (_relative_determinants(machine, configuration(result.x)) > 0).all()
        ):
            break
    target = configuration(result.x)
    target[moving] = np.clip(target[moving], low, low + stroke_lengths)
    last_configuration, is_closed = last_closed_configuration(machine, q, target[closure.active])
    if is_closed or not _is_reachable_on_branch(machine, last_configuration, target, free):
        target = last_configuration  # closed to rounding
    value = objective(target)[0]
    if _satisfies_constraints(constraints, target) and (
        value > initial_value or not is_initially_feasible
    ):
        return value, target
    return (initial_value if is_initially_feasible else -np.inf), q


def _satisfies_constraints(constraints: Sequence[ObjectiveConstraint], q: Array) -> bool:
    values = [(kind, demand(q)[0]) for kind, demand in constraints]
    return all((abs(x) if kind == "eq" else -x) < _CONSTRAINT_TOLERANCE for kind, x in values)


def _is_reachable_on_branch(
    machine: Machine, q: Array, target: Array, free_columns: Array
) -> bool:
    """Whether the branch leads from a configuration to a singular one.

    Points of the straight line are projected onto phi(q) = 0 by steps of least norm in all joints:
    unlike the strokes alone, these determine the configuration at the end of the branch.
    """
    equations, rows = machine.closure.equations, machine.closure.structure.independent_rows
    units = machine.closure.units
    path_length = float(np.abs((target - q) / units).max())
    for share in np.linspace(0, 1, _CONTINUATION_POINTS + 1)[1:]:
        chord = q + share * (target - q)
        projected = chord.copy()
        for _ in range(_NEWTON_ITERATIONS):
            phi, jacobian = equations.evaluate_scaled(projected)
            step = np.linalg.lstsq(jacobian[rows][:, free_columns], -phi[rows])[0]
            projected = equations.displace(projected, free_columns, step)
        if (
            np.abs((projected - chord) / units).max()
            > _MAX_CHORD_DEVIATION * path_length + _CLOSURE_TOLERANCE
        ):
            return False
        if not (np.abs(equations.evaluate_scaled(projected)[0]) < _CLOSURE_TOLERANCE).all():
            return False
        if (_relative_determinants(machine, projected) < -_CLOSURE_TOLERANCE).any():
            return False
    return True


def _relative_determinants(machine: Machine, q: Array) -> Array:
    """Determinants (blocks,) of the blocks of J_P, relative to those at home."""
    return _block_determinants(machine, q) / _block_determinants(machine, machine.home)


def _block_determinants(machine: Machine, q: Array) -> Array:
    closure = machine.closure
    jacobian = closure.equations.evaluate_scaled(q)[1][closure.structure.independent_rows][
        :, closure.passive
    ]
    return np.array(
        [np.linalg.det(jacobian[np.ix_(*block)]) for block in closure.structure.blocks]
    )


def _determinant_derivatives(machine: Machine, q: Array, columns: Array) -> Array:
    """Derivatives (blocks, k) of `_relative_determinants` by some coordinates."""
    out = []
    for column in columns:
        step = np.zeros(len(q))
        step[column] = _DIFFERENCE_STEP * machine.closure.units[column]
        forward_value, backward_value = (
            _block_determinants(machine, q + sign * step) for sign in (1, -1)
        )
        out.append((forward_value - backward_value) / (2 * step[column]))
    return np.array(out).T / _block_determinants(machine, machine.home)[:, None]
