"""One forward sweep (Kane's form) and the forces along joints and distances, as formulas."""

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from crane.closure.kinematics_formulas import (
    FormulaConstants,
    LoopFormulas,
    PositionKinematics,
    TreeGeometry,
    VelocityKinematics,
)
from crane.closure.rotation_vector_formulas import rotation_matrix, rotation_vector_derivative
from crane.closure.spatial_vectors import SpatialVector, Vector
from crane.codegen.matrix_factorization import LdltFactorization
from crane.codegen.symbolic import (
    Scalar,
    add_vectors,
    apply_function,
    cross,
    dot,
    matmul,
    matvec,
    maximum,
    minimum,
    scale_vector,
    subtract_vectors,
    transpose,
    where_positive,
)  # fmt: skip
from crane.common.samples import Array
from crane.dynamics.cluster_recursion import RecursionPlan, joint_accelerations, plan_recursion
from crane.dynamics.composite_mass_matrix import CompositeMassMatrix
from crane.dynamics.force_law_formulas import (
    END_STOP_INDEX,
    LAW_SIZE,
    NO_FORCE,
    SLIP_INDEX,
    ForceLawValues,
    evaluate_force_law,
    friction_sign,
)
from crane.dynamics.formulation import carrier_bodies
from crane.dynamics.frame_distances import MIN_LENGTH
from crane.dynamics.joint_forces import REST_ACCELERATION, REST_VELOCITY, JointForces
from crane.dynamics.recursion_input import RecursionInput
from crane.machine import Machine

BODY_SIZE = 10  # numbers of a body
_MAX_MOBILITY_FACTORIZED = (
    7  # freedoms up to which solving with M_A takes fewer operations than recursion
)
_UPPER_TRIANGLE = np.triu_indices(3)
DistanceBodies = tuple[tuple[int, int], ...]  # by distance the bodies of both ends; 0 is the world


def dynamics_constants(machine: Machine, geometry: TreeGeometry, forces: JointForces) -> Array:
    """Inertias, force laws and gravity in the order that `DynamicsFormulas` reads them.

    Per body mass, COM (3), inertia about it (xx, xy, xz, yy, yz, zz) in the body's directions of
    the geometry; per joint the 22 numbers of `JointForces.law_table`; gravity (3); per joint its
    rotor inertia; per distance its 22 numbers, and where its two ends are on their bodies,
    likewise; whether anything moves; what a circuit adds to the Coulomb friction of joints
    (`JointForces.circuit_friction_columns`); mass and first moment of what stands (4); where the
    tip is on its body, likewise, if there is one.
    """
    bodies = []
    for i, joint in enumerate(machine.coordinates.joints, start=1):
        if i in geometry.massless_bodies:
            bodies.append([0.0] * BODY_SIZE)
            continue
        turn, inertia = geometry.body_rotations[i], machine.model.inertias[int(joint)]
        tensor = turn.T @ inertia.inertia @ turn
        bodies.append([inertia.mass, *(turn.T @ inertia.lever), *tensor[_UPPER_TRIANGLE]])
    gravity = machine.model.gravity.linear
    rotors = machine.model.armature
    joint_laws, distance_laws = np.split(forces.table, [len(bodies)])
    numbers = [np.ravel(bodies), np.ravel(joint_laws), gravity, rotors]
    for law, ends in zip(distance_laws, forces.lengths.end_points, strict=True):
        turns = (
            geometry.body_rotations[machine.coordinates.body_of_joint[joint]] for joint, _ in ends
        )
        places = (turn.T @ place for turn, (_, place) in zip(turns, ends, strict=True))
        numbers += [law, *places]
    numbers += [
        [forces.moving_factor],
        forces.circuit_friction[list(forces.circuit_friction_columns)],
    ]
    fixed_inertia = machine.model.inertias[0]
    numbers += [[fixed_inertia.mass], fixed_inertia.mass * fixed_inertia.lever]
    if machine.tip is not None:
        body, place = tip_body_and_point(machine)
        numbers.append(geometry.body_rotations[body].T @ place)
    return np.concatenate(numbers)


def tip_body_and_point(machine: Machine) -> tuple[int, Array]:
    """The body of a machine's tip, and where it is on it (3,) [m]."""
    assert machine.tip is not None
    frame = machine.model.frames[machine.frame(machine.tip)]
    return machine.coordinates.body_of_joint[frame.parentJoint], np.array(
        frame.placement.translation
    )


def circuit_friction_indices(machine: Machine, forces: JointForces) -> list[int]:
    """Where `dynamics_constants` has what `JointForces.set_circuit_friction` says."""
    first = stick_slip_mode_indices(machine, forces)[-1] + 1
    return list(range(first, first + len(forces.circuit_friction_columns)))


def stick_slip_mode_indices(machine: Machine, forces: JointForces) -> list[int]:
    """Indices in `dynamics_constants` of the stick-slip modes, joint by joint."""
    bodies = machine.model.nv
    first = BODY_SIZE * bodies + SLIP_INDEX
    last = (
        (BODY_SIZE + LAW_SIZE + 1) * bodies + 3 + (LAW_SIZE + 6) * len(forces.lengths.end_points)
    )
    return [first + LAW_SIZE * i + k for i in forces.sticking for k in range(3)] + [last]


@dataclass(frozen=True)
class FormulaStructure:
    """What a machine's formulas depend on besides its loops and numbers.

    Attributes:
        carrier_bodies: See `crane.dynamics.formulation`.
        recursion_plan: How forward dynamics goes through the machine's clusters; see
            `crane.dynamics.cluster_recursion`.
        distance_bodies: By distance of `JointForces.frame_distances` the bodies that its ends are
            on.
        stick_slip_columns: Columns of the joints whose friction sticks.
        circuit_friction_columns: Columns of the joints whose Coulomb friction a circuit adds to.
        tip_body: Body of the tip, if there is one.
    """

    carrier_bodies: tuple[int, ...]
    recursion_plan: RecursionPlan
    distance_bodies: DistanceBodies
    stick_slip_columns: tuple[int, ...]
    circuit_friction_columns: tuple[int, ...]
    tip_body: int | None

    @classmethod
    def from_machine(
        cls, machine: Machine, formulation: str, forces: JointForces
    ) -> "FormulaStructure":
        """That of a machine.

        Raises:
            InputError: Unknown formulation.
        """
        bodies = machine.coordinates.body_of_joint
        spans = ((bodies[one], bodies[two]) for (one, _), (two, _) in forces.lengths.end_points)
        plan = plan_recursion(machine) if formulation == "exact" else ()
        kinds = forces.sticking, forces.circuit_friction_columns
        tip = None if machine.tip is None else tip_body_and_point(machine)[0]
        return cls(carrier_bodies(machine, formulation), plan, tuple(spans), *kinds, tip)


@dataclass(frozen=True)
class StickSlipAccelerations:
    """A machine under forces, with friction that sticks.

    Attributes:
        a_a: (n,) accelerations.
        friction_at_rest: (k,) friction of the joints at rest whose friction sticks, 0 of those
            that slip.
        active_friction: gamma^T tau_F (n,).
        transition_margin: What is left until a joint slips that is at rest, as a share of its
            limit, or comes to rest that slips, as a velocity of the machine; the least. Negative
            beyond.
    """

    a_a: Vector
    friction_at_rest: Vector
    active_friction: Vector
    transition_margin: Scalar


class DynamicsFormulas:
    """Dynamics at a traced closed posture.

    Args:
        kinematics: Bodies.
        loops: Loops at that posture.
        constants: See `dynamics_constants`.
        q: (nb,).
        v_a: (n,).
        formula_structure: What goes where.
        use_modes: Whether `JointForces.set_stick_slip_modes` says what joints do whose friction
            sticks, not their velocities.
        drift: If it is known already.

    Attributes:
        kinematics: Bodies.
        loops: Loops.
        q: (nb,).
        v_a: (n,).
        rotor_inertias: (nb + 1,) rotor inertias, 0 for the world.
        gamma: Rows of gamma by joint.
        joint_velocities: (nb + 1,) joint velocities, 0 for the world.
        drift: (nb + 1,) accelerations of the joints at a_A = 0.
        circuit_friction: (g,) what the constants say that a circuit adds to Coulomb friction.
    """

    def __init__(
        self,
        kinematics: PositionKinematics,
        loops: LoopFormulas,
        constants: FormulaConstants,
        q: Sequence[Scalar],
        v_a: Sequence[Scalar],
        formula_structure: FormulaStructure,
        use_modes: bool = False,
        drift: Vector | None = None,
    ):
        self.formula_structure, self._use_modes = formula_structure, use_modes
        self.v_a = list(v_a)
        self.posture, self.loops, self.q = kinematics, loops, q
        self._body_count = len(kinematics.geometry.parents)
        self._mobility = len(v_a)
        bodies = self._body_count - 1
        self._inertia_constants = [
            constants.vector(BODY_SIZE * i, BODY_SIZE) for i in range(bodies)
        ]
        first = BODY_SIZE * bodies
        self._joint_laws = [
            constants.vector(first + LAW_SIZE * i, LAW_SIZE) for i in range(bodies)
        ]
        gravity = constants.vector((BODY_SIZE + LAW_SIZE) * bodies)
        self._gravity = matvec(kinematics.rotation[0], gravity)
        self.rotors: Vector = [0.0, *constants.vector((BODY_SIZE + LAW_SIZE) * bodies + 3, bodies)]
        after = (BODY_SIZE + LAW_SIZE + 1) * bodies + 3
        self._distance_constants = [
            constants.vector(after + (LAW_SIZE + 6) * k, LAW_SIZE + 6)
            for k in range(len(formula_structure.distance_bodies))
        ]
        last = after + (LAW_SIZE + 6) * len(formula_structure.distance_bodies)
        self._moving_factor = constants[last]
        self.circuit_friction = constants.vector(
            last + 1, len(formula_structure.circuit_friction_columns)
        )
        last += len(formula_structure.circuit_friction_columns)
        self._fixed_inertia = constants.vector(last + 1, 4)
        self._tip_point = (
            None if formula_structure.tip_body is None else constants.vector(last + 5)
        )
        self.gamma = loops.gamma
        self.rates: Vector = [0.0, *(dot(self.gamma[i], v_a) for i in range(1, self._body_count))]
        # the loops' drift is that of the whole machine whatever carries a body
        tree_velocities, carrier_velocities = (
            VelocityKinematics(kinematics, loops, self.rates, self._gravity, parents)
            for parents in (kinematics.geometry.parents, formula_structure.carrier_bodies)
        )
        self.drift = tree_velocities.drift if drift is None else drift
        self._tree_velocities, self._carrier_velocities = tree_velocities, carrier_velocities

    def with_circuit_friction(self, circuit_friction: Sequence[Scalar]) -> "DynamicsFormulas":
        """The same with the Coulomb friction (g,) that a circuit adds.

        Its joints are those of `FormulaStructure.with_circuit_friction`.
        """
        if not self.formula_structure.circuit_friction_columns:
            return self
        out = copy(self)
        for name in ("_joint_law_values", "_passive_joint_forces"):  # cached friction
            out.__dict__.pop(name, None)
        out._joint_laws = list(self._joint_laws)
        for i, more in zip(
            self.formula_structure.circuit_friction_columns, circuit_friction, strict=True
        ):
            out._joint_laws[i] = [self._joint_laws[i][0] + more, *self._joint_laws[i][1:]]
        return out

    @cached_property
    def _body_jacobians(self) -> list[list[tuple[Vector, Vector]]]:
        """Per body dV/dv_A (linear at the trunk's origin, angular) by column, then the drift."""
        columns: list[list[tuple[Vector, Vector]]] = [
            [([0.0] * 3, [0.0] * 3)] * (self._mobility + 1)
        ]
        for i in range(1, self._body_count):
            linear, angular = self.posture.joint_axes[i]
            factors = [*self.gamma[i], self.drift[i]]
            carried = columns[self.formula_structure.carrier_bodies[i]]
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
        """Per body mass, lever from origin to COM, inertia about it, in the trunk's axes."""
        out: list[tuple[Scalar, Vector, list[Vector]]] = []
        for i in range(1, self._body_count):
            mass, *rest = self._inertia_constants[i - 1]
            rotation = self.posture.rotation[i]
            xx, xy, xz, yy, yz, zz = rest[3:]
            half = matmul(rotation, [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            tensor: list[Vector] = [[0.0] * 3 for _ in range(3)]
            for r in range(3):
                for c in range(r + 1):
                    tensor[r][c] = tensor[c][r] = dot(half[r], rotation[c])
            out.append((mass, matvec(rotation, rest[:3]), tensor))
        return out

    @cached_property
    def body_inertias(self) -> list[tuple[Scalar, Vector, list[Vector]]]:
        """Per body mass, COM, inertia about it, in the trunk's frame."""
        origins = self.posture.origin[1:]
        return [
            (mass, add_vectors(origin, lever), tensor)
            for origin, (mass, lever, tensor) in zip(origins, self._body_inertias, strict=True)
        ]

    def _centre_of_mass_jacobian(self, i: int) -> list[tuple[Vector, Vector]]:
        """Columns of body i: linear at its COM, angular."""
        _, centre, _ = self.body_inertias[i - 1]
        return [
            (add_vectors(v, cross(w, centre)), w)
            for v, w in self._body_jacobians[i][: self._mobility]
        ]

    @cached_property
    def mass_matrix(self) -> list[Vector]:
        """M_A = sum J_b^T I_b J_b + sum gamma_i^T I_r,i gamma_i."""
        if self.formula_structure.recursion_plan:
            clusters = [cluster for cluster, _ in self.formula_structure.recursion_plan]
            masses, rotors = self._body_inertias, self.rotors
            return CompositeMassMatrix(
                self.posture, self.loops, masses, rotors, clusters
            ).mass_matrix
        out: list[Vector] = [[0.0] * self._mobility for _ in range(self._mobility)]
        for i in range(1, self._body_count):
            mass, _, tensor = self.body_inertias[i - 1]
            columns = self._centre_of_mass_jacobian(i)
            for k, (v, w) in enumerate(columns):
                momentum, spin = scale_vector(mass, v), matvec(tensor, w)
                for j in range(k + 1):
                    out[k][j] = out[k][j] + dot(momentum, columns[j][0]) + dot(spin, columns[j][1])
                    out[j][k] = out[k][j]
        for i, row in self.gamma.items():
            for k in range(self._mobility):
                for j in range(k + 1):
                    out[j][k] = out[k][j] = out[k][j] + self.rotors[i] * row[k] * row[j]
        return out

    def project(self, joint_forces: Sequence[Scalar]) -> Vector:
        """gamma^T of forces along the joints (nb + 1,)."""
        out: Vector = [0.0] * self._mobility
        for i, row in self.gamma.items():
            out = add_vectors(out, scale_vector(joint_forces[i], row))
        return out

    def _propagate_wrenches(self, wrenches: Sequence[SpatialVector]) -> Vector:
        """Forces along the joints (nb + 1,) that hold wrenches at the bodies' COMs."""
        forces = [force for force, _ in wrenches]
        moments = [
            add_vectors(moment, cross(lever, force))
            for (_, lever, _), (force, moment) in zip(self._body_inertias, wrenches, strict=True)
        ]
        out: Vector = [0.0] * self._body_count
        for i in range(self._body_count - 1, 0, -1):
            force, moment = forces[i - 1], moments[i - 1]
            axis = self.posture.joint_axis(i)
            out[i] = dot(axis, moment if self.posture.geometry.is_revolute[i] else force)
            carrier = self.formula_structure.carrier_bodies[i]
            if carrier:
                arm = self.posture.offsets[i]
                forces[carrier - 1] = add_vectors(forces[carrier - 1], force)
                moments[carrier - 1] = add_vectors(moments[carrier - 1], moment, cross(arm, force))
        return out

    def body_motions(
        self, joint_accelerations: Sequence[Scalar]
    ) -> tuple[list[SpatialVector], list[SpatialVector]]:
        """Velocities and accelerations of the bodies whose joints accelerate so (nb + 1,).

        Linear at the trunk's origin, angular; the world accelerates with -gravity.
        """
        added_accelerations: list[SpatialVector] = [([0.0] * 3, [0.0] * 3)]
        for i in range(1, self._body_count):
            linear, angular = (
                scale_vector(joint_accelerations[i], part) for part in self.posture.joint_axes[i]
            )
            before = added_accelerations[self.formula_structure.carrier_bodies[i]]
            added_accelerations.append(
                (add_vectors(before[0], linear), add_vectors(before[1], angular))
            )
        accelerations = [
            (add_vectors(a, more), add_vectors(e, turned))
            for (a, e), (more, turned) in zip(
                self._carrier_velocities.bias_accelerations, added_accelerations, strict=True
            )
        ]
        return self._carrier_velocities.velocities, accelerations

    def body_wrenches(self, joint_accelerations: Sequence[Scalar]) -> list[SpatialVector]:
        """Wrenches about the COMs that accelerate the joints so (nb + 1,), weights included."""
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
        """Forces along the joints (nb + 1,) that accelerate them so, weights included."""
        rotor_inertias = [
            inertia * rate for inertia, rate in zip(self.rotors, joint_accelerations, strict=True)
        ]
        return add_vectors(
            self._propagate_wrenches(self.body_wrenches(joint_accelerations)), rotor_inertias
        )

    @cached_property
    def inertial_bias(self) -> Vector:
        """Sum J_b^T (I_b a_b + v_b x* I_b v_b) at a_A = 0, weights and rotors included."""
        return self.project(self._inertial_joint_forces(self.drift))

    @cached_property
    def gravity_force(self) -> Vector:
        """gamma^T g(q)."""
        wrenches: list[SpatialVector] = [
            (scale_vector(-mass, self._gravity), [0.0] * 3) for mass, _, _ in self._body_inertias
        ]
        return self.project(self._propagate_wrenches(wrenches))

    @property
    def static_quantities(self) -> list[Scalar]:
        """The numbers that loads at rest depend on, see `crane.dynamics.static_quantities.layout`.

        First moment s = sum m c of all masses and ds/dq_A, mass, gamma^T f (at rest where v_A is
        0); tip and dtip/dq_A if there is one; in the world. With what joint j carries, m_j, s_j,

            ds/dq_k = sum_j gamma_jk (m_j l_j + a_j x s_j),

        l_j, a_j its column, linear at the trunk's origin and angular.
        """
        kinematics, parents = self.posture, self.posture.geometry.parents
        carried: list[tuple[Scalar, Vector]] = [(0.0, [0.0] * 3)]
        carried += [(mass, scale_vector(mass, centre)) for mass, centre, _ in self.body_inertias]
        for i in range(self._body_count - 1, 0, -1):
            mass, first_moment = carried[parents[i]]
            carried[parents[i]] = (mass + carried[i][0], add_vectors(first_moment, carried[i][1]))
        mass, first_moment = carried[0]
        first_moment = self._rotate_to_world(
            subtract_vectors(first_moment, scale_vector(mass, kinematics.origin[0]))
        )
        jacobian: list[Vector] = [[0.0] * 3 for _ in range(self._mobility)]
        for i in range(1, self._body_count):
            linear, angular = kinematics.joint_axes[i]
            derivative = add_vectors(
                scale_vector(carried[i][0], linear), cross(angular, carried[i][1])
            )
            jacobian = [
                add_vectors(x, scale_vector(f, derivative))
                for x, f in zip(jacobian, self.gamma[i], strict=True)
            ]
        out = [
            *add_vectors(first_moment, self._fixed_inertia[1:]),
            *_flatten_by_row(map(self._rotate_to_world, jacobian)),
        ]
        out += [mass + self._fixed_inertia[0], *self.passive_force]
        if self._tip_point is None or self.formula_structure.tip_body is None:
            return out
        body = self.formula_structure.tip_body
        point = add_vectors(
            kinematics.origin[body], matvec(kinematics.rotation[body], self._tip_point)
        )
        jacobian = [[0.0] * 3 for _ in range(self._mobility)]
        for i in sorted(_supporting_bodies(parents, body)):
            linear, angular = kinematics.joint_axes[i]
            derivative = add_vectors(linear, cross(angular, point))
            jacobian = [
                add_vectors(x, scale_vector(f, derivative))
                for x, f in zip(jacobian, self.gamma[i], strict=True)
            ]
        out += self._rotate_to_world(subtract_vectors(point, kinematics.origin[0]))
        return [*out, *_flatten_by_row(map(self._rotate_to_world, jacobian))]

    def _rotate_to_world(self, vector: Vector) -> Vector:
        """A vector in the world's directions."""
        return matvec(transpose(self.posture.rotation[0]), vector)

    @cached_property
    def _joint_law_values(self) -> list[ForceLawValues]:
        """What happens at all joints (nb + 1,)."""
        every = zip(self._joint_laws, self.q, self.rates[1:], strict=True)
        sticking = self.formula_structure.stick_slip_columns
        laws = (
            evaluate_force_law(*x, i in sticking, self._use_modes) for i, x in enumerate(every)
        )
        return [NO_FORCE, *laws]

    @cached_property
    def _distance_law_values(self) -> list[tuple[dict[int, Scalar], ForceLawValues, Scalar]]:
        """Of every distance dl/dv by joint, what happens along it, and itself.

        See `crane.dynamics.frame_distances`.
        The force along it is a wrench [u; p_2 x u] on the second body, and its reaction on the
        first, so what carries both feels nothing.
        """
        posture, out = self.posture, []
        for bodies, numbers in zip(
            self.formula_structure.distance_bodies, self._distance_constants, strict=True
        ):
            law, places = numbers[:LAW_SIZE], (numbers[LAW_SIZE:-3], numbers[-3:])
            one, two = (
                add_vectors(posture.origin[body], matvec(posture.rotation[body], place))
                for body, place in zip(bodies, places, strict=True)
            )
            vector = subtract_vectors(two, one)
            length = apply_function("sqrt", dot(vector, vector))
            direction = scale_vector(1.0 / maximum(length, MIN_LENGTH), vector)
            moment = cross(two, direction)
            first_supports, second_supports = (
                _supporting_bodies(posture.geometry.parents, body) for body in bodies
            )
            distance_jacobian: dict[int, Scalar] = {}
            for i in sorted(first_supports ^ second_supports):
                linear, angular = posture.joint_axes[i]
                derivative = dot(direction, linear) + dot(moment, angular)
                distance_jacobian[i] = derivative if i in second_supports else -derivative
            rate = dot(
                list(distance_jacobian.values()), [self.rates[i] for i in distance_jacobian]
            )
            out.append(
                (distance_jacobian, evaluate_force_law(law, length, rate, False, False), length)
            )
        return out

    @cached_property
    def _passive_joint_forces(self) -> Vector:
        """f, passive forces along the joints (nb + 1,)."""
        out = [found.force for found in self._joint_law_values]
        for slopes, found, _ in self._distance_law_values:
            for i, slope in slopes.items():
                out[i] = out[i] + found.force * slope
        return out

    @property
    def _joint_friction(self) -> Vector:
        """tau_F, friction along the joints (nb + 1,)."""
        return [found.friction for found in self._joint_law_values]

    @property
    def _law_values(self) -> list[ForceLawValues]:
        """What happens at all joints and along all distances."""
        return [*self._joint_law_values, *(found for _, found, _ in self._distance_law_values)]

    @property
    def stiffness(self) -> list[Vector]:
        """d(gamma^T f)/dq_A of springs, gas, end stops and ropes at frozen gamma (n, n)."""
        along = [
            (self.gamma[i], self._joint_law_values[i].force_derivative)
            for i in range(1, self._body_count)
        ]
        for slopes, found, _ in self._distance_law_values:
            row: Vector = [0.0] * self._mobility
            for i, slope in slopes.items():
                row = add_vectors(row, scale_vector(slope, self.gamma[i]))
            along.append((row, found.force_derivative))
        out: list[Vector] = [[0.0] * self._mobility for _ in range(self._mobility)]
        for row, stiffness in along:
            for k, entry in enumerate(row):
                out[k] = add_vectors(out[k], scale_vector(entry * stiffness, row))
        return out

    def end_stop_distances(
        self, coordinate_units: Sequence[float], characteristic_length: float
    ) -> Vector:
        """How far what stops is beyond where it begins to, each over its unit.

        Args:
            coordinate_units: (nb,) of the joints.
            characteristic_length: Of the machine, that of ropes [m].
        """
        out: Vector = []
        for law, q, unit in zip(self._joint_laws, self.q, coordinate_units, strict=True):
            if law[END_STOP_INDEX] != 0.0:
                out += [
                    (q - law[END_STOP_INDEX + 3]) * (1.0 / unit),
                    (law[END_STOP_INDEX + 2] - q) * (1.0 / unit),
                ]
        for numbers, (_, _, length) in zip(
            self._distance_constants, self._distance_law_values, strict=True
        ):
            if numbers[END_STOP_INDEX] != 0.0:
                out.append((length - numbers[END_STOP_INDEX + 3]) * (1.0 / characteristic_length))
        return out

    @property
    def rate_jacobian(self) -> list[Vector]:
        """d(slopes)/dv_A (nb, n), none of free-flyers."""
        flying = {i + k for i in self.posture.geometry.floating_bases for k in range(6)}
        none: Vector = [0.0] * self._mobility
        return [none if i in flying else self.gamma[i] for i in range(1, self._body_count)]

    @property
    def active_motion_factors(self) -> Vector:
        """(n,) 0 of active joints that are at rest to the last bit, else 1."""
        out: Vector = [self._moving_factor] * self._mobility
        is_held = {
            i: self._joint_laws[i][SLIP_INDEX + 1]
            for i in self.formula_structure.stick_slip_columns
        }
        for k, joint in enumerate(self.loops.active_joints):
            if joint - 1 in is_held:
                out[k] = self._moving_factor * (1.0 - is_held[joint - 1])
        return out

    @property
    def coordinate_derivatives(self) -> Vector:
        """Time derivatives of the coordinates (nb,): the rates, but of rotation vectors."""
        return self._coordinate_derivatives(self.rates)

    def coordinate_direction(self, k: int) -> Vector:
        """How the coordinates (nb,) change with the motion v_k = 1."""
        return self._coordinate_derivatives(
            [0.0, *(self.gamma[i][k] for i in range(1, self._body_count))]
        )

    def _coordinate_derivatives(self, joint_velocities: Vector) -> Vector:
        out = list(joint_velocities[1:])
        for i in self.posture.geometry.floating_bases:
            linear, angular = out[i - 1 : i + 2], out[i + 2 : i + 5]
            vector = self.q[i + 2 : i + 5]
            out[i - 1 : i + 2] = matvec(rotation_matrix(vector), linear)
            out[i + 2 : i + 5] = rotation_vector_derivative(vector, angular)
        return out

    @property
    def passive_force(self) -> Vector:
        """gamma^T f."""
        return self.project(self._passive_joint_forces)

    @property
    def friction_force(self) -> Vector:
        """gamma^T tau_F."""
        return self.project(self._joint_friction)

    @property
    def dissipated_power(self) -> Scalar:
        """Power that friction, dampers, end stops and ropes take out [W]."""
        total: Scalar = 0.0
        for found in self._law_values:
            total = total + found.dissipated_power
        return total

    @cached_property
    def kinetic(self) -> Scalar:
        """v_A^T M_A v_A / 2, summed over bodies [J]."""
        velocity = self._carrier_velocities.velocities
        total: Scalar = 0.0
        for i in range(1, self._body_count):
            mass, centre, tensor = self.body_inertias[i - 1]
            v, w = velocity[i]
            at = add_vectors(v, cross(w, centre))
            total = total + 0.5 * mass * dot(at, at) + 0.5 * dot(w, matvec(tensor, w))
        for inertia, rate in zip(self.rotors, self.rates, strict=True):
            total = total + 0.5 * inertia * rate * rate
        return total

    @cached_property
    def potential(self) -> Scalar:
        """Weights, springs, constant forces, gas, end stops, ropes [J]."""
        total: Scalar = 0.0
        for found in self._law_values:
            total = total + found.stored_energy
        for mass, centre, _ in self.body_inertias:
            height = subtract_vectors(centre, self.posture.origin[0])
            total = total - mass * dot(self._gravity, height)
        return total

    def inverse_dynamics(self, a_a: Sequence[Scalar], friction: bool) -> Vector:
        """M_A a_A + bias - passive [+ friction]; friction at rest is against the acceleration."""
        joint_velocities = [
            0.0,
            *(dot(row, a_a) + self.drift[i] for i, row in sorted(self.gamma.items())),
        ]
        joint_forces = subtract_vectors(
            self._inertial_joint_forces(joint_velocities),
            self.passive_and_friction_forces(friction),
        )
        for i in self.formula_structure.stick_slip_columns if friction else ():
            law, rate = self._joint_laws[i], joint_velocities[i + 1]
            sign = friction_sign(law, self.rates[i + 1], True, self._use_modes)
            negative_sign = where_positive(-REST_ACCELERATION - rate, -1.0, 0.0)
            breakaway = (law[0] + law[5]) * (
                where_positive(rate - REST_ACCELERATION, 1.0, negative_sign) - sign
            )
            joint_forces[i + 1] = joint_forces[i + 1] + where_positive(
                1.0 - apply_function("abs", sign), breakaway, 0.0
            )
        return self.project(joint_forces)

    def passive_and_friction_forces(self, friction: bool) -> Vector:
        """Forces along the joints (nb + 1,) that nobody commands."""
        return (
            subtract_vectors(self._passive_joint_forces, self._joint_friction)
            if friction
            else self._passive_joint_forces
        )

    def forward_dynamics(self, tau: Sequence[Scalar], friction: bool) -> Vector:
        """M_A^-1 (tau - bias + passive [- friction])."""
        if self.formula_structure.recursion_plan and self._mobility > _MAX_MOBILITY_FACTORIZED:
            return self._recursive_forward_dynamics(tau, friction)
        right = add_vectors(tau, self.project(self.passive_and_friction_forces(friction)))
        return LdltFactorization(self.mass_matrix).solve(
            subtract_vectors(right, self.inertial_bias)
        )

    def stick_slip_equations(self, tau: Sequence[Scalar]) -> Vector:
        """What tells which joints stick: M_A (n^2), rows of gamma (k n), their drift (k), net (n).

        Of the joints whose friction sticks; net is what tau leaves behind bias and friction.
        """
        rows = [
            entry for i in self.formula_structure.stick_slip_columns for entry in self.gamma[i + 1]
        ]
        drift = [self.drift[i + 1] for i in self.formula_structure.stick_slip_columns]
        return [
            *(entry for row in self.mass_matrix for entry in row),
            *rows,
            *drift,
            *self._net_force(tau),
        ]

    def _net_force(self, tau: Sequence[Scalar]) -> Vector:
        """What is left of tau behind bias and friction."""
        return subtract_vectors(
            add_vectors(tau, self.project(self.passive_and_friction_forces(True))),
            self.inertial_bias,
        )

    @property
    def stick_slip_rows(self) -> list[tuple[Scalar, Vector]]:
        """Of each joint that can stick, whether it is held, and its row of gamma."""
        return [
            (self._joint_laws[i][SLIP_INDEX + 1], self.gamma[i + 1])
            for i in self.formula_structure.stick_slip_columns
        ]

    def accelerations_with_stick_slip(
        self, tau: Sequence[Scalar], with_joints_at_rest: bool
    ) -> StickSlipAccelerations:
        """Accelerations under active forces, with joints at rest or without.

        Joints k that are held accelerate by nothing, Gamma a_A + d = 0 with Gamma their rows of
        gamma and d their drift, and r is what that takes beside the offset of their friction:

            M_A a_A = f - Gamma^T r,    Gamma M_A^-1 Gamma^T r = Gamma M_A^-1 f + d.

        Args:
            tau: (n,).
            with_joints_at_rest: Whether some joint is at rest.
        """
        laws = [self._joint_laws[i] for i in self.formula_structure.stick_slip_columns]
        slip_signs, is_held, inverse_velocities = (
            [law[SLIP_INDEX + k] for law in laws] for k in range(3)
        )
        limits = [law[0] + law[5] for law in laws]
        velocities = [self.rates[i + 1] for i in self.formula_structure.stick_slip_columns]
        slip_velocities = [
            s * v * p for s, v, p in zip(slip_signs, velocities, inverse_velocities, strict=True)
        ]
        if not with_joints_at_rest:
            none: Vector = [0.0] * len(laws)
            return StickSlipAccelerations(
                self.forward_dynamics(tau, True),
                none,
                self.friction_force,
                _minimum(slip_velocities),
            )
        rows = [self.gamma[i + 1] for i in self.formula_structure.stick_slip_columns]
        right = self._net_force(tau)
        mass = LdltFactorization(self.mass_matrix)
        half = [
            scale_vector(w, mass.forward_substitute(row))
            for w, row in zip(is_held, rows, strict=True)
        ]
        weighted = [
            [x * d for x, d in zip(row, mass.inverse_diagonal, strict=True)] for row in half
        ]
        half_right = mass.forward_substitute(right)
        matrix = [[dot(one, other) for other in half] for one in weighted]
        required: Vector = []
        for k, (i, w) in enumerate(
            zip(self.formula_structure.stick_slip_columns, is_held, strict=True)
        ):
            matrix[k][k] = matrix[k][k] + (1.0 - w)
            required.append(dot(weighted[k], half_right) + w * self.drift[i + 1])
        holding_forces = LdltFactorization(matrix).solve(required)
        holding_active_forces: Vector = [0.0] * self._mobility
        for r, row in zip(holding_forces, rows, strict=True):
            holding_active_forces = add_vectors(holding_active_forces, scale_vector(r, row))
        a_a = mass.solve(subtract_vectors(right, holding_active_forces))
        a_a = [a * free for a, free in zip(a_a, self.active_motion_factors, strict=True)]
        remaining_limit = [
            1.0 - apply_function("abs", r) / limit
            for r, limit in zip(holding_forces, limits, strict=True)
        ]
        margins = [
            where_positive(w - 0.5, one, other)
            for w, one, other in zip(is_held, remaining_limit, slip_velocities, strict=True)
        ]
        any_held = 1.0 - _minimum([1.0 - w for w in is_held])  # whether any is held
        # at rest: held, or with a share of its limit, or all of it, beside others that are held
        at_rest = [
            where_positive(
                1.0 - apply_function("abs", s),
                law[1] + limit * s + r,
                where_positive(
                    any_held * REST_VELOCITY - apply_function("abs", v) * p,
                    law[1] + limit * s,
                    0.0,
                ),
            )
            for s, law, limit, r, v, p in zip(
                slip_signs,
                laws,
                limits,
                holding_forces,
                velocities,
                inverse_velocities,
                strict=True,
            )
        ]
        return StickSlipAccelerations(
            a_a,
            at_rest,
            add_vectors(self.friction_force, holding_active_forces),
            _minimum(margins),
        )

    def _recursive_forward_dynamics(self, tau: Sequence[Scalar], friction: bool) -> Vector:
        """The same without M_A."""
        forces = list(self.passive_and_friction_forces(friction))
        for joint, force in zip(self.loops.active_joints, tau, strict=True):
            forces[joint] = forces[joint] + force
        projected_joints = {
            i
            for cluster, by_forces in self.formula_structure.recursion_plan
            if by_forces
            for i in cluster.joints
        }
        reference_accelerations = [
            0.0 if i in projected_joints else x for i, x in enumerate(self.drift)
        ]
        recursion = RecursionInput(
            self.posture,
            self.loops,
            self._tree_velocities,
            reference_accelerations,
            self._body_inertias,
            self.body_wrenches(reference_accelerations),
            self.rotors,
            forces,
        )
        rates = joint_accelerations(recursion, self.formula_structure.recursion_plan)
        return [rates[joint] for joint in self.loops.active_joints]

    def regressor(self, a_a: Sequence[Scalar]) -> list[Vector]:
        """Y_A (n, 10 nb + nr), inertial parameters in Pinocchio's joint frames, then rotors'."""
        velocity, acceleration = (
            self._carrier_velocities.velocities,
            self._carrier_velocities.bias_accelerations,
        )
        out: list[Vector] = [[] for _ in range(self._mobility)]
        for i in sorted(set(range(1, self._body_count)) - self.posture.geometry.massless_bodies):
            turn = self.posture.geometry.body_rotations[i]
            axes = matmul(self.posture.rotation[i], turn.T.tolist())  # columns: joint's axes
            local = list(zip(*axes, strict=True))  # rows: trunk to joint
            origin = self.posture.origin[i]
            v, w = velocity[i]
            a, e = acceleration[i]
            for k in range(self._mobility + 1):
                factor: Scalar = a_a[k] if k < self._mobility else 1.0
                a = add_vectors(a, scale_vector(factor, self._body_jacobians[i][k][0]))
                e = add_vectors(e, scale_vector(factor, self._body_jacobians[i][k][1]))
            at = add_vectors(a, cross(e, origin), cross(w, add_vectors(v, cross(w, origin))))
            w, e, at = matvec(local, w), matvec(local, e), matvec(local, at)
            for k in range(self._mobility):
                linear, angular = self._body_jacobians[i][k]
                u = matvec(local, add_vectors(linear, cross(angular, origin)))
                out[k] += _body_regressor_row(u, matvec(local, angular), w, e, at)
        for i, row in sorted(self.gamma.items()):
            if self.rotors[i] != 0.0:
                rate = dot(row, a_a) + self.drift[i]
                for k in range(self._mobility):
                    out[k].append(row[k] * rate)
        return out


def _flatten_by_row(columns: Iterable[Vector]) -> Vector:
    """The entries of a matrix (3, n), row by row."""
    return [entry for row in zip(*columns, strict=True) for entry in row]


def _minimum(values: Sequence[Scalar]) -> Scalar:
    """The least, 1 of none."""
    out: Scalar = 1.0
    for value in values:
        out = minimum(out, value)
    return out


def _supporting_bodies(parents: Sequence[int], body: int) -> set[int]:
    """The joints that carry a body."""
    found = set()
    while body:
        found.add(body)
        body = parents[body]
    return found


def _body_regressor_row(u: Vector, r: Vector, w: Vector, e: Vector, a: Vector) -> Vector:
    """Ten entries u . f + r . t per unit of each inertial parameter, all in the body's frame."""
    # mass times COM: f = e x c + w x (w x c), t = c x a
    first = add_vectors(cross(u, e), cross(w, cross(w, u)), cross(a, r))
    # inertia: t = I e + w x (I w), so r . t = r . I e + (r x w) . I w
    s = cross(r, w)

    def entry(j: int, k: int) -> Scalar:
        if j == k:
            return r[j] * e[j] + s[j] * w[j]
        return r[j] * e[k] + r[k] * e[j] + s[j] * w[k] + s[k] * w[j]

    pairs = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
    return [dot(u, a), *first, *(entry(j, k) for j, k in pairs)]
