"""Write a machine as a MJCF file for MuJoCo."""

from pathlib import Path

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common.atomic_output import replace_file
from crane.common.errors import InputError
from crane.description.force_elements import ForceElement, Friction, Rope, element_name
from crane.description.kinematic_tree import ROTATIONS, unique_name
from crane.description.rotation_vectors import ROTATION_COUNT
from crane.description.specification import Coupling, Drive, LoopSpec
from crane.formats.mjcf.mjcf_elements import (
    add_fixed_tendon,
    add_inertial,
    add_tendon,
    find_massless_struts,
    placement_attributes,
    solve_polynomial,
)
from crane.formats.urdf.urdf_writer import (
    format_document,
    origin_text,
    solve_coupling,
    warn_about_unsupported,
)
from crane.formats.xml_file import finite_limits, format_numbers
from crane.machine.machine import Machine

_HINGE_POINT_DISTANCE = 0.1  # [m] between the two points that define a hinge


def write_mjcf(machine: Machine, path: str | Path) -> None:
    """Write a machine as a MJCF file with equality constraints between sites.

    Spherical loops become `connect`, fixed loops `weld`, revolute loops two `connect` at points on
    the axis; couplings become `joint`, or `tendon` if they have more than two joints. Each drive
    has a motor, with a fixed tendon if it acts along several joints; if the drives are not the
    active joints, a text lists these. Frames are sites, the home configuration is the key "home".
    Gravity, Coulomb and viscous friction, springs and rotor inertias are written; damping of force
    elements along joints becomes viscous friction; force elements and ropes between frames become
    spatial tendons. Cylinders without mass, as they are read, become spatial tendons or cranks of
    actuators. A warning lists what is left out. Shapes are not written, so there are no contacts.

    Args:
        machine: The machine with its parameter changes, locked joints and payload.
        path: The file, .xml.

    Raises:
        InputError: MJCF does not have a type of loop or joint.
        OutputError: The file cannot be written.
    """
    writer = _MjcfWriter(machine)
    with replace_file(path) as temporary_file:
        temporary_file.write_bytes(writer.build_content())
    constant = [f"the constant force on {x.joint}" for x in machine.forces if x.force and x.joint]
    warn_about_unsupported(machine, "MJCF", [*constant, *writer.unsupported])


class _MjcfWriter:
    """Builds the document.

    Args:
        machine: The machine.

    Attributes:
        unsupported: Parts of the machine that are left out.
    """

    def __init__(self, machine: Machine):
        self.machine, self.model, self.tree = machine, machine.model, machine.tree
        self.joints = range(1, self.model.njoints)
        self.moved_links = [
            self.tree.root_link,
            *(
                self.tree.joints[machine.joints[column - 1]].child
                for column in machine.coordinates.body_of_joint[1:]
            ),
        ]
        self.frames = [  # of all other links
            frame
            for frame in self.model.frames
            if frame.type == pin.FrameType.BODY
            and frame.name not in self.moved_links
            and self.tree.links[frame.name].composite_joint is None
        ]
        struts = find_massless_struts(machine)
        driven = [x for drive in machine.drives if drive.factors.keys() <= struts.keys()
                  for x in drive.factors]  # fmt: skip
        self.struts = {joint: strut for joint, strut in struts.items() if joint in driven}
        self._strut_joints = {joint for strut in self.struts.values() for joint in strut.joints}
        self.root = etree.Element("mujoco", model=machine.name)
        self.bodies: dict[int, etree._Element] = {}  # by index of the joint
        self.home_coordinates: list[float] = []
        self.site_names: set[str] = set()
        self.unsupported: list[str] = []

    def build_content(self) -> bytes:
        """Return the file's content."""
        add = etree.SubElement
        add(self.root, "compiler", angle="radian", autolimits="false", inertiafromgeom="false")
        add(
            self.root,
            "option",
            timestep="0.001",
            gravity=format_numbers(self.machine.gravity),
            integrator="implicitfast",
        )
        self._add_texts()
        self.bodies[0] = add(self.root, "worldbody")
        pending = [(joint, self.bodies[0]) for joint in reversed(self._child_joints(0))]
        while pending:  # parents before children
            joint, parent = pending.pop()
            series = self._joints_of_body(joint)
            body = self.bodies[series[-1]] = self._add_body(series, parent)
            pending += [(i, body) for i in reversed(self._child_joints(series[-1]))]
        if self.tree.root_link != "world":
            self._add_site(self.bodies[0], self.tree.root_link, pin.SE3.Identity())
        for frame in self.frames:
            if frame.parentJoint in self.bodies:
                self._add_site(self.bodies[frame.parentJoint], frame.name, frame.placement)
        equations = self.machine.closure.equations
        tendons, equality, actuator = map(etree.Element, ("tendon", "equality", "actuator"))
        for loop in equations.loops:
            if all(strut.loop is not loop for strut in self.struts.values()):
                self._add_loop(equality, loop)
        for coupling in equations.couplings:
            self._add_coupling(equality, tendons, coupling)
        for drive in self.machine.drives:
            if drive.factors.keys() <= self.struts.keys():
                self._add_strut_drive(actuator, tendons, drive)
                continue
            target = {"joint": drive.name}
            joints = {
                self.model.names[int(self.machine.coordinates.joints[self.machine.column(joint)])]
                for joint in drive.factors
            }
            if len(joints) == 1 and joints != set(drive.factors):  # about an axis of a ball
                (ball,) = joints
                gear = [drive.factors.get(f"{ball}_{part}", 0.0) for part, _, _ in ROTATIONS]
                target = {"joint": ball, "gear": format_numbers(gear)}
            elif drive.factors.keys() != {drive.name}:
                target = {"tendon": add_fixed_tendon(tendons, drive.name, drive.factors)}
            elif (factor := drive.factors[drive.name]) != 1.0:
                target["gear"] = format_numbers([factor])
            add(actuator, "motor", {"name": drive.name, **target})
        force_elements: list[ForceElement | Rope] = [*self.machine.forces, *self.machine.ropes]
        for item in force_elements:
            if item.between is not None:
                self._add_spatial_tendon(tendons, item, item.between)
        self.root.extend(part for part in (tendons, equality, actuator) if len(part))
        add(
            add(self.root, "keyframe"),
            "key",
            name="home",
            qpos=format_numbers(self.home_coordinates),
        )
        return format_document(self.root, origin_text(self.machine))

    def _add_texts(self) -> None:
        machine = self.machine
        texts = {"name": machine.name, "source": machine.source, "tip": machine.tip or ""}
        parents = {joint.parent for joint in self.tree.joints.values()}
        if not machine.tip and len(self.tree.links.keys() - parents) == 1:
            texts["tip"] = "none"
        if [drive.name for drive in machine.drives] != list(machine.active):
            # otherwise the drives determine the active joints
            texts |= {"active": ", ".join(machine.active), "free": ", ".join(machine.free)}
        custom = etree.SubElement(self.root, "custom")
        for name, data in texts.items():
            if data:
                etree.SubElement(custom, "text", name=name, data=data)

    def _child_joints(self, joint: int) -> list[int]:
        """Return the joints on the link that a joint moves."""
        joints = (i for i in self.joints if i not in self._strut_joints)
        return [i for i in joints if self.model.parents[i] == joint]

    def _joints_of_body(self, joint: int) -> list[int]:
        """Return the joints of one body: a joint and those after it up to a link with mass."""
        series = [joint]
        while not self.model.inertias[series[-1]].mass:
            last = series[-1]
            child_joints = self._child_joints(last)
            if len(child_joints) != 1 or any(frame.parentJoint == last for frame in self.frames):
                raise InputError(
                    f"link '{self.moved_links[last]}' has no mass, which MuJoCo asks of every "
                    "body with frames or several joints on it: give it some, or write URDF+"
                )
            series += child_joints
        return series

    def _add_body(self, series: list[int], parent: etree._Element) -> etree._Element:
        placements = [pin.SE3.Identity()]
        for i in series:
            placements.append(placements[-1] * self.model.jointPlacements[i])
        attributes = {"name": self.moved_links[series[-1]]} | placement_attributes(placements[-1])
        body = etree.SubElement(parent, "body", attributes)
        add_inertial(body, self.model.inertias[series[-1]])
        for i, placement in zip(series, placements[1:], strict=True):
            self._add_joint(body, i, placements[-1].actInv(placement))
        return body

    def _add_joint(self, body: etree._Element, joint: int, placement: pin.SE3) -> None:
        """Add a joint at a placement in its body's frame at coordinate zero."""
        machine, name = self.machine, self.model.names[joint]
        column, count = self.model.joints[joint].idx_v, self.model.joints[joint].nv
        if count > 1:
            self._add_composite_joint(body, joint, placement)
            return
        tree_joint = self.tree.joints[name]
        values = {
            "name": name,
            "type": "hinge" if tree_joint.kind == "revolute" else "slide",
            **placement_attributes(pin.SE3(np.eye(3), placement.translation)),
            "axis": format_numbers(placement.rotation @ np.array(tree_joint.axis)),
        }
        if (limits := finite_limits(tree_joint.limits)) is not None:
            values |= {"limited": "true", "range": format_numbers(limits)}
        values |= self._joint_attributes(name, "springref")
        etree.SubElement(body, "joint", values)
        self.home_coordinates.append(float(machine.home[column]))

    def _joint_attributes(self, name: str, rest_attribute: str) -> dict[str, str]:
        """Return the attributes for rotor inertia, friction and springs of a joint."""
        joint_elements = [item for item in self.machine.forces if item.joint == name]
        stiffness = sum(item.stiffness for item in joint_elements)
        effects = self._joint_effects(name) | {"stiffness": stiffness}
        if stiffness:
            rest = sum(item.stiffness * item.rest for item in joint_elements) / stiffness
            effects[rest_attribute] = rest
        return {
            key: format_numbers([value])
            for key, value in effects.items()
            if value or key == rest_attribute
        }

    def _add_strut_drive(
        self, actuator: etree._Element, tendons: etree._Element, drive: Drive
    ) -> None:
        """Add the motor of struts along a spatial tendon, or of a slider-crank.

        The parts of the tendon are its branches, whose divisors are gear / factor.
        """
        gear = max(drive.factors.values(), key=abs)
        motor = {"name": drive.name, "gear": format_numbers([gear])}
        struts = [self.struts[joint] for joint in drive.factors]
        effects = self._joint_attributes(struts[0].joint, "springlength")
        if any(gear * factor < 0 for factor in drive.factors.values()) or (
            len(struts) > 1 and any(strut.rod_length for strut in struts)
        ):
            self.unsupported.append(f"the drive {drive.name}")
            return
        sites = [
            tuple(self._frame_site(link)[2] for link in (strut.base, strut.loop.successor))
            for strut in struts
        ]
        if struts[0].rod_length:
            crank = {"slidersite": sites[0][0], "cranksite": sites[0][1]}
            crank["cranklength"] = format_numbers([struts[0].rod_length])
            etree.SubElement(actuator, "motor", motor | crank)
            self.unsupported += [f"{key} of {drive.name}" for key in effects]
            return
        tendon = add_tendon(tendons, "spatial", drive.name)
        for ends, factor in zip(sites, drive.factors.values(), strict=True):
            if len(sites) > 1:
                etree.SubElement(tendon, "pulley", divisor=format_numbers([gear / factor]))
            for site in ends:
                etree.SubElement(tendon, "site", site=site)
        if len(struts) == 1:
            if (limits := finite_limits(self.tree.joints[struts[0].joint].limits)) is not None:
                effects |= {"limited": "true", "range": format_numbers(limits)}
            tendon.attrib.update(effects)
        else:
            alone = {tuple(x.factors) for x in self.machine.drives}  # written with their tendon
            parts = (x.joint for x in struts if (x.joint,) not in alone)
            self.unsupported += [
                f"friction, springs and rotors of {joint}"
                for joint in parts
                if self._joint_attributes(joint, "springlength")
            ]
        etree.SubElement(actuator, "motor", motor | {"tendon": str(tendon.get("name"))})

    def _joint_effects(self, name: str) -> dict[str, float]:
        """Return rotor inertia and friction along a coordinate by attribute."""
        friction = self.machine.friction.get(name, Friction())
        damping = sum(item.damping for item in self.machine.forces if item.joint == name)
        return {
            "armature": self.tree.joints[name].rotor_inertia,
            "damping": damping + friction.viscous,
            "frictionloss": friction.sliding_force,
        }

    def _add_composite_joint(self, body: etree._Element, joint: int, placement: pin.SE3) -> None:
        """Add a ball joint, or the free joint of a floating base.

        MuJoCo has one value of each effect for all axes.
        """
        machine, data = self.machine, self.model.createData()
        pin.forwardKinematics(self.model, data, machine.coordinates.configuration(machine.home))
        first = self.model.joints[joint].idx_v
        names = machine.joints[first : first + self.model.joints[joint].nv]
        is_ball = len(names) == ROTATION_COUNT
        values = {"name": self.model.names[joint], "type": "ball" if is_ball else "free"}
        if is_ball:
            values |= placement_attributes(pin.SE3(np.eye(3), placement.translation))
            # the rotation in the axes of the body
            turn = placement.rotation @ data.joints[joint].M.rotation @ placement.rotation.T
            *_, x, y, z, w = pin.SE3ToXYZQUAT(pin.SE3(turn, np.zeros(3)))
            self.home_coordinates += [float(value) for value in (w, x, y, z)]
        else:
            *position, x, y, z, w = pin.SE3ToXYZQUAT(data.oMi[joint])  # in the world
            self.home_coordinates += [float(value) for value in (*position, w, x, y, z)]
        effects = [self._joint_effects(name) for name in names]
        for key, value in effects[0].items():
            if any(other[key] != value for other in effects):
                self.unsupported.append(f"different {key} about the axes of {values['name']}")
            elif value and key == "frictionloss" and not is_ball:
                self.unsupported.append(f"the friction of {values['name']}")
            elif value:
                values[key] = format_numbers([value])
        etree.SubElement(body, "joint", values)

    def _add_site(self, body: etree._Element, name: str, placement: pin.SE3) -> str:
        """Add a site under a unique name, and return the name."""
        name = unique_name(name, self.site_names)
        self.site_names.add(name)
        site = etree.Element("site", {"name": name} | placement_attributes(placement))
        first = body.find("body")
        if first is None:
            body.append(site)
        else:
            first.addprevious(site)
        return name

    def _frame_site(self, link: str) -> tuple[etree._Element, pin.SE3, str]:
        """Return the body of a link, the placement on it, and the name of the site."""
        frame = self.model.frames[self.machine.frame(link)]
        if frame.parentJoint not in self.bodies:
            raise InputError(f"link '{link}' has no mass, which MuJoCo asks for: write URDF+")
        body = self.bodies[frame.parentJoint]
        site = link if link in self.site_names else self._add_site(body, link, frame.placement)
        return body, frame.placement, site

    def _add_loop(self, equality: etree._Element, loop: LoopSpec) -> None:
        ends = [self._frame_site(link) for link in (loop.predecessor, loop.successor)]
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
        axis_offset = pin.SE3(np.eye(3), _HINGE_POINT_DISTANCE * np.array(loop.axis))
        for key, side, end in zip(
            ("site1", "site2"), ("predecessor", "successor"), ends, strict=True
        ):
            sites[key] = self._add_site(end[0], f"{loop.name}_{side}_axis", end[1] * axis_offset)
        etree.SubElement(equality, "connect", {"name": f"{loop.name}_2", **sites})

    def _add_coupling(
        self, equality: etree._Element, tendons: etree._Element, coupling: Coupling
    ) -> None:
        joints, derivatives, offset = solve_coupling(coupling)
        attributes = {"name": coupling.name, "solref": "0.002 1"}
        coefficients = [offset, *(derivatives or [0.0]), 0, 0, 0]
        tag = "joint"
        if coupling.powers:
            joints, coefficients = solve_polynomial(coupling)
        if len(joints) > 2:
            tag, coefficients = "tendon", [coupling.offset, 0, 0, 0, 0]
            joints = [add_fixed_tendon(tendons, coupling.name, coupling.factors)]
        attributes |= {f"{tag}{i}": name for i, name in enumerate(joints, start=1)}
        attributes["polycoef"] = format_numbers(coefficients)
        etree.SubElement(equality, tag, attributes)

    def _add_spatial_tendon(
        self, tendons: etree._Element, item: ForceElement | Rope, links: tuple[str, str]
    ) -> None:
        """Add a tendon straight from frame to frame.

        MuJoCo's springs have no constant force, so that of an element changes the rest length. The
        damping of a rope acts only while it is taut, that of a tendon always: it is left out.
        """
        name, values = element_name(item), {}
        if isinstance(item, Rope):
            values = {"stiffness": [item.stiffness], "springlength": [0.0, item.length]}
            self.unsupported += [f"the damping of the {name}"] * bool(item.damping)
        else:
            slack_force = item.force + item.stiffness * item.rest
            if slack_force < 0 or (slack_force and not item.stiffness):
                self.unsupported.append(f"the constant force of the {name}")
            if item.stiffness:
                rest = slack_force / item.stiffness if item.force else item.rest
                values = {"stiffness": [item.stiffness], "springlength": [max(rest, 0.0)]}
            if item.damping:
                values["damping"] = [item.damping]
        if not values:
            return
        tendon = add_tendon(tendons, "spatial", "_".join(links))
        for key, numbers in values.items():
            tendon.set(key, format_numbers(numbers))
        for link in links:
            etree.SubElement(tendon, "site", site=self._frame_site(link)[2])
