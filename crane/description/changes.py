"""Machines that differ from their files: other numbers, locked joints."""

import dataclasses
import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from types import MappingProxyType
from typing import Any

import numpy as np

from crane.common.errors import CraneWarning, InputError, known
from crane.common.magnitudes import doubt
from crane.common.samples import FARTHEST, as_number
from crane.description.external import ExternalForce
from crane.description.floating import grounded
from crane.description.sensors import (
    SENSOR,
    named_numbers,
    parsed,
    quantities,
    unit_of,
    with_numbers,
)
from crane.description.sources import bundled, command_words
from crane.description.spec import (
    Chain,
    Coupling,
    Drive,
    Element,
    EndStop,
    Friction,
    MachineSpec,
)
from crane.description.tree import Joint, Limits, Link, Tree, limit
from crane.hydraulics.components import Hydraulics
from crane.hydraulics.numbers import number_names

PAYLOAD = "payload.mass"
PINS = "pins."
_LISTS = ("forces", "gas_springs", "ropes", "end_stops")
_TURNS = ("roll", "pitch", "yaw")
_SLACK = 1e-9  # of a limit, for rounding


# Where a number stands: names of fields, and indices in tuples, from a link or a joint on
_Way = tuple[str | int, ...]
_TENSOR = ("xx", "xy", "xz", "yy", "yz", "zz")


def tree_numbers(tree: Tree, chains: Iterable[Chain]) -> Iterator[tuple[str, Link | Joint, _Way]]:
    """Names of a tree's numbers, with the link or joint that has them, and where."""
    for link in tree.links.values():
        if link.inertial is None:
            continue
        yield f"{link.name}.mass", link, ("inertial", "mass")
        for i, axis in enumerate("xyz"):
            yield f"{link.name}.com.{axis}", link, ("inertial", "com", i)
        for i, key in enumerate(_TENSOR):
            yield f"{link.name}.inertia.{key}", link, ("inertial", "tensor", i)
    attached = {chain.attachment for chain in chains if chain.parent is not None}
    for joint in tree.joints.values():
        if joint.name in attached:
            continue  # whose place stands in no file
        for i, (axis, turn) in enumerate(zip("xyz", _TURNS, strict=True)):
            yield f"{joint.child}.{axis}", joint, ("xyz", i)
            yield f"{joint.child}.{turn}", joint, ("rpy", i)
        ends = ("lower", "upper") if joint.moves else ()
        for key in [key for key in ends if math.isfinite(getattr(joint.limits, key))]:
            yield f"{joint.name}.{key}", joint, ("limits", key)
        if joint.moves:
            yield f"{joint.name}.rotor_inertia", joint, ("rotor_inertia",)


def number_at(part: Any, way: _Way) -> float:
    """The number of a link or a joint where `tree_numbers` says that it stands."""
    for at in way:
        part = part[at] if isinstance(at, int) else getattr(part, at)
    return float(part)


def _with(part: Any, way: _Way, value: float) -> Any:
    """A part of the description with another number in it."""
    if not way:
        return value
    at, rest = way[0], way[1:]
    if isinstance(at, int):
        return (*part[:at], _with(part[at], rest, value), *part[at + 1 :])
    return dataclasses.replace(part, **{at: _with(getattr(part, at), rest, value)})


def parameters(spec: MachineSpec) -> dict[str, float]:
    """Numbers of a machine that can be changed, by name.

    `LINK.mass`, `LINK.com.x`, `LINK.inertia.xx` (about the centre of mass), `LINK.x`, `LINK.roll`
    (where its joint places it on its parent; frames such as pins are links, too), `JOINT.lower`,
    `JOINT.rotor_inertia`, `friction.JOINT.coulomb`, `control.JOINT.kp`, of a circuit
    `supply.pressure`, `oil.bulk_modulus`, `cylinder.JOINT.area_a`, `valve.JOINT.c1`; of what acts
    along joints or between frames `spring.JOINT.stiffness`, `gas_spring.JOINT.pressure`,
    `rope.LINK-LINK.length`, `end_stop.JOINT.stiffness`; and `payload.mass`, a point mass at the
    tip, or the load that the machine file names, scaled to that mass; of its sensors
    `sensor.QUANTITY.zero`, `.scale`, `.delay`, `.noise`, which may be set of any quantity; of pins
    `pins.JOINT`, the largest force that they bear.
    """
    every = tree_numbers(spec.tree, spec.chains)
    found = {name: number_at(part, way) for name, part, way in every}
    for joint in (joint.name for joint in spec.tree.moving):
        friction = spec.friction.get(joint, Friction())
        for field in dataclasses.fields(Friction):
            found[f"friction.{joint}.{field.name}"] = getattr(friction, field.name)
    for joint, gains in spec.control.items():
        for field in dataclasses.fields(gains):
            found[f"control.{joint}.{field.name}"] = getattr(gains, field.name)
    for head, (_, _, item) in elements(**_lists(spec)).items():
        for field in dataclasses.fields(item):
            if field.name not in ("joint", "between"):
                found[f"{head}.{field.name}"] = getattr(item, field.name)
    if spec.hydraulics is not None:
        for head, part in circuit_parts(spec.hydraulics).items():
            of = [x for x in number_names(type(part)) if (head[:7], x) != ("supply.", "tank")]
            found |= {f"{head}.{name}": getattr(part, name) for name in of}
    if spec.tip is not None:
        found[PAYLOAD] = 0.0
    found |= {f"{PINS}{name}": force for name, force in spec.pins.items()}
    return found | named_numbers(spec.sensors)


def elements(
    **lists: Sequence[Element | EndStop],
) -> dict[str, tuple[str, int, Element | EndStop]]:
    """Springs, gas springs, ropes and end stops by the names that their numbers begin with.

    With the field of the description and the place in it that they have.

    Args:
        lists: By those fields: forces, gas_springs, ropes, end_stops.
    """
    found: dict[str, tuple[str, int, Element | EndStop]] = {}
    for head, field in (
        ("spring", "forces"), ("gas_spring", "gas_springs"), ("rope", "ropes"),
        ("end_stop", "end_stops"),
    ):  # fmt: skip
        for i, item in enumerate(lists[field]):
            between = getattr(item, "between", None)
            name = f"{head}.{'-'.join(between) if between else item.joint}"
            count = sum(other == name or other.startswith(f"{name}#") for other in found)
            found[f"{name}#{count + 1}" if count else name] = field, i, item
    return found


def _lists(spec: MachineSpec) -> dict[str, Sequence[Any]]:
    return {field: getattr(spec, field) for field in _LISTS}


def changed(spec: MachineSpec, changes: Mapping[str, float]) -> MachineSpec:
    """A machine with other numbers.

    Args:
        spec: The machine as read.
        changes: New values by name, see `parameters`; SI units.

    Raises:
        InputError: Unknown name, or a value that cannot be.
    """
    names = parameters(spec)
    numbers = {name: (part, way) for name, part, way in tree_numbers(spec.tree, spec.chains)}
    tree, chains = spec.tree, spec.chains
    friction, control, pins = dict(spec.friction), dict(spec.control), dict(spec.pins)
    circuit = circuit_parts(spec.hydraulics) if spec.hydraulics else {}
    acting = elements(**_lists(spec))
    replaced: dict[str, dict[str, float]] = {}
    renewed: dict[str, dict[str, float]] = {}
    off: dict[str, float] = {}
    for name in sorted(changes, key=lambda name: name == PAYLOAD):  # last: it adds to a link
        if name.startswith(SENSOR):
            _check_sensor(spec, name)
        elif name not in names:
            raise InputError(unknown_parameter(spec, names, name))
        value = as_number(changes[name], f"parameter '{name}'", "")
        head, _, rest = name.partition(".")
        if name.endswith(".mass") and value < 0:
            raise InputError(f"parameter '{name}' is {value:g} kg, it must not be negative")
        if name.endswith(".rotor_inertia") and value < 0:
            raise InputError(f"parameter '{name}' is {value:g}, it must not be negative")
        if name.startswith(PINS) and value <= 0:
            raise InputError(f"parameter '{name}' is {value:g} N, give a force above 0")
        if name == PAYLOAD:
            tree, chains = _load(spec, tree, value)
        elif name.startswith(SENSOR):
            off[name] = value
        elif name.startswith(PINS):
            pins[rest] = value
        elif head == "friction":
            _set(friction, rest, value, Friction)
        elif (part := name.rpartition(".")[0]) in acting:
            renewed.setdefault(part, {})[name.rpartition(".")[2]] = value
        elif part in circuit:
            replaced.setdefault(part, {})[name.rpartition(".")[2]] = value
        elif head == "control":
            _set(control, rest, value, None)
        else:
            owner, way = numbers[name]
            now = (tree.links if isinstance(owner, Link) else tree.joints)[owner.name]
            tree = tree.replacing(_changed(now, way, value, name))
    for part, values in replaced.items():
        circuit[part] = dataclasses.replace(circuit[part], **values)
    lists: dict[str, list[Any]] = {field: list(items) for field, items in _lists(spec).items()}
    for part, values in renewed.items():
        field, i, _ = acting[part]
        lists[field][i] = dataclasses.replace(lists[field][i], **values)
    hydraulics = _circuit(spec.hydraulics, circuit) if spec.hydraulics else None
    for part, values in replaced.items():
        _warn_of_units(spec, part, values)
    return dataclasses.replace(
        spec,
        chains=chains,
        tree=tree,
        friction=MappingProxyType(friction),
        control=MappingProxyType(control),
        pins=MappingProxyType(pins),
        hydraulics=hydraulics,
        forces=tuple(lists["forces"]),
        gas_springs=tuple(lists["gas_springs"]),
        ropes=tuple(lists["ropes"]),
        end_stops=tuple(lists["end_stops"]),
        sensors=MappingProxyType(with_numbers(spec.sensors, off)),
    )


def _check_sensor(spec: MachineSpec, name: str) -> None:
    """See that a number is of a sensor that a machine may have."""
    quantity, _ = parsed(name)
    if unit_of(spec.tree, quantity) is None and quantity not in spec.sensors:
        hint = known(quantities(spec.tree), quantity)
        raise InputError(f"'{name}' is of no quantity of '{spec.name}', {hint}")


def _changed(part: Link | Joint, way: _Way, value: float, name: str) -> Link | Joint:
    """A link or joint with another number, called `name`, in it."""
    if way[0] != "limits":
        return _with(part, way, value)
    assert isinstance(part, Joint)
    end = {str(way[-1]): limit(value)}
    limits = dataclasses.replace(part.limits, where=f"changed by {name}", **end)
    return dataclasses.replace(part, limits=limits)


def unknown_parameter(spec: MachineSpec, names: Iterable[str], wanted: str) -> str:
    """What is said of a parameter that is none: names like it, and where all are."""
    near = get_close_matches(wanted, names, 3, 0.6)
    meant = f"did you mean '{near[0]}'? " if near else ""
    if len(near) > 1:
        meant += f"like it are {' and '.join(map(repr, near[1:]))}; "
    at = spec.path.stem if bundled().get(spec.path.stem) == spec.path else spec.path
    what = f"parameter '{wanted}' is unknown"
    return f"{what}, {meant}crane info {command_words(at)} --names lists all names"


def _warn_of_units(spec: MachineSpec, part: str, values: Mapping[str, float]) -> None:
    """Warn of numbers of the circuit that can be, and hardly are in their SI unit."""
    joint = part.partition(".")[2]
    turning = joint in spec.tree.joints and spec.tree.joints[joint].kind != "prismatic"
    for name, value in values.items():
        if text := doubt(name, value, turning, part.partition(".")[0]):
            what = f"parameter '{part}.{name}' {text}"
            warnings.warn(what, CraneWarning, stacklevel=2)


SPOOL_B = "spool_b"  # second spool of a valve, whose numbers are those of a part of their own
CIRCUIT = {
    "cylinder.": "cylinders", "valve.": "valves", "valve_control.": "control",
    "supply.": "supplies", "line.": "lines", "accumulator.": "accumulators",
    "element.": "elements",
}  # fmt: skip


def circuit_parts(hydraulics: Hydraulics) -> dict[str, Any]:
    """The parts of a circuit by the names that their numbers begin with."""
    return (
        {"supply": hydraulics.supply, "oil": hydraulics.oil}
        | {f"supply.{name}": part for name, part in hydraulics.supplies.items()}
        | ({"engine": hydraulics.engine} if hydraulics.engine is not None else {})
        | {f"line.{name}": part for name, part in hydraulics.lines.items()}
        | {f"accumulator.{name}": part for name, part in hydraulics.accumulators.items()}
        | {f"element.{name}": part for name, part in hydraulics.elements.items()}
        | {f"cylinder.{joint}": part for joint, part in hydraulics.cylinders.items()}
        | {f"valve.{joint}": part for joint, part in hydraulics.valves.items()}
        | {
            f"valve.{x.joint}.{SPOOL_B}": x.spool_b
            for x in hydraulics.valves.values()
            if x.spool_b
        }
        | {f"valve_control.{joint}": part for joint, part in hydraulics.control.items()}
    )


def _circuit(hydraulics: Hydraulics, parts: Mapping[str, Any]) -> Hydraulics:
    """A circuit with these parts in place of its own."""
    parts = dict(parts)
    for joint, valve in hydraulics.valves.items():
        second = parts.pop(f"valve.{joint}.{SPOOL_B}", None)
        if valve.spool_b is not None:
            of = parts[f"valve.{joint}"]
            parts[f"valve.{joint}"] = dataclasses.replace(of, spool_b=second)
    kinds: dict[str, Any] = {
        field: {
            name.removeprefix(kind): part for name, part in parts.items() if name.startswith(kind)
        }
        for kind, field in CIRCUIT.items()
    }
    own: dict[str, Any] = {
        name: parts[name] for name in ("supply", "oil", "engine") if name in parts
    }
    return dataclasses.replace(hydraulics, **own, **kinds)


def locked(spec: MachineSpec, lock: Mapping[str, float]) -> MachineSpec:
    """A machine with some joints fixed.

    What refers to a locked joint, such as its friction, goes with it, and so do tasks of active
    joints if one of them is locked, and what acts between two frames that make one body now.

    Args:
        spec: The machine as read.
        lock: Coordinate [m], [rad] by joint.

    Raises:
        InputError: No such joint, no finite coordinate, one beyond its limits, or the last active
            joint.
    """
    joints = {joint.name: joint for joint in spec.tree.moving}
    held = []
    spec, lock = grounded(spec, lock)
    for name in lock.keys() & joints.keys():
        _check_within(joints[name], lock[name])
    lock, couplings = _coupled(spec.couplings, lock)
    for name, given in lock.items():
        if name not in joints:
            raise InputError(f"joint '{name}' to lock is unknown, {known(joints, name)}")
        held.append(_fixed(joints[name], given))
    active = spec.active and tuple(name for name in spec.active if name not in lock)
    sways = any(name not in lock for name in spec.free)
    if (spec.active and not active and not sways) or not joints.keys() - lock.keys():
        raise InputError(f"with {', '.join(lock)} locked nothing drives the machine, lock less")
    tree = spec.tree.replacing(*held)
    body = tree.bodies()

    spools = spec.hydraulics.spools if spec.hydraulics else {}

    def moves(force: ExternalForce) -> bool:
        return body[force.frame] != body[tree.root]

    def acts(item: Element) -> bool:
        if item.between is None:
            return item.joint not in lock
        return len({body[frame] for frame in item.between}) > 1

    chains = tuple(
        dataclasses.replace(chain, joints=tuple(j for j in chain.joints if j not in lock))
        for chain in spec.chains
    )
    return dataclasses.replace(
        spec,
        tree=tree,
        chains=chains,
        active=active,
        free=tuple(name for name in spec.free if name not in lock),
        drives=_without(spec.drives, lock),
        home={joint: value for joint, value in spec.home.items() if joint not in lock},
        friction={joint: value for joint, value in spec.friction.items() if joint not in lock},
        control={joint: value for joint, value in spec.control.items() if joint not in lock},
        pins={name: value for name, value in spec.pins.items() if name not in lock},
        forces=tuple(filter(acts, spec.forces)),
        external=tuple(filter(moves, spec.external)),
        hydraulics=spec.hydraulics and spec.hydraulics.only(active or ()),
        gas_springs=tuple(filter(acts, spec.gas_springs)),
        ropes=tuple(filter(acts, spec.ropes)),
        end_stops=tuple(item for item in spec.end_stops if item.joint not in lock),
        tasks={
            name: dataclasses.replace(
                task,
                levers={
                    x: lever
                    for x, lever in task.levers.items()
                    if x not in lock and (x not in spools or spools[x].joint not in lock)
                },
                phases=tuple(x for phase in task.phases if (x := phase.without(lock)).levers),
                start={x: value for x, value in task.start.items() if x not in lock},
                loads=tuple(filter(moves, task.loads)),
            )
            for name, task in spec.tasks.items()
            if not (task.space == "active" and lock.keys() & set(task.coordinates))
        },
        couplings=couplings,
    )


def _without(drives: tuple[Drive, ...], lock: Mapping[str, float]) -> tuple[Drive, ...]:
    """Drives of what still moves."""
    rest = (
        dataclasses.replace(
            drive, factors={x: f for x, f in drive.factors.items() if x not in lock}
        )
        for drive in drives
    )
    return tuple(drive for drive in rest if drive.factors)


def driven(
    spec: MachineSpec, active: Sequence[str] | None, free: Sequence[str] | None
) -> MachineSpec:
    """A machine whose drives, or whose free coordinates, are others than its file says.

    Circuits, gains and tasks of joints that are not driven any more go.

    Args:
        spec: The machine as read.
        active: Driven joints, in the order of q_A; None for those of the file.
        free: Coordinates that nothing drives; None for those of the file.

    Raises:
        InputError: No such joint, or one in both.
    """
    names = [joint.name for joint in spec.tree.moving]
    for what, given in (("active", active), ("free", free)):
        for joint in given or ():
            if joint not in names:
                raise InputError(f"{what} joint '{joint}' is unknown, {known(names, joint)}")
            if list(given or ()).count(joint) > 1:
                raise InputError(f"{what} joint '{joint}' is named twice, once will do")
            if joint in (active or ()) and joint in (free or ()):
                raise InputError(f"joint '{joint}' is active and free, keep one of the two")
    undriven = tuple(spec.free if free is None else free)
    if active is None:
        drives = _without(spec.drives, dict.fromkeys(undriven, 0.0))
        now = spec.active and tuple(name for name in spec.active if name not in undriven)
    else:
        drives, now = (), tuple(active)
    undriven = tuple(name for name in undriven if name not in (now or ()))
    kept = names if now is None else now
    same = now == spec.active
    return dataclasses.replace(
        spec,
        active=now,
        free=undriven,
        drives=drives,
        control={x: gains for x, gains in spec.control.items() if x in kept and x not in undriven},
        hydraulics=spec.hydraulics and spec.hydraulics.only(kept),
        tasks={
            name: task
            for name, task in spec.tasks.items()
            if task.space == "tip" or same or not {*task.coordinates, *task.start} - set(kept)
        },
    )


def _lock_followers(couplings: list[Coupling], locked: dict[str, float]) -> bool:
    """Lock joints that couplings leave no freedom, take out these couplings; whether any was."""
    before = len(locked)
    for coupling in tuple(couplings):
        free = {name: x for name, x in coupling.factors.items() if name not in locked}
        held = coupling.factors.keys() - free.keys()
        if len(free) > 1 or not held:
            continue
        couplings.remove(coupling)
        left = coupling.offset - sum(coupling.factors[name] * locked[name] for name in held)
        if not free and abs(left) > 1e-9:
            raise InputError(
                f"coupling '{coupling.name}' does not allow "
                f"{', '.join(f'{x} = {locked[x]:g}' for x in sorted(held))}, lock one of "
                "them alone"
            )
        locked |= {name: left / factor for name, factor in free.items()}
    return len(locked) > before


def _coupled(
    couplings: tuple[Coupling, ...], lock: Mapping[str, float]
) -> tuple[dict[str, float], tuple[Coupling, ...]]:
    """Locks with what couplings make of them, and the couplings of what still moves."""
    locked = {
        name: as_number(x, f"the coordinate to lock '{name}' at", "m or rad", most=FARTHEST)
        for name, x in lock.items()
    }
    rest = list(couplings)
    while _lock_followers(rest, locked):
        pass  # others may follow those
    return locked, tuple(
        dataclasses.replace(
            coupling,
            factors={name: x for name, x in coupling.factors.items() if name not in locked},
            offset=coupling.offset
            - sum(x * locked[name] for name, x in coupling.factors.items() if name in locked),
        )
        for coupling in rest
    )


def _check_within(joint: Joint, given: object) -> None:
    """Raise where a joint cannot be at a coordinate [m], [rad]."""
    value = as_number(
        given, f"the coordinate to lock '{joint.name}' at", "m or rad", most=FARTHEST
    )
    lower, upper = joint.limits.lower, joint.limits.upper
    slack = _SLACK * max(1.0, abs(value))
    if not lower - slack <= value <= upper + slack:
        unit = "m" if joint.kind == "prismatic" else "rad"
        raise InputError(
            f"joint '{joint.name}' cannot be locked at {value:g} {unit}, beyond its limits "
            f"{joint.limits}, give a coordinate within them"
        )


def _fixed(joint: Joint, value: float) -> Joint:
    """A joint fixed where its coordinate has a value."""
    from scipy.spatial.transform import Rotation

    held = dataclasses.replace(joint, kind="fixed", limits=Limits(), rotor_inertia=0.0)
    turn, axis = Rotation.from_euler("xyz", joint.rpy), np.array(joint.axis)
    if joint.kind == "prismatic":
        x, y, z = (np.array(joint.xyz) + turn.apply(value * axis)).tolist()
        return dataclasses.replace(held, xyz=(x, y, z))
    if not value:
        return held
    roll, pitch, yaw = (turn * Rotation.from_rotvec(value * axis)).as_euler("xyz").tolist()
    return dataclasses.replace(held, rpy=(roll, pitch, yaw))


def _set(by_joint: dict, name: str, value: float, default: Callable | None) -> None:
    joint, _, field = name.rpartition(".")
    before = by_joint[joint] if default is None else by_joint.get(joint, default())
    by_joint[joint] = dataclasses.replace(before, **{field: value})


def _load(spec: MachineSpec, tree: Tree, mass: float) -> tuple[Tree, tuple[Chain, ...]]:
    """Fix a payload to the tip: the machine's own, scaled to the mass, or else a point mass.

    Masses and inertias are scaled, places are not: a load of another density.

    Returns:
        The tree with it, and the chains that it is made of now.
    """
    if mass == 0:
        return tree, spec.chains
    if spec.payload is None:
        import pinocchio as pin

        from crane.description.rigid import loaded

        tip = str(spec.tip)
        frame = Link("payload", PAYLOAD), Joint("payload_fixed", "fixed", tip, "payload", PAYLOAD)
        point = pin.Inertia(mass, np.zeros(3), np.zeros((3, 3)))
        return loaded(tree.replacing(*frame), tip, point), spec.chains
    scale = mass / spec.payload.tree.mass
    parts = [
        _scaled(part, scale) if isinstance(part, Link) else part for part in spec.payload.tree
    ]
    return tree.replacing(*parts), (*spec.chains, spec.payload.chain)


def _scaled(link: Link, scale: float) -> Link:
    """A link of another density."""
    if (inertial := link.inertial) is None:
        return link
    tensor = tuple(scale * x for x in inertial.tensor)
    inertial = dataclasses.replace(inertial, mass=scale * inertial.mass, tensor=tensor)
    return dataclasses.replace(link, inertial=inertial)
