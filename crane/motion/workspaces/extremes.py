"""How far a workspace reaches."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.optimize import minimize

from crane.common.samples import Array
from crane.machine import Machine
from crane.motion.workspaces.patch import last_closed
from crane.motion.workspaces.probe import Probe
from crane.motion.workspaces.result import Curve, Extreme

Goal = Callable[[Array], tuple[float, Array]]
Demand = tuple[str, Goal]  # "eq": the goal is 0, "ineq": it is at least 0

# in rad and shares of the machine's size
_STEP = 1e-6  # of the differences that give the slope of a determinant
_OPEN = 1e-9  # residual of the loops up to which an extreme is one
_MISSED = 1e-9  # of a demand that is met
_WAY, _ITERATIONS = 8, 6  # points of the way to a singular posture, steps of Newton's method
_BESIDE = 0.3  # of the length of that way, how far it may be from a straight one


def extremes(
    probe: Probe, q: Array, places: Array, ends: tuple[Array, Array], curves: Sequence[Curve]
) -> tuple[Extreme, ...]:
    """Least and largest coordinates of a section.

    The best posture of a grid, or of a singular curve, improved by `farthest`.

    Args:
        probe: The machine and the section.
        q: (N, nq) postures.
        places: (N, 2) theirs.
        ends: Limits (n,) of the active coordinates.
        curves: Singular curves.
    """
    active = probe.machine.closure.active
    found = []
    names, words = enumerate(probe.section.names), ((1.0, "least"), (-1.0, "largest"))
    for (axis, name), (sign, word) in itertools.product(names, words):

        def goal(posture: Array, axis: int = axis, sign: float = sign) -> tuple[float, Array]:
            tips = probe.tips(posture[None])
            tree = probe.kinematics.tree_jacobian(posture)[None]
            slopes = probe.section.slopes(tips, tree)[0, axis]
            return -sign * float(probe.section.coordinates(tips)[0, axis]), -sign * slopes

        best = int((sign * places[:, axis]).argmin())
        value, posture = farthest(probe.machine, q[best], probe.strokes, ends, goal)
        value, q_a = -sign * value, posture[active]
        for curve in curves:
            k = int((sign * curve.places[:, axis]).argmin())
            if sign * curve.places[k, axis] < sign * value:
                value, q_a = float(curve.places[k, axis]), curve.q_a[k]
        found.append(Extreme(f"{word} {name}", value, q_a))
    return tuple(found)


def farthest(
    machine: Machine,
    q: Array,
    strokes: Sequence[int],
    ends: tuple[Array, Array],
    goal: Goal,
    demands: Sequence[Demand] = (),
) -> tuple[float, Array]:
    """The largest value of a goal near a posture, on its assembly branch and within the limits.

    Passive joints are unknowns beside the strokes, so that the problem is smooth where the branch
    ends, too:

        max g(q)   with   phi(q) = 0,   d_k(q) d_k(home) >= 0,   lower <= q_A <= upper,

    d_k the determinants of the blocks of J_P, one of which is zero at the end of a branch. Solved
    by sequential quadratic programming (SLSQP); a solution counts if the branch leads there.

    Args:
        machine: The machine.
        q: (nq,) closed posture to start from.
        strokes: Indices of the active joints that move; the others are held.
        ends: Lower and upper limits (n,) of the active coordinates.
        goal: (nq,) -> value, and its slope (nv,) by the joints of the tree.
        demands: What else has to hold, likewise; lengths in shares of the machine's size.

    Returns:
        The value and its posture (nq,); those of the start where nothing better is found, with
        -inf where that does not meet the demands.
    """
    closure = machine.closure
    moving = closure.active[list(strokes)]
    free = np.concatenate([moving, closure.passive])
    low, span = ends[0][list(strokes)], (ends[1] - ends[0])[list(strokes)]
    unit = np.concatenate([span, closure.units[closure.passive]])
    first = goal(q)[0]
    met = _met(demands, q)
    equations, rows = closure.equations, closure.structure.rows
    size = max(abs(first), 1e-3 * closure.size)  # so that the accuracy asked for is a relative one

    def posture(x: Array) -> Array:
        out = q.copy()
        out[free] = x * unit
        return out

    def cost(x: Any) -> tuple[float, Any]:
        value, slope = goal(posture(x))
        return -value / size, -slope[free] * unit / size

    closed: Any = {
        "type": "eq",
        "fun": lambda x: equations.scaled(posture(x))[0][rows],
        "jac": lambda x: (equations.scaled(posture(x))[1][rows] / closure.units)[:, free] * unit,
    }
    branch: Any = {
        "type": "ineq",
        "fun": lambda x: _determinants(machine, posture(x)),
        "jac": lambda x: _slopes(machine, posture(x), free) * unit,
    }
    others: Any = [
        {
            "type": kind,
            "fun": lambda x, demand=demand: demand(posture(x))[0],
            "jac": lambda x, demand=demand: demand(posture(x))[1][free] * unit,
        }
        for kind, demand in demands
    ]
    bounds = [
        *zip(low / span, (low + span) / span, strict=True),
        *[(None, None)] * len(closure.passive),
    ]
    for constraints in ([closed], [closed, branch]) if len(rows) else ([],):
        result = minimize(
            cost, q[free] / unit, jac=True, bounds=bounds, constraints=[*constraints, *others],
            method="SLSQP", options={"ftol": 1e-13, "maxiter": 200},
        )  # fmt: skip
        if len(rows) and (_determinants(machine, posture(result.x)) > 0).all():
            break  # few extremes are at the end of a branch, and its slopes are dear
    target = posture(result.x)
    target[moving] = np.clip(target[moving], low, low + span)
    reached, able = last_closed(machine, q, target[closure.active])
    if able or not _leads(machine, reached, target, free):
        target = reached  # closed to rounding
    value = goal(target)[0]
    if _met(demands, target) and (value > first or not met):
        return value, target
    return (first if met else -np.inf), q


def _met(demands: Sequence[Demand], q: Array) -> bool:
    """Whether a posture meets all demands."""
    found = [(kind, demand(q)[0]) for kind, demand in demands]
    return all((abs(x) if kind == "eq" else -x) < _MISSED for kind, x in found)


def _leads(machine: Machine, q: Array, target: Array, free: Array) -> bool:
    """Whether the branch leads from a posture to another, singular one.

    Points of the straight way are projected on phi(q) = 0 along the shortest way, all joints
    being free: unlike the strokes alone, these determine the posture where the branch ends.
    """
    equations, rows = machine.closure.equations, machine.closure.structure.rows
    units = machine.closure.units
    way = float(np.abs((target - q) / units).max())
    for share in np.linspace(0, 1, _WAY + 1)[1:]:
        chord = q + share * (target - q)
        at = chord.copy()
        for _ in range(_ITERATIONS):
            phi, jacobian = equations.scaled(at)
            at[free] -= units[free] * np.linalg.lstsq(jacobian[rows][:, free], phi[rows])[0]
        if np.abs((at - chord) / units).max() > _BESIDE * way + _OPEN:
            return False
        if not (np.abs(equations.scaled(at)[0]) < _OPEN).all():
            return False
        if (_determinants(machine, at) < -_OPEN).any():
            return False
    return True


def _determinants(machine: Machine, q: Array) -> Array:
    """(blocks,) determinants of the blocks of J_P, as shares of those at home."""
    return _blocks(machine, q) / _blocks(machine, machine.home)


def _blocks(machine: Machine, q: Array) -> Array:
    closure = machine.closure
    jacobian = closure.equations.scaled(q)[1][closure.structure.rows][:, closure.passive]
    return np.array(
        [np.linalg.det(jacobian[np.ix_(*block)]) for block in closure.structure.blocks]
    )


def _slopes(machine: Machine, q: Array, columns: Array) -> Array:
    """(blocks, k) slopes of `_determinants` by some coordinates."""
    out = []
    for column in columns:
        step = np.zeros(len(q))
        step[column] = _STEP * machine.closure.units[column]
        ahead, behind = (_blocks(machine, q + sign * step) for sign in (1, -1))
        out.append((ahead - behind) / (2 * step[column]))
    return np.array(out).T / _blocks(machine, machine.home)[:, None]
