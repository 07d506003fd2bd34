"""One forward sweep (Kane's form) and the forces along joints as traced formulas."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from crane.closure.traced import Bodies, Constants, Geometry, Loops, MovingBodies, Vector
from crane.codegen.scalar import (
    Number,
    add,
    apply,
    cross,
    dot,
    maximum,
    product,
    scale,
    solve_positive,
    subtract,
    times,
)  # fmt: skip
from crane.common.samples import Array
from crane.dynamics.joint_forces import JointForces
from crane.machine import Machine

BODY, JOINT = 10, 19  # numbers per body and per joint
_UPPER = np.triu_indices(3)


def numbers_of(machine: Machine, geometry: Geometry, forces: JointForces) -> Array:
    """Inertias, force laws and gravity in the order that `Sweep` reads them.

    Per body mass, COM (3), inertia about it (xx, xy, xz, yy, yz, zz) in the body's directions of
    the geometry; per joint the 19 numbers of `JointForces.table`; gravity (3); per joint its rotor
    inertia.
    """
    bodies = []
    for turn, inertia in zip(geometry.turns[1:], list(machine.model.inertias)[1:], strict=True):
        tensor = turn.T @ inertia.inertia @ turn
        bodies.append([inertia.mass, *(turn.T @ inertia.lever), *tensor[_UPPER]])
    gravity = machine.model.gravity.linear
    rotors = machine.model.armature
    return np.concatenate([np.ravel(bodies), np.ravel(forces.table), gravity, rotors])


class Sweep:
    """Dynamics at a traced closed posture.

    Args:
        posture: Bodies.
        loops: Loops at that posture.
        constants: See `numbers_of`.
        q: (nb,).
        v_a: (n,).
        carriers: See `crane.dynamics.formulation`.

    Attributes:
        gamma: Rows of gamma by joint.
        rates: (nb + 1,) joint velocities, 0 for the world.
        drift: (nb + 1,) accelerations of the joints at a_A = 0.
    """

    def __init__(
        self,
        posture: Bodies,
        loops: Loops,
        constants: Constants,
        q: Sequence[Number],
        v_a: Sequence[Number],
        carriers: Sequence[int],
    ):
        self._carriers = carriers
        self._posture, self._loops, self._q = posture, loops, q
        self._size = len(posture.geometry.parents)
        self._n = len(v_a)
        bodies = self._size - 1
        self._inertial = [constants.vector(BODY * i, BODY) for i in range(bodies)]
        self._laws = [constants.vector(BODY * bodies + JOINT * i, JOINT) for i in range(bodies)]
        gravity = constants.vector((BODY + JOINT) * bodies)
        self._gravity = times(posture.rotation[0], gravity)
        rotors = constants.vector((BODY + JOINT) * bodies + 3, bodies)
        self._rotors = [(i, value) for i, value in enumerate(rotors, start=1) if value != 0.0]
        self.gamma = loops.gamma
        self.rates: Vector = [0.0, *(dot(self.gamma[i], v_a) for i in range(1, self._size))]
        # the loops' drift is that of the whole machine whatever carries a body
        whole, alone = (
            MovingBodies(posture, loops, self.rates, self._gravity, parents)
            for parents in (posture.geometry.parents, carriers)
        )
        self.drift, self._motion = whole.drift, alone

    @cached_property
    def _columns(self) -> list[list[tuple[Vector, Vector]]]:
        """Per body dV/dv_A (linear at the trunk's origin, angular) by column, then the drift."""
        columns: list[list[tuple[Vector, Vector]]] = [[([0.0] * 3, [0.0] * 3)] * (self._n + 1)]
        for i in range(1, self._size):
            linear, angular = self._posture.columns[i]
            factors = [*self.gamma[i], self.drift[i]]
            carried = columns[self._carriers[i]]
            columns.append(
                [
                    (add(v, scale(factor, linear)), add(w, scale(factor, angular)))
                    for factor, (v, w) in zip(factors, carried, strict=True)
                ]
            )
        return columns

    @cached_property
    def _bodies(self) -> list[tuple[Number, Vector, list[Vector]]]:
        """Per body mass, COM, inertia about it, in the trunk's frame."""
        out: list[tuple[Number, Vector, list[Vector]]] = []
        for i in range(1, self._size):
            mass, *rest = self._inertial[i - 1]
            rotation = self._posture.rotation[i]
            centre = add(self._posture.origin[i], times(rotation, rest[:3]))
            xx, xy, xz, yy, yz, zz = rest[3:]
            half = product(rotation, [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            tensor: list[Vector] = [[0.0] * 3 for _ in range(3)]
            for r in range(3):
                for c in range(r + 1):
                    tensor[r][c] = tensor[c][r] = dot(half[r], rotation[c])
            out.append((mass, centre, tensor))
        return out

    def _at_centre(self, i: int) -> list[tuple[Vector, Vector]]:
        """Columns of body i: linear at its COM, angular."""
        _, centre, _ = self._bodies[i - 1]
        return [(add(v, cross(w, centre)), w) for v, w in self._columns[i][: self._n]]

    @cached_property
    def mass(self) -> list[Vector]:
        """M_A = sum J_b^T I_b J_b + sum gamma_i^T I_r,i gamma_i."""
        out: list[Vector] = [[0.0] * self._n for _ in range(self._n)]
        for i in range(1, self._size):
            mass, _, tensor = self._bodies[i - 1]
            columns = self._at_centre(i)
            for k, (v, w) in enumerate(columns):
                momentum, spin = scale(mass, v), times(tensor, w)
                for j in range(k + 1):
                    out[k][j] = out[k][j] + dot(momentum, columns[j][0]) + dot(spin, columns[j][1])
                    out[j][k] = out[k][j]
        for i, inertia in self._rotors:
            row = self.gamma[i]
            for k in range(self._n):
                for j in range(k + 1):
                    out[j][k] = out[k][j] = out[k][j] + inertia * row[k] * row[j]
        return out

    @cached_property
    def inertial_bias(self) -> Vector:
        """Sum J_b^T (I_b a_b + v_b x* I_b v_b) at a_A = 0, weights and rotors included."""
        velocity, acceleration = self._motion.velocity, self._motion.acceleration
        out: Vector = [0.0] * self._n
        for i in range(1, self._size):
            mass, centre, tensor = self._bodies[i - 1]
            v, w = velocity[i]
            a = add(acceleration[i][0], self._columns[i][self._n][0])
            e = add(acceleration[i][1], self._columns[i][self._n][1])
            at = add(a, cross(e, centre), cross(w, add(v, cross(w, centre))))
            force, moment = scale(mass, at), add(times(tensor, e), cross(w, times(tensor, w)))
            for k, (linear, angular) in enumerate(self._at_centre(i)):
                out[k] = out[k] + dot(linear, force) + dot(angular, moment)
        for i, inertia in self._rotors:
            out = add(out, scale(inertia * self.drift[i], self.gamma[i]))
        return out

    @cached_property
    def weight(self) -> Vector:
        """gamma^T g(q)."""
        out: Vector = [0.0] * self._n
        for i in range(1, self._size):
            force = scale(-self._bodies[i - 1][0], self._gravity)
            for k, (linear, _) in enumerate(self._at_centre(i)):
                out[k] = out[k] + dot(linear, force)
        return out

    def _law(self, i: int) -> tuple[Number, Number, Number, Number]:
        """Of joint i: passive force, friction, power taken out, energy stored.

        Written apart from `JointForces`, which has the same in numpy, so that each checks the
        other.
        """
        (
            coulomb, coulomb_offset, viscous, viscous_offset, sharpness, stiction, stribeck,
            stiffness, damping, constant, slack, stop, stop_damping, lower, upper,
            gas, gas_share, gas_rest, gas_exponent,
        ) = self._laws[i - 1]  # fmt: skip
        q, rate = self._q[i - 1], self.rates[i]
        friction = viscous * rate + coulomb_offset
        if coulomb != 0.0 or viscous_offset != 0.0 or stiction != 0.0:
            sign = apply("tanh", sharpness * rate)
            if stiction != 0.0:
                slow = stribeck * rate
                coulomb = coulomb + stiction * apply("exp", -1.0 * (slow * slow))
            friction = friction + (coulomb + viscous_offset * rate) * sign
        force = constant - stiffness * q - damping * rate
        stored = 0.5 * stiffness * q * q - constant * q + slack
        lost = (friction + damping * rate) * rate
        if gas != 0.0:
            swollen = 1.0 + gas_share * (q - gas_rest)
            if gas_exponent == 1.0:
                force = force + gas / swollen
                stored = stored - gas / gas_share * apply("log", swollen)
            else:
                less = 1.0 - gas_exponent
                power = apply("exp", less * apply("log", swollen))
                force = force + gas * power / swollen
                stored = stored - gas / gas_share * ((power - 1.0) / less)
        if stop != 0.0:
            over, under = maximum(q - upper, 0.0), maximum(lower - q, 0.0)
            push = stop * over * maximum(1.0 + stop_damping * rate, 0.0)
            pull = stop * under * maximum(1.0 - stop_damping * rate, 0.0)
            force = force + pull - push
            stored = stored + 0.5 * stop * (over * over + under * under)
            lost = lost + (push - stop * over - pull + stop * under) * rate
        return force, friction, lost, stored

    @cached_property
    def _along_joints(self) -> tuple[Vector, Vector, Number, Number]:
        passive: Vector = [0.0] * self._n
        friction: Vector = [0.0] * self._n
        lost: Number = 0.0
        stored: Number = 0.0
        for i in range(1, self._size):
            force, braking, power, energy = self._law(i)
            passive = add(passive, scale(force, self.gamma[i]))
            friction = add(friction, scale(braking, self.gamma[i]))
            lost, stored = lost + power, stored + energy
        return passive, friction, lost, stored

    @property
    def passive(self) -> Vector:
        """gamma^T f."""
        return self._along_joints[0]

    @property
    def friction(self) -> Vector:
        """gamma^T tau_F."""
        return self._along_joints[1]

    @property
    def dissipation(self) -> Number:
        """Power that friction, dampers and end stops take out [W]."""
        return self._along_joints[2]

    @cached_property
    def kinetic(self) -> Number:
        """v_A^T M_A v_A / 2, summed over bodies [J]."""
        velocity = self._motion.velocity
        total: Number = 0.0
        for i in range(1, self._size):
            mass, centre, tensor = self._bodies[i - 1]
            v, w = velocity[i]
            at = add(v, cross(w, centre))
            total = total + 0.5 * mass * dot(at, at) + 0.5 * dot(w, times(tensor, w))
        for i, inertia in self._rotors:
            total = total + 0.5 * inertia * self.rates[i] * self.rates[i]
        return total

    @cached_property
    def potential(self) -> Number:
        """Weights, springs, constant forces, end stops [J]."""
        total = self._along_joints[3]
        for mass, centre, _ in self._bodies:
            height = subtract(centre, self._posture.origin[0])
            total = total - mass * dot(self._gravity, height)
        return total

    def inverse(self, a_a: Sequence[Number], friction: bool) -> Vector:
        """M_A a_A + bias - passive [+ friction]."""
        tau = subtract(add(times(self.mass, a_a), self.inertial_bias), self.passive)
        return add(tau, self.friction) if friction else tau

    def forward(self, tau: Sequence[Number], friction: bool) -> Vector:
        """M_A^-1 (tau - bias + passive [- friction])."""
        right = subtract(add(tau, self.passive), self.inertial_bias)
        if friction:
            right = subtract(right, self.friction)
        return solve_positive(self.mass, right)

    def regressor(self, a_a: Sequence[Number]) -> list[Vector]:
        """Y_A (n, 10 nb + nr), inertial parameters in Pinocchio's joint frames, then rotors'."""
        velocity, acceleration = self._motion.velocity, self._motion.acceleration
        out: list[Vector] = [[] for _ in range(self._n)]
        for i in range(1, self._size):
            turn = self._posture.geometry.turns[i]
            axes = product(self._posture.rotation[i], turn.T.tolist())  # columns: joint's axes
            local = list(zip(*axes, strict=True))  # rows: trunk to joint
            origin = self._posture.origin[i]
            v, w = velocity[i]
            a, e = acceleration[i]
            for k in range(self._n + 1):
                factor: Number = a_a[k] if k < self._n else 1.0
                a = add(a, scale(factor, self._columns[i][k][0]))
                e = add(e, scale(factor, self._columns[i][k][1]))
            at = add(a, cross(e, origin), cross(w, add(v, cross(w, origin))))
            w, e, at = times(local, w), times(local, e), times(local, at)
            for k in range(self._n):
                linear, angular = self._columns[i][k]
                u = times(local, add(linear, cross(angular, origin)))
                out[k] += _body_row(u, times(local, angular), w, e, at)
        for i, _ in self._rotors:
            rate = dot(self.gamma[i], a_a) + self.drift[i]
            for k in range(self._n):
                out[k].append(self.gamma[i][k] * rate)
        return out


def _body_row(u: Vector, r: Vector, w: Vector, e: Vector, a: Vector) -> Vector:
    """Ten entries u . f + r . t per unit of each inertial parameter, all in the body's frame."""
    # mass times COM: f = e x c + w x (w x c), t = c x a
    first = add(cross(u, e), cross(w, cross(w, u)), cross(a, r))
    # inertia: t = I e + w x (I w), so r . t = r . I e + (r x w) . I w
    s = cross(r, w)

    def entry(j: int, k: int) -> Number:
        if j == k:
            return r[j] * e[j] + s[j] * w[j]
        return r[j] * e[k] + r[k] * e[j] + s[j] * w[k] + s[k] * w[j]

    pairs = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
    return [dot(u, a), *first, *(entry(j, k) for j, k in pairs)]
