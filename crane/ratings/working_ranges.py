"""Working range, as brochures draw it: how far, deep and high a machine works."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.errors import InputError, suggest_names
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import as_number
from crane.dynamics.statics import StaticsEvaluator
from crane.machine import Machine
from crane.motion.workspaces import Workspace, workspace
from crane.motion.workspaces.workspace_section import up_direction
from crane.ratings.pivot_joints import bucket_and_arm_strokes, find_pivot
from crane.ratings.strokes import Strokes, check_drives
from crane.ratings.working_range_dimensions import Dimension, DimensionFinder
from crane.recordings.timeseries import Table, write_table

DEFAULT_LEVEL_LENGTH = 2.44  # length of the level bottom, 8 ft [m]
_WORKSPACE_SAMPLES = 4000  # postures


@dataclass(frozen=True, eq=False, repr=False)
class WorkingRange(OneLineRepr):
    """How far a machine works.

    Attributes:
        machine: The machine.
        frame: Whose reach it is: the lip.
        ground_height: Height of the ground [m].
        workspace: What the frame reaches.
        bucket_joint: Joint of the bucket, None where there is none.
        level_length: Length of the level bottom [m].
        dimensions: The numbers.
    """

    machine: Machine
    frame: str
    ground_height: float
    workspace: Workspace
    bucket_joint: str | None
    level_length: float
    dimensions: tuple[Dimension, ...]

    def _one_line(self) -> str:
        """Its numbers."""
        dimension_texts = ", ".join(
            f"{dimension.name} {dimension.value:.4g} m" for dimension in self.dimensions
        )
        return f"WorkingRange of '{self.machine.name}' at '{self.frame}': {dimension_texts}"

    def __getitem__(self, name: str) -> Dimension:
        for dimension in self.dimensions:
            if dimension.name == name:
                return dimension
        hint = suggest_names((one.name for one in self.dimensions), name)
        raise InputError(f"'{name}' is no dimension of '{self.machine.name}', {hint}")

    def to_markdown(self) -> str:
        """A table: each dimension, where it is, and how it is defined."""
        lines = [
            f"# Working range of {self.machine.name}\n",
            f"Of `{self.frame}`, over ground at height {self.ground_height:g} m.\n",
            "| | m | radius [m] | height [m] | strokes | defined as |",
            "| --- | --- | --- | --- | --- | --- |",
        ]
        lines += [
            f"| {dimension.name} | {dimension.value:.3f} | {dimension.section_position[0]:.3f} "
            f"| {dimension.section_position[1]:.3f} | "
            f"{self.workspace.format_strokes(dimension.q_a)} | {dimension.definition} |"
            for dimension in self.dimensions
        ]
        return "\n".join([*lines, ""])

    def to_csv(self, path: str | Path) -> None:
        """Write a row per dimension: value, place, active coordinates; names are above.

        Raises:
            OutputError: The file cannot be written.
        """
        machine = self.machine
        units = {
            "dimension": "1", "value": "m", "radius": "m", "height": "m",
            **{joint: machine.unit(joint) for joint in machine.active},
        }  # fmt: skip
        rows = [
            np.r_[k, dimension.value, dimension.section_position, dimension.q_a]
            for k, dimension in enumerate(self.dimensions)
        ]
        notes = {"machine": machine.load_expression, "frame": self.frame}
        notes |= {f"dimension {k}": one.name for k, one in enumerate(self.dimensions)}
        write_table(path, Table(units, np.array(rows), notes))


def working_range(
    machine: Machine,
    frame: str | None = None,
    *,
    bucket: str | None = None,
    level: float = DEFAULT_LEVEL_LENGTH,
) -> WorkingRange:
    """How far, deep and high a machine works, by the terms of ISO 7135 and brochures.

    Every number is an optimum over all strokes within their limits, with exact slopes, from
    several postures (`crane.motion.workspaces.workspace_extremes.maximize_on_branch`); the slewing
    joint stays at home. Without a bucket there are reach, depth and height alone.

    Args:
        machine: The machine.
        frame: The lip; the tip if not given.
        bucket: The joint whose drive turns the bucket, see `breakout`.
        level: Length of the level bottom [m].

    Raises:
        InputError: An unknown frame or joint, or a frame that moves in no upright plane.
    """
    level = as_number(level, "the level bottom's length", "m", greater_than=0.0)
    reachable_space = workspace(machine, _WORKSPACE_SAMPLES, frame)
    vertical = up_direction(machine)
    if (
        not reachable_space.area
        or abs(reachable_space.section.second_direction @ vertical) < 1 - 1e-9
    ):
        raise InputError(
            f"'{reachable_space.frame}' of '{machine.name}' moves in no upright plane, a "
            f"working range is "
            "drawn in one: name another frame"
        )
    joint = pivot_joint = None
    strokes = Strokes(StaticsEvaluator(check_drives(machine), frame))
    try:
        i = bucket_and_arm_strokes(strokes, bucket)[0]
        joint, pivot_joint = machine.active[i], find_pivot(machine, reachable_space.frame, i)
    except InputError:
        if bucket is not None:
            raise
    ground_height = _ground_height(machine)
    dimensions = tuple(
        DimensionFinder(reachable_space, ground_height, pivot_joint).find_all(level)
    )
    return WorkingRange(
        machine, reachable_space.frame, ground_height, reachable_space, joint, level, dimensions
    )


def _ground_height(machine: Machine) -> float:
    """Height of the ground under the machine: that of what touches it, else 0 [m]."""
    for force in machine.external_forces:
        ground = getattr(force, "ground", None)
        if ground is not None and not ground.profile:
            return float(ground.height)
    return 0.0
