"""MJCF files of MuJoCo: bodies, joints, equality constraints and actuators."""

import dataclasses
from pathlib import Path

import numpy as np
import pinocchio as pin

from crane.common.errors import DescriptionError
from crane.description.rigid import inertial, placement, vector
from crane.description.spec import Chain, Drive, ForceElement, Friction, MachineSpec, places
from crane.description.tree import Inertial, Joint, Limits, Link, Tree, limit
from crane.formats.machine_file.tree_builder import TreeBuilder
from crane.formats.mjcf.equality import Frames, read_equality
from crane.formats.mjcf.file import MujocoFile
from crane.formats.mjcf.left_out import warn_of_the_rest
from crane.formats.series import parts_of, series
from crane.formats.urdf.read import Urdf


def read_mjcf(path: Path) -> MachineSpec:
    """Read a machine from a MJCF file.

    Coordinates are MuJoCo's: of a hinge or slide its `qpos`, of a ball the Cardan angles from its
    body's rest, of a free joint its body's place and Cardan angles in the world.

    Raises:
        DescriptionError: With file, line, and what is wrong or is not a part of a machine.
    """
    return _Reader(MujocoFile(path)).spec()


class _Reader:
    """What has been read so far.

    Args:
        mjcf: The file.
    """

    def __init__(self, mjcf: MujocoFile):
        self.mjcf, self.model = mjcf, mjcf.model
        self.links: dict[str, Link] = {}
        self.joints: dict[str, Joint] = {}
        self.bodies: list[str] = []  # their links
        self.parts: dict[int, list[str]] = {}  # joint of MuJoCo -> joints
        self.friction: dict[str, Friction] = {}
        self.forces: list[ForceElement] = []

    def spec(self) -> MachineSpec:
        """The machine."""
        mjcf = self.mjcf
        joints = [self._name("JOINT", i) for i in range(self.model.njnt)]
        self.names = joints
        for body in range(self.model.nbody):
            self._body(body)
        if not self.model.njnt:
            raise DescriptionError(f"{mjcf.file.name}: no joint moves in this file, add one")
        frames = self._frames()
        loops, couplings = read_equality(mjcf, frames, self.parts)
        for link, (body, place) in frames.made.items():
            self._add_link(link, frames.where[link])
            self._fix(link, self.bodies[body], place)
        warn_of_the_rest(mjcf, joints)
        urdf = Urdf(
            mjcf.file,
            mjcf.file.stem,
            Tree(self.links, self.joints),
            self.bodies[0],
            loops,
            None,
            self.friction,
            couplings,
        )
        chain = Chain(mjcf.file.stem, mjcf.file, None, mjcf.file.name, urdf.moving)
        tree = TreeBuilder()
        tree.add(chain, urdf)
        for loop in loops:
            tree.check_loop(loop)
        active = self._active()
        if active is None and (loops or couplings):
            active = ()
        home = self._home()
        homes = {f"home {joint}": self.joints[joint].where for joint in home}
        return MachineSpec(
            name=self._custom("name") or mjcf.file.stem,
            source=self._custom("source") or mjcf.file.name,
            path=mjcf.file,
            chains=(chain,),
            tree=tree.tree,
            loops=loops,
            active=active,
            home=home,
            friction=self.friction,
            forces=tuple(self.forces),
            tip=self._tip(tree),
            couplings=couplings,
            where=places(loops, couplings) | homes,
            drives=tuple(Drive(joint, {joint: 1.0}) for joint in active or ()),
        )

    def _name(self, kind: str, index: int) -> str:
        """Name of a body or joint, invented where it has none."""
        if kind == "BODY":
            return self.mjcf.body(index)
        return self.mjcf.name(kind, index).strip() or f"joint{index + 1}"

    def _link(self, wanted: str) -> str:
        """A name for a link that no body and no other link has."""
        taken = {self._name("BODY", i) for i in range(self.model.nbody)}
        taken |= self.links.keys()
        while wanted in taken:
            wanted += "_"
        return wanted

    def _add_link(
        self, name: str, where: str, mass: Inertial | None = None, between: str | None = None
    ) -> None:
        self.links[name] = Link(name, where, mass, between)

    def _fix(self, link: str, parent: str, place: pin.SE3) -> None:
        """Fix a link to another."""
        name = f"{link}_fixed"
        while name in self.joints or name in self.names:
            name += "_"
        where = self.links[link].where
        self.joints[name] = Joint(name, "fixed", parent, link, where, *placement(place))

    def _body(self, body: int) -> None:
        """A body with its joints."""
        model, name = self.model, self._name("BODY", body)
        where = self.mjcf.where(name, "body")
        self.bodies.append(name)
        if body == 0:
            self._add_link(name, where)
            return
        turn = _rotation(model.body_iquat[body])
        tensor = turn @ np.diag(model.body_inertia[body]) @ turn.T
        inertia = pin.Inertia(float(model.body_mass[body]), model.body_ipos[body].copy(), tensor)
        parent = self.bodies[model.body_parentid[body]]
        place = pin.SE3(_rotation(model.body_quat[body]), model.body_pos[body].copy())
        first = model.body_jntadr[body]
        parts: list[Joint] = []
        at = np.zeros(3)  # anchor of the part before, in the body's frame
        for joint in range(first, first + model.body_jntnum[body]):
            if model.jnt_type[joint] == 0:
                place = pin.SE3.Identity()
            anchor = model.jnt_pos[joint].copy()
            step = pin.SE3(np.eye(3), anchor - at)
            found = self._joint(joint, place * step if not parts else step)
            self.parts[joint] = [part.name for part in found]
            parts += found
            at = anchor
        self._add_link(name, where, inertial(inertia))
        for i, part in enumerate(parts):
            last = i == len(parts) - 1
            child = name if last and not at.any() else self._link(f"{name}_{i + 1}")
            if child != name:
                self._add_link(child, where, between=None if last else name)
            if part.name in self.joints:
                raise DescriptionError(f"{part.where}: two joints '{part.name}', rename one")
            self.joints[part.name] = dataclasses.replace(part, parent=parent, child=child)
            parent = child
        if parent != name:
            self._fix(name, parent, place if not parts else pin.SE3(np.eye(3), -at))

    def _joint(self, joint: int, place: pin.SE3) -> list[Joint]:
        """The freedoms of a joint, without their links, and what acts on them."""
        model, name = self.model, self.names[joint]
        where = self.mjcf.where(name, "joint", "freejoint")
        kind = self.mjcf.kind("Joint", model.jnt_type[joint])
        dof = model.jnt_dofadr[joint]
        if kind in ("BALL", "FREE"):
            parts = parts_of("spherical" if kind == "BALL" else "floating", (0.0, 0.0, 1.0))
            own = range(dof, dof + len(parts))
            if model.dof_damping[own].any() or model.dof_frictionloss[own].any() or (
                model.jnt_stiffness[joint]
            ):  # fmt: skip
                self.mjcf.warn(
                    f"damping, friction and stiffness of the {kind.lower()} joint '{name}' are "
                    "left out, a machine has them along single freedoms"
                )
            made = series(name, parts, placement(place), ("", ""), where)
            return [part for part in made if isinstance(part, Joint)]
        axis = model.jnt_axis[joint].copy()
        turns = kind == "HINGE"
        zero = float(model.qpos0[model.jnt_qposadr[joint]])
        if turns:
            place = place * pin.SE3(pin.AngleAxis(-zero, axis).toRotationMatrix(), np.zeros(3))
        else:
            place = place * pin.SE3(np.eye(3), -zero * axis)
        limits = Limits(where=where)
        if model.jnt_limited[joint]:
            lower, upper = (limit(float(x)) for x in model.jnt_range[joint])
            limits = Limits(lower, upper, where=where)
        damping, loss = float(model.dof_damping[dof]), float(model.dof_frictionloss[dof])
        if damping or loss:
            self.friction[name] = Friction(viscous=damping, coulomb=loss)
        if stiffness := float(model.jnt_stiffness[joint]):
            rest = float(model.qpos_spring[model.jnt_qposadr[joint]])
            self.forces.append(ForceElement(name, stiffness=stiffness, rest=rest))
        style = "revolute" if turns else "prismatic"
        return [Joint(name, style, "", "", where, *placement(place), vector(axis), limits)]

    def _frames(self) -> Frames:
        """Links of the named sites."""
        frames = Frames(taken=set(self.links))
        model = self.model
        for site in range(model.nsite):
            name = self.mjcf.name("SITE", site).strip()
            body = int(model.site_bodyid[site])
            place = pin.SE3(_rotation(model.site_quat[site]), model.site_pos[site].copy())
            if name and name == self.bodies[body] and place.isIdentity(0.0):
                frames.sites[site] = name
                continue
            frames.sites[site] = frames.add(
                name or f"site{site + 1}", body, place, self.mjcf.where(name, "site")
            )
        return frames

    def _active(self) -> tuple[str, ...] | None:
        """Joints that actuators drive, in their order."""
        model, found = self.model, []
        for index in range(model.nu):
            kind = self.mjcf.kind("Trn", model.actuator_trntype[index])
            name = self.mjcf.name("ACTUATOR", index)
            if kind not in ("JOINT", "JOINTINPARENT"):
                self.mjcf.warn(
                    f"the actuator '{name}' acts by a {kind.lower()} and is left out, those of "
                    "joints make them active"
                )
                continue
            parts = self.parts[int(model.actuator_trnid[index, 0])]
            if len(parts) > 1:
                where = self.mjcf.where(name, "motor", "position", "velocity", "general")
                raise DescriptionError(
                    f"{where}: the actuator '{name}' drives a joint with {len(parts)} freedoms, "
                    "drive hinges or slides"
                )
            if parts[0] not in found:
                found += parts
        return tuple(found) or None

    def _home(self) -> dict[str, float]:
        """Coordinates of the key "home", or else of the posture that the file draws."""
        model = self.model
        keys = {self.mjcf.name("KEY", i): i for i in range(model.nkey)}
        qpos = model.key_qpos[keys["home"]] if "home" in keys else model.qpos0
        home: dict[str, float] = {}
        for joint, names in self.parts.items():
            at = model.jnt_qposadr[joint]
            kind = self.mjcf.kind("Joint", model.jnt_type[joint])
            values = list(qpos[at : at + 1])
            if kind == "FREE":
                values = [*qpos[at : at + 3], *_cardan(_rotation(qpos[at + 3 : at + 7]))]
            elif kind == "BALL":
                values = _cardan(_rotation(qpos[at : at + 4]))
            home |= {x: float(value) for x, value in zip(names, values, strict=True) if value}
        return home

    def _custom(self, name: str) -> str:
        """A `<text>` under `<custom>`, empty where there is none."""
        model = self.model
        for index in range(model.ntext):
            if self.mjcf.name("TEXT", index) == name:
                start = model.text_adr[index]
                raw = bytes(model.text_data[start : start + model.text_size[index]])
                return raw.split(b"\0")[0].decode("utf-8", "replace").strip()
        return ""

    def _tip(self, tree: TreeBuilder) -> str | None:
        tip = self._custom("tip")
        if tip in tree.links and tree.moves(tip):
            return tip
        if tip:
            self.mjcf.warn(f"the text 'tip' names no moving body or site '{tip}', it is left out")
        return None if tip else tree.only_leaf()


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """(3, 3) of MuJoCo's quaternion, w first; of length zero: none."""
    length = float(np.linalg.norm(quaternion))
    if length == 0:
        return np.eye(3)
    w, x, y, z = (float(value) / length for value in quaternion)
    return np.asarray(pin.Quaternion(w, x, y, z).toRotationMatrix())


def _cardan(turn: np.ndarray) -> list[float]:
    """Angles a, b, c with turn = R_x(a) R_y(b) R_z(c)."""
    first = np.arctan2(-turn[1, 2], turn[2, 2])
    sine, cosine = np.sin(first), np.cos(first)
    second = np.arctan2(turn[0, 2], cosine * turn[2, 2] - sine * turn[1, 2])
    third = np.arctan2(
        cosine * turn[1, 0] + sine * turn[2, 0], cosine * turn[1, 1] + sine * turn[2, 1]
    )
    return [float(first), float(second), float(third)]
