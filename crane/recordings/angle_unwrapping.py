"""Angles of joints that turn on: recorded within one revolution, as encoders give them."""

import warnings
from collections.abc import Mapping

import numpy as np

from crane.common.errors import CraneWarning
from crane.common.samples import Array
from crane.machine.machine import Machine
from crane.recordings.recording import REFERENCE_PREFIX
from crane.recordings.timeseries import TIME, Table, table_column

_REVOLUTION = 2 * np.pi
_MAX_STEP = 0.8  # largest motion between samples beside a revolution [rad]
_RANGE_TOLERANCE = 0.05  # by which noise extends the range of a revolution [rad]


def unwrap_table(machine: Machine, table: Table) -> Table:
    """The table with angles that jump by a revolution made continuous, see `unwrap_angles`."""
    names = [x for x in table.units if table.units[x] == "rad"]
    columns = {x: table_column(table, x) for x in names}
    unwrapped = unwrap_angles(machine, table_column(table, TIME), columns)
    if not unwrapped:
        return table
    values = table.values.copy()
    for name, column in unwrapped.items():
        values[:, list(table.units).index(name)] = column
    return Table(table.units, values, table.notes)


def unwrap_angles(machine: Machine, time: Array, columns: Mapping[str, Array]) -> dict[str, Array]:
    """Make angles and references of joints without limits continuous; warns of what it changes.

    A jump is one of a revolution, to 0.8 rad, in an angle that stays within one revolution.
    Outliers and jumps of other sizes do not change, and neither do joints with limits.

    Args:
        machine: The recorded machine.
        time: Instants (N,) [s].
        columns: Columns (N,) by name [rad].

    Returns:
        The changed columns.
    """
    coordinates = machine.coordinates
    is_endless = np.isinf(coordinates.lower) & np.isinf(coordinates.upper)
    is_angle = ~coordinates.is_translation & ~coordinates.is_rotation_vector
    endless = np.array(coordinates.names)[is_endless & is_angle].tolist()
    found, messages = {}, []
    for joint in endless:
        for name in (joint, REFERENCE_PREFIX + joint):
            angle = columns.get(name)
            if angle is None or np.ptp(angle) > _REVOLUTION + _RANGE_TOLERANCE:
                continue
            steps = np.diff(angle)
            turns = np.rint(steps / _REVOLUTION)
            turns[np.abs(steps - _REVOLUTION * turns) > _MAX_STEP] = 0.0
            if turns.any():
                found[name] = angle - _REVOLUTION * np.append(0.0, np.cumsum(turns))
                first = time[np.flatnonzero(turns)[0] + 1]
                messages.append(
                    f"'{name}' {np.count_nonzero(turns)} times (the first at {first:.6g} s)"
                )
    if messages:
        warnings.warn(
            f"angles jump by a revolution and are made continuous: {', '.join(messages)}",
            CraneWarning,
            stacklevel=3,
        )
    return found
