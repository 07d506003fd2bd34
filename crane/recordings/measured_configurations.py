"""Configurations and velocities of a machine from measured joints and inclinations.

Measured coordinates of active joints are used directly. The others are computed from other joints
by closing the loops, velocities by v_A = gamma_A v_B with the measured joints q_B.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property

import numpy as np

from crane.common.errors import ClosureError, MechanismError, RecordingError
from crane.common.samples import Array, independent_rows
from crane.description.kinematic_tree import path_to_root
from crane.description.sensors import INCLINATION_PREFIX, VELOCITY_SUFFIX, VELOCITY_UNITS
from crane.machine.machine import Machine
from crane.recordings.rotation_columns import body_rates
from crane.recordings.sensor_kinematics import ideal_readings, pin_derivatives
from crane.recordings.timeseries import TIME, Table, table_column, time_derivative

_MIN_INDEPENDENT_SHARE = 1e-6  # least part of the motion of a joint that others do not determine
_CONFIGURATION_TOLERANCE = 1e-6  # [rad], [characteristic length]
# samples that are compared, and samples for derivatives
_COMPARED_SAMPLES, _DERIVATIVE_SAMPLES = 2000, 200
_BLOCK_SAMPLES = 1 << 16  # samples per block
_SAMPLE_PATTERN = re.compile(r"\(sample (\d+)\)")  # in an error message of the closure
_LIMIT_TOLERANCE = 0.1  # of a range, for errors of sensors
_MAX_ITERATIONS, _STEP_TOLERANCE = 12, 1e-11  # Newton iterations, and the last step [rad]
_MIN_DERIVATIVE = 0.1  # least derivative of an inclination by the joint of its link
AGREEMENT_TOLERANCE = {"rad": 5e-3, "m": 5e-4}  # between sensors of one quantity
HELD_JOINT_TOLERANCE = {"rad": 0.02, "m": 2e-3}  # of a joint that is held
UnknownAngles = list[tuple[str, str]]  # joint, inclination


class MissingMeasurementError(RecordingError):
    """Coordinates or forces of joints are not determined by a recording.

    Args:
        message: Message with the required columns.
        joints: Joints that may have been held.
    """

    def __init__(self, message: str, joints: Iterable[str]):
        super().__init__(message)
        self.joints = tuple(joints)


def determining_joints(machine: Machine, names: Sequence[str]) -> tuple[str, ...]:
    """Measured joints that determine the configuration, active ones first.

    Raises:
        MissingMeasurementError: They do not determine it.
    """
    drives = independent_joints(machine, names)
    if len(drives) == len(machine.active):
        return drives
    missing = independent_joints(machine, [*drives, *machine.active], first=drives)[len(drives) :]
    others = [x for x in machine.joints if x not in machine.active]
    others = [
        x for x in others if len(independent_joints(machine, [x], first=drives)) > len(drives)
    ]
    it, are = ("it", "is") if len(missing) == 1 else ("them", "are")
    requested = ", ".join(repr(f"{x} [{machine.unit(x)}]") for x in missing)
    alternatives = f", or a joint that moves with {it} ({', '.join(others)})" if others else ""
    raise MissingMeasurementError(
        f"{', '.join(map(repr, missing))} {are} not determined, give {requested}{alternatives}",
        missing,
    )


def independent_joints(
    machine: Machine, names: Sequence[str], first: Sequence[str] = ()
) -> tuple[str, ...]:
    """Joints that are independent of each other: `first`, then active ones, then others.

    A joint is independent if its row of gamma = dq/dq_A at home is linearly independent of the
    rows before it.
    """
    gamma = machine.closure.gamma(machine.home) * _stroke_ranges(machine)
    measured = [x for x in names if x in machine.joints and x not in first]
    joints = [*first, *sorted(measured, key=lambda x: x not in machine.active)]
    rows = gamma[[machine.column(joint) for joint in joints]]
    return tuple(joints[i] for i in independent_rows(rows, _MIN_INDEPENDENT_SHARE))


def _stroke_ranges(machine: Machine) -> Array:
    """Ranges (n,) of the active coordinates, 1 where they are unlimited."""
    span = machine.upper - machine.lower
    return np.where(np.isfinite(span), span, 1.0)


class MeasuredConfigurations:
    """Configurations of a machine at some samples, by the determining joints of a table.

    Args:
        machine: The recorded machine.
        table: Table of quantities.

    Attributes:
        machine: The machine with the determining joints as active joints.
        drives: Names of the determining joints.
        sample_slice: The samples.
        time: (N,) [s].
    """

    def __init__(self, machine: Machine, table: Table):
        self.table, self.drives = table, determining_joints(machine, list(table.units))
        self.sample_slice = slice(None, None, max(1, len(table.values) // _COMPARED_SAMPLES))
        self.time = table_column(table, TIME)[self.sample_slice]
        self._recorded_machine = machine

    @cached_property
    def machine(self) -> Machine:
        """The machine with the determining joints as active joints."""
        return (
            self._recorded_machine
            if (set(self.drives) == set(self._recorded_machine.active))
            else self._recorded_machine.with_active_joints(self.drives)
        )

    @cached_property
    def q_b(self) -> Array:
        """Measured coordinates (N, n) of the determining joints."""
        machine = self.machine
        columns = [
            table_column(self.table, x, machine.unit(x))[self.sample_slice] for x in machine.active
        ]
        return np.column_stack(columns)

    @cached_property
    def q(self) -> Array:
        """Closed configurations (N, nv)."""
        return self.machine.closure.solve(self.q_b)

    def expected_reading(self, name: str, q: Array | None = None) -> Array:
        """Ideal readings (N,) of a joint or inclination at these configurations, or at others."""
        q = self.q if q is None else q
        return ideal_readings(self.machine, q, np.zeros_like(q), [name])[name]

    def directional_derivative(self, name: str, q: Array, dq: Array) -> Array:
        """Derivatives (N,) of ideal readings along changes (N, nv) of the configurations."""
        return ideal_readings(self.machine, q, dq, [name + VELOCITY_SUFFIX])[
            name + VELOCITY_SUFFIX
        ]

    @cached_property
    def derivative_slice(self) -> slice:
        """Samples for derivatives, which are smooth."""
        return slice(None, None, max(1, len(self.time) // _DERIVATIVE_SAMPLES))

    @cached_property
    def pin_derivatives(self) -> dict[str, Array]:
        """Derivatives of some configurations by positions of pins, see `pin_derivatives`."""
        return pin_derivatives(self.machine, self.q[self.derivative_slice])


def joint_motion(machine: Machine, table: Table) -> tuple[Array, Array]:
    """Active coordinates and velocities (N, n) from the joints in a table.

    Raises:
        RecordingError: The table does not determine them, or the machine cannot move so.
    """
    return motion_from_joints(machine, determining_joints(machine, list(table.units)), table)


def motion_from_joints(
    machine: Machine, drives: tuple[str, ...], table: Table
) -> tuple[Array, Array]:
    """Active coordinates and velocities (N, n) from those of the determining joints."""
    time = table_column(table, TIME)
    q_b = np.column_stack([table_column(table, x, machine.unit(x)) for x in drives])
    v_b = np.empty_like(q_b)
    for x, v, joint in zip(q_b.T, v_b.T, drives, strict=True):
        v[:] = (
            time_derivative(x, time)
            if (recorded := recorded_velocity(machine, joint, table)) is None
            else recorded
        )
    for column in machine.coordinates.rotation_columns:
        parts = machine.joints[column : column + 3]
        missing = [
            x for x in parts if recorded_velocity(machine, x, table) is None and x in drives
        ]
        if not missing:
            continue
        if not set(parts) <= set(drives):
            raise RecordingError(
                f"'{missing[0]}_velocity' is missing, the angular velocity about an axis of the "
                f"child, which {', '.join(parts)} together determine: record it, or all of them"
            )
        rates = body_rates(q_b[:, [drives.index(x) for x in parts]], time)
        for x in missing:
            v_b[:, drives.index(x)] = rates[:, parts.index(x)]
    if set(drives) == set(machine.active):
        order = [drives.index(x) for x in machine.active]
        return q_b[:, order], v_b[:, order]
    angles = ", ".join(x for x in drives if x not in machine.active)
    hint = (
        f"see that zero and sign of {angles} are the machine's, and that none of them counts from "
        "the horizon (inclination_LINK)"
    )
    q_a, v_a = np.empty_like(q_b), np.empty_like(v_b)
    try:
        closure = machine.with_active_joints(drives).closure
    except MechanismError as error:
        raise RecordingError(f"{error}; {hint}") from None
    for start in range(0, len(time), _BLOCK_SAMPLES):
        block = slice(start, start + _BLOCK_SAMPLES)
        try:
            q = closure.solve(q_b[block])
            gamma = closure.gamma(q)[:, machine.closure.active]
            q_a[block] = q[:, machine.closure.active]
            v_a[block] = np.einsum("nij,nj->ni", gamma, v_b[block])
            distance = np.abs(machine.closure.solve(q_a[block]) - q).max(axis=1)
        except ClosureError as error:
            raise RecordingError(f"{_renumber_samples(start, error)}; {hint}") from None
        if (distance > _CONFIGURATION_TOLERANCE).any():
            raise RecordingError(
                f"sample {start + int(np.argmax(distance > _CONFIGURATION_TOLERANCE))} is beyond "
                f"a dead centre, where {', '.join(machine.active)} do not determine the "
                f"configuration: {hint}, or cut the recording"
            )
    low, high = q_a.min(axis=0), q_a.max(axis=0)
    slack = _LIMIT_TOLERANCE * _stroke_ranges(machine)
    computed = np.array([x not in drives for x in machine.active])
    outside = (low < machine.lower - slack) | (high > machine.upper + slack)
    for i in np.flatnonzero(computed & outside):
        raise RecordingError(
            f"by {angles} '{machine.active[i]}' goes from {low[i]:.4g} to {high[i]:.4g} "
            f"{machine.unit(machine.active[i])}, its limits are {machine.lower[i]:.4g} and "
            f"{machine.upper[i]:.4g}: {hint}"
        )
    for v, joint in zip(v_a.T, machine.active, strict=True):
        if (recorded := recorded_velocity(machine, joint, table)) is not None:
            v[:] = recorded
    return q_a, v_a


def _renumber_samples(start: int, error: ClosureError) -> str:
    """Message of an error about a block, with sample numbers of the whole recording."""
    return _SAMPLE_PATTERN.sub(lambda found: f"(sample {start + int(found[1])})", str(error))


def recorded_velocity(machine: Machine, joint: str, table: Table) -> Array | None:
    """Recorded velocity (N,) of a joint, None if it is not recorded."""
    if joint + VELOCITY_SUFFIX not in table.units:
        return None
    return table_column(table, joint + VELOCITY_SUFFIX, VELOCITY_UNITS[machine.unit(joint)])


def add_inclination_angles(machine: Machine, table: Table) -> Table:
    """Add joint angles that inclinations determine to a table.

    Newton's method solves h(q(q_B)) = y with the inclinations h and the joints q_B, measured and
    unknown ones.

    Args:
        machine: The machine.
        table: Table of quantities.

    Returns:
        The extended table; the table itself if joints determine the configuration, or inclinations
        do not.

    Raises:
        RecordingError: No closed configuration has these inclinations.
    """
    names = list(table.units)
    try:
        determining_joints(machine, names)
        return table
    except MissingMeasurementError:
        pass
    drives, unknown_angles = _find_unknown_angles(machine, table)
    if len(drives) < len(machine.active):
        return table  # the caller reports what is missing
    try:
        angles = _solve_angles(machine.with_active_joints(drives), table, unknown_angles)
    except (ClosureError, MechanismError) as error:
        listed = ", ".join(name for _, name in unknown_angles)
        hint = f"see that zero and sign of {listed} are the machine's"
        raise RecordingError(f"{error}; {hint}") from None
    return Table(
        table.units | {joint: "rad" for joint, _ in unknown_angles},
        np.column_stack([table.values, angles]),
        table.notes,
    )


def _find_unknown_angles(machine: Machine, table: Table) -> tuple[tuple[str, ...], UnknownAngles]:
    """Independent joints of the machine, and those of them to be computed from inclinations.

    An inclination determines the nearest joint below its link that it depends on and that is not
    measured.
    """
    drives = independent_joints(machine, list(table.units))
    unknown_angles: UnknownAngles = []
    for name, unit in table.units.items():
        if not name.startswith(INCLINATION_PREFIX) or unit != "rad":
            continue
        for joint in _inclining_joints(machine, name):
            extended = independent_joints(machine, [joint], first=drives)
            if len(extended) > len(drives):
                drives, unknown_angles = extended, [*unknown_angles, (joint, name)]
                break
    return drives, unknown_angles


def _inclining_joints(machine: Machine, name: str) -> list[str]:
    """Joints from a link to the ground that change its inclination at home."""
    link = name.removeprefix(INCLINATION_PREFIX)
    home, rate, found = machine.home[None], name + VELOCITY_SUFFIX, []
    for joint in path_to_root(machine.tree.parent_joints, link):
        if joint.name in machine.joints:
            direction = np.zeros_like(home)
            direction[0, machine.column(joint.name)] = 1.0
            if (
                abs(float(ideal_readings(machine, home, direction, [rate])[rate][0]))
                > _MIN_DERIVATIVE
            ):
                found.append(joint.name)
    return found


def _solve_angles(driven: Machine, table: Table, unknown_angles: UnknownAngles) -> Array:
    """Angles (N, k) of the unknown joints of a machine with unknown and measured active joints.

    Raises:
        ClosureError: No configuration has these inclinations.
    """
    count, joints = len(table.values), [joint for joint, _ in unknown_angles]
    indices = [driven.active.index(joint) for joint in joints]
    names = [name for _, name in unknown_angles]
    rates = [name + VELOCITY_SUFFIX for name in names]
    q_b = np.tile(driven.home[driven.closure.active], (count, 1))
    for i, joint in enumerate(driven.active):
        if joint not in joints:
            q_b[:, i] = table_column(table, joint, driven.unit(joint))
    measured = np.column_stack([table_column(table, name) for name in names])
    for _ in range(_MAX_ITERATIONS):
        q = driven.closure.solve(q_b)
        computed = ideal_readings(driven, q, np.zeros_like(q), names)
        residual = measured - np.column_stack([computed[name] for name in names])
        gamma = driven.closure.gamma(q)
        by_joint = [ideal_readings(driven, q, gamma[:, :, i], rates) for i in indices]
        jacobian = np.stack(
            [np.column_stack([x[rate] for rate in rates]) for x in by_joint], axis=2
        )
        step = np.linalg.solve(jacobian, residual[:, :, None])[:, :, 0]
        q_b[:, indices] += step
        if np.abs(step).max() < _STEP_TOLERANCE:
            return q_b[:, indices]
    raise ClosureError(f"no configuration has the inclinations of {', '.join(names)}")


class MissingMeasurements:
    """Collector of errors about missing measurements, raised as one error.

    Args:
        machine: The recorded machine.
        table: Table of quantities.
    """

    def __init__(self, machine: Machine, table: Table):
        self._machine, self._table = machine, table
        self._errors: list[RecordingError] = []

    @contextmanager
    def collect_errors(self) -> Iterator[None]:
        """Collect a recording error of the block, to be raised later."""
        try:
            yield
        except RecordingError as error:
            self._errors.append(error)

    def raise_collected(self) -> None:
        """Raise all collected errors as one.

        Raises:
            RecordingError: There are collected errors.
        """
        if not self._errors:
            return
        joints = dict.fromkeys(
            joint for error in self._errors if isinstance(error, MissingMeasurementError)
            for joint in error.joints
        )  # fmt: skip
        message = "; ".join(map(str, self._errors))
        lock_options = [
            f"--lock {joint}={place}" for joint in joints if (place := self._held_position(joint))
        ]
        if lock_options:
            message += f"; or lock what was held, where it was: {' '.join(lock_options)}"
        raise RecordingError(message)

    def _held_position(self, joint: str) -> str:
        """Text of the coordinate at which a joint may have been held; "" if it moved."""
        machine, unit = self._machine, self._machine.unit(joint)
        if self._table.units.get(joint) != unit:
            return f"{machine.home[machine.column(joint)]:.4g} (home)"
        low, place, high = np.quantile(table_column(self._table, joint), [0.005, 0.5, 0.995])
        return (
            f"{place:.4g}"
            if high - low <= 2 * tolerance(HELD_JOINT_TOLERANCE, machine, unit)
            else ""
        )


def tolerance(tolerances: Mapping[str, float], machine: Machine, unit: str) -> float:
    """Tolerance in a unit, scaled by the characteristic length for machines below 1 m."""
    return tolerances[unit] * (
        min(machine.closure.characteristic_length, 1.0) if unit == "m" else 1.0
    )
