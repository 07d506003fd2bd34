"""Working range: reach, depth and height of a machine (ISO 7135, brochures)."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.errors import InputError, check_name
from crane.common.result import Result
from crane.common.samples import as_number
from crane.dynamics.tipping_stability import TippingStability, has_supports
from crane.machine.machine import Machine
from crane.motion.workspaces import Workspace, workspace
from crane.ratings.posture_search import ANGLE, PostureSearch
from crane.ratings.strokes import Strokes, bucket_and_arm_strokes, find_pivot
from crane.ratings.working_range_dimensions import Dimension, DimensionFinder
from crane.recordings.timeseries import Table, write_table

DEFAULT_LEVEL_LENGTH = 2.44  # 8 ft [m]
_WORKSPACE_SAMPLES = 4000
_LOADER_DIMENSIONS = "reach", "reach at ground level", "digging depth", "cutting height"


@dataclass(frozen=True, eq=False, repr=False)
class WorkingRange(Result):
    """Dimensions of the working range of a machine.

    Attributes:
        machine: The machine.
        frame: Lip, whose reach is measured.
        ground_height: Height of the ground [m].
        workspace: Workspace of the frame.
        bucket_joint: Joint of the bucket; None if there is no bucket.
        level_length: Length of the level bottom [m].
        dimensions: Dimensions, in the order of brochures.
    """

    machine: Machine
    frame: str
    ground_height: float
    workspace: Workspace
    bucket_joint: str | None
    level_length: float
    dimensions: tuple[Dimension, ...]

    def _one_line(self) -> str:
        dimension_texts = ", ".join(
            f"{dimension.name} {dimension.value:.4g} m" for dimension in self.dimensions
        )
        return f"WorkingRange of '{self.machine.name}' at '{self.frame}': {dimension_texts}"

    def __getitem__(self, name: str) -> Dimension:
        by_name = {dimension.name: dimension for dimension in self.dimensions}
        check_name(name, by_name, f"'{name}' is no dimension of '{self.machine.name}'")
        return by_name[name]

    def to_markdown(self) -> str:
        """Return a table of the dimensions with their positions and definitions."""
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
        """Write one row per dimension: value, position, active coordinates; names in the head.

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
    """Compute reach, depth and height of a machine by the terms of ISO 7135 and brochures.

    Each dimension is an optimum over all strokes within their limits, computed with exact
    derivatives from several starts (`maximize_on_branch`); the slewing joint stays at home.
    Without a bucket there are only reach, depth and height. For a bucket that two strokes move,
    as a loader's, the terms are those of SAE J732 (ISO 7131): height of the hinge pin with the
    boom up, and height and reach of the edge there at a dump angle of 45 degrees. The angle of the
    bucket is that of the frame's x axis.

    Args:
        machine: The machine.
        frame: The lip; the tip by default.
        bucket: Joint whose drive turns the bucket, see `breakout`.
        level: Length of the level bottom [m].

    Raises:
        InputError: A frame or joint is unknown, or the frame does not move in a vertical plane.
    """
    level = as_number(level, "the level bottom's length", "m", greater_than=0.0)
    reach = workspace(machine, _WORKSPACE_SAMPLES, frame)
    is_upright = abs(reach.section.second_direction @ machine.up_direction) >= 1 - 1e-9
    if not reach.area or not is_upright:
        raise InputError(
            f"'{reach.frame}' of '{machine.name}' covers no area of an upright plane, in which a "
            "working range is drawn: name another frame"
        )
    joint = pivot_joint = None
    strokes = Strokes(machine, frame)
    try:
        i = bucket_and_arm_strokes(strokes, bucket)[0]
        joint, pivot_joint = machine.active[i], find_pivot(machine, reach.frame, i)
    except InputError:
        if bucket is not None:
            raise
    grounds = (getattr(force, "ground", None) for force in machine.external_forces)
    ground_height = next(
        (float(x.height) for x in grounds if x is not None and not x.profile), 0.0
    )
    finder = DimensionFinder(reach, ground_height, pivot_joint)
    dimensions = list(finder.find_all(level))
    if joint is not None and len(strokes.moving) == 2:
        dimensions = [x for x in dimensions if x.name in _LOADER_DIMENSIONS]
        dimensions += _dump_dimensions(strokes, joint, finder.hinge_pin_height(), ground_height)
    return WorkingRange(
        machine,
        reach.frame,
        ground_height,
        reach,
        joint,
        level,
        tuple(dimensions),
    )


def _dump_dimensions(
    strokes: Strokes, bucket_joint: str, hinge: Dimension | None, ground_height: float
) -> list[Dimension]:
    """Return height of the hinge pin, and height and reach of the edge that dumps at 45 degrees.

    The last two only for a bucket that turns so far where its pin is highest.
    """
    machine, section = strokes.machine, strokes.section
    if hinge is None:
        return []
    at = dict(zip(machine.active, hinge.q_a.tolist(), strict=True)) | {ANGLE: -np.pi / 4}
    del at[bucket_joint]
    try:
        q = PostureSearch(strokes, at).configuration()
    except InputError:
        return [hinge]
    place = section.coordinates(strokes.statics.evaluate(q[None]).tip_positions)[0]
    points = section.origin[None]
    if has_supports(machine):
        (points,) = TippingStability(machine).support_positions(machine.home[None])
    q_a, front = q[machine.closure.active], section.coordinates(points)[:, 0].max()
    return [
        hinge,
        Dimension("dump height at 45 degrees", place[1] - ground_height, place, q_a,
                  "edge of the dumping bucket where its pivot is highest"),
        Dimension("dump reach at 45 degrees", place[0] - front, place, q_a,
                  "that edge before the foremost support, or the origin"),
    ]  # fmt: skip
