"""A recording that a live view plays."""

import numpy as np

from crane.common.errors import RecordingError, known
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
        q: (N, nq) closed postures of all samples [m], [rad].

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
                    f"{known(recording.joints, joint)}"
                )
            columns.append(recording.joints.index(joint))
        self._time = recording.time
        self._n = len(columns)
        self._values = np.hstack([recording.q[:, columns], recording.tau[:, columns]])
        self.start, self.end = float(self._time[0]), float(self._time[-1])
        self.q = machine.closure.solve(self._values[:, : self._n])

    def at(self, time: float) -> tuple[Array, Array]:
        """Active coordinates (n,) [m], [rad] and forces (n,) [N], [N m] at a time [s].

        They run straight from sample to sample.
        """
        after = int(np.clip(np.searchsorted(self._time, time), 1, max(len(self._time) - 1, 1)))
        rows = self._values[after - 1 : after + 1]
        if len(rows) == 1:
            return rows[0, : self._n], rows[0, self._n :]
        begin, end = self._time[after - 1 : after + 1]
        share = np.clip((time - begin) / (end - begin), 0.0, 1.0)
        values = rows[0] + share * (rows[1] - rows[0])
        return values[: self._n], values[self._n :]
