"""A recording's columns as a page plots them: grouped, in units to read, thinned out.

A column of few samples is kept as it is. Of more, the page has the lowest and highest value in
each of many spans of time, so that no peak is lost, and the samples at the frames, which are the
values at the cursor.
"""

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from crane.common.samples import Array
from crane.common.scratch import in_blocks, release
from crane.common.units import reading
from crane.machine import Machine
from crane.recordings.recording import FORCE_UNITS, REFERENCE, VELOCITY, VELOCITY_UNITS
from crane.view.page.arrays import packed

if TYPE_CHECKING:
    from crane.recordings.recording import Recording

SPANS = 4000  # of time, in a short recording
SPANS_PER_SECOND = 15.0  # in a long one
MOST_SPANS = 1_100_000  # in all columns of a page
SHOWN = 8  # lines that a plot shows at first

ANGLES, STROKES, ERRORS = "Angles", "Strokes", "Errors"
TORQUES, FORCES = "Torques", "Forces"
# Groups in the order of the page; those of the first tuple are open at first.
OPEN = (
    STROKES, FORCES, "Pressures", ANGLES, TORQUES, ERRORS, "Stroke velocities",
    "Angular velocities",
)  # fmt: skip
CLOSED = (
    "Valve voltages", "Spools", "Flows", "Tip", "Passive angles", "Passive strokes",
    "Passive velocities", "Friction", "Energies", "Powers", "Volumes", "Signals", "Other",
)  # fmt: skip
_BY_UNIT = {
    "Pa": "Pressures", "V": "Valve voltages", "m3/s": "Flows", "J": "Energies", "W": "Powers",
    "m3": "Volumes", "": "Signals",
}  # fmt: skip
_PREFIXES = ("pressure_", "voltage_", "spool_", "flow_", "friction_")
_ERROR = "error_"  # of a joint to its reference


@dataclass(frozen=True, eq=False)
class Column:
    """One column of a recording, in SI units.

    Attributes:
        name: As in the recording's file.
        group: Title of the group it is plotted in.
        label: What the plot calls it.
        unit: Its unit.
        values: (N,).
        reference: (N,) what it should be; None if not recorded.
        limits: Limits of a coordinate.
    """

    name: str
    group: str
    label: str
    unit: str
    values: Array
    reference: Array | None = None
    limits: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Grid:
    """How the samples of one recording are thinned out.

    Attributes:
        time: (N,) of the samples [s].
        frames: Samples that are frames.
        starts: First sample of each span; None where every sample is kept.
    """

    time: Array
    frames: np.ndarray
    starts: np.ndarray | None

    @classmethod
    def of(cls, recording: "Recording", frames: np.ndarray, share: float = 1.0) -> "Grid":
        """Spans for a recording that takes a share of the page."""
        time, columns = recording.time, 1 + 3 * len(recording.joints) + len(recording.channels)
        wanted = max(SPANS, int(SPANS_PER_SECOND * (time[-1] - time[0])))
        count = max(min(wanted, int(share * MOST_SPANS / columns)), 500)
        if len(time) <= 2 * count:
            return cls(time, frames, None)
        return cls(time, frames, np.arange(count) * len(time) // count)

    def axis(self) -> dict[str, Any]:
        """Times of what `series` keeps, and where the frames are among them."""
        if self.starts is None:
            return {"time": packed(self.time, "f8"), "rows": packed(self.frames, "u4")}
        ends = np.append(self.starts[1:], len(self.time)) - 1
        return {"time": packed((self.time[self.starts] + self.time[ends]) / 2, "f8"), "rows": ""}

    def series(self, values: Array) -> dict[str, str]:
        """Values (N,) thinned out: lowest and highest of each span, samples at the frames."""
        if self.starts is None:
            return {"low": packed(values, "f4"), "high": "", "frames": ""}
        return {
            "low": packed(np.minimum.reduceat(values, self.starts), "f4"),
            "high": packed(np.maximum.reduceat(values, self.starts), "f4"),
            "frames": packed(values[self.frames], "f4"),
        }


def _series(column: Column, grid: Grid, scale: float) -> dict[str, Any]:
    """The values of a column, of its reference and its limits."""
    found: dict[str, Any] = {"series": grid.series(scale * column.values)}
    if column.reference is not None:
        found["reference"] = grid.series(scale * column.reference)
    if column.limits is not None:
        found["limits"] = [scale * x if np.isfinite(x) else None for x in column.limits]
    return found


def groups(
    machine: Machine,
    recording: "Recording",
    grid: Grid,
    other: "tuple[Recording, Grid] | None" = None,
) -> list[dict[str, Any]]:
    """Everything that a page plots, by group.

    Args:
        machine: The machine.
        recording: What it did.
        grid: How its samples are thinned out.
        other: A second recording, with its grid: its columns of the same names are second lines.
    """
    sorted_in: dict[tuple[str, str], list[Column]] = {}
    for column in columns(machine, recording):
        sorted_in.setdefault((column.group, column.unit), []).append(column)
    second = {} if other is None else {x.name: x for x in columns(machine, other[0])}
    order = [*OPEN, *CLOSED]
    found = []
    for title, unit in sorted(sorted_in, key=lambda key: order.index(key[0])):
        members = sorted_in[title, unit]
        peak = max(_peak(column.values) for column in members)
        shown, scale = reading(unit, peak)
        lines = []
        for index, (column, hue, shade) in enumerate(_coloured(machine, members)):
            release()
            line = {
                "name": column.name,
                "label": column.label,
                "hue": hue,
                "shade": shade,
                "shown": index < SHOWN,
                **_series(column, grid, scale),
            }
            there = second.get(column.name)
            if other is not None and there is not None and there.unit == unit:
                line["other"] = other[1].series(scale * there.values)
            lines.append(line)
        moves = len(recording.time) == 1 or any(_varies(column.values) for column in members)
        release()
        found.append(
            {
                "title": title,
                "unit": shown,
                "open": moves and title in OPEN,
                "lines": lines,
            }
        )
    return found


def columns(machine: Machine, recording: "Recording") -> Iterator[Column]:
    """All columns but time, each in its group; references with what they are references of.

    Beside them what follows from them: errors, references less coordinates, and the sum of
    kinetic and potential energy.
    """
    channels = recording.channels
    used = set()

    def reference(name: str) -> Array | None:
        used.add(REFERENCE + name)
        return channels.get(REFERENCE + name)

    for i, joint in enumerate(recording.joints):
        unit = recording.units[joint]
        turns, passive = unit == "rad", joint not in machine.active
        column = machine.column(joint)
        low, high = (
            float(limits[column])
            for limits in (machine.coordinates.lower, machine.coordinates.upper)
        )
        titles = (
            [ANGLES, "Angular velocities", TORQUES]
            if turns
            else [STROKES, "Stroke velocities", FORCES]
        )
        if passive:
            titles = [
                "Passive angles" if turns else "Passive strokes",
                "Passive velocities",
                "Other",
            ]
        yield Column(
            joint, titles[0], joint, unit, recording.q[:, i], reference(joint), (low, high)
        )
        rates = VELOCITY_UNITS[unit]
        wanted = reference(f"velocity_{joint}")
        yield Column(joint + VELOCITY, titles[1], joint, rates, recording.v[:, i], wanted)
        if REFERENCE + joint in channels:
            yield Column(_ERROR + joint, ERRORS, joint, unit, recording.error(joint))
        if joint in recording.free:
            continue
        yield Column(f"{joint}_force", titles[2], joint, FORCE_UNITS[unit], recording.tau[:, i])
    for name, values in channels.items():
        if name.startswith(REFERENCE):
            continue
        unit = recording.channel_units[name]
        if not unit and name in machine.joints:
            unit = machine.unit(name)
        group, label = _place(machine, name, unit)
        yield Column(name, group, label, unit, values, reference(name))
        if name == "potential" and unit == recording.channel_units.get("kinetic") == "J":
            both = "kinetic + potential"
            yield Column(both, group, both, unit, _sum(channels["kinetic"], values))
    for name, values in channels.items():
        if name.startswith(REFERENCE) and name not in used:
            yield Column(name, "Other", name, recording.channel_units[name], values)


def _sum(one: Array, other: Array) -> Array:
    return in_blocks(lambda part: (one[part] + other[part])[:, None], len(one))[:, 0]


def _place(machine: Machine, name: str, unit: str) -> tuple[str, str]:
    """Group and label of a channel."""
    if name in machine.joints:
        return ("Passive strokes" if machine.unit(name) == "m" else "Passive angles"), name
    joint = name.removesuffix(VELOCITY)
    if joint in machine.joints:
        return "Passive velocities", joint
    if name in ("tip_x", "tip_y", "tip_z"):
        return "Tip", name[-1]
    prefix = next((x for x in _PREFIXES if name.startswith(x)), "")
    label = name.removeprefix(prefix)
    if prefix == "friction_":
        return "Friction", label
    if prefix == "spool_":
        return "Spools", label
    return _BY_UNIT.get(unit, "Other"), label if unit in _BY_UNIT else name


def _peak(values: Array) -> float:
    release()
    return float(np.abs(values).max())


def _varies(values: Array) -> bool:
    """Whether a column is more than a constant and rounding noise."""
    return float(np.ptp(values)) > 1e-9 * max(1.0, _peak(values))


def _coloured(machine: Machine, members: list[Column]) -> Iterator[tuple[Column, int, int]]:
    """Each column with a hue, the same for one joint everywhere, and a shade of it."""
    hues: Mapping[str, int] = {joint: i for i, joint in enumerate(machine.active)}
    taken: dict[int, int] = {}
    for column in members:
        # the longest name is meant: X_ext is no part of X_extra
        joints = [x for x in hues if f"_{x}_" in f"_{column.name}_"]
        if joints:
            hue = hues[max(joints, key=len)]
        else:
            hue = next(free for free in itertools.count() if free not in taken)
        shade = taken.get(hue, 0)
        taken[hue] = shade + 1
        yield column, hue, shade
