"""Parameters of a machine: names, values, units and where they are in its description."""

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from difflib import get_close_matches
from fnmatch import fnmatchcase
from typing import Any

from crane.common.errors import InputError
from crane.description.circuit_schema import (
    ACCUMULATOR,
    CYLINDER,
    ELEMENT,
    ENGINE,
    FIRST_PUMP,
    LINE,
    OIL,
    VALVE,
    VALVE_CONTROL,
)
from crane.description.force_elements import Friction
from crane.description.key_types import NumberKey
from crane.description.kinematic_tree import Joint, Link, Tree
from crane.description.machine_lookup import bundled_machines, command_line_arguments
from crane.description.machine_schema import CONTROL, END_STOP, FORCE, FRICTION, GAS_SPRING, ROPE
from crane.description.sensors import (
    PRESSURE_PREFIX,
    SENSOR_PREFIX,
    SUPPLY_PRESSURE,
    TANK_PRESSURE,
    VALVE_SIGNAL_PREFIX,
    parse_sensor_parameter,
    quantity_unit,
    quantity_units,
    sensor_parameters,
)
from crane.description.specification import Chain, MachineSpec, PIGains
from crane.hydraulics.circuit_elements import parameter_names
from crane.hydraulics.hydraulic_circuit import Hydraulics

PAYLOAD_MASS = "payload.mass"
PINS_PREFIX = "pins."
GRAVITY_PREFIX = "gravity."
SPOOL_B = "spool_b"  # second spool of a valve; its parameters are named `valve.JOINT.spool_b.NAME`
CIRCUIT_FIELDS = {  # field of `Hydraulics` by the prefix of parameter names
    "supply.": "supplies", "line.": "lines", "accumulator.": "accumulators",
    "element.": "elements", "cylinder.": "cylinders", "valve.": "valves",
    "valve_control.": "control",
}  # fmt: skip
ELEMENT_FIELDS = {  # field of `MachineSpec` by the prefix of parameter names
    "spring": "forces", "gas_spring": "gas_springs", "rope": "ropes", "end_stop": "end_stops",
}  # fmt: skip
FieldPath = tuple[str | int, ...]  # attribute names, mapping keys and indices that lead to a value

_ANGLE_NAMES = ("roll", "pitch", "yaw")
_TENSOR_COMPONENTS = ("xx", "xy", "xz", "yy", "yz", "zz")


def tree_parameters(
    tree: Tree, chains: Iterable[Chain]
) -> Iterator[tuple[str, Link | Joint, FieldPath]]:
    """Yield name, owner and field path within the owner of each parameter of a tree."""
    for link in tree.links.values():
        if link.inertial is None:
            continue
        yield f"{link.name}.mass", link, ("inertial", "mass")
        for i, axis in enumerate("xyz"):
            yield f"{link.name}.com.{axis}", link, ("inertial", "com", i)
        for i, key in enumerate(_TENSOR_COMPONENTS):
            yield f"{link.name}.inertia.{key}", link, ("inertial", "tensor", i)
    attachment_names = {chain.attachment_name for chain in chains if chain.parent is not None}
    for joint in tree.joints.values():
        if joint.name in attachment_names:
            continue  # no file contains its placement
        for i, (axis, angle) in enumerate(zip("xyz", _ANGLE_NAMES, strict=True)):
            yield f"{joint.child}.{axis}", joint, ("xyz", i)
            yield f"{joint.child}.{angle}", joint, ("rpy", i)
        if not joint.is_movable:
            continue
        for key in [x for x in ("lower", "upper") if math.isfinite(getattr(joint.limits, x))]:
            yield f"{joint.name}.{key}", joint, ("limits", key)
        yield f"{joint.name}.rotor_inertia", joint, ("rotor_inertia",)


def value_at(owner: Any, field_path: FieldPath) -> Any:
    """Return what a field path of an object leads to."""
    for key in field_path:
        is_container = isinstance(owner, Mapping | tuple)
        owner = owner[key] if is_container else getattr(owner, str(key))
    return owner


def parameter_paths(spec: Any) -> dict[str, FieldPath]:
    """Field paths of all parameters within a description or a machine, by name.

    Parameters of sensors and the payload mass, which is a function of several values, have none.
    Paths of joints without friction lead to mapping keys that do not exist yet.
    """
    paths: dict[str, FieldPath] = {
        name: ("tree", "links" if isinstance(owner, Link) else "joints", owner.name, *field_path)
        for name, owner, field_path in tree_parameters(spec.tree, spec.chains)
    }
    parts: list[tuple[str, FieldPath, type]] = [
        (f"friction.{joint.name}", ("friction", joint.name), Friction)
        for joint in spec.tree.moving_joints
    ]
    parts += [(f"control.{joint}", ("control", joint), PIGains) for joint in spec.control]
    counts: Counter[str] = Counter()
    for prefix, section in ELEMENT_FIELDS.items():
        for i, element in enumerate(getattr(spec, section)):
            label = f"{prefix}.{'-'.join(getattr(element, 'between', None) or [element.joint])}"
            counts[label] += 1
            number_text = f"#{counts[label]}" if counts[label] > 1 else ""
            parts.append((label + number_text, (section, i), type(element)))
    paths |= {
        f"{prefix}.{field.name}": (*path, field.name)
        for prefix, path, part_type in parts
        for field in dataclasses.fields(part_type)
        if field.name not in ("joint", "between")
    }
    if spec.hydraulics is not None:
        paths |= {
            f"{prefix}.{name}": ("hydraulics", *path, name)
            for prefix, path in _component_paths(spec.hydraulics).items()
            for name in parameter_names(type(value_at(spec.hydraulics, path)))
            if not (prefix.startswith("supply.") and name == "tank")
        }
    paths |= {f"{GRAVITY_PREFIX}{axis}": ("gravity", i) for i, axis in enumerate("xyz")}
    return paths | {
        f"{PINS_PREFIX}{name}": ("pin_capacities", name) for name in spec.pin_capacities
    }


def parameters(spec: MachineSpec) -> dict[str, float]:
    """Return the parameters of a machine that can be changed, by name, in SI units.

    - `LINK.mass`, `LINK.com.x`, `LINK.inertia.xx` (about the centre of mass), and `LINK.x`,
      `LINK.roll`, which place the link on its parent. Frames such as pins are links, too.
    - `JOINT.lower`, `JOINT.rotor_inertia`, `friction.JOINT.coulomb`, `control.JOINT.kp`.
    - Of a circuit: `supply.pressure`, `oil.bulk_modulus`, `cylinder.JOINT.area_a`,
      `valve.JOINT.c1`.
    - Of force elements: `spring.JOINT.stiffness`, `gas_spring.JOINT.pressure`,
      `rope.LINK-LINK.length`, `end_stop.JOINT.stiffness`.
    - `payload.mass`: a point mass at the tip, or the payload of the machine file, scaled to that
      mass.
    - `pins.JOINT`: the largest force that a pin bears.
    - `gravity.x`, `.y`, `.z`: the acceleration of gravity, in the axes of the world.
    - Of sensors: `sensor.QUANTITY.zero`, `.scale`, `.delay`, `.noise`. They may be set for any
      quantity.

    Args:
        spec: The machine as read.
    """
    friction = {joint.name: Friction() for joint in spec.tree.moving_joints} | dict(spec.friction)
    completed = dataclasses.replace(spec, friction=friction)
    values = {
        name: float(value_at(completed, path)) for name, path in parameter_paths(spec).items()
    }
    payload = {} if spec.tip is None else {PAYLOAD_MASS: 0.0}
    pins = {name: values.pop(name) for name in [*values] if name.startswith(PINS_PREFIX)}
    return values | payload | pins | sensor_parameters(spec.sensors)


def _component_paths(hydraulics: Hydraulics) -> dict[str, FieldPath]:
    """Field paths of the components of a circuit by the prefix of their parameter names."""
    paths: dict[str, FieldPath] = {"supply": ("supply",), "oil": ("oil",)}
    for prefix, field in CIRCUIT_FIELDS.items():
        paths |= {f"{prefix}{name}": (field, name) for name in getattr(hydraulics, field)}
        if field == "supplies" and hydraulics.engine is not None:
            paths["engine"] = ("engine",)
        if field == "valves":
            paths |= {
                f"valve.{valve.joint}.{SPOOL_B}": ("valves", valve.joint, SPOOL_B)
                for valve in hydraulics.valves.values()
                if valve.spool_b
            }
    return paths


def unknown_parameter_text(spec: MachineSpec, names: Iterable[str], unknown_name: str) -> str:
    """Return the message about an unknown parameter, with similar names and a command."""
    similar_names = get_close_matches(unknown_name, names, 3, 0.6)
    suggestion = f"did you mean '{similar_names[0]}'? " if similar_names else ""
    if len(similar_names) > 1:
        suggestion += f"like it are {' and '.join(map(repr, similar_names[1:]))}; "
    machine_name = (
        spec.path.stem if bundled_machines().get(spec.path.stem) == spec.path else spec.path
    )
    return (
        f"parameter '{unknown_name}' is unknown, {suggestion}crane info "
        f"{command_line_arguments(machine_name)} --names lists all names"
    )


_INERTIAL_UNITS = {"com": "m", "inertia": "kg m2"}
_LINK_UNITS = {"mass": "kg"} | dict.fromkeys("xyz", "m") | dict.fromkeys(_ANGLE_NAMES, "rad")
_JOINT_UNITS = {  # of a sliding and of a turning joint
    "lower": ("m", "rad"), "upper": ("m", "rad"), "rotor_inertia": ("kg", "kg m2"),
}  # fmt: skip
_SECTIONS = {
    "friction": FRICTION, "spring": FORCE, "gas_spring": GAS_SPRING, "end_stop": END_STOP,
    "rope": ROPE, "control": CONTROL, "cylinder": CYLINDER, "valve": VALVE,
    "valve_control": VALVE_CONTROL,
    "supply": FIRST_PUMP, "oil": OIL, "engine": ENGINE, "line": LINE, "accumulator": ACCUMULATOR,
    "element": ELEMENT,
}  # fmt: skip


def parameter_unit(tree: Tree, name: str) -> str:
    """SI unit of a number as `crane.description.parameters` names it, "" of one without.

    Numbers of several, with `*`, are common factors, and have none.
    """
    if "*" in name:
        return ""
    if name.startswith(SENSOR_PREFIX):
        quantity, sensor_parameter = parse_sensor_parameter(name)
        return {"scale": "", "delay": "s"}.get(
            sensor_parameter, quantity_unit(tree, quantity) or ""
        )
    prefix, _, rest = name.partition(".")
    part, _, key = name.rpartition(".")
    owner = rest.rpartition(".")[0]
    if name.startswith(PINS_PREFIX):
        return "N"
    if name.startswith(GRAVITY_PREFIX):
        return "m/s2"
    if prefix not in _SECTIONS:
        kind = part.rpartition(".")[2]
        if kind in _INERTIAL_UNITS and part not in tree.links:
            return _INERTIAL_UNITS[kind]
        if part in tree.joints and key in _JOINT_UNITS:
            return _JOINT_UNITS[key][tree.joints[part].kind == "revolute"]
        return _LINK_UNITS.get(key, "")
    owner = owner.partition("#")[0]  # of several elements of a joint
    is_rotary = owner in tree.joints and tree.joints[owner].kind == "revolute"
    value = _SECTIONS[prefix].keys.get(key)
    value = next(iter(getattr(value, "types", ())), value)  # an edge, which may be a curve
    if not isinstance(value, NumberKey):
        return ""
    return value.rotary_unit or value.unit if is_rotary else value.unit


NamesByKind = dict[str, dict[str, str]]  # kind -> name -> short description
_MAX_SUGGESTIONS, _MIN_SIMILARITY = 5, 0.6


def names_by_kind(spec: MachineSpec) -> NamesByKind:
    """Return the names of joints, frames, columns of recordings and parameters of a machine.

    Returns:
        By kind and name a short description: type of the joint, joint or link that carries the
        frame, unit of the column, value of the parameter with its unit.
    """
    tree = spec.tree
    cylinders = {} if spec.hydraulics is None else spec.hydraulics.cylinders

    def is_available(name: str) -> bool:  # whether the circuit has that valve or chamber
        heads = PRESSURE_PREFIX, VALVE_SIGNAL_PREFIX, "spool_"
        head = next((head for head in heads if name.startswith(head)), "")
        rest = name.removeprefix(head)
        if name in (SUPPLY_PRESSURE, TANK_PRESSURE):
            return bool(cylinders)
        return not head or not cylinders.keys().isdisjoint((rest, rest[:-2]))

    parents = {joint.child: joint for joint in tree.joints.values()}
    return {
        "joint": {joint.name: joint.kind for joint in tree.moving_joints},
        "frame": {
            link: f"{'moved by' if parents[link].is_movable else 'on'} "
            f"{parents[link].name if parents[link].is_movable else parents[link].parent}"
            if link in parents
            else "root"
            for link in tree.links
        },
        "column": {
            name: unit for name, unit in quantity_units(tree).items() if is_available(name)
        },
        "parameter": {
            name: f"{value:.6g} {parameter_unit(tree, name)}".rstrip()
            for name, value in parameters(spec).items()
        },
    }


def search_names(names: NamesByKind, pattern: str) -> NamesByKind:
    """Select the names that a pattern matches.

    Args:
        names: As `names_by_kind` returns them.
        pattern: With `*`, `?` or `[...]` it has to match a whole name, else a part of a name.

    Raises:
        InputError: No name matches; the message lists similar names.
    """
    lowercase_pattern = pattern.lower()
    glob = lowercase_pattern if set(lowercase_pattern) & set("*?[") else f"*{lowercase_pattern}*"
    found = {
        kind: {name: text for name, text in values.items() if fnmatchcase(name.lower(), glob)}
        for kind, values in names.items()
    }
    if any(found.values()):
        return found
    name_of_word: dict[str, str] = {}  # first name that contains a word
    for name in [name for values in names.values() for name in values]:
        for word in (name, *name.split("."), *name.replace("_", ".").split(".")):
            name_of_word.setdefault(word.lower(), name)
    similar_words = get_close_matches(
        lowercase_pattern.strip("*?[]"), name_of_word, _MAX_SUGGESTIONS, _MIN_SIMILARITY
    )
    suggestions = list(dict.fromkeys(repr(name_of_word[word]) for word in similar_words))
    hint = (
        f"did you mean {' or '.join(suggestions)}?"
        if suggestions
        else "leave it out for all parameters"
    )
    raise InputError(f"nothing is called like '{pattern}', {hint}")
