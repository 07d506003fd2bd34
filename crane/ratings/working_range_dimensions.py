"""Dimensions of a working range, each an optimum over the strokes."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from crane.common.samples import Array
from crane.description.soil_cutting import SoilCutting
from crane.dynamics.frame_jacobians import FrameJacobians
from crane.machine.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.motion.workspaces import Workspace
from crane.motion.workspaces.workspace_extremes import (
    Objective,
    ObjectiveConstraint,
    maximize_on_branch,
)
from crane.motion.workspaces.workspace_section import find_slewing_joint

_START_COUNT = 3  # configurations from which an optimum is searched
_MIN_START_DISTANCE = 0.05  # share of the strokes between two starts
_CONSTRAINT_WEIGHT = 10.0  # of the violation of constraints by a start, against the objective
_MIN_IMPROVEMENT = 1e-9  # share of the characteristic length by which a later optimum is better
_MIN_DEPTH = 1e-6  # smallest depth that is reported [m]
_SCANNED_RADII = 13  # radii between which the start of a level bottom is searched
_CHECKED_POINTS = 9  # points of a wall or a bottom at which the reach of the lip is checked
_POSITION_TOLERANCE = 1e-9  # [m]
_ROUNDING_DIGITS = 12  # decimal places; further ones are rounding errors

Optimum = tuple[float, Array] | None


class FrameSectionCoordinates:
    """Coordinates (u, w) of a frame in the section of a workspace, with derivatives.

    Args:
        workspace: The workspace.
        frame: A link.
    """

    def __init__(self, workspace: Workspace, frame: str):
        self._section, self._kinematics = workspace.section, Kinematics(workspace.machine, frame)

    def coordinates(self, q: Array) -> Array:
        """Return the coordinates (N, 2) at configurations (N, nq) [m]."""
        return self._section.coordinates(self._kinematics.positions_at_configurations(q))

    def coordinate_objective(
        self, axis: int, sign: float = 1.0, offset: float = 0.0, scale: float = 1.0
    ) -> Objective:
        """Return the objective sign (x - offset) / scale of coordinate x, axis 0 or 1."""

        def evaluate(q: Array) -> tuple[float, Array]:
            position = self._kinematics.position_at_configuration(q)[None]
            section_jacobian = self._section.section_jacobian(
                position, self._kinematics.tree_jacobian(q)[None]
            )
            coordinate = float(self._section.coordinates(position)[0, axis])
            return sign * (coordinate - offset) / scale, sign * section_jacobian[0, axis] / scale

        return evaluate


def objective_difference(first: Objective, second: Objective) -> Objective:
    """Return the first objective minus the second."""

    def evaluate(q: Array) -> tuple[float, Array]:
        (a, first_gradient), (b, second_gradient) = first(q), second(q)
        return a - b, first_gradient - second_gradient

    return evaluate


class Dimension(NamedTuple):
    """One dimension of a working range.

    Attributes:
        name: Such as "digging depth".
        value: Length [m].
        section_position: (2,) position in the section at which it is measured [m].
        q_a: (n,) active coordinates at this position.
        definition: Definition in words.
    """

    name: str
    value: float
    section_position: Array
    q_a: Array
    definition: str


class DimensionFinder:
    """Computes the dimensions of a working range.

    Each is an optimum: the configurations of the workspace that are best, and satisfy the
    constraints best, are improved by `maximize_on_branch`.

    Args:
        workspace: Workspace of the lip.
        ground_height: Height of the ground [m].
        bucket_pivot: Pivot joint of the bucket; None if there is no bucket.
    """

    def __init__(self, workspace: Workspace, ground_height: float, bucket_pivot: str | None):
        self._workspace, self._ground, self._machine = workspace, ground_height, workspace.machine
        self._strokes = [workspace.machine.active.index(joint) for joint in workspace.strokes]
        self._limits = lower, upper = workspace.lower, workspace.upper
        self._lengths = np.where(upper > lower, upper - lower, 1.0)
        self._q = np.concatenate([x.configurations[x.is_closed] for x in workspace.patches])
        self._lip = FrameSectionCoordinates(workspace, workspace.frame)
        self._size = workspace.machine.closure.characteristic_length
        self._positions = self._lip.coordinates(self._q)
        self._pivot = None
        if bucket_pivot is not None:
            self._pivot = FrameSectionCoordinates(
                workspace, self._machine.tree.joints[bucket_pivot].child
            )

    def find_all(self, level_length: float) -> Iterator[Dimension]:
        """Yield the dimensions that exist, in the order of brochures.

        Args:
            level_length: Length of the level bottom [m].
        """
        pivot, has_slewing_joint = self._pivot, self._workspace.slewing_joint_name is not None
        distance_text = "distance from the slewing axis" if has_slewing_joint else (
            "first coordinate")  # fmt: skip
        dimensions = [
            self._dimension("reach", self._maximize_lip(0), f"largest {distance_text}"),
            self._dimension(
                "reach at ground level",
                self._maximize_lip(0, fixed={1: self._ground}),
                "with the lip on the ground",
            ),
        ]
        depth = self._dimension(
            "digging depth" if pivot else "depth",
            self._maximize_lip(1, -1.0, self._ground),
            "lowest below the ground",
        )
        if depth is not None and depth.value > _MIN_DEPTH:
            dimensions.append(depth)
            if pivot is not None:
                dimensions.append(self._level_bottom_depth(level_length))
                dimensions.append(self._vertical_wall_depth(pivot))
        dimensions.append(
            self._dimension(
                "cutting height" if pivot else "height",
                self._maximize_lip(1, 1.0, self._ground),
                "highest above the ground",
            )
        )
        if pivot is not None:
            dimensions.append(self._dump_height(pivot))
            dimensions.append(self._front_slewing_radius() if has_slewing_joint else None)
        yield from (dimension for dimension in dimensions if dimension is not None)

    def _maximize(
        self,
        objective: Objective,
        values: Array,
        constraints: Sequence[ObjectiveConstraint] = (),
        violation: Array | None = None,
    ) -> Optimum:
        """Find the largest value of an objective.

        Args:
            objective: See `maximize_on_branch`.
            values: (N,) values of the objective at the configurations of the workspace.
            constraints: Constraints; lengths as shares of the characteristic length.
            violation: (N,) violation of the constraints there, 0 where they hold.

        Returns:
            The value and its configuration (nq,); None if no start satisfies the constraints.
        """
        score = (
            values if violation is None else values - (_CONSTRAINT_WEIGHT * self._size) * violation
        )
        best: Optimum = None
        for start in self._select_starts(score):
            value, configuration = maximize_on_branch(
                self._machine, start, self._strokes, self._limits, objective, constraints
            )
            margin = _MIN_IMPROVEMENT * self._size
            if np.isfinite(value) and (best is None or value > best[0] + margin):
                best = value, configuration
        return best

    def _select_starts(self, score: Array) -> list[Array]:
        columns = self._machine.closure.active[self._strokes]
        out: list[Array] = []
        for k in np.argsort(-score, kind="stable"):
            q = self._q[k]
            distances = [
                np.abs((q - x)[columns] / self._lengths[self._strokes]).max() for x in out
            ]
            if not distances or min(distances) > _MIN_START_DISTANCE:
                out.append(q)
            if len(out) == _START_COUNT:
                break
        return out

    def _maximize_lip(
        self,
        axis: int,
        sign: float = 1.0,
        offset: float = 0.0,
        fixed: Mapping[int, float] | None = None,
    ) -> Optimum:
        """Maximize sign (x - offset) of coordinate x of the lip, with other coordinates fixed."""
        return self._maximize_fixed(
            self._lip.coordinate_objective(axis, sign, offset),
            sign * self._positions[:, axis],
            fixed or {},
        )

    def _maximize_fixed(
        self, objective: Objective, values: Array, fixed: Mapping[int, float]
    ) -> Optimum:
        if not fixed:
            return self._maximize(objective, values)
        axes, targets = list(fixed), list(fixed.values())
        constraints: list[ObjectiveConstraint] = [
            ("eq", self._lip.coordinate_objective(k, 1.0, x, self._size)) for k, x in fixed.items()
        ]
        violation = np.abs(self._positions[:, axes] - targets).sum(axis=1) / self._size
        return self._maximize(objective, values, constraints, violation)

    def _dimension(
        self,
        name: str,
        optimum: Optimum,
        definition: str,
        place: FrameSectionCoordinates | None = None,
    ) -> Dimension | None:
        if optimum is None:
            return None
        value, q = optimum
        return Dimension(
            name,
            value,
            np.round((place or self._lip).coordinates(q[None])[0], _ROUNDING_DIGITS) + 0.0,
            np.round(q[self._machine.closure.active], _ROUNDING_DIGITS) + 0.0,
            definition,
        )

    def _lowest_height(self, radius: float) -> Optimum:
        """Return the lowest height of the lip at a radius, negated, and its configuration."""
        return self._maximize_lip(1, -1.0, fixed={0: radius})

    def _level_bottom_depth(self, level_length: float) -> Dimension | None:
        """Return the deepest level line: at both ends the reach is equally deep."""
        deepest = float(self._positions[self._positions[:, 1].argmin(), 0])
        first = max(deepest - level_length, float(self._positions[:, 0].min()))

        def height_difference(radius: float) -> float:
            near = self._lowest_height(radius)
            far = self._lowest_height(radius + level_length)
            return np.nan if near is None or far is None else near[0] - far[0]

        radii = np.linspace(first, deepest, _SCANNED_RADII).tolist()
        differences = [height_difference(x) for x in radii]
        k = next((k for k, (a, b) in enumerate(zip(differences, differences[1:], strict=False))
                  if a <= 0 <= b), None)  # fmt: skip
        if k is None:
            return None
        radius = float(brentq(height_difference, radii[k], radii[k + 1], xtol=_POSITION_TOLERANCE))
        bottom = self._lowest_height(radius)
        inner = [
            self._lowest_height(x)
            for x in np.linspace(radius, radius + level_length, _CHECKED_POINTS)[1:-1].tolist()
        ]
        if bottom is None or any(x is None or x[0] < bottom[0] - 1e-6 for x in inner):
            return None
        return self._dimension(
            f"depth of a {level_length:g} m level bottom", (bottom[0] + self._ground, bottom[1]),
            "deepest level line of that length that the lip follows",
        )  # fmt: skip

    def _vertical_wall_depth(self, pivot: FrameSectionCoordinates) -> Dimension | None:
        """Return the deepest point of a vertical wall that the lip follows.

        Neither the floor of the bucket nor its pivot may be beyond the wall.
        """
        blade = next(
            (x.blade for x in self._machine.external_forces
             if isinstance(x, SoilCutting) and x.frame == self._workspace.frame), None,
        )  # fmt: skip
        if blade is None or self._workspace.section.is_radial:
            return None
        section, size = self._workspace.section, self._size
        inward = self._floor_objective(np.array(blade), -section.first_direction)
        upward = self._floor_objective(np.array(blade), section.second_direction)
        pivot_behind = objective_difference(
            self._lip.coordinate_objective(0, scale=size),
            pivot.coordinate_objective(0, scale=size),
        )
        q, positions = self._q, self._positions
        components = np.array([[inward(x)[0], upward(x)[0]] for x in q])
        violation = np.maximum(-components, 0.0).sum(axis=1)
        violation += np.maximum(pivot.coordinates(q) - positions, 0.0)[:, 0] / size
        optimum = self._maximize(
            self._lip.coordinate_objective(1, -1.0, self._ground),
            -positions[:, 1],
            [("ineq", inward), ("ineq", upward), ("ineq", pivot_behind)],
            violation,
        )
        if optimum is None or optimum[0] <= _MIN_DEPTH:
            return None
        radius, lip_height = self._lip.coordinates(optimum[1][None])[0].tolist()
        objective, zeros = self._lip.coordinate_objective(1), np.zeros(len(positions))
        for height in np.linspace(lip_height, self._ground, _CHECKED_POINTS)[1:].tolist():
            if self._maximize_fixed(objective, zeros, {0: radius, 1: height}) is None:
                return None
        return self._dimension(
            "vertical wall digging depth", optimum,
            "deepest lip with neither the bucket's floor nor its pivot beyond an upright line, "
            "that the lip follows to the ground",
        )  # fmt: skip

    def _floor_objective(self, blade: Array, direction: Array) -> Objective:
        """Return the component along a direction (3,) of the floor behind the lip."""
        frames, frame = FrameJacobians(self._machine), self._workspace.frame

        def evaluate(q: Array) -> tuple[float, Array]:
            frames.set_configuration(q)
            floor = frames.frame_pose(frame).rotation @ blade
            gradient = np.cross(floor, direction) @ frames.jacobian(frame)[3:]
            return float(direction @ floor), np.asarray(gradient)

        return evaluate

    def hinge_pin_height(self) -> Dimension | None:
        """Return the largest height of the bucket's pivot over the ground."""
        pivot = self._pivot
        assert pivot is not None, "it has a bucket"
        heights = pivot.coordinates(self._q)[:, 1] - self._ground
        optimum = self._maximize(pivot.coordinate_objective(1, 1.0, self._ground), heights)
        return self._dimension("hinge pin height", optimum, "highest pivot of the bucket", pivot)

    def _dump_height(self, pivot: FrameSectionCoordinates) -> Dimension | None:
        lip, size = self._lip, self._size
        horizontal = objective_difference(
            lip.coordinate_objective(0, scale=size), pivot.coordinate_objective(0, scale=size)
        )
        vertical = objective_difference(
            pivot.coordinate_objective(1, scale=size), lip.coordinate_objective(1, scale=size)
        )
        offsets = self._positions - pivot.coordinates(self._q)
        optimum = self._maximize(
            lip.coordinate_objective(1, 1.0, self._ground),
            self._positions[:, 1],
            [("eq", horizontal), ("ineq", vertical)],
            (np.abs(offsets)[:, 0] + np.maximum(offsets, 0.0)[:, 1]) / size,
        )
        return self._dimension(
            "dump height", optimum, "highest lip straight under the bucket's pivot"
        )

    def _front_slewing_radius(self) -> Dimension | None:
        """Return the smallest radius that contains all pins of the front.

        Each pin that is the outermost one in some configuration is tried.
        """
        q, size = self._q, self._size
        signed_pins = [
            (FrameSectionCoordinates(self._workspace, link), sign)
            for link in _front_pin_links(self._machine, self._workspace.frame)
            for sign in (1.0, -1.0)
        ]
        distances = np.column_stack([sign * pin.coordinates(q)[:, 0] for pin, sign in signed_pins])
        objectives = [pin.coordinate_objective(0, sign, scale=size) for pin, sign in signed_pins]
        best: tuple[FrameSectionCoordinates, float, Array] | None = None
        for k in np.unique(distances.argmax(axis=1)).tolist():
            pin, sign = signed_pins[k]
            constraints: list[ObjectiveConstraint] = [
                ("ineq", objective_difference(objectives[k], other))
                for j, other in enumerate(objectives)
                if j != k
            ]
            violation = (distances.max(axis=1) - distances[:, k]) / size
            optimum = self._maximize(
                pin.coordinate_objective(0, -sign), -distances[:, k], constraints, violation
            )
            if optimum is not None and (best is None or -optimum[0] < best[1]):
                best = pin, -optimum[0], optimum[1]
        if best is None:
            return None
        pin, radius, configuration = best
        return self._dimension(
            "smallest front slewing radius", (radius, configuration),
            "smallest radius that contains the lip and all pins of the front", pin,
        )  # fmt: skip


def _front_pin_links(machine: Machine, frame: str) -> list[str]:
    """Return the frame and the links whose origins are the pins of the slewing part."""
    slewing_joint = find_slewing_joint(machine, frame)
    assert slewing_joint is not None, "it slews"
    model, slew = machine.model, machine.active[slewing_joint[0]]
    pins = [x for x in machine.tree.moving_joints if x.kind == "revolute" and x.name != slew]
    carried = [
        x.child
        for x in pins
        if model.existJointName(x.name)
        and model.getJointId(slew) in list(model.supports[model.getJointId(x.name)])
    ]
    return [frame, *carried, *(loop.successor for loop in machine.closure.equations.loops)]
