"""What a workspace consists of, as tables and in words."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.one_line_repr import OneLineRepr
from crane.common.result import Result
from crane.common.samples import Array
from crane.machine import Machine
from crane.motion.workspaces.coverage_raster import CoverageRaster
from crane.motion.workspaces.workspace_patch import WorkspacePatch
from crane.motion.workspaces.workspace_section import WorkspaceSection
from crane.recordings.timeseries import Table, write_table

CURVE_KINDS = {
    "branch": "end of the branch: J_P is singular, the strokes lead no further",
    "tip": "singularity of the tip: strokes move it along one direction only",
}


@dataclass(frozen=True, eq=False, repr=False)
class SingularCurve(OneLineRepr):
    """A singular curve; a point where one stroke is all that moves.

    Attributes:
        kind: A key of `CURVE_KINDS`.
        q_a: (k, n) active coordinates.
        tip_positions: (k, 3) [m].
        section_positions: (k, 2) in the section [m].
    """

    kind: str
    q_a: Array
    tip_positions: Array
    section_positions: Array


@dataclass(frozen=True, eq=False, repr=False)
class WorkspaceExtreme(OneLineRepr):
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
class StrokeMap(OneLineRepr):
    """Two strokes against each other, or one: those that move the tip most, others at home.

    Attributes:
        patch: Its postures.
        condition: (a, b) of the drive, NaN where open.
        least_singular_value: (a, b) least singular value of d(u, w)/dq_A D_A by all strokes [m],
            likewise.
        curves: Singular curves within it; those of the tip by these two strokes alone.
    """

    patch: WorkspacePatch
    condition: Array
    least_singular_value: Array
    curves: tuple[SingularCurve, ...]


@dataclass(frozen=True, eq=False, repr=False)
class Workspace(Result):
    """Closed postures all over the strokes of a machine.

    Attributes:
        machine: The machine.
        frame: What moves.
        section: The plane of `section_positions`.
        strokes: Joints that were moved; all others are held at home.
        lower: (n,) lower ends of the active coordinates.
        upper: (n,) upper ends.
        q_a: (N, n) active coordinates whose loops close.
        tip_positions: (N, 3) positions of the frame [m].
        section_positions: (N, 2) the same in the section [m].
        condition: (N,) of the drive, see `Closure.condition_number`.
        least_singular_value: (N,) least singular value of d(u, w)/dq_A D_A [m].
        closed_share: Share of the strokes' box that closes, connected with home.
        area: Of the section [m2], 0 where it is a line.
        extremes: How far it reaches.
        curves: Singular curves.
        patches: Of which the postures are made.
        stroke_map: The two strokes that move the frame most.
        raster: Which points of the section are covered.
        is_complete: Whether the strokes were covered by a grid; else they were drawn, and the true
            workspace is larger.
    """

    machine: Machine
    frame: str
    section: WorkspaceSection
    strokes: tuple[str, ...]
    lower: Array
    upper: Array
    q_a: Array
    tip_positions: Array
    section_positions: Array
    condition: Array
    least_singular_value: Array
    closed_share: float
    area: float
    extremes: tuple[WorkspaceExtreme, ...]
    curves: tuple[SingularCurve, ...]
    patches: tuple[WorkspacePatch, ...]
    stroke_map: StrokeMap
    raster: CoverageRaster
    is_complete: bool

    def _one_line(self) -> str:
        """What moves, with what, and how much of it closes."""
        return (
            f"Workspace of '{self.frame}' of '{self.machine.name}': {len(self.tip_positions)} "
            f"postures "
            f"over {', '.join(self.strokes)}, {100 * self.closed_share:.3g} % close, "
            f"{self.area:.4g} m2"
        )

    def __len__(self) -> int:
        return len(self.q_a)

    def extreme(self, name: str) -> WorkspaceExtreme:
        """One of `extremes` by its name."""
        return next(item for item in self.extremes if item.name == name)

    @property
    def slewing_joint_name(self) -> str | None:
        """The joint that turns the section, None where there is none."""
        return (
            None
            if self.section.slewing_joint is None
            else self.machine.active[self.section.slewing_joint]
        )

    def format_strokes(self, q_a: Array) -> str:
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
        u, w = self.section.coordinate_names
        units = {
            **{joint: self.machine.unit(joint) for joint in self.machine.active},
            **{f"tip_{axis}": "m" for axis in "xyz"},
            f"section_{u}": "m", f"section_{w}": "m", "condition": "1", "least_singular": "m",
        }  # fmt: skip
        columns = (
            self.q_a,
            self.tip_positions,
            self.section_positions,
            self.condition,
            self.least_singular_value,
        )
        write_table(
            path, Table(units, np.column_stack(columns), {"machine": self.machine.load_expression})
        )

    def curves_to_csv(self, path: str | Path) -> None:
        """Write the singular curves: number, kind (0 branch, 1 tip), then as `to_csv`.

        Raises:
            OutputError: The file cannot be written.
        """
        u, w = self.section.coordinate_names
        units = {
            "curve": "1", "kind": "1",
            **{joint: self.machine.unit(joint) for joint in self.machine.active},
            **{f"tip_{axis}": "m" for axis in "xyz"}, f"section_{u}": "m", f"section_{w}": "m",
        }  # fmt: skip
        rows = [
            np.column_stack(
                [
                    np.full(len(curve.q_a), curve_number),
                    np.full(len(curve.q_a), list(CURVE_KINDS).index(curve.kind)),
                    curve.q_a, curve.tip_positions, curve.section_positions,
                ]
            )
            for curve_number, curve in enumerate(self.curves)
        ]  # fmt: skip
        notes = {
            "machine": self.machine.load_expression,
            "kind 0": CURVE_KINDS["branch"],
            "kind 1": CURVE_KINDS["tip"],
        }
        write_table(path, Table(units, np.vstack([np.empty((0, len(units))), *rows]), notes))

    def to_markdown(self) -> str:
        """A summary: reach, area, share of the strokes that closes, conditions."""
        machine, lines = self.machine, []
        slewing_joint = self.slewing_joint_name
        u, w = self.section.coordinate_names
        lines.append(f"# Workspace of {machine.name}\n")
        lines.append(f"{len(self)} closed postures; `{self.frame}` in the section ({u}, {w}).")
        if slewing_joint is not None:
            i = machine.active.index(slewing_joint)
            slewing_range = np.rad2deg([self.lower[i], self.upper[i]])
            lines.append(
                f"The section turns with `{slewing_joint}` from {slewing_range[0]:.4g} to "
                f"{slewing_range[1]:.4g} degrees."
            )
        if not self.is_complete:
            lines.append(
                f"{len(self.strokes)} strokes are too many for a grid: they were drawn, and the "
                "true workspace is larger."
            )
        lines += ["", "| | | at |", "| --- | --- | --- |"]
        for extreme_item in self.extremes:
            lines.append(
                f"| {extreme_item.name} | {extreme_item.value:.4f} m | "
                f"{self.format_strokes(extreme_item.q_a)} |"
            )
        if self.area:
            lines.append(f"| area of the section | {self.area:.4g} m2 | |")
        lines.append(f"| share of the strokes that closes | {100 * self.closed_share:.4g} % | |")
        worst_index = int(self.condition.argmax())
        has_branch_ends = any(curve.kind == "branch" for curve in self.curves)
        location_text = (
            ", beside the end of the branch"
            if has_branch_ends and self.condition[worst_index] > 3
            else ""
        )
        lines.append(
            f"| largest condition of the drive | "
            f"{self.condition[worst_index]:.3g}{location_text} | "
            f"{self.format_strokes(self.q_a[worst_index])} |"
        )
        least_index = int(self.least_singular_value.argmin())
        lines.append(
            f"| least singular value of the tip | {self.least_singular_value[least_index]:.3g} "
            f"m per scale | "
            f"{self.format_strokes(self.q_a[least_index])} |"
        )
        lines += ["", "| stroke | reaches | of its limits |", "| --- | --- | --- |"]
        for joint in self.strokes:
            i = machine.active.index(joint)
            edges = [curve.q_a[:, i] for curve in self.curves if curve.kind == "branch"]
            reached = np.concatenate([self.q_a[:, i], *edges])
            limits = f"{self.lower[i]:.5g} to {self.upper[i]:.5g} {machine.unit(joint)}"
            lines.append(f"| {joint} | {reached.min():.5g} to {reached.max():.5g} | {limits} |")
        lines.append("")
        for kind, description in CURVE_KINDS.items():
            count = sum(curve.kind == kind for curve in self.curves)
            if count:
                lines.append(f"- {count} curve{'s' * (count != 1)}: {description}.")
        return "\n".join([*lines, ""])
