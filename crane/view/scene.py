"""What a page shows: a machine in its home posture, or moving as recorded."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from crane.errors import InputError, RecordingError, known
from crane.machine import Machine
from crane.samples import Array
from crane.view.drawing import Recorder, animate, draw_line, draw_surroundings, draw_visuals
from crane.view.visuals import Visual, read_visuals

if TYPE_CHECKING:
    from crane.recording import Recording

FPS = 30.0
TRACES = {"tip": 0xD02020, "reference": 0x2050D0}  # lines and their colours


@dataclass(frozen=True)
class Scene:
    """What a page shows.

    Attributes:
        commands: Commands of the meshcat viewer, in their order. Each link that has visuals is
            the group machine/<link>, its pose that group's transform; lines are trace/<name>.
        start: Time of the first frame [s].
        duration: Time from the first frame to the last [s]; 0 for a still posture.
        lower: (3,) lowest corner of everything that is drawn in any frame [m].
        upper: (3,) highest corner [m].
        traces: Names of the lines that are drawn, among `TRACES`.
        heading: Angle about z from the x axis to where the tip points in the first frame, seen
            from the first joint that moves it [rad]; 0 without a tip, or with one on that axis.
    """

    commands: Sequence[dict[str, Any]]
    start: float
    duration: float
    lower: Array
    upper: Array
    traces: tuple[str, ...]
    heading: float


def build_scene(machine: Machine, recording: "Recording | None" = None) -> Scene:
    """The machine in its home posture, or moving as recorded.

    Args:
        machine: The machine.
        recording: Its motion. Where it lacks the channel of a passive joint, the loops are closed
            at its active coordinates.

    Raises:
        RecordingError: The recording lacks an active joint of the machine.
        ClosureError: The loops cannot be closed at a recorded sample.
        InputError: A posture is not finite.
    """
    import meshcat

    rows = np.zeros(1, dtype=int) if recording is None else decimate(recording.time, FPS)
    time = np.zeros(1) if recording is None else recording.time[rows]
    q = machine.home[None] if recording is None else postures(machine, recording, rows)
    visuals = read_visuals(machine)
    poses = link_poses(machine, q, list(dict.fromkeys(visual.link for visual in visuals)))
    lines = {} if recording is None else _lines(machine, recording, rows, q)
    lower, upper = _bounds(visuals, poses, list(lines.values()))

    recorder = Recorder()
    viewer = meshcat.Visualizer(window=recorder)
    draw_surroundings(viewer["ground"], lower, upper)
    draw_visuals(viewer["machine"], visuals)
    for link, pose in poses.items():
        viewer["machine"][link].set_transform(pose[0])
    for name, points in lines.items():
        draw_line(viewer["trace"][name], points, TRACES[name])
    if len(time) > 1:
        animate(viewer["machine"], poses, time - time[0])
    return Scene(
        commands=recorder.commands,
        start=float(time[0]),
        duration=float(time[-1] - time[0]),
        lower=lower,
        upper=upper,
        traces=tuple(lines),
        heading=_heading(machine, q[0], float(np.linalg.norm(upper - lower))),
    )


def decimate(time: Array, fps: float) -> np.ndarray:
    """Rows of the samples nearest to the frames of a film, the first and the last among them.

    Args:
        time: (N,) increasing [s].
        fps: Frames per second.
    """
    wanted = np.arange(time[0], time[-1], 1 / fps)
    nearest = np.searchsorted((time[1:] + time[:-1]) / 2, wanted)
    return np.unique(np.append(nearest, len(time) - 1))


def postures(machine: Machine, recording: "Recording", rows: np.ndarray) -> Array:
    """(len(rows), nq) closed postures of some samples of a recording.

    Raises:
        RecordingError: An active joint is missing.
        ClosureError: The loops cannot be closed.
    """
    columns = {joint: recording.q[rows, i] for i, joint in enumerate(recording.joints)}
    for joint in machine.active:
        if joint not in columns:
            raise RecordingError(
                f"the recording has no joint '{joint}', which drives {machine.name}, "
                f"{known(columns, joint)}"
            )
    if not all(joint in columns or joint in recording.channels for joint in machine.joints):
        q_a = np.column_stack([columns[joint] for joint in machine.active])
        return machine.closure.solve(q_a)
    q = np.empty((len(rows), machine.model.nq))
    for joint in machine.joints:
        column = columns[joint] if joint in columns else recording.channels[joint][rows]
        q[:, machine.column(joint)] = column
    return q


def link_poses(machine: Machine, q: Array, links: Sequence[str]) -> dict[str, Array]:
    """Poses (N, 4, 4) of some links in the world, at postures q (N, nq).

    Raises:
        InputError: A pose is not finite.
    """
    data = machine.model.createData()
    frames = {link: machine.frame(link) for link in links}
    poses = {link: np.empty((len(q), 4, 4)) for link in links}
    for i, posture in enumerate(q):
        pin.framesForwardKinematics(machine.model, data, posture)
        for link, frame in frames.items():
            poses[link][i] = data.oMf[frame].homogeneous
    for link, pose in poses.items():
        if not np.isfinite(pose).all():
            raise InputError(f"link '{link}' has a pose that is not finite, check the recording")
    return poses


def _lines(
    machine: Machine, recording: "Recording", rows: np.ndarray, q: Array
) -> dict[str, Array]:
    """Points (N, 3) where the tip should go, and where it goes."""
    lines = {}
    names = [f"reference_tip_{axis}" for axis in "xyz"]
    if all(name in recording.channels for name in names):
        lines["reference"] = np.column_stack([recording.channels[name][rows] for name in names])
    if machine.tip is not None:
        lines["tip"] = link_poses(machine, q, [machine.tip])[machine.tip][:, :3, 3]
    return lines


def _heading(machine: Machine, q: Array, size: float) -> float:
    if machine.tip is None:
        return 0.0
    data = machine.model.createData()
    pin.framesForwardKinematics(machine.model, data, q)
    frame = machine.frame(machine.tip)
    joints = machine.model.supports[machine.model.frames[frame].parentJoint]
    if len(joints) < 2:  # the tip stands still
        return 0.0
    x, y, _ = data.oMf[frame].translation - data.oMi[joints[1]].translation
    return float(np.arctan2(y, x)) if np.hypot(x, y) > 1e-3 * size else 0.0


def _bounds(
    visuals: Sequence[Visual], poses: Mapping[str, Array], lines: Sequence[Array]
) -> tuple[Array, Array]:
    """Lowest and highest corner of everything in all frames."""
    points = list(lines)
    for visual in visuals:
        pose, corners = poses[visual.link], visual.corners()
        moved = corners @ pose[:, :3, :3].transpose(0, 2, 1) + pose[:, None, :3, 3]
        points.append(moved.reshape(-1, 3))
    everything = np.concatenate(points)
    return everything.min(axis=0), everything.max(axis=0)
