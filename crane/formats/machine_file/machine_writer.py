"""A machine file with a URDF per sub-chain."""

import dataclasses
import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lxml import etree

from crane.common.atomic_output import portable_file_name, replace_folder
from crane.common.errors import CraneError, CraneWarning, InputError, OutputError, format_one_line
from crane.description.sensors import quantity_unit
from crane.description.specification import Friction, Task, ViaPoint
from crane.description.task_phases import Phase
from crane.formats.machine_file.circuit_section import MOTOR_KEYS
from crane.formats.machine_file.estimation_section import estimation_data
from crane.formats.machine_file.external_force_sections import external_force_data, load_data
from crane.formats.machine_file.flow_curves import curve_data
from crane.formats.machine_file.machine_reader import read_machine_spec
from crane.formats.machine_file.parameter_locations import (
    MachineFileLocation,
    UrdfLocation,
    parameter_locations,
)
from crane.formats.machine_file.yaml_text import KeyPath, format_yaml
from crane.formats.urdf_output import (
    add_joint,
    add_link,
    compound_drive_factors,
    copy_shapes,
    format_document,
    origin_text,
    rotor_inertias,
    with_floating_joints,
)
from crane.hydraulics import CircuitElement, Cylinder, Hydraulics, Supply, Valve
from crane.hydraulics.circuit_elements import parameter_names
from crane.hydraulics.components import COUNTERBALANCE_KEYS
from crane.machine import Machine


def write_machine(
    machine: Machine,
    folder: str | Path,
    notes: Mapping[str, str] | None = None,
    overwrite: bool = True,
) -> Path:
    """Write a machine as a machine file, with one URDF per sub-chain beside it.

    Args:
        machine: The machine, as it is: with its changes, locks and payload.
        folder: Created where there is none; files of the same names are replaced.
        notes: What is to be said of numbers, by their names, see `crane.description.parameters`:
            comments in the lines where these stand, or at the head of the machine file.
        overwrite: Whether files that are there are replaced; if not, the folder has to be new or
            empty.

    Returns:
        The machine file.

    Raises:
        InputError: A coupling holds a single joint.
        OutputError: The folder cannot be written, or holds what the machine was read from.
    """
    file = f"{portable_file_name(machine.name)}.yaml"
    draft = MachineDraft(machine)
    draft.add_notes(notes or {})
    originals = {machine.path, *(chain.urdf for chain in machine.chains)}
    for relative_path in draft.file_paths(file):
        if (target := (Path(folder) / relative_path).resolve()) in originals:
            raise OutputError(
                f"{target}: is what '{machine.name}' was read from, choose another folder"
            )
    with replace_folder(folder, overwrite) as temporary_folder:
        draft.write(temporary_folder, file)
    return Path(folder) / file


class MachineDraft:
    """A machine as machine file and URDFs that are not written yet.

    Args:
        machine: The machine, as it is: with its changes, locks and payload.
        folder: Of the URDFs, from the machine file's on.

    Attributes:
        data: What the machine file says.
        urdfs: The URDF of each sub-chain.

    Raises:
        InputError: A coupling holds a single joint.
    """

    def __init__(self, machine: Machine, folder: str = ""):
        self._machine, self._chain_division = machine, _ChainDivision(machine)
        self._folder, self._comment = folder, origin_text(machine)
        self.data = _machine_data(machine)
        self.urdfs: dict[str, etree._Element] = {}
        self._line_notes: dict[KeyPath, str] = {}
        self._element_notes: dict[str, list[tuple[etree._Element, str]]] = {}
        self._header_notes: list[str] = []
        for name in self._chain_division.names:
            parent = (
                {"parent": self._chain_division.parent_frames[name]}
                if name in self._chain_division.parent_frames
                else {}
            )
            self.add_chain(name, self._chain_division.chain_urdf(name), parent)
        load = _payload_urdf(machine)
        self._payload_file = None if load is None else (load.name, load.read_bytes())
        if self._payload_file is not None:
            self.data["payload"] = {"urdf": self._path_from_file(self._payload_file[0])}

    def add_notes(self, notes: Mapping[str, str]) -> None:
        """Put words beside numbers; at the head where they do not stand in a line as they are."""
        locations, changes = parameter_locations(self._machine), self._machine.parameter_changes
        notes_by_element: dict[etree._Element, str] = {}
        for name, note in notes.items():
            location = locations.get(name)
            value = changes.get(name, None if location is None else location.value)
            if location is not None and location.value == value:
                if isinstance(location, MachineFileLocation) and self._write_explicitly(
                    location.key_path, location.value
                ):
                    self._line_notes[location.key_path] = note
                    continue
                if (
                    isinstance(location, UrdfLocation)
                    and (element := self._find_element(location)) is not None
                ):
                    named = f"{name}: {note}"
                    notes_by_element[element] = "; ".join(
                        filter(None, (notes_by_element.get(element), named))
                    )
                    continue
            self._header_notes.append(f"{name}{'' if value is None else f' = {value!r}'}: {note}")
        for element, note in notes_by_element.items():
            chain = element.getroottree().getroot().get("name")
            self._element_notes.setdefault(chain, []).append((element, note))

    def _write_explicitly(self, key_path: KeyPath, value: float) -> bool:
        """Write a number that is as by default, too; whether there is a place for it."""
        parent: Any = self.data
        for key in key_path[:-1]:
            if not isinstance(key, int) and key not in parent:
                return False
            parent = parent[key]
        circuit = self._machine.hydraulics
        is_valve_value = key_path[:2] == ("hydraulics", "valves") and len(key_path) == 4
        if circuit is not None and is_valve_value and key_path[-1] not in parent:
            valve_data = _valve_data(circuit.valves[str(key_path[2])], allow_flow=False)
            parent.clear()
            parent.update(valve_data)
        return bool(parent.setdefault(key_path[-1], value) == value)

    def _find_element(self, location: UrdfLocation) -> etree._Element | None:
        """Of a URDF, None where it has none of that name."""
        for owner in self.urdf_of_link(location.link).iterfind(location.element_type):
            if owner.get("name") == location.owner:
                return owner.find(location.path)
        return None

    def add_chain(self, name: str, robot: etree._Element, extra_data: Mapping[str, str]) -> None:
        """Append a sub-chain; `extra_data` is what its entry says beside its name and file."""
        self.urdfs[name] = robot
        file = self._path_from_file(f"{len(self.urdfs)}_{portable_file_name(name)}.urdf")
        self.data["chains"].append({"name": name, "urdf": file, **extra_data})

    def urdf_of_link(self, link: str) -> etree._Element:
        """The URDF that a link is in."""
        return self.urdfs[self._chain_division.chain_of[link]]

    def file_paths(self, file: str) -> list[str]:
        """Paths of all files from the folder on, that of the machine file first."""
        urdfs = [chain["urdf"] for chain in self.data["chains"]]
        return [file, *urdfs, *([self.data["payload"]["urdf"]] if self._payload_file else [])]

    def write(self, folder: Path, file: str) -> None:
        """Write all into a folder, the machine file by this name."""
        (folder / self._folder).mkdir(exist_ok=True)
        for chain in self.data["chains"]:
            name = chain["name"]
            content = format_document(
                self.urdfs[name], self._comment, self._element_notes.get(name, ())
            )
            (folder / chain["urdf"]).write_bytes(content)
        if self._payload_file is not None:
            (folder / self.data["payload"]["urdf"]).write_bytes(self._payload_file[1])
        nonempty = {key: value for key, value in self.data.items() if value not in (None, [], {})}
        header = "".join(f"# {format_one_line(line)}\n" for line in self._header_notes)
        (folder / file).write_text(
            header + format_yaml(nonempty, self._line_notes), encoding="utf-8"
        )

    def _path_from_file(self, file: str) -> str:
        return f"{self._folder}/{file}" if self._folder else file


class _ChainDivision:
    """The sub-chains, cut at their attachments again.

    Args:
        machine: The machine.
    """

    def __init__(self, machine: Machine):
        self.machine, self.tree = machine, with_floating_joints(machine)
        self.chains = [chain for chain in machine.chains if chain.name != "payload"]
        self.names = [chain.name for chain in self.chains]
        self.parent_frames = {chain.name: str(chain.parent) for chain in self.chains[1:]}
        self._chain_of_attachment = {
            chain.attachment_name: chain.name for chain in self.chains[1:]
        }
        root = self.tree.root_link
        self.chain_of = {root: self.names[0]}
        joints_by_parent, pending = self.tree.joints_by_parent(), [root]
        while pending:
            link = pending.pop()
            for joint in joints_by_parent.get(link, ()):
                chain_name = self._chain_of_attachment.get(joint.name, self.chain_of[link])
                self.chain_of[joint.child] = chain_name
                pending.append(joint.child)

    def chain_urdf(self, chain: str) -> etree._Element:
        """The URDF of a sub-chain."""
        robot = etree.Element("robot", name=chain)
        for link in self.tree.links.values():
            if self.chain_of[link.name] == chain:
                add_link(robot, link)
        for joint in self.tree.joints.values():
            if self.chain_of[joint.child] == chain and joint.name not in self._chain_of_attachment:
                add_joint(robot, joint)
        copy_shapes(robot, self.machine, [chain])
        return robot


def _machine_data(machine: Machine) -> dict[str, Any]:
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
    data["active"] = _active_data(machine)
    data["free"] = list(machine.free)
    data["home"] = dict(zip(machine.joints, machine.home.tolist(), strict=True))
    data["friction"] = {joint: friction_data(law) for joint, law in machine.friction.items()}
    data["forces"] = [_nondefault_values(item) for item in machine.forces]
    data["gas_springs"] = {
        item.joint: _nondefault_values(item, "joint") for item in machine.gas_springs
    }
    data["ropes"] = [_nondefault_values(item) for item in machine.ropes]
    data |= external_force_data(machine.external_forces)
    data["supports"] = list(machine.supports)
    data["pins"] = dict(machine.pin_capacities)
    data["end_stops"] = {
        item.joint: _nondefault_values(item, "joint") for item in machine.end_stops
    }
    data["rotor_inertia"] = rotor_inertias(machine)
    data["drives"] = compound_drive_factors(machine)
    data["tip"] = machine.tip
    data["tasks"] = {name: _task_data(task) for name, task in machine.tasks.items()}
    data["control"] = {
        joint: _nondefault_values(gains) for joint, gains in machine.control.items()
    }
    data["identification"] = estimation_data(machine)
    if machine.hydraulics is not None:
        data["hydraulics"] = _hydraulics_data(machine.hydraulics)
    data["sensors"] = {
        name: _nondefault_values(sensor) or {"zero": 0.0}
        for name, sensor in machine.sensors.items()
        if quantity_unit(machine.tree, name) is not None  # a joint that is locked has none
    }
    return data


def _active_data(machine: Machine) -> list[str]:
    """Joints under `active`: drives in surplus are among them."""
    if machine.explicit_drives and all(
        list(x.factors.values()) == [1.0] for x in machine.explicit_drives
    ):
        return [joint for motor in machine.explicit_drives for joint in motor.factors]
    return list(machine.driven_joints)


def _nondefault_values(item: Any, *excluded: str) -> dict[str, Any]:
    """What of a dataclass is not as by default."""
    return {
        field.name: getattr(item, field.name)
        for field in dataclasses.fields(item)
        if field.name not in excluded and getattr(item, field.name) != field.default
    }


def friction_data(law: Friction) -> dict[str, Any]:
    """What a machine file says of friction; that it drives was told where it comes from."""
    return (_nondefault_values(law) or {"viscous": 0.0}) | (
        {"drives": True} if law.is_driving else {}
    )


def _task_data(task: Task) -> dict[str, Any]:
    data: dict[str, Any] = {"description": task.description} if task.description else {}
    if not task.phases:
        data["duration"] = task.duration
    if task.loads:
        data["loads"] = [load_data(load) for load in task.loads]
    if task.space == "joystick":
        lever_data = {
            joint: [x for point in polygon for x in point]
            for joint, polygon in task.levers.items()
        }
        start = {"start": dict(task.start)} if task.start else {}
        if task.phases:
            return (
                data | {"phases": [_phase_data(x) for x in task.phases], "ramp": task.ramp} | start
            )
        return data | {"joystick": lever_data} | start
    if task.via:
        del data["duration"]
        return data | {"via": [_via_data(via) for via in task.via]}
    return data | {task.space: {key: list(row) for key, row in task.coefficients.items()}}


def _phase_data(phase: Phase) -> dict[str, Any]:
    data = {"name": phase.name, "levers": dict(phase.levers), "until": dict(phase.until)}
    return data | {"within": phase.within}


def _via_data(via: ViaPoint) -> dict[str, Any]:
    rates = {"rates": dict(via.rates)} if via.rates else {}
    return {"time": via.time, **via.point, **rates}


def _hydraulics_data(circuit: Hydraulics) -> dict[str, Any]:
    data = {
        "supply": _supply_data(circuit.supply) | {"tank": circuit.supply.tank},
        "oil": _all_values(circuit.oil),
        "cylinders": {joint: _cylinder_data(item) for joint, item in circuit.cylinders.items()},
        "valves": {joint: _valve_data(valve) for joint, valve in circuit.valves.items()},
    }
    motors = [joint for joint, item in circuit.cylinders.items() if item.motor]
    if motors:
        data["motors"] = {x: _motor_data(x, data["cylinders"].pop(x)) for x in motors}
    if circuit.engine is not None:
        data["engine"] = _all_values(circuit.engine)
    data |= {
        key: found
        for key, found in {
            "supplies": {x: _supply_data(part) for x, part in circuit.supplies.items()},
            "lines": {x: _all_values(part) for x, part in circuit.lines.items()},
            "accumulators": {x: _all_values(part) for x, part in circuit.accumulators.items()},
            "elements": {x: _element_data(part) for x, part in circuit.elements.items()},
        }.items()
        if found
    }
    if circuit.control:
        data["control"] = {joint: _all_values(gains) for joint, gains in circuit.control.items()}
    return data


def _all_values(part: Any) -> dict[str, Any]:
    return {name: getattr(part, name) for name in parameter_names(type(part))}


def _supply_data(supply: Supply) -> dict[str, Any]:
    data = _all_values(supply)
    del data["tank"]
    if supply.control != "pressure":
        data["control"] = supply.control
    return data | ({"summed": list(supply.summed)} if supply.summed else {})


def _element_data(element: CircuitElement) -> dict[str, Any]:
    data: dict[str, Any] = {"type": element.kind, "from": element.source, "to": element.target}
    data |= _all_values(element)
    return data | ({"joints": [*element.joints], "side": element.side} if element.joints else {})


def _motor_data(joint: str, cylinder: dict[str, Any]) -> dict[str, Any]:
    """A motor from what it is as a cylinder."""
    motor_values = {"displacement": cylinder["area_a"], "volume": cylinder["hose_a"]}
    motor_values |= {key: cylinder[name] for key, name in MOTOR_KEYS.items() if name is not None}
    defaults = _all_values(
        Cylinder(joint, *2 * [motor_values["displacement"]], *2 * [motor_values["volume"]])
    )
    defaults["count"] = 1
    for name in cylinder.keys() - motor_values.keys():
        if cylinder[name] != defaults[name]:
            raise InputError(
                f"{name} of the motor of '{joint}' is {cylinder[name]:g}, which a machine file "
                f"has no motor with, leave it at {defaults[name]:g}"
            )
    return motor_values


def _cylinder_data(cylinder: Cylinder) -> dict[str, Any]:
    counterbalance_valves = {
        key: getattr(cylinder, key)
        for key in COUNTERBALANCE_KEYS
        if getattr(cylinder, key) is not None
    }
    data = _all_values(cylinder) | {
        key: _all_values(valve) for key, valve in counterbalance_valves.items()
    }
    return data | ({"count": cylinder.count} if cylinder.count > 1 else {})


def _valve_data(valve: Valve, allow_flow: bool = True) -> dict[str, Any]:
    edges = ("c1", "c2", "c3", "c4")
    other_values = {
        name: getattr(valve, name)
        for name in parameter_names(Valve)
        if name not in (*edges, "margin")
    }
    orifice_values: dict[str, Any] = {name: getattr(valve, name) for name in edges}
    defaults = Valve(valve.joint, 1.0, 1.0, 1.0, 1.0)
    for name in ("supply", "return_a", "return_b"):
        if getattr(valve, name) != getattr(defaults, name):
            other_values[name] = getattr(valve, name)
    if valve.priority:
        other_values["priority"] = True
    if valve.spool_b:
        other_values["spool_b"] = _all_values(valve.spool_b)
    for name, curve in valve.curves.items():
        target = other_values if name == "centre" else orifice_values
        target[name] = curve_data(getattr(valve, name), curve)
    if not valve.margin:
        return {
            "type": "sharing" if valve.sharing else "orifice",
            **orifice_values,
            **other_values,
        }
    allow_flow = allow_flow and not valve.curves.keys() & {*edges}
    flow = _exact_flow(valve) if allow_flow else None
    size_values = orifice_values if flow is None else {"flow": flow, "meter_out": valve.c2}
    return {"type": "compensated", "margin": valve.margin, **size_values, **other_values}


def _exact_flow(valve: Valve) -> float | None:
    """The flow at full stroke that a compensated valve is read from to the last bit, if one is."""
    if (valve.c1, valve.c2) != (valve.c4, valve.c3):
        return None
    root = math.sqrt(valve.margin)
    estimate = valve.c1 * root
    candidates = (estimate, math.nextafter(estimate, 0.0), math.nextafter(estimate, math.inf))
    return next((flow for flow in candidates if flow / root == valve.c1), None)


def _payload_urdf(machine: Machine) -> Path | None:
    """The file of the load that the machine can carry, None where there is none, or it does."""
    if (
        machine.path.suffix.lower() not in (".yaml", ".yml")
        or "payload.mass" in machine.parameter_changes
    ):
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CraneWarning)
            load = read_machine_spec(machine.path).payload
    except CraneError:  # its files are gone
        return None
    return None if load is None else load.chain.urdf
