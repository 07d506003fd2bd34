"""Self-contained HTML documents of text, tables and figures."""

import json
from collections.abc import Callable, Iterable, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from crane.common.atomic_output import replace_file
from crane.common.errors import OutputError

PAGE_SUFFIXES = (".html", ".htm")

_CSS = """
:root { color: #26292e; background: #fff; font: 15px/1.5 system-ui, "Segoe UI", sans-serif; }
body { max-width: 74rem; margin: 0 auto; padding: 1.5rem clamp(.8rem, 3vw, 2rem) 4rem; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: .5rem 0 1.2rem; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 2.6rem 0 .6rem; padding-top: .9rem; border-top: 1px solid #ddd; }
h3 { font-size: 1rem; margin: 1.4rem 0 .3rem; }
p { max-width: 46rem; margin: .4rem 0 .8rem; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .2rem 1.4rem; margin: 0; }
dt { color: #646a73; } dd { margin: 0; overflow-wrap: anywhere; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .87rem; }
th { text-align: left; font-weight: 600; border-bottom: 1.5px solid #9aa0a8; color: #444a52; }
th, td { padding: .22rem .9rem .22rem 0; vertical-align: top; white-space: nowrap; }
td { border-bottom: 1px solid #eceef0; }
th.n, td.n { text-align: right; }
th:first-child, td:first-child { position: sticky; left: 0; background: #fff; }
td.words { white-space: normal; min-width: 20rem; overflow-wrap: anywhere; }
tr.weak td { color: #8a9099; }
summary { cursor: pointer; } code { font-size: .93em; }
.figures { display: grid; gap: 1rem 1.5rem;
           grid-template-columns: repeat(auto-fit, minmax(min(100%, 27rem), 1fr)); }
pre { overflow-x: auto; background: #f5f6f7; padding: .7rem .9rem; font-size: .85rem; }
img { width: 100%; height: auto; display: block; }
.matrix { margin-top: 1.5rem; min-width: 36rem; max-width: 56rem; }
"""


def write_document(path: str | Path, heading: str, parts: Iterable[str]) -> Path:
    """Write a page.

    Args:
        path: The file to write; replaced if it exists.
        heading: Heading of the page.
        parts: HTML of its parts.

    Returns:
        The path.

    Raises:
        OutputError: The file's suffix is not .html or .htm, or it cannot be written.
    """
    heading = escape(heading)
    text = (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{heading}</title>\n<style>{_CSS}</style>\n</head>\n<body>\n"
        f"<h1>{heading}</h1>\n" + "\n".join(parts) + "\n</body>\n</html>\n"
    )
    return write_page(path, lambda: text)


def write_page(path: str | Path, create_text: Callable[[], str]) -> Path:
    """Create the HTML text of a page, write it to a file, and return the path.

    Raises:
        OutputError: The file's suffix is not .html or .htm, or it cannot be written.
    """
    if Path(path).suffix.lower() not in PAGE_SUFFIXES:
        raise OutputError(f"{path}: a page is for a browser, end the name in .html")
    text = create_text()
    with replace_file(path) as part:
        part.write_text(text, encoding="utf-8", errors="backslashreplace")
    return Path(path)


def asset_text(*names: str) -> str:
    """Return files of `assets`, one after the other."""
    assets = files("crane.view.page") / "assets"
    return "\n".join((assets / name).read_text(encoding="utf-8") for name in names)


def filled_template(
    template: str,
    styles: Iterable[str],
    scripts: Iterable[str],
    title: str,
    data: Any,
    **texts: str,
) -> str:
    """Return a page by a template of `assets`.

    Args:
        template: Its name without suffix.
        styles: Names of style sheets without suffix.
        scripts: Names of scripts without suffix.
        title: Title of the page.
        data: What the scripts read, as JSON.
        texts: Other texts of the template.
    """
    return Template(asset_text(f"{template}.html")).substitute(
        title=escape(title),
        style=asset_text(*(f"{name}.css" for name in styles)),
        script=asset_text(*(f"{name}.js" for name in scripts)),
        data=script_json(data),
        **texts,
    )


def script_json(value: Any) -> str:
    """Return JSON that is safe inside a script element."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def definition_list(rows: Iterable[tuple[str, str]]) -> str:
    """Return a definition list as HTML, without entries of empty text."""
    items = (f"<dt>{name}</dt><dd>{escape(text)}</dd>" for name, text in rows if text)
    return f"<dl>{''.join(items)}</dl>"


def html_table(
    headings: Sequence[str], rows: Iterable[Sequence[str]], classes: Iterable[str] = ()
) -> str:
    """Return an HTML table of HTML cells; a heading that ends in * marks a text column."""
    cell_attributes = ["" if name.endswith("*") else ' class="n"' for name in headings]
    heading_cells = "".join(
        f"<th{k}>{name.rstrip('*')}</th>"
        for k, name in zip(cell_attributes, headings, strict=True)
    )
    row_classes = iter(classes)
    body = []
    for row in rows:
        row_class = next(row_classes, "")
        cells = "".join(
            cell if cell.startswith("<td") else f"<td{k}>{cell}</td>"
            for k, cell in zip(cell_attributes, row, strict=True)
        )
        body.append(f'<tr class="{row_class}">{cells}</tr>' if row_class else f"<tr>{cells}</tr>")
    return f'<div class="scroll"><table><tr>{heading_cells}</tr>{"".join(body)}</table></div>'
