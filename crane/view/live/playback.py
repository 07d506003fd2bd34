"""A recording that a live view plays."""

import numpy as np

from crane.common.errors import RecordingError, suggest_names
from crane.common.samples import Array
from crane.machine import Machine
from crane.recordings.recording import Recording


class Playback:
    """The active coordinates and forces of a recording at any time within it.

    Args:
        machine: The machine it belongs to.
        recording: The recording.

    Attributes:
        start: Time of the first sample [s].
        end: Time of the last sample [s].
        configurations: (N, nq) closed postures of all samples [m], [rad].

    Raises:
        RecordingError: It lacks an active joint of the machine.
        ClosureError: The loops cannot be closed at a sample.
    """

    def __init__(self, machine: Machine, recording: Recording):
        columns = []
        for joint in machine.active:
            if joint not in recording.joints:
                raise RecordingError(
                    f"the recording has no joint '{joint}', which drives {machine.name}, "
                    f"{suggest_names(recording.joints, joint)}"
                )
            columns.append(recording.joints.index(joint))
        self._time = recording.time
        self._active_count = len(columns)
        self._coordinates_and_forces = np.hstack(
            [recording.q[:, columns], recording.tau[:, columns]]
        )
        self.start, self.end = float(self._time[0]), float(self._time[-1])
        self.configurations = machine.closure.solve(
            self._coordinates_and_forces[:, : self._active_count]
        )

    def interpolate(self, time: float) -> tuple[Array, Array]:
        """Active coordinates (n,) [m], [rad] and forces (n,) [N], [N m] at a time [s].

        They run straight from sample to sample.
        """
        next_index = int(
            np.clip(np.searchsorted(self._time, time), 1, max(len(self._time) - 1, 1))
        )
        adjacent_rows = self._coordinates_and_forces[next_index - 1 : next_index + 1]
        if len(adjacent_rows) == 1:
            return adjacent_rows[0, : self._active_count], adjacent_rows[0, self._active_count :]
        start_time, end_time = self._time[next_index - 1 : next_index + 1]
        share = np.clip((time - start_time) / (end_time - start_time), 0.0, 1.0)
        values = adjacent_rows[0] + share * (adjacent_rows[1] - adjacent_rows[0])
        return values[: self._active_count], values[self._active_count :]
