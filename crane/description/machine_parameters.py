"""Parameters of a machine: names, values and where they are in its description."""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping
from difflib import get_close_matches
from typing import Any

from crane.description.force_elements import Friction
from crane.description.kinematic_tree import Joint, Link, Tree
from crane.description.machine_lookup import bundled_machines, command_line_arguments
from crane.description.sensors import (
    sensor_parameters,
)
from crane.description.specification import Chain, MachineSpec, PIGains
from crane.hydraulics.circuit_elements import parameter_names
from crane.hydraulics.hydraulic_circuit import Hydraulics

PAYLOAD_MASS = "payload.mass"
PINS_PREFIX = "pins."
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
        for key in ("lower", "upper"):
            if math.isfinite(getattr(joint.limits, key)):
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
    for section, joints, element_type in (
        ("friction", [joint.name for joint in spec.tree.moving_joints], Friction),
        ("control", list(spec.control), PIGains),
    ):
        for joint in joints:
            for field in dataclasses.fields(element_type):
                paths[f"{section}.{joint}.{field.name}"] = section, joint, field.name
    prefixes: dict[str, int] = {}
    for prefix, section in ELEMENT_FIELDS.items():
        for i, element in enumerate(getattr(spec, section)):
            between = getattr(element, "between", None)
            label = f"{prefix}.{'-'.join(between) if between else element.joint}"
            prefixes[label] = prefixes.get(label, 0) + 1
            if prefixes[label] > 1:
                label += f"#{prefixes[label]}"
            for field in dataclasses.fields(element):
                if field.name not in ("joint", "between"):
                    paths[f"{label}.{field.name}"] = section, i, field.name
    if spec.hydraulics is not None:
        for prefix, path in _component_paths(spec.hydraulics).items():
            for name in parameter_names(type(value_at(spec.hydraulics, path))):
                if not (prefix.startswith("supply.") and name == "tank"):
                    paths[f"{prefix}.{name}"] = "hydraulics", *path, name
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
