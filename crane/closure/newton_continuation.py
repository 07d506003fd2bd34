"""Newton's method and continuation along one branch."""

import warnings
from dataclasses import replace

import numpy as np

from crane.closure.change_points import (
    NEIGHBOUR_PLACES,
    NEIGHBOUR_WEIGHTS,
    is_smooth_passage,
)
from crane.closure.constraint_structure import ConstraintStructure
from crane.closure.continuation_diagnosis import (
    CLOSED_TOLERANCE,
    SINGULAR_TOLERANCE,
    ClosedConfiguration,
    ContinuationDiagnosis,
)
from crane.closure.coordinates import Indices
from crane.closure.loop_equations import LoopEquations
from crane.common.errors import (
    ClosureError,
    CraneWarning,
    MechanismError,
    OutOfReachError,
)
from crane.common.samples import Array, solve_linear

# Scaled values (rad, characteristic length): the same for machines of any size.
_MIN_STEP = 2.0**-24  # smallest step of the continuation, as a fraction of the line
# least singular value, as a share of that at home, over the correction of a prediction
_MIN_REGULARITY = 2.0
_CHANGE_POINT_ZONE = 1e-5  # least singular value, as a share of that at home, to which steps lead
_CHANGE_POINT_TOLERANCE = 1e-11  # relative least singular value below which gamma has no digits
_MIN_PASSAGE = 1e-4  # scaled distance of the two sides of a change point
_INTERPOLATION_STEP = 1e-2  # scaled distance of the neighbours of a change point


class NewtonContinuation(ContinuationDiagnosis):
    """The configurations that are reached from home without passing a singular one.

    Args:
        equations: All loop equations.
        structure: Independent equations.
        active: Columns of the active joints.
        passive: Columns of the other joints.
        ranges: (n,) ranges of the active coordinates, to compare distances [m], [rad].

    Raises:
        MechanismError: The home configuration does not close.
    """

    def __init__(
        self,
        equations: LoopEquations,
        structure: ConstraintStructure,
        active: Indices,
        passive: Indices,
        ranges: Array,
    ):
        super().__init__(equations, structure, active, passive)
        self._active_ranges, units = ranges, equations.coordinate_units
        self._blocks = structure.blocks_by_size()
        self._all_columns = np.arange(equations.model.nv)
        self._has_partly_active_rotations = equations.coordinates.has_partial_rotations(active)
        self._gamma_units = units[passive, None] / units[active]
        home = self.solve_newton(structure.home, structure.home[active], 30)
        if home is None:
            raise MechanismError("the home configuration does not close, change 'home'", "home")
        self.home = home
        self._home_determinants = self._block_determinants(home)
        self._home_regularity = max(self._most_singular_block(home.jacobian)[0], 1e-300)
        self._has_warned = False

    def solve_newton(
        self, q: Array, q_a: Array | None, max_iterations: int
    ) -> ClosedConfiguration | None:
        """Close the loops at q_A by Newton's method from a nearby q; None if it diverges.

        Without q_A the active joints do not move, which differs from constant coordinates where
        they are parts of rotation vectors.
        """
        q = q.copy()
        if q_a is not None:
            q[self._active_columns] = q_a
        rounding_scale, previous_residual = self.rounding_scale(q), np.inf
        for _ in range(max_iterations):
            phi, jacobian = self._evaluate_rows(q)
            residual = np.abs(phi).max(initial=0.0)
            at_rounding = residual <= 4e-15 * rounding_scale
            stalled = (
                residual <= 0.1 * CLOSED_TOLERANCE * rounding_scale
                and residual > 0.25 * previous_residual
            )
            try:
                if at_rounding or stalled:
                    gamma = self._scaled_passive_gamma(jacobian)
                    q_a = q[self._active_columns].copy()
                    return ClosedConfiguration(q, q_a, jacobian, gamma * self._gamma_units)
                step = np.zeros(len(q))
                step[self._passive_columns] = solve_linear(
                    jacobian[:, self._passive_columns], -phi
                )
                if q_a is not None and self._has_partly_active_rotations:
                    moved = self._equations.coordinates.coordinate_derivatives(q, step)
                    gamma = self._scaled_passive_gamma(jacobian)
                    step += self._displacement_of(q, gamma, -moved[self._active_columns])
            except np.linalg.LinAlgError:
                return None
            if not np.abs(step).max(initial=0.0) < 1.0:  # also NaN
                return None
            previous_residual = residual
            q = self._equations.displace(q, self._all_columns, step)
        return None

    def _scaled_passive_gamma(self, jacobian: Array) -> Array:
        return solve_linear(jacobian[:, self._passive_columns], -jacobian[:, self._active_columns])

    def _displacement_of(self, q: Array, passive_gamma: Array, active_step: Array) -> Array:
        """Scaled displacements (nv,) along which the active coordinates change by a step (n,).

        The coordinates change by N gamma times the displacements of the active joints, with N of
        `Coordinates.rate_matrix`; this is the identity without rotation vectors.

        Raises:
            LinAlgError: The active coordinates do not determine a rotation there.
        """
        gamma = np.zeros((len(q), len(active_step)))
        gamma[self._active_columns] = np.eye(len(active_step))
        gamma[self._passive_columns] = passive_gamma
        coordinates = self._equations.coordinates
        if coordinates.rotation_columns:
            rates = (coordinates.rate_matrix(q) @ gamma)[self._active_columns]
            active_step = solve_linear(rates, active_step)
        return gamma @ active_step

    def continue_to(
        self, target: Array, known: ClosedConfiguration, sample: str = ""
    ) -> ClosedConfiguration:
        """The closed configuration at a target, followed from a known one or from home.

        Args:
            target: (n,) active coordinates.
            known: Start; home if that is nearer or if this start fails.
            sample: Name of the target in errors.

        Raises:
            OutOfReachError: No configuration closes the loops.
            SingularConfigurationError: The passive joints are not determined there.
        """
        starts = [known] if known is self.home else [known, self.home]
        starts.sort(
            key=lambda start: float(np.abs((target - start.q_a) / self._active_ranges).max())
        )
        last_reached = known
        for start in starts:
            solution, last_reached = self._follow_line(start, target)
            if solution is None:
                solution = self._interpolate_at(last_reached, target)
            if solution is not None:
                self._check_solution(solution, sample)
                return solution
        raise self._out_of_reach_error(target, last_reached, sample)

    def nearest_closed_configuration(self, q: Array) -> ClosedConfiguration:
        """The closed configuration nearest to a guess (nq,), home if Newton's method diverges.

        Raises:
            WrongBranchError: It lies on another branch.
        """
        solution = self.solve_newton(q, q[self._active_columns], 10)
        if solution is None:
            return self.home
        is_changed = self.determinants(solution) < 0
        if is_changed.any() and not self._is_beyond_change_points(solution):
            loops = self._format_loop_names(self._block_rows(int(is_changed.argmax())))
            raise self._wrong_branch_error(loops, solution)
        opposed_loop = self._equations.find_opposed_loop(solution.q)
        if opposed_loop is not None:
            raise self._wrong_branch_error(f"loop '{opposed_loop}'", solution)
        return solution

    def gamma(self, q: Array) -> Array:
        """Derivative (nv, n) of f at a closed configuration (nq,); see `Closure.gamma`."""
        return self._insert_passive_gamma(self._evaluate_rows(q)[1], q)

    def drift(self, q: Array, v: Array) -> Array:
        """Accelerations (nv,) at a_A = 0; see `Closure.drift`."""
        return self._drift(self._evaluate_rows(q)[1], q, v)

    def gamma_velocity_drift(self, q: Array, v_a: Array) -> tuple[Array, Array, Array]:
        """gamma, v = gamma v_A and drift; see `Closure.gamma_velocity_drift`."""
        jacobian = self._evaluate_rows(q)[1]
        gamma = self._insert_passive_gamma(jacobian, q)
        v = gamma @ v_a
        return gamma, v, self._drift(jacobian, q, v)

    def _evaluate_rows(self, q: Array) -> tuple[Array, Array]:
        """Scaled residuals and Jacobian of the independent equations."""
        phi, jacobian = self._equations.evaluate_scaled(q)
        rows = self._structure.independent_rows
        return phi[rows], jacobian[rows]

    def _insert_passive_gamma(self, jacobian: Array, q: Array) -> Array:
        active, passive = self._active_columns, self._passive_columns
        rows = self._solve_passive(jacobian, jacobian[:, active], q)
        gamma = np.zeros((len(q), len(active)))
        gamma[active] = np.eye(len(active))
        units = self._coordinate_units
        gamma[passive] = rows * units[passive, None] / units[active]
        return gamma

    def _drift(self, jacobian: Array, q: Array, v: Array) -> Array:
        bias = self._equations.acceleration_bias(q, v) / self._equations.residual_units
        passive = self._solve_passive(jacobian, bias[self._structure.independent_rows], q)
        drift = np.zeros(len(q))
        drift[self._passive_columns] = passive * self._coordinate_units[self._passive_columns]
        return drift

    def _solve_passive(self, jacobian: Array, right_side: Array, q: Array) -> Array:
        """-J_P^-1 right_side, all scaled."""
        q_a = q[self._active_columns]
        try:
            solution = solve_linear(jacobian[:, self._passive_columns], -right_side)
        except np.linalg.LinAlgError:
            raise self.singularity_error(jacobian, q_a) from None
        self.check_singularity(jacobian, solution, q_a)
        if self._most_singular_block(jacobian)[0] < _CHANGE_POINT_TOLERANCE:
            raise self.singularity_error(jacobian, q_a)
        return solution

    def check_singularity(
        self, jacobian: Array, solution: Array, q_a: Array, sample: str = ""
    ) -> None:
        """Raise if J_P is singular, judged by a solution of a system with it.

        Args:
            jacobian: (m, nv) see `LoopEquations.evaluate_scaled`.
            solution: Solution of a linear system with its passive columns.
            q_a: (n,) active coordinates, for the error.
            sample: See `continue_to`.

        Raises:
            SingularConfigurationError: J_P is singular.
        """
        if (
            np.abs(solution).max(initial=0.0) > 1e-3 / SINGULAR_TOLERANCE
            and self._most_singular_block(jacobian)[0] < SINGULAR_TOLERANCE
        ):
            raise self.singularity_error(jacobian, q_a, sample)

    def _block_determinants(self, solution: ClosedConfiguration) -> Array:
        blocks = [
            np.linalg.det(solution.jacobian[rows, self._passive_columns[columns]])
            for rows, columns in self._blocks
        ]
        return np.concatenate(blocks) if blocks else np.zeros(0)

    def determinants(self, solution: ClosedConfiguration) -> Array:
        """Determinant of every block as a share of that at home: of constant sign on a branch."""
        return np.asarray(self._block_determinants(solution) / self._home_determinants)

    def _block_rows(self, block: int) -> Indices:
        """Rows of a block, by its place in `determinants`."""
        return np.ravel([rows for group, _ in self._blocks for rows in group][block])

    def _follow_line(
        self, start: ClosedConfiguration, target: Array
    ) -> tuple[ClosedConfiguration | None, ClosedConfiguration]:
        """Follow the branch along the straight line of q_A to a target.

        Returns:
            The configuration at the target, or None, and the last configuration that was reached.
        """
        current, progress, step = start, 0.0, 1.0
        while progress < 1.0 and step >= _MIN_STEP:
            next_progress = min(1.0, progress + step)
            q_a = (
                target
                if next_progress == 1.0
                else start.q_a + next_progress * (target - start.q_a)
            )
            # towards a fold Newton only converges linearly
            corrected = self._predict_and_correct(current, q_a, 8 if step > _MIN_STEP * 16 else 40)
            if corrected is None:
                step /= 2
                continue
            current, progress = corrected, next_progress
            step *= 2
        return current if progress == 1.0 else None, current

    def _predict_and_correct(
        self, current: ClosedConfiguration, q_a: Array, max_iterations: int
    ) -> ClosedConfiguration | None:
        """The configuration at q_A next to the current one, None if the branch changes.

        It may pass a change point. Where the least singular value is smaller than the error of the
        prediction, another branch may be as near.
        """
        passive, units = self._passive_columns, self._coordinate_units
        active_step = (q_a - current.q_a) / units[self._active_columns]
        gamma = current.passive_gamma / self._gamma_units
        try:
            step = self._displacement_of(current.q, gamma, active_step)
        except np.linalg.LinAlgError:
            return None
        predicted_step = np.abs(step[passive]).max(initial=0.0)
        if not predicted_step < 1.0:
            return None
        predicted = self._equations.displace(current.q, self._all_columns, step)
        corrected = self.solve_newton(predicted, q_a, max_iterations)
        if corrected is None:
            return None
        correction = np.abs((corrected.q - predicted)[passive] / units[passive]).max(initial=0.0)
        is_near = correction <= 0.02 + 0.5 * predicted_step
        if not is_near or not self._continues(current, corrected, float(correction)):
            return None
        q = self._equations.coordinates.wrap_rotations(corrected.q, self._passive_columns)
        return replace(corrected, q=q)

    def _continues(
        self, current: ClosedConfiguration, corrected: ClosedConfiguration, correction: float
    ) -> bool:
        """Whether a configuration is on the branch of the current one; see above."""
        before, determinants = self.determinants(current), self.determinants(corrected)
        least = self._most_singular_block(corrected.jacobian)[0]
        regularity = least / self._home_regularity
        if regularity < _CHANGE_POINT_ZONE and self._is_bounded(current):
            return False
        if least < SINGULAR_TOLERANCE:  # the end of the branch itself
            return True
        if (before * determinants < 0).any():
            return self._passes_change_point(current, corrected)
        return bool(regularity > _MIN_REGULARITY * correction)

    def _is_bounded(self, solution: ClosedConfiguration) -> bool:
        """Whether gamma is that of a motion through a change point, not towards a dead centre."""
        largest = np.abs(solution.passive_gamma / self._gamma_units).max(initial=0.0)
        return bool(largest < 1e-3 / SINGULAR_TOLERANCE)

    def _slope(self, at: ClosedConfiguration, active_rate: Array) -> Array:
        """Derivative (nq,) of the configuration along a rate (n,) of the active coordinates."""
        rate = active_rate / self._coordinate_units[self._active_columns]
        step = self._displacement_of(at.q, at.passive_gamma / self._gamma_units, rate)
        return self._equations.displace(at.q, self._all_columns, step) - at.q

    def _passes_change_point(self, one: ClosedConfiguration, other: ClosedConfiguration) -> bool:
        """Whether a smooth motion joins two sides of a change point; warns of the first one."""
        step = other.q_a - one.q_a
        distance = np.abs((other.q - one.q) / self._coordinate_units).max()
        before, behind = ((x.q, self._slope(x, step)) for x in (one, other))
        # sides of a dead centre are on one smooth motion, too, if they are near enough
        if distance < _MIN_PASSAGE or not is_smooth_passage(
            before, behind, lambda q: self._evaluate_rows(q)[0]
        ):
            return False
        if not self._has_warned:
            self._has_warned = True
            first, last = self.determinants(one), self.determinants(other)
            block = int((first * last).argmin())
            place = one.q_a + step * first[block] / (first[block] - last[block])
            warnings.warn(
                f"{self._format_loop_names(self._block_rows(block))} passes a change point at "
                f"{self._format_values(place)}, from which it could go on in several ways: here "
                "and at others it goes on as it moves",
                CraneWarning,
                stacklevel=2,
            )
        return True

    def _is_beyond_change_points(self, solution: ClosedConfiguration) -> bool:
        """Whether the way from home to a configuration leads through change points only."""
        try:
            found = self.continue_to(solution.q_a, self.home)
        except ClosureError:
            return False
        # equal rotations may have several rotation vectors
        q = self._equations.coordinates.unwrap_rotations(found.q, solution.q)
        return bool(np.abs((q - solution.q) / self._coordinate_units).max() < 1e-6)

    def _interpolate_at(
        self, current: ClosedConfiguration, target: Array
    ) -> ClosedConfiguration | None:
        """The configuration at a target in a change point, from neighbours on both sides.

        None if the target is not there.
        """
        direction = target - current.q_a
        slope = np.abs(self._slope(current, direction) / self._coordinate_units).max(initial=0.0)
        if not 0.0 < slope < _INTERPOLATION_STEP:
            return None
        direction *= _INTERPOLATION_STEP / slope
        nodes: list[ClosedConfiguration] = []
        for place in NEIGHBOUR_PLACES:
            known = nodes[-1] if nodes else current
            node, _ = self._follow_line(known, target + place * direction)
            if node is None:
                return None
            nodes.append(node)
        q = NEIGHBOUR_WEIGHTS @ np.array([node.q for node in nodes])
        q[self._active_columns] = target
        phi, jacobian = self._evaluate_rows(q)
        if np.abs(phi).max() > 10 * CLOSED_TOLERANCE * self.rounding_scale(q):
            return None
        gamma = np.tensordot(NEIGHBOUR_WEIGHTS, [node.passive_gamma for node in nodes], 1)
        return ClosedConfiguration(q, target, jacobian, gamma, tuple(nodes))

    def _check_solution(self, solution: ClosedConfiguration, sample: str) -> None:
        """Raise unless every equation holds and the passive joints are determined."""
        scaled_gamma = solution.passive_gamma / self._gamma_units
        self.check_singularity(solution.jacobian, scaled_gamma, solution.q_a, sample)
        if len(self._structure.redundant_rows):
            phi, _ = self._equations.evaluate_scaled(solution.q)
            redundant_residuals = np.abs(phi[self._structure.redundant_rows])
            if redundant_residuals.max() > self._structure.redundancy.tolerance:
                row = int(self._structure.redundant_rows[redundant_residuals.argmax()])
                raise OutOfReachError(
                    f"loop '{self._equations.name_of_row(row)}' stays "
                    f"{self._format_gap(row, redundant_residuals.max())} open at "
                    f"{self._format_values(solution.q_a)}{sample}, its redundant equations hold "
                    "only near home: the mechanism is overconstrained, use a looser loop type"
                )
