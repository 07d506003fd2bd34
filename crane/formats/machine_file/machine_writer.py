"""A machine file with a URDF per sub-chain."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from lxml import etree

from crane.common.atomic_output import portable_file_name, replace_folder
from crane.common.errors import (
    CraneError,
    InputError,
    OutputError,
    format_one_line,
    ignore_warnings,
)
from crane.common.unit_conversions import KeyPath
from crane.description.force_elements import Friction
from crane.description.kinematic_tree import path_to_root
from crane.description.machine_parameters import FieldPath, parameter_paths, value_at
from crane.description.machine_schema import (
    COUPLING,
    FRICTION,
    LOOP,
    MACHINE,
    SENSOR,
    TASK,
    VIA_POINT,
)
from crane.description.sensors import SENSOR_PARAMETERS, SENSOR_PREFIX, quantity_unit
from crane.description.specification import LoopSpec, Task
from crane.formats.machine_file.circuit_writer import circuit_data, replace_data_sheet_keys
from crane.formats.machine_file.force_sections import external_force_data, load_data
from crane.formats.machine_file.machine_reader import estimation_data, read_machine_spec
from crane.formats.machine_file.yaml_text import format_yaml
from crane.formats.urdf.urdf_writer import (
    compound_drive_factors,
    copy_shapes,
    format_document,
    origin_text,
    rotor_inertias,
    with_floating_joints,
)
from crane.formats.xml_file import add_joint, add_link
from crane.machine.machine import Machine

_ELEMENT_PATHS = {"mass": "inertial/mass", "com": "inertial/origin", "tensor": "inertial/inertia",
         "xyz": "origin", "rpy": "origin", "limits": "limit"}  # fmt: skip


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
    draft = MachineDraft(machine)
    draft.add_notes(notes or {})
    return draft.write_folder(folder, overwrite)


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
        self._machine, self._folder, self._comment = machine, folder, origin_text(machine)
        self.data = _machine_data(machine)
        self.urdfs: dict[str, etree._Element] = {}
        self._line_notes: dict[KeyPath, str] = {}
        self._element_notes: dict[etree._Element, list[str]] = {}
        self._header_notes: list[str] = []
        tree = with_floating_joints(machine)
        chains = [chain for chain in machine.chains if chain.name != "payload"]
        chain_of_attachment = {chain.attachment_name: chain.name for chain in chains[1:]}
        parent_joints = tree.parent_joints
        self._chain_of_link: dict[str, str] = {}
        for name in tree.links:
            joints = [joint.name for joint in path_to_root(parent_joints, name)]
            begun = (chain_of_attachment[x] for x in joints if x in chain_of_attachment)
            self._chain_of_link[name] = next(begun, chains[0].name)
        robots = {chain.name: etree.Element("robot", name=chain.name) for chain in chains}
        for link in tree.links.values():
            add_link(robots[self._chain_of_link[link.name]], link)
        for joint in tree.joints.values():
            if joint.name not in chain_of_attachment:
                add_joint(robots[self._chain_of_link[joint.child]], joint)
        for chain in chains:
            copy_shapes(robots[chain.name], machine, [chain.name])
            parent = {"parent": chain.parent} if self.urdfs else {}
            self.add_chain(chain.name, robots[chain.name], parent)
        load = _payload_urdf(machine)
        self._payload_file = None if load is None else (load.name, load.read_bytes())
        if self._payload_file is not None:
            self.data["payload"] = {"urdf": self._path_from_file(self._payload_file[0])}

    def add_notes(self, notes: Mapping[str, str]) -> None:
        """Put words beside numbers; at the head where they do not stand in a line as they are."""
        machine, changes = self._machine, self._machine.parameter_changes
        paths = {
            name: path
            for name, path in parameter_paths(machine).items()
            if path[0] != "friction" or path[1] in machine.friction
        }
        for quantity in machine.sensors:
            for key in SENSOR_PARAMETERS:
                paths[f"{SENSOR_PREFIX}{quantity}.{key}"] = "sensors", quantity, key
        for name, note in notes.items():
            path = paths.get(name)
            written_value = None if path is None else value_at(machine, path)
            value = changes.get(name, written_value)
            if path is None or written_value != value or not self._place_note(path, name, note):
                shown = "" if value is None else f" = {value!r}"
                self._header_notes.append(f"{name}{shown}: {note}")

    def _place_note(self, path: FieldPath, name: str, note: str) -> bool:
        """Put a note on the line of a number, written even if it is a default; whether it has one.

        `payload.mass` has none: it is part of a link's mass, or of several.
        """
        machine, (section, key, *rest) = self._machine, path
        if section == "tree" and rest[-1] != "rotor_inertia":
            tag, part = ("link", rest[2]) if key == "links" else ("joint", rest[1])
            xpath = f"{tag}[@name=$name]/{_ELEMENT_PATHS[str(part)]}"
            elements = [
                x for robot in self.urdfs.values() for x in robot.xpath(xpath, name=rest[0])
            ]
            for element in elements[:1]:
                self._element_notes.setdefault(element, []).append(f"{name}: {note}")
            return bool(elements)
        if section == "gravity":  # a list, whose items have no lines
            return False
        key_path: KeyPath = path
        if section == "tree":
            key_path = "rotor_inertia", rest[0]
        elif section == "pin_capacities":
            key_path = "pins", key
        if section in ("gas_springs", "end_stops"):  # which are mappings in the file
            key_path = str(section), value_at(machine, path[:2]).joint, *rest
        parent: Any = self.data
        for step in key_path[:-1]:
            if not isinstance(step, int) and step not in parent:
                return False
            parent = parent[step]
        if section == "hydraulics":
            replace_data_sheet_keys(parent, str(key_path[-1]), value_at(machine, path[:-1]))
        value = value_at(machine, path)
        if parent.setdefault(key_path[-1], value) != value:
            return False
        self._line_notes[key_path] = note
        return True

    def add_chain(
        self, name: str, robot: etree._Element, extra_data: Mapping[str, str | None]
    ) -> None:
        """Append a sub-chain; `extra_data` is what its entry says beside its name and file."""
        self.urdfs[name] = robot
        self.data["chains"].append(
            {
                "name": name,
                "urdf": self._path_from_file(f"{len(self.urdfs)}_{portable_file_name(name)}.urdf"),
                **extra_data,
            }
        )

    def urdf_of_link(self, link: str) -> etree._Element:
        """The URDF that a link is in."""
        return self.urdfs[self._chain_of_link[link]]

    def file_paths(self, file: str) -> list[str]:
        """Paths of all files from the folder on, that of the machine file first."""
        return [
            file,
            *[chain["urdf"] for chain in self.data["chains"]],
            *([self.data["payload"]["urdf"]] if self._payload_file else []),
        ]

    def write_folder(
        self,
        folder: str | Path,
        overwrite: bool = True,
        check: Callable[[Path], object] = lambda file: None,
    ) -> Path:
        """Write all into a folder of the user's, see `write_machine`.

        Args:
            folder: The folder.
            overwrite: Whether files that are there are replaced.
            check: Called with the written machine file before files that are there are replaced.

        Returns:
            The machine file.
        """
        machine, file = self._machine, f"{portable_file_name(self._machine.name)}.yaml"
        originals = {machine.path, *(chain.urdf for chain in machine.chains)}
        for relative_path in self.file_paths(file):
            if (target := (Path(folder) / relative_path).resolve()) in originals:
                raise OutputError(
                    f"{target}: is what '{machine.name}' was read from, choose another folder"
                )
        with replace_folder(folder, overwrite) as temporary_folder:
            self.write(temporary_folder, file)
            check(temporary_folder / file)
        return Path(folder) / file

    def write(self, folder: Path, file: str) -> None:
        """Write all into a folder, the machine file by this name."""
        (folder / self._folder).mkdir(exist_ok=True)
        notes = {element: "; ".join(texts) for element, texts in self._element_notes.items()}
        for chain in self.data["chains"]:
            robot = self.urdfs[chain["name"]]
            (folder / chain["urdf"]).write_bytes(
                format_document(
                    robot,
                    self._comment,
                    [(x, text) for x, text in notes.items() if robot in x.iterancestors()],
                )
            )
        if self._payload_file is not None:
            (folder / self.data["payload"]["urdf"]).write_bytes(self._payload_file[1])
        nonempty = {key: value for key, value in self.data.items() if value not in (None, [], {})}
        circuit = nonempty.get("hydraulics", {})
        if not circuit.get("oil", True):
            nonempty["hydraulics"] = {k: value for k, value in circuit.items() if k != "oil"}
        (folder / file).write_text(
            "".join(f"# {format_one_line(line)}\n" for line in self._header_notes)
            + format_yaml(nonempty, self._line_notes, self._machine.written_numbers),
            encoding="utf-8",
        )

    def _path_from_file(self, file: str) -> str:
        return f"{self._folder}/{file}" if self._folder else file


def _machine_data(machine: Machine) -> dict[str, Any]:
    """The machine file, with empty chains and without payload."""
    equations = machine.closure.equations
    for coupling in equations.couplings:
        if len(coupling.joints) < 2:
            raise InputError(
                f"coupling '{coupling.name}' holds {next(iter(coupling.factors))} alone, lock "
                "that joint instead"
            )
    drives = machine.explicit_drives
    has_plain_drives = drives and all(list(x.factors.values()) == [1.0] for x in drives)
    data: dict[str, Any] = {
        "chains": [],
        "loops": [loop_data(loop) for loop in equations.loops],
        "couplings": [COUPLING.values_of(coupling) for coupling in equations.couplings],
        "active": [joint for motor in drives for joint in motor.factors]
        if has_plain_drives
        else list(machine.driven_joints),  # drives in surplus are among them
        "drives": compound_drive_factors(machine),
        "home": dict(zip(machine.joints, machine.home.tolist(), strict=True)),
        "friction": {joint: friction_data(law) for joint, law in machine.friction.items()},
        **external_force_data(machine.external_forces),
        "rotor_inertia": rotor_inertias(machine),
        "payload": None,
        "tasks": {name: _task_data(task) for name, task in machine.tasks.items()},
        "hydraulics": machine.hydraulics
        and circuit_data(machine.hydraulics, machine.written_numbers),
        "sensors": {
            name: SENSOR.values_of(sensor) or {"zero": 0.0}
            for name, sensor in machine.sensors.items()
            if quantity_unit(machine.tree, name) is not None  # a joint that is locked has none
        },
        "identification": estimation_data(machine.estimation),
    }
    data |= MACHINE.values_of(machine, *data)
    return {key: data[key] for key in MACHINE.keys if key in data}


def loop_data(loop: LoopSpec) -> dict[str, Any]:
    """An entry of `loops` in a machine file."""
    return LOOP.values_of(loop) | {"axis": [float(x) for x in loop.axis]}


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
    if not (task.via or task.coefficients or task.phases):
        data["joystick"] = {
            joint: [x for point in polygon for x in point]
            for joint, polygon in task.levers.items()
        }
    return data


def _payload_urdf(machine: Machine) -> Path | None:
    """The file of the load that the machine can carry, None where there is none, or it does."""
    if (
        machine.path.suffix.lower() not in (".yaml", ".yml")
        or "payload.mass" in machine.parameter_changes
    ):
        return None
    try:
        with ignore_warnings():
            load = read_machine_spec(machine.path).payload
    except CraneError:  # its files are gone
        return None
    return None if load is None else load.chain.urdf
