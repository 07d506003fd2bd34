"""Levers of valves over time, or those of a task."""

from collections.abc import Mapping, Sequence

import numpy as np

from crane.common.errors import InputError, known
from crane.common.samples import Array
from crane.control.phases import Phases
from crane.control.valves import Signals, circuit_of, signal_of
from crane.machine import Machine

_LONGEST = 4000.0  # of levers [s], what a simulation can have of milliseconds


def joystick(
    machine: Machine, points: Mapping[str, Sequence[tuple[float, float]]] | str
) -> Signals | Phases:
    """Signals of levers: per joint a polygon of (time [s], lever from -1 to 1), or a task's name.

    A lever moves both spools of a valve that has two; JOINT_b names a lever of the second alone. A
    task begins at its own `start`, and may have `Phases` in the place of polygons. The lever
    asks for a share of the valve's flow, see `signal_of`.

    Raises:
        InputError: Unknown joints or task, levers beyond -1 to 1, or times that do not increase.
    """
    circuit = circuit_of(machine)
    last, start = 0.0, None
    if isinstance(points, str):
        task = machine.tasks.get(points)
        if task is None or task.space != "joystick":
            names = [name for name, task in machine.tasks.items() if task.space == "joystick"]
            raise InputError(f"'{points}' is no task of levers, {known(names, points)}")
        if task.start:
            start = machine.check_limits(
                [
                    task.start.get(joint, machine.home[machine.column(joint)])
                    for joint in machine.active
                ],
                f"the start of task '{points}'",
            )
        if task.phases:
            return Phases(machine, task.phases, task.ramp, start)
        points, last = task.levers, task.duration
    corners: dict[str, tuple[Array, Array]] = {}
    for joint, polygon in points.items():
        if joint not in circuit.spools:
            raise InputError(f"no valve for '{joint}', {known(circuit.spools, joint)}")
        try:
            table = np.array(polygon, dtype=np.float64)
        except (TypeError, ValueError):
            table = np.zeros(0)
        if table.shape[1:] != (2,) or not len(table):
            raise InputError(f"lever of '{joint}': give pairs of time and position")
        if not (np.diff(table[:, 0]) > 0).all() or not (np.abs(table[:, 1]) <= 1).all():
            raise InputError(
                f"lever of '{joint}': give increasing times and positions from -1 to 1"
            )
        corners[joint] = table[:, 0], table[:, 1]
    # between corners the dead band is jumped where a lever passes zero: fine steps, not corners
    last = max([last, *(times[-1] for times, _ in corners.values())])
    if not 0 < last <= _LONGEST:
        raise InputError(f"the levers end at {last:g} s, give times up to {_LONGEST:g} s")
    fine = np.linspace(0.0, last, max(2, round(last / 1e-3) + 1))
    signals = {}
    for name, spool in circuit.spools.items():
        by = name if name in corners else spool.joint
        if by in corners:
            signals[name] = signal_of(spool, np.interp(fine, *corners[by]))
    found = Signals(machine, fine, signals)
    found.title, found.start = "joystick", start
    return found
