"""Angles of joints from inclinations of their links, where nothing else tells the posture."""

import numpy as np

from crane.common.errors import ClosureError, MechanismError, RecordingError
from crane.common.samples import Array
from crane.description.sensors import INCLINATION, VELOCITY
from crane.machine import Machine
from crane.recordings.missing import MissingError
from crane.recordings.postures import drives_of, telling
from crane.recordings.sensed import sensed
from crane.recordings.timeseries import Table, column

_STEPS, _DONE = 12, 1e-11  # of Newton's method, and the step that ends it [rad]
_TELLS = 0.1  # least slope of an inclination by the joint of its link
Sought = list[tuple[str, str]]  # joint, inclination


def with_angles(machine: Machine, table: Table) -> Table:
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
        drives_of(machine, names)
        return table
    except MissingError:
        pass
    drives, sought = _sought(machine, table)
    if len(drives) < len(machine.active):
        return table  # whoever needs them says so
    try:
        angles = _angles(machine.driven_by(drives), table, sought)
    except (ClosureError, MechanismError) as error:
        listed = ", ".join(name for _, name in sought)
        hint = f"see that zero and sign of {listed} are the machine's"
        raise RecordingError(f"{error}; {hint}") from None
    units = table.units | {joint: "rad" for joint, _ in sought}
    return Table(units, np.column_stack([table.values, angles]), table.notes)


def _sought(machine: Machine, table: Table) -> tuple[tuple[str, ...], Sought]:
    """Joints that drive the machine, and those of them that inclinations have to tell.

    Of each inclination the nearest joint below its link, which it depends on and nothing tells.
    """
    drives = telling(machine, list(table.units))
    sought: Sought = []
    for name, unit in table.units.items():
        if not name.startswith(INCLINATION) or unit != "rad":
            continue
        for joint in _carrying(machine, name):
            more = telling(machine, [joint], first=drives)
            if len(more) > len(drives):
                drives, sought = more, [*sought, (joint, name)]
                break
    return drives, sought


def _carrying(machine: Machine, name: str) -> list[str]:
    """Joints from a link to the ground that change its inclination, at home."""
    above = {joint.child: joint for joint in machine.tree.joints.values()}
    link, home, rate, found = (
        name.removeprefix(INCLINATION),
        machine.home[None],
        name + VELOCITY,
        [],
    )
    while link in above:
        joint = above[link]
        if joint.name in machine.joints:
            along = np.zeros_like(home)
            along[0, machine.column(joint.name)] = 1.0
            if abs(float(sensed(machine, home, along, [rate])[rate][0])) > _TELLS:
                found.append(joint.name)
        link = joint.parent
    return found


def _angles(driven: Machine, table: Table, sought: Sought) -> Array:
    """(N, k) of the joints that are sought, of a machine that they drive with those recorded.

    Raises:
        ClosureError: No posture has these inclinations.
    """
    count, joints = len(table.values), [joint for joint, _ in sought]
    at = [driven.active.index(joint) for joint in joints]
    names = [name for _, name in sought]
    q_b = np.tile(driven.home[driven.closure.active], (count, 1))
    for i, joint in enumerate(driven.active):
        if joint not in joints:
            q_b[:, i] = column(table, joint, driven.unit(joint))
    wanted = np.column_stack([column(table, name) for name in names])
    for _ in range(_STEPS):
        q = driven.closure.solve(q_b)
        said = sensed(driven, q, np.zeros_like(q), names)
        off = wanted - np.column_stack([said[name] for name in names])
        step = np.linalg.solve(_slopes(driven, q, names, at), off[:, :, None])[:, :, 0]
        q_b[:, at] += step
        if np.abs(step).max() < _DONE:
            return q_b[:, at]
    raise ClosureError(f"no posture has the inclinations of {', '.join(names)}")


def _slopes(driven: Machine, q: Array, names: list[str], at: list[int]) -> Array:
    """(N, k, k) of inclinations by some of the coordinates that drive a machine."""
    gamma, rates = driven.closure.gamma(q), [name + VELOCITY for name in names]
    columns = [sensed(driven, q, gamma[:, :, i], rates) for i in at]
    return np.stack([np.column_stack([x[rate] for rate in rates]) for x in columns], axis=2)
