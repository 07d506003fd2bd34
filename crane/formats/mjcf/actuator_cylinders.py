"""Actuators between sites of a MJCF file as cylinders without mass.

The length of a spatial tendon over sites is the sum of the distances of successive sites, those
behind a pulley divided by its divisor. Each distance that changes becomes a strut: a universal
joint at the first site, a prismatic joint whose coordinate is the distance, and a spherical loop
at the second site. Its three coordinates and three equations leave the mobility as it is. Tendons
over the same two sites share it. An actuator by a slider and a crank has a prismatic joint along
the z axis of the slider's site, and a strut of constant length from there to the crank's site.
"""

from itertools import pairwise

import numpy as np
import pinocchio as pin

from crane.description.kinematic_tree import (
    X_AXIS,
    Y_AXIS,
    Z_AXIS,
    Joint,
    Limits,
    Link,
    joint_series,
)
from crane.description.pinocchio_conversion import xyz_rpy_from_se3
from crane.description.specification import LoopSpec
from crane.formats.mjcf.mujoco_file import MujocoFile

_MIN_LENGTH = 1e-9  # [m] of a strut, which has a direction
_MIN_SINE = 0.1  # of the angle between a strut and the axis of a hinge that its first pin follows
_DEAD_CENTRE_TOLERANCE = 1e-6  # of the lever arm over the length
_RANGE_SAMPLES = 201  # over the range of a joint
_MAX_STRUTS = 100  # each adds three joints
_NAME_SUFFIXES = (
    "", "_1", "_2", "_pin_y", "_pin_z", "_end", "_eye", "_slider", "_rod", "_rod_1", "_rod_2",
    "_rod_pin_y", "_rod_pin_z", "_rod_end", "_rod_eye",
)  # fmt: skip
_ACTUATOR_TAGS = (
    "general", "motor", "position", "velocity", "intvelocity", "damper", "cylinder", "muscle",
)  # fmt: skip
_PINS = [("pin_y", "revolute", Y_AXIS), ("pin_z", "revolute", Z_AXIS)]


class MjcfCylinders:
    """Joints, links and loops of actuators by spatial tendons over sites, and by slider and crank.

    Args:
        mjcf: The file.
        sites: Name of the link by site.
        used_names: Names of its links and joints, which receives those of the cylinders.
        home: (nq,) MuJoCo's coordinates of the home configuration.

    Attributes:
        parts: Links and joints.
        loops: Loops that close them.
        home: Lengths by joint [m].
        tendon_factors: By tendon the factors of joints in its length.
        tendon_offsets: By tendon its length [m] with these joints at zero.
        actuator_joints: By actuator with slider and crank the joint of the slider.
        resting: Prismatic joints that do not move at first order at home, at a dead centre.
    """

    def __init__(
        self, mjcf: MujocoFile, sites: dict[int, str], used_names: set[str], home: np.ndarray
    ):
        self.parts: list[Link | Joint] = []
        self.loops: list[LoopSpec] = []
        self.home: dict[str, float] = {}
        self.tendon_factors: dict[int, dict[str, float]] = {}
        self.tendon_offsets: dict[int, float] = {}
        self.actuator_joints: dict[int, str] = {}
        self.resting: set[str] = set()
        self._mjcf, self._model, self._used_names = mjcf, mjcf.model, used_names
        self._links = sites
        self._data = mjcf.kinematics(home)
        self._struts: dict[frozenset[int], str] = {}  # joints by their two sites
        for actuator in range(mjcf.model.nu):
            kind, target = mjcf.transmission(actuator)
            if kind == "TENDON" and target not in self.tendon_factors:
                self._add_tendon(target)
            elif kind == "SLIDERCRANK":
                self._add_slider_crank(actuator)

    def _add_tendon(self, tendon: int) -> None:
        """Add the struts of a tendon, if it runs over sites and pulleys only."""
        weld = np.array(self._model.body_weldid)
        weld[self._model.body_mocapid[weld] >= 0] = 0  # what a program moves stands still
        weld = weld[self._model.site_bodyid]
        moving = [x for x in self._segments(tendon) if weld[x[0]] != weld[x[1]]]
        lengths = [float(np.linalg.norm(self._vector(*sites))) for *sites, _ in moving]
        shares: dict[frozenset[int], float] = {}  # in the length, by the two sites
        for *sites, divisor in moving:
            shares[frozenset(sites)] = shares.get(frozenset(sites), 0.0) + 1.0 / divisor
        new_pairs = [pair for pair in shares if pair not in self._struts]
        is_too_many = len(self._struts) + len(new_pairs) > _MAX_STRUTS
        if not moving or min(lengths) < _MIN_LENGTH or is_too_many:
            return
        name = self._mjcf.name("TENDON", tendon)
        location = self._mjcf.source_location(name, "spatial")
        parts = (length / x[2] for length, x in zip(lengths, moving, strict=True))
        offset = float(self._data.ten_length[tendon]) - sum(parts)
        bounds = None
        if len(shares) == 1 and self._model.tendon_limited[tendon]:
            (share,) = shares.values()
            bounds = (self._model.tendon_range[tendon] - offset) / share
        for i, pair in enumerate(new_pairs, start=1):
            first, second = next((x[0], x[1]) for x in moving if pair == {x[0], x[1]})
            strut = self._unique_name(name if len(new_pairs) == 1 else f"{name}_{i}")
            ends = self._length_range(first, second) if bounds is None else bounds
            limits = Limits(source_location=location)
            if ends is not None:
                limits = Limits(max(float(ends[0]), 0.0), float(ends[1]), source_location=location)
            self._add_strut(strut, (first, second), self._vector(first, second), location, limits)
            self._struts[pair] = strut
            if self._is_resting(first, second, self._data.site_xpos[first]):
                self.resting.add(strut)
        self.tendon_factors[tendon] = {self._struts[x]: y for x, y in shares.items()}
        self.tendon_offsets[tendon] = offset

    def _segments(self, tendon: int) -> list[tuple[int, int, float]]:
        """First and second site and divisor of each part; none if it runs over other things."""
        divisor = 1.0
        path: list[tuple[int, float]] = []  # site, -1 of a pulley, and the divisor there
        for kind, item, parameter in self._mjcf.tendon_path(tendon):
            if kind not in ("SITE", "PULLEY"):
                return []
            divisor = parameter if kind == "PULLEY" else divisor
            path.append((item if kind == "SITE" else -1, divisor))
        return [
            (first, second, divisor)
            for (first, _), (second, divisor) in pairwise(path)
            if min(first, second) >= 0
        ]

    def _add_slider_crank(self, actuator: int) -> None:
        """Add the slider and the rod to the crank, if they meet at home."""
        crank, slider = (int(x) for x in self._model.actuator_trnid[actuator])
        rod_length = float(self._model.actuator_cranklength[actuator])
        rotation, vector = self._rotation(slider), self._vector(slider, crank)
        along = float(vector @ rotation[:, 2])
        squared = along**2 + rod_length**2 - float(vector @ vector)
        if squared <= _MIN_LENGTH**2:
            return
        length = along - float(np.sqrt(squared))
        name = self._unique_name(self._mjcf.name("ACTUATOR", actuator))
        location = self._mjcf.source_location(name, *_ACTUATOR_TAGS)
        slide = f"{name}_slider"
        joint = Joint(name, "prismatic", self._links[slider], slide, location, axis=Z_AXIS)
        self.parts += [Link(slide, location, composite_joint=name), joint]
        self.actuator_joints[actuator] = name
        self.home[name] = length
        rod = vector - length * rotation[:, 2]
        self._add_strut(f"{name}_rod", (slider, crank), rod, location, link=slide)
        if self._is_resting(slider, crank, self._data.site_xpos[crank] - rod):
            self.resting.add(name)

    def _add_strut(
        self,
        name: str,
        sites: tuple[int, int],
        vector: np.ndarray,
        location: str,
        limits: Limits | None = None,
        link: str = "",
    ) -> None:
        """Add two pins, a prismatic joint, or a constant length without limits, and the loop.

        Args:
            name: Name of the prismatic joint.
            sites: Site whose axes the first pin's place is in, and site at the end.
            vector: (3,) to its end in the world, at home [m].
            location: File and line.
            limits: Limits of the prismatic joint.
            link: Link at whose origin it begins; that of the first site if not given.
        """
        length = float(np.linalg.norm(vector))
        direction = vector / length
        normal = self._pin_direction(direction, *sites)
        rotation = np.column_stack([direction, normal, np.cross(direction, normal)])
        placement = xyz_rpy_from_se3(pin.SE3(self._rotation(sites[0]).T @ rotation, np.zeros(3)))
        rod_end = f"{name}_end"
        series = joint_series(name, [*_PINS, ("slide", "prismatic", X_AXIS)], placement,
                              (link or self._links[sites[0]], rod_end), location)  # fmt: skip
        *pins, slide = series
        assert isinstance(slide, Joint)
        if limits is None:
            slide = Joint(slide.name, "fixed", slide.parent, rod_end, location, (length, 0.0, 0.0))
        else:
            slide = Joint(name, "prismatic", slide.parent, rod_end, location, limits=limits)
            self.home[name] = length
        self.parts += [*pins, slide, Link(rod_end, location, composite_joint=name)]
        self.loops.append(
            LoopSpec(f"{name}_eye", "spherical", rod_end, self._links[sites[1]], Z_AXIS,
                     location)
        )  # fmt: skip

    def _is_resting(self, first: int, second: int, start: np.ndarray) -> bool:
        """Whether the distance from a point on the body of one site to another one is at rest."""
        bodies, end = self._model.site_bodyid, self._data.site_xpos[second]
        jacobians = (
            self._mjcf.point_jacobian(self._data, point, int(bodies[site]))
            for site, point in ((first, start), (second, end))
        )
        rates = (end - start) @ (-np.subtract(*jacobians))
        return bool(
            np.abs(rates).max() < _DEAD_CENTRE_TOLERANCE * float((end - start) @ (end - start))
        )

    def _length_range(self, first: int, second: int) -> np.ndarray | None:
        """Return least and largest distance of two sites between the limits of their only joint.

        It is on the side of a dead centre on which home is; None with several joints or no limits.
        """
        model, joints = self._model, self._joints_between(first, second)
        is_limited = (
            len(joints) == 1 and model.jnt_limited[joints[0]] and model.jnt_type[joints[0]] >= 2
        )
        if not is_limited:
            return None
        index, qpos = int(model.jnt_qposadr[joints[0]]), np.array(self._data.qpos)
        lower, upper = (float(x) for x in model.jnt_range[joints[0]])
        values, data = np.linspace(lower, upper, _RANGE_SAMPLES), self._mjcf.kinematics(qpos)
        home = int(np.abs(values - qpos[index]).argmin())
        values[home] = qpos[index]
        lengths = np.empty(len(values))
        for i, value in enumerate(values):
            qpos[index] = value
            sites = self._mjcf.kinematics(qpos, data).site_xpos
            lengths[i] = np.linalg.norm(sites[second] - sites[first])
        turns = np.flatnonzero(np.diff(np.sign(np.diff(lengths)))) + 1
        start = turns[turns <= home].max(initial=0)
        end = turns[turns > home].min(initial=len(values) - 1)
        return np.array([lengths[start : end + 1].min(), lengths[start : end + 1].max()])

    def _joints_between(self, first: int, second: int) -> list[int]:
        """Return the joints on the path between two sites in the tree."""
        bodies = set[int]()
        for site in (first, second):
            body, path = int(self._model.site_bodyid[site]), set[int]()
            while body:
                path.add(body)
                body = int(self._model.body_parentid[body])
            bodies ^= path
        return [i for i, body in enumerate(self._model.jnt_bodyid) if int(body) in bodies]

    def _pin_direction(self, direction: np.ndarray, first: int, second: int) -> np.ndarray:
        """Return a unit vector (3,) across a direction, along a hinge between two sites if any.

        In a planar mechanism the second pin then stays at zero.
        """
        hinges = [
            joint
            for joint in self._joints_between(first, second)
            if self._mjcf.joint_type(joint) == "HINGE"
        ]
        across = (x - (x @ direction) * direction for x in [*self._data.xaxis[hinges], *np.eye(3)])
        found = next(x for x in across if np.linalg.norm(x) > _MIN_SINE)
        return found / np.linalg.norm(found)

    def _vector(self, first: int, second: int) -> np.ndarray:
        return np.array(self._data.site_xpos[second] - self._data.site_xpos[first])

    def _rotation(self, site: int) -> np.ndarray:
        return np.array(self._data.site_xmat[site]).reshape(3, 3)

    def _unique_name(self, name: str) -> str:
        while any(f"{name}{suffix}" in self._used_names for suffix in _NAME_SUFFIXES):
            name += "_"
        self._used_names.add(name)
        return name
