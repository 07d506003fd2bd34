"""Angles of joints from inclinations of their links, where nothing else tells the posture."""

import numpy as np

from crane.common.errors import ClosureError, MechanismError, RecordingError
from crane.common.samples import Array
from crane.description.sensors import INCLINATION_PREFIX, VELOCITY_SUFFIX
from crane.machine import Machine
from crane.recordings.ideal_sensors import ideal_readings
from crane.recordings.measured_configurations import determining_joints, independent_joints
from crane.recordings.missing_measurements import MissingMeasurementError
from crane.recordings.timeseries import Table, table_column

_MAX_ITERATIONS, _STEP_TOLERANCE = 12, 1e-11  # of Newton's method, and the step that ends it [rad]
_MIN_DERIVATIVE = 0.1  # least slope of an inclination by the joint of its link
UnknownAngles = list[tuple[str, str]]  # joint, inclination


def add_inclination_angles(machine: Machine, table: Table) -> Table:
    """The table with angles of joints whose links' inclinations determine the posture.

    Those that are missing are found by Newton's method, h(q(q_B)) = y, with h the inclinations
    and q_B the joints that were measured and those that are sought.

    Args:
        machine: The machine.
        table: Quantities.

    Returns:
        The table as it is where joints determine the posture, or inclinations do not, either.

    Raises:
        RecordingError: No posture has these inclinations.
    """
    names = list(table.units)
    try:
        determining_joints(machine, names)
        return table
    except MissingMeasurementError:
        pass
    drives, unknown_angles = _find_unknown_angles(machine, table)
    if len(drives) < len(machine.active):
        return table  # whoever needs them says so
    try:
        angles = _solve_angles(machine.with_active_joints(drives), table, unknown_angles)
    except (ClosureError, MechanismError) as error:
        listed = ", ".join(name for _, name in unknown_angles)
        hint = f"see that zero and sign of {listed} are the machine's"
        raise RecordingError(f"{error}; {hint}") from None
    units = table.units | {joint: "rad" for joint, _ in unknown_angles}
    return Table(units, np.column_stack([table.values, angles]), table.notes)


def _find_unknown_angles(machine: Machine, table: Table) -> tuple[tuple[str, ...], UnknownAngles]:
    """Joints that drive the machine, and those of them that inclinations have to tell.

    Of each inclination the nearest joint below its link, which it depends on and nothing tells.
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
    """Joints from a link to the ground that change its inclination, at home."""
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
    """(N, k) of the joints that are sought, of a machine that they drive with those recorded.

    Raises:
        ClosureError: No posture has these inclinations.
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
    raise ClosureError(f"no posture has the inclinations of {', '.join(names)}")


def _inclination_jacobian(
    driven: Machine, q: Array, names: list[str], indices: list[int]
) -> Array:
    """(N, k, k) of inclinations by some of the coordinates that drive a machine."""
    gamma, rates = driven.closure.gamma(q), [name + VELOCITY_SUFFIX for name in names]
    columns = [ideal_readings(driven, q, gamma[:, :, i], rates) for i in indices]
    return np.stack([np.column_stack([x[rate] for rate in rates]) for x in columns], axis=2)
