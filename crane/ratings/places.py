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
_NEAR = 5  # postures from which one place is sought
_FEW, _FINER = 100, 3  # places of which more levels are tried, and how often these are halved
_BETTER = 1e-6  # share by which a posture from beside has to be better

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

    def and_those(self, others: "Found") -> "Found":
        """These and others."""
        at = AtRest(*(np.concatenate(both) for both in zip(self.at, others.at, strict=True)))
        return Found(
            np.concatenate([self.place, others.place]), np.concatenate([self.q, others.q]), at
        )


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
        count = len(axes[0]) * len(axes[1])
        if self.others and count <= _FEW:  # from the nearest known ones, too: at the border
            for k in range(count):
                at = np.array([axes[0][k % len(axes[0])], axes[1][k // len(axes[0])]])
                near = np.argsort(np.linalg.norm(self.reach - at, axis=1))[:_NEAR]
                places.append(np.full(len(near), k))
                starts.append(self.postures[near])
        place, q = np.concatenate(places), np.concatenate(starts)
        targets = np.column_stack([axes[0][place % len(axes[0])], axes[1][place // len(axes[0])]])
        moved, rest, good = self.moved(q, targets, self.pair)
        found = Found(place, moved, rest).some(good)
        if self.others:  # where the pair leaves its limits, the others may help
            lost = np.logical_not(good)
            moved, rest, good = self.moved(q[lost], targets[lost], self.moving)
            found = found.and_those(Found(place[lost], moved, rest).some(good))
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
        if len(np.unique(found.place)) <= _FEW:  # none beside them to learn from, see below
            for k in range(_FINER):
                found = self._halved(found, axes, 0.5**k)
            values = value(found.q, found.at)
        kept = self._peaks(found, values)
        found, values = found.some(kept), values[kept]
        targets = np.column_stack(
            [axes[0][found.place % len(axes[0])], axes[1][found.place // len(axes[0])]]
        )
        found, values = self._improved(found, values, targets, value)
        kept = _first(found.place, values)
        return self._from_beside(found.some(kept), values[kept], axes, value)

    def _from_beside(
        self, found: Found, values: Array, axes: tuple[Array, Array], value: Value
    ) -> tuple[Found, Array]:
        """Improve places from the best postures of those beside them, until none gets better.

        Levels may miss the largest of several peaks, or a place at the border, where another one
        has it.

        Args:
            found: One posture per place.
            values: Of these.
            axes: See `all`.
            value: See `best`.
        """
        wide, high = len(axes[0]), len(axes[1])
        fresh: NDArray[np.intp] = np.arange(len(values))
        while len(fresh):
            column, row = found.place[fresh] % wide, found.place[fresh] // wide
            source, place = [], []
            for i, j in itertools.product((-1, 0, 1), repeat=2):
                a, b = column + i, row + j
                inside = (a >= 0) & (a < wide) & (b >= 0) & (b < high)
                source.append(fresh[inside])
                place.append(b[inside] * wide + a[inside])
            beside = np.concatenate(place)
            targets = np.column_stack([axes[0][beside % wide], axes[1][beside // wide]])
            q, at, good = self.moved(found.q[np.concatenate(source)], targets, self.moving)
            new = Found(beside, q, at).some(good)
            tried = value(new.q, new.at)
            known = np.full(wide * high, -np.inf)
            known[found.place] = values
            better = tried > known[new.place] * (1 + _BETTER)
            new, tried, targets = new.some(better), tried[better], targets[good][better]
            kept = _first(new.place, tried)
            new, tried = self._improved(new.some(kept), tried[kept], targets[kept], value)
            old = np.isin(found.place, new.place, invert=True)
            found, values = found.some(old).and_those(new), np.concatenate([values[old], tried])
            fresh = np.arange(len(values) - len(tried), len(values))
        return found, values

    def _halved(self, found: Found, axes: tuple[Array, Array], step: float) -> Found:
        """Postures half a step beside those found, too, in each of the other strokes."""
        every = [found]
        targets = np.column_stack(
            [axes[0][found.place % len(axes[0])], axes[1][found.place // len(axes[0])]]
        )
        half = 0.5 * step / (_LEVELS[len(self.others)] - 1)
        for i, way in itertools.product(self.others, (-half, half)):
            q = found.q.copy()
            q[:, self.machine.closure.active[i]] += way * self.span[i]
            moved, at, good = self.moved(q, targets, self.pair)
            every.append(Found(found.place, moved, at).some(good))
        found = every[0]
        for one in every[1:]:
            found = found.and_those(one)
        return found.some(self._different(found))

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

        Newton's method by the shortest steps; where there are more than two, those that would
        leave their limits stay there.

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
            if len(strokes) == 2:
                step = _shortest(slopes, miss[here])
            else:
                q_a = q[here][:, columns]
                low, high = ((x[strokes] - q_a) / span for x in (self.low, self.high))
                step = _shortest_inside(slopes, miss[here], low, high)
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


def _shortest_inside(matrix: Array, right: Array, low: Array, high: Array) -> Array:
    """The shortest x (M, k) with matrix (M, 2, k) x = right (M, 2) and low <= x <= high (M, k).

    As near as it is found by holding what leaves its limits there, one round after the other.
    """
    x = np.zeros(low.shape)
    free = np.ones(low.shape, dtype=bool)
    for _ in range(low.shape[1] - 1):
        held = np.where(free, 0.0, x)
        left = right - np.einsum("mik,mk->mi", matrix, held)
        x = held + _shortest(matrix * free[:, None], left)
        leaves = free & ((x < low) | (x > high))
        if not leaves.any():
            break
        x = np.clip(x, low, high)
        free &= np.logical_not(leaves)
    return x


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
