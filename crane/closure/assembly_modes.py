"""Assembly-mode search: other configurations that close the loops at the same active coordinates.

The blocks of equations (see `crane.closure.constraint_structure`) are solved one after another,
and each has its own assembly modes: a triangle or a four-bar linkage has two, mirror images of
each other. Each block is solved again from starting points over the range of its unknowns, with
the blocks before it as at home; the blocks after it are solved from the initial guess.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from crane.closure.closure import Closure
from crane.closure.constraint_tolerances import FILE_PRECISION
from crane.closure.coordinates import Indices
from crane.closure.home_search import within_limits
from crane.closure.loop_equations import LoopEquations
from crane.closure.multi_start_search import MultiStartSearch, low_discrepancy_steps
from crane.common.samples import Array, solve_linear
from crane.common.threads import single_threaded_blas

_CLOSED_TOLERANCE = 1e-9  # scaled residual
# [rad] or scaled: distance of equal configurations
_SAME_CONFIGURATION_TOLERANCE = 1e-3
_MAX_STEP = 1.0  # largest scaled step of an iteration
_MAX_ITERATIONS = 15
_CERTAIN_DEVIATION = 0.05  # scaled distance from the guess below which home is certain
_LARGE_DEVIATION = 0.5  # scaled distance beyond which a guess is not decisive
_DISTANCE_RATIO, _LOOSE_DISTANCE_RATIO = (
    2.0,
    5.0,
)  # ratio of distances from the guess up to which it does not decide
_STARTS_PER_UNKNOWN = 8  # starting points per unknown of a block


@dataclass(frozen=True)
class AssemblyMode:
    """Another assembly mode of a machine that the initial guess does not rule out.

    Attributes:
        q: (nq,) configuration.
        loops: Names of the loops that are assembled differently.
        changed_columns: Columns of the joints whose coordinates differ from home.
        largest_deviation: Column of the joint farthest from the guess, and its distance [m],
            [rad].
        home_deviation: The same for the home configuration.
        home_outside_limits: Whether home violates joint limits that this configuration satisfies.
    """

    q: Array
    loops: tuple[str, ...]
    changed_columns: Indices
    largest_deviation: tuple[int, float]
    home_deviation: tuple[int, float]
    home_outside_limits: bool


def find_alternative_assembly_modes(
    closure: Closure, initial_guess: Array, specified: Indices, max_starts: int
) -> list[AssemblyMode]:
    """Find assembly modes that the initial guess does not rule out, at most one per block.

    Distances from the guess are compared over the joints that differ from home, or over those of
    them that the file specifies, if any. An assembly mode is returned if its distance is less than
    twice that of home; less than five times if no joint is specified or home is 0.5 rad from the
    guess; or if it satisfies joint limits that home violates.

    Args:
        closure: The loops, closed at home.
        initial_guess: (nq,) initial guess of the home configuration.
        specified: Columns whose value in the guess comes from the file.
        max_starts: Number of starting points per block, which bounds the work.
    """
    with single_threaded_blas(closure.model.nv):
        return _find_alternatives(
            _AssemblyModeSearch(closure, initial_guess, specified), max_starts
        )


def _find_alternatives(search: "_AssemblyModeSearch", max_starts: int) -> list[AssemblyMode]:
    closure = search.closure
    found: list[AssemblyMode] = []
    for index, (_, columns) in enumerate(closure.structure.blocks):
        block = closure.passive[columns]
        home_within_limits = within_limits(closure.equations, closure.home)[block].all()
        if (
            home_within_limits
            and search.distance_from_guess(closure.home, search.specified_among(block))
            < _CERTAIN_DEVIATION
        ):
            continue
        alternatives = sorted(
            search.find_block_solutions(index, max_starts),
            key=lambda q: search.distance_from_guess(q, block),
        )
        candidates = (
            one
            for q in alternatives
            if (one := search.assess_block_solution(q, index)) is not None
        )
        found += itertools.islice(candidates, 1)
    if closure.home_search is None:
        return found
    # passive joints that loops connect, directly or through others
    group, group_of_row = closure.equations.coupled_groups(closure.passive)
    for index in np.unique(group_of_row[group_of_row >= 0]):
        columns = closure.passive[group == index]
        rows = search.independent_rows_of(columns)
        group_candidates = (
            one
            for q in search.find_group_solutions(rows, columns, max_starts)
            if (one := search.assess_assembly_mode(q, rows)) is not None
            and not any(search.is_same_for_masses(q, other.q) for other in found)
        )
        found += itertools.islice(group_candidates, 1)
    return found


class _AssemblyModeSearch:
    """Solutions of the blocks of one machine."""

    def __init__(self, closure: Closure, initial_guess: Array, specified: Indices):
        self.closure, self.guess, self.specified_columns = closure, initial_guess, specified
        self.model, self.equations = closure.model, closure.equations
        self.home, self.blocks = closure.home, closure.structure.blocks
        self._coordinate_units = self.equations.coordinate_units
        self._distances = self.equations.coordinates.scaled_distances
        self._is_rotation = ~self.equations.coordinates.is_translation
        self._loop_subsets: dict[tuple[int, ...], LoopEquations] = {}
        self._body_placements: dict[bytes, Array] = {}
        self._massless = not any(inertia.mass > 0 for inertia in list(self.model.inertias)[1:])

    def distance_from_guess(self, q: Array, columns: Indices) -> float:
        """Largest distance of some joints from the guess."""
        return float(self._distances(q, self.guess)[columns].max(initial=0.0))

    def specified_among(self, columns: Indices) -> Indices:
        """Those of some columns that the file specifies; all of them if it specifies none."""
        specified = columns[np.isin(columns, self.specified_columns)]
        return specified if len(specified) else columns

    def find_block_solutions(self, block: int, max_starts: int) -> list[Array]:
        """Solutions of a block other than home's, with the blocks before it as at home."""
        rows, columns = self._block_indices(block)
        found = [self.home]
        sign = np.linalg.slogdet(self.equations.evaluate(self.home)[1][np.ix_(rows, columns)])[0]
        # circles or lines that intersect: translations of one loop only
        one_loop = len(set(self.equations.loop_of_row[rows].tolist())) == 1
        two_solutions = (
            len(columns) <= 2 and one_loop and self.equations.is_translation[rows].all()
        )
        for start in [
            *self._starts_across_home(rows, columns),
            *self._starting_points(columns, _STARTS_PER_UNKNOWN * len(columns)),
        ][:max_starts]:
            q = self._solve_newton(start, rows, columns, found)
            if q is None or any(
                self._distances(q, x)[columns].max() < _SAME_CONFIGURATION_TOLERANCE for x in found
            ):
                continue
            found.append(q)
            jacobian = self.equations.evaluate(q)[1][np.ix_(rows, columns)]
            if two_solutions and np.linalg.slogdet(jacobian)[0] != sign:
                break  # mirror images: there are no others
        return found[1:]

    def independent_rows_of(self, columns: Indices) -> Indices:
        """Independent rows of the loops that contain some joints."""
        involved = (
            np.vstack([self.equations.sign, self.equations.is_coupled])[:, columns] != 0
        ).any(1)
        rows = self.closure.structure.independent_rows
        return rows[involved[self.equations.loop_of_row[rows]]]

    def find_group_solutions(
        self, rows: Indices, columns: Indices, max_starts: int
    ) -> list[Array]:
        """Closed configurations with all other joints as at home, nearest to the guess first."""
        initial_guess = self.home.copy()
        initial_guess[columns] = self.guess[columns]
        search = MultiStartSearch(
            self._equations_of_rows(rows)[0], initial_guess, self.specified_columns, max_starts
        )
        candidates = search.find_configurations(
            columns, np.zeros(0, dtype=np.intp), FILE_PRECISION
        )
        closed = (self._solve_newton(q, rows, columns) for q in candidates)
        return [q for q in closed if q is not None]

    def _equations_of_rows(self, rows: Indices) -> tuple[LoopEquations, Indices]:
        """Equations of the loops that contain some rows, and the indices of the rows in them."""
        loop_of_row = self.equations.loop_of_row
        loop_indices = tuple(np.unique(loop_of_row[rows]).tolist())
        if loop_indices not in self._loop_subsets:
            names = self.equations.names
            self._loop_subsets[loop_indices] = self.equations.subset(
                [names[i] for i in loop_indices]
            )
        return self._loop_subsets[loop_indices], np.searchsorted(
            np.flatnonzero(np.isin(loop_of_row, loop_indices)), rows
        )

    def _block_indices(self, block: int) -> tuple[Indices, Indices]:
        rows, columns = self.blocks[block]
        return self.closure.structure.independent_rows[rows], self.closure.passive[columns]

    def _starts_across_home(self, rows: Indices, columns: Indices) -> Array:
        """(4, nq) configurations on both sides of home, along the least determined direction."""
        least_determined_direction = np.linalg.svd(
            self.equations.evaluate_scaled(self.home)[1][np.ix_(rows, columns)]
        )[2][-1]
        out = np.tile(self.home, (4, 1))
        out[:, columns] += np.outer(
            [0.5, -0.5, 1.5, -1.5], least_determined_direction * self._coordinate_units[columns]
        )
        return out

    def _starting_points(self, columns: Indices, count: int) -> Array:
        """(count, nq) configurations of a low-discrepancy sequence around the guess.

        They cover one revolution, the limits of a prismatic joint, or the characteristic length.
        """
        fractions = np.outer(np.arange(count), low_discrepancy_steps(len(columns))) + 0.5
        fractions = np.remainder(fractions, 1.0) - 0.5
        coordinates = self.equations.coordinates
        lower, upper = coordinates.lower, coordinates.upper
        ranges = np.where(self._is_rotation, 2 * np.pi, 2 * self._coordinate_units)
        centre = self.guess.copy()
        limited = ~self._is_rotation & np.isfinite(lower) & np.isfinite(upper)
        centre[limited] = (lower[limited] + upper[limited]) / 2
        ranges[limited] = upper[limited] - lower[limited]
        out = np.tile(self.home, (count, 1))
        out[:, columns] = centre[columns] + fractions * ranges[columns]
        return out

    def _solve_newton(
        self, q: Array, rows: Indices, columns: Indices, known_solutions: Sequence[Array] = ()
    ) -> Array | None:
        """Newton's method for some rows and columns; None where it does not converge.

        Known solutions are deflated (Farrell, Birkisson, Funke 2015): for m phi instead of phi,
        with m = prod 1 / r^2 + 1 and the distance r from a known solution, the Newton step d is
        divided by 1 - (grad m . d) / m, which turns it around near known solutions.
        """
        q, coordinates = q.copy(), self.equations.coordinates
        equations, rows = self._equations_of_rows(rows)
        for _ in range(_MAX_ITERATIONS):
            phi, jacobian = equations.evaluate_scaled(q)
            if np.abs(phi[rows]).max(initial=0.0) < 1e-13:
                break
            try:
                step = solve_linear(jacobian[np.ix_(rows, columns)], -phi[rows])
            except np.linalg.LinAlgError:
                return None
            deflation = 0.0
            for other in known_solutions:
                difference = (q - other)[columns] / self._coordinate_units[columns]
                is_rotation = self._is_rotation[columns]
                square = np.where(is_rotation, 2 - 2 * np.cos(difference), difference**2).sum()
                distance_gradient = np.where(is_rotation, 2 * np.sin(difference), 2 * difference)
                deflation -= float(distance_gradient @ step) / max(square * (1 + square), 1e-12)
            step = step / (1 - deflation if abs(1 - deflation) > 1e-6 else 1e-6)
            largest = float(np.abs(step).max())
            if not largest < np.inf:
                return None
            q = equations.displace(q, columns, step * min(1.0, _MAX_STEP / max(largest, 1e-300)))
        if not np.abs(equations.evaluate_scaled(q)[0][rows]).max(initial=0.0) < _CLOSED_TOLERANCE:
            return None
        angles = columns[(self._is_rotation & ~coordinates.is_rotation_vector)[columns]]
        q[angles] = np.remainder(q[angles] + np.pi, 2 * np.pi) - np.pi
        return coordinates.wrap_rotations(q, columns)

    def assess_block_solution(self, q: Array, block: int) -> AssemblyMode | None:
        """The assembly mode with another solution of a block, or None."""
        for later_block in range(block + 1, len(self.blocks)):
            later_rows, columns = self._block_indices(later_block)
            solutions = []
            for start in (self.guess, self.home):
                start_configuration = q.copy()
                start_configuration[columns] = start[columns]
                solutions.append(self._solve_newton(start_configuration, later_rows, columns))
            closed = [found for found in solutions if found is not None]
            if not closed:
                return None
            distances = [self.distance_from_guess(found, columns) for found in closed]
            q = closed[int(np.argmin(distances))]
        return self.assess_assembly_mode(q, self._block_indices(block)[0])

    def assess_assembly_mode(self, q: Array, rows: Indices) -> AssemblyMode | None:
        """The assembly mode of a configuration that solves some rows differently, or None."""
        passive = self.closure.passive
        if (
            np.abs(self.equations.evaluate_scaled(q)[0]).max()
            > self.closure.structure.redundancy.tolerance
        ):
            return None
        is_inside = within_limits(self.equations, q)[passive].all()
        if self.equations.find_opposed_loop(q) is not None or not is_inside:
            return None
        columns = np.flatnonzero(self._distances(q, self.home) > _SAME_CONFIGURATION_TOLERANCE)
        if not len(columns) or self.is_same_for_masses(q, self.home):
            return None
        compared = self.specified_among(columns)
        distance, home_distance = (
            self.distance_from_guess(q, compared),
            self.distance_from_guess(self.home, compared),
        )
        home_outside_limits = not within_limits(self.equations, self.home)[passive].all()
        is_decisive = (
            home_distance < _LARGE_DEVIATION and np.isin(compared, self.specified_columns).all()
        )
        ratio = _DISTANCE_RATIO if is_decisive else _LOOSE_DISTANCE_RATIO
        if distance > ratio * home_distance and not home_outside_limits:
            return None
        names = tuple(
            self.equations.names[i] for i in sorted(set(self.equations.loop_of_row[rows].tolist()))
        )
        largest_deviation, home_deviation = (
            self._largest_deviation(q, compared),
            self._largest_deviation(self.home, compared),
        )
        return AssemblyMode(
            q, names, columns, largest_deviation, home_deviation, home_outside_limits
        )

    def _largest_deviation(self, q: Array, columns: Indices) -> tuple[int, float]:
        differences = self._distances(q, self.guess)[columns]
        column = int(columns[differences.argmax()])
        return column, float(differences.max() * self._coordinate_units[column])

    def is_same_for_masses(self, first: Array, second: Array) -> bool:
        """Whether all bodies with mass have the same poses in two configurations."""
        difference = np.abs(self._placements_of_masses(first) - self._placements_of_masses(second))
        return bool(difference.max(initial=0.0) < _SAME_CONFIGURATION_TOLERANCE)

    def _placements_of_masses(self, q: Array) -> Array:
        """Rotations and scaled origins (b, 3, 4) of the bodies with mass."""
        key = q.tobytes()
        if key not in self._body_placements:
            data = self.equations.data
            pin.forwardKinematics(self.model, data, self.equations.coordinates.configuration(q))
            self._body_placements[key] = np.array(
                [
                    np.column_stack(
                        [place.rotation, place.translation / self.equations.characteristic_length]
                    )
                    for place, inertia in zip(data.oMi, self.model.inertias, strict=True)
                    if inertia.mass > 0 or self._massless
                ]
            )
        return self._body_placements[key]
