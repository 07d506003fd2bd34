"""Rated loads in words: what they hold for, by what they end, and their table as Markdown."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from crane.common.errors import BranchEdgeError
from crane.common.units import quantity
from crane.ratings.causes import PIN
from crane.ratings.strength import strengths
from crane.ratings.tables import LoadTable

if TYPE_CHECKING:
    from crane.ratings.lifting import Capacity

_SIDES = {0: "front", 90: "side", -90: "side", 180: "rear", -180: "rear"}  # [deg]
ASTERISK = "* ended by drives, all others by tipping"


def facts(chart: "Capacity") -> list[tuple[str, str]]:
    """What the loads hold for: names, and what is said of each."""
    others = [joint for joint in chart.machine.driven_joints if joint not in chart.raising]
    raised = (", ".join(chart.raising) or "nothing") + (
        f" ({', '.join(others)} held)" if others else ""
    )
    rows = [
        ("load", f"at '{chart.frame}', in kg; what is there already is no part of it"),
        ("rule", chart.rule.says),
        ("raised by", raised),
        ("ground", f"leans by {np.rad2deg(chart.slope):.3g} degrees" if chart.slope else "level"),
    ]
    if chart.friction:
        rows.append(("friction", "overcome from rest by what raises"))
    return [*rows, ("limits", "; ".join(limits(chart)))]


def limits(chart: "Capacity") -> list[str]:
    """Of each drive its pressure or torque: "X_boom 350 bar (working pressure)"; of pins too."""
    out = []
    for drive in strengths(chart.machine, chart.raising, chart.friction):
        if drive.pressures:
            both = [quantity(pressure, "Pa", 4) for pressure in drive.pressures]
            value = both[0] if both[0] == both[1] else f"A {both[0]}, B {both[1]}"
        else:
            unit = "N" if chart.machine.unit(drive.joint) == "m" else "N m"
            value = quantity(drive.most, unit, 4)
        out.append(f"{drive.joint} {value} ({drive.why})")
    rated = {cause.what for cause in chart.causes if cause.why == PIN}
    pins = {name: force for name, force in chart.machine.pins.items() if name in rated}
    return out + [f"{name} {quantity(force, 'N', 4)} ({PIN})" for name, force in pins.items()]


def sides(chart: "Capacity") -> list[str]:
    """What slew angles are called: front, side, rear or degrees; nothing of home alone."""
    slew = chart.section.slew
    if slew is None:
        return [""]
    home = chart.machine.home[chart.machine.closure.active[slew]]
    if len(chart.slews) == 1 and chart.slews[0] == home:
        return [""]
    degrees = [float(f"{x:.6g}") for x in np.rad2deg(chart.slews)]
    names = [_SIDES.get(x, f"{x:.4g}°") for x in degrees]  # type: ignore[call-overload]
    return [
        name if names.count(name) == 1 else f"{x:.4g}°"
        for name, x in zip(names, degrees, strict=True)
    ]


def shares(chart: "Capacity") -> list[tuple[str, float, float]]:
    """Causes that end loads, the share of all places where each does, and with another one."""
    all_places = max(int((~np.isnan(chart.loads)).sum()), 1)
    several = chart.together.sum(axis=-1) > 1
    found = []
    for k in chart.ends:
        ends = chart.together[..., k]
        each, both = (float(x.sum()) / all_places for x in (ends, ends & several))
        found.append((str(chart.causes[k]), each, both))
    return sorted(found, key=lambda one: -one[1])


def headings(chart: "Capacity", table: LoadTable) -> list[str]:
    """Of the table's columns."""
    names = sides(chart)
    places = [f"{radius:g} m" for radius in table.radii] + ["farthest"]
    return [
        f"{chart.section.names[1]} [m]",
        *(f"{place} {side}".strip() for place in places for side in names),
        "at [m]",
    ]


def to_markdown(chart: "Capacity") -> str:
    """What the loads hold for, their table, and what ends them."""
    table = chart.table
    rows = [[f"{height:g}", *row] for height, row in zip(table.heights, table.rows(), strict=True)]
    lines = [f"# Lifting capacity of {chart.machine.name}\n"]
    lines += [f"- {name}: {text}" for name, text in facts(chart)]
    lines += ["", *_table(headings(chart, table), rows), "", note(chart, table)]
    lines += ["\n| ended by | of all places | of all, with another |", "| --- | ---: | ---: |"]
    lines += [
        f"| {cause} | {100 * share:.3g} % | {100 * both:.3g} % |"
        for cause, share, both in shares(chart)
    ]
    if rows := bearing(chart):
        lines += ["", *_table(["under these loads", "", *chart.section.names, "slew"], rows)]
    return "\n".join(lines) + "\n"


def bearing(chart: "Capacity") -> list[list[str]]:
    """What its parts bear, and where: the largest force in a pin, the least margin to buckling.

    Pins are left out on ground that leans, and where the passive joints are not determined.
    """
    machine, rows = chart.machine, []
    if not np.isfinite(chart.loads).any():
        return []
    slides = [joint.name for joint in machine.tree.moving if joint.kind == "prismatic"]
    slides += [loop.name for loop in machine.closure.equations.loops if loop.type == "prismatic"]
    try:
        forces = {} if chart.slope else chart.pin_forces()
    except BranchEdgeError:
        forces = {}
    pins = {name: x for name, x in forces.items() if name not in slides}
    if pins:
        name = max(pins, key=lambda pin: np.nanmax(pins[pin]))
        at = int(np.nanargmax(pins[name]))
        force = quantity(float(pins[name].flat[at]), "N", 4)
        rows.append([f"largest force in a pin: {name}", force, *_place(chart, at)])
    margins = {name: x for name, x in chart.buckling().items() if np.isfinite(x).any()}
    if margins:
        name = min(margins, key=lambda joint: np.nanmin(margins[joint]))
        at = int(np.nanargmin(margins[name]))
        margin = f"{margins[name].flat[at]:.3g} times its force"
        rows.append([f"first to buckle: {name}", margin, *_place(chart, at)])
    return rows


def _place(chart: "Capacity", at: int) -> list[str]:
    """First and second coordinate and slew angle of a place of the chart."""
    s, b, a = np.unravel_index(at, chart.loads.shape)
    turn = f"{np.rad2deg(chart.slews[s]):.4g}°"
    return [f"{chart.radii[a]:.4g} m", f"{chart.heights[b]:.4g} m", turn]


def note(chart: "Capacity", table: LoadTable) -> str:
    """What the table's marks and columns say."""
    far = f"Loads in kg by {chart.section.names[0]}; 'farthest' at the largest one of each row."
    if table.tips:
        pins = " or by pins" if any(cause.why == PIN for cause in chart.causes) else ""
        return f"{far} {ASTERISK[0]}: {ASTERISK[2:]}{pins}."
    return f"{far} Nothing tips: {chart.machine.name} has no supports."


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A Markdown table whose columns are aligned."""
    width = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    rule = ["-" * (w - 1) + ":" for w in width]
    cells = [[cell.rjust(w) for cell, w in zip(row, width, strict=True)] for row in (head, *rows)]
    return [f"| {' | '.join(row)} |" for row in (cells[0], rule, *cells[1:])]
