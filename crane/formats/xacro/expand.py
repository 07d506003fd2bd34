"""Files with macros, expanded by the xacro package in a process of its own."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from lxml import etree

from crane.common.errors import CraneError, DescriptionError, InputError, known
from crane.common.extras import how
from crane.common.packages import OWN_ARGUMENTS, given
from crane.formats.xacro import process
from crane.formats.xml import Places, XmlFile

_SPACE = "http://www.ros.org/wiki/xacro"
_INSTALL = f"is written with xacro, {how('xacro')}"
_ROOT = Path(__file__).resolve().parents[3]
_PATIENCE = 10 * process.SECONDS  # [s], for systems that do not limit computing


def needs_xacro(xml: XmlFile) -> bool:
    """Whether a file has elements of xacro, or is called .xacro."""
    if xml.file.suffix.lower() == ".xacro":
        return True
    return any(
        isinstance(element.tag, str) and element.tag.startswith("{") and "xacro" in element.tag
        for element in xml.root.iter()
    )


def expanded(xml: XmlFile) -> XmlFile:
    """A file with its macros expanded, whose elements know where they were written.

    Includes by `$(find PACKAGE)`, `package://` and paths, arguments, conditions, properties and
    YAML mean what they mean in xacro, since xacro reads them.

    Raises:
        DescriptionError: xacro is not installed, or refuses the file.
        InputError: An argument was given that the file does not have.
    """
    told = _ask(xml.file)
    if "missing" in told:
        raise DescriptionError(f"{xml.file.name}: {_INSTALL}")
    if "wrong" in told:
        raise _refused(xml.file, told)
    _check_arguments(xml.file, told["arguments"])
    parser = etree.XMLParser(resolve_entities=False, no_network=True, remove_comments=True)
    root = etree.fromstring(told["text"].encode("utf-8"), parser)
    names = [Path(name).name for name in told["files"]]
    places = Places(xml.file.name)
    for element in root.iter(etree.Element):
        number, _, line = element.attrib.pop(process.PLACE, "0:1").partition(":")
        places.put(element, f"{names[int(number)]}:{line}")
    return XmlFile.made(xml.file, root, places.listed)


def _ask(file: Path) -> dict[str, Any]:
    """What the process says."""
    now = given()
    wanted = {
        "file": str(file), "root": str(_ROOT), "packages": list(now.packages),
        "arguments": dict(now.arguments),
    }  # fmt: skip
    program = [sys.executable, "-P", process.__file__]  # its folder has modules of other names
    try:
        done = subprocess.run(
            program, input=json.dumps(wanted).encode(), capture_output=True, timeout=_PATIENCE
        )
        return dict(json.loads(done.stdout))
    except subprocess.TimeoutExpired:
        pass
    except ValueError:  # it was ended before it could answer
        pass
    return {"wrong": f"expanding it takes more than {process.SECONDS} s", "file": str(file)}


def _refused(file: Path, told: dict[str, Any]) -> CraneError:
    place = Path(told.get("file") or file).name
    if "line" in told:
        place += f":{told['line']}"
    if name := told.get("package"):
        return DescriptionError(
            f"{place}: package '{name}' is not found, say where it is: --packages FOLDER, "
            "packages=[...] in Python"
        )
    return DescriptionError(f"{place}: xacro refuses it ({told['wrong']}), correct it")


def _check_arguments(file: Path, has: list[str]) -> None:
    for name in given().arguments:
        if name not in (*has, *OWN_ARGUMENTS):
            raise InputError(f"{file.name} has no argument '{name}', {known(has, name)}")
