"""Numbers that can be, and hardly are: other units than SI, inertias that do not fit the drawing.

The radius of gyration of a body is at most half of its size. Published arms exceed that sevenfold,
perhaps because only part of a body is drawn. What is said here is beyond that.
"""

import math
import warnings
from collections.abc import Iterator, Sequence

import numpy as np
from lxml import etree

from crane.common.errors import CraneWarning
from crane.common.magnitudes import LONGEST
from crane.common.samples import Array
from crane.description import MachineSpec, inertia_problem
from crane.formats.check.geometry import Bounds, extents, numbers
from crane.formats.visuals.visuals import Drawn, Mesh, read_drawn
from crane.formats.xml import XmlFile

_TURN = 2 * math.pi
_NO_LIMIT = 3600.0  # [rad] from which on limits stand for none, in whatever unit
_WIDE, _SLIM = 4.0, 0.01  # radius of gyration by the size of what is drawn
_FAR_WIDE, _FAR_SLIM = 20.0, 0.003  # by the distance of the joints, which says less
_OUTSIDE = 3.0  # of the centre of mass, by the same size
_DENSE = 1e5  # [kg/m3] in the box about a link; osmium has 2.3e4
_DUMMY = 1e-2, 1e-4  # [m], [kg] below which a link only stands for a sensor or a frame

Large = list[tuple[etree._Element, str]]


def implausible(files: Sequence[XmlFile], spec: MachineSpec | None) -> None:
    """Warn of what is hardly meant, in files that could be parsed and in the home posture."""
    for xml in {xml.file: xml for xml in files}.values():
        drawn = read_drawn(xml, ("visual", "collision"))
        _warn_drawn(drawn)
        _warn_angles(xml)
        if _warn_lengths(xml):  # sizes in other units say nothing about inertias
            continue
        reaches = _reaches(xml)
        # visuals count; where there are none, what a link collides with
        bounds = extents(drawn.shapes["collision"]) | extents(drawn.shapes["visual"])
        for link in xml.root.iterfind("link"):
            name = link.get("name", "").strip()
            _warn_body(xml, link, reaches.get(name, 0.0), bounds.get(name))
    if spec is not None:
        _warn_home(spec)


def _warn(text: str) -> None:
    warnings.warn(text, CraneWarning, stacklevel=2)


def _warn_first(xml: XmlFile, found: Large, hint: str) -> bool:
    """Warn of the first of several, with their number."""
    if found:
        element, what = found[0]
        more = f" ({len(found)} such in this file)" if len(found) > 1 else ""
        _warn(f"{xml.where(element)}: {what}{more}, {hint}")
    return bool(found)


def _warn_lengths(xml: XmlFile) -> bool:
    found: Large = []
    lengths = (
        ("origin", "xyz", 3), ("box", "size", 3), ("cylinder", "length", 1),
        ("cylinder", "radius", 1), ("sphere", "radius", 1),
    )  # fmt: skip
    given = (
        (element, numbers(element, key, count))
        for tag, key, count in lengths
        for element in xml.root.iter(tag)
    )
    for element, values in given:
        if values is not None and np.abs(values).max() > LONGEST:
            far = values[np.abs(values).argmax()]
            found.append((element, f"{far:g} m in <{element.tag}> is a long way for a machine"))
    for joint in xml.root.iterfind("joint"):
        far = _largest_limit(joint)
        if joint.get("type") == "prismatic" and LONGEST < abs(far) <= _NO_LIMIT:
            what = f"the limit {far:g} m of joint '{joint.get('name')}' is a long way"
            found.append((joint.find("limit"), what))
    found.sort(key=lambda item: item[0].sourceline or 0)
    return _warn_first(xml, found, "write metres if these are millimetres")


def _largest_limit(joint: etree._Element) -> float:
    """The end of a joint's range that is farthest from zero; 0 where it has none."""
    limit = joint.find("limit")
    ends = (numbers(limit, key, 1) for key in ("lower", "upper"))
    return max((float(end[0]) for end in ends if end is not None), key=abs, default=0.0)


def _warn_angles(xml: XmlFile) -> None:
    turned: Large = []
    for origin in xml.root.iter("origin"):
        rpy = numbers(origin, "rpy", 3)
        if rpy is not None and np.abs(rpy).max() > _TURN * 1.01:
            turned.append((origin, f'rpy="{origin.get("rpy")}" turns more than once'))
    _warn_first(xml, turned, "write radians if these are degrees")
    wide: Large = []
    for joint in xml.root.iterfind("joint"):
        far = _largest_limit(joint)
        if joint.get("type") == "revolute" and 2 * _TURN < abs(far) <= _NO_LIMIT:
            what = f"the limit {far:g} rad of joint '{joint.get('name')}' is many turns"
            wide.append((joint.find("limit"), what))
    _warn_first(xml, wide, "write radians if these are degrees, or make it continuous")


def _warn_home(spec: MachineSpec) -> None:
    turning = {joint.name for joint in spec.tree.moving if joint.kind == "revolute"}
    for name, value in spec.home.items():
        if name in turning and abs(value) > 2 * _TURN:
            place = spec.where.get(f"home {name}", spec.path.name)
            _warn(
                f"{place}: home of '{name}' is {value:g} rad, many turns, write radians if these "
                "are degrees"
            )


def _warn_drawn(drawn: Drawn) -> None:
    for name, where in drawn.missing.items():
        _warn(
            f"{where}: mesh file '{name}' is not there, correct its path or "
            "install the package that has it; a box is drawn instead"
        )
    for problem in drawn.problems:
        _warn(problem)
    sizes: dict[str, Array] = {}
    for visual in (*drawn.shapes["visual"], *drawn.shapes["collision"]):
        if isinstance(visual.shape, Mesh):
            size = np.ptp(visual.shape.vertices, axis=0)
            sizes[visual.mesh] = np.maximum(size, sizes.get(visual.mesh, 0.0))
    for mesh, size in sizes.items():
        if size.max() > LONGEST:
            _warn(
                f"{mesh} is {size.max():.3g} m large, give it "
                'scale="0.001 0.001 0.001" if it is in millimetres'
            )


def _warn_body(xml: XmlFile, link: etree._Element, reach: float, bounds: Bounds | None) -> None:
    inertial = link.find("inertial")
    if inertial is None:
        return
    mass_tag, tensor_tag, origin = (inertial.find(x) for x in ("mass", "inertia", "origin"))
    mass = numbers(mass_tag, "value", 1)
    parts = [numbers(tensor_tag, key, 1) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")]
    if mass is None or not mass[0] > _DUMMY[1] or any(part is None for part in parts):
        return
    xx, xy, xz, yy, yz, zz = (float(part[0]) for part in parts if part is not None)
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if inertia_problem(float(mass[0]), tensor):
        return  # which has been said
    com = numbers(origin, "xyz", 3)
    radius = math.sqrt(float(np.linalg.eigvalsh(tensor).max()) / float(mass[0]))
    reach = max(reach, 0.0 if com is None else float(np.linalg.norm(com)))
    name = link.get("name")
    for where, problem in _misfits(bounds, reach, radius, com, float(mass[0])):
        place = {"mass": mass_tag, "origin": origin, "inertia": tensor_tag}[where]
        _warn(f"{xml.where(place)}: link '{name}' {problem}")


def _misfits(
    bounds: Bounds | None, reach: float, radius: float, com: Array | None, mass: float
) -> Iterator[tuple[str, str]]:
    """What about a body does not fit its size: the tag to correct, and how it reads."""
    hint = "correct the inertia (kg m2, about the centre of mass) or the mass (kg)"
    if bounds is None:
        if reach > _DUMMY[0] and not _FAR_SLIM < radius / reach < _FAR_WIDE:
            yield (
                "inertia",
                f"has a radius of gyration of {radius:.3g} m, and its joints and its centre of "
                f"mass are at most {reach:.3g} m away, {hint}",
            )
        return
    size = float(np.linalg.norm(bounds[1] - bounds[0]))
    if not _DUMMY[0] < size < LONGEST:
        return
    if not _SLIM < radius / size < _WIDE:
        yield (
            "inertia",
            f"has a radius of gyration of {radius:.3g} m and is drawn {size:.3g} m large, {hint}",
        )
    if com is not None:
        outside = np.maximum(0.0, np.maximum(bounds[0] - com, com - bounds[1]))
        if (away := float(np.linalg.norm(outside))) > _OUTSIDE * size:
            yield (
                "origin",
                f"has its centre of mass {away:.3g} m outside of what is drawn, which is "
                f"{size:.3g} m large, correct one of them (m, in the link's frame)",
            )
    volume = float(np.prod(bounds[1] - bounds[0]))
    if volume > 0 and mass / volume > _DENSE:
        yield (
            "mass",
            f"has {mass:g} kg in a box of {volume:.3g} m3, denser than any metal, write kilograms "
            "if these are grams",
        )


def _reaches(xml: XmlFile) -> dict[str, float]:
    """By link the distance of the farthest joint on it [m]."""
    found: dict[str, float] = {}
    for joint in xml.root.iterfind("joint"):
        parent, xyz = joint.find("parent"), numbers(joint.find("origin"), "xyz", 3)
        if parent is not None and xyz is not None:
            link = parent.get("link", "").strip()
            found[link] = max(found.get(link, 0.0), float(np.linalg.norm(xyz)))
    return found
