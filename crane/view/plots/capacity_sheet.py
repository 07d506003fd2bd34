"""Load charts on one page to print: charts, conditions and load table."""

import textwrap
from typing import Any

from matplotlib.figure import Figure

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
_TEXT_SIZE = 7.5  # size of letters [points]
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
    _draw_charts(figure, chart, table_top + 0.2, top - _HEADING_HEIGHT)
    _draw_facts(figure, chart, top - _HEADING_HEIGHT)
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


def _draw_charts(figure: Figure, chart: Capacity, bottom: float, top: float) -> None:
    """Draw one panel per slew angle, in as many lines as make them largest."""
    lower, upper = drawing_extent(chart)
    count, width = len(chart.slews), _PAGE_WIDTH - 2 * _PAGE_MARGIN - _FACTS_WIDTH
    aspect = (upper - lower)[1] / (upper - lower)[0]

    def panel_width(lines: int) -> float:
        return float(
            min(width / -(-count // lines) - 0.55, ((top - bottom) / lines - 0.6) / aspect)
        )

    lines = max(range(1, count + 1), key=panel_width)
    grid = figure.add_gridspec(
        lines,
        -(-count // lines),
        left=(_PAGE_MARGIN + 0.5) / _PAGE_WIDTH,
        right=(_PAGE_MARGIN + width) / _PAGE_WIDTH,
        bottom=(bottom + 0.4) / _PAGE_HEIGHT,
        top=(top - 0.2) / _PAGE_HEIGHT,
        hspace=0.25,
    )
    for k in range(count):
        axes = figure.add_subplot(grid[k], anchor="NW")
        draw_capacity_panel(axes, chart, k)
        if k % grid.ncols:
            axes.set_ylabel("")


def _draw_facts(figure: Figure, chart: Capacity, top: float) -> None:
    """Write conditions and limiting factors, in the colours of the charts."""
    left, y = _PAGE_WIDTH - _PAGE_MARGIN - _FACTS_WIDTH + 0.2, top - 0.1
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
    headings = [*(f"{radius:g} m" for radius in table.radii), "farthest"]
    labels = [f"{heading}\n{name}".strip() for heading in headings for name in names]
    count = len(rows[0])
    column_width = min((_PAGE_WIDTH - 2 * _PAGE_MARGIN - 0.6) / count, 0.75)
    width, height = 0.6 + column_width * count, _LINE_HEIGHT * (len(rows) + 2)
    axes = figure.add_axes(
        (
            _PAGE_MARGIN / _PAGE_WIDTH,
            bottom / _PAGE_HEIGHT,
            width / _PAGE_WIDTH,
            height / _PAGE_HEIGHT,
        )
    )
    axes.axis("off")
    cells = axes.table(
        cellText=[[f"{x:g} m", *row] for x, row in zip(table.heights, rows, strict=True)],
        colLabels=["", *labels, "at [m]"],
        cellLoc="right",
        colLoc="right",
        colWidths=[0.6 / width, *[column_width / width] * count],
        bbox=(0.0, 0.0, 1.0, 1.0),  # type: ignore[arg-type]
        edges="horizontal",
    )
    cells.auto_set_font_size(False)
    cells.set_fontsize(min(_TEXT_SIZE, 72 * column_width / 4.6))
    for (row, column), cell in cells.get_celld().items():
        cell.set(edgecolor=FAINT_COLOUR, linewidth=0.5)
        cell.PAD = 0.04
        if row == 0:
            cell.set_height(2 * cell.get_height())
        if 0 in (row, column):
            cell.set_text_props(fontweight="bold")
    return bottom + height
