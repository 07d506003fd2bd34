"""Recordings from files and folders of runs, completed from angles and pressures.

A recording (crane.recordings.recording) has the columns X and X_force for every active joint X.
Missing ones are computed:

- X from the coordinates of other joints, by closing the loops;
- X_velocity from the velocities of these joints, v_A = gamma_A v_B with the measured joints q_B;
- X_force from the absolute pressures pressure_X_a and pressure_X_b by equation (20) of the
  electro-hydraulic forwarder paper, F = area_a p_a - area_b p_b.

Recorded columns are not changed. All other columns are channels.
"""

import itertools
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin

from crane.common.errors import CraneWarning, DescriptionError, InputError, RecordingError
from crane.common.samples import Array
from crane.common.scratch_arrays import stack_columns
from crane.description.machine_lookup import find_machine_file, without_changes
from crane.description.sensors import PRESSURE_PREFIX, SENSOR_PREFIX, Sensor
from crane.formats.machine_loading import load_from_expression
from crane.machine.machine import Machine
from crane.recordings.angle_unwrapping import unwrap_table
from crane.recordings.measured_configurations import (
    HELD_JOINT_TOLERANCE,
    MissingMeasurementError,
    MissingMeasurements,
    add_inclination_angles,
    determining_joints,
    motion_from_joints,
    tolerance,
)
from crane.recordings.recording import (
    CHANGES_NOTE,
    FORCE_SUFFIX,
    FORCE_UNITS,
    FREE_JOINTS_NOTE,
    IDEAL_SENSORS,
    SENSORS_NOTE,
    VELOCITY_SUFFIX,
    VELOCITY_UNITS,
    Recording,
)
from crane.recordings.recording_reader import (
    FULL_TIME_SPAN,
    TimeSpan,
    known_sensors,
    quantities_from_readings,
    read_quantities,
    read_sensor_readings,
)
from crane.recordings.sensor_discrepancy import noise_std, warn_discrepancies
from crane.recordings.timeseries import (
    TIME,
    Table,
    check_columns_present,
    check_finite,
    free_force_message,
    located_errors,
    table_column,
)

RECORDING, RECORDING_NPZ = "recording.csv", "recording.npz"
_CHAMBER_PATTERN = re.compile("pressure_.+_[ab]")
_NOISE_FACTOR = 6.0  # standard deviations, more than the extreme of a million samples
_STROKE_TOLERANCE = 0.02  # of a stroke, for errors of sensors
_MAX_AXIS_DEVIATION = 0.01  # distance of the pins from the axis, per length of a cylinder


def read_measured(
    machine: Machine,
    path: str | Path,
    columns: str | Path | None = None,
    span: TimeSpan = FULL_TIME_SPAN,
) -> Recording:
    """Read a recording of a machine, and complete it from other measurements.

    Args:
        machine: The recorded machine, with joints locked that were held, see `load`.
        path: A CSV or npz file.
        columns: Column file of a log, see `crane.recordings.logs`; default by the sensors of the
            machine.
        span: Start and end [s] by the clock of the file.

    Returns:
        Recording of all active joints, then of other joints with recorded coordinate and force.
        The joints of a complete recording are in the order of the file.

    Raises:
        RecordingError: The file is malformed, does not determine all coordinates and forces, or
            the machine cannot move so.
    """
    return complete_recording(machine, read_quantities(path, machine, columns, span), path)


def read_run(
    path: str | Path,
    machine: Machine | None = None,
    columns: str | Path | None = None,
    span: TimeSpan = FULL_TIME_SPAN,
    required_columns: Sequence[Sequence[str]] = (),
) -> Recording:
    """Read the recording of a run's folder, a CSV or npz file, or a log of another program.

    Args:
        path: Folder or file.
        machine: The recorded machine. Coordinates and forces that the file does not have are
            computed with it, see the module's documentation. By default this is done
            with the machine that the file names, if it has pressures or angles instead of forces.
        columns: File that assigns the columns of a log, see `crane.recordings.logs`.
        span: Start and end [s] of the part to read, in recorded time.
        required_columns: Further columns that the file has to have, any one of each group, if a
            machine is given.

    Returns:
        The recording.

    Raises:
        RecordingError: There is no recording, it is malformed, or it does not determine all
            coordinates and forces.
        DescriptionError: The machine that the file names is not found.
    """
    path = recording_file(path)
    if machine is not None:
        table = read_quantities(path, machine, columns, span)
        return complete_recording(machine, table, path, required_columns)
    table = read_sensor_readings(path, columns=columns)
    name = table.notes.get("machine", "")
    if name and is_measured(table):
        machine = recorded_machine(path, name)
        table = quantities_from_readings(unwrap_table(machine, table), path, machine, span)
        return complete_recording(machine, table, path)
    return Recording.from_table(quantities_from_readings(table, path, None, span), path)


def recording_file(path: str | Path) -> Path:
    """The file of a recording: the path itself, or the file in the folder of a run.

    Raises:
        RecordingError: The folder has none.
    """
    path = Path(path)
    if not path.is_dir():
        return path
    for file in (path / RECORDING, path / RECORDING_NPZ):
        if file.is_file():
            return file
    raise RecordingError(f"{path}: no {RECORDING} in this folder, give a run's folder")


def recorded_machine(path: str | Path, name: str) -> Machine:
    """Load the machine that a recording names.

    Args:
        path: The recording, for errors.
        name: The machine in the recording, see `Recording.machine`.

    Raises:
        InputError: The name is empty.
        DescriptionError: The machine is not found, or cannot be read.
    """
    if not name:
        raise InputError(
            f"{path}: does not name its machine, add --machine, or write '# machine: NAME' above "
            "its header row"
        )
    try:
        find_machine_file(without_changes(name))
    except DescriptionError as error:
        raise DescriptionError(
            f"{path}: its machine is not found ({error}); add --machine to say where it is"
        ) from None
    return load_from_expression(name)


def complete_recording(
    machine: Machine,
    table: Table,
    path: str | Path,
    required_columns: Sequence[Sequence[str]] = (),
) -> Recording:
    """Complete a recording from a table of quantities.

    Args:
        machine: The recorded machine.
        table: Table of quantities.
        path: File, for messages.
        required_columns: Further required columns, as alternatives each.

    Raises:
        RecordingError: As for `read_measured`.
    """
    if changes := table.notes.get(CHANGES_NOTE):
        warnings.warn(
            f"{path}: parameters of the machine change during the recording ({changes}), which "
            "fits and power balances do not follow: choose a part by --from and --until, and its "
            "parameters by --set",
            CraneWarning,
            stacklevel=2,
        )
    with located_errors(path):
        table = _remove_free_forces(machine, table)
        # before computations, so that the message names a column of the file
        check_finite(dict(zip(table.units, table.values.T, strict=True)))
        check_strokes(machine, table)
        complete_table = add_inclination_angles(machine, table)
        missing = MissingMeasurements(machine, table)
        with missing.collect_errors():
            check_columns_present(required_columns, table.units)
        forces = [x + FORCE_SUFFIX for x in machine.driven_joints]
        if not all(x in table.units for x in (*machine.active, *forces)):
            complete_table = _complete_table(machine, complete_table, missing)
        missing.raise_collected()
        warn_discrepancies(machine, table)  # of measured columns only
    notes = complete_table.notes | (
        {SENSORS_NOTE: IDEAL_SENSORS} if known_sensors(table, machine) else {}
    )
    return Recording.from_table(Table(complete_table.units, complete_table.values, notes), path)


def _remove_free_forces(machine: Machine, table: Table) -> Table:
    """Remove the zero forces of free joints from a table, and note these joints.

    Raises:
        RecordingError: A force is not zero.
    """
    notes = {key: text for key, text in table.notes.items() if key != FREE_JOINTS_NOTE}
    if machine.free:
        notes[FREE_JOINTS_NOTE] = ", ".join(machine.free)
    forces = {joint + FORCE_SUFFIX: joint for joint in machine.free}
    free_columns = {i: forces[name] for i, name in enumerate(table.units) if name in forces}
    for i, joint in free_columns.items():
        if table.values[:, i].any():
            raise RecordingError(free_force_message(joint, table.values[:, i]))
    kept_columns = [i for i in range(len(table.units)) if i not in free_columns]
    units = {name: unit for i, (name, unit) in enumerate(table.units.items()) if i in kept_columns}
    columns = (table.values[:, i] for i in kept_columns)
    return Table(
        units, stack_columns(columns, len(units)) if free_columns else table.values, notes
    )


def is_measured(table: Table) -> bool:
    """Whether a table has pressures without the corresponding force, or no forces."""
    forces = {x.removesuffix(FORCE_SUFFIX) for x in table.units if x.endswith(FORCE_SUFFIX)}
    chambers = {x[len(PRESSURE_PREFIX) : -2] for x in table.units if _CHAMBER_PATTERN.fullmatch(x)}
    return not forces or not chambers <= forces


def _complete_table(machine: Machine, table: Table, missing: MissingMeasurements) -> Table:
    """Complete a table with coordinates, velocities and forces of all active joints."""
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
    joint_units = {x: machine.unit(x) for x in machine.active}
    units = {TIME: "s"} | joint_units
    units |= {x + VELOCITY_SUFFIX: VELOCITY_UNITS[kind] for x, kind in joint_units.items()}
    units |= {x + FORCE_SUFFIX: FORCE_UNITS[joint_units[x]] for x in machine.driven_joints}
    others = {name: unit for name, unit in table.units.items() if name not in units}
    columns = [table_column(table, TIME), *q.T, *v.T, *forces]
    columns += [table_column(table, name) for name in others]
    notes = table.notes | {"machine": machine.load_expression}
    return Table(units | others, np.column_stack(columns), notes)


def check_pressures(machine: Machine, table: Table) -> None:
    """Check that pressures are given per chamber, in units of pressure, as absolute pressures.

    Values slightly below zero by noise cause a warning.
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
            f"by up to {-lowest:.3g} Pa, taken as noise; to gauge pressures add 1e5 Pa",
            CraneWarning,
            stacklevel=2,
        )


def locked_joint_conflicts(
    machine: Machine, columns: Mapping[str, Array], units: Mapping[str, str]
) -> list[str]:
    """Messages about recorded columns (N,) that contradict locked joints.

    The middle 99 % of the samples must be within 0.02 rad or 2 mm (2e-3 of the characteristic
    length for machines below 1 m), plus eight standard deviations of noise, of the locked
    coordinate.
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
    """Force (N,) of a joint: recorded, or by equation (20)."""
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


def check_strokes(machine: Machine, table: Table) -> None:
    """Reject pin-to-pin lengths of cylinders that are given as strokes.

    Raises:
        RecordingError: There are some; the message gives the dead lengths.
    """
    known = known_sensors(table, machine)
    messages = []
    for joint, lower, upper in zip(machine.active, machine.lower, machine.upper, strict=True):
        if table.units.get(joint) != "m" or not np.isfinite([lower, upper]).all():
            continue
        low, high = np.quantile(table_column(table, joint), [0.005, 0.995])
        slack = _STROKE_TOLERANCE * (upper - lower)
        if low >= lower - slack and high <= upper + slack:
            continue
        pin_offset = dead_length(machine, joint)
        if (
            pin_offset is not None
            and low - pin_offset >= lower - slack
            and high - pin_offset <= upper + slack
        ):
            was = known.get(joint, Sensor())
            messages.append(
                f"'{joint}' goes from {low:.4g} to {high:.4g} m, its stroke from {lower:.4g} to "
                f"{upper:.4g} m: from pin to pin it is {pin_offset:.4g} m longer, subtract that "
                f"({SENSOR_PREFIX}{joint}.zero = {was.zero + was.scale * pin_offset:.6g})"
            )
    if messages:
        raise RecordingError("; ".join(messages))


def dead_length(machine: Machine, joint: str) -> float | None:
    """Dead length of a cylinder: pin-to-pin length minus stroke [m]; None for other slides.

    A pin of a body is a revolute joint on either side of it, or the end of a loop; the two pins
    whose connecting line is closest to the axis of the slide are used.
    """
    slide = machine.tree.joints[joint]
    model = machine.model
    data = model.createData()
    pin.framesForwardKinematics(model, data, machine.coordinates.configuration(machine.home))
    axis = data.oMf[machine.frame(slide.child)].rotation @ np.array(slide.axis)
    bodies = machine.tree.bodies_by_link()
    smallest_deviation, length = _MAX_AXIS_DEVIATION, None
    pins = (_pin_positions(machine, data, bodies[x], joint) for x in (slide.parent, slide.child))
    for one, two in itertools.product(*pins):
        along = float(axis @ (two - one))
        axis_distance = float(np.linalg.norm(two - one - along * axis))
        if axis_distance < smallest_deviation * along:
            smallest_deviation, length = axis_distance / along, along
    return None if length is None else length - float(machine.home[machine.column(joint)])


def _pin_positions(machine: Machine, data: pin.Data, body: str, slide: str) -> list[Array]:
    """Positions (3,) of the pins of a body, without its slide."""
    tree, bodies = machine.tree, machine.tree.bodies_by_link()
    frames = [
        joint.child
        for joint in tree.moving_joints
        if joint.name != slide
        and joint.kind == "revolute"
        and body in (joint.child, bodies[joint.parent])
    ]
    for loop in machine.closure.equations.loops:
        frames += [end for end in (loop.predecessor, loop.successor) if bodies[end] == body]
    return [data.oMf[machine.frame(frame)].translation.copy() for frame in frames]
