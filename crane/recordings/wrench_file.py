"""A wrench over time from a file."""

from pathlib import Path

import numpy as np

from crane.common.errors import InputError, check_name
from crane.description.external_forces import WRENCH_COMPONENTS, Wrench
from crane.recordings.table_reader import read_table


def read_wrench(path: Path, frame: str, axes: str) -> Wrench:
    """Read an external force: columns time and force_x to moment_z [N], [N m], 0 where missing.

    Args:
        path: CSV or npz file.
        frame: See `Wrench`.
        axes: See `Wrench`.

    Raises:
        InputError: Other columns, or none.
        RecordingError: The file cannot be read.
    """
    table = read_table(path)
    columns = dict(zip(table.units, table.values.T, strict=True))
    times = columns.pop("time")
    for name in columns:
        check_name(name, WRENCH_COMPONENTS, f"{path}: '{name}' is no part of a wrench")
    if not columns:
        raise InputError(f"{path}: has no force, add columns such as force_z")
    zero = np.zeros(len(table.values))
    wrench = np.stack([columns.get(part, zero) for part in WRENCH_COMPONENTS], axis=1)
    return Wrench(frame, wrench[:, :3], wrench[:, 3:], times, axes)
