"""tau = W beta: the drives' forces as linear functions of a machine's parameters."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError, known
from crane.common.samples import Array, Brief, as_samples
from crane.description import Friction
from crane.dynamics import Dynamics
from crane.dynamics.joint_forces import JointForces
from crane.dynamics.lengths import Lengths
from crane.machine import Machine

PER_BODY = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")


@dataclass(frozen=True, eq=False, repr=False)
class Samples(Brief):
    """A closed motion.

    Attributes:
        q_a: (N, n) active coordinates [m], [rad].
        v_a: (N, n).
        a_a: (N, n).
        q: (N, nq) all coordinates.
        gamma: (N, nv, n).
        starts: Indices where recordings begin: what depends on the past starts anew there.
        memory: Of a part of a longer motion, what each term that depends on the past has kept of
            the part before, by term; it puts there (anew, not in place) what the next one needs.
    """

    q_a: Array
    v_a: Array
    a_a: Array
    q: Array
    gamma: Array
    starts: Sequence[int] = (0,)
    memory: dict[object, Any] = field(default_factory=dict)


class Term(Protocol):
    """Some columns of W.

    Attributes:
        names: (k,) of its parameters.
        nominal: (k,) their values by the machine's description.
        signs: (k,) whether a parameter cannot be negative.
    """

    names: tuple[str, ...]
    nominal: Array
    signs: tuple[bool, ...]

    def columns(self, at: Samples) -> Array:
        """(N, n, k)."""


class Inertial:
    """Ten parameters per body about its joint frame's origin, Y_A = gamma^T Y(q, v, a)."""

    def __init__(self, machine: Machine):
        self._dynamics = Dynamics(machine)
        bodies = body_names(machine)
        self.nominal = self._dynamics.parameters[: 10 * len(bodies)]
        self.names = tuple(f"{body}.{key}" for body in bodies for key in PER_BODY)
        self.signs = (False,) * len(self.names)  # that a body is possible is more than signs

    def columns(self, at: Samples) -> Array:
        """See `Term`."""
        return inertial_columns(self._dynamics, at)


def inertial_columns(dynamics: Dynamics, at: Samples) -> Array:
    """The bodies' part of `Dynamics.regressor`, (N, n, 10 nb), along a closed motion."""
    found = dynamics.at("regressor", at.q, at.v_a, at.a_a)
    return found.reshape(*at.v_a.shape, -1)[:, :, : 10 * (dynamics.machine.model.njoints - 1)]


def body_names(machine: Machine) -> tuple[str, ...]:
    """The link that each joint moves, in the order of the joints."""
    model = machine.model
    names = []
    for joint in range(1, model.njoints):
        frames = [f for f in model.frames if f.parentJoint == joint and f.type.name == "BODY"]
        names.append(frames[0].name)
    return tuple(names)


@dataclass(frozen=True)
class Direction:
    """Along what a force acts: a joint of the tree, active joints together, or a distance.

    Attributes:
        name: The joint's, or what to call the combination (a motor that turns with two joints) or
            the distance.
        factors: By active joint; None for the joint `name`.
        between: Two links whose distance it is.
    """

    name: str
    factors: Mapping[str, float] | None = None
    between: tuple[str, str] | None = None

    def coordinate(self, machine: Machine, at: Samples) -> Array:
        """(N,) [m], [rad]."""
        if self.between is not None:
            return Lengths(machine, [self.between]).at(at.q)[0][:, 0]
        if self.factors is None:
            return at.q[:, machine.column(self.name)]
        return np.einsum("ij,ij->i", self.rows(machine, at), at.q_a)

    def rows(self, machine: Machine, at: Samples) -> Array:
        """(N, n) derivative of the direction's coordinate by q_A."""
        if self.between is not None:
            slopes = Lengths(machine, [self.between]).at(at.q)[1]
            return np.einsum("ki,kij->kj", slopes[:, 0], at.gamma)
        if self.factors is None:
            return at.gamma[:, machine.column(self.name)]
        row = np.zeros(len(machine.active))
        for joint, factor in self.factors.items():
            if joint not in machine.active:
                raise InputError(
                    f"'{self.name}' combines '{joint}', which is not active, "
                    f"{known(machine.active, joint)}"
                )
            row[machine.active.index(joint)] = factor
        return np.broadcast_to(row, at.v_a.shape)


def _direction(machine: Machine, given: str | Direction) -> Direction:
    """The direction of a joint's name, or the one given; raises for what is not there."""
    direction = Direction(given) if isinstance(given, str) else given
    if direction.between is not None:
        for link in direction.between:
            machine.frame(link)
    elif direction.factors is None:
        machine.column(direction.name)
    return direction


Shape = Callable[[Array], Array]


class Along:
    """Forces along one direction whose shapes over its velocity are known: friction.

    Args:
        machine: The machine.
        direction: A joint's name, or a combination.
        shapes: Velocity (N,) -> (N,) by name of the parameter.
        nominal: Their values; zero if not given.
        positive: Names of parameters that cannot be negative.
    """

    def __init__(
        self,
        machine: Machine,
        direction: str | Direction,
        shapes: Mapping[str, Shape],
        nominal: Mapping[str, float] | None = None,
        positive: Sequence[str] = (),
    ):
        direction = _direction(machine, direction)
        self._machine, self._direction, self._shapes = machine, direction, shapes
        self.names = tuple(f"{direction.name}.{name}" for name in shapes)
        self.nominal = np.array([(nominal or {}).get(name, 0.0) for name in shapes])
        self.signs = tuple(name in positive for name in shapes)

    def columns(self, at: Samples) -> Array:
        """See `Term`."""
        rows = self._direction.rows(self._machine, at)
        speed = np.einsum("ij,ij->i", rows, at.v_a)
        return np.stack([rows * shape(speed)[:, None] for shape in self._shapes.values()], axis=2)


def sign_of(smoothing: float) -> Shape:
    """sign(v), smoothed to tanh(v / smoothing) as in the simulation."""
    if smoothing == 0:
        return np.sign
    return lambda v: np.tanh(v / smoothing)


def friction(
    machine: Machine,
    direction: str | Direction,
    kinds: Sequence[str] = ("coulomb", "coulomb_offset", "viscous", "viscous_offset"),
    smoothing: float | None = None,
    stribeck: Sequence[float] = (),
) -> Along:
    """Friction of equation (5) of the reduced-scale forwarder paper, and Stribeck's.

        coulomb s + coulomb_offset + viscous v + viscous_offset |v|
        + sum_i stiction_i s e^-(v / v_i)^2,    s = sign(v).

    Args:
        machine: The machine, whose own friction is nominal.
        direction: A joint's name, or a combination.
        kinds: Which of the four.
        smoothing: Of the sign [m/s], [rad/s]; the machine's if not given, 0 for a jump.
        stribeck: Velocities v_i [m/s], [rad/s].
    """
    name = direction if isinstance(direction, str) else direction.name
    law = machine.friction.get(name, Friction(smoothing=0.0))
    sign = sign_of(law.smoothing if smoothing is None else smoothing)
    every: dict[str, Shape] = {
        "coulomb": sign,
        "coulomb_offset": np.ones_like,
        "viscous": lambda v: v,
        "viscous_offset": lambda v: v * sign(v),
    }
    for kind in kinds:
        if kind not in every:
            raise InputError(f"friction '{kind}' is unknown, {known(every, kind)}")
    shapes = {kind: every[kind] for kind in kinds}
    nominal = {kind: getattr(law, kind) for kind in kinds}
    for v_s in stribeck:
        label = "stiction" if len(stribeck) == 1 else f"stiction_{v_s:g}"
        shapes[label] = lambda v, v_s=v_s: sign(v) * np.exp(-((v / v_s) ** 2))  # type: ignore[misc]
        if law.stribeck == v_s:
            nominal[label] = law.stiction
    return Along(machine, direction, shapes, nominal, positive=("coulomb", "viscous"))


class Presliding:
    """Friction that has to be wound up first: Dahl's law over the travelled distance.

    F = force z, dz = (1 - sign(v) z) ds / length, z = 0 where a recording begins (Dahl, 1968).

    Args:
        machine: The machine.
        direction: A joint's name, or a combination.
        length: Distance over which it winds up [m], [rad].
    """

    def __init__(self, machine: Machine, direction: str | Direction, length: float):
        direction = _direction(machine, direction)
        if not length > 0:
            raise InputError(f"the length of presliding of '{direction.name}' is {length:g}")
        self._machine, self._direction, self._length = machine, direction, length
        self.names, self.nominal = (f"{direction.name}.presliding",), np.zeros(1)
        self.signs = (True,)

    def columns(self, at: Samples) -> Array:
        """See `Term`."""
        rows = self._direction.rows(self._machine, at)
        way = self._direction.coordinate(self._machine, at)
        state, last = at.memory.get(self, (0.0, way[0]))
        steps = np.diff(way, prepend=last) / self._length
        steps[list(at.starts)] = 0.0
        z = np.empty(len(way))
        fresh = set(at.starts)
        for i, step in enumerate(steps.tolist()):
            if i in fresh:
                state = 0.0
            end = 1.0 if step > 0 else -1.0
            state = end + (state - end) * np.exp(-abs(step))  # exact for a steady direction
            z[i] = state
        at.memory[self] = (state, way[-1])
        return rows[:, :, None] * z[:, None, None]


class RotorInertia:
    """Inertia that moves with a direction, such as a motor's behind its gear: c (c . a_A) I.

    Args:
        machine: The machine.
        direction: An active joint's name, or a combination of them.
        nominal: [kg], [kg m2] on the joint's side.
    """

    def __init__(self, machine: Machine, direction: str | Direction, nominal: float = 0.0):
        if isinstance(direction, str):
            direction = Direction(direction, {direction: 1.0})
        self._machine, self._direction = machine, direction
        self.names, self.nominal = (f"{direction.name}.rotor",), np.array([nominal])
        self.signs = (True,)

    def columns(self, at: Samples) -> Array:
        """See `Term`."""
        rows = self._direction.rows(self._machine, at)
        return (rows * np.einsum("ij,ij->i", rows, at.a_a)[:, None])[:, :, None]


class GasScale:
    """A factor on the force of a gas spring, whose nominal value is 1.

    Args:
        machine: The machine.
        joint: That the gas spring acts on, or its own name.
    """

    def __init__(self, machine: Machine, joint: str):
        springs = [spring for spring in machine.gas_springs if spring.joint == joint]
        if not springs:
            names = [spring.joint for spring in machine.gas_springs]
            raise InputError(f"joint '{joint}' has no gas spring, {known(names, joint)}")
        self._forces = JointForces(machine.replace(gas_springs=tuple(springs)))
        self.names, self.nominal, self.signs = (f"{joint}.gas_scale",), np.ones(1), (True,)

    def columns(self, at: Samples) -> Array:
        """See `Term`."""
        return -np.einsum("kij,ki->kj", at.gamma, self._forces.gas(at.q))[:, :, None]


class SpringForce:
    """A passive force of known shape along a joint or distance times an unknown factor.

    Args:
        machine: The machine.
        direction: A joint's name, active or passive, or a combination or distance.
        shape: Coordinate (N,) [m], [rad] -> force in the positive direction per factor.
        name: Of the factor.
        nominal: Its value.
    """

    def __init__(
        self,
        machine: Machine,
        direction: str | Direction,
        shape: Shape,
        name: str,
        nominal: float = 0.0,
    ):
        self._machine, self._shape = machine, shape
        self._direction = _direction(machine, direction)
        self.names, self.nominal = (f"{self._direction.name}.{name}",), np.array([nominal])
        self.signs = (False,)

    def columns(self, at: Samples) -> Array:
        """See `Term`."""
        force = self._shape(self._direction.coordinate(self._machine, at))
        return -(self._direction.rows(self._machine, at) * force[:, None])[:, :, None]


def default_terms(machine: Machine) -> list[Term]:
    """Bodies; four coefficients of friction per active joint, viscous friction of passive ones."""
    terms: list[Term] = [Inertial(machine)]
    terms += [friction(machine, joint) for joint in machine.active]
    passive = [joint for joint in machine.joints if joint not in machine.active]
    for joint in passive:
        law = machine.friction.get(joint)
        rough = law is not None and law.coulomb > 0
        terms.append(friction(machine, joint, ("coulomb", "viscous") if rough else ("viscous",)))
    return terms


class Model:
    """The parameters of a machine and their linear effect on the drives' forces.

        tau_A = W(q_A, v_A, a_A) beta + known,

    known = gamma^T (I_r a - f) with the passive forces f and the rotor inertias I_r of the machine
    that no term scales.

    Args:
        machine: The machine.
        terms: Groups of columns; `default_terms` if not given.
        known: Samples -> (N, n), in the place of these forces.

    Attributes:
        names: (p,) of the parameters.
        nominal: (p,) values by the machine's description.
        signs: (p,) whether a parameter cannot be negative.
        bodies: Names of the bodies, whose inertial parameters are the first 10 nb columns, or ()
            where the model has none.

    Raises:
        InputError: Two parameters of the same name.
    """

    def __init__(
        self,
        machine: Machine,
        terms: Sequence[Term] | None = None,
        known: Callable[[Samples], Array] | None = None,
    ):
        self.machine = machine
        self.terms = list(default_terms(machine) if terms is None else terms)
        self.terms.sort(key=lambda term: not isinstance(term, Inertial))
        self.names = tuple(name for term in self.terms for name in term.names)
        twice = {name for name in self.names if self.names.count(name) > 1}
        if twice:
            raise InputError(f"two terms have the parameter '{sorted(twice)[0]}', keep one")
        self.nominal = np.concatenate([term.nominal for term in self.terms])
        self.signs = tuple(sign for term in self.terms for sign in term.signs)
        has_bodies = isinstance(self.terms[0], Inertial)
        self.bodies = body_names(machine) if has_bodies else ()
        scaled = {
            name.removesuffix(".gas_scale") for name in self.names if name.endswith(".gas_scale")
        }
        rest = tuple(spring for spring in machine.gas_springs if spring.joint not in scaled)
        self._forces = JointForces(machine.replace(gas_springs=rest))
        estimated = [joint for joint in machine.joints if f"{joint}.rotor" in self.names]
        self._rotors = np.array(machine.model.armature)
        self._rotors[[machine.column(joint) for joint in estimated]] = 0.0
        self._given = known

    def samples(
        self, q_a: ArrayLike, v_a: ArrayLike, a_a: ArrayLike, starts: Sequence[int] = (0,)
    ) -> Samples:
        """Close the loops along a motion, (N, n) each."""
        active = self.machine.active
        q_a, v_a, a_a = (
            np.atleast_2d(as_samples(x, len(active), name, active))
            for x, name in ((q_a, "q_a"), (v_a, "v_a"), (a_a, "a_a"))
        )
        closure = self.machine.closure
        q = closure.solve(q_a)
        return Samples(q_a, v_a, a_a, q, closure.gamma(q), starts)

    def regressor(self, at: Samples) -> Array:
        """W (N, n, p)."""
        return np.concatenate([term.columns(at) for term in self.terms], axis=2)

    def known(self, at: Samples) -> Array:
        """Forces (N, n) that no parameter changes: tau = W beta + known."""
        if self._given is not None:
            return self._given(at)
        v = np.einsum("kij,kj->ki", at.gamma, at.v_a)
        force = -self._forces.passive(at.q, v)
        if self._rotors.any():
            drift = self.machine.closure.drift(at.q, v)
            force += self._rotors * (np.einsum("kij,kj->ki", at.gamma, at.a_a) + drift)
        return np.einsum("kij,ki->kj", at.gamma, force)
