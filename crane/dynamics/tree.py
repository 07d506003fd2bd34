"""Equations of motion by Pinocchio's algorithms on the spanning tree, projected by gamma."""

from collections.abc import Iterator, Sequence
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from crane.common.errors import MechanismError
from crane.common.samples import Array, solve
from crane.common.threads import PerThread
from crane.dynamics.frames import point_jacobian
from crane.dynamics.joint_forces import AT_REST, JointForces
from crane.machine import Machine


class ClosedState(NamedTuple):
    """One closed posture in motion.

    Attributes:
        q: (nv,) posture.
        gamma: (nv, n).
        v: (nv,) velocities gamma v_A.
        drift: (nv,) accelerations at a_A = 0.
    """

    q: Array
    gamma: Array
    v: Array
    drift: Array


class _Part:
    """Bodies that move together, on a base that stands still.

    Args:
        whole: The machine's tree.
        bodies: Their indices, a parent before its children.

    Attributes:
        bodies: The same.
        columns: Of their joints in v.
        places: Of their joints in Pinocchio's q.
        base: The body of the tree that they stand on.
        model: Of them alone; its gravity is written as the base turns.
        data: Its data.
    """

    def __init__(self, whole: pin.Model, bodies: Sequence[int]):
        self.bodies = np.array(bodies)
        joints = [whole.joints[body] for body in bodies]
        self.columns = np.concatenate([np.arange(x.idx_v, x.idx_v + x.nv) for x in joints])
        self.places = np.concatenate([np.arange(x.idx_q, x.idx_q + x.nq) for x in joints])
        self.base = whole.parents[bodies[0]]
        self.model, place = pin.Model(), {self.base: 0}
        for body in bodies:
            place[body] = self.model.addJoint(
                place[whole.parents[body]],
                whole.joints[body],
                whole.jointPlacements[body],
                whole.names[body],
            )
            self.model.appendBodyToJoint(place[body], whole.inertias[body], pin.SE3.Identity())
        self.data = self.model.createData()


class _Memory:
    """What evaluating a quantity writes.

    Args:
        model: The tree.
        parts: Bodies that carry each other, together.

    Attributes:
        data: Of the tree.
        parts: Models of the bodies and their data.
    """

    def __init__(self, model: pin.Model, parts: Sequence[Sequence[int]]):
        self.data = model.createData()
        self.parts = [_Part(model, bodies) for bodies in parts]


class TreeDynamics:
    """Any quantity of `QUANTITIES` at a closed posture, with rnea, crba and the tree's regressor.

    Args:
        machine: The machine.
        forces: Its friction and passive forces.
        carriers: See `crane.dynamics.formulation`.
    """

    def __init__(self, machine: Machine, forces: JointForces, carriers: Sequence[int]):
        # a copy, so that parameters stay those of this moment
        self._model = pin.Model(machine.model)
        # added here, not by the parts: Pinocchio's kinetic energy forgets those of some joints
        self._armature = np.array(self._model.armature)
        self._rotors = np.flatnonzero(self._armature)
        self._closure, self._forces = machine.closure, forces
        self._coordinates, self._carriers = machine.coordinates, carriers
        self._tip: tuple[int, Array] | None = None
        if machine.tip is not None:
            frame = self._model.frames[machine.frame(machine.tip)]
            self._tip = int(frame.parentJoint), np.array(frame.placement.translation)

    @cached_property
    def _memory(self) -> PerThread[_Memory]:
        return PerThread(partial(_Memory, self._model, self._together(self._carriers)))

    def _together(self, carriers: Sequence[int]) -> list[list[int]]:
        """Bodies that carry each other, a parent before its children."""
        joints = [0, *self._coordinates.joints.tolist()]
        roots: dict[int, list[int]] = {}
        root_of = {0: 0}
        for body in range(1, self._model.njoints):
            carrier = joints[carriers[self._model.joints[body].idx_v + 1]]
            root_of[body] = root_of[carrier] or body
            roots.setdefault(root_of[body], []).append(body)
        return list(roots.values())

    @property
    def parameters(self) -> Array:
        """See `Dynamics.parameters`."""
        inertias = list(self._model.inertias)[1:]
        bodies = [inertia.toDynamicParameters() for inertia in inertias]
        return np.concatenate([*bodies, self._armature[self._rotors]])

    def at(self, quantity: str, q: Array, v_a: Array, x: Array) -> Array:
        """A quantity of one sample; see `QUANTITIES` for x.

        Args:
            quantity: Its name.
            q: (nq,) closed posture.
            v_a: (n,).
            x: (n,).

        Returns:
            The result, flattened.
        """
        motion = ClosedState(q, *self._closure.motion(q, v_a))
        gamma, v = motion.gamma, motion.v
        match quantity:
            case "inverse" | "inverse with friction":
                a = gamma @ x + motion.drift
                friction = quantity.endswith("friction")
                start = self._forces.starting(v, a) if friction else np.zeros_like(v)
                return self._project(motion, a, friction) + gamma.T @ start
            case "forward" | "forward with friction":
                return self._forward(motion, x, quantity.endswith("friction"))
            case "mass matrix":
                return self._mass(motion).ravel()
            case "bias":
                return self._project(motion, motion.drift, False)
            case "gravity":
                return gamma.T @ self._inverse(q, np.zeros_like(v), np.zeros_like(v))
            case "friction":
                return gamma.T @ self._forces.friction(v)
            case "passive":
                return gamma.T @ self._forces.passive(q, v)
            case "energy":
                return self._energy(motion)
            case "rates":
                a_a, _, margin, _ = self._moved(motion, x)
                rates = self._coordinates.rates(q, v)
                return np.concatenate([rates, a_a, [self._dissipation(motion), margin]])
            case "observation":
                _, along, _, needed = self._moved(motion, x)
                here, (slip, held, pace) = list(self._forces.sticking), self._forces.modes
                rests = (np.abs(slip) < 1) | (held.any() & (np.abs(v[here]) * pace < AT_REST))
                rest = np.where(rests, self._forces.held(slip) + needed, 0.0)
                return np.concatenate([gamma.T @ along, self._energy(motion), rest])
            case "resting":
                here = list(self._forces.sticking)
                along = gamma.T @ self._forces.friction(v, modes=True)
                net = x - self._project(motion, motion.drift, False) - along
                parts = self._mass(motion), gamma[here], motion.drift[here], net
                return np.concatenate([np.ravel(part) for part in parts])
            case "statics":
                return self._statics(motion)
            case "regressor":
                return (gamma.T @ self._regressor(q, v, gamma @ x + motion.drift)).ravel()
        raise AssertionError(quantity)

    def _statics(self, motion: ClosedState) -> Array:
        """See `Sweep.statics`."""
        q, gamma = motion.q, motion.gamma
        model, data = self._model, self._memory.own.data
        jacobian = pin.jacobianCenterOfMass(model, data, self._coordinates.configuration(q), False)
        still, moving = model.inertias[0], data.mass[0]
        moment = moving * data.com[0] + still.mass * still.lever
        out = [moment, moving * jacobian @ gamma, [moving + still.mass]]
        out.append(gamma.T @ self._forces.passive(q, motion.v))
        if self._tip is not None:
            joint, place = self._tip
            pin.computeJointJacobians(model, data, self._coordinates.configuration(q))
            out.append(data.oMi[joint].act(place))
            out.append(point_jacobian(model, data, joint, place)[:3] @ gamma)
        return np.concatenate([np.ravel(part) for part in out])

    def _forward(self, motion: ClosedState, tau_a: Array, friction: bool) -> Array:
        return self._accelerated(motion, tau_a - self._project(motion, motion.drift, friction))

    def _moved(self, motion: ClosedState, tau_a: Array) -> tuple[Array, Array, float, Array]:
        """Accelerations, friction of all joints, margin, and what holds; see `Sweep.moved`."""
        forces, here = self._forces, list(self._forces.sticking)
        slip, held, pace = forces.modes
        along = forces.friction(motion.v, modes=True)
        bias = self._project(motion, motion.drift, False) + motion.gamma.T @ along
        a_a = self._accelerated(motion, tau_a - bias)
        margins, holding = slip * motion.v[here] * pace, np.zeros(len(here))
        stuck = np.flatnonzero(held)
        if len(stuck):
            rows = motion.gamma[here][stuck]
            reach = np.array([self._accelerated(motion, row) for row in rows])
            asked = rows @ a_a + motion.drift[here][stuck]
            needed = np.linalg.solve(rows @ reach.T, asked)
            a_a = (a_a - needed @ reach) * forces.moving
            holding[stuck] = needed
            along[here] += holding
            margins[stuck] = 1.0 - np.abs(needed) / forces.breakaway[stuck]
        return a_a, along, float(min([1.0, *margins])), holding

    def _accelerated(self, motion: ClosedState, net: Array) -> Array:
        """M_A^-1 of net forces."""
        mass = self._mass(motion)
        try:
            np.linalg.cholesky(mass)  # elimination would divide by what rounding leaves
            return solve(mass, net)
        except np.linalg.LinAlgError:
            raise MechanismError(
                "the mass matrix is not definite: some motion moves no mass that counts beside "
                "the others', correct the masses and inertias"
            ) from None

    def _energy(self, motion: ClosedState) -> Array:
        """Kinetic and potential."""
        configuration = self._coordinates.configuration(motion.q)
        kinetic, memory = 0.5 * float(self._armature @ motion.v**2), self._memory.own
        for part in memory.parts:
            at, v = configuration[part.places], motion.v[part.columns]
            kinetic += pin.computeKineticEnergy(part.model, part.data, at, v)
        weight = pin.computePotentialEnergy(self._model, memory.data, configuration)
        return np.array([kinetic, weight + self._forces.potential(motion.q)])

    def _dissipation(self, motion: ClosedState) -> float:
        """Power that friction, dampers and end stops take out."""
        conservative = self._forces.passive(motion.q, np.zeros_like(motion.v))
        braking = conservative - self._forces.passive(motion.q, motion.v)
        return float(motion.v @ (self._forces.friction(motion.v, modes=True) + braking))

    def _project(self, motion: ClosedState, a: Array, friction: bool) -> Array:
        """gamma^T (rnea(q, v, a) - f [+ tau_F])."""
        tau = self._inverse(motion.q, motion.v, a) - self._forces.passive(motion.q, motion.v)
        if friction:
            tau += self._forces.friction(motion.v)
        return np.asarray(motion.gamma.T @ tau)

    def _mass(self, motion: ClosedState) -> Array:
        configuration = self._coordinates.configuration(motion.q)
        total = motion.gamma.T @ (self._armature[:, None] * motion.gamma)
        for part in self._memory.own.parts:
            upper = np.triu(pin.crba(part.model, part.data, configuration[part.places]))
            gamma = motion.gamma[part.columns]
            total += gamma.T @ (upper + np.triu(upper, 1).T) @ gamma
        return total

    def _inverse(self, q: Array, v: Array, a: Array) -> Array:
        """Forces along the joints (nv,), part after part."""
        tau = np.empty_like(v)
        for part, at in self._turned(q):
            c = part.columns
            tau[c] = pin.rnea(part.model, part.data, at, v[c], a[c])
        return tau + self._armature * a

    def _regressor(self, q: Array, v: Array, a: Array) -> Array:
        """Of the tree (nv, 10 nb + nr), part after part; a column for each rotor."""
        size = 10 * (self._model.njoints - 1)
        out = np.zeros((len(v), size + len(self._rotors)))
        out[self._rotors, size + np.arange(len(self._rotors))] = a[self._rotors]
        for part, at in self._turned(q):
            c = part.columns
            block = pin.computeJointTorqueRegressor(part.model, part.data, at, v[c], a[c])
            out[np.ix_(c, (10 * (part.bodies[:, None] - 1) + np.arange(10)).ravel())] = block
        return out

    def _turned(self, q: Array) -> Iterator[tuple[_Part, Array]]:
        """The parts and their configurations, gravity turned into their bases' directions."""
        configuration, memory = self._coordinates.configuration(q), self._memory.own
        pin.forwardKinematics(self._model, memory.data, configuration)
        for part in memory.parts:
            base = memory.data.oMi[part.base].rotation
            part.model.gravity.linear = base.T @ self._model.gravity.linear
            yield part, configuration[part.places]
