"""Search for configurations that put a frame at positions of its section."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import InputError
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.dynamics.statics import StaticQuantities
from crane.machine.machine import Machine
from crane.motion.workspaces.workspace_patch import WorkspacePatch, fill_patch
from crane.ratings.grid_points import grid_points_in_patch
from crane.ratings.strokes import Strokes

_PATCH_VALUES = 33  # values of each of the two strokes of a patch
_LEVELS_BY_COUNT = (1, 17, 7)  # values of each further stroke, by how many there are
_NEWTON_ITERATIONS = 12
_MAX_STEP_SHARE = 0.2  # largest step of an iteration, as a share of the stroke
_POSITION_TOLERANCE = 1e-11  # share of the characteristic length
_LIMIT_TOLERANCE = 1e-9  # share of a stroke, beyond its limits
_DUPLICATE_TOLERANCE = 1e-6  # share of a stroke between equal configurations
_STEP_TOLERANCE = 1e-8  # share of a stroke at which the search ends
_MAXIMA_COUNT = 3  # best levels that are improved
_MIN_LEVEL_DISTANCE = 1.5  # steps between two of these levels
_MAX_ROUNDS = 200
_NEAREST_COUNT = 5  # known configurations from which one position is searched
_MAX_FEW_POSITIONS = 100  # number of positions up to which levels are refined
_REFINEMENTS = 3  # of the levels, each halves their distance
_MIN_RELATIVE_IMPROVEMENT = 1e-6  # of a configuration from a neighbouring position

ValueFunction = Callable[[Array, StaticQuantities], Array]


@dataclass(frozen=True, eq=False, repr=False)
class ConfigurationSet(OneLineRepr):
    """Configurations with the frame at positions.

    Attributes:
        position_index: (M,) index of the position.
        q: (M, nq) closed configurations.
        statics: Statics at these configurations.
    """

    position_index: NDArray[np.intp]
    q: Array
    statics: StaticQuantities

    def select(self, index: NDArray[Any]) -> "ConfigurationSet":
        """Return some of the configurations, by index or mask."""
        return ConfigurationSet(
            self.position_index[index], self.q[index], self.statics.select(index)
        )

    @classmethod
    def concatenate(cls, sets: Sequence["ConfigurationSet"]) -> "ConfigurationSet":
        """Return the configurations of several sets, in order."""
        statics = zip(*(x.statics for x in sets), strict=True)
        return cls(
            np.concatenate([x.position_index for x in sets]),
            np.concatenate([x.q for x in sets]),
            StaticQuantities(*(np.concatenate(parts) for parts in statics)),
        )


class ConfigurationSearch(Strokes):
    """Search for configurations that put a frame at positions of its section, within limits.

    The two strokes that move the frame most follow from the position by Newton's method. Further
    strokes are free: at each position the configuration of the largest value is searched over
    them.

    Args:
        machine: The machine.
        frame: A link; the tip by default.

    Attributes:
        position_strokes: Indices of the two strokes among the active joints.
        free_strokes: Indices of further strokes that move the frame.
        configurations: (N, nq) closed configurations over the ranges of all strokes.
        section_positions: (N, 2) positions of the frame in these configurations [m].

    Raises:
        InputError: Fewer than two strokes move the frame in its section, or more than four.
    """

    def __init__(self, machine: Machine, frame: str | None = None):
        super().__init__(machine, frame)
        moving, statics = self.moving, self.statics
        if not 2 <= len(moving) <= len(_LEVELS_BY_COUNT) + 1:
            names = ", ".join(machine.active[i] for i in moving)
            lock_hint = "fewer" if len(moving) < 2 else "some: --lock"
            raise InputError(
                f"what moves '{statics.frame}' in its section is {names or 'nothing'}, a chart "
                f"takes 2 to {len(_LEVELS_BY_COUNT) + 1} strokes: name another frame, or lock "
                f"{lock_hint}"
            )
        self.position_strokes, self.free_strokes = (moving[0], moving[1]), moving[2:]
        home = machine.home[machine.closure.active]
        count = _LEVELS_BY_COUNT[len(self.free_strokes)]
        levels = [np.linspace(self.low[i], self.high[i], count) for i in self.free_strokes]
        axes = tuple(
            np.linspace(self.low[i], self.high[i], _PATCH_VALUES) for i in self.position_strokes
        )
        self._patches: list[WorkspacePatch] = []  # at levels of the free strokes
        for values in itertools.product(*levels):
            held_coordinates = home.copy()
            held_coordinates[self.free_strokes] = values
            patch = fill_patch(
                machine, held_coordinates, self.position_strokes, (axes[0], axes[1])
            )
            if patch is not None:
                self._patches.append(patch)
        if not self._patches:
            raise InputError(f"no configuration of '{machine.name}' closes on the way from home")
        self.configurations = np.concatenate(
            [patch.configurations[patch.is_closed] for patch in self._patches]
        )
        self.section_positions = self.section.coordinates(
            statics.evaluate(self.configurations).tip_positions
        )

    def find_all(self, axes: tuple[Array, Array]) -> ConfigurationSet:
        """Find configurations at all positions of a grid, at levels of the free strokes.

        Args:
            axes: Coordinates (a,), (b,) of the section [m]; position k is (axes[0][k % a],
                axes[1][k // a]).

        Returns:
            No, one or several configurations per position.
        """
        start_sets, position_sets = [], []
        for patch in self._patches:
            node_positions = np.full((*patch.is_closed.shape, 2), np.nan)
            node_positions[patch.is_closed] = self.section.coordinates(
                self.statics.evaluate(patch.configurations[patch.is_closed]).tip_positions
            )
            position_index, q = grid_points_in_patch(patch, node_positions, axes)
            position_sets.append(position_index)
            start_sets.append(q)
        count = len(axes[0]) * len(axes[1])
        if self.free_strokes and count <= _MAX_FEW_POSITIONS:  # grids miss the border of the reach
            for k, target in enumerate(_grid_positions(axes, np.arange(count))):
                distances = np.linalg.norm(self.section_positions - target, axis=1)
                nearest = np.argsort(distances)[:_NEAREST_COUNT]
                position_sets.append(np.full(len(nearest), k))
                start_sets.append(self.configurations[nearest])
        position_index, q = np.concatenate(position_sets), np.concatenate(start_sets)
        targets = _grid_positions(axes, position_index)
        moved, rest, is_valid = self.move_to_targets(q, targets, self.position_strokes)
        configurations = ConfigurationSet(position_index, moved, rest).select(is_valid)
        if self.free_strokes:  # if the two strokes leave their limits, the others may help
            lost = np.logical_not(is_valid)
            moved, rest, is_valid = self.move_to_targets(q[lost], targets[lost], self.moving)
            further = ConfigurationSet(position_index[lost], moved, rest).select(is_valid)
            configurations = ConfigurationSet.concatenate([configurations, further])
        return configurations.select(self._unique_indices(configurations))

    def select_best(
        self, configurations: ConfigurationSet, axes: tuple[Array, Array], evaluate: ValueFunction
    ) -> tuple[ConfigurationSet, Array]:
        """Find the configuration of the largest value at each position.

        The best levels of the free strokes are improved by moving all strokes, with the frame
        held, in steps that are halved if no direction gives a larger value.

        Args:
            configurations: Result of `find_all`.
            axes: See `find_all`.
            evaluate: Function of q (M, nq) and its statics that returns values (M,).

        Returns:
            One configuration per position that has any, and its value.
        """
        values = evaluate(configurations.q, configurations.statics)
        if not self.free_strokes:
            indices = _largest_per_position(configurations.position_index, values)
            return configurations.select(indices), values[indices]
        if len(np.unique(configurations.position_index)) <= _MAX_FEW_POSITIONS:
            # few positions have no neighbours that would improve them
            for k in range(_REFINEMENTS):
                configurations = self._refine_levels(configurations, axes, 0.5**k)
            values = evaluate(configurations.q, configurations.statics)
        indices = self._separated_maxima(configurations, values)
        configurations, values = configurations.select(indices), values[indices]
        configurations, values = self._improve(
            configurations, values, _grid_positions(axes, configurations.position_index), evaluate
        )
        indices = _largest_per_position(configurations.position_index, values)
        return self._improve_from_neighbours(
            configurations.select(indices), values[indices], axes, evaluate
        )

    def _improve_from_neighbours(
        self,
        configurations: ConfigurationSet,
        values: Array,
        axes: tuple[Array, Array],
        evaluate: ValueFunction,
    ) -> tuple[ConfigurationSet, Array]:
        """Improve each position from the best configurations of its neighbours, until none helps.

        Levels may miss the largest of several peaks, or a position at the border of the reach,
        which a neighbour has found.

        Args:
            configurations: One configuration per position.
            values: Their values.
            axes: See `find_all`.
            evaluate: See `select_best`.
        """
        shape = np.array([len(axes[0]), len(axes[1])])
        offsets = np.array(list(itertools.product((-1, 0, 1), repeat=2)))
        improved: NDArray[np.intp] = np.arange(len(values))
        while len(improved):
            index = configurations.position_index[improved]
            neighbours = np.column_stack([index % shape[0], index // shape[0]]) + offsets[:, None]
            offset, source = np.nonzero(((neighbours >= 0) & (neighbours < shape)).all(axis=2))
            first, second = neighbours[offset, source].T
            position = second * shape[0] + first
            targets = _grid_positions(axes, position)
            q, statics, is_valid = self.move_to_targets(
                configurations.q[improved[source]], targets, self.moving
            )
            new = ConfigurationSet(position, q, statics).select(is_valid)
            new_values = evaluate(new.q, new.statics)
            known = np.full(int(shape.prod()), -np.inf)
            known[configurations.position_index] = values
            is_better = new_values > known[new.position_index] * (1 + _MIN_RELATIVE_IMPROVEMENT)
            new, new_values, targets = (
                new.select(is_better), new_values[is_better], targets[is_valid][is_better],
            )  # fmt: skip
            best = _largest_per_position(new.position_index, new_values)
            new, new_values = self._improve(
                new.select(best), new_values[best], targets[best], evaluate
            )
            is_kept = np.isin(configurations.position_index, new.position_index, invert=True)
            configurations = ConfigurationSet.concatenate([configurations.select(is_kept), new])
            values = np.concatenate([values[is_kept], new_values])
            improved = np.arange(len(values) - len(new_values), len(values))
        return configurations, values

    def _refine_levels(
        self, configurations: ConfigurationSet, axes: tuple[Array, Array], step: float
    ) -> ConfigurationSet:
        """Add configurations half a step away from each in each free stroke."""
        sets = [configurations]
        targets = _grid_positions(axes, configurations.position_index)
        half_step = 0.5 * step / (_LEVELS_BY_COUNT[len(self.free_strokes)] - 1)
        for i, change in itertools.product(self.free_strokes, (-half_step, half_step)):
            q = configurations.q.copy()
            q[:, self.machine.closure.active[i]] += change * self.span[i]
            moved, statics, is_valid = self.move_to_targets(q, targets, self.position_strokes)
            sets.append(
                ConfigurationSet(configurations.position_index, moved, statics).select(is_valid)
            )
        refined = ConfigurationSet.concatenate(sets)
        return refined.select(self._unique_indices(refined))

    def _separated_maxima(
        self, configurations: ConfigurationSet, values: Array
    ) -> NDArray[np.intp]:
        """Return indices of the largest values at each position, at levels that are apart."""
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
        """Move all strokes to larger values, along the null space of the frame's Jacobian."""
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
        """Put the frame at targets (M, 2) by some strokes, from nearby configurations (M, nq).

        Newton's method with minimum-norm steps. With more than two strokes, those that would
        leave their limits stay at them.

        Returns:
            Configurations, their statics, and whether each reaches its target within its limits.
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
                step = _bounded_solution(scaled_jacobian, position_error[active], lower, high)
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
        q_a = configurations.q[:, self.machine.closure.active] / (_DUPLICATE_TOLERANCE * self.span)
        keys = np.column_stack([configurations.position_index, np.round(q_a[:, self.moving])])
        return np.asarray(np.sort(np.unique(keys, axis=0, return_index=True)[1]))


def _grid_positions(axes: tuple[Array, Array], index: NDArray[np.intp]) -> Array:
    """Return the positions (M, 2) with indices (M,) of a grid."""
    return np.column_stack([axes[0][index % len(axes[0])], axes[1][index // len(axes[0])]])


def _bounded_solution(matrix: Array, right_side: Array, low: Array, high: Array) -> Array:
    """Return short x (M, k) with matrix (M, 2, k) x = right_side (M, 2) and low <= x <= high.

    Components that leave their bounds are held there, in one round after the other; x is exact
    unless too many are held.
    """
    x = np.zeros(low.shape)
    free = np.ones(low.shape, dtype=bool)
    for _ in range(low.shape[1] - 1):
        held = np.where(free, 0.0, x)
        remaining = right_side - np.einsum("mik,mk->mi", matrix, held)
        x = held + _minimum_norm_solution(matrix * free[:, None], remaining)
        leaves = free & ((x < low) | (x > high))
        if not leaves.any():
            break
        x = np.clip(x, low, high)
        free &= np.logical_not(leaves)
    return x


def _minimum_norm_solution(matrix: Array, right_side: Array) -> Array:
    """Return the shortest x (M, k) with matrix (M, 2, k) x = right_side (M, 2); 0 if none."""
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
    order = np.lexsort((-values, position_index))
    return np.asarray(order[np.unique(position_index[order], return_index=True)[1]])
