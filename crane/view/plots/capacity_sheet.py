"""Rated loads on one page to print: charts, what they hold for, and the table."""

import textwrap
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from crane.ratings import Capacity
from crane.ratings.tables import LoadTable
from crane.ratings.words import facts, note, shares, sides
from crane.view.plots.capacity import colours, draw_panel, extent, heading
from crane.view.plots.recording import FAINT, INK, STYLE, write_figure
from crane.view.plots.text import literal, plain

_WIDE, _TALL, _EDGE = 11.69, 8.27, 0.45  # A4 on its side, and what printers leave white [inch]
_LINE = 0.152  # between lines [inch]
_WORDS, _CELLS = 7.5, 7.5  # sizes of letters [points]
_FACTS = 3.5  # width of what stands beside the charts [inch]
_HEAD = 0.35  # height of the heading [inch]


def plot_sheet(chart: Capacity, path: str | Path) -> None:
    """Write rated loads as one A4 page on its side.

    Args:
        chart: What to show.
        path: Where to write; its suffix .png, .svg or .pdf chooses the format.

    Raises:
        OutputError: The suffix is another one, or the file cannot be written.
    """
    write_figure(path, lambda: sheet_figure(chart))


def sheet_figure(chart: Capacity) -> Figure:
    """The page as a figure."""
    table = chart.table
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(_WIDE, _TALL))
        top = _TALL - _EDGE
        figure.text(_EDGE / _WIDE, top / _TALL, plain(heading(chart)), va="top", fontsize=13,
                    fontweight="bold")  # fmt: skip
        _write(figure, _EDGE, _EDGE, note(chart, table), colour="#555555")
        foot = _EDGE + 1.6 * _LINE
        head = _draw_table(figure, chart, table, foot)
        beside = _draw_charts(figure, chart, head + 0.2, top - _HEAD)
        _draw_facts(figure, chart, beside, top - _HEAD)
    return figure


def _write(
    figure: Figure,
    x: float,
    y: float,
    text: str,
    colour: str = INK,
    size: float = _WORDS,
    **options: object,
) -> None:
    """A line of text at a place [inch]."""
    words = literal(text)
    figure.text(x / _WIDE, y / _TALL, words, fontsize=size, color=colour, **options)  # type: ignore[arg-type]


def _draw_charts(figure: Figure, chart: Capacity, bottom: float, top: float) -> float:
    """One panel per slew angle.

    Returns:
        Where they end on the right [inch].
    """
    low, high = extent(chart)
    many, room = len(chart.slews), _WIDE - 2 * _EDGE - _FACTS
    shape = (high - low)[1] / (high - low)[0]

    def size(lines: int) -> float:
        columns = -(-many // lines)
        return float(min(room / columns - 0.55, ((top - bottom) / lines - 0.6) / shape))

    lines = max(range(1, many + 1), key=size)
    columns, wide = -(-many // lines), size(lines)
    for k in range(many):
        row, column = divmod(k, columns)
        left = _EDGE + 0.5 + column * (wide + 0.55)
        base = top - 0.2 - row * (top - bottom) / lines - wide * shape
        axes = figure.add_axes((left / _WIDE, base / _TALL, wide / _WIDE, wide * shape / _TALL))
        draw_panel(axes, chart, k)
        if column:
            axes.set_ylabel("")
    return _EDGE + columns * (wide + 0.55)


def _draw_facts(figure: Figure, chart: Capacity, left: float, top: float) -> None:
    """What the loads hold for, and what ends them, in the colours of the charts."""
    left, y = left + 0.2, top - 0.1
    letters = int((_FACTS - 0.2) * 72 / (0.56 * _WORDS))
    for name, text in facts(chart):
        for i, line in enumerate(textwrap.wrap(f"{name}: {text}", letters)):
            _write(figure, left + (0.1 if i else 0.0), y, line)
            y -= _LINE
        y -= 0.05
    y -= 0.1
    _write(figure, left, y, "ended by (of all places)", fontweight="bold")
    tints = {str(chart.causes[k]): tint for k, tint in colours(chart).items()}
    for cause, share, _ in shares(chart):
        y -= _LINE + 0.02
        _write(figure, left, y, "■", tints[cause], 11.0)
        lines = textwrap.wrap(f"{cause}, {100 * share:.3g}\u00a0%", letters - 5)
        for i, line in enumerate(lines):
            _write(figure, left + 0.2, y, line)
            y -= _LINE if i + 1 < len(lines) else 0.0


def _draw_table(figure: Figure, chart: Capacity, table: LoadTable, foot: float) -> float:
    """Rows by height, columns by radius and slew.

    Returns:
        Where it ends above [inch].
    """
    rows, names = table.rows(), sides(chart)
    many = len(names)
    first, room = _EDGE + 0.6, _WIDE - 2 * _EDGE - 0.6
    width = min(room / len(rows[0]), 0.75)
    size = min(_CELLS, 72 * width / 4.6)
    ends = first + width * (1 + np.arange(len(rows[0]))) - 0.08  # right ends of columns
    top = foot + _LINE * (len(rows) + (2 if any(names) else 1))
    for i, (height, row) in enumerate(zip(table.heights, rows, strict=True)):
        y = foot + _LINE * (len(rows) - 1 - i)
        if i % 2 == 0:
            _band(figure, y - 0.045, first + width * len(row))
        _write(figure, _EDGE + 0.5, y, f"{height:g} m", size=size, ha="right", fontweight="bold")
        for x, cell in zip(ends, row, strict=True):
            _write(figure, x, y, cell, size=size, ha="right")
    y = foot + _LINE * len(rows)
    if any(names):
        for j in range(len(rows[0]) - 1):
            _write(figure, ends[j], y, names[j % many], size=size, ha="right", colour="#555555")
        y += _LINE
    heads = [f"{radius:g} m" for radius in table.radii] + ["farthest"]
    for j, word in enumerate(heads):
        middle = ends[many * j : many * (j + 1)].mean() - (width / 2 - 0.08 if many > 1 else 0.0)
        side = "center" if many > 1 else "right"
        _write(figure, middle, y, word, size=size, ha=side, fontweight="bold")
    _write(figure, ends[-1], y, "at [m]", size=size, ha="right", fontweight="bold")
    return top


def _band(figure: Figure, y: float, right: float) -> None:
    """A tint behind a row."""
    patch = Rectangle(
        (_EDGE / _WIDE, y / _TALL), (right - _EDGE) / _WIDE, _LINE / _TALL, facecolor=FAINT,
        alpha=0.45, transform=figure.transFigure, linewidth=0, zorder=-1,
    )  # fmt: skip
    figure.add_artist(patch)
