"""Warnings about what is possible but unlikely: units, inertias, connections of a circuit.

The radius of gyration of a body is at most half of its size. Published robot models exceed that up
to sevenfold, perhaps because only a part of the body is drawn, so the bounds are wider.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np
from lxml import etree

from crane.common.errors import warn
from crane.common.plausible_ranges import LONGEST
from crane.common.samples import Array
from crane.description.kinematic_tree import TENSOR_ATTRIBUTES, Inertial, inertia_problem
from crane.description.specification import MachineSpec
from crane.formats.robot_files import DRAWING_SUFFIXES
from crane.formats.visuals.urdf_shapes import MeshShape, UrdfShapes, Visual
from crane.formats.xml_file import XmlFile, parse_attribute
from crane.hydraulics.circuit_elements import MAIN_PUMP, TANK_NODE
from crane.hydraulics.components import Valve
from crane.hydraulics.hydraulic_circuit import (
    Hydraulics,
    connected_nodes,
    full_opening_flow,
    nodes_draining_to_tank,
    nodes_fed_by_pumps,
)
from crane.hydraulics.pump_equations import least_sensing_ratio, unstable_frequency_range

Bounds = tuple[Array, Array]
_MAX_DEMAND_RATIO = 1.01  # of the flow of its valves to the flow of a pump
_MAX_PRESSURE_RISE = 0.1  # of a line, relative to the pressure of its pump
_LITRES_PER_MINUTE = 6e4  # in 1 m3/s
_MISSING_INPUT_TEXTS = {  # by type of control that needs valves, or their open centres
    "load-sensing": "senses the load of its valves and has none, so that it stays at its standby, "
    "let it feed a valve",
    "positive": "gives what its valves ask for and has none, so that it gives nothing, let it "
    "feed a valve",
    "negative": "senses the flow through open centres and no valve of it has one, so that it "
    "always gives all, add 'centre' to its valves",
}


def read_numbers(element: etree._Element | None, key: str, count: int) -> Array | None:
    """Return the finite numbers of an attribute, None if it has others."""
    found = np.array([] if element is None else parse_attribute(element, key))
    return found if found.shape == (count,) and np.isfinite(found).all() else None


_REVOLUTION = 2 * math.pi
_NO_LIMIT = 3600.0  # [rad] from which on a limit means none, in any unit
# radius of gyration relative to the size of the shapes, and to the distance of the joints
_MAX_GYRATION_SHARE, _MIN_GYRATION_SHARE = 4.0, 0.01
_MAX_GYRATION_BY_JOINTS, _MIN_GYRATION_BY_JOINTS = 20.0, 0.003
_MAX_COM_DISTANCE = 3.0  # of the centre of mass, relative to the size of the shapes
_MAX_DENSITY = 1e5  # [kg/m3] in the bounding box of a link; osmium has 2.3e4
_ZERO = (0.0, 0.0, 0.0)
_DUMMY_LIMITS = 1e-2, 1e-4  # [m], [kg] below which a link only represents a sensor or frame


def warn_about_implausible_values(files: Sequence[XmlFile], spec: MachineSpec | None) -> None:
    """Warn of implausible values in parsed files and in the home configuration."""
    for xml in {xml.file: xml for xml in files}.values():
        shapes = UrdfShapes(xml, ("visual", "collision"))
        _warn_about_shapes(shapes)
        if _warn_about_units(xml):  # inertias cannot be compared with sizes in other units
            continue
        joint_distances = _joint_distances(xml)
        # of visuals, or of collisions for links without visuals
        bounds = _bounds_by_link(shapes.shapes["collision"]) | _bounds_by_link(
            shapes.shapes["visual"]
        )
        if xml.file.suffix.lower() in DRAWING_SUFFIXES:  # lines between points
            bounds = {}
        for link in xml.root.iterfind("link"):
            name = link.get("name", "").strip()
            _warn_about_body(xml, link, joint_distances.get(name, 0.0), bounds.get(name))
    if spec is not None:
        _warn_about_home(spec)


def _bounds_by_link(visuals: Sequence[Visual]) -> dict[str, Bounds]:
    """Return lowest and highest corner (3,) [m] of the shapes of each link, in its frame."""
    corners: dict[str, list[Array]] = {}
    for visual in visuals:
        corners.setdefault(visual.link, []).append(visual.bounding_corners())
    points = {link: np.concatenate(found) for link, found in corners.items()}
    return {link: (found.min(axis=0), found.max(axis=0)) for link, found in points.items()}


def _warn_about_units(xml: XmlFile) -> bool:
    """Warn of lengths and angles in other units, and return whether lengths seem to be."""
    length_hint, rotation_hint = (
        f"write {unit} if these are {other}"
        for unit, other in (("metres", "millimetres"), ("radians", "degrees"))
    )
    long_elements: list[tuple[etree._Element, str]] = []
    attributes = (
        ("origin", "rpy", 3), ("origin", "xyz", 3), ("box", "size", 3), ("cylinder", "length", 1),
        ("cylinder", "radius", 1), ("sphere", "radius", 1),
    )  # fmt: skip
    values_by_element = (
        (element, key, read_numbers(element, key, count))
        for tag, key, count in attributes
        for element in xml.root.iter(tag)
    )
    for element, key, values in values_by_element:
        largest = 0.0 if values is None else values[np.abs(values).argmax()]
        if key == "rpy" and abs(largest) > _REVOLUTION * 1.01:
            problem = f'rpy="{element.get("rpy")}" turns more than once'
            xml.warn(element, f"{problem}, {rotation_hint}")
        if key != "rpy" and abs(largest) > LONGEST:
            problem = f"{largest:g} m in <{element.tag}> is a long way for a machine"
            long_elements.append((element, problem))
    for joint in xml.root.iterfind("joint"):
        limit, label = joint.find("limit"), f"of joint '{joint.get('name')}'"
        limits = (read_numbers(limit, key, 1) for key in ("lower", "upper"))
        largest = max((float(end[0]) for end in limits if end is not None), key=abs, default=0.0)
        if joint.get("type") == "prismatic" and LONGEST < abs(largest) <= _NO_LIMIT:
            long_elements.append((limit, f"the limit {largest:g} m {label} is a long way"))
        if joint.get("type") == "revolute" and 2 * _REVOLUTION < abs(largest) <= _NO_LIMIT:
            warn(
                f"{xml.source_location(limit)}: the limit {largest:g} rad {label} is many turns, "
                f"{rotation_hint}, or make it continuous"
            )
    for element, problem in long_elements:
        xml.warn(element, f"{problem}, {length_hint}")
    return bool(long_elements)


def _warn_about_home(spec: MachineSpec) -> None:
    revolute_joints = {joint.name for joint in spec.tree.moving_joints if joint.kind == "revolute"}
    for name, value in spec.home.items():
        if name in revolute_joints and abs(value) > 2 * _REVOLUTION:
            location = spec.source_locations.get(f"home {name}", spec.path.name)
            warn(
                f"{location}: home of '{name}' is {value:g} rad, many turns, write radians if "
                "these are degrees"
            )


def _warn_about_shapes(shapes: UrdfShapes) -> None:
    for name, where in shapes.missing_meshes.items():
        warn(
            f"{where}: mesh file '{name}' is not there, correct its path or "
            "install the package that has it; a box is drawn instead"
        )
    for problem in shapes.problems:
        warn(problem)
    sizes: dict[str, Array] = {}
    for visual in (*shapes.shapes["visual"], *shapes.shapes["collision"]):
        if isinstance(visual.shape, MeshShape):
            size = np.ptp(visual.shape.vertices, axis=0)
            sizes[visual.mesh_label] = np.maximum(size, sizes.get(visual.mesh_label, 0.0))
    for mesh, size in sizes.items():
        if size.max() > LONGEST:
            warn(
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
    parts = [read_numbers(tensor_tag, key, 1) for key in TENSOR_ATTRIBUTES]
    if mass is None or not mass[0] > _DUMMY_LIMITS[1] or any(part is None for part in parts):
        return
    values = tuple(float(part[0]) for part in parts if part is not None)
    tensor = Inertial(float(mass[0]), _ZERO, _ZERO, values).inertia_matrix
    if inertia_problem(float(mass[0]), tensor):
        return  # has an error or warning already
    com = read_numbers(origin, "xyz", 3)
    gyration_radius = math.sqrt(float(np.linalg.eigvalsh(tensor).max()) / float(mass[0]))
    joint_distance = max(joint_distance, 0.0 if com is None else float(np.linalg.norm(com)))
    for tag, problem in _size_problems(
        bounds, joint_distance, gyration_radius, com, float(mass[0])
    ):
        location = xml.source_location(inertial.find(tag))
        warn(f"{location}: link '{link.get('name')}' {problem}")


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
                f"centre of mass are at most {joint_distance:.3g} m from its origin, {hint}",
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


def warn_about_circuit(spec: MachineSpec) -> None:
    """Warn of implausible connections and pump controls of a circuit."""
    if spec.hydraulics is None:
        return
    for key, text in (*_node_problems(spec.hydraulics), *_pump_problems(spec.hydraulics)):
        location = spec.source_locations.get(
            key, spec.source_locations.get("hydraulics", spec.path.name)
        )
        warn(f"{location}: {text}")


def flow_shortages(spec: MachineSpec) -> list[str]:
    """Return a line for each pump whose valves take more flow together than it delivers.

    Only valves that control a flow count, those with a margin. Most machines have such pumps.
    """
    messages = []
    for name, supply in spec.hydraulics.pumps.items() if spec.hydraulics else ():
        assert spec.hydraulics is not None
        demand = full_opening_flow(spec.hydraulics, name)
        if supply.flow > 0 and demand > _MAX_DEMAND_RATIO * supply.flow:
            messages.append(
                f"hydraulics: fully open valves of pump '{name}' need "
                f"{demand * _LITRES_PER_MINUTE:.4g} l/min together, it delivers at most "
                f"{supply.flow * _LITRES_PER_MINUTE:.4g} l/min"
            )
    return messages


def _node_problems(hydraulics: Hydraulics) -> Iterator[tuple[str, str]]:
    connected, drained_nodes, fed_nodes = (
        connected_nodes(hydraulics),
        nodes_draining_to_tank(hydraulics),
        nodes_fed_by_pumps(hydraulics),
    )
    valves = hydraulics.valves.values()
    return_nodes = {node for x in valves for node in (x.return_a, x.return_b)} & {
        *hydraulics.lines
    }
    kinds = dict.fromkeys(hydraulics.lines, "line")
    kinds |= dict.fromkeys(hydraulics.accumulators, "accumulator")
    for name, kind in kinds.items():
        if name not in connected or (name in return_nodes and name not in drained_nodes):
            continue  # has an error already
        if name not in fed_nodes:
            is_fed_from_tank = any(
                x.kind == "check" and (x.source, x.target) == (TANK_NODE, name)
                for x in hydraulics.elements.values()
            )
            check_valve_text = (
                "only a check valve from the tank feeds it, " if is_fed_from_tank else ""
            )
            yield (
                f"{kind} {name}",
                f"no pump feeds the {kind} '{name}', {check_valve_text}add an element that "
                f"leads into it",
            )
        if name in fed_nodes and name not in drained_nodes:
            yield (
                f"{kind} {name}",
                f"what gets into the {kind} '{name}' never leaves it, add an orifice or a relief "
                "valve that leads on to the tank",
            )
    for name in hydraulics.pumps:
        if name in connected and name not in drained_nodes:
            yield (
                f"supply {name}",
                f"no way leads from '{name}' to the tank, it only fills what it feeds, add a "
                "relief valve, an orifice or a valve of a joint",
            )


def _pump_problems(hydraulics: Hydraulics) -> Iterator[tuple[str, str]]:
    connected = connected_nodes(hydraulics)
    for name, supply in hydraulics.pumps.items():
        valves = [x for x in hydraulics.valves.values() if x.supply == name]
        key = f"supply {name}"
        if name == MAIN_PUMP and name not in connected:
            yield key, f"nothing is joined to '{name}', let it feed a valve: the others need none"
        has_input = any(x.centre > 0 or supply.control != "negative" for x in valves)
        if supply.control in _MISSING_INPUT_TEXTS and not has_input:
            yield key, f"'{name}' {_MISSING_INPUT_TEXTS[supply.control]} or choose another control"
        has_controlled_pressure = supply.control != "fixed" and supply.relief > 0
        if has_controlled_pressure and supply.relief <= supply.pressure:
            yield (
                key,
                f"relief of '{name}' is {supply.relief:g} Pa, not above its pressure of "
                f"{supply.pressure:g} Pa: what the pump gives flows off there, give a higher one",
            )
        modulus = hydraulics.oil.bulk_modulus
        if valves and (unstable_band := unstable_frequency_range(supply, modulus)):
            min_damping = math.ceil(100.0 * least_sensing_ratio(supply, modulus)) / 100.0
            yield (
                key,
                f"'{name}' follows its loads so closely that it drives those that swing at "
                f"{unstable_band[0]:.3g} to {unstable_band[1]:.3g} Hz: pressures may ring on, "
                f"give 'sensing' {min_damping:g} or more (damping of the load-sensing line)",
            )
        # volume that it delivers into a closed line until its displacement is reduced
        pressure_rise = supply.flow * supply.response * hydraulics.oil.bulk_modulus / supply.volume
        if pressure_rise > _MAX_PRESSURE_RISE * supply.pressure and not _is_relieved(
            hydraulics, name, valves
        ):
            yield (
                key,
                f"nothing relieves '{name}', which swings back within {supply.response:g} s: "
                "once its valves close or what they feed stalls, its line rises by up to "
                f"{pressure_rise:.3g} Pa over its {supply.pressure:.3g} Pa, give 'relief' [Pa]",
            )


def _is_relieved(hydraulics: Hydraulics, name: str, valves: Sequence[Valve]) -> bool:
    """Whether a pump's line has an outlet other than closed valves and its slow slip."""
    adjacent_elements = [
        part for part in hydraulics.elements.values() if name in (part.source, part.target)
    ]
    return (
        hydraulics.pumps[name].relief > 0
        or any(valve.centre > 0 for valve in valves)
        or any(
            part.source == name or part.kind in ("orifice", "leak") for part in adjacent_elements
        )
    )
