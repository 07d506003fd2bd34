"""Break-out forces of bucket and arm (ISO 6015, SAE J1179)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

from crane.common.errors import InputError
from crane.common.result import Result
from crane.common.samples import Array
from crane.common.units import format_quantity
from crane.dynamics.statics import StaticQuantities
from crane.machine.machine import Machine
from crane.motion.workspaces.workspace_patch import last_closed_configuration
from crane.motion.workspaces.workspace_section import WorkspaceSection
from crane.ratings.drive_force_limits import drive_force_limits
from crane.ratings.limiting_factors import LimitingFactor, LoadLimits
from crane.ratings.posture_search import PostureSearch
from crane.ratings.rating_rules import find_rule
from crane.ratings.strokes import (
    TOGGLE_DISTANCE,
    InstantaneousRotation,
    Strokes,
    bucket_and_arm_strokes,
    find_pivot,
    find_toggle,
    instantaneous_rotation,
)
from crane.ratings.tool_forces import direction_action, direction_text

_DIGGING_STROKE_VALUES = 81  # values of the stroke that digs in the grid of starts
_OTHER_STROKE_VALUES = 9  # values of another stroke in this grid
_START_COUNT = 3  # best configurations of the grid that are improved
_PIVOT_TOLERANCE = 1e-6  # share of the characteristic length
_MIN_RELATIVE_IMPROVEMENT = 1e-9  # of a configuration that is farther from home


class BreakoutForce(NamedTuple):
    """Largest force of one drive along the path of the frame, in the drive's stronger direction.

    Attributes:
        joint: Joint of the drive that works.
        pivot: Joint that the drive turns most, of those that carry the frame.
        turn: Rotation of the frame in the configuration of `force`: about the pivot, or about an
            instantaneous centre elsewhere.
        isolated_force: Force with the best lever if everything else held; infinite at a
            toggle [N].
        stroke: Stroke of the drive at this force [m], [rad].
        lever: (n,) active coordinates at this force.
        home: The same force with the lever of the home configuration [N].
        force: Force with all other parts at their limits; infinite if nothing limits it [N].
        limiting_factor: Limiting factor of `force`; None if nothing limits it.
        forces_by_factor: Force by limiting factor in the configuration of `force` [N].
        q_a: (n,) active coordinates of this configuration.
    """

    joint: str
    pivot: str
    turn: InstantaneousRotation
    isolated_force: float
    stroke: float
    lever: Array
    home: float
    force: float
    limiting_factor: LimitingFactor | None
    forces_by_factor: dict[LimitingFactor, float]
    q_a: Array

    @property
    def radius(self) -> float:
        """Distance from the centre of rotation to the frame [m]."""
        return self.turn.radius


@dataclass(frozen=True, eq=False, repr=False)
class Breakout(Result):
    """Break-out forces.

    Attributes:
        machine: The machine.
        frame: Link that digs.
        section: Section in which it digs.
        with_weight: Whether weight and tipping are included.
        direction: Direction of the force.
        at: Posture of the forces; None for that of the largest ones.
        bucket: Force of the bucket's drive.
        arm: Force of the arm's drive; None if there is no arm.
    """

    machine: Machine
    frame: str
    section: WorkspaceSection
    with_weight: bool
    direction: str
    at: Mapping[str, float] | None
    bucket: BreakoutForce
    arm: BreakoutForce | None

    def _named_forces(self) -> list[tuple[str, BreakoutForce]]:
        return [("bucket", self.bucket), *([] if self.arm is None else [("arm", self.arm)])]

    def _one_line(self) -> str:
        texts = [f"{name} {format_quantity(x.force, 'N', 4)}" for name, x in self._named_forces()]
        return f"Breakout of '{self.machine.name}' at '{self.frame}': {', '.join(texts)}"

    def to_markdown(self) -> str:
        """Return a table of forces, levers, configurations and limiting factors."""
        weight_text = f"weight and tipping {'included' if self.with_weight else 'left out'}"
        path_text = self.direction
        if path_text == "tangent":
            path_text = "along its path when the drive moves alone"
        alone_text = "with the drive's best lever" if self.at is None else "at this posture"
        lines = [
            f"# Break-out forces of {self.machine.name}\n",
            f"At `{self.frame}`, {path_text}, without friction. "
            f"Alone: {alone_text}, if everything else held. At home: with the lever "
            f"at home. Force: {weight_text}, other circuits hold at their relief valves.\n",
            "| | drive | turns about | radius [m] | alone [kN] | at | at home [kN] | force [kN] | "
            "limited by | at |",
            "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
            *(self._row(name, force) for name, force in self._named_forces()),
        ]
        lines += [
            f"\nThe {name} has no largest force alone: it goes through a toggle, where the lip "
            f"stands still while the drive moves, or within {100 * TOGGLE_DISTANCE:g} % of its "
            "stroke of one."
            for name, force in self._named_forces()
            if np.isinf(force.isolated_force)
        ]
        return "\n".join([*lines, ""])

    def _row(self, name: str, force: BreakoutForce) -> str:
        machine = self.machine
        coordinates = ", ".join(
            f"{joint} = {x:.4g} {machine.unit(joint)}"
            for joint, x in zip(machine.active, force.q_a, strict=True)
        )
        cells = (
            name, force.joint, self._centre_text(force), f"{force.radius:.4f}",
            _format_kn(force.isolated_force), f"{force.stroke:.4g} {machine.unit(force.joint)}",
            _format_kn(force.home), _format_kn(force.force), force.limiting_factor or "nothing",
            coordinates,
        )  # fmt: skip
        return f"| {' | '.join(map(str, cells))} |"

    def _centre_text(self, force: BreakoutForce) -> str:
        if np.isinf(force.radius):
            return f"nothing: {force.joint} shifts it"
        if force.turn.offset <= _PIVOT_TOLERANCE * self.machine.closure.characteristic_length:
            return force.pivot
        u, w = self.section.coordinates(force.turn.centre[None])[0]
        first, second = self.section.coordinate_names
        return (
            f"instantaneous centre, {first} {u:.3f}, {second} {w:.3f} m, "
            f"{force.turn.offset:.3f} m off {force.pivot}"
        )


def _format_kn(force: float) -> str:
    return f"{force / 1e3:.2f}" if np.isfinite(force) else "unbounded"


def breakout(
    machine: Machine,
    frame: str | None = None,
    *,
    bucket: str | None = None,
    arm: str | None = None,
    weights: bool = False,
    direction: str | Sequence[float] = "tangent",
    at: Mapping[str, float] | None = None,
) -> Breakout:
    """Compute the largest forces of bucket and arm at the lip, tangent to its path.

    By ISO 6015 and SAE J1179 one drive works at its pump's pressure and pushes with

        F = tau / |dp/dX|

    at the frame position p, with the force tau of the drive and its stroke X. The value for the
    best lever is the force of the drive alone. All other drives hold behind closed valves, at no
    more than the pressure of their relief valves. If one of them yields earlier, the force is the
    largest one at which none yields, over all strokes. Weight and friction are left out. The arm's
    force is computed with the bucket at the stroke of its own best lever. All forces are optima
    within the limits of the strokes. ISO measures at the lip, SAE at the tip of the teeth; choose
    the frame accordingly.

    By ISO 14397-2 and SAE J732 the force of a loader is vertical, 100 mm behind the edge of the
    level bucket on the ground, by either cylinder: direction "up" at a frame there, at the posture
    {"angle": 0.0, "height": 0.0}; with weights also as far as the machine does not tip.

    The path is a circle about the pivot if the stroke turns one pin only. If it turns several, as
    for the boom of a loader whose tilt cylinder stands on the frame, it is a circle about the
    instantaneous centre, see `InstantaneousRotation`.

    At a toggle, dp/dX = 0, statics does not limit the force of the drive alone: it is infinite.
    It is reported as infinite also within 1 % of the stroke from a toggle, where the compliance
    of the oil decides, not the lever of rigid links. The arm's force then has the bucket at home.

    Args:
        machine: A machine with hydraulics, or with `effort` limits in its URDFs.
        frame: The lip; the tip by default.
        bucket: Joint whose drive turns the bucket; by default the one nearest to the lip of three
            that turn it.
        arm: Joint whose drive turns the arm; by default the one before the bucket's.
        weights: Whether the machine has weight, which its drives hold and which keeps it from
            tipping: all limits of the configuration, with the slewing joint at home.
        direction: Direction of the force, see `tool_force`.
        at: Posture of all forces, see `PostureSearch`; by default the best one of each.

    Raises:
        InputError: There is no such posture or direction, no joint moves a bucket, a frame or
            joint is unknown, or nothing limits a force.
    """
    strokes = Strokes(machine, frame)
    bucket_stroke, arm_stroke = bucket_and_arm_strokes(strokes, bucket, arm)
    start, moving = machine.home, strokes.moving
    if at is not None:
        start, moving = PostureSearch(strokes, at).configuration(), []
    held_coordinates = start[machine.closure.active].copy()
    bucket_force, lever = _largest_breakout_force(
        strokes, bucket_stroke, (held_coordinates, start), moving, weights, direction
    )
    arm_force = None
    if arm_stroke is not None:
        if np.isfinite(bucket_force.isolated_force) and moving:
            held_coordinates[bucket_stroke], start = bucket_force.stroke, lever
        arm_force, _ = _largest_breakout_force(
            strokes,
            arm_stroke,
            (held_coordinates, start),
            [i for i in moving if i != bucket_stroke],
            weights,
            direction,
        )
    return Breakout(
        machine, strokes.statics.frame, strokes.section, weights, direction_text(direction), at,
        bucket_force, arm_force,
    )  # fmt: skip


def _largest_breakout_force(
    strokes: Strokes,
    stroke_index: int,
    held: tuple[Array, Array],
    moved: list[int],
    with_weight: bool,
    direction: str | Sequence[float],
) -> tuple[BreakoutForce, Array]:
    """Return the force of the drive of one stroke, and the configuration (nq,) of its best lever.

    Args:
        strokes: Strokes of the frame.
        stroke_index: Index of the stroke among the active joints.
        held: Active coordinates (n,) of the strokes that are held, and a closed configuration
            (nq,) to start from.
        moved: Indices of the strokes that move; none for the posture to start from.
        with_weight: Whether weight is included.
        direction: Direction of the force, see `tool_force`.
    """
    machine, frame, active = strokes.machine, strokes.statics.frame, strokes.machine.closure.active
    joint = machine.active[stroke_index]
    is_path = isinstance(direction, str) and direction.endswith(("tangent", "normal"))
    action = direction_action(strokes, direction, joint if is_path else None)[0]
    rule, drives = find_rule("none"), drive_force_limits(machine, [joint])
    own_limits = LoadLimits(
        strokes.statics, [x for x in drives if x.joint == joint], rule, action, with_weight=False
    )
    grid = _start_configurations(strokes, stroke_index, held, moved)
    isolated_force, lever, tried = _maximize_over_starts(strokes, own_limits, grid, moved)
    for q in tried:
        if (toggle := find_toggle(strokes, stroke_index, q)) is not None:
            isolated_force, lever = np.inf, toggle
            break
    limits = LoadLimits(strokes.statics, drives, rule, action, with_weight=with_weight)
    force, best, _ = _maximize_over_starts(strokes, limits, grid, moved)
    if not (force > 0 and isolated_force > 0):
        raise InputError(f"'{joint}' exerts no force at '{frame}'")
    forces = limits.rated_values(strokes.statics.evaluate(best[None]))[0]
    smallest = int(np.nan_to_num(forces, nan=np.inf).argmin())
    home = own_limits.rated_values(strokes.statics.evaluate(machine.home[None]))[0].min()
    return BreakoutForce(
        joint=joint,
        pivot=find_pivot(machine, frame, stroke_index),
        turn=instantaneous_rotation(machine, frame, stroke_index, best),
        isolated_force=isolated_force,
        stroke=float(lever[active][stroke_index]),
        lever=lever[active].copy(),
        home=float(np.nan_to_num(home, nan=np.inf)),
        force=force,
        limiting_factor=limits.factors[smallest] if np.isfinite(force) else None,
        forces_by_factor=dict(zip(limits.factors, forces.tolist(), strict=True)),
        q_a=best[active].copy(),
    ), lever


def _maximize_over_starts(
    strokes: Strokes, limits: LoadLimits, grids: tuple[Array, Array], moved: list[int]
) -> tuple[float, Array, list[Array]]:
    """Maximize the force from the best start of the first grid, then from those of the second.

    Returns:
        The largest force, its configuration (nq,), and all configurations that were tried.
    """

    def largest_forces(q: Array) -> Array:
        forces = limits.rated_values(strokes.statics.evaluate(q))
        return np.where(np.isnan(forces), np.inf, forces).min(axis=1)

    value, best = -np.inf, strokes.machine.home
    tried: list[Array] = []
    for grid, count in zip(grids, (1, _START_COUNT), strict=True):
        for q in grid[np.argsort(-largest_forces(grid), kind="stable")[:count]]:
            configuration = maximize_force(strokes, limits, q, moved)
            force = float(largest_forces(configuration[None])[0])
            tried += [q, configuration]
            if force > value * (1 + _MIN_RELATIVE_IMPROVEMENT) or value == -np.inf:
                value, best = force, configuration
    return value, best, tried


def _start_configurations(
    strokes: Strokes, i: int, held: tuple[Array, Array], moved: list[int]
) -> tuple[Array, Array]:
    """Return closed configurations (N, nq) over stroke i alone, and over it and each other one."""
    machine, (base, start) = strokes.machine, held
    if not moved:
        return start[None], start[None]
    counts = {k: _OTHER_STROKE_VALUES for k in moved} | {i: _DIGGING_STROKE_VALUES}

    def grid(*swept: int) -> Array:
        names = [machine.active[k] for k in swept]
        at = {x: base[k] for k, x in enumerate(machine.active) if x not in names}
        axes = [np.linspace(strokes.low[k], strokes.high[k], counts[k]) for k in swept]
        values = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, len(swept))
        q, is_found = PostureSearch(strokes, at, names).configurations(values, start)
        return q[is_found]

    own = grid(i)
    pairs = np.concatenate([own, *(grid(i, k) for k in moved if k != i)])
    if not len(pairs):
        raise InputError(f"no configuration of '{machine.name}' closes on the way from home")
    return own, pairs


def maximize_force(strokes: Strokes, limits: LoadLimits, q: Array, moved: list[int]) -> Array:
    """Find the configuration of the largest force near a configuration.

    The smallest force over all limiting factors is largest at the solution of

        max x   with   a_k(q_A) + b_k(q_A) x <= 0,   lower <= q_A <= upper,

    over the bounds k of `LoadLimits`. This problem is smooth, although the smallest force is not.
    It is solved by sequential quadratic programming (SLSQP) with exact derivatives.

    Args:
        strokes: Strokes of the frame.
        limits: Load limits on level ground.
        q: (nq,) closed start configuration.
        moved: Indices of the active joints that move.

    Returns:
        (nq,) closed configuration; the start if no larger force is found.
    """
    statics, active = strokes.statics, strokes.machine.closure.active
    force = float(limits.rated_values(statics.evaluate(q[None]))[0].min())
    if not (0 < force < np.inf and moved):
        return q
    lower, lengths = strokes.low[moved], (strokes.high - strokes.low)[moved]

    # the variables y are shares of the moved strokes, and the force over that of the start
    @lru_cache(maxsize=1)
    def evaluate(shares: tuple[float, ...]) -> tuple[Array, StaticQuantities, StaticQuantities]:
        """Return the configuration (nq,), its statics, and their derivatives by coordinates."""
        target = q[active].copy()
        target[moved] = lower + np.clip(shares, 0, 1) * lengths
        found = last_closed_configuration(strokes.machine, q, target)[0]
        return found, statics.evaluate(found[None]), statics.coordinate_derivatives(found[None])

    def coefficients(at_rest: StaticQuantities) -> list[tuple[Array, ...]]:
        return [limits.bound_coefficients(x, at_rest, np.zeros(1)) for x in limits.bounds]

    def slacks(y: Any) -> Any:
        """Return the slack of each bound over its scale."""
        found = coefficients(evaluate(tuple(y[:-1]))[1])
        return -np.array([a[0] + b[0] * force * y[-1] for a, b, *_ in found]) / scales

    def jacobian(y: Any) -> Any:
        """Return the derivatives of the slacks by y."""
        _, at_rest, derivatives = evaluate(tuple(y[:-1]))
        out = np.empty((len(limits.bounds), len(y)))
        for k, i in enumerate(moved):
            by_stroke = StaticQuantities(*(part[..., i] for part in derivatives))
            for row, bound in zip(out, limits.bounds, strict=True):
                a, b, *_ = limits.coefficient_derivatives(bound, at_rest, by_stroke)
                row[k] = (a[0] + b[0] * force * y[-1]) * lengths[k]
        out[:, -1] = [b[0] * force for _, b, *_ in coefficients(at_rest)]
        return -out / scales[:, None]

    at_start = coefficients(statics.evaluate(q[None]))
    scales = np.array([abs(a[0]) + abs(b[0]) * force for a, b, *_ in at_start])
    constraints: Any = {"type": "ineq", "fun": slacks, "jac": jacobian}
    bounds: Any = [*[(0.0, 1.0)] * len(moved), (0.0, None)]

    def cost(y: Any) -> tuple[float, Any]:
        return -float(y[-1]), -np.eye(len(y))[-1]

    result = minimize(
        cost,
        np.r_[(q[active][moved] - lower) / lengths, 1.0],
        jac=True, bounds=bounds, constraints=[constraints], method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 200},
    )  # fmt: skip
    configuration, at_rest, _ = evaluate(tuple(result.x[:-1]))
    return configuration if float(limits.rated_values(at_rest)[0].min()) > force else q
