"""Machine: the assembled, immutable result of reading and closing a description."""

import copy
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pinocchio as pin
from lxml import etree
from numpy.typing import ArrayLike

from crane.closure import Closure, frame_id
from crane.description import (
    Chain,
    EndStop,
    ForceElement,
    Friction,
    GasSpring,
    MachineSpec,
    PIGains,
    Task,
    bundled,
    changed,
    examples,
    inertia_problem,
    locked,
    read,
)
from crane.errors import DescriptionError, InputError, LimitError, MechanismError, known
from crane.samples import Array, as_number, as_sample, as_samples

_NO_LIMIT = 1e9  # stands for infinity in the text handed to Pinocchio
_LIMIT_SLACK = 1e-9  # [m], [rad] beyond a limit that counts as on it


@dataclass(frozen=True)
class Payload:
    """A rigid load put on a frame at run time.

    Attributes:
        frame: A link of the machine.
        mass: [kg].
        com: Centre of mass in the frame [m].
        inertia: (3, 3) about the centre of mass, in the frame's directions [kg m2]; zero for a
            point mass.
    """

    frame: str
    mass: float
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    inertia: ArrayLike = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class Machine:
    """A machine with closed kinematic chains, ready to be computed with.

    Attributes:
        name: Its name.
        source: Where its numbers come from.
        path: The machine file or URDF it was read from.
        chains: Its open sub-chains.
        model: Pinocchio's model of the spanning tree, depth-first, nq = nv.
        closure: Its loops.
        active: Names of the active joints, in the order of q_A.
        lower: (n,) lower limits of the active joints [m], [rad].
        upper: (n,) upper limits of the active joints [m], [rad].
        friction: Friction by joint.
        forces: Passive force elements.
        gas_springs: Enclosed gas along joints, at most one per joint.
        end_stops: End stops.
        tip: Name of the tip's frame.
        tasks: Named reference motions.
        control: PI gains by active joint.
        changes: Numbers that are not those of its files, by name.
    """

    name: str
    source: str
    path: Path
    chains: tuple[Chain, ...]
    model: pin.Model
    closure: Closure
    active: tuple[str, ...]
    lower: Array
    upper: Array
    friction: Mapping[str, Friction]
    forces: tuple[ForceElement, ...]
    gas_springs: tuple[GasSpring, ...]
    end_stops: tuple[EndStop, ...]
    tip: str | None
    tasks: Mapping[str, Task]
    control: Mapping[str, PIGains]
    changes: Mapping[str, float]

    @property
    def home(self) -> Array:
        """(nq,) the home posture, closed."""
        return self.closure.home

    @property
    def reference(self) -> str:
        """What `load` takes to load it again: the bundled name, or the path."""
        known_as = self.path.stem
        named = bundled() | examples()
        return known_as if named.get(known_as) == self.path else str(self.path)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of all joints of the tree, in the order of q."""
        return tuple(self.model.names)[1:]

    def column(self, joint: str) -> int:
        """Index of a joint in q and v.

        Raises:
            InputError: There is no such joint.
        """
        if joint not in self.joints:
            raise InputError(f"joint '{joint}' is unknown, {known(self.joints, joint)}")
        return int(self.model.joints[self.model.getJointId(joint)].idx_v)

    def unit(self, joint: str) -> str:
        """Unit of a joint's coordinate, "m" or "rad"."""
        self.column(joint)
        kind = self.model.joints[self.model.getJointId(joint)].shortname()
        return "m" if kind.startswith("JointModelP") else "rad"

    def frame(self, link: str) -> int:
        """Pinocchio's index of a link's frame.

        Raises:
            InputError: There is no such link.
        """
        links = [f.name for f in self.model.frames if f.type == pin.FrameType.BODY]
        if link not in links:
            raise InputError(f"frame '{link}' is unknown, {known(links, link)}")
        return frame_id(self.model, link)

    def check_limits(self, q_a: ArrayLike, what: str = "q_a") -> Array:
        """Active coordinates (n,) or (N, n) that lie within the limits.

        Raises:
            InputError: Wrong shape or not finite.
            LimitError: A coordinate lies outside of its limits.
        """
        q_a = as_samples(q_a, len(self.active), what, self.active)
        outside = (q_a < self.lower - _LIMIT_SLACK) | (q_a > self.upper + _LIMIT_SLACK)
        if outside.any():
            index = tuple(int(i) for i in np.argwhere(outside)[0])
            joint = index[-1]
            sample = f" in sample {index[0]}" if q_a.ndim == 2 else ""
            raise LimitError(
                f"{what}: {self.active[joint]} = {q_a[index]:.6g}{sample} is outside of its "
                f"limits {self.lower[joint]:.6g} to {self.upper[joint]:.6g} "
                f"{self.unit(self.active[joint])}, choose one within them"
            )
        return q_a

    def replace(
        self,
        *,
        friction: Mapping[str, Friction] | None = None,
        forces: tuple[ForceElement, ...] | None = None,
        gas_springs: tuple[GasSpring, ...] | None = None,
        end_stops: tuple[EndStop, ...] | None = None,
    ) -> "Machine":
        """The same machine with other friction, passive forces, gas springs or end stops.

        Raises:
            InputError: A joint is unknown, has two gas springs, or an end stop but no limits.
        """
        for joint in friction or {}:
            self.column(joint)
        for force in forces or ():
            self.column(force.joint)
        for spring in gas_springs or ():
            self.column(spring.joint)
            if [other.joint for other in gas_springs or ()].count(spring.joint) > 1:
                raise InputError(f"joint '{spring.joint}' has two gas springs, keep one")
        for stop in end_stops or ():
            column = self.column(stop.joint)
            limits = self.model.lowerPositionLimit[column], self.model.upperPositionLimit[column]
            if not np.isfinite(limits).all():
                raise InputError(f"joint '{stop.joint}' has no limits to stop at, give it some")
        return dataclasses.replace(
            self,
            friction=self.friction if friction is None else MappingProxyType(dict(friction)),
            forces=self.forces if forces is None else tuple(forces),
            gas_springs=self.gas_springs if gas_springs is None else tuple(gas_springs),
            end_stops=self.end_stops if end_stops is None else tuple(end_stops),
        )

    def with_payload(self, payload: Payload) -> "Machine":
        """The same machine carrying a payload.

        Raises:
            InputError: Unknown frame, or no possible mass and inertia.
        """
        frame = self.model.frames[self.frame(payload.frame)]
        com = as_sample(payload.com, 3, "the payload's com")
        tensor = as_samples(payload.inertia, 3, "the payload's inertia")
        mass = as_number(payload.mass, "the payload's mass", "kg")
        if mass < 0:
            raise InputError(f"the payload's mass is {mass:g} kg, it must not be negative")
        if tensor.shape != (3, 3) or not np.allclose(tensor, tensor.T, rtol=1e-9, atol=1e-15):
            raise InputError("the payload's inertia is not a symmetric (3, 3) matrix")
        problem = inertia_problem(mass, tensor)
        if problem and tensor.any():
            raise InputError(f"the payload has {problem}")
        model = pin.Model(self.model)
        model.appendBodyToJoint(frame.parentJoint, pin.Inertia(mass, com, tensor), frame.placement)
        return dataclasses.replace(self, model=model)


def load(
    name: str | Path,
    changes: Mapping[str, float] | None = None,
    lock: Mapping[str, float] | None = None,
) -> Machine:
    """Load a machine, perhaps with some of its numbers changed, or joints locked.

    Args:
        name: A bundled machine's name, a robot of example-robot-data by its file's name, or the
            path of a machine file (.yaml) or URDF (.urdf, with `<loop>` elements if it has loops).
        changes: New values by the names of `crane.description.parameters`, such as
            {"link3_G.x": 0.1, "link7.mass": 0.25, "payload.mass": 0.1}; SI units.
        lock: Coordinates [m], [rad] of joints to be fixed, by name.

    Returns:
        The machine, its home posture closed.

    Raises:
        DescriptionError: A file is wrong; the message has file and line.
        MechanismError: The parts do not make a machine that can be driven.
        InputError: A change of a parameter that is not there, or to what cannot be.
    """
    spec = read(name)
    if changes:
        spec = changed(spec, changes)
    if lock:
        spec = locked(spec, lock)
    for joint in spec.mimics:
        raise DescriptionError(
            f"{spec.where[f'joint {joint}']}: joint '{joint}' mimics another, which is not "
            "supported: make it fixed, or lock it"
        )
    model = _assemble(spec)
    active = tuple(model.names)[1:] if spec.active is None else spec.active
    try:
        closure = Closure(model, spec.loops, active, _home_guess(spec, model, active))
    except MechanismError as error:
        where = spec.where.get(error.about, spec.path.name)
        raise MechanismError(f"{where}: {error}", error.about) from None
    lower, upper = model.lowerPositionLimit, model.upperPositionLimit
    return Machine(
        name=spec.name,
        source=spec.source,
        path=spec.path,
        chains=spec.chains,
        model=model,
        closure=closure,
        active=active,
        lower=_fixed(lower[closure.active]),
        upper=_fixed(upper[closure.active]),
        friction=MappingProxyType(dict(spec.friction)),
        forces=spec.forces,
        gas_springs=spec.gas_springs,
        end_stops=spec.end_stops,
        tip=spec.tip,
        tasks=MappingProxyType(dict(spec.tasks)),
        control=MappingProxyType(dict(spec.control)),
        changes=MappingProxyType(dict(changes or {})),
    )


def _home_guess(spec: MachineSpec, model: pin.Model, active: tuple[str, ...]) -> Array:
    """(nq,) coordinates under `home`, of other joints zero or the limit nearest to it."""
    lower, upper = model.lowerPositionLimit, model.upperPositionLimit
    guess = np.clip(np.zeros(model.nq), lower, upper)
    for joint, value in spec.home.items():
        column = model.joints[model.getJointId(joint)].idx_q
        if joint in active and not lower[column] <= value <= upper[column]:
            raise DescriptionError(
                f"{spec.where[f'home {joint}']}: home of '{joint}' is {value:g}, outside of its "
                f"limits {lower[column]:g} to {upper[column]:g}, choose one within them"
            )
        guess[column] = value
    return guess


def _fixed(array: Array) -> Array:
    """A copy that cannot be changed."""
    out = array.copy()
    out.flags.writeable = False
    return out


def _assemble(spec: MachineSpec) -> pin.Model:
    """Pinocchio's model of the merged chains.

    One text for all chains, because Pinocchio then adds the joints depth-first: joints appended
    chain by chain make its crba wrong without a word.
    """
    robot = copy.deepcopy(spec.tree)
    for joint in robot.iter("joint"):
        if joint.get("type") == "continuous":
            joint.set("type", "revolute")  # Pinocchio's continuous joint has two coordinates
        if joint.get("type") != "fixed":
            limit = joint.find("limit")
            if limit is None:
                limit = etree.SubElement(joint, "limit")
            for key, sign in (("lower", "-"), ("upper", ""), ("effort", ""), ("velocity", "")):
                limit.set(key, limit.get(key, f"{sign}{_NO_LIMIT}"))
    model = pin.buildModelFromXML(etree.tostring(robot).decode())
    for limits in (
        model.lowerPositionLimit, model.upperPositionLimit, model.effortLimit, model.velocityLimit,
    ):  # fmt: skip
        endless = np.abs(limits) >= _NO_LIMIT
        limits[endless] = np.copysign(np.inf, limits[endless])
    model.name = spec.name
    moved = {joint.get("name"): joint.find("child").get("link") for joint in robot.iter("joint")}
    for index in range(1, model.njoints):
        name = model.names[index]
        inertia = model.inertias[index]
        link = moved[name]
        where = spec.where[f"link {link}"]
        if not inertia.mass > 0:
            raise DescriptionError(
                f"{where}: joint '{name}' moves link '{link}', which has no mass, give it an "
                "<inertial>"
            )
        if problem := inertia_problem(inertia.mass, inertia.inertia):
            raise DescriptionError(
                f"{where}: link '{link}' with what is fixed to it has {problem}"
            )
    return model
