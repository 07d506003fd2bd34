"""The postures that put a frame at given places of its section, and the best of them."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import InputError
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.dynamics.statics import StaticQuantities, StaticsEvaluator
from crane.motion.workspaces.workspace_patch import WorkspacePatch, fill_patch
from crane.ratings.grid_points import grid_points_in_patch
from crane.ratings.strokes import Strokes

_PATCH_VALUES = 33  # values of both strokes of a patch
_LEVELS_BY_COUNT = (1, 17, 7)  # values of each further stroke, by how many there are
_NEWTON_ITERATIONS = 12
_MAX_STEP_SHARE = 0.2  # of a stroke, the farthest that one iteration moves
_POSITION_TOLERANCE = 1e-11  # of the machine's size
_LIMIT_TOLERANCE = 1e-9  # of a stroke, beyond its limits
_DUPLICATE_TOLERANCE = 1e-6  # of a stroke: postures that are one
_STEP_TOLERANCE = 1e-8  # of a stroke, to which the best is sought
_MAXIMA_COUNT, _MIN_LEVEL_DISTANCE = (
    3,
    1.5,
)  # how many of the best levels are improved, and steps between two of them
_MAX_ROUNDS = 200
_NEAR = 5  # postures from which one place is sought
_FEW, _FINER = 100, 3  # places of which more levels are tried, and how often these are halved
_BETTER = 1e-6  # share by which a posture from beside has to be better

ValueFunction = Callable[[Array, StaticQuantities], Array]


@dataclass(frozen=True, eq=False, repr=False)
class ConfigurationSet(OneLineRepr):
    """Postures with the frame at places.

    Attributes:
        position_index: (M,) index of the place.
        q: (M, nq) closed postures.
        statics: What they are at rest.
    """

    position_index: NDArray[np.intp]
    q: Array
    statics: StaticQuantities

    def select(self, index: NDArray[Any]) -> "ConfigurationSet":
        """Some of them, by index or mask."""
        return ConfigurationSet(
            self.position_index[index], self.q[index], self.statics.select(index)
        )

    def and_those(self, others: "ConfigurationSet") -> "ConfigurationSet":
        """These and others."""
        at = StaticQuantities(
            *(np.concatenate(both) for both in zip(self.statics, others.statics, strict=True))
        )
        return ConfigurationSet(
            np.concatenate([self.position_index, others.position_index]),
            np.concatenate([self.q, others.q]),
            at,
        )


class ConfigurationSearch(Strokes):
    """All ways in which a machine puts a frame at places of its section, within its limits.

    Two strokes, those that move the frame most, follow from the place by Newton's method; further
    ones are free to choose: of a place, the posture of the largest value is sought over them.

    Args:
        statics: The machine and the frame.

    Attributes:
        position_strokes: The two strokes, among the active joints.
        free_strokes: Further strokes that move it.
        configurations: (N, nq) closed ones all over the strokes.
        section_positions: (N, 2) their places.

    Raises:
        InputError: Fewer than two strokes move the frame in its section, or more than four.
    """

    def __init__(self, statics: StaticsEvaluator):
        super().__init__(statics)
        machine, moving = self.machine, self.moving
        if not 2 <= len(moving) <= len(_LEVELS_BY_COUNT) + 1:
            names = ", ".join(machine.active[i] for i in moving)
            lock_hint = "fewer" if len(moving) < 2 else "some: --lock"
            raise InputError(
                f"what moves '{statics.frame}' in its section is {names or 'nothing'}, a chart "
                f"takes 2 to {len(_LEVELS_BY_COUNT) + 1} strokes: name another frame, or lock "
                f"{lock_hint}"
            )
        self.position_strokes, self.free_strokes = (moving[0], moving[1]), moving[2:]
        self._patches = list(self._fill_patches())
        if not self._patches:
            raise InputError(f"no posture of '{machine.name}' closes on the way from home")
        self.configurations = np.concatenate(
            [patch.configurations[patch.is_closed] for patch in self._patches]
        )
        self.section_positions = self.section.coordinates(
            statics.evaluate(self.configurations).tip_positions
        )

    def _fill_patches(self) -> list[WorkspacePatch]:
        """Patches over the pair, at levels of the other strokes."""
        home = self.machine.home[self.machine.closure.active]
        count = _LEVELS_BY_COUNT[len(self.free_strokes)]
        levels = [np.linspace(self.low[i], self.high[i], count) for i in self.free_strokes]
        axes = tuple(
            np.linspace(self.low[i], self.high[i], _PATCH_VALUES) for i in self.position_strokes
        )
        out = []
        for values in itertools.product(*levels):
            held_coordinates = home.copy()
            held_coordinates[self.free_strokes] = values
            patch = fill_patch(
                self.machine, held_coordinates, self.position_strokes, (axes[0], axes[1])
            )
            if patch is not None:
                out.append(patch)
        return out

    def find_all(self, axes: tuple[Array, Array]) -> ConfigurationSet:
        """Postures at all places of a grid, one and more each, by levels of the other strokes.

        Args:
            axes: Coordinates (a,), (b,) of the section; place k is (axes[0][k % a],
                axes[1][k // a]).
        """
        start_sets, position_sets = [], []
        for patch in self._patches:
            node_positions = np.full((*patch.is_closed.shape, 2), np.nan)
            tip_positions = self.statics.evaluate(
                patch.configurations[patch.is_closed]
            ).tip_positions
            node_positions[patch.is_closed] = self.section.coordinates(tip_positions)
            position_index, q = grid_points_in_patch(patch, node_positions, axes)
            position_sets.append(position_index)
            start_sets.append(q)
        count = len(axes[0]) * len(axes[1])
        if self.free_strokes and count <= _FEW:  # from the nearest known ones, too: at the border
            for k in range(count):
                statics_values = np.array([axes[0][k % len(axes[0])], axes[1][k // len(axes[0])]])
                near = np.argsort(np.linalg.norm(self.section_positions - statics_values, axis=1))[
                    :_NEAR
                ]
                position_sets.append(np.full(len(near), k))
                start_sets.append(self.configurations[near])
        position_index, q = np.concatenate(position_sets), np.concatenate(start_sets)
        targets = np.column_stack(
            [axes[0][position_index % len(axes[0])], axes[1][position_index // len(axes[0])]]
        )
        moved, rest, is_valid = self.move_to_targets(q, targets, self.position_strokes)
        configurations = ConfigurationSet(position_index, moved, rest).select(is_valid)
        if self.free_strokes:  # where the pair leaves its limits, the others may help
            lost = np.logical_not(is_valid)
            moved, rest, is_valid = self.move_to_targets(q[lost], targets[lost], self.moving)
            configurations = configurations.and_those(
                ConfigurationSet(position_index[lost], moved, rest).select(is_valid)
            )
        return configurations.select(self._unique_indices(configurations))

    def select_best(
        self, configurations: ConfigurationSet, axes: tuple[Array, Array], evaluate: ValueFunction
    ) -> tuple[ConfigurationSet, Array]:
        """Of each place the posture of the largest value.

        Among the levels first; from the best of them all strokes are moved, the frame held, by
        steps that are halved where none helps.

        Args:
            configurations: See `find_all`.
            axes: Likewise.
            evaluate: (q, at rest) -> (M,).

        Returns:
            One posture per place that has any, and its value.
        """
        values = evaluate(configurations.q, configurations.statics)
        if not self.free_strokes:
            indices = _largest_per_position(configurations.position_index, values)
            return configurations.select(indices), values[indices]
        if (
            len(np.unique(configurations.position_index)) <= _FEW
        ):  # none beside them to learn from, see below
            for k in range(_FINER):
                configurations = self._halved(configurations, axes, 0.5**k)
            values = evaluate(configurations.q, configurations.statics)
        indices = self._separated_maxima(configurations, values)
        configurations, values = configurations.select(indices), values[indices]
        targets = np.column_stack(
            [
                axes[0][configurations.position_index % len(axes[0])],
                axes[1][configurations.position_index // len(axes[0])],
            ]
        )
        configurations, values = self._improve(configurations, values, targets, evaluate)
        indices = _largest_per_position(configurations.position_index, values)
        return self._from_beside(configurations.select(indices), values[indices], axes, evaluate)

    def _from_beside(
        self,
        found: ConfigurationSet,
        values: Array,
        axes: tuple[Array, Array],
        value: ValueFunction,
    ) -> tuple[ConfigurationSet, Array]:
        """Improve places from the best postures of those beside them, until none gets better.

        Levels may miss the largest of several peaks, or a place at the border, where another one
        has it.

        Args:
            found: One posture per place.
            values: Of these.
            axes: See `find_all`.
            value: See `select_best`.
        """
        wide, upper = len(axes[0]), len(axes[1])
        fresh: NDArray[np.intp] = np.arange(len(values))
        while len(fresh):
            column, row = found.position_index[fresh] % wide, found.position_index[fresh] // wide
            source, place = [], []
            for i, j in itertools.product((-1, 0, 1), repeat=2):
                a, b = column + i, row + j
                inside = (a >= 0) & (a < wide) & (b >= 0) & (b < upper)
                source.append(fresh[inside])
                place.append(b[inside] * wide + a[inside])
            beside = np.concatenate(place)
            targets = np.column_stack([axes[0][beside % wide], axes[1][beside // wide]])
            q, at, good = self.move_to_targets(
                found.q[np.concatenate(source)], targets, self.moving
            )
            new = ConfigurationSet(beside, q, at).select(good)
            tried = value(new.q, new.statics)
            known = np.full(wide * upper, -np.inf)
            known[found.position_index] = values
            better = tried > known[new.position_index] * (1 + _BETTER)
            new, tried, targets = new.select(better), tried[better], targets[good][better]
            kept = _largest_per_position(new.position_index, tried)
            new, tried = self._improve(new.select(kept), tried[kept], targets[kept], value)
            old = np.isin(found.position_index, new.position_index, invert=True)
            found, values = found.select(old).and_those(new), np.concatenate([values[old], tried])
            fresh = np.arange(len(values) - len(tried), len(values))
        return found, values

    def _halved(
        self, found: ConfigurationSet, axes: tuple[Array, Array], step: float
    ) -> ConfigurationSet:
        """Postures half a step beside those found, too, in each of the other strokes."""
        every = [found]
        targets = np.column_stack(
            [
                axes[0][found.position_index % len(axes[0])],
                axes[1][found.position_index // len(axes[0])],
            ]
        )
        half = 0.5 * step / (_LEVELS_BY_COUNT[len(self.free_strokes)] - 1)
        for i, way in itertools.product(self.free_strokes, (-half, half)):
            q = found.q.copy()
            q[:, self.machine.closure.active[i]] += way * self.span[i]
            moved, at, good = self.move_to_targets(q, targets, self.position_strokes)
            every.append(ConfigurationSet(found.position_index, moved, at).select(good))
        found = every[0]
        for one in every[1:]:
            found = found.and_those(one)
        return found.select(self._unique_indices(found))

    def _separated_maxima(
        self, configurations: ConfigurationSet, values: Array
    ) -> NDArray[np.intp]:
        """Indices of the largest values of each place that are not beside each other."""
        columns = self.machine.closure.active[self.free_strokes]
        level_steps = self.span[self.free_strokes] / (_LEVELS_BY_COUNT[len(self.free_strokes)] - 1)
        levels = configurations.q[:, columns] / level_steps
        remaining: NDArray[np.intp] = np.arange(len(values))
        out: list[NDArray[np.intp]] = []
        while len(remaining) and len(out) < _MAXIMA_COUNT:
            largest = remaining[
                _largest_per_position(configurations.position_index[remaining], values[remaining])
            ]
            out.append(largest)
            largest_by_position = np.zeros(configurations.position_index.max() + 1, dtype=np.intp)
            largest_by_position[configurations.position_index[largest]] = largest
            level_distances = (
                levels[remaining]
                - levels[largest_by_position[configurations.position_index[remaining]]]
            )
            remaining = remaining[np.abs(level_distances).max(axis=1) > _MIN_LEVEL_DISTANCE]
        return np.concatenate(out)

    def _improve(
        self,
        configurations: ConfigurationSet,
        values: Array,
        targets: Array,
        evaluate: ValueFunction,
    ) -> tuple[ConfigurationSet, Array]:
        """Move all strokes to larger values along the null space of the frame's motion."""
        strokes = self.moving
        columns, stroke_lengths = self.machine.closure.active[strokes], self.span[strokes]
        count = len(self.free_strokes)
        step = np.full(len(values), 1.0 / (_LEVELS_BY_COUNT[count] - 1))
        q, values, random = configurations.q.copy(), values.copy(), np.random.default_rng(0)
        statics_values = StaticQuantities(*(x.copy() for x in configurations.statics))
        for _ in range(_MAX_ROUNDS):
            active = np.flatnonzero(step > _STEP_TOLERANCE)
            if not len(active):
                break
            scaled_jacobian = (
                self.section.section_jacobian(
                    statics_values.tip_positions[active], statics_values.tip_jacobian[active]
                )[:, :, strokes]
                * stroke_lengths
            )
            null_space = np.linalg.svd(scaled_jacobian)[2][:, 2:]
            search_directions = (
                np.eye(1) if count == 1 else np.linalg.qr(random.normal(size=(count, count)))[0]
            )
            initial, is_improved = q[active].copy(), np.zeros(len(active), dtype=bool)
            for direction in (*search_directions, *-search_directions):
                start = initial.copy()
                start[:, columns] += step[active, None] * (direction @ null_space) * stroke_lengths
                moved_configurations, moved_statics, is_valid = self.move_to_targets(
                    start, targets[active], strokes
                )
                trial_values = np.full(len(active), -np.inf)
                trial_values[is_valid] = evaluate(
                    moved_configurations[is_valid], moved_statics.select(is_valid)
                )
                is_larger = trial_values > values[active]
                k, is_improved = active[is_larger], is_improved | is_larger
                q[k], values[k] = moved_configurations[is_larger], trial_values[is_larger]
                for stored, updated in zip(statics_values, moved_statics, strict=True):
                    stored[k] = updated[is_larger]
            step[active[np.logical_not(is_improved)]] *= 0.5
        return ConfigurationSet(configurations.position_index, q, statics_values), values

    def move_to_targets(
        self, q: Array, targets: Array, strokes: Sequence[int]
    ) -> tuple[Array, StaticQuantities, NDArray[np.bool_]]:
        """Put the frame at targets (M, 2) by some strokes, from postures (M, nq) nearby.

        Newton's method by the shortest steps; where there are more than two, those that would
        leave their limits stay there.

        Returns:
            Postures, what they are at rest, and whether each is there and within its limits.
        """
        closure, strokes = self.machine.closure, list(strokes)
        columns, stroke_lengths = closure.active[strokes], self.span[strokes]
        q, is_valid = self.statics.close_loops(q)
        statics_values = self.statics.evaluate(q)
        tolerance = _POSITION_TOLERANCE * closure.characteristic_length
        position_error = targets - self.section.coordinates(statics_values.tip_positions)
        active = np.flatnonzero(is_valid & (np.abs(position_error).max(axis=1) > tolerance))
        for _ in range(_NEWTON_ITERATIONS):
            if not len(active):
                break
            scaled_jacobian = (
                self.section.section_jacobian(
                    statics_values.tip_positions[active], statics_values.tip_jacobian[active]
                )[:, :, strokes]
                * stroke_lengths
            )
            if len(strokes) == 2:
                step = _minimum_norm_solution(scaled_jacobian, position_error[active])
            else:
                q_a = q[active][:, columns]
                lower, high = ((x[strokes] - q_a) / stroke_lengths for x in (self.low, self.high))
                step = _shortest_inside(scaled_jacobian, position_error[active], lower, high)
            step /= np.maximum(1.0, np.abs(step).max(axis=1) / _MAX_STEP_SHARE)[:, None]
            start = q[active]
            start[:, columns] += step * stroke_lengths
            q[active], is_closed = self.statics.close_loops(start)
            is_valid[active] = is_closed
            for stored, updated in zip(
                statics_values, self.statics.evaluate(q[active]), strict=True
            ):
                stored[active] = updated
            position_error[active] = targets[active] - self.section.coordinates(
                statics_values.tip_positions[active]
            )
            active = active[is_closed & (np.abs(position_error[active]).max(axis=1) > tolerance)]
        is_valid[active] = False
        q_a = q[:, closure.active]
        limit_tolerance = _LIMIT_TOLERANCE * self.span
        is_within_limits = np.all(
            (q_a >= self.low - limit_tolerance) & (q_a <= self.high + limit_tolerance), axis=1
        )
        return q, statics_values, is_valid & is_within_limits

    def _unique_indices(self, configurations: ConfigurationSet) -> NDArray[np.intp]:
        """Of postures that are the same at one place, one each."""
        q_a = configurations.q[:, self.machine.closure.active] / (_DUPLICATE_TOLERANCE * self.span)
        keys = np.column_stack([configurations.position_index, np.round(q_a[:, self.moving])])
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
        x = held + _minimum_norm_solution(matrix * free[:, None], left)
        leaves = free & ((x < low) | (x > high))
        if not leaves.any():
            break
        x = np.clip(x, low, high)
        free &= np.logical_not(leaves)
    return x


def _minimum_norm_solution(matrix: Array, right_side: Array) -> Array:
    """The shortest x (M, k) with matrix (M, 2, k) x = right (M, 2); 0 where there is none."""
    gram_matrix = matrix @ np.swapaxes(matrix, 1, 2)
    a, b, c = gram_matrix[:, 0, 0], gram_matrix[:, 0, 1], gram_matrix[:, 1, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        multipliers = np.column_stack(
            [
                c * right_side[:, 0] - b * right_side[:, 1],
                a * right_side[:, 1] - b * right_side[:, 0],
            ]
        )
        multipliers /= (a * c - b * b)[:, None]
    multipliers = np.nan_to_num(multipliers, nan=0.0, posinf=0.0, neginf=0.0)
    return np.asarray(np.einsum("mik,mi->mk", matrix, multipliers))


def _largest_per_position(position_index: NDArray[np.intp], values: Array) -> NDArray[np.intp]:
    """Index of the largest value of each place, by place."""
    order = np.lexsort((-values, position_index))
    return np.asarray(order[np.unique(position_index[order], return_index=True)[1]])
