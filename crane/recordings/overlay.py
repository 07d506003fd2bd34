"""Two recordings of a machine, one laid over the other."""

from dataclasses import dataclass

import numpy as np

from crane.common.scratch import release
from crane.common.units import number, reading
from crane.recordings.recording import Recording


@dataclass(frozen=True)
class Difference:
    """How far two recordings are apart in one joint.

    Attributes:
        joint: The joint.
        unit: Unit of its coordinate, "rad" or "m".
        most: Largest distance of its coordinates.
        time: When it is that large [s], by the first recording's clock.
    """

    joint: str
    unit: str
    most: float
    time: float

    @property
    def words(self) -> tuple[str, str]:
        """Distance and time in units to read them in; the same numbers are 0."""
        unit, scale = reading(self.unit, 0.0)
        return f"{number(scale * self.most)} {unit}", f"{self.time:.4g} s"


def shift_of(recording: Recording, other: Recording) -> float:
    """What the second clock is moved by [s]: 0, or to start together if they do not overlap."""
    apart = other.time[0] > recording.time[-1] or other.time[-1] < recording.time[0]
    return float(recording.time[0] - other.time[0]) if apart else 0.0


def differences(recording: Recording, other: Recording) -> list[Difference]:
    """The largest distance of each joint over the time that both recordings have.

    At the samples of both; a recording is straight between its own.
    """
    late = other.time + shift_of(recording, other)
    time = np.union1d(recording.time, late)
    start, end = max(recording.time[0], late[0]), min(recording.time[-1], late[-1])
    time = time[(time >= start) & (time <= end)]
    found = []
    for joint in (x for x in recording.joints if x in other.joints):
        release()
        one = np.interp(time, recording.time, recording.q[:, recording.joints.index(joint)])
        apart = np.abs(np.interp(time, late, other.q[:, other.joints.index(joint)]) - one)
        most = int(apart.argmax())
        unit = recording.units[joint]
        found.append(Difference(joint, unit, float(apart[most]), float(time[most])))
    return found
