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
from crane.formats import recalled
from crane.machine import Machine
from crane.recordings.recording import Recording
from crane.recordings.summary import summarize
from crane.view.facts import Fact, facts_of
from crane.view.page.build import page
from crane.view.page.document import table
from crane.view.plots.recording import STYLE
from crane.view.plots.tags import drawing_tag, image_tag
from crane.view.sketch.draw import sketch_figure

_SHARE = 0.06  # of the frames and spans of a page: a notebook keeps all its outputs in one file
_MOST_FIGURES = 8
_FIGURES: Mapping[str, tuple[str, ...]] = {  # by class, in `crane.view.plots`
    "Calibration": ("calibration.calibration_figure",),
    "Capacity": ("capacity.capacity_figure",),
    "Comparison": ("comparison.comparison_figure",),
    "Design": ("design.design_figure",),
    "Excitation": ("excitation.excitation_figure",),
    "Identification": ("identification.force_figures",),
    "LinearModel": ("modes.modes_figure",),
    "PowerAccount": ("sankey.sankey_figure", "power.power_figure"),
    "PowerComparison": ("power_comparison.power_comparison_figure",),
    "Recording": ("recording.recording_figure",),
    "Sensitivities": ("sensitivities.sensitivities_figure",),
    "SignalExcitation": ("excitation.signals_figure",),
    "Study": ("study.study_figure",),
    "ToolForce": ("tool_force.tool_force_figure",),
    "WorkingRange": ("working_range.working_range_figure",),
    "Workspace": ("workspace.workspace_figure",),
}
# What moves, and how.
_MOTIONS: Mapping[str, Callable[[Any], tuple[Machine, Recording | None]]] = {
    "LinearModel": lambda model: (model.machine, model.motion()),
    "Recording": lambda recording: (recalled(recording.machine), recording),
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


def html(what: Any) -> str | None:
    """An object as HTML; None where nothing is to be shown but its line."""
    parts = [*_page(what), *_pictures(what), *_words(what)]
    if not parts:
        return None
    line = f'<p class="crane-line">{escape(repr(what))}</p>'
    return f'<div class="crane-shown"><style>{_CSS}</style>{line}{"".join(parts)}</div>'


def _of(what: Any, by_class: Mapping[str, Any]) -> Any:
    """What is said of an object's class, or of the nearest that it inherits from."""
    return next((by_class[x.__name__] for x in type(what).__mro__ if x.__name__ in by_class), None)


def _page(what: Any) -> Iterator[str]:
    """The page that plays its motion, in a frame that nothing gets out of."""
    if (motion_of := _of(what, _MOTIONS)) is None:
        return
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # said when the machine was loaded first
            machine, motion = motion_of(what)
            if motion is None:
                return
            text = page(machine, motion, share=_SHARE)
    except CraneError as error:
        yield _note(f"its motion is not played: {error}")
        return
    source = text.replace("&", "&amp;").replace('"', "&quot;")
    yield f'<iframe title="motion" sandbox="allow-scripts" srcdoc="{source}"></iframe>'


def _pictures(what: Any) -> Iterator[str]:
    try:
        with mpl.rc_context(STYLE):
            if isinstance(what, Machine):
                yield drawing_tag(sketch_figure(what), f"sketch of {what.name}")
            for name in _of(what, _FIGURES) or ():
                module, _, function = name.partition(".")
                drawn = getattr(import_module(f"crane.view.plots.{module}"), function)(what)
                figures = drawn if isinstance(drawn, list) else [drawn]
                yield from (image_tag(figure, repr(what)) for figure in figures[:_MOST_FIGURES])
    except CraneError as error:
        yield _note(f"no picture: {error}")


def _words(what: Any) -> Iterator[str]:
    if isinstance(what, Machine):
        # notebooks are given away, and where a file lies here concerns nobody there
        yield from _facts([fact for fact in facts_of(what) if fact.name != "file"])
    elif isinstance(what, Recording):
        yield from _blocks(summarize(what).to_markdown(), _markdown)
    elif hasattr(what, "to_markdown"):
        yield from _blocks(what.to_markdown(), _markdown)
    elif hasattr(what, "to_text"):
        yield from _blocks(what.to_text(), _typed)


def _facts(facts: list[Fact]) -> Iterator[str]:
    """What is said in a word first, then what has a table, which can be folded."""
    rows = [(escape(x.name), f'<td class="crane-words">{escape(x.text)}</td>') for x in facts]
    yield table(["*", "*"], [row for row, x in zip(rows, facts, strict=True) if not x.rows])
    for fact in facts:
        if fact.rows:
            head = [f"{escape(name)}*" for name in fact.head]
            cells = table(head, [[escape(cell) for cell in row] for row in fact.rows])
            title = escape(f"{fact.name}: {fact.text}")
            yield f"<details open><summary>{title}</summary>{cells}</details>"


def _blocks(text: str, otherwise: Callable[[str], str]) -> Iterator[str]:
    """Parts of a text that blank lines divide; its tables as such, without its title."""
    for block in re.split(r"\n\s*\n", re.sub(r"\A# .*\n", "", text).strip("\n")):
        if block.lstrip().startswith("|"):
            yield f'<div class="scroll">{_markdown(block)}</div>'
        elif block:
            yield otherwise(block)


def _markdown(text: str) -> str:
    """Markdown of lists, tables, bold words and code; HTML, links and images are but text."""
    rules = ["backticks", "emphasis", "heading", "list", "table"]
    return MarkdownIt("zero").enable(rules).render(text)


def _typed(text: str) -> str:
    return f"<pre>{escape(text)}</pre>"


def _note(text: str) -> str:
    return f'<p class="crane-note">{escape(text)}</p>'
