"""What a workspace consists of, as tables and in words."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.samples import Array
from crane.common.shown import Brief
from crane.machine import Machine
from crane.motion.workspaces.patch import Patch
from crane.motion.workspaces.raster import Raster
from crane.motion.workspaces.section import Section
from crane.recordings.timeseries import Table, write

KINDS = {
    "branch": "end of the branch: J_P is singular, the strokes lead no further",
    "tip": "singularity of the tip: strokes move it along one direction only",
}


@dataclass(frozen=True, eq=False, repr=False)
class Curve(Brief):
    """A singular curve; a point where one stroke is all that moves.

    Attributes:
        kind: A key of `KINDS`.
        q_a: (k, n) active coordinates.
        tips: (k, 3) [m].
        places: (k, 2) in the section [m].
    """

    kind: str
    q_a: Array
    tips: Array
    places: Array


@dataclass(frozen=True, eq=False, repr=False)
class Extreme(Brief):
    """How far the section reaches in one direction.

    Attributes:
        name: Such as "largest radius".
        value: [m].
        q_a: (n,) active coordinates there.
    """

    name: str
    value: float
    q_a: Array


@dataclass(frozen=True, eq=False, repr=False)
class StrokeMap(Brief):
    """Two strokes against each other, or one: those that move the tip most, others at home.

    Attributes:
        patch: Its postures.
        condition: (a, b) of the drive, NaN where open.
        least: (a, b) least singular value of d(u, w)/dq_A D_A by all strokes [m], likewise.
        curves: Singular curves within it; those of the tip by these two strokes alone.
    """

    patch: Patch
    condition: Array
    least: Array
    curves: tuple[Curve, ...]


@dataclass(frozen=True, eq=False, repr=False)
class Workspace(Brief):
    """Closed postures all over the strokes of a machine.

    Attributes:
        machine: The machine.
        frame: What moves.
        section: The plane of `places`.
        strokes: Joints that were moved; all others are held at home.
        low: (n,) lower ends of the active coordinates.
        high: (n,) upper ends.
        q_a: (N, n) active coordinates whose loops close.
        tips: (N, 3) positions of the frame [m].
        places: (N, 2) the same in the section [m].
        condition: (N,) of the drive, see `Closure.condition`.
        least: (N,) least singular value of d(u, w)/dq_A D_A [m].
        share: Share of the strokes' box that closes, connected with home.
        area: Of the section [m2], 0 where it is a line.
        extremes: How far it reaches.
        curves: Singular curves.
        patches: Of which the postures are made.
        stroke_map: The two strokes that move the frame most.
        raster: Which points of the section are covered.
        complete: Whether the strokes were covered by a grid; else they were drawn, and the true
            workspace is larger.
    """

    machine: Machine
    frame: str
    section: Section
    strokes: tuple[str, ...]
    low: Array
    high: Array
    q_a: Array
    tips: Array
    places: Array
    condition: Array
    least: Array
    share: float
    area: float
    extremes: tuple[Extreme, ...]
    curves: tuple[Curve, ...]
    patches: tuple[Patch, ...]
    stroke_map: StrokeMap
    raster: Raster
    complete: bool

    def _line(self) -> str:
        """What moves, with what, and how much of it closes."""
        return (
            f"Workspace of '{self.frame}' of '{self.machine.name}': {len(self.tips)} postures "
            f"over {', '.join(self.strokes)}, {100 * self.share:.3g} % close, {self.area:.4g} m2"
        )

    def __len__(self) -> int:
        return len(self.q_a)

    def extreme(self, name: str) -> Extreme:
        """One of `extremes` by its name."""
        return next(item for item in self.extremes if item.name == name)

    @property
    def slew(self) -> str | None:
        """The joint that turns the section, None where there is none."""
        return None if self.section.slew is None else self.machine.active[self.section.slew]

    def at(self, q_a: Array) -> str:
        """The strokes of a posture in words."""
        machine = self.machine
        return ", ".join(
            f"{joint} = {q_a[machine.active.index(joint)]:.4g} {machine.unit(joint)}"
            for joint in self.strokes
        )

    def to_csv(self, path: str | Path) -> None:
        """Write all postures: strokes, tip, place in the section, conditions.

        Raises:
            OutputError: The file cannot be written.
        """
        u, w = self.section.names
        units = {
            **{joint: self.machine.unit(joint) for joint in self.machine.active},
            **{f"tip_{axis}": "m" for axis in "xyz"},
            f"section_{u}": "m", f"section_{w}": "m", "condition": "1", "least_singular": "m",
        }  # fmt: skip
        columns = (self.q_a, self.tips, self.places, self.condition, self.least)
        write(path, Table(units, np.column_stack(columns), {"machine": self.machine.call}))

    def curves_to_csv(self, path: str | Path) -> None:
        """Write the singular curves: number, kind (0 branch, 1 tip), then as `to_csv`.

        Raises:
            OutputError: The file cannot be written.
        """
        u, w = self.section.names
        units = {
            "curve": "1", "kind": "1",
            **{joint: self.machine.unit(joint) for joint in self.machine.active},
            **{f"tip_{axis}": "m" for axis in "xyz"}, f"section_{u}": "m", f"section_{w}": "m",
        }  # fmt: skip
        rows = [
            np.column_stack(
                [
                    np.full(len(curve.q_a), number),
                    np.full(len(curve.q_a), list(KINDS).index(curve.kind)),
                    curve.q_a, curve.tips, curve.places,
                ]
            )
            for number, curve in enumerate(self.curves)
        ]  # fmt: skip
        notes = {"machine": self.machine.call, "kind 0": KINDS["branch"], "kind 1": KINDS["tip"]}
        write(path, Table(units, np.vstack([np.empty((0, len(units))), *rows]), notes))

    def to_markdown(self) -> str:
        """A summary: reach, area, share of the strokes that closes, conditions."""
        machine, lines = self.machine, []
        slew = self.slew
        u, w = self.section.names
        lines.append(f"# Workspace of {machine.name}\n")
        lines.append(f"{len(self)} closed postures; `{self.frame}` in the section ({u}, {w}).")
        if slew is not None:
            i = machine.active.index(slew)
            turn = np.rad2deg([self.low[i], self.high[i]])
            lines.append(
                f"The section turns with `{slew}` from {turn[0]:.4g} to {turn[1]:.4g} degrees."
            )
        if not self.complete:
            lines.append(
                f"{len(self.strokes)} strokes are too many for a grid: they were drawn, and the "
                "true workspace is larger."
            )
        lines += ["", "| | | at |", "| --- | --- | --- |"]
        for item in self.extremes:
            lines.append(f"| {item.name} | {item.value:.4f} m | {self.at(item.q_a)} |")
        if self.area:
            lines.append(f"| area of the section | {self.area:.4g} m2 | |")
        lines.append(f"| share of the strokes that closes | {100 * self.share:.4g} % | |")
        worst = int(self.condition.argmax())
        ends = any(curve.kind == "branch" for curve in self.curves)
        beside = ", beside the end of the branch" if ends and self.condition[worst] > 3 else ""
        lines.append(
            f"| largest condition of the drive | {self.condition[worst]:.3g}{beside} | "
            f"{self.at(self.q_a[worst])} |"
        )
        least = int(self.least.argmin())
        lines.append(
            f"| least singular value of the tip | {self.least[least]:.3g} m per scale | "
            f"{self.at(self.q_a[least])} |"
        )
        lines += ["", "| stroke | reaches | of its limits |", "| --- | --- | --- |"]
        for joint in self.strokes:
            i = machine.active.index(joint)
            edges = [curve.q_a[:, i] for curve in self.curves if curve.kind == "branch"]
            reached = np.concatenate([self.q_a[:, i], *edges])
            limits = f"{self.low[i]:.5g} to {self.high[i]:.5g} {machine.unit(joint)}"
            lines.append(f"| {joint} | {reached.min():.5g} to {reached.max():.5g} | {limits} |")
        lines.append("")
        for kind, words in KINDS.items():
            count = sum(curve.kind == kind for curve in self.curves)
            if count:
                lines.append(f"- {count} curve{'s' * (count != 1)}: {words}.")
        return "\n".join([*lines, ""])
