"""External forces along the joints: J^T w, by Pinocchio and as symbolic formulas."""

from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numpy as np

from crane.closure.kinematics_formulas import Vector
from crane.codegen import PythonCallback, SymbolicExpression, Tape
from crane.codegen.symbolic import (
    Scalar,
    add_vectors,
    cross,
    dot,
    matmul,
    matvec,
    scale_vector,
    subtract_vectors,
    transpose,
)
from crane.common.samples import Array
from crane.description.external_forces import WRENCH_COMPONENTS, ExternalForce, FrameMotion
from crane.dynamics.dynamics_formulas import DynamicsFormulas
from crane.dynamics.frame_jacobians import FrameJacobians, frame_placement
from crane.machine.machine import Machine

_CALLBACK_INPUT_SIZE = 19  # inputs of a Python function


class ExternalForceFormulas(NamedTuple):
    """Effects of the external forces of a machine.

    Attributes:
        active_forces: gamma^T J^T w (n,) of all forces together.
        powers: (k,) power of each [W].
        event_distances: Lengths [m] whose sign changes are events.
        outputs: (s,) wrench in the world's axes and channels of each.
        state_rates: Time derivatives of their states, concatenated.
        callback_inputs: Inputs of the Python functions among them, see `ExternalForceCallback`.
    """

    active_forces: Vector
    powers: Vector
    event_distances: Vector
    outputs: Vector
    state_rates: Vector
    callback_inputs: Vector


class ExternalForceValues(NamedTuple):
    """The same at a state, as numbers.

    Attributes:
        generalized_forces: J^T w (nv,) of all forces together; gamma^T J^T w (n,) in a chart.
        powers: (k,) power of each [W].
        outputs: See `ExternalForceFormulas`.
        state_rates: See `ExternalForceFormulas`.
    """

    generalized_forces: Array
    powers: Array
    outputs: Array
    state_rates: Array


def reference_samples(forces: Sequence[ExternalForce], times: Array) -> Array:
    """References (N, c) of all forces at times (N,) [s], and columns for results of callbacks."""
    parts: list[Array] = [np.zeros((len(times), 0))]
    for force in forces:
        parts.append(force.references(times))
        if not force.is_traceable:
            parts.append(np.zeros((len(times), len(WRENCH_COMPONENTS))))
    return np.hstack(parts)


def reference_counts(forces: Sequence[ExternalForce]) -> list[int]:
    """(k,) number of columns of each force in `reference_samples`."""
    return [reference_samples([force], np.zeros(1)).shape[1] for force in forces]


def formula_key(machine: Machine) -> Hashable:
    """Cache key of the formulas of a machine's external forces, each traced separately."""
    out: list[Hashable] = []
    for force, count in zip(
        machine.external_forces, reference_counts(machine.external_forces), strict=True
    ):
        tape = Tape()
        place, velocity, spin = (tape.load_vector(i, 0, 3) for i in range(3))
        turn = [tape.load_vector(3, 3 * row, 3) for row in range(3)]
        references_and_states = (
            tape.load_vector(4, 0, count),
            tape.load_vector(5, 0, force.state_count),
        )
        here = FrameMotion(place, turn, velocity, spin, *references_and_states)
        outputs = [
            [x.index if isinstance(x, SymbolicExpression) else float(x) for x in part]
            for part in (
                *force.wrench(here),
                force.event_distances(here),
                force.outputs(here),
                force.state_rates(here),
            )  # fmt: skip
        ]
        joint, pose = frame_placement(machine, force.frame)
        out.append(
            (
                repr(((count, force.state_count), tape.operations, outputs)),
                joint,
                pose.homogeneous.tobytes(),
            )
        )
    return tuple(out)


def state_count(forces: Sequence[ExternalForce]) -> int:
    """Number of states of all forces."""
    return sum(force.state_count for force in forces)


def trace_external_forces(
    machine: Machine,
    formulas: DynamicsFormulas,
    references: Sequence[Scalar],
    states: Sequence[Scalar],
) -> ExternalForceFormulas:
    """`ExternalForces` as formulas, from the concatenated references and states."""
    kinematics, geometry = formulas.kinematics, formulas.kinematics.geometry
    active_forces: Vector = [0.0] * len(machine.active)
    powers: Vector = []
    event_distances: Vector = []
    outputs: Vector = []
    state_rates: Vector = []
    callback_inputs: Vector = []
    world_rotation, first = (
        transpose(kinematics.rotation[0]),
        0,
    )  # formulas are in the frame of the reference body
    for force, count in zip(
        machine.external_forces, reference_counts(machine.external_forces), strict=True
    ):
        joint, pose = frame_placement(machine, force.frame)
        body = machine.coordinates.body_of_joint[joint]
        turn = geometry.body_rotations[body].T
        at = add_vectors(
            kinematics.origin[body],
            matvec(kinematics.rotation[body], (turn @ pose.translation).tolist()),
        )
        axes = matmul(kinematics.rotation[body], (turn @ pose.rotation).tolist())
        carriers = geometry.supporting_bodies(body)
        velocity: Vector = [0.0] * 3
        spin: Vector = [0.0] * 3
        for i in carriers:
            linear, angular = kinematics.joint_axes[i]
            velocity = add_vectors(
                velocity,
                scale_vector(
                    formulas.joint_velocities[i], add_vectors(linear, cross(angular, at))
                ),
            )
            spin = add_vectors(spin, scale_vector(formulas.joint_velocities[i], angular))
        here = FrameMotion(
            matvec(world_rotation, subtract_vectors(at, kinematics.origin[0])),
            matmul(world_rotation, axes),
            matvec(world_rotation, velocity),
            matvec(world_rotation, spin),
            list(references[first : first + count]),
            list(states[len(state_rates) : len(state_rates) + force.state_count]),
        )
        first += count
        state_rates += force.state_rates(here)
        if not force.is_traceable:
            callback_inputs += [
                here.reference[0],
                *here.position,
                *[x for row in here.rotation for x in row],
                *here.velocity,
                *here.angular_velocity,
            ]
        event_distances += force.event_distances(here)
        wrench = [list(part) for part in force.wrench(here)]
        outputs += [*wrench[0], *wrench[1], *force.outputs(here)]
        push, moment = (matvec(kinematics.rotation[0], part) for part in wrench)
        powers.append(dot(push, velocity) + dot(moment, spin))
        about = add_vectors(moment, cross(at, push))
        for i in carriers:
            linear, angular = kinematics.joint_axes[i]
            active_forces = add_vectors(
                active_forces,
                scale_vector(dot(push, linear) + dot(about, angular), formulas.gamma[i]),
            )
    return ExternalForceFormulas(
        active_forces, powers, event_distances, outputs, state_rates, callback_inputs
    )


class ExternalForceCallback(PythonCallback):
    """Calls the Python functions among the external forces from machine code.

    It reads 19 values per function: time, position, rotation, velocity and angular velocity, see
    `FrameMotion`, and writes the wrench into the references of all forces.

    Args:
        forces: All external forces of a machine.
    """

    def __init__(self, forces: Sequence[ExternalForce]):
        counts = reference_counts(forces)
        ends = np.cumsum(counts)
        self._reference_slices = [
            (force, slice(end - len(WRENCH_COMPONENTS), end))
            for force, end in zip(forces, ends.tolist(), strict=True)
            if not force.is_traceable
        ]
        super().__init__(
            self._evaluate_forces,
            _CALLBACK_INPUT_SIZE * len(self._reference_slices),
            int(sum(counts)),
        )

    def _evaluate_forces(self, inputs: Array, references: Array) -> None:
        for k, (force, place) in enumerate(self._reference_slices):
            x = inputs[_CALLBACK_INPUT_SIZE * k : _CALLBACK_INPUT_SIZE * (k + 1)].tolist()
            push, moment = force.wrench(
                FrameMotion(x[1:4], [x[4:7], x[7:10], x[10:13]], x[13:16], x[16:], x[:1])
            )
            references[place] = np.array([*push, *moment], dtype=np.float64)


class ExternalForces:
    """External forces on a machine, evaluated with Pinocchio.

    Args:
        machine: The machine.
        forces: Those of its `external_forces` that act.
    """

    def __init__(self, machine: Machine, forces: Sequence[ExternalForce]):
        self._forces, self._jacobians = forces, FrameJacobians(machine)

    def generalized_forces(
        self, time: float, q: Array, v: Array, states: Array
    ) -> ExternalForceValues:
        """J^T w along the joints.

        Args:
            time: [s].
            q: (nq,) closed configuration.
            v: (nv,) velocities of all joints.
            states: States of all forces, concatenated.
        """
        self._jacobians.set_configuration(q)
        joint_forces, powers = np.zeros(len(v)), np.empty(len(self._forces))
        outputs: Vector = []
        state_rates: Vector = []
        for k, force in enumerate(self._forces):
            jacobian = self._jacobians.jacobian(force.frame)
            own = states[len(state_rates) : len(state_rates) + force.state_count].tolist()
            pose, rate = self._jacobians.frame_pose(force.frame), jacobian @ v
            reference = force.references(np.array([time]))[0].tolist()
            here = FrameMotion(
                pose.translation.tolist(), pose.rotation.tolist(), rate[:3].tolist(),
                rate[3:].tolist(), reference, own,
            )  # fmt: skip
            state_rates += force.state_rates(here)
            push, moment = force.wrench(here)
            outputs += [*push, *moment, *force.outputs(here)]
            wrench = np.array([*push, *moment], dtype=np.float64)
            joint_forces += jacobian.T @ wrench
            powers[k] = wrench @ rate
        return ExternalForceValues(
            joint_forces,
            powers,
            np.array(outputs, dtype=np.float64),
            np.array(state_rates, dtype=np.float64),
        )


def static_active_forces(machine: Machine, q: Array, states: Array | None = None) -> Array:
    """gamma^T J^T w (n,) of the external forces at time 0, at rest at a configuration (nq,).

    Args:
        machine: The machine.
        q: (nq,) closed configuration.
        states: States of all external forces; zeros if not given.
    """
    if not machine.external_forces:
        return np.zeros(len(machine.active))
    if states is None:
        states = np.zeros(state_count(machine.external_forces))
    still = np.zeros(machine.model.nv)
    applied = ExternalForces(machine, machine.external_forces).generalized_forces(
        0.0, q, still, states
    )
    return np.asarray(machine.closure.gamma(q).T @ applied.generalized_forces)
