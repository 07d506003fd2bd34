"""Warnings about values that are possible but unlikely: wrong units, inertias that do not fit.

The radius of gyration of a body is at most half of its size. Published robot models exceed that up
to sevenfold, perhaps because only a part of the body is drawn, so the bounds are wider.
"""

import math
import warnings
from collections.abc import Iterator, Sequence

import numpy as np
from lxml import etree

from crane.common.errors import CraneWarning
from crane.common.plausible_ranges import LONGEST
from crane.common.samples import Array
from crane.description.inertia_feasibility import inertia_problem
from crane.description.specification import MachineSpec
from crane.formats.visuals.urdf_shapes import MeshShape, UrdfShapes, Visual, read_shapes
from crane.formats.xml_file import XmlFile

Bounds = tuple[Array, Array]


def read_numbers(element: etree._Element | None, key: str, count: int) -> Array | None:
    """Return the finite numbers of an attribute, None if it has others."""
    text = None if element is None else element.get(key)
    try:
        found = np.array([float(word) for word in (text or "").split()])
    except ValueError:
        return None
    return found if found.shape == (count,) and np.isfinite(found).all() else None


def bounds_by_link(visuals: Sequence[Visual]) -> dict[str, Bounds]:
    """Return lowest and highest corner (3,) [m] of the shapes of each link, in its frame."""
    corners: dict[str, list[Array]] = {}
    for visual in visuals:
        corners.setdefault(visual.link, []).append(visual.bounding_corners())
    points = {link: np.concatenate(found) for link, found in corners.items()}
    return {link: (found.min(axis=0), found.max(axis=0)) for link, found in points.items()}


_REVOLUTION = 2 * math.pi
_NO_LIMIT = 3600.0  # [rad] from which on a limit means none, in any unit
# radius of gyration relative to the size of the shapes, and to the distance of the joints
_MAX_GYRATION_SHARE, _MIN_GYRATION_SHARE = 4.0, 0.01
_MAX_GYRATION_BY_JOINTS, _MIN_GYRATION_BY_JOINTS = 20.0, 0.003
_MAX_COM_DISTANCE = 3.0  # of the centre of mass, relative to the size of the shapes
_MAX_DENSITY = 1e5  # [kg/m3] in the bounding box of a link; osmium has 2.3e4
_DUMMY_LIMITS = 1e-2, 1e-4  # [m], [kg] below which a link only represents a sensor or frame

ElementProblems = list[tuple[etree._Element, str]]


def warn_about_implausible_values(files: Sequence[XmlFile], spec: MachineSpec | None) -> None:
    """Warn of implausible values in parsed files and in the home configuration."""
    for xml in {xml.file: xml for xml in files}.values():
        shapes = read_shapes(xml, ("visual", "collision"))
        _warn_about_shapes(shapes)
        _warn_about_angles(xml)
        if _warn_about_lengths(xml):  # inertias cannot be compared with sizes in other units
            continue
        joint_distances = _joint_distances(xml)
        # of visuals, or of collisions for links without visuals
        bounds = bounds_by_link(shapes.shapes["collision"]) | bounds_by_link(
            shapes.shapes["visual"]
        )
        for link in xml.root.iterfind("link"):
            name = link.get("name", "").strip()
            _warn_about_body(xml, link, joint_distances.get(name, 0.0), bounds.get(name))
    if spec is not None:
        _warn_about_home(spec)


def _warn(text: str) -> None:
    warnings.warn(text, CraneWarning, stacklevel=2)


def _warn_first(xml: XmlFile, problems: ElementProblems, hint: str) -> bool:
    """Warn of the first problem with their number, and return whether there are any."""
    if problems:
        element, problem = problems[0]
        count_text = f" ({len(problems)} such in this file)" if len(problems) > 1 else ""
        _warn(f"{xml.source_location(element)}: {problem}{count_text}, {hint}")
    return bool(problems)


def _warn_about_lengths(xml: XmlFile) -> bool:
    problems: ElementProblems = []
    lengths = (
        ("origin", "xyz", 3), ("box", "size", 3), ("cylinder", "length", 1),
        ("cylinder", "radius", 1), ("sphere", "radius", 1),
    )  # fmt: skip
    values_by_element = (
        (element, read_numbers(element, key, count))
        for tag, key, count in lengths
        for element in xml.root.iter(tag)
    )
    for element, values in values_by_element:
        if values is not None and np.abs(values).max() > LONGEST:
            largest = values[np.abs(values).argmax()]
            problems.append(
                (element, f"{largest:g} m in <{element.tag}> is a long way for a machine")
            )
    for joint in xml.root.iterfind("joint"):
        largest = _largest_limit(joint)
        if joint.get("type") == "prismatic" and LONGEST < abs(largest) <= _NO_LIMIT:
            problem = f"the limit {largest:g} m of joint '{joint.get('name')}' is a long way"
            problems.append((joint.find("limit"), problem))
    problems.sort(key=lambda item: item[0].sourceline or 0)
    return _warn_first(xml, problems, "write metres if these are millimetres")


def _largest_limit(joint: etree._Element) -> float:
    """Return the limit with the largest magnitude, 0 for a joint without limits."""
    limit = joint.find("limit")
    limits = (read_numbers(limit, key, 1) for key in ("lower", "upper"))
    return max((float(end[0]) for end in limits if end is not None), key=abs, default=0.0)


def _warn_about_angles(xml: XmlFile) -> None:
    rotation_problems: ElementProblems = []
    for origin in xml.root.iter("origin"):
        rpy = read_numbers(origin, "rpy", 3)
        if rpy is not None and np.abs(rpy).max() > _REVOLUTION * 1.01:
            rotation_problems.append((origin, f'rpy="{origin.get("rpy")}" turns more than once'))
    _warn_first(xml, rotation_problems, "write radians if these are degrees")
    limit_problems: ElementProblems = []
    for joint in xml.root.iterfind("joint"):
        largest = _largest_limit(joint)
        if joint.get("type") == "revolute" and 2 * _REVOLUTION < abs(largest) <= _NO_LIMIT:
            problem = f"the limit {largest:g} rad of joint '{joint.get('name')}' is many turns"
            limit_problems.append((joint.find("limit"), problem))
    _warn_first(xml, limit_problems, "write radians if these are degrees, or make it continuous")


def _warn_about_home(spec: MachineSpec) -> None:
    revolute_joints = {joint.name for joint in spec.tree.moving_joints if joint.kind == "revolute"}
    for name, value in spec.home.items():
        if name in revolute_joints and abs(value) > 2 * _REVOLUTION:
            location = spec.source_locations.get(f"home {name}", spec.path.name)
            _warn(
                f"{location}: home of '{name}' is {value:g} rad, many turns, write radians if "
                "these are degrees"
            )


def _warn_about_shapes(shapes: UrdfShapes) -> None:
    for name, where in shapes.missing_meshes.items():
        _warn(
            f"{where}: mesh file '{name}' is not there, correct its path or "
            "install the package that has it; a box is drawn instead"
        )
    for problem in shapes.problems:
        _warn(problem)
    sizes: dict[str, Array] = {}
    for visual in (*shapes.shapes["visual"], *shapes.shapes["collision"]):
        if isinstance(visual.shape, MeshShape):
            size = np.ptp(visual.shape.vertices, axis=0)
            sizes[visual.mesh_label] = np.maximum(size, sizes.get(visual.mesh_label, 0.0))
    for mesh, size in sizes.items():
        if size.max() > LONGEST:
            _warn(
                f"{mesh} is {size.max():.3g} m large, give it "
                'scale="0.001 0.001 0.001" if it is in millimetres'
            )


def _warn_about_body(
    xml: XmlFile, link: etree._Element, joint_distance: float, bounds: Bounds | None
) -> None:
    inertial = link.find("inertial")
    if inertial is None:
        return
    mass_tag, tensor_tag, origin = (inertial.find(x) for x in ("mass", "inertia", "origin"))
    mass = read_numbers(mass_tag, "value", 1)
    parts = [
        read_numbers(tensor_tag, key, 1) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    ]
    if mass is None or not mass[0] > _DUMMY_LIMITS[1] or any(part is None for part in parts):
        return
    xx, xy, xz, yy, yz, zz = (float(part[0]) for part in parts if part is not None)
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if inertia_problem(float(mass[0]), tensor):
        return  # has an error or warning already
    com = read_numbers(origin, "xyz", 3)
    gyration_radius = math.sqrt(float(np.linalg.eigvalsh(tensor).max()) / float(mass[0]))
    joint_distance = max(joint_distance, 0.0 if com is None else float(np.linalg.norm(com)))
    name = link.get("name")
    for where, problem in _size_problems(
        bounds, joint_distance, gyration_radius, com, float(mass[0])
    ):
        element = {"mass": mass_tag, "origin": origin, "inertia": tensor_tag}[where]
        _warn(f"{xml.source_location(element)}: link '{name}' {problem}")


def _size_problems(
    bounds: Bounds | None,
    joint_distance: float,
    gyration_radius: float,
    com: Array | None,
    mass: float,
) -> Iterator[tuple[str, str]]:
    """Yield tags and texts of properties of a body that do not fit its size."""
    hint = "correct the inertia (kg m2, about the centre of mass) or the mass (kg)"
    if bounds is None:
        if (
            joint_distance > _DUMMY_LIMITS[0]
            and not _MIN_GYRATION_BY_JOINTS
            < gyration_radius / joint_distance
            < _MAX_GYRATION_BY_JOINTS
        ):
            yield (
                "inertia",
                f"has a radius of gyration of {gyration_radius:.3g} m, and its joints and its "
                f"centre of mass are at most {joint_distance:.3g} m away, {hint}",
            )
        return
    size = float(np.linalg.norm(bounds[1] - bounds[0]))
    if not _DUMMY_LIMITS[0] < size < LONGEST:
        return
    if not _MIN_GYRATION_SHARE < gyration_radius / size < _MAX_GYRATION_SHARE:
        yield (
            "inertia",
            f"has a radius of gyration of {gyration_radius:.3g} m and is drawn {size:.3g} m "
            f"large, {hint}",
        )
    if com is not None:
        outside = np.maximum(0.0, np.maximum(bounds[0] - com, com - bounds[1]))
        if (com_distance := float(np.linalg.norm(outside))) > _MAX_COM_DISTANCE * size:
            yield (
                "origin",
                f"has its centre of mass {com_distance:.3g} m outside of what is drawn, which is "
                f"{size:.3g} m large, correct one of them (m, in the link's frame)",
            )
    volume = float(np.prod(bounds[1] - bounds[0]))
    if volume > 0 and mass / volume > _MAX_DENSITY:
        yield (
            "mass",
            f"has {mass:g} kg in a box of {volume:.3g} m3, denser than any metal, write kilograms "
            "if these are grams",
        )


def _joint_distances(xml: XmlFile) -> dict[str, float]:
    """Return the distance [m] of the farthest joint on each link."""
    found: dict[str, float] = {}
    for joint in xml.root.iterfind("joint"):
        parent, xyz = joint.find("parent"), read_numbers(joint.find("origin"), "xyz", 3)
        if parent is not None and xyz is not None:
            link = parent.get("link", "").strip()
            found[link] = max(found.get(link, 0.0), float(np.linalg.norm(xyz)))
    return found
