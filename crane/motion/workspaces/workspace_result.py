"""Results of a workspace: curves, extremes, covered area, tables and text."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing

from crane.common.one_line_repr import OneLineRepr
from crane.common.result import Result
from crane.common.samples import Array
from crane.machine.machine import Machine
from crane.motion.workspaces.workspace_patch import WorkspacePatch
from crane.motion.workspaces.workspace_section import WorkspaceSection
from crane.recordings.timeseries import Table, write_table

_RASTER_POINTS = 800  # grid points along the longer side
CURVE_KINDS = {
    "branch": "end of the branch: J_P is singular, the strokes lead no further",
    "tip": "singularity of the tip: strokes move it along one direction only",
}


class CoverageRaster:
    """Fine grid over the section whose points are marked where a triangle covers them.

    Args:
        points: (N, 2) points whose bounding box the grid spans [m].

    Attributes:
        u: (W,) first coordinates of the grid [m].
        w: (H,) second coordinates of the grid [m].
        covered: (H, W) whether a grid point is covered.
    """

    def __init__(self, points: Array):
        low, high = points.min(axis=0), points.max(axis=0)
        # arbitrary for a single point
        self.spacing = (float((high - low).max()) or 1.0) / _RASTER_POINTS
        count = np.ceil((high - low) / self.spacing).astype(int) + 3
        self.u = low[0] + self.spacing * (np.arange(count[0]) - 0.5)
        self.w = low[1] + self.spacing * (np.arange(count[1]) - 0.5)
        self.covered: NDArray[np.bool_] = np.zeros((count[1], count[0]), dtype=bool)

    @property
    def area(self) -> float:
        """Covered area [m2]."""
        return float(self.covered.sum()) * self.spacing**2

    def fill_cracks(self, width: int) -> Array:
        """Array (H, W): 1 where covered or in a crack of at most 2 width points, else 0."""
        padded = np.pad(self.covered, width + 1)
        return binary_closing(padded, iterations=width)[
            width + 1 : -width - 1, width + 1 : -width - 1
        ].astype(np.float64)

    def cover(self, triangles: Array) -> None:
        """Mark all grid points within triangles (N, 3, 2)."""
        grid_positions = (triangles - np.array([self.u[0], self.w[0]])) / self.spacing
        low = np.maximum(np.ceil(grid_positions.min(axis=1) - 1e-9).astype(int), 0)
        high = np.floor(grid_positions.max(axis=1) + 1e-9).astype(int) + 1
        for corners, (x0, y0), (x1, y1) in zip(grid_positions, low, high, strict=True):
            if x1 <= x0 or y1 <= y0:
                continue
            block = self.covered[y0:y1, x0:x1]
            if block.all():
                continue
            x, y = np.arange(x0, x1), np.arange(y0, y1)[:, None]
            edge_functions = [
                (bx - ax) * (y - ay) - (by - ay) * (x - ax)
                for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True)
            ]
            block |= np.minimum.reduce(edge_functions) >= -1e-9
            block |= np.maximum.reduce(edge_functions) <= 1e-9


@dataclass(frozen=True, eq=False, repr=False)
class SingularCurve(OneLineRepr):
    """Singular curve; for a single stroke a point.

    Attributes:
        kind: A key of `CURVE_KINDS`.
        q_a: (k, n) active coordinates.
        tip_positions: (k, 3) [m].
        section_positions: (k, 2) coordinates in the section [m].
    """

    kind: str
    q_a: Array
    tip_positions: Array
    section_positions: Array


@dataclass(frozen=True, eq=False, repr=False)
class WorkspaceExtreme(OneLineRepr):
    """Extreme coordinate of the section.

    Attributes:
        name: Name, such as "largest radius".
        value: Coordinate [m].
        q_a: (n,) active coordinates of the extreme.
    """

    name: str
    value: float
    q_a: Array


@dataclass(frozen=True, eq=False, repr=False)
class StrokeMap(OneLineRepr):
    """Condition over the two strokes that move the tip most, or one; others are at home.

    Attributes:
        patch: Configurations of the map.
        condition: (a, b) condition number of gamma, NaN where the loops do not close.
        least_singular_value: (a, b) least singular value of d(u, w)/dq_A D_A by all strokes [m],
            NaN likewise.
        curves: Singular curves in the map; those of the tip for these two strokes alone.
    """

    patch: WorkspacePatch
    condition: Array
    least_singular_value: Array
    curves: tuple[SingularCurve, ...]


@dataclass(frozen=True, eq=False, repr=False)
class Workspace(Result):
    """Workspace: closed configurations over the whole range of the strokes of a machine.

    Attributes:
        machine: The machine.
        frame: Name of the frame.
        section: Plane of `section_positions`.
        strokes: Joints that were varied; all others are at home.
        lower: (n,) lower limits of the active coordinates.
        upper: (n,) upper limits.
        q_a: (N, n) active coordinates of closed configurations.
        tip_positions: (N, 3) positions of the frame [m].
        section_positions: (N, 2) coordinates in the section [m].
        condition: (N,) condition number of gamma, see `Closure.condition_number`.
        least_singular_value: (N,) least singular value of d(u, w)/dq_A D_A [m].
        closed_share: Share of the box of strokes in which the loops close, connected with home.
        area: Covered area of the section [m2], 0 if it is a line.
        extremes: Extreme coordinates of the section.
        curves: Singular curves.
        patches: Grids of the configurations.
        stroke_map: Map over the two strokes that move the frame most.
        raster: Covered grid points of the section.
        is_complete: Whether a grid covers the strokes; else they were sampled at random, and the
            true workspace is larger.
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
        return (
            f"Workspace of '{self.frame}' of '{self.machine.name}': {len(self.tip_positions)} "
            f"configurations over {', '.join(self.strokes)}, {100 * self.closed_share:.3g} % "
            f"close, {self.area:.4g} m2"
        )

    def __len__(self) -> int:
        return len(self.q_a)

    def extreme(self, name: str) -> WorkspaceExtreme:
        """Extreme by its name."""
        return next(item for item in self.extremes if item.name == name)

    @property
    def slewing_joint_name(self) -> str | None:
        """Name of the slewing joint, None if there is none."""
        joint = self.section.slewing_joint
        return None if joint is None else self.machine.active[joint]

    def format_strokes(self, q_a: Array) -> str:
        """Text of the strokes of a configuration."""
        machine = self.machine
        return ", ".join(
            f"{joint} = {q_a[machine.active.index(joint)]:.4g} {machine.unit(joint)}"
            for joint in self.strokes
        )

    def _position_units(self) -> dict[str, str]:
        lengths = [
            "tip_x",
            "tip_y",
            "tip_z",
            *(f"section_{x}" for x in self.section.coordinate_names),
        ]
        units = {joint: self.machine.unit(joint) for joint in self.machine.active}
        return units | dict.fromkeys(lengths, "m")

    def to_csv(self, path: str | Path) -> None:
        """Write all configurations: strokes, tip, section coordinates, conditions.

        Raises:
            OutputError: The file cannot be written.
        """
        units = self._position_units() | {"condition": "1", "least_singular": "m"}
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
        units = {"curve": "1", "kind": "1"} | self._position_units()
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
        """Summary in Markdown: extremes, area, share of the strokes that closes, conditions."""
        machine, (u, w) = self.machine, self.section.coordinate_names
        lines = [
            f"# Workspace of {machine.name}\n",
            f"{len(self)} closed configurations; `{self.frame}` in the section ({u}, {w}).",
        ]
        if self.section.slewing_joint is not None:
            i = self.section.slewing_joint
            slewing_range = np.rad2deg([self.lower[i], self.upper[i]])
            lines.append(
                f"The section turns with `{machine.active[i]}` from {slewing_range[0]:.4g} to "
                f"{slewing_range[1]:.4g} degrees."
            )
        if not self.is_complete:
            lines.append(
                f"{len(self.strokes)} strokes are too many for a grid: they were drawn, and the "
                "true workspace is larger."
            )
        lines += ["", "| | | at |", "| --- | --- | --- |"]
        lines += [
            f"| {x.name} | {x.value:.4f} m | {self.format_strokes(x.q_a)} |" for x in self.extremes
        ]
        if self.area:
            lines.append(f"| area of the section | {self.area:.4g} m2 | |")
        worst, least = int(self.condition.argmax()), int(self.least_singular_value.argmin())
        has_branch_ends = any(curve.kind == "branch" for curve in self.curves)
        is_beside_end = has_branch_ends and bool(self.condition[worst] > 3)
        lines += [
            f"| share of the strokes that closes | {100 * self.closed_share:.4g} % | |",
            f"| largest condition of the drive | {self.condition[worst]:.3g}"
            f"{', beside the end of the branch' * is_beside_end} | "
            f"{self.format_strokes(self.q_a[worst])} |",
            f"| least singular value of the tip | {self.least_singular_value[least]:.3g} m "
            f"per scale | {self.format_strokes(self.q_a[least])} |",
            "",
            "| stroke | reaches | of its limits |",
            "| --- | --- | --- |",
        ]
        for joint in self.strokes:
            i = machine.active.index(joint)
            edges = [curve.q_a[:, i] for curve in self.curves if curve.kind == "branch"]
            reached = np.concatenate([self.q_a[:, i], *edges])
            limits = f"{self.lower[i]:.5g} to {self.upper[i]:.5g} {machine.unit(joint)}"
            lines.append(f"| {joint} | {reached.min():.5g} to {reached.max():.5g} | {limits} |")
        lines.append("")
        for kind, description in CURVE_KINDS.items():
            if count := sum(curve.kind == kind for curve in self.curves):
                lines.append(f"- {count} curve{'s' * (count != 1)}: {description}.")
        return "\n".join([*lines, ""])
