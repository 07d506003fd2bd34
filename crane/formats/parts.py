"""The links and joints of a machine, as they are written."""

import copy
import math
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.description import Coupling
from crane.description.clean import add_joint, add_link, text
from crane.description.mesh_file import mesh_file
from crane.errors import CraneWarning
from crane.machine import Machine
from crane.samples import Array

ENDLESS = 1e9  # limit that is read as none, written where one has to stand


@dataclass(frozen=True)
class Frame:
    """A link without mass, fixed to the link that a joint moves.

    Attributes:
        name: The link.
        fixed: Its fixed joint.
        joint: Index of the joint whose link it is fixed to, 0 for the world.
        place: In that link's frame.
        parent: Link that it was fixed to when the machine was read.
    """

    name: str
    fixed: str
    joint: int
    place: pin.SE3
    parent: str


class Parts:
    """What a machine consists of, seen from its model: changes, locks and payloads are in it.

    Args:
        machine: The machine.

    Attributes:
        links: By index of a joint, the link that it moves; the root link for the world.
        frames: All other links.
    """

    def __init__(self, machine: Machine):
        self.machine = machine
        model = self.model = machine.model
        self.links: dict[int, str] = {}
        self.frames: list[Frame] = []
        for frame in model.frames:
            if frame.type != pin.FrameType.BODY:
                continue
            above = model.frames[frame.parentFrame]
            if frame.parentJoint not in self.links and (
                above.type == pin.FrameType.JOINT or above.name == "universe"
            ):
                self.links[frame.parentJoint] = frame.name
                continue
            parent = model.frames[above.parentFrame].name
            self.frames.append(
                Frame(frame.name, above.name, frame.parentJoint, frame.placement, parent)
            )

    @property
    def joints(self) -> range:
        """Indices of the joints."""
        return range(1, self.model.njoints)

    def ordered(self) -> list[int]:
        """Indices of the joints, the active ones first and in their order."""
        active = [self.model.getJointId(name) for name in self.machine.active]
        return active + [i for i in self.joints if i not in active]

    def axis(self, joint: int) -> Array:
        """(3,) direction of a joint in its frame."""
        column = np.ravel(self.model.joints[joint].createData().S)
        return column[3:] if self.turns(joint) else column[:3]

    def turns(self, joint: int) -> bool:
        """Whether a joint turns, and does not slide."""
        return self.machine.unit(self.model.names[joint]) == "rad"

    def limits(self, joint: int) -> tuple[float, float] | None:
        """Lower and upper limit of a joint, None where it has none."""
        column = self.model.joints[joint].idx_q
        lower = float(self.model.lowerPositionLimit[column])
        upper = float(self.model.upperPositionLimit[column])
        return (lower, upper) if math.isfinite(lower) and math.isfinite(upper) else None

    def massless(self, joint: int) -> bool:
        """Whether a joint moves nothing but the next joint of a series."""
        return bool(self.model.inertias[joint].mass == 0)

    def write_link(self, robot: etree._Element, joint: int) -> None:
        """The link that a joint moves, with the mass of all that is fixed to it."""
        if joint == 0:
            add_link(robot, self.links[0])
            return
        add_link(robot, self.links[joint], self.model.inertias[joint])
        if self.massless(joint):
            robot[-1].set("between", self.model.names[joint])

    def write_joint(
        self, robot: etree._Element, joint: int, parent: str, place: pin.SE3
    ) -> etree._Element:
        """A moving joint with its limits, placed on a link."""
        limits, turns = self.limits(joint), self.turns(joint)
        kind = "prismatic" if not turns else "continuous" if limits is None else "revolute"
        element = add_joint(
            robot, self.model.names[joint], kind, place, (parent, self.links[joint]),
            self.axis(joint),
        )  # fmt: skip
        given: dict[str, str] = {}
        if limits is not None or not turns:
            lower, upper = limits or (-ENDLESS, ENDLESS)
            given = {"lower": text([lower]), "upper": text([upper])}
        column = self.model.joints[joint].idx_v
        for key, values in (
            ("effort", self.model.effortLimit), ("velocity", self.model.velocityLimit),
        ):  # fmt: skip
            if math.isfinite(values[column]):
                given[key] = text([values[column]])
        if given:
            endless = {"effort": text([ENDLESS]), "velocity": text([ENDLESS])}
            etree.SubElement(element, "limit", endless | given)
        return element

    def draw(self, robot: etree._Element, chains: Iterable[str] | None = None) -> None:
        """Copy what the machine's URDFs draw to the links of the same names."""
        links = {link.get("name"): link for link in robot.iterfind("link")}
        materials: dict[str, etree._Element] = {}
        for chain in self.machine.chains:
            if chain.urdf.suffix.lower() != ".urdf" or (chains and chain.name not in chains):
                continue
            source = etree.parse(
                str(chain.urdf),
                etree.XMLParser(resolve_entities=False, no_network=True, remove_comments=True),
            ).getroot()
            for material in source.iterfind("material"):
                materials.setdefault(material.get("name", ""), copy.deepcopy(material))
            for link in source.iterfind("link"):
                target = links.get(link.get("name", "").strip())
                for drawn in (*link.iterfind("visual"), *link.iterfind("collision")):
                    if target is not None:
                        target.append(_located(drawn, chain.urdf.parent))
        for material in reversed(materials.values()):
            robot.insert(0, material)


def _located(drawn: etree._Element, folder: Path) -> etree._Element:
    """A copy of what is drawn, its mesh named by its whole path where it is there."""
    drawn = copy.deepcopy(drawn)
    for mesh in drawn.iter("mesh"):
        if (file := mesh_file(mesh.get("filename", ""), folder)) is not None:
            mesh.set("filename", str(file.resolve()))
    return drawn


def linear(coupling: Coupling) -> tuple[list[str], list[float], float]:
    """A coupling solved for its first joint: q_0 = sum slope_i q_i + offset.

    Returns:
        All joints, slopes of those after the first, offset.
    """
    joints, factors = list(coupling.factors), list(coupling.factors.values())
    slopes = [-factor / factors[0] + 0.0 for factor in factors[1:]]
    return joints, slopes, coupling.offset / factors[0] + 0.0


def finished(robot: etree._Element, comment: str) -> bytes:
    """A file of an element, indented, with a comment in the first line."""
    etree.indent(robot)
    words = comment.replace("--", "- -").strip(" -")
    head = f'<?xml version="1.0" encoding="utf-8"?>\n<!-- {" ".join(words.split())} -->\n'
    return head.encode() + etree.tostring(robot, encoding="utf-8") + b"\n"


def origin_of(machine: Machine) -> str:
    """Words on where a written machine comes from."""
    return f"{machine.name}, written by crane; source: {machine.source or machine.path.name}"


def left_out(machine: Machine, what: str, names: Sequence[str] | Iterator[str]) -> None:
    """Warn of what a format has no place for."""
    if names := list(names):
        warnings.warn(
            f"{machine.name}: {what} has no place for {', '.join(names)}, left out (a machine "
            "file has)",
            CraneWarning,
            stacklevel=3,
        )


def plain_friction(machine: Machine) -> list[str]:
    """Joints with a friction law of more than Coulomb and viscous friction."""
    return [
        f"the friction law of {joint}"
        for joint, law in machine.friction.items()
        if law.coulomb_offset or law.viscous_offset or law.stiction or (
            law.coulomb and law.smoothing != 1e-3
        )
    ]  # fmt: skip


def only_in_machine_files(machine: Machine) -> list[str]:
    """Sections of a machine that no other format has."""
    sections = {
        "gas springs": machine.gas_springs,
        "end stops": machine.end_stops,
        "tasks": machine.tasks,
        "gains": machine.control,
        "hydraulics": machine.hydraulics,
    }
    return [name for name, section in sections.items() if section]
