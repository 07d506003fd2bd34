"""Lengths of cylinders from pin to pin, where strokes are expected."""

import numpy as np
import pinocchio as pin

from crane.common.errors import RecordingError
from crane.common.samples import Array
from crane.description.sensors import SENSOR_PREFIX, Sensor
from crane.machine import Machine
from crane.recordings.recording_reader import known_sensors
from crane.recordings.timeseries import Table, table_column

_STROKE_TOLERANCE = 0.02  # of a stroke, by which sensors may be off
_MAX_AXIS_DEVIATION = 0.01  # of a cylinder's length, by which its pins may be off its axis


def check_strokes(machine: Machine, table: Table) -> None:
    """Refuse lengths of cylinders from pin to pin that are given as strokes.

    Raises:
        RecordingError: There are some; the message says the dead lengths.
    """
    known = known_sensors(table, machine)
    messages = []
    for joint, lower, upper in zip(machine.active, machine.lower, machine.upper, strict=True):
        if table.units.get(joint) != "m" or not np.isfinite([lower, upper]).all():
            continue
        low, high = np.quantile(table_column(table, joint), [0.005, 0.995])
        slack = _STROKE_TOLERANCE * (upper - lower)
        if low >= lower - slack and high <= upper + slack:
            continue
        pin_offset = dead_length(machine, joint)
        if (
            pin_offset is not None
            and low - pin_offset >= lower - slack
            and high - pin_offset <= upper + slack
        ):
            was = known.get(joint, Sensor())
            messages.append(
                f"'{joint}' goes from {low:.4g} to {high:.4g} m, its stroke from {lower:.4g} to "
                f"{upper:.4g} m: from pin to pin it is {pin_offset:.4g} m longer, subtract that "
                f"({SENSOR_PREFIX}{joint}.zero = {was.zero + was.scale * pin_offset:.6g})"
            )
    if messages:
        raise RecordingError("; ".join(messages))


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
    bodies = machine.tree.bodies_by_link()
    smallest_deviation, length = _MAX_AXIS_DEVIATION, None
    for one in _pin_positions(machine, data, bodies[slide.parent], joint):
        for two in _pin_positions(machine, data, bodies[slide.child], joint):
            along = float(axis @ (two - one))
            axis_distance = float(np.linalg.norm(two - one - along * axis))
            if axis_distance < smallest_deviation * along:
                smallest_deviation, length = axis_distance / along, along
    return None if length is None else length - float(machine.home[machine.column(joint)])


def _pin_positions(machine: Machine, data: pin.Data, body: str, slide: str) -> list[Array]:
    """Where (3,) pins hold a body, but for a slide."""
    tree, bodies = machine.tree, machine.tree.bodies_by_link()
    frames = [
        joint.child
        for joint in tree.moving_joints
        if joint.name != slide
        and joint.kind == "revolute"
        and body in (joint.child, bodies[joint.parent])
    ]
    loops = machine.closure.equations.loops
    ends = [end for loop in loops for end in (loop.predecessor, loop.successor)]
    frames += [end for end in ends if bodies[end] == body]
    return [data.oMf[machine.frame(frame)].translation.copy() for frame in frames]
