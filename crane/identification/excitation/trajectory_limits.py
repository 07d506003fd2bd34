"""What a reference may use of a machine."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from crane.common.errors import InputError, suggest_names
from crane.common.samples import Array, as_number
from crane.identification.mechanics.base_parameters import stroke_limits
from crane.identification.mechanics.model_term import MotionSamples
from crane.machine import Machine

QUANTITIES = ("stroke", "velocity", "acceleration", "force", "flow")
_SINGULARITY_GAIN = (
    5.0  # times as fast as at home, passive joints near the edge of the assembly branch
)


@dataclass(frozen=True, eq=False)
class TrajectoryLimits:
    """What a reference may use of a machine, infinite where there is no limit.

    Attributes:
        stroke_middle: (n,) of the strokes [m], [rad].
        half_stroke: (n,) of the strokes' lengths.
        velocity: (n,).
        acceleration: (n,).
        force: (n,) [N], [N m].
        flow: (n,) of the pump that feeds a joint, for all that it feeds [m3/s].
        areas: (2, n, n) areas of A and B of joint j where one pump feeds i and j, else 0 [m2],
            [m3/rad]: the pump of i gives the sum over j of max(A_ij v_j, -B_ij v_j).
    """

    stroke_middle: Array
    half_stroke: Array
    velocity: Array
    acceleration: Array
    force: Array
    flow: Array
    areas: Array

    @property
    def as_array(self) -> Array:
        """(5, n) by `QUANTITIES`, of strokes their half lengths."""
        return np.stack(
            [self.half_stroke, self.velocity, self.acceleration, self.force, self.flow]
        )

    def usage(self, q_a: Array, v_a: Array, a_a: Array, tau: Array) -> Array:
        """What of the limits a motion uses, 1 at a limit, (..., 5, n) as in `QUANTITIES`."""
        out, back = self.areas
        drawn = np.maximum(v_a, 0.0) @ out.T + np.maximum(-v_a, 0.0) @ back.T
        return (
            np.abs(np.stack([q_a - self.stroke_middle, v_a, a_a, tau, drawn], axis=-2))
            / self.as_array
        )


def trajectory_limits(
    machine: Machine, acceleration: Mapping[str, float] | None = None, margin: float = 0.05
) -> TrajectoryLimits:
    """Limits of the active joints: strokes, velocities and forces as in the URDF, flow of pumps.

    A joint without end keeps within 1 rad (1 m) of home. Accelerations need no limit of their
    own: one below velocity V with harmonics up to K w is below K w V (Bernstein).

    Args:
        machine: The machine.
        acceleration: Further limits by active joint [m/s2], [rad/s2].
        margin: Share of every limit that is left unused, at both ends of a stroke.

    Raises:
        InputError: Unknown joints, limits that let nothing move.
    """
    if not 0 <= as_number(margin, "the margin", "") < 1:
        raise InputError(f"the margin is {margin:g}, give a share from 0 to below 1")
    columns = machine.closure.active
    lower, upper = stroke_limits(machine)
    velocity, flow, areas = _fed(machine)
    found = TrajectoryLimits(
        (lower + upper) / 2,
        (upper - lower) / 2 * (1 - margin),
        np.minimum(machine.model.velocityLimit[columns], velocity) * (1 - margin),
        joint_values(machine, acceleration, "acceleration", np.full(len(columns), np.inf))
        * (1 - margin),
        machine.model.effortLimit[columns] * (1 - margin),
        flow * (1 - margin),
        areas,
    )
    for what, values in zip(QUANTITIES, found.as_array, strict=True):
        for joint, value in zip(machine.active, values, strict=True):
            if not value > 0:
                raise InputError(f"the {what} limit of '{joint}' is 0, give one above")
    return found


def _fed(machine: Machine) -> tuple[Array, Array, Array]:
    """Velocity limits of each joint alone by valve and pump, with the flow and the areas.

    A valve that keeps a flow gives c sqrt(margin) at most, any valve what its pump has.
    """
    n = len(machine.active)
    velocity, flow, areas = np.full(n, np.inf), np.full(n, np.inf), np.zeros((2, n, n))
    hydraulics = machine.hydraulics
    if hydraulics is None:
        return velocity, flow, areas
    column = {joint: machine.active.index(joint) for joint in hydraulics.joints}
    for joint, i in column.items():
        valve, cylinder = hydraulics.valves[joint], hydraulics.cylinders[joint]
        pump = hydraulics.pumps[valve.supply]
        flow[i] = pump.flow or np.inf
        for edge, area in ((valve.c1, cylinder.area_a), (valve.c4, cylinder.area_b)):
            most = edge * np.sqrt(valve.margin) if valve.margin else np.inf
            velocity[i] = min(velocity[i], most / area, flow[i] / area)
        for other, j in column.items():
            if pump.flow and hydraulics.valves[other].supply == valve.supply:
                beside = hydraulics.cylinders[other]
                areas[:, i, j] = beside.area_a, beside.area_b
    return velocity, flow, areas


def joint_values(
    machine: Machine, given: Mapping[str, float] | None, what: str, default: Array
) -> Array:
    """Positive numbers (n,) by active joint.

    Raises:
        InputError: An unknown joint, or a number that is not positive.
    """
    out = default.copy()
    for joint, value in (given or {}).items():
        if joint not in machine.active:
            raise InputError(
                f"{what} of '{joint}', which is not active, {suggest_names(machine.active, joint)}"
            )
        out[machine.active.index(joint)] = as_number(
            value, f"{what} of '{joint}'", "", greater_than=0
        )
    return out


def singularity_proximity(machine: Machine, samples: MotionSamples) -> Array:
    """How near the edge of the branch postures are, (N,), 1 where it is near.

    Passive joints move there without end for a small way of the active ones, which would tell
    everything and cannot be driven: |gamma_P diag(span)| / (5 |...| at home).
    """
    lower, upper = stroke_limits(machine)
    rows, span = machine.closure.passive, upper - lower

    def size(gamma: Array) -> Array:
        return np.asarray(np.linalg.norm(gamma[..., rows, :] * span, axis=(-2, -1)))

    home = float(size(machine.closure.gamma(machine.home)))
    return size(samples.gamma) / (_SINGULARITY_GAIN * home) if home else np.zeros(len(samples.q))
