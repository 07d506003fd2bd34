"""Plot data of a page: columns of a recording, grouped, in display units, thinned.

Short columns are complete. Of long columns, the page has the smallest and the largest value in
each of many time spans, so that no peak is lost, and the samples at the frames, for the cursor.
"""

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from crane.common.samples import Array
from crane.common.scratch_arrays import compute_in_blocks, release_pages
from crane.common.units import display_unit
from crane.machine.machine import Machine
from crane.recordings.recording import (
    FORCE_UNITS,
    REFERENCE_PREFIX,
    VELOCITY_SUFFIX,
    VELOCITY_UNITS,
    Recording,
)
from crane.view.page.page_motion import pack_base64

MIN_SPANS = 4000  # of time, in a short recording
SPANS_PER_SECOND = 15.0  # in a long one
MAX_SPANS = 1_100_000  # in all columns of a page
INITIALLY_SHOWN = 8  # lines that a plot shows at first

ANGLES, STROKES, ERRORS = "Angles", "Strokes", "Errors"
TORQUES, FORCES = "Torques", "Forces"
# Groups in the order of the page; those of the first tuple are open at first.
OPEN_GROUPS = (
    STROKES, FORCES, "Pressures", ANGLES, TORQUES, ERRORS, "Stroke velocities",
    "Angular velocities",
)  # fmt: skip
CLOSED_GROUPS = (
    "Valve voltages", "Spools", "Flows", "Tip", "Passive angles", "Passive strokes",
    "Passive velocities", "Friction", "Energies", "Powers", "Volumes", "Signals", "Other",
)  # fmt: skip
_GROUP_BY_UNIT = {
    "Pa": "Pressures", "V": "Valve voltages", "m3/s": "Flows", "J": "Energies", "W": "Powers",
    "m3": "Volumes", "": "Signals",
}  # fmt: skip
_PREFIXES = ("pressure_", "voltage_", "spool_", "flow_", "friction_")
_GROUP_BY_PREFIX = {"friction_": "Friction", "spool_": "Spools"}
# Groups of coordinate, velocity and force by the unit of a joint and whether it is passive.
_JOINT_GROUPS = {
    ("rad", False): (ANGLES, "Angular velocities", TORQUES),
    ("m", False): (STROKES, "Stroke velocities", FORCES),
    ("rad", True): ("Passive angles", "Passive velocities", "Other"),
    ("m", True): ("Passive strokes", "Passive velocities", "Other"),
}
_ERROR_PREFIX = "error_"  # of a joint to its reference


@dataclass(frozen=True, eq=False)
class PageColumn:
    """One column of a recording, in SI units.

    Attributes:
        name: Name in the recording.
        group: Title of its plot group.
        label: Label in the plot.
        unit: Its unit.
        values: (N,).
        reference: (N,) reference; None if not recorded.
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
class ThinningGrid:
    """Grid on which the samples of a recording are thinned.

    Attributes:
        time: (N,) times of the samples [s].
        frame_rows: Rows of the samples that are frames.
        span_starts: First sample of each span; None if every sample is kept.
    """

    time: Array
    frame_rows: np.ndarray
    span_starts: np.ndarray | None

    @classmethod
    def from_recording(
        cls, recording: Recording, frame_rows: np.ndarray, page_share: float = 1.0
    ) -> "ThinningGrid":
        """Return a grid for a recording that takes a share of the page."""
        time, columns = recording.time, 1 + 3 * len(recording.joints) + len(recording.channels)
        wanted_spans = max(MIN_SPANS, int(SPANS_PER_SECOND * (time[-1] - time[0])))
        count = max(min(wanted_spans, int(page_share * MAX_SPANS / columns)), 500)
        if len(time) <= 2 * count:
            return cls(time, frame_rows, None)
        return cls(time, frame_rows, np.arange(count) * len(time) // count)

    def time_axis(self) -> dict[str, Any]:
        """Return the times of the values of `thin_out`, and the rows of the frames."""
        if self.span_starts is None:
            return {
                "time": pack_base64(self.time, "f8"),
                "rows": pack_base64(self.frame_rows, "u4"),
            }
        return {
            "time": pack_base64(
                (
                    self.time[self.span_starts]
                    + self.time[(np.append(self.span_starts[1:], len(self.time)) - 1)]
                )
                / 2,
                "f8",
            ),
            "rows": "",
        }

    def thin_out(self, values: Array) -> dict[str, str]:
        """Return smallest and largest of values (N,) in each span, and the values at frames."""
        if self.span_starts is None:
            return {"low": pack_base64(values, "f4"), "high": "", "frames": ""}
        return {
            "low": pack_base64(np.minimum.reduceat(values, self.span_starts), "f4"),
            "high": pack_base64(np.maximum.reduceat(values, self.span_starts), "f4"),
            "frames": pack_base64(values[self.frame_rows], "f4"),
        }


def plot_groups(
    machine: Machine,
    recording: Recording,
    grid: ThinningGrid,
    second_recording: tuple[Recording, ThinningGrid] | None = None,
) -> list[dict[str, Any]]:
    """Return the plot data of a page by group.

    Args:
        machine: The machine.
        recording: Recording of its run.
        grid: Grid on which its samples are thinned.
        second_recording: Second recording with its grid; its columns are drawn as second lines.
    """
    columns_by_group: dict[tuple[str, str], list[PageColumn]] = {}
    for column in page_columns(machine, recording):
        columns_by_group.setdefault((column.group, column.unit), []).append(column)
    second_columns: dict[tuple[str, str], PageColumn] = {}
    if second_recording is not None:
        second_columns = {(x.name, x.unit): x for x in page_columns(machine, second_recording[0])}
    order = [*OPEN_GROUPS, *CLOSED_GROUPS]
    group_data = []
    for title, unit in sorted(columns_by_group, key=lambda key: order.index(key[0])):
        group_columns = columns_by_group[title, unit]
        peaks = [_peak_magnitude(column.values) for column in group_columns]
        shown_unit, scale = display_unit(unit, max(peaks))
        line_data = []
        for index, (column, hue, shade) in enumerate(_with_colours(machine, group_columns)):
            release_pages()
            line = {
                "name": column.name,
                "label": column.label,
                "hue": hue,
                "shade": shade,
                "shown": index < INITIALLY_SHOWN,
                "series": grid.thin_out(scale * column.values),
            }
            if column.reference is not None:
                line["reference"] = grid.thin_out(scale * column.reference)
            if column.limits is not None:
                line["limits"] = [scale * x if np.isfinite(x) else None for x in column.limits]
            second_column = second_columns.get((column.name, unit))
            if second_recording is not None and second_column is not None:
                line["other"] = second_recording[1].thin_out(scale * second_column.values)
            line_data.append(line)
        # whether a column varies by more than rounding errors
        release_pages()
        group_data.append(
            {
                "title": title,
                "unit": shown_unit,
                "open": (
                    len(recording.time) == 1
                    or any(
                        float(np.ptp(column.values)) > 1e-9 * max(1.0, peak)
                        for column, peak in zip(group_columns, peaks, strict=True)
                    )
                )
                and title in OPEN_GROUPS,
                "lines": line_data,
            }
        )
    return group_data


def page_columns(machine: Machine, recording: Recording) -> Iterator[PageColumn]:
    """Yield all columns except time, with their groups, and references with their columns.

    Errors (reference minus coordinate) and the sum of kinetic and potential energy are added.
    """
    channels, units = recording.channels, recording.channel_units
    used_references = set()

    def reference(name: str) -> Array | None:
        used_references.add(REFERENCE_PREFIX + name)
        return channels.get(REFERENCE_PREFIX + name)

    for i, joint in enumerate(recording.joints):
        unit, column = recording.units[joint], machine.column(joint)
        is_passive = joint not in machine.active
        lower, upper = (
            float(x[column]) for x in (machine.coordinates.lower, machine.coordinates.upper)
        )
        groups = _JOINT_GROUPS[unit, is_passive]
        values, velocity = recording.q[:, i], recording.v[:, i]
        yield PageColumn(joint, groups[0], joint, unit, values, reference(joint), (lower, upper))
        yield PageColumn(
            joint + VELOCITY_SUFFIX,
            groups[1],
            joint,
            VELOCITY_UNITS[unit],
            velocity,
            reference(f"velocity_{joint}"),
        )
        if REFERENCE_PREFIX + joint in channels:
            yield PageColumn(_ERROR_PREFIX + joint, ERRORS, joint, unit, recording.error(joint))
        if joint not in recording.free:
            yield PageColumn(
                f"{joint}_force", groups[2], joint, FORCE_UNITS[unit], recording.tau[:, i]
            )
    for name, values in channels.items():
        if name.startswith(REFERENCE_PREFIX):
            continue
        unit = units[name]
        if not unit and name in machine.joints:
            unit = machine.unit(name)
        group, label = _group_and_label(machine, name, unit)
        yield PageColumn(name, group, label, unit, values, reference(name))
        if name == "potential" and unit == units.get("kinetic") == "J":
            total = "kinetic + potential"
            energy = _sum_blockwise(channels["kinetic"], values)
            yield PageColumn(total, group, total, unit, energy)
    for name, values in channels.items():
        if name.startswith(REFERENCE_PREFIX) and name not in used_references:
            yield PageColumn(name, "Other", name, units[name], values)


def _sum_blockwise(first: Array, second: Array) -> Array:
    return compute_in_blocks(lambda part: (first[part] + second[part])[:, None], len(first))[:, 0]


def _group_and_label(machine: Machine, name: str, unit: str) -> tuple[str, str]:
    if name in machine.joints:
        return _JOINT_GROUPS[machine.unit(name), True][0], name
    joint = name.removesuffix(VELOCITY_SUFFIX)
    if joint in machine.joints:
        return "Passive velocities", joint
    if name in ("tip_x", "tip_y", "tip_z"):
        return "Tip", name[-1]
    prefix = next((x for x in _PREFIXES if name.startswith(x)), "")
    label = name.removeprefix(prefix)
    group = _GROUP_BY_PREFIX.get(prefix) or _GROUP_BY_UNIT.get(unit)
    return (group, label) if group else ("Other", name)


def _peak_magnitude(values: Array) -> float:
    release_pages()
    return float(np.abs(values).max())


def _with_colours(
    machine: Machine, group_columns: list[PageColumn]
) -> Iterator[tuple[PageColumn, int, int]]:
    """Yield each column with a hue, which is the same in all plots of a joint, and a shade."""
    hue_by_joint: Mapping[str, int] = {joint: i for i, joint in enumerate(machine.active)}
    used_hues: dict[int, int] = {}
    for column in group_columns:
        # the longest name is meant: X_ext is no part of X_extra
        joints = [x for x in hue_by_joint if f"_{x}_" in f"_{column.name}_"]
        if joints:
            hue = hue_by_joint[max(joints, key=len)]
        else:
            hue = next(free for free in itertools.count() if free not in used_hues)
        shade = used_hues.get(hue, 0)
        used_hues[hue] = shade + 1
        yield column, hue, shade
