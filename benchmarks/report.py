"""Tables and paragraphs in Markdown."""

import textwrap
from collections.abc import Iterable, Sequence

WIDTH = 99  # of a line


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown, with numbers on the right."""
    marks = ["---", *["---:"] * (len(head) - 1)]
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, marks, *rows))


def paragraph(text: str) -> str:
    """A paragraph in lines of the usual width."""
    return textwrap.fill(text, WIDTH, break_long_words=False, break_on_hyphens=False)


def sentence(text: str) -> str:
    """A text with a capital at its begin."""
    return text[0].upper() + text[1:]
