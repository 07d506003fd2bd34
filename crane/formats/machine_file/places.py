"""Where the numbers of a machine stand in the files that are written of it."""

from dataclasses import dataclass
from typing import Any

from crane.description.changes import (
    CIRCUIT,
    PINS,
    SPOOL_B,
    circuit_parts,
    elements,
    number_at,
    tree_numbers,
)
from crane.description.sensors import SENSOR
from crane.description.tree import Link
from crane.formats.machine_file.text import Way
from crane.hydraulics import Spool
from crane.machine import Machine

_LISTS = ("forces", "ropes")  # of which a machine file has lists, of the rest mappings
_TAGS = {"mass": "inertial/mass", "com": "inertial/origin", "tensor": "inertial/inertia",
         "xyz": "origin", "rpy": "origin", "limits": "limit"}  # fmt: skip


@dataclass(frozen=True)
class InURDF:
    """A number of an element of a URDF.

    Attributes:
        link: Whose URDF it is in.
        kind: "link" or "joint".
        owner: Name of that.
        path: Of the element within.
        value: What it is.
    """

    link: str
    kind: str
    owner: str
    path: str
    value: float


@dataclass(frozen=True)
class InFile:
    """A number of a machine file.

    Attributes:
        way: Keys and indices down to it.
        value: What it is.
    """

    way: Way
    value: float


def places(machine: Machine) -> dict[str, InURDF | InFile]:
    """Where numbers stand, by their names, see `crane.description.parameters`.

    `payload.mass` stands nowhere: it is part of a link's mass, or of several.
    """
    found: dict[str, InURDF | InFile] = {}
    for name, owner, way in tree_numbers(machine.tree, machine.chains):
        value = number_at(owner, way)
        if way[0] == "rotor_inertia":
            found[name] = InFile(("rotor_inertia", owner.name), value)
            continue
        if isinstance(owner, Link):
            found[name] = InURDF(owner.name, "link", owner.name, _TAGS[str(way[1])], value)
        else:
            found[name] = InURDF(owner.child, "joint", owner.name, _TAGS[str(way[0])], value)
    parts: dict[str, tuple[Way, Any]] = {
        f"friction.{joint}": (("friction", joint), law) for joint, law in machine.friction.items()
    }
    parts |= {f"control.{joint}": (("control", joint), x) for joint, x in machine.control.items()}
    acting = elements(
        forces=machine.forces, gas_springs=machine.gas_springs, ropes=machine.ropes,
        end_stops=machine.end_stops,
    )  # fmt: skip
    for head, (field, i, item) in acting.items():
        parts[head] = (field, i if field in _LISTS else item.joint), item
    for head, part in circuit_parts(machine.hydraulics).items() if machine.hydraulics else ():
        kind, _, joint = head.partition(".")
        own: Way = (kind,)
        if joint:
            outer = joint.removesuffix(f".{SPOOL_B}") if isinstance(part, Spool) else joint
            own = (CIRCUIT[f"{kind}."], outer, *([SPOOL_B] if outer != joint else []))
        parts[head] = ("hydraulics", *own), part
    for quantity, sensor in machine.sensors.items():
        parts[f"{SENSOR}{quantity}"] = ("sensors", quantity), sensor
    found |= {f"{PINS}{name}": InFile(("pins", name), x) for name, x in machine.pins.items()}
    for head, (way, item) in parts.items():
        found |= {
            f"{head}.{name}": InFile((*way, name), value)
            for name, value in vars(item).items()
            if isinstance(value, int | float)
        }
    return found
