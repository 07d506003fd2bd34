"""MJCF files of MuJoCo: bodies, joints, equality constraints and actuators."""

import dataclasses
from pathlib import Path

import numpy as np
import pinocchio as pin

from crane.common.errors import DescriptionError
from crane.description.floating import with_rotation_vectors
from crane.description.rigid import inertial, placement, vector
from crane.description.spec import Chain, MachineSpec, places
from crane.description.tree import Inertial, Joint, Limits, Link, Tree, limit, with_rotors
from crane.formats.machine_file.tree_builder import TreeBuilder
from crane.formats.mjcf.acting import isotropic, read_acting
from crane.formats.mjcf.actuators import read_drives
from crane.formats.mjcf.equality import Frames, read_equality
from crane.formats.mjcf.file import MujocoFile
from crane.formats.mjcf.left_out import note_the_rest
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

    def spec(self) -> MachineSpec:
        """The machine."""
        mjcf = self.mjcf
        self.names = [mjcf.joint(i) for i in range(self.model.njnt)]
        for body in range(self.model.nbody):
            self._body(body)
        if not self.model.njnt:
            raise DescriptionError(f"{mjcf.file.name}: no joint moves in this file, add one")
        frames = self._frames()
        loops, couplings = read_equality(mjcf, frames, self.parts)
        for link, (body, place) in frames.made.items():
            self._add_link(link, frames.where[link])
            self._fix(link, self.bodies[body], place)
        acting, drives = read_acting(mjcf, self.parts, frames.sites), read_drives(mjcf, self.parts)
        note_the_rest(mjcf)
        urdf = Urdf(
            mjcf.file,
            mjcf.file.stem,
            with_rotors(Tree(self.links, self.joints), acting.rotors),
            self.bodies[0],
            loops,
            None,
            acting.friction,
            couplings,
        )
        chain = Chain(mjcf.file.stem, mjcf.file, None, mjcf.file.name, urdf.moving)
        tree = TreeBuilder()
        tree.add(chain, urdf)
        for loop in loops:
            tree.check_loop(loop)
        active = self._listed("active")
        for drive in drives if not active else ():
            # one joint of each: what else it moves hangs on that, or is another coordinate
            active += [x for x in drive.factors if x not in active][:1]
        free = self._listed("free")
        home, tip = self._home(), self._tip(tree)
        mjcf.tell()
        homes = {f"home {joint}": self.joints[joint].where for joint in home}
        spec = MachineSpec(
            name=self._custom("name") or mjcf.file.stem,
            source=self._custom("source") or mjcf.file.name,
            path=mjcf.file,
            chains=(chain,),
            tree=tree.tree,
            loops=loops,
            active=tuple(active) if active or loops or couplings else None,
            home=home,
            friction=acting.friction,
            forces=tuple(acting.springs),
            ropes=tuple(acting.ropes),
            tip=tip,
            couplings=couplings,
            where=places(loops, couplings) | homes,
            free=tuple(free),
            drives=drives,
        )
        return with_rotation_vectors(spec)

    def _link(self, wanted: str) -> str:
        """A name for a link that no body and no other link has."""
        taken = {self.mjcf.body(i) for i in range(self.model.nbody)}
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
        model, name = self.model, self.mjcf.body(body)
        where = self.mjcf.where(name, "body")
        self.bodies.append(name)
        if body == 0:
            self._add_link(name, where)
            return
        turn = _rotation(model.body_iquat[body])
        tensor = turn @ np.diag(model.body_inertia[body]) @ turn.T
        first = model.body_jntadr[body]
        joints = range(first, first + model.body_jntnum[body])
        for joint in joints:
            if self.mjcf.kind("Joint", model.jnt_type[joint]) in ("BALL", "FREE"):
                tensor = tensor + isotropic(self.mjcf, joint) * np.eye(3)
        inertia = pin.Inertia(float(model.body_mass[body]), model.body_ipos[body].copy(), tensor)
        parent = self.bodies[model.body_parentid[body]]
        place = pin.SE3(_rotation(model.body_quat[body]), model.body_pos[body].copy())
        parts: list[Joint] = []
        at = np.zeros(3)  # anchor of the part before, in the body's frame
        for joint in joints:
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
        """The freedoms of a joint, without their links."""
        model, name = self.model, self.names[joint]
        where = self.mjcf.where(name, "joint", "freejoint")
        kind = self.mjcf.kind("Joint", model.jnt_type[joint])
        if kind in ("BALL", "FREE"):
            parts = parts_of("spherical" if kind == "BALL" else "floating", (0.0, 0.0, 1.0))
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

    def _home(self) -> dict[str, float]:
        """Coordinates of the key "home", else of the first key, else as the file draws them."""
        model = self.model
        keys = [self.mjcf.name("KEY", i) for i in range(model.nkey)]
        at_home = keys.index("home") if "home" in keys else 0
        qpos = model.key_qpos[at_home] if keys else model.qpos0
        home: dict[str, float] = {}
        for joint, names in self.parts.items():
            at = model.jnt_qposadr[joint]
            kind = self.mjcf.kind("Joint", model.jnt_type[joint])
            values = list(qpos[at : at + 1])
            if kind == "FREE":
                values = [*qpos[at : at + 3], *_cardan(_rotation(qpos[at + 3 : at + 7]))]
            elif kind == "BALL":
                values = _cardan(_rotation(qpos[at : at + 4]))
            home |= {x: self._within(x, float(y)) for x, y in zip(names, values, strict=True) if y}
        return home

    def _within(self, joint: str, value: float) -> float:
        """A coordinate of home within the limits of its joint."""
        limits = self.joints[joint].limits
        inside = min(max(value, limits.lower), limits.upper)
        if inside != value:
            self.mjcf.differ("home is taken within the limits", f"{joint} {value:g} as {inside:g}")
        return inside

    def _custom(self, name: str) -> str:
        """A `<text>` under `<custom>`, empty where there is none."""
        model = self.model
        for index in range(model.ntext):
            if self.mjcf.name("TEXT", index) == name:
                start = model.text_adr[index]
                raw = bytes(model.text_data[start : start + model.text_size[index]])
                return raw.split(b"\0")[0].decode("utf-8", "replace").strip()
        return ""

    def _listed(self, name: str) -> list[str]:
        """Joints that a `<text>` lists, none if one of them is not there."""
        joints = [word for word in self._custom(name).split(", ") if word]
        if all(joint in self.joints for joint in joints):
            return joints
        self.mjcf.lose(f"the text '{name}', which names no joints", *joints)
        return []

    def _tip(self, tree: TreeBuilder) -> str | None:
        tip = self._custom("tip")
        if tip in tree.links and tree.moves(tip):
            return tip
        if tip:
            self.mjcf.lose(f"the text 'tip', which names no moving body or site '{tip}'")
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
