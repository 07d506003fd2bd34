"""Lengths of cylinders from pin to pin, where strokes are expected."""

import numpy as np
import pinocchio as pin

from crane.common.errors import RecordingError
from crane.common.samples import Array
from crane.description.sensors import SENSOR, Sensor
from crane.machine import Machine
from crane.recordings.reading import known_sensors
from crane.recordings.timeseries import Table, column

_SLACK = 0.02  # of a stroke, by which sensors may be off
_STRAIGHT = 0.01  # of a cylinder's length, by which its pins may be off its axis


def check_strokes(machine: Machine, table: Table) -> None:
    """Refuse lengths of cylinders from pin to pin that are given as strokes.

    Raises:
        RecordingError: There are some; the message says the dead lengths.
    """
    known = known_sensors(table, machine)
    told = []
    for joint, lower, upper in zip(machine.active, machine.lower, machine.upper, strict=True):
        if table.units.get(joint) != "m" or not np.isfinite([lower, upper]).all():
            continue
        low, high = np.quantile(column(table, joint), [0.005, 0.995])
        slack = _SLACK * (upper - lower)
        if low >= lower - slack and high <= upper + slack:
            continue
        dead = dead_length(machine, joint)
        if dead is not None and low - dead >= lower - slack and high - dead <= upper + slack:
            was = known.get(joint, Sensor())
            told.append(
                f"'{joint}' goes from {low:.4g} to {high:.4g} m, its stroke from {lower:.4g} to "
                f"{upper:.4g} m: from pin to pin it is {dead:.4g} m longer, subtract that "
                f"({SENSOR}{joint}.zero = {was.zero + was.scale * dead:.6g})"
            )
    if told:
        raise RecordingError("; ".join(told))


def dead_length(machine: Machine, joint: str) -> float | None:
    """From pin to pin of a cylinder less the coordinate of its slide [m]; None of other slides.

    A pin of a body is where a revolute joint holds it or stands on it, or where a loop ends; those
    two count whose line is the axis of the slide.
    """
    slide = machine.tree.joints[joint]
    model = machine.model
    data = model.createData()
    place = machine.coordinates.configuration(machine.home)
    pin.framesForwardKinematics(model, data, place)
    axis = data.oMf[machine.frame(slide.child)].rotation @ np.array(slide.axis)
    bodies = machine.tree.bodies()
    best, length = _STRAIGHT, None
    for one in _pins(machine, data, bodies[slide.parent], joint):
        for two in _pins(machine, data, bodies[slide.child], joint):
            along = float(axis @ (two - one))
            off = float(np.linalg.norm(two - one - along * axis))
            if off < best * along:
                best, length = off / along, along
    return None if length is None else length - float(machine.home[machine.column(joint)])


def _pins(machine: Machine, data: pin.Data, body: str, slide: str) -> list[Array]:
    """Where (3,) pins hold a body, but for a slide."""
    tree, bodies = machine.tree, machine.tree.bodies()
    frames = [
        joint.child
        for joint in tree.moving
        if joint.name != slide
        and joint.kind == "revolute"
        and body in (joint.child, bodies[joint.parent])
    ]
    loops = machine.closure.equations.loops
    ends = [end for loop in loops for end in (loop.predecessor, loop.successor)]
    frames += [end for end in ends if bodies[end] == body]
    return [data.oMf[machine.frame(frame)].translation.copy() for frame in frames]
