"""Newton's method and continuation along one branch."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from crane.closure.constraint_structure import ConstraintStructure
from crane.closure.coordinates import Indices
from crane.closure.loop_equations import LoopEquations
from crane.common.errors import (
    MechanismError,
    OutOfReachError,
    SingularConfigurationError,
    WrongBranchError,
)
from crane.common.samples import Array, solve_linear

# Scaled values (rad, characteristic length): the same for machines of any size.
_CLOSED_TOLERANCE = 1e-12  # residual of a closed loop
# relative least singular value of a singular block
_SINGULAR_TOLERANCE = 1e-6
_MIN_STEP = 2.0**-24  # smallest step of the continuation, as a fraction of the line


@dataclass(frozen=True, eq=False)
class ClosedConfiguration:
    """A closed configuration with what the next continuation step needs.

    Attributes:
        q: (nq,).
        q_a: (n,) its active coordinates.
        jacobian: (m, nv) of the independent equations, see `LoopEquations.evaluate_scaled`.
        passive_gamma: (m, n) passive rows of gamma.
    """

    q: Array
    q_a: Array
    jacobian: Array
    passive_gamma: Array


class NewtonContinuation:
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
        self._equations, self._structure = equations, structure
        self._active_columns, self._passive_columns, self._active_ranges = active, passive, ranges
        self._blocks = structure.blocks_by_size()
        units = self._coordinate_units = equations.coordinate_units
        self._all_columns = np.arange(equations.model.nv)
        self._has_partly_active_rotations = equations.coordinates.has_partial_rotations(active)
        self._gamma_units = units[passive, None] / units[active]
        model = equations.model
        places = [*model.jointPlacements, *(frame.placement for frame in model.frames)]
        self._largest_dimension = max(float(np.abs(place.translation).max()) for place in places)
        home = self.solve_newton(structure.home, structure.home[active], 30)
        if home is None:
            raise MechanismError("the home configuration does not close, change 'home'", "home")
        self.home = home
        self._home_signs = self._determinant_signs(home)

    def rounding_scale(self, q: Array) -> float:
        """Factor on rounding errors at a configuration (nq,): its largest scaled dimension."""
        return max(
            1.0,
            float(
                np.abs(q[self._equations.coordinates.is_translation]).max(
                    initial=self._largest_dimension
                )
            )
            / self._equations.characteristic_length,
        )

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
            phi, jacobian = self._equations.evaluate_scaled(q)
            phi, jacobian = (
                phi[self._structure.independent_rows],
                jacobian[self._structure.independent_rows],
            )
            residual = np.abs(phi).max(initial=0.0)
            at_rounding = residual <= 4e-15 * rounding_scale
            stalled = (
                residual <= 0.1 * _CLOSED_TOLERANCE * rounding_scale
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
        changed_signs = self._changed_signs(solution)
        if changed_signs.any():
            rows = [block for group, _ in self._blocks for block in group][changed_signs.argmax()]
            raise self._wrong_branch_error(self._format_loop_names(np.ravel(rows)), solution)
        opposed_loop = self._equations.find_opposed_loop(solution.q)
        if opposed_loop is not None:
            raise self._wrong_branch_error(f"loop '{opposed_loop}'", solution)
        return solution

    def gamma(self, q: Array) -> Array:
        """Derivative (nv, n) of f at a closed configuration (nq,); see `Closure.gamma`."""
        return self._insert_passive_gamma(self._scaled_jacobian(q), q)

    def drift(self, q: Array, v: Array) -> Array:
        """Accelerations (nv,) at a_A = 0; see `Closure.drift`."""
        return self._drift(self._scaled_jacobian(q), q, v)

    def gamma_velocity_drift(self, q: Array, v_a: Array) -> tuple[Array, Array, Array]:
        """gamma, v = gamma v_A and drift; see `Closure.gamma_velocity_drift`."""
        jacobian = self._scaled_jacobian(q)
        gamma = self._insert_passive_gamma(jacobian, q)
        v = gamma @ v_a
        return gamma, v, self._drift(jacobian, q, v)

    def _scaled_jacobian(self, q: Array) -> Array:
        return self._equations.evaluate_scaled(q)[1][self._structure.independent_rows]

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
            np.abs(solution).max(initial=0.0) > 1e-3 / _SINGULAR_TOLERANCE
            and self._most_singular_block(jacobian)[0] < _SINGULAR_TOLERANCE
        ):
            raise self.singularity_error(jacobian, q_a, sample)

    def singularity_error(
        self, jacobian: Array, q_a: Array, sample: str = ""
    ) -> SingularConfigurationError:
        """The error for a configuration with a singular J_P."""
        loops = self._format_loop_names(self._most_singular_block(jacobian)[1])
        return SingularConfigurationError(
            f"{loops} is at the edge of its branch at {self._format_values(q_a)}{sample}, where "
            "the passive joints are undetermined: stay away from it"
        )

    def _most_singular_block(self, jacobian: Array) -> tuple[float, Indices]:
        """Relative least singular value and rows of the most singular block.

        Whole rows set the scale: a single equation for a single joint is singular where that joint
        loses its lever while others keep theirs.
        """
        least_ratio, rows = 1.0, np.zeros(0, dtype=np.intp)
        for block_rows, block_columns in self._structure.blocks:
            values = np.linalg.svd(
                jacobian[np.ix_(block_rows, self._passive_columns[block_columns])],
                compute_uv=False,
            )
            scale = np.abs(jacobian[block_rows]).max()
            ratio = values[-1] / scale if scale > 0 else 0.0
            if ratio <= least_ratio:
                least_ratio, rows = float(ratio), block_rows
        return least_ratio, rows

    def _determinant_signs(self, solution: ClosedConfiguration) -> Array:
        """Sign of every block's determinant: constant on a branch."""
        signs = [
            np.linalg.slogdet(solution.jacobian[rows, self._passive_columns[columns]])[0]
            for rows, columns in self._blocks
        ]
        return np.concatenate(signs) if signs else np.zeros(0)

    def _changed_signs(self, solution: ClosedConfiguration) -> NDArray[np.bool_]:
        """Which blocks have a determinant of another sign than at home."""
        return np.asarray(self._determinant_signs(solution) * self._home_signs < 0)

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
        """The configuration at q_A next to the current one, None if the branch changes."""
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
        if corrected is None or self._changed_signs(corrected).any():
            return None
        correction = np.abs((corrected.q - predicted)[passive] / units[passive]).max(initial=0.0)
        if correction > 0.02 + 0.5 * predicted_step:
            return None
        q = self._equations.coordinates.wrap_rotations(corrected.q, self._passive_columns)
        return replace(corrected, q=q)

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

    def _out_of_reach_error(
        self, target: Array, last_reached: ClosedConfiguration, sample: str
    ) -> OutOfReachError:
        from scipy.optimize import least_squares  # slow to import

        q = last_reached.q.copy()
        q[self._active_columns] = target

        def evaluate(passive: Array) -> tuple[Array, Array]:
            moved = self._equations.displace(q, self._passive_columns, passive)
            phi, jacobian = self._equations.evaluate_scaled(moved)
            return phi, jacobian[:, self._passive_columns]

        def residual(passive: Array) -> Array:
            return evaluate(passive)[0]

        def jacobian(passive: Array) -> Array:
            return evaluate(passive)[1]

        start = np.zeros(len(self._passive_columns))
        phi = evaluate(least_squares(residual, start, jacobian, xtol=1e-12).x)[0]
        worst = int(np.abs(phi).argmax())
        place, last = self._format_values(target), self._format_values(last_reached.q_a)
        if np.abs(phi[worst]) < 10 * _CLOSED_TOLERANCE * self.rounding_scale(q):
            loops = self._format_loop_names(self._most_singular_block(last_reached.jacobian)[1])
            return OutOfReachError(
                f"{loops} can be closed at {place}{sample}, but the branch does not lead straight "
                f"there from {last}: go around in between, or give a nearer guess"
            )
        return OutOfReachError(
            f"loop '{self._equations.name_of_row(worst)}' cannot be closed at {place}{sample}: it "
            f"stays {self._format_gap(worst, np.abs(phi[worst]))} open; the last configuration on "
            f"the way that closes is at {last}"
        )

    def _wrong_branch_error(self, subject: str, solution: ClosedConfiguration) -> WrongBranchError:
        return WrongBranchError(
            f"{subject} is assembled the other way at {self._format_values(solution.q_a)}: start "
            "from the branch of the home configuration"
        )

    def _format_gap(self, row: int, scaled_residual: float) -> str:
        gap = scaled_residual * self._equations.residual_units[row]
        return f"{gap:.3g} {self._equations.unit_of_row(row)}"

    def _format_loop_names(self, rows: Indices) -> str:
        loops = sorted(
            set(self._equations.loop_of_row[self._structure.independent_rows[rows]].tolist())
        )
        names = " and ".join(f"'{self._equations.names[i]}'" for i in loops)
        return ("loop " if len(loops) == 1 else "the group of loops ") + names

    def _format_values(self, q_a: Array) -> str:
        return self._equations.coordinates.format_values(self._active_columns, q_a)
