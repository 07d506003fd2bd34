"""Delays of columns of a recording, taken out."""

import fnmatch
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from crane.common.errors import RecordingError, suggest_names
from crane.common.samples import as_number
from crane.recordings.recording import FORCE_SUFFIX, VELOCITY_SUFFIX, Recording
from crane.recordings.timeseries import TIME


def shift_columns(recording: Recording, delays: Mapping[str, float]) -> Recording:
    """Take delays d out of columns y: x(t) = y(t + d), linear between samples.

    Args:
        recording: The recording.
        delays: Delays [s] by column or pattern, such as `{"*_force": 0.03}`; negative for columns
            that are ahead of the others. A rate or force that was computed from another column
            is shifted by its own name.

    Returns:
        The recording over the time that all columns cover.

    Raises:
        RecordingError: A pattern matches no column, or no time is left.
    """
    names = [name for name in recording if name != TIME]
    columns, time, shifts = recording.columns(), recording.time, dict.fromkeys(names, 0.0)
    for pattern, delay in delays.items():
        matches = fnmatch.filter(names, pattern)
        if not matches:
            raise RecordingError(
                f"no column to shift is named '{pattern}', {suggest_names(names, pattern)}"
            )
        shifts |= dict.fromkeys(matches, as_number(delay, f"the shift of '{pattern}'", "s"))
    for name, delay in shifts.items():
        if delay:
            columns[name] = np.interp(time + delay, time, columns[name])
    first, last = time[0] - min(shifts.values()), time[-1] - max(shifts.values())
    is_covered = (time >= max(first, time[0])) & (time <= min(last, time[-1]))
    if not is_covered.any():
        raise RecordingError("nothing is left of a recording that is shorter than its shift")
    columns = {name: column[is_covered] for name, column in columns.items()}
    zeros = np.zeros_like(columns[TIME])
    q, v, tau = (
        np.column_stack([columns.get(x + suffix, zeros) for x in recording.joints])
        for suffix in ("", VELOCITY_SUFFIX, FORCE_SUFFIX)
    )
    channels = {name: columns[name] for name in recording.channels}
    return replace(recording, time=columns[TIME], q=q, v=v, tau=tau, channels=channels)
