"""Multi-start search: closing the loops without a good initial guess.

The residual of a loop is the locked part of log(M_1^-1 M_2), with M_i the placements of its
frames: rotations [rad], and scaled translations; for loops that lock no rotation, the distance of
the origins. Unlike the loop equations it only vanishes where axes point in the same direction, and
it grows up to half a revolution. Damped least squares decrease it from any starting point
(Levenberg 1944; damping proportional to the squared residual keeps quadratic convergence,
Yamashita and Fukushima 2001), with a line search along the path that limits bend. Starting points
lie around the guess at increasing distances.
"""

import itertools
from collections.abc import Callable, Iterator

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from crane.closure.coordinates import Indices
from crane.closure.loop_equations import LoopEquations
from crane.common.samples import Array
from crane.description.specification import LOOP_TYPES

_RESIDUAL_TOLERANCE = 1e-11  # scaled
_MAX_ITERATIONS = 80
_MAX_STEP = 1.0  # largest scaled step of an iteration
_MAX_HALVINGS = 12
_DAMPING = 1e-3
_SLOW_PROGRESS_RATIO, _MAX_SLOW_ITERATIONS = (
    0.99,
    6,
)  # ratio of residuals that is no progress, and how often it is borne
_MAX_STARTS_UNTIL_CLOSED, _EXTRA_STARTS_RANGE = (
    24,
    (5, 24),
)  # until one closes, and at least and at most from then on
_MAX_STARTS_TIMES_JOINTS, _EXTRA_STARTS_TIMES_JOINTS = (
    2000,
    120,
)  # starts times joints at most: in all, and after one closes
_START_RADII = (0.3, 1.0, 2.0, np.pi)  # scaled radii of the starting points
_SAME_CONFIGURATION_TOLERANCE = 1e-3  # scaled distance of equal configurations


def damped_step(
    jacobian: Array,
    residual: Array,
    base_damping: float = 1e-14,
    max_step: float = _MAX_STEP,
    max_cost: float = 1.0,
) -> Array:
    """Levenberg-Marquardt step towards residual = 0, at most `max_step` in any joint; scaled.

    The damping falls with the squared residual, which keeps quadratic convergence.
    """
    gram = jacobian.T @ jacobian
    rounding = base_damping + 1e-15 * float(gram.diagonal().max(initial=0.0))
    damping = _DAMPING * min(max_cost, float(residual @ residual)) + rounding
    step = np.linalg.solve(gram + damping * np.eye(len(gram)), -jacobian.T @ residual)
    return np.asarray(step * min(1.0, max_step / max(np.abs(step).max(initial=0.0), 1e-300)))


def closest_approach(
    equations: LoopEquations,
    q: Array,
    columns: Indices,
    evaluate: Callable[[Array], tuple[Array, ...]],
    xtol: float = 1e-8,
    max_nfev: int | None = None,
) -> Array:
    """The configuration (nq,) of least squared residuals near q, where loops need not close.

    Args:
        equations: The loops.
        q: (nq,) configuration to start from.
        columns: (k,) columns that may move.
        evaluate: Scaled residuals (m,) at a configuration, their Jacobian (m, nv), and more.
        xtol: See `scipy.optimize.least_squares`.
        max_nfev: See `scipy.optimize.least_squares`.
    """
    from scipy.optimize import least_squares  # slow to import, only needed for open loops

    if not len(columns):
        return q

    def moved(x: Array) -> Array:
        return equations.displace(q, columns, x)

    def residual(x: Array) -> Array:
        return evaluate(moved(x))[0]

    def jacobian(x: Array) -> Array:
        return evaluate(moved(x))[1][:, columns]

    start = np.zeros(len(columns))
    return moved(least_squares(residual, start, jacobian, xtol=xtol, max_nfev=max_nfev).x)


def low_discrepancy_steps(count: int) -> Array:
    """Steps (count,) of a low-discrepancy sequence of points: multiples of them modulo 1.

    The powers of 1 / phi, phi^(k + 1) = phi + 1 for k unknowns (Roberts 2018).
    """
    phi = 2.0
    for _ in range(40):
        phi = (1 + phi) ** (1 / (count + 1))
    return np.asarray(phi ** -np.arange(1.0, count + 1))


class ClosureResidual:
    """Residuals of loops and couplings that grow with the distance from closed.

    Args:
        equations: The loops.
    """

    def __init__(self, equations: LoopEquations):
        self._equations = equations
        self._length_scales = np.where(np.arange(6) < 3, equations.characteristic_length, 1.0)
        self._locked_components = [
            np.flatnonzero(LOOP_TYPES[loop.type]) for loop in equations.loops
        ]
        self._coupling_units = equations.residual_units[
            equations.loop_of_row >= len(equations.loops)
        ]

    def evaluate(self, q: Array) -> tuple[Array, Array]:
        """Residuals (m,) and their Jacobian (m, nv)."""
        equations = self._equations
        model, data = equations.model, equations.data
        joint_jacobians = pin.computeJointJacobians(
            model, data, equations.coordinates.configuration(q)
        ).reshape(6, -1)
        coupling_residuals, coupling_jacobian, _ = equations.evaluate_couplings(q)
        residuals = [coupling_residuals / self._coupling_units]
        jacobians = [coupling_jacobian / self._coupling_units[:, None]]
        for index, locked in enumerate(self._locked_components):
            one, two = (
                data.oMi[joint] * place for joint, place in equations.frames[2 * index :][:2]
            )
            relative_placement = one.actInv(two)
            relative_jacobian = two.toActionMatrixInverse() @ (
                equations.sign[index] * joint_jacobians
            )  # in frame 2
            if locked.max() < 3:
                residual, jacobian = (
                    relative_placement.translation,
                    relative_placement.rotation @ relative_jacobian[:3],
                )
            else:
                residual, jacobian = (
                    pin.log6(relative_placement).vector,
                    pin.Jlog6(relative_placement) @ relative_jacobian,
                )
            residuals.append(residual[locked] / self._length_scales[locked])
            jacobians.append(jacobian[locked] / self._length_scales[locked, None])
        return np.concatenate(residuals), np.vstack(jacobians)


def periodic_coordinates(equations: LoopEquations) -> NDArray[np.bool_]:
    """(nv,) joints that a full revolution leaves unchanged: revolute, in no coupling."""
    coordinates = equations.coordinates
    is_angle = ~coordinates.is_translation & ~coordinates.is_rotation_vector
    return np.asarray(is_angle & ~equations.is_coupled.any(axis=0))


def remove_revolutions(
    q: Array, nearby: Array, periodic: NDArray[np.bool_], lower: Array, upper: Array
) -> Array:
    """The same configuration, with full revolutions removed so that joints are within limits.

    Args:
        q: (nq,).
        nearby: (nq,) configuration to stay near.
        periodic: (nq,) see `periodic_coordinates`.
        lower: (nq,) limits.
        upper: (nq,) limits.

    Returns:
        (nq,), joints within half a revolution of `nearby`, or within their limits where these need
        more revolutions; unchanged where no number of revolutions satisfies the limits.
    """
    turn = 2 * np.pi
    turned = np.where(periodic, nearby + np.remainder(q - nearby + np.pi, turn) - np.pi, q)
    slack = 1e-12
    turned += np.where(
        periodic & (turned < lower), turn * np.ceil((lower - slack - turned) / turn), 0
    )
    turned -= np.where(
        periodic & (turned > upper), turn * np.ceil((turned - upper - slack) / turn), 0
    )
    within_limits = (turned >= lower - slack) & (turned <= upper + slack)
    return np.where(periodic & within_limits, turned, q)


class MultiStartSearch:
    """Search for closed configurations of a machine from many starting points.

    Args:
        equations: The loops.
        initial_guess: (nq,) initial guess.
        specified: Columns whose value in the guess comes from the file.
        extra_starts: Starting points after the first closed configuration; more for smaller
            machines if not given.
    """

    def __init__(
        self,
        equations: LoopEquations,
        initial_guess: Array,
        specified: Indices,
        extra_starts: int | None = None,
    ):
        extra_starts = (
            min(
                max(
                    _EXTRA_STARTS_TIMES_JOINTS // max(len(initial_guess), 1),
                    _EXTRA_STARTS_RANGE[0],
                ),
                _EXTRA_STARTS_RANGE[1],
            )
            if extra_starts is None
            else extra_starts
        )
        self._residual, self.initial_guess = ClosureResidual(equations), initial_guess
        self._coordinates, self._coordinate_units = (
            equations.coordinates,
            equations.coordinate_units,
        )
        self._step_units = equations.step_units
        self._is_geared = np.zeros(len(initial_guess), dtype=bool)
        self._is_geared[[column for _, column in equations.geared_columns]] = True
        self.specified, self._extra_starts = specified, extra_starts
        self._in_loops = (equations.sign != 0).any(axis=0)
        self._periodic = periodic_coordinates(equations)
        self._unlimited_periodic = (
            self._periodic & np.isinf(self._coordinates.upper) & np.isinf(self._coordinates.lower)
        )

    def find_configurations(
        self, movable: Indices, unlimited: Indices, tolerance: float
    ) -> list[Array]:
        """Closed configurations, the nearest to the guess first.

        Ordered by the largest scaled distance of the specified joints; where equal, by their sum
        of squares, then by all joints.

        Args:
            movable: Columns of the joints that may move.
            unlimited: Columns of those that may leave their limits.
            tolerance: Residual that counts as closed.
        """
        found: list[Array] = []
        max_starts = max(2, _MAX_STARTS_TIMES_JOINTS // len(self.initial_guess))
        last_start = min(_MAX_STARTS_UNTIL_CLOSED, max_starts)
        for count, start in enumerate(self._starting_points(movable)):
            if count >= last_start:
                break
            q = self._search_from(start, movable, unlimited, tolerance)
            if q is None:
                continue
            if not found:
                last_start = min(max_starts, count + 1 + self._extra_starts)
            if all(
                self.coordinate_differences(q, other).max() > _SAME_CONFIGURATION_TOLERANCE
                for other in found
            ):
                found.append(q)
        return sorted(found, key=self.distance_from_guess)

    def _search_from(
        self, start: Array, movable: Indices, unlimited: Indices, tolerance: float
    ) -> Array | None:
        """Search within the limits from one starting point; else across them."""
        for without_limits in (unlimited, movable):
            q, residual = self.minimize_residual(start, movable, without_limits)
            limited = np.setdiff1d(movable, unlimited)
            within_limits = self._coordinates.within_limits(q, _RESIDUAL_TOLERANCE)
            if residual <= tolerance and within_limits[limited].all():
                return q
            if not np.isfinite(
                [self._coordinates.lower[limited], self._coordinates.upper[limited]]
            ).any():
                return None
        return None

    def distance_from_guess(self, q: Array) -> tuple[float, float, float]:
        """Distances from the guess: largest of specified joints, their norm, largest of all."""
        differences = self._differences_from_guess(q)
        specified = differences[self.specified]
        return (
            round(float(specified.max(initial=0.0)), 3),
            round(float(np.linalg.norm(specified)), 3),
            float(differences.max(initial=0.0)),
        )

    def largest_specified_deviation(self, q: Array) -> tuple[int, float]:
        """The specified joint that is farthest from the guess, full revolutions ignored.

        Joints in no loop, for example of rotors on gears, are ignored: couplings place them.

        Args:
            q: (nq,).

        Returns:
            Its column, and the scaled distance.
        """
        joints = self.specified[self._in_loops[self.specified]]
        if not len(joints):
            return 0, 0.0
        differences = self._coordinates.scaled_distances(q, self.initial_guess)[joints]
        return int(joints[differences.argmax()]), float(differences.max())

    def largest_deviation(self, q: Array) -> tuple[int, float]:
        """Column of the joint that is farthest from the guess, and its distance [m], [rad]."""
        differences = self._differences_from_guess(q)
        return int(differences.argmax()), float(
            (differences * self._coordinate_units)[differences.argmax()]
        )

    def _differences_from_guess(self, q: Array) -> Array:
        """(nq,) scaled distances from the guess; 0 of geared joints, which others place."""
        return np.where(self._is_geared, 0.0, self.coordinate_differences(q, self.initial_guess))

    def coordinate_differences(self, first: Array, second: Array) -> Array:
        """(nq,) scaled distances of two configurations by joint."""
        angle_differences = np.abs(np.remainder(first - second + np.pi, 2 * np.pi) - np.pi)
        return np.asarray(
            np.where(
                self._unlimited_periodic,
                angle_differences,
                np.abs(first - second) / self._coordinate_units,
            )
        )

    def _starting_points(self, movable: Indices) -> Iterator[Array]:
        """The guess, and low-discrepancy points of growing boxes around it."""
        yield self.initial_guess.copy()
        steps = low_discrepancy_steps(len(movable))
        for count in itertools.count(1):
            share = 2 * np.remainder(0.5 + count * steps, 1.0) - 1
            start = self.initial_guess.copy()
            start[movable] += (
                _START_RADII[count % len(_START_RADII)] * self._step_units[movable] * share
            )
            yield start

    def minimize_residual(
        self, q: Array, movable: Indices, unlimited: Indices
    ) -> tuple[Array, float]:
        """Damped least squares from one starting point.

        Args:
            q: (nq,) starting point.
            movable: Columns of the joints that may move.
            unlimited: Columns of those that may leave their limits.

        Returns:
            The configuration, see `remove_revolutions`, and its largest residual.
        """
        lower, upper = self._coordinates.lower.copy(), self._coordinates.upper.copy()
        lower[unlimited], upper[unlimited] = -np.inf, np.inf
        q = q.copy()
        q[movable] = np.clip(q, lower, upper)[movable]
        residual, jacobian = self._residual.evaluate(q)
        slow_iterations = 0
        for _ in range(_MAX_ITERATIONS):
            cost = float(residual @ residual)
            if (
                np.abs(residual).max(initial=0.0) < _RESIDUAL_TOLERANCE
                or slow_iterations >= _MAX_SLOW_ITERATIONS
            ):
                break
            descent_direction = -jacobian.T @ residual
            at_limit = ((q <= lower) & (descent_direction < 0)) | (
                (q >= upper) & (descent_direction > 0)
            )
            free_columns = movable[~at_limit[movable]]
            if not len(free_columns):
                break
            step = np.zeros(len(q))
            step[free_columns] = (
                damped_step(jacobian[:, free_columns] * self._step_units[free_columns], residual)
                * self._step_units[free_columns]
            )
            step = self._coordinates.coordinate_derivatives(q, step)
            accepted = self._line_search(q, step, cost, lambda way: np.clip(way, lower, upper))
            if accepted is None:
                break
            q, residual, jacobian = accepted
            slow_iterations += int(residual @ residual > _SLOW_PROGRESS_RATIO * cost)
        periodic = self._periodic & np.isin(np.arange(len(q)), movable)
        q = remove_revolutions(
            q, self.initial_guess, periodic, self._coordinates.lower, self._coordinates.upper
        )
        q = self._coordinates.wrap_rotations(q, movable)
        return q, float(np.abs(residual).max(initial=0.0))

    def _line_search(
        self, q: Array, step: Array, cost: float, clip_to_limits: Callable[[Array], Array]
    ) -> tuple[Array, Array, Array] | None:
        """The longest of successively halved steps that decreases the cost, or None."""
        for halvings in range(_MAX_HALVINGS):
            trial = clip_to_limits(q + step / 2**halvings)
            residual, jacobian = self._residual.evaluate(trial)
            if residual @ residual < cost * (1 - 1e-4 / 2**halvings):
                return trial, residual, jacobian
        return None
