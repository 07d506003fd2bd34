"""The dimensions of a working range, one by one."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from crane.common.samples import Array
from crane.description.soil_cutting import SoilCutting
from crane.dynamics.frame_jacobians import FrameJacobians
from crane.machine import Machine
from crane.motion.workspaces import Workspace
from crane.motion.workspaces.workspace_extremes import Objective
from crane.motion.workspaces.workspace_section import find_slewing_joint
from crane.ratings.workspace_optimizer import (
    FrameSectionCoordinates,
    WorkspaceOptimizer,
    objective_difference,
)

_MIN_DEPTH = 1e-6  # [m] that is no depth
_SCANNED_RADII = 13  # radii between which a level bottom is sought to begin
_CHECKED_POINTS = (
    9  # places of a wall or a bottom at which it is looked whether the lip gets there
)
_POSITION_TOLERANCE = 1e-9  # [m]
_ROUNDING_DIGITS = 12  # behind the point: what is below is rounding


class Dimension(NamedTuple):
    """One number of a working range.

    Attributes:
        name: Such as "digging depth".
        value: [m].
        section_position: (2,) in the section, at which it is measured.
        q_a: (n,) active coordinates there.
        definition: How it is defined.
    """

    name: str
    value: float
    section_position: Array
    q_a: Array
    definition: str


class DimensionFinder:
    """The dimensions of a working range, one by one.

    Args:
        workspace: What the lip reaches.
        ground_height: Its height.
        bucket_pivot: The bucket's pivot, None where there is none.
    """

    def __init__(self, workspace: Workspace, ground_height: float, bucket_pivot: str | None):
        self.workspace, self.ground, self.machine = workspace, ground_height, workspace.machine
        self._optimizer, self._lip_coordinates = (
            WorkspaceOptimizer(workspace),
            FrameSectionCoordinates(workspace, workspace.frame),
        )
        self._characteristic_length, self._lip_positions = (
            workspace.machine.closure.characteristic_length,
            self._lip_coordinates.coordinates(self._optimizer.q),
        )
        self._pivot_coordinates = (
            None
            if bucket_pivot is None
            else FrameSectionCoordinates(workspace, self.machine.tree.joints[bucket_pivot].child)
        )

    def find_all(self, level_length: float) -> Iterator[Dimension]:
        """Those that there are, in the order of brochures.

        Args:
            level_length: Length of the level bottom [m].
        """
        lip_coordinates, ground_height, has_bucket = (
            self._lip_coordinates,
            self.ground,
            self._pivot_coordinates is not None,
        )
        has_slewing_joint = self.workspace.slewing_joint_name is not None
        dimensions: list[Dimension | None] = [
            self._extreme_dimension(
                "reach",
                lip_coordinates.coordinate_objective(0),
                0,
                1.0,
                "largest distance from the slewing axis"
                if has_slewing_joint
                else "largest first coordinate",
            ),
            self._ground_level_reach(),
        ]
        depth = self._extreme_dimension(
            "digging depth" if has_bucket else "depth",
            lip_coordinates.coordinate_objective(1, -1.0, ground_height),
            1,
            -1.0,
            "lowest below the ground",
        )
        if depth is not None and depth.value > _MIN_DEPTH:
            dimensions.append(depth)
            if self._pivot_coordinates is not None:
                dimensions += [
                    self._level_bottom_depth(level_length),
                    self._vertical_wall_depth(self._pivot_coordinates),
                ]
        dimensions.append(
            self._extreme_dimension(
                "cutting height" if has_bucket else "height",
                lip_coordinates.coordinate_objective(1, 1.0, ground_height),
                1,
                1.0,
                "highest above the ground",
            )
        )
        if self._pivot_coordinates is not None:
            dimensions.append(self._dump_height(self._pivot_coordinates))
            dimensions.append(self._front_slewing_radius() if has_slewing_joint else None)
        yield from (dimension for dimension in dimensions if dimension is not None)

    def _extreme_dimension(
        self, name: str, objective: Objective, axis: int, sign: float, definition: str
    ) -> Dimension | None:
        return self._create_dimension(
            name,
            self._optimizer.maximize(objective, sign * self._lip_positions[:, axis]),
            definition,
        )

    def _create_dimension(
        self, name: str, optimum: tuple[float, Array] | None, definition: str
    ) -> Dimension | None:
        if optimum is None:
            return None
        value, q = optimum
        q_a = np.round(q[self.machine.closure.active], _ROUNDING_DIGITS) + 0.0
        return Dimension(
            name, value, self._rounded_position(self._lip_coordinates, q), q_a, definition
        )

    def _rounded_position(self, coordinates: FrameSectionCoordinates, q: Array) -> Array:
        return np.asarray(np.round(coordinates.coordinates(q[None])[0], _ROUNDING_DIGITS) + 0.0)

    def _ground_level_reach(self) -> Dimension | None:
        optimum = self._optimizer.maximize(
            self._lip_coordinates.coordinate_objective(0),
            self._lip_positions[:, 0],
            [
                (
                    "eq",
                    self._lip_coordinates.coordinate_objective(
                        1, 1.0, self.ground, self._characteristic_length
                    ),
                )
            ],
            np.abs(self._lip_positions[:, 1] - self.ground) / self._characteristic_length,
        )
        return self._create_dimension(
            "reach at ground level", optimum, "with the lip on the ground"
        )

    def _lowest_height(self, radius: float) -> tuple[float, Array] | None:
        """The lowest height that the lip reaches at a radius, below 0, and its posture."""
        return self._optimizer.maximize(
            self._lip_coordinates.coordinate_objective(1, -1.0),
            -self._lip_positions[:, 1],
            [
                (
                    "eq",
                    self._lip_coordinates.coordinate_objective(
                        0, 1.0, radius, self._characteristic_length
                    ),
                )
            ],
            np.abs(self._lip_positions[:, 0] - radius) / self._characteristic_length,
        )

    def _level_bottom_depth(self, level_length: float) -> Dimension | None:
        """The deepest level line: its ends are where the reach is equally deep."""
        deepest = float(self._lip_positions[self._lip_positions[:, 1].argmin(), 0])
        lower, upper = max(deepest - level_length, float(self._lip_positions[:, 0].min())), deepest

        def height_difference(radius: float) -> float:
            near_end, far_end = (
                self._lowest_height(radius),
                self._lowest_height(radius + level_length),
            )
            return np.nan if near_end is None or far_end is None else near_end[0] - far_end[0]

        scanned_radii = np.linspace(lower, upper, _SCANNED_RADII)
        differences = [height_difference(x) for x in scanned_radii.tolist()]
        sign_change = next(
            (k for k in range(_SCANNED_RADII - 1) if differences[k] <= 0 <= differences[k + 1]),
            None,
        )
        if sign_change is None:
            return None
        radius = float(
            brentq(
                height_difference,
                scanned_radii[sign_change],
                scanned_radii[sign_change + 1],
                xtol=_POSITION_TOLERANCE,
            )
        )
        bottom = self._lowest_height(radius)
        inner_radii = np.linspace(radius, radius + level_length, _CHECKED_POINTS)[1:-1]
        inner_bottoms = [self._lowest_height(x) for x in inner_radii.tolist()]
        if bottom is None or any(x is None or x[0] < bottom[0] - 1e-6 for x in inner_bottoms):
            return None
        return self._create_dimension(
            f"depth of a {level_length:g} m level bottom", (bottom[0] + self.ground, bottom[1]),
            "deepest level line of that length that the lip follows",
        )  # fmt: skip

    def _vertical_wall_depth(self, pivot: FrameSectionCoordinates) -> Dimension | None:
        """The deepest point of an upright wall: the lip follows it, the floor keeps off it."""
        blade = next(
            (x.blade for x in self.machine.external_forces
             if isinstance(x, SoilCutting) and x.frame == self.workspace.frame), None,
        )  # fmt: skip
        if blade is None or self.workspace.section.is_radial:
            return None
        frames, section, size = (
            FrameJacobians(self.machine),
            self.workspace.section,
            self._characteristic_length,
        )

        def floor_direction_objective(way: Array) -> Objective:
            """How far the floor points along a direction, from the lip on."""

            def evaluate(q: Array) -> tuple[float, Array]:
                frames.set_configuration(q)
                blade_direction = frames.frame_pose(self.workspace.frame).rotation @ np.array(
                    blade
                )
                angular_jacobian = frames.jacobian(self.workspace.frame)[3:]
                return float(way @ blade_direction), np.asarray(
                    np.cross(blade_direction, way) @ angular_jacobian
                )

            return evaluate

        inward_objective, rise_objective = (
            floor_direction_objective(-section.first_direction),
            floor_direction_objective(section.second_direction),
        )
        pivot_objective = objective_difference(
            self._lip_coordinates.coordinate_objective(0, scale=size),
            pivot.coordinate_objective(0, scale=size),
        )
        q, positions = self._optimizer.q, self._lip_positions
        direction_components = np.array(
            [[inward_objective(x)[0], rise_objective(x)[0]] for x in q]
        )
        constraint_violation = np.maximum(-direction_components, 0.0).sum(axis=1)
        constraint_violation += np.maximum(pivot.coordinates(q) - positions, 0.0)[:, 0] / size
        optimum = self._optimizer.maximize(
            self._lip_coordinates.coordinate_objective(1, -1.0, self.ground),
            -positions[:, 1],
            [("ineq", inward_objective), ("ineq", rise_objective), ("ineq", pivot_objective)],
            constraint_violation,
        )
        if (
            optimum is None
            or optimum[0] <= _MIN_DEPTH
            or not self._reaches_ground_vertically(optimum[1])
        ):
            return None
        return self._create_dimension(
            "vertical wall digging depth", optimum,
            "deepest lip with neither the bucket's floor nor its pivot beyond an upright line, "
            "that the lip follows to the ground",
        )  # fmt: skip

    def _reaches_ground_vertically(self, q: Array) -> bool:
        """Whether the lip gets from a posture straight up to the ground."""
        radius, lip_height = self._lip_coordinates.coordinates(q[None])[0].tolist()
        for height in np.linspace(lip_height, self.ground, _CHECKED_POINTS)[1:].tolist():
            optimum = self._optimizer.maximize(
                self._lip_coordinates.coordinate_objective(1),
                np.zeros(len(self._lip_positions)),
                [
                    (
                        "eq",
                        self._lip_coordinates.coordinate_objective(
                            0, 1.0, radius, self._characteristic_length
                        ),
                    ),
                    (
                        "eq",
                        self._lip_coordinates.coordinate_objective(
                            1, 1.0, height, self._characteristic_length
                        ),
                    ),
                ],
                np.abs(self._lip_positions - [radius, height]).sum(axis=1)
                / self._characteristic_length,
            )
            if optimum is None:
                return False
        return True

    def _dump_height(self, pivot: FrameSectionCoordinates) -> Dimension | None:
        lip_coordinates, size = self._lip_coordinates, self._characteristic_length
        lip_positions, pivot_positions = self._lip_positions, pivot.coordinates(self._optimizer.q)
        horizontal_difference = objective_difference(
            lip_coordinates.coordinate_objective(0, scale=size),
            pivot.coordinate_objective(0, scale=size),
        )
        vertical_difference = objective_difference(
            pivot.coordinate_objective(1, scale=size),
            lip_coordinates.coordinate_objective(1, scale=size),
        )
        optimum = self._optimizer.maximize(
            lip_coordinates.coordinate_objective(1, 1.0, self.ground),
            lip_positions[:, 1],
            [("eq", horizontal_difference), ("ineq", vertical_difference)],
            (
                np.abs(lip_positions - pivot_positions)[:, 0]
                + np.maximum(lip_positions - pivot_positions, 0.0)[:, 1]
            )
            / size,
        )
        return self._create_dimension(
            "dump height", optimum, "highest lip straight under the bucket's pivot"
        )

    def _front_slewing_radius(self) -> Dimension | None:
        """The least radius that holds all pins of the front: of each that may be the outermost."""
        q, size = self._optimizer.q, self._characteristic_length
        pin_coordinates = [
            FrameSectionCoordinates(self.workspace, link)
            for link in _front_pin_links(self.machine, self.workspace.frame)
        ]
        signed_pins = [(pin, sign) for pin in pin_coordinates for sign in (1.0, -1.0)]
        signed_distances = np.column_stack(
            [sign * pin.coordinates(q)[:, 0] for pin, sign in signed_pins]
        )
        objectives = [pin.coordinate_objective(0, sign, scale=size) for pin, sign in signed_pins]
        best_candidate: tuple[FrameSectionCoordinates, float, Array] | None = None
        for k in np.unique(signed_distances.argmax(axis=1)).tolist():
            pin, sign = signed_pins[k]
            constraints = [
                ("ineq", objective_difference(objectives[k], other))
                for j, other in enumerate(objectives)
                if j != k
            ]
            constraint_violation = (signed_distances.max(axis=1) - signed_distances[:, k]) / size
            optimum = self._optimizer.maximize(
                pin.coordinate_objective(0, -sign),
                -signed_distances[:, k],
                constraints,
                constraint_violation,
            )
            if optimum is not None and (best_candidate is None or -optimum[0] < best_candidate[1]):
                best_candidate = pin, -optimum[0], optimum[1]
        if best_candidate is None:
            return None
        pin, radius, configuration = best_candidate
        dimension = self._create_dimension(
            "smallest front slewing radius", (radius, configuration),
            "least radius that holds the lip and all pins of the front",
        )  # fmt: skip
        return dimension and dimension._replace(
            section_position=self._rounded_position(pin, configuration)
        )


def _front_pin_links(machine: Machine, frame: str) -> list[str]:
    """Links whose origins are the pins of what slews, and the frame itself."""
    slewing_joint = find_slewing_joint(machine, frame)
    assert slewing_joint is not None, "it slews"
    model = machine.model
    slew_joint_id = model.getJointId(machine.active[slewing_joint[0]])
    out = [frame]
    for joint in machine.tree.moving_joints:
        if joint.kind == "revolute" and model.existJointName(joint.name):
            joint_id = model.getJointId(joint.name)
            if joint_id != slew_joint_id and slew_joint_id in list(model.supports[joint_id]):
                out.append(joint.child)
    for loop in machine.closure.equations.loops:
        out.append(loop.successor)
    return out
