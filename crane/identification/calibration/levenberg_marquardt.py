"""Levenberg-Marquardt method of a calibration, within bounds and with channel scales.

Its states are kept, so that an interrupted search goes on from the last one.
"""

from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.signal import correlate

from crane.common.checkpoint import Checkpoint
from crane.common.errors import CraneError, SimulationError, prefix_location
from crane.common.progress import Progress
from crane.common.samples import Array, root_mean_square
from crane.dynamics.joint_forces import find_stick_slip_columns
from crane.identification.calibration.calibration_problem import (
    DERIVATIVE_TOLERANCE,
    CalibrationProblem,
)
from crane.identification.calibration.normal_equations import bounded_step, scaled_inverse
from crane.identification.calibration.recording_case import NOISE_LEVEL, RecordingCase, noise_std

_MAX_WEIGHT_ROUNDS = 3  # rounds of channel scales
_SCALE_TOLERANCE = 0.05  # relative change of channel scales that ends them
# smoothing of friction and least smoothing for derivatives: initial rounds, and final
_SMOOTHING_SCHEDULE, FINAL_SMOOTHING = (
    ((1.0, 1.0), (0.3, 0.3), (0.1, 0.1), (0.0, 0.3)),
    (0.0, 0.003),
)
_COVARIANCE_SMOOTHING = 0.1  # smoothing for derivatives of the covariance
_MAX_ITERATIONS = 40  # iterations per round
# relative change of the cost that ends the iterations; where sets of parameters are compared
_COST_TOLERANCE, INITIAL_COST_TOLERANCE, COMPARED_COST_TOLERANCE = 1e-4, 1e-2, 3e-4
# largest cost that the change is relative to: much left of some channels shall not hide others
_MAX_COMPARED_COST = 500.0
# least scale per largest value of a channel, and absolute [SI]
_MIN_RELATIVE_SCALE, _MIN_SCALE = 1e-6, 1e-9
# largest scale of a channel, the usual error of a model, per range of its unit in the recordings
_MAX_SCALE_SHARE = 5e-3
_MAX_SCALES = 1e3  # largest change of an unknown without bounds, in its scales
# damping at first, and the largest reduction of an iteration that is expected, per the last one
_INITIAL_DAMPING, _EXPECTED_REDUCTION = 1e-3, 2.0
_DAMPING_INCREASE, _DAMPING_DECREASE, _MAX_DAMPING = 10.0, 0.2, 1e8  # of the damping
# relative error of derivatives far from the minimum, and of searches
_COARSE_DERIVATIVE_TOLERANCE, _SEARCH_DERIVATIVE_TOLERANCE = 1e-2, 1e-3
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
        has_ended: Whether the search has ended, at its minimum or because that is too high.
    """

    z: Array
    cost: float
    damping: float
    iteration: int = 0
    has_ended: bool = False


class SearchLog:
    """States of successive searches of a calibration.

    A search depends on nothing but the searches before it and its last state, so that it goes on
    from there as it would have.

    Args:
        checkpoint: Where states are kept; None if they are not.

    Attributes:
        iterations: Number of iterations so far.
        simulations: Number of simulations so far.
    """

    def __init__(self, checkpoint: Checkpoint):
        self._checkpoint, self._number = checkpoint, 0
        self.iterations = self.simulations = 0

    def begin(self) -> SearchState | None:
        """Begin the next search; returns its last state if one is kept."""
        self._number += 1
        with suppress(KeyError, ValueError):  # none, or damaged: it is searched again
            *numbers, unknowns = self._checkpoint.rows[(str(self._number),)]
            iteration, cost, damping, has_ended, *counts = map(float, numbers)
            z = np.array([float(x) for x in unknowns.split()])
            state = SearchState(z, cost, damping, int(iteration), bool(has_ended))
            self.iterations, self.simulations = map(int, counts)
            return state
        return None

    def add(self, state: SearchState) -> None:
        """Keep a state of the present search.

        Raises:
            OutputError: It cannot be written.
        """
        cells = (
            state.iteration, repr(float(state.cost)), repr(float(state.damping)),
            int(state.has_ended), self.iterations, self.simulations,
            " ".join(map(repr, state.z.tolist())),
        )  # fmt: skip
        self._checkpoint.append((str(self._number),), cells)


class LevenbergMarquardt:
    """Levenberg-Marquardt method within bounds, with channel scales by their residuals.

    Attributes:
        problem: The calibration problem.
        training_cases: Recordings with training data.
        channel_scales: Channel scales by sensor.
        scale_bounds: Least and largest scale of each channel.
        jacobian: (M, p) weighted derivatives of the training data at the minimum.
        residual: (M,) weighted residuals, likewise.
        blocks: (M,) time of each row, unique over recordings.
        channels: (M,) channel of each row, by its index in `channel_scales`.
        redundancies: Samples per independent residual by sensor: residuals of model errors are no
            independent observations.
        has_equal_channels: Whether all channels count by the largest redundancy, not by their own.
        prior: (p,) weights of the priors.
        has_stiction: Whether friction of the machine sticks.
        minima: Minima of the searches from several starts, first the one that goes on.
    """

    def __init__(
        self,
        problem: CalibrationProblem,
        progress: Progress,
        log: SearchLog,
    ):
        self.problem, self._progress, self.log = problem, progress, log
        unknowns = problem.unknowns
        start_count = problem.unknown_count - len(unknowns)
        self.low = np.nan_to_num(
            [(x.low - x.start) / x.scale for x in unknowns] + [-np.inf] * start_count,
            neginf=-_MAX_SCALES,
        )
        self.high = np.nan_to_num(
            [(x.high - x.start) / x.scale for x in unknowns] + [np.inf] * start_count,
            posinf=_MAX_SCALES,
        )
        self.training_cases = [case for case in problem.cases if case.train_mask.any()]
        self.prior = np.array([x.prior for x in unknowns] + [1.0] * start_count)
        count = sum(int(case.train_mask.sum()) for case in self.training_cases)
        self._max_redundancy = max(count / _BLOCK_COUNT_RANGE[1], 1.0)
        self.scale_bounds = self._channel_scale_bounds()
        self.redundancies = dict.fromkeys(self.scale_bounds, self._max_redundancy)
        self.channel_scales: dict[str, float] = {}
        self.jacobian = self.residual = self.blocks = self.channels = np.zeros(0)
        self.minima: list[SearchState] = []
        self.has_equal_channels = True
        self.has_stiction = bool(find_stick_slip_columns(problem.machine))

    def restricted_search(self, problem: CalibrationProblem) -> "LevenbergMarquardt":
        """Method for fewer unknowns, with these channel scales."""
        search = LevenbergMarquardt(problem, self._progress, self.log)
        search.channel_scales, search.redundancies = self.channel_scales, self.redundancies
        search.has_equal_channels, search.blocks = self.has_equal_channels, self.blocks
        return search

    def start_with_smoothed_friction(self) -> None:
        """Prepare a search far from the minimum: largest channel scales, smoothed friction."""
        problem = self.problem
        self.channel_scales = {name: most for name, (_, most) in self.scale_bounds.items()}
        problem.smooth = float(self.has_stiction)
        problem.derivative_tolerance = _COARSE_DERIVATIVE_TOLERANCE

    def sharpen_friction(self, z: Array) -> Array:
        """Follow the minimum of smoothed friction near to that of the friction model."""
        problem = self.problem
        problem.derivative_tolerance = _SEARCH_DERIVATIVE_TOLERANCE
        # residuals with smoothed friction do not give the final scales: they are updated
        for problem.smooth, problem.slopes in _SMOOTHING_SCHEDULE if self.has_stiction else ():
            is_last = not problem.smooth
            z = self.minimize(z, COMPARED_COST_TOLERANCE if is_last else INITIAL_COST_TOLERANCE).z
            self.update_scales(z)
        return z

    def nearest_minimum(self, z: Array) -> Array:
        """Nearest minimum to some unknowns, with updated channel scales."""
        problem = self.problem
        problem.smooth, problem.slopes = FINAL_SMOOTHING
        for _ in range(_MAX_WEIGHT_ROUNDS):
            z, before = self.minimize(z).z, self.weight_divisors
            self.update_scales(z)
            self.has_equal_channels = False
            if all(
                abs(np.log(x / before[name])) < _SCALE_TOLERANCE
                for name, x in self.weight_divisors.items()
            ):
                break
        self.linearize_for_covariance(z)
        self._progress(1.0)
        return z

    def linearize_for_covariance(self, z: Array) -> None:
        """Linearize with derivatives that hold over an interval."""
        problem = self.problem
        before = problem.slopes, problem.derivative_tolerance
        problem.slopes, problem.derivative_tolerance = _COVARIANCE_SMOOTHING, DERIVATIVE_TOLERANCE
        self.linearize(z)
        problem.slopes, problem.derivative_tolerance = before

    def _training_residuals(self, z: Array) -> dict[str, Array]:
        """Residuals of each channel over the training data."""
        residuals: dict[str, list[Array]] = {}
        for case in self.training_cases:
            self.log.simulations += 1
            residual = self.problem.residuals(case, z)[case.train_mask]
            for name, x in zip(case.sensors, residual.T, strict=True):
                residuals.setdefault(name, []).append(x)
        return {name: np.concatenate(parts) for name, parts in residuals.items()}

    def training_errors(self, z: Array) -> dict[str, float]:
        """RMS residual of each channel over the training data."""
        return {
            name: max(root_mean_square(x), _MIN_SCALE)
            for name, x in self._training_residuals(z).items()
        }

    def update_scales(self, z: Array) -> None:
        """Set scale and redundancy of each channel by the residuals of the training data."""
        for name, x in self._training_residuals(z).items():
            scale = np.clip(root_mean_square(x), *self.scale_bounds[name])
            redundancy = np.clip(2.0 * _correlation_time(x) - 1.0, 1.0, self._max_redundancy)
            self.channel_scales = self.channel_scales | {name: float(scale)}
            self.redundancies = self.redundancies | {name: float(redundancy)}

    @property
    def weight_divisors(self) -> dict[str, float]:
        """One over the weight of each channel in its unit."""
        sizes = dict.fromkeys(self.channel_scales, self._max_redundancy) | (
            {} if self.has_equal_channels else self.redundancies
        )
        return {x: scale * float(np.sqrt(sizes[x])) for x, scale in self.channel_scales.items()}

    def _channel_scale_bounds(self) -> dict[str, tuple[float, float]]:
        """Least and largest scale of each channel.

        The least is its noise, by third differences, with a lower bound by its digits. The largest
        is a share of the range of all channels in the same unit, of pressures from vacuum: model
        errors depend on the motion and the load, not on the channel. No channel is given up.
        """
        variances: dict[str, list[float]] = {}
        digits, ranges = dict[str, float](), dict[str, float]()
        units: dict[str, str] = {}
        for case in self.training_cases:
            for name, x in zip(case.sensors, case.measured.T, strict=True):
                known_noise = case.known_sensors[name].noise if name in case.known_sensors else 0.0
                variances.setdefault(name, []).append((known_noise or noise_std(x)) ** 2)
                largest = float(np.abs(x).max())
                digits[name] = max(digits.get(name, _MIN_SCALE), _MIN_RELATIVE_SCALE * largest)
                unit = units[name] = case.table.units[name]
                span = largest if unit == "Pa" else float(np.ptp(x[case.train_mask]))
                ranges[unit] = max(ranges.get(unit, 1e-12), span)
        bounds = {}
        for name, squares in variances.items():
            least = max(float(np.sqrt(np.mean(squares))), digits[name])
            bounds[name] = least, max(least, _MAX_SCALE_SHARE * ranges[units[name]])
        return bounds

    def leaves_noise(
        self, z: Array, names: Collection[str] = (), level: float = NOISE_LEVEL
    ) -> bool:
        """Whether the residuals of channels, all by default, are about their noise."""
        return all(
            rms < level * self.scale_bounds[name][0]
            for name, rms in self.training_errors(z).items()
            if not names or name in names
        )

    def channel_weights(self, case: RecordingCase) -> Array:
        """Weights (N, k) by channel scales and redundancies, 0 for held-out data."""
        divisors = self.weight_divisors
        return case.train_mask[:, None] / np.array([divisors[x] for x in case.sensors])

    def weighted_residuals(self, z: Array) -> Array:
        """Weighted residuals (M,) of the training data.

        Raises:
            CraneError: The machine is not valid, or its simulation fails.
        """
        parts = []
        for case in self.training_cases:
            self.log.simulations += 1
            residuals = self.problem.residuals(case, z, training_only=True)
            parts.append((residuals * self.channel_weights(case))[case.train_mask].ravel())
        return np.concatenate(parts)

    def cost(self, z: Array) -> float:
        """Half the sum of squares, infinite if the simulation fails."""
        try:
            residuals = self.weighted_residuals(z)
        except CraneError:
            return np.inf
        return 0.5 * float(residuals @ residuals + np.sum((self.prior * z) ** 2))

    def linearize(self, z: Array) -> None:
        """Set jacobian, residual, blocks and channels at z."""
        rows, weighted, blocks, channels = [], [], [], []
        order = {name: k for k, name in enumerate(self.scale_bounds)}
        for number, case in enumerate(self.training_cases):
            self.log.simulations += 1
            try:
                residual, derivatives = self.problem.linearize(case, z)
            except SimulationError as error:
                raise SimulationError(prefix_location(case.name, error)) from None
            weights, mask = self.channel_weights(case), case.train_mask
            rows.append(
                (derivatives * weights[:, :, None])[mask].reshape(-1, self.problem.unknown_count)
            )
            weighted.append((residual * weights)[mask].ravel())
            time = np.repeat(case.inputs.time[mask], len(case.sensors))
            blocks.append(time + 1e9 * number)
            channels.append(np.tile([order[x] for x in case.sensors], int(mask.sum())))
        self.jacobian, self.residual = np.vstack(rows), np.concatenate(weighted)
        self.blocks, self.channels = np.concatenate(blocks), np.concatenate(channels)

    def minimize(
        self,
        z: Array,
        cost_tolerance: float = _COST_TOLERANCE,
        damping: float = _INITIAL_DAMPING,
        max_iterations: int = _MAX_ITERATIONS,
        highest_cost: float = np.inf,
    ) -> SearchState:
        """Last state of a search for the nearest minimum, for the present channel scales.

        Args:
            z: (p,) start.
            cost_tolerance: Relative reduction of the cost by an iteration that ends the search.
            damping: Initial damping.
            max_iterations: Number of iterations that ends the search.
            highest_cost: The search ends where even twice the last reduction in each iteration
                that is left would not lead below it.

        Raises:
            CraneError: The simulation fails at the start.
        """
        state = self.log.begin()
        if state is None:
            state = SearchState(z, self.cost(z), damping)
        if not np.isfinite(state.cost):  # raises the error
            for case in self.training_cases:
                self.problem.residuals(case, z)
        while not state.has_ended and state.iteration < max_iterations:
            state = self._iterate(state, cost_tolerance, max_iterations, highest_cost)
            self.log.add(state)
        return state

    def _iterate(
        self, state: SearchState, cost_tolerance: float, max_iterations: int, highest_cost: float
    ) -> SearchState:
        """State after an iteration: a step that reduces the cost, if there is one.

        For arguments see `minimize`.
        """
        z, cost, damping = state.z, state.cost, state.damping
        self.linearize(z)
        hessian = self.jacobian.T @ self.jacobian + np.diag(self.prior**2)
        gradient = self.jacobian.T @ self.residual + self.prior**2 * z
        while damping <= _MAX_DAMPING:
            trial = np.clip(
                z + bounded_step(hessian, gradient, self.low - z, self.high - z, damping),
                self.low,
                self.high,
            )
            trial_cost = self.cost(trial)
            self.log.iterations += 1
            self._progress(1.0 - 0.97**self.log.iterations)
            if trial_cost < cost:
                z, cost, damping = trial, trial_cost, max(damping * _DAMPING_DECREASE, 1e-9)
                break
            damping *= _DAMPING_INCREASE
        iteration, reduction = state.iteration + 1, state.cost - cost
        has_ended = (
            not reduction
            or reduction < cost_tolerance * min(state.cost, _MAX_COMPARED_COST)
            or cost - _EXPECTED_REDUCTION * (max_iterations - iteration) * reduction > highest_cost
        )
        return SearchState(z, cost, damping, iteration, has_ended)

    def covariance(self, z: Array) -> tuple[Array, int]:
        """Covariance (p, p) of the scaled unknowns, and the number of blocks.

        It is H^-1 (sum_b g_b g_b^T) H^-1 with the gradients g_b of blocks, at least that of white
        noise, without regard to bounds. The variance of an unknown without effect is infinite.
        """
        hessian = self.jacobian.T @ self.jacobian + np.diag(self.prior**2)
        inverse = scaled_inverse(hessian)
        numbers = np.unique(np.floor(self.blocks / self._block_duration()), return_inverse=True)[1]
        sums = np.zeros((numbers.max() + 1, len(z)))
        np.add.at(sums, numbers, self.jacobian * self.residual[:, None])
        count = len(sums)
        robust = inverse @ (
            sums.T @ sums * (count / max(count - 1, 1)) + np.diag(self.prior**2)
        ) @ inverse  # fmt: skip
        white = inverse * (
            float(self.residual @ self.residual) / max(len(self.residual) - len(z), 1)
        )
        inflation = np.sqrt(np.maximum(np.diag(white) / np.maximum(np.diag(robust), 1e-300), 1.0))
        return robust * np.outer(inflation, inflation) + np.diag(
            np.where(np.diag(hessian) == 0.0, np.inf, 0.0)
        ), count

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
