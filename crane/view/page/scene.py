"""Scene of a page: visuals of a machine, surroundings and frames as meshcat commands."""

import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin

from crane.common.errors import CraneWarning, InputError
from crane.common.samples import Array
from crane.formats.robot_files import open_robots
from crane.formats.visuals.urdf_shapes import (
    DEFAULT_COLOUR,
    BoxShape,
    CylinderShape,
    MeshShape,
    SphereShape,
    UrdfShapes,
    Visual,
)
from crane.machine.machine import Machine
from crane.recordings.recording import Recording
from crane.view.page.page_motion import frame_rows, recorded_configurations

_TOP_COLOUR, _BOTTOM_COLOUR, _GRID_COLOUR = [0.80, 0.87, 0.93], [0.97, 0.97, 0.95], 0xB4BAC0
_IDENTIFIED_PARTS = ("geometry", "material", "map", "image")  # that meshcat identifies, too
_CYLINDER_ROTATION = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


@dataclass
class CommandRecorder:
    """Replacement of meshcat's window that records commands, without server and port.

    Meshcat's identifiers depend on time and computer. Here they are numbers in the order of the
    commands, so that equal runs give equal pages.
    """

    commands: list[dict[str, Any]] = field(default_factory=list)
    _object_count: int = 0

    def send(self, command: Any) -> None:
        """Record a command."""
        if hasattr(command, "object"):
            self._assign_identifier(command.object)
        self.commands.append(command.lower())

    def _assign_identifier(self, element: Any) -> None:
        """Number a meshcat object and its parts."""
        element.uuid, self._object_count = str(self._object_count), self._object_count + 1
        for part in filter(None, map(vars(element).get, _IDENTIFIED_PARTS)):
            self._assign_identifier(part)


def draw_visuals(viewer: Any, visuals: Sequence[Visual]) -> None:
    """Add the visuals of each link to the group of the link."""
    import meshcat.geometry as g

    for index, visual in enumerate(visuals):
        red, green, blue, opacity = (min(max(value, 0.0), 1.0) for value in visual.colour)
        placement = visual.placement
        match visual.shape:
            case BoxShape(size):
                geometry = g.Box(list(size))
            case CylinderShape(radius, length):
                geometry = g.Cylinder(length, radius)
                placement = placement @ _CYLINDER_ROTATION  # meshcat's cylinder lies along y
            case SphereShape(radius):
                geometry = g.Sphere(radius)
            case MeshShape(vertices, faces):
                geometry = g.TriangularMeshGeometry(vertices, faces)
        shape = viewer[visual.link][f"visual_{index}"]
        shape.set_object(
            geometry,
            g.MeshPhongMaterial(
                color=(round(255 * red) << 16) + (round(255 * green) << 8) + round(255 * blue),
                opacity=opacity,
            ),
        )
        shape.set_transform(placement)


def draw_surroundings(viewer: Any, lower: Array, upper: Array, ground_height: float) -> None:
    """Add background and a ground grid with round spacing around a box (3,), (3,) [m]."""
    import meshcat.geometry as g

    viewer["/Background"].set_property("top_color", _TOP_COLOUR)
    viewer["/Background"].set_property("bottom_color", _BOTTOM_COLOUR)
    viewer["/Grid"].set_property("visible", False)
    viewer["/Axes"].set_property("visible", False)
    size = float(np.linalg.norm(upper - lower))
    spacing = round_up_to_nice(size / 12)
    count = int(np.ceil(size / spacing))
    end = count * spacing
    ticks = np.arange(-count, count + 1) * spacing
    line_ends = np.array([[(x, -end), (x, end)] for x in ticks]).reshape(-1, 2)
    centre = np.round((lower + upper)[:2] / 2 / spacing) * spacing
    points = np.full((2 * len(line_ends), 3), ground_height)
    points[:, :2] = np.concatenate([line_ends, line_ends[:, ::-1]]) + centre
    geometry = g.PointsGeometry(np.ascontiguousarray(points.T, dtype=np.float32))
    viewer.set_object(g.LineSegments(geometry, g.LineBasicMaterial(color=_GRID_COLOUR)))


def round_up_to_nice(value: float) -> float:
    """Round a positive value up to 1, 2 or 5 times a power of ten."""
    power_of_ten = 10.0 ** np.floor(np.log10(value))
    return float(
        next(x for x in (1, 2, 5, 10) if x * power_of_ten >= value * (1 - 1e-9)) * power_of_ten
    )


_SAMPLED_FRAMES = 300  # frames that determine the size of the scene
_MIN_SIDE_SHARE = 1e-3  # share of a scene's size that each side has at least
_MIN_SIZE = 1e-3  # [m], of a scene in which everything is a point


@dataclass(frozen=True)
class Scene:
    """Three-dimensional content of a page.

    Attributes:
        commands: Commands of the meshcat viewer, in order. Each link with visuals is a group
            machine/<link>, whose transform is the pose in the first frame.
        frame_rows: (N,) rows of the recording that are frames; one 0 without a recording.
        time: (N,) times of the frames [s].
        configurations: (N, nq) configurations of the frames.
        lower: (3,) lower corner of the scene [m].
        upper: (3,) upper corner of the scene [m].
        ground_height: Height of the ground [m].
        heading: Angle about z from the x axis to the tip in the first frame, seen from the first
            joint that moves it [rad]; 0 without a tip.
    """

    commands: Sequence[dict[str, Any]]
    frame_rows: np.ndarray
    time: Array
    configurations: Array
    lower: Array
    upper: Array
    ground_height: float
    heading: float


def build_scene(
    machine: Machine, recording: Recording | None = None, frame_share: float = 1.0
) -> Scene:
    """Build the scene of a machine at home, or of a recorded run.

    Args:
        machine: The machine.
        recording: Recording of its run. If the channel of a passive joint is missing, the loops
            are closed at the active coordinates.
        frame_share: See `frame_rows`.

    Raises:
        RecordingError: The recording is of a machine with other joints.
        ClosureError: The loops cannot be closed at a recorded sample.
        InputError: A configuration is not finite.
    """
    import meshcat

    sample_rows = (
        np.zeros(1, dtype=int) if recording is None else frame_rows(recording.time, frame_share)
    )
    configurations = (
        machine.home[None]
        if recording is None
        else recorded_configurations(machine, recording, sample_rows)
    )
    visuals = read_visuals(machine)
    sampled_rows = np.unique(np.linspace(0, len(configurations) - 1, _SAMPLED_FRAMES).astype(int))
    poses = link_poses(
        machine,
        configurations[sampled_rows],
        tuple(dict.fromkeys(visual.link for visual in visuals)),
    )
    element_links = {link for item in machine.force_elements for link in item.between or ()}
    ends = link_poses(machine, configurations[sampled_rows], element_links)
    lower, upper = scene_bounds(visuals, poses, ends)
    floor_height = ground_height(machine, visuals)
    lower[2], upper[2] = min(lower[2], floor_height), max(upper[2], floor_height)

    recorder = CommandRecorder()
    viewer = meshcat.Visualizer(window=recorder)
    draw_surroundings(viewer["ground"], lower, upper, floor_height)
    draw_visuals(viewer["machine"], visuals)
    for link, pose in poses.items():
        viewer["machine"][link].set_transform(pose[0])
    return Scene(
        commands=recorder.commands,
        frame_rows=sample_rows,
        time=np.zeros(1) if recording is None else recording.time[sample_rows],
        configurations=configurations,
        lower=lower,
        upper=upper,
        ground_height=floor_height,
        heading=_tip_heading(machine, configurations[0], float(np.linalg.norm(upper - lower))),
    )


def link_poses(machine: Machine, q: Array, links: Iterable[str]) -> dict[str, Array]:
    """Return the poses (N, 4, 4) of some links in the world, at configurations q (N, nq).

    Raises:
        InputError: A pose is not finite.
    """
    data = machine.model.createData()
    frames = {link: machine.frame(link) for link in links}
    poses = {link: np.empty((len(q), 4, 4)) for link in frames}
    for i, configuration in enumerate(q):
        pin.framesForwardKinematics(
            machine.model, data, machine.coordinates.configuration(configuration)
        )
        for link, frame in frames.items():
            poses[link][i] = data.oMf[frame].homogeneous
    for link, pose in poses.items():
        if not np.isfinite(pose).all():
            raise InputError(f"link '{link}' has a pose that is not finite, check the recording")
    return poses


def ground_height(machine: Machine, visuals: Sequence[Visual]) -> float:
    """Return the height of the ground [m]: the lowest point of fixed visuals.

    Without fixed visuals this is the height of the origin, because the reach of the tip does not
    determine the ground.
    """
    return min(
        [
            float((frame.placement * corner)[2])
            for visual in visuals
            if not (frame := machine.model.frames[machine.frame(visual.link)]).parentJoint
            for corner in visual.bounding_corners()
        ],
        default=0.0,
    )


def _tip_heading(machine: Machine, q: Array, size: float) -> float:
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


def shape_corners(visuals: Sequence[Visual], poses: Mapping[str, Array]) -> Array:
    """Return the corners (k, 3) of boxes around all shapes, at poses (N, 4, 4) of their links."""
    points = []
    for visual in visuals:
        pose, corners = poses[visual.link], visual.bounding_corners()
        world_corners = corners @ pose[:, :3, :3].transpose(0, 2, 1) + pose[:, None, :3, 3]
        points.append(world_corners.reshape(-1, 3))
    return np.concatenate(points)


def scene_bounds(
    visuals: Sequence[Visual], poses: Mapping[str, Array], further_poses: Mapping[str, Array]
) -> tuple[Array, Array]:
    """Return the corners of the bounding box of shapes, and of origins of further links."""
    origins = [pose[:, :3, 3] for pose in further_poses.values()]
    all_points = np.concatenate([shape_corners(visuals, poses), *origins])
    lower, upper = all_points.min(axis=0), all_points.max(axis=0)
    return lower, np.maximum(
        upper, lower + (_MIN_SIDE_SHARE * float((upper - lower).max()) or _MIN_SIZE)
    )


# Longest stroke that is drawn as a rod, in largest distances on one body.
_MAX_ROD_STROKE_RATIO = 3.0


def read_visuals(machine: Machine) -> list[Visual]:
    """Return the visuals of every link, and a skeleton of bodies with mass that have none.

    Without any visuals, all bodies are drawn as a skeleton. A mesh with a missing or damaged file
    is drawn as a box, and shapes that cannot be drawn are left out, with a warning; if only boxes
    remain, the skeleton is added. Sliding bodies without visuals are drawn as rods or blocks.
    """
    visuals: list[Visual] = []
    missing_meshes: list[str] = []
    problems: list[str] = []
    model = machine.model
    distance = max(float(np.linalg.norm(x.translation)) for x in model.jointPlacements)
    box = BoxShape((0.15 * (distance or 1.0),) * 3)
    with open_robots(machine) as sources:
        for xml in sources:
            drawn_visuals = UrdfShapes(xml, replacement=box)
            visuals += drawn_visuals.shapes["visual"]
            missing_meshes += drawn_visuals.missing_meshes
            problems += drawn_visuals.problems
    if missing_meshes:
        warnings.warn(
            f"{machine.name}: {len(missing_meshes)} mesh files are not there and are drawn as "
            f"boxes ({missing_meshes[0]}), install the package that has them",
            CraneWarning,
            stacklevel=2,
        )
    if problems:
        more_text = f" ({len(problems)} such, crane check lists them)" if len(problems) > 1 else ""
        warnings.warn(f"{problems[0]}{more_text}", CraneWarning, stacklevel=2)
    shown_joints = {model.frames[machine.frame(x.link)].parentJoint for x in visuals}
    bodies: set[int] | None = None
    if not all(visual.shape is box for visual in visuals):
        long = {joint for joint, end, _ in _body_points(machine) if joint and end.any()}
        bodies = {joint for joint in long - shown_joints if model.inertias[joint].mass}
    visuals += skeleton_visuals(machine, bodies)
    return visuals + sliding_body_visuals(machine, shown_joints)


def _body_points(machine: Machine) -> list[tuple[int, Array, str]]:
    """Return parent joint, position (3,) [m] and name of all frames and joints on bodies."""
    model = machine.model
    frames = [
        (frame.parentJoint, frame.placement.translation, frame.name)
        for frame in model.frames
        if frame.type == pin.FrameType.BODY
    ]
    return (
        frames
        + [
            (parent, x.translation, name)
            for parent, x, name in zip(
                model.parents, model.jointPlacements, model.names, strict=True
            )
        ][1:]
    )


def largest_body_extent(machine: Machine) -> float:
    """Return the largest distance from a joint to a frame of its body [m]; 1 if all are 0."""
    return max(float(np.linalg.norm(end)) for _, end, _ in _body_points(machine)) or 1.0


def _first_links(machine: Machine) -> dict[int, str]:
    """Return the first link of each body, by joint."""
    links: dict[int, str] = {}
    for frame in machine.model.frames:
        if frame.type == pin.FrameType.BODY:
            links.setdefault(frame.parentJoint, frame.name)
    return links


def sliding_body_visuals(machine: Machine, drawn_joints: Collection[int]) -> list[Visual]:
    """Return rods and blocks for sliding bodies with mass that have no visuals.

    A body on a moving body is a rod as long as the stroke, whose end is in the mouth of the barrel
    when extended; a body on the ground, or with a long stroke, is a block.
    """
    model, links, size = machine.model, _first_links(machine), largest_body_extent(machine)
    width, limits = 0.11 * size, machine.coordinates
    visuals = []
    for joint in range(1, model.njoints):
        column = model.joints[joint].idx_v
        is_prismatic = model.joints[joint].nv == 1 and limits.is_translation[column]
        if not is_prismatic or joint in drawn_joints or not model.inertias[joint].mass:
            continue
        axis = np.ravel(model.joints[joint].createData().S)[:3]
        stroke = float(limits.upper[column] - limits.lower[column])
        is_rod = bool(model.parents[joint]) and stroke < _MAX_ROD_STROKE_RATIO * size
        rotation = pin.Quaternion.FromTwoVectors(pin.ZAxis if is_rod else pin.XAxis, axis)
        link_placement = model.frames[machine.frame(links[joint])].placement.inverse() * pin.SE3(
            rotation, -0.5 * stroke * axis if is_rod else np.zeros(3)
        )
        visuals.append(
            Visual(
                links[joint],
                CylinderShape(0.2 * width, stroke)
                if is_rod
                else BoxShape((1.5 * width, width, width)),
                link_placement.homogeneous,
                DEFAULT_COLOUR,
            )
        )
    return visuals


def skeleton_visuals(machine: Machine, bodies: Collection[int] | None = None) -> list[Visual]:
    """Return bars from each joint to the joints and frames of its body.

    Ends of springs on the ground are drawn as spheres only; a bar would hide the springs.

    Args:
        machine: The machine.
        bodies: Joints of the bodies to draw; by default all, and the ground.
    """
    model, links = machine.model, _first_links(machine)
    radius = 0.03 * largest_body_extent(machine)
    element_links = {link for item in machine.force_elements for link in item.between or ()}
    visuals = []
    for body, point, name in _body_points(machine):
        if bodies is not None and body not in bodies:
            continue
        link_placement = model.frames[machine.frame(links[body])].placement.inverse()
        shapes: list[tuple[Any, pin.SE3]] = [
            (SphereShape(1.5 * radius), pin.SE3(np.eye(3), point))
        ]
        length = float(np.linalg.norm(point))
        if length and (body or name not in element_links):
            shapes.append(
                (
                    CylinderShape(radius, length),
                    pin.SE3(pin.Quaternion.FromTwoVectors(pin.ZAxis, point), point / 2),
                )
            )
        for shape, placement in shapes:
            visuals.append(
                Visual(
                    links[body], shape, (link_placement * placement).homogeneous, DEFAULT_COLOUR
                )
            )
    return visuals
