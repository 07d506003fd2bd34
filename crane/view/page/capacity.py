"""Rated loads as one page to point at: load, causes, posture, strokes and pressures of a place."""

import json
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from crane.common.errors import OutputError
from crane.common.output import replacing
from crane.common.samples import Array
from crane.common.units import reading
from crane.ratings import Capacity
from crane.ratings.strength import strengths
from crane.ratings.words import facts, sides
from crane.view.page.build import SUFFIXES
from crane.view.plots.capacity import colours, contours, extent, heading, homes
from crane.view.sketch.outline import Outline, outline

_CELLS = 1500  # per slew angle, at most
_PARTS = 4000.0  # of the extent, to which outlines are rounded
_DIGITS, _OF_LOADS = 5, 7


def write_capacity_page(chart: Capacity, path: str | Path) -> Path:
    """Write rated loads as one HTML file that needs no network.

    Args:
        chart: What to show; of more than 1500 places per slew angle every second, third ...
        path: The file to write; replaced if it exists.

    Returns:
        The path.

    Raises:
        OutputError: The file's suffix is not .html or .htm, or it cannot be written.
    """
    if Path(path).suffix.lower() not in SUFFIXES:
        raise OutputError(f"{path}: a page is for a browser, end the name in .html")
    assets = files("crane.view.page") / "assets"
    style, script, template = (
        (assets / f"capacity.{kind}").read_text(encoding="utf-8") for kind in ("css", "js", "html")
    )
    data = json.dumps(page_data(chart), separators=(",", ":"), allow_nan=False)
    text = Template(template).substitute(
        title=escape(heading(chart)), style=style, script=script, data=data.replace("</", "<\\/")
    )
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")
    return Path(path)


def page_data(chart: Capacity) -> dict[str, Any]:
    """What the page shows, as JSON has it; lengths of outlines in `unit` metres."""
    low, high = extent(chart)
    unit = float((high - low).max()) / _PARTS
    machine, pressures = chart.machine, chart.pressures()
    limits = {drive.joint: drive.pressures for drive in strengths(machine, chart.raising)}
    drives = [
        {
            "joint": joint,
            "unit": _unit(machine.unit(joint))[0],
            "limits": [_number(1e-5 * x) for x in limits.get(joint, ())],
        }
        for joint in machine.active
    ]
    shapes: dict[str, int] = {}
    stills = [_rounded(one.standing, unit) for one in homes(chart)]
    return {
        "facts": facts(chart),
        "names": chart.section.names,
        "slews": sides(chart),
        "low": low.tolist(),
        "high": high.tolist(),
        "unit": unit,
        "step": [_every(chart) * _between(x) for x in (chart.radii, chart.heights)],
        "causes": [str(cause) for cause in chart.causes],
        "tints": colours(chart),
        "drives": drives,
        "standing": stills,
        "cells": [_cells(chart, k, pressures, unit, shapes) for k in range(len(chart.slews))],
        "contours": [_contours(chart, k, unit) for k in range(len(chart.slews))],
        "shapes": [json.loads(shape) for shape in shapes],
    }


def _cells(
    chart: Capacity, k: int, pressures: dict[str, Array], unit: float, shapes: dict[str, int]
) -> list[list[Any]]:
    """Of each place at a slew angle what the page tells of it.

    Radius, height, load, cause, loads by cause, strokes, pressures by joint, and the number of
    its outline.
    """
    machine, active = chart.machine, chart.machine.closure.active
    every = _every(chart)
    b, a = np.nonzero(~np.isnan(chart.loads[k])[::every, ::every])
    b, a = b * every, a * every
    scales = np.array([_unit(machine.unit(joint))[1] for joint in machine.active])
    q = machine.closure.solve(np.ascontiguousarray(chart.q_a[k, b, a]))
    out = []
    for posture, i, j in zip(q, b, a, strict=True):
        seen = outline(machine, chart.frame, chart.section, posture)
        number = shapes.setdefault(json.dumps(_shape(seen, unit)), len(shapes))
        held = [
            [_number(1e-5 * x) for x in pressures[joint][k, i, j]] if joint in pressures else []
            for joint in machine.active
        ]
        out.append([
            _number(chart.radii[j]), _number(chart.heights[i]),
            _number(chart.loads[k, i, j], _OF_LOADS), int(chart.cause[k, i, j]),
            [_number(x, _OF_LOADS) for x in chart.each[k, i, j]],
            [_tenths(x) for x in scales * posture[active]], held, number,
        ])  # fmt: skip
    return out


def _every(chart: Capacity) -> int:
    """Of how many places along an axis one is shown."""
    most = int((~np.isnan(chart.loads)).sum(axis=(1, 2)).max())
    return max(int(np.ceil(np.sqrt(most / _CELLS))), 1)


def _contours(chart: Capacity, k: int, unit: float) -> list[list[Any]]:
    """Of each contour that is there its load in words and its lines."""
    found = contours(chart, k)
    name, scale = reading("kg", max((level for level, _ in found), default=0.0))
    return [
        [f"{scale * level:g} {name}", [_rounded(line, unit) for line in lines]]
        for level, lines in found
        if lines
    ]


def _shape(seen: Outline, unit: float) -> list[Any]:
    return [[_rounded(body, unit) for body in seen.bodies],
            [_rounded(cylinder, unit) for cylinder in seen.cylinders]]  # fmt: skip


def _rounded(points: Array, unit: float) -> list[int]:
    """x, y, x, y ... in units."""
    return [int(x) for x in np.rint(points / unit).ravel()]


def _unit(unit: str) -> tuple[str, float]:
    """Degrees and millimetres."""
    return reading(unit, 0.0)


def _between(values: Array) -> float:
    return float(np.diff(values).min()) if len(values) > 1 else 0.0


def _tenths(value: float) -> float:
    """Strokes and angles to 0.1 mm or deg, without rounding noise at their limits."""
    return round(float(value), 1) + 0.0  # no -0.0


def _number(value: float, digits: int = _DIGITS) -> float | None:
    """A number with few digits, None where there is none."""
    return float(f"{value:.{digits}g}") if np.isfinite(value) else None
