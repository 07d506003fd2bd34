"""Multibody systems as every engine can build them, and their states."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pinocchio as pin

import crane

Array = np.ndarray


@dataclass(frozen=True)
class Body:
    """A rigid body on a joint of the spanning tree.

    Attributes:
        name: Name of the joint.
        parent: Index of the body that carries it, -1 for the world.
        is_revolute: Whether the joint rotates; it slides otherwise.
        axis: Unit vector (3,) of the joint in the frame of the body.
        placement: (4, 4) frame of the body in that of its parent at coordinate 0.
        mass: [kg].
        com: Centre of mass (3,) in the frame of the body [m].
        inertia: About the centre of mass (3, 3), axes of the body [kg m2].
        stiffness: Of a spring along the joint [N/m], [N m/rad].
        rest: Coordinate at which it is slack [m], [rad].
        damping: Along the joint [N s/m], [N m s/rad].
        force: Constant force along the joint [N], [N m].
    """

    name: str
    parent: int
    is_revolute: bool
    axis: Array
    placement: Array
    mass: float
    com: Array
    inertia: Array
    stiffness: float = 0.0
    rest: float = 0.0
    damping: float = 0.0
    force: float = 0.0


@dataclass(frozen=True)
class Mount:
    """A frame (4, 4) on a body, -1 for the world."""

    body: int
    placement: Array


@dataclass(frozen=True)
class Loop:
    """A joint that closes a loop: coincident origins and, if `axis` is given, a common axis.

    Attributes:
        predecessor: Frame on the one body.
        successor: Frame on the other body.
        axis: Of a revolute joint in both frames (3,); None for a ball.
    """

    predecessor: Mount
    successor: Mount
    axis: Array | None


@dataclass(frozen=True)
class Spring:
    """A spring and damper along the distance of two points."""

    ends: tuple[Mount, Mount]
    stiffness: float
    rest: float
    damping: float


@dataclass(frozen=True)
class State:
    """Poses and velocities of all bodies in the world.

    Attributes:
        rotation: (n, 3, 3) of the frames of the bodies.
        position: (n, 3) of the centres of mass [m].
        velocity: (n, 3) of the centres of mass [m/s].
        angular_velocity: (n, 3) [rad/s].
    """

    rotation: Array
    position: Array
    velocity: Array
    angular_velocity: Array


@dataclass(frozen=True, eq=False)
class Multibody:
    """A tree of bodies with joints of one degree of freedom, and loops.

    Attributes:
        machine: The machine that it was read from.
        model: Its spanning tree for Pinocchio.
        loops: What closes the loops.
        couplings: Rows C (k, n) of linear constraints C v = 0 of velocities of joints.
        springs: Between points.
        gravity: (3,) [m/s2].
        q: Closed configuration (n,) at the start, in crane's coordinates.
        v: Velocities (n,) of all joints there.
    """

    machine: crane.Machine
    model: pin.Model
    loops: tuple[Loop, ...]
    couplings: Array
    springs: tuple[Spring, ...]
    gravity: Array
    q: Array
    v: Array

    @classmethod
    def from_machine(
        cls, machine: crane.Machine, velocity: dict[str, float], start: float = 0.0
    ) -> "Multibody":
        """The system at the home configuration of a machine, with velocities of active joints.

        Args:
            machine: The machine.
            velocity: Of active joints at the start, by name; 0 where not given.
            start: Size of the active coordinates at the start, with the signs of those at home,
                where home is next to a change point; 0 for home itself.

        Raises:
            ValueError: A loop is no pin and no ball, or a coupling is not linear.
        """
        model, closure = machine.model, machine.closure
        if closure.equations.coupling_powers.any():
            raise ValueError("a coupling is not linear")
        q = np.array(machine.home)
        if start:
            signs = np.sign(q) * (np.abs(q) > 1e-6)
            q = closure.solve(start * signs[closure.active])
        v = closure.gamma(q) @ np.array([velocity.get(name, 0.0) for name in machine.active])
        return cls(
            machine=machine,
            model=model,
            loops=tuple(_loop(machine, loop) for loop in closure.equations.loops),
            couplings=closure.equations.coupling_factors,
            springs=tuple(
                Spring(
                    (_mount(machine, element.between[0]), _mount(machine, element.between[1])),
                    element.stiffness,
                    element.rest,
                    element.damping,
                )
                for element in machine.forces
                if element.between
            ),
            gravity=np.array(model.gravity.linear),
            q=q,
            v=v,
        )

    @cached_property
    def bodies(self) -> tuple[Body, ...]:
        """Bodies in the order of the joints of `model`.

        Raises:
            ValueError: A joint has several degrees of freedom, or joints are coupled.
        """
        if len(self.couplings):
            raise ValueError("joints are coupled")
        bodies = tuple(
            _body(self.model, i, self.joint_force_parameters) for i in range(1, self.model.njoints)
        )
        return _possible_bodies(bodies)

    def configuration(self, q: Array) -> Array:
        """Pinocchio's configuration of coordinates (n,), with quaternions of balls."""
        return self.machine.closure.equations.coordinates.configuration(q)

    @cached_property
    def start(self) -> State:
        """State at the start."""
        return self.state(self.q, self.v)

    def joint_forces(self, q: Array, v: Array) -> Array:
        """Forces (n,) of springs, dampers and constant forces along joints [N], [N m]."""
        stiffness, rest, damping, force = self.joint_force_parameters
        return stiffness * (rest - q) - damping * v + force

    @cached_property
    def joint_force_parameters(self) -> Array:
        """Stiffness, rest, damping and constant force (4, n) along the joints."""
        values = np.zeros((4, self.model.nv))
        for element in self.machine.forces:
            if element.joint:
                values[:, self.machine.column(element.joint)] = (
                    element.stiffness, element.rest, element.damping, element.force,
                )  # fmt: skip
        return values

    def state(self, q: Array, v: Array, data: pin.Data | None = None) -> State:
        """State of all bodies at coordinates and velocities (n,) of the tree."""
        model = self.model
        data = data or model.createData()
        pin.forwardKinematics(model, data, q, v)
        spatial = [pin.getVelocity(model, data, i, pin.WORLD) for i in range(1, model.njoints)]
        rotation = np.array([data.oMi[i].rotation for i in range(1, model.njoints)])
        position = np.array(
            [data.oMi[i].act(model.inertias[i].lever) for i in range(1, model.njoints)]
        )
        angular = np.array([velocity.angular for velocity in spatial])
        linear = np.array([velocity.linear for velocity in spatial])
        return State(rotation, position, linear + np.cross(angular, position), angular)

    def point(self, state: State, mount: Mount) -> Array:
        """Position (3,) of the origin of a frame on a body."""
        if mount.body < 0:
            return mount.placement[:3, 3]
        body = self.bodies[mount.body]
        offset = mount.placement[:3, 3] - body.com
        return state.position[mount.body] + state.rotation[mount.body] @ offset

    def direction(self, state: State, mount: Mount, axis: Array) -> Array:
        """Vector (3,) in the world that is given in a frame on a body."""
        rotation = np.eye(3) if mount.body < 0 else state.rotation[mount.body]
        return rotation @ mount.placement[:3, :3] @ axis

    def joint_point(self, state: State, i: int) -> Array:
        """Position (3,) of the origin of the frame of a body."""
        return self.point(state, Mount(i, np.eye(4)))

    def joint_axis(self, state: State, i: int) -> Array:
        """Axis (3,) of the joint of a body in the world."""
        return state.rotation[i] @ self.bodies[i].axis

    def joint_coordinate(self, state: State, i: int) -> float:
        """Coordinate of the joint of a body [m], or between -pi and pi [rad]."""
        body = self.bodies[i]
        mount = Mount(body.parent, body.placement)
        if not body.is_revolute:
            offset = self.joint_point(state, i) - self.point(state, mount)
            return float(offset @ self.direction(state, mount, body.axis))
        start = np.column_stack([self.direction(state, mount, column) for column in np.eye(3)])
        turn = start.T @ state.rotation[i]
        return float(pin.log3(turn) @ body.axis)

    def is_planar_loop(self, loop: Loop) -> bool:
        """Whether all joints of a loop move in the plane across its axis.

        Such a loop has two independent equations: one point of contact, in the plane.
        """
        if loop.axis is None:
            return False
        axis = self.direction(self.start, loop.predecessor, loop.axis)
        paths = [self._path(mount.body) for mount in (loop.predecessor, loop.successor)]
        for i in set(paths[0]) ^ set(paths[1]):
            along = abs(self.joint_axis(self.start, i) @ axis)
            if abs(along - self.bodies[i].is_revolute) > 1e-9:
                return False
        return True

    def _path(self, body: int) -> list[int]:
        """Bodies from one to the root."""
        path = []
        while body >= 0:
            path.append(body)
            body = self.bodies[body].parent
        return path

    def loop_error(self, state: State) -> float:
        """Largest distance of the two origins of a loop [m]."""
        gaps = [
            np.linalg.norm(self.point(state, loop.predecessor) - self.point(state, loop.successor))
            for loop in self.loops
        ]
        return float(max(gaps, default=0.0))

    def energy(self, state: State) -> float:
        """Kinetic energy, that of gravity and of springs [J].

        Springs along revolute joints have to stay within half a turn of their frame.
        """
        masses = np.array([body.mass for body in self.bodies])
        kinetic = 0.5 * masses @ (state.velocity**2).sum(axis=1)
        for body, turn, omega in zip(
            self.bodies, state.rotation, state.angular_velocity, strict=True
        ):
            local = turn.T @ omega
            kinetic += 0.5 * local @ body.inertia @ local
        potential = -masses @ (state.position @ self.gravity)
        for spring in self.springs:
            one, two = (self.point(state, end) for end in spring.ends)
            potential += 0.5 * spring.stiffness * (np.linalg.norm(two - one) - spring.rest) ** 2
        for i, body in enumerate(self.bodies):
            if body.stiffness:
                stretch = self.joint_coordinate(state, i) - body.rest
                potential += 0.5 * body.stiffness * stretch**2
        return float(kinetic + potential)


def _body(model: pin.Model, i: int, forces: Array) -> Body:
    joint, inertia = model.joints[i], model.inertias[i]
    if joint.nv != 1 or joint.nq != 1:
        raise ValueError(f"joint '{model.names[i]}' has {joint.nv} degrees of freedom")
    data = joint.createData()
    joint.calc(data, np.zeros(1))
    subspace = np.asarray(data.S).ravel()
    is_revolute = bool(np.abs(subspace[3:]).max() > 0.5)
    stiffness, rest, damping, force = forces[:, joint.idx_v]
    return Body(
        name=model.names[i],
        parent=model.parents[i] - 1,
        is_revolute=is_revolute,
        axis=subspace[3:] if is_revolute else subspace[:3],
        placement=np.array(model.jointPlacements[i].homogeneous),
        mass=inertia.mass,
        com=np.array(inertia.lever),
        inertia=np.array(inertia.inertia),
        stiffness=stiffness,
        rest=rest,
        damping=damping,
        force=force,
    )


def _possible_bodies(bodies: tuple[Body, ...]) -> tuple[Body, ...]:
    """Bodies that can exist and move alike.

    Planar machines are written with inertias of which no body can be; engines refuse them. If all
    joints turn about parallel axes, only the moment about these matters.
    """
    rotations, axes = [], []
    for body in bodies:
        parent = np.eye(3) if body.parent < 0 else rotations[body.parent]
        rotations.append(parent @ body.placement[:3, :3])
        axes.append(rotations[-1] @ body.axis)
    is_planar = all(body.is_revolute for body in bodies) and np.allclose(np.abs(axes @ axes[0]), 1)
    if not is_planar or all(_is_possible(body.inertia) for body in bodies):
        return bodies
    return tuple(
        replace(body, inertia=body.axis @ body.inertia @ body.axis * np.eye(3)) for body in bodies
    )


def _is_possible(inertia: Array) -> bool:
    """Whether the principal moments are positive and none is above the sum of the others."""
    moments = np.linalg.eigvalsh(inertia)
    return moments[0] > 0 and moments[2] <= moments[0] + moments[1]


def _mount(machine: crane.Machine, name: str) -> Mount:
    frame = machine.model.frames[machine.frame(name)]
    return Mount(frame.parentJoint - 1, np.array(frame.placement.homogeneous))


def _loop(machine: crane.Machine, loop: object) -> Loop:
    kinds: Sequence[str] = ("revolute", "spherical")
    if loop.type not in kinds:  # type: ignore[attr-defined]
        raise ValueError(f"loop '{loop.name}' is {loop.type}")  # type: ignore[attr-defined]
    ends = _mount(machine, loop.predecessor), _mount(machine, loop.successor)  # type: ignore[attr-defined]
    axis = np.array(loop.axis) if loop.type == "revolute" else None  # type: ignore[attr-defined]
    return Loop(*ends, axis)
