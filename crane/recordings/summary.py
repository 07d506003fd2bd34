"""The few numbers that sum a recording up."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.samples import Array
from crane.common.scratch import in_blocks, release
from crane.common.units import quantity
from crane.description.sources import unchanged
from crane.recordings.limit_cycles import ringing
from crane.recordings.recording import FORCE_UNITS, REFERENCE, Recording

SUPPORT = "support_"
_LIFTED = 0.05  # [s] in the air that is worth telling

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
        stability: How far it is from tipping, in words, "" where that is not recorded.
        balance: How far the balance of energy is off, see `energy_balance`, likewise.
        ringing: Pressures that swing without decaying, see `limit_cycles`, likewise.
        stopped: When and why it ended before its time, "" if it did not.
        start: How it starts where that is not what the machine's file says.
    """

    duration: float
    joints: tuple[JointSummary, ...]
    tip_peak_error: float | None
    tip_rms_error: float | None
    stability: str = ""
    balance: str = ""
    ringing: str = ""
    stopped: str = ""
    start: str = ""

    def to_markdown(self) -> str:
        """A table with one row per joint, in degrees and millimetres, and what is to be said."""
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
        table = "".join(f"| {' | '.join(row)} |\n" for row in rows)
        balance = f"energy balance: {self.balance}" if self.balance else ""
        start = f"starts {self.start}" if self.start else ""
        end = f"**Stopped {self.stopped}**\n\n" if self.stopped else ""
        below = (f"{text}\n" for text in (start, self.stability, self.ringing, balance) if text)
        return end + "\n".join([table, *below])


def tipping(recording: Recording) -> str:
    """What to say of supports that lift, or would if they could, else nothing.

    By the channels stability, stability_<line> and support_<name>, see `crane.dynamics.stability`.
    """
    time, seen = recording.time, recording.channels
    if "stability" not in seen:
        return ""
    names = [x.removeprefix(SUPPORT) for x in seen if x.startswith(SUPPORT)]
    if any(f"work_{name}" in seen for name in names):  # contacts
        lifted = {name: _lifted(time, seen[SUPPORT + name]) for name in names}
        words = [f"'{name}' at t = {at:.4g} s" for name, at in lifted.items() if at is not None]
        return f"supports lift: {', '.join(words)}" if words else ""
    if seen["stability"].min() >= 0:
        return ""
    first = int(np.argmax(seen["stability"] < 0))
    lines = {x: seen[x] for x in seen if x.startswith("stability_")}
    line = min(lines, key=lambda x: float(lines[x][first]))
    return (
        f"it would tip at t = {time[first]:.4g} s, where it is fixed all the same: {line} is "
        f"{lines[line].min():.3g} N m at worst; let a machine that may tip float on contacts"
    )


def _lifted(time: Array, force: Array) -> float | None:
    """When what has stood is in the air for a while [s]."""
    up = (force <= 0) & np.maximum.accumulate(force > 0)
    edges = np.flatnonzero(np.diff(up.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    long = [first for first, behind in edges.tolist() if time[behind - 1] - time[first] > _LIFTED]
    return float(time[long[0]]) if long else None


def _stability(recording: Recording) -> str:
    if "stability" not in recording.channels:
        return ""
    shares, still = (recording.channels[x] for x in ("stability", "static_stability"))
    least = int(np.argmin(shares))
    text = (
        f"stability: at least {100 * shares[least]:.1f} % of the weight hold it down, at t = "
        f"{recording.time[least]:.4g} s (at rest {100 * still.min():.1f} %)"
    )
    told = tipping(recording)
    return f"{text}; {told}" if told else text


def title(machine: str, what: str = "") -> str:
    """What results are headed with, as figures, pages and tables alike: "patu655: swing"."""
    return ": ".join(word for word in (machine, what) if word)


def subject(recording: Recording) -> str:
    """Name of what a recording is of: the machine's own, or else of the file that it names."""
    return recording.machine_name or Path(unchanged(recording.machine)).stem


def label(recording: Recording) -> str:
    """What a recording shows: its task, and until when where it was stopped."""
    until = f"(stopped at {recording.time[-1]:.4g} s)" if recording.stopped else ""
    return f"{recording.task} {until}".strip()


def heading(recording: Recording) -> str:
    """What its results are headed with."""
    return title(subject(recording), label(recording))


def summarize(recording: Recording) -> Summary:
    """Ranges, peaks, RMS values and tracking errors of a recording.

    Tracking errors need the channels reference_<joint> and reference_tip_x, _y, _z beside tip_x,
    _y, _z.
    """
    time, channels = recording.time, recording.channels
    joints = []
    for i, name in enumerate(recording.joints):
        release()
        q, v, tau = recording.q[:, i], recording.v[:, i], recording.tau[:, i]
        error = recording.error(name) if REFERENCE + name in channels else None
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
    return Summary(
        duration=float(time[-1] - time[0]),
        joints=tuple(joints),
        tip_peak_error=None if distance is None else _peak(distance),
        tip_rms_error=None if distance is None else rms(time, distance),
        stability=_stability(recording),
        balance=_balance(recording),
        ringing=ringing(recording),
        stopped=recording.stopped,
        start=recording.start,
    )


def energy_balance(recording: Recording) -> Array | None:
    """Energy (N,) that came from nowhere since the start [J], None where it is not recorded.

    kinetic + potential + dissipated less work of the active forces and of the loads, less its
    first value: zero but for the error of the integration. The work of a circuit's forces is in
    `work`, see `oil_balance` for where that comes from.
    """
    loads = [x for x in recording.channels if x.startswith("work_")]
    return _off(recording, ("kinetic", "potential", "dissipated"), ("work", *loads))


def oil_balance(recording: Recording) -> Array | None:
    """The same of a circuit: work + hydraulic_loss + oil_energy less pump_work (N,) [J]."""
    return _off(recording, ("work", "hydraulic_loss", "oil_energy"), ("pump_work",))


def _off(recording: Recording, held: Sequence[str], given: Sequence[str]) -> Array | None:
    """What channels hold [J] beyond what was given since the start; None if one is not there."""
    seen, units = recording.channels, recording.channel_units
    if any(units.get(name) != "J" for name in (*held, *given)):
        return None

    def since_start(names: Sequence[str], part: slice) -> Array:
        return np.sum([seen[name][part] - seen[name][0] for name in names], axis=0)

    return in_blocks(
        lambda part: (since_start(held, part) - since_start(given, part))[:, None],
        len(recording.time),
    )[:, 0]


def _balance(recording: Recording) -> str:
    balances = (("", energy_balance(recording)), ("of the oil ", oil_balance(recording)))
    return ", ".join(
        f"{what}off by at most {_peak(gap):.2g} J" for what, gap in balances if gap is not None
    )


def points(recording: Recording, name: str) -> Array | None:
    """The channels <name>_x, <name>_y, <name>_z as (N, 3) [m], None if one is not there."""
    axes = [f"{name}_{axis}" for axis in "xyz"]
    if any(axis not in recording.channels for axis in axes):
        return None
    columns = [recording.channels[axis] for axis in axes]
    return in_blocks(lambda part: np.column_stack([x[part] for x in columns]), len(recording.time))


def tip_error(recording: Recording) -> Array | None:
    """Distance (N,) of the tip from its reference [m], None if one is not there."""
    tip, wanted = points(recording, "tip"), points(recording, "reference_tip")
    if tip is None or wanted is None:
        return None
    return in_blocks(
        lambda part: np.linalg.norm(tip[part] - wanted[part], axis=1, keepdims=True), len(tip)
    )[:, 0]


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
