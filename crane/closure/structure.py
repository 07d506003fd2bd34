"""Which loop equations count, which joints they determine, and in what order they solve."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr

from crane.closure.blocks import Block, block_triangular
from crane.closure.equations import LoopEquations
from crane.errors import MechanismError
from crane.samples import Array

_RANK = 1e-8  # relative size of a pivot that still counts
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
    rows: Array
    redundant: Array
    blocks: tuple[Block, ...]

    def by_size(self) -> list[tuple[Array, Array]]:
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
    largest = np.abs(step).max(initial=0.0)
    return step * min(1.0, 0.3 / largest) if largest > 0 else step


def _close(equations: LoopEquations, q: Array, free: Array) -> Array:
    """Close all loops by moving the free joints; the residual tells whether that worked."""
    q = q.copy()
    for _ in range(200):
        phi, jacobian = equations.evaluate(q)
        if np.abs(phi).max(initial=0.0) < 1e-13:
            break
        q[free] += least_squares_step(jacobian[:, free], phi)
    return q


def analyse(
    equations: LoopEquations, active: Array, passive: Array, guess: Array
) -> Structure:
    """Close the machine at home and find out what its equations determine.

    Independent equations are chosen at the home posture by a QR factorisation with column
    pivoting of J_P^T; ranks are confirmed at other closed postures nearby.

    Args:
        equations: All loop equations.
        active: Columns of the active joints.
        passive: Columns of the others.
        guess: (nq,) active coordinates of the home posture and a guess of the others.

    Raises:
        MechanismError: Not closable from the guess, wrong number of active joints, or active
            joints that cannot drive the others.
    """
    model = equations.model
    names = list(model.names)[1:]
    everything = np.arange(model.nv)
    if not equations.loops:
        if len(passive):
            raise MechanismError(_missing(names, active, passive, model.nv))
        none = np.zeros(0, dtype=np.intp)
        return Structure(guess.copy(), none, none, ())
    somewhere = _close(equations, guess, everything)
    _check_closed(equations, somewhere, names, active, guess, "from the guess under 'home'")
    random = np.random.default_rng(0)
    postures = [somewhere]
    for _ in range(4):
        moved = somewhere + random.uniform(-0.02, 0.02, model.nv)
        near = _close(equations, moved, everything)
        if np.abs(equations.evaluate(near)[0]).max() < _CLOSED:
            postures.append(near)
    rank = max(_rank(equations.evaluate(q)[1]) for q in postures)
    freedom = model.nv - rank
    if freedom != len(active):
        stuck = _undetermined(equations, postures, passive)
        raise MechanismError(_missing(names, active, stuck, freedom))
    drivable = max(_rank(equations.evaluate(q)[1][:, passive]) for q in postures)
    if drivable < rank:
        stuck = _undetermined(equations, postures, passive)
        raise MechanismError(
            f"the active joints {_list(names, active)} cannot drive {_list(names, stuck)}: "
            "choose others"
        )
    home = _close(equations, guess, passive)
    _check_closed(
        equations, home, names, active, guess,
        "at the active coordinates under 'home' (guess more passive joints there)",
    )  # fmt: skip
    turned = equations.turned_over(home)
    if turned is not None:
        raise MechanismError(
            f"loop '{turned}' closes with its frames turned over at home: guess its joints better"
        )
    jacobian = equations.evaluate(home)[1][:, passive]
    _, upper, pivots = qr(jacobian.T, mode="economic", pivoting=True)
    diagonal = np.abs(np.diag(upper))
    if (diagonal > _RANK * diagonal[0]).sum() < rank:
        raise MechanismError(
            f"the home posture ({_at(names, active, home)}) is at the edge of the assembly "
            "branch: choose another under 'home'"
        )
    rows, redundant = np.sort(pivots[:rank]), np.sort(pivots[rank:])
    incidence = np.zeros((rank, rank), dtype=bool)
    for _ in range(3):  # open postures: an entry that is zero only on closed ones must count
        q = home + random.uniform(-0.3, 0.3, model.nv)
        part = np.abs(equations.evaluate(q)[1][np.ix_(rows, passive)])
        incidence |= part > 1e-10 * part.max(initial=1.0)
    blocks = block_triangular(incidence)
    assert blocks is not None, "independent equations have a matching"
    return Structure(home, rows, redundant, tuple(blocks))


def _rank(jacobian: Array) -> int:
    if not jacobian.size:
        return 0
    values = np.linalg.svd(jacobian, compute_uv=False)
    return int((values > _RANK * values[0]).sum())


def _undetermined(equations: LoopEquations, postures: Sequence[Array], passive: Array) -> Array:
    """Passive joints that the loops leave free at held active joints."""
    free = np.zeros(len(passive))
    for q in postures:
        jacobian = equations.evaluate(q)[1][:, passive]
        _, values, right = np.linalg.svd(jacobian)
        rank = int((values > _RANK * values.max(initial=0.0)).sum())
        free = np.maximum(free, np.abs(right[rank:]).max(axis=0, initial=0.0))
    return passive[free > 1e-6]


def _check_closed(
    equations: LoopEquations, q: Array, names: Sequence[str], active: Array, guess: Array, how: str
) -> None:
    phi, _ = equations.evaluate(q)
    worst = int(np.abs(phi).argmax())
    if abs(phi[worst]) > _CLOSED:
        loop = equations.loops[equations.loop_of_row[worst]]
        raise MechanismError(
            f"{loop.where}: loop '{loop.name}' stays {abs(phi[worst]):.3g} m open {how}, at "
            f"{_at(names, active, guess)}: change 'home' or the frames"
        )


def _list(names: Sequence[str], columns: Array) -> str:
    return ", ".join(names[int(i)] for i in columns)


def _at(names: Sequence[str], active: Array, q: Array) -> str:
    return ", ".join(f"{names[int(i)]} = {q[int(i)]:.6g}" for i in active)


def _missing(names: Sequence[str], active: Array, stuck: Array, freedom: int) -> str:
    text = (
        f"{len(active)} active joints ({_list(names, active)}) for {freedom} degrees of freedom: "
    )
    if len(active) < freedom:
        return text + f"activate {freedom - len(active)} of {_list(names, stuck)} too"
    return text + f"name only {freedom} of them"
