"""Strokes that move a frame in its section, and the pivots about which they turn it."""

from typing import NamedTuple

import numpy as np

from crane.common.errors import InputError, check_name
from crane.common.samples import Array
from crane.dynamics.frame_jacobians import FrameJacobians
from crane.dynamics.statics import StaticsEvaluator
from crane.machine.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.motion.workspaces.workspace_mapping import moving_strokes, stroke_limits
from crane.motion.workspaces.workspace_patch import last_closed_configuration
from crane.motion.workspaces.workspace_section import find_slewing_joint, workspace_section

TOGGLE_DISTANCE = 0.01  # share of a stroke near a toggle where the compliance of the oil decides
_SAMPLED_CONFIGURATIONS = 200
_MOTION_TOLERANCE = 1e-6  # share of the motion by other strokes below which the frame is still
_ROTATION_TOLERANCE = 1e-9  # share of the stroke's largest rate that counts as rotation
_PARALLEL_TOLERANCE = 1e-6  # [rad]
_MAX_ITERATIONS = 8  # of Newton's method for a toggle
_TOGGLE_TOLERANCE = 1e-9  # share of a stroke
_MAX_REMAINING_VELOCITY = 0.1  # share of the frame's velocity that may remain at a toggle


class Strokes:
    """The strokes that move a frame in its section.

    A joint that slews the whole machine stays at home, and so do strokes that do not move the
    frame.

    Args:
        machine: The machine.
        frame: A link; the tip by default.

    Attributes:
        machine: The machine.
        statics: Evaluates the machine and the frame.
        section: Section of the frame: radius and height.
        low: (n,) lower limits of the active joints.
        high: (n,) upper limits.
        span: (n,) differences of the limits; 1 where they are equal.
        moving: Indices of the strokes among the active joints: the two that move the frame most,
            then the others, both in the order of the machine.

    Raises:
        InputError: A joint is free, or the drives are not the active joints.
    """

    def __init__(self, machine: Machine, frame: str | None = None):
        drives = machine.explicit_drives or ()
        if any(x.name not in machine.active or len(x.factors) > 1 for x in drives):
            raise InputError(
                f"the drives of '{machine.name}' are not its active joints, choose them: --active "
                + ",".join(machine.active)
            )
        statics = self.statics = StaticsEvaluator(machine, frame)
        machine = self.machine = statics.machine
        frame, active = statics.frame, machine.closure.active
        self.low, self.high = stroke_limits(machine)
        self.span = np.where(self.high > self.low, self.high - self.low, 1.0)
        slew, random = find_slewing_joint(machine, frame), np.random.default_rng(0)
        if machine.free:
            raise InputError(
                f"'{machine.free[0]}' of '{machine.name}' is free, hold it: "
                f"--lock {machine.free[0]}=0"
            )
        kinematics = Kinematics(machine, frame)
        strokes = moving_strokes(
            machine, kinematics, self.low, self.high, None if slew is None else slew[0], random
        )
        samples = np.repeat(machine.home[None], _SAMPLED_CONFIGURATIONS, axis=0)
        for k in strokes:
            samples[:, active[k]] = random.uniform(
                self.low[k], self.high[k], _SAMPLED_CONFIGURATIONS
            )
        closed, is_closed = statics.close_loops(samples)
        for i in np.flatnonzero(np.logical_not(is_closed)).tolist():  # far from home, by steps
            closed[i] = last_closed_configuration(machine, machine.home, samples[i, active])[0]
        at_rest = statics.evaluate(closed)
        self.section = workspace_section(
            machine, frame, at_rest.tip_positions,
            kinematics.position_at_configuration(machine.home),
        )  # fmt: skip
        jacobian = self.section.section_jacobian(at_rest.tip_positions, at_rest.tip_jacobian)
        motion = np.linalg.norm(jacobian, axis=1).mean(axis=0) * self.span
        strokes = [i for i in strokes if motion[i] > _MOTION_TOLERANCE * motion[strokes].max()]
        order = sorted(strokes, key=lambda i: -motion[i])
        self.moving = [*sorted(order[:2]), *sorted(order[2:])]


def find_pivot(machine: Machine, frame: str, stroke_index: int) -> str:
    """Return the joint that a stroke turns most, of those that carry the frame.

    Raises:
        InputError: The stroke turns none of them.
    """
    model = machine.model
    joint_rates = np.abs(machine.closure.gamma(machine.home)[:, stroke_index])
    supports = list(model.supports[model.frames[machine.frame(frame)].parentJoint])
    names = [model.names[joint] for joint in supports if joint]
    rates = {
        name: joint_rates[machine.column(name)] for name in names if machine.unit(name) == "rad"
    }
    if not rates or max(rates.values()) <= _ROTATION_TOLERANCE * max(joint_rates.max(), 1.0):
        raise InputError(f"'{machine.active[stroke_index]}' turns nothing that carries '{frame}'")
    return max(rates, key=lambda name: rates[name])


def frame_rates(machine: Machine, frame: str, q: Array) -> Array:
    """Return the rates (6, n) of a frame by the active joints at a closed q (nq,).

    Those of its origin [m/m], [m/rad], then its angular velocity [rad/m], [1].
    """
    frames = FrameJacobians(machine)
    frames.set_configuration(q)
    return np.asarray(frames.jacobian(frame) @ machine.closure.gamma(q))


class InstantaneousRotation(NamedTuple):
    """Rotation of a frame when one stroke alone moves.

    Attributes:
        centre: (3,) instantaneous centre of rotation, in the plane in which the frame moves;
            infinite if the frame is only shifted [m].
        radius: Distance from the centre to the frame, |v| / |w| [m].
        offset: Distance from the centre to the axis of the pivot [m].
    """

    centre: Array
    radius: float
    offset: float


def instantaneous_rotation(
    machine: Machine, frame: str, stroke_index: int, q: Array
) -> InstantaneousRotation:
    """Compute the instantaneous rotation of a frame by one stroke.

    With the position p, the velocity v and the angular velocity w of the frame, the centre is

        c = p + w x v / |w|^2.

    If the stroke turns one pin only, c lies on its axis. If it turns several pins, c lies
    elsewhere, as for the boom of a loader whose tilt cylinder stands on the frame.

    Args:
        machine: The machine.
        frame: A link.
        stroke_index: Index of the stroke among the active joints.
        q: (nq,) closed configuration.
    """
    frames = FrameJacobians(machine)
    pivot = machine.tree.joints[find_pivot(machine, frame, stroke_index)]
    frames.set_configuration(q)
    position = frames.frame_pose(frame).translation
    rates = frames.jacobian(frame) @ machine.closure.gamma(q)
    velocity, angular_velocity = rates[:3, stroke_index], rates[3:, stroke_index]
    speed, rate = float(np.linalg.norm(velocity)), float(np.linalg.norm(angular_velocity))
    if rate * machine.closure.characteristic_length <= _ROTATION_TOLERANCE * speed:
        return InstantaneousRotation(np.full(3, np.inf), np.inf, np.inf)
    centre = np.asarray(position + np.cross(angular_velocity, velocity) / rate**2)
    offset = np.cross(angular_velocity / rate, centre - frames.frame_pose(pivot.child).translation)
    return InstantaneousRotation(centre, speed / rate, float(np.linalg.norm(offset)))


def turning_strokes(strokes: Strokes) -> dict[int, str]:
    """Return the strokes that turn pins which carry the frame, and these pins.

    The order is from the ground outwards; pins that are not parallel to the first one are left
    out.
    """
    machine, frame = strokes.machine, strokes.statics.frame
    model, frames = machine.model, FrameJacobians(machine)
    frames.set_configuration(machine.home)
    pivots = {}
    for i in strokes.moving:
        try:
            pivots[i] = find_pivot(machine, frame, i)
        except InputError:  # the stroke shifts the frame
            continue
    supports = list(model.supports[model.frames[machine.frame(frame)].parentJoint])
    order = sorted(pivots, key=lambda i: supports.index(model.getJointId(pivots[i])))
    axes = frames.jacobian(frame)[3:, [machine.column(pivots[i]) for i in order]]
    return {
        i: pivots[i]
        for k, i in enumerate(order)
        if np.linalg.norm(np.cross(axes[:, 0], axes[:, k])) < _PARALLEL_TOLERANCE
    }


def find_toggle(strokes: Strokes, stroke_index: int, q: Array) -> Array | None:
    """Find the toggle near a configuration: the frame stands still while a stroke moves.

    With v = dp/dX and v' = dv/dX, the speed |v(X + d)| is smallest, to first order, at

        d = -v . v' / |v'|^2

    and vanishes there if v and v' are parallel. The step is repeated until X stays.

    Args:
        strokes: Strokes of the frame.
        stroke_index: Index of the stroke among the active joints.
        q: (nq,) closed configuration.

    Returns:
        The configuration (nq,) of the toggle, or the last one within the stroke's limits on the
        way to it; None if it is farther away than `TOGGLE_DISTANCE` of the stroke's length, or if
        the frame does not stand still.
    """
    i, machine, statics = stroke_index, strokes.machine, strokes.statics
    span, active = strokes.span[i], machine.closure.active
    start = float(q[active][i])
    for _ in range(_MAX_ITERATIONS):
        velocity = statics.evaluate(q[None]).tip_jacobian[0, :, i]
        derivative = statics.coordinate_derivatives(q[None]).tip_jacobian[0, :, i, i]
        speed, squared = float(np.linalg.norm(velocity)), float(derivative @ derivative)
        if speed <= _TOGGLE_TOLERANCE * span * np.sqrt(squared):
            break
        step = -float(velocity @ derivative) / squared if squared else np.inf
        target = q[active].copy()
        target[i] += step
        if abs(target[i] - start) > 2 * TOGGLE_DISTANCE * span:
            return None
        if np.linalg.norm(velocity + step * derivative) > _MAX_REMAINING_VELOCITY * speed:
            return None
        target[i] = np.clip(target[i], strokes.low[i], strokes.high[i])
        q, is_reached = last_closed_configuration(machine, q, target)
        if not is_reached or q[active][i] != target[i]:
            break
    return q if abs(q[active][i] - start) <= TOGGLE_DISTANCE * span else None


def bucket_and_arm_strokes(
    strokes: Strokes, bucket: str | None = None, arm: str | None = None
) -> tuple[int, int | None]:
    """Return the strokes of bucket and arm, as indices among the active joints.

    Three cylinders of an excavator turn the tip, each about its own pivot: the one nearest to the
    tip moves the bucket, the next one the arm.

    Args:
        strokes: Strokes of the tip.
        bucket: Joint of the bucket, in place of the one nearest to the tip.
        arm: Joint of the arm, in place of the one before the bucket.

    Returns:
        Both indices; that of the arm is None if only the bucket's stroke turns the tip.

    Raises:
        InputError: A named joint does not turn the tip, or there is no bucket: fewer than three
            cylinders turn the tip.
    """
    machine, frame = strokes.machine, strokes.statics.frame
    pivots = turning_strokes(strokes)
    names = [machine.active[i] for i in pivots]
    for name in filter(None, (bucket, arm)):
        check_name(name, names, f"'{name}' does not turn '{frame}'")
    if bucket is not None and bucket == arm:
        raise InputError(f"'{bucket}' is named as both bucket and arm, name two joints")
    cylinders = [i for i in pivots if machine.unit(machine.active[i]) == "m"]
    if bucket is None and len(cylinders) < 3:
        text = ", ".join(f"{machine.active[i]} about {pivots[i]}" for i in cylinders)
        raise InputError(
            f"'{machine.name}' has no bucket: '{frame}' is turned by {text or 'no cylinder'}, "
            "and boom, arm and bucket are three; name its joint with --bucket"
        )
    order = list(pivots)
    bucket_stroke = cylinders[-1] if bucket is None else machine.active.index(bucket)
    if arm is not None:
        return bucket_stroke, machine.active.index(arm)
    return bucket_stroke, next(reversed(order[: order.index(bucket_stroke)]), None)
