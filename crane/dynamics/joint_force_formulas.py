"""Forces along joints and distances as symbolic formulas: friction, spring, gas, end stop."""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

from crane.closure.kinematics_formulas import (
    FormulaConstants,
    PositionKinematics,
    Vector,
)
from crane.closure.loop_formulas import LoopFormulas, VelocityKinematics
from crane.codegen.symbolic import (
    Scalar,
    add_vectors,
    apply_function,
    cross,
    dot,
    matvec,
    maximum,
    scale_vector,
    subtract_vectors,
    sum_scalars,
    where_positive,
)  # fmt: skip
from crane.dynamics.formula_structure import BODY_SIZE, DISTANCE_SIZE, FormulaStructure
from crane.dynamics.frame_jacobians import MIN_LENGTH
from crane.dynamics.joint_forces import (
    BREAKAWAY_INDICES,
    END_STOP_INDEX,
    PARAMETER_COUNT,
    ROOT_VELOCITY,
    SHARPNESS_INDEX,
    SLIP_INDEX,
)


class ForceLawValues(NamedTuple):
    """Values of a force law at a position and velocity.

    Attributes:
        force: Passive force.
        friction: Friction.
        dissipated_power: Dissipated power.
        stored_energy: Stored energy.
        force_derivative: d force/dq.
    """

    force: Scalar
    friction: Scalar
    dissipated_power: Scalar
    stored_energy: Scalar
    force_derivative: Scalar


NO_FORCE = ForceLawValues(0.0, 0.0, 0.0, 0.0, 0.0)


def friction_sign(law: Vector, velocity: Scalar, has_stick_slip: bool, use_modes: bool) -> Scalar:
    """Sign of a joint's friction: of the slip for stick-slip joints, else smoothed.

    Args:
        law: (27,), see `JointForces.table`.
        velocity: Velocity.
        has_stick_slip: Whether the joint has stick-slip friction.
        use_modes: Whether the stick-slip mode in `law` gives the sign instead of the velocity.
    """
    if has_stick_slip:
        negative_sign = where_positive(-1.0 * velocity, -1.0, 0.0)
        return law[SLIP_INDEX] if use_modes else where_positive(velocity, 1.0, negative_sign)
    return apply_function("tanh", law[SHARPNESS_INDEX] * velocity)


def breakaway_force(law: Vector) -> Scalar:
    """Largest friction at rest relative to its offset, of a law (27,)."""
    return sum_scalars(law[i] for i in BREAKAWAY_INDICES)


def _steady_friction(
    law: Vector, velocity: Scalar, has_stick_slip: bool, use_modes: bool
) -> Scalar:
    """Friction at a steady velocity; arguments as for `evaluate_force_law`."""
    (
        coulomb, coulomb_offset, viscous, viscous_offset, _, stiction, stribeck,
        stiction_2, stribeck_2, memory, memory_speed, root,
    ) = law[:SLIP_INDEX]  # fmt: skip
    friction = viscous * velocity + coulomb_offset
    if root != 0.0:
        speed = maximum(apply_function("abs", velocity), ROOT_VELOCITY)
        friction = friction + root * velocity / apply_function("sqrt", speed)
    if not any(x != 0.0 for x in (coulomb, viscous_offset, stiction, stiction_2, memory)):
        return friction
    for excess, rate in ((stiction, stribeck), (stiction_2, stribeck_2)):
        if excess != 0.0:
            slow = rate * velocity
            coulomb = coulomb + excess * apply_function("exp", -1.0 * (slow * slow))
    if memory != 0.0:
        speed = apply_function("abs", memory_speed * velocity)
        coulomb = coulomb + memory * apply_function("exp", -1.0 * speed)
    sign = friction_sign(law, velocity, has_stick_slip, use_modes)
    return friction + (coulomb + viscous_offset * velocity) * sign


def evaluate_force_law(
    law: Vector, q: Scalar, velocity: Scalar, has_stick_slip: bool, use_modes: bool
) -> ForceLawValues:
    """Evaluate a force law.

    `JointForces` has the same law in numpy, on purpose: each checks the other.

    Args:
        law: (27,), see `JointForces.table`.
        q: Position.
        velocity: Velocity.
        has_stick_slip: See `friction_sign`.
        use_modes: See `friction_sign`.
    """
    (
        stiffness, damping, constant, energy_offset, stop, stop_damping, lower, upper,
        gas, gas_area_per_volume, gas_rest_position, gas_exponent,
    ) = law[SLIP_INDEX + 3 :]  # fmt: skip
    friction = _steady_friction(law, velocity, has_stick_slip, use_modes)
    force = constant - stiffness * q - damping * velocity
    force_derivative = -1.0 * stiffness
    stored_energy = 0.5 * stiffness * q * q - constant * q + energy_offset
    dissipated_power = (friction + damping * velocity) * velocity
    if gas != 0.0:
        volume_ratio = 1.0 + gas_area_per_volume * (q - gas_rest_position)
        if gas_exponent == 1.0:
            gas_force = gas / volume_ratio
            stored_energy = stored_energy - gas / gas_area_per_volume * apply_function(
                "log", volume_ratio
            )
        else:
            less = 1.0 - gas_exponent
            power = apply_function("exp", less * apply_function("log", volume_ratio))
            gas_force = gas * power / volume_ratio
            stored_energy = stored_energy - gas / gas_area_per_volume * ((power - 1.0) / less)
        force = force + gas_force
        force_derivative = (
            force_derivative - gas_exponent * gas_area_per_volume * gas_force / volume_ratio
        )
    if stop != 0.0:
        over, under = maximum(q - upper, 0.0), maximum(lower - q, 0.0)
        harder, softer = (maximum(1.0 + s * stop_damping * velocity, 0.0) for s in (1.0, -1.0))
        push, pull = stop * over * harder, stop * under * softer
        force_derivative = force_derivative - stop * where_positive(
            over, harder, where_positive(under, softer, 0.0)
        )
        force = force + pull - push
        stored_energy = stored_energy + 0.5 * stop * (over * over + under * under)
        dissipated_power = dissipated_power + (push - stop * over - pull + stop * under) * velocity
    return ForceLawValues(force, friction, dissipated_power, stored_energy, force_derivative)


class JointForceFormulas:
    """Symbolic forces along joints and distances; base class of `DynamicsFormulas`."""

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
        self._stick_slip_columns = formula_structure.stick_slip_columns
        self.v_a = list(v_a)
        self.kinematics, self.loops, self.q = kinematics, loops, q
        self._body_count = len(kinematics.geometry.parents)
        self._mobility = len(v_a)
        layout = formula_structure.constants_layout

        def load(part: str) -> Vector:
            return constants.vector(layout.start_index(part), layout.parts[part])

        def load_rows(part: str, size: int) -> list[Vector]:
            values = load(part)
            return [values[i : i + size] for i in range(0, len(values), size)]

        self._inertia_constants = load_rows("inertias", BODY_SIZE)
        self._joint_laws = load_rows("joint_laws", PARAMETER_COUNT)
        self._gravity = matvec(kinematics.rotation[0], load("gravity"))
        self.rotor_inertias: Vector = [0.0, *load("rotor_inertias")]
        self._distance_constants = load_rows("distances", DISTANCE_SIZE)
        (self._moving_factor,) = load("moving_factor")
        self.circuit_friction = load("circuit_friction")
        self._fixed_inertia, self._tip_point = load("fixed_inertia"), load("tip_point")
        self._least_inertias: Vector = [0.0, *load("least_inertias")]
        self.gamma = loops.gamma
        self.joint_velocities: Vector = [
            0.0,
            *(dot(self.gamma[i], v_a) for i in range(1, self._body_count)),
        ]
        # the drift of the loops is that of the whole machine in both formulations
        tree_velocities, carrier_velocities = (
            VelocityKinematics(kinematics, loops, self.joint_velocities, self._gravity, parents)
            for parents in (kinematics.geometry.parents, formula_structure.motion_parents)
        )
        self.drift = tree_velocities.drift if drift is None else drift
        self._tree_velocities, self._carrier_velocities = tree_velocities, carrier_velocities

    @cached_property
    def _joint_law_values(self) -> list[ForceLawValues]:
        """Values of the force laws of all joints (nb + 1,)."""
        every = zip(self._joint_laws, self.q, self.joint_velocities[1:], strict=True)
        return [
            NO_FORCE,
            *(
                evaluate_force_law(*x, i in self._stick_slip_columns, self._use_modes)
                for i, x in enumerate(every)
            ),
        ]

    @cached_property
    def _distance_law_values(self) -> list[tuple[dict[int, Scalar], ForceLawValues, Scalar]]:
        """For every distance dl/dv by joint, the values of its force law, and its length.

        See `crane.dynamics.frame_jacobians`. A force along the distance is a wrench [u; p_2 x u]
        on the second body and its reaction on the first, so that joints that carry both are not
        affected.
        """
        kinematics, out = self.kinematics, []
        for bodies, numbers in zip(
            self.formula_structure.distance_bodies, self._distance_constants, strict=True
        ):
            law, places = numbers[:PARAMETER_COUNT], (numbers[PARAMETER_COUNT:-3], numbers[-3:])
            one, two = (
                add_vectors(kinematics.origin[body], matvec(kinematics.rotation[body], place))
                for body, place in zip(bodies, places, strict=True)
            )
            vector = subtract_vectors(two, one)
            length = apply_function("sqrt", dot(vector, vector))
            direction = scale_vector(1.0 / maximum(length, MIN_LENGTH), vector)
            moment = cross(two, direction)
            first_supports, second_supports = (
                set(kinematics.geometry.supporting_bodies(body)) for body in bodies
            )
            distance_jacobian: dict[int, Scalar] = {}
            for i in sorted(first_supports ^ second_supports):
                linear, angular = kinematics.joint_axes[i]
                derivative = dot(direction, linear) + dot(moment, angular)
                distance_jacobian[i] = derivative if i in second_supports else -derivative
            rate = dot(
                list(distance_jacobian.values()),
                [self.joint_velocities[i] for i in distance_jacobian],
            )
            out.append(
                (distance_jacobian, evaluate_force_law(law, length, rate, False, False), length)
            )
        return out

    @cached_property
    def _passive_joint_forces(self) -> Vector:
        """f, passive forces along the joints (nb + 1,)."""
        out = [found.force for found in self._joint_law_values]
        for derivatives, found, _ in self._distance_law_values:
            for i, derivative in derivatives.items():
                out[i] = out[i] + found.force * derivative
        return out

    @property
    def _joint_friction(self) -> Vector:
        """tau_F, friction along the joints (nb + 1,)."""
        return [found.friction for found in self._joint_law_values]

    @property
    def _law_values(self) -> list[ForceLawValues]:
        """Values of the force laws of all joints and distances."""
        return [*self._joint_law_values, *(found for _, found, _ in self._distance_law_values)]

    @property
    def stiffness(self) -> list[Vector]:
        """d(gamma^T f)/dq_A of springs, gas, end stops and ropes at constant gamma (n, n)."""
        along = [
            (self.gamma[i], self._joint_law_values[i].force_derivative)
            for i in range(1, self._body_count)
        ]
        for derivatives, found, _ in self._distance_law_values:
            row: Vector = [0.0] * self._mobility
            for i, derivative in derivatives.items():
                row = add_vectors(row, scale_vector(derivative, self.gamma[i]))
            along.append((row, found.force_derivative))
        out: list[Vector] = [[0.0] * self._mobility for _ in range(self._mobility)]
        for row, stiffness in along:
            for k, entry in enumerate(row):
                out[k] = add_vectors(out[k], scale_vector(entry * stiffness, row))
        return out

    def end_stop_distances(
        self, coordinate_units: Sequence[float], characteristic_length: float
    ) -> Vector:
        """Distances beyond the engagement points of end stops and ropes, each divided by its unit.

        Args:
            coordinate_units: (nb,) of the joints.
            characteristic_length: Unit of rope lengths [m].
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

    def passive_and_friction_forces(self, friction: bool) -> Vector:
        """Passive forces minus friction (optional) along the joints (nb + 1,)."""
        return (
            subtract_vectors(self._passive_joint_forces, self._joint_friction)
            if friction
            else self._passive_joint_forces
        )

    @property
    def dissipated_power(self) -> Scalar:
        """Power dissipated by friction, dampers, end stops and ropes [W]."""
        return sum_scalars(found.dissipated_power for found in self._law_values)

    def project(self, joint_forces: Sequence[Scalar]) -> Vector:
        """gamma^T of forces along the joints (nb + 1,)."""
        out: Vector = [0.0] * self._mobility
        for i, row in self.gamma.items():
            out = add_vectors(out, scale_vector(joint_forces[i], row))
        return out
