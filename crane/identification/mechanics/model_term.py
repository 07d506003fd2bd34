"""Terms of an identification model, and those of bodies and rotors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from crane.common.errors import InputError, suggest_names
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.dynamics.dynamics import Dynamics
from crane.dynamics.frame_jacobians import FrameDistances
from crane.machine.machine import Machine

BODY_PARAMETERS = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")


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
    """Direction of a force: a joint of the tree, a combination of active joints, or a distance.

    Attributes:
        name: Name of the joint, or of the combination (a motor that turns two joints) or distance.
        factors: Factors by active joint; None for the joint `name`.
        between: The two links of a distance.
    """

    name: str
    factors: Mapping[str, float] | None = None
    between: tuple[str, str] | None = None

    def has_locked_joint(self, machine: Machine) -> bool:
        """Whether it combines joints of which one is locked."""
        return any(joint in machine.locked_joints for joint in self.factors or ())

    def coordinate(self, machine: Machine, samples: MotionSamples) -> Array:
        """Coordinate (N,) along the direction [m], [rad]."""
        if self.between is not None:
            return FrameDistances(machine, [self.between]).evaluate(samples.q)[0][:, 0]
        if self.factors is None:
            return samples.q[:, machine.column(self.name)]
        return np.einsum("ij,ij->i", self.jacobian(machine, samples), samples.q_a)

    def jacobian(self, machine: Machine, samples: MotionSamples) -> Array:
        """Derivatives (N, n) of the coordinate by q_A."""
        if self.between is not None:
            length_derivatives = FrameDistances(machine, [self.between]).evaluate(samples.q)[1]
            return np.einsum("ki,kij->kj", length_derivatives[:, 0], samples.gamma)
        if self.factors is None:
            return samples.gamma[:, machine.column(self.name)]
        row = np.zeros(len(machine.active))
        for joint, factor in self.factors.items():
            if joint not in machine.active:
                raise InputError(
                    f"'{self.name}' combines '{joint}', which is not active, "
                    f"{suggest_names(machine.active, joint)}"
                )
            row[machine.active.index(joint)] = factor
        return np.broadcast_to(row, samples.v_a.shape)


def resolve_direction(machine: Machine, given: str | ForceDirection) -> ForceDirection:
    """Direction of a joint's name, or the given one, with a check that it exists."""
    direction = ForceDirection(given) if isinstance(given, str) else given
    if direction.between is not None:
        for link in direction.between:
            machine.frame(link)
    elif direction.factors is None:
        machine.column(direction.name)
    return direction


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
    names = []
    for joint in range(1, model.njoints):
        frames = [f for f in model.frames if f.parentJoint == joint and f.type.name == "BODY"]
        names.append(frames[0].name)
    return tuple(names)


class RotorInertiaTerm(ModelTerm):
    """Term of a rotor inertia along a direction s, such as that of a geared motor.

        tau_A = c s'' I,   c = ds/dq_A,   s'' = c^T a_A + dc^T/dt v_A.

    The nominal value is the `rotor_inertia` of the machine.

    Args:
        machine: The machine.
        direction: Name of a joint, active or passive, or a combination of active ones.
    """

    def __init__(self, machine: Machine, direction: str | ForceDirection):
        self.direction = direction = resolve_direction(machine, direction)
        self._machine = machine
        joint = machine.tree.joints.get(direction.name)
        nominal = 0.0 if joint is None else joint.rotor_inertia
        self.names, self.nominal = (f"{direction.name}.rotor_inertia",), np.array([nominal])
        self.nonnegative = (True,)

    def columns(self, samples: MotionSamples) -> Array:
        """See `ModelTerm`."""
        rows = self.direction.jacobian(self._machine, samples)
        rate = np.einsum("ij,ij->i", rows, samples.a_a)
        if self.direction.name not in self._machine.active and not self.direction.factors:
            v = np.einsum("kij,kj->ki", samples.gamma, samples.v_a)
            drift = self._machine.closure.drift(samples.q, v)
            rate = rate + drift[:, self._machine.column(self.direction.name)]
        return (rows * rate[:, None])[:, :, None]
