"""Goals of the page on which a machine is driven: points that the tip passes in order."""

from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np

from crane.common.errors import CraneError
from crane.common.samples import Array
from crane.description.specification import Task
from crane.machine.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.motion.task_trajectories import task_trajectory
from crane.motion.workspaces.workspace_section import find_slewing_joint

_SAMPLES, _LEAST_SAMPLES, _SEED = 80, 20, 1  # configurations that show where the tip goes
_MIDDLE = (0.2, 0.8)  # of the ranges, where goals are
_FREE_RANGE, _LARGEST_SLEW = 0.8, 1.3  # [rad] about home
_PATH_POINTS, _LINE_POINTS = 40, 12
_RADIUS = 0.025  # of a goal, in distances that the tip goes
_LINE_SHARE = 0.25  # of the tip's distance from the axis
_LOAD_SHARE = 0.3  # of the largest payload


def goal_data(machine: Machine, payloads: list[float], ground: float) -> list[dict[str, Any]]:
    """Goals: those of the machine's tasks, and such as its reach allows.

    Each has `points` (k, 3) of the tip in the world [m] that are passed in order, within `radius`.
    The distance from the line through them counts where it is a `path`. A load of `mass` is taken
    at the point `take` and put down at the point `put`, where there are some.

    Args:
        machine: The machine.
        payloads: Payloads to choose from [kg].
        ground: Height of the ground, above which goals are where the tip goes there [m].
    """
    if machine.tip is None:
        return []
    kinematics = Kinematics(machine)
    found = list(_reachable(machine, kinematics))
    if not found:
        return []
    points = np.array(found)
    above = points @ machine.up_direction > ground
    points = points[above] if above.sum() > _LEAST_SAMPLES else points
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    if not size:
        return []
    goals = []
    if len(payloads) > 1:
        goals.append(_carry(machine, points, payloads[int(_LOAD_SHARE * len(payloads))]))
    with suppress(CraneError):
        goals.append(_grade(machine, kinematics))
    goals.append(_reach(kinematics.position(machine.home[machine.closure.active]), points))
    for task in machine.tasks.values():
        with suppress(CraneError):
            goals.append(_task_goal(machine, kinematics, task))
    return [{"radius": _RADIUS * size, "path": False, "mass": 0.0} | goal for goal in goals]


def _reachable(machine: Machine, kinematics: Kinematics) -> Iterator[Array]:
    """Positions of the tip in the middle of the ranges."""
    home = machine.home[machine.closure.active]
    bounded = np.isfinite(machine.lower) & np.isfinite(machine.upper)
    lower = np.where(bounded, machine.lower, home - _FREE_RANGE)
    upper = np.where(bounded, machine.upper, home + _FREE_RANGE)
    low, high = (lower + x * (upper - lower) for x in _MIDDLE)
    slewing = find_slewing_joint(machine, kinematics.frame)
    if slewing is not None:
        i = slewing[0]
        low[i], high[i] = (
            max(low[i], home[i] - _LARGEST_SLEW),
            min(high[i], home[i] + _LARGEST_SLEW),
        )
    for share in np.random.default_rng(_SEED).random((_SAMPLES, len(home))):
        with suppress(CraneError):
            yield kinematics.position(low + share * (high - low))


def _carry(machine: Machine, points: Array, mass: float) -> dict[str, Any]:
    """A load is taken low and far out, and put down high, and beside if the machine slews."""
    heights = points @ machine.up_direction
    start = int(heights.argmin())
    distances = np.linalg.norm(points - points[start], axis=1)
    end = int(np.where(heights >= np.median(heights), distances, -1.0).argmax())
    return {
        "name": "lift the load", "text": "take the load, lift it over, put it down",
        "points": points[[start, end]].tolist(), "take": 0, "put": 1, "mass": mass,
    }  # fmt: skip


def _grade(machine: Machine, kinematics: Kinematics) -> dict[str, Any]:
    """A level line towards the machine, as far as the tip reaches it.

    Raises:
        CraneError: It does not.
    """
    q_a = machine.home[machine.closure.active]
    tip, up = kinematics.position(q_a), machine.up_direction
    level = tip - (tip @ up) * up
    line = tip - np.linspace(0.0, _LINE_SHARE, _LINE_POINTS)[:, None] * level
    kinematics.inverse(line, q_a)
    return {
        "name": "grade a line", "text": "draw the tip in along a level line",
        "points": line.tolist(), "path": True,
    }  # fmt: skip


def _reach(tip: Array, points: Array) -> dict[str, Any]:
    """Three points far from each other."""
    chosen = [tip]
    for _ in range(3):
        distances = np.linalg.norm(points[:, None] - np.array(chosen), axis=2).min(axis=1)
        chosen.append(points[int(distances.argmax())])
    return {
        "name": "reach three points", "text": "bring the tip to each of them",
        "points": [x.tolist() for x in chosen[1:]],
    }  # fmt: skip


def _task_goal(machine: Machine, kinematics: Kinematics, task: Task) -> dict[str, Any]:
    """The path of the tip in a task of the machine file.

    Raises:
        CraneError: It has no path, as levers over time have none.
    """
    text = task.description or f"the path of task {task.name}"
    if task.phases:
        positions = dict(zip(machine.active, machine.home[machine.closure.active], strict=True))
        positions |= dict(task.start)
        points = []
        for phase in task.phases:
            positions |= dict(phase.until)
            points.append(kinematics.position([positions[x] for x in machine.active]).tolist())
        return {"name": task.name, "text": text, "points": points}
    reference = task_trajectory(machine, task.name)
    times = np.linspace(0.0, reference.duration, _PATH_POINTS)
    path = kinematics.position(np.array([reference.position(x) for x in times]))
    return {"name": task.name, "text": text, "points": path.tolist(), "path": True}
