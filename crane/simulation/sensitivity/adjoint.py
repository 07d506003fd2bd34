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
from crane.simulation.sensitivity.variational import bending, bent, returns, staged


class Gatherer:
    """The way back along a motion, stretch by stretch.

    Steps are taken in parts over which A^T lambda or B^T lambda bend too much for the method, as
    `follow` does where A S + B do: the rule for lambda and the gradient is that for S.

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
        back, stages = returns(staged(by_state), lengths, self._track.largest)
        added = seen @ looks[::2, :k]
        every = _returned(back, added, now)
        found = self._taken(nodes, stages, every, seen)
        self._scale(every, found)
        rough = self._rough(nodes, by_state, every) if depth else []
        for i in reversed(rough):
            finer = self._track.within(nodes, i)
            begin = self._gathered(finer, every[i + 1], None, depth - 1)
            every[: i + 1] = _returned(back[:i], added[: i + 1], begin)
            stages[i] = 0.0
        if rough:
            found = self._taken(nodes, stages, every, seen)
        self._total += found.sum(axis=0)
        return every[0]

    def _taken(self, nodes: Nodes, stages: Array, every: Array, seen: Array) -> Array:
        """What is added to the gradient at nodes (2 n + 1, K, l)."""
        weights = np.zeros((len(nodes.times), seen.shape[1], self._weighed))
        m = self._tangent.size
        mu = np.einsum("njab,nkb->njka", stages, every[1:])
        for j in range(3):
            weights[j : len(weights) - 2 + j : 2, :, :m] += mu[:, j]
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

    def _rough(self, nodes: Nodes, by_state: Array, every: Array) -> list[int]:
        """Steps over which A^T lambda or B^T lambda bend too much, lambda that behind each."""
        lengths, several = nodes.lengths, every.shape[1]
        if len(lengths) < 2:
            return list(range(len(lengths)))
        behind = every[1:]
        weights = np.zeros((len(lengths), several, self._weighed))
        weights[..., : self._tangent.size] = behind
        by_number = np.zeros((len(lengths), several, len(self._sizes)))
        for some, share in bending(len(lengths)):
            by_number += share * self._against(nodes, some, weights)
        curves = behind @ bent(by_state), by_number
        rough = np.zeros(len(lengths), dtype=bool)
        for curve, scale in zip(curves, self._scales, strict=True):
            error = np.abs(curve) * lengths[:, None, None]
            rough |= (error > self._accuracy * scale).any(axis=(1, 2))
        return np.flatnonzero(rough).tolist()

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


def _returned(back: Array, added: Array, now: Array) -> Array:
    """Lambda (n + 1, K, m) along n steps, from that where they end."""
    every = [now + added[-1]]
    for one, more in zip(back[::-1], added[-2::-1], strict=True):
        every.append(every[-1] @ one.T + more)
    return np.array(every[::-1])
