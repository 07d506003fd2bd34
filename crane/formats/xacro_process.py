"""A process that expands a xacro file, so that the file can crash only this process.

`crane.formats.robot_files` runs it with its request as JSON on the standard input; it writes a
line of JSON. xacro evaluates Python expressions without bounds, so time and memory are limited.

The attribute `LOCATION_ATTRIBUTE` of every element of the result contains index of the file and
line.
"""

import json
import os
import sys
import types
from pathlib import Path
from typing import Any
from xml.dom import expatbuilder
from xml.parsers.expat import ExpatError

MAX_LENGTH = 50_000_000  # characters of an expanded file
LOCATION_ATTRIBUTE = "crane_place"
_XACRO_PREFIX = "xacro:"


def main() -> None:
    """Expand the file of the request."""
    output = os.fdopen(os.dup(1), "w", encoding="utf-8")
    null_device = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null_device, 1)  # expressions cannot write into the output
    os.dup2(null_device, 2)
    request = json.load(sys.stdin)
    sys.path.insert(0, request["root"])
    try:
        import xacro
    except ImportError:
        answer: dict[str, Any] = {"missing": True}
    else:
        answer = _expand(xacro, request)
    output.write(json.dumps(answer) + "\n")
    output.flush()


class _LocationBuilder(expatbuilder.ExpatBuilderNS):
    """Builds the document of a file with the locations of all elements but those of xacro.

    Args:
        number: Index of the file.
        arguments: Receives the arguments of the file.
    """

    def __init__(self, number: int, arguments: dict[str, None]):
        super().__init__()
        self._number, self._arguments = number, arguments

    def start_element_handler(self, name: str, attributes: list[str]) -> None:
        """Called at each element."""
        super().start_element_handler(name, attributes)
        element: Any = self.curNode
        if not element.tagName.startswith(_XACRO_PREFIX):
            location = f"{self._number}:{self.getParser().CurrentLineNumber}"
            element.setAttribute(LOCATION_ATTRIBUTE, location)
        elif element.localName == "arg":
            self._arguments[element.getAttribute("name")] = None


def _expand(xacro: Any, request: dict[str, Any]) -> dict[str, Any]:
    from crane.formats.visuals.mesh_process import MAX_MEMORY, limit_resources

    limit_resources()
    names: list[str] = []
    arguments: dict[str, None] = {}
    missing: list[str] = []
    _provide_package_search(Path(request["file"]).parent, request["packages"], missing, xacro)

    def parse(inp: Any, filename: str | None = None) -> Any:
        if filename is None:
            return inp
        names.append(filename)
        try:
            builder = _LocationBuilder(len(names) - 1, arguments)
            return builder.parseString(Path(filename).read_bytes())
        except OSError as error:
            xacro.filestack.pop()
            raise xacro.XacroException(f"{error.strerror}: {filename}", exc=error) from None

    xacro.parse = parse
    found: dict[str, Any] = {}
    try:
        text = xacro.process_file(request["file"], mappings=dict(request["arguments"])).toxml()
        if len(text) > MAX_LENGTH:
            return {"wrong": f"it grows beyond {MAX_LENGTH} characters", "file": request["file"]}
        found["text"] = text
    except ExpatError as error:
        words = str(error).partition(": line")[0]
        found = {"wrong": f"not XML, {words}", "file": names[-1], "line": error.lineno}
    except MemoryError:
        found["wrong"] = f"expanding it takes more than {MAX_MEMORY >> 30} GB"
    except RecursionError:
        found["wrong"] = "its macros or files use themselves without end"
    except Exception as error:  # xacro and expressions raise anything
        found["wrong"] = " ".join(str(error).split())[:300] or type(error).__name__
    if "wrong" in found and missing:
        found |= {"package": missing[0]}
    stack = [name for name in (getattr(xacro, "filestack", None) or []) if name]
    return {"file": stack[-1] if stack else request["file"], "files": names,
            "arguments": list(arguments), **found}  # fmt: skip


def _provide_package_search(
    folder: Path, packages: list[str], missing_packages: list[str], xacro: Any
) -> None:
    """Make xacro find packages as this package does, whether ROS is installed or not."""
    from crane.common.package_search import find_file, find_package, use_load_options

    def share(name: str) -> str:
        here = Path(next((x for x in reversed(xacro.filestack or []) if x), folder / "x")).parent
        with use_load_options(packages):
            found = find_package(name, here) or find_package(name, folder)
        if found is None:
            missing_packages.append(name)
            raise LookupError(f"package '{name}' is not found")
        return str(found)

    original_function = xacro.abs_filename_spec

    def absolute(name: str) -> str:
        if "://" not in name:
            return str(original_function(name))
        package = name.partition("://")[2].partition("/")[0]
        with use_load_options(packages):
            found = find_file(name, folder)
            if found is None and find_package(package, folder) is None:
                missing_packages.append(package)
        if found is None:
            raise LookupError(f"there is no '{name}'")
        return str(found)

    replacement_module = types.ModuleType("ament_index_python.packages")
    replacement_module.get_package_share_directory = share  # type: ignore[attr-defined]
    sys.modules["ament_index_python"] = types.ModuleType("ament_index_python")
    sys.modules["ament_index_python.packages"] = replacement_module
    xacro.abs_filename_spec = absolute


if __name__ == "__main__":
    main()
