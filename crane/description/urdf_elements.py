"""Links and joints of a URDF, checked and written anew in plain numbers."""

import math
import warnings

import numpy as np
from lxml import etree

from crane.description.findings import FollowUpError, kept, note
from crane.description.inertia import inertia_problem
from crane.description.series import parts_of, write_series
from crane.description.spec import Friction
from crane.description.urdf_loops import Placement
from crane.description.xml import XmlFile
from crane.errors import CraneWarning


def _text(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)


def _add_origin(clean: etree._Element, placement: Placement) -> None:
    xyz, rpy = placement
    etree.SubElement(clean, "origin", xyz=_text(*xyz), rpy=_text(*rpy))


def add_joint(
    robot: etree._Element, name: str, kind: str, placement: Placement, ends: tuple[str, str]
) -> etree._Element:
    """Add a joint to a robot: name, type, origin, parent and child."""
    joint = etree.SubElement(robot, "joint", name=name, type=kind)
    _add_origin(joint, placement)
    etree.SubElement(joint, "parent", link=ends[0])
    etree.SubElement(joint, "child", link=ends[1])
    return joint


def write_link(
    xml: XmlFile, name: str, link: etree._Element, moved: bool, robot: etree._Element
) -> None:
    """Write a checked link into a robot."""
    what = f"link '{name}'"
    clean = etree.SubElement(robot, "link", name=name)
    if (series := link.get("between")) is not None and link.find("inertial") is None:
        clean.set("between", series)
    with kept():
        if any(map(any, xml.placement(link, what))):
            raise xml.fail(link, f"{what} has an <origin>, which is its joint's: move it there")
    with kept(harmless=True):
        for drawn in (*link.iterfind("visual"), *link.iterfind("collision")):
            xml.placement(drawn, f"a {drawn.tag} of {what}")
    with kept(harmless=True):
        inertial = xml.only(link, "inertial", what)
        if inertial is not None:
            clean.set("refused", "inertial")
            _write_inertial(xml, what, inertial, moved, clean)
            del clean.attrib["refused"]


def _write_inertial(
    xml: XmlFile, what: str, inertial: etree._Element, moved: bool, clean: etree._Element
) -> None:
    mass_tag, tensor_tag = (xml.only(inertial, tag, what) for tag in ("mass", "inertia"))
    for tag, found in (("mass", mass_tag), ("inertia", tensor_tag)):
        if found is None:
            note(xml.fail(inertial, f"the inertial of {what} has no <{tag}>, add it"))
    placement = xml.placement(inertial, what)
    if mass_tag is None or tensor_tag is None:
        raise FollowUpError(f"{what} has no inertia")
    mass = xml.number(mass_tag, "value", f"the mass of {what}")
    tensor = {
        key: xml.number(tensor_tag, key, f"the inertia of {what}")
        for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    }
    if mass < 0:
        raise xml.fail(mass_tag, f"{what} has the mass {mass:g} kg, give a positive one")
    if not all(map(math.isfinite, (mass, *tensor.values(), *placement[0], *placement[1]))):
        raise FollowUpError(f"{what} has no inertia")
    xx, xy, xz, yy, yz, zz = tensor.values()
    if problem := inertia_problem(mass, np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])):
        error = xml.fail(tensor_tag, f"{what} has {problem}")
        if moved:
            raise error
        # rigidly attached, it only adds to another body, whose sum is checked later
        warnings.warn(str(error), CraneWarning, stacklevel=2)
    written = etree.SubElement(clean, "inertial")
    _add_origin(written, placement)
    etree.SubElement(written, "mass", value=_text(mass))
    etree.SubElement(written, "inertia", {key: _text(value) for key, value in tensor.items()})


def write_joint(
    xml: XmlFile,
    name: str,
    joint: etree._Element,
    ends: tuple[str, str],
    robot: etree._Element,
) -> None:
    """Write a checked joint with one freedom, or none, into a robot."""
    what, kind = f"joint '{name}'", joint.get("type")
    xml.only(joint, "mimic", what)
    clean = add_joint(robot, name, kind, xml.placement(joint, what), ends)
    if joint.get("cut"):
        clean.set("cut", "true")
    if kind != "fixed":
        axis = xml.direction(joint, what, (1.0, 0.0, 0.0))
        etree.SubElement(clean, "axis", xyz=_text(*axis))
        _write_limit(xml, what, joint, clean)


def write_several(
    xml: XmlFile,
    name: str,
    joint: etree._Element,
    ends: tuple[str, str],
    robot: etree._Element,
) -> dict[tuple[str, str], str]:
    """A joint with several freedoms as a series; what was added, and where it was written."""
    what, kind = f"joint '{name}'", joint.get("type")
    for tag in ("dynamics", "mimic"):
        if (found := xml.only(joint, tag, what)) is not None:
            problem = f"{what} is {kind}, for which <{tag}> has no meaning, remove it"
            note(xml.fail(found, problem))
    axis = xml.direction(joint, what, (1.0, 0.0, 0.0))
    xyz, rpy = xml.placement(joint, what)
    origin = {"xyz": _text(*xyz), "rpy": _text(*rpy)}
    added = write_series(robot, name, parts_of(kind, axis), origin, ends)
    return dict.fromkeys(added, xml.where(joint))


def _write_limit(xml: XmlFile, what: str, joint: etree._Element, clean: etree._Element) -> None:
    kind, limit = joint.get("type"), xml.only(joint, "limit", what)
    if limit is None:
        if kind != "continuous":
            etree.SubElement(clean, "limit")
            raise xml.fail(joint, f"{what} is {kind} and has no <limit>, add one")
        return
    values = {}
    for key in ("effort", "velocity"):
        with kept(harmless=True):
            if limit.get(key) is not None:
                value = xml.number(limit, key, f"the limit of {what}")
                if value < 0:
                    problem = f"the {key} limit of {what} is negative, make it positive"
                    raise xml.fail(limit, problem)
                if math.isfinite(value):
                    values[key] = value
    if kind != "continuous":
        lower, upper = (
            xml.number(limit, key, f"the limit of {what}", 0.0) for key in ("lower", "upper")
        )
        problem = ""
        if lower > upper:
            problem = f"the limits of {what} are reversed ({lower:g} > {upper:g}), swap them"
        if lower == upper:
            both = f"lower and upper limit of {what} are both {lower:g}"
            problem = f"{both}, widen them or make it fixed"
        if problem:
            note(xml.fail(limit, problem))
        values |= {"lower": lower, "upper": upper}
    etree.SubElement(clean, "limit", {key: _text(value) for key, value in values.items()})


def read_friction(xml: XmlFile, name: str, joint: etree._Element) -> Friction | None:
    """Friction of a joint by its `<dynamics>`, None where it has none."""
    what = f"joint '{name}'"
    tag = xml.only(joint, "dynamics", what)
    if tag is None or joint.get("type") == "fixed":
        return None
    damping, friction = (
        xml.number(tag, key, f"the dynamics of {what}", 0.0) for key in ("damping", "friction")
    )
    if min(damping, friction) < 0:
        raise xml.fail(tag, f"damping or friction of {what} is negative, make it positive")
    return Friction(viscous=damping, coulomb=friction) if damping or friction else None
