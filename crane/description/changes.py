"""Machines that differ from their files: other numbers, locked joints."""

import copy
import dataclasses
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from difflib import get_close_matches
from types import MappingProxyType
from typing import Any

import numpy as np
from lxml import etree

from crane.description.circuit_section import numbers_of
from crane.description.hydraulics import Hydraulics
from crane.description.magnitudes import doubt
from crane.description.sources import bundled
from crane.description.spec import Chain, Coupling, Friction, MachineSpec
from crane.description.urdf import read_urdf
from crane.errors import CraneWarning, InputError, known
from crane.samples import FARTHEST, as_number

PAYLOAD = "payload.mass"
_TURNS = ("roll", "pitch", "yaw")


class _Number:
    """One number in an attribute of the tree.

    Args:
        element: Its element.
        attribute: Its attribute, numbers with blanks between.
        index: Which of them.
    """

    def __init__(self, element: etree._Element, attribute: str, index: int = 0):
        self._element, self._attribute, self._index = element, attribute, index

    def get(self) -> float:
        return float(self._element.get(self._attribute).split()[self._index])

    def set(self, value: float) -> None:
        words = self._element.get(self._attribute).split()
        words[self._index] = repr(value)
        self._element.set(self._attribute, " ".join(words))


def _numbers(tree: etree._Element) -> Iterator[tuple[str, _Number]]:
    for link in tree.iterfind("link"):
        name, inertial = link.get("name"), link.find("inertial")
        if inertial is not None:
            yield f"{name}.mass", _Number(inertial.find("mass"), "value")
            for i, axis in enumerate("xyz"):
                yield f"{name}.com.{axis}", _Number(inertial.find("origin"), "xyz", i)
            for key in inertial.find("inertia").attrib:
                yield f"{name}.inertia.{key[1:]}", _Number(inertial.find("inertia"), key)
    for joint in tree.iterfind("joint"):
        origin, limit = joint.find("origin"), joint.find("limit")
        link = joint.find("child").get("link")
        if origin is not None:
            for i, (axis, turn) in enumerate(zip("xyz", _TURNS, strict=True)):
                yield f"{link}.{axis}", _Number(origin, "xyz", i)
                yield f"{link}.{turn}", _Number(origin, "rpy", i)
        for key in ("lower", "upper"):
            if limit is not None and limit.get(key) is not None:
                yield f"{joint.get('name')}.{key}", _Number(limit, key)


def parameters(spec: MachineSpec) -> dict[str, float]:
    """Numbers of a machine that can be changed, by name.

    `LINK.mass`, `LINK.com.x`, `LINK.inertia.xx` (about the centre of mass), `LINK.x`, `LINK.roll`
    (where its joint places it on its parent; frames such as pins are links, too), `JOINT.lower`,
    `friction.JOINT.coulomb`, `control.JOINT.kp`, of a circuit `supply.pressure`,
    `oil.bulk_modulus`, `cylinder.JOINT.area_a`, `valve.JOINT.c1`, and `payload.mass`, a point
    mass at the tip, or the load that the machine file names, scaled to that mass.
    """
    found = {name: number.get() for name, number in _numbers(spec.tree)}
    joints = [j.get("name") for j in spec.tree.iterfind("joint") if j.get("type") != "fixed"]
    for joint in joints:
        friction = spec.friction.get(joint, Friction())
        for field in dataclasses.fields(Friction):
            found[f"friction.{joint}.{field.name}"] = getattr(friction, field.name)
    for joint, gains in spec.control.items():
        for field in dataclasses.fields(gains):
            found[f"control.{joint}.{field.name}"] = getattr(gains, field.name)
    if spec.hydraulics is not None:
        for head, part in _parts(spec.hydraulics).items():
            found |= {f"{head}.{name}": getattr(part, name) for name in numbers_of(type(part))}
    if spec.tip is not None:
        found[PAYLOAD] = 0.0
    return found


def changed(spec: MachineSpec, changes: Mapping[str, float]) -> MachineSpec:
    """A machine with other numbers.

    Args:
        spec: The machine as read.
        changes: New values by name, see `parameters`; SI units.

    Raises:
        InputError: Unknown name, or a value that cannot be.
    """
    names = parameters(spec)
    tree = copy.deepcopy(spec.tree)
    numbers = dict(_numbers(tree))
    chains = spec.chains
    friction, control = dict(spec.friction), dict(spec.control)
    circuit = _parts(spec.hydraulics) if spec.hydraulics else {}
    replaced: dict[str, dict[str, float]] = {}
    for name, given in changes.items():
        if name not in names:
            raise InputError(f"parameter '{name}' is unknown, {_nearest(spec, names, name)}")
        value = as_number(given, f"parameter '{name}'", "")
        head, _, rest = name.partition(".")
        if name.endswith(".mass") and value < 0:
            raise InputError(f"parameter '{name}' is {value:g} kg, it must not be negative")
        if name == PAYLOAD:
            chains = _load(spec, tree, value)
        elif head == "friction":
            _set(friction, rest, value, Friction)
        elif (part := name.rpartition(".")[0]) in circuit:
            replaced.setdefault(part, {})[name.rpartition(".")[2]] = value
        elif head == "control":
            _set(control, rest, value, None)
        else:
            numbers[name].set(value)
    for part, values in replaced.items():
        circuit[part] = dataclasses.replace(circuit[part], **values)
    hydraulics = _circuit(circuit) if circuit else None
    for part, values in replaced.items():
        _warn_of_units(spec, part, values)
    return dataclasses.replace(
        spec,
        chains=chains,
        tree=tree,
        friction=MappingProxyType(friction),
        control=MappingProxyType(control),
        hydraulics=hydraulics,
        where={**spec.where, "link payload": PAYLOAD},
    )


def _nearest(spec: MachineSpec, names: Iterable[str], wanted: str) -> str:
    """What an error about an unknown parameter ends with: names like it, and where all are."""
    near = get_close_matches(wanted, names, 3, 0.6)
    meant = f"did you mean '{near[0]}'? " if near else ""
    if len(near) > 1:
        meant += f"like it are {' and '.join(map(repr, near[1:]))}; "
    at = spec.path.stem if bundled().get(spec.path.stem) == spec.path else spec.path
    return f"{meant}crane info {at} --parameters lists all names"


def _warn_of_units(spec: MachineSpec, part: str, values: Mapping[str, float]) -> None:
    """Warn of numbers of the circuit that can be, and hardly are in their SI unit."""
    joint = part.partition(".")[2]
    turning = any(
        element.get("name") == joint and element.get("type") != "prismatic"
        for element in spec.tree.iterfind("joint")
    )
    for name, value in values.items():
        if text := doubt(name, value, turning):
            what = f"parameter '{part}.{name}' {text}"
            warnings.warn(what, CraneWarning, stacklevel=2)


def _parts(hydraulics: Hydraulics) -> dict[str, Any]:
    """The parts of a circuit by the names that their numbers begin with."""
    return (
        {"supply": hydraulics.supply, "oil": hydraulics.oil}
        | {f"cylinder.{joint}": part for joint, part in hydraulics.cylinders.items()}
        | {f"valve.{joint}": part for joint, part in hydraulics.valves.items()}
        | {f"valve_control.{joint}": part for joint, part in hydraulics.control.items()}
    )


def _circuit(parts: Mapping[str, Any]) -> Hydraulics:
    """The circuit of these parts."""
    cylinders, valves, control = (
        {name.removeprefix(kind): part for name, part in parts.items() if name.startswith(kind)}
        for kind in ("cylinder.", "valve.", "valve_control.")
    )
    return Hydraulics(parts["supply"], parts["oil"], cylinders, valves, control)


def locked(spec: MachineSpec, lock: Mapping[str, float]) -> MachineSpec:
    """A machine with some joints fixed.

    What refers to a locked joint, such as its friction, goes with it, and so do tasks of active
    joints if one of them is locked.

    Args:
        spec: The machine as read.
        lock: Coordinate [m], [rad] by joint.

    Raises:
        InputError: No such joint, no finite coordinate, or the last active joint.
    """
    tree = copy.deepcopy(spec.tree)
    joints = {j.get("name"): j for j in tree.iterfind("joint") if j.get("type") != "fixed"}
    lock, couplings = _coupled(spec.couplings, lock)
    for name, given in lock.items():
        if name not in joints:
            raise InputError(f"joint '{name}' to lock is unknown, {known(joints, name)}")
        _fix(joints[name], given)
    active = spec.active and tuple(name for name in spec.active if name not in lock)
    if (spec.active and not active) or not joints.keys() - lock.keys():
        raise InputError(f"with {', '.join(lock)} locked nothing drives the machine, lock less")
    chains = tuple(
        dataclasses.replace(chain, joints=tuple(j for j in chain.joints if j not in lock))
        for chain in spec.chains
    )
    return dataclasses.replace(
        spec,
        tree=tree,
        chains=chains,
        active=active,
        home={joint: value for joint, value in spec.home.items() if joint not in lock},
        friction={joint: value for joint, value in spec.friction.items() if joint not in lock},
        control={joint: value for joint, value in spec.control.items() if joint not in lock},
        forces=tuple(item for item in spec.forces if item.joint not in lock),
        hydraulics=spec.hydraulics and spec.hydraulics.only(active or ()),
        gas_springs=tuple(item for item in spec.gas_springs if item.joint not in lock),
        end_stops=tuple(item for item in spec.end_stops if item.joint not in lock),
        tasks={
            name: dataclasses.replace(
                task, levers={x: lever for x, lever in task.levers.items() if x not in lock}
            )
            for name, task in spec.tasks.items()
            if not (task.space == "active" and task.coefficients.keys() & lock.keys())
        },
        couplings=couplings,
    )


def _coupled(
    couplings: tuple[Coupling, ...], lock: Mapping[str, float]
) -> tuple[dict[str, float], tuple[Coupling, ...]]:
    """Locks with what couplings make of them, and the couplings of what still moves."""
    locked = {
        name: as_number(x, f"the coordinate to lock '{name}' at", "m or rad", most=FARTHEST)
        for name, x in lock.items()
    }
    rest = list(couplings)
    settled = False
    while not settled:
        settled = True
        for coupling in tuple(rest):
            free = {name: x for name, x in coupling.factors.items() if name not in locked}
            held = coupling.factors.keys() - free.keys()
            left = coupling.offset - sum(coupling.factors[name] * locked[name] for name in held)
            if len(free) > 1 or not held:
                continue
            rest.remove(coupling)
            if not free:
                if abs(left) > 1e-9:
                    raise InputError(
                        f"coupling '{coupling.name}' does not allow "
                        f"{', '.join(f'{x} = {locked[x]:g}' for x in sorted(held))}, lock one of "
                        "them alone"
                    )
                continue
            ((name, factor),) = free.items()
            locked[name], settled = left / factor, False
    return locked, tuple(
        dataclasses.replace(
            coupling,
            factors={name: x for name, x in coupling.factors.items() if name not in locked},
            offset=coupling.offset
            - sum(x * locked[name] for name, x in coupling.factors.items() if name in locked),
        )
        for coupling in rest
    )


def _fix(joint: etree._Element, value: float) -> None:
    """Make a joint fixed where its coordinate has a value."""
    from scipy.spatial.transform import Rotation

    origin = joint.find("origin")
    xyz, rpy, axis = (
        np.array([float(word) for word in text.split()])
        for text in (origin.get("xyz"), origin.get("rpy"), joint.find("axis").get("xyz"))
    )
    turn = Rotation.from_euler("xyz", rpy)
    if joint.get("type") == "prismatic":
        xyz = xyz + turn.apply(value * axis)
    else:
        turn = turn * Rotation.from_rotvec(value * axis)
    origin.set("xyz", " ".join(map(repr, xyz.tolist())))
    if value and joint.get("type") != "prismatic":
        origin.set("rpy", " ".join(map(repr, turn.as_euler("xyz").tolist())))
    joint.set("type", "fixed")
    for tag in ("axis", "limit"):
        for element in joint.findall(tag):
            joint.remove(element)


def _set(by_joint: dict, name: str, value: float, default: Callable | None) -> None:
    joint, _, field = name.rpartition(".")
    before = by_joint[joint] if default is None else by_joint.get(joint, default())
    by_joint[joint] = dataclasses.replace(before, **{field: value})


def _load(spec: MachineSpec, tree: etree._Element, mass: float) -> tuple[Chain, ...]:
    """Fix a payload to the tip: the machine's own, scaled to the mass, or else a point mass.

    Masses and inertias are scaled, places are not: a load of another density.

    Returns:
        The chains that the tree is made of now.
    """
    if mass == 0:
        return spec.chains
    if spec.payload is None:
        link = etree.SubElement(tree, "link", name="payload")
        inertial = etree.SubElement(link, "inertial")
        etree.SubElement(inertial, "origin", xyz="0 0 0", rpy="0 0 0")
        etree.SubElement(inertial, "mass", value=repr(mass))
        etree.SubElement(
            inertial, "inertia", dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0")
        )
        _attach(tree, "payload_fixed", spec.tip, "payload")
        return spec.chains
    load = read_urdf(spec.payload.urdf)
    scale = mass / sum(float(element.get("value")) for element in load.robot.iter("mass"))
    for element in load.robot.iter("mass", "inertia"):
        for key, value in element.items():
            element.set(key, repr(scale * float(value)))
    _attach(tree, f"{spec.payload.name}_attachment", spec.tip, load.root)
    tree.extend(load.robot)
    return (*spec.chains, spec.payload)


def _attach(tree: etree._Element, name: str, parent: str | None, child: str) -> None:
    joint = etree.SubElement(tree, "joint", name=name, type="fixed")
    etree.SubElement(joint, "parent", link=str(parent))
    etree.SubElement(joint, "child", link=child)
