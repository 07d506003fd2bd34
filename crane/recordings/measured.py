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

from crane.common.errors import CraneWarning, RecordingError, at
from crane.common.samples import Array
from crane.description.sensors import PRESSURE
from crane.machine import Machine
from crane.recordings.disagreement import noise_of, tell_disagreement
from crane.recordings.inclined import with_angles
from crane.recordings.missing import Missing, MissingError
from crane.recordings.postures import drives_of, motion_by
from crane.recordings.reading import ALWAYS, Span, known_sensors, read
from crane.recordings.recording import (
    FORCE,
    FORCE_UNITS,
    FREE,
    IDEAL,
    SENSORS,
    VELOCITY,
    VELOCITY_UNITS,
    Recording,
    check_finite,
    driven_all_the_same,
)
from crane.recordings.strokes import check_strokes
from crane.recordings.timeseries import TIME, Table, column
from crane.recordings.tolerances import HELD, allowed

_CHAMBER = re.compile("pressure_.+_[ab]")
_NOISES = 6.0  # standard deviations, beyond all of a million samples


def read_measured(
    machine: Machine,
    path: str | Path,
    columns: str | Path | None = None,
    span: Span = ALWAYS,
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
    return completed(machine, read(path, machine, columns, span), path)


def completed(
    machine: Machine, table: Table, path: str | Path, needs: Sequence[Sequence[str]] = ()
) -> Recording:
    """The same of a table of quantities that was read from a path.

    Args:
        machine: What was recorded.
        table: Its quantities.
        path: For errors.
        needs: Columns that have to be there besides, of each any one.

    Raises:
        RecordingError: As for `read_measured`.
    """
    try:
        table = _without_free_forces(machine, table)
        # before anything is computed from them, to name the column as it is in the file
        check_finite(dict(zip(table.units, table.values.T, strict=True)))
        check_strokes(machine, table)
        told = with_angles(machine, table)
        missing = Missing(machine, table)
        missing.note_absent(needs)
        full = all(x in table.units for x in machine.active)
        full = full and all(x + FORCE in table.units for x in machine.driven_joints)
        if not full:
            told = _completed(machine, told, missing)
        missing.refuse()
        tell_disagreement(machine, table)  # of what was measured alone
    except RecordingError as error:
        raise RecordingError(at(str(path), error)) from None
    notes = told.notes | ({SENSORS: IDEAL} if known_sensors(table, machine) else {})
    return Recording.from_table(Table(told.units, told.values, notes), path)


def _without_free_forces(machine: Machine, table: Table) -> Table:
    """The table without the forces of free joints, which it names as such.

    Raises:
        RecordingError: One is not zero.
    """
    notes = {key: text for key, text in table.notes.items() if key != FREE}
    if machine.free:
        notes[FREE] = ", ".join(machine.free)
    kept = []
    for i, name in enumerate(table.units):
        joint = name.removesuffix(FORCE)
        if not name.endswith(FORCE) or joint not in machine.free:
            kept.append(i)
        elif table.values[:, i].any():
            raise RecordingError(driven_all_the_same(joint, table.values[:, i]))
    units = {name: unit for i, (name, unit) in enumerate(table.units.items()) if i in kept}
    return Table(units, table.values[:, kept], notes)


def is_measured(table: Table) -> bool:
    """Whether a table has pressures without the force that they make, or no force at all."""
    forces = {x.removesuffix(FORCE) for x in table.units if x.endswith(FORCE)}
    chambers = {x[len(PRESSURE) : -2] for x in table.units if _CHAMBER.fullmatch(x)}
    return not forces or not chambers <= forces


def _completed(machine: Machine, table: Table, missing: Missing) -> Table:
    """The table with coordinates, velocities and forces of all active joints."""
    check_pressures(machine, table)
    forces: list[Array] = []
    drives: tuple[str, ...] = ()
    with missing.noted():
        drives = drives_of(machine, list(table.units))
    for joint in machine.driven_joints:
        with missing.noted():
            forces.append(_force(machine, joint, table))
    missing.refuse()
    q, v = motion_by(machine, drives, table)
    columns = {TIME: column(table, TIME)} | dict(zip(machine.active, q.T, strict=True))
    columns |= {x + VELOCITY: v[:, i] for i, x in enumerate(machine.active)}
    columns |= {x + FORCE: force for x, force in zip(machine.driven_joints, forces, strict=True)}
    kinds = {x: machine.unit(x) for x in machine.active}
    units = {TIME: "s"} | kinds
    units |= {x + VELOCITY: VELOCITY_UNITS[kind] for x, kind in kinds.items()}
    units |= {x + FORCE: FORCE_UNITS[kinds[x]] for x in machine.driven_joints}
    for name, unit in table.units.items():
        if name not in units:
            units[name], columns[name] = unit, column(table, name)
    notes = table.notes | {"machine": machine.call}
    return Table(units, np.column_stack([columns[name] for name in units]), notes)


def check_pressures(machine: Machine, table: Table) -> None:
    """See that pressures are in units of pressure, per chamber, and count from a vacuum.

    A chamber that is sucked empty reads a little less with noise; a warning says so.
    """
    for name in table.units:
        joint = name.removeprefix(PRESSURE)
        if joint == name:
            continue
        if joint in machine.active:
            raise RecordingError(
                f"column '{name}' does not say in which chamber, give '{name}_a' and '{name}_b'"
            )
        pressure = column(table, name, "Pa")
        if not (below := pressure < 0).any():
            continue
        lowest = float(pressure.min())
        if lowest < -_NOISES * noise_of(pressure):
            sample = int(np.argmax(below))
            raise RecordingError(
                f"'{name}' is {pressure[sample]:g} Pa at sample {sample}, but pressures count "
                "from a vacuum: to gauge pressures add 1e5 Pa"
            )
        warnings.warn(
            f"'{name}' is below a vacuum in {below.sum()} of {len(below)} samples, by up to "
            f"{-lowest:.3g} Pa, taken as noise; to gauge pressures add 1e5 Pa",
            CraneWarning,
            stacklevel=2,
        )


def moved_locks(
    machine: Machine, columns: Mapping[str, Array], units: Mapping[str, str]
) -> list[str]:
    """What recorded columns (N,) say against locked joints, a text for each.

    The middle 99 % of the samples have to lie within a fiftieth of a radian or two millimetres (of
    a machine smaller than a metre, as many thousandths of its size) of where the joint is locked,
    but for eight standard deviations of their noise.
    """
    told = []
    for joint, place in machine.locks.items():
        unit = units.get(joint, "")
        if joint not in columns or unit not in HELD:
            continue
        x = columns[joint]
        noise = float(np.median(np.abs(np.diff(x)))) if len(x) > 1 else 0.0
        low, high = np.quantile(x, [0.005, 0.995])
        if max(high - place, place - low) > allowed(HELD, machine, unit) + 8 * noise:
            told.append(
                f"'{joint}' is locked at {place:.4g} {unit}, but goes from {low:.4g} to "
                f"{high:.4g} {unit} in the recording"
            )
    return told


def _force(machine: Machine, joint: str, table: Table) -> Array:
    """A joint's force (N,): as recorded, or by equation (20)."""
    unit = FORCE_UNITS[machine.unit(joint)]
    if joint + FORCE in table.units:
        return column(table, joint + FORCE, unit)
    a, b = (f"{PRESSURE}{joint}_{chamber}" for chamber in "ab")
    there = [name for name in (a, b) if name in table.units]
    cylinder = None if machine.hydraulics is None else machine.hydraulics.cylinders.get(joint)
    if cylinder is None and there:
        raise RecordingError(
            f"'{machine.name}' has no cylinder that makes '{there[0]}' a force, describe it "
            f"under 'hydraulics' in the machine file, or give '{joint}{FORCE} [{unit}]'"
        )
    if cylinder is None or not there:
        pressures = "" if cylinder is None else f", or '{a} [Pa]' and '{b} [Pa]'"
        raise MissingError(
            f"column '{joint}{FORCE}' is missing, give it in [{unit}]{pressures}", [joint]
        )
    if len(there) < 2:
        missing = b if a in there else a
        raise RecordingError(
            f"column '{missing}' is missing beside '{there[0]}', give it, or "
            f"'{joint}{FORCE} [{unit}]'"
        )
    return cylinder.area_a * column(table, a, "Pa") - cylinder.area_b * column(table, b, "Pa")
