"""Which strokes turn a frame about pins, and which of them are those of arm and bucket."""

import numpy as np

from crane.common.errors import InputError, known
from crane.common.samples import Array
from crane.dynamics.frames import FrameJacobians
from crane.machine import Machine
from crane.ratings.places import Places

_TURNS = 1e-9  # share of the stroke's largest slope that is a turn
_PARALLEL = 1e-6  # rad


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


def turning(places: Places) -> dict[int, str]:
    """Strokes that turn the frame in its section, and their pivots, from the ground outwards."""
    machine, frame = places.machine, places.statics.frame
    model = machine.model
    rates = turns(machine, frame, machine.home)
    found = {}
    for i in [*places.pair, *places.others]:
        try:
            found[i] = pivot(machine, frame, i)
        except InputError:  # it slides
            continue
    along = list(model.supports[model.frames[machine.frame(frame)].parentJoint])
    order = sorted(found, key=lambda i: along.index(model.getJointId(found[i])))
    axes = {i: rates[:, i] / np.linalg.norm(rates[:, i]) for i in order}
    flat = [i for i in order if np.linalg.norm(np.cross(axes[order[0]], axes[i])) < _PARALLEL]
    return {i: found[i] for i in flat}


def digging(
    places: Places, bucket: str | None = None, arm: str | None = None
) -> tuple[int, int | None]:
    """The strokes of bucket and arm, among the active joints.

    Of an excavator's front three cylinders turn the tip, each about a pivot of its own: the one
    nearest to the tip is the bucket's, the next one the arm's.

    Args:
        places: Of the tip.
        bucket: The joint, if it is another one.
        arm: Likewise.

    Returns:
        The arm's is None where nothing turns the tip but the bucket's.

    Raises:
        InputError: A name that turns nothing, or no bucket: fewer than three cylinders.
    """
    machine, frame = places.machine, places.statics.frame
    found = turning(places)
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
