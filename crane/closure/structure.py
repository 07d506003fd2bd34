"""Which loop equations count, which joints they determine, and in what order they solve."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from crane.closure.blocks import Block, block_triangular
from crane.closure.choice import proposals, words
from crane.closure.equations import LoopEquations
from crane.closure.mobility import locked_up, surplus_open
from crane.common.errors import MechanismError
from crane.common.samples import Array

Indices = NDArray[np.intp]

_RANK = 1e-8  # relative size of a pivot that still counts
_SINGULAR = 1e-5  # the same at home, which closing finds to the root of rounding if singular
_CLOSED = 1e-9


@dataclass(frozen=True)
class Structure:
    """Result of `analyse`.

    Attributes:
        home: (nq,) the closed home posture.
        rows: (m,) independent equations, as many as there are passive joints.
        redundant: The other equations, which follow from them.
        blocks: (rows of `rows`, columns of the passive joints) in the order of solution.
    """

    home: Array
    rows: Indices
    redundant: Indices
    blocks: tuple[Block, ...]

    def by_size(self) -> list[tuple[Indices, Indices]]:
        """Blocks of equal size k stacked: rows (b, k, 1) and columns (b, 1, k)."""
        out = []
        for size in sorted({len(rows) for rows, _ in self.blocks}):
            chosen = [block for block in self.blocks if len(block[0]) == size]
            out.append(
                (
                    np.array([rows for rows, _ in chosen])[:, :, None],
                    np.array([columns for _, columns in chosen])[:, None, :],
                )
            )
        return out


def least_squares_step(jacobian: Array, phi: Array) -> Array:
    """A damped Gauss-Newton step towards phi = 0, at most 0.3 [m], [rad] in any joint."""
    damping = 1e-12 + 1e-3 * float(phi @ phi)
    gram = jacobian.T @ jacobian
    step = np.linalg.solve(gram + damping * np.eye(len(gram)), -jacobian.T @ phi)
    largest = float(np.abs(step).max(initial=0.0))
    return np.asarray(step * min(1.0, 0.3 / largest) if largest > 0 else step, dtype=np.float64)


def _close(equations: LoopEquations, q: Array, free: Indices) -> Array:
    """Close all loops by moving the free joints; the residual tells whether that worked."""
    q = q.copy()
    for _ in range(200):
        phi, jacobian = equations.evaluate(q)
        if np.abs(phi).max(initial=0.0) < 1e-13:
            break
        q[free] += least_squares_step(jacobian[:, free], phi)
    return q


def analyse(
    equations: LoopEquations, active: Indices, passive: Indices, guess: Array
) -> Structure:
    """Close the machine at home and find out what its equations determine.

    Independent equations are chosen at the home posture by a QR factorisation with column
    pivoting of J_P^T; ranks are confirmed at other closed postures nearby, and that surplus
    equations hold there.

    Args:
        equations: All loop equations.
        active: Columns of the active joints, none to be told which might be.
        passive: Columns of the others.
        guess: (nq,) active coordinates of the home posture and a guess of the others.

    Raises:
        MechanismError: Not closable from the guess or only there, wrong number of active joints,
            or active joints that cannot drive the others.
    """
    model = equations.model
    names = list(model.names)[1:]
    everything = np.arange(model.nv)
    followers = [int(i) for i in range(model.nv) if (equations.factors[:, i] != 0).any()]
    if not equations.names:
        if not len(active):
            raise MechanismError(_unnamed(model.nv) + f"try [{', '.join(names)}]", "active", guess)
        if len(passive):
            raise MechanismError(_miscounted(names, active, passive, model.nv), "active", guess)
        none = np.zeros(0, dtype=np.intp)
        return Structure(guess.copy(), none, none, ())
    somewhere = _close(equations, guess, everything)
    given = f" ({_at(names, active, guess)})" if len(active) else ""
    _check_closed(
        equations, somewhere, f"from the home guess{given}", "correct the frames or the guess"
    )
    random = np.random.default_rng(0)
    postures = [somewhere]
    for _ in range(4):
        moved = somewhere + random.uniform(-0.02, 0.02, model.nv)
        near = _close(equations, moved, everything)
        if np.abs(equations.evaluate(near)[0]).max() < _CLOSED:
            postures.append(near)
    jacobians = [equations.evaluate(q)[1] for q in postures]
    for index, name in enumerate(equations.names):
        rows = equations.loop_of_row == index
        if max(np.abs(jacobian[rows]).max() for jacobian in jacobians) < _CLOSED:
            raise MechanismError(
                f"loop '{name}' locks nothing that the joints do not lock already: remove it",
                f"loop {name}",
            )
    rank = max(_rank(jacobian) for jacobian in jacobians)
    freedom = model.nv - rank
    lock = locked_up(
        equations, somewhere, freedom, _SINGULAR, lambda q: _close(equations, q, everything)
    )
    if lock is not None:
        raise _overconstrained(equations, *lock)

    def proposed(text: str, **choice: Sequence[int]) -> str:
        found = proposals(model, jacobians[0], followers, **choice)
        return f"{text}{words(found)}" if found else ""

    if freedom != len(active) and _rank(jacobians[0], _SINGULAR) < rank:
        raise MechanismError(
            f"the home posture{given} is singular, where the linkage may go on in several ways: "
            "choose another under 'home'",
            "home",
        )
    if not len(active) and freedom:
        raise MechanismError(_unnamed(freedom) + proposed("try "), "active", somewhere)
    if freedom != len(active):
        stuck = _undetermined(jacobians, passive)
        text = _miscounted(names, active, stuck, freedom)
        if 0 < freedom < len(active):
            text += proposed(", such as ", among=[int(i) for i in active])
        elif freedom - len(active) < len(stuck):
            text += proposed(", such as ", kept=[int(i) for i in active])
        raise MechanismError(text, "active", somewhere if freedom else None)
    drivable = max(_rank(jacobian[:, passive]) for jacobian in jacobians)
    if drivable < rank:
        stuck = _undetermined(jacobians, passive)
        raise MechanismError(
            f"the active joints {_list(names, active)} cannot drive {_list(names, stuck)}: "
            f"choose others{proposed(', such as ')}",
            "active",
            somewhere,
        )
    home = _close(equations, guess, passive)
    endless = passive[np.isinf(model.upperPositionLimit[passive])]  # pins may have wound up
    home[endless] = np.remainder(home[endless] + np.pi, 2 * np.pi) - np.pi
    _check_closed(
        equations, home, f"at home{given}", "choose other values or guess more passive joints"
    )
    turned = equations.turned_over(home)
    if turned is not None:
        raise MechanismError(
            f"loop '{turned}' closes at home with its axes opposed: turn a frame over, or guess "
            "its joints better",
            f"loop {turned}",
        )
    jacobian = equations.evaluate(home)[1][:, passive]
    _, upper, pivots = qr(jacobian.T, mode="economic", pivoting=True)
    diagonal = np.abs(np.diag(upper))
    if (diagonal > _SINGULAR * diagonal[0]).sum() < rank:
        at_home = equations.evaluate(home)[1]
        other = ""
        if _rank(at_home, _SINGULAR) == rank:  # a dead centre of these drives only
            other = proposed(", or drive it by ")
        raise MechanismError(
            f"the home posture ({_at(names, active, home)}) is at the edge of the assembly "
            f"branch: choose another under 'home'{other}",
            "home",
        )
    rows, redundant = (np.sort(part).astype(np.intp) for part in np.split(pivots, [rank]))
    lock = surplus_open(equations, home, rows, redundant, active)
    if lock is not None:
        raise _overconstrained(equations, *lock)
    incidence = np.zeros((rank, rank), dtype=bool)
    for _ in range(3):  # open postures: an entry that is zero only on closed ones must count
        q = home + random.uniform(-0.3, 0.3, model.nv)
        part = np.abs(equations.evaluate(q)[1][np.ix_(rows, passive)])
        incidence |= part > 1e-10 * part.max(initial=1.0)
    blocks = block_triangular(incidence)
    assert blocks is not None, "independent equations have a matching"
    return Structure(home, rows, redundant, tuple(blocks))


def _rank(jacobian: Array, tolerance: float = _RANK) -> int:
    if not jacobian.size:
        return 0
    values = np.linalg.svd(jacobian, compute_uv=False)
    return int((values > tolerance * values[0]).sum())


def _overconstrained(equations: LoopEquations, row: int, gap: float) -> MechanismError:
    name = equations.names[equations.loop_of_row[row]]
    unit = "m" if equations.is_translation[row] else "rad"
    return MechanismError(
        f"loop '{name}' closes at home only: a small step beside it leaves it {gap:.2g} {unit} "
        "open, though to first order the joints could move; the machine is overconstrained and "
        "locks up, correct frames and axes or use a looser loop type",
        f"loop {name}",
    )


def _undetermined(jacobians: Sequence[Array], passive: Indices) -> Indices:
    """Passive joints that the loops leave free at held active joints."""
    free = np.zeros(len(passive))
    for jacobian in jacobians:
        _, values, right = np.linalg.svd(jacobian[:, passive])
        rank = int((values > _RANK * values.max(initial=0.0)).sum())
        free = np.maximum(free, np.abs(right[rank:]).max(axis=0, initial=0.0))
    return passive[free > 1e-6]


def _check_closed(equations: LoopEquations, q: Array, where: str, hint: str) -> None:
    phi, _ = equations.evaluate(q)
    worst = int(np.abs(phi).argmax())
    if not abs(phi[worst]) <= _CLOSED:  # also NaN
        loop = equations.names[equations.loop_of_row[worst]]
        unit = "m" if equations.is_translation[worst] else "rad"
        raise MechanismError(
            f"loop '{loop}' cannot be closed {where}: it stays {abs(phi[worst]):.3g} {unit} "
            f"open, {hint}",
            f"loop {loop}",
        )


def _list(names: Sequence[str], columns: Indices) -> str:
    return ", ".join(names[int(i)] for i in columns)


def _at(names: Sequence[str], active: Indices, q: Array) -> str:
    return ", ".join(f"{names[int(i)]} = {q[int(i)]:.6g}" for i in active)


def _unnamed(freedom: int) -> str:
    return (
        f"{freedom} degree{'s' * (freedom != 1)} of freedom and no active joints, name "
        f"{'one' if freedom == 1 else freedom}: "
    )


def _miscounted(names: Sequence[str], active: Indices, stuck: Indices, freedom: int) -> str:
    if freedom == 0:
        listed = _list(names, active) or "all joints"
        return (
            f"the loops leave {listed} no freedom to move: check the types and axes "
            "of the loops, and the axes of the joints"
        )
    text = (
        f"{len(active)} active joint{'s' * (len(active) != 1)} ({_list(names, active)}) for "
        f"{freedom} degree{'s' * (freedom != 1)} of freedom: "
    )
    missing = freedom - len(active)
    if missing < 0:
        return text + f"name only {freedom} of them"
    some = "" if missing == len(stuck) else f"{missing} of "
    return text + f"activate {some}{_list(names, stuck)} too"
