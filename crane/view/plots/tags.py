"""Figures as HTML elements that hold their pictures."""

import base64
import io
import re
from html import escape
from urllib.parse import quote

from matplotlib.figure import Figure

_PER_INCH = 96  # dots of a browser
# What of an SVG may stand in an address as it is; all else is written as %XX.
_PLAIN = " /:=;,.()'!*?&@+$[]"


def image_tag(figure: Figure, words: str) -> str:
    """A figure as an HTML element that holds its picture, at its own size in inches."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150, metadata={"Software": None})
    return _tag(figure, words, f"png;base64,{base64.b64encode(buffer.getvalue()).decode()}")


def drawing_tag(figure: Figure, words: str) -> str:
    """A figure of few lines likewise, as SVG.

    It stands in an element of its own and not among those of the page: names within two drawings
    of a page cannot meet, no script in it would run, and notebooks that are not trusted show it.
    """
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = re.sub(r"<!--.*?-->", "", buffer.getvalue(), flags=re.DOTALL)
    paths = re.sub(r' d="[^"]*"', lambda path: _rounded(path[0]), text)
    drawing = " ".join(paths[paths.index("<svg") :].replace('"', "'").split())
    return _tag(figure, words, f"svg+xml,{quote(drawing, safe=_PLAIN)}")


def _rounded(path: str) -> str:
    """A path to hundredths of a point."""
    return re.sub(r"(\.\d\d)\d+", r"\1", path)


def _tag(figure: Figure, words: str, data: str) -> str:
    width = round(_PER_INCH * figure.get_figwidth())
    source = data.replace("&", "&amp;")
    return f'<img alt="{escape(words)}" width="{width}" src="data:image/{source}">'
