"""Joint angles from inclinations of links, where no joint measurement determines them."""

import numpy as np

from crane.common.errors import ClosureError, MechanismError, RecordingError
from crane.common.samples import Array
from crane.description.sensors import INCLINATION_PREFIX, VELOCITY_SUFFIX
from crane.machine import Machine
from crane.recordings.measured_configurations import determining_joints, independent_joints
from crane.recordings.missing_measurements import MissingMeasurementError
from crane.recordings.sensor_kinematics import ideal_readings
from crane.recordings.timeseries import Table, table_column

_MAX_ITERATIONS, _STEP_TOLERANCE = 12, 1e-11  # Newton iterations, and the last step [rad]
_MIN_DERIVATIVE = 0.1  # least derivative of an inclination by the joint of its link
UnknownAngles = list[tuple[str, str]]  # joint, inclination


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
    units = table.units | {joint: "rad" for joint, _ in unknown_angles}
    return Table(units, np.column_stack([table.values, angles]), table.notes)


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
    parent_joints = {joint.child: joint for joint in machine.tree.joints.values()}
    link, home, rate, found = (
        name.removeprefix(INCLINATION_PREFIX),
        machine.home[None],
        name + VELOCITY_SUFFIX,
        [],
    )
    while link in parent_joints:
        joint = parent_joints[link]
        if joint.name in machine.joints:
            direction = np.zeros_like(home)
            direction[0, machine.column(joint.name)] = 1.0
            if (
                abs(float(ideal_readings(machine, home, direction, [rate])[rate][0]))
                > _MIN_DERIVATIVE
            ):
                found.append(joint.name)
        link = joint.parent
    return found


def _solve_angles(driven: Machine, table: Table, unknown_angles: UnknownAngles) -> Array:
    """Angles (N, k) of the unknown joints of a machine with unknown and measured active joints.

    Raises:
        ClosureError: No configuration has these inclinations.
    """
    count, joints = len(table.values), [joint for joint, _ in unknown_angles]
    indices = [driven.active.index(joint) for joint in joints]
    names = [name for _, name in unknown_angles]
    q_b = np.tile(driven.home[driven.closure.active], (count, 1))
    for i, joint in enumerate(driven.active):
        if joint not in joints:
            q_b[:, i] = table_column(table, joint, driven.unit(joint))
    measured = np.column_stack([table_column(table, name) for name in names])
    for _ in range(_MAX_ITERATIONS):
        q = driven.closure.solve(q_b)
        computed = ideal_readings(driven, q, np.zeros_like(q), names)
        residual = measured - np.column_stack([computed[name] for name in names])
        step = np.linalg.solve(
            _inclination_jacobian(driven, q, names, indices), residual[:, :, None]
        )[:, :, 0]
        q_b[:, indices] += step
        if np.abs(step).max() < _STEP_TOLERANCE:
            return q_b[:, indices]
    raise ClosureError(f"no configuration has the inclinations of {', '.join(names)}")


def _inclination_jacobian(
    driven: Machine, q: Array, names: list[str], indices: list[int]
) -> Array:
    """Derivatives (N, k, k) of inclinations by some of the active coordinates."""
    gamma, rates = driven.closure.gamma(q), [name + VELOCITY_SUFFIX for name in names]
    columns = [ideal_readings(driven, q, gamma[:, :, i], rates) for i in indices]
    return np.stack([np.column_stack([x[rate] for rate in rates]) for x in columns], axis=2)
