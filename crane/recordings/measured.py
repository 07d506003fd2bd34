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

from crane.closure import Closure
from crane.common.errors import ClosureError, CraneWarning, MechanismError, RecordingError, at
from crane.common.samples import Array
from crane.machine import Machine
from crane.recordings import timeseries
from crane.recordings.recording import (
    FORCE,
    FORCE_UNITS,
    VELOCITY,
    VELOCITY_UNITS,
    Recording,
    check_finite,
    derivative,
)
from crane.recordings.timeseries import TIME, Table, check_unit, spellings

_PRESSURE, _CHAMBER = "pressure_", re.compile("pressure_.+_[ab]")
_TELLS = 1e-6  # least share of a joint's motion that others do not tell
_SAME = 1e-6  # [rad], [machine's size]
# by which a joint that is held may be off, and the root mean square by which sensors of one joint
# may differ [rad], [m]; in a machine of less than a metre shares of its size
_HELD = {"rad": 0.02, "m": 2e-3}
_AGREE = {"rad": 5e-3, "m": 5e-4}
_COMPARED = 2000  # samples at which they are compared
_AT_ONCE = 1 << 16  # samples whose postures are held
_SAMPLE = re.compile(r"\(sample (\d+)\)")  # of an error of the closure
_SLACK = 0.1  # of a range, by which sensors may be off


def read_measured(machine: Machine, path: str | Path) -> Recording:
    """Read what was recorded of a machine: a full recording, or one that can be completed.

    Args:
        machine: What was recorded; joints that were held are locked in it, see `load`.
        path: A CSV or npz file.

    Returns:
        All active joints, then other joints whose coordinate and force are recorded. A full
        recording keeps the order of its file.

    Raises:
        RecordingError: The file is malformed, does not tell all coordinates and forces, or tells
            what the machine cannot do.
    """
    return completed(machine, timeseries.read(path), path)


def completed(machine: Machine, table: Table, path: str | Path) -> Recording:
    """The same of a table that was read from a path.

    Raises:
        RecordingError: As for `read_measured`.
    """
    full = all(x in table.units and x + FORCE in table.units for x in machine.active)
    try:
        if not full:
            table = _completed(machine, table)
        tell_disagreement(machine, table)
    except RecordingError as error:
        raise RecordingError(at(str(path), error)) from None
    return Recording.from_table(table, path)


def is_measured(table: Table) -> bool:
    """Whether a table has pressures without the force that they make, or no force at all."""
    forces = {x.removesuffix(FORCE) for x in table.units if x.endswith(FORCE)}
    chambers = {x[len(_PRESSURE) : -2] for x in table.units if _CHAMBER.fullmatch(x)}
    return not forces or not chambers <= forces


def _completed(machine: Machine, table: Table) -> Table:
    """The table with coordinates, velocities and forces of all active joints."""
    # before anything is computed from them, to name the column as it is in the file
    check_finite(dict(zip(table.units, table.values.T, strict=True)))
    check_pressures(machine, table)
    forces, missing = [], []
    for joint in machine.active:
        try:
            forces.append(_force(machine, joint, table))
        except RecordingError as error:
            missing.append(str(error))
    try:
        drives = _drives(machine, list(table.units))
    except RecordingError as error:
        missing.insert(0, str(error))
    if missing:
        raise RecordingError("; ".join(missing))
    q, v = _motion(machine, drives, table)
    columns = {TIME: column(table, TIME)} | dict(zip(machine.active, q.T, strict=True))
    columns |= {x + VELOCITY: v[:, i] for i, x in enumerate(machine.active)}
    columns |= {x + FORCE: force for x, force in zip(machine.active, forces, strict=True)}
    kinds = {x: machine.unit(x) for x in machine.active}
    units = {TIME: "s"} | kinds
    units |= {x + VELOCITY: VELOCITY_UNITS[kind] for x, kind in kinds.items()}
    units |= {x + FORCE: FORCE_UNITS[kind] for x, kind in kinds.items()}
    for name, unit in table.units.items():
        if name not in units:
            units[name], columns[name] = unit, column(table, name)
    notes = table.notes | {"machine": machine.call}
    return Table(units, np.column_stack([columns[name] for name in units]), notes)


def column(table: Table, name: str, unit: str | None = None) -> Array:
    """A column (N,), in a unit.

    Raises:
        RecordingError: It is in another one.
    """
    if unit is not None:
        check_unit(name, table.units[name], spellings(unit))
    return table.values[:, list(table.units).index(name)]


def check_pressures(machine: Machine, table: Table) -> None:
    """See that pressures are in units of pressure, per chamber, and count from a vacuum."""
    for name in table.units:
        joint = name.removeprefix(_PRESSURE)
        if joint == name:
            continue
        if joint in machine.active:
            raise RecordingError(
                f"column '{name}' does not say in which chamber, give '{name}_a' and '{name}_b'"
            )
        pressure = column(table, name, "Pa")
        if (pressure < 0).any():
            sample = int(np.argmax(pressure < 0))
            raise RecordingError(
                f"'{name}' is {pressure[sample]:g} Pa at sample {sample}, but pressures count "
                "from a vacuum: to gauge pressures add 1e5 Pa"
            )


def _most(allowed: Mapping[str, float], machine: Machine, unit: str) -> float:
    return allowed[unit] * (min(machine.closure.size, 1.0) if unit == "m" else 1.0)


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
        if joint not in columns or unit not in _HELD:
            continue
        x = columns[joint]
        noise = float(np.median(np.abs(np.diff(x)))) if len(x) > 1 else 0.0
        low, high = np.quantile(x, [0.005, 0.995])
        if max(high - place, place - low) > _most(_HELD, machine, unit) + 8 * noise:
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
    a, b = (f"{_PRESSURE}{joint}_{chamber}" for chamber in "ab")
    there = [name for name in (a, b) if name in table.units]
    cylinder = None if machine.hydraulics is None else machine.hydraulics.cylinders.get(joint)
    if cylinder is None and there:
        raise RecordingError(
            f"'{machine.name}' has no cylinder that makes '{there[0]}' a force, describe it "
            f"under 'hydraulics' in the machine file, or give '{joint}{FORCE} [{unit}]'"
        )
    if cylinder is None or not there:
        pressures = "" if cylinder is None else f", or '{a} [Pa]' and '{b} [Pa]'"
        raise RecordingError(
            f"column '{joint}{FORCE}' is missing, give it in [{unit}]{pressures}, or lock the "
            f"joint if it was held (lock {joint}=VALUE)"
        )
    if len(there) < 2:
        missing = b if a in there else a
        raise RecordingError(
            f"column '{missing}' is missing beside '{there[0]}', give it, or "
            f"'{joint}{FORCE} [{unit}]'"
        )
    return cylinder.area_a * column(table, a, "Pa") - cylinder.area_b * column(table, b, "Pa")


def _drives(machine: Machine, names: Sequence[str]) -> tuple[str, ...]:
    """Measured joints that determine all others: active ones, then such as tell something new.

    The rows of gamma = dq/dq_A at home that belong to them have to span all of v_A. A joint tells
    what its row has in the directions that the rows before it leave open.
    """
    gamma = machine.closure.gamma(machine.home) * _span(machine)
    told = np.zeros((0, len(machine.active)))

    def new(joint: str) -> Array | None:
        """Unit direction that a joint adds, None where it adds none."""
        row = gamma[machine.column(joint)]
        rest = row - told.T @ (told @ row)
        rest -= told.T @ (told @ rest)  # once more for rounding
        size = np.linalg.norm(rest)
        return rest / size if size > _TELLS * np.linalg.norm(row) else None

    drives = []
    measured = [x for x in names if x in machine.joints]
    for joint in sorted(measured, key=lambda x: x not in machine.active):
        if (direction := new(joint)) is not None:
            told = np.vstack([told, direction])
            drives.append(joint)
    if len(drives) < len(machine.active):
        telling = [x for x in machine.joints if new(x) is not None]
        missing = []
        for joint in machine.active:  # those that suffice
            if (direction := new(joint)) is not None:
                told = np.vstack([told, direction])
                missing.append(joint)
        others = ", ".join(x for x in telling if x not in machine.active)
        one = len(missing) == 1
        raise RecordingError(
            f"nothing tells where {', '.join(repr(x) for x in missing)} {'is' if one else 'are'}, "
            f"give {', '.join(repr(f'{x} [{machine.unit(x)}]') for x in missing)}"
            + (f", or a joint that moves with {'it' if one else 'them'} ({others})" * bool(others))
            + f", or lock what was held (lock {', '.join(f'{x}=VALUE' for x in missing)})"
        )
    return tuple(drives)


def _span(machine: Machine) -> Array:
    """Ranges (n,) of the active coordinates, 1 where they are endless."""
    span = machine.upper - machine.lower
    return np.where(np.isfinite(span), span, 1.0)


def joint_motion(machine: Machine, table: Table) -> tuple[Array, Array]:
    """Active coordinates and velocities (N, n) of what a table tells of the machine's joints.

    Raises:
        RecordingError: It does not tell all of them, or what the machine cannot do.
    """
    return _motion(machine, _drives(machine, list(table.units)), table)


def tell_disagreement(machine: Machine, table: Table) -> None:
    """Warn where sensors of one quantity disagree through the machine's loops.

    Joints that are recorded beside those that determine the posture, in the machine's unit, are
    compared with where these put them.
    """
    drives = _drives(machine, list(table.units))
    others = [
        x for x in machine.joints
        if x not in drives and table.units.get(x) == machine.unit(x)
    ]  # fmt: skip
    if not others:
        return
    chosen = slice(None, None, max(1, len(table.values) // _COMPARED))
    time = column(table, TIME)[chosen]
    q_b = np.column_stack([column(table, x, machine.unit(x))[chosen] for x in drives])
    try:
        driven = machine if set(drives) == set(machine.active) else machine.driven_by(drives)
        order = [drives.index(x) for x in driven.active]
        q = driven.closure.solve(q_b[:, order])
    except (ClosureError, MechanismError):  # whoever closes the loops tells it
        return
    told = []
    for joint in others:
        unit = machine.unit(joint)
        x = column(table, joint)[chosen]
        off = x - q[:, driven.column(joint)]
        if unit == "rad":
            off -= 2 * np.pi * np.round(np.median(off) / (2 * np.pi))
        noise = float(np.median(np.abs(np.diff(x, 2)))) if len(x) > 2 else 0.0
        if np.sqrt(np.mean(off**2)) > max(_most(_AGREE, machine, unit), 2 * noise):
            factor, shown = (180 / np.pi, "deg") if unit == "rad" else (1e3, "mm")
            at = int(np.abs(off).argmax())
            told.append(
                f"'{joint}' is {factor * off.mean():+.3g} {shown} off on the mean, "
                f"{factor * off[at]:+.3g} at most (at {time[at]:.4g} s)"
            )
    if told:
        text = f"sensors disagree: by {', '.join(drives)}, which are used, {'; '.join(told)}"
        warnings.warn(text, CraneWarning, stacklevel=3)


def _motion(machine: Machine, drives: tuple[str, ...], table: Table) -> tuple[Array, Array]:
    """Active coordinates and velocities (N, n) from those of the joints that were measured."""
    time = column(table, TIME)
    q_b = np.column_stack([column(table, x, machine.unit(x)) for x in drives])
    v_b = np.empty_like(q_b)
    for x, v, joint in zip(q_b.T, v_b.T, drives, strict=True):
        v[:] = derivative(x, time) if (told := _velocity(machine, joint, table)) is None else told
    if set(drives) == set(machine.active):
        order = [drives.index(x) for x in machine.active]
        return q_b[:, order], v_b[:, order]
    angles = ", ".join(x for x in drives if x not in machine.active)
    hint = f"see that zero and sign of {angles} are the machine's"
    q_a, v_a = np.empty_like(q_b), np.empty_like(v_b)
    try:
        closure = machine.driven_by(drives).closure
    except MechanismError as error:
        raise RecordingError(f"{error}; {hint}") from None
    for start in range(0, len(time), _AT_ONCE):
        some = slice(start, start + _AT_ONCE)
        try:
            q_a[some], v_a[some], off = _driven(machine, closure, q_b[some], v_b[some])
        except ClosureError as error:
            raise RecordingError(f"{_counted_from(start, error)}; {hint}") from None
        if (off > _SAME).any():
            raise RecordingError(
                f"sample {start + int(np.argmax(off > _SAME))} is beyond a dead centre, where "
                f"{', '.join(machine.active)} do not tell the posture: {hint}, or cut the "
                "recording"
            )
    low, high = q_a.min(axis=0), q_a.max(axis=0)
    slack = _SLACK * _span(machine)
    computed = np.array([x not in drives for x in machine.active])
    outside = (low < machine.lower - slack) | (high > machine.upper + slack)
    for i in np.flatnonzero(computed & outside):
        raise RecordingError(
            f"by {angles} '{machine.active[i]}' goes from {low[i]:.4g} to {high[i]:.4g} "
            f"{machine.unit(machine.active[i])}, its limits are {machine.lower[i]:.4g} and "
            f"{machine.upper[i]:.4g}: {hint}"
        )
    for v, joint in zip(v_a.T, machine.active, strict=True):
        if (told := _velocity(machine, joint, table)) is not None:
            v[:] = told
    return q_a, v_a


def _driven(
    machine: Machine, closure: Closure, q_b: Array, v_b: Array
) -> tuple[Array, Array, Array]:
    """q_A and v_A = gamma_A v_B, and how far from the posture q_A leads (N,).

    Args:
        machine: Driven by q_A.
        closure: Of the same machine driven by q_B.
        q_b: (N, n).
        v_b: (N, n).

    Raises:
        ClosureError: No posture has these coordinates.
    """
    q = closure.solve(q_b)
    gamma = closure.gamma(q)[:, machine.closure.active]
    q_a = q[:, machine.closure.active]
    off = np.abs(machine.closure.solve(q_a) - q).max(axis=1)
    return q_a, np.einsum("nij,nj->ni", gamma, v_b), off


def _counted_from(start: int, error: ClosureError) -> str:
    """What an error says of a block of samples, its samples counted from the first of all."""
    return _SAMPLE.sub(lambda found: f"(sample {start + int(found[1])})", str(error))


def _velocity(machine: Machine, joint: str, table: Table) -> Array | None:
    """A joint's velocity (N,) where it is recorded."""
    if joint + VELOCITY not in table.units:
        return None
    return column(table, joint + VELOCITY, VELOCITY_UNITS[machine.unit(joint)])
