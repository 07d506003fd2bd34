"""Levers of valves over time, or those of a task."""

from collections.abc import Mapping, Sequence

import numpy as np

from crane.common.errors import InputError, suggest_names
from crane.common.samples import Array
from crane.control.lever_phases import LeverPhases
from crane.control.valve_commands import ValveSignals, lever_signals, require_circuit
from crane.machine import Machine

_MAX_DURATION = 4000.0  # of levers [s], what a simulation can have of milliseconds


def joystick(
    machine: Machine, points: Mapping[str, Sequence[tuple[float, float]]] | str
) -> ValveSignals | LeverPhases:
    """Signals of levers: per joint a polygon of (time [s], lever from -1 to 1), or a task's name.

    A lever moves both spools of a valve that has two; JOINT_b names a lever of the second alone. A
    task begins at its own `start`, and may have `LeverPhases` in the place of polygons. The lever
    asks for a share of the valve's flow, see `lever_signals`.

    Raises:
        InputError: Unknown joints or task, levers beyond -1 to 1, or times that do not increase.
    """
    circuit = require_circuit(machine)
    last, start = 0.0, None
    if isinstance(points, str):
        task = machine.tasks.get(points)
        if task is None or task.space != "joystick":
            names = [name for name, task in machine.tasks.items() if task.space == "joystick"]
            raise InputError(f"'{points}' is no task of levers, {suggest_names(names, points)}")
        if task.start:
            start = machine.check_limits(
                [
                    task.start.get(joint, machine.home[machine.column(joint)])
                    for joint in machine.active
                ],
                f"the start of task '{points}'",
            )
        if task.phases:
            return LeverPhases(machine, task.phases, task.ramp, start)
        points, last = task.levers, task.duration
    polygons: dict[str, tuple[Array, Array]] = {}
    for joint, polygon in points.items():
        if joint not in circuit.spools:
            raise InputError(f"no valve for '{joint}', {suggest_names(circuit.spools, joint)}")
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
        polygons[joint] = table[:, 0], table[:, 1]
    # between corners the dead band is jumped where a lever passes zero: fine steps, not corners
    last = max([last, *(times[-1] for times, _ in polygons.values())])
    if not 0 < last <= _MAX_DURATION:
        raise InputError(f"the levers end at {last:g} s, give times up to {_MAX_DURATION:g} s")
    times_fine = np.linspace(0.0, last, max(2, round(last / 1e-3) + 1))
    signals = {}
    for name, spool in circuit.spools.items():
        lever = name if name in polygons else spool.joint
        if lever in polygons:
            signals[name] = lever_signals(spool, np.interp(times_fine, *polygons[lever]))
    command = ValveSignals(machine, times_fine, signals)
    command.title, command.initial_coordinates = "joystick", start
    return command
