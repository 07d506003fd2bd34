"""y = W beta along a motion, filtered and thinned, in blocks that fit into memory."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from itertools import pairwise

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.identification.estimation.regressor import add_rows, triangular
from crane.identification.mechanics.base import Base
from crane.identification.mechanics.comparison import ForceComparison
from crane.identification.mechanics.model import Model
from crane.identification.mechanics.term import Samples
from crane.identification.mechanics.undriven import related
from crane.identification.signals.motion import Motion, filter_kernel, filter_rows, moving

_FEWEST = 5.0  # periods of the filter's cutoff in a recording
_BLOCK = 1 << 25  # bytes of an unfiltered regressor that are computed at once
_HELD = 3 << 27  # bytes of filtered blocks that are held; others are computed again when needed

Progress = Callable[[float], None]


class _Part:
    """One of the motions, through the low-pass.

    Attributes:
        motion: The motion.
        step: Of its samples [s].
        thinning: One of so many samples is left.
        reach: Samples that the filter sees to each side, a multiple of the thinning.
        moving: (M, n) which of the rows that are left count.
    """

    def __init__(self, motion: Motion, bandwidth: float, slow: Array):
        from scipy.ndimage import maximum_filter1d

        self.motion, self.step = motion, float(motion.time[1] - motion.time[0])
        duration = float(motion.time[-1] - motion.time[0])
        if not long_enough(motion, bandwidth):
            raise InputError(
                f"a bandwidth of {bandwidth:g} Hz leaves nothing of {duration:g} s, give at least "
                f"{_FEWEST / duration:.2g} Hz"
            )
        self.thinning, seen = 1, 0
        if bandwidth * self.step < 0.25:
            self.thinning = max(1, int(0.25 / (self.step * bandwidth)))
            seen = len(filter_kernel(self.step, bandwidth)) // 2
        self.reach = -(-seen // self.thinning) * self.thinning
        # near standstill friction is none of its shapes, and in no row that the filter mixes it in
        stuck = ~moving(motion.v, slow)
        near = maximum_filter1d(stuck.view(np.uint8), 2 * seen + 1, axis=0, mode="constant")
        self.moving = near[:: self.thinning] == 0

    def __len__(self) -> int:
        """How many instants are left."""
        return len(self.moving)


@dataclasses.dataclass
class _Block:
    """Rows that are computed at once.

    Attributes:
        part: Whose.
        rows: Which of the part's.
        span: Which of all.
        memory: What terms that depend on the past keep, before the first sample that it needs.
    """

    part: _Part
    rows: slice
    span: slice
    memory: dict[object, object] = dataclasses.field(default_factory=dict)


class Equations:
    """tau_A + gamma^T f = W(q_A, v_A, a_A) beta of motions, both sides through one low-pass.

    The regressor of a long recording is larger than memory. It is computed, filtered and thinned
    block by block, each with as many samples before and after as the filter's kernel has,
    so that the blocks are those of the whole.

    Args:
        model: The model.
        base: Its base parameters; W has their columns.
        motions: The motions, one after the other.
        bandwidth: [Hz] of the low-pass.
        slow: (n,) velocities below which rows do not count.
        progress: Takes the finished share of each pass over the motions.
        values: (r,) at which rows of free joints are taken, see `undriven`; as they are without.

    Attributes:
        time: (M,) instants that are left [s]; those of a motion after another follow it.
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
        motions: Sequence[Motion],
        bandwidth: float,
        slow: Array,
        progress: Progress | None = None,
        values: Array | None = None,
    ):
        self.base, self.bandwidth, self.slow = base, bandwidth, slow
        self._model, self._progress, self._values = model, progress, values
        self._motions = motions
        self._parts = [_Part(motion, bandwidth, slow) for motion in motions]
        self.moving = np.concatenate([part.moving for part in self._parts])
        self.time = _one_after_the_other(
            [part.motion.time[:: part.thinning] for part in self._parts]
        )
        self.forces, self.offset = np.empty((2, *self.moving.shape))
        wanted = _BLOCK // (8 * len(model.names) * len(model.machine.active))
        self._blocks, first = list[_Block](), 0
        for part in self._parts:
            length = max(wanted, 2 * part.reach) // part.thinning + 1
            for i in range(0, len(part), length):
                rows = slice(i, min(i + length, len(part)))
                span = slice(first + rows.start, first + rows.stop)
                self._blocks.append(_Block(part, rows, span))
            first += len(part)
        self._held: dict[int, Array] = {}

    def at(self, values: Array) -> "Equations":
        """The same with rows of free joints taken at values (r,), see `undriven`."""
        same = self._model, self.base, self._motions, self.bandwidth, self.slow, self._progress
        return Equations(*same, values)

    def blocks(self, backwards: bool = False) -> Iterator[tuple[slice, Array]]:
        """Which of the instants, and W there (L, n, r)."""
        numbers = range(len(self._blocks))
        for done, number in enumerate(reversed(numbers) if backwards else numbers):
            W = self._held.get(number)
            if W is None:
                W = self._block(number)
                if sum(one.nbytes for one in self._held.values()) + W.nbytes <= _HELD:
                    self._held[number] = W
            if self._progress is not None:
                self._progress((done + 1) / len(self._blocks))
            yield self._blocks[number].span, W

    def _block(self, number: int) -> Array:
        """W (L, n, r) of a block, filtered; its forces and offset are written down on the way."""
        block = self._blocks[number]
        part, rows, thinning = block.part, block.rows, block.part.thinning
        start = max(0, rows.start * thinning - part.reach)
        stop = min(len(part.motion.q), rows.stop * thinning + part.reach)
        both = self._unfiltered(number, start, stop)
        tau = part.motion.tau[start:stop]
        if part.reach:
            both, tau = filter_rows(both, tau, part.step, self.bandwidth, thinning)
        here = slice(rows.start - start // thinning, rows.stop - start // thinning)
        self.forces[block.span], self.offset[block.span] = tau[here], both[here, :, -1]
        return np.ascontiguousarray(both[here, :, :-1])

    def _unfiltered(self, number: int, start: int, stop: int) -> Array:
        """[W, offset] (stop - start, n, r + 1), little by little."""
        part, following = self._blocks[number].part, self._blocks[number + 1 : number + 2]
        motion = part.motion
        first = None  # sample at which the next block's filter begins
        if following and following[0].part is part:
            first = max(0, following[0].rows.start * part.thinning - part.reach)
        size = _BLOCK // (8 * len(self._model.names) * motion.q.shape[1])
        cuts = {*range(start, stop, max(size, 1)), stop, *([first] if first else [])}
        memory = dict(self._blocks[number].memory)
        both = np.empty((stop - start, motion.q.shape[1], self.base.rank + 1))
        for low, high in pairwise(sorted(cuts)):
            q, v, a = (x[low:high] for x in (motion.q, motion.v, motion.a))
            at = self._model.samples(q, v, a, part.step, (0,) if low == 0 else ())
            at = dataclasses.replace(at, memory=memory)
            here = both[low - start : high - start]
            here[:, :, :-1], here[:, :, -1] = self._sides(at)
            if high == first:
                following[0].memory = dict(memory)
        return both

    def _sides(self, at: Samples) -> tuple[Array, Array]:
        """W (N, n, r) and known forces (N, n)."""
        model = self._model

        def sides(at: Samples) -> tuple[Array, Array]:
            return model.regressor(at)[:, :, self.base.independent], model.known(at)

        if self._values is None:
            return sides(at)
        return related(sides, at, np.flatnonzero(~model.machine.driven), self._values)

    def thinned(self) -> list[Motion]:
        """The motions at the instants that are left, with the filtered forces."""
        forces = np.split(self.forces, np.cumsum([len(part) for part in self._parts[:-1]]))
        out = []
        for part, tau in zip(self._parts, forces, strict=True):
            x, kept = part.motion, slice(None, None, part.thinning)
            out.append(Motion(x.time[kept], x.q[kept], x.v[kept], x.a[kept], tau))
        return out

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


def long_enough(motion: Motion, bandwidth: float) -> bool:
    """Whether a low-pass [Hz] leaves anything of a motion."""
    return bandwidth * float(motion.time[-1] - motion.time[0]) >= _FEWEST


def _one_after_the_other(times: Sequence[Array]) -> Array:
    """Instants of motions, each after the one before."""
    out = [times[0]]
    for time in times[1:]:
        out.append(out[-1][-1] + (time - time[0]) + (time[1] - time[0]))
    return np.concatenate(out)


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
