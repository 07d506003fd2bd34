"""Which strokes turn a frame about pins, and which of them are those of arm and bucket."""

from typing import NamedTuple

import numpy as np

from crane.common.errors import InputError, suggest_names
from crane.common.samples import Array
from crane.dynamics.frame_jacobians import FrameJacobians
from crane.machine import Machine
from crane.motion.workspaces.workspace_patch import last_closed_configuration
from crane.ratings.strokes import Strokes

_ROTATION_TOLERANCE = 1e-9  # share of the stroke's largest slope that is a turn
_PARALLEL_TOLERANCE = 1e-6  # rad
NEAR = 0.01  # of a stroke: nearer to a toggle than oil gives way under its working pressure
_ROUNDS, _SAME = 8, 1e-9  # at most, and of a stroke from a toggle that is none
_LEFT = 0.1  # of the frame's velocity, that may be left at a toggle


def find_pivot(machine: Machine, frame: str, stroke_index: int) -> str:
    """The joint that stroke i turns most of those that carry the frame.

    Raises:
        InputError: There is none.
    """
    model, joint_rates = (
        machine.model,
        np.abs(machine.closure.gamma(machine.home)[:, stroke_index]),
    )
    supports = list(model.supports[model.frames[machine.frame(frame)].parentJoint])
    names = [model.names[joint] for joint in supports if joint]
    rates = {
        name: joint_rates[machine.column(name)] for name in names if machine.unit(name) == "rad"
    }
    if not rates or max(rates.values()) <= _ROTATION_TOLERANCE * max(joint_rates.max(), 1.0):
        raise InputError(f"'{machine.active[stroke_index]}' turns nothing that carries '{frame}'")
    return max(rates, key=lambda name: rates[name])


def frame_angular_jacobian(machine: Machine, frame: str, q: Array) -> Array:
    """Angular velocity of a frame by the active joints (3, n) at a closed posture (nq,)."""
    frames = FrameJacobians(machine)
    frames.set_configuration(q)
    return np.asarray(frames.jacobian(frame)[3:] @ machine.closure.gamma(q))


class Turn(NamedTuple):
    """How a frame turns as one stroke moves alone.

    Attributes:
        centre: (3,) its instantaneous centre of rotation, in the plane in which the frame moves;
            infinite where it only shifts [m].
        radius: From there to the frame, |v| / |w| [m].
        offset: From there to the axis of the pivot [m].
    """

    centre: Array
    radius: float
    offset: float


def turn(machine: Machine, frame: str, i: int, q: Array) -> Turn:
    """The instantaneous rotation of a frame as a stroke moves.

    With its place p, velocity v and angular velocity w its centre is

        c = p + w x v / |w|^2.

    Where the stroke turns one pin alone, c is on its axis, and else, as the boom of a loader whose
    tilt cylinder stands on the frame, it is not.

    Args:
        machine: The machine.
        frame: A link.
        i: The stroke, among the active joints.
        q: (nq,) closed posture.
    """
    frames, pin = FrameJacobians(machine), machine.tree.joints[find_pivot(machine, frame, i)]
    frames.set_configuration(q)
    place, rates = (
        frames.frame_pose(frame).translation,
        frames.jacobian(frame) @ machine.closure.gamma(q),
    )
    velocity, rate = rates[:3, i], rates[3:, i]
    speed = float(np.linalg.norm(rate))
    if speed * machine.closure.characteristic_length <= _ROTATION_TOLERANCE * float(
        np.linalg.norm(velocity)
    ):
        return Turn(np.full(3, np.inf), np.inf, np.inf)
    centre = place + np.cross(rate, velocity) / speed**2
    away = np.cross(rate / speed, centre - frames.frame_pose(pin.child).translation)
    radius = float(np.linalg.norm(velocity)) / speed
    return Turn(np.asarray(centre), radius, float(np.linalg.norm(away)))


def turning_strokes(strokes: Strokes) -> dict[int, str]:
    """Strokes that turn pins which carry the frame, and these, from the ground outwards.

    Of pins that are parallel to the first one.
    """
    machine, frame = strokes.machine, strokes.statics.frame
    model, frames = machine.model, FrameJacobians(machine)
    frames.set_configuration(machine.home)
    pivots = {}
    for i in strokes.moving:
        try:
            pivots[i] = find_pivot(machine, frame, i)
        except InputError:  # it slides
            continue
    supporting_joints = list(model.supports[model.frames[machine.frame(frame)].parentJoint])
    order = sorted(pivots, key=lambda i: supporting_joints.index(model.getJointId(pivots[i])))
    axes = frames.jacobian(frame)[3:]
    columns = [machine.column(pivots[i]) for i in order]
    parallel_strokes = [np.linalg.norm(np.cross(axes[:, columns[0]], axes[:, k])) for k in columns]
    return {
        i: pivots[i]
        for i, lean in zip(order, parallel_strokes, strict=True)
        if lean < _PARALLEL_TOLERANCE
    }


def toggle(strokes: Strokes, i: int, q: Array) -> Array | None:
    """The posture of a toggle beside another one: the frame stands still as stroke i moves.

    With v = dp/dX and v' = dv/dX, to first order |v(X + d)| is least at

        d = -v . v' / |v'|^2

    and vanishes there where v and v' are parallel. Repeated until X stays.

    Args:
        strokes: Of the frame.
        i: The stroke, among the active joints.
        q: (nq,) closed posture.

    Returns:
        The posture (nq,), or the last one within the stroke's limits on the way to it; None where
        it is farther off than `EVENT_TOLERANCE` of the stroke's length, or the frame does not
        stand still.
    """
    machine, statics, span = strokes.machine, strokes.statics, strokes.span[i]
    active, start = machine.closure.active, float(q[machine.closure.active][i])
    for _ in range(_ROUNDS):
        v = statics.evaluate(q[None]).tip_jacobian[0, :, i]
        slope = statics.coordinate_derivatives(q[None]).tip_jacobian[0, :, i, i]
        speed, steep = float(np.linalg.norm(v)), float(slope @ slope)
        if speed <= _SAME * span * np.sqrt(steep):
            break
        step = -float(v @ slope) / steep if steep else np.inf
        target = q[active].copy()
        target[i] += step
        if abs(target[i] - start) > 2 * NEAR * span:
            return None
        if np.linalg.norm(v + step * slope) > _LEFT * speed:
            return None
        target[i] = np.clip(target[i], strokes.low[i], strokes.high[i])
        q, there = last_closed_configuration(machine, q, target)
        if not there or q[active][i] != target[i]:
            break
    return q if abs(q[active][i] - start) <= NEAR * span else None


def bucket_and_arm_strokes(
    strokes: Strokes, bucket: str | None = None, arm: str | None = None
) -> tuple[int, int | None]:
    """The strokes of bucket and arm, among the active joints.

    Of an excavator's front three cylinders turn the tip, each about a pivot of its own: the one
    nearest to the tip is the bucket's, the next one the arm's.

    Args:
        strokes: Of the tip.
        bucket: The joint, if it is another one.
        arm: Likewise.

    Returns:
        The arm's is None where nothing turns the tip but the bucket's.

    Raises:
        InputError: A name that turns nothing, or no bucket: fewer than three cylinders.
    """
    machine, frame = strokes.machine, strokes.statics.frame
    pivots = turning_strokes(strokes)
    names = [machine.active[i] for i in pivots]
    for name in (bucket, arm):
        if name is not None and name not in names:
            raise InputError(f"'{name}' does not turn '{frame}', {suggest_names(names, name)}")
    if bucket is not None and bucket == arm:
        raise InputError(f"'{bucket}' is named as both bucket and arm, name two joints")
    cylinders = [i for i in pivots if machine.unit(machine.active[i]) == "m"]
    if bucket is None and len(cylinders) < 3:
        text = ", ".join(f"{machine.active[i]} about {pivots[i]}" for i in cylinders)
        raise InputError(
            f"'{machine.name}' has no bucket: {len(cylinders)} cylinders turn '{frame}' "
            f"({text or 'none'}), boom, arm and bucket are three; name its joint with --bucket"
        )
    order = list(pivots)
    bucket_stroke = cylinders[-1] if bucket is None else machine.active.index(bucket)
    if arm is not None:
        return bucket_stroke, machine.active.index(arm)
    inner_strokes = order[: order.index(bucket_stroke)]
    return bucket_stroke, inner_strokes[-1] if inner_strokes else None
