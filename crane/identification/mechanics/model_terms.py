"""Terms of an identification model: bodies, rotors, friction, gas springs."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Protocol

import numpy as np

from crane.common.errors import InputError, check_name
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.description.force_elements import Friction
from crane.dynamics.dynamics import Dynamics
from crane.dynamics.friction_history import dahl_deflections, remembered_speeds
from crane.dynamics.joint_forces import JointForces, root_speed
from crane.machine.machine import Machine

BODY_PARAMETERS = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
ForceShape = Callable[[Array], Array]


@dataclass(frozen=True, eq=False, repr=False)
class MotionSamples(OneLineRepr):
    """Samples of a motion with closed loops.

    Attributes:
        q_a: (N, n) active coordinates [m], [rad].
        v_a: (N, n).
        a_a: (N, n).
        q: (N, nq) coordinates of all joints.
        gamma: (N, nv, n).
        step: Step of the samples [s], None if they are not consecutive.
        starts: Indices at which recordings begin; terms with memory are reset there.
        term_states: States of terms with memory at the start of a part of a longer motion, by
            term; a term replaces its state (not in place) by that at the end of the part.
    """

    q_a: Array
    v_a: Array
    a_a: Array
    q: Array
    gamma: Array
    step: float | None = None
    starts: Sequence[int] = (0,)
    term_states: dict[object, Any] = field(default_factory=dict)


class ModelTerm(Protocol):
    """Term of an identification model: some columns of the regressor W.

    Attributes:
        names: (k,) names of its parameters.
        nominal: (k,) values by the description of the machine.
        nonnegative: (k,) whether a parameter must not be negative.
    """

    names: tuple[str, ...]
    nominal: Array
    nonnegative: tuple[bool, ...]

    def columns(self, samples: MotionSamples) -> Array:
        """Columns (N, n, k) of W."""


@dataclass(frozen=True)
class ForceDirection:
    """Direction of a force: a joint of the tree, or a combination of active joints.

    Attributes:
        name: Name of the joint, or of the combination (a motor that turns two joints).
        factors: Factors by active joint; None for the joint `name`.
    """

    name: str
    factors: Mapping[str, float] | None = None

    def coordinate(self, machine: Machine, samples: MotionSamples) -> Array:
        """Coordinate (N,) along the direction [m], [rad]."""
        if self.factors is None:
            return samples.q[:, machine.column(self.name)]
        return np.einsum("ij,ij->i", self.jacobian(machine, samples), samples.q_a)

    def jacobian(self, machine: Machine, samples: MotionSamples) -> Array:
        """Derivatives (N, n) of the coordinate by q_A."""
        if self.factors is None:
            return samples.gamma[:, machine.column(self.name)]
        row = np.zeros(len(machine.active))
        for joint, factor in self.factors.items():
            check_name(
                joint, machine.active, f"'{self.name}' combines '{joint}', which is not active"
            )
            row[machine.active.index(joint)] = factor
        return np.broadcast_to(row, samples.v_a.shape)


class DirectionalTerm(ModelTerm):
    """Term of a force along a direction.

    Args:
        machine: The machine.
        direction: Name of a joint, active or passive, or a combination of active ones.
        kinds: (k,) names of the parameters along it.
        nominal: (k,) values by the description of the machine.
        nonnegative: (k,) whether a parameter must not be negative.

    Attributes:
        direction: The direction.
        law_constants: Fields of `Friction` that are no parameters of the term.
    """

    law_constants: Mapping[str, float] = {}

    def __init__(
        self,
        machine: Machine,
        direction: str | ForceDirection,
        kinds: Iterable[str],
        nominal: Sequence[float],
        nonnegative: Iterable[bool],
    ):
        self.direction = ForceDirection(direction) if isinstance(direction, str) else direction
        if self.direction.factors is None:
            machine.column(self.direction.name)  # raises an error for an unknown joint
        self._machine, self.nominal = machine, np.array(nominal, dtype=np.float64)
        self.names = tuple(f"{self.direction.name}.{kind}" for kind in kinds)
        self.nonnegative = tuple(nonnegative)


class InertialTerm(ModelTerm):
    """Term of the bodies: ten parameters each about the joint frame, Y_A = gamma^T Y(q, v, a)."""

    def __init__(self, machine: Machine):
        self._dynamics = Dynamics(machine)
        bodies = body_names(machine)
        self.nominal = self._dynamics.parameters[: 10 * len(bodies)]
        self.names = tuple(f"{body}.{key}" for body in bodies for key in BODY_PARAMETERS)
        # feasibility of a body is no matter of signs
        self.nonnegative = (False,) * len(self.names)

    def columns(self, samples: MotionSamples) -> Array:
        """See `ModelTerm`."""
        return inertial_regressor(self._dynamics, samples)


def inertial_regressor(dynamics: Dynamics, samples: MotionSamples) -> Array:
    """Columns (N, n, 10 nb) of the bodies in `Dynamics.regressor` along a closed motion."""
    found = dynamics.evaluate_closed("regressor", samples.q, samples.v_a, samples.a_a)
    return found.reshape(*samples.v_a.shape, -1)[:, :, : 10 * (dynamics.machine.model.njoints - 1)]


def body_names(machine: Machine) -> tuple[str, ...]:
    """Names of the links that the joints move, in the order of the joints."""
    model = machine.model
    links: dict[int, str] = {}  # first link of each joint
    for frame in model.frames:
        if frame.type.name == "BODY":
            links.setdefault(frame.parentJoint, frame.name)
    return tuple(links[joint] for joint in range(1, model.njoints))


class RotorInertiaTerm(DirectionalTerm):
    """Term of a rotor inertia along a direction s, such as that of a geared motor.

        tau_A = c s'' I,   c = ds/dq_A,   s'' = c^T a_A + dc^T/dt v_A.

    The nominal value is the `rotor_inertia` of the machine.

    Args:
        machine: The machine.
        direction: Name of a joint, active or passive, or a combination of active ones.
    """

    def __init__(self, machine: Machine, direction: str | ForceDirection):
        super().__init__(machine, direction, ("rotor_inertia",), (0.0,), (True,))
        if (joint := machine.tree.joints.get(self.direction.name)) is not None:
            self.nominal[0] = joint.rotor_inertia

    def columns(self, samples: MotionSamples) -> Array:
        """See `ModelTerm`."""
        rows = self.direction.jacobian(self._machine, samples)
        rate = np.einsum("ij,ij->i", rows, samples.a_a)
        if self.direction.name not in self._machine.active and not self.direction.factors:
            v = np.einsum("kij,kj->ki", samples.gamma, samples.v_a)
            drift = self._machine.closure.drift(samples.q, v)
            rate = rate + drift[:, self._machine.column(self.direction.name)]
        return (rows * rate[:, None])[:, :, None]


class VelocityFriction(DirectionalTerm):
    """Friction term: known functions of the velocity along one direction times parameters.

    Args:
        machine: The machine.
        direction: Name of a joint, or a combination.
        shapes: Functions velocity (N,) -> (N,) by name of the parameter.
        nominal: Nominal values; default zero.
        nonnegative: Names of parameters that must not be negative.
    """

    def __init__(
        self,
        machine: Machine,
        direction: str | ForceDirection,
        shapes: Mapping[str, ForceShape],
        nominal: Mapping[str, float] | None = None,
        nonnegative: Sequence[str] = (),
    ):
        values = [(nominal or {}).get(name, 0.0) for name in shapes]
        signs = [name in nonnegative for name in shapes]
        super().__init__(machine, direction, shapes, values, signs)
        self._shapes = shapes

    def columns(self, samples: MotionSamples) -> Array:
        """See `ModelTerm`."""
        rows = self.direction.jacobian(self._machine, samples)
        speed = np.einsum("ij,ij->i", rows, samples.v_a)
        force = np.stack([shape(speed) for shape in self._shapes.values()], axis=1)
        return rows[:, :, None] * force[:, None, :]


def _described_law(machine: Machine, direction: str | ForceDirection) -> Friction:
    """Described friction along a direction; where there is none, with an unsmoothed sign."""
    name = direction if isinstance(direction, str) else direction.name
    return machine.friction.get(name, Friction(smoothing=0.0))


def _smoothed_sign(v: Array, smoothing: float) -> Array:
    """Sign of velocities as in the simulation."""
    return np.tanh(v / smoothing) if smoothing else np.sign(v)


def friction_term(
    machine: Machine,
    direction: str | ForceDirection,
    kinds: Sequence[str] = ("coulomb", "coulomb_offset", "viscous", "viscous_offset"),
    smoothing: float | None = None,
    stribeck: Sequence[float] = (),
) -> VelocityFriction:
    """Friction term of equation (5) of the reduced-scale forwarder paper, with stiction.

        coulomb s + coulomb_offset + viscous v + viscous_offset |v|
        + stiction s e^-(v / v_1)^2 + stiction_2 s e^-(v / v_2)^2,    s = sign(v).

    Args:
        machine: The machine, whose friction gives the nominal values.
        direction: Name of a joint, or a combination.
        kinds: Names of the kinds, some of the four.
        smoothing: Smoothing velocity of the sign [m/s], [rad/s]; default that of the machine.
        stribeck: At most two Stribeck velocities v_i [m/s], [rad/s].
    """
    law = _described_law(machine, direction)
    width = law.smoothing if smoothing is None else smoothing

    def sign(v: Array) -> Array:
        return _smoothed_sign(v, width)

    shapes_by_kind: dict[str, ForceShape] = {
        "coulomb": sign,
        "coulomb_offset": np.ones_like,
        "viscous": lambda v: v,
        "viscous_offset": lambda v: v * sign(v),
    }
    for kind in kinds:
        check_name(kind, shapes_by_kind, f"friction '{kind}' is unknown")
    shapes = {kind: shapes_by_kind[kind] for kind in kinds}
    nominal = {kind: getattr(law, kind) for kind in kinds}
    constants = {"smoothing": width}
    for number, v_s in zip(("", "_2"), stribeck, strict=False):
        label = f"stiction{number}"
        shapes[label] = lambda v, v_s=v_s: sign(v) * np.exp(-((v / v_s) ** 2))  # type: ignore[misc]
        constants[f"stribeck{number}"] = v_s
        if getattr(law, f"stribeck{number}") == v_s:
            nominal[label] = getattr(law, label)
    term = VelocityFriction(
        machine, direction, shapes, nominal, nonnegative=("coulomb", "viscous")
    )
    term.law_constants = constants
    return term


def root_friction_term(machine: Machine, direction: str | ForceDirection) -> VelocityFriction:
    """Friction term of mixed lubrication: root sign(v) sqrt |v|."""
    nominal = {"root": _described_law(machine, direction).root}
    return VelocityFriction(machine, direction, {"root": root_speed}, nominal)


class FrictionalMemory(DirectionalTerm):
    """Frictional memory: memory sign(v) e^-(w / speed), lag w' = |v| - w, w = 0 at the start.

    The friction is larger after rest than before it, as the contact changes with a lag.

    Args:
        machine: The machine.
        direction: Name of a joint, or a combination.
        lag: Time constant [s].
        speed: Characteristic speed [m/s], [rad/s].
    """

    def __init__(
        self, machine: Machine, direction: str | ForceDirection, lag: float, speed: float
    ):
        law = _described_law(machine, direction)
        is_described = (lag, speed) == (law.memory_time, law.memory_speed)
        super().__init__(
            machine, direction, ("memory",), (law.memory if is_described else 0.0,), (False,)
        )
        if not (lag > 0 and speed > 0):
            raise InputError(
                f"the memory of '{self.direction.name}' has the lag {lag:g} s and the speed "
                f"{speed:g}, give two numbers above 0"
            )
        self._lag, self._speed, self._smoothing = lag, speed, law.smoothing
        self.law_constants = {"memory_time": lag, "memory_speed": speed}

    def columns(self, samples: MotionSamples) -> Array:
        """See `ModelTerm`."""
        if samples.step is None:
            raise InputError(f"'{self.names[0]}' depends on time, give the step of the samples")
        rows = self.direction.jacobian(self._machine, samples)
        v = np.einsum("ij,ij->i", rows, samples.v_a)
        w, state = np.empty_like(v), samples.term_states.get(self, 0.0)
        for start, end in pairwise(sorted({0, *samples.starts, len(v)})):
            state = 0.0 if start in samples.starts else state
            w[start:end], state = remembered_speeds(v[start:end], samples.step, self._lag, state)
        samples.term_states[self] = state
        force = _smoothed_sign(v, self._smoothing) * np.exp(-w / self._speed)
        return (rows * force[:, None])[:, :, None]


class PreslidingFriction(DirectionalTerm):
    """Presliding friction: Dahl's law over the travelled distance.

    F = force z, dz = (1 - sign(v) z) ds / length, z = 0 at the start of a recording (Dahl, 1968).

    Args:
        machine: The machine.
        direction: Name of a joint, or a combination.
        length: Characteristic distance [m], [rad].
    """

    def __init__(self, machine: Machine, direction: str | ForceDirection, length: float):
        law = _described_law(machine, direction)
        nominal = law.presliding if length == law.presliding_length else 0.0
        super().__init__(machine, direction, ("presliding",), (nominal,), (True,))
        if not length > 0:
            raise InputError(f"the length of presliding of '{self.direction.name}' is {length:g}")
        self._length, self.law_constants = length, {"presliding_length": length}

    def columns(self, samples: MotionSamples) -> Array:
        """See `ModelTerm`."""
        rows = self.direction.jacobian(self._machine, samples)
        travel = self.direction.coordinate(self._machine, samples)
        state, z = samples.term_states.get(self, (0.0, None)), np.empty(len(travel))
        for start, end in pairwise(sorted({0, *samples.starts, len(travel)})):
            state = (0.0, None) if start in samples.starts else state
            z[start:end] = dahl_deflections(travel[start:end], self._length, *state)
            state = (z[end - 1], travel[end - 1])
        samples.term_states[self] = state
        return rows[:, :, None] * z[:, None, None]


FrictionTerm = VelocityFriction | PreslidingFriction | FrictionalMemory


class GasSpringTerm(ModelTerm):
    """Term of a gas spring: a factor on its force with the nominal value 1.

    Args:
        machine: The machine.
        joint: Joint of the gas spring, or its name.
    """

    def __init__(self, machine: Machine, joint: str):
        names = [spring.joint for spring in machine.gas_springs]
        check_name(joint, names, f"joint '{joint}' has no gas spring")
        springs = [spring for spring in machine.gas_springs if spring.joint == joint]
        self._joint_forces = JointForces(machine.replace(gas_springs=tuple(springs)))
        self.names, self.nominal, self.nonnegative = (f"{joint}.gas_scale",), np.ones(1), (True,)

    def columns(self, samples: MotionSamples) -> Array:
        """See `ModelTerm`."""
        return -np.einsum("kij,ki->kj", samples.gamma, self._joint_forces.gas_forces(samples.q))[
            :, :, None
        ]
