"""Which strokes turn a frame about pins, and which of them are those of arm and bucket."""

from typing import NamedTuple

import numpy as np

from crane.common.errors import InputError, known
from crane.common.samples import Array
from crane.dynamics.frames import FrameJacobians
from crane.machine import Machine
from crane.motion.workspaces.patch import last_closed
from crane.ratings.strokes import Strokes

_TURNS = 1e-9  # share of the stroke's largest slope that is a turn
_PARALLEL = 1e-6  # rad
NEAR = 0.01  # of a stroke: nearer to a toggle than oil gives way under its working pressure
_ROUNDS, _SAME = 8, 1e-9  # at most, and of a stroke from a toggle that is none
_LEFT = 0.1  # of the frame's velocity, that may be left at a toggle


def pivot(machine: Machine, frame: str, i: int) -> str:
    """The joint that stroke i turns most of those that carry the frame.

    Raises:
        InputError: There is none.
    """
    model, moves = machine.model, np.abs(machine.closure.gamma(machine.home)[:, i])
    supports = list(model.supports[model.frames[machine.frame(frame)].parentJoint])
    names = [model.names[joint] for joint in supports if joint]
    rates = {name: moves[machine.column(name)] for name in names if machine.unit(name) == "rad"}
    if not rates or max(rates.values()) <= _TURNS * max(moves.max(), 1.0):
        raise InputError(f"'{machine.active[i]}' turns nothing that carries '{frame}'")
    return max(rates, key=lambda name: rates[name])


def turns(machine: Machine, frame: str, q: Array) -> Array:
    """Angular velocity of a frame by the active joints (3, n) at a closed posture (nq,)."""
    frames = FrameJacobians(machine)
    frames.place(q)
    return np.asarray(frames.of(frame)[3:] @ machine.closure.gamma(q))


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
    frames, pin = FrameJacobians(machine), machine.tree.joints[pivot(machine, frame, i)]
    frames.place(q)
    place, rates = frames.pose(frame).translation, frames.of(frame) @ machine.closure.gamma(q)
    velocity, rate = rates[:3, i], rates[3:, i]
    speed = float(np.linalg.norm(rate))
    if speed * machine.closure.size <= _TURNS * float(np.linalg.norm(velocity)):
        return Turn(np.full(3, np.inf), np.inf, np.inf)
    centre = place + np.cross(rate, velocity) / speed**2
    away = np.cross(rate / speed, centre - frames.pose(pin.child).translation)
    radius = float(np.linalg.norm(velocity)) / speed
    return Turn(np.asarray(centre), radius, float(np.linalg.norm(away)))


def turning(strokes: Strokes) -> dict[int, str]:
    """Strokes that turn pins which carry the frame, and these, from the ground outwards.

    Of pins that are parallel to the first one.
    """
    machine, frame = strokes.machine, strokes.statics.frame
    model, frames = machine.model, FrameJacobians(machine)
    frames.place(machine.home)
    found = {}
    for i in strokes.moving:
        try:
            found[i] = pivot(machine, frame, i)
        except InputError:  # it slides
            continue
    along = list(model.supports[model.frames[machine.frame(frame)].parentJoint])
    order = sorted(found, key=lambda i: along.index(model.getJointId(found[i])))
    axes = frames.of(frame)[3:]
    columns = [machine.column(found[i]) for i in order]
    flat = [np.linalg.norm(np.cross(axes[:, columns[0]], axes[:, k])) for k in columns]
    return {i: found[i] for i, lean in zip(order, flat, strict=True) if lean < _PARALLEL}


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
        it is farther off than `NEAR` of the stroke's length, or the frame does not stand still.
    """
    machine, statics, span = strokes.machine, strokes.statics, strokes.span[i]
    active, start = machine.closure.active, float(q[machine.closure.active][i])
    for _ in range(_ROUNDS):
        v = statics.at(q[None]).ways[0, :, i]
        slope = statics.derivatives(q[None]).ways[0, :, i, i]
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
        q, there = last_closed(machine, q, target)
        if not there or q[active][i] != target[i]:
            break
    return q if abs(q[active][i] - start) <= NEAR * span else None


def digging(
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
    found = turning(strokes)
    names = [machine.active[i] for i in found]
    for name in (bucket, arm):
        if name is not None and name not in names:
            raise InputError(f"'{name}' does not turn '{frame}', {known(names, name)}")
    if bucket is not None and bucket == arm:
        raise InputError(f"'{bucket}' is named as both bucket and arm, name two joints")
    cylinders = [i for i in found if machine.unit(machine.active[i]) == "m"]
    if bucket is None and len(cylinders) < 3:
        words = ", ".join(f"{machine.active[i]} about {found[i]}" for i in cylinders)
        raise InputError(
            f"'{machine.name}' has no bucket: {len(cylinders)} cylinders turn '{frame}' "
            f"({words or 'none'}), boom, arm and bucket are three; name its joint with --bucket"
        )
    order = list(found)
    one = cylinders[-1] if bucket is None else machine.active.index(bucket)
    if arm is not None:
        return one, machine.active.index(arm)
    before = order[: order.index(one)]
    return one, before[-1] if before else None
