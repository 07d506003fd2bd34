"""Gradients of sums over a simulated motion, by going back along it.

With J = sum over instants i and outputs of w_i . y(s_i, c), all numbers c and S = ds/dc,

    dJ/dc = sum_i w_i^T (C_i S_i + D_i),    S_(i+1) = Phi_i S_i + Psi_i,

is a sum over i that weights lambda of the state gather on their way back,

    lambda_i = Phi_i^T lambda_(i+1) + C_i^T w_i,
    dJ/dc = lambda_0^T S_0 + sum_i (Psi_i^T lambda_(i+1) + D_i^T w_i),

the exact transpose of `follow` on the same steps (Bryson and Ho, Applied Optimal Control, 1975,
chapter 2; Sandu, On the Properties of Runge-Kutta Discrete Adjoints, 2006). A number of the
machine takes nothing on this way: B^T mu and D^T w, by all numbers at once, are one pass against
the order of the formulas. The recorded states are the checkpoints; derivatives are made anew from
them, one stretch at a time.
"""

from collections.abc import Sequence

import numpy as np

from crane.closure.structure import Indices
from crane.common.samples import Array
from crane.simulation.sensitivity.cotangent import Cotangent
from crane.simulation.sensitivity.follow import ACCURACY, LEAST
from crane.simulation.sensitivity.rate import traceable
from crane.simulation.sensitivity.setup import Setup
from crane.simulation.sensitivity.tangent import Tangent
from crane.simulation.sensitivity.track import DEEPEST, Jump, Nodes, Part, Track
from crane.simulation.sensitivity.variational import BENDING, ReturnedPairs, bent, returned_pairs


class Gatherer:
    """The way back along a motion, stretch by stretch.

    Pairs of steps over which A^T lambda or B^T lambda bend too much for the method are taken in
    parts, as `follow` does where A S + B do: the rule for lambda and the gradient is that for S.

    Args:
        track: The motion.
        outputs: Names (k,) of what is observed, see `Rate`.
        base: Numbers of the simulation.
        changes: By how much they change that do; 0 of others, and of references.
        accuracy: Error of a step, per size of what it is of.

    Raises:
        InputError: An output that is not there, or formulas that are too long.
    """

    def __init__(
        self,
        track: Track,
        outputs: Sequence[str],
        base: Setup,
        changes: Setup,
        accuracy: float = ACCURACY,
    ):
        self._track, self._base, self._accuracy = track, base, accuracy
        of = track.chart, track.control, track.own, track.stiff, outputs
        still = Setup(*(np.zeros(part.shape[-1]) for part in base))
        with traceable(track.chart.machine):
            self._tangent, self._cotangent = Tangent(*of, still), Cotangent(*of, changes)
        self._which = [np.flatnonzero(part) for part in changes[:4]]
        self._sizes = np.concatenate([np.abs(part[part != 0]) for part in changes[:4]])
        self._still = Setup(*(np.zeros((0, part.shape[-1])) for part in base))

    def run(self, weights: Array) -> Setup:
        """Gradients of K sums over the motion.

        Args:
            weights: (K, N + 1, k) of the outputs.

        Returns:
            By all numbers but references, with a leading axis K each; 0 by those that do not
            change.
        """
        track, several, moving = self._track, len(weights), len(self._sizes)
        self._total = np.zeros((several, moving))
        now = np.zeros((several, self._tangent.size))
        self._scales = now.copy(), self._total.copy()
        for piece in reversed(track.course()):
            track.adopt(piece.mode)
            if isinstance(piece, Jump):
                now = self._jumped(piece, now)
            elif isinstance(piece, Part):
                nodes = track.simulated(*piece[1:])
                now = self._gathered(nodes, now, None, DEEPEST - 1)
            else:
                nodes = track.recorded(piece)
                seen = np.swapaxes(weights[:, piece.first : piece.last + 1], 0, 1).copy()
                if len(seen) > 1:
                    seen[-1] = 0.0  # it is seen in the next one
                now = self._gathered(nodes, now, seen, DEEPEST)
        return self._setup(now)

    def _setup(self, start: Array) -> Setup:
        """The gradient in all parts."""
        out = Setup(*(np.zeros((len(start), part.shape[-1])) for part in self._base))
        ends = np.cumsum([len(which) for which in self._which])[:-1]
        every = np.split(self._total, ends, axis=1)
        for part, which, found in zip(out[:4], self._which, every, strict=True):
            part[:, which] = found
        return out._replace(start=start)

    def _gathered(self, nodes: Nodes, now: Array, seen: Array | None, depth: int) -> Array:
        """Lambda (K, m) where a stretch begins, from that where it ends.

        Args:
            nodes: Of n steps.
            now: lambda.
            seen: Weights (n + 1, K, k) of outputs; none of parts of a step.
            depth: How often steps may be taken in parts.
        """
        lengths, k = nodes.lengths, len(self._tangent.outputs)
        if seen is None:
            seen = np.zeros((len(lengths) + 1, len(now), k))
        still = self._still.references.shape
        by_state, looks = self._tangent.along(
            self._track.numbers(self._base, nodes), nodes.states,
            self._still._replace(references=np.zeros((0, len(nodes.times), still[1]))),
            self._track.rest,
        )  # fmt: skip
        count, paired = len(lengths), len(lengths) // 2 * 2
        maps = returned_pairs(
            by_state[: 2 * paired + 1], lengths[:paired], self._track.largest
        )  # fmt: skip
        added = seen @ looks[::2, :k]
        every = np.empty((count + 1, *now.shape))
        every[-1] = now + added[-1]
        if paired < count:
            self._refined(nodes, every, added, count - 1, depth)
        smooth = np.ones(len(maps.first.back), dtype=bool)
        self._back(nodes, maps, every, added, smooth, depth)
        found = self._taken(nodes, maps, every, added, seen, smooth)
        self._scale(every[::2], found)
        if depth:
            bends = bent(by_state[: 2 * paired + 1])
            smooth = np.logical_not(self._rough(nodes, bends, every[2 : paired + 1 : 2]))
        if not smooth.all():
            self._back(nodes, maps, every, added, smooth, depth)
            found = self._taken(nodes, maps, every, added, seen, smooth)
        self._total += found.sum(axis=0)
        return every[0]

    def _back(
        self,
        nodes: Nodes,
        maps: ReturnedPairs,
        every: Array,
        added: Array,
        smooth: Array,
        depth: int,
    ) -> None:
        """Lambda (n + 1, K, m) along pairs, with those that are not smooth in parts."""
        for i in range(len(smooth))[::-1]:
            begin, middle, end = 2 * i, 2 * i + 1, 2 * i + 2
            if smooth[i]:
                every[begin] = (
                    every[end] @ maps.both.back[i].T
                    + added[middle] @ maps.first.back[i].T
                    + added[begin]
                )
            else:
                self._refined(nodes, every, added, middle, depth)
                self._refined(nodes, every, added, begin, depth)

    def _refined(self, nodes: Nodes, every: Array, added: Array, step: int, depth: int) -> None:
        """Lambda where a step begins, which is taken in parts."""
        finer = self._track.within(nodes, step)
        every[step] = self._gathered(finer, every[step + 1], None, depth - 1) + added[step]

    def _taken(
        self,
        nodes: Nodes,
        maps: ReturnedPairs,
        every: Array,
        added: Array,
        seen: Array,
        smooth: Array,
    ) -> Array:
        """What pairs that are smooth add to the gradient, and what is seen, at nodes (., K, l)."""
        weights = np.zeros((len(nodes.times), seen.shape[1], self._weighed))
        m, pairs = self._tangent.size, 2 * np.arange(len(smooth))[smooth]
        for of, end in ((maps.both, pairs + 2), (maps.first, pairs + 1)):
            behind = every[end] if of is maps.both else added[end]
            mu = np.einsum("njab,nkb->njka", of.stages[smooth], behind)
            for j in range(mu.shape[1]):
                weights[2 * pairs + j, :, :m] += mu[:, j]
        weights[::2, :, m:-1] = seen
        found = np.zeros((*weights.shape[:2], len(self._sizes)))
        some = np.flatnonzero(weights.any(axis=(1, 2)))
        if len(some):
            found[some] = self._against(nodes, some, weights[some])
        return found

    @property
    def _weighed(self) -> int:
        return self._tangent.size + len(self._tangent.outputs) + 1

    def _against(self, nodes: Nodes, some: Indices, weights: Array) -> Array:
        """See `Cotangent.against`, at some of the nodes."""
        numbers = self._track.numbers(self._base, nodes)
        numbers = numbers._replace(references=numbers.references[some])
        return self._cotangent.against(numbers, nodes.states[some], weights, self._track.rest)

    def _scale(self, every: Array, found: Array) -> None:
        """Remember how large lambda and the gradient get; see `_rough`."""
        of_lambda, of_total = self._scales
        largest = self._track.largest
        np.maximum(of_lambda, np.abs(every).max(axis=0), out=of_lambda)
        least = LEAST * (of_lambda * largest).max(axis=1, keepdims=True)
        np.maximum(of_lambda, least / largest, out=of_lambda)
        gathered = self._total + np.cumsum(found[::-1], axis=0)
        np.maximum(of_total, np.abs(gathered).max(axis=0), out=of_total)
        np.maximum(of_total, least / self._sizes, out=of_total)

    def _rough(self, nodes: Nodes, bends: Array, behind: Array) -> Array:
        """Over which pairs of steps A^T lambda or B^T lambda bend too much.

        Args:
            nodes: Of the stretch.
            bends: Those of A (n, m, m).
            behind: lambda (n, K, m) behind each.
        """
        count, several, m = behind.shape
        weights = np.zeros((count, several, self._weighed))
        weights[..., :m] = behind
        by_number = np.zeros((count, several, len(self._sizes)))
        if count:
            for j, share in enumerate(BENDING):
                by_number += share * self._against(nodes, 4 * np.arange(count) + j, weights)
        rough = np.zeros(count, dtype=bool)
        for curve, scale in zip((behind @ bends, by_number), self._scales, strict=True):
            error = np.abs(curve) * nodes.lengths[: 2 * count : 2, None, None]
            rough |= (error > self._accuracy * scale).any(axis=(1, 2))
        return rough

    def _jumped(self, jump: Jump, now: Array) -> Array:
        """Lambda before joints start or stop, from that behind; see `Track.leap`."""
        track, nodes = self._track, self._track.moment(jump.switch)
        by_state, leap = track.leap(self._tangent, self._base, jump)
        track.adopt(jump.mode)
        weights = np.zeros((1, len(now), self._weighed))
        weights[0, :, -1] = -(now @ leap)
        self._total += self._against(nodes, np.array([1]), weights)[0]
        out: Array = now + np.outer(weights[0, :, -1], by_state)
        return out
