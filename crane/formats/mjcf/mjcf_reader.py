"""Read a machine from a MJCF file of MuJoCo."""

import dataclasses
from pathlib import Path

import numpy as np
import pinocchio as pin

from crane.closure.coordinates import cardan_angles
from crane.common.errors import DescriptionError
from crane.description.kinematic_tree import (
    Joint,
    Limits,
    Link,
    Tree,
    joint_freedoms,
    joint_series,
    parse_limit,
    to_vector,
    unique_name,
    with_rotor_inertias,
)
from crane.description.pinocchio_conversion import inertial_from_inertia, xyz_rpy_from_se3
from crane.description.rotation_vectors import with_rotation_vectors
from crane.description.specification import Chain, MachineSpec, source_locations
from crane.formats.machine_file.structure_sections import TreeBuilder
from crane.formats.mjcf.actuator_cylinders import MjcfCylinders
from crane.formats.mjcf.equality_constraints import MjcfFrames, read_equality_constraints
from crane.formats.mjcf.model_features import ModelFeatures
from crane.formats.mjcf.mujoco_file import MujocoFile, pose
from crane.formats.mjcf.unsupported_features import note_unsupported_features


def read_mjcf(path: Path) -> MachineSpec:
    """Read a machine from a MJCF file.

    The coordinate of a hinge or slide is its `qpos`. A ball joint has the rotation vector of its
    body relative to the reference pose, a free joint position and rotation vector in the world.

    Raises:
        DescriptionError: The file is wrong or has an element that no machine has; the message has
            file and line.
    """
    return _MjcfReader(MujocoFile(path)).read_spec()


class _MjcfReader:
    """Reads a compiled file.

    Args:
        mjcf: The file.
    """

    def __init__(self, mjcf: MujocoFile):
        self.mjcf, self.model = mjcf, mjcf.model
        self.links: dict[str, Link] = {}
        self.joints: dict[str, Joint] = {}
        self.body_links: list[str] = []  # name of the link by index of the body
        self.series_joints: dict[int, list[str]] = {}  # names of joints by joint of MuJoCo
        self.texts: dict[str, str] = {}  # of <text> under <custom>, by name
        for i, start in enumerate(mjcf.model.text_adr):
            end = start + mjcf.model.text_size[i]
            raw = bytes(mjcf.model.text_data[start:end]).split(b"\0")[0]
            self.texts.setdefault(
                mjcf.element_name("TEXT", i), raw.decode("utf-8", "replace").strip()
            )

    def read_spec(self) -> MachineSpec:
        """Return the machine."""
        mjcf = self.mjcf
        self.names = [mjcf.name("JOINT", i) for i in range(self.model.njnt)]
        for body in range(self.model.nbody):
            self._read_body(body)
        if not self.model.njnt:
            raise DescriptionError(f"{mjcf.file.name}: no joint moves in this file, add one")
        frames = self._read_frames()
        loops, couplings = read_equality_constraints(mjcf, frames, self.series_joints)
        for link, (body, placement, source_location) in frames.placements.items():
            self.links[link] = Link(link, source_location)
            self._add_fixed_joint(link, self.body_links[body], placement)
        used_names = {*self.links, *self.joints, *(loop.name for loop in loops)}
        qpos = self._home_coordinates()
        cylinders = MjcfCylinders(mjcf, frames.link_of_site, used_names, qpos)
        self.links |= {x.name: x for x in cylinders.parts if isinstance(x, Link)}
        self.joints |= {x.name: x for x in cylinders.parts if isinstance(x, Joint)}
        loops += tuple(cylinders.loops)
        features = ModelFeatures(mjcf, self.series_joints, frames.link_of_site, cylinders)
        note_unsupported_features(mjcf, cylinders)
        tree = TreeBuilder(
            with_rotor_inertias(Tree(self.links, self.joints), features.rotor_inertias)
        )
        for loop in loops:
            tree.check_loop(loop)
        active = self._listed_joints("active")
        for drive in features.drives.values() if not active else ():
            # one joint of each drive: its other joints depend on that, or are other coordinates
            active += [x for x in drive.factors if x not in {*active, *cylinders.resting}][:1]
        free = tuple(self._listed_joints("free"))
        home, tip = self._read_home(qpos) | cylinders.home, self._read_tip(tree)
        mjcf.warn_about_notes()
        home_locations = {f"home {joint}": self.joints[joint].source_location for joint in home}
        spec = MachineSpec(
            name=self.texts.get("name") or mjcf.file.stem,
            source=self.texts.get("source") or mjcf.file.name,
            path=mjcf.file,
            chains=(Chain(mjcf.file.stem, mjcf.file, None, mjcf.file.name, tuple(tree.joints)),),
            tree=tree.tree,
            loops=loops,
            active=tuple(active) if active or loops or couplings else None,
            home=home,
            friction=features.friction,
            forces=tuple(features.springs),
            ropes=tuple(features.ropes),
            tip=tip,
            couplings=couplings,
            source_locations=source_locations(loops, couplings) | home_locations,
            free=free,
            drives=tuple(features.drives.values()),
            gravity=(0.0,) * 3
            if "GRAVITY" in mjcf.disabled_features
            else to_vector(self.model.opt.gravity),
        )
        return with_rotation_vectors(spec)

    def _unique_link_name(self, name: str) -> str:
        """Return a name that no body and no other link has."""
        bodies = (self.mjcf.name("BODY", i) for i in range(self.model.nbody))
        return unique_name(name, {*bodies, *self.links})

    def _add_fixed_joint(self, link: str, parent: str, placement: pin.SE3) -> None:
        name = unique_name(f"{link}_fixed", {*self.joints, *self.names})
        self.joints[name] = Joint(
            name,
            "fixed",
            parent,
            link,
            self.links[link].source_location,
            *xyz_rpy_from_se3(placement),
        )

    def _read_body(self, body: int) -> None:
        model, name = self.model, self.mjcf.name("BODY", body)
        source_location = self.mjcf.source_location(name, "body")
        self.body_links.append(name)
        if body == 0:
            self.links[name] = Link(name, source_location)
            return
        inertia_pose = pose(model.body_iquat[body], model.body_ipos[body])
        rotation = inertia_pose.rotation
        tensor = rotation @ np.diag(model.body_inertia[body]) @ rotation.T
        first = model.body_jntadr[body]
        parent = self.body_links[model.body_parentid[body]]
        placement = pose(model.body_quat[body], model.body_pos[body])
        series_joints: list[Joint] = []
        previous_anchor = np.zeros(3)  # anchor of the previous joint, in the body's frame
        for joint in range(first, first + model.body_jntnum[body]):
            if model.jnt_type[joint] == 0:
                placement = pin.SE3.Identity()
            offset = pin.SE3(np.eye(3), model.jnt_pos[joint] - previous_anchor)
            previous_anchor = model.jnt_pos[joint].copy()
            new_joints = self._read_joint(joint, offset if series_joints else placement * offset)
            self.series_joints[joint] = [part.name for part in new_joints]
            series_joints += new_joints
        inertia = pin.Inertia(float(model.body_mass[body]), inertia_pose.translation, tensor)
        self.links[name] = Link(name, source_location, inertial_from_inertia(inertia))
        for i, part in enumerate(series_joints, start=1):
            child, is_last = name, i == len(series_joints)
            if not is_last or previous_anchor.any():
                child = self._unique_link_name(f"{name}_{i}")
                self.links[child] = Link(
                    child, source_location, composite_joint=None if is_last else name
                )
            if part.name in self.joints:
                raise DescriptionError(
                    f"{part.source_location}: two joints '{part.name}', rename one"
                )
            self.joints[part.name] = dataclasses.replace(part, parent=parent, child=child)
            parent = child
        if parent != name:
            if series_joints:
                placement = pin.SE3(np.eye(3), -previous_anchor)
            self._add_fixed_joint(name, parent, placement)

    def _read_joint(self, joint: int, placement: pin.SE3) -> list[Joint]:
        """Return the joints with one freedom that a joint consists of, without their links."""
        model, name = self.model, self.names[joint]
        source_location = self.mjcf.source_location(name, "joint", "freejoint")
        kind = self.mjcf.joint_type(joint)
        if kind in ("BALL", "FREE"):
            parts = joint_freedoms("spherical" if kind == "BALL" else "floating", (0.0, 0.0, 1.0))
            series_parts = joint_series(
                name, parts, xyz_rpy_from_se3(placement), ("", ""), source_location
            )
            return [part for part in series_parts if isinstance(part, Joint)]
        axis, joint_type = model.jnt_axis[joint].copy(), "revolute"
        offset = pin.SE3.Identity()
        reference_coordinate = float(model.qpos0[model.jnt_qposadr[joint]])
        if kind == "HINGE":
            offset.rotation = pin.AngleAxis(-reference_coordinate, axis).toRotationMatrix()
        else:
            joint_type = "prismatic"
            offset.translation = -reference_coordinate * axis
        limits = Limits(source_location=source_location)
        if model.jnt_limited[joint]:
            lower, upper = (parse_limit(float(x)) for x in model.jnt_range[joint])
            limits = Limits(lower, upper, source_location=source_location)
        place = xyz_rpy_from_se3(placement * offset)
        return [Joint(name, joint_type, "", "", source_location, *place, to_vector(axis), limits)]

    def _read_frames(self) -> MjcfFrames:
        frames = MjcfFrames(used_names=set(self.links))
        model = self.model
        for site in range(model.nsite):
            name = self.mjcf.element_name("SITE", site).strip()
            body = int(model.site_bodyid[site])
            placement = pose(model.site_quat[site], model.site_pos[site])
            if name and name == self.body_links[body] and placement.isIdentity(0.0):
                frames.link_of_site[site] = name
                continue
            frames.link_of_site[site] = frames.add(
                name or f"site{site + 1}", body, placement, self.mjcf.source_location(name, "site")
            )
        return frames

    def _home_coordinates(self) -> np.ndarray:
        """Return `qpos` of the key "home", else of the first key, else `qpos0`, within limits."""
        model = self.model
        keys = [self.mjcf.element_name("KEY", i) for i in range(model.nkey)]
        key_index = keys.index("home") if "home" in keys else 0
        qpos = np.array(model.key_qpos[key_index] if keys else model.qpos0)
        for joint, (name, *others) in self.series_joints.items():
            limits, i = self.joints[name].limits, model.jnt_qposadr[joint]
            if others or limits.lower <= qpos[i] <= limits.upper:
                continue
            inside = min(max(qpos[i], limits.lower), limits.upper)
            if qpos[i]:
                self.mjcf.note_difference(
                    "home is taken within the limits", f"{name} {qpos[i]:g} as {inside:g}"
                )
            qpos[i] = inside
        return qpos

    def _read_home(self, qpos: np.ndarray) -> dict[str, float]:
        """Return the coordinates that are not zero, by joint."""
        model = self.model
        home: dict[str, float] = {}
        for joint, joint_names in self.series_joints.items():
            kind, first = self.mjcf.joint_type(joint), model.jnt_qposadr[joint]
            translation_count = {"BALL": 0, "FREE": 3}.get(kind, 1)
            values = list(qpos[first : first + translation_count])
            if kind in ("BALL", "FREE"):
                quaternion = qpos[first + translation_count : first + translation_count + 4]
                values += cardan_angles(pose(quaternion, np.zeros(3)).rotation)
            home |= {x: float(y) for x, y in zip(joint_names, values, strict=True) if y}
        return home

    def _listed_joints(self, name: str) -> list[str]:
        """Return the joints that a `<text>` lists, none if one of them is unknown."""
        joints = [word for word in self.texts.get(name, "").split(", ") if word]
        if all(joint in self.joints for joint in joints):
            return joints
        self.mjcf.note_unsupported(f"the text '{name}', which names no joints", *joints)
        return []

    def _read_tip(self, tree: TreeBuilder) -> str | None:
        if not (tip := self.texts.get("tip")):
            return tree.single_leaf_link()
        if tip in tree.links and tree.is_movable(tip):
            return tip
        self.mjcf.note_unsupported(f"the text 'tip', which names no moving body or site '{tip}'")
        return None
