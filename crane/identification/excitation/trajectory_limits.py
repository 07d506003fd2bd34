"""Limits of a machine for excitation trajectories."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from crane.common.errors import InputError, suggest_names
from crane.common.samples import Array, as_number
from crane.identification.mechanics.base_parameters import stroke_limits
from crane.identification.mechanics.model_term import MotionSamples
from crane.machine.machine import Machine

QUANTITIES = ("stroke", "velocity", "acceleration", "force", "flow")
_SINGULARITY_GAIN = 5.0  # ratio of gamma to that at home, near the end of the branch


@dataclass(frozen=True, eq=False)
class TrajectoryLimits:
    """Limits of a trajectory, infinite if there is no limit.

    Attributes:
        stroke_middle: (n,) middle of the strokes [m], [rad].
        half_stroke: (n,) half lengths of the strokes.
        velocity: (n,) velocity limits.
        acceleration: (n,) acceleration limits.
        force: (n,) force limits [N], [N m].
        flow: (n,) flow of the pump that feeds a joint [m3/s].
        areas: (2, n, n) areas A and B of joint j if one pump feeds i and j, else 0 [m2], [m3/rad]:
            the flow of the pump of i is the sum over j of max(A_ij v_j, -B_ij v_j).
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
        """Limits (5, n) by `QUANTITIES`, with half lengths of strokes."""
        return np.stack(
            [self.half_stroke, self.velocity, self.acceleration, self.force, self.flow]
        )

    def usage(self, q_a: Array, v_a: Array, a_a: Array, tau: Array) -> Array:
        """Used share (..., 5, n) of the limits by a motion, 1 at a limit, by `QUANTITIES`."""
        out, back = self.areas
        drawn = np.maximum(v_a, 0.0) @ out.T + np.maximum(-v_a, 0.0) @ back.T
        return (
            np.abs(np.stack([q_a - self.stroke_middle, v_a, a_a, tau, drawn], axis=-2))
            / self.as_array
        )


def trajectory_limits(
    machine: Machine, acceleration: Mapping[str, float] | None = None, margin: float = 0.05
) -> TrajectoryLimits:
    """Limits of the active joints: strokes, velocities, forces, and flows of pumps.

    An unlimited joint stays within 1 rad (1 m) of home. Accelerations need no separate limit: for
    a velocity below V with harmonics up to K w they are below K w V (Bernstein).

    Args:
        machine: The machine.
        acceleration: Acceleration limits by active joint [m/s2], [rad/s2].
        margin: Unused share of every limit, at both ends of a stroke.

    Raises:
        InputError: Joints are unknown, or limits are zero.
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
    """Velocity limits of each joint alone by valve and pump, flows, and areas.

    A compensated valve has the largest flow c sqrt(margin), any valve that of its pump.
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
    """Positive values (n,) by active joint, with defaults.

    Raises:
        InputError: A joint is unknown, or a value is not positive.
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
    """Proximity (N,) of configurations to the end of the branch, 1 at the limit.

    It is |gamma_P diag(span)| / (5 |...| at home). Near the end of the branch small active motions
    cause large passive ones, which drives cannot follow.
    """
    lower, upper = stroke_limits(machine)
    rows, span = machine.closure.passive, upper - lower

    def size(gamma: Array) -> Array:
        return np.asarray(np.linalg.norm(gamma[..., rows, :] * span, axis=(-2, -1)))

    home = float(size(machine.closure.gamma(machine.home)))
    return size(samples.gamma) / (_SINGULARITY_GAIN * home) if home else np.zeros(len(samples.q))
