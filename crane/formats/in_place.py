"""The home posture written into the file of a machine, whose other text stays as it is."""

import re
import shutil
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from xml.parsers import expat

import numpy as np
import yaml

from crane.common.errors import CraneError, CraneWarning, OutputError
from crane.common.output import check_file, replacing
from crane.common.packages import NEAREST_ASSEMBLY
from crane.description.sources import bundled, examples
from crane.formats.loading import load
from crane.formats.opening import is_sdf, is_simulators
from crane.machine import Machine

Edit = tuple[int, int, str]  # from, to, what stands there then

_SAME = 1e-9
_TAG = re.compile(r"""<(?:[^>"']|"[^"]*"|'[^']*')*>""")
_VALUE = re.compile(r"""(?<=\s)value\s*=\s*(?:"[^"]*"|'[^']*')""")


def write_home(
    name: str | Path,
    active: Sequence[str] | None = None,
    free: Sequence[str] | None = None,
    packages: Sequence[str | Path] = (),
    arguments: Mapping[str, object] | None = None,
) -> Path:
    """Write the closed home posture of a machine into its file, all joints in full digits.

    That also takes over an assembly that is far from what the file says, which `load` refuses.
    A machine file and a robot.yaml get it under `home:`, a URDF in `<group_state name="home">`.
    Numbers that stand there are replaced, joints that are missing are added; comments stay. A file
    that does not give the same home when it is loaded again gets its old text back.

    Args:
        name: As for `load`.
        active: As for `load`.
        free: As for `load`.
        packages: As for `load`.
        arguments: As for `load`.

    Returns:
        The file.

    Raises:
        OutputError: The file belongs to a package, is a MJCF, or cannot be written.
        CraneError: As `load`.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        anyway = {**(arguments or {}), NEAREST_ASSEMBLY: True}
        machine = load(name, active=active, free=free, packages=packages, arguments=anyway)
        path = machine.path.resolve()
        _check_place(machine, path)
        try:
            text = path.read_bytes().decode("utf-8")
        except UnicodeDecodeError:
            raise OutputError(f"{path}: is not UTF-8, save it so first") from None
        home = dict(zip(machine.joints, machine.home.tolist(), strict=True))
        urdf = path.suffix.lower() not in (".yaml", ".yml")
        _replace(path, _edited(text, _in_xml(text, home) if urdf else _in_yaml(text, home)))
        try:
            _check(path, machine)
        except CraneError:
            _replace(path, text)
            raise
    return path


def _replace(path: Path, text: str) -> None:
    with replacing(path) as part:
        part.write_bytes(text.encode("utf-8"))
        shutil.copymode(path, part)


def _own_arguments(machine: Machine) -> dict[str, str]:
    """Those of its file, without the one that takes whatever home was found."""
    return {x: value for x, value in machine.arguments.items() if x != NEAREST_ASSEMBLY}


def _check_place(machine: Machine, path: Path) -> None:
    sought = machine.closure.sought
    if sought is None or not sought.is_far:
        machine = replace(machine, arguments=MappingProxyType(_own_arguments(machine)))
    elsewhere = f"write it into a copy: crane convert {machine.command} FOLDER"
    packaged = {place.resolve() for place in (*bundled().values(), *examples().values())}
    if path in packaged:
        raise OutputError(f"{path}: belongs to a package, {elsewhere}")
    if is_simulators(path):
        kind = "an SDF" if is_sdf(path) else "a MJCF"
        raise OutputError(f"{path}: is {kind}, {elsewhere}")
    check_file(path)


def _check(path: Path, before: Machine) -> None:
    """Load the file that was written, and compare."""
    try:
        machine = load(
            path,
            active=before.chosen.get("active"),
            free=before.chosen.get("free"),
            packages=before.packages,
            arguments=_own_arguments(before),
        )
    except CraneError as error:
        raise OutputError(f"{path}: home cannot be written into it ({error})") from None
    same = machine.joints == before.joints and machine.closure.sought is None
    if not same or np.abs(machine.home - before.home).max(initial=0.0) > _SAME:
        listed = zip(before.joints, before.home.tolist(), strict=True)
        raise OutputError(
            f"{path}: home is read differently than written into it, write it by hand: "
            + ", ".join(f"{joint}: {value!r}" for joint, value in listed)
        )


def _edited(text: str, edits: list[Edit]) -> str:
    for start, end, new in sorted(edits, reverse=True):
        text = text[:start] + new + text[end:]
    return text


# --- YAML ------------------------------------------------------------------------------------


def _in_yaml(text: str, home: Mapping[str, float]) -> list[Edit]:
    """Edits of a machine file or robot.yaml."""
    bom = text.startswith("\ufeff")
    line = "\r\n" if "\r\n" in text else "\n"
    top = yaml.compose(text[bom:], yaml.SafeLoader)
    assert isinstance(top, yaml.MappingNode), "it was read before"
    found = next((value for key, value in top.value if key.value == "home"), None)
    if found is not None:
        edits = _in_mapping(text[bom:], found, home, line)
    elif top.flow_style:
        edits = [(top.end_mark.index - 1,) * 2 + (f", home: {{{_flow(home)}}}",)]
    else:
        end = top.end_mark.index
        before = "" if text[bom:][:end].endswith("\n") else line
        edits = [(end, end, f"{before}home:{_block(home, '  ', line)}{line}")]
    return [(start + bom, end + bom, new) for start, end, new in edits]


def _in_mapping(
    text: str, found: yaml.MappingNode, home: Mapping[str, float], line: str
) -> list[Edit]:
    span = range(found.start_mark.index, found.end_mark.index)
    shared = any(value.start_mark.index not in span for _, value in found.value)
    if shared or "&" in text[span.start : span.stop]:
        raise OutputError(
            "'home' shares values with other keys (&, *), write its numbers out first"
        )
    edits: list[Edit] = [
        (value.start_mark.index, value.end_mark.index, _number(home[key.value]))
        for key, value in found.value
    ]
    missing = {
        joint: home[joint] for joint in home if joint not in {k.value for k, _ in found.value}
    }
    if not missing:
        return edits
    if found.flow_style:
        comma = ", " if found.value else ""
        end = text.rindex("}", 0, found.end_mark.index)
        return [*edits, (end, end, comma + _flow(missing))]
    key, last = found.value[-1]
    after = text.find("\n", last.end_mark.index)
    end = len(text) if after < 0 else after - text[:after].endswith("\r")
    return [*edits, (end, end, _block(missing, " " * key.start_mark.column, line))]


def _block(home: Mapping[str, float], indent: str, line: str) -> str:
    return "".join(f"{line}{indent}{_name(x)}: {_number(value)}" for x, value in home.items())


def _flow(home: Mapping[str, float]) -> str:
    return ", ".join(f"{_name(joint)}: {_number(value)}" for joint, value in home.items())


def _name(joint: str) -> str:
    return str(yaml.safe_dump([joint], default_flow_style=True, width=10**6)).strip()[1:-1]


def _number(value: float) -> str:
    return str(yaml.safe_dump(value)).split("\n", 1)[0]


# --- XML -------------------------------------------------------------------------------------


def _in_xml(text: str, home: Mapping[str, float]) -> list[Edit]:
    """Edits of a URDF."""
    data = text.encode("utf-8")
    line = "\r\n" if "\r\n" in text else "\n"
    states: list[tuple[int, int]] = []  # where a state's start tag begins, and its end tag
    joints: dict[str, int] = {}
    path: list[bool] = []  # whether an element on the way down is a state of home
    end = 0
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        name = attributes.get("name", "").strip()
        if path and path[-1] and tag == "joint":
            joints[name] = parser.CurrentByteIndex
        path.append(len(path) == 1 and tag == "group_state" and name == "home")
        if path[-1]:
            states.append((parser.CurrentByteIndex, -1))

    def finish(_: str) -> None:
        nonlocal end
        if path.pop():
            states[-1] = (states[-1][0], parser.CurrentByteIndex)
        end = parser.CurrentByteIndex

    parser.StartElementHandler, parser.EndElementHandler = start, finish
    parser.Parse(data, True)

    def place(index: int) -> int:
        return len(data[:index].decode("utf-8"))

    edits = [_value(text, place(joints[joint]), home[joint]) for joint in joints]
    missing = {joint: home[joint] for joint in home if joint not in joints}
    if not missing:
        return edits
    if not states:
        joined = f'  <group_state name="home" group="all">{_joints(missing, line)}'
        return [*edits, (*(place(end),) * 2, f"{joined}  </group_state>{line}")]
    first, last = map(place, states[0])
    tag = _TAG.match(text, first)
    assert tag is not None, "it was parsed"
    if tag[0].endswith("/>"):
        new = f"{tag[0][:-2].rstrip()}>{_joints(missing, line)}  </group_state>"
        return [*edits, (tag.start(), tag.end(), new)]
    return [*edits, (last, last, f"{_joints(missing, line).lstrip()}  ")]


def _value(text: str, at: int, value: float) -> Edit:
    """The edit of the value in a `<joint>` tag."""
    tag = _TAG.match(text, at)
    old = None if tag is None else _VALUE.search(text, tag.start(), tag.end())
    assert old is not None, "it was read before"
    return old.start(), old.end(), f'value="{value!r}"'


def _joints(home: Mapping[str, float], line: str) -> str:
    from xml.sax.saxutils import quoteattr  # which imports what the network needs

    tags = (
        f'    <joint name={quoteattr(x)} value="{value!r}"/>{line}' for x, value in home.items()
    )
    return line + "".join(tags)
