"""Motion of a page: joint tree, packed coordinates and frames for its script."""

import base64
from typing import Any

import numpy as np
import pinocchio as pin

from crane.common.errors import InputError, RecordingError, check_name
from crane.common.samples import Array
from crane.description.rotation_vectors import ROTATION_COUNT
from crane.machine.machine import Machine
from crane.recordings.recording import Recording

_LEVELS = 2**32 - 1


def pack_base64(values: np.ndarray, dtype_name: str) -> str:
    """Return little-endian numbers as base64.

    Args:
        values: Array of any shape, in row-major order.
        dtype_name: numpy type, "f4", "f8" or "u4".
    """
    return base64.b64encode(
        np.ascontiguousarray(values, dtype=f"<{dtype_name}").tobytes()
    ).decode()


def quantise(values: Array) -> dict[str, Any]:
    """Pack coordinates into four bytes each, to 1.2e-10 of their range (float32: 6e-8).

    Args:
        values: (N,) finite values.

    Returns:
        low, step and levels with value = low + step * level; no levels if all values are equal.
    """
    low = float(values.min())
    step = (float(values.max()) - low) / _LEVELS
    if not step:
        return {"low": low, "step": 0.0, "levels": ""}
    return {"low": low, "step": step, "levels": pack_base64(np.rint((values - low) / step), "u4")}


FRAMES_PER_SECOND = 30.0
MAX_FRAMES = 36_000  # twenty minutes at full rate; longer recordings get fewer per second


def joint_tree(machine: Machine) -> dict[str, Any]:
    """Return joints, masses and link frames for the script; matrices in column-major order.

    Returns:
        Joints, each after its parent, with the index of their first coordinate; -1 is the world.
    """
    model = machine.model
    joints = []
    for i in range(1, model.njoints):
        column = model.joints[i].idx_v
        joint_kind = "floating" if model.joints[i].nv > ROTATION_COUNT else "ball"
        axis = np.zeros(3)
        if model.joints[i].nv == 1:
            subspace = np.ravel(model.joints[i].createData().S)
            is_prismatic = bool(machine.coordinates.is_translation[column])
            joint_kind = "prismatic" if is_prismatic else "revolute"
            axis = subspace[:3] if is_prismatic else subspace[3:]
        joints.append(
            {
                "name": model.names[i],
                "parent": model.parents[i] - 1,
                "column": column,
                "placement": column_major_pose(model.jointPlacements[i]),
                "type": joint_kind,
                "axis": axis.tolist(),
                "mass": model.inertias[i].mass,
                "lever": model.inertias[i].lever.tolist(),
            }
        )
    return {
        "joints": joints,
        "links": {
            link: frame_data(machine, link)
            for link in [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
        },
    }


def frame_data(machine: Machine, link: str) -> dict[str, Any]:
    """Return the joint of a link's frame, and its pose in the joint's frame."""
    frame = machine.model.frames[machine.frame(link)]
    return {"joint": frame.parentJoint - 1, "placement": column_major_pose(frame.placement)}


def column_major_pose(pose: pin.SE3) -> list[float]:
    """Return a pose as 16 numbers, column by column."""
    values: list[float] = pose.homogeneous.ravel("F").tolist()
    return values


def payload_frame_data(machine: Machine) -> dict[str, Any] | None:
    """Return the centre of mass of the payload as a frame; None without payload."""
    model, tree = machine.model, machine.tree
    payload_chain = next((chain for chain in machine.chains if chain.name == "payload"), None)
    if payload_chain is None:
        return frame_data(machine, "payload") if "payload" in tree.links else None
    total, moment, joint = 0.0, np.zeros(3), 0
    child_joints = tree.joints_by_parent()
    pending_links = [tree.joints[payload_chain.attachment_name].child]
    while pending_links:
        link = pending_links.pop()
        pending_links += [joint.child for joint in child_joints.get(link, ())]
        frame = model.frames[machine.frame(link)]
        joint = frame.parentJoint
        if (inertial := tree.links[link].inertial) is not None:
            total += inertial.mass
            moment += inertial.mass * frame.placement.act(np.array(inertial.com))
    if not total:
        return None
    return {"joint": joint - 1, "placement": column_major_pose(pin.SE3(np.eye(3), moment / total))}


def frame_rows(time: Array, frame_share: float = 1.0) -> np.ndarray:
    """Return the rows of the samples that are frames: 30 per second, fewer of long recordings.

    Args:
        time: (N,) increasing times [s].
        frame_share: Share of the largest number of frames of a page.
    """
    duration = float(time[-1] - time[0])
    return nearest_frame_rows(
        time,
        min(FRAMES_PER_SECOND, frame_share * MAX_FRAMES / duration)
        if duration
        else FRAMES_PER_SECOND,
    )


def nearest_frame_rows(time: Array, fps: float) -> np.ndarray:
    """Return the rows of the samples nearest to equidistant frames, first and last included.

    Args:
        time: (N,) increasing times [s].
        fps: Frames per second.
    """
    return np.unique(
        np.append(
            np.searchsorted((time[1:] + time[:-1]) / 2, np.arange(time[0], time[-1], 1 / fps)),
            len(time) - 1,
        )
    )


def motion_data(time: Array, q: Array) -> dict[str, Any]:
    """Return packed times (N,) [s] and configurations (N, nq) for the script."""
    return {"time": pack_base64(time, "f8"), "q": [quantise(column) for column in q.T]}


def check_joints(machine: Machine, recording: Recording) -> None:
    """Check that a recording is of this machine.

    Raises:
        RecordingError: The recording lacks an active joint, or has an unknown joint or unit.
    """
    for joint in machine.active:
        problem = f"the recording has no joint '{joint}', which drives {machine.name}"
        check_name(joint, recording.joints, problem, RecordingError)
    for joint in recording.joints:
        problem = f"the recording has a joint '{joint}' that {machine.name} does not have"
        check_name(joint, machine.joints, problem, RecordingError)
        if recording.units[joint] != machine.unit(joint):
            raise RecordingError(
                f"'{joint}' is recorded in {recording.units[joint]}, in {machine.name} it is in "
                f"{machine.unit(joint)}: give a recording of this machine"
            )


def recorded_configurations(machine: Machine, recording: Recording, rows: np.ndarray) -> Array:
    """Return closed configurations (len(rows), nq) of some samples of a recording.

    Raises:
        RecordingError: The recording is of a machine with other joints.
        ClosureError: The loops cannot be closed.
        InputError: A coordinate is not finite.
    """
    check_joints(machine, recording)
    columns = {joint: recording.q[rows, i] for i, joint in enumerate(recording.joints)}
    for joint, unit in recording.channel_units.items():
        # a passive joint, in its unit or without unit
        if joint in machine.joints and unit in ("", machine.unit(joint)):
            columns.setdefault(joint, recording.channels[joint][rows])
    if len(columns) == len(machine.joints):
        q = np.empty((len(rows), len(machine.joints)))
        for joint, values in columns.items():
            q[:, machine.column(joint)] = values
    else:
        q = machine.closure.solve(np.column_stack([columns[joint] for joint in machine.active]))
    for joint in machine.joints:
        if not np.isfinite(q[:, machine.column(joint)]).all():
            raise InputError(f"joint '{joint}' is not finite, check the recording")
    return q
