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

from crane.common.errors import (
    CraneWarning,
    InputError,
    RecordingError,
    prefix_location,
    suggest_names,
)
from crane.description.sensors import (
    PRESSURE_PREFIX,
    SENSOR_PREFIX,
    TIME,
    VALVE_SIGNAL_PREFIX,
    Sensor,
    parse_sensor_parameter,
    quantity_unit,
    sensor_parameters,
    with_sensor_parameters,
)
from crane.description.sensors import quantity_names as quantity_names
from crane.machine import Machine
from crane.recordings import logs, timeseries
from crane.recordings.recording import IDEAL_SENSORS, SENSORS_NOTE
from crane.recordings.timeseries import Table, table_column

_ALIKE = 0.7  # likeness of names, from which on one is meant

TimeSpan = tuple[float, float]
FULL_TIME_SPAN: TimeSpan = (-math.inf, math.inf)


def read_quantities(
    path: str | Path,
    machine: Machine | None = None,
    columns: str | Path | None = None,
    span: TimeSpan = FULL_TIME_SPAN,
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
    return quantities_from_readings(
        read_sensor_readings(path, machine, columns), path, machine, span
    )


def quantities_from_readings(
    table: Table, path: str | Path, machine: Machine | None, span: TimeSpan
) -> Table:
    """The same from readings of a path."""
    try:
        known = known_sensors(table, machine)
        if known and machine is not None:
            _warn_conflicting_notes(table, machine)
        table = correct_readings(table, known)
    except RecordingError as error:
        raise RecordingError(prefix_location(str(path), error)) from None
    return select_time_span(table, span, path)


def read_sensor_readings(
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
    log_sensors = {} if machine is None else {x: s for x, s in machine.sensors.items() if s.column}
    if machine is not None and log_sensors:
        arrays = timeseries.read_log_arrays(Path(path))
        if any(
            name in arrays
            for s in log_sensors.values()
            for name in logs.expression_names(s.column)
        ):
            return _read_machine_log(Path(path), machine, log_sensors, arrays)
    return timeseries.read_table(path)


def _check_names(machine: Machine, table: Table, columns: str | Path) -> None:
    """See that columns which almost have the name of a quantity of the machine have it.

    Others are channels, which may be called anything.

    Raises:
        RecordingError: One has not.
    """
    names = quantity_names(machine.tree)
    nodes = [] if machine.hydraulics is None else machine.hydraulics.node_names
    own = {
        f"{PRESSURE_PREFIX}{node.replace('.', '_')}" for node in nodes
    }  # much like those of cylinders
    for name in table.units:
        if name in own or quantity_unit(machine.tree, name) is not None:
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


def _read_machine_log(
    path: Path, machine: Machine, sensors: Mapping[str, Sensor], arrays: Mapping[str, np.ndarray]
) -> Table:
    """The table of a log whose columns a machine's sensors name."""
    lines, missing_sensors = [], []
    for quantity, sensor in sensors.items():
        unit = sensor.unit or quantity_unit(machine.tree, quantity) or ""
        heading = f"{quantity} [{unit}]" if unit else quantity
        line = logs.LogColumn(f"{machine.path}: sensor '{quantity}'", heading, sensor.column)
        missing = logs.missing_names(sensor.column, arrays)
        if not missing:
            lines.append(line)
        elif quantity == TIME:
            raise RecordingError(f"{path}: the log has no '{missing[0]}', {suggest_names(arrays)}")
        else:
            missing_sensors.append(f"'{quantity}' (no '{missing[0]}')")
    if missing_sensors:
        text = (
            f"{path}: the log does not have all of the machine's sensors: "
            f"{', '.join(missing_sensors)}"
        )
        warnings.warn(text, CraneWarning, stacklevel=4)
    notes = {"machine": machine.load_expression}
    return logs.assemble_table(path, machine.path, arrays, lines, notes)


def known_sensors(table: Table, machine: Machine | None = None) -> dict[str, Sensor]:
    """What is known of the sensors of a table by what they measure: notes count first.

    Raises:
        RecordingError: A note is none of a sensor.
    """
    if table.notes.get(SENSORS_NOTE) == IDEAL_SENSORS:
        return {}
    found = {} if machine is None else dict(machine.sensors)
    try:
        return with_sensor_parameters(found, _sensor_notes(table))
    except InputError as error:
        raise RecordingError(f"the note {error}") from None


def _sensor_notes(table: Table) -> dict[str, float]:
    """Numbers of sensors in the notes."""
    parameters = {}
    for name, text in table.notes.items():
        if not name.startswith(SENSOR_PREFIX):
            continue
        try:
            quantity, _ = parse_sensor_parameter(name)
            parameters[name] = float(text)
            if quantity not in table.units:
                raise RecordingError(
                    f"the note '{name}' is of no column, {suggest_names(table.units, quantity)}"
                )
        except InputError as error:
            raise RecordingError(f"the note {error}") from None
        except ValueError:
            raise RecordingError(f"the note '{name}' is '{text}', give a number") from None
    return parameters


def _warn_conflicting_notes(table: Table, machine: Machine) -> None:
    """Warn of numbers that the machine and a recording say differently."""
    machine_parameters = sensor_parameters(machine.sensors)
    messages = [
        f"{name} ({value:g}, not {machine_parameters[name]:g})"
        for name, value in _sensor_notes(table).items()
        if name in machine_parameters
        and machine_parameters[name]
        not in (value, getattr(Sensor(), parse_sensor_parameter(name)[1]))
    ]
    if messages:
        text = f"notes of the recording count, not the machine's sensors: {', '.join(messages)}"
        warnings.warn(text, CraneWarning, stacklevel=4)


def correct_readings(table: Table, sensors: Mapping[str, Sensor]) -> Table:
    """Readings as quantities, up to when the latest sensor tells them.

    Raises:
        RecordingError: No sample is that early.
    """
    used = {x: s for x, s in sensors.items() if x in table.units and not s.is_ideal}
    if not used:
        return table
    time = table_column(table, TIME)
    values = table.values.copy()
    for i, name in enumerate(table.units):
        if name in used:
            values[:, i] = used[name].correct_readings(name, time, table.values[:, i])
    max_delay = max(
        (s.delay for x, s in used.items() if not x.startswith(VALVE_SIGNAL_PREFIX)), default=0.0
    )
    is_available = time <= time[-1] - max_delay
    if not is_available.any():
        raise RecordingError(f"is shorter than a sensor is late, {max_delay:g} s, record more")
    return Table(table.units, values[is_available], table.notes)


def select_time_span(table: Table, span: TimeSpan, path: str | Path) -> Table:
    """The samples from when to when [s].

    Raises:
        RecordingError: There are none.
        InputError: The span is none.
    """
    if not span[0] < span[1]:
        raise InputError(f"nothing lies from {span[0]:g} to {span[1]:g} s, give a later end")
    time = table_column(table, TIME)
    is_inside = np.logical_and(time >= span[0] - 1e-9, time <= span[1] + 1e-9)
    if not is_inside.any():
        raise RecordingError(
            f"{path}: no sample lies from {span[0]:g} to {span[1]:g} s, it is recorded from "
            f"{time[0]:g} to {time[-1]:g} s"
        )
    if is_inside.all():
        return table
    first, last = np.flatnonzero(is_inside)[[0, -1]]
    return Table(table.units, table.values[first : last + 1], table.notes)
