"""Scene of a live view: shapes that move with their links."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from crane.common.samples import Array
from crane.formats.visuals.urdf_shapes import (
    BoxShape,
    CylinderShape,
    MeshShape,
    SphereShape,
    Visual,
)
from crane.view.live.live_session import Session
from crane.view.page.scene import (
    ground_height,
    link_poses,
    read_visuals,
    round_up_to_nice,
    scene_bounds,
)

_CAMERA_DIRECTION = np.array(
    [0.55, -1.0, 0.45]
)  # from the target to the camera, over the size of the scene
_FIELD_OF_VIEW = 40.0  # of view, upright [deg]
_FREE_HEIGHT_SHARE = 0.4  # share of a phone's height that viser's panel leaves free
_PAYLOAD_DENSITY = 1000.0  # density of the ball that stands for the payload [kg/m3]
_PAYLOAD_COLOUR = (224, 112, 26)


class LiveScene:
    """Shapes of a machine on a viser server.

    Args:
        server: The server.
        session: Session that is shown.
    """

    def __init__(self, server: Any, session: Session):
        self._server, self._session = server, session
        visuals = read_visuals(session.machine)
        self._links = list(dict.fromkeys(visual.link for visual in visuals))
        self._frames = [
            server.scene.add_frame(f"/machine/{link}", show_axes=False) for link in self._links
        ]
        for index, visual in enumerate(visuals):
            _add_shape(server.scene, f"/machine/{visual.link}/{index}", visual)
        if session.machine.tip is not None:
            self._links.append(session.machine.tip)
            self._frames.append(server.scene.add_frame("/tip", show_axes=False))
        self._set_view(*_motion_bounds(visuals, session), ground_height(session.machine, visuals))
        self.update_poses()

    def update_poses(self) -> None:
        """Update the poses of all links from the session."""
        q = self._session.readout.configuration[None]
        poses = link_poses(self._session.machine, q, self._links)
        for frame, (pose,) in zip(self._frames, poses.values(), strict=True):
            x, y, z, w = pin.Quaternion(pose[:3, :3]).coeffs()
            frame.position = pose[:3, 3]
            frame.wxyz = np.array([w, x, y, z])

    def show_payload(self) -> None:
        """Draw the payload as a sphere of water at the tip."""
        volume = self._session.payload_mass / _PAYLOAD_DENSITY
        self._server.scene.add_icosphere(
            "/tip/payload",
            radius=max(float(np.cbrt(0.75 * volume / np.pi)), 1e-6),
            color=_PAYLOAD_COLOUR,
            opacity=0.8,
            visible=volume > 0,
        )

    def add_path(self, points: Array) -> None:
        """Draw a line through points (N, 3) [m]."""
        if len(points) > 1:
            self._server.scene.add_line_segments(
                "/path",
                np.stack([points[:-1], points[1:]], axis=1).astype(np.float32),
                _PAYLOAD_COLOUR,
                thickness=2.0,
                thickness_units="screen",
            )

    def _set_view(self, lower: Array, upper: Array, ground_height: float) -> None:
        """Add a grid at the ground height [m], and set the camera."""
        scene, camera = self._server.scene, self._server.initial_camera
        self._scene_size = size = float(np.linalg.norm(upper - lower))
        self._scene_centre = centre = (lower + upper) / 2
        cell_size = round_up_to_nice(size / 12)
        scene.add_grid(
            "/ground",
            width=4 * size,
            height=4 * size,
            cell_size=cell_size,
            section_size=10 * cell_size,
            cell_color=(215, 218, 222),
            section_color=(185, 190, 196),
            position=(centre[0], centre[1], ground_height),
        )
        scene.set_background_image(np.full((2, 2, 3), 247, dtype=np.uint8))
        camera.fov = np.radians(_FIELD_OF_VIEW)
        camera.near, camera.far = size / 1000, 100 * size
        camera.look_at, camera.position = self.camera_view()

    def camera_view(self, aspect: float = 1.0) -> tuple[Array, Array]:
        """Return target and position of a camera that shows the whole machine [m].

        In a portrait window, such as a phone's, the panel covers the lower part; the machine is
        shown above it.

        Args:
            aspect: Width of the window over its height.
        """
        direction = _CAMERA_DIRECTION / np.linalg.norm(_CAMERA_DIRECTION)
        half_tangent = float(np.tan(np.radians(_FIELD_OF_VIEW / 2)))
        if aspect >= 1:
            return (
                self._scene_centre,
                self._scene_centre + 0.5 * self._scene_size / half_tangent * direction,
            )
        distance = 0.5 * self._scene_size / (half_tangent * min(aspect, _FREE_HEIGHT_SHARE))
        up = np.array([0.0, 0.0, 1.0]) - direction[2] * direction
        centre = self._scene_centre - (
            1 - _FREE_HEIGHT_SHARE
        ) * half_tangent * distance * up / np.linalg.norm(up)
        return centre, centre + distance * direction


def _add_shape(scene: Any, name: str, visual: Visual) -> None:
    x, y, z, w = pin.Quaternion(np.array(visual.placement[:3, :3])).coeffs()
    red, green, blue, opacity = (min(max(value, 0.0), 1.0) for value in visual.colour)
    appearance: dict[str, Any] = {
        "color": (round(255 * red), round(255 * green), round(255 * blue)),
        "opacity": None if opacity == 1 else opacity,
        "position": visual.placement[:3, 3],
        "wxyz": np.array([w, x, y, z]),
    }
    match visual.shape:
        case BoxShape(size):
            scene.add_box(name, dimensions=size, **appearance)
        case CylinderShape(radius, length):
            scene.add_cylinder(name, radius=radius, height=length, **appearance)
        case SphereShape(radius):
            scene.add_icosphere(name, radius=radius, **appearance)
        case MeshShape(vertices, faces):
            scene.add_mesh_simple(
                name,
                vertices.astype(np.float32),
                faces,
                flat_shading=True,
                side="double",
                **appearance,
            )


def _motion_bounds(visuals: Sequence[Visual], session: Session) -> tuple[Array, Array]:
    """Return the corners (3,) of the space that is reached from home by single joints.

    Joints with a range of half a turn or more stay at home, because the space would be too large.
    """
    machine, home_readout = session.machine, session.readout
    configurations = [home_readout.configuration]
    for joint, lower, upper in zip(machine.active, session.lower, session.upper, strict=True):
        is_full_swing = machine.unit(joint) == "rad" and upper - lower >= np.pi
        for value in () if is_full_swing else (lower, upper):
            configurations.append(session.move(joint, value).configuration)
            session.readout = home_readout
    links = {visual.link for visual in visuals}
    return scene_bounds(visuals, link_poses(machine, np.array(configurations), links), {})
