"""The force law of a joint or of a distance between frames, as formulas."""

from typing import NamedTuple

from crane.closure.screws import Vector
from crane.codegen.scalar import Number, apply, maximum, where_positive

NUMBERS = 22  # of a law, see `JointForces.table`
_SHARPNESS = 4
SLIP = 7  # where the three are that change with the motion: slip, held, pace
STOP = 14  # where those of its stops are: stiffness, damping, lower, upper


class Effects(NamedTuple):
    """What a law does at a position and velocity.

    Attributes:
        force: Passive force.
        friction: Friction.
        lost: Power taken out.
        stored: Energy.
        slope: d force/dq.
    """

    force: Number
    friction: Number
    lost: Number
    stored: Number
    slope: Number


NONE = Effects(0.0, 0.0, 0.0, 0.0, 0.0)


def sign_of(law: Vector, rate: Number, sticks: bool, modes: bool) -> Number:
    """Of a joint's friction: that of the slip where it sticks, else smoothed.

    Args:
        law: (22,), see `JointForces.table`.
        rate: Velocity.
        sticks: Whether friction sticks there.
        modes: Whether the law's numbers say the sign of what sticks, not the velocity.
    """
    if sticks:
        back = where_positive(-1.0 * rate, -1.0, 0.0)
        return law[SLIP] if modes else where_positive(rate, 1.0, back)
    return apply("tanh", law[_SHARPNESS] * rate)


def effects(law: Vector, q: Number, rate: Number, sticks: bool, modes: bool) -> Effects:
    """What the law does.

    Written apart from `JointForces`, which has the same in numpy, so that each checks the other.

    Args:
        law: (22,), see `JointForces.table`.
        q: Position.
        rate: Velocity.
        sticks: See `sign_of`.
        modes: Likewise.
    """
    (
        coulomb, coulomb_offset, viscous, viscous_offset, _, stiction, stribeck,
        _, _, _, stiffness, damping, constant, slack, stop, stop_damping, lower, upper,
        gas, gas_share, gas_rest, gas_exponent,
    ) = law  # fmt: skip
    friction = viscous * rate + coulomb_offset
    if coulomb != 0.0 or viscous_offset != 0.0 or stiction != 0.0:
        sign = sign_of(law, rate, sticks, modes)
        if stiction != 0.0:
            slow = stribeck * rate
            coulomb = coulomb + stiction * apply("exp", -1.0 * (slow * slow))
        friction = friction + (coulomb + viscous_offset * rate) * sign
    force = constant - stiffness * q - damping * rate
    slope = -1.0 * stiffness
    stored = 0.5 * stiffness * q * q - constant * q + slack
    lost = (friction + damping * rate) * rate
    if gas != 0.0:
        swollen = 1.0 + gas_share * (q - gas_rest)
        if gas_exponent == 1.0:
            pressed = gas / swollen
            stored = stored - gas / gas_share * apply("log", swollen)
        else:
            less = 1.0 - gas_exponent
            power = apply("exp", less * apply("log", swollen))
            pressed = gas * power / swollen
            stored = stored - gas / gas_share * ((power - 1.0) / less)
        force = force + pressed
        slope = slope - gas_exponent * gas_share * pressed / swollen
    if stop != 0.0:
        over, under = maximum(q - upper, 0.0), maximum(lower - q, 0.0)
        harder, softer = (maximum(1.0 + s * stop_damping * rate, 0.0) for s in (1.0, -1.0))
        push, pull = stop * over * harder, stop * under * softer
        slope = slope - stop * where_positive(over, harder, where_positive(under, softer, 0.0))
        force = force + pull - push
        stored = stored + 0.5 * stop * (over * over + under * under)
        lost = lost + (push - stop * over - pull + stop * under) * rate
    return Effects(force, friction, lost, stored, slope)
