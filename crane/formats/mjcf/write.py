"""A MJCF file for MuJoCo."""

import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common.errors import CraneWarning, InputError
from crane.common.output import replacing
from crane.description import Coupling, Drive, ForceElement, LoopSpec, Rope
from crane.description.spec import element_name
from crane.formats.parts import (
    ends,
    finished,
    left_out,
    linear,
    only_in_machine_files,
    origin_of,
    plain_friction,
    text,
)
from crane.machine import Machine

_LEVER = 0.1  # [m] between the two points that make a hinge
_SAME = 1e-9  # share of an inertia that counts as rounding
_LEAST = 1e-14  # [kg m2] moment of inertia that MuJoCo still takes


def write_mjcf(machine: Machine, path: str | Path) -> None:
    """Write a machine as a MJCF file with equality constraints between sites.

    Spherical loops become `connect`, fixed ones `weld`, revolute ones two `connect` at points of
    the axis; couplings `joint`, of more than two joints `tendon`. Drives have a motor each, by a
    fixed tendon where they act along more than one joint; where drives are not the active joints,
    a text names these. Frames are sites, the home posture is the key "home". Coulomb and viscous
    friction, springs and rotor inertias are there; the damping of force elements on joints becomes
    viscous friction; force elements and ropes between frames are spatial tendons. A warning names
    what else is left out. There are no shapes, so nothing collides.

    Args:
        machine: The machine, as it is: with its changes, locks and payload.
        path: The file, .xml.

    Raises:
        InputError: A loop or a joint is of a kind that MJCF has not.
        OutputError: It cannot be written.
    """
    writer = _Writer(machine)
    content = writer.content()
    with replacing(path) as part:
        part.write_bytes(content)
    lost = plain_friction(machine) + only_in_machine_files(machine)
    floating = [
        machine.joints[column + i] for column in machine.coordinates.floating for i in range(6)
    ]
    lost += [f"the friction of {joint}" for joint in floating if joint in machine.friction]
    lost += [f"the constant force on {x.joint}" for x in machine.forces if x.force and x.joint]
    lost += writer.lost
    left_out(machine, "MJCF", lost)


class _Writer:
    """The document as it grows.

    Args:
        machine: The machine.
    """

    def __init__(self, machine: Machine):
        self.machine, self.model, self.tree = machine, machine.model, machine.tree
        self.joints = range(1, self.model.njoints)
        bodies = machine.coordinates.bodies[1:]  # by index of the joint the last of its columns
        self.links = [
            self.tree.root,
            *(self.tree.joints[machine.joints[body - 1]].child for body in bodies),
        ]
        self.frames = [  # all other links
            frame
            for frame in self.model.frames
            if frame.type == pin.FrameType.BODY
            and frame.name not in self.links
            and self.tree.links[frame.name].between is None
        ]
        self.root = etree.Element("mujoco", model=machine.name)
        self.bodies: dict[int, etree._Element] = {}  # by index of the joint
        self.home: list[float] = []
        self.names: set[str] = set()  # of sites
        self.lost: list[str] = []

    def content(self) -> bytes:
        """All of the file."""
        add = etree.SubElement
        add(self.root, "compiler", angle="radian", autolimits="false", inertiafromgeom="false")
        add(self.root, "option", timestep="0.001", gravity="0 0 -9.81", integrator="implicitfast")
        self._texts()
        self.bodies[0] = add(self.root, "worldbody")
        self._tree()
        if self.tree.root != "world":
            self._site(self.bodies[0], self.tree.root, pin.SE3.Identity())
        for frame in self.frames:
            if frame.parentJoint in self.bodies:
                self._site(self.bodies[frame.parentJoint], frame.name, frame.placement)
        equations = self.machine.closure.equations
        tendons, equality, actuator = map(etree.Element, ("tendon", "equality", "actuator"))
        for loop in equations.loops:
            self._loop(equality, loop)
        for coupling in equations.couplings:
            self._coupling(equality, tendons, coupling)
        for drive in self.machine.drives:
            self._drive(actuator, tendons, drive)
        acting: list[ForceElement | Rope] = [*self.machine.forces, *self.machine.ropes]
        for item in acting:
            if item.between is not None:
                self._between(tendons, item, item.between)
        self.root.extend(part for part in (tendons, equality, actuator) if len(part))
        key = add(add(self.root, "keyframe"), "key", name="home", qpos=text(self.home))
        assert key is not None
        return finished(self.root, origin_of(self.machine))

    def _texts(self) -> None:
        machine = self.machine
        texts = {"name": machine.name, "source": machine.source, "tip": machine.tip or ""}
        if not machine.tip and len(self._leaves()) == 1:
            texts["tip"] = "none"
        if [drive.name for drive in machine.drives] != list(machine.active):
            # else the drives say which joints are active
            texts |= {"active": ", ".join(machine.active), "free": ", ".join(machine.free)}
        custom = etree.SubElement(self.root, "custom")
        for name, data in texts.items():
            if data:
                etree.SubElement(custom, "text", name=name, data=data)

    def _leaves(self) -> list[str]:
        parents = {joint.parent for joint in self.tree.joints.values()}
        return [link for link in self.tree.links if link not in parents]

    def _above(self, joint: int) -> list[int]:
        """The joints on the link that a joint moves."""
        return [i for i in self.joints if self.model.parents[i] == joint]

    def _tree(self) -> None:
        """Bodies with the series of joints that move each, parents before children."""
        waiting = [(joint, self.bodies[0]) for joint in reversed(self._above(0))]
        while waiting:
            joint, parent = waiting.pop()
            series = self._series(joint)
            body = self.bodies[series[-1]] = self._body(series, parent)
            waiting += [(i, body) for i in reversed(self._above(series[-1]))]

    def _series(self, joint: int) -> list[int]:
        """Joints that move one body: a joint, and those above it as long as there is no mass."""
        series = [joint]
        while not self.model.inertias[series[-1]].mass:
            last = series[-1]
            above = self._above(last)
            if len(above) != 1 or any(frame.parentJoint == last for frame in self.frames):
                raise InputError(
                    f"link '{self.links[last]}' has no mass, which MuJoCo asks of every body "
                    "with frames or several joints on it: give it some, or write URDF+"
                )
            series += above
        return series

    def _body(self, series: list[int], parent: etree._Element) -> etree._Element:
        """A body with the series of joints that moves it."""
        whole = pin.SE3.Identity()
        for i in series:
            whole = whole * self.model.jointPlacements[i]
        name = self.links[series[-1]]
        body = etree.SubElement(parent, "body", {"name": name} | _placed(whole))
        _inertial(body, self.model.inertias[series[-1]])
        before = pin.SE3.Identity()
        for i in series:
            before = before * self.model.jointPlacements[i]
            self._joint(body, i, whole.actInv(before))
        return body

    def _joint(self, body: etree._Element, joint: int, place: pin.SE3) -> None:
        """A joint, placed in its body's frame at zero."""
        machine, name = self.machine, self.model.names[joint]
        column = self.model.joints[joint].idx_v
        if column in machine.coordinates.floating:
            self._flyer(body, joint)
            return
        described = self.tree.joints[name]
        values = {
            "name": name,
            "type": "hinge" if described.kind == "revolute" else "slide",
            **_placed(pin.SE3(np.eye(3), place.translation)),
            "axis": text(place.rotation @ np.array(described.axis)),
        }
        if (limits := ends(described.limits)) is not None:
            values |= {"limited": "true", "range": text(limits)}
        if described.rotor_inertia:
            values["armature"] = text([described.rotor_inertia])
        law = machine.friction.get(name)
        acting = [item for item in machine.forces if item.joint == name]
        stiffness = sum(item.stiffness for item in acting)
        damping = sum(item.damping for item in acting) + (law.viscous if law else 0.0)
        if damping:
            values["damping"] = text([damping])
        if law and law.coulomb:
            values["frictionloss"] = text([law.coulomb])
        if stiffness:
            rest = sum(item.stiffness * item.rest for item in acting) / stiffness
            values |= {"stiffness": text([stiffness]), "springref": text([rest])}
        etree.SubElement(body, "joint", values)
        self.home.append(float(machine.home[column]))

    def _flyer(self, body: etree._Element, joint: int) -> None:
        """A free joint, whose position is the body's pose in the world."""
        machine = self.machine
        etree.SubElement(body, "freejoint", name=self.model.names[joint])
        data = self.model.createData()
        pin.forwardKinematics(self.model, data, machine.coordinates.configuration(machine.home))
        *place, x, y, z, w = pin.SE3ToXYZQUAT(data.oMi[joint])
        self.home += [float(value) for value in (*place, w, x, y, z)]

    def _site(self, body: etree._Element, name: str, place: pin.SE3) -> str:
        """A site, under a name that no other has."""
        while name in self.names:
            name += "_"
        self.names.add(name)
        site = etree.Element("site", {"name": name} | _placed(place))
        first = body.find("body")
        if first is None:
            body.append(site)
        else:
            first.addprevious(site)
        return name

    def _end(self, link: str) -> tuple[etree._Element, pin.SE3, str]:
        """Body of a link, its placement there, and its site."""
        frame = self.model.frames[self.machine.frame(link)]
        if frame.parentJoint not in self.bodies:
            raise InputError(f"link '{link}' has no mass, which MuJoCo asks for: write URDF+")
        body = self.bodies[frame.parentJoint]
        site = link if link in self.names else self._site(body, link, frame.placement)
        return body, frame.placement, site

    def _loop(self, equality: etree._Element, loop: LoopSpec) -> None:
        ends = [self._end(link) for link in (loop.predecessor, loop.successor)]
        sites = {"site1": ends[0][2], "site2": ends[1][2], "solref": "0.002 1"}
        if loop.type in ("spherical", "fixed"):
            tag = "connect" if loop.type == "spherical" else "weld"
            etree.SubElement(equality, tag, {"name": loop.name, **sites})
            return
        if loop.type != "revolute":
            raise InputError(
                f"loop '{loop.name}' is {loop.type}, for which MJCF has no constraint, write "
                "URDF+ or a machine file"
            )
        etree.SubElement(equality, "connect", {"name": f"{loop.name}_1", **sites})
        along = pin.SE3(np.eye(3), _LEVER * np.array(loop.axis))
        for i, (body, place, _) in enumerate(ends, start=1):
            end = ("predecessor", "successor")[i - 1]
            sites[f"site{i}"] = self._site(body, f"{loop.name}_{end}_axis", place * along)
        etree.SubElement(equality, "connect", {"name": f"{loop.name}_2", **sites})

    def _coupling(
        self, equality: etree._Element, tendons: etree._Element, coupling: Coupling
    ) -> None:
        joints, slopes, offset = linear(coupling)
        stiff = {"name": coupling.name, "solref": "0.002 1"}
        if len(joints) <= 2:
            named = {f"joint{i}": joint for i, joint in enumerate(joints, start=1)}
            polynomial = text([offset, slopes[0] if slopes else 0.0, 0, 0, 0])
            etree.SubElement(equality, "joint", {**stiff, **named, "polycoef": polynomial})
            return
        tendon = _tendon(tendons, coupling.name, coupling.factors)
        polynomial = text([coupling.offset, 0, 0, 0, 0])
        etree.SubElement(equality, "tendon", {**stiff, "tendon1": tendon, "polycoef": polynomial})

    def _between(
        self, tendons: etree._Element, item: ForceElement | Rope, links: tuple[str, str]
    ) -> None:
        """A tendon straight from frame to frame.

        MuJoCo's springs have no constant force, so that of an element moves the length at which
        its spring is slack. Damping of a rope acts while it is taut, that of a tendon always.
        """
        name, values = element_name(item), {}
        if isinstance(item, Rope):
            values = {"stiffness": [item.stiffness], "springlength": [0.0, item.length]}
            self.lost += [f"the damping of the {name}"] * bool(item.damping)
        else:
            push = item.force + item.stiffness * item.rest
            if push < 0 or (push and not item.stiffness):
                self.lost.append(f"the constant force of the {name}")
            if item.stiffness:
                rest = max(push, 0.0) / item.stiffness if item.force else max(item.rest, 0.0)
                values = {"stiffness": [item.stiffness], "springlength": [rest]}
            if item.damping:
                values["damping"] = [item.damping]
        if not values:
            return
        tendon = _named(tendons, "spatial", "_".join(links))
        for key, numbers in values.items():
            tendon.set(key, text(numbers))
        for link in links:
            etree.SubElement(tendon, "site", site=self._end(link)[2])

    def _drive(self, actuator: etree._Element, tendons: etree._Element, drive: Drive) -> None:
        along = {"joint": drive.name}
        if dict(drive.factors) != {drive.name: 1.0}:
            along = {"tendon": _tendon(tendons, drive.name, drive.factors)}
        etree.SubElement(actuator, "motor", {"name": drive.name, **along})


def _named(tendons: etree._Element, tag: str, name: str) -> etree._Element:
    """Add a tendon, under a name that no other has."""
    while any(tendon.get("name") == name for tendon in tendons):
        name += "_"
    return etree.SubElement(tendons, tag, name=name)


def _tendon(tendons: etree._Element, name: str, factors: Mapping[str, float]) -> str:
    """Add a fixed tendon."""
    tendon = _named(tendons, "fixed", name)
    for joint, factor in factors.items():
        etree.SubElement(tendon, "joint", joint=joint, coef=text([factor]))
    return str(tendon.get("name"))


def _placed(place: pin.SE3) -> dict[str, str]:
    """Attributes of a placement, without those that say nothing."""
    found = {}
    if place.translation.any():
        found["pos"] = text(place.translation)
    if not np.array_equal(place.rotation, np.eye(3)):
        found["quat"] = _quaternion(place.rotation)
    return found


def _quaternion(turn: np.ndarray) -> str:
    x, y, z, w = pin.Quaternion(turn).normalize().coeffs()
    return text([w, x, y, z])


def _inertial(body: etree._Element, inertia: pin.Inertia) -> None:
    """Principal moments and axes; MuJoCo asks for moments of a possible body that are not zero."""
    moments, axes = np.linalg.eigh(inertia.inertia)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    moments = np.maximum(moments, _LEAST)
    short = moments[2] - moments[0] - moments[1]
    if short > _SAME * moments[2]:
        warnings.warn(
            f"the inertia of '{body.get('name')}' is of no possible body by {short:.2g} kg m2, "
            "which MuJoCo refuses: two moments are written larger",
            CraneWarning,
            stacklevel=5,
        )
    if short > 0:
        moments[:2] += (0.5 + 1e-15) * short
    values = {"pos": text(inertia.lever), "mass": text([inertia.mass])}
    values |= _placed(pin.SE3(axes, np.zeros(3)))
    etree.SubElement(body, "inertial", {**values, "diaginertia": text(moments)})
