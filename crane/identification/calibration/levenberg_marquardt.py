"""Levenberg-Marquardt method of a calibration, within bounds and with channel scales.

Its states are kept, so that an interrupted search goes on from the last one.
"""

import warnings
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.signal import correlate

from crane.common.checkpoint import Checkpoint
from crane.common.errors import CraneError
from crane.common.progress import Progress
from crane.common.samples import Array, root_mean_square
from crane.dynamics.joint_forces import find_stick_slip_columns
from crane.identification.calibration.calibration_problem import (
    DERIVATIVE_TOLERANCE,
    CalibrationProblem,
)
from crane.identification.calibration.recording_case import RecordingCase, noise_std

_MAX_WEIGHT_ROUNDS = 3  # rounds of channel scales
_SCALE_TOLERANCE = 0.05  # relative change of channel scales that ends them
# smoothing of friction and least smoothing for derivatives: initial rounds, and final
_SMOOTHING_SCHEDULE, _FINAL_SMOOTHING = (
    ((1.0, 1.0), (0.3, 0.3), (0.1, 0.1), (0.0, 0.3)),
    (0.0, 0.03),
)
_COVARIANCE_SMOOTHING = 0.1  # smoothing for derivatives of the covariance
_MAX_ITERATIONS = 40  # iterations per round
# relative change of the cost that ends the iterations
_COST_TOLERANCE, _INITIAL_COST_TOLERANCE = 1e-4, 1e-2
# least scale per largest value of a channel, and absolute [SI]
_MIN_RELATIVE_SCALE, _MIN_SCALE = 1e-6, 1e-9
_MAX_SCALE_SHARE = 0.2  # largest scale per variation of a channel
# initial damping, and that far from the minimum
_INITIAL_DAMPING, _CAUTIOUS_DAMPING = 1e-3, 1.0
_DAMPING_INCREASE, _DAMPING_DECREASE, _MAX_DAMPING = 10.0, 0.2, 1e8  # of the damping
_PART_DURATION = 2.0  # [s] of the parts of the initial search
_COARSE_DERIVATIVE_TOLERANCE = 1e-2  # relative error of derivatives far from the minimum
_BLOCK_COUNT_RANGE = 8, 40  # range of the number of blocks of a covariance
LOG_COLUMNS = (
    "search", "iteration", "cost", "damping", "ended", "all iterations", "simulations", "unknowns",
)  # fmt: skip


@dataclass(frozen=True)
class SearchState:
    """State of a search after an iteration.

    Attributes:
        z: (p,) scaled unknowns.
        cost: Cost there.
        damping: Damping of the next step.
        iteration: Number of iterations.
        has_ended: Whether this is the minimum.
        total_iterations: Number of iterations of all searches so far.
        simulations: Number of simulations so far.
    """

    z: Array
    cost: float
    damping: float
    iteration: int = 0
    has_ended: bool = False
    total_iterations: int = 0
    simulations: int = 0


class SearchLog:
    """States of successive searches of a calibration.

    A search depends on nothing but the searches before it and its last state, so that it goes on
    from there as it would have.

    Args:
        checkpoint: Where states are kept; None if they are not.
    """

    def __init__(self, checkpoint: Checkpoint):
        self._checkpoint, self._number = checkpoint, 0

    def begin(self) -> SearchState | None:
        """Begin the next search; returns its last state if one is kept."""
        self._number += 1
        with suppress(KeyError, ValueError):  # none, or damaged: it is searched again
            *numbers, unknowns = self._checkpoint.rows[(str(self._number),)]
            iteration, cost, damping, has_ended, total, simulations = map(float, numbers)
            return SearchState(
                np.array([float(x) for x in unknowns.split()]), cost, damping, int(iteration),
                bool(has_ended), int(total), int(simulations),
            )  # fmt: skip
        return None

    def add(self, state: SearchState) -> None:
        """Keep a state of the present search.

        Raises:
            OutputError: It cannot be written.
        """
        cells = (
            state.iteration, repr(float(state.cost)), repr(float(state.damping)),
            int(state.has_ended), state.total_iterations, state.simulations,
            " ".join(map(repr, state.z.tolist())),
        )  # fmt: skip
        self._checkpoint.append((str(self._number),), cells)


class LevenbergMarquardt:
    """Levenberg-Marquardt method within bounds, with channel scales by their residuals.

    Attributes:
        problem: The calibration problem.
        training_cases: Recordings with training data.
        channel_scales: Channel scales by sensor.
        jacobian: (M, p) weighted derivatives of the training data at the minimum.
        residual: (M,) weighted residuals, likewise.
        blocks: (M,) time of each row, unique over recordings.
    """

    def __init__(
        self,
        problem: CalibrationProblem,
        progress: Progress,
        log: SearchLog,
        iteration_count: int = 0,
    ):
        self.problem, self._progress, self._log = problem, progress, log
        unknowns = problem.unknowns
        start_count = problem.unknown_count - len(unknowns)
        self.low = np.array(
            [(x.low - x.start) / x.scale for x in unknowns] + [-np.inf] * start_count
        )
        self.high = np.array(
            [(x.high - x.start) / x.scale for x in unknowns] + [np.inf] * start_count
        )
        self.prior = np.array([x.prior for x in unknowns] + [1.0] * start_count)
        self.training_cases = [case for case in problem.cases if case.train_mask.any()]
        self._scale_bounds = self._channel_scale_bounds()
        self.channel_scales: dict[str, float] = {}
        self.jacobian = self.residual = self.blocks = np.zeros(0)
        self._iteration_count = iteration_count
        self._initial_guess: Array | None = None
        self._has_stiction = bool(find_stick_slip_columns(problem.machine))

    def restricted_search(self, problem: CalibrationProblem, z: Array) -> "LevenbergMarquardt":
        """Method for fewer unknowns, with these channel scales and an initial guess."""
        search = LevenbergMarquardt(problem, self._progress, self._log, self._iteration_count)
        search.channel_scales, search._initial_guess = self.channel_scales, z
        return search

    def run(self) -> Array:
        """Run all rounds; returns the unknowns at the minimum."""
        problem = self.problem
        z = self.smoothed_minimum() if self._initial_guess is None else self._initial_guess
        problem.derivative_tolerance = DERIVATIVE_TOLERANCE
        # residuals with smoothed friction do not give the final scales: they are updated
        for problem.smooth, problem.slopes in _SMOOTHING_SCHEDULE if self._has_stiction else ():
            z = self._minimize(z, _INITIAL_COST_TOLERANCE)
            self.channel_scales = self._updated_channel_scales(z)
        return self.nearest_minimum(z)

    def smoothed_minimum(self) -> Array:
        """Approximate minimum with smoothed friction, and the linearization there."""
        problem = self.problem
        self.channel_scales = {name: most for name, (_, most) in self._scale_bounds.items()}
        problem.smooth = float(self._has_stiction)
        problem.derivative_tolerance = _COARSE_DERIVATIVE_TOLERANCE
        z = self._best_initial_minimum(np.zeros(problem.unknown_count))
        self.channel_scales = self._updated_channel_scales(z)
        z = self._minimize(z, _INITIAL_COST_TOLERANCE)
        self._linearize(z)
        return z

    def nearest_minimum(self, z: Array) -> Array:
        """Nearest minimum to some unknowns, with updated channel scales."""
        problem = self.problem
        problem.smooth, problem.slopes = _FINAL_SMOOTHING
        for _ in range(_MAX_WEIGHT_ROUNDS):
            z = self._minimize(z)
            before, self.channel_scales = self.channel_scales, self._updated_channel_scales(z)
            if all(
                abs(np.log(x / before[name])) < _SCALE_TOLERANCE
                for name, x in self.channel_scales.items()
            ):
                break
        problem.slopes = _COVARIANCE_SMOOTHING
        self._linearize(z)
        self._progress(1.0)
        return z

    def _updated_channel_scales(self, z: Array) -> dict[str, float]:
        """Channel scales by the residuals of the training data."""
        residuals: dict[str, list[Array]] = {}
        for case in self.training_cases:
            residual = self.problem.residuals(case, z)[case.train_mask]
            for name, x in zip(case.sensors, residual.T, strict=True):
                residuals.setdefault(name, []).append(x)
        scales = {}
        for name, parts in residuals.items():
            rms = max(root_mean_square(np.concatenate(parts)), _MIN_SCALE)
            least, most = self._scale_bounds[name]
            scales[name] = min(max(least, rms), most)
        return scales

    def _best_initial_minimum(self, z: Array) -> Array:
        """The better of two minima: from the initial parameters, and from a fit to short parts.

        Long motions have local minima with another number of oscillations, or without motion.
        """
        problem, count = self.problem, len(self.problem.unknowns)
        minima = [self._minimize(z, _INITIAL_COST_TOLERANCE, _CAUTIOUS_DAMPING)]
        with warnings.catch_warnings(action="ignore"):
            parts = [
                x
                for case in self.training_cases
                for x in case.split_training(problem.machine, _PART_DURATION)
            ]
        if parts:
            part_problem = CalibrationProblem(problem.machine, problem.unknowns, parts)
            part_problem.smooth = problem.smooth
            part_problem.derivative_tolerance = problem.derivative_tolerance
            search = LevenbergMarquardt(
                part_problem, self._progress, self._log, self._iteration_count
            )
            search.channel_scales = self.channel_scales
            part_minimum = search._minimize(
                np.zeros(part_problem.unknown_count), _INITIAL_COST_TOLERANCE, _CAUTIOUS_DAMPING
            )
            self._iteration_count = search._iteration_count
            problem.simulation_count += part_problem.simulation_count
            z = z.copy()
            z[:count] = part_minimum[:count]
            if np.isfinite(self._cost(z)):
                minima.append(self._minimize(z, _INITIAL_COST_TOLERANCE, _CAUTIOUS_DAMPING))
        return min(minima, key=self._cost)

    def _channel_scale_bounds(self) -> dict[str, tuple[float, float]]:
        """Least and largest scale of each channel.

        The least is its noise, by third differences, with a lower bound by its digits. The largest
        is by the largest variation of all channels in the same unit: model errors depend on the
        motion, not on the channel.
        """
        variances: dict[str, list[float]] = {}
        digits, variation = dict[str, float](), dict[str, float]()
        units: dict[str, str] = {}
        for case in self.training_cases:
            for name, x in zip(case.sensors, case.measured.T, strict=True):
                known_noise = case.known_sensors[name].noise if name in case.known_sensors else 0.0
                variances.setdefault(name, []).append((known_noise or noise_std(x)) ** 2)
                smallest = _MIN_RELATIVE_SCALE * float(np.abs(x).max())
                digits[name] = max(digits.get(name, _MIN_SCALE), smallest)
                unit = units[name] = case.table.units[name]
                variation[unit] = max(
                    variation.get(unit, 1e-12), float(np.std(x[case.train_mask]))
                )
        bounds = {}
        for name, squares in variances.items():
            least = max(float(np.sqrt(np.mean(squares))), digits[name])
            bounds[name] = least, max(least, _MAX_SCALE_SHARE * variation[units[name]])
        return bounds

    def channel_weights(self, case: RecordingCase) -> Array:
        """Weights (N, k): one over the channel scales, 0 for held-out data."""
        return case.train_mask[:, None] / np.array(
            [self.channel_scales[name] for name in case.sensors]
        )

    def weighted_residuals(self, z: Array) -> Array:
        """Weighted residuals (M,) of the training data.

        Raises:
            CraneError: The machine is not valid, or its simulation fails.
        """
        parts = []
        for case in self.training_cases:
            residuals = self.problem.residuals(case, z, training_only=True)
            parts.append((residuals * self.channel_weights(case))[case.train_mask].ravel())
        return np.concatenate(parts)

    def _cost(self, z: Array) -> float:
        """Half the sum of squares, infinite if the simulation fails."""
        try:
            residuals = self.weighted_residuals(z)
        except CraneError:
            return np.inf
        return 0.5 * float(residuals @ residuals + np.sum((self.prior * z) ** 2))

    def _linearize(self, z: Array) -> None:
        rows, weighted, blocks = [], [], []
        for number, case in enumerate(self.training_cases):
            residual, derivatives = self.problem.linearize(case, z)
            weights, mask = self.channel_weights(case), case.train_mask
            rows.append(
                (derivatives * weights[:, :, None])[mask].reshape(-1, self.problem.unknown_count)
            )
            weighted.append((residual * weights)[mask].ravel())
            time = np.repeat(case.inputs.time[mask], len(case.sensors))
            blocks.append(time + 1e9 * number)
        self.jacobian, self.residual = np.vstack(rows), np.concatenate(weighted)
        self.blocks = np.concatenate(blocks)

    def _minimize(
        self, z: Array, cost_tolerance: float = _COST_TOLERANCE, damping: float = _INITIAL_DAMPING
    ) -> Array:
        """Nearest minimum for the present channel scales."""
        state = self._log.begin()
        if state is None:
            state = SearchState(z, self._cost(z), damping)
        else:
            self._iteration_count = state.total_iterations
            self.problem.simulation_count = state.simulations
        if not np.isfinite(state.cost):  # raises the error
            for case in self.training_cases:
                self.problem.residuals(case, z)
        while not state.has_ended:
            state = self._iterate(state, cost_tolerance)
            self._log.add(state)
        return state.z

    def _iterate(self, state: SearchState, cost_tolerance: float) -> SearchState:
        """State after an iteration: a step that reduces the cost, if there is one."""
        z, cost, damping = state.z, state.cost, state.damping
        self._linearize(z)
        hessian = self.jacobian.T @ self.jacobian + np.diag(self.prior**2)
        gradient = self.jacobian.T @ self.residual + self.prior**2 * z
        while damping <= _MAX_DAMPING:
            trial = self._step(z, hessian, gradient, damping)
            trial_cost = self._cost(trial)
            self._iteration_count += 1
            self._progress(1.0 - 0.97**self._iteration_count)
            if trial_cost < cost:
                z, cost, damping = trial, trial_cost, max(damping * _DAMPING_DECREASE, 1e-9)
                break
            damping *= _DAMPING_INCREASE
        iteration, reduction = state.iteration + 1, state.cost - cost
        has_ended = reduction < cost_tolerance * state.cost or not reduction
        return SearchState(
            z, cost, damping, iteration, has_ended or iteration >= _MAX_ITERATIONS,
            self._iteration_count, self.problem.simulation_count,
        )  # fmt: skip

    def _step(self, z: Array, hessian: Array, gradient: Array, damping: float) -> Array:
        """Damped step within the bounds, by an active set."""
        size = np.diag(hessian)
        scaled = hessian + damping * np.diag(np.maximum(size, 1e-12 * size.max()))
        free = np.ones(len(z), dtype=bool)
        step = np.zeros(len(z))
        for _ in range(len(z)):
            free_indices = np.flatnonzero(free)
            right_side = (
                -gradient[free_indices] - scaled[np.ix_(free_indices, ~free)] @ step[~free]
            )
            step[free_indices] = np.linalg.lstsq(
                scaled[np.ix_(free_indices, free_indices)], right_side, rcond=1e-12
            )[0]
            trial = z + step
            outside = free & ((trial < self.low) | (trial > self.high))
            if not outside.any():
                break
            step[outside] = np.clip(trial, self.low, self.high)[outside] - z[outside]
            free &= ~outside
        return np.clip(z + step, self.low, self.high)

    def covariance(self, z: Array) -> tuple[Array, int]:
        """Covariance (p, p) of the scaled unknowns, and the number of blocks.

        It is H^-1 (sum_b g_b g_b^T) H^-1 with the gradients g_b of blocks, at least that of white
        noise, without regard to bounds.
        """
        hessian = self.jacobian.T @ self.jacobian + np.diag(self.prior**2)
        inverse = np.linalg.pinv(hessian, rcond=1e-13, hermitian=True)
        numbers = np.unique(np.floor(self.blocks / self._block_duration()), return_inverse=True)[1]
        sums = np.zeros((numbers.max() + 1, len(z)))
        np.add.at(sums, numbers, self.jacobian * self.residual[:, None])
        count = len(sums)
        meat = sums.T @ sums * (count / max(count - 1, 1)) + np.diag(self.prior**2)
        robust = inverse @ meat @ inverse
        degrees_of_freedom = max(len(self.residual) - len(z), 1)
        white = inverse * float(self.residual @ self.residual) / degrees_of_freedom
        inflation = np.sqrt(np.maximum(np.diag(white) / np.maximum(np.diag(robust), 1e-300), 1.0))
        return robust * np.outer(inflation, inflation), count

    def _block_duration(self) -> float:
        """Duration of a block [s], four correlation times of the residuals."""
        correlation_time = duration = 0.0
        start = 0
        for case in self.training_cases:
            time = case.inputs.time[case.train_mask]
            duration += float(time[-1] - time[0])
            rows = self.residual[start : start + len(time) * len(case.sensors)]
            start += len(rows)
            step = float(np.median(np.diff(case.inputs.time)))
            for x in rows.reshape(len(time), -1).T:
                correlation_time = max(correlation_time, step * _correlation_time(x))
        fewest, most = _BLOCK_COUNT_RANGE
        return max(min(max(4.0 * correlation_time, duration / most), duration / fewest), 1e-9)


def _correlation_time(x: Array) -> float:
    """Integral correlation time of a sequence in samples."""
    x = x - x.mean()
    power = float(x @ x)
    if not power:
        return 0.0
    correlation = correlate(x, x, method="fft")[len(x) - 1 :] / power
    negative = np.flatnonzero(correlation < 0.05)
    return float(correlation[: negative[0] if len(negative) else len(x)].sum())
