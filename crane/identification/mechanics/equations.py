"""y = W beta along a motion, filtered and thinned, in blocks that fit into memory."""

import dataclasses
from collections.abc import Callable, Iterator
from functools import cached_property

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.identification.estimation.regressor import add_rows, triangular
from crane.identification.mechanics.base import Base
from crane.identification.mechanics.model import Model
from crane.identification.mechanics.result import ForceComparison
from crane.identification.signals.motion import Motion, filter_kernel, filter_rows, moving

_FEWEST = 5.0  # periods of the filter's cutoff in a recording
_BLOCK = 1 << 25  # bytes of an unfiltered regressor that are computed at once
_HELD = 3 << 27  # bytes of filtered blocks that are held; others are computed again when needed

Progress = Callable[[float], None]


class Equations:
    """tau_A + gamma^T f = W(q_A, v_A, a_A) beta of a motion, both sides through one low-pass.

    The regressor of a long recording is larger than memory. It is computed, filtered and thinned
    block by block, each with as many samples before and after as the filter's kernel has,
    so that the blocks are those of the whole.

    Args:
        model: The model.
        base: Its base parameters; W has their columns.
        motion: The motion.
        bandwidth: [Hz] of the low-pass.
        slow: (n,) velocities below which rows do not count.
        progress: Takes the finished share of each pass over the motion.

    Attributes:
        time: (M,) instants that are left [s].
        forces: (M, n) measured, filtered.
        offset: (M, n) of these what no parameter changes; known when all blocks have been read.
        moving: (M, n) which rows count.
        base, bandwidth, slow: See above.

    Raises:
        InputError: The bandwidth leaves nothing, or something is not finite.
    """

    def __init__(
        self,
        model: Model,
        base: Base,
        motion: Motion,
        bandwidth: float,
        slow: Array,
        progress: Progress | None = None,
    ):
        from scipy.ndimage import maximum_filter1d

        step = float(motion.time[1] - motion.time[0])
        duration = float(motion.time[-1] - motion.time[0])
        if bandwidth * duration < _FEWEST:
            raise InputError(
                f"a bandwidth of {bandwidth:g} Hz leaves nothing of {duration:g} s, give at least "
                f"{_FEWEST / duration:.2g} Hz"
            )
        self.base, self.bandwidth, self.slow = base, bandwidth, slow
        self._model, self._motion = model, motion
        self._progress = progress
        self._step = step
        self._thinning, seen = 1, 0
        if bandwidth * step < 0.25:
            self._thinning = max(1, int(0.25 / (step * bandwidth)))
            seen = len(filter_kernel(step, bandwidth)) // 2
        self._reach = -(-seen // self._thinning) * self._thinning
        # near standstill friction is none of its shapes, and in no row that the filter mixes it in
        stuck = ~moving(motion.v, slow)
        near = maximum_filter1d(stuck.view(np.uint8), 2 * seen + 1, axis=0, mode="constant")
        self.moving = near[:: self._thinning] == 0
        self.time = motion.time[:: self._thinning]
        self.forces, self.offset = np.empty((2, *self.moving.shape))
        wanted = _BLOCK // (8 * len(model.names) * motion.q.shape[1])
        length = max(wanted, 2 * self._reach) // self._thinning + 1
        starts = np.arange(0, len(self.time), length)
        self._spans = [slice(i, min(i + length, len(self.time))) for i in starts.tolist()]
        # of the terms that depend on the past, at the first sample that each block needs
        self._memories: dict[int, dict[object, object]] = {0: {}}
        self._held: dict[int, Array] = {}

    def blocks(self, backwards: bool = False) -> Iterator[tuple[slice, Array]]:
        """Which of the instants, and W there (L, n, r)."""
        numbers = range(len(self._spans))
        for done, number in enumerate(reversed(numbers) if backwards else numbers):
            W = self._held.get(number)
            if W is None:
                W = self._block(number)
                if sum(one.nbytes for one in self._held.values()) + W.nbytes <= _HELD:
                    self._held[number] = W
            if self._progress is not None:
                self._progress((done + 1) / len(self._spans))
            yield self._spans[number], W

    def _block(self, number: int) -> Array:
        """W (L, n, r) of a block, filtered; its forces and offset are written down on the way."""
        span, thinning, motion = self._spans[number], self._thinning, self._motion
        start = max(0, span.start * thinning - self._reach)
        stop = min(len(motion.q), span.stop * thinning + self._reach)
        both = self._unfiltered(number, start, stop)
        tau = motion.tau[start:stop]
        if self._reach:
            both, tau = filter_rows(both, tau, self._step, self.bandwidth, thinning)
        here = slice(span.start - start // thinning, span.stop - start // thinning)
        self.forces[span], self.offset[span] = tau[here], both[here, :, -1]
        return np.ascontiguousarray(both[here, :, :-1])

    def _unfiltered(self, number: int, start: int, stop: int) -> Array:
        """[W, offset] (stop - start, n, r + 1), little by little."""
        following = number + 1
        first = None  # sample at which the next block's filter begins
        if following < len(self._spans):
            first = max(0, self._spans[following].start * self._thinning - self._reach)
        size = _BLOCK // (8 * len(self._model.names) * self._motion.q.shape[1])
        cuts = {*range(start, stop, max(size, 1)), stop, *([first] if first else [])}
        memory = dict(self._memories[number])
        both = np.empty((stop - start, self._motion.q.shape[1], self.base.rank + 1))
        edges = sorted(cuts)
        for low, high in zip(edges[:-1], edges[1:], strict=True):
            q, v, a = (x[low:high] for x in (self._motion.q, self._motion.v, self._motion.a))
            at = self._model.samples(q, v, a, starts=(0,) if low == 0 else ())
            at = dataclasses.replace(at, memory=memory)
            part = both[low - start : high - start]
            part[:, :, :-1] = self._model.regressor(at)[:, :, self.base.independent]
            part[:, :, -1] = self._model.known(at)
            if high == first:
                self._memories.setdefault(following, dict(memory))
        return both

    def thinned(self) -> Motion:
        """The motion at the instants that are left, with the filtered forces."""
        q, v, a = (x[:: self._thinning] for x in (self._motion.q, self._motion.v, self._motion.a))
        return Motion(self.time, q, v, a, self.forces)

    def modelled(self, values: Array) -> Array:
        """W values (M, n) for columns of parameters (r,), or (r, k) at once: (M, n, k)."""
        out = np.empty((*self.moving.shape, *values.shape[1:]))
        for span, W in self.blocks():
            out[span] = W @ values
        return out

    def compare(self, values: Array) -> ForceComparison:
        """Measured and modelled forces, for values (r,)."""
        modelled = self.modelled(values) + self.offset
        joints = self._model.machine.active
        return ForceComparison(self.time, self.forces, modelled, self.moving, joints)

    @cached_property
    def _rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Instant and joint of the rows that count, by time."""
        instant, joint = np.nonzero(self.moving)
        return instant.astype(np.int32), joint.astype(np.int8)

    @property
    def samples(self) -> np.ndarray:
        """(m,) instant of each row that counts."""
        return self._rows[0]

    @cached_property
    def groups(self) -> np.ndarray:
        """(m,) joint of each row that counts, 0, 1, ... without those that have none."""
        there = self.moving.any(axis=0)
        return (np.cumsum(there) - 1).astype(np.int8)[self._rows[1]]

    @cached_property
    def y(self) -> Array:
        """(m,) forces of the rows that count, less what no parameter changes."""
        _ = self.factors
        return (self.forces - self.offset)[self.moving]

    @cached_property
    def factors(self) -> Array:
        """(g, r + 1, r + 1) triangular factors of [W y] of each joint's rows that count."""
        return self.segments(1)[0]

    def segments(self, count: int) -> Array:
        """The same of so many equal parts of the time, one after the other (count, g, k, k)."""
        joints = np.flatnonzero(self.moving.any(axis=0))
        out = np.zeros((count, len(joints), self.base.rank + 1, self.base.rank + 1))
        part = np.arange(len(self.time)) * count // len(self.time)
        for span, W in self.blocks():
            y = self.forces[span] - self.offset[span]
            for i in np.unique(part[span]).tolist():
                for R, joint in zip(out[i], joints.tolist(), strict=True):
                    kept = self.moving[span, joint] & (part[span] == i)
                    add_rows(R, np.column_stack([W[kept, joint], y[kept, joint]]))
        return out

    def selection(self, base: Base) -> Array:
        """(r, s) that picks the columns of a narrower base."""
        return np.eye(self.base.rank)[:, np.searchsorted(self.base.independent, base.independent)]

    def columns(self, T: Array) -> "Columns":
        """W T, the rows that count, for T (r, p)."""
        return Columns(self, T)


class Columns:
    """Rows of equations that count, their columns combined: a `regressor.Regressor`.

    Args:
        equations: Whose W (., r).
        T: (r, p).

    Attributes:
        shape: (m, p).
    """

    def __init__(self, equations: Equations, T: Array):
        self._equations, self._T = equations, T
        self.shape = len(equations.samples), T.shape[1]

    def blocks(self, backwards: bool = False) -> Iterator[tuple[slice, Array]]:
        """See `regressor.Regressor`."""
        samples = self._equations.samples
        for span, W in self._equations.blocks(backwards):
            start, stop = np.searchsorted(samples, [span.start, span.stop]).tolist()
            if stop > start:
                yield slice(start, stop), W[self._equations.moving[span]] @ self._T

    def factors(self, y: Array, groups: np.ndarray) -> Array:
        """See `regressor.factors`."""
        size = self.shape[1]
        T = np.zeros((len(self._T) + 1, size + 1))
        T[:-1, :-1], T[-1, -1] = self._T, 1.0
        return np.array([triangular(R @ T) for R in self._equations.factors])
