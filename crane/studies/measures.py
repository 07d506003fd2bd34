"""What a machine needs for its tasks, and where its strokes take it."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import ClosureError
from crane.common.samples import Array
from crane.control import ComputedTorque, joystick
from crane.dynamics import Dynamics
from crane.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.motion.trajectories import task_trajectory
from crane.motion.workspaces.extremes import farthest
from crane.motion.workspaces.section import upwards
from crane.recordings.recording import FORCE_UNITS
from crane.simulation import simulate

_RATE = 200  # samples per second of a task
_LEVERS = 5e-3  # [s] between samples of a task of levers
_CELLS = 1000  # postures of the grid over the strokes that move passive joints
_POSTURES = 5000  # with those of the other strokes
_STEPS = 16  # from one of the grid to the next
_DRAWN = 8  # postures at which a stroke is seen to move the tip
_MOVES = 1e-9  # slope of the tip that it does so by [m/m], [m/rad]
_STARTS = 12  # postures of the grid from which the farthest reach is sought
_FEW = 4  # the same for the end of a stroke
_APART = 0.2  # of the strokes, between two of them


def task_measures(machine: Machine) -> dict[str, str]:
    """Names and units of what is measured task by task; pump_work of tasks of levers alone."""
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
    """Names and units of what is measured over the strokes."""
    return {
        **({} if machine.tip is None else {"reach": "m"}),
        "range": "",
        **{f"lower_{joint}": machine.unit(joint) for joint in machine.driven_joints},
        **{f"upper_{joint}": machine.unit(joint) for joint in machine.driven_joints},
    }


def of_task(machine: Machine, dynamics: Dynamics, task: str) -> tuple[float, dict[str, float]]:
    """What the driven joints need to move as a task asks, and its duration [s].

    Inverse dynamics of the reference motion, friction included, while free joints move as they
    will: with some, the motion is that of a simulation under `ComputedTorque`. A task of levers
    is simulated with its circuit: the forces are those of the cylinders then, and pump_work is
    what the pumps gave.

        tau = inverse(q_ref, v_ref, a_ref),     peak = max |tau|,   rms^2 = 1/T int tau^2 dt,
        energy = int sum max(0, tau_i v_i) dt,  work = int sum tau_i v_i dt.

    Raises:
        CraneError: The machine cannot do it.
    """
    if machine.tasks[task].space == "joystick":
        return _of_levers(machine, task)
    path = task_trajectory(machine, task)
    time = np.linspace(0.0, path.duration, int(np.ceil(_RATE * path.duration)) + 1)
    if machine.free:
        step = float(time[1] - time[0])
        run = simulate(machine, ComputedTorque(machine, path), step=step)
        v_a, tau = run.v, run.tau
    else:
        q_a, v_a, a_a = path(time)
        tau = dynamics.inverse(q_a, v_a, a_a, friction=True)
    return path.duration, _of_forces(machine, time, v_a, tau)


def _of_levers(machine: Machine, name: str) -> tuple[float, dict[str, float]]:
    """The same of a task of levers, simulated with its circuit and loads."""
    task = machine.tasks[name]
    run = simulate(
        machine.under(*task.loads),
        joystick(machine, name),
        duration=None if task.phases else task.duration,
        step=_LEVERS,
    )
    found = _of_forces(machine, run.time, run.v, run.tau)
    found["pump_work"] = float(run.channels["pump_work"][-1])
    return float(run.time[-1]), found


def _of_forces(machine: Machine, time: Array, v_a: Array, tau: Array) -> dict[str, float]:
    """Measures of forces (N, n) along a motion."""
    power, duration = tau * v_a, float(time[-1] - time[0])
    found = {}
    for joint in machine.driven_joints:
        i = machine.active.index(joint)
        found[f"peak_{joint}"] = float(np.abs(tau[:, i]).max())
        square = np.trapezoid(tau[:, i] ** 2, time) / duration
        found[f"rms_{joint}"] = float(np.sqrt(square))
    found["energy"] = float(np.trapezoid(np.maximum(power, 0.0).sum(axis=1), time))
    found["work"] = float(np.trapezoid(power.sum(axis=1), time))
    found["duration"] = duration
    return found


def together(tasks: Sequence[tuple[float, dict[str, float]]]) -> dict[str, float]:
    """Measures of tasks done one after the other, from those of each, see `of_task`."""
    whole = sum(duration for duration, _ in tasks)
    out = {}
    for name in [x for x in tasks[0][1] if all(x in found for _, found in tasks)]:
        values = [found[name] for _, found in tasks]
        if name.startswith("peak_"):
            out[name] = max(values)
        elif name.startswith("rms_"):
            squares = [d * x * x for (d, _), x in zip(tasks, values, strict=True)]
            out[name] = float(np.sqrt(sum(squares) / whole))
        else:
            out[name] = sum(values)
    return out


def of_strokes(machine: Machine) -> dict[str, float]:
    """Where the strokes can go from home with the loops closed, within the limits.

    A grid over the limits finds where, and the extremes of it are improved until they are exact,
    see `farthest`: lower and upper are the ends of each stroke, reach is the largest horizontal
    distance of the tip from the world's origin. range is the share of the grid that closes, and as
    fine as that.
    """
    home = machine.home[machine.closure.active]
    coupled = _coupled(machine)
    low, high = _ends(machine, home)
    count = _values(coupled)
    axes = [
        np.linspace(a, b, count) if moves else np.array([at])
        for a, b, at, moves in zip(low, high, home, coupled, strict=True)
    ]
    postures = _closed(machine, axes)
    found = {"range": len(postures) / int(np.prod([len(axis) for axis in axes]))}
    if not len(postures):
        return found
    strokes = np.flatnonzero(coupled)
    for joint in machine.driven_joints:
        i = machine.active.index(joint)
        found[f"lower_{joint}"], found[f"upper_{joint}"] = float(low[i]), float(high[i])
        if not coupled[i]:
            continue
        for name, sign in (("lower", -1.0), ("upper", 1.0)):
            found[f"{name}_{joint}"] = _end(machine, postures, strokes, (low, high), i, sign)
    if machine.tip is not None:
        found["reach"] = _reach(machine, postures, coupled, (low, high))
    return found


def notes(machine: Machine, measures: Sequence[str]) -> tuple[str, ...]:
    """How fine measures are that are not exact, a line each."""
    found = []
    if any(name in task_measures(machine) for name in measures):
        found.append(f"forces are taken every {1e3 / _RATE:g} ms of a task")
    if "range" in measures:
        coupled = _coupled(machine)
        count = int(coupled.sum())
        strokes = f"{count} stroke{'s' * (count != 1)}"
        found.append(f"range is counted on {_values(coupled)} values of each of {strokes}")
    return tuple(found)


def _coupled(machine: Machine) -> NDArray[np.bool_]:
    """Which driven joints (n,) move passive ones."""
    gamma = machine.closure.gamma(machine.home)[machine.closure.passive]
    return np.asarray((np.abs(gamma).max(axis=0, initial=0.0) > 0) & machine.driven)


def _values(coupled: NDArray[np.bool_]) -> int:
    """How many values of each stroke the grid has."""
    return max(3, int(_CELLS ** (1 / max(1, int(coupled.sum()))) + 1e-9))


def _ends(machine: Machine, home: Array) -> tuple[Array, Array]:
    """Limits of the active joints; a turn about home where an angle has none, free ones there."""
    half = np.array([np.pi if machine.unit(joint) == "rad" else 0.0 for joint in machine.active])
    low = np.where(np.isfinite(machine.lower), machine.lower, home - half)
    high = np.where(np.isfinite(machine.upper), machine.upper, home + half)
    return np.where(machine.driven, low, home), np.where(machine.driven, high, home)


def _next_to(cell: tuple[int, ...], shape: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """The neighbours of a cell along the axes of a grid."""
    for i, step in itertools.product(range(len(shape)), (-1, 1)):
        if 0 <= cell[i] + step < shape[i]:
            yield (*cell[:i], cell[i] + step, *cell[i + 1 :])


def _closed(machine: Machine, axes: list[Array]) -> Array:
    """Closed postures (N, nq) of a grid that are connected with home."""
    closure = machine.closure
    try:
        return closure.solve(np.array(list(itertools.product(*axes))))
    except ClosureError:
        pass
    shape = tuple(len(axis) for axis in axes)
    home = machine.home[closure.active]
    last = [len(axis) - 1 for axis in axes]
    above = [int(np.searchsorted(axis, at)) for axis, at in zip(axes, home, strict=True)]
    around = [{max(k - 1, 0), min(k, most)} for k, most in zip(above, last, strict=True)]
    found, seen = {}, set(itertools.product(*around))
    waiting = [(cell, machine.home) for cell in sorted(seen)]
    while waiting:
        cell, beside = waiting.pop(0)
        q_a = np.array([axis[k] for axis, k in zip(axes, cell, strict=True)])
        posture = _beside(machine, beside, q_a)
        if posture is None:
            continue
        found[cell] = posture
        new = [near for near in _next_to(cell, shape) if near not in seen]
        seen.update(new)
        waiting += [(near, posture) for near in new]
    return np.array([found[cell] for cell in sorted(found)]).reshape(-1, len(machine.home))


def _beside(machine: Machine, q: Array, target: Array) -> Array | None:
    """The closed posture at a target beside a posture q (nq,), None where the loops open."""
    closure = machine.closure
    if closure.compiled:  # to find out slowly that they do would take most of the time
        fast = closure.fast
        cursor, start = fast.cursor(), q[closure.active]
        fast.start_near(cursor, q)
        way = start + np.linspace(0, 1, _STEPS + 1)[1:, None] * (target - start)
        out = np.empty((_STEPS, len(q)))
        return out[-1] if fast.follow(cursor, way, out) == _STEPS else None
    try:
        return closure.solve(target, guess=q)
    except ClosureError:
        return None


def _end(
    machine: Machine,
    postures: Array,
    strokes: NDArray[np.intp],
    ends: tuple[Array, Array],
    i: int,
    sign: float,
) -> float:
    """How far one stroke goes up (sign 1) or down (-1), from the closed postures of the grid."""
    column = machine.closure.active[i]
    limit = float(ends[int(sign > 0)][i])
    values = sign * postures[:, column]
    if (values >= sign * limit).any():
        return limit
    slope = np.zeros(machine.model.nv)
    slope[column] = sign

    def goal(q: Array) -> tuple[float, Array]:
        return sign * float(q[column]), slope

    q_a = postures[:, machine.closure.active]
    starts = postures[_apart(values, _shares(q_a, ends))[:_FEW]]
    return sign * max(farthest(machine, q, strokes.tolist(), ends, goal)[0] for q in starts)


def _reach(
    machine: Machine, postures: Array, coupled: NDArray[np.bool_], ends: tuple[Array, Array]
) -> float:
    """Largest horizontal distance of the tip, over all strokes."""
    kinematics, up = Kinematics(machine), upwards(machine)
    active = machine.closure.active

    def goal(q: Array) -> tuple[float, Array]:
        tip = kinematics.position_at(q)
        away = tip - up * (up @ tip)
        length = float(np.linalg.norm(away))
        return length, (away / (length or 1.0)) @ kinematics.tree_jacobian(q)

    random = np.random.default_rng(0)
    drawn = postures[random.integers(len(postures), size=_DRAWN)]
    drawn[:, active[~coupled]] = random.uniform(*ends, (_DRAWN, len(active)))[:, ~coupled]
    moves = np.abs([goal(q)[1][active] for q in drawn]).max(axis=0) > _MOVES
    moves &= machine.driven
    free = np.flatnonzero(~coupled & moves)
    each = max(2, int((_POSTURES / len(postures)) ** (1 / max(1, len(free)))))
    turns = np.array(
        list(itertools.product(*(np.linspace(ends[0][i], ends[1][i], each) for i in free)))
    )
    every = np.repeat(postures, len(turns), axis=0)
    every[:, active[free]] = np.tile(turns, (len(postures), 1))
    strokes = np.flatnonzero(coupled | moves)
    places = _shares(every[:, active], ends)[:, strokes]
    starts = every[_apart(np.array([goal(q)[0] for q in every]), places)]
    return max(farthest(machine, q, strokes.tolist(), ends, goal)[0] for q in starts)


def _shares(q_a: Array, ends: tuple[Array, Array]) -> Array:
    """Active coordinates (N, n) as shares of the way between their ends."""
    return (q_a - ends[0]) / np.where(ends[1] > ends[0], ends[1] - ends[0], 1.0)


def _apart(values: Array, places: Array) -> list[int]:
    """Indices of the largest values (N,) whose places (N, n) are not beside each other."""
    left = np.argsort(-values, kind="stable")
    chosen: list[int] = []
    while len(left) and len(chosen) < _STARTS:
        chosen.append(int(left[0]))
        left = left[np.abs(places[left] - places[left[0]]).max(axis=1) > _APART]
    return chosen
