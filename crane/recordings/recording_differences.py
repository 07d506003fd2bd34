"""Two recordings of a machine, one laid over the other."""

from dataclasses import dataclass

import numpy as np

from crane.common.scratch_arrays import release_pages
from crane.common.units import display_unit, format_number
from crane.recordings.recording import Recording


@dataclass(frozen=True)
class JointDifference:
    """How far two recordings are apart in one joint.

    Attributes:
        joint: The joint.
        unit: Unit of its coordinate, "rad" or "m".
        largest: Largest distance of its coordinates.
        time: When it is that large [s], by the first recording's clock.
    """

    joint: str
    unit: str
    largest: float
    time: float

    @property
    def formatted(self) -> tuple[str, str]:
        """Distance and time in units to read them in; the same numbers are 0."""
        unit, scale = display_unit(self.unit, 0.0)
        return f"{format_number(scale * self.largest)} {unit}", f"{self.time:.4g} s"


def clock_shift(recording: Recording, other: Recording) -> float:
    """What the second clock is moved by [s]: 0, or to start together if they do not overlap."""
    is_disjoint = other.time[0] > recording.time[-1] or other.time[-1] < recording.time[0]
    return float(recording.time[0] - other.time[0]) if is_disjoint else 0.0


def joint_differences(recording: Recording, other: Recording) -> list[JointDifference]:
    """The largest distance of each joint over the time that both recordings have.

    At the samples of both; a recording is straight between its own.
    """
    shifted_time = other.time + clock_shift(recording, other)
    time = np.union1d(recording.time, shifted_time)
    start, end = max(recording.time[0], shifted_time[0]), min(recording.time[-1], shifted_time[-1])
    time = time[(time >= start) & (time <= end)]
    found = []
    for joint in (x for x in recording.joints if x in other.joints):
        release_pages()
        one = np.interp(time, recording.time, recording.q[:, recording.joints.index(joint)])
        distance = np.abs(
            np.interp(time, shifted_time, other.q[:, other.joints.index(joint)]) - one
        )
        largest_index = int(distance.argmax())
        unit = recording.units[joint]
        found.append(
            JointDifference(
                joint, unit, float(distance[largest_index]), float(time[largest_index])
            )
        )
    return found
