"""What a page shows in space: the machine's shapes and surroundings, its frames in time."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.formats.visuals.visuals import Visual
from crane.machine import Machine
from crane.view.page.drawing import Recorder, draw_surroundings, draw_visuals
from crane.view.page.motion import frame_rows, postures
from crane.view.page.visuals import read_visuals

if TYPE_CHECKING:
    from crane.recordings.recording import Recording

_LOOKED_AT = 300  # frames that tell how large the scene is
_FLAT = 1e-3  # share of a scene's size that each side has at least
_SMALLEST = 1e-3  # [m], of a scene in which everything is a point


@dataclass(frozen=True)
class Scene:
    """What a page shows in space.

    Attributes:
        commands: Commands of the meshcat viewer, in their order. Each link that has visuals is
            the group machine/<link>, its pose in the first frame that group's transform.
        rows: (N,) samples of the recording that are frames; one 0 for a still posture.
        time: (N,) their times [s].
        q: (N, nq) their postures.
        lower: (3,) lowest corner of what is drawn [m].
        upper: (3,) highest corner [m].
        ground: Height that the machine stands at [m].
        heading: Angle about z from the x axis to where the tip points in the first frame, seen
            from the first joint that moves it [rad]; 0 without a tip, or with one on that axis.
    """

    commands: Sequence[dict[str, Any]]
    rows: np.ndarray
    time: Array
    q: Array
    lower: Array
    upper: Array
    ground: float
    heading: float


def build_scene(
    machine: Machine, recording: "Recording | None" = None, share: float = 1.0
) -> Scene:
    """The machine in its home posture, or moving as recorded.

    Args:
        machine: The machine.
        recording: Its motion. Where it lacks the channel of a passive joint, the loops are closed
            at its active coordinates.
        share: See `frame_rows`.

    Raises:
        RecordingError: The recording is of a machine with other joints.
        ClosureError: The loops cannot be closed at a recorded sample.
        InputError: A posture is not finite.
    """
    import meshcat

    rows = np.zeros(1, dtype=int) if recording is None else frame_rows(recording.time, share)
    time = np.zeros(1) if recording is None else recording.time[rows]
    q = machine.home[None] if recording is None else postures(machine, recording, rows)
    visuals = read_visuals(machine)
    links = tuple(dict.fromkeys(visual.link for visual in visuals))
    some = np.unique(np.linspace(0, len(q) - 1, _LOOKED_AT).astype(int))
    poses = link_poses(machine, q[some], links)
    between = {link for item in machine.elements for link in item.between or ()}
    lower, upper = _bounds(visuals, poses, link_poses(machine, q[some], between))
    floor = ground(machine, visuals)
    lower[2], upper[2] = min(lower[2], floor), max(upper[2], floor)

    recorder = Recorder()
    viewer = meshcat.Visualizer(window=recorder)
    draw_surroundings(viewer["ground"], lower, upper, floor)
    draw_visuals(viewer["machine"], visuals)
    for link, pose in poses.items():
        viewer["machine"][link].set_transform(pose[0])
    return Scene(
        commands=recorder.commands,
        rows=rows,
        time=time,
        q=q,
        lower=lower,
        upper=upper,
        ground=floor,
        heading=_heading(machine, q[0], float(np.linalg.norm(upper - lower))),
    )


def link_poses(machine: Machine, q: Array, links: Iterable[str]) -> dict[str, Array]:
    """Poses (N, 4, 4) of some links in the world, at postures q (N, nq).

    Raises:
        InputError: A pose is not finite.
    """
    data = machine.model.createData()
    frames = {link: machine.frame(link) for link in links}
    poses = {link: np.empty((len(q), 4, 4)) for link in frames}
    for i, posture in enumerate(q):
        at = machine.coordinates.configuration(posture)
        pin.framesForwardKinematics(machine.model, data, at)
        for link, frame in frames.items():
            poses[link][i] = data.oMf[frame].homogeneous
    for link, pose in poses.items():
        if not np.isfinite(pose).all():
            raise InputError(f"link '{link}' has a pose that is not finite, check the recording")
    return poses


def ground(machine: Machine, visuals: Sequence[Visual]) -> float:
    """Height that the machine stands at [m]: the lowest point of what cannot move.

    The origin's height where nothing of what is drawn stands still: how low the tip reaches says
    nothing about the ground.
    """
    heights = [
        float((place.placement * corner)[2])
        for visual in visuals
        if not (place := machine.model.frames[machine.frame(visual.link)]).parentJoint
        for corner in visual.corners()
    ]
    return min(heights, default=0.0)


def _heading(machine: Machine, q: Array, size: float) -> float:
    if machine.tip is None:
        return 0.0
    data = machine.model.createData()
    pin.framesForwardKinematics(machine.model, data, machine.coordinates.configuration(q))
    frame = machine.frame(machine.tip)
    joints = machine.model.supports[machine.model.frames[frame].parentJoint]
    if len(joints) < 2:  # the tip stands still
        return 0.0
    x, y, _ = data.oMf[frame].translation - data.oMi[joints[1]].translation
    return float(np.arctan2(y, x)) if np.hypot(x, y) > 1e-3 * size else 0.0


def _bounds(
    visuals: Sequence[Visual], poses: Mapping[str, Array], ends: Mapping[str, Array]
) -> tuple[Array, Array]:
    """Lowest and highest corner of everything in all frames, ends of springs included."""
    points = [pose[:, :3, 3] for pose in ends.values()]
    for visual in visuals:
        pose, corners = poses[visual.link], visual.corners()
        moved = corners @ pose[:, :3, :3].transpose(0, 2, 1) + pose[:, None, :3, 3]
        points.append(moved.reshape(-1, 3))
    everything = np.concatenate(points)
    lower, upper = everything.min(axis=0), everything.max(axis=0)
    size = float((upper - lower).max())
    return lower, np.maximum(upper, lower + (_FLAT * size or _SMALLEST))
