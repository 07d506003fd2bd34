"""A machine file with a URDF per sub-chain."""

import dataclasses
import math
import shutil
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lxml import etree

from crane.common.errors import CraneError, CraneWarning, InputError, OutputError
from crane.common.output import file_name, staging
from crane.description import Task
from crane.formats.machine_file.read import read
from crane.formats.parts import add_joint, add_link, draw, finished, origin_of
from crane.hydraulics import Cylinder, Hydraulics, Valve
from crane.hydraulics.components import HOLDING, number_names
from crane.machine import Machine


def write_machine(machine: Machine, folder: str | Path) -> Path:
    """Write a machine as a machine file, with one URDF per sub-chain beside it.

    Args:
        machine: The machine, as it is: with its changes, locks and payload.
        folder: Created where there is none; files of the same names are replaced.

    Returns:
        The machine file.

    Raises:
        InputError: A coupling holds a single joint.
        OutputError: The folder cannot be written, or holds what the machine was read from.
    """
    chains = _Chains(machine)
    name = file_name(machine.name)
    file = f"{name}.yaml"
    data = _content(machine, chains)
    load = _payload(machine)
    if load is not None:
        data["payload"] = {"urdf": load.name}
    originals = {machine.path, *(chain.urdf for chain in machine.chains)}
    for written in (file, *chains.files.values()):
        if (place := (Path(folder) / written).resolve()) in originals:
            raise OutputError(
                f"{place}: is what '{machine.name}' was read from, choose another folder"
            )
    with staging(folder) as part:
        for chain in chains.names:
            content = finished(chains.robot(chain), origin_of(machine))
            (part / chains.files[chain]).write_bytes(content)
        if load is not None:
            shutil.copyfile(load, part / load.name)
        (part / file).write_text(_yaml(data), encoding="utf-8")
    return Path(folder) / file


class _Chains:
    """The sub-chains, cut at their attachments again.

    Args:
        machine: The machine.
    """

    def __init__(self, machine: Machine):
        self.machine, self.tree = machine, machine.tree
        self.chains = [chain for chain in machine.chains if chain.name != "payload"]
        self.names = [chain.name for chain in self.chains]
        self.files = {name: f"{i}_{file_name(name)}.urdf" for i, name in enumerate(self.names, 1)}
        self.parents = {chain.name: str(chain.parent) for chain in self.chains[1:]}
        self._attached = {chain.attachment: chain.name for chain in self.chains[1:]}
        root = self.tree.root
        self._chain_of = {root: self.names[0]}
        below, waiting = self.tree.below(), [root]
        while waiting:
            link = waiting.pop()
            for joint in below.get(link, ()):
                within = self._attached.get(joint.name, self._chain_of[link])
                self._chain_of[joint.child] = within
                waiting.append(joint.child)

    def robot(self, chain: str) -> etree._Element:
        """The URDF of a sub-chain."""
        robot = etree.Element("robot", name=chain)
        for link in self.tree.links.values():
            if self._chain_of[link.name] == chain:
                add_link(robot, link)
        for joint in self.tree.joints.values():
            if self._chain_of[joint.child] == chain and joint.name not in self._attached:
                add_joint(robot, joint)
        draw(robot, self.machine, [chain])
        return robot


def _content(machine: Machine, chains: _Chains) -> dict[str, Any]:
    """The machine file, without the payload."""
    data: dict[str, Any] = {"name": machine.name}
    if machine.source:
        data["source"] = machine.source
    data["chains"] = []
    for name in chains.names:
        parent = {"parent": chains.parents[name]} if name in chains.parents else {}
        data["chains"].append({"name": name, "urdf": chains.files[name], **parent})
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
    data["active"] = list(machine.active)
    data["home"] = dict(zip(machine.joints, machine.home.tolist(), strict=True))
    data["friction"] = {
        joint: _numbers(law) or {"viscous": 0.0} for joint, law in machine.friction.items()
    }
    data["forces"] = [_numbers(item) for item in machine.forces]
    data["gas_springs"] = {item.joint: _numbers(item, "joint") for item in machine.gas_springs}
    data["end_stops"] = {item.joint: _numbers(item, "joint") for item in machine.end_stops}
    data["tip"] = machine.tip
    data["tasks"] = {name: _task(task) for name, task in machine.tasks.items()}
    data["control"] = {joint: _numbers(gains) for joint, gains in machine.control.items()}
    if machine.hydraulics is not None:
        data["hydraulics"] = _hydraulics(machine.hydraulics)
    return {key: value for key, value in data.items() if value not in (None, [], {})}


def _numbers(item: Any, *without: str) -> dict[str, Any]:
    """What of a dataclass is not as by default."""
    return {
        field.name: getattr(item, field.name)
        for field in dataclasses.fields(item)
        if field.name not in without and getattr(item, field.name) != field.default
    }


def _task(task: Task) -> dict[str, Any]:
    data: dict[str, Any] = {"description": task.description} if task.description else {}
    data["duration"] = task.duration
    if task.space == "joystick":
        levers = {
            joint: [x for point in polygon for x in point]
            for joint, polygon in task.levers.items()
        }
        return data | {"joystick": levers}
    return data | {task.space: {key: list(row) for key, row in task.coefficients.items()}}


def _hydraulics(circuit: Hydraulics) -> dict[str, Any]:
    data = {
        "supply": _all_numbers(circuit.supply),
        "oil": _all_numbers(circuit.oil),
        "cylinders": {joint: _cylinder(item) for joint, item in circuit.cylinders.items()},
        "valves": {joint: _valve(valve) for joint, valve in circuit.valves.items()},
    }
    if circuit.control:
        data["control"] = {joint: _all_numbers(gains) for joint, gains in circuit.control.items()}
    return data


def _all_numbers(part: Any) -> dict[str, Any]:
    return {name: getattr(part, name) for name in number_names(type(part))}


def _cylinder(cylinder: Cylinder) -> dict[str, Any]:
    fitted = {key: getattr(cylinder, key) for key in HOLDING if getattr(cylinder, key) is not None}
    return _all_numbers(cylinder) | {key: _all_numbers(valve) for key, valve in fitted.items()}


def _valve(valve: Valve) -> dict[str, Any]:
    edges = ("c1", "c2", "c3", "c4")
    rest = {
        name: getattr(valve, name)
        for name in number_names(Valve)
        if name not in (*edges, "margin")
    }
    if not valve.margin:
        return {"type": "orifice", **{name: getattr(valve, name) for name in edges}, **rest}
    if (valve.c1, valve.c2) != (valve.c4, valve.c3):
        raise InputError(
            f"the compensated valve of '{valve.joint}' has other numbers for either direction, "
            "for which a machine file has no place"
        )
    flow = valve.c1 * math.sqrt(valve.margin)
    given = {"flow": flow, "margin": valve.margin, "meter_out": valve.c2}
    return {"type": "compensated", **given, **rest}


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


def _yaml(data: Mapping[str, Any]) -> str:
    import yaml

    return str(
        yaml.safe_dump(
            dict(data), sort_keys=False, allow_unicode=True, width=100, default_flow_style=None
        )
    )
