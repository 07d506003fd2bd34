"""Limits of a load or force at a frame: drives, tipping lines and pins."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import InputError
from crane.common.result import Result
from crane.common.samples import Array
from crane.dynamics.statics import StaticQuantities, StaticsEvaluator
from crane.dynamics.tipping_stability import TippingStability, has_supports
from crane.machine.machine import Machine
from crane.motion.workspaces.workspace_section import WorkspaceSection, find_slewing_joint
from crane.ratings.drive_force_limits import DriveForceLimits, PinForces, drive_force_limits
from crane.ratings.rating_rules import Rule, UnitAction, rotate_about_axis
from crane.ratings.strokes import Strokes, frame_rates

TIPPING, PIN_FORCE = "tips", "pin force"


class LimitingFactor(NamedTuple):
    """One limit of a load.

    Attributes:
        element: Name of a joint or loop, or of a tipping line, "A to B".
        reason: Such as "working pressure", "tips" or "pin force".
        rated_share: Share of the limit that counts as rated load.
    """

    element: str
    reason: str
    rated_share: float

    def __str__(self) -> str:
        """Description for reports."""
        if self.reason == TIPPING:
            return f"{self.reason} over {self.element}"
        return f"{self.element}: {self.reason}"


class LimitBound(NamedTuple):
    """One bound of a limiting factor: a + b x + |c + d x| <= 0 with the load or force x.

    Attributes:
        factor_index: Index of the limiting factor.
        drive: Drive whose force is bounded; None for a tipping line or a pin.
        tipping_line: Tipping line; None for a drive or a pin.
        sign: 1 for the pushing force of a drive, -1 for its pulling force and for tipping lines.
        pin_index: Index among the pins with a limit; None for a drive or a tipping line.
    """

    factor_index: int
    drive: DriveForceLimits | None
    tipping_line: "TippingLine | None"
    sign: float
    pin_index: int | None = None


class LoadLimits:
    """Largest load or force at a frame of a machine at rest, by limiting factor.

    With the load or force x and its unit action e (gravity g for a load in kg, a unit vector for
    a force in N), the drives have to hold the load and the weight of the machine, and the moment
    about each tipping line has to keep its sign,

        tau_min <= tau(x) <= tau_max,   tau(x) = -(ds/dq)^T g - x (dp/dq)^T e - gamma^T f,
        w . [(s - M p_1) x -g + x (p - p_1) x -e] >= 0,

    with the first moment s and the mass M of the machine, the position p of the frame, and the
    direction w of a tipping line through p_1, as in `TippingStability`. On sloping ground g leans
    by the slope to any side; the smallest value over all sides is a cone in x, see
    `largest_feasible_magnitude`. The limit of a pin is a cone, too,

        |R_0 + x R_1| <= R_max,

    with its force R_0 without load and the increase R_1 per kg; for loads on level ground only.

    Args:
        statics: Evaluates the machine and the frame.
        drive_limits: Force limits of the drives.
        rule: Rule of the shares that count.
        action: Unit action at the frame.
        ground_slope: Slope of the ground [rad].
        with_weight: Whether the machine has weight; without weight it does not tip.

    Attributes:
        factors: Limiting factors.
        bounds: Bounds of the limiting factors.

    Raises:
        InputError: Pins have limits and the ground slopes, or statics does not determine the
            force of a pin that has a limit.
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
        self.action, self._up_direction = action, machine.up_direction
        weight = with_weight * float(np.linalg.norm(machine.model.gravity.linear))
        self._slope_tangent = np.tan(ground_slope)
        self._vertical_gravity = weight * np.cos(ground_slope)
        self._lateral_gravity = weight * np.sin(ground_slope)
        drives = list(drive_limits)
        lines = tipping_lines(machine, statics.frame) if with_weight else []
        capacities = machine.pin_capacities if action.is_weight else {}
        if capacities and ground_slope:
            raise InputError(
                f"pins of '{machine.name}' are rated on level ground, but the ground slopes by "
                f"{np.rad2deg(ground_slope):.3g} degrees: rate without slope, or leave 'pins' out"
            )
        self._pin_forces = PinForces(machine, statics.frame, capacities) if capacities else None
        self._pin_capacities = list(capacities.values())
        self.factors = tuple(
            [LimitingFactor(x.joint, x.limit_kind, rule.hydraulic) for x in drives]
            + [LimitingFactor(x.name, TIPPING, rule.tipping) for x in lines]
            + [LimitingFactor(name, PIN_FORCE, rule.structural) for name in capacities]
        )
        pin_offset = len(drives) + len(lines)
        self.bounds = [
            *(LimitBound(k, x, None, sign) for k, x in enumerate(drives) for sign in (1.0, -1.0)),
            *(LimitBound(k, None, x, -1.0) for k, x in enumerate(lines, start=len(drives))),
            *(LimitBound(pin_offset + k, None, None, 1.0, k) for k in range(len(capacities))),
        ]
        self.rated_shares = np.array([factor.rated_share for factor in self.factors])

    def rated_values(
        self, statics: StaticQuantities, angles: Array | None = None, q: Array | None = None
    ) -> Array:
        """Return the rated load or force (N, K) by limiting factor [kg], [N].

        Args:
            statics: The machine at rest.
            angles: (N,) slew angles from home [rad]; 0 by default.
            q: (N, nq) configurations; required if pins have limits.

        Returns:
            Largest load or force times the rated share; infinite where it has no limit.
        """
        pin_forces = self.pin_loads(statics, angles, q)
        out = np.full((len(statics.total_mass), len(self.factors)), np.inf)
        angles = np.zeros(len(statics.total_mass)) if angles is None else angles
        for bound in self.bounds:
            magnitude = self.bound_magnitude(
                bound, self.bound_coefficients(bound, statics, angles, pin_forces)
            )
            out[:, bound.factor_index] = np.minimum(out[:, bound.factor_index], magnitude)
        return np.asarray(out * self.rated_shares)

    def pin_loads(
        self, statics: StaticQuantities, angles: Array | None = None, q: Array | None = None
    ) -> tuple[Array, Array] | None:
        """Return forces (N, p, 3) of pins with limits, without load and per kg; None if none."""
        if self._pin_forces is None:
            return None
        assert q is not None
        angles = np.zeros(len(q)) if angles is None else angles
        return self._pin_forces.load_forces(q, self.action.unit_vectors(statics, angles))

    def bound_magnitude(self, bound: LimitBound, coefficients: tuple[Array, ...]) -> Array:
        """Return the load or force (N,) at which a bound with these coefficients is reached."""
        is_cone = self._lateral_gravity or bound.pin_index is not None
        return largest_feasible_magnitude(*(coefficients if is_cone else coefficients[:2]))

    def bound_coefficients(
        self,
        bound: LimitBound,
        statics: StaticQuantities,
        angles: Array,
        pin_forces: tuple[Array, Array] | None = None,
    ) -> tuple[Array, ...]:
        """Return a, b (N,), c and d (N, 3) of a bound a + b x + |c + d x| <= 0.

        Args:
            bound: One of `bounds`.
            statics: The machine at rest.
            angles: (N,) slew angles from home [rad].
            pin_forces: Result of `pin_loads`.
        """
        if bound.pin_index is not None:
            assert pin_forces is not None
            zeros = np.zeros(len(statics.total_mass))
            return (
                zeros - self._pin_capacities[bound.pin_index],
                zeros,
                *(x[:, bound.pin_index] for x in pin_forces),
            )
        weight_lever, action_lever, constant_part = self._lever_arms(bound, statics, 1.0, angles)
        unit = self.action.unit_vectors(statics, angles)
        return self._sum_coefficients(bound, weight_lever, constant_part, [(action_lever, unit)])

    def coefficient_derivatives(
        self,
        bound: LimitBound,
        statics: StaticQuantities,
        derivatives: StaticQuantities,
        angles: Array | None = None,
    ) -> tuple[Array, ...]:
        """Return the derivatives of `bound_coefficients` by one parameter; not for pins."""
        angles = np.zeros(len(statics.total_mass)) if angles is None else angles
        unit = self.action.unit_vectors(statics, angles)
        unit_derivatives = self.action.unit_derivatives(statics, derivatives, angles)
        weight_lever, action_lever, constant_part = self._lever_arms(
            bound, derivatives, 0.0, angles
        )
        return self._sum_coefficients(
            bound,
            weight_lever,
            constant_part,
            [
                (action_lever, unit),
                (self._lever_arms(bound, statics, 1.0, angles)[1], unit_derivatives),
            ],
        )

    def _sum_coefficients(
        self,
        bound: LimitBound,
        weight_lever: Array,
        constant_part: Array,
        pairs: list[tuple[Array, Array]],
    ) -> tuple[Array, ...]:
        """Return a, b, c, d with the products of pairs (lever, unit action) summed."""
        vertical_levers = weight_lever @ self._up_direction
        a = self._vertical_gravity * vertical_levers
        c = self._lateral_gravity * (weight_lever - vertical_levers[:, None] * self._up_direction)
        b, d = np.zeros(len(vertical_levers)), np.zeros_like(c)
        for action_lever, unit in pairs:
            if not self.action.is_weight:
                b = b - (action_lever * unit).sum(axis=1)
                continue
            # the weight of a load leans with the ground
            downward_parts = -(unit @ self._up_direction) / np.hypot(1.0, self._slope_tangent)
            vertical_levers = action_lever @ self._up_direction
            b = b + downward_parts * vertical_levers
            d = d + self._slope_tangent * downward_parts[:, None] * (
                action_lever - vertical_levers[:, None] * self._up_direction
            )
        return bound.sign * (a + constant_part), bound.sign * b, c, d

    def _lever_arms(
        self, bound: LimitBound, statics: StaticQuantities, constant_factor: float, angles: Array
    ) -> tuple[Array, Array, Array]:
        """Return the levers of the weight and of the action (N, 3), and the constant part (N,).

        All are linear in `statics` except for constants, which `constant_factor` 0 leaves out of
        derivatives.
        """
        if bound.drive is not None:
            i = bound.drive.active_index
            limit = bound.drive.max_force if bound.sign > 0 else bound.drive.min_force
            constant_part = -statics.passive_forces[:, i] - constant_factor * limit
            return statics.moment_jacobian[:, :, i], statics.tip_jacobian[:, :, i], constant_part
        assert bound.tipping_line is not None
        point, direction = bound.tipping_line.slewed(angles)
        return (
            np.cross(direction, statics.first_moment - statics.total_mass[:, None] * point),
            np.cross(direction, statics.tip_positions - constant_factor * point),
            np.zeros(len(statics.total_mass)),
        )


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class RatingConditions(Result):
    """Conditions of a rating: all that its load limits depend on.

    Attributes:
        machine: The machine.
        places: Strokes of the frame, and for charts over its positions a `ConfigurationSearch`.
        action: Unit action at the frame.
        rule: Rating rule.
        working_joints: Joints whose drives work; all others hold.
        ground_slope: Slope of the ground [rad].
        with_friction: Whether drives that work overcome friction.
        with_weight: Whether the machine has weight.
    """

    machine: Machine
    places: Strokes
    action: UnitAction
    rule: Rule
    working_joints: tuple[str, ...]
    ground_slope: float = 0.0
    with_friction: bool = False
    with_weight: bool = True

    @property
    def frame(self) -> str:
        """Frame at which the load or force acts."""
        return self.places.statics.frame

    @property
    def section(self) -> WorkspaceSection:
        """Section in which the frame moves."""
        return self.places.section

    def drive_limits(self, machine: Machine | None = None) -> list[DriveForceLimits]:
        """Return the force limits of the drives, also for a variant of the machine."""
        machine = self.machine if machine is None else machine
        return drive_force_limits(machine, self.working_joints, self.with_friction)

    def load_limits(self) -> LoadLimits:
        """Return the limits of the load or force."""
        return LoadLimits(
            self.places.statics, self.drive_limits(), self.rule, self.action, self.ground_slope,
            self.with_weight,
        )  # fmt: skip


class TippingLine(NamedTuple):
    """A tipping line between two supports.

    Attributes:
        name: Name, "A to B".
        ends: (2, 3) places of the supports with the slewing joint at home [m].
        turns: Which of the two supports turn with the slewing joint, as the front wheels of a
            machine with an articulated frame do with its steering joint.
        origin: (3,) point on the slewing axis [m].
        axis: (3,) slewing axis, upwards.
    """

    name: str
    ends: Array
    turns: NDArray[np.bool_]
    origin: Array
    axis: Array

    def slewed(self, angles: Array) -> tuple[Array, Array]:
        """Return a point (N, 3) and the direction (N, 3) at slew angles (N,) from home [rad]."""
        first, second = (
            self.origin + rotate_about_axis(
                np.broadcast_to(end - self.origin, (len(angles), 3)), self.axis, turns * angles
            )
            for end, turns in zip(self.ends, self.turns, strict=True)
        )  # fmt: skip
        way = second - first
        return first, way / np.linalg.norm(way, axis=1, keepdims=True)


def tipping_lines(machine: Machine, frame: str) -> list[TippingLine]:
    """Return the tipping lines of a machine on a fixed base; none for others.

    Raises:
        InputError: A joint moves a support and the frame, and it is not the slewing joint.
    """
    if not has_supports(machine) or not (stability := TippingStability(machine)).is_stationary:
        return []
    (points,) = stability.support_positions(machine.home[None])
    moved = np.abs(stability.support_rates()).max(axis=1) > 0.0  # (s, n)
    slew = find_slewing_joint(machine, frame)
    index, origin, _ = (None, np.zeros(3), 1.0) if slew is None else slew
    rates = frame_rates(machine, frame, machine.home)
    for i in np.flatnonzero(moved.any(axis=0) & rates.any(axis=0)).tolist():
        if i != index:
            joint = machine.active[i]
            raise InputError(
                f"'{joint}' moves the supports and '{frame}', but is no upright pin on the base: "
                f"lock it: --lock {joint}=..."
            )
    turns = np.zeros(len(points), dtype=bool) if index is None else moved[:, index]
    return [
        TippingLine(
            " to ".join(names), points[list(pair)], turns[list(pair)], origin, machine.up_direction
        )
        for pair, names in zip(stability.line_indices, stability.line_names, strict=True)
    ]


def largest_feasible_magnitude(
    a: Array, b: Array, c: Array | None = None, d: Array | None = None
) -> Array:
    """Return the largest x >= 0 such that a + b y + |c + d y| <= 0 for all y in [0, x].

    If the inequality holds at 0, x is the smallest positive root of

        (b^2 - |d|^2) x^2 + 2 (a b - c.d) x + a^2 - |c|^2 = 0

    at which a + b x is not positive. The two roots and the discriminant,
    |a d - b c|^2 - |c x d|^2, are computed without cancellation.

    Args:
        a: Any shape; negative where the bound is not reached without load.
        b: The shape of a.
        c: The shape of a with one more axis (3,); 0 by default.
        d: Like c.

    Returns:
        The shape of a; 0 where the inequality fails at x = 0, infinite where x has no limit.
    """
    if c is None or d is None:
        with np.errstate(divide="ignore", invalid="ignore"):
            out = np.where(b > 0, -a / b, np.inf)
        return np.where(a >= 0, 0.0, out)
    quadratic = b * b - (d * d).sum(axis=-1)
    half_linear = a * b - (c * d).sum(axis=-1)
    constant = a * a - (c * c).sum(axis=-1)
    cross_terms = a[..., None] * d - b[..., None] * c  # by Lagrange's identity
    discriminant = (cross_terms * cross_terms).sum(axis=-1) - (np.cross(c, d) ** 2).sum(axis=-1)
    root, is_real = np.sqrt(np.maximum(discriminant, 0.0)), discriminant >= 0
    stable_sum = -(half_linear + np.copysign(root, half_linear))
    with np.errstate(divide="ignore", invalid="ignore"):
        roots = np.stack([constant / stable_sum, stable_sum / quadratic])
        is_valid = is_real & (roots > 0) & np.isfinite(roots)
        is_valid &= a + b * roots <= 1e-9 * np.abs(a)
        smallest = np.where(is_valid, roots, np.inf).min(axis=0)
    return np.asarray(np.where(a + np.sqrt((c * c).sum(axis=-1)) >= 0, 0.0, smallest))
