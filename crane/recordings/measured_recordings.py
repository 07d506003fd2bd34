"""Recordings of real cranes: angles instead of strokes, pressures instead of forces.

A file as in crane.recordings.timeseries, of which crane.recordings.recording wants the columns X
and X_force for every active joint X. Where they are missing, they are computed:

- X from the coordinates of other joints, by closing the machine's loops;
- X_velocity from those joints' velocities, v_A = gamma_A v_B with q_B the measured coordinates;
- X_force from pressure_X_a and pressure_X_b, which count from a vacuum, by equation (20) of the
  electro-hydraulic forwarder paper, F = area_a p_a - area_b p_b.

What is there is taken as it is. Everything else is a channel.
"""

import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from crane.common.errors import CraneWarning, RecordingError, prefix_location
from crane.common.samples import Array
from crane.description.sensors import PRESSURE_PREFIX
from crane.machine import Machine
from crane.recordings.inclination_angles import add_inclination_angles
from crane.recordings.measured_configurations import determining_joints, motion_from_joints
from crane.recordings.missing_measurements import MissingMeasurementError, MissingMeasurements
from crane.recordings.recording import (
    FORCE_SUFFIX,
    FORCE_UNITS,
    FREE_JOINTS_NOTE,
    IDEAL_SENSORS,
    SENSORS_NOTE,
    VELOCITY_SUFFIX,
    VELOCITY_UNITS,
    Recording,
    check_finite,
    free_force_message,
)
from crane.recordings.recording_reader import (
    FULL_TIME_SPAN,
    TimeSpan,
    known_sensors,
    read_quantities,
)
from crane.recordings.sensor_discrepancy import noise_std, warn_discrepancies
from crane.recordings.sensor_tolerances import HELD_JOINT_TOLERANCE, tolerance
from crane.recordings.stroke_check import check_strokes
from crane.recordings.timeseries import TIME, Table, table_column

_CHAMBER_PATTERN = re.compile("pressure_.+_[ab]")
_NOISE_FACTOR = 6.0  # standard deviations, beyond all of a million samples


def read_measured(
    machine: Machine,
    path: str | Path,
    columns: str | Path | None = None,
    span: TimeSpan = FULL_TIME_SPAN,
) -> Recording:
    """Read what was recorded of a machine: a full recording, or one that can be completed.

    Args:
        machine: What was recorded; joints that were held are locked in it, see `load`.
        path: A CSV or npz file.
        columns: Which columns of a log are which, if not as the machine's sensors say, see
            `crane.recordings.logs`.
        span: From when to when [s], by the file's own clock.

    Returns:
        All active joints, then other joints whose coordinate and force are recorded. A full
        recording keeps the order of its file.

    Raises:
        RecordingError: The file is malformed, does not tell all coordinates and forces, or tells
            what the machine cannot do.
    """
    return complete_recording(machine, read_quantities(path, machine, columns, span), path)


def complete_recording(
    machine: Machine,
    table: Table,
    path: str | Path,
    required_columns: Sequence[Sequence[str]] = (),
) -> Recording:
    """The same of a table of quantities that was read from a path.

    Args:
        machine: What was recorded.
        table: Its quantities.
        path: For errors.
        required_columns: Columns that have to be there besides, of each any one.

    Raises:
        RecordingError: As for `read_measured`.
    """
    try:
        table = _remove_free_forces(machine, table)
        # before anything is computed from them, to name the column as it is in the file
        check_finite(dict(zip(table.units, table.values.T, strict=True)))
        check_strokes(machine, table)
        complete_table = add_inclination_angles(machine, table)
        missing = MissingMeasurements(machine, table)
        missing.collect_missing_columns(required_columns)
        is_complete = all(x in table.units for x in machine.active)
        is_complete = is_complete and all(
            x + FORCE_SUFFIX in table.units for x in machine.driven_joints
        )
        if not is_complete:
            complete_table = _complete_table(machine, complete_table, missing)
        missing.raise_collected()
        warn_discrepancies(machine, table)  # of what was measured alone
    except RecordingError as error:
        raise RecordingError(prefix_location(str(path), error)) from None
    notes = complete_table.notes | (
        {SENSORS_NOTE: IDEAL_SENSORS} if known_sensors(table, machine) else {}
    )
    return Recording.from_table(Table(complete_table.units, complete_table.values, notes), path)


def _remove_free_forces(machine: Machine, table: Table) -> Table:
    """The table without the forces of free joints, which it names as such.

    Raises:
        RecordingError: One is not zero.
    """
    notes = {key: text for key, text in table.notes.items() if key != FREE_JOINTS_NOTE}
    if machine.free:
        notes[FREE_JOINTS_NOTE] = ", ".join(machine.free)
    kept_columns = []
    for i, name in enumerate(table.units):
        joint = name.removesuffix(FORCE_SUFFIX)
        if not name.endswith(FORCE_SUFFIX) or joint not in machine.free:
            kept_columns.append(i)
        elif table.values[:, i].any():
            raise RecordingError(free_force_message(joint, table.values[:, i]))
    units = {name: unit for i, (name, unit) in enumerate(table.units.items()) if i in kept_columns}
    return Table(units, table.values[:, kept_columns], notes)


def is_measured(table: Table) -> bool:
    """Whether a table has pressures without the force that they make, or no force at all."""
    forces = {x.removesuffix(FORCE_SUFFIX) for x in table.units if x.endswith(FORCE_SUFFIX)}
    chambers = {x[len(PRESSURE_PREFIX) : -2] for x in table.units if _CHAMBER_PATTERN.fullmatch(x)}
    return not forces or not chambers <= forces


def _complete_table(machine: Machine, table: Table, missing: MissingMeasurements) -> Table:
    """The table with coordinates, velocities and forces of all active joints."""
    check_pressures(machine, table)
    forces: list[Array] = []
    drives: tuple[str, ...] = ()
    with missing.collect_errors():
        drives = determining_joints(machine, list(table.units))
    for joint in machine.driven_joints:
        with missing.collect_errors():
            forces.append(_joint_force(machine, joint, table))
    missing.raise_collected()
    q, v = motion_from_joints(machine, drives, table)
    columns = {TIME: table_column(table, TIME)} | dict(zip(machine.active, q.T, strict=True))
    columns |= {x + VELOCITY_SUFFIX: v[:, i] for i, x in enumerate(machine.active)}
    columns |= {
        x + FORCE_SUFFIX: force for x, force in zip(machine.driven_joints, forces, strict=True)
    }
    joint_units = {x: machine.unit(x) for x in machine.active}
    units = {TIME: "s"} | joint_units
    units |= {x + VELOCITY_SUFFIX: VELOCITY_UNITS[kind] for x, kind in joint_units.items()}
    units |= {x + FORCE_SUFFIX: FORCE_UNITS[joint_units[x]] for x in machine.driven_joints}
    for name, unit in table.units.items():
        if name not in units:
            units[name], columns[name] = unit, table_column(table, name)
    notes = table.notes | {"machine": machine.load_expression}
    return Table(units, np.column_stack([columns[name] for name in units]), notes)


def check_pressures(machine: Machine, table: Table) -> None:
    """See that pressures are in units of pressure, per chamber, and count from a vacuum.

    A chamber that is sucked empty reads a little less with noise; a warning says so.
    """
    for name in table.units:
        joint = name.removeprefix(PRESSURE_PREFIX)
        if joint == name:
            continue
        if joint in machine.active:
            raise RecordingError(
                f"column '{name}' does not say in which chamber, give '{name}_a' and '{name}_b'"
            )
        pressure = table_column(table, name, "Pa")
        if not (is_negative := pressure < 0).any():
            continue
        lowest = float(pressure.min())
        if lowest < -_NOISE_FACTOR * noise_std(pressure):
            sample = int(np.argmax(is_negative))
            raise RecordingError(
                f"'{name}' is {pressure[sample]:g} Pa at sample {sample}, but pressures count "
                "from a vacuum: to gauge pressures add 1e5 Pa"
            )
        warnings.warn(
            f"'{name}' is below a vacuum in {is_negative.sum()} of {len(is_negative)} samples, "
            f"by up to "
            f"{-lowest:.3g} Pa, taken as noise; to gauge pressures add 1e5 Pa",
            CraneWarning,
            stacklevel=2,
        )


def locked_joint_conflicts(
    machine: Machine, columns: Mapping[str, Array], units: Mapping[str, str]
) -> list[str]:
    """What recorded columns (N,) say against locked joints, a text for each.

    The middle 99 % of the samples have to lie within a fiftieth of a radian or two millimetres (of
    a machine smaller than a metre, as many thousandths of its size) of where the joint is locked,
    but for eight standard deviations of their noise.
    """
    messages = []
    for joint, locked_position in machine.locked_joints.items():
        unit = units.get(joint, "")
        if joint not in columns or unit not in HELD_JOINT_TOLERANCE:
            continue
        x = columns[joint]
        noise = float(np.median(np.abs(np.diff(x)))) if len(x) > 1 else 0.0
        low, high = np.quantile(x, [0.005, 0.995])
        if (
            max(high - locked_position, locked_position - low)
            > tolerance(HELD_JOINT_TOLERANCE, machine, unit) + 8 * noise
        ):
            messages.append(
                f"'{joint}' is locked at {locked_position:.4g} {unit}, but goes from {low:.4g} to "
                f"{high:.4g} {unit} in the recording"
            )
    return messages


def _joint_force(machine: Machine, joint: str, table: Table) -> Array:
    """A joint's force (N,): as recorded, or by equation (20)."""
    unit = FORCE_UNITS[machine.unit(joint)]
    if joint + FORCE_SUFFIX in table.units:
        return table_column(table, joint + FORCE_SUFFIX, unit)
    a, b = (f"{PRESSURE_PREFIX}{joint}_{chamber}" for chamber in "ab")
    available = [name for name in (a, b) if name in table.units]
    cylinder = None if machine.hydraulics is None else machine.hydraulics.cylinders.get(joint)
    if cylinder is None and available:
        raise RecordingError(
            f"'{machine.name}' has no cylinder that makes '{available[0]}' a force, describe it "
            f"under 'hydraulics' in the machine file, or give '{joint}{FORCE_SUFFIX} [{unit}]'"
        )
    if cylinder is None or not available:
        pressures = "" if cylinder is None else f", or '{a} [Pa]' and '{b} [Pa]'"
        raise MissingMeasurementError(
            f"column '{joint}{FORCE_SUFFIX}' is missing, give it in [{unit}]{pressures}", [joint]
        )
    if len(available) < 2:
        missing = b if a in available else a
        raise RecordingError(
            f"column '{missing}' is missing beside '{available[0]}', give it, or "
            f"'{joint}{FORCE_SUFFIX} [{unit}]'"
        )
    return cylinder.area_a * table_column(table, a, "Pa") - cylinder.area_b * table_column(
        table, b, "Pa"
    )
