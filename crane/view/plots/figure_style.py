"""Style of all figures: colours, texts and axes, thinned curves, and how figures are written."""

import base64
import io
import re
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from crane.common.atomic_output import replace_file
from crane.common.errors import OutputError
from crane.common.samples import Array

FIGURE_FORMATS: dict[str, dict[str, None] | None] = {  # metadata without dates
    "png": None,
    "svg": {"Date": None},
    "pdf": {"CreationDate": None},
}
DASHED_STYLE: Any = {"color": "#e0701a", "linestyle": (0, (4, 2)), "linewidth": 1.1}
RECORDED_COLOUR, INK_COLOUR, FAINT_COLOUR = "#1f5fa8", "#333333", "#d4d4d4"
CURVE_COLOURS = (
    "#1f5fa8", "#e0701a", "#2a8c4a", "#8a5fb0", "#d9b53f", "#b04a7a", "#3f8f9f", "#9a6b3f",
    "#7a7a7a", "#6f9bca", "#c2452d", "#333333",
)  # fmt: skip
FIGURE_STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "mathtext.fontset": "dejavusans",
    "axes.titlesize": 10,
    "axes.labelsize": 8.5,
    "axes.edgecolor": INK_COLOUR,
    "axes.labelcolor": INK_COLOUR,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.color": FAINT_COLOUR,
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.4,
    "text.color": INK_COLOUR,
    "xtick.color": INK_COLOUR,
    "ytick.color": INK_COLOUR,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "legend.frameon": False,
    "pdf.fonttype": 42,
    "svg.hashsalt": "crane",
}
figure_style = mpl.rc_context(FIGURE_STYLE)  # decorator of functions that draw a figure
_MAX_LABEL_LENGTH = 80  # characters
_MAX_POINTS = 40_000  # points of a curve, several per column of dots of any print
_PIXELS_PER_INCH = 96  # dots of a browser
# What of an SVG may stand in an address as it is; all else is written as %XX.
_UNQUOTED_CHARACTERS = " /:=;,.()'!*?&@+$[]"


def escape_label(text: str) -> str:
    r"""Return a text that matplotlib shows literally.

    Without escapes matplotlib reads text between two $ as mathematics (and raises for `$\bad$`),
    and leaves labels with a leading underscore out of legends.
    """
    shortened = text if len(text) <= _MAX_LABEL_LENGTH else f"{text[: _MAX_LABEL_LENGTH - 1]}…"
    shortened = escape_text(shortened)
    return f" {shortened}" if shortened.startswith("_") else shortened


def escape_text(text: str) -> str:
    """Escape a text of any length that is not in a legend, see `escape_label`."""
    return "".join(c if c.isprintable() or c == "\u00a0" else " " for c in text).replace(
        "$", r"\$"
    )


def joint_symbol(name: str) -> str:
    """Return a joint's name as a label: q1 as q with index 1, X_lift as X with index lift."""
    if match := re.fullmatch(r"([A-Za-z])(\d+|_[A-Za-z]+)", name):
        return f"${match[1]}_{{\\mathrm{{{match[2].removeprefix('_')}}}}}$"
    return escape_label(name)


def add_heading(figure: Figure, text: str) -> None:
    """Add a bold heading at the upper left."""
    figure.suptitle(text, x=0.01, ha="left", fontsize=11, fontweight="bold")


def create_time_panels(
    count: int, max_columns: int, width: float, extra_height: float
) -> tuple[Figure, list[Axes]]:
    """Return a figure of panels over time, the lowest ones with their label; sizes in inches."""
    columns = max(min(count, max_columns), 1)
    rows = max(-(-count // columns), 1)
    size = (width * columns, 1.9 * rows + extra_height)
    figure = Figure(figsize=size, layout="constrained")
    panels = [figure.add_subplot(rows, columns, k + 1) for k in range(count)]
    for axes in panels[-columns:]:
        axes.set_xlabel("time [s]")
    return figure, panels


def create_residual_panels(title: str, unit: str, residual_unit: str) -> tuple[Figure, Axes, Axes]:
    """Return a figure of a quantity over time, with a lower panel for its residual."""
    figure = Figure(figsize=(5.8, 3.3))
    grid = {"height_ratios": (2, 1), "left": 0.14, "right": 0.985, "top": 0.9, "bottom": 0.13}
    upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={**grid, "hspace": 0.12})
    upper.set_ylabel(unit)
    upper.set_title(title, loc="left", fontsize=8.5)
    upper.margins(x=0.0)
    lower.set(ylabel=f"residual [{residual_unit}]", xlabel="time [s]")
    for axes in (upper, lower):
        axes.yaxis.set_label_coords(-0.125, 0.5)
    return figure, upper, lower


def add_residual_legend(axes: Axes, columns: int) -> None:
    """Add the legend of `create_residual_panels` above its upper panel."""
    axes.legend(
        loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=columns, borderpad=0, fontsize=8
    )


def set_round_ticks(axes: Axes, count: int) -> None:
    """Set at most `count` intervals of round lengths on both axes."""
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(count, steps=[1, 2, 2.5, 5, 10]))


def add_side_colour_bar(axes: Axes, mesh: ScalarMappable, label: str, **options: Any) -> Colorbar:
    """Add a narrow colour bar on the right of axes."""
    figure = axes.get_figure()
    assert figure is not None, "axes belong to a figure"
    colour_bar = figure.colorbar(
        mesh, cax=axes.inset_axes((1.03, 0.03, 0.04, 0.94)), label=label, **options
    )
    colour_bar.outline.set_visible(False)
    return colour_bar


def envelope(time: Array, values: Array) -> tuple[Array, Array]:
    """Thin a curve (N,) to the smallest and the largest sample of each time span.

    First and last sample are kept; short curves are unchanged.
    """
    count = len(values)
    if count <= _MAX_POINTS:
        return time, values
    size = -(-2 * count // _MAX_POINTS)
    blocks = np.pad(values, (0, -count % size), mode="edge").reshape(-1, size)
    starts = np.arange(0, count, size)
    indices = np.unique(
        np.concatenate(
            [[0, count - 1], starts + blocks.argmin(axis=1), starts + blocks.argmax(axis=1)]
        )
    )
    return time[indices], values[indices]


def thin_path(points: Array) -> Array:
    """Thin a path (N, 3); the first and the last point are kept."""
    step = -(-len(points) // _MAX_POINTS)
    return points if step == 1 else np.vstack([points[:-1:step], points[-1:]])


def write_figure(path: str | Path, draw: Callable[[], Figure]) -> None:
    """Draw a figure and write it to a file.

    Args:
        path: File to write; the suffix .png, .svg or .pdf determines the format.
        draw: Function that draws the figure.

    Raises:
        OutputError: The suffix is another one, or the file cannot be written.
    """
    file_format = Path(path).suffix.lower().removeprefix(".")
    if file_format not in FIGURE_FORMATS:
        raise OutputError(f"{path}: unknown kind of picture, end the name in .png, .svg or .pdf")
    figure = draw()
    with mpl.rc_context(FIGURE_STYLE), replace_file(path) as part:
        figure.savefig(part, format=file_format, dpi=200, metadata=FIGURE_FORMATS[file_format])


def image_tag(figure: Figure, alternative_text: str) -> str:
    """A figure as an HTML element that holds its picture, at its own size in inches."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150, metadata={"Software": None})
    data = base64.b64encode(buffer.getvalue()).decode()
    return _image_element(figure, alternative_text, f"png;base64,{data}")


def svg_tag(figure: Figure, alternative_text: str) -> str:
    """A figure of few lines likewise, as SVG.

    It stands in an element of its own and not among those of the page: names within two drawings
    of a page cannot meet, no script in it would run, and notebooks that are not trusted show it.
    """
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = re.sub(r"<!--.*?-->", "", buffer.getvalue(), flags=re.DOTALL)
    # paths to hundredths of a point
    text = re.sub(r' d="[^"]*"', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path[0]), text)
    drawing = " ".join(text[text.index("<svg") :].replace('"', "'").split())
    data = quote(drawing, safe=_UNQUOTED_CHARACTERS)
    return _image_element(figure, alternative_text, f"svg+xml,{data}")


def _image_element(figure: Figure, alternative_text: str, data: str) -> str:
    width = round(_PIXELS_PER_INCH * figure.get_figwidth())
    source = data.replace("&", "&amp;")
    return f'<img alt="{escape(alternative_text)}" width="{width}" src="data:image/{source}">'
