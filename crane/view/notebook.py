"""What a notebook shows of an object: one line, its page, its figures, and its words as tables.

Results know their text (`to_markdown` or `to_text`), `crane.view.result_files` their figures. The
HTML holds all of it, nothing is loaded from anywhere.
"""

import re
import warnings
from collections.abc import Callable, Iterator
from html import escape
from typing import Any

import matplotlib as mpl
from markdown_it import MarkdownIt

from crane.common.errors import CraneError
from crane.machine.machine import Machine
from crane.recordings.recording import Recording
from crane.recordings.recording_summary import summarize
from crane.view.machine_facts import MachineFact, machine_facts
from crane.view.page.html_document import html_table
from crane.view.page.report_page import report_html
from crane.view.plots.figure_style import FIGURE_STYLE, image_tag, svg_tag
from crane.view.result_files import notebook_figures, result_files, view_function
from crane.view.sketches.sketch_figure import sketch_figure

_FRAME_SHARE = (
    0.06  # of the frames and spans of a page: a notebook keeps all its outputs in one file
)
_MAX_FIGURES = 8
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


def _motion_frame(value: Any) -> Iterator[str]:
    """The page that plays its motion, in a frame that nothing gets out of."""
    files = result_files(value)
    if files is None or files.motion is None:
        return
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # said when the machine was loaded first
            machine, motion = files.motion(value)
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
            for name in notebook_figures(value):
                result = view_function(name)(value)
                yield from (
                    image_tag(figure, repr(value))
                    for figure in (result if isinstance(result, list) else [result])[:_MAX_FIGURES]
                )
    except CraneError as error:
        yield _note_paragraph(f"no picture: {error}")


def _text_blocks(value: Any) -> Iterator[str]:
    if isinstance(value, Machine):
        # notebooks are given away, and where a file lies here concerns nobody there
        return _fact_tables([fact for fact in machine_facts(value) if fact.name != "file"])
    if isinstance(value, Recording):
        return _split_blocks(summarize(value).to_markdown(), _render_markdown)
    if hasattr(value, "to_markdown"):
        return _split_blocks(value.to_markdown(), _render_markdown)
    text = value.to_text() if hasattr(value, "to_text") else ""
    return _split_blocks(text, lambda block: f"<pre>{escape(block)}</pre>")


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
    blocks = re.split(r"\n\s*\n", re.sub(r"\A# .*\n", "", text).strip("\n"))
    for block in filter(None, blocks):
        if block.lstrip().startswith("|"):
            yield f'<div class="scroll">{_render_markdown(block)}</div>'
        else:
            yield render_text(block)


def _render_markdown(text: str) -> str:
    """Markdown of lists, tables, bold words and code; HTML, links and images are but text."""
    return (
        MarkdownIt("zero")
        .enable(["backticks", "emphasis", "heading", "list", "table"])
        .render(text)
    )


def _note_paragraph(text: str) -> str:
    return f'<p class="crane-note">{escape(text)}</p>'
