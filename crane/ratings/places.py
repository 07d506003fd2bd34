"""The postures that put a frame at given places of its section, and the best of them."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.common.shown import Brief
from crane.dynamics.statics import AtRest, Statics
from crane.motion.workspaces.patch import Patch, fill
from crane.ratings.grids import within
from crane.ratings.strokes import Strokes

_NODES = 33  # values of both strokes of a patch
_LEVELS = (1, 17, 7)  # values of each further stroke, by how many there are
_ITERATIONS = 12
_STRIDE = 0.2  # of a stroke, the farthest that one iteration moves
_MISS = 1e-11  # of the machine's size
_SLACK = 1e-9  # of a stroke, beyond its limits
_SAME = 1e-6  # of a stroke: postures that are one
_FINE = 1e-8  # of a stroke, to which the best is sought
_PEAKS, _APART = 3, 1.5  # how many of the best levels are improved, and steps between two of them
_ROUNDS = 200

Value = Callable[[Array, AtRest], Array]


@dataclass(frozen=True, eq=False, repr=False)
class Found(Brief):
    """Postures with the frame at places.

    Attributes:
        place: (M,) index of the place.
        q: (M, nq) closed postures.
        at: What they are at rest.
    """

    place: NDArray[np.intp]
    q: Array
    at: AtRest

    def some(self, which: NDArray[Any]) -> "Found":
        """Some of them, by index or mask."""
        return Found(self.place[which], self.q[which], self.at.some(which))


class Places(Strokes):
    """All ways in which a machine puts a frame at places of its section, within its limits.

    Two strokes, those that move the frame most, follow from the place by Newton's method; further
    ones are free to choose: of a place, the posture of the largest value is sought over them.

    Args:
        statics: The machine and the frame.

    Attributes:
        pair: The two strokes, among the active joints.
        others: Further strokes that move it.
        postures: (N, nq) closed ones all over the strokes.
        reach: (N, 2) their places.

    Raises:
        InputError: Fewer than two strokes move the frame in its section, or more than four.
    """

    def __init__(self, statics: Statics):
        super().__init__(statics)
        machine, moving = self.machine, self.moving
        if not 2 <= len(moving) <= len(_LEVELS) + 1:
            names = ", ".join(machine.active[i] for i in moving)
            less = "fewer" if len(moving) < 2 else "some: --lock"
            raise InputError(
                f"what moves '{statics.frame}' in its section is {names or 'nothing'}, a chart "
                f"takes 2 to {len(_LEVELS) + 1} strokes: name another frame, or lock {less}"
            )
        self.pair, self.others = (moving[0], moving[1]), moving[2:]
        self._patches = list(self._filled())
        if not self._patches:
            raise InputError(f"no posture of '{machine.name}' closes on the way from home")
        self.postures = np.concatenate([patch.q[patch.closed] for patch in self._patches])
        self.reach = self.section.coordinates(statics.at(self.postures).tip)

    def _filled(self) -> list[Patch]:
        """Patches over the pair, at levels of the other strokes."""
        home = self.machine.home[self.machine.closure.active]
        count = _LEVELS[len(self.others)]
        levels = [np.linspace(self.low[i], self.high[i], count) for i in self.others]
        axes = tuple(np.linspace(self.low[i], self.high[i], _NODES) for i in self.pair)
        out = []
        for values in itertools.product(*levels):
            base = home.copy()
            base[self.others] = values
            patch = fill(self.machine, base, self.pair, (axes[0], axes[1]))
            if patch is not None:
                out.append(patch)
        return out

    def all(self, axes: tuple[Array, Array]) -> Found:
        """Postures at all places of a grid, one and more each, by levels of the other strokes.

        Args:
            axes: Coordinates (a,), (b,) of the section; place k is (axes[0][k % a],
                axes[1][k // a]).
        """
        starts, places = [], []
        for patch in self._patches:
            nodes = np.full((*patch.closed.shape, 2), np.nan)
            tips = self.statics.at(patch.q[patch.closed]).tip
            nodes[patch.closed] = self.section.coordinates(tips)
            place, q = within(patch, nodes, axes)
            places.append(place)
            starts.append(q)
        place, q = np.concatenate(places), np.concatenate(starts)
        targets = np.column_stack([axes[0][place % len(axes[0])], axes[1][place // len(axes[0])]])
        q, at, good = self.moved(q, targets, self.pair)
        found = Found(place, q, at).some(good)
        return found.some(self._different(found))

    def best(self, found: Found, axes: tuple[Array, Array], value: Value) -> tuple[Found, Array]:
        """Of each place the posture of the largest value.

        Among the levels first; from the best of them all strokes are moved, the frame held, by
        steps that are halved where none helps.

        Args:
            found: See `all`.
            axes: Likewise.
            value: (q, at rest) -> (M,).

        Returns:
            One posture per place that has any, and its value.
        """
        values = value(found.q, found.at)
        if not self.others:
            kept = _first(found.place, values)
            return found.some(kept), values[kept]
        kept = self._peaks(found, values)
        found, values = found.some(kept), values[kept]
        targets = np.column_stack(
            [axes[0][found.place % len(axes[0])], axes[1][found.place // len(axes[0])]]
        )
        found, values = self._improved(found, values, targets, value)
        kept = _first(found.place, values)
        return found.some(kept), values[kept]

    def _peaks(self, found: Found, values: Array) -> NDArray[np.intp]:
        """Indices of the largest values of each place that are not beside each other."""
        columns = self.machine.closure.active[self.others]
        step = self.span[self.others] / (_LEVELS[len(self.others)] - 1)
        levels = found.q[:, columns] / step
        left: NDArray[np.intp] = np.arange(len(values))
        out: list[NDArray[np.intp]] = []
        while len(left) and len(out) < _PEAKS:
            first = left[_first(found.place[left], values[left])]
            out.append(first)
            taken = np.zeros(found.place.max() + 1, dtype=np.intp)
            taken[found.place[first]] = first
            beside = levels[left] - levels[taken[found.place[left]]]
            left = left[np.abs(beside).max(axis=1) > _APART]
        return np.concatenate(out)

    def _improved(
        self, found: Found, values: Array, targets: Array, value: Value
    ) -> tuple[Found, Array]:
        """Move all strokes to larger values along the null space of the frame's motion."""
        strokes = self.moving
        columns, span = self.machine.closure.active[strokes], self.span[strokes]
        count = len(self.others)
        step = np.full(len(values), 1.0 / (_LEVELS[count] - 1))
        q, values, random = found.q.copy(), values.copy(), np.random.default_rng(0)
        at = AtRest(*(x.copy() for x in found.at))
        for _ in range(_ROUNDS):
            here = np.flatnonzero(step > _FINE)
            if not len(here):
                break
            slopes = self.section.slopes(at.tip[here], at.ways[here])[:, :, strokes] * span
            free = np.linalg.svd(slopes)[2][:, 2:]
            turned = (
                np.eye(1) if count == 1 else np.linalg.qr(random.normal(size=(count, count)))[0]
            )
            begun, better = q[here].copy(), np.zeros(len(here), dtype=bool)
            for way in (*turned, *-turned):
                start = begun.copy()
                start[:, columns] += step[here, None] * (way @ free) * span
                new, there, good = self.moved(start, targets[here], strokes)
                tried = np.full(len(here), -np.inf)
                tried[good] = value(new[good], there.some(good))
                up = tried > values[here]
                k, better = here[up], better | up
                q[k], values[k] = new[up], tried[up]
                for old, young in zip(at, there, strict=True):
                    old[k] = young[up]
            step[here[np.logical_not(better)]] *= 0.5
        return Found(found.place, q, at), values

    def moved(
        self, q: Array, targets: Array, strokes: Sequence[int]
    ) -> tuple[Array, AtRest, NDArray[np.bool_]]:
        """Put the frame at targets (M, 2) by some strokes, from postures (M, nq) nearby.

        Newton's method by the shortest steps.

        Returns:
            Postures, what they are at rest, and whether each is there and within its limits.
        """
        closure, strokes = self.machine.closure, list(strokes)
        columns, span = closure.active[strokes], self.span[strokes]
        q, good = self.statics.closed(q)
        at = self.statics.at(q)
        near = _MISS * closure.size
        miss = targets - self.section.coordinates(at.tip)
        here = np.flatnonzero(good & (np.abs(miss).max(axis=1) > near))
        for _ in range(_ITERATIONS):
            if not len(here):
                break
            slopes = self.section.slopes(at.tip[here], at.ways[here])[:, :, strokes] * span
            step = _shortest(slopes, miss[here])
            step /= np.maximum(1.0, np.abs(step).max(axis=1) / _STRIDE)[:, None]
            start = q[here]
            start[:, columns] += step * span
            q[here], closes = self.statics.closed(start)
            good[here] = closes
            for old, new in zip(at, self.statics.at(q[here]), strict=True):
                old[here] = new
            miss[here] = targets[here] - self.section.coordinates(at.tip[here])
            here = here[closes & (np.abs(miss[here]).max(axis=1) > near)]
        good[here] = False
        q_a = q[:, closure.active]
        slack = _SLACK * self.span
        inside = np.all((q_a >= self.low - slack) & (q_a <= self.high + slack), axis=1)
        return q, at, good & inside

    def _different(self, found: Found) -> NDArray[np.intp]:
        """Of postures that are the same at one place, one each."""
        q_a = found.q[:, self.machine.closure.active] / (_SAME * self.span)
        keys = np.column_stack([found.place, np.round(q_a[:, self.moving])])
        return np.asarray(np.sort(np.unique(keys, axis=0, return_index=True)[1]))


def _shortest(matrix: Array, right: Array) -> Array:
    """The shortest x (M, k) with matrix (M, 2, k) x = right (M, 2); 0 where there is none."""
    square = matrix @ np.swapaxes(matrix, 1, 2)
    a, b, c = square[:, 0, 0], square[:, 0, 1], square[:, 1, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        both = np.column_stack(
            [c * right[:, 0] - b * right[:, 1], a * right[:, 1] - b * right[:, 0]]
        )
        both /= (a * c - b * b)[:, None]
    both = np.nan_to_num(both, nan=0.0, posinf=0.0, neginf=0.0)
    return np.asarray(np.einsum("mik,mi->mk", matrix, both))


def _first(place: NDArray[np.intp], values: Array) -> NDArray[np.intp]:
    """Index of the largest value of each place, by place."""
    order = np.lexsort((-values, place))
    return np.asarray(order[np.unique(place[order], return_index=True)[1]])
