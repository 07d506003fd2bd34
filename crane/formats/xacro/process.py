"""A process that expands a xacro file: whatever is in it can end this process, and nothing else.

Run by crane.formats.xacro.expand with what it needs as JSON on its input; it writes a line of
JSON. xacro computes with Python's expressions, without bounds, so time and memory are limited.

Every element of the result says where it was written: the attribute `PLACE` has the number of its
file and its line.
"""

import json
import os
import sys
import types
from pathlib import Path
from typing import Any
from xml.dom import expatbuilder
from xml.parsers.expat import ExpatError

MEMORY, SECONDS = 2 << 30, 20  # [bytes], [s] of computing
LARGEST = 50_000_000  # characters of an expanded file
PLACE = "crane_place"
_XACRO = "xacro:"


def main() -> None:
    """Expand what is asked for."""
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)  # the output is ours alone
    os.dup2(silence, 2)
    asked = json.load(sys.stdin)
    sys.path.insert(0, asked["root"])
    try:
        import xacro
    except ImportError:
        answer: dict[str, Any] = {"missing": True}
    else:
        _limit()
        answer = _expanded(xacro, asked)
    out.write(json.dumps(answer) + "\n")
    out.flush()


def _limit() -> None:
    """Bound time and memory, where the system can."""
    try:
        import resource
    except ImportError:
        return
    for what, most in ((resource.RLIMIT_CPU, SECONDS), (resource.RLIMIT_AS, MEMORY)):
        hard = resource.getrlimit(what)[1]
        resource.setrlimit(what, (most if hard < 0 else min(most, hard), hard))


class _Files:
    """The files that were read, with the lines of their elements, and the arguments they have."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.arguments: dict[str, None] = {}

    def parsed(self, file: str) -> Any:
        """The document of a file, each element but those of xacro with its place."""
        number = len(self.names)
        self.names.append(file)
        files = self

        class Marking(expatbuilder.ExpatBuilderNS):
            def start_element_handler(self, name: str, attributes: list[str]) -> None:
                super().start_element_handler(name, attributes)
                files.mark(self.curNode, number, self.getParser().CurrentLineNumber)

        return Marking().parseString(Path(file).read_bytes())

    def mark(self, element: Any, number: int, line: int) -> None:
        """Note where an element was written."""
        if not element.tagName.startswith(_XACRO):
            element.setAttribute(PLACE, f"{number}:{line}")
        elif element.localName == "arg":
            self.arguments[element.getAttribute("name")] = None


def _expanded(xacro: Any, asked: dict[str, Any]) -> dict[str, Any]:
    files = _Files()
    missing: list[str] = []
    _lend_packages(Path(asked["file"]).parent, asked["packages"], missing, xacro)

    def parse(inp: Any, filename: str | None = None) -> Any:
        if filename is None:
            return inp
        try:
            return files.parsed(filename)
        except OSError as error:
            xacro.filestack.pop()
            raise xacro.XacroException(f"{error.strerror}: {filename}", exc=error) from None

    xacro.parse = parse
    found: dict[str, Any] = {}
    try:
        text = xacro.process_file(asked["file"], mappings=dict(asked["arguments"])).toxml()
        if len(text) > LARGEST:
            return {"wrong": f"it grows beyond {LARGEST} characters", "file": asked["file"]}
        found["text"] = text
    except ExpatError as error:
        words = str(error).partition(": line")[0]
        found = {"wrong": f"not XML, {words}", "file": files.names[-1], "line": error.lineno}
    except MemoryError:
        found["wrong"] = f"expanding it takes more than {MEMORY >> 30} GB"
    except RecursionError:
        found["wrong"] = "its macros or files use themselves without end"
    except Exception as error:  # whatever xacro and the expressions in a file raise
        found["wrong"] = " ".join(str(error).split())[:300] or type(error).__name__
    if "wrong" in found and missing:
        found |= {"package": missing[0]}
    stack = [name for name in (getattr(xacro, "filestack", None) or []) if name]
    return {"file": stack[-1] if stack else asked["file"], "files": files.names,
            "arguments": list(files.arguments), **found}  # fmt: skip


def _lend_packages(folder: Path, packages: list[str], missing: list[str], xacro: Any) -> None:
    """Let xacro find packages as this program does, whether ROS is installed or not."""
    from crane.common.packages import find_file, find_package, giving

    def share(name: str) -> str:
        here = Path(next((x for x in reversed(xacro.filestack or []) if x), folder / "x")).parent
        with giving(packages):
            found = find_package(name, here) or find_package(name, folder)
        if found is None:
            missing.append(name)
            raise LookupError(f"package '{name}' is not found")
        return str(found)

    before = xacro.abs_filename_spec

    def absolute(name: str) -> str:
        if "://" not in name:
            return str(before(name))
        package = name.partition("://")[2].partition("/")[0]
        with giving(packages):
            found = find_file(name, folder)
            if found is None and find_package(package, folder) is None:
                missing.append(package)
        if found is None:
            raise LookupError(f"there is no '{name}'")
        return str(found)

    lent = types.ModuleType("ament_index_python.packages")
    lent.get_package_share_directory = share  # type: ignore[attr-defined]
    sys.modules["ament_index_python"] = types.ModuleType("ament_index_python")
    sys.modules["ament_index_python.packages"] = lent
    xacro.abs_filename_spec = absolute


if __name__ == "__main__":
    main()
