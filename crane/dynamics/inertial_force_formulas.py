"""Inertial and gravity forces, mass matrix, energies and hybrid dynamics as symbolic formulas."""

from collections.abc import Callable, Sequence
from functools import cached_property

from crane.closure.kinematics_formulas import (
    ZERO_VECTOR,
    SpatialVector,
    Vector,
    add_spatial,
    coordinate_rates,
    scale_spatial,
)
from crane.codegen.symbolic import (
    Scalar,
    add_vectors,
    cross,
    dot,
    matmul,
    matvec,
    scale_vector,
    subtract_vectors,
    sum_scalars,
)
from crane.codegen.symbolic_linear_algebra import LdltFactorization
from crane.dynamics.joint_force_formulas import JointForceFormulas
from crane.dynamics.spatial_inertia import composite_mass_matrix


class InertialForceFormulas(JointForceFormulas):
    """Symbolic inertial forces and energies; base class of `DynamicsFormulas`."""

    @cached_property
    def _body_jacobians(self) -> list[list[tuple[Vector, Vector]]]:
        """Per body dV/dv_A (linear at the reference origin, angular) by column, then the drift."""
        columns: list[list[tuple[Vector, Vector]]] = [
            [([0.0] * 3, [0.0] * 3)] * (self._mobility + 1)
        ]
        for i in range(1, self._body_count):
            linear, angular = self.kinematics.joint_axes[i]
            factors = [*self.gamma[i], self.drift[i]]
            carried = columns[self.formula_structure.motion_parents[i]]
            columns.append(
                [
                    (
                        add_vectors(v, scale_vector(factor, linear)),
                        add_vectors(w, scale_vector(factor, angular)),
                    )
                    for factor, (v, w) in zip(factors, carried, strict=True)
                ]
            )
        return columns

    @cached_property
    def _body_inertias(self) -> list[tuple[Scalar, Vector, list[Vector]]]:
        """Per body mass, lever from origin to COM, inertia about it, in reference axes."""
        out: list[tuple[Scalar, Vector, list[Vector]]] = []
        for i in range(1, self._body_count):
            mass, *rest = self._inertia_constants[i - 1]
            rotation = self.kinematics.rotation[i]
            xx, xy, xz, yy, yz, zz = rest[3:]
            half = matmul(rotation, [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            tensor: list[Vector] = [[0.0] * 3 for _ in range(3)]
            for r, c in ((i, j) for i in range(3) for j in range(i + 1)):
                tensor[r][c] = tensor[c][r] = dot(half[r], rotation[c])
            out.append((mass, matvec(rotation, rest[:3]), tensor))
        return out

    @cached_property
    def body_inertias(self) -> list[tuple[Scalar, Vector, list[Vector]]]:
        """Per body mass, COM, inertia about it, in the frame of the reference body."""
        return [
            (mass, add_vectors(origin, lever), tensor)
            for origin, (mass, lever, tensor) in zip(
                self.kinematics.origin[1:], self._body_inertias, strict=True
            )
        ]

    @cached_property
    def mass_matrix(self) -> list[Vector]:
        """M_A = sum J_b^T I_b J_b + sum gamma_i^T I_r,i gamma_i."""
        if self.formula_structure.recursion_plan:
            clusters = [cluster for cluster, _ in self.formula_structure.recursion_plan]
            masses, rotors = self._body_inertias, self.rotor_inertias
            return composite_mass_matrix(self.kinematics, self.loops, masses, rotors, clusters)
        out: list[Vector] = [[0.0] * self._mobility for _ in range(self._mobility)]
        for i in range(1, self._body_count):
            mass, centre, tensor = self.body_inertias[i - 1]
            columns = [  # linear at the COM, angular
                (add_vectors(v, cross(w, centre)), w)
                for v, w in self._body_jacobians[i][: self._mobility]
            ]
            for k, (v, w) in enumerate(columns):
                momentum, spin = scale_vector(mass, v), matvec(tensor, w)
                for j in range(k + 1):
                    out[k][j] = out[k][j] + dot(momentum, columns[j][0]) + dot(spin, columns[j][1])
                    out[j][k] = out[k][j]
        for i, row in self.gamma.items():
            for k in range(self._mobility):
                for j in range(k + 1):
                    out[j][k] = out[k][j] = out[k][j] + self.rotor_inertias[i] * row[k] * row[j]
        return out

    def _propagate_wrenches(self, wrenches: Sequence[SpatialVector]) -> Vector:
        """Forces along the joints (nb + 1,) that balance wrenches at the bodies' COMs."""
        forces = [force for force, _ in wrenches]
        moments = [
            add_vectors(moment, cross(lever, force))
            for (_, lever, _), (force, moment) in zip(self._body_inertias, wrenches, strict=True)
        ]
        out: Vector = [0.0] * self._body_count
        for i in range(self._body_count - 1, 0, -1):
            force, moment = forces[i - 1], moments[i - 1]
            out[i] = dot(
                self.kinematics.joint_axis(i),
                moment if self.kinematics.geometry.is_revolute[i] else force,
            )
            carrier = self.formula_structure.motion_parents[i]
            if carrier:
                forces[carrier - 1] = add_vectors(forces[carrier - 1], force)
                moments[carrier - 1] = add_vectors(
                    moments[carrier - 1], moment, cross(self.kinematics.offsets[i], force)
                )
        return out

    def body_motions(
        self, joint_accelerations: Sequence[Scalar]
    ) -> tuple[list[SpatialVector], list[SpatialVector]]:
        """Velocities and accelerations of the bodies for joint accelerations (nb + 1,).

        Linear at the reference origin, angular; the world accelerates with -gravity.
        """
        added_accelerations = [ZERO_VECTOR]
        for i in range(1, self._body_count):
            before = added_accelerations[self.formula_structure.motion_parents[i]]
            added = scale_spatial(joint_accelerations[i], self.kinematics.joint_axes[i])
            added_accelerations.append(add_spatial(before, added))
        accelerations = [
            add_spatial(bias, added)
            for bias, added in zip(
                self._carrier_velocities.bias_accelerations, added_accelerations, strict=True
            )
        ]
        return self._carrier_velocities.velocities, accelerations

    def body_wrenches(self, joint_accelerations: Sequence[Scalar]) -> list[SpatialVector]:
        """Wrenches about the COMs for joint accelerations (nb + 1,), weights included."""
        wrenches: list[SpatialVector] = []
        velocities, accelerations = self.body_motions(joint_accelerations)
        for i in range(1, self._body_count):
            mass, centre, tensor = self.body_inertias[i - 1]
            (v, w), (a, e) = velocities[i], accelerations[i]
            at = add_vectors(a, cross(e, centre), cross(w, add_vectors(v, cross(w, centre))))
            wrenches.append(
                (
                    scale_vector(mass, at),
                    add_vectors(matvec(tensor, e), cross(w, matvec(tensor, w))),
                )
            )
        return wrenches

    def _inertial_joint_forces(self, joint_accelerations: Sequence[Scalar]) -> Vector:
        """Joint forces (nb + 1,) for joint accelerations (nb + 1,), weights included."""
        rotor_forces = [
            inertia * rate
            for inertia, rate in zip(self.rotor_inertias, joint_accelerations, strict=True)
        ]
        bodies = self._propagate_wrenches(self.body_wrenches(joint_accelerations))
        return add_vectors(bodies, rotor_forces)

    @cached_property
    def inertial_bias(self) -> Vector:
        """Sum J_b^T (I_b a_b + v_b x* I_b v_b) at a_A = 0, weights and rotors included."""
        return self.project(self._inertial_joint_forces(self.drift))

    @cached_property
    def gravity_force(self) -> Vector:
        """gamma^T g(q)."""
        return self.project(
            self._propagate_wrenches(
                [
                    (scale_vector(-mass, self._gravity), [0.0] * 3)
                    for mass, _, _ in self._body_inertias
                ]
            )
        )

    @property
    def coordinate_derivatives(self) -> Vector:
        """Time derivatives of the coordinates (nb,): the rates, except for rotation vectors."""
        return self.coordinate_rates(self.joint_velocities)

    def coordinate_rates(self, joint_velocities: Sequence[Scalar]) -> Vector:
        """Derivatives of the coordinates (nb,) along joint velocities (nb + 1,)."""
        return coordinate_rates(self.kinematics.geometry, self.q, joint_velocities[1:])

    @property
    def rate_jacobian(self) -> list[Vector]:
        """d(rates)/dv_A (nb, n), zero for ball joints and floating bases."""
        none: Vector = [0.0] * self._mobility
        series = self.kinematics.geometry.series_of_body
        return [none if i in series else self.gamma[i] for i in range(1, self._body_count)]

    @cached_property
    def kinetic(self) -> Scalar:
        """v_A^T M_A v_A / 2, summed over bodies [J]."""
        total: Scalar = 0.0
        for i in range(1, self._body_count):
            mass, centre, tensor = self.body_inertias[i - 1]
            v, w = self._carrier_velocities.velocities[i]
            at = add_vectors(v, cross(w, centre))
            total = total + 0.5 * mass * dot(at, at) + 0.5 * dot(w, matvec(tensor, w))
        for inertia, rate in zip(self.rotor_inertias, self.joint_velocities, strict=True):
            total = total + 0.5 * inertia * rate * rate
        return total

    @cached_property
    def potential(self) -> Scalar:
        """Weights, springs, constant forces, gas, end stops, ropes [J]."""
        total = sum_scalars(found.stored_energy for found in self._law_values)
        for mass, centre, _ in self.body_inertias:
            total = total - mass * dot(
                self._gravity, subtract_vectors(centre, self.kinematics.origin[0])
            )
        return total


def hybrid_dynamics(
    inverse: Callable[[Sequence[Scalar], bool], Vector],
    driven: Sequence[bool],
    a_d: Sequence[Scalar],
    friction: bool,
    held: Sequence[int] = (),
) -> tuple[Vector, Vector]:
    """`Dynamics.hybrid` from a function of inverse dynamics, for numbers or formulas.

    Columns of M_A are differences of inverse dynamics, which share all but the accelerations.

    Args:
        inverse: (a_A (n,), friction) -> tau_A (n,).
        driven: (n,) whether a joint is driven.
        a_d: (k,) accelerations of the driven joints [m/s2], [rad/s2].
        friction: Whether friction is included.
        held: See `Machine.held`.

    Returns:
        Forces (k,) of the driven joints and accelerations (n - k,) of the others.
    """
    n, given = len(driven), iter(a_d)
    forces_without_free_motion = inverse(
        [next(given) if moved else 0.0 for moved in driven], friction
    )
    free = [i for i in range(n) if not driven[i]]
    if not free:
        return forces_without_free_motion, []
    bias = inverse([0.0] * n, False)
    columns = [
        subtract_vectors(inverse([float(k == i) for k in range(n)], False), bias) for i in free
    ]
    free_block = [[column[i] for column in columns] for i in free]
    held_places = [k for k, i in enumerate(free) if i in held]
    a_f = LdltFactorization(free_block, [0.0] * len(free), held_places).solve(
        [-forces_without_free_motion[i] for i in free]
    )
    tau = add_vectors(
        forces_without_free_motion,
        *(scale_vector(a, column) for a, column in zip(a_f, columns, strict=True)),
    )
    return [x for x, moved in zip(tau, driven, strict=True) if moved], a_f
