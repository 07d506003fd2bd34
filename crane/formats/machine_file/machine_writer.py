"""A machine file with a URDF per sub-chain."""

import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lxml import etree

from crane.common.atomic_output import portable_file_name, replace_folder
from crane.common.errors import CraneError, CraneWarning, InputError, OutputError, format_one_line
from crane.description.circuit_schema import (
    BORE_KEYS,
    CYLINDER,
    HYDRAULICS,
    MOTOR,
    ORIFICE_KEYS,
    SPOOL,
    VALVE,
)
from crane.description.force_elements import Friction
from crane.description.key_types import REQUIRED
from crane.description.machine_schema import (
    COUPLING,
    FRICTION,
    LOOP,
    MACHINE,
    SENSOR,
    TASK,
    VIA_POINT,
)
from crane.description.sensors import quantity_unit
from crane.description.specification import Task
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
from crane.formats.urdf.urdf_writer import (
    compound_drive_factors,
    copy_shapes,
    format_document,
    origin_text,
    rotor_inertias,
    with_floating_joints,
)
from crane.formats.xml_file import add_joint, add_link
from crane.hydraulics.components import Cylinder, Valve
from crane.hydraulics.hydraulic_circuit import Hydraulics
from crane.machine.machine import Machine


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
        if circuit is not None and key_path[-1] in ORIFICE_KEYS and "flow" in parent:
            del parent["flow"], parent["meter_out"]
            valve = circuit.valves[str(key_path[2])]
            parent.update({key: getattr(valve, key) for key in ORIFICE_KEYS})
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
        circuit = nonempty.get("hydraulics", {})
        if not circuit.get("oil", True):
            nonempty["hydraulics"] = {k: value for k, value in circuit.items() if k != "oil"}
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
    """The machine file, with empty chains and without payload."""
    equations = machine.closure.equations
    for coupling in equations.couplings:
        if len(coupling.factors) < 2:
            raise InputError(
                f"coupling '{coupling.name}' holds {next(iter(coupling.factors))} alone, lock "
                "that joint instead"
            )
    data: dict[str, Any] = {
        "chains": [],
        "loops": [
            LOOP.values_of(loop) | {"axis": [float(x) for x in loop.axis]}
            for loop in equations.loops
        ],
        "couplings": [COUPLING.values_of(coupling) for coupling in equations.couplings],
        "active": _active_data(machine),
        "drives": compound_drive_factors(machine),
        "home": dict(zip(machine.joints, machine.home.tolist(), strict=True)),
        "friction": {joint: friction_data(law) for joint, law in machine.friction.items()},
        **external_force_data(machine.external_forces),
        "rotor_inertia": rotor_inertias(machine),
        "payload": None,
        "tasks": {name: _task_data(task) for name, task in machine.tasks.items()},
        "hydraulics": machine.hydraulics and _hydraulics_data(machine.hydraulics),
        "sensors": {
            name: SENSOR.values_of(sensor) or {"zero": 0.0}
            for name, sensor in machine.sensors.items()
            if quantity_unit(machine.tree, name) is not None  # a joint that is locked has none
        },
        "identification": estimation_data(machine),
    }
    data |= MACHINE.values_of(machine, *data)
    return {key: data[key] for key in MACHINE.keys if key in data}


def _active_data(machine: Machine) -> list[str]:
    """Joints under `active`: drives in surplus are among them."""
    if machine.explicit_drives and all(
        list(x.factors.values()) == [1.0] for x in machine.explicit_drives
    ):
        return [joint for motor in machine.explicit_drives for joint in motor.factors]
    return list(machine.driven_joints)


def friction_data(law: Friction) -> dict[str, Any]:
    """The keys of a friction law in a machine file."""
    return FRICTION.values_of(law) or {"viscous": 0.0}


def _task_data(task: Task) -> dict[str, Any]:
    data = TASK.values_of(task, "via", "loads")
    if task.via or task.phases:
        del data["duration"]
    if task.loads:
        data["loads"] = [load_data(load) for load in task.loads]
    if task.via:
        data["via"] = [VIA_POINT.values_of(via) | dict(via.point) for via in task.via]
    elif task.coefficients:
        data[task.space] = {key: list(row) for key, row in task.coefficients.items()}
    elif not task.phases:
        data["joystick"] = {
            joint: [x for point in polygon for x in point]
            for joint, polygon in task.levers.items()
        }
    return data


def _hydraulics_data(circuit: Hydraulics) -> dict[str, Any]:
    drives: dict[str, dict[str, Any]] = {"cylinders": {}, "motors": {}}
    for joint, item in circuit.cylinders.items():
        if item.motor:
            drives["motors"][joint] = _motor_data(item)
        else:
            drives["cylinders"][joint] = CYLINDER.values_of(item, *BORE_KEYS)
    data = HYDRAULICS.values_of(circuit, "cylinders", "valves") | {
        **{key: value for key, value in drives.items() if value},
        "valves": {joint: _valve_data(valve) for joint, valve in circuit.valves.items()},
    }
    return {key: data[key] for key in HYDRAULICS.keys if key in data}


def _motor_data(motor: Cylinder) -> dict[str, Any]:
    """A motor from its values as a cylinder."""
    expected = {"area_b": motor.area_a, "hose_b": motor.hose_a}
    expected |= {
        name: key.default
        for name, key in CYLINDER.keys.items()
        if name not in {*MOTOR.keys, *BORE_KEYS} and key.default not in (REQUIRED, None)
    }
    for name, value in expected.items():
        if getattr(motor, name) != value:
            raise InputError(
                f"{name} of the motor of '{motor.joint}' is {getattr(motor, name):g}, which a "
                f"machine file has no motor with, leave it at {value:g}"
            )
    size = {"displacement": motor.area_a, "volume": motor.hose_a}
    return size | MOTOR.values_of(motor, "displacement", "gear", "volume")


def _valve_data(valve: Valve) -> dict[str, Any]:
    values = VALVE.values_of(valve, "margin", "spool_b")
    if valve.spool_b:
        values["spool_b"] = {name: getattr(valve.spool_b, name) for name in SPOOL.keys}
    for name, curve in valve.curves.items():
        values[name] = curve_data(getattr(valve, name), curve)
    if not valve.margin:
        return {"type": "sharing" if valve.sharing else "orifice"} | values
    flow = None if valve.curves.keys() & {*ORIFICE_KEYS} else _exact_flow(valve)
    size = {"type": "compensated", "margin": valve.margin}
    if flow is not None:
        size |= {"flow": flow, "meter_out": valve.c2}
        values = {name: value for name, value in values.items() if name not in ORIFICE_KEYS}
    return size | values


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
