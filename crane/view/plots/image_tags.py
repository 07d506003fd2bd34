"""Figures as HTML elements that hold their pictures."""

import base64
import io
import re
from html import escape
from urllib.parse import quote

from matplotlib.figure import Figure

_PIXELS_PER_INCH = 96  # dots of a browser
# What of an SVG may stand in an address as it is; all else is written as %XX.
_UNQUOTED_CHARACTERS = " /:=;,.()'!*?&@+$[]"


def image_tag(figure: Figure, alternative_text: str) -> str:
    """A figure as an HTML element that holds its picture, at its own size in inches."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150, metadata={"Software": None})
    return _image_element(
        figure, alternative_text, f"png;base64,{base64.b64encode(buffer.getvalue()).decode()}"
    )


def svg_tag(figure: Figure, alternative_text: str) -> str:
    """A figure of few lines likewise, as SVG.

    It stands in an element of its own and not among those of the page: names within two drawings
    of a page cannot meet, no script in it would run, and notebooks that are not trusted show it.
    """
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = re.sub(r"<!--.*?-->", "", buffer.getvalue(), flags=re.DOTALL)
    paths = re.sub(r' d="[^"]*"', lambda path: _round_path(path[0]), text)
    drawing = " ".join(paths[paths.index("<svg") :].replace('"', "'").split())
    return _image_element(
        figure, alternative_text, f"svg+xml,{quote(drawing, safe=_UNQUOTED_CHARACTERS)}"
    )


def _round_path(path: str) -> str:
    """A path to hundredths of a point."""
    return re.sub(r"(\.\d\d)\d+", r"\1", path)


def _image_element(figure: Figure, alternative_text: str, data: str) -> str:
    width = round(_PIXELS_PER_INCH * figure.get_figwidth())
    source = data.replace("&", "&amp;")
    return f'<img alt="{escape(alternative_text)}" width="{width}" src="data:image/{source}">'
