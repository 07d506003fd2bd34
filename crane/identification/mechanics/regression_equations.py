"""Regression equations y = W beta of motions, filtered and decimated, in blocks."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from itertools import pairwise

import numpy as np

from crane.common.errors import InputError
from crane.common.progress import Progress, ignore_progress
from crane.common.samples import Array
from crane.common.scratch_arrays import release_pages
from crane.identification.estimation.estimators import Estimate, Prior
from crane.identification.estimation.regressor import (
    Regressor,
    triangular_factor,
    update_triangular_factor,
)
from crane.identification.mechanics.base_parameters import BaseParameters
from crane.identification.mechanics.force_comparison import ForceComparison
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.model_terms import MotionSamples
from crane.identification.signals.signal_processing import (
    Motion,
    filter_kernel,
    filter_rows,
)

MIN_PERIODS = 5.0  # least duration of a recording in periods of the cutoff
_BLOCK_BYTES = 1 << 25  # bytes of an unfiltered regressor per block
# bytes of cached filtered blocks; others are computed again
_CACHE_BYTES = 3 << 27
_MAX_ITERATIONS = 31
_CONVERGENCE_TOLERANCE = 1e-2  # of a standard deviation
_ROUNDING_TOLERANCE = 1e-9  # of the largest value


class _FilteredMotion:
    """Low-pass and decimation of one motion.

    Attributes:
        motion: The motion.
        step: Step of its samples [s].
        thinning: Decimation factor.
        filter_reach: Reach of the filter to each side in samples, a multiple of the factor.
        is_moving: (M, n) mask of the decimated rows that are used.
        in_motion: (M, n) mask of the decimated rows that are not at standstill.
    """

    def __init__(self, motion: Motion, bandwidth: float, min_speed: Array, near_rest: bool):
        from scipy.ndimage import maximum_filter1d

        self.motion, self.step = motion, float(motion.time[1] - motion.time[0])
        duration = float(motion.time[-1] - motion.time[0])
        if not is_long_enough(motion, bandwidth):
            raise InputError(
                f"a bandwidth of {bandwidth:g} Hz leaves nothing of {duration:g} s, give at least "
                f"{MIN_PERIODS / duration:.2g} Hz"
            )
        self.thinning, kernel_reach = 1, 0
        if bandwidth * self.step < 0.25:
            self.thinning = max(1, int(0.25 / (self.step * bandwidth)))
            kernel_reach = len(filter_kernel(self.step, bandwidth)) // 2
        self.filter_reach = -(-kernel_reach // self.thinning) * self.thinning
        # friction laws are not valid near standstill, nor in rows within the reach of the filter
        is_resting = np.abs(motion.v) <= min_speed
        is_near_rest = maximum_filter1d(
            is_resting.view(np.uint8), 2 * kernel_reach + 1, axis=0, mode="constant"
        )
        self.in_motion = ~is_resting[:: self.thinning]
        self.is_moving = self.in_motion if near_rest else is_near_rest[:: self.thinning] == 0


@dataclasses.dataclass
class _EquationBlock:
    """Block of rows that are computed together.

    Attributes:
        filtered_motion: Motion of the block.
        rows: Rows within the motion.
        instants: Rows among all instants.
        term_states: States of terms with memory before the first sample of the block.
    """

    filtered_motion: _FilteredMotion
    rows: slice
    instants: slice
    term_states: dict[object, object] = dataclasses.field(default_factory=dict)


class RegressionEquations:
    """Regression equations of motions: tau_A + gamma^T f = W(q_A, v_A, a_A) beta after a low-pass.

    The regressor of a long recording may exceed the memory. It is computed, filtered and decimated
    in blocks, each with the samples before and after it that the kernel of the filter needs.

    Args:
        model: The model.
        base: Base parameters, whose columns W has.
        motions: The motions, one after the other.
        bandwidth: Bandwidth of the low-pass [Hz].
        min_speed: (n,) standstill velocities, below which rows are omitted.
        progress: Called with the finished share of each pass over the motions.
        values: (r,) parameters at which rows of free joints are evaluated, see `_free_joint_rows`.
        near_rest: Whether rows within the reach of the filter from standstill are used.

    Attributes:
        time: (M,) decimated instants of all motions, one after the other [s].
        forces: (M, n) measured, filtered forces.
        offset: (M, n) known forces, available when all blocks have been read.
        is_moving: (M, n) mask of the rows that are used.
        in_motion: (M, n) mask of all rows that are not at standstill.
        samples: (m,) instants of the used rows.
        groups: (m,) groups of the used rows: joints 0, 1, ... without those that have no rows.
        base, bandwidth, min_speed: See above.

    Raises:
        InputError: The bandwidth is too low, or values are not finite.
    """

    def __init__(
        self,
        model: IdentificationModel,
        base: BaseParameters,
        motions: Sequence[Motion],
        bandwidth: float,
        min_speed: Array,
        progress: Progress = ignore_progress,
        values: Array | None = None,
        near_rest: bool = False,
    ):
        self.base, self.bandwidth, self.min_speed = base, bandwidth, min_speed
        self._model, self._progress, self._values = model, progress, values
        self._motions = motions
        self._filtered_motions = [
            _FilteredMotion(motion, bandwidth, min_speed, near_rest) for motion in motions
        ]
        self.is_moving, self.in_motion = (
            np.concatenate([getattr(part, name) for part in self._filtered_motions])
            for name in ("is_moving", "in_motion")
        )
        instant, joint = np.nonzero(self.is_moving)
        self.samples = instant.astype(np.int32)
        used_joints = np.cumsum(self.is_moving.any(axis=0)) - 1
        self.groups = used_joints.astype(np.int8)[joint]
        times: list[Array] = []  # shifted to follow each other
        end = 0.0
        for part in self._filtered_motions:
            time = part.motion.time[:: part.thinning]
            times.append(time if not times else end + (time - time[0]) + (time[1] - time[0]))
            end = times[-1][-1]
        self.time = np.concatenate(times)
        self.forces, self.offset = np.empty((2, *self.is_moving.shape))
        wanted = _BLOCK_BYTES // (8 * len(model.names) * len(model.machine.active))
        self._blocks, first = list[_EquationBlock](), 0
        for part in self._filtered_motions:
            length = max(wanted, 2 * part.filter_reach) // part.thinning + 1
            count = len(part.is_moving)
            for i in range(0, count, length):
                rows = slice(i, min(i + length, count))
                span = slice(first + rows.start, first + rows.stop)
                self._blocks.append(_EquationBlock(part, rows, span))
            first += count
        self._block_cache: dict[int, Array] = {}

    def blocks(self, backwards: bool = False) -> Iterator[tuple[slice, Array]]:
        """Slices of instants, and blocks of W (L, n, r)."""
        numbers = range(len(self._blocks))
        for done, number in enumerate(reversed(numbers) if backwards else numbers):
            W = self._block_cache.get(number)
            if W is None:
                W = self._compute_block(number)
            cached_bytes = sum(one.nbytes for one in self._block_cache.values())
            if cached_bytes + W.nbytes <= _CACHE_BYTES:
                self._block_cache[number] = W
            self._progress((done + 1) / len(self._blocks))
            yield self._blocks[number].instants, W

    def _compute_block(self, number: int) -> Array:
        """Filtered W (L, n, r) of a block; also stores its forces and offset."""
        block = self._blocks[number]
        part, rows, thinning = block.filtered_motion, block.rows, block.filtered_motion.thinning
        start = max(0, rows.start * thinning - part.filter_reach)
        stop = min(len(part.motion.q), rows.stop * thinning + part.filter_reach)
        both = self._unfiltered_block(number, start, stop)
        tau = part.motion.tau[start:stop]
        if part.filter_reach:
            both, tau = filter_rows(both, tau, part.step, self.bandwidth, thinning)
        release_pages()
        here = slice(rows.start - start // thinning, rows.stop - start // thinning)
        self.forces[block.instants], self.offset[block.instants] = tau[here], both[here, :, -1]
        return np.ascontiguousarray(both[here, :, :-1])

    def _unfiltered_block(self, number: int, start: int, stop: int) -> Array:
        """Matrix [W, offset] (stop - start, n, r + 1), computed in parts."""
        part, next_blocks = (
            self._blocks[number].filtered_motion,
            self._blocks[number + 1 : number + 2],
        )
        motion = part.motion
        first = None  # first sample of the filter of the next block
        if next_blocks and next_blocks[0].filtered_motion is part:
            first = max(0, next_blocks[0].rows.start * part.thinning - part.filter_reach)
        size = _BLOCK_BYTES // (8 * len(self._model.names) * motion.q.shape[1])
        cuts = {*range(start, stop, max(size, 1)), stop, *([first] if first else [])}
        term_states = dict(self._blocks[number].term_states)
        both = np.empty((stop - start, motion.q.shape[1], self.base.rank + 1))
        for low, high in pairwise(sorted(cuts)):
            q, v, a = (x[low:high] for x in (motion.q, motion.v, motion.a))
            at = self._model.samples(q, v, a, part.step, (0,) if low == 0 else ())
            at = dataclasses.replace(at, term_states=term_states)
            here = both[low - start : high - start]
            if self._values is None:
                here[:, :, :-1], here[:, :, -1] = self._sides(at)
            else:
                here[:, :, :-1], here[:, :, -1] = self._free_joint_rows(at, self._values)
            if high == first:
                next_blocks[0].term_states = dict(term_states)
        return both

    def _sides(self, at: MotionSamples) -> tuple[Array, Array]:
        """W (N, n, r) and known forces (N, n)."""
        return self._model.regressor(at)[:, :, self.base.independent], self._model.known_forces(at)

    def _free_joint_rows(self, samples: MotionSamples, values: Array) -> tuple[Array, Array]:
        """W (N, n, r) and known forces (N, n) with rows of free joints at parameters b.

        The force of a free joint is known to be zero, and noise is in its motion. The equation
        0 = W beta + known determines ratios of parameters only, and least squares would be biased
        by the noise of the measured accelerations in W. With the accelerations a_f(b) of the free
        joints f by the model (hybrid dynamics, see `Dynamics.hybrid`) the error is

            e = -(W(a) b + known(a))_f = M_ff(b) (a_f(b) - a_f).

        Gauss-Newton steps with the weights M_ff give rows at the accelerations of the model,
        without measured noise:

            W_f(a(b)) beta = e + W_f(a(b)) b.

        They do not determine the scale of b, which driven joints, known forces or a prior
        determine.

        Args:
            samples: Samples of the motion.
            values: (r,) parameters b.
        """
        machine = self._model.machine
        free_joints = np.setdiff1d(np.flatnonzero(~machine.is_driven), machine.held)
        term_states = dict(samples.term_states)  # states of terms with memory
        W, known = self._sides(samples)
        residual = (W @ values + known)[:, free_joints]

        def free_rows_at(a_a: Array) -> tuple[Array, Array]:
            at = dataclasses.replace(samples, a_a=a_a, term_states=dict(term_states))
            W, known = self._sides(at)
            return W[:, free_joints], (W @ values + known)[:, free_joints]

        columns = [
            free_rows_at(samples.a_a + np.eye(samples.a_a.shape[1])[i])[1] - residual
            for i in free_joints.tolist()
        ]
        a_a = samples.a_a.copy()
        a_a[:, free_joints] -= np.linalg.solve(np.stack(columns, axis=2), residual[:, :, None])[
            :, :, 0
        ]
        W[:, free_joints], _ = free_rows_at(a_a)
        known[:, free_joints] = residual - W[:, free_joints] @ values
        return W, known

    def thinned_motions(self) -> list[Motion]:
        """The motions at the decimated instants, with filtered forces."""
        forces = np.split(
            self.forces, np.cumsum([len(part.is_moving) for part in self._filtered_motions[:-1]])
        )
        return [
            dataclasses.replace(part.motion[:: part.thinning], tau=tau)
            for part, tau in zip(self._filtered_motions, forces, strict=True)
        ]

    def modelled_forces(self, values: Array) -> Array:
        """Products of W with parameters (r,): (M, n), or with (r, k): (M, n, k)."""
        out = np.empty((*self.is_moving.shape, *values.shape[1:]))
        for span, W in self.blocks():
            out[span] = W @ values
        return out

    def compare(self, values: Array) -> ForceComparison:
        """Measured and modelled forces for parameters (r,)."""
        modelled = self.modelled_forces(values) + self.offset
        return ForceComparison(
            self.time,
            self.forces,
            modelled,
            self.is_moving,
            self._model.machine.active,
            self.in_motion,
        )

    @cached_property
    def y(self) -> Array:
        """Forces (m,) of the used rows minus known forces."""
        _ = self.triangular_factors
        return (self.forces - self.offset)[self.is_moving]

    def stacked_factors(self, T: Array) -> Array:
        """Triangular factors (n p, k) of the regressor W T, stacked by joint."""
        return np.vstack(list(self.triangular_factors[:, :, :-1] @ T))

    @cached_property
    def triangular_factors(self) -> Array:
        """Triangular factors (g, r + 1, r + 1) of [W y] of the used rows of each joint."""
        return self.segment_factors(1)[0]

    def segment_factors(self, count: int) -> Array:
        """Triangular factors (count, g, k, k) of equal segments of the time."""
        joints = np.flatnonzero(self.is_moving.any(axis=0))
        out = np.zeros((count, len(joints), self.base.rank + 1, self.base.rank + 1))
        part = np.arange(len(self.time)) * count // len(self.time)
        for span, W in self.blocks():
            y = self.forces[span] - self.offset[span]
            for i in np.unique(part[span]).tolist():
                for R, joint in zip(out[i], joints.tolist(), strict=True):
                    mask = self.is_moving[span, joint] & (part[span] == i)
                    update_triangular_factor(R, np.column_stack([W[mask, joint], y[mask, joint]]))
        return out

    def estimate(
        self, T: Array, estimator: Callable[..., Estimate], prior: Prior | None, start: Array
    ) -> tuple["RegressionEquations", Estimate]:
        """Estimate theta of the parameters T theta, (r, p).

        With free joints the estimate is iterated until their rows are evaluated at its own values.

        Args:
            T: (r, p) combinations of the columns.
            estimator: One of `estimators`.
            prior: Prior of theta, None without one.
            start: (r,) parameters at which rows of free joints are evaluated first.

        Returns:
            The equations of the last iteration, and the estimate.
        """
        equations, values = self, start
        previous = np.full(T.shape[1], np.nan)  # nothing converges to it
        has_free_joints = bool(self._model.machine.free)
        for _ in range(_MAX_ITERATIONS):
            if has_free_joints:
                equations = RegressionEquations(
                    self._model,
                    self.base,
                    self._motions,
                    self.bandwidth,
                    self.min_speed,
                    self._progress,
                    values,
                )
            found = estimator(
                CombinedRegressor(equations, T),
                equations.y,
                equations.groups,
                equations.samples,
                prior,
            )
            tolerance = _CONVERGENCE_TOLERANCE * found.std
            tolerance += _ROUNDING_TOLERANCE * np.abs(previous).max()
            if not has_free_joints or (np.abs(found.values - previous) <= tolerance).all():
                break
            values, previous = T @ found.values, found.values
        return equations, found

    def column_selection(self, base: BaseParameters) -> Array:
        """Selection matrix (r, s) of the columns of a subset of the base parameters."""
        return np.eye(self.base.rank)[:, np.searchsorted(self.base.independent, base.independent)]


def is_long_enough(motion: Motion, bandwidth: float) -> bool:
    """Whether a motion is long enough for a low-pass [Hz]."""
    return bandwidth * float(motion.time[-1] - motion.time[0]) >= MIN_PERIODS


class CombinedRegressor(Regressor):
    """Regressor of the used rows with combined columns.

    Args:
        equations: Equations with the regressor W (., r).
        T: (r, p).

    Attributes:
        shape: (m, p).
    """

    def __init__(self, equations: RegressionEquations, T: Array):
        self._equations, self._T = equations, T
        self.shape = len(equations.samples), T.shape[1]

    def blocks(self, backwards: bool = False) -> Iterator[tuple[slice, Array]]:
        """See `regressor.Regressor`."""
        samples = self._equations.samples
        for span, W in self._equations.blocks(backwards):
            start, stop = np.searchsorted(samples, [span.start, span.stop]).tolist()
            if stop > start:
                yield slice(start, stop), W[self._equations.is_moving[span]] @ self._T

    def triangular_factors(self, y: Array, groups: np.ndarray) -> Array:
        """See `regressor.triangular_factors`."""
        T = np.zeros((len(self._T) + 1, self.shape[1] + 1))
        T[:-1, :-1], T[-1, -1] = self._T, 1.0
        return np.array([triangular_factor(R @ T) for R in self._equations.triangular_factors])
