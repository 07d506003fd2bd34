"""One assembly branch: closing the loops from a near posture, and following the branch."""

from dataclasses import dataclass

import numpy as np

from crane.closure.constraint_structure import ConstraintStructure, Indices
from crane.closure.loop_equations import LoopEquations
from crane.common.errors import (
    MechanismError,
    OutOfReachError,
    SingularConfigurationError,
    WrongBranchError,
)
from crane.common.samples import Array, solve_linear

# All in rad and shares of the machine's size, so that a branch is the same at any scale.
_CLOSED_TOLERANCE = 1e-12  # of a closed loop
_SINGULAR_TOLERANCE = (
    1e-6  # relative least singular value of a block where the passive joints get undetermined
)
_MIN_STEP = 2.0**-24  # step of the continuation at which it gives up


@dataclass(frozen=True, eq=False)
class ClosedConfiguration:
    """A closed posture with what the next step from it needs.

    Attributes:
        q: (nq,).
        q_a: (n,) its active coordinates.
        jacobian: (m, nv) of the independent loop equations, as `LoopEquations.evaluate_scaled` has
            it.
        passive_gamma: (m, n) passive rows of gamma.
    """

    q: Array
    q_a: Array
    jacobian: Array
    passive_gamma: Array


class NewtonContinuation:
    """The postures that can be reached from home without passing a singular one.

    Args:
        equations: All loop equations.
        structure: Which of them count.
        names: Names of all joints.
        active: Columns of the active joints.
        passive: Columns of the others.
        ranges: (n,) ranges of the active coordinates, to compare distances [m], [rad].

    Raises:
        MechanismError: The home posture does not close.
    """

    def __init__(
        self,
        equations: LoopEquations,
        structure: ConstraintStructure,
        names: tuple[str, ...],
        active: Indices,
        passive: Indices,
        ranges: Array,
    ):
        self._equations, self._structure = equations, structure
        self._active_names = [names[i] for i in active]
        self._active_columns, self._passive_columns, self._active_ranges = active, passive, ranges
        self._blocks = structure.blocks_by_size()
        self._coordinate_units, self._is_translation = (
            equations.coordinate_units,
            equations.coordinates.is_translation,
        )
        model = equations.model
        places = [*model.jointPlacements, *(frame.placement for frame in model.frames)]
        self._largest_dimension = max(float(np.abs(place.translation).max()) for place in places)
        home = self.solve_newton(structure.home, structure.home[active], 30)
        if home is None:
            raise MechanismError("the home posture does not close, change 'home'", "home")
        self.home = home
        self._home_signs = self._determinant_signs(home)

    def rounding_scale(self, q: Array) -> float:
        """The longest part of a posture (nq,) whose rounding is that of its loops, at least 1."""
        largest_stroke = float(
            np.abs(q[self._is_translation]).max(initial=self._largest_dimension)
        )
        return max(1.0, largest_stroke / self._equations.characteristic_length)

    def solve_newton(
        self, q: Array, q_a: Array, max_iterations: int
    ) -> ClosedConfiguration | None:
        """Close the loops at q_A from a near posture; None where that does not work."""
        q = q.copy()
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
                    gamma = solve_linear(
                        jacobian[:, self._passive_columns], -jacobian[:, self._active_columns]
                    )
                    units = (
                        self._coordinate_units[self._passive_columns, None]
                        / self._coordinate_units[self._active_columns]
                    )
                    return ClosedConfiguration(q, q_a, jacobian, gamma * units)
                step = solve_linear(jacobian[:, self._passive_columns], -phi)
            except np.linalg.LinAlgError:
                return None
            if not np.abs(step).max() < 1.0:  # also NaN
                return None
            previous_residual = residual
            q[self._passive_columns] += step * self._coordinate_units[self._passive_columns]
        return None

    def take_newton_step(self, q: Array, target: Array) -> ClosedConfiguration | None:
        """The posture at a target right beside a posture q (nq,); None where in doubt."""
        if not (np.abs(target - q[self._active_columns]) < 0.01 * self._active_ranges).all():
            return None
        solution = self.solve_newton(q, target, 5)
        if solution is None or not self._is_continuation(
            q, solution, np.zeros(len(self._passive_columns))
        ):
            return None
        self._check_solution(solution, "")
        return solution

    def continue_to(
        self, target: Array, known: ClosedConfiguration, sample: str = ""
    ) -> ClosedConfiguration:
        """The closed posture at a target, tracked from a known one or from home.

        Args:
            target: (n,) active coordinates.
            known: Where to start; home if that is nearer or if it fails.
            sample: What to call the target in errors.

        Raises:
            OutOfReachError: No posture closes the loops.
            BranchEdgeError: The passive joints are not determined there.
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
        """The closed posture nearest to a guess (nq,), home where the guess leads nowhere.

        Raises:
            WrongBranchError: It lies on another branch.
        """
        posture = self.solve_newton(q, q[self._active_columns], 10)
        if posture is None:
            return self.home
        changed_signs = np.flatnonzero(self._determinant_signs(posture) * self._home_signs < 0)
        if len(changed_signs):
            rows = [block for group, _ in self._blocks for block in group][int(changed_signs[0])]
            raise self._wrong_branch_error(self._format_loop_names(np.ravel(rows)), posture)
        opposed_loop = self._equations.find_opposed_loop(posture.q)
        if opposed_loop is not None:
            raise self._wrong_branch_error(f"loop '{opposed_loop}'", posture)
        return posture

    def check_singularity(
        self, jacobian: Array, solution: Array, q_a: Array, sample: str = ""
    ) -> None:
        """Raise where J_P is singular, which shows in what was solved with it.

        Args:
            jacobian: (m, nv) see `LoopEquations.evaluate_scaled`.
            solution: What was solved with its passive columns.
            q_a: (n,) where.
            sample: See `continue_to`.

        Raises:
            BranchEdgeError: It is.
        """
        if (
            np.abs(solution).max(initial=0.0) > 1e-3 / _SINGULAR_TOLERANCE
            and self._most_singular_block(jacobian)[0] < _SINGULAR_TOLERANCE
        ):
            raise self.singularity_error(jacobian, q_a, sample)

    def singularity_error(
        self, jacobian: Array, q_a: Array, sample: str = ""
    ) -> SingularConfigurationError:
        """The error for a posture with a singular J_P."""
        return SingularConfigurationError(
            f"{self._format_loop_names(self._most_singular_block(jacobian)[1])} is at the edge "
            f"of its assembly branch "
            f"at {self._format_active_coordinates(q_a)}{sample}, where the passive joints are "
            f"undetermined: stay away "
            "from it"
        )

    def _most_singular_block(self, jacobian: Array) -> tuple[float, Indices]:
        """Least singular value of a block, relative to its rows, at the most singular block.

        Rows are taken whole: a single equation for a single joint is singular where that joint
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
        """Sign of every block's determinant: constant on an assembly branch."""
        signs = [
            np.linalg.slogdet(solution.jacobian[rows, self._passive_columns[columns]])[0]
            for rows, columns in self._blocks
        ]
        return np.concatenate(signs) if signs else np.zeros(0)

    def _follow_line(
        self, start: ClosedConfiguration, target: Array
    ) -> tuple[ClosedConfiguration | None, ClosedConfiguration]:
        """Follow the branch along the straight line from a posture to a target.

        Returns:
            The posture at the target, or None, and the last posture on the way.
        """
        current, progress, step = start, 0.0, 1.0
        while progress < 1.0 and step >= _MIN_STEP:
            next_progress = min(1.0, progress + step)
            q_a = (
                target
                if next_progress == 1.0
                else start.q_a + next_progress * (target - start.q_a)
            )
            passive_step = current.passive_gamma @ (q_a - current.q_a)
            # towards a fold Newton only converges linearly
            corrected = self._predict_and_correct(
                current, q_a, passive_step, 8 if step > _MIN_STEP * 16 else 40
            )
            if corrected is None:
                step /= 2
                continue
            current, progress = corrected, next_progress
            step *= 2
        return current if progress == 1.0 else None, current

    def _predict_and_correct(
        self, current: ClosedConfiguration, q_a: Array, passive_step: Array, max_iterations: int
    ) -> ClosedConfiguration | None:
        """The posture at q_A from one beside it, None where it is not on the same branch."""
        if (
            not np.abs(passive_step / self._coordinate_units[self._passive_columns]).max(
                initial=0.0
            )
            < 1.0
        ):
            return None
        predicted = current.q.copy()
        predicted[self._passive_columns] += passive_step
        corrected = self.solve_newton(predicted, q_a, max_iterations)
        if corrected is None or not self._is_continuation(predicted, corrected, passive_step):
            return None
        return corrected

    def _is_continuation(
        self, predicted: Array, solution: ClosedConfiguration, passive_step: Array
    ) -> bool:
        """Whether a posture continues the branch it was predicted on."""
        if (self._determinant_signs(solution) * self._home_signs < 0).any():
            return False
        units = self._coordinate_units[self._passive_columns]
        correction = np.abs((solution.q - predicted)[self._passive_columns] / units).max(
            initial=0.0
        )
        predicted_step = np.abs(passive_step / units).max(initial=0.0)
        return bool(correction <= 0.02 + 0.5 * predicted_step)

    def _check_solution(self, solution: ClosedConfiguration, sample: str) -> None:
        """Raise unless every equation holds and the passive joints are determined."""
        units = (
            self._coordinate_units[self._passive_columns, None]
            / self._coordinate_units[self._active_columns]
        )
        self.check_singularity(
            solution.jacobian, solution.passive_gamma / units, solution.q_a, sample
        )
        if len(self._structure.redundant_rows):
            phi, _ = self._equations.evaluate_scaled(solution.q)
            redundant_residuals = np.abs(phi[self._structure.redundant_rows])
            if redundant_residuals.max() > self._structure.redundancy.tolerance:
                row = int(self._structure.redundant_rows[redundant_residuals.argmax()])
                loop = self._equations.names[self._equations.loop_of_row[row]]
                raise OutOfReachError(
                    f"loop '{loop}' stays {self._format_gap(row, redundant_residuals.max())} "
                    f"open at "
                    f"{self._format_active_coordinates(solution.q_a)}{sample}, its surplus "
                    f"equations hold only near home: "
                    "the mechanism is overconstrained, use a looser loop type"
                )

    def _out_of_reach_error(
        self, target: Array, last_reached: ClosedConfiguration, sample: str
    ) -> OutOfReachError:
        from scipy.optimize import least_squares  # slow to import

        q, units = last_reached.q.copy(), self._coordinate_units[self._passive_columns]
        q[self._active_columns] = target

        def evaluate(passive: Array) -> tuple[Array, Array]:
            q[self._passive_columns] = passive * units
            phi, jacobian = self._equations.evaluate_scaled(q)
            return phi, jacobian[:, self._passive_columns]

        def residual(passive: Array) -> Array:
            return evaluate(passive)[0]

        def passive_jacobian(passive: Array) -> Array:
            return evaluate(passive)[1]

        nearest = least_squares(
            residual, q[self._passive_columns] / units, passive_jacobian, xtol=1e-12
        )
        phi = residual(nearest.x)
        worst = int(np.abs(phi).argmax())
        if np.abs(phi[worst]) < 10 * _CLOSED_TOLERANCE * self.rounding_scale(q):
            return OutOfReachError(
                f"{self._format_loop_names(self._most_singular_block(last_reached.jacobian)[1])} "
                "can be closed at "
                f"{self._format_active_coordinates(target)}{sample}, but the branch does not "
                f"lead straight there from "
                f"{self._format_active_coordinates(last_reached.q_a)}: go around in between, or "
                f"give a nearer guess"
            )
        loop = self._equations.names[self._equations.loop_of_row[worst]]
        return OutOfReachError(
            f"loop '{loop}' cannot be closed at "
            f"{self._format_active_coordinates(target)}{sample}: it stays "
            f"{self._format_gap(worst, np.abs(phi[worst]))} open; the last posture on the way "
            f"that "
            f"closes is at {self._format_active_coordinates(last_reached.q_a)}"
        )

    def _wrong_branch_error(self, subject: str, solution: ClosedConfiguration) -> WrongBranchError:
        return WrongBranchError(
            f"{subject} is assembled the other way at "
            f"{self._format_active_coordinates(solution.q_a)}: start from the home "
            "posture's branch"
        )

    def _format_gap(self, row: int, scaled_residual: float) -> str:
        """How far an equation is open, in words."""
        unit = "m" if self._equations.is_translation[row] else "rad"
        return f"{scaled_residual * self._equations.residual_units[row]:.3g} {unit}"

    def _format_loop_names(self, rows: Indices) -> str:
        loops = sorted(
            set(self._equations.loop_of_row[self._structure.independent_rows[rows]].tolist())
        )
        names = " and ".join(f"'{self._equations.names[i]}'" for i in loops)
        return ("loop " if len(loops) == 1 else "the group of loops ") + names

    def _format_active_coordinates(self, q_a: Array) -> str:
        pairs = zip(self._active_names, q_a, strict=True)
        return ", ".join(f"{name} = {value:.6g}" for name, value in pairs)
