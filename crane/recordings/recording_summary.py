"""Summaries of recordings, and differences between two of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.samples import Array, true_runs
from crane.common.scratch_arrays import compute_in_blocks, release_pages
from crane.common.units import display_unit, format_number, format_quantity
from crane.description.machine_lookup import without_changes
from crane.recordings.limit_cycle_detection import limit_cycle_message
from crane.recordings.recording import FORCE_UNITS, REFERENCE_PREFIX, Recording

SUPPORT_PREFIX = "support_"
_MIN_LIFT_DURATION = 0.05  # [s] without ground contact that is reported
# display unit of a coordinate, and its number per rad or m
DISPLAY_UNITS = {"rad": ("deg", 180.0 / np.pi), "m": ("mm", 1000.0)}


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
        rms_force: Root mean square of the force over time; None likewise.
        peak_error: Largest distance from the reference; None without one.
        rms_error: Root mean square of the error over time; None without one.
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
class RecordingSummary:
    """Summary of a recording.

    Attributes:
        duration: Duration [s].
        joints: One entry per active joint.
        tip_peak_error: Largest distance of the tip from its reference [m]; None without one.
        tip_rms_error: Root mean square of it over time [m]; None without one.
        stability_text: Text of the stability margin, "" if it is not recorded.
        balance_text: Text of the energy imbalance, see `energy_imbalance`, "" likewise.
        ringing: Text of pressures in a limit cycle, see `limit_cycles`, "" likewise.
        stopped: Time and reason of an early end, "" if there is none.
        start: Description of a start other than that of the machine file, else "".
    """

    duration: float
    joints: tuple[JointSummary, ...]
    tip_peak_error: float | None
    tip_rms_error: float | None
    stability_text: str = ""
    balance_text: str = ""
    ringing: str = ""
    stopped: str = ""
    start: str = ""

    def to_markdown(self) -> str:
        """Table with one row per joint, in degrees and millimetres, and remarks below it."""
        rows: list[tuple[str, ...]] = [
            (
                "joint",
                "position range",
                "peak speed",
                "peak force",
                "RMS force",
                "peak tracking error",
                "RMS tracking error",
            ),  # fmt: skip
            ("---", *["---:"] * 6),
        ]
        for joint in self.joints:
            unit, scale = DISPLAY_UNITS[joint.unit]
            force = FORCE_UNITS[joint.unit]
            rows.append(
                (
                    joint.name,
                    f"{scale * joint.lowest:z.2f} to {scale * joint.highest:z.2f} {unit}",
                    f"{scale * joint.peak_speed:.2f} {unit}/s",
                    *(
                        "free" if x is None else format_quantity(x, force, 4)
                        for x in (joint.peak_force, joint.rms_force)
                    ),
                    _format_value(joint.peak_error, scale, unit),
                    _format_value(joint.rms_error, scale, unit),
                )
            )
        if self.tip_peak_error is not None:
            errors = (
                _format_value(x, 1e3, "mm") for x in (self.tip_peak_error, self.tip_rms_error)
            )
            rows.append(("tip", "", "", "", "", *errors))
        table = "".join(f"| {' | '.join(row)} |\n" for row in rows)
        balance = f"maximum energy imbalance: {self.balance_text}" if self.balance_text else ""
        start = f"starts {self.start}" if self.start else ""
        end = f"**Stopped {self.stopped}**\n\n" if self.stopped else ""
        below = (
            f"{text}\n" for text in (start, self.stability_text, self.ringing, balance) if text
        )
        return end + "\n".join([table, *below])


def tipping_message(recording: Recording) -> str:
    """Message about supports that lift, or of a fixed machine that would tip, else "".

    It uses the channels stability, stability_<line> and support_<name>, see
    `crane.dynamics.tipping_stability`.
    """
    time, channels = recording.time, recording.channels
    if "stability" not in channels:
        return ""
    names = [x.removeprefix(SUPPORT_PREFIX) for x in channels if x.startswith(SUPPORT_PREFIX)]
    if any(f"work_{name}" in channels for name in names):  # contacts
        lifted = {name: _lift_time(time, channels[SUPPORT_PREFIX + name]) for name in names}
        words = [f"'{name}' at t = {at:.4g} s" for name, at in lifted.items() if at is not None]
        return f"supports lift: {', '.join(words)}" if words else ""
    if channels["stability"].min() >= 0:
        return ""
    first = int(np.argmax(channels["stability"] < 0))
    lines = {x: channels[x] for x in channels if x.startswith("stability_")}
    line = min(lines, key=lambda x: float(lines[x][first]), default="")
    worst = f"{line} is {lines[line].min():.3g} N m at worst; " if line else ""
    return (
        f"it would tip at t = {time[first]:.4g} s, where it is fixed all the same: {worst}let a "
        "machine that may tip float on contacts"
    )


def _lift_time(time: Array, force: Array) -> float | None:
    """Time [s] at which a support with contact force (N,) lifts, None if it does not."""
    is_lifted = (force <= 0) & np.maximum.accumulate(force > 0)
    starts = (
        a for a, b in true_runs(is_lifted).tolist() if time[b - 1] - time[a] > _MIN_LIFT_DURATION
    )
    return next((float(time[first]) for first in starts), None)


def _stability_text(recording: Recording) -> str:
    if "stability" not in recording.channels:
        return ""
    shares, static_shares = (recording.channels[x] for x in ("stability", "static_stability"))
    least = int(np.argmin(shares))
    text = (
        f"stability: at least {100 * shares[least]:.1f} % of the weight hold it down, at t = "
        f"{recording.time[least]:.4g} s (at rest {100 * static_shares.min():.1f} %)"
    )
    return "; ".join(filter(None, (text, tipping_message(recording))))


def result_title(machine: str, what: str = "") -> str:
    """Title of results in figures, pages and tables, such as "patu655: swing"."""
    return ": ".join(word for word in (machine, what) if word)


def recorded_machine_name(recording: Recording) -> str:
    """Name of the recorded machine: its own, or else that of its file."""
    return recording.machine_name or Path(without_changes(recording.machine)).stem


def label(recording: Recording) -> str:
    """Label of a recording: its task, and its end if it was stopped."""
    until = f"(stopped at {recording.time[-1]:.4g} s)" if recording.stopped else ""
    return f"{recording.task} {until}".strip()


def heading(recording: Recording) -> str:
    """Title of the results of a recording: machine and label."""
    return result_title(recorded_machine_name(recording), label(recording))


def summarize(recording: Recording) -> RecordingSummary:
    """Compute ranges, peaks, RMS values and tracking errors of a recording.

    Tracking errors need the channels reference_<joint>, reference_tip_x, _y, _z and tip_x, _y, _z.
    """
    time, channels = recording.time, recording.channels
    joints = []
    for i, name in enumerate(recording.joints):
        release_pages()
        q, v, tau = recording.q[:, i], recording.v[:, i], recording.tau[:, i]
        error = recording.error(name) if REFERENCE_PREFIX + name in channels else None
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
    distance = tip_error(recording)
    gaps = ("mechanism", energy_imbalance(recording)), ("oil", oil_energy_imbalance(recording))
    return RecordingSummary(
        duration=float(time[-1] - time[0]),
        joints=tuple(joints),
        tip_peak_error=None if distance is None else _peak(distance),
        tip_rms_error=None if distance is None else rms(time, distance),
        stability_text=_stability_text(recording),
        balance_text=", ".join(
            f"{_peak(gap):.2g} J ({what})" for what, gap in gaps if gap is not None
        ),
        ringing=limit_cycle_message(recording),
        stopped=recording.stopped,
        start=recording.start,
    )


def energy_imbalance(recording: Recording) -> Array | None:
    """Energy imbalance (N,) since the start [J], None if it is not recorded.

    It is kinetic + potential + dissipated energy minus the work of active forces and loads, minus
    its first value: zero except for integration errors. `work` includes the forces of a circuit;
    `oil_energy_imbalance` is the balance of the circuit.
    """
    loads = [x for x in recording.channels if x.startswith("work_")]
    return _energy_difference(recording, ("kinetic", "potential", "dissipated"), ("work", *loads))


def oil_energy_imbalance(recording: Recording) -> Array | None:
    """Energy imbalance (N,) of a circuit [J]: work + hydraulic_loss + oil_energy - pump_work."""
    return _energy_difference(recording, ("work", "hydraulic_loss", "oil_energy"), ("pump_work",))


def _energy_difference(
    recording: Recording, stored_channels: Sequence[str], supplied_channels: Sequence[str]
) -> Array | None:
    """Stored minus supplied energy since the start [J]; None if a channel is missing."""
    seen, units = recording.channels, recording.channel_units
    if any(units.get(name) != "J" for name in (*stored_channels, *supplied_channels)):
        return None

    def since_start(names: Sequence[str], part: slice) -> Array:
        return np.sum([seen[name][part] - seen[name][0] for name in names], axis=0)

    return compute_in_blocks(
        lambda part: (since_start(stored_channels, part) - since_start(supplied_channels, part))[
            :, None
        ],
        len(recording.time),
    )[:, 0]


def point_channel(recording: Recording, name: str) -> Array | None:
    """Channels <name>_x, <name>_y, <name>_z as (N, 3) [m], None if one is missing."""
    axes = [f"{name}_{axis}" for axis in "xyz"]
    if any(axis not in recording.channels for axis in axes):
        return None
    columns = [recording.channels[axis] for axis in axes]
    return compute_in_blocks(
        lambda part: np.column_stack([x[part] for x in columns]), len(recording.time)
    )


def tip_error(recording: Recording) -> Array | None:
    """Distance (N,) of the tip from its reference [m], None if a channel is missing."""
    tip, reference = point_channel(recording, "tip"), point_channel(recording, "reference_tip")
    if tip is None or reference is None:
        return None
    return compute_in_blocks(
        lambda part: np.linalg.norm(tip[part] - reference[part], axis=1, keepdims=True), len(tip)
    )[:, 0]


def rms(time: Array, values: Array) -> float:
    """Root mean square over time, by the trapezoidal rule.

    Args:
        time: Instants (N,) [s].
        values: Samples (N,).
    """
    if len(time) == 1:
        return float(abs(values[0]))
    return float(np.sqrt(np.trapezoid(values**2, time) / (time[-1] - time[0])))


def _peak(values: Array) -> float:
    return float(np.max(np.abs(values)))


def _format_value(value: float | None, scale: float, unit: str) -> str:
    return "" if value is None else f"{scale * value:.3f} {unit}"


@dataclass(frozen=True)
class JointDifference:
    """Largest difference of two recordings in one joint.

    Attributes:
        joint: The joint.
        unit: Unit of its coordinate, "rad" or "m".
        largest: Largest difference of the coordinates.
        time: Time of it [s] by the clock of the first recording.
    """

    joint: str
    unit: str
    largest: float
    time: float

    @property
    def formatted(self) -> tuple[str, str]:
        """Texts of difference and time in display units."""
        unit, scale = display_unit(self.unit, 0.0)
        return f"{format_number(scale * self.largest)} {unit}", f"{self.time:.4g} s"


def clock_shift(recording: Recording, other: Recording) -> float:
    """Shift of the second clock [s]: 0, or a common start if the recordings do not overlap."""
    is_disjoint = other.time[0] > recording.time[-1] or other.time[-1] < recording.time[0]
    return float(recording.time[0] - other.time[0]) if is_disjoint else 0.0


def joint_differences(recording: Recording, other: Recording) -> list[JointDifference]:
    """Largest difference in each joint over the common time of two recordings.

    Differences are taken at the samples of both, with linear interpolation.
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
        found.append(
            JointDifference(
                joint,
                recording.units[joint],
                float(distance[largest_index]),
                float(time[largest_index]),
            )
        )
    return found
