"""What a notebook shows of an object: one line, its page, its figures, and its words as tables.

Results know their words (`to_markdown` or `to_text`); which figures are theirs stands here. All is
in the HTML itself, nothing is loaded from anywhere.
"""

import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from html import escape
from importlib import import_module
from typing import Any

import matplotlib as mpl
from markdown_it import MarkdownIt

from crane.common.errors import CraneError
from crane.formats import load_from_expression
from crane.machine import Machine
from crane.recordings.recording import Recording
from crane.recordings.recording_summary import summarize
from crane.view.machine_facts import MachineFact, machine_facts
from crane.view.page.html_document import html_table
from crane.view.page.report_page import report_html
from crane.view.plots.image_tags import image_tag, svg_tag
from crane.view.plots.recording_figure import FIGURE_STYLE
from crane.view.sketch.sketch_figure import sketch_figure

_FRAME_SHARE = (
    0.06  # of the frames and spans of a page: a notebook keeps all its outputs in one file
)
_MAX_FIGURES = 8
_FIGURES: Mapping[str, tuple[str, ...]] = {  # by class, in `crane.view.plots`
    "Calibration": ("calibration_figure.calibration_figure",),
    "Capacity": ("capacity_figure.capacity_figure",),
    "Comparison": ("calibration_figure.comparison_figure",),
    "Design": ("design_figure.design_figure",),
    "Excitation": ("excitation_figure.excitation_figure",),
    "Identification": ("identification_figures.force_figures",),
    "LinearModel": ("modes_figure.modes_figure",),
    "PowerBalance": ("sankey_diagram.sankey_figure", "power_figure.power_figure"),
    "PowerComparison": ("power_figure.power_comparison_figure",),
    "Recording": ("recording_figure.recording_figure",),
    "Sensitivities": ("modes_figure.sensitivities_figure",),
    "SignalExcitation": ("excitation_figure.signals_figure",),
    "Study": ("study_figure.study_figure",),
    "ToolForce": ("tool_force_figure.tool_force_figure",),
    "WorkingRange": ("working_range_figure.working_range_figure",),
    "Workspace": ("workspace_figure.workspace_figure",),
}
# What moves, and how.
_MOTIONS: Mapping[str, Callable[[Any], tuple[Machine, Recording | None]]] = {
    "LinearModel": lambda model: (model.machine, model.motion()),
    "Recording": lambda recording: (load_from_expression(recording.machine), recording),
}
# Colours are those of whatever notebook it stands in, light or dark; pictures are on white.
_CSS = """
.crane-shown { max-width: 72rem; font-size: 13px; line-height: 1.45; }
.crane-shown p { margin: .4em 0; overflow-wrap: anywhere; }
.crane-shown .crane-line { font-weight: 600; }
.crane-shown .crane-note { opacity: .75; }
.crane-shown .scroll, .crane-shown pre { overflow: auto; max-height: 30rem; margin: .5em 0; }
.crane-shown table { border-collapse: collapse; margin: 0; font-size: inherit;
  font-variant-numeric: tabular-nums; color: inherit; border: 0; }
.crane-shown tr { background: none !important; }
.crane-shown th, .crane-shown td { padding: .15em 1.1em .15em 0; text-align: left !important;
  white-space: nowrap; border: 0; border-bottom: 1px solid rgba(128, 128, 128, .3);
  vertical-align: top; background: none; }
.crane-shown th { font-weight: 600; }
.crane-shown .n, .crane-shown [style*="right"] { text-align: right !important; }
.crane-shown td.crane-words { white-space: normal; min-width: 16rem; overflow-wrap: anywhere; }
.crane-shown pre { padding: 0; font-size: 12px;
  background: none; color: inherit; white-space: pre; }
.crane-shown img { max-width: 100%; height: auto; display: block; margin: .5em 0;
  background: #fff; border-radius: 6px; }
.crane-shown iframe { width: 100%; height: 560px; display: block; margin: .5em 0;
  border: 1px solid rgba(128, 128, 128, .4); border-radius: 6px; background: #f4f6f8; }
.crane-shown summary { cursor: pointer; font-weight: 600; margin: .5em 0 0; }
"""


def to_html(value: Any) -> str | None:
    """An object as HTML; None where nothing is to be shown but its line."""
    parts = [*_motion_frame(value), *_figure_images(value), *_text_blocks(value)]
    if not parts:
        return None
    line = f'<p class="crane-line">{escape(repr(value))}</p>'
    return f'<div class="crane-shown"><style>{_CSS}</style>{line}{"".join(parts)}</div>'


def _lookup_by_class(value: Any, by_class: Mapping[str, Any]) -> Any:
    """What is said of an object's class, or of the nearest that it inherits from."""
    return next(
        (by_class[x.__name__] for x in type(value).__mro__ if x.__name__ in by_class), None
    )


def _motion_frame(value: Any) -> Iterator[str]:
    """The page that plays its motion, in a frame that nothing gets out of."""
    if (motion_of := _lookup_by_class(value, _MOTIONS)) is None:
        return
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # said when the machine was loaded first
            machine, motion = motion_of(value)
            if motion is None:
                return
            text = report_html(machine, motion, frame_share=_FRAME_SHARE)
    except CraneError as error:
        yield _note_paragraph(f"its motion is not played: {error}")
        return
    source = text.replace("&", "&amp;").replace('"', "&quot;")
    yield f'<iframe title="motion" sandbox="allow-scripts" srcdoc="{source}"></iframe>'


def _figure_images(value: Any) -> Iterator[str]:
    try:
        with mpl.rc_context(FIGURE_STYLE):
            if isinstance(value, Machine):
                yield svg_tag(sketch_figure(value), f"sketch of {value.name}")
            for name in _lookup_by_class(value, _FIGURES) or ():
                module, _, function = name.partition(".")
                result = getattr(import_module(f"crane.view.plots.{module}"), function)(value)
                figures = result if isinstance(result, list) else [result]
                yield from (image_tag(figure, repr(value)) for figure in figures[:_MAX_FIGURES])
    except CraneError as error:
        yield _note_paragraph(f"no picture: {error}")


def _text_blocks(value: Any) -> Iterator[str]:
    if isinstance(value, Machine):
        # notebooks are given away, and where a file lies here concerns nobody there
        yield from _fact_tables([fact for fact in machine_facts(value) if fact.name != "file"])
    elif isinstance(value, Recording):
        yield from _split_blocks(summarize(value).to_markdown(), _render_markdown)
    elif hasattr(value, "to_markdown"):
        yield from _split_blocks(value.to_markdown(), _render_markdown)
    elif hasattr(value, "to_text"):
        yield from _split_blocks(value.to_text(), _preformatted)


def _fact_tables(facts: list[MachineFact]) -> Iterator[str]:
    """What is said in a word first, then what has a table, which can be folded."""
    rows = [(escape(x.name), f'<td class="crane-words">{escape(x.text)}</td>') for x in facts]
    yield html_table(["*", "*"], [row for row, x in zip(rows, facts, strict=True) if not x.rows])
    for fact in facts:
        if fact.rows:
            heading = [f"{escape(name)}*" for name in fact.heading]
            cells = html_table(heading, [[escape(cell) for cell in row] for row in fact.rows])
            title = escape(f"{fact.name}: {fact.text}")
            yield f"<details open><summary>{title}</summary>{cells}</details>"


def _split_blocks(text: str, render_text: Callable[[str], str]) -> Iterator[str]:
    """Parts of a text that blank lines divide; its tables as such, without its title."""
    for block in re.split(r"\n\s*\n", re.sub(r"\A# .*\n", "", text).strip("\n")):
        if block.lstrip().startswith("|"):
            yield f'<div class="scroll">{_render_markdown(block)}</div>'
        elif block:
            yield render_text(block)


def _render_markdown(text: str) -> str:
    """Markdown of lists, tables, bold words and code; HTML, links and images are but text."""
    rules = ["backticks", "emphasis", "heading", "list", "table"]
    return MarkdownIt("zero").enable(rules).render(text)


def _preformatted(text: str) -> str:
    return f"<pre>{escape(text)}</pre>"


def _note_paragraph(text: str) -> str:
    return f'<p class="crane-note">{escape(text)}</p>'
