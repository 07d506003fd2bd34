"""Where the numbers of a machine stand in the files that are written of it."""

from dataclasses import dataclass
from typing import Any

from crane.description.kinematic_tree import Link
from crane.description.machine_parameters import (
    CIRCUIT_FIELDS,
    PINS_PREFIX,
    SPOOL_B,
    components_by_prefix,
    elements_by_prefix,
    tree_parameters,
    value_at,
)
from crane.description.sensors import SENSOR_PREFIX
from crane.formats.machine_file.yaml_text import KeyPath
from crane.hydraulics.components import Spool
from crane.machine.machine import Machine

_LIST_SECTIONS = ("forces", "ropes")  # of which a machine file has lists, of the rest mappings
_ELEMENT_PATHS = {"mass": "inertial/mass", "com": "inertial/origin", "tensor": "inertial/inertia",
         "xyz": "origin", "rpy": "origin", "limits": "limit"}  # fmt: skip


@dataclass(frozen=True)
class UrdfLocation:
    """A number of an element of a URDF.

    Attributes:
        link: Whose URDF it is in.
        element_type: "link" or "joint".
        owner: Name of that.
        path: Of the element within.
        value: What it is.
    """

    link: str
    element_type: str
    owner: str
    path: str
    value: float


@dataclass(frozen=True)
class MachineFileLocation:
    """A number of a machine file.

    Attributes:
        key_path: Keys and indices down to it.
        value: What it is.
    """

    key_path: KeyPath
    value: float


def parameter_locations(machine: Machine) -> dict[str, UrdfLocation | MachineFileLocation]:
    """Where numbers stand, by their names, see `crane.description.parameters`.

    `payload.mass` stands nowhere: it is part of a link's mass, or of several.
    """
    locations: dict[str, UrdfLocation | MachineFileLocation] = {}
    for name, owner, field_path in tree_parameters(machine.tree, machine.chains):
        value = value_at(owner, field_path)
        if field_path[0] == "rotor_inertia":
            locations[name] = MachineFileLocation(("rotor_inertia", owner.name), value)
            continue
        if isinstance(owner, Link):
            locations[name] = UrdfLocation(
                owner.name, "link", owner.name, _ELEMENT_PATHS[str(field_path[1])], value
            )
        else:
            locations[name] = UrdfLocation(
                owner.child, "joint", owner.name, _ELEMENT_PATHS[str(field_path[0])], value
            )
    parts: dict[str, tuple[KeyPath, Any]] = {
        f"friction.{joint}": (("friction", joint), law) for joint, law in machine.friction.items()
    }
    parts |= {f"control.{joint}": (("control", joint), x) for joint, x in machine.control.items()}
    elements_of_prefix = elements_by_prefix(
        forces=machine.forces, gas_springs=machine.gas_springs, ropes=machine.ropes,
        end_stops=machine.end_stops,
    )  # fmt: skip
    for head, (field, i, item) in elements_of_prefix.items():
        parts[head] = (field, i if field in _LIST_SECTIONS else item.joint), item
    for head, part in (
        components_by_prefix(machine.hydraulics).items() if machine.hydraulics else ()
    ):
        kind, _, joint = head.partition(".")
        component_path: KeyPath = (kind,)
        if joint:
            owner_name = joint.removesuffix(f".{SPOOL_B}") if isinstance(part, Spool) else joint
            component_path = (
                CIRCUIT_FIELDS[f"{kind}."],
                owner_name,
                *([SPOOL_B] if owner_name != joint else []),
            )
        parts[head] = ("hydraulics", *component_path), part
    for quantity, sensor in machine.sensors.items():
        parts[f"{SENSOR_PREFIX}{quantity}"] = ("sensors", quantity), sensor
    locations |= {
        f"{PINS_PREFIX}{name}": MachineFileLocation(("pins", name), x)
        for name, x in machine.pin_capacities.items()
    }
    for head, (field_path, item) in parts.items():
        locations |= {
            f"{head}.{name}": MachineFileLocation((*field_path, name), value)
            for name, value in vars(item).items()
            if isinstance(value, int | float)
        }
    return locations
