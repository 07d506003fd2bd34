"""What ends a load or a force: drives, tipping lines, and pins."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.dynamics.statics import StaticQuantities, StaticsEvaluator
from crane.dynamics.tipping_stability import TippingStability, has_supports
from crane.machine import Machine
from crane.motion.workspaces.workspace_section import up_direction
from crane.ratings.conic_limits import largest_feasible_magnitude
from crane.ratings.drive_force_limits import DriveForceLimits
from crane.ratings.pin_forces import PinForces
from crane.ratings.rating_rules import Rule
from crane.ratings.unit_actions import UnitAction

TIPPING, PIN_FORCE = "tips", "pin force"


class LimitingFactor(NamedTuple):
    """What may end a load.

    Attributes:
        element: Joint or loop, or tipping line "A to B".
        reason: Such as "working pressure", "tips" or "pin force".
        rated_share: Of the load at its end that counts.
    """

    element: str
    reason: str
    rated_share: float

    def __str__(self) -> str:
        """In words."""
        return (
            f"{self.reason} over {self.element}"
            if self.reason == TIPPING
            else f"{self.element}: {self.reason}"
        )


class LimitBound(NamedTuple):
    """One end of what a cause lets: a + b m + |c + d m| <= 0.

    Attributes:
        factor_index: Its index.
        drive: Whose force it is, None for a line or a pin.
        tipping_line: About which, None for a drive or a pin.
        sign: 1 of the most that a drive pushes, -1 of the most that it pulls, and of lines.
        pin_index: Its index among those with a limit, None for a drive or a line.
    """

    factor_index: int
    drive: DriveForceLimits | None
    tipping_line: "TippingLine | None"
    sign: float
    pin_index: int | None = None


class LoadLimits:
    """The load or force at a frame that a machine holds, cause by cause, at rest.

    With x its magnitude and e what acts on the frame per magnitude (gravity g of a load in kg, a
    unit vector of a force in N), drives have to hold it and the machine's weight, tipping lines
    have to keep their moment,

        least <= tau(x) <= most,   tau(x) = -(ds/dq)^T g - x (dp/dq)^T e - gamma^T f,
        w . [(s - M p_1) x -g + x (p - p_1) x -e] >= 0,

    with the first moment s and the mass M of the machine, the frame's place p, and w the direction
    of a line through p_1, as in `TippingStability`. On a slope g leans by its angle to any side:
    what is least over all sides is a cone in x, see `crane.ratings.conic_limits`. So is a pin's
    limit,

        |R_0 + x R_1| <= R_max,

    with its force R_0 without load and what a load adds per kg; of loads on level ground alone.

    Args:
        statics: The machine and the frame.
        drive_limits: Of its drives.
        rule: What share counts.
        action: What acts on the frame.
        ground_slope: Of the ground [rad].
        with_weight: Whether the machine has its weight; without, nothing tips.

    Attributes:
        factors: The causes.
        bounds: Their ends.

    Raises:
        InputError: Pins have limits and the ground leans, or statics does not determine their
            forces.
    """

    def __init__(
        self,
        statics: StaticsEvaluator,
        drive_limits: Iterable[DriveForceLimits],
        rule: Rule,
        action: UnitAction,
        ground_slope: float = 0.0,
        with_weight: bool = True,
    ):
        machine = self.machine = statics.machine
        self.action, self._up_direction = action, up_direction(machine)
        weight = with_weight * float(np.linalg.norm(machine.model.gravity.linear))
        self._slope_tangent = np.tan(ground_slope)
        self._vertical_gravity, self._lateral_gravity = (
            weight * np.cos(ground_slope),
            weight * np.sin(ground_slope),
        )
        drives, line_list = list(drive_limits), list(tipping_lines(machine)) if with_weight else []
        pin_capacities = machine.pin_capacities if action.is_weight else {}
        if pin_capacities and ground_slope:
            raise InputError(
                f"pins of '{machine.name}' are rated on level ground, and this leans by "
                f"{np.rad2deg(ground_slope):.3g} degrees: rate without slope, or leave 'pins' out"
            )
        self._pin_forces = (
            PinForces(machine, statics.frame, pin_capacities) if pin_capacities else None
        )
        self._pin_capacities = list(pin_capacities.values())
        self.factors = tuple(
            [LimitingFactor(x.joint, x.limit_kind, rule.hydraulic) for x in drives]
            + [LimitingFactor(x.name, TIPPING, rule.tipping) for x in line_list]
            + [LimitingFactor(name, PIN_FORCE, rule.structural) for name in pin_capacities]
        )
        self.bounds = [
            LimitBound(k, drive, None, sign)
            for k, drive in enumerate(drives)
            for sign in (1.0, -1.0)
        ]
        self.bounds += [
            LimitBound(k, None, x, -1.0) for k, x in enumerate(line_list, start=len(drives))
        ]
        pin_offset = len(drives) + len(line_list)
        self.bounds += [
            LimitBound(pin_offset + k, None, None, 1.0, k) for k in range(len(pin_capacities))
        ]
        self.rated_shares = np.array([cause.rated_share for cause in self.factors])

    def max_magnitudes(
        self, statics: StaticQuantities, angles: Array | None = None, q: Array | None = None
    ) -> Array:
        """The magnitude (N, K) [kg], [N] of each cause, times its share; infinite without end.

        Args:
            statics: The machine at rest.
            angles: (N,) by which it is slewed from home; 0 if not given.
            q: (N, nq) its postures, which pins need.
        """
        pin_forces = self.pin_loads(statics, angles, q)
        out = np.full((len(statics.total_mass), len(self.factors)), np.inf)
        unit = self.action.unit_vectors(
            statics, np.zeros(len(statics.total_mass)) if angles is None else angles
        )
        for bound in self.bounds:
            magnitude = self.bound_magnitude(
                bound, self.bound_coefficients(bound, statics, unit, pin_forces)
            )
            out[:, bound.factor_index] = np.minimum(out[:, bound.factor_index], magnitude)
        return np.asarray(out * self.rated_shares)

    def pin_loads(
        self, statics: StaticQuantities, angles: Array | None = None, q: Array | None = None
    ) -> tuple[Array, Array] | None:
        """Forces (N, p, 3) of pins with limits, without load and per kg; None without limits."""
        if self._pin_forces is None:
            return None
        assert q is not None
        angles = np.zeros(len(q)) if angles is None else angles
        return self._pin_forces.load_forces(q, self.action.unit_vectors(statics, angles))

    def bound_magnitude(self, bound: LimitBound, coefficients: tuple[Array, ...]) -> Array:
        """The magnitude (N,) at which a bound of these terms ends."""
        a, b, c, d = coefficients
        is_cone = self._lateral_gravity or bound.pin_index is not None
        return (
            largest_feasible_magnitude(a, b, c, d) if is_cone else largest_feasible_magnitude(a, b)
        )

    def bound_coefficients(
        self,
        bound: LimitBound,
        statics: StaticQuantities,
        unit: Array,
        pin_forces: tuple[Array, Array] | None = None,
    ) -> tuple[Array, ...]:
        """What a bound's a, b (N,), c and d (N, 3) are: a + b x + |c + d x| <= 0.

        Args:
            bound: One of `bounds`.
            statics: The machine at rest.
            unit: (N, 3) of what acts, see `UnitAction`.
            pin_forces: See `pin_loads`.
        """
        if bound.pin_index is not None:
            assert pin_forces is not None
            zeros = np.zeros(len(statics.total_mass))
            return (
                zeros - self._pin_capacities[bound.pin_index],
                zeros,
                *(x[:, bound.pin_index] for x in pin_forces),
            )
        weight_lever, action_lever, constant_part = self._lever_arms(bound, statics, 1.0)
        return self._sum_coefficients(bound, weight_lever, constant_part, [(action_lever, unit)])

    def coefficient_derivatives(
        self,
        bound: LimitBound,
        statics: StaticQuantities,
        derivatives: StaticQuantities,
        angles: Array | None = None,
    ) -> tuple[Array, ...]:
        """Derivatives of `bound_coefficients`, pins left out, by one parameter."""
        angles = np.zeros(len(statics.total_mass)) if angles is None else angles
        unit, unit_derivatives = (
            self.action.unit_vectors(statics, angles),
            self.action.unit_derivatives(statics, derivatives, angles),
        )
        weight_lever, action_lever, constant_part = self._lever_arms(bound, derivatives, 0.0)
        pairs = [
            (action_lever, unit),
            (self._lever_arms(bound, statics, 1.0)[1], unit_derivatives),
        ]
        return self._sum_coefficients(bound, weight_lever, constant_part, pairs)

    def _sum_coefficients(
        self,
        bound: LimitBound,
        weight_lever: Array,
        constant_part: Array,
        pairs: list[tuple[Array, Array]],
    ) -> tuple[Array, ...]:
        """With pairs of levers and units whose products are summed."""
        vertical_levers = weight_lever @ self._up_direction
        a, c = (
            self._vertical_gravity * vertical_levers,
            self._lateral_gravity * (weight_lever - vertical_levers[:, None] * self._up_direction),
        )
        b, d = np.zeros(len(vertical_levers)), np.zeros_like(c)
        for action_lever, unit in pairs:
            if self.action.is_weight:  # of a load, which leans with the ground
                downward_parts = -(unit @ self._up_direction) / np.hypot(1.0, self._slope_tangent)
                vertical_levers = action_lever @ self._up_direction
                b = b + downward_parts * vertical_levers
                d = d + self._slope_tangent * downward_parts[:, None] * (
                    action_lever - vertical_levers[:, None] * self._up_direction
                )
            else:
                b = b - (action_lever * unit).sum(axis=1)
        return bound.sign * (a + constant_part), bound.sign * b, c, d

    def _lever_arms(
        self, bound: LimitBound, statics: StaticQuantities, constant_factor: float
    ) -> tuple[Array, Array, Array]:
        """Of the weight (N, 3), of what acts (N, 3), and the rest (N,).

        Linear in `statics` but for what stands still, which is left out of derivatives.
        """
        if bound.drive is not None:
            i = bound.drive.active_index
            constant_part = -statics.passive_forces[:, i]
            constant_part = constant_part - constant_factor * (
                bound.drive.max_force if bound.sign > 0 else bound.drive.min_force
            )
            return statics.moment_jacobian[:, :, i], statics.tip_jacobian[:, :, i], constant_part
        assert bound.tipping_line is not None
        line_point, direction = bound.tipping_line.point, bound.tipping_line.direction
        weight_lever = np.cross(
            direction, statics.first_moment - statics.total_mass[:, None] * line_point
        )
        return (
            weight_lever,
            np.cross(direction, statics.tip_positions - constant_factor * line_point),
            np.zeros(len(statics.total_mass)),
        )


class TippingLine(NamedTuple):
    """A tipping line: its name, a point on it, and its direction."""

    name: str
    point: Array
    direction: Array


def tipping_lines(machine: Machine) -> Iterable[TippingLine]:
    """The tipping lines of a machine whose supports stand still; none of others."""
    if not has_supports(machine):
        return
    stability = TippingStability(machine)
    if not stability.is_stationary:
        return
    (points,) = stability.support_positions(machine.home[None])
    for (first_point, second_point), names in zip(
        stability.line_indices, stability.line_names, strict=True
    ):
        direction = points[second_point] - points[first_point]
        yield TippingLine(
            " to ".join(names), points[first_point], direction / np.linalg.norm(direction)
        )
