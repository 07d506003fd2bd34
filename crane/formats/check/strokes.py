"""Whether tasks stay within the strokes, and whether the loops close all over these."""

import warnings
from collections.abc import Iterator, Mapping

import numpy as np

from crane.closure import Closure
from crane.common.errors import ClosureError, CraneWarning
from crane.common.samples import Array
from crane.description import MachineSpec
from crane.description.specification import TIP_COORDINATES

_SAMPLES, _WORK = 150, 6000  # of the strokes' box, and samples times joints at most
_FAILED = 20  # of these that end it: each takes a hundred times as long as one that closes
_LONG = 100.0  # characteristic lengths of the machine, of a stroke that is told as millimetres
_TOLD = 0.01  # share of the box that does not close
_SLACK = 1e-6  # of a limit [rad], [machine's size], as runs have it


def warn_of_tasks(spec: MachineSpec, closure: Closure) -> None:
    """Warn of points of tasks that are beyond limits of active joints, or do not close.

    Points are via points, starts, and the positions that phases of levers end at. Those of the tip
    are only held against the length of all links in line.

    Args:
        spec: The machine as read.
        closure: Its loops, closed at home.
    """
    coordinates, active = closure.equations.coordinates, closure.active
    names = closure.active_names
    slack = _SLACK * closure.units
    place, reach = spec.source_locations.get("tasks", spec.path.name), _reach(spec)
    for name, task in spec.tasks.items():
        for via in task.via if task.space == "tip" else ():
            away = float(np.linalg.norm([via.point.get(axis, 0.0) for axis in TIP_COORDINATES]))
            if away > reach:
                _warn(
                    f"{place}: task '{name}' has its tip {away:.4g} m from the root at t = "
                    f"{via.time:g} s, and all links in line are {reach:.4g} m long, choose a "
                    "point within reach"
                )
                break
        for what, point in _points(spec, name):
            q_a = closure.home[active].copy()
            for joint in point.keys() & set(names):
                column = coordinates.column(joint)
                lower, upper = coordinates.lower[column], coordinates.upper[column]
                value = q_a[names.index(joint)] = point[joint]
                if not lower - slack[column] <= value <= upper + slack[column]:
                    unit = "m" if coordinates.is_translation[column] else "rad"
                    _warn(
                        f"{place}: task '{name}' has '{joint}' at {value:g} {unit} {what}, beyond "
                        f"its limits {lower:g} to {upper:g} {unit}, choose a position within them"
                    )
                    break
            else:
                try:
                    closure.solve(q_a)
                except ClosureError as error:
                    _warn(f"{place}: task '{name}' {what}: {error}; choose another position")


def warn_of_strokes(spec: MachineSpec, closure: Closure) -> None:
    """Warn where loops do not close in a part of the box that the limits of slides make.

    Those are the active slides in loops; all other active joints stay at home.

    Args:
        spec: The machine as read.
        closure: Its loops, closed at home.
    """
    coordinates, active = closure.equations.coordinates, closure.active
    lower, upper = coordinates.lower[active], coordinates.upper[active]
    moved = coordinates.is_translation[active] & (
        upper - lower < _LONG * closure.characteristic_length
    )
    moved &= (closure.equations.sign[:, active] != 0).any(axis=0)
    if not moved.any():
        return
    failed: list[tuple[float, str]] = []
    shares = _shares(int(moved.sum()), max(1, min(_SAMPLES, _WORK // len(closure.home))))
    span = (upper - lower)[moved]
    home = closure.home[active]
    tried = 0
    for share in shares:
        tried += 1
        q_a = home.copy()
        q_a[moved] = lower[moved] + share * span
        try:
            closure.solve(q_a)
        except ClosureError as error:
            away = np.abs((q_a - home)[moved] / np.where(span > 0, span, 1.0)).max()
            failed.append((float(away), str(error)))
            if len(failed) == _FAILED:
                break
    part = len(failed) / tried
    if part >= _TOLD:
        names = ", ".join(x for x, yes in zip(closure.active_names, moved, strict=True) if yes)
        _warn(
            f"{spec.source_locations.get('active', spec.path.name)}: {100 * part:.0f} % of the "
            f"strokes "
            f"within the limits of {names} lie beyond dead centres, the nearest "
            f"of those tried: "
            f"{min(failed)[1]}; narrow the limits, or see that the lengths are right"
        )


def _reach(spec: MachineSpec) -> float:
    """Length of all links from the root to the tip in line, of slides at their longest [m]."""
    above = {joint.child: joint for joint in spec.tree.joints.values()}
    link, length = spec.tip, 0.0
    while link in above:
        joint = above[link]
        length += float(np.linalg.norm(joint.xyz))
        if joint.kind == "prismatic":
            length += max(abs(joint.limits.lower), abs(joint.limits.upper))
        elif joint.kind not in ("fixed", "revolute", "continuous"):
            return np.inf
        link = joint.parent
    return length


def _points(spec: MachineSpec, name: str) -> Iterator[tuple[str, Mapping[str, float]]]:
    """Positions of active joints that a task comes to, in words and by joint."""
    task = spec.tasks[name]
    if task.start:
        yield "at its start", task.start
    if task.via and task.space == "active":
        known: dict[str, float] = {}
        for via in task.via:
            known |= via.point
            yield f"at t = {via.time:g} s", dict(known)
    now = dict(task.start)
    for phase in task.phases:
        now |= phase.until
        yield f"at the end of phase '{phase.name}'", dict(now)


def _shares(count: int, samples: int) -> Array:
    """(samples, count) points of the unit box, a low-discrepancy sequence.

    Multiples of the powers of 1 / phi, phi^(k + 1) = phi + 1 for k unknowns (Roberts 2018).
    """
    phi = 2.0
    for _ in range(40):
        phi = (1 + phi) ** (1 / (count + 1))
    steps = phi ** -np.arange(1.0, count + 1)
    return np.remainder(0.5 + np.outer(np.arange(1, samples + 1), steps), 1.0)


def _warn(text: str) -> None:
    warnings.warn(text, CraneWarning, stacklevel=3)
