"""Forces from outside along the joints: J^T w, by Pinocchio and as formulas."""

from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from crane.closure.screws import Vector
from crane.closure.traced import Geometry
from crane.codegen import Callback, Expression, Tape
from crane.codegen.scalar import (
    Number,
    add,
    cross,
    dot,
    product,
    scale,
    subtract,
    times,
    transposed,
)
from crane.common.samples import Array
from crane.description.external import PARTS, ExternalForce, Here
from crane.dynamics.frames import FrameJacobians
from crane.dynamics.traced import Sweep
from crane.machine import Machine

_SEEN = 19  # numbers that a function in Python is called with


class Applied(NamedTuple):
    """What forces from outside do to a machine.

    Attributes:
        forces: gamma^T J^T w (n,) of all of them together.
        powers: (k,) of each [W].
        edges: Lengths [m] at whose signs some of them bend.
        seen: (s,) of each its wrench in the world's axes and its channels.
        rates: Of their states, one after the other.
        asked: What those that are functions in Python are called with, see `Asked`.
    """

    forces: Vector
    powers: Vector
    edges: Vector
    seen: Vector
    rates: Vector
    asked: Vector


class AppliedAt(NamedTuple):
    """The same at a state, in numbers.

    Attributes:
        forces: J^T w (nv,) of all of them together; gamma^T J^T w (n,) where a chart gives it.
        powers: (k,) of each [W].
        seen: See `Applied`.
        rates: See `Applied`.
    """

    forces: Array
    powers: Array
    seen: Array
    rates: Array


def references_of(forces: Sequence[ExternalForce], times: Array) -> Array:
    """References (N, c) of all at times (N,) [s], with room for answers of functions in Python."""
    parts: list[Array] = [np.zeros((len(times), 0))]
    for force in forces:
        parts.append(force.references(times))
        if not force.traced:
            parts.append(np.zeros((len(times), len(PARTS))))
    return np.hstack(parts)


def columns_of(forces: Sequence[ExternalForce]) -> list[int]:
    """(k,) how many references each has there."""
    return [references_of([force], np.zeros(1)).shape[1] for force in forces]


def form_of(machine: Machine) -> Hashable:
    """All that the formulas of a machine's external forces are, each traced by itself."""
    out: list[Hashable] = []
    for force, count in zip(machine.external, columns_of(machine.external), strict=True):
        tape = Tape()
        parts = (tape.loads(i, 0, 3) for i in range(3))
        place, velocity, spin = parts
        turn = [tape.loads(3, 3 * row, 3) for row in range(3)]
        own = tape.loads(4, 0, count), tape.loads(5, 0, force.states)
        here = Here(place, turn, velocity, spin, *own)
        outputs = [
            [x.index if isinstance(x, Expression) else float(x) for x in part]
            for part in (
                *force.wrench(here),
                force.edges(here),
                force.look(here),
                force.rates(here),
            )  # fmt: skip
        ]
        joint, pose = _placed(machine, force)
        shape = count, force.states
        out.append((repr((shape, tape.operations, outputs)), joint, pose.homogeneous.tobytes()))
    return tuple(out)


def states_of(forces: Sequence[ExternalForce]) -> int:
    """How many states they have together."""
    return sum(force.states for force in forces)


def traced(
    machine: Machine, sweep: Sweep, references: Sequence[Number], states: Sequence[Number]
) -> Applied:
    """`ExternalForces` as formulas, with their references and states one after the other."""
    posture, geometry = sweep.posture, sweep.posture.geometry
    total: Vector = [0.0] * len(machine.active)
    powers: Vector = []
    edges: Vector = []
    seen: Vector = []
    rates: Vector = []
    asked: Vector = []
    back, first = transposed(posture.rotation[0]), 0  # formulas are seen from the trunk
    for force, count in zip(machine.external, columns_of(machine.external), strict=True):
        joint, pose = _placed(machine, force)
        body = machine.coordinates.bodies[joint]
        turn = geometry.turns[body].T
        arm = times(posture.rotation[body], (turn @ pose.translation).tolist())
        at = add(posture.origin[body], arm)
        axes = product(posture.rotation[body], (turn @ pose.rotation).tolist())
        carriers = _carriers(geometry, body)
        velocity: Vector = [0.0] * 3
        spin: Vector = [0.0] * 3
        for i in carriers:
            linear, angular = posture.columns[i]
            velocity = add(velocity, scale(sweep.rates[i], add(linear, cross(angular, at))))
            spin = add(spin, scale(sweep.rates[i], angular))
        here = Here(
            times(back, subtract(at, posture.origin[0])), product(back, axes),
            times(back, velocity), times(back, spin), list(references[first : first + count]),
            list(states[len(rates) : len(rates) + force.states]),
        )  # fmt: skip
        first += count
        rates += force.rates(here)
        if not force.traced:
            axes_ = [x for row in here.turn for x in row]
            asked += [here.reference[0], *here.place, *axes_, *here.velocity, *here.spin]
        edges += force.edges(here)
        acting = [list(part) for part in force.wrench(here)]
        seen += [*acting[0], *acting[1], *force.look(here)]
        push, moment = (times(posture.rotation[0], part) for part in acting)
        powers.append(dot(push, velocity) + dot(moment, spin))
        about = add(moment, cross(at, push))
        for i in carriers:
            linear, angular = posture.columns[i]
            total = add(total, scale(dot(push, linear) + dot(about, angular), sweep.gamma[i]))
    return Applied(total, powers, edges, seen, rates, asked)


class Asked(Callback):
    """Calls those of a machine's external forces that are functions in Python, for machine code.

    It reads of each (19,): time, place, axes, velocity and spin, see `Here`, and fills its answer
    into the references of all.

    Args:
        forces: All of a machine.
    """

    def __init__(self, forces: Sequence[ExternalForce]):
        counts = columns_of(forces)
        ends = np.cumsum(counts)
        self._places = [
            (force, slice(end - len(PARTS), end))
            for force, end in zip(forces, ends.tolist(), strict=True)
            if not force.traced
        ]
        super().__init__(self._answer, _SEEN * len(self._places), int(sum(counts)))

    def _answer(self, seen: Array, references: Array) -> None:
        for k, (force, place) in enumerate(self._places):
            x = seen[_SEEN * k : _SEEN * (k + 1)].tolist()
            turn = [x[4:7], x[7:10], x[10:13]]
            here = Here(x[1:4], turn, x[13:16], x[16:], x[:1])
            push, moment = force.wrench(here)
            references[place] = np.array([*push, *moment], dtype=np.float64)


class ExternalForces:
    """What acts on a machine from outside, in numbers.

    Args:
        machine: The machine.
        forces: Those of its `external` that act.
    """

    def __init__(self, machine: Machine, forces: Sequence[ExternalForce]):
        self._forces, self._jacobians = forces, FrameJacobians(machine)

    def along(self, time: float, q: Array, v: Array, states: Array) -> AppliedAt:
        """J^T w along the joints.

        Args:
            time: [s].
            q: (nq,) closed posture.
            v: (nv,) velocities of all joints.
            states: Of all forces.
        """
        self._jacobians.place(q)
        total, powers = np.zeros(len(v)), np.empty(len(self._forces))
        seen: Vector = []
        rates: Vector = []
        for k, force in enumerate(self._forces):
            jacobian = self._jacobians.of(force.frame)
            own = states[len(rates) : len(rates) + force.states].tolist()
            pose, rate = self._jacobians.pose(force.frame), jacobian @ v
            reference = force.references(np.array([time]))[0].tolist()
            here = Here(
                pose.translation.tolist(), pose.rotation.tolist(), rate[:3].tolist(),
                rate[3:].tolist(), reference, own,
            )  # fmt: skip
            rates += force.rates(here)
            push, moment = force.wrench(here)
            seen += [*push, *moment, *force.look(here)]
            wrench = np.array([*push, *moment], dtype=np.float64)
            total += jacobian.T @ wrench
            powers[k] = wrench @ rate
        return AppliedAt(
            total, powers, np.array(seen, dtype=np.float64), np.array(rates, dtype=np.float64)
        )


def at_rest(machine: Machine, q: Array) -> Array:
    """gamma^T J^T w (n,) of a machine's external forces at time 0, at rest in a posture (nq,)."""
    if not machine.external:
        return np.zeros(len(machine.active))
    still, none = np.zeros(machine.model.nv), np.zeros(states_of(machine.external))
    applied = ExternalForces(machine, machine.external).along(0.0, q, still, none)
    return np.asarray(machine.closure.gamma(q).T @ applied.forces)


def _placed(machine: Machine, force: ExternalForce) -> tuple[int, pin.SE3]:
    """Pinocchio's joint that moves a force's frame, and where the frame is in it."""
    frame = machine.model.frames[machine.frame(force.frame)]
    return int(frame.parentJoint), frame.placement


def _carriers(geometry: Geometry, body: int) -> list[int]:
    found = []
    while body:
        found.append(body)
        body = geometry.parents[body]
    return found
