"""Write the home configuration into the file of a machine, whose other text stays unchanged."""

import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from lxml import etree

from crane.common.atomic_output import check_file_is_writable, replace_file
from crane.common.errors import CraneError, OutputError, ignore_warnings
from crane.common.package_search import NEAREST_ASSEMBLY
from crane.common.samples import Array
from crane.common.unit_conversions import WrittenNumber
from crane.description.machine_lookup import bundled_machines, example_robots
from crane.formats.machine_file.yaml_edits import TextEdit, apply_edits, edit_yaml
from crane.formats.machine_loading import load
from crane.formats.robot_files import is_sdf_file, is_simulator_file
from crane.machine.machine import Machine

_SAME_HOME_TOLERANCE = 1e-9
_BYTE_ORDER_MARK = "\ufeff"
# comments and the like, which have no name, and tags
_TAG_PATTERN = re.compile(
    r"""<!--.*?-->|<!\[CDATA\[.*?\]\]>|<\?.*?\?>"""
    r"""|<(?P<slash>/?)(?P<name>[^\s/>]+)(?:[^>"']|"[^"]*"|'[^']*')*>""",
    re.DOTALL,
)
_VALUE_PATTERN = re.compile(r"""(?<=\s)value\s*=\s*(?:"[^"]*"|'[^']*')""")


def write_home(
    name: str | Path,
    active: Sequence[str] | None = None,
    free: Sequence[str] | None = None,
    packages: Sequence[str | Path] = (),
    arguments: Mapping[str, object] | None = None,
    q: Array | None = None,
) -> Path:
    """Write the closed home configuration of a machine into its file in full precision.

    This also accepts a home that is far from the home of the file, which `load` refuses. In a
    machine file and a robot.yaml home is the section `home:`, in a URDF `<group_state
    name="home">`. Existing values are replaced, missing joints are added; comments stay. If the
    file does not give the same home when it is loaded again, its old text is restored.

    Args:
        name: As for `load`.
        active: As for `load`.
        free: As for `load`.
        packages: As for `load`.
        arguments: As for `load`.
        q: (nq,) closed configuration that becomes home instead [m], [rad].

    Returns:
        The file.

    Raises:
        OutputError: The file belongs to a package, is SDF or MJCF, or cannot be written.
        CraneError: As `load`.
    """
    with ignore_warnings():
        machine = load(
            name,
            active=active,
            free=free,
            packages=packages,
            arguments={**(arguments or {}), NEAREST_ASSEMBLY: True},
        )
        if q is not None:
            machine = machine.with_home_configuration(q, machine.active)
        path = machine.path.resolve()
        _check_is_writable(machine, path)
        try:
            text = path.read_bytes().decode("utf-8")
        except UnicodeDecodeError:
            raise OutputError(f"{path}: is not UTF-8, save it so first") from None
        written, plain = machine.written_numbers, WrittenNumber(0.0)
        home = {
            joint: written.get(("home", joint), plain).write(value)
            for joint, value in zip(machine.joints, machine.home.tolist(), strict=True)
        }
        plain_text = text.removeprefix(_BYTE_ORDER_MARK)
        if path.suffix.lower() in (".yaml", ".yml"):
            edited = edit_yaml(plain_text, {"home": home})
        else:
            edited = apply_edits(plain_text, _xml_edits(plain_text, home))
        _replace_text(path, _BYTE_ORDER_MARK * text.startswith(_BYTE_ORDER_MARK) + edited)
        try:
            _check_written_home(path, machine, arguments)
        except CraneError:
            _replace_text(path, text)
            raise
    return path


def _replace_text(path: Path, text: str) -> None:
    with replace_file(path) as temporary_file:
        temporary_file.write_bytes(text.encode("utf-8"))
        shutil.copymode(path, temporary_file)


def _check_is_writable(machine: Machine, path: Path) -> None:
    search, command_line = machine.closure.home_search, machine.command_line_arguments
    if search is None or not search.is_far:
        command_line = command_line.replace(f" --arg {NEAREST_ASSEMBLY}:=true", "")
    copy_hint = f"write it into a copy: crane convert {command_line} FOLDER"
    packaged_files = {
        place.resolve() for place in (*bundled_machines().values(), *example_robots().values())
    }
    if path in packaged_files:
        raise OutputError(f"{path}: belongs to a package, {copy_hint}")
    if is_simulator_file(path):
        kind = "an SDF" if is_sdf_file(path) else "a MJCF"
        raise OutputError(f"{path}: is {kind}, {copy_hint}")
    check_file_is_writable(path)


def _check_written_home(
    path: Path, expected: Machine, arguments: Mapping[str, object] | None
) -> None:
    try:
        machine = load(
            path,
            active=expected.chosen_joints.get("active"),
            free=expected.chosen_joints.get("free"),
            packages=expected.packages,
            arguments=arguments,
            trust_xacro=expected.trusts_xacro,
        )
    except CraneError as error:
        raise OutputError(f"{path}: home cannot be written into it ({error})") from None
    is_same = machine.joints == expected.joints and machine.closure.home_search is None
    if not is_same or np.abs(machine.home - expected.home).max(initial=0.0) > _SAME_HOME_TOLERANCE:
        coordinates = zip(expected.joints, expected.home.tolist(), strict=True)
        raise OutputError(
            f"{path}: home is read differently than written into it, write it by hand: "
            + ", ".join(f"{joint}: {value!r}" for joint, value in coordinates)
        )


def _xml_edits(text: str, home: Mapping[str, float | str]) -> list[TextEdit]:
    line_break = "\r\n" if "\r\n" in text else "\n"
    tags = [tag for tag in _TAG_PATTERN.finditer(text) if tag["name"]]
    start_tags = [tag for tag in tags if not tag["slash"]]
    root = etree.fromstring(text.encode("utf-8"))
    tag_of_element = dict(zip(root.iter(etree.Element), start_tags, strict=True))
    states = [x for x in root.iterfind("group_state") if x.get("name", "").strip() == "home"]
    edits: list[TextEdit] = []
    missing = dict(home)
    for element in (x for state in states for x in state.iterfind("joint")):
        tag = tag_of_element[element]
        old = _VALUE_PATTERN.search(text, tag.start(), tag.end())
        assert old is not None, "it was read before"
        value = missing.pop(element.get("name", "").strip())
        edits.append((old.start(), old.end(), f'value="{value!r}"'))
    joints = (etree.Element("joint", name=x, value=repr(value)) for x, value in missing.items())
    texts = [etree.tostring(joint, encoding="unicode") for joint in joints]
    new = "".join(f"{line_break}    {joint}" for joint in texts)
    if missing and not states:
        state = f'  <group_state name="home" group="all">{new}{line_break}  </group_state>'
        end = tags[-1].start()
        edits.append((end, end, f"{state}{line_break}"))
    elif missing:
        tag = tag_of_element[states[0]]
        is_empty = tag[0].endswith("/>")
        start = tag.end() - 2 * is_empty
        end_tag = f">{new}{line_break}  </group_state>" if is_empty else new
        edits.append((start, tag.end(), end_tag))
    return edits
