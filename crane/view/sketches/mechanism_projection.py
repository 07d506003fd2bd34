"""Projection of a machine onto a plane: its mechanism and its outline."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from crane.common.samples import Array
from crane.machine.machine import Machine
from crane.motion.workspaces.workspace_section import WorkspaceSection
from crane.ratings.rating_rules import rotate_about_axis, slew_angles
from crane.view.sketches.sketch_canvas import convex_hull
from crane.view.sketches.sketch_elements import (
    DrawingPlane,
    SketchBody,
    SketchCollar,
    SketchMechanism,
    SketchPin,
    SketchSlide,
    joint_axes,
)

COINCIDENCE_TOLERANCE = 1e-9  # share of the drawing's size between coincident points
_COLLAR_DISTANCE_SHARE = (
    0.04  # share of the drawing's size within which a collar would hide beside a pin
)
_BARREL_LENGTH_SHARE = 0.82  # length of a barrel, as a share of the cylinder's shortest length
_MIN_PIN_COSINE = 0.7  # cosine to the plane's normal above which an axis is drawn as a pin


def project_mechanism(machine: Machine, q: Array, plane: DrawingPlane) -> SketchMechanism:
    """Project the mechanism of a machine in a closed configuration q (nq,) onto a plane."""
    return _MechanismProjection(machine, q, plane).mechanism()


class _MechanismProjection:
    """Projection of a machine in one configuration."""

    def __init__(self, machine: Machine, q: Array, plane: DrawingPlane):
        self.machine, self.plane, self.q = machine, plane, q
        model = self.model = machine.model
        data = self.data = model.createData()
        pin.framesForwardKinematics(model, data, machine.coordinates.configuration(q))
        self.origins = np.array([plane.project(placement.translation) for placement in data.oMi])
        axes = joint_axes(machine, data)
        self.axes, self.axis_cosines = plane.project(axes), np.abs(axes @ plane.normal)
        self.axis_cosines[[joint.nv > 1 for joint in model.joints]] = 1.0  # ball joints
        self.parents = [int(parent) for parent in model.parents]
        names = [machine.joints[joint.idx_v] for joint in list(model.joints)[1:]]
        self.turns = [False] + [machine.unit(name) == "rad" for name in names]
        self.chains = [-1] + [
            {x: i for i, chain in enumerate(machine.chains) for x in chain.joints}.get(name, 0)
            for name in names
        ]
        self.tip_body, self.tip = 0, None
        if machine.tip is not None:
            frame = model.frames[machine.frame(machine.tip)]
            self.tip_body = frame.parentJoint
            self.tip = self._project_placement(self.tip_body, frame.placement)
        self.tip_supports = set(model.supports[self.tip_body])
        self.loop_frames = [
            (int(joint), self._project_placement(joint, place))
            for joint, place in machine.closure.equations.frames
        ]
        self.outer = self._find_outer_points()
        everything = np.concatenate(
            [np.array(body_points) for body_points in self.outer if body_points]
        )
        self.size = float(np.ptp(everything, axis=0).max()) or 1.0
        self.points: list[list[Array]] = [[] for _ in self.parents]

    def mechanism(self) -> SketchMechanism:
        pins, collars = self._pins_and_collars()
        for index, (joint, position) in enumerate(self.loop_frames):
            self.points[joint].append(position)
            if index % 2:
                pins.append(
                    SketchPin(
                        self.machine.closure.equations.loops[index // 2].name,
                        self.loop_frames[index - 1][1],
                        position,
                        index // 2 + 1,
                    )
                )
        if self.tip is not None:
            self.points[self.tip_body].append(self.tip)
        joints = range(1, len(self.parents))
        slides = [self._create_slide(i) for i in joints if not self.turns[i]]
        bodies = [
            SketchBody(
                _distinct_points(self.points[i], self.size),
                self.chains[i],
                i in self.tip_supports,
                self.plane.project(self.data.oMi[i].act(self.model.inertias[i].lever)),
            )
            for i in joints
        ]
        ground = [
            (at, np.array([0.0, -1.0])) for at in _distinct_points(self.points[0], self.size)
        ]
        if collars and self._has_base():
            base_point, collar = self.outer[0][0], collars[0]
            ground = [item for item in ground if np.abs(item[0] - collar.position).max() > 0]
            position = self.origins[1]
            farthest = max(
                self.outer[1], key=lambda x: float(np.abs(x - position).max()), default=position
            )
            direction = -np.sign(collar.axis @ (farthest - base_point) or 1.0)
            ground.append((base_point, direction * collar.axis))
            if len(base_line := _distinct_points([base_point, collar.position], self.size)) > 1:
                bodies.append(SketchBody(base_line, -1, False, base_point))
        return SketchMechanism(
            pins,
            collars,
            slides,
            bodies,
            ground,
            self._regions(),
            self.tip,
            self.size,
        )

    def _project_placement(self, joint: int, placement: pin.SE3) -> Array:
        return self.plane.project((self.data.oMi[joint] * placement).translation)

    def _find_outer_points(self) -> list[list[Array]]:
        """Return the points of each body at which others are attached: joints, loops, tip."""
        outer_points: list[list[Array]] = [[] for _ in self.parents]
        outer_points[0].append(
            self.plane.project(np.zeros(3)) if self._has_base() else self.origins[1]
        )
        for joint, parent in enumerate(self.parents[1:], start=1):
            if self.turns[joint]:
                outer_points[parent].append(self.origins[joint])
        for joint, position in self.loop_frames:
            outer_points[joint].append(position)
        if self.tip is not None:
            outer_points[self.tip_body].append(self.tip)
        return outer_points

    def _has_base(self) -> bool:
        """Return whether the first joint axis goes through the world's origin."""
        first, axis = self.origins[1], self.axes[1]
        tolerance = COINCIDENCE_TOLERANCE * self.machine.closure.characteristic_length
        return bool(
            self.axis_cosines[1] < _MIN_PIN_COSINE
            and np.linalg.norm(first - (first @ axis) * axis) < tolerance
        )

    def _pins_and_collars(self) -> tuple[list[SketchPin], list[SketchCollar]]:
        pins, collars = [], []
        for joint in range(1, len(self.parents)):
            if not self.turns[joint]:
                continue
            name, position = self.model.names[joint], self.origins[joint]
            if self.axis_cosines[joint] >= _MIN_PIN_COSINE:
                pins.append(SketchPin(name, position, position))
            else:
                axis = self.axes[joint] / np.linalg.norm(self.axes[joint])
                position = self._collar_position(joint, axis)
                collars.append(SketchCollar(name, position, axis))
            self.points[self.parents[joint]].append(position)
            self.points[joint].append(position)
        return pins, collars

    def _collar_position(self, joint: int, axis: Array) -> Array:
        """Return the origin of a joint, or the middle of its axis if a pin would hide it."""
        position, parent = self.origins[joint], self.parents[joint]
        pins = [*self.outer[joint], *([self.origins[parent]] if parent else [])]
        previous_origin = self.origins[parent] if parent else self.outer[0][0]
        length = max(
            [float((point - previous_origin) @ axis) for point in self.outer[joint]],
            key=abs,
            default=0.0,
        )
        min_distance = _COLLAR_DISTANCE_SHARE * self.size
        if (
            (parent == 0 and not (joint == 1 and self._has_base()))
            or abs(length) < min_distance
            or all(np.linalg.norm(point - position) > min_distance for point in pins)
        ):
            return position
        return position + (float((previous_origin - position) @ axis) + length / 2) * axis

    def _create_slide(self, joint: int) -> SketchSlide:
        """Return a prismatic joint between its parent's origin and the far end of its body."""
        parent, position = self.parents[joint], self.origins[joint]
        axis = self.axes[joint] / max(float(np.linalg.norm(self.axes[joint])), 1e-9)
        outer = self.outer[joint] or [position]
        column = self.model.joints[joint].idx_v
        lower = float(self.machine.coordinates.lower[column])
        upper = float(self.machine.coordinates.upper[column])
        value = float(self.q[column])
        chains = (self.chains[parent], self.chains[joint])
        carries_tip, name = joint in self.tip_supports, self.model.names[joint]
        if self.axis_cosines[joint] > _MIN_PIN_COSINE:  # it moves towards the viewer
            self.points[parent].append(position)
            self.points[joint].append(position)
            return SketchSlide(
                name, position, position, position, position, *chains, carries_tip, is_rail=False
            )
        if parent == 0:
            rail_half_length = 0.15 * self.size
            offsets = (
                [lower - value, upper - value]
                if np.isfinite(upper - lower)
                else [-rail_half_length, rail_half_length]
            )
            start, mouth = (position + offset * axis for offset in offsets)
            self.points[joint] += [position]
            return SketchSlide(
                name,
                start,
                mouth,
                position,
                position,
                chains[1],
                chains[1],
                carries_tip,
                is_rail=True,
            )
        inner_coordinate = float((self.origins[parent] - position) @ axis)
        end = max(
            (float((x - position) @ axis) for x in outer), key=lambda s: abs(s - inner_coordinate)
        )
        sign, length = (1.0 if end >= inner_coordinate else -1.0), abs(end - inner_coordinate)
        offsets = [sign * (limit - value) for limit in (lower, upper) if np.isfinite(limit)]
        min_length = length + min(offsets) if offsets else 0.6 * length
        barrel = (
            _BARREL_LENGTH_SHARE * min_length
            if min_length > 0.25 * (length + max(offsets) if offsets else 1.4 * length)
            else 0.5 * length
        )
        inner_length = max(length - 0.9 * min_length, 0.0) + 0.05 * barrel
        inner_length = min(inner_length, 0.94 * barrel)
        start = position + inner_coordinate * axis
        self.points[parent].append(start)
        self.points[joint].append(position + end * axis)
        return SketchSlide(
            name,
            start,
            start + sign * barrel * axis,
            start + sign * inner_length * axis,
            position + end * axis,
            *chains,
            carries_tip,
            is_rail=False,
        )

    def _regions(self) -> dict[int, Array]:
        """Return the corners that each loop encloses: its pin and those of both branches."""
        regions = {}
        supports = self.model.supports
        for number, ((first_joint, position), (second_joint, _)) in enumerate(
            zip(self.loop_frames[::2], self.loop_frames[1::2], strict=True), start=1
        ):
            shared = set(supports[first_joint]) & set(supports[second_joint])
            paths = [
                [j for j in reversed(list(supports[body])) if j not in shared and self.turns[j]]
                for body in (second_joint, first_joint)
            ]
            path = [*paths[0], *reversed(paths[1])]
            corners = _distinct_points([position, *(self.origins[j] for j in path)], self.size)
            if all(self.axis_cosines[j] > 0.99 for j in path) and len(corners) > 2:
                regions[number] = corners
        return regions


def _distinct_points(points: Sequence[Array], size: float) -> Array:
    """Return points (k, 2) without those that repeat an earlier one."""
    distinct: list[Array] = []
    tolerance = COINCIDENCE_TOLERANCE * size
    for point in points:
        if all(np.abs(point - other).max() >= tolerance for other in distinct):
            distinct.append(point)
    return np.array(distinct).reshape(-1, 2)


class MachineOutline(NamedTuple):
    """Outline of a machine in one configuration, in the coordinates of a section [m].

    Attributes:
        bodies: Hulls (k, 2) of bodies between their pins, those that carry the tip last.
        cylinders: (c, 3, 2) closed end, mouth and rod's end.
        stationary_hull: (k, 2) hull of the stationary parts; empty without supports.
    """

    bodies: list[Array]
    cylinders: Array
    stationary_hull: Array

    @property
    def points(self) -> Array:
        """(k, 2) points of all parts."""
        return np.concatenate([*self.bodies, self.cylinders.reshape(-1, 2), self.stationary_hull])


def machine_outline(
    machine: Machine, frame: str, section: WorkspaceSection, q: Array
) -> MachineOutline:
    """Compute the outline of a machine in the plane through its slewing axis.

    Args:
        machine: The machine.
        frame: Frame of the section.
        section: The section; its plane turns with the slewing joint.
        q: (nq,) closed configuration.
    """
    if machine.tip is None:
        machine = dataclasses.replace(machine, tip=frame)
    model, data = machine.model, machine.model.createData()
    pin.framesForwardKinematics(model, data, machine.coordinates.configuration(q))
    plane = DrawingPlane(
        _forward_direction(machine, frame, section, q, data),
        section.second_direction,
        section.coordinate_names,
    )
    origin = plane.project(section.origin)
    mechanism = project_mechanism(machine, q, plane)
    bodies = [
        convex_hull(body.points) - origin
        for body in sorted(mechanism.bodies, key=lambda x: x.carries_tip)
        if len(body.points) > 1
    ]
    slides = [
        np.array([x.start, x.mouth, x.rod_outer_end]) - origin
        for x in mechanism.slides
        if not x.is_rail
    ]
    support_points = [
        plane.project(data.oMf[machine.frame(x)].translation) for x in machine.supports
    ]
    stationary_hull = np.zeros((0, 2))
    if support_points:
        stationary_hull = (
            convex_hull(
                np.array([*support_points, *(position for position, _ in mechanism.ground)])
            )
            - origin
        )
    return MachineOutline(bodies, np.array(slides).reshape(-1, 3, 2), stationary_hull)


def _forward_direction(
    machine: Machine, frame: str, section: WorkspaceSection, q: Array, data: pin.Data
) -> Array:
    """Return the direction (3,) of the section's first coordinate."""
    if section.is_radial:
        offset = data.oMf[machine.frame(frame)].translation - section.origin
        offset = offset - (offset @ section.second_direction) * section.second_direction
        length = float(np.linalg.norm(offset))
        if length > 0:
            return np.asarray(offset / length)
        lateral = np.cross(section.second_direction, machine.up_direction)
        return np.asarray(lateral if lateral.any() else np.eye(3)[0])
    if section.slewing_joint is None:
        return section.first_direction
    slew = q[machine.closure.active[section.slewing_joint]]
    angles = slew_angles(machine, section, np.array([slew]))
    return rotate_about_axis(section.first_direction[None], section.second_direction, angles)[0]
