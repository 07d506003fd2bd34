"""The few numbers that sum a recording up."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.samples import Array
from crane.common.units import quantity
from crane.description.sources import unchanged
from crane.recordings.recording import FORCE_UNITS, Recording

# Unit to read a coordinate in, and how many of it make one rad or m.
READING_UNITS = {"rad": ("deg", 180.0 / np.pi), "m": ("mm", 1000.0)}


@dataclass(frozen=True)
class JointSummary:
    """Extremes of one active joint, in SI units.

    Attributes:
        name: The joint.
        unit: Unit of its coordinate, "rad" or "m".
        lowest: Smallest coordinate.
        highest: Largest coordinate.
        peak_speed: Largest absolute velocity.
        peak_force: Largest absolute force or torque; None where nothing drives the joint.
        rms_force: Root of the time average of its square; likewise.
        peak_error: Largest distance from the reference; None without one.
        rms_error: Root of the time average of its square; None without one.
    """

    name: str
    unit: str
    lowest: float
    highest: float
    peak_speed: float
    peak_force: float | None
    rms_force: float | None
    peak_error: float | None
    rms_error: float | None


@dataclass(frozen=True)
class Summary:
    """Extremes of a recording.

    Attributes:
        duration: From the first sample to the last [s].
        joints: One entry per active joint.
        tip_peak_error: Largest distance of the tip from its reference [m]; None without one.
        tip_rms_error: Root of the time average of its square [m]; None without one.
    """

    duration: float
    joints: tuple[JointSummary, ...]
    tip_peak_error: float | None
    tip_rms_error: float | None

    def to_markdown(self) -> str:
        """A table with one row per joint, in degrees and millimetres."""
        head = (
            "joint",
            "range",
            "peak speed",
            "peak force",
            "RMS force",
            "peak error",
            "RMS error",
        )
        rows = [head, ("---",) + ("---:",) * (len(head) - 1)]
        for joint in self.joints:
            unit, scale = READING_UNITS[joint.unit]
            force = FORCE_UNITS[joint.unit]
            rows.append(
                (
                    joint.name,
                    f"{scale * joint.lowest:z.2f} to {scale * joint.highest:z.2f} {unit}",
                    f"{scale * joint.peak_speed:.2f} {unit}/s",
                    *(
                        "free" if x is None else quantity(x, force, 4)
                        for x in (joint.peak_force, joint.rms_force)
                    ),
                    _measure(joint.peak_error, scale, unit),
                    _measure(joint.rms_error, scale, unit),
                )
            )
        if self.tip_peak_error is not None:
            errors = (_measure(x, 1e3, "mm") for x in (self.tip_peak_error, self.tip_rms_error))
            rows.append(("tip", "", "", "", "", *errors))
        return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def title(machine: str, what: str = "") -> str:
    """What results are headed with, as figures, pages and tables alike: "patu655: swing"."""
    return ": ".join(word for word in (machine, what) if word)


def subject(recording: Recording, otherwise: str = "") -> str:
    """Name of what a recording is of: of the bundled machine or file that it names, or else."""
    return Path(unchanged(recording.machine)).stem or otherwise


def summarize(recording: Recording) -> Summary:
    """Ranges, peaks, RMS values and tracking errors of a recording.

    Tracking errors need the channels reference_<joint> and reference_tip_x, _y, _z beside tip_x,
    _y, _z.
    """
    time, channels = recording.time, recording.channels
    joints = []
    for i, name in enumerate(recording.joints):
        q, v, tau = recording.q[:, i], recording.v[:, i], recording.tau[:, i]
        reference = channels.get(f"reference_{name}")
        error = None if reference is None else q - reference
        joints.append(
            JointSummary(
                name=name,
                unit=recording.units[name],
                lowest=float(q.min()),
                highest=float(q.max()),
                peak_speed=_peak(v),
                peak_force=None if name in recording.free else _peak(tau),
                rms_force=None if name in recording.free else rms(time, tau),
                peak_error=None if error is None else _peak(error),
                rms_error=None if error is None else rms(time, error),
            )
        )
    tip, reference_tip = points(recording, "tip"), points(recording, "reference_tip")
    distance = None
    if tip is not None and reference_tip is not None:
        distance = np.linalg.norm(tip - reference_tip, axis=1)
    return Summary(
        duration=float(time[-1] - time[0]),
        joints=tuple(joints),
        tip_peak_error=None if distance is None else _peak(distance),
        tip_rms_error=None if distance is None else rms(time, distance),
    )


def points(recording: Recording, name: str) -> Array | None:
    """The channels <name>_x, <name>_y, <name>_z as (N, 3) [m], None if one is not there."""
    columns = [recording.channels.get(f"{name}_{axis}") for axis in "xyz"]
    if any(column is None for column in columns):
        return None
    return np.column_stack([column for column in columns if column is not None])


def rms(time: Array, values: Array) -> float:
    """Root of the time average of the square, by the trapezoidal rule.

    Args:
        time: Instants (N,) [s].
        values: Samples (N,).
    """
    if len(time) == 1:
        return float(abs(values[0]))
    return float(np.sqrt(np.trapezoid(values**2, time) / (time[-1] - time[0])))


def _peak(values: Array) -> float:
    return float(np.max(np.abs(values)))


def _measure(value: float | None, scale: float, unit: str) -> str:
    return "" if value is None else f"{scale * value:.3f} {unit}"
