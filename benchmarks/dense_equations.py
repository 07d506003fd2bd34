"""Equations of motion with multipliers in dense matrices: slow, simple, without crane.

M a + J' lambda = tau - h,  J a = -drift, with M, h and the Jacobians of frames by Pinocchio. They
are solved in the null space of J by its singular value decomposition: redundant rows do no harm.
"""

from collections.abc import Callable

import numpy as np
import pinocchio as pin
from multibody import Array, Loop, Multibody

Solver = Callable[[Array, Array, Array], Array]
RANK_TOLERANCE = 1e-9  # share of the largest singular value below which a row is redundant


def exact_forward(system: Multibody) -> Solver:
    """Forward dynamics from the dense equations with multipliers, by their pseudo-inverse.

    Rows: both origins of a loop coincide, and the axes stay parallel; couplings. Redundant rows do
    no harm. Configurations are Pinocchio's (nq,).
    """
    rows = KinematicRows(system)
    model, data = system.model, system.model.createData()

    def forward(q: Array, v: Array, tau: Array) -> Array:
        mass = pin.crba(model, data, q)
        mass = np.triu(mass) + np.triu(mass, 1).T
        bias = pin.nonLinearEffects(model, data, q, v)
        jacobian, drift = rows.jacobian_and_drift(q, v)
        u, s, w = np.linalg.svd(jacobian)
        rank = int((s > RANK_TOLERANCE * s[0]).sum())
        particular = -w[:rank].T @ ((u[:, :rank].T @ drift) / s[:rank])
        null = w[rank:].T
        reduced = null.T @ mass @ null
        right = null.T @ (tau - bias - mass @ particular)
        return particular + null @ np.linalg.solve(reduced, right)

    return forward


class KinematicRows:
    """Position error, Jacobian and drift of the loops, by Pinocchio's frame Jacobians."""

    def __init__(self, system: Multibody):
        self._model, self._data = system.model, system.model.createData()
        self._system = system

    def _ends(self, loop: Loop) -> list[tuple[int, pin.SE3]]:
        return [
            (mount.body + 1, pin.SE3(mount.placement))
            for mount in (loop.predecessor, loop.successor)
        ]

    def error(self, q: Array) -> Array:
        """Distances of the origins, and components of one axis across the other."""
        pin.forwardKinematics(self._model, self._data, q)
        values = []
        for loop in self._system.loops:
            one, two = (self._data.oMi[i] * placement for i, placement in self._ends(loop))
            values.append(two.translation - one.translation)
            if loop.axis is not None:
                values.append(np.cross(one.rotation @ loop.axis, two.rotation @ loop.axis))
        return np.concatenate(values)

    def jacobian_and_drift(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Derivative of the error (m, n), and its product's change with velocity (m,)."""
        model, data = self._model, self._data
        pin.computeJointJacobians(model, data, q)
        pin.forwardKinematics(model, data, q, v, np.zeros(model.nv))
        jacobians, drifts = [], []
        for loop in self._system.loops:
            parts = [self._end_terms(i, placement, loop) for i, placement in self._ends(loop)]
            (_, axis1, j1, w1, a1, rate1, drift1), (_, axis2, j2, w2, a2, rate2, drift2) = parts
            jacobians.append(j2 - j1)
            drifts.append(a2 - a1)
            if loop.axis is not None:
                d1, d2 = -skew(axis1) @ w1, -skew(axis2) @ w2
                jacobians.append(skew(axis1) @ d2 - skew(axis2) @ d1)
                drifts.append(
                    np.cross(drift1, axis2) + 2 * np.cross(rate1, rate2) + np.cross(axis1, drift2)
                )
        couplings = self._system.couplings
        return np.vstack([*jacobians, couplings]), np.append(
            np.concatenate([*drifts, []]), np.zeros(len(couplings))
        )

    def _end_terms(self, joint: int, placement: pin.SE3, loop: Loop) -> tuple:
        """Point, axis, Jacobians of point and rotation, drift of the point, rates of the axis."""
        model, data = self._model, self._data
        frame = data.oMi[joint] * placement
        point = frame.translation
        axis = frame.rotation @ (np.zeros(3) if loop.axis is None else loop.axis)
        if joint == 0:
            zero = np.zeros((3, model.nv))
            return point, axis, zero, zero, np.zeros(3), np.zeros(3), np.zeros(3)
        jacobian = pin.getJointJacobian(model, data, joint, pin.WORLD)
        linear = jacobian[:3] - skew(point) @ jacobian[3:]
        motion = pin.getVelocity(model, data, joint, pin.WORLD)
        drift = pin.getAcceleration(model, data, joint, pin.WORLD)
        omega, alpha = motion.angular, drift.angular
        speed = motion.linear + np.cross(omega, point)
        acceleration = drift.linear + np.cross(alpha, point) + np.cross(omega, speed)
        rate = np.cross(omega, axis)
        second = np.cross(alpha, axis) + np.cross(omega, rate)
        return point, axis, linear, jacobian[3:], acceleration, rate, second

    def project(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Closed configuration nearest to q, and velocities along the loops nearest to v."""
        jacobian = self.jacobian_and_drift(q, v)[0]
        for _ in range(3):
            error = self.error(q)
            if np.abs(error).max() < 1e-14:
                break
            q = q - np.linalg.lstsq(jacobian, error, rcond=RANK_TOLERANCE)[0]
            jacobian = self.jacobian_and_drift(q, v)[0]
        return q, v - np.linalg.lstsq(jacobian, jacobian @ v, rcond=RANK_TOLERANCE)[0]


def skew(x: Array) -> Array:
    """Matrix (3, 3) of the cross product with x."""
    return np.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])


class SpringForces:
    """Joint forces (n,) of the springs between points."""

    def __init__(self, system: Multibody):
        self._system, self._data = system, system.model.createData()

    def __call__(self, q: Array, v: Array) -> Array:
        """Joint forces (n,) [N], [N m]."""
        system, model, data = self._system, self._system.model, self._data
        tau = np.zeros(model.nv)
        if not system.springs:
            return tau
        pin.computeJointJacobians(model, data, q)
        for spring in system.springs:
            points, jacobians = [], []
            for mount in spring.ends:
                placement = data.oMi[mount.body + 1] * pin.SE3(mount.placement)
                points.append(placement.translation)
                jacobian = np.zeros((6, model.nv))
                if mount.body >= 0:
                    jacobian = pin.getJointJacobian(model, data, mount.body + 1, pin.WORLD)
                jacobians.append(jacobian[:3] + np.cross(jacobian[3:].T, placement.translation).T)
            way = points[1] - points[0]
            length = float(np.linalg.norm(way))
            gradient = way / length @ (jacobians[1] - jacobians[0])
            force = spring.stiffness * (spring.rest - length) - spring.damping * gradient @ v
            tau += force * gradient
        return tau
