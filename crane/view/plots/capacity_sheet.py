"""Load charts on one page to print: charts, conditions and load table."""

import textwrap
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from crane.ratings.capacity_report import (
    LoadTable,
    capacity_facts,
    factor_shares,
    slew_labels,
    table_note,
)
from crane.ratings.lifting_capacity import Capacity
from crane.view.plots.figure_style import (
    FAINT_COLOUR,
    INK_COLOUR,
    escape_label,
    escape_text,
    figure_style,
)
from crane.view.plots.rating_figures import (
    capacity_heading,
    draw_capacity_panel,
    drawing_extent,
    factor_colours,
)

_PAGE_WIDTH, _PAGE_HEIGHT, _PAGE_MARGIN = (
    11.69,
    8.27,
    0.45,
)  # A4 landscape and margin [inch]
_LINE_HEIGHT = 0.152  # between lines [inch]
_TEXT_SIZE, _CELL_TEXT_SIZE = 7.5, 7.5  # sizes of letters [points]
_FACTS_WIDTH = 3.5  # width of the facts beside the charts [inch]
_HEADING_HEIGHT = 0.35  # height of the heading [inch]


@figure_style
def capacity_sheet_figure(chart: Capacity) -> Figure:
    """Return the page as a figure."""
    table = chart.table
    figure = Figure(figsize=(_PAGE_WIDTH, _PAGE_HEIGHT))
    top = _PAGE_HEIGHT - _PAGE_MARGIN
    figure.text(
        _PAGE_MARGIN / _PAGE_WIDTH,
        top / _PAGE_HEIGHT,
        escape_label(capacity_heading(chart)),
        va="top",
        fontsize=13,
        fontweight="bold",
    )
    _write_text(figure, _PAGE_MARGIN, _PAGE_MARGIN, table_note(chart, table), colour="#555555")
    table_top = _draw_table(figure, chart, table, _PAGE_MARGIN + 1.6 * _LINE_HEIGHT)
    charts_right = _draw_charts(figure, chart, table_top + 0.2, top - _HEADING_HEIGHT)
    _draw_facts(figure, chart, charts_right, top - _HEADING_HEIGHT)
    return figure


def _write_text(
    figure: Figure,
    x: float,
    y: float,
    text: str,
    colour: str = INK_COLOUR,
    size: float = _TEXT_SIZE,
    **options: Any,
) -> None:
    """Write a line of text at x, y [inch]."""
    x, y = x / _PAGE_WIDTH, y / _PAGE_HEIGHT
    figure.text(x, y, escape_text(text), fontsize=size, color=colour, **options)


def _draw_charts(figure: Figure, chart: Capacity, bottom: float, top: float) -> float:
    """Draw one panel per slew angle, and return the right end of the panels [inch]."""
    lower, upper = drawing_extent(chart)
    panel_count, available_width = len(chart.slews), _PAGE_WIDTH - 2 * _PAGE_MARGIN - _FACTS_WIDTH
    aspect = (upper - lower)[1] / (upper - lower)[0]

    def panel_width(lines: int) -> float:
        columns = -(-panel_count // lines)
        return float(
            min(available_width / columns - 0.55, ((top - bottom) / lines - 0.6) / aspect)
        )

    lines = max(range(1, panel_count + 1), key=panel_width)
    columns, best_width = -(-panel_count // lines), panel_width(lines)
    for k in range(panel_count):
        row, column = divmod(k, columns)
        axes = figure.add_axes(
            (
                (_PAGE_MARGIN + 0.5 + column * (best_width + 0.55)) / _PAGE_WIDTH,
                (top - 0.2 - row * (top - bottom) / lines - best_width * aspect) / _PAGE_HEIGHT,
                best_width / _PAGE_WIDTH,
                best_width * aspect / _PAGE_HEIGHT,
            )
        )
        draw_capacity_panel(axes, chart, k)
        if column:
            axes.set_ylabel("")
    return _PAGE_MARGIN + columns * (best_width + 0.55)


def _draw_facts(figure: Figure, chart: Capacity, left: float, top: float) -> None:
    """Write conditions and limiting factors, in the colours of the charts."""
    left, y = left + 0.2, top - 0.1
    line_length = int((_FACTS_WIDTH - 0.2) * 72 / (0.56 * _TEXT_SIZE))
    for name, text in capacity_facts(chart):
        for i, line in enumerate(textwrap.wrap(f"{name}: {text}", line_length)):
            _write_text(figure, left + (0.1 if i else 0.0), y, line)
            y -= _LINE_HEIGHT
        y -= 0.05
    y -= 0.1
    _write_text(figure, left, y, "limited by (of all positions)", fontweight="bold")
    colours_by_factor = {
        str(chart.limiting_factors[k]): tint for k, tint in factor_colours(chart).items()
    }
    for cause, share, _ in factor_shares(chart):
        y -= _LINE_HEIGHT + 0.02
        _write_text(figure, left, y, "■", colours_by_factor[cause], 11.0)
        lines = textwrap.wrap(f"{cause}, {100 * share:.3g}\u00a0%", line_length - 5)
        for i, line in enumerate(lines):
            _write_text(figure, left + 0.2, y, line)
            y -= _LINE_HEIGHT if i + 1 < len(lines) else 0.0


def _draw_table(figure: Figure, chart: Capacity, table: LoadTable, bottom: float) -> float:
    """Draw the load table: rows by height, columns by radius and slew angle.

    Returns:
        Top of the table [inch].
    """
    rows, names = table.format_rows(), slew_labels(chart)
    slew_count = len(names)
    first_column, available_width = _PAGE_MARGIN + 0.6, _PAGE_WIDTH - 2 * _PAGE_MARGIN - 0.6
    width = min(available_width / len(rows[0]), 0.75)
    size = min(_CELL_TEXT_SIZE, 72 * width / 4.6)
    right_edges = (
        first_column + width * (1 + np.arange(len(rows[0]))) - 0.08
    )  # right ends of columns
    for i, (height, row) in enumerate(zip(table.heights, rows, strict=True)):
        y = bottom + _LINE_HEIGHT * (len(rows) - 1 - i)
        if i % 2 == 0:
            figure.add_artist(
                Rectangle(
                    (_PAGE_MARGIN / _PAGE_WIDTH, (y - 0.045) / _PAGE_HEIGHT),
                    (first_column + width * len(row) - _PAGE_MARGIN) / _PAGE_WIDTH,
                    _LINE_HEIGHT / _PAGE_HEIGHT,
                    facecolor=FAINT_COLOUR,
                    alpha=0.45,
                    transform=figure.transFigure,
                    linewidth=0,
                    zorder=-1,
                )
            )
        _write_text(
            figure,
            _PAGE_MARGIN + 0.5,
            y,
            f"{height:g} m",
            size=size,
            ha="right",
            fontweight="bold",
        )
        for x, cell in zip(right_edges, row, strict=True):
            _write_text(figure, x, y, cell, size=size, ha="right")
    y = bottom + _LINE_HEIGHT * len(rows)
    if any(names):
        for j in range(len(rows[0]) - 1):
            _write_text(
                figure,
                right_edges[j],
                y,
                names[j % slew_count],
                size=size,
                ha="right",
                colour="#555555",
            )
        y += _LINE_HEIGHT
    for j, heading_text in enumerate([f"{radius:g} m" for radius in table.radii] + ["farthest"]):
        middle = right_edges[slew_count * j : slew_count * (j + 1)].mean() - (
            width / 2 - 0.08 if slew_count > 1 else 0.0
        )
        _write_text(
            figure,
            middle,
            y,
            heading_text,
            size=size,
            ha="center" if slew_count > 1 else "right",
            fontweight="bold",
        )
    _write_text(figure, right_edges[-1], y, "at [m]", size=size, ha="right", fontweight="bold")
    return y + _LINE_HEIGHT
