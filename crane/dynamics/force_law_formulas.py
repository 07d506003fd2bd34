"""The force law of a joint or distance as symbolic formulas: friction, spring, gas, end stop."""

from typing import NamedTuple

from crane.closure.spatial_vectors import Vector
from crane.codegen.symbolic import Scalar, apply_function, maximum, where_positive

LAW_SIZE = 22  # values of a law, see `JointForces.table`
_SHARPNESS_INDEX = 4
SLIP_INDEX = 7  # where the three are that change with the motion: slip, held, pace
END_STOP_INDEX = 14  # where those of its stops are: stiffness, damping, lower, upper


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
        law: (22,), see `JointForces.table`.
        velocity: Velocity.
        has_stick_slip: Whether the joint has stick-slip friction.
        use_modes: Whether the stick-slip mode in `law` gives the sign instead of the velocity.
    """
    if has_stick_slip:
        negative_sign = where_positive(-1.0 * velocity, -1.0, 0.0)
        return law[SLIP_INDEX] if use_modes else where_positive(velocity, 1.0, negative_sign)
    return apply_function("tanh", law[_SHARPNESS_INDEX] * velocity)


def evaluate_force_law(
    law: Vector, q: Scalar, velocity: Scalar, has_stick_slip: bool, use_modes: bool
) -> ForceLawValues:
    """Evaluate a force law.

    `JointForces` has the same law in numpy, on purpose: each checks the other.

    Args:
        law: (22,), see `JointForces.table`.
        q: Position.
        velocity: Velocity.
        has_stick_slip: See `friction_sign`.
        use_modes: See `friction_sign`.
    """
    (
        coulomb, coulomb_offset, viscous, viscous_offset, _, stiction, stribeck,
        _, _, _, stiffness, damping, constant, energy_offset, stop, stop_damping, lower, upper,
        gas, gas_area_per_volume, gas_rest_position, gas_exponent,
    ) = law  # fmt: skip
    friction = viscous * velocity + coulomb_offset
    if coulomb != 0.0 or viscous_offset != 0.0 or stiction != 0.0:
        sign = friction_sign(law, velocity, has_stick_slip, use_modes)
        if stiction != 0.0:
            slow = stribeck * velocity
            coulomb = coulomb + stiction * apply_function("exp", -1.0 * (slow * slow))
        friction = friction + (coulomb + viscous_offset * velocity) * sign
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
