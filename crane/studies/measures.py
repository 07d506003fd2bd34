"""Measures of a machine: forces and energy of its tasks, ranges of its strokes, reach."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import ClosureError
from crane.common.samples import Array
from crane.control.control_law import ComputedTorque
from crane.control.levers import joystick
from crane.dynamics.dynamics import Dynamics
from crane.machine.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.motion.task_trajectories import task_trajectory
from crane.motion.workspaces.workspace_extremes import maximize_on_branch
from crane.motion.workspaces.workspace_patch import last_closed_configuration
from crane.recordings.recording import FORCE_UNITS
from crane.simulation.simulation_run import simulate

_SAMPLES_PER_SECOND = 200  # of a task
_LEVER_TASK_STEP = 5e-3  # between samples of a task of levers [s]
_COUPLED_GRID_SIZE = 1000  # configurations of the grid over strokes that move passive joints
_MAX_CONFIGURATIONS = 5000  # of this grid and of all other strokes
_RANDOM_CONFIGURATIONS = 8  # configurations that decide whether a stroke moves the tip
_MOTION_TOLERANCE = 1e-9  # derivative of the tip position at rest [m/m], [m/rad]
_REACH_START_COUNT = 12  # configurations of the grid from which the reach is searched
_STROKE_START_COUNT = 4  # configurations from which the end of a stroke is searched
_MIN_START_DISTANCE = 0.2  # share of the strokes between two starts


def task_measures(machine: Machine) -> dict[str, str]:
    """Return names and units of the measures of tasks; pump_work for tasks of levers only."""
    units = {joint: FORCE_UNITS[machine.unit(joint)] for joint in machine.driven_joints}
    return {
        **{f"peak_{joint}": unit for joint, unit in units.items()},
        **{f"rms_{joint}": unit for joint, unit in units.items()},
        "energy": "J",
        "work": "J",
        "duration": "s",
        **({"pump_work": "J"} if machine.hydraulics is not None else {}),
    }


def stroke_measures(machine: Machine) -> dict[str, str]:
    """Return names and units of the measures of strokes."""
    return {
        **({} if machine.tip is None else {"reach": "m"}),
        "range": "",
        **{f"lower_{joint}": machine.unit(joint) for joint in machine.driven_joints},
        **{f"upper_{joint}": machine.unit(joint) for joint in machine.driven_joints},
    }


def measure_task(
    machine: Machine, dynamics: Dynamics, task: str
) -> tuple[float, dict[str, float]]:
    """Compute the duration [s] of a task and its measures.

    Forces follow from inverse dynamics of the trajectory, friction included. With free joints, the
    motion is simulated under `ComputedTorque`. A task of levers is simulated with its circuit;
    the forces are then those of the cylinders, and pump_work is the work of the pumps.

        tau = inverse(q_ref, v_ref, a_ref),     peak = max |tau|,   rms^2 = 1/T int tau^2 dt,
        energy = int sum max(0, tau_i v_i) dt,  work = int sum tau_i v_i dt.

    Raises:
        CraneError: The machine cannot perform the task.
    """
    if machine.tasks[task].space == "joystick":
        levers = machine.tasks[task]
        run = simulate(
            machine.with_external_forces(*levers.loads),
            joystick(machine, task),
            duration=None if levers.phases else levers.duration,
            step=_LEVER_TASK_STEP,
        )
        measures = _force_measures(machine, run.time, run.v, run.tau)
        measures["pump_work"] = float(run.channels["pump_work"][-1])
        return float(run.time[-1]), measures
    trajectory = task_trajectory(machine, task)
    time = np.linspace(
        0.0, trajectory.duration, int(np.ceil(_SAMPLES_PER_SECOND * trajectory.duration)) + 1
    )
    if machine.free:
        run = simulate(machine, ComputedTorque(machine, trajectory), step=float(time[1] - time[0]))
        v_a, tau = run.v, run.tau
    else:
        q_a, v_a, a_a = trajectory(time)
        tau = dynamics.inverse(q_a, v_a, a_a, friction=True)
    return trajectory.duration, _force_measures(machine, time, v_a, tau)


def _force_measures(machine: Machine, time: Array, v_a: Array, tau: Array) -> dict[str, float]:
    """Return the measures of forces tau (N, n) along a motion."""
    power, duration = tau * v_a, float(time[-1] - time[0])
    measures = {}
    for joint in machine.driven_joints:
        i = machine.active.index(joint)
        measures[f"peak_{joint}"] = float(np.abs(tau[:, i]).max())
        measures[f"rms_{joint}"] = float(np.sqrt(np.trapezoid(tau[:, i] ** 2, time) / duration))
    measures["energy"] = float(np.trapezoid(np.maximum(power, 0.0).sum(axis=1), time))
    measures["work"] = float(np.trapezoid(power.sum(axis=1), time))
    measures["duration"] = duration
    return measures


def combine_task_measures(tasks: Sequence[tuple[float, dict[str, float]]]) -> dict[str, float]:
    """Combine the measures of tasks that follow each other, see `measure_task`."""
    total_duration = sum(duration for duration, _ in tasks)
    out = {}
    for name in [x for x in tasks[0][1] if all(x in found for _, found in tasks)]:
        values = [measures[name] for _, measures in tasks]
        if name.startswith("rms_"):
            squares = [d * x * x for (d, _), x in zip(tasks, values, strict=True)]
            out[name] = float(np.sqrt(sum(squares) / total_duration))
        else:
            out[name] = max(values) if name.startswith("peak_") else sum(values)
    return out


def measure_strokes(machine: Machine) -> dict[str, float]:
    """Compute the ranges of the strokes that are reached from home with closed loops.

    A grid over the limits is closed from home, and its extremes are improved until they are exact
    (`maximize_on_branch`): lower and upper are the ends of each stroke, reach is the largest
    horizontal distance of the tip from the world's origin. range is the share of the grid that
    closes; its resolution is that of the grid.
    """
    home = machine.home[machine.closure.active]
    is_coupled = _coupled_strokes(machine)
    lower, upper = _stroke_ranges(machine, home)
    count = _values_per_stroke(is_coupled)
    axes = [
        np.linspace(a, b, count) if is_moved else np.array([home_value])
        for a, b, home_value, is_moved in zip(lower, upper, home, is_coupled, strict=True)
    ]
    configurations = _closed_configurations(machine, axes)
    measures = {"range": len(configurations) / int(np.prod([len(axis) for axis in axes]))}
    if not len(configurations):
        return measures
    strokes = np.flatnonzero(is_coupled)
    for joint in machine.driven_joints:
        i = machine.active.index(joint)
        measures[f"lower_{joint}"], measures[f"upper_{joint}"] = float(lower[i]), float(upper[i])
        if not is_coupled[i]:
            continue
        for name, sign in (("lower", -1.0), ("upper", 1.0)):
            measures[f"{name}_{joint}"] = _stroke_end(
                machine, configurations, strokes, (lower, upper), i, sign
            )
    if machine.tip is not None:
        measures["reach"] = _largest_reach(machine, configurations, is_coupled, (lower, upper))
    return measures


def resolution_notes(machine: Machine, measures: Sequence[str]) -> tuple[str, ...]:
    """Return one line per measure that is not exact, with its resolution."""
    lines = []
    if any(name in task_measures(machine) for name in measures):
        lines.append(f"forces are taken every {1e3 / _SAMPLES_PER_SECOND:g} ms of a task")
    if "range" in measures:
        is_coupled = _coupled_strokes(machine)
        count = int(is_coupled.sum())
        strokes = f"{count} stroke{'s' * (count != 1)}"
        lines.append(
            f"range is counted on {_values_per_stroke(is_coupled)} values of each of {strokes}"
        )
    return tuple(lines)


def _coupled_strokes(machine: Machine) -> NDArray[np.bool_]:
    """Return which driven joints (n,) move passive joints."""
    gamma = machine.closure.gamma(machine.home)[machine.closure.passive]
    return (np.abs(gamma).max(axis=0, initial=0.0) > 0) & machine.is_driven


def _values_per_stroke(is_coupled: NDArray[np.bool_]) -> int:
    return max(3, int(_COUPLED_GRID_SIZE ** (1 / max(1, int(is_coupled.sum()))) + 1e-9))


def _stroke_ranges(machine: Machine, home_values: Array) -> tuple[Array, Array]:
    """Return limits of the active joints: a turn if unlimited; home for free joints."""
    half_turn = np.array(
        [np.pi if machine.unit(joint) == "rad" else 0.0 for joint in machine.active]
    )
    lower = np.where(np.isfinite(machine.lower), machine.lower, home_values - half_turn)
    upper = np.where(np.isfinite(machine.upper), machine.upper, home_values + half_turn)
    return np.where(machine.is_driven, lower, home_values), np.where(
        machine.is_driven, upper, home_values
    )


def _neighbouring_cells(
    cell: tuple[int, ...], grid_shape: tuple[int, ...]
) -> Iterator[tuple[int, ...]]:
    for i, step in itertools.product(range(len(grid_shape)), (-1, 1)):
        if 0 <= cell[i] + step < grid_shape[i]:
            yield (*cell[:i], cell[i] + step, *cell[i + 1 :])


def _closed_configurations(machine: Machine, axes: list[Array]) -> Array:
    """Return the closed configurations (N, nq) of a grid that are connected with home."""
    closure = machine.closure
    try:
        return closure.solve(np.array(list(itertools.product(*axes))))
    except ClosureError:
        pass
    shape = tuple(len(axis) for axis in axes)
    home = machine.home[closure.active]
    last_indices = [len(axis) - 1 for axis in axes]
    upper_indices = [
        int(np.searchsorted(axis, home_value)) for axis, home_value in zip(axes, home, strict=True)
    ]
    adjacent_indices = [
        {max(k - 1, 0), min(k, last_index)}
        for k, last_index in zip(upper_indices, last_indices, strict=True)
    ]
    configurations, visited = {}, set(itertools.product(*adjacent_indices))
    pending = [(cell, machine.home) for cell in sorted(visited)]
    while pending:
        cell, neighbour_configuration = pending.pop(0)
        q_a = np.array([axis[k] for axis, k in zip(axes, cell, strict=True)])
        configuration, is_closed = last_closed_configuration(machine, neighbour_configuration, q_a)
        if not is_closed:
            continue
        configurations[cell] = configuration
        new_cells = [
            neighbour for neighbour in _neighbouring_cells(cell, shape) if neighbour not in visited
        ]
        visited.update(new_cells)
        pending += [(near, configuration) for near in new_cells]
    return np.array([configurations[cell] for cell in sorted(configurations)]).reshape(
        -1, len(machine.home)
    )


def _stroke_end(
    machine: Machine,
    configurations: Array,
    strokes: NDArray[np.intp],
    limits: tuple[Array, Array],
    stroke_index: int,
    sign: float,
) -> float:
    column = machine.closure.active[stroke_index]
    limit = float(limits[int(sign > 0)][stroke_index])
    values = sign * configurations[:, column]
    if (values >= sign * limit).any():
        return limit
    gradient = np.zeros(machine.model.nv)
    gradient[column] = sign

    def objective(q: Array) -> tuple[float, Array]:
        return sign * float(q[column]), gradient

    starts = configurations[
        _separated_indices(
            values, _relative_strokes(configurations[:, machine.closure.active], limits)
        )[:_STROKE_START_COUNT]
    ]
    return sign * max(
        maximize_on_branch(machine, q, strokes.tolist(), limits, objective)[0] for q in starts
    )


def _largest_reach(
    machine: Machine,
    configurations: Array,
    is_coupled: NDArray[np.bool_],
    limits: tuple[Array, Array],
) -> float:
    kinematics, up = Kinematics(machine), machine.up_direction
    active = machine.closure.active

    def objective(q: Array) -> tuple[float, Array]:
        tip = kinematics.position_at_configuration(q)
        horizontal = tip - up * (up @ tip)
        length = float(np.linalg.norm(horizontal))
        return length, (horizontal / (length or 1.0)) @ kinematics.tree_jacobian(q)

    random = np.random.default_rng(0)
    random_configurations = configurations[
        random.integers(len(configurations), size=_RANDOM_CONFIGURATIONS)
    ]
    random_configurations[:, active[~is_coupled]] = random.uniform(
        *limits, (_RANDOM_CONFIGURATIONS, len(active))
    )[:, ~is_coupled]
    moves_tip = (
        np.abs([objective(q)[1][active] for q in random_configurations]).max(axis=0)
        > _MOTION_TOLERANCE
    )
    moves_tip &= machine.is_driven
    uncoupled_strokes = np.flatnonzero(~is_coupled & moves_tip)
    values_per_stroke = max(
        2, int((_MAX_CONFIGURATIONS / len(configurations)) ** (1 / max(1, len(uncoupled_strokes))))
    )
    axes = [np.linspace(limits[0][i], limits[1][i], values_per_stroke) for i in uncoupled_strokes]
    stroke_values = np.array(list(itertools.product(*axes)))
    all_configurations = np.repeat(configurations, len(stroke_values), axis=0)
    all_configurations[:, active[uncoupled_strokes]] = np.tile(
        stroke_values, (len(configurations), 1)
    )
    strokes = np.flatnonzero(is_coupled | moves_tip)
    relative_strokes = _relative_strokes(all_configurations[:, active], limits)[:, strokes]
    starts = all_configurations[
        _separated_indices(
            np.array([objective(q)[0] for q in all_configurations]), relative_strokes
        )
    ]
    return max(
        maximize_on_branch(machine, q, strokes.tolist(), limits, objective)[0] for q in starts
    )


def _relative_strokes(q_a: Array, limits: tuple[Array, Array]) -> Array:
    return (q_a - limits[0]) / np.where(limits[1] > limits[0], limits[1] - limits[0], 1.0)


def _separated_indices(values: Array, relative_strokes: Array) -> list[int]:
    """Return indices of the largest values (N,) whose strokes (N, n) are apart."""
    remaining = np.argsort(-values, kind="stable")
    chosen: list[int] = []
    while len(remaining) and len(chosen) < _REACH_START_COUNT:
        chosen.append(int(remaining[0]))
        remaining = remaining[
            np.abs(relative_strokes[remaining] - relative_strokes[remaining[0]]).max(axis=1)
            > _MIN_START_DISTANCE
        ]
    return chosen
