"""Working range, as brochures draw it: how far, deep and high a machine works."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.errors import InputError, known
from crane.common.samples import as_number
from crane.common.shown import Brief
from crane.dynamics.statics import Statics
from crane.machine import Machine
from crane.motion.workspaces import Workspace, workspace
from crane.motion.workspaces.section import upwards
from crane.ratings.dimensions import Dimension, Dimensions
from crane.ratings.pivots import digging, pivot
from crane.ratings.strokes import Strokes, check_drives
from crane.recordings.timeseries import Table, write

LEVEL = 2.44  # length of the level bottom, 8 ft [m]
_SAMPLES = 4000  # postures


@dataclass(frozen=True, eq=False, repr=False)
class WorkingRange(Brief):
    """How far a machine works.

    Attributes:
        machine: The machine.
        frame: Whose reach it is: the lip.
        ground: Height of the ground [m].
        space: What the frame reaches.
        bucket: Joint of the bucket, None where there is none.
        level: Length of the level bottom [m].
        dimensions: The numbers.
    """

    machine: Machine
    frame: str
    ground: float
    space: Workspace
    bucket: str | None
    level: float
    dimensions: tuple[Dimension, ...]

    def _line(self) -> str:
        """Its numbers."""
        words = ", ".join(f"{one.name} {one.value:.4g} m" for one in self.dimensions)
        return f"WorkingRange of '{self.machine.name}' at '{self.frame}': {words}"

    def __getitem__(self, name: str) -> Dimension:
        for one in self.dimensions:
            if one.name == name:
                return one
        hint = known((one.name for one in self.dimensions), name)
        raise InputError(f"'{name}' is no dimension of '{self.machine.name}', {hint}")

    def to_markdown(self) -> str:
        """A table: each dimension, where it is, and how it is defined."""
        lines = [
            f"# Working range of {self.machine.name}\n",
            f"Of `{self.frame}`, over ground at height {self.ground:g} m.\n",
            "| | m | radius [m] | height [m] | strokes | defined as |",
            "| --- | --- | --- | --- | --- | --- |",
        ]
        lines += [
            f"| {one.name} | {one.value:.3f} | {one.place[0]:.3f} | {one.place[1]:.3f} | "
            f"{self.space.at(one.q_a)} | {one.says} |"
            for one in self.dimensions
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
        rows = [np.r_[k, one.value, one.place, one.q_a] for k, one in enumerate(self.dimensions)]
        notes = {"machine": machine.call, "frame": self.frame}
        notes |= {f"dimension {k}": one.name for k, one in enumerate(self.dimensions)}
        write(path, Table(units, np.array(rows), notes))


def working_range(
    machine: Machine,
    frame: str | None = None,
    *,
    bucket: str | None = None,
    level: float = LEVEL,
) -> WorkingRange:
    """How far, deep and high a machine works, by the terms of ISO 7135 and brochures.

    Every number is an optimum over all strokes within their limits, with exact slopes, from
    several postures (`crane.motion.workspaces.extremes.farthest`); the slewing joint stays at
    home. Without a bucket there are reach, depth and height alone.

    Args:
        machine: The machine.
        frame: The lip; the tip if not given.
        bucket: The joint whose drive turns the bucket, see `breakout`.
        level: Length of the level bottom [m].

    Raises:
        InputError: An unknown frame or joint, or a frame that moves in no upright plane.
    """
    level = as_number(level, "the level bottom's length", "m", above=0.0)
    space = workspace(machine, _SAMPLES, frame)
    up = upwards(machine)
    if not space.area or abs(space.section.second @ up) < 1 - 1e-9:
        raise InputError(
            f"'{space.frame}' of '{machine.name}' moves in no upright plane, a working range is "
            "drawn in one: name another frame"
        )
    joint = pin = None
    strokes = Strokes(Statics(check_drives(machine), frame))
    try:
        i = digging(strokes, bucket)[0]
        joint, pin = machine.active[i], pivot(machine, space.frame, i)
    except InputError:
        if bucket is not None:
            raise
    ground = _ground(machine)
    dimensions = tuple(Dimensions(space, ground, pin).all(level))
    return WorkingRange(machine, space.frame, ground, space, joint, level, dimensions)


def _ground(machine: Machine) -> float:
    """Height of the ground under the machine: that of what touches it, else 0 [m]."""
    for force in machine.external:
        ground = getattr(force, "ground", None)
        if ground is not None and not ground.profile:
            return float(ground.height)
    return 0.0
