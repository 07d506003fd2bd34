"""Which loop equations count, which joints they determine, and in what order they solve."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crane.closure.anywhere import unwound, winding
from crane.closure.blocks import Block, block_triangular
from crane.closure.choice import Choice, proposals, words
from crane.closure.equations import LoopEquations
from crane.closure.exactness import Exact, Surplus
from crane.common.errors import MechanismError
from crane.common.samples import Array

Indices = NDArray[np.intp]

_RANK = 1e-8  # relative size of a pivot that still counts
_SINGULAR = 1e-5  # the same at home, which closing finds to the root of rounding if singular
_NOTHING = 1e-9  # slope of an equation that no joint changes, all in shares of the machine's size


class HomeError(MechanismError):
    """The loops do not close from the guess, or only to a posture that cannot be home.

    Args:
        message: See `CraneError`.
        about: See `MechanismError`.
        reason: In a few words why.
    """

    def __init__(self, message: str, about: str, reason: str):
        super().__init__(message, about)
        self.reason = reason


class OpenLoopError(HomeError):
    """The loops do not close from the guess."""


class ActiveError(MechanismError):
    """Too many or too few active joints.

    Args:
        message: See `CraneError`.
        posture: (nq,) where the loops close; None where they leave no freedom.
        jacobian: (m, nv) of all equations there, in shares of the machine's size.
        choices: Active joints that would do.
    """

    def __init__(
        self,
        message: str,
        posture: Array | None,
        jacobian: Array,
        choices: Sequence[Choice] = (),
    ):
        super().__init__(message, "active", posture)
        self.jacobian = jacobian
        self.choices = tuple(choices)


@dataclass(frozen=True)
class Structure:
    """Result of `analyse`.

    Attributes:
        home: (nq,) the closed home posture.
        rows: (m,) independent equations, as many as there are passive joints.
        redundant: The other equations, which follow from them.
        blocks: (rows of `rows`, columns of the passive joints) in the order of solution.
        surplus: How far the other equations may be open, see `crane.closure.exactness`.
    """

    home: Array
    rows: Indices
    redundant: Indices
    blocks: tuple[Block, ...]
    surplus: Surplus = Surplus()

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


def analyse(
    equations: LoopEquations,
    active: Indices,
    passive: Indices,
    guess: Array,
    exact: Exact,
) -> Structure:
    """Close the machine at home and find out what its equations determine.

    Independent equations are chosen at the home posture; ranks are confirmed at other closed
    postures nearby, and that surplus equations hold there.

    Args:
        equations: All loop equations.
        active: Columns of the active joints, none to be told which might be.
        passive: Columns of the others.
        guess: (nq,) active coordinates of the home posture and a guess of the others.
        exact: How exactly the equations hold.

    Raises:
        MechanismError: Not closable from the guess or only there, wrong number of active joints,
            or active joints that cannot drive the others.
    """
    model = equations.model
    names = equations.coordinates.names
    everything = np.arange(model.nv)
    followers = [int(i) for i in range(model.nv) if (equations.factors[:, i] != 0).any()]
    if not equations.names:
        none = np.zeros((0, model.nv))
        if not len(active):
            raise ActiveError(_unnamed(model.nv) + f"try [{', '.join(names)}]", guess, none)
        if len(passive):
            raise ActiveError(_miscounted(names, active, passive, model.nv), guess, none)
        rows = np.zeros(0, dtype=np.intp)
        return Structure(guess.copy(), rows, rows, ())
    somewhere = exact.close(guess, everything)
    given = f" ({_at(names, active, guess)})" if len(active) else ""
    _check_closed(
        equations,
        exact,
        somewhere,
        f"from the home guess{given}",
        "correct the frames or the guess",
    )
    random = np.random.default_rng(0)
    postures = [somewhere]
    for _ in range(4):
        moved = somewhere + random.uniform(-0.02, 0.02, model.nv) * equations.units
        near = exact.close(moved, everything)
        if exact.is_closed(near):
            postures.append(near)
    jacobians = [exact.jacobian(q) for q in postures]
    units = equations.units
    for index, name in enumerate(equations.names):
        rows = equations.loop_of_row == index
        if max(np.abs(jacobian[rows] * units).max() for jacobian in jacobians) < _NOTHING:
            raise MechanismError(
                f"loop '{name}' locks nothing that the joints do not lock already: remove it",
                f"loop {name}",
            )
    rank = max(_rank(jacobian * units) for jacobian in jacobians)
    freedom = model.nv - rank
    lock = exact.locked_up(somewhere, freedom, _SINGULAR)
    if lock is not None:
        raise _overconstrained(equations, *lock)

    def proposed(**choice: Sequence[int]) -> list[Choice]:
        return proposals(model, jacobians[0], followers, **choice)

    if freedom != len(active) and _rank(jacobians[0] * units, _SINGULAR) < rank:
        raise HomeError(
            f"the home posture{given} is singular, where the linkage may go on in several ways: "
            "choose another under 'home'",
            "home",
            "the posture is singular",
        )
    if not len(active) and freedom:
        found = proposed()
        raise ActiveError(
            _unnamed(freedom) + _listed("try ", found), somewhere, jacobians[0], found
        )
    if freedom != len(active):
        stuck = _undetermined(jacobians, units, passive)
        text, found = _miscounted(names, active, stuck, freedom), proposed()
        if 0 < freedom < len(active):
            text += _listed(", such as ", proposed(among=[int(i) for i in active]))
        elif freedom - len(active) < len(stuck):
            text += _listed(", such as ", proposed(kept=[int(i) for i in active]))
        raise ActiveError(text, somewhere if freedom else None, jacobians[0], found)
    drivable = max(_rank((jacobian * units)[:, passive]) for jacobian in jacobians)
    if drivable < rank:
        stuck, found = _undetermined(jacobians, units, passive), proposed()
        raise ActiveError(
            f"the active joints {_list(names, active)} cannot drive {_list(names, stuck)}: "
            f"choose others{_listed(', such as ', found)}",
            somewhere,
            jacobians[0],
            found,
        )
    home = exact.close(guess, passive)
    home = _unwound(equations, home, passive)
    _check_closed(
        equations,
        exact,
        home,
        f"at home{given}",
        "choose other values or guess more passive joints",
    )
    turned = equations.turned_over(home)
    if turned is not None:
        raise HomeError(
            f"loop '{turned}' closes at home with its axes opposed: turn a frame over, or guess "
            "its joints better",
            f"loop {turned}",
            f"loop '{turned}' closes with its axes opposed",
        )
    independent = exact.independent(home, passive, rank, _SINGULAR)
    if independent is None:
        other = ""
        if (
            _rank(exact.jacobian(home) * units, _SINGULAR) == rank
        ):  # a dead centre of these drives only
            other = _listed(", or drive it by ", proposed())
        raise HomeError(
            f"the home posture ({_at(names, active, home)}) is at the edge of the assembly "
            f"branch: choose another under 'home'{other}",
            "home",
            "the posture is at the edge of its branch",
        )
    rows, redundant = independent
    lock, surplus = exact.surplus(home, rows, redundant, active)
    if lock is not None:
        raise _overconstrained(equations, *lock)
    incidence = np.zeros((rank, rank), dtype=bool)
    for _ in range(3):  # open postures: an entry that is zero only on closed ones must count
        q = home + random.uniform(-0.3, 0.3, model.nv) * units
        part = np.abs(equations.scaled(q)[1][np.ix_(rows, passive)])
        incidence |= part > 1e-10 * part.max(initial=1.0)
    blocks = block_triangular(incidence)
    assert blocks is not None, "independent equations have a matching"
    return Structure(home, rows, redundant, tuple(blocks), surplus)


def _unwound(equations: LoopEquations, home: Array, passive: Indices) -> Array:
    """Home without the whole turns that pins have wound up: in limits, or half a turn."""
    coordinates = equations.coordinates
    lower, upper = coordinates.lower, coordinates.upper
    winds = winding(equations)
    winds[np.setdiff1d(np.arange(len(home)), passive)] = False
    near = np.where(np.isinf(lower) | np.isinf(upper), 0.0, home)
    return unwound(home, near, winds, lower, upper)


def _rank(jacobian: Array, tolerance: float = _RANK) -> int:
    if not jacobian.size:
        return 0
    values = np.linalg.svd(jacobian, compute_uv=False)
    return int((values > tolerance * values[0]).sum())


def _overconstrained(equations: LoopEquations, row: int, gap: float) -> MechanismError:
    name, gap = equations.names[equations.loop_of_row[row]], gap * equations.row_units[row]
    unit = "m" if equations.is_translation[row] else "rad"
    return MechanismError(
        f"loop '{name}' closes at home only: a small step beside it leaves it {gap:.2g} {unit} "
        "open, though to first order the joints could move; the machine is overconstrained and "
        "locks up, correct frames and axes or use a looser loop type",
        f"loop {name}",
    )


def _undetermined(jacobians: Sequence[Array], units: Array, passive: Indices) -> Indices:
    """Passive joints that the loops leave free at held active joints."""
    free = np.zeros(len(passive))
    for jacobian in jacobians:
        _, values, right = np.linalg.svd((jacobian * units)[:, passive])
        rank = int((values > _RANK * values.max(initial=0.0)).sum())
        free = np.maximum(free, np.abs(right[rank:]).max(axis=0, initial=0.0))
    return passive[free > 1e-6]


def _check_closed(equations: LoopEquations, exact: Exact, q: Array, where: str, hint: str) -> None:
    phi, _ = equations.evaluate(q)
    worst = int((np.abs(phi) / exact.closed).argmax())
    if not abs(phi[worst]) <= exact.closed[worst]:  # also NaN
        loop = equations.names[equations.loop_of_row[worst]]
        gap = f"{abs(phi[worst]):.3g} {'m' if equations.is_translation[worst] else 'rad'}"
        raise OpenLoopError(
            f"loop '{loop}' cannot be closed {where}: it stays {gap} open, {hint}",
            f"loop {loop}",
            f"loop '{loop}' stays {gap} open",
        )


def _listed(before: str, choices: Sequence[Choice]) -> str:
    return f"{before}{words(choices)}" if choices else ""


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
