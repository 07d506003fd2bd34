"""A machine file with a URDF per sub-chain."""

import dataclasses
import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lxml import etree

from crane.common.errors import CraneError, CraneWarning, InputError, OutputError, one_line
from crane.common.output import file_name, staging
from crane.description.phases import Phase
from crane.description.sensors import unit_of
from crane.description.spec import Friction, Task, Via
from crane.formats.machine_file.circuit import MOTOR
from crane.formats.machine_file.curves import curve_data
from crane.formats.machine_file.estimation import estimation_data
from crane.formats.machine_file.outside import load_data, outside_data
from crane.formats.machine_file.places import InFile, InURDF, places
from crane.formats.machine_file.read import read
from crane.formats.machine_file.text import Way, yaml_text
from crane.formats.parts import (
    add_joint,
    add_link,
    draw,
    drives_of,
    finished,
    origin_of,
    rotors_of,
    with_whole_flyers,
)
from crane.hydraulics import Cylinder, Element, Hydraulics, Supply, Valve
from crane.hydraulics.components import HOLDING
from crane.hydraulics.numbers import number_names
from crane.machine import Machine


def write_machine(
    machine: Machine,
    folder: str | Path,
    notes: Mapping[str, str] | None = None,
    force: bool = True,
) -> Path:
    """Write a machine as a machine file, with one URDF per sub-chain beside it.

    Args:
        machine: The machine, as it is: with its changes, locks and payload.
        folder: Created where there is none; files of the same names are replaced.
        notes: What is to be said of numbers, by their names, see `crane.description.parameters`:
            comments in the lines where these stand, or at the head of the machine file.
        force: Whether files that are there are replaced; if not, the folder has to be new or
            empty.

    Returns:
        The machine file.

    Raises:
        InputError: A coupling holds a single joint.
        OutputError: The folder cannot be written, or holds what the machine was read from.
    """
    file = f"{file_name(machine.name)}.yaml"
    draft = Draft(machine)
    draft.note(notes or {})
    originals = {machine.path, *(chain.urdf for chain in machine.chains)}
    for written in draft.files(file):
        if (place := (Path(folder) / written).resolve()) in originals:
            raise OutputError(
                f"{place}: is what '{machine.name}' was read from, choose another folder"
            )
    with staging(folder, force) as part:
        draft.write(part, file)
    return Path(folder) / file


class Draft:
    """A machine as machine file and URDFs that are not written yet.

    Args:
        machine: The machine, as it is: with its changes, locks and payload.
        folder: Of the URDFs, from the machine file's on.

    Attributes:
        data: What the machine file says.
        robots: The URDF of each sub-chain.

    Raises:
        InputError: A coupling holds a single joint.
    """

    def __init__(self, machine: Machine, folder: str = ""):
        self._machine, self._chains = machine, _Chains(machine)
        self._folder, self._comment = folder, origin_of(machine)
        self.data = _content(machine)
        self.robots: dict[str, etree._Element] = {}
        self._lines: dict[Way, str] = {}
        self._beside: dict[str, list[tuple[etree._Element, str]]] = {}
        self._head: list[str] = []
        for name in self._chains.names:
            parent = {"parent": self._chains.parents[name]} if name in self._chains.parents else {}
            self.add_chain(name, self._chains.robot(name), parent)
        load = _payload(machine)
        self._load = None if load is None else (load.name, load.read_bytes())
        if self._load is not None:
            self.data["payload"] = {"urdf": self._inside(self._load[0])}

    def note(self, notes: Mapping[str, str]) -> None:
        """Put words beside numbers; at the head where they do not stand in a line as they are."""
        where, changes = places(self._machine), self._machine.changes
        beside: dict[etree._Element, str] = {}
        for name, words in notes.items():
            place = where.get(name)
            value = changes.get(name, None if place is None else place.value)
            if place is not None and place.value == value:
                if isinstance(place, InFile) and self._put(place.way, place.value):
                    self._lines[place.way] = words
                    continue
                if isinstance(place, InURDF) and (element := self._element(place)) is not None:
                    named = f"{name}: {words}"
                    beside[element] = "; ".join(filter(None, (beside.get(element), named)))
                    continue
            self._head.append(f"{name}{'' if value is None else f' = {value!r}'}: {words}")
        for element, words in beside.items():
            chain = element.getroottree().getroot().get("name")
            self._beside.setdefault(chain, []).append((element, words))

    def _put(self, way: Way, value: float) -> bool:
        """Write a number that is as by default, too; whether there is a place for it."""
        parent: Any = self.data
        for key in way[:-1]:
            if not isinstance(key, int) and key not in parent:
                return False
            parent = parent[key]
        circuit = self._machine.hydraulics
        valves = way[:2] == ("hydraulics", "valves") and len(way) == 4
        if circuit is not None and valves and way[-1] not in parent:
            edges = _valve(circuit.valves[str(way[2])], by_flow=False)
            parent.clear()
            parent.update(edges)
        return bool(parent.setdefault(way[-1], value) == value)

    def _element(self, place: InURDF) -> etree._Element | None:
        """Of a URDF, None where it has none of that name."""
        for owner in self.robot_of(place.link).iterfind(place.kind):
            if owner.get("name") == place.owner:
                return owner.find(place.path)
        return None

    def add_chain(self, name: str, robot: etree._Element, more: Mapping[str, str]) -> None:
        """Append a sub-chain; `more` is what its entry says beside its name and file."""
        self.robots[name] = robot
        file = self._inside(f"{len(self.robots)}_{file_name(name)}.urdf")
        self.data["chains"].append({"name": name, "urdf": file, **more})

    def robot_of(self, link: str) -> etree._Element:
        """The URDF that a link is in."""
        return self.robots[self._chains.chain_of[link]]

    def files(self, file: str) -> list[str]:
        """Paths of all files from the folder on, that of the machine file first."""
        urdfs = [chain["urdf"] for chain in self.data["chains"]]
        return [file, *urdfs, *([self.data["payload"]["urdf"]] if self._load else [])]

    def write(self, folder: Path, file: str) -> None:
        """Write all into a folder, the machine file by this name."""
        (folder / self._folder).mkdir(exist_ok=True)
        for chain in self.data["chains"]:
            name = chain["name"]
            content = finished(self.robots[name], self._comment, self._beside.get(name, ()))
            (folder / chain["urdf"]).write_bytes(content)
        if self._load is not None:
            (folder / self.data["payload"]["urdf"]).write_bytes(self._load[1])
        kept = {key: value for key, value in self.data.items() if value not in (None, [], {})}
        head = "".join(f"# {one_line(line)}\n" for line in self._head)
        (folder / file).write_text(head + yaml_text(kept, self._lines), encoding="utf-8")

    def _inside(self, file: str) -> str:
        return f"{self._folder}/{file}" if self._folder else file


class _Chains:
    """The sub-chains, cut at their attachments again.

    Args:
        machine: The machine.
    """

    def __init__(self, machine: Machine):
        self.machine, self.tree = machine, with_whole_flyers(machine)
        self.chains = [chain for chain in machine.chains if chain.name != "payload"]
        self.names = [chain.name for chain in self.chains]
        self.parents = {chain.name: str(chain.parent) for chain in self.chains[1:]}
        self._attached = {chain.attachment: chain.name for chain in self.chains[1:]}
        root = self.tree.root
        self.chain_of = {root: self.names[0]}
        below, waiting = self.tree.below(), [root]
        while waiting:
            link = waiting.pop()
            for joint in below.get(link, ()):
                within = self._attached.get(joint.name, self.chain_of[link])
                self.chain_of[joint.child] = within
                waiting.append(joint.child)

    def robot(self, chain: str) -> etree._Element:
        """The URDF of a sub-chain."""
        robot = etree.Element("robot", name=chain)
        for link in self.tree.links.values():
            if self.chain_of[link.name] == chain:
                add_link(robot, link)
        for joint in self.tree.joints.values():
            if self.chain_of[joint.child] == chain and joint.name not in self._attached:
                add_joint(robot, joint)
        draw(robot, self.machine, [chain])
        return robot


def _content(machine: Machine) -> dict[str, Any]:
    """The machine file, without chains and payload."""
    data: dict[str, Any] = {"name": machine.name}
    if machine.source:
        data["source"] = machine.source
    data["chains"] = []
    equations = machine.closure.equations
    data["loops"] = [
        {
            "name": loop.name, "type": loop.type, "predecessor": loop.predecessor,
            "successor": loop.successor, "axis": [float(x) for x in loop.axis],
        }
        for loop in equations.loops
    ]  # fmt: skip
    data["couplings"] = []
    for coupling in equations.couplings:
        if len(coupling.factors) < 2:
            raise InputError(
                f"coupling '{coupling.name}' holds {next(iter(coupling.factors))} alone, lock "
                "that joint instead"
            )
        item = {"name": coupling.name, "joints": dict(coupling.factors)}
        data["couplings"].append(item | ({"offset": coupling.offset} if coupling.offset else {}))
    data["active"] = _driven(machine)
    data["free"] = list(machine.free)
    data["home"] = dict(zip(machine.joints, machine.home.tolist(), strict=True))
    data["friction"] = {joint: friction_data(law) for joint, law in machine.friction.items()}
    data["forces"] = [_numbers(item) for item in machine.forces]
    data["gas_springs"] = {item.joint: _numbers(item, "joint") for item in machine.gas_springs}
    data["ropes"] = [_numbers(item) for item in machine.ropes]
    data |= outside_data(machine.external)
    data["supports"] = list(machine.supports)
    data["pins"] = dict(machine.pins)
    data["end_stops"] = {item.joint: _numbers(item, "joint") for item in machine.end_stops}
    data["rotor_inertia"] = rotors_of(machine)
    data["drives"] = drives_of(machine)
    data["tip"] = machine.tip
    data["tasks"] = {name: _task(task) for name, task in machine.tasks.items()}
    data["control"] = {joint: _numbers(gains) for joint, gains in machine.control.items()}
    data["identification"] = estimation_data(machine)
    if machine.hydraulics is not None:
        data["hydraulics"] = _hydraulics(machine.hydraulics)
    data["sensors"] = {
        name: _numbers(sensor) or {"zero": 0.0}
        for name, sensor in machine.sensors.items()
        if unit_of(machine.tree, name) is not None  # a joint that is locked has none
    }
    return data


def _driven(machine: Machine) -> list[str]:
    """Joints under `active`: drives in surplus are among them."""
    if machine.motors and all(list(x.factors.values()) == [1.0] for x in machine.motors):
        return [joint for motor in machine.motors for joint in motor.factors]
    return list(machine.driven_joints)


def _numbers(item: Any, *without: str) -> dict[str, Any]:
    """What of a dataclass is not as by default."""
    return {
        field.name: getattr(item, field.name)
        for field in dataclasses.fields(item)
        if field.name not in without and getattr(item, field.name) != field.default
    }


def friction_data(law: Friction) -> dict[str, Any]:
    """What a machine file says of friction; that it drives was told where it comes from."""
    return (_numbers(law) or {"viscous": 0.0}) | ({"drives": True} if law.drives else {})


def _task(task: Task) -> dict[str, Any]:
    data: dict[str, Any] = {"description": task.description} if task.description else {}
    if not task.phases:
        data["duration"] = task.duration
    if task.loads:
        data["loads"] = [load_data(load) for load in task.loads]
    if task.space == "joystick":
        levers = {
            joint: [x for point in polygon for x in point]
            for joint, polygon in task.levers.items()
        }
        start = {"start": dict(task.start)} if task.start else {}
        if task.phases:
            return data | {"phases": [_phase(x) for x in task.phases], "ramp": task.ramp} | start
        return data | {"joystick": levers} | start
    if task.via:
        del data["duration"]
        return data | {"via": [_via(via) for via in task.via]}
    return data | {task.space: {key: list(row) for key, row in task.coefficients.items()}}


def _phase(phase: Phase) -> dict[str, Any]:
    data = {"name": phase.name, "levers": dict(phase.levers), "until": dict(phase.until)}
    return data | {"within": phase.within}


def _via(via: Via) -> dict[str, Any]:
    rates = {"rates": dict(via.rates)} if via.rates else {}
    return {"time": via.time, **via.point, **rates}


def _hydraulics(circuit: Hydraulics) -> dict[str, Any]:
    data = {
        "supply": _supply(circuit.supply) | {"tank": circuit.supply.tank},
        "oil": _all_numbers(circuit.oil),
        "cylinders": {joint: _cylinder(item) for joint, item in circuit.cylinders.items()},
        "valves": {joint: _valve(valve) for joint, valve in circuit.valves.items()},
    }
    motors = [joint for joint, item in circuit.cylinders.items() if item.motor]
    if motors:
        data["motors"] = {x: _motor(x, data["cylinders"].pop(x)) for x in motors}
    if circuit.engine is not None:
        data["engine"] = _all_numbers(circuit.engine)
    data |= {
        key: found
        for key, found in {
            "supplies": {x: _supply(part) for x, part in circuit.supplies.items()},
            "lines": {x: _all_numbers(part) for x, part in circuit.lines.items()},
            "accumulators": {x: _all_numbers(part) for x, part in circuit.accumulators.items()},
            "elements": {x: _element(part) for x, part in circuit.elements.items()},
        }.items()
        if found
    }
    if circuit.control:
        data["control"] = {joint: _all_numbers(gains) for joint, gains in circuit.control.items()}
    return data


def _all_numbers(part: Any) -> dict[str, Any]:
    return {name: getattr(part, name) for name in number_names(type(part))}


def _supply(supply: Supply) -> dict[str, Any]:
    data = _all_numbers(supply)
    del data["tank"]
    if supply.control != "pressure":
        data["control"] = supply.control
    return data | ({"summed": list(supply.summed)} if supply.summed else {})


def _element(element: Element) -> dict[str, Any]:
    data: dict[str, Any] = {"type": element.kind, "from": element.source, "to": element.target}
    data |= _all_numbers(element)
    return data | ({"joints": [*element.joints], "side": element.side} if element.joints else {})


def _motor(joint: str, cylinder: dict[str, Any]) -> dict[str, Any]:
    """A motor from what it is as a cylinder."""
    own = {"displacement": cylinder["area_a"], "volume": cylinder["hose_a"]}
    own |= {key: cylinder[name] for key, name in MOTOR.items() if name is not None}
    usual = _all_numbers(Cylinder(joint, *2 * [own["displacement"]], *2 * [own["volume"]]))
    usual["count"] = 1
    for name in cylinder.keys() - own.keys():
        if cylinder[name] != usual[name]:
            raise InputError(
                f"{name} of the motor of '{joint}' is {cylinder[name]:g}, which a machine file "
                f"has no motor with, leave it at {usual[name]:g}"
            )
    return own


def _cylinder(cylinder: Cylinder) -> dict[str, Any]:
    fitted = {key: getattr(cylinder, key) for key in HOLDING if getattr(cylinder, key) is not None}
    data = _all_numbers(cylinder) | {key: _all_numbers(valve) for key, valve in fitted.items()}
    return data | ({"count": cylinder.count} if cylinder.count > 1 else {})


def _valve(valve: Valve, by_flow: bool = True) -> dict[str, Any]:
    edges = ("c1", "c2", "c3", "c4")
    rest = {
        name: getattr(valve, name)
        for name in number_names(Valve)
        if name not in (*edges, "margin")
    }
    every: dict[str, Any] = {name: getattr(valve, name) for name in edges}
    usual = Valve(valve.joint, 1.0, 1.0, 1.0, 1.0)
    for name in ("supply", "return_a", "return_b"):
        if getattr(valve, name) != getattr(usual, name):
            rest[name] = getattr(valve, name)
    if valve.priority:
        rest["priority"] = True
    if valve.spool_b:
        rest["spool_b"] = _all_numbers(valve.spool_b)
    for name, curve in valve.curves.items():
        of = rest if name == "centre" else every
        of[name] = curve_data(getattr(valve, name), curve)
    if not valve.margin:
        return {"type": "sharing" if valve.sharing else "orifice", **every, **rest}
    by_flow = by_flow and not valve.curves.keys() & {*edges}
    flow = _flow(valve) if by_flow else None
    given = every if flow is None else {"flow": flow, "meter_out": valve.c2}
    return {"type": "compensated", "margin": valve.margin, **given, **rest}


def _flow(valve: Valve) -> float | None:
    """The flow at full stroke that a compensated valve is read from to the last bit, if one is."""
    if (valve.c1, valve.c2) != (valve.c4, valve.c3):
        return None
    root = math.sqrt(valve.margin)
    near = valve.c1 * root
    around = (near, math.nextafter(near, 0.0), math.nextafter(near, math.inf))
    return next((flow for flow in around if flow / root == valve.c1), None)


def _payload(machine: Machine) -> Path | None:
    """The file of the load that the machine can carry, None where there is none, or it does."""
    if machine.path.suffix.lower() not in (".yaml", ".yml") or "payload.mass" in machine.changes:
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CraneWarning)
            load = read(machine.path).payload
    except CraneError:  # its files are gone
        return None
    return None if load is None else load.chain.urdf
