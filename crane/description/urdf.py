"""Strict reading of URDF files: what Pinocchio would swallow silently is caught here."""

import copy
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lxml import etree

from crane.description.spec import Friction, LoopSpec
from crane.errors import CraneWarning, DescriptionError, known

MOVING = ("revolute", "continuous", "prismatic")
_CHILDREN = {
    "link": {"inertial", "visual", "collision"},
    "joint": {
        "origin", "parent", "child", "axis", "limit", "dynamics", "mimic", "calibration",
        "safety_controller",
    },
    "inertial": {"origin", "mass", "inertia"},
    "robot": {"link", "joint", "loop", "coupling", "material", "transmission", "gazebo"},
}  # fmt: skip
_LOOP_TYPES = ("fixed", "revolute", "continuous", "prismatic", "spherical", "planar")

# Inertias are printed with a few digits: a violation below this share of the largest principal
# moment is rounding.
_ROUNDING = 1e-4
_NO_INERTIA = 1e-15  # [kg m2]


@dataclass(frozen=True)
class Urdf:
    """A checked URDF.

    Attributes:
        file: The file.
        robot: Its links and joints for the dynamics, normalised (unit axes), without visuals.
        root: Name of the root link.
        lines: Line of each link and joint, as ("link", name) or ("joint", name).
        loops: Loops of `<loop>` elements.
        independent: Joints marked `independent="true"`; None where no joint has the attribute.
        friction: Friction of `<dynamics>` elements.
    """

    file: Path
    robot: etree._Element
    root: str
    lines: Mapping[tuple[str, str], int]
    loops: tuple[LoopSpec, ...]
    independent: tuple[str, ...] | None
    friction: Mapping[str, Friction]

    def where(self, kind: str, name: str) -> str:
        """File and line of a link or joint."""
        return f"{self.file.name}:{self.lines[kind, name]}"


def read_urdf(file: Path) -> Urdf:
    """Read and check one URDF.

    Raises:
        DescriptionError: With file, line, and what is wrong.
    """
    return _Reader(file).read()


def inertia_problem(mass: float, tensor: np.ndarray) -> str | None:
    """What makes a mass [kg] and an inertia about the COM (3, 3) [kg m2] impossible, if anything.

    The principal moments of a body are non-negative and none exceeds the sum of the others.
    """
    moments = np.linalg.eigvalsh(tensor)
    largest = float(np.abs(moments).max())
    if largest < _NO_INERTIA:
        return "a mass but no inertia, give at least a small sphere's" if mass > 0 else None
    if mass == 0:
        return "an inertia but no mass, give it a mass"
    if moments[0] < -_ROUNDING * largest:
        return f"the negative principal moment of inertia {moments[0]:.4g} kg m2, correct it"
    if moments[0] + moments[1] < moments[2] * (1 - _ROUNDING):
        return (
            "an inertia of no possible body: principal moments "
            f"{moments[0]:.4g} + {moments[1]:.4g} < {moments[2]:.4g} kg m2, correct it"
        )
    return None


class _Reader:
    def __init__(self, file: Path):
        self.file = file
        self.lines: dict[tuple[str, str], int] = {}

    def fail(self, element: etree._Element | None, what: str) -> DescriptionError:
        line = f":{element.sourceline}" if element is not None else ""
        return DescriptionError(f"{self.file.name}{line}: {what}")

    def read(self) -> Urdf:
        robot = self._parse()
        self._check_tags(robot)
        links = self._named(robot, "link")
        joints = self._named(robot, "joint")
        friction = {}
        for name, joint in joints.items():
            self._check_joint(name, joint, links)
            if (found := self._friction(name, joint)) is not None:
                friction[name] = found
        moved = {
            joint.find("child").get("link")
            for joint in joints.values()
            if joint.get("type") != "fixed"
        }
        for name, link in links.items():
            self._check_inertial(link, name in moved)
        root = self._check_graph(links, joints)
        clean = etree.Element("robot", name=robot.get("name") or self.file.stem)
        for element in (*links.values(), *joints.values()):
            kept = copy.deepcopy(element)
            for child in list(kept):
                if child.tag not in _CHILDREN[element.tag] - {"visual", "collision"}:
                    kept.remove(child)
            clean.append(kept)
        loops = self._loops(robot, clean, links)
        return Urdf(
            self.file, clean, root, self.lines, loops, self._independent(joints), friction
        )

    def _parse(self) -> etree._Element:
        parser = etree.XMLParser(resolve_entities=False, no_network=True, remove_comments=True)
        try:
            robot = etree.parse(str(self.file), parser).getroot()
        except etree.XMLSyntaxError as error:
            line = f":{error.lineno}" if error.lineno else ""
            text = (error.msg or "empty file").split(", line")[0]
            raise DescriptionError(
                f"{self.file.name}{line}: not XML, {text}, mend it"
            ) from None
        except OSError:
            raise DescriptionError(f"{self.file}: cannot be read, check the path") from None
        if robot.tag != "robot":
            raise self.fail(robot, f"a URDF starts with <robot>, this file with <{robot.tag}>")
        return robot

    def _check_tags(self, robot: etree._Element) -> None:
        for element in robot.iter(*_CHILDREN):
            allowed = _CHILDREN[element.tag]
            for child in element:
                if not isinstance(child.tag, str) or child.tag in allowed:
                    continue
                # foreign tags (sensors, simulator settings) are common; a slip must not be
                if (hint := known(allowed, child.tag)).startswith("did"):
                    raise self.fail(child, f"unknown <{child.tag}> in <{element.tag}>, {hint}")
        for coupling in robot.iterfind("coupling"):
            raise self.fail(coupling, "<coupling> is not supported, couple the joints by a loop")

    def _named(self, robot: etree._Element, kind: str) -> dict[str, etree._Element]:
        found: dict[str, etree._Element] = {}
        for element in robot.iterfind(kind):
            name = element.get("name")
            if not name:
                raise self.fail(element, f"a {kind} has no name, add name=\"...\"")
            if name in found:
                raise self.fail(
                    element,
                    f"{kind} '{name}' is there twice (first in line {found[name].sourceline}), "
                    "rename one",
                )
            found[name] = element
            self.lines[kind, name] = element.sourceline
        if kind == "link" and not found:
            raise self.fail(robot, "no <link> in this file, add one")
        return found

    def _number(
        self, element: etree._Element, name: str, what: str, default: float | None = None
    ) -> float:
        return self._vector(element, name, what, 1, None if default is None else [default])[0]

    def _vector(
        self,
        element: etree._Element,
        name: str,
        what: str,
        length: int,
        default: list[float] | None = None,
    ) -> list[float]:
        text = element.get(name)
        if text is None:
            if default is not None:
                return default
            raise self.fail(element, f"{what} has no '{name}', add it")
        words = text.split()
        try:
            values = [float(word) for word in words]
        except ValueError:
            hint = ", write a decimal point" if "," in text else ""
            raise self.fail(element, f"{name}=\"{text}\" of {what} is no number{hint}") from None
        if len(values) != length:
            raise self.fail(element, f"{name}=\"{text}\" of {what} needs {length} numbers")
        if not all(math.isfinite(value) for value in values):
            raise self.fail(element, f"{name}=\"{text}\" of {what} must be finite")
        return values

    def _only(self, element: etree._Element, tag: str, what: str) -> etree._Element | None:
        found = element.findall(tag)
        if len(found) > 1:
            raise self.fail(found[1], f"{what} has {len(found)} <{tag}>, keep one")
        return found[0] if found else None

    def _check_origin(self, element: etree._Element, what: str) -> None:
        origin = self._only(element, "origin", what)
        if origin is not None:
            self._vector(origin, "xyz", f"the origin of {what}", 3, [0.0] * 3)
            self._vector(origin, "rpy", f"the origin of {what}", 3, [0.0] * 3)

    def _check_inertial(self, link: etree._Element, moved: bool) -> None:
        what = f"link '{link.get('name')}'"
        inertial = self._only(link, "inertial", what)
        if inertial is None:
            return
        self._check_origin(inertial, what)
        mass_tag = self._only(inertial, "mass", what)
        tensor_tag = self._only(inertial, "inertia", what)
        if mass_tag is None or tensor_tag is None:
            missing = "mass" if mass_tag is None else "inertia"
            raise self.fail(inertial, f"the inertial of {what} has no <{missing}>, add it")
        mass = self._number(mass_tag, "value", f"the mass of {what}")
        xx, xy, xz, yy, yz, zz = (
            self._number(tensor_tag, key, f"the inertia of {what}")
            for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        )
        if mass < 0:
            raise self.fail(mass_tag, f"{what} has the mass {mass:g} kg, it must not be negative")
        problem = inertia_problem(mass, np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
        if problem:
            error = self.fail(tensor_tag, f"{what} has {problem}")
            if moved:
                raise error
            # rigidly attached, it only adds to another body, whose sum is checked later
            warnings.warn(str(error), CraneWarning, stacklevel=2)

    def _check_joint(
        self, name: str, joint: etree._Element, links: Mapping[str, etree._Element]
    ) -> None:
        what = f"joint '{name}'"
        kind = joint.get("type")
        if kind not in (*MOVING, "fixed"):
            raise self.fail(
                joint,
                f"{what} has the type {kind!r}, {known([*MOVING, 'fixed'], kind or '')}",
            )
        self._check_origin(joint, what)
        ends = []
        for end in ("parent", "child"):
            tag = self._only(joint, end, what)
            link = None if tag is None else tag.get("link")
            if not link:
                raise self.fail(joint, f"{what} has no {end} link, add <{end} link=\"...\"/>")
            if link not in links:
                raise self.fail(tag, f"{what} names the {end} '{link}', {known(links, link)}")
            ends.append(link)
        if ends[0] == ends[1]:
            raise self.fail(joint, f"{what} joins link '{ends[0]}' to itself, change one end")
        if self._only(joint, "mimic", what) is not None:
            raise self.fail(joint, f"{what} mimics another, which is not supported: make it fixed")
        if kind == "fixed":
            return
        axis_tag = self._only(joint, "axis", what)
        if axis_tag is not None:
            axis = np.array(self._vector(axis_tag, "xyz", f"the axis of {what}", 3))
            if not (length := np.linalg.norm(axis)) > 0:
                raise self.fail(axis_tag, f"the axis of {what} is zero, give a direction")
            axis_tag.set("xyz", " ".join(repr(float(value)) for value in axis / length))
        limit = self._only(joint, "limit", what)
        if limit is None:
            if kind != "continuous":
                raise self.fail(joint, f"{what} is {kind} and has no <limit>, add one")
            return
        for key in ("effort", "velocity"):
            if self._number(limit, key, f"the limit of {what}", math.inf) < 0:
                raise self.fail(limit, f"the {key} limit of {what} is negative, make it positive")
        if kind != "continuous":
            lower = self._number(limit, "lower", f"the limit of {what}", 0.0)
            upper = self._number(limit, "upper", f"the limit of {what}", 0.0)
            if lower > upper:
                raise self.fail(
                    limit, f"the limits of {what} are reversed: {lower:g} > {upper:g}, swap them"
                )
            if lower == upper:
                raise self.fail(
                    limit, f"the limits of {what} are both {lower:g}: widen them or make it fixed"
                )

    def _friction(self, name: str, joint: etree._Element) -> Friction | None:
        tag = self._only(joint, "dynamics", f"joint '{name}'")
        if tag is None:
            return None
        values = [
            self._number(tag, key, f"the dynamics of joint '{name}'", 0.0)
            for key in ("damping", "friction")
        ]
        if min(values) < 0:
            raise self.fail(tag, f"damping and friction of joint '{name}' must not be negative")
        return Friction(viscous=values[0], coulomb=values[1]) if any(values) else None

    def _check_graph(
        self, links: Mapping[str, etree._Element], joints: Mapping[str, etree._Element]
    ) -> str:
        parent_of: dict[str, tuple[str, str]] = {}
        for name, joint in joints.items():
            parent = joint.find("parent").get("link")
            child = joint.find("child").get("link")
            if child in parent_of:
                raise self.fail(
                    joint,
                    f"link '{child}' has two parents, joints '{parent_of[child][1]}' and "
                    f"'{name}': keep one and close the other as a loop",
                )
            parent_of[child] = (parent, name)
        roots = [name for name in links if name not in parent_of]
        if not roots:
            raise self.fail(None, "every link has a parent, so the joints form a ring: cut it")
        if len(roots) > 1:
            raise self.fail(
                links[roots[1]],
                f"{len(roots)} links have no parent ({', '.join(roots[:4])}): join them",
            )
        for name in links:
            seen = {name}
            at = name
            while at in parent_of:
                at = parent_of[at][0]
                if at in seen:
                    raise self.fail(
                        links[at], f"link '{at}' is its own ancestor: cut the ring of joints"
                    )
                seen.add(at)
        return roots[0]

    def _independent(self, joints: Mapping[str, etree._Element]) -> tuple[str, ...] | None:
        marked = {}
        for name, joint in joints.items():
            value = joint.get("independent")
            if value is not None:
                if value not in ("true", "false"):
                    raise self.fail(joint, f"independent=\"{value}\" must be true or false")
                marked[name] = value == "true"
        return tuple(name for name, value in marked.items() if value) if marked else None

    def _loops(
        self,
        robot: etree._Element,
        clean: etree._Element,
        links: Mapping[str, etree._Element],
    ) -> tuple[LoopSpec, ...]:
        """Loops of `<loop>` elements; their two frames become massless links of `clean`."""
        loops = []
        for element in self._named(robot, "loop").values():
            name = element.get("name")
            what = f"loop '{name}'"
            kind = element.get("type", "")
            if kind not in _LOOP_TYPES:
                raise self.fail(element, f"{what} has the type '{kind}', {known(_LOOP_TYPES, kind)}")
            axis_tag = self._only(element, "axis", what)
            axis = np.array(
                [1.0, 0.0, 0.0]
                if axis_tag is None
                else self._vector(axis_tag, "xyz", f"the axis of {what}", 3)
            )
            if not (length := np.linalg.norm(axis)) > 0:
                raise self.fail(axis_tag, f"the axis of {what} is zero, give a direction")
            ends, frames = [], []
            for end in ("predecessor", "successor"):
                tag = self._only(element, end, what)
                link = None if tag is None else tag.get("link")
                if link not in links:
                    raise self.fail(element, f"{what} names the {end} {link!r}, {known(links, link)}")
                self._check_origin(tag, f"{what}'s {end}")
                frame = f"{name}_{end}"
                if frame in links:
                    raise self.fail(element, f"{what} needs the name '{frame}', rename that link")
                etree.SubElement(clean, "link", name=frame)
                joint = etree.SubElement(clean, "joint", name=f"{frame}_fixed", type="fixed")
                if (origin := tag.find("origin")) is not None:
                    joint.append(copy.deepcopy(origin))
                etree.SubElement(joint, "parent", link=link)
                etree.SubElement(joint, "child", link=frame)
                for kind_, name_ in (("link", frame), ("joint", f"{frame}_fixed")):
                    self.lines[kind_, name_] = element.sourceline
                ends.append(link)
                frames.append(frame)
            unit = axis / length
            loops.append(
                LoopSpec(
                    name,
                    "revolute" if kind == "continuous" else kind,
                    frames[0],
                    frames[1],
                    (float(unit[0]), float(unit[1]), float(unit[2])),
                    f"{self.file.name}:{element.sourceline}",
                )
            )
        return tuple(loops)
