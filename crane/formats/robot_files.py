"""Files of robots as URDF: xacro is expanded, SDF and drawings are translated."""

import json
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lxml import etree

from crane.common.errors import (
    DescriptionError,
    InputError,
    ignore_warnings,
    suggest_names,
)
from crane.common.optional_libraries import installation_hint
from crane.common.package_search import OWN_ARGUMENTS, load_options, use_load_options
from crane.description.force_elements import ForceElement
from crane.formats import xacro_process
from crane.formats.visuals.mesh_process import MAX_SECONDS
from crane.formats.xml_file import XmlFile, set_source_location
from crane.machine.machine import Machine

_PACKAGE_ROOT = Path(__file__).resolve().parents[2]
_TIMEOUT = 10 * MAX_SECONDS  # [s], for systems without CPU limits


def _expand_xacro(xml: XmlFile) -> XmlFile:
    """Return a file with its macros expanded and the source locations of its elements.

    xacro itself processes includes by `$(find PACKAGE)`, `package://` and paths, arguments,
    conditions, properties and YAML, with the restrictions of `crane.formats.xacro_process`.

    Raises:
        DescriptionError: xacro is not installed, or refuses the file.
        InputError: The file does not have one of the given arguments.
    """
    answer = _run_xacro_process(xml.file)
    if "missing" in answer:
        raise DescriptionError(
            f"{xml.file.name}: is written with xacro, {installation_hint('xacro')}"
        )
    if "wrong" in answer:
        location = Path(answer.get("file") or xml.file).name
        location += f":{answer['line']}" if "line" in answer else ""
        if name := answer.get("package"):
            raise DescriptionError(
                f"{location}: package '{name}' is not found, say where it is: --packages FOLDER, "
                "packages=[...] in Python"
            )
        raise DescriptionError(f"{location}: xacro refuses it ({answer['wrong']}), correct it")
    for name in load_options().arguments:
        if name not in (*answer["arguments"], *OWN_ARGUMENTS):
            raise InputError(
                f"{xml.file.name} has no argument '{name}', "
                f"{suggest_names(answer['arguments'], name)}"
            )
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, remove_comments=True, remove_pis=True
    )
    root = etree.fromstring(answer["text"].encode("utf-8"), parser)
    locations = {xml.file.name: 0}
    for element in root.iter(etree.Element):
        number, _, line = element.attrib.pop(xacro_process.LOCATION_ATTRIBUTE, "0:1").partition(
            ":"
        )
        file_name = Path(answer["files"][int(number)]).name
        set_source_location(element, f"{file_name}:{line}", locations)
    return XmlFile(xml.file, root, locations)


def _run_xacro_process(file: Path) -> dict[str, Any]:
    options = load_options()
    request = {
        "file": str(file), "root": str(_PACKAGE_ROOT), "packages": list(options.packages),
        "arguments": dict(options.arguments), "trust": options.trust_xacro,
    }  # fmt: skip
    program = [sys.executable, "-P", xacro_process.__file__]  # without its folder in sys.path
    try:
        completed = subprocess.run(
            program, input=json.dumps(request).encode(), capture_output=True, timeout=_TIMEOUT
        )
        return dict(json.loads(completed.stdout))
    except (subprocess.TimeoutExpired, ValueError):  # killed before it could answer
        return {"wrong": f"expanding it takes more than {MAX_SECONDS} s", "file": str(file)}


_SDF_SUFFIXES, DRAWING_SUFFIXES = (".sdf", ".world"), (".yaml", ".yml")
_ROBOT_SUFFIXES, _AMBIGUOUS_SUFFIXES = (".urdf", ".xacro", *_SDF_SUFFIXES), (".xml", ".mjcf")


def open_robot(file: Path) -> tuple[XmlFile, tuple[ForceElement, ...]]:
    """Return the robot of a file as URDF, and its springs, which URDF does not have.

    Raises:
        DescriptionError: The file cannot be read, expanded or translated.
    """
    if file.suffix.lower() in DRAWING_SUFFIXES:
        from crane.formats.drawing.drawing_translation import (
            open_drawing,  # few machines are drawn
        )

        return open_drawing(file), ()
    xml = XmlFile(file)
    if file.suffix.lower() == ".xacro" or any(
        element.tag.startswith("{") and "xacro" in element.tag for element in xml.root.iter()
    ):
        xml = _expand_xacro(xml)
    if file.suffix.lower() in _SDF_SUFFIXES and xml.root.tag not in ("sdf", "robot"):
        raise xml.error_at(xml.root, f"an SDF starts with <sdf>, this file with <{xml.root.tag}>")
    if xml.root.tag == "sdf":
        from crane.formats.sdf.sdf_translation import translate_to_urdf  # few files are SDF

        return translate_to_urdf(xml)
    return xml, ()


def is_robot_file(file: Path) -> bool:
    """Whether a file is XML with a robot and not a MuJoCo model."""
    suffix = file.suffix.lower()
    if suffix in _AMBIGUOUS_SUFFIXES:
        return XmlFile(file).root.tag in ("robot", "sdf")
    return suffix in _ROBOT_SUFFIXES


def is_sdf_file(file: Path) -> bool:
    """Whether a file is SDF."""
    suffix = file.suffix.lower()
    return suffix in _SDF_SUFFIXES or (suffix == ".xml" and XmlFile(file).root.tag == "sdf")


def is_simulator_file(file: Path) -> bool:
    """Whether a file is SDF or MJCF, which give all coordinates of home and are not changed."""
    is_machine_file = file.suffix.lower() in DRAWING_SUFFIXES
    return not is_machine_file and (is_sdf_file(file) or not is_robot_file(file))


@contextmanager
def open_robots(machine: Machine, chains: Iterable[str] | None = None) -> Iterator[list[XmlFile]]:
    """Yield the robots that a machine was made of, with its load options active; MJCF has none.

    Args:
        machine: The machine.
        chains: Names of the chains, all if not given.
    """
    chain_names = None if chains is None else set(chains)
    with use_load_options(machine.packages, machine.arguments, trust_xacro=machine.trusts_xacro):
        with ignore_warnings():  # they were issued when it was loaded
            documents = [
                open_robot(chain.urdf)[0]
                for chain in machine.chains
                if (is_robot_file(chain.urdf) or chain.urdf.suffix.lower() in DRAWING_SUFFIXES)
                and (not chain_names or chain.name in chain_names)
            ]
        yield documents
