"""Interactive page of rated loads: load, limits, strokes and pressures at each position."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from crane.common.samples import Array
from crane.common.units import display_unit
from crane.ratings.capacity_report import capacity_facts, slew_labels
from crane.ratings.drive_force_limits import drive_force_limits
from crane.ratings.lift_charts import LiftChart
from crane.ratings.lifting_capacity import Capacity
from crane.view.page.html_document import filled_template, write_page
from crane.view.plots.rating_figures import (
    capacity_heading,
    drawing_extent,
    factor_colours,
    home_outlines,
    load_contours,
    zone_lines,
)
from crane.view.sketches.mechanism_projection import machine_outline

_MAX_CELLS = 1500  # per slew angle, at most
_OUTLINE_RESOLUTION = 4000.0  # of the extent, to which outlines are rounded
_SIGNIFICANT_DIGITS, _LOAD_DIGITS = 5, 7


def write_capacity_page(chart: Capacity | LiftChart, path: str | Path) -> Path:
    """Write a load chart or a lift chart as one self-contained HTML file.

    Args:
        chart: The chart; positions are thinned to 1500 per slew angle.
        path: The file to write; replaced if it exists.

    Returns:
        The path.

    Raises:
        OutputError: The file's suffix is not .html or .htm, or it cannot be written.
    """
    heading = capacity_heading(chart)
    return write_page(
        path,
        lambda: filled_template(
            "capacity", ["capacity"], ["capacity"], heading, capacity_page_data(chart)
        ),
    )


def capacity_page_data(chart: Capacity | LiftChart) -> dict[str, Any]:
    """Return the data of the page for JSON; outlines in multiples of `unit` metres."""
    lower, upper = drawing_extent(chart)
    unit = float((upper - lower).max()) / _OUTLINE_RESOLUTION
    machine, pressures = chart.machine, chart.pressures()
    limits = {
        drive.joint: drive.chamber_pressures
        for drive in drive_force_limits(machine, chart.raising_joints)
    }
    max_count = int((~np.isnan(chart.loads)).sum(axis=(1, 2)).max())
    stride = max(int(np.ceil(np.sqrt(max_count / _MAX_CELLS))), 1)
    places = chart.positions[::stride, ::stride]
    ways = [np.abs(np.diff(places, axis=axis)).reshape(-1, 2) for axis in (0, 1)]
    shapes: dict[str, int] = {}
    cells, contours = [], []
    for k in range(len(chart.slews)):
        cells.append(_cell_rows(chart, k, stride, pressures, unit, shapes))
        lines_by_load = (
            zone_lines(chart, k) if isinstance(chart, LiftChart) else load_contours(chart, k)
        )
        name, scale = display_unit("kg", max((load for load, _ in lines_by_load), default=0.0))
        contours.append(
            [
                [f"{scale * load:g} {name}", [_round_points(line, unit) for line in lines]]
                for load, lines in lines_by_load
                if lines
            ]
        )
    return {
        "facts": chart.facts() if isinstance(chart, LiftChart) else capacity_facts(chart),
        "names": chart.section.coordinate_names,
        "slews": slew_labels(chart),
        "low": lower.tolist(),
        "high": upper.tolist(),
        "unit": unit,
        "step": np.nanmax(np.concatenate([np.zeros((1, 2)), *ways]), axis=0).tolist(),
        "causes": [str(cause) for cause in chart.limiting_factors],
        "tints": factor_colours(chart),
        "drives": [
            {
                "joint": joint,
                "unit": display_unit(machine.unit(joint), 0.0)[0],
                "limits": [_rounded_or_none(1e-5 * x) for x in limits.get(joint, ())],
            }
            for joint in machine.active
        ],
        "standing": [
            _round_points(home_outline.stationary_hull, unit)
            for home_outline in home_outlines(chart)
        ],
        "cells": cells,
        "contours": contours,
        "shapes": [json.loads(shape) for shape in shapes],
    }


def _cell_rows(
    chart: Capacity | LiftChart,
    k: int,
    stride: int,
    pressures: dict[str, Array],
    unit: float,
    shapes: dict[str, int],
) -> list[list[Any]]:
    """Return one row per position at a slew angle.

    Radius, height, load, limiting factor, loads by factor, strokes to 0.1 mm or deg, pressures by
    joint, outline index; in lift charts the angle of the frame [deg].
    """
    machine, active = chart.machine, chart.machine.closure.active
    b, a = np.nonzero(~np.isnan(chart.loads[k])[::stride, ::stride])
    b, a = b * stride, a * stride
    scales = np.array([display_unit(machine.unit(joint), 0.0)[1] for joint in machine.active])
    q = machine.closure.solve(np.ascontiguousarray(chart.q_a[k, b, a]))
    out = []
    for configuration, i, j in zip(q, b, a, strict=True):
        outline = machine_outline(machine, chart.frame, chart.section, configuration)
        parts = (outline.bodies, outline.cylinders)
        shape = json.dumps([[_round_points(x, unit) for x in part] for part in parts])
        out.append(
            [
                *map(_rounded_or_none, chart.positions[i, j]),
                _rounded_or_none(chart.loads[k, i, j], _LOAD_DIGITS),
                int(chart.limiting_factor_index[k, i, j]),
                [_rounded_or_none(x, _LOAD_DIGITS) for x in chart.values_by_factor[k, i, j]],
                [round(float(x), 1) + 0.0 for x in scales * configuration[active]],  # no -0.0
                [
                    [_rounded_or_none(1e-5 * x) for x in pressures[joint][k, i, j]]
                    if joint in pressures
                    else []
                    for joint in machine.active
                ],
                shapes.setdefault(shape, len(shapes)),
                *([np.rad2deg(chart.angles[i, j])] if isinstance(chart, LiftChart) else []),
            ]
        )
    return out


def _round_points(points: Array, unit: float) -> list[int]:
    """Return rounded coordinates x, y, x, y ... in multiples of `unit`."""
    return [int(x) for x in np.rint(points / unit).ravel()]


def _rounded_or_none(value: float, digits: int = _SIGNIFICANT_DIGITS) -> float | None:
    """Round to some significant digits; None if not finite."""
    return float(f"{value:.{digits}g}") if np.isfinite(value) else None
