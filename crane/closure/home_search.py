"""The home configuration of a machine: closed from the initial guess, or by a multi-start search.

Where the loops do not close from the guess, they are closed by a multi-start search (see
`crane.closure.multi_start_search`):

1. with the active joints held, all others within their limits;
2. with those active joints free, too, whose home the file does not specify;
3. the same two with passive joints beyond their limits.

The first stage that closes decides; of its configurations the one nearest to the guess is taken,
see `MultiStartSearch.find_configurations`. The search also runs where the number of active joints
does not fit the mobility at the configuration that closes, and where home as closed from the guess
violates limits or is more than 0.5 rad (or half of the characteristic length) from the file's
values. In that case home is only replaced by a configuration nearer to the guess.

Deviations from the file are measured by the joints of links in loops, see
`MultiStartSearch.largest_specified_deviation`, and by the orientation of the loops. In a plane the
determinant of the two equations of a loop for its two passive joints is

    det dphi / d(q_1, q_2) = l_1 l_2 sin(angle between the links).

Its sign is the side on which their pin lies: it changes where the loop is in its other assembly
mode.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crane.closure.constraint_structure import (
    ActiveJointError,
    ConstraintStructure,
    HomeError,
    analyse_constraints,
)
from crane.closure.constraint_tolerances import (
    CLOSED_TOLERANCE,
    FILE_PRECISION,
    ExactConstraints,
    RedundancyGap,
    RoundedConstraints,
)
from crane.closure.coordinates import Indices
from crane.closure.loop_equations import LoopEquations
from crane.closure.multi_start_search import MultiStartSearch
from crane.codegen import cached_result
from crane.common.errors import MechanismError
from crane.common.samples import Array
from crane.common.threads import single_threaded_blas

_MAX_CANDIDATES = 4  # configurations that are tried as home
# scaled distance of equal configurations
_SAME_CONFIGURATION_TOLERANCE = 1e-3
FAR = 0.5  # scaled distance from the file's values beyond which home is doubtful


@dataclass(frozen=True)
class HomeSearchResult:
    """How home was found where it did not follow from the initial guess.

    Attributes:
        reason: Why it did not follow.
        configuration_count: Number of configurations that were found.
        moved_columns: Columns of joints whose coordinate differs from the guess.
        largest_deviation: Column of the joint farthest from the guess, and its distance [m],
            [rad].
        specified_deviation: Column of the joint farthest from the file's value, and its scaled
            distance; see `MultiStartSearch.largest_specified_deviation`.
        reversed: Names of loops in the other assembly mode than the guess.
    """

    reason: str
    configuration_count: int
    moved_columns: Indices
    largest_deviation: tuple[int, float]
    specified_deviation: tuple[int, float]
    reversed: tuple[str, ...]

    @property
    def is_far(self) -> bool:
        """Whether home is far from the configuration that the file specifies."""
        return self.specified_deviation[1] > FAR


def find_home(
    equations: LoopEquations,
    active: Indices,
    passive: Indices,
    initial_guess: Array,
    specified: Collection[int] | None,
    movable: Collection[int] = (),
) -> tuple[ConstraintStructure, HomeSearchResult | None]:
    """Structure and home of a machine, and how home was found if not from the guess.

    Args:
        equations: All loop equations.
        active: Columns of the active joints.
        passive: Columns of the other joints.
        initial_guess: (nq,) initial guess of home.
        specified: Columns that the file specifies; None: no search.
        movable: Columns of active joints that may move during the search.

    Raises:
        MechanismError: There is no home configuration, or see `analyse_constraints`.
    """
    initial_guess = _follow_couplings(equations, initial_guess, specified or ())
    search = MultiStartSearch(
        equations, initial_guess, np.array(sorted(specified or ()), dtype=np.intp)
    )
    first: ConstraintStructure | None = None
    try:
        first = _analyse_to_file_precision(equations, active, passive, initial_guess)
    except HomeError as error:
        rejection: MechanismError = error
        reason = error.reason
    except ActiveJointError as error:  # perhaps because the linkage collapses there
        rejection, reason = error, "the joints have other freedoms where it closes"
        if not len(active) or ExactConstraints(equations).is_closed(initial_guess):
            raise
    if first is not None:
        reason = _home_problem(search, equations, passive, first.home)
        if specified is None or not reason:
            return first, None
    elif specified is None:
        raise rejection
    alternative_count = 0
    for found in _search_by_stages(
        search, equations, active, passive, specified, movable, first is None
    ):
        if first is not None:
            alternative_count += sum(
                search.coordinate_differences(q, first.home).max() > _SAME_CONFIGURATION_TOLERANCE
                for q in found
            )
        if first is not None and within_limits(equations, first.home)[passive].all():
            distance = search.distance_from_guess(first.home)[:2]
            found = [q for q in found if search.distance_from_guess(q)[:2] < distance]
        usable = _first_usable(equations, active, passive, found[:_MAX_CANDIDATES])
        if isinstance(usable, ConstraintStructure):
            return usable, _search_result(
                search,
                equations,
                reason,
                len(found) if first is None else alternative_count + 1,
                passive,
                usable,
            )
        if usable is not None and first is None:
            raise rejection if isinstance(rejection, ActiveJointError) else usable
    if first is None:
        raise rejection
    if search.largest_specified_deviation(first.home)[1] <= FAR:
        return first, None
    return first, _search_result(search, equations, reason, alternative_count + 1, passive, first)


def _follow_couplings(
    equations: LoopEquations, initial_guess: Array, specified: Collection[int]
) -> Array:
    """The guess (nq,) with geared joints that the file does not specify placed by the others.

    Where a geared joint is specified and the others of its coupling are not, these follow it.
    """
    q = initial_guess.copy()
    is_specified = np.isin(np.arange(len(q)), list(specified))
    for row, column in equations.geared_columns:
        factors = equations.coupling_factors[row]
        weights = np.where(np.arange(len(q)) == column, factors, 0.0)
        if is_specified[column]:
            weights = np.where(is_specified, 0.0, factors)
        if weights.any():
            gap = equations.coupling_offsets[row] - factors @ q
            q += weights * gap / (weights @ weights)
    return q


def find_cached_home(
    equations: LoopEquations,
    active: Indices,
    passive: Indices,
    initial_guess: Array,
    specified: Collection[int] | None,
    movable: Collection[int] = (),
) -> tuple[ConstraintStructure, HomeSearchResult | None]:
    """`find_home`, from the cache if an earlier process has found it; the arguments are equal."""

    def find() -> tuple[ConstraintStructure, HomeSearchResult | None]:
        import scipy.linalg  # noqa: F401 - loads the BLAS library to limit

        with single_threaded_blas(equations.model.nv):
            return find_home(equations, active, passive, initial_guess, specified, movable)

    if not equations.names:
        return find_home(equations, active, passive, initial_guess, specified, movable)
    columns = None if specified is None else tuple(specified), tuple(movable)
    dependencies = ("home", (equations.cache_key, active, initial_guess, *columns))
    return cached_result(
        dependencies, find, "scipy.linalg", (ConstraintStructure, RedundancyGap, HomeSearchResult)
    )


def within_limits(equations: LoopEquations, q: Array) -> NDArray[np.bool_]:
    """(nv,) whether joints of a configuration (nq,) are within their limits, up to rounding."""
    return equations.coordinates.within_limits(q, CLOSED_TOLERANCE)


def _home_problem(
    search: MultiStartSearch, equations: LoopEquations, passive: Indices, home: Array
) -> str:
    """Why home as closed from the guess is doubtful; empty if it is not."""
    names = equations.coordinates.names
    columns = passive[~within_limits(equations, home)[passive]]
    if len(columns):
        return f"{names[int(columns[0])]} closes outside of its limits"
    joint, deviation = search.largest_specified_deviation(home)
    return f"{names[joint]} closes far off" if deviation > FAR else ""


def _search_result(
    search: MultiStartSearch,
    equations: LoopEquations,
    reason: str,
    count: int,
    passive: Indices,
    structure: ConstraintStructure,
) -> HomeSearchResult:
    home = structure.home
    moved = np.flatnonzero(
        search.coordinate_differences(home, search.initial_guess) > CLOSED_TOLERANCE
    )
    return HomeSearchResult(
        reason,
        count,
        moved,
        search.largest_deviation(home),
        search.largest_specified_deviation(home),
        _reversed(search, equations, passive, structure),
    )


def _reversed(
    search: MultiStartSearch,
    equations: LoopEquations,
    passive: Indices,
    structure: ConstraintStructure,
) -> tuple[str, ...]:
    """Names of loops in the other assembly mode than the guess, see the module."""
    jacobians = [equations.evaluate_scaled(q)[1] for q in (structure.home, search.initial_guess)]
    found: list[int] = []
    for rows, columns in structure.blocks:
        block, joints = structure.independent_rows[rows], passive[columns]
        if not np.isin(joints, search.specified).all():
            continue
        home, guess = (np.linalg.slogdet(x[np.ix_(block, joints)])[0] for x in jacobians)
        if home * guess < 0:
            found += [int(i) for i in equations.loop_of_row[block]]
    return tuple(equations.names[i] for i in dict.fromkeys(found))


def _first_usable(
    equations: LoopEquations, active: Indices, passive: Indices, found: list[Array]
) -> ConstraintStructure | ActiveJointError | None:
    """The structure of the first configuration that can be home; else an `ActiveJointError`."""
    rejection: ActiveJointError | None = None
    for q in found:
        try:
            return _analyse_to_file_precision(equations, active, passive, q)
        except ActiveJointError as error:
            rejection = rejection or error
        except MechanismError:
            continue
    return rejection


def _analyse_to_file_precision(
    equations: LoopEquations, active: Indices, passive: Indices, initial_guess: Array
) -> ConstraintStructure:
    """`analyse_constraints`, to the file precision where equations contradict each other."""
    try:
        return analyse_constraints(
            equations, active, passive, initial_guess, ExactConstraints(equations)
        )
    except MechanismError as error:
        exact_error = error
    rounded = RoundedConstraints(equations)
    try:
        return analyse_constraints(equations, active, passive, initial_guess, rounded)
    except ActiveJointError as error:
        if str(error) == str(exact_error) or not error.selections:
            raise exact_error from None
        active_joint_error = error
    except MechanismError:
        raise exact_error from None
    # other active joints are proposed only if the machine moves with them
    names = equations.coordinates.names
    others = np.array(
        [names.index(joint) for joint in active_joint_error.selections[0].joints], dtype=np.intp
    )
    try:
        analyse_constraints(
            equations,
            others,
            np.setdiff1d(np.arange(equations.model.nv), others),
            initial_guess,
            rounded,
        )
    except MechanismError:
        raise exact_error from None
    raise active_joint_error


def _search_by_stages(
    search: MultiStartSearch,
    equations: LoopEquations,
    active: Indices,
    passive: Indices,
    specified: Collection[int],
    movable: Collection[int],
    beyond_limits: bool,
) -> Iterator[list[Array]]:
    """Closed configurations of each stage of the search; beyond the limits only if allowed."""
    movable_columns = np.union1d(passive, np.array(list(movable), dtype=np.intp))
    all_movable = np.union1d(movable_columns, np.setdiff1d(active, list(specified)))
    column_sets = (
        [movable_columns, all_movable]
        if len(all_movable) > len(movable_columns)
        else [movable_columns]
    )
    has_limits = np.isfinite(equations.coordinates.lower[passive]).any()
    has_limits |= np.isfinite(equations.coordinates.upper[passive]).any()
    nothing = np.zeros(0, dtype=np.intp)
    for unlimited in (nothing, passive) if has_limits and beyond_limits else (nothing,):
        for columns in column_sets:
            yield search.find_configurations(columns, unlimited, FILE_PRECISION)
