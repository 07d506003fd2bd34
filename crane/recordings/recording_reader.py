"""Reading of recordings and logs: correction of sensor readings, and selection of a time span.

A recorded file contains readings of sensors. The sensor parameters of the machine and of the notes
of the file (`# sensor.q2.zero: 0.02`, which take precedence) convert them into quantities. Files
with the note `# sensors: ideal`, as a simulation writes it, contain quantities and are not
changed.
"""

import fnmatch
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
    check_name,
    suggest_names,
)
from crane.common.samples import as_number
from crane.common.unit_conversions import UnitError, parse_number
from crane.description.sensors import (
    PRESSURE_PREFIX,
    SENSOR_PREFIX,
    TIME,
    VALVE_SIGNAL_PREFIX,
    Sensor,
    parse_sensor_parameter,
    quantity_unit,
    quantity_units,
    sensor_parameters,
    with_sensor_parameters,
)
from crane.machine.machine import Machine
from crane.recordings import logs, table_reader
from crane.recordings.angle_unwrapping import unwrap_table
from crane.recordings.recording import (
    IDEAL_SENSORS,
    SENSORS_NOTE,
    Recording,
)
from crane.recordings.timeseries import Table, located_errors, table_column

_ALIKE = 0.7  # similarity from which a name counts as a misspelling

TimeSpan = tuple[float, float]
FULL_TIME_SPAN: TimeSpan = (-math.inf, math.inf)


def read_quantities(
    path: str | Path,
    machine: Machine | None = None,
    columns: str | Path | None = None,
    span: TimeSpan = FULL_TIME_SPAN,
) -> Table:
    """Read the quantities of a file in SI units.

    Args:
        path: A recording or a log of another program, CSV or npz.
        machine: The recorded machine, whose sensors give the columns of a log and the errors of
            readings.
        columns: Column file of a log, in place of the machine's sensors, see
            `crane.recordings.logs`.
        span: Start and end [s] by the clock of the file.

    Raises:
        RecordingError: A file is missing or malformed, or has no samples in the span.
        InputError: The span is empty.
    """
    return quantities_from_readings(
        read_sensor_readings(path, machine, columns), path, machine, span
    )


def quantities_from_readings(
    table: Table, path: str | Path, machine: Machine | None, span: TimeSpan
) -> Table:
    """Correct readings of a file, and select a time span."""
    with located_errors(path):
        known = known_sensors(table, machine)
        if known and machine is not None:
            _warn_conflicting_notes(table, machine)
        table = correct_readings(table, known)
    return select_time_span(table, span, path)


def read_sensor_readings(
    path: str | Path, machine: Machine | None = None, columns: str | Path | None = None
) -> Table:
    """Read all sensor readings of a file, without correction of other than whole revolutions.

    Raises:
        RecordingError: A file is missing or malformed, or misspells a quantity of the machine.
    """
    table = _read_table(path, machine, columns)
    return table if machine is None else unwrap_table(machine, table)


def _read_table(path: str | Path, machine: Machine | None, columns: str | Path | None) -> Table:
    if columns is not None:
        table = logs.read_log(path, columns)
        if machine is not None:
            _check_names(machine, table, columns)
        return table
    log_sensors = {} if machine is None else {x: s for x, s in machine.sensors.items() if s.column}
    if machine is not None and log_sensors:
        wanted = [x for s in log_sensors.values() for x in logs.expression_names(s.column)]
        arrays = table_reader.read_log_arrays(Path(path), wanted)
        if any(name in arrays for name in wanted):
            return _read_machine_log(Path(path), machine, log_sensors, arrays)
    return table_reader.read_table(path)


def _check_names(machine: Machine, table: Table, columns: str | Path) -> None:
    names = quantity_units(machine.tree)
    nodes = [] if machine.hydraulics is None else machine.hydraulics.node_names
    # similar to the names of cylinder pressures
    own = {f"{PRESSURE_PREFIX}{node.replace('.', '_')}" for node in nodes}
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
    """Similarity of two names, 0 to 1, by the words that differ; 0 if digits differ."""
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
    lines, missing_sensors = [], []
    for quantity, sensor in sensors.items():
        unit = sensor.unit or quantity_unit(machine.tree, quantity) or ""
        heading = f"{quantity} [{unit}]" if unit else quantity
        line = logs.LogColumn(f"{machine.path}: sensor '{quantity}'", heading, sensor.column)
        missing = logs.missing_names(sensor.column, arrays)
        if missing and quantity == TIME:
            raise RecordingError(f"{path}: the log has no '{missing[0]}', {suggest_names(arrays)}")
        if not missing:
            lines.append(line)
        else:
            missing_sensors.append(f"'{quantity}' (no '{missing[0]}')")
    if missing_sensors:
        warnings.warn(
            f"{path}: the log does not have all of the machine's sensors: "
            f"{', '.join(missing_sensors)}",
            CraneWarning,
            stacklevel=4,
        )
    return logs.assemble_table(
        path, machine.path, arrays, lines, {"machine": machine.load_expression}
    )


def known_sensors(table: Table, machine: Machine | None = None) -> dict[str, Sensor]:
    """Known sensors of a table by quantity; notes take precedence over the machine.

    Raises:
        RecordingError: A note is no valid sensor parameter.
    """
    if table.notes.get(SENSORS_NOTE) == IDEAL_SENSORS:
        return {}
    found = {} if machine is None else dict(machine.sensors)
    try:
        return with_sensor_parameters(found, _sensor_notes(table))
    except InputError as error:
        raise RecordingError(f"the note {error}") from None


def _sensor_notes(table: Table) -> dict[str, float]:
    parameters = {}
    for name, text in table.notes.items():
        if not name.startswith(SENSOR_PREFIX):
            continue
        try:
            quantity, parameter = parse_sensor_parameter(name)
            problem = f"the note '{name}' is of no column"
            check_name(quantity, table.units, problem, RecordingError)
            unit = {"scale": "", "delay": "s"}.get(parameter, table.units[quantity])
            parameters[name] = parse_number(text, (unit,))
        except UnitError as error:
            raise RecordingError(f"the note '{name}' is '{text}', {error}") from None
        except InputError as error:
            raise RecordingError(f"the note {error}") from None
        except ValueError:
            raise RecordingError(f"the note '{name}' is '{text}', give a number") from None
    return parameters


def _warn_conflicting_notes(table: Table, machine: Machine) -> None:
    machine_parameters = sensor_parameters(machine.sensors)
    messages = [
        f"{name} ({value:g}, not {machine_parameters[name]:g})"
        for name, value in _sensor_notes(table).items()
        if name in machine_parameters
        and machine_parameters[name]
        not in (value, getattr(Sensor(), parse_sensor_parameter(name)[1]))
    ]
    if messages:
        warnings.warn(
            f"notes of the recording count, not the machine's sensors: {', '.join(messages)}",
            CraneWarning,
            stacklevel=4,
        )


def correct_readings(table: Table, sensors: Mapping[str, Sensor]) -> Table:
    """Convert readings into quantities, up to the last time that the most delayed sensor covers.

    Raises:
        RecordingError: No sample is left.
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
        raise RecordingError(
            f"is shorter than the delay of a sensor, {max_delay:g} s, record more"
        )
    return Table(table.units, values[is_available], table.notes)


def select_time_span(table: Table, span: TimeSpan, path: str | Path) -> Table:
    """Select the samples of a time span [s].

    Raises:
        RecordingError: There are none.
        InputError: The span is empty.
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


def shift_columns(recording: Recording, delays: Mapping[str, float]) -> Recording:
    """Take delays d out of columns y: x(t) = y(t + d), linear between samples.

    Args:
        recording: The recording.
        delays: Delays [s] by column or pattern, such as `{"*_force": 0.03}`; negative for columns
            that are ahead of the others. A rate or force that was computed from another column
            is shifted by its own name.

    Returns:
        The recording over the time that all columns cover.

    Raises:
        RecordingError: A pattern matches no column, or no time is left.
    """
    names = [name for name in recording if name != TIME]
    columns, time, shifts = recording.columns(), recording.time, dict.fromkeys(names, 0.0)
    for pattern, delay in delays.items():
        matches = fnmatch.filter(names, pattern)
        if not matches:
            raise RecordingError(
                f"no column to shift is named '{pattern}', {suggest_names(names, pattern)}"
            )
        shifts |= dict.fromkeys(matches, as_number(delay, f"the shift of '{pattern}'", "s"))
    for name, delay in shifts.items():
        if delay:
            columns[name] = np.interp(time + delay, time, columns[name])
    first, last = time[0] - min(shifts.values()), time[-1] - max(shifts.values())
    is_covered = (time >= max(first, time[0])) & (time <= min(last, time[-1]))
    if not is_covered.any():
        raise RecordingError("nothing is left of a recording that is shorter than its shift")
    return recording.with_columns({name: x[is_covered] for name, x in columns.items()})
