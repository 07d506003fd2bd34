"""From a file to what a machine did: whichever log it is, by its sensors, from when to when.

Every file that was recorded is read here. What a file holds are readings of sensors; what is known
of these, from the machine and from notes of the file (`# sensor.q2.zero: 0.02`, which count
first), turns them into quantities. A file of quantities, as a simulation writes it, says so in the
note `# sensors: ideal` and is taken as it is.
"""

import math
import re
import warnings
from collections.abc import Mapping
from difflib import SequenceMatcher
from pathlib import Path

import numpy as np

from crane.common.errors import CraneWarning, InputError, RecordingError, at, known
from crane.description.sensors import (
    PRESSURE,
    SENSOR,
    SIGNAL,
    TIME,
    Sensor,
    named_numbers,
    parsed,
    unit_of,
    with_numbers,
)
from crane.description.sensors import quantities as quantity_names
from crane.machine import Machine
from crane.recordings import logs, timeseries
from crane.recordings.recording import IDEAL, SENSORS
from crane.recordings.timeseries import Table, column

_ALIKE = 0.7  # likeness of names, from which on one is meant

Span = tuple[float, float]
ALWAYS: Span = (-math.inf, math.inf)


def read(
    path: str | Path,
    machine: Machine | None = None,
    columns: str | Path | None = None,
    span: Span = ALWAYS,
) -> Table:
    """The quantities that a file tells, in SI units.

    Args:
        path: A recording or a log of another program, CSV or npz.
        machine: What was recorded, whose sensors say which columns of a log are which, and by how
            much readings are off.
        columns: A file that says which columns of a log are which instead, see
            `crane.recordings.logs`.
        span: From when to when [s], by the file's own clock.

    Raises:
        RecordingError: A file is missing or malformed, or has no samples in that time.
        InputError: The span is none.
    """
    return quantities(readings(path, machine, columns), path, machine, span)


def quantities(table: Table, path: str | Path, machine: Machine | None, span: Span) -> Table:
    """The same from readings of a path."""
    try:
        known = known_sensors(table, machine)
        if known and machine is not None:
            _tell_both(table, machine)
        table = corrected(table, known)
    except RecordingError as error:
        raise RecordingError(at(str(path), error)) from None
    return within(table, span, path)


def readings(
    path: str | Path, machine: Machine | None = None, columns: str | Path | None = None
) -> Table:
    """The same as the sensors said it, from first to last.

    Raises:
        RecordingError: A file is missing or malformed, or names a quantity of the machine wrongly.
    """
    if columns is not None:
        table = logs.read_log(path, columns)
        if machine is not None:
            _check_names(machine, table, columns)
        return table
    told = {} if machine is None else {x: s for x, s in machine.sensors.items() if s.column}
    if machine is not None and told:
        arrays = timeseries.arrays(Path(path))
        if any(name in arrays for s in told.values() for name in logs.names_in(s.column)):
            return _logged(Path(path), machine, told, arrays)
    return timeseries.read(path)


def _check_names(machine: Machine, table: Table, columns: str | Path) -> None:
    """See that columns which almost have the name of a quantity of the machine have it.

    Others are channels, which may be called anything.

    Raises:
        RecordingError: One has not.
    """
    names = quantity_names(machine.tree)
    nodes = [] if machine.hydraulics is None else machine.hydraulics.nodes
    own = {f"{PRESSURE}{node.replace('.', '_')}" for node in nodes}  # much like those of cylinders
    for name in table.units:
        if name in own or unit_of(machine.tree, name) is not None:
            continue
        near = max(names, key=lambda x: _likeness(x, name))
        if _likeness(near, name) > _ALIKE:
            raise RecordingError(
                f"{columns}: '{name}' is no quantity of '{machine.name}', did you mean '{near}'? "
                "If it is a channel of its own, give it another name"
            )


def _likeness(one: str, two: str) -> float:
    """Of two names, 0 to 1, by those words in which they differ; other numbers are others."""
    if re.findall(r"\d", one) != re.findall(r"\d", two):
        return 0.0
    words, others = (name.lower().split("_") for name in (one, two))
    for end in (-1, 0):
        while words and others and words[end] == others[end]:
            del words[end], others[end]
    if not words and not others:
        return 1.0
    return SequenceMatcher(None, "_".join(words), "_".join(others)).ratio()


def _logged(
    path: Path, machine: Machine, sensors: Mapping[str, Sensor], arrays: Mapping[str, np.ndarray]
) -> Table:
    """The table of a log whose columns a machine's sensors name."""
    lines, without = [], []
    for quantity, sensor in sensors.items():
        unit = sensor.unit or unit_of(machine.tree, quantity) or ""
        heading = f"{quantity} [{unit}]" if unit else quantity
        line = logs.Line(f"{machine.path}: sensor '{quantity}'", heading, sensor.column)
        missing = logs.absent(sensor.column, arrays)
        if not missing:
            lines.append(line)
        elif quantity == TIME:
            raise RecordingError(f"{path}: the log has no '{missing[0]}', {known(arrays)}")
        else:
            without.append(f"'{quantity}' (no '{missing[0]}')")
    if without:
        text = f"{path}: the log does not have all of the machine's sensors: {', '.join(without)}"
        warnings.warn(text, CraneWarning, stacklevel=4)
    notes = {"machine": machine.call}
    return logs.assembled(path, machine.path, arrays, lines, notes)


def known_sensors(table: Table, machine: Machine | None = None) -> dict[str, Sensor]:
    """What is known of the sensors of a table by what they measure: notes count first.

    Raises:
        RecordingError: A note is none of a sensor.
    """
    if table.notes.get(SENSORS) == IDEAL:
        return {}
    found = {} if machine is None else dict(machine.sensors)
    try:
        return with_numbers(found, _noted(table))
    except InputError as error:
        raise RecordingError(f"the note {error}") from None


def _noted(table: Table) -> dict[str, float]:
    """Numbers of sensors in the notes."""
    numbers = {}
    for name, text in table.notes.items():
        if not name.startswith(SENSOR):
            continue
        try:
            quantity, _ = parsed(name)
            numbers[name] = float(text)
            if quantity not in table.units:
                raise RecordingError(
                    f"the note '{name}' is of no column, {known(table.units, quantity)}"
                )
        except InputError as error:
            raise RecordingError(f"the note {error}") from None
        except ValueError:
            raise RecordingError(f"the note '{name}' is '{text}', give a number") from None
    return numbers


def _tell_both(table: Table, machine: Machine) -> None:
    """Warn of numbers that the machine and a recording say differently."""
    here = named_numbers(machine.sensors)
    told = [
        f"{name} ({value:g}, not {here[name]:g})"
        for name, value in _noted(table).items()
        if name in here and here[name] not in (value, getattr(Sensor(), parsed(name)[1]))
    ]
    if told:
        text = f"notes of the recording count, not the machine's sensors: {', '.join(told)}"
        warnings.warn(text, CraneWarning, stacklevel=4)


def corrected(table: Table, sensors: Mapping[str, Sensor]) -> Table:
    """Readings as quantities, up to when the latest sensor tells them.

    Raises:
        RecordingError: No sample is that early.
    """
    used = {x: s for x, s in sensors.items() if x in table.units and not s.ideal}
    if not used:
        return table
    time = column(table, TIME)
    values = table.values.copy()
    for i, name in enumerate(table.units):
        if name in used:
            values[:, i] = used[name].quantity(name, time, table.values[:, i])
    late = max((s.delay for x, s in used.items() if not x.startswith(SIGNAL)), default=0.0)
    some = time <= time[-1] - late
    if not some.any():
        raise RecordingError(f"is shorter than a sensor is late, {late:g} s, record more")
    return Table(table.units, values[some], table.notes)


def within(table: Table, span: Span, path: str | Path) -> Table:
    """The samples from when to when [s].

    Raises:
        RecordingError: There are none.
        InputError: The span is none.
    """
    if not span[0] < span[1]:
        raise InputError(f"nothing lies from {span[0]:g} to {span[1]:g} s, give a later end")
    time = column(table, TIME)
    some = np.logical_and(time >= span[0] - 1e-9, time <= span[1] + 1e-9)
    if not some.any():
        raise RecordingError(
            f"{path}: no sample lies from {span[0]:g} to {span[1]:g} s, it is recorded from "
            f"{time[0]:g} to {time[-1]:g} s"
        )
    if some.all():
        return table
    first, last = np.flatnonzero(some)[[0, -1]]
    return Table(table.units, table.values[first : last + 1], table.notes)
