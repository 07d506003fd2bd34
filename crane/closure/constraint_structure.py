"""Analysis of the loop equations: independent rows, rank, passive joints and order of solution.

The order is the block triangular form: blocks of equations are solved one after another.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from graphlib import TopologicalSorter

import numpy as np
from numpy.typing import NDArray

from crane.closure.active_joint_selection import (
    ActiveJointSelection,
    propose_active_joints,
)
from crane.closure.constraint_tolerances import ExactConstraints, RedundancyGap
from crane.closure.coordinates import Indices
from crane.closure.loop_equations import LoopEquations
from crane.closure.multi_start_search import periodic_coordinates, remove_revolutions
from crane.common.errors import MechanismError
from crane.common.one_line_repr import format_count
from crane.common.samples import Array

Block = tuple[Indices, Indices]  # rows and columns

_RANK_TOLERANCE = 1e-8  # relative singular value that still counts
# the same at home: a singular home is found to the square root of rounding only
_SINGULAR_TOLERANCE = 1e-5
# scaled derivative that counts as zero
_ZERO_TOLERANCE = 1e-9


_DEGREES = "degree of freedom", "degrees of freedom"


class HomeError(MechanismError):
    """The loops do not close from the initial guess, or not at a valid home configuration.

    Args:
        message: See `CraneError`.
        subject: See `MechanismError`.
        reason: The cause in a few words.
    """

    def __init__(self, message: str, subject: str, reason: str):
        super().__init__(message, subject)
        self.reason = reason


class OpenLoopError(HomeError):
    """The loops do not close from the initial guess."""


class ActiveJointError(MechanismError):
    """Too many or too few active joints.

    Args:
        message: See `CraneError`.
        configuration: (nq,) where the loops close; None if they leave no degree of freedom.
        jacobian: (m, nv) scaled Jacobian of all equations there.
        selections: Selections of active joints that drive the machine.
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
        home: (nq,) closed home configuration.
        independent_rows: (m,) independent equations, as many as there are passive joints.
        redundant_rows: The other equations, which follow from them.
        blocks: (rows of `independent_rows`, columns of the passive joints) in the order of
            solution.
        redundancy: Tolerance of the redundant equations, see
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
    """Close the loops at home and analyse which joints the equations determine.

    Independent equations are selected at the home configuration. Ranks are confirmed, and
    redundant equations are checked, at other closed configurations nearby.

    Args:
        equations: All loop equations.
        active: Columns of the active joints; none, to get proposals in the error.
        passive: Columns of the other joints.
        initial_guess: (nq,) active coordinates of home, and an initial guess of the others.
        constraints: How exactly the equations hold.

    Raises:
        MechanismError: The loops do not close from the guess, or close only there; the number of
            active joints is wrong; or the active joints do not determine the others.
    """
    return _ConstraintAnalysis(equations, active, passive, initial_guess, constraints).run()


class _ConstraintAnalysis:
    """The steps of `analyse_constraints`, which has the same arguments."""

    def __init__(
        self,
        equations: LoopEquations,
        active: Indices,
        passive: Indices,
        initial_guess: Array,
        constraints: ExactConstraints,
    ):
        self._equations, self._active, self._passive = equations, active, passive
        self._guess, self._constraints = initial_guess, constraints
        self._coordinates, self._units = equations.coordinates, equations.coordinate_units
        self._random = np.random.default_rng(0)
        values = self._coordinates.format_values(active, initial_guess[active])
        self._active_text = f" ({values})" if values else ""

    def _run_without_loops(self) -> ConstraintStructure:
        """The structure of a machine without loops, whose joints are all active."""
        nv, none = self._equations.model.nv, np.zeros(0, dtype=np.intp)
        jacobian = np.zeros((0, nv))
        if not len(self._active):
            text = f"{_missing_active_joints_text(nv)}try [{', '.join(self._coordinates.names)}]"
            raise ActiveJointError(text, self._guess, jacobian)
        if len(self._passive):
            text = self._wrong_count_text(self._passive, nv)
            raise ActiveJointError(text, self._guess, jacobian)
        return ConstraintStructure(self._guess.copy(), none, none, ())

    def run(self) -> ConstraintStructure:
        """The structure of a machine."""
        if not self._equations.names:
            return self._run_without_loops()
        first = self._constraints.close_loops(self._guess, np.arange(self._equations.model.nv))
        self._check_closed(
            first, f"from the home guess{self._active_text}", "correct the frames or the guess"
        )
        jacobians = [self._constraints.intended_jacobian(q) for q in self._neighbours(first)]
        for index, name in enumerate(self._equations.names):
            loop_rows = self._equations.loop_of_row == index
            derivatives = [jacobian[loop_rows] * self._units for jacobian in jacobians]
            if np.abs(derivatives).max() < _ZERO_TOLERANCE:
                text = "locks nothing that the joints do not lock already: remove it"
                raise MechanismError(f"loop '{name}' {text}", f"loop {name}")
        rank = max(_numerical_rank(jacobian * self._units) for jacobian in jacobians)
        self._check_active_joints(first, jacobians, rank)
        home = self._close_home()
        rows, redundant = self._independent_rows(home, jacobians[0], rank)
        lock, redundancy = self._constraints.assess_redundancy(home, rows, redundant, self._active)
        if lock is not None:
            raise self._overconstrained_error(*lock)
        blocks = block_triangular_form(self._incidence(home, rows))
        assert blocks is not None, "independent equations have a matching"
        return ConstraintStructure(home, rows, redundant, tuple(blocks), redundancy)

    def _neighbours(self, first: Array) -> list[Array]:
        """A closed configuration and others near it."""
        found, nv = [first], self._equations.model.nv
        for _ in range(4):
            closed = self._constraints.close_loops(
                first + self._random.uniform(-0.02, 0.02, nv) * self._units, np.arange(nv)
            )
            if self._constraints.is_closed(closed):
                found.append(closed)
        return found

    def _check_active_joints(self, q: Array, jacobians: Sequence[Array], rank: int) -> None:
        """Raise unless the active joints are as many as the mobility, and drive the others."""
        active, mobility = self._active, self._equations.model.nv - rank
        lock = self._constraints.find_locked_equation(q, mobility, _SINGULAR_TOLERANCE)
        if lock is not None:
            raise self._overconstrained_error(*lock)
        if (
            mobility != len(active)
            and _numerical_rank(jacobians[0] * self._units, _SINGULAR_TOLERANCE) < rank
        ):
            raise HomeError(
                f"the home configuration{self._active_text} is singular, where the linkage may "
                "continue in several ways: choose another under 'home'",
                "home",
                "the configuration is singular",
            )
        if (
            mobility == len(active)
            and max(_numerical_rank((x * self._units)[:, self._passive]) for x in jacobians)
            == rank
        ):
            return
        found = self._propose(jacobians[0])
        raise ActiveJointError(
            self._active_joints_problem(mobility, jacobians, found),
            q if mobility else None,
            jacobians[0],
            found,
        )

    def _active_joints_problem(
        self, mobility: int, jacobians: Sequence[Array], found: Sequence[ActiveJointSelection]
    ) -> str:
        active, undetermined = self._active, self._undetermined_joints(jacobians)
        if mobility == len(active):
            return (
                f"the active joints {self._format_names(active)} cannot drive "
                f"{self._format_names(undetermined)}: "
                f"choose others{_format_proposals(', such as ', found)}"
            )
        if not len(active) and mobility:
            return _missing_active_joints_text(mobility) + _format_proposals("try ", found)
        given, proposals = active.tolist(), list[ActiveJointSelection]()
        if 0 < mobility < len(active):
            proposals = self._propose(jacobians[0], candidates=given)
        elif mobility - len(active) < len(undetermined):
            proposals = self._propose(jacobians[0], required=given)
        return self._wrong_count_text(undetermined, mobility) + _format_proposals(
            ", such as ", proposals
        )

    def _close_home(self) -> Array:
        """Home with the active joints as in the guess."""
        home = self._constraints.close_loops(self._guess, self._passive)
        # full revolutions of passive joints are removed, within limits or half a revolution
        lower, upper = self._coordinates.lower, self._coordinates.upper
        is_passive = np.isin(np.arange(len(home)), self._passive)
        periodic = periodic_coordinates(self._equations) & is_passive
        nearby = np.where(np.isinf(lower) | np.isinf(upper), 0.0, home)
        home = remove_revolutions(home, nearby, periodic, lower, upper)
        home = self._coordinates.wrap_rotations(home, self._passive)
        self._check_closed(
            home, f"at home{self._active_text}", "choose other values or guess more passive joints"
        )
        opposed_loop = self._equations.find_opposed_loop(home)
        if opposed_loop is not None:
            raise HomeError(
                f"loop '{opposed_loop}' closes at home with its axes opposed: turn a frame over, "
                "or guess its joints better",
                f"loop {opposed_loop}",
                f"loop '{opposed_loop}' closes with its axes opposed",
            )
        return home

    def _independent_rows(
        self, home: Array, first_jacobian: Array, rank: int
    ) -> tuple[Indices, Indices]:
        """Independent and redundant rows at home."""
        passive, tolerance = self._passive, _SINGULAR_TOLERANCE
        found = self._constraints.select_independent_rows(home, passive, rank, tolerance)
        if found is not None:
            return found
        other = ""
        jacobian = self._constraints.intended_jacobian(home) * self._units
        # a dead centre of these active joints only
        if _numerical_rank(jacobian, tolerance) == rank:
            other = _format_proposals(", or drive it by ", self._propose(first_jacobian))
        values = self._coordinates.format_values(self._active, home[self._active])
        raise HomeError(
            f"the home configuration ({values}) is at the edge of the branch: choose another "
            f"under 'home'{other}",
            "home",
            "the configuration is at the edge of its branch",
        )

    def _incidence(self, home: Array, rows: Indices) -> NDArray[np.bool_]:
        """Whether each independent row contains each passive joint."""
        incidence = np.zeros((len(rows), len(rows)), dtype=bool)
        # open configurations: an entry that vanishes on closed ones only counts
        for _ in range(3):
            q = home + self._random.uniform(-0.3, 0.3, len(home)) * self._units
            part = np.abs(self._equations.evaluate_scaled(q)[1][np.ix_(rows, self._passive)])
            incidence |= part > 1e-10 * part.max(initial=1.0)
        return incidence

    def _propose(self, jacobian: Array, **choice: Sequence[int]) -> list[ActiveJointSelection]:
        return propose_active_joints(self._equations, jacobian, **choice)

    def _undetermined_joints(self, jacobians: Sequence[Array]) -> Indices:
        """Columns of the passive joints that can move while the active joints are held."""
        free = np.zeros(len(self._passive))
        for jacobian in jacobians:
            _, values, right = np.linalg.svd((jacobian * self._units)[:, self._passive])
            rank = int((values > _RANK_TOLERANCE * values.max(initial=0.0)).sum())
            free = np.maximum(free, np.abs(right[rank:]).max(axis=0, initial=0.0))
        return self._passive[free > 1e-6]

    def _check_closed(self, q: Array, place: str, hint: str) -> None:
        phi, tolerances = self._equations.evaluate(q)[0], self._constraints.closed_tolerances
        worst = int((np.abs(phi) / tolerances).argmax())
        if not abs(phi[worst]) <= tolerances[worst]:  # also NaN
            loop = self._equations.name_of_row(worst)
            gap = f"{abs(phi[worst]):.3g} {self._equations.unit_of_row(worst)}"
            raise OpenLoopError(
                f"loop '{loop}' cannot be closed {place}: it stays {gap} open, {hint}",
                f"loop {loop}",
                f"loop '{loop}' stays {gap} open",
            )

    def _overconstrained_error(self, row: int, gap: float) -> MechanismError:
        name, unit = self._equations.name_of_row(row), self._equations.unit_of_row(row)
        gap *= self._equations.residual_units[row]
        return MechanismError(
            f"loop '{name}' closes at home only: a small step beside it leaves it {gap:.2g} "
            f"{unit} open, though to first order the joints could move; the machine is "
            "overconstrained and locks up, correct frames and axes or use a looser loop type",
            f"loop {name}",
        )

    def _format_names(self, columns: Indices) -> str:
        return ", ".join(self._coordinates.names[int(i)] for i in columns)

    def _wrong_count_text(self, undetermined: Indices, mobility: int) -> str:
        names, count = self._format_names(self._active), len(self._active)
        if mobility == 0:
            return (
                f"the loops leave {names or 'all joints'} no freedom to move: check the types "
                "and axes of the loops, and the axes of the joints"
            )
        degrees = format_count(mobility, *_DEGREES)
        text = f"{format_count(count, 'active joint')} ({names}) for {degrees}: "
        if mobility < count:
            return text + f"name only {mobility} of them"
        missing = mobility - count
        some = "" if missing == len(undetermined) else f"{missing} of "
        return text + f"activate {some}{self._format_names(undetermined)} too"


def _numerical_rank(jacobian: Array, tolerance: float = _RANK_TOLERANCE) -> int:
    if not jacobian.size:
        return 0
    values = np.linalg.svd(jacobian, compute_uv=False)
    return int((values > tolerance * values[0]).sum())


def _format_proposals(prefix: str, selections: Sequence[ActiveJointSelection]) -> str:
    return prefix + ", or ".join(map(str, selections)) if selections else ""


def _missing_active_joints_text(mobility: int) -> str:
    count = "one" if mobility == 1 else mobility
    return f"{format_count(mobility, *_DEGREES)} and no active joints, name {count}: "


def block_triangular_form(incidence: NDArray[np.bool_]) -> list[Block] | None:
    """Permute square equations into blocks that can be solved one after another.

    A maximum matching assigns one unknown to every equation; the strongly connected components of
    the graph "equation i needs the unknown of equation j" are the blocks (Duff, Erisman, Reid:
    Direct Methods for Sparse Matrices, chapter 6).

    Args:
        incidence: (m, m), whether equation i contains unknown j.

    Returns:
        Blocks (rows, columns) in the order of solution; None if the equations are structurally
        singular.
    """
    if len(incidence) == 0:
        return []
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components, maximum_bipartite_matching

    unknown_of = maximum_bipartite_matching(csr_array(incidence), perm_type="column")
    if (unknown_of < 0).any():
        return None
    dependencies = incidence[:, unknown_of]  # equation i needs the unknown of equation j
    count, label = connected_components(csr_array(dependencies.astype(float)), connection="strong")
    order = TopologicalSorter({block: set[int]() for block in range(count)})
    for i, j in np.argwhere(dependencies):
        if label[i] != label[j]:
            order.add(int(label[i]), int(label[j]))
    blocks = []
    for block in order.static_order():
        rows = np.flatnonzero(label == block)
        columns = np.sort(unknown_of[rows]).astype(np.intp)
        order_of_rows, order_of_columns = _fill_reducing_order(incidence[np.ix_(rows, columns)])
        blocks.append((rows[order_of_rows], columns[order_of_columns]))
    return blocks


def _fill_reducing_order(incidence: NDArray[np.bool_]) -> tuple[list[int], list[int]]:
    """An order of rows and columns in which Householder reflections cause little fill-in.

    The next column is the one whose reflection takes the fewest operations: the number of rows
    with an entry in it, times the number of unknowns in these rows. The rows have the same pattern
    afterwards.
    """
    pattern = incidence.copy()
    remaining_rows, remaining_columns = list(range(len(pattern))), list(range(len(pattern)))
    rows, columns = [], []
    while remaining_columns:

        def cost(column: int) -> int:
            mixed = pattern[:, column]
            return int(mixed.sum() * (pattern[mixed].any(axis=0).sum() - 1))

        column = min(remaining_columns, key=cost)
        affected = [row for row in remaining_rows if pattern[row, column]]
        pivot = min(affected, key=lambda row: int(pattern[row].sum()))
        pattern[affected] = pattern[affected].any(axis=0)
        pattern[pivot] = False
        pattern[:, column] = False
        remaining_rows.remove(pivot)
        remaining_columns.remove(column)
        rows.append(pivot)
        columns.append(column)
    return rows, columns
