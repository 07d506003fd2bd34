"""Which loop equations count, which joints they determine, and in what order they solve."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crane.closure.active_joint_selection import (
    ActiveJointSelection,
    format_selections,
    propose_active_joints,
)
from crane.closure.block_triangular_form import Block, block_triangular_form
from crane.closure.constraint_tolerances import ExactConstraints, RedundancyGap
from crane.closure.loop_equations import LoopEquations
from crane.closure.multi_start_search import periodic_coordinates, remove_revolutions
from crane.common.errors import MechanismError
from crane.common.samples import Array

Indices = NDArray[np.intp]

_RANK_TOLERANCE = 1e-8  # relative size of a pivot that still counts
_SINGULAR_TOLERANCE = (
    1e-5  # the same at home, which closing finds to the root of rounding if singular
)
_ZERO_TOLERANCE = (
    1e-9  # slope of an equation that no joint changes, all in shares of the machine's size
)


class HomeError(MechanismError):
    """The loops do not close from the guess, or only to a posture that cannot be home.

    Args:
        message: See `CraneError`.
        subject: See `MechanismError`.
        reason: In a few words why.
    """

    def __init__(self, message: str, subject: str, reason: str):
        super().__init__(message, subject)
        self.reason = reason


class OpenLoopError(HomeError):
    """The loops do not close from the guess."""


class ActiveJointError(MechanismError):
    """Too many or too few active joints.

    Args:
        message: See `CraneError`.
        configuration: (nq,) where the loops close; None where they leave no freedom.
        jacobian: (m, nv) of all equations there, in shares of the machine's size.
        selections: Active joints that would do.
    """

    def __init__(
        self,
        message: str,
        configuration: Array | None,
        jacobian: Array,
        selections: Sequence[ActiveJointSelection] = (),
    ):
        super().__init__(message, "active", configuration)
        self.jacobian = jacobian
        self.selections = tuple(selections)


@dataclass(frozen=True)
class ConstraintStructure:
    """Result of `analyse_constraints`.

    Attributes:
        home: (nq,) the closed home posture.
        independent_rows: (m,) independent equations, as many as there are passive joints.
        redundant_rows: The other equations, which follow from them.
        blocks: (rows of `independent_rows`, columns of the passive joints) in the order of
            solution.
        redundancy: How far the other equations may be open, see
            `crane.closure.constraint_tolerances`.
    """

    home: Array
    independent_rows: Indices
    redundant_rows: Indices
    blocks: tuple[Block, ...]
    redundancy: RedundancyGap = RedundancyGap()

    def blocks_by_size(self) -> list[tuple[Indices, Indices]]:
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


def analyse_constraints(
    equations: LoopEquations,
    active: Indices,
    passive: Indices,
    initial_guess: Array,
    constraints: ExactConstraints,
) -> ConstraintStructure:
    """Close the machine at home and find out what its equations determine.

    Independent equations are chosen at the home posture; ranks are confirmed at other closed
    postures nearby, and that surplus equations hold there.

    Args:
        equations: All loop equations.
        active: Columns of the active joints, none to be told which might be.
        passive: Columns of the others.
        initial_guess: (nq,) active coordinates of the home posture and a guess of the others.
        constraints: How exactly the equations hold.

    Raises:
        MechanismError: Not closable from the guess or only there, wrong number of active joints,
            or active joints that cannot drive the others.
    """
    model = equations.model
    names = equations.coordinates.names
    all_columns = np.arange(model.nv)
    coupled = [int(i) for i in range(model.nv) if (equations.coupling_factors[:, i] != 0).any()]
    if not equations.names:
        none = np.zeros((0, model.nv))
        if not len(active):
            raise ActiveJointError(
                _missing_active_joints_text(model.nv) + f"try [{', '.join(names)}]",
                initial_guess,
                none,
            )
        if len(passive):
            raise ActiveJointError(
                _wrong_count_text(names, active, passive, model.nv), initial_guess, none
            )
        rows = np.zeros(0, dtype=np.intp)
        return ConstraintStructure(initial_guess.copy(), rows, rows, ())
    first_configuration = constraints.close_loops(initial_guess, all_columns)
    active_text = (
        f" ({_format_active_coordinates(names, active, initial_guess)})" if len(active) else ""
    )
    _check_closed(
        equations,
        constraints,
        first_configuration,
        f"from the home guess{active_text}",
        "correct the frames or the guess",
    )
    random = np.random.default_rng(0)
    configurations = [first_configuration]
    for _ in range(4):
        perturbed = (
            first_configuration
            + random.uniform(-0.02, 0.02, model.nv) * equations.coordinate_units
        )
        closed = constraints.close_loops(perturbed, all_columns)
        if constraints.is_closed(closed):
            configurations.append(closed)
    jacobians = [constraints.intended_jacobian(q) for q in configurations]
    units = equations.coordinate_units
    for index, name in enumerate(equations.names):
        rows = equations.loop_of_row == index
        if max(np.abs(jacobian[rows] * units).max() for jacobian in jacobians) < _ZERO_TOLERANCE:
            raise MechanismError(
                f"loop '{name}' locks nothing that the joints do not lock already: remove it",
                f"loop {name}",
            )
    rank = max(_numerical_rank(jacobian * units) for jacobian in jacobians)
    mobility = model.nv - rank
    lock = constraints.find_locked_equation(first_configuration, mobility, _SINGULAR_TOLERANCE)
    if lock is not None:
        raise _overconstrained_error(equations, *lock)

    def proposed(**choice: Sequence[int]) -> list[ActiveJointSelection]:
        return propose_active_joints(model, jacobians[0], coupled, **choice)

    if (
        mobility != len(active)
        and _numerical_rank(jacobians[0] * units, _SINGULAR_TOLERANCE) < rank
    ):
        raise HomeError(
            f"the home posture{active_text} is singular, where the linkage may go on in several "
            f"ways: "
            "choose another under 'home'",
            "home",
            "the posture is singular",
        )
    if not len(active) and mobility:
        found = proposed()
        raise ActiveJointError(
            _missing_active_joints_text(mobility) + _format_proposals("try ", found),
            first_configuration,
            jacobians[0],
            found,
        )
    if mobility != len(active):
        undetermined = _undetermined_joints(jacobians, units, passive)
        text, found = _wrong_count_text(names, active, undetermined, mobility), proposed()
        if 0 < mobility < len(active):
            text += _format_proposals(", such as ", proposed(candidates=[int(i) for i in active]))
        elif mobility - len(active) < len(undetermined):
            text += _format_proposals(", such as ", proposed(required=[int(i) for i in active]))
        raise ActiveJointError(
            text, first_configuration if mobility else None, jacobians[0], found
        )
    passive_rank = max(_numerical_rank((jacobian * units)[:, passive]) for jacobian in jacobians)
    if passive_rank < rank:
        undetermined, found = _undetermined_joints(jacobians, units, passive), proposed()
        raise ActiveJointError(
            f"the active joints {_format_names(names, active)} cannot drive "
            f"{_format_names(names, undetermined)}: "
            f"choose others{_format_proposals(', such as ', found)}",
            first_configuration,
            jacobians[0],
            found,
        )
    home = constraints.close_loops(initial_guess, passive)
    home = _remove_revolutions_from_home(equations, home, passive)
    _check_closed(
        equations,
        constraints,
        home,
        f"at home{active_text}",
        "choose other values or guess more passive joints",
    )
    opposed_loop = equations.find_opposed_loop(home)
    if opposed_loop is not None:
        raise HomeError(
            f"loop '{opposed_loop}' closes at home with its axes opposed: turn a frame over, or "
            f"guess "
            "its joints better",
            f"loop {opposed_loop}",
            f"loop '{opposed_loop}' closes with its axes opposed",
        )
    independent = constraints.select_independent_rows(home, passive, rank, _SINGULAR_TOLERANCE)
    if independent is None:
        other = ""
        if (
            _numerical_rank(constraints.intended_jacobian(home) * units, _SINGULAR_TOLERANCE)
            == rank
        ):  # a dead centre of these drives only
            other = _format_proposals(", or drive it by ", proposed())
        raise HomeError(
            f"the home posture ({_format_active_coordinates(names, active, home)}) is at the "
            f"edge of the assembly "
            f"branch: choose another under 'home'{other}",
            "home",
            "the posture is at the edge of its branch",
        )
    rows, redundant = independent
    lock, surplus = constraints.assess_redundancy(home, rows, redundant, active)
    if lock is not None:
        raise _overconstrained_error(equations, *lock)
    incidence = np.zeros((rank, rank), dtype=bool)
    for _ in range(3):  # open postures: an entry that is zero only on closed ones must count
        q = home + random.uniform(-0.3, 0.3, model.nv) * units
        part = np.abs(equations.evaluate_scaled(q)[1][np.ix_(rows, passive)])
        incidence |= part > 1e-10 * part.max(initial=1.0)
    blocks = block_triangular_form(incidence)
    assert blocks is not None, "independent equations have a matching"
    return ConstraintStructure(home, rows, redundant, tuple(blocks), surplus)


def _remove_revolutions_from_home(
    equations: LoopEquations, home: Array, passive: Indices
) -> Array:
    """Home without the whole turns that pins have wound up: in limits, or half a turn."""
    coordinates = equations.coordinates
    lower, upper = coordinates.lower, coordinates.upper
    periodic = periodic_coordinates(equations)
    periodic[np.setdiff1d(np.arange(len(home)), passive)] = False
    nearby = np.where(np.isinf(lower) | np.isinf(upper), 0.0, home)
    return remove_revolutions(home, nearby, periodic, lower, upper)


def _numerical_rank(jacobian: Array, tolerance: float = _RANK_TOLERANCE) -> int:
    if not jacobian.size:
        return 0
    values = np.linalg.svd(jacobian, compute_uv=False)
    return int((values > tolerance * values[0]).sum())


def _overconstrained_error(equations: LoopEquations, row: int, gap: float) -> MechanismError:
    name, gap = equations.names[equations.loop_of_row[row]], gap * equations.residual_units[row]
    unit = "m" if equations.is_translation[row] else "rad"
    return MechanismError(
        f"loop '{name}' closes at home only: a small step beside it leaves it {gap:.2g} {unit} "
        "open, though to first order the joints could move; the machine is overconstrained and "
        "locks up, correct frames and axes or use a looser loop type",
        f"loop {name}",
    )


def _undetermined_joints(jacobians: Sequence[Array], units: Array, passive: Indices) -> Indices:
    """Passive joints that the loops leave free at held active joints."""
    free = np.zeros(len(passive))
    for jacobian in jacobians:
        _, values, right = np.linalg.svd((jacobian * units)[:, passive])
        rank = int((values > _RANK_TOLERANCE * values.max(initial=0.0)).sum())
        free = np.maximum(free, np.abs(right[rank:]).max(axis=0, initial=0.0))
    return passive[free > 1e-6]


def _check_closed(
    equations: LoopEquations, constraints: ExactConstraints, q: Array, where: str, hint: str
) -> None:
    phi, _ = equations.evaluate(q)
    worst = int((np.abs(phi) / constraints.closed_tolerances).argmax())
    if not abs(phi[worst]) <= constraints.closed_tolerances[worst]:  # also NaN
        loop = equations.names[equations.loop_of_row[worst]]
        gap = f"{abs(phi[worst]):.3g} {'m' if equations.is_translation[worst] else 'rad'}"
        raise OpenLoopError(
            f"loop '{loop}' cannot be closed {where}: it stays {gap} open, {hint}",
            f"loop {loop}",
            f"loop '{loop}' stays {gap} open",
        )


def _format_proposals(prefix: str, selections: Sequence[ActiveJointSelection]) -> str:
    return f"{prefix}{format_selections(selections)}" if selections else ""


def _format_names(names: Sequence[str], columns: Indices) -> str:
    return ", ".join(names[int(i)] for i in columns)


def _format_active_coordinates(names: Sequence[str], active: Indices, q: Array) -> str:
    return ", ".join(f"{names[int(i)]} = {q[int(i)]:.6g}" for i in active)


def _missing_active_joints_text(mobility: int) -> str:
    return (
        f"{mobility} degree{'s' * (mobility != 1)} of freedom and no active joints, name "
        f"{'one' if mobility == 1 else mobility}: "
    )


def _wrong_count_text(
    names: Sequence[str], active: Indices, undetermined: Indices, mobility: int
) -> str:
    if mobility == 0:
        listed = _format_names(names, active) or "all joints"
        return (
            f"the loops leave {listed} no freedom to move: check the types and axes "
            "of the loops, and the axes of the joints"
        )
    text = (
        f"{len(active)} active joint{'s' * (len(active) != 1)} ({_format_names(names, active)}) "
        f"for "
        f"{mobility} degree{'s' * (mobility != 1)} of freedom: "
    )
    missing = mobility - len(active)
    if missing < 0:
        return text + f"name only {mobility} of them"
    some = "" if missing == len(undetermined) else f"{missing} of "
    return text + f"activate {some}{_format_names(names, undetermined)} too"
