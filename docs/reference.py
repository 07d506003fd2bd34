"""Pages of the site that the package writes itself: its public names, commands and examples."""

import inspect
import re
import shutil
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, get_args, get_type_hints

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxRole

import crane
from crane.cli import program
from crane.cli.entry import GROUPS
from crane.view.result_files import RESULT_FILES

HERE = Path(__file__).parent
GENERATED = HERE / "generated"
EXAMPLES = HERE.parent / "examples"
ROOMS = [name for name in crane.__all__ if inspect.ismodule(getattr(crane, name))]
_HOMES = {name: f"crane.{room}" for room in ROOMS for name in getattr(crane, room).__all__}
_MEMBERS = "   :members:\n   :inherited-members: Exception, BaseException, object, tuple\n"


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the pages before any is read."""
    app.add_role("public", Public())
    app.connect("config-inited", lambda *_: write())
    app.connect("autodoc-process-docstring", _restructured, priority=400)  # before napoleon
    app.connect("autodoc-skip-member", _of_a_tuple)
    return {"parallel_read_safe": True}


class Public(SphinxRole):
    """`name`: a link where the package has a public name like that, otherwise code."""

    def run(self) -> tuple[list[nodes.Node], list[nodes.system_message]]:
        """The node of one name in backticks."""
        name = self.text.removeprefix("crane.")
        shown = nodes.literal(self.rawtext, self.text)
        first = name.split(".")[0]
        if first in ROOMS and "." in name:  # `crane.control.PI`
            first, name = name.split(".")[1], name.partition(".")[2]
        home = _HOMES.get(first, "crane.common.errors")
        if not hasattr(import_module(home), first):
            return [shown], []
        link = pending_xref(
            self.rawtext, shown, refdomain="py", reftype="obj", reftarget=f"{home}.{name}"
        )
        link["refdoc"] = self.env.docname
        return [link], []


def _of_a_tuple(
    _app: Sphinx, _what: str, _name: str, of: Any, _skip: bool, _options: Any
) -> bool | None:
    """Leave out what Python says of the fields of named tuples; their class says what they are."""
    return True if str(of.__doc__).startswith("Alias for field") else None


def _restructured(
    _app: Sphinx, _what: str, _name: str, _of: Any, _options: Any, lines: list[str]
) -> None:
    """Docstrings as reStructuredText has them: tables of Markdown, indented equations."""
    written: list[str] = []
    block, last = 0, ""  # indentation of a block of equations, the last line that is not empty
    for before, line in zip(["", *lines], lines, strict=False):
        indent = len(line) - len(line.lstrip())
        if not line or (block and indent >= block):
            written.append(line)
        elif not before and last and indent > len(last) - len(last.lstrip()):
            block = indent
            written += [" " * (len(last) - len(last.lstrip())) + "::", "", line]
        elif line.startswith("|"):
            block = 0
            written += _row(line, first=not before)
        else:
            block = 0
            written.append(line.replace("|", "\\|"))
        last = line or last
    lines[:] = written


def _row(line: str, first: bool) -> list[str]:
    if set(line) <= set("|-: "):
        return []
    key, *others = line.strip("|").split(" | ")
    head = [".. list-table::", "   :header-rows: 1", ""] if first else []
    return [*head, f"   * - {key.strip()}", *(f"     - {cell.strip()}" for cell in others)]


def write() -> None:
    """Write all of them anew."""
    shutil.rmtree(GENERATED / "api", ignore_errors=True)
    (GENERATED / "api").mkdir(parents=True)
    parts = _parts()
    for room in ROOMS:
        names = getattr(crane, room).__all__
        _write(f"api/{room}.rst", _room(room, sorted(names), parts.get(room, [])))
    _write("api/errors.rst", _errors())
    _write("api/index.rst", _index())
    _write("commands.md", _commands())
    _write("results.md", _results())
    _write("examples.md", _examples())


def _write(name: str, text: str) -> None:
    (GENERATED / name).write_text(text)


def _parts() -> dict[str, list[type]]:
    """By room, classes without a public name that attributes and results of public ones are."""
    every = [getattr(import_module(home), name) for name, home in _HOMES.items()]
    to_follow = [value for value in every if callable(value)]
    seen, found = set(to_follow), {}
    while to_follow:
        for part in _leads_to(to_follow.pop()):
            root, _, rest = part.__module__.partition(".")
            room = rest.partition(".")[0]
            inner = part.__name__.startswith("_") or room in ("closure", "codegen", "common")
            if part not in seen and root == "crane" and not inner:
                seen.add(part)
                to_follow.append(part)
                found.setdefault(room, []).append(part)
    return {room: sorted(parts, key=lambda x: x.__name__) for room, parts in found.items()}


def _leads_to(value: Any) -> Iterator[type]:
    """Classes of the attributes of a class, or of what a function returns."""
    if not inspect.isclass(value):
        yield from _classes(_hints(value).get("return"))
        return
    for name, hint in _hints(value).items():
        yield from () if name.startswith("_") else _classes(hint)
    for name, member in inspect.getmembers(value):
        of = getattr(member, "fget", None) or getattr(member, "func", None) or member
        if inspect.isfunction(of) and not name.startswith("_"):
            yield from _classes(_hints(of).get("return"))


def _hints(of: Any) -> dict[str, Any]:
    try:
        return get_type_hints(of)
    except NameError:  # of types that are imported where they are checked alone
        return {}


def _classes(hint: Any) -> Iterator[type]:
    if inspect.isclass(hint) and not get_args(hint):
        yield hint
    for part in get_args(hint):
        yield from _classes(part)


def _room(room: str, names: list[str], inner: list[type]) -> str:
    module = import_module(f"crane.{room}")
    parts = [_title(room.capitalize()), str(module.__doc__)]
    for name in names:
        value, path = getattr(module, name), f"crane.{room}.{name}"
        if inspect.isclass(value):
            parts.append(f".. autoclass:: {path}\n{_MEMBERS}")
        elif callable(value):
            parts.append(f".. autofunction:: {path}\n")
        else:
            parts.append(f".. py:data:: {path}\n\n   By name: {', '.join(value)}.\n")
    if inner:
        heading = "Related classes"
        parts += [
            f"{heading}\n{'-' * len(heading)}",
            "Classes of the attributes and results of the above.",
        ]
        parts += [f".. autoclass:: {x.__module__}.{x.__name__}\n{_MEMBERS}" for x in inner]
    return "\n\n".join(parts)


def _errors() -> str:
    text = "Errors of the package. The message is one line: what is wrong, where, and the remedy."
    body = ".. automodule:: crane.common.errors\n   :members:\n   :show-inheritance:\n"
    return "\n\n".join([_title("Errors"), text, body])


def _index() -> str:
    root = ", ".join(
        f"`{name}`" for name in crane.__all__ if not inspect.ismodule(getattr(crane, name))
    )
    rows = "\n".join(
        f"   * - :doc:`crane.{room} <{room}>`\n     - {_first_sentence(getattr(crane, room))}"
        for room in ROOMS
    )
    tree = "\n".join(f"   {room}" for room in [*ROOMS, "errors"])
    text = (
        f"The root of ``crane`` has the names that short programs need: {root}. All others are in "
        "submodules, which ``import crane`` makes available."
    )
    table = f".. list-table::\n\n{rows}\n"
    toctree = f".. toctree::\n   :maxdepth: 2\n   :hidden:\n\n{tree}\n"
    return "\n\n".join([_title("The package"), text, table, toctree])


def _first_sentence(module: ModuleType) -> str:
    return str(module.__doc__).partition("\n\n")[0].replace("\n", " ")


def _title(text: str) -> str:
    return f"{text}\n{'=' * len(text)}"


def _commands() -> str:
    """The commands by group, each with its arguments and options."""
    import typer
    from typer.cli import get_docs_for_click

    command = typer.main.get_command(program())
    context = typer.Context(command, info_name="crane")
    parts = ["# Commands", "```text", command.get_help(context), "```"]
    for group, names in GROUPS.items():
        parts.append(f"## {group.capitalize()}")
        for name in names.split():
            text = get_docs_for_click(
                obj=command.commands[name], ctx=context, name=name, call_prefix="crane", indent=2
            )
            parts.append(text.strip())
    return "\n\n".join(parts) + "\n"


def _results() -> str:
    """A table of the files of each class of results."""
    rows = ["| class | files | options |", "| --- | --- | --- |"]
    for name, files in RESULT_FILES.items():
        names = [*files.tables, *files.figures, *files.documents, *files.more_files]
        cells = ([files.summary] * bool(files.summary) + names, files.options)
        words = (", ".join(f"`{x}`" for x in cell) for cell in cells)
        rows.append(f"| `{name}` | {' | '.join(words)} |")
    return "\n".join(rows) + "\n"


def _examples() -> str:
    text = (EXAMPLES / "README.md").read_text()
    programs = re.findall(r"^\| (.+?) \| \[(\w+)\.py\]", text, re.MULTILINE)
    text = re.sub(r"\]\((\w+)\.py\)", r"](#example-\1)", text)
    whole = [
        f"(example-{name})=\n### {question}\n\n"
        f"```{{literalinclude}} ../../examples/{name}.py\n:language: python\n```\n"
        for question, name in programs
    ]
    return "\n".join([text, "## The programs", "", *whole])
