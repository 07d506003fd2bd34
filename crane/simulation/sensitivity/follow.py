"""Sensitivities along a simulated motion."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from crane.codegen import Parts
from crane.common.samples import Array
from crane.simulation.sensitivity.rate import traceable
from crane.simulation.sensitivity.setup import Setup
from crane.simulation.sensitivity.tangent import Tangent
from crane.simulation.sensitivity.track import DEEPEST, Jump, Motion, Nodes, Part, Track
from crane.simulation.sensitivity.variational import bent, pairs

ACCURACY = 1e-8  # error of a step, per size of what it is of
LEAST = 1e-6  # of the states, what matters of what a number as a whole changes


class Followed(NamedTuple):
    """A motion and how it changes.

    Attributes:
        time: (N + 1,) [s].
        parts: Of the rows (N + 1, .), see `crane.simulation.run.integrate`.
        slopes: (N + 1, k, p) of k outputs in p directions.
        notes: What is to be said of the motion.
    """

    time: Array
    parts: Parts
    slopes: Array
    notes: list[str]


def follow(
    motion: Motion,
    outputs: Sequence[str],
    setup: Callable[[Array], tuple[Setup, Setup]],
    sizes: Array,
    accuracy: float = ACCURACY,
    progress: Callable[[float], None] | None = None,
) -> Followed:
    """Simulate a machine, and how its outputs change in some directions.

    Args:
        motion: What is simulated.
        outputs: What is observed, see `Rate`.
        setup: Numbers of the simulation, and p directions of them with a leading axis each, given
            the times (2 N + 1,) at which references are asked.
        sizes: (p,) how long directions are that change much.
        accuracy: Error of a step, per size of what it is of.
        progress: See `simulate`.

    Raises:
        InputError: A machine that has no formulas, or floats; an output that is not there.
        SimulationError: It comes to a dead centre; else as `simulate`.
    """
    track = Track(motion, progress)
    base, directions = setup(track.time)
    with traceable(track.chart.machine):
        tangent = Tangent(
            track.chart, track.control, track.own, track.stiff, outputs, _moved(directions)
        )
    scale = LEAST * np.outer(track.largest, 1.0 / sizes)
    slopes = _Follower(track, tangent, base, directions, scale, accuracy).run()
    return Followed(track.time[::2], track.layout.view(track.rows[::2]), slopes, track.notes)


def _moved(directions: Setup) -> Setup:
    """Which numbers change in some of p directions, 1 or 0."""
    flat = (np.any(part != 0, axis=tuple(range(part.ndim - 1))) for part in directions)
    return Setup(*(part.astype(np.float64) for part in flat))


class _Follower:
    """The variational equations along a recorded motion, stretch by stretch.

    Pairs of steps over which A or B bend too much for the method are taken in parts, along states
    that are simulated anew: where a valve opens or a compensator closes they jump.

    Args:
        track: The motion.
        tangent: Derivatives of the rate.
        base: Numbers of the simulation.
        directions: p directions of them.
        scale: (m, p) what is taken for no smaller.
        accuracy: See `follow`.
    """

    def __init__(
        self,
        track: Track,
        tangent: Tangent,
        base: Setup,
        directions: Setup,
        scale: Array,
        accuracy: float,
    ):
        self._track, self._tangent = track, tangent
        self._base, self._directions = base, directions
        self._scale = np.maximum(np.abs(directions.start.T), scale)
        self._accuracy = accuracy

    def run(self) -> Array:
        """Derivatives (N + 1, k, p) of the outputs."""
        track, m, k = self._track, self._tangent.size, len(self._tangent.outputs)
        now = self._directions.start.T.copy()
        out = np.empty((len(track.time) // 2 + 1, k, now.shape[1]))
        for piece in track.course():
            track.adopt(piece.mode)
            if isinstance(piece, Jump):
                now = self._jumped(piece, now)
            elif isinstance(piece, Part):
                now = self._followed(track.simulated(*piece[1:]), now, DEEPEST - 1)[0][-1]
            else:
                every, seen = self._followed(track.recorded(piece), now, DEEPEST)
                at = seen[::2, :k]
                out[piece.first : piece.last + 1] = at[..., :m] @ every + at[..., m:]
                now = every[-1]
        return out

    def _along(self, nodes: Nodes) -> tuple[Array, Array]:
        """A and B, derivatives of outputs and margin; see `Tangent.along`."""
        moved = nodes.between(self._directions.references)
        return self._tangent.along(
            self._track.numbers(self._base, nodes), nodes.states,
            self._directions._replace(references=moved), self._track.rest,
        )  # fmt: skip

    def _followed(self, nodes: Nodes, now: Array, depth: int) -> tuple[Array, Array]:
        """S (n + 1, m, p) at the ends of a stretch's steps, and what is seen at its nodes."""
        m, (both, seen) = self._tangent.size, self._along(nodes)
        count, paired = len(nodes.lengths), len(nodes.lengths) // 2 * 2
        maps = pairs(both[: 2 * paired + 1], nodes.lengths[:paired], self._track.largest)
        ends = np.empty((paired // 2 + 1, *now.shape))
        ends[0] = now
        for i, pair in enumerate(maps.both):
            ends[i + 1] = pair[:, :m] @ ends[i] + pair[:, m:]
        self._scale = np.maximum(self._scale, np.abs(ends).max(axis=0))
        curve = bent(both[: 2 * paired + 1])
        error = np.abs(curve[..., :m] @ ends[:-1] + curve[..., m:])
        error *= nodes.lengths[:paired:2, None, None]
        rough = np.any(error > self._accuracy * self._scale, axis=(1, 2))
        every = [now]
        for first, pair, finer in zip(maps.first, maps.both, rough, strict=True):
            if finer and depth:
                self._refined(nodes, every, depth)
                self._refined(nodes, every, depth)
            else:
                begin = every[-1]
                every += [one[:, :m] @ begin + one[:, m:] for one in (first, pair)]
        if paired < count:
            self._refined(nodes, every, depth)
        return np.array(every), seen

    def _refined(self, nodes: Nodes, every: list[Array], depth: int) -> None:
        """One more step, in parts."""
        finer = self._track.within(nodes, len(every) - 1)
        every.append(self._followed(finer, every[-1], depth - 1)[0][-1])

    def _jumped(self, jump: Jump, now: Array) -> Array:
        """S behind an instant at which joints start or stop; see `Track.leap`."""
        track, m, nodes = self._track, self._tangent.size, self._track.moment(jump.switch)
        by_number = self._along(nodes)[1][1, -1, m:]
        by_state, leap = track.leap(self._tangent, self._base, jump)
        return now - np.outer(leap, by_state @ now + by_number)
