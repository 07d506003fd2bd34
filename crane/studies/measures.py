"""What a machine needs for its tasks, and where its strokes take it."""

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from crane.dynamics import Dynamics
from crane.errors import ClosureError
from crane.kinematics import Kinematics
from crane.machine import Machine
from crane.paths import task_path
from crane.recording import FORCE_UNITS
from crane.samples import Array

_RATE = 200  # samples per second of a task
_CELLS = 1000  # postures of the grid over the strokes that move passive joints
_POSTURES = 5000  # with those of the other strokes
_STEPS = 16  # from one of the grid to the next


def task_measures(machine: Machine) -> dict[str, str]:
    """Names and units of what is measured task by task."""
    units = {joint: FORCE_UNITS[machine.unit(joint)] for joint in machine.active}
    return {
        **{f"peak_{joint}": unit for joint, unit in units.items()},
        **{f"rms_{joint}": unit for joint, unit in units.items()},
        "energy": "J",
        "work": "J",
    }


def stroke_measures(machine: Machine) -> dict[str, str]:
    """Names and units of what is measured over the strokes."""
    return {
        **({} if machine.tip is None else {"reach": "m"}),
        "range": "",
        **{f"lower_{joint}": machine.unit(joint) for joint in machine.active},
        **{f"upper_{joint}": machine.unit(joint) for joint in machine.active},
    }


def of_task(machine: Machine, dynamics: Dynamics, task: str) -> tuple[float, dict[str, float]]:
    """What the active joints need to move as a task asks, and its duration [s].

    Inverse dynamics of the reference motion, friction included:

        tau = inverse(q_ref, v_ref, a_ref),     peak = max |tau|,   rms^2 = 1/T int tau^2 dt,
        energy = int sum max(0, tau_i v_i) dt,  work = int sum tau_i v_i dt.

    Raises:
        CraneError: The machine cannot do it.
    """
    path = task_path(machine, task)
    time = np.linspace(0.0, path.duration, int(np.ceil(_RATE * path.duration)) + 1)
    q_a, v_a, a_a = path(time)
    tau = dynamics.inverse(q_a, v_a, a_a, friction=True)
    power = tau * v_a
    found = {}
    for i, joint in enumerate(machine.active):
        found[f"peak_{joint}"] = float(np.abs(tau[:, i]).max())
        square = np.trapezoid(tau[:, i] ** 2, time) / path.duration
        found[f"rms_{joint}"] = float(np.sqrt(square))
    found["energy"] = float(np.trapezoid(np.maximum(power, 0.0).sum(axis=1), time))
    found["work"] = float(np.trapezoid(power.sum(axis=1), time))
    return path.duration, found


def together(tasks: Sequence[tuple[float, dict[str, float]]]) -> dict[str, float]:
    """Measures of tasks done one after the other, from those of each, see `of_task`."""
    whole = sum(duration for duration, _ in tasks)
    out = {}
    for name in tasks[0][1]:
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
    """Where the strokes can go from home with the loops closed, on a grid over the limits.

    range is the share of the grid that closes, lower and upper are the ends of each stroke there,
    reach is the largest horizontal distance of the tip from the world's origin.
    """
    home = machine.home[machine.closure.active]
    gamma = machine.closure.gamma(machine.home)
    coupled = np.abs(gamma[machine.closure.passive]).max(axis=0, initial=0.0) > 0
    low, high = _ends(machine, home)
    count = max(3, int(_CELLS ** (1 / max(1, coupled.sum()))))
    axes = [
        np.linspace(a, b, count) if moves else np.array([at])
        for a, b, at, moves in zip(low, high, home, coupled, strict=True)
    ]
    postures = _closed(machine, axes)
    q_a = postures[:, machine.closure.active]
    found = {"range": len(postures) / int(np.prod([len(axis) for axis in axes]))}
    if not len(postures):
        return found
    for i, joint in enumerate(machine.active):
        found[f"lower_{joint}"] = float(q_a[:, i].min() if coupled[i] else low[i])
        found[f"upper_{joint}"] = float(q_a[:, i].max() if coupled[i] else high[i])
    if machine.tip is not None:
        free = np.flatnonzero(~coupled)
        each = max(2, int((_POSTURES / len(postures)) ** (1 / max(1, len(free)))))
        found["reach"] = _reach(
            machine, postures, free, [np.linspace(low[i], high[i], each) for i in free]
        )
    return found


def _ends(machine: Machine, home: Array) -> tuple[Array, Array]:
    """Limits of the active joints; a turn about home where an angle has none."""
    half = np.array([np.pi if machine.unit(joint) == "rad" else 0.0 for joint in machine.active])
    return (
        np.where(np.isfinite(machine.lower), machine.lower, home - half),
        np.where(np.isfinite(machine.upper), machine.upper, home + half),
    )


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
        for i, step in itertools.product(range(len(shape)), (-1, 1)):
            near = (*cell[:i], cell[i] + step, *cell[i + 1 :])
            if 0 <= near[i] < shape[i] and near not in seen:
                seen.add(near)
                waiting.append((near, found[cell]))
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


def _reach(machine: Machine, postures: Array, free: NDArray[np.intp], axes: list[Array]) -> float:
    """Largest horizontal distance of the tip over postures and coordinates that move no loop."""
    kinematics = Kinematics(machine)
    gravity = machine.model.gravity.linear
    length = float(np.linalg.norm(gravity))
    up = -gravity / length if length > 0 else np.zeros(3)
    columns, most = machine.closure.active[free], 0.0
    for posture in postures:
        q = posture.copy()
        for values in itertools.product(*axes):
            q[columns] = values
            tip = kinematics.position_at(q)
            most = max(most, float(np.linalg.norm(tip - up * (up @ tip))))
    return most
