"""Rated loads in words: what they hold for, by what they end, and their table as Markdown."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from crane.common.errors import SingularConfigurationError
from crane.common.units import format_quantity
from crane.ratings.drive_force_limits import drive_force_limits
from crane.ratings.limiting_factors import PIN_FORCE
from crane.ratings.load_tables import LoadTable

if TYPE_CHECKING:
    from crane.ratings.lifting_capacity import Capacity

_SIDE_NAMES = {0: "front", 90: "side", -90: "side", 180: "rear", -180: "rear"}  # [deg]
ASTERISK_NOTE = "* ended by drives, all others by tipping"


def capacity_facts(chart: "Capacity") -> list[tuple[str, str]]:
    """What the loads hold for: names, and what is said of each."""
    holding_joints = [
        joint for joint in chart.machine.driven_joints if joint not in chart.raising_joints
    ]
    raising_text = (", ".join(chart.raising_joints) or "nothing") + (
        f" ({', '.join(holding_joints)} held)" if holding_joints else ""
    )
    rows = [
        ("load", f"at '{chart.frame}', in kg; what is there already is no part of it"),
        ("rule", chart.rule.description),
        ("raised by", raising_text),
        (
            "ground",
            f"leans by {np.rad2deg(chart.ground_slope):.3g} degrees"
            if chart.ground_slope
            else "level",
        ),
    ]
    if chart.with_friction:
        rows.append(("friction", "overcome from rest by what raises"))
    return [*rows, ("limits", "; ".join(limit_texts(chart)))]


def limit_texts(chart: "Capacity") -> list[str]:
    """Of each drive its pressure or torque: "X_boom 350 bar (working pressure)"; of pins too."""
    out = []
    for drive in drive_force_limits(chart.machine, chart.raising_joints, chart.with_friction):
        if drive.chamber_pressures:
            pressure_texts = [
                format_quantity(pressure, "Pa", 4) for pressure in drive.chamber_pressures
            ]
            value = (
                pressure_texts[0]
                if pressure_texts[0] == pressure_texts[1]
                else f"A {pressure_texts[0]}, B {pressure_texts[1]}"
            )
        else:
            unit = "N" if chart.machine.unit(drive.joint) == "m" else "N m"
            value = format_quantity(drive.max_force, unit, 4)
        out.append(f"{drive.joint} {value} ({drive.limit_kind})")
    limited_pins = {cause.element for cause in chart.limiting_factors if cause.reason == PIN_FORCE}
    pins = {
        name: force for name, force in chart.machine.pin_capacities.items() if name in limited_pins
    }
    return out + [
        f"{name} {format_quantity(force, 'N', 4)} ({PIN_FORCE})" for name, force in pins.items()
    ]


def slew_labels(chart: "Capacity") -> list[str]:
    """What slew angles are called: front, side, rear or degrees; nothing of home alone."""
    slewing_joint = chart.section.slewing_joint
    if slewing_joint is None:
        return [""]
    home = chart.machine.home[chart.machine.closure.active[slewing_joint]]
    if len(chart.slews) == 1 and chart.slews[0] == home:
        return [""]
    degrees = [float(f"{x:.6g}") for x in np.rad2deg(chart.slews)]
    names = [_SIDE_NAMES.get(x, f"{x:.4g}°") for x in degrees]  # type: ignore[call-overload]
    return [
        name if names.count(name) == 1 else f"{x:.4g}°"
        for name, x in zip(names, degrees, strict=True)
    ]


def factor_shares(chart: "Capacity") -> list[tuple[str, float, float]]:
    """Causes that end loads, the share of all places where each does, and with another one."""
    all_places = max(int((~np.isnan(chart.loads)).sum()), 1)
    several = chart.together.sum(axis=-1) > 1
    share_rows = []
    for k in chart.active_factors:
        ends = chart.together[..., k]
        each, both = (float(x.sum()) / all_places for x in (ends, ends & several))
        share_rows.append((str(chart.limiting_factors[k]), each, both))
    return sorted(share_rows, key=lambda one: -one[1])


def table_headings(chart: "Capacity", table: LoadTable) -> list[str]:
    """Of the table's columns."""
    slew_names = slew_labels(chart)
    radius_labels = [f"{radius:g} m" for radius in table.radii] + ["farthest"]
    return [
        f"{chart.section.coordinate_names[1]} [m]",
        *(
            f"{radius_label} {slew_label}".strip()
            for radius_label in radius_labels
            for slew_label in slew_names
        ),
        "at [m]",
    ]


def to_markdown(chart: "Capacity") -> str:
    """What the loads hold for, their table, and what ends them."""
    table = chart.table
    rows = [
        [f"{height:g}", *row]
        for height, row in zip(table.heights, table.format_rows(), strict=True)
    ]
    lines = [f"# Lifting capacity of {chart.machine.name}\n"]
    lines += [f"- {name}: {text}" for name, text in capacity_facts(chart)]
    lines += [
        "",
        *_markdown_table(table_headings(chart, table), rows),
        "",
        table_note(chart, table),
    ]
    lines += ["\n| ended by | of all places | of all, with another |", "| --- | ---: | ---: |"]
    lines += [
        f"| {cause} | {100 * share:.3g} % | {100 * both:.3g} % |"
        for cause, share, both in factor_shares(chart)
    ]
    if rows := structural_rows(chart):
        lines += [
            "",
            *_markdown_table(
                ["under these loads", "", *chart.section.coordinate_names, "slew"], rows
            ),
        ]
    return "\n".join(lines) + "\n"


def structural_rows(chart: "Capacity") -> list[list[str]]:
    """What its parts bear, and where: the largest force in a pin, the least margin to buckling.

    Pins are left out on ground that leans, and where the passive joints are not determined.
    """
    machine, rows = chart.machine, []
    if not np.isfinite(chart.loads).any():
        return []
    prismatic_joints = [
        joint.name for joint in machine.tree.moving_joints if joint.kind == "prismatic"
    ]
    prismatic_joints += [
        loop.name for loop in machine.closure.equations.loops if loop.type == "prismatic"
    ]
    try:
        forces = {} if chart.ground_slope else chart.pin_forces()
    except SingularConfigurationError:
        forces = {}
    pins = {name: x for name, x in forces.items() if name not in prismatic_joints}
    if pins:
        name = max(pins, key=lambda pin: np.nanmax(pins[pin]))
        index = int(np.nanargmax(pins[name]))
        force = format_quantity(float(pins[name].flat[index]), "N", 4)
        rows.append([f"largest force in a pin: {name}", force, *_position_cells(chart, index)])
    margins = {name: x for name, x in chart.buckling().items() if np.isfinite(x).any()}
    if margins:
        name = min(margins, key=lambda joint: np.nanmin(margins[joint]))
        index = int(np.nanargmin(margins[name]))
        margin = f"{margins[name].flat[index]:.3g} times its force"
        rows.append([f"first to buckle: {name}", margin, *_position_cells(chart, index)])
    return rows


def _position_cells(chart: "Capacity", index: int) -> list[str]:
    """First and second coordinate and slew angle of a place of the chart."""
    s, b, a = np.unravel_index(index, chart.loads.shape)
    slew_text = f"{np.rad2deg(chart.slews[s]):.4g}°"
    return [f"{chart.radii[a]:.4g} m", f"{chart.heights[b]:.4g} m", slew_text]


def table_note(chart: "Capacity", table: LoadTable) -> str:
    """What the table's marks and columns say."""
    radius_note = (
        f"Loads in kg by {chart.section.coordinate_names[0]}; 'farthest' at the largest one of "
        f"each row."
    )
    if table.can_tip:
        pins = (
            " or by pins"
            if any(cause.reason == PIN_FORCE for cause in chart.limiting_factors)
            else ""
        )
        return f"{radius_note} {ASTERISK_NOTE[0]}: {ASTERISK_NOTE[2:]}{pins}."
    return f"{radius_note} Nothing tips: {chart.machine.name} has no supports."


def _markdown_table(heading: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A Markdown table whose columns are aligned."""
    width = [max(map(len, column)) for column in zip(heading, *rows, strict=True)]
    separator = ["-" * (w - 1) + ":" for w in width]
    cells = [
        [cell.rjust(w) for cell, w in zip(row, width, strict=True)] for row in (heading, *rows)
    ]
    return [f"| {' | '.join(row)} |" for row in (cells[0], separator, *cells[1:])]
