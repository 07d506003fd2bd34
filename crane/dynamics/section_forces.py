"""Axial and shear force, bending moment and stress along a drawn body, and over a run."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from crane.common.errors import InputError, check_name
from crane.common.one_line_repr import OneLineRepr
from crane.common.result import Result
from crane.common.samples import Array
from crane.common.units import display_unit
from crane.description.external_forces import WRENCH_COMPONENTS
from crane.description.machine_schema import MACHINE
from crane.dynamics.frame_jacobians import frame_placement
from crane.dynamics.reactions import Reactions
from crane.formats.drawing.body_inertia import polygon_moments
from crane.formats.drawing.body_shapes import PlateShape
from crane.formats.drawing.drawing import DrawnBody, read_drawing
from crane.formats.machine_file.yaml_section import YamlSection
from crane.machine.machine import Machine
from crane.recordings.recording import Recording
from crane.recordings.timeseries import write_columns

_STATION_COUNT, _STATION_GAP = 201, 1e-9  # along a body; share of its length beside a load
SECTION_UNITS = {"axial_force": "N", "shear_force": "N", "bending_moment": "N m",
          "lower_stress": "Pa", "upper_stress": "Pa"}  # fmt: skip
_PLANE = [0, 2]  # axes of the plane of a drawing
_ZERO_MASS = 1e-9  # share of the mass of a body
_FLATNESS_TOLERANCE = 1e-6  # slope of an axis out of the plane of the drawing


class SectionForces(OneLineRepr):
    """Forces in the cross sections of a body that a drawing gives by plates and tubes.

    The axis e of the body goes from pin to pin, of those that are farthest apart; u is up across
    it in the plane of the drawing, y into the plane. With the accelerations a(r) less gravity, the
    mass at r before s and the wrenches (F_i, m_i) of joints and loads at s_i < s,

        (F, m) = integral of (a, r x a) dm - sum (F_i, m_i),
        N = e F,    Q = -u F,    M = -y (m about the axis at s),

    so that N pulls, M bends the lower side longer, and dM/ds = Q without a moment in between.
    Weight and inertia of the body are distributed; what the drawing does not have (a payload, a
    changed mass) acts at its centre of mass. With the section A, I and its centroid u_c,

        stress(u) = N / A - (M + N u_c) (u - u_c) / I.

    Forces across the plane, torsion and the stress of shear are not included.

    Args:
        machine: The machine of a machine file with a drawing.
        body: A body that moves.

    Attributes:
        positions: (S,) s [m], with two beside each point; 0 at the first pin.
        sections: (S, 5) A [m2], u_c [m], I [m4], lowest and highest u [m]; nan without section.

    Raises:
        InputError: The body has no sections, does not move, or leaves the plane of the drawing.

    Source: Gross et al., Engineering Mechanics 1 and 3 (stress resultants, d'Alembert).
    """

    def __init__(self, machine: Machine, body: str):
        self.machine, self._reactions = machine, Reactions(machine)
        section = YamlSection.read(machine.path, MACHINE).section("drawing")
        if section is None:
            raise InputError(f"{machine.path}: has no drawing, whose plates and tubes are needed")
        drawing = read_drawing(section)
        check_name(body, drawing.bodies, f"body '{body}' is not in the drawing of {machine.path}")
        drawn, self._joint = drawing.bodies[body], frame_placement(machine, body)[0]
        if not drawn.plates or not self._joint:
            problem = "stands on the world, name one that moves"
            problem = problem if drawn.plates else "has no plates and no tubes, add them"
            raise InputError(f"body '{body}' {problem}")
        self._model, self._data = machine.model, machine.model.createData()
        pin.forwardKinematics(
            self._model, self._data, machine.coordinates.configuration(machine.home)
        )
        ends = machine.closure.equations.frames
        parents, zero = list(self._model.parents)[1:], np.zeros(3)
        # wrenches with their signs, and the joints and points where they act
        self._loads = [(self._joint - 1, 1.0, self._joint, zero)]
        self._loads += [(k, -1.0, k + 1, zero) for k, x in enumerate(parents) if x == self._joint]
        for k, (joint, _) in enumerate(ends):
            if joint == self._joint:
                successor, placement = ends[k | 1]
                load = len(parents) + k // 2, 2.0 * (k % 2) - 1.0, successor
                self._loads.append((*load, placement.translation))
        pins = self._load_points()
        first, last = max(
            ((p, r) for p in pins for r in pins if p[0] <= r[0]),
            key=lambda pair: float(np.linalg.norm(pair[1] - pair[0])),
        )
        length = float(np.linalg.norm(last - first))
        if not length:
            raise InputError(f"body '{body}' has one pin and no axis, name one with two")
        self._first, self._axis = first, (last - first) / length
        if abs(self._axis[1]) > _FLATNESS_TOLERANCE:
            raise InputError(
                f"body '{body}' has pins beside the plane of the drawing, name one within it"
            )
        self._up = np.cross(self._axis, [0.0, 1.0, 0.0])
        name = drawn.points[0]
        link = f"{body}_{name}" if self._model.existFrame(f"{body}_{name}") else name
        origin = drawing.points[name] - frame_placement(machine, link)[1].translation
        marks = self._along(np.array([*pins, *(drawing.points[x] - origin for x in drawn.points)]))
        gap = _STATION_GAP * length
        spread = np.linspace(marks.min(), marks.max(), _STATION_COUNT)
        self.positions = np.unique(np.concatenate([spread, marks - gap, marks + gap]))
        self._add_plates(drawn, origin)

    def _add_plates(self, drawn: DrawnBody, origin: Array) -> None:
        plates = [(plate, plate.outline - origin) for plate in drawn.plates]
        whole = np.sum([_mass_moments(plate, outline) for plate, outline in plates], axis=0)
        factor = drawn.inertia.mass / whole[3, 3]
        total = self._model.inertias[self._joint].toPseudoInertia().toMatrix()
        rest, place = total - factor * whole, np.inf
        if abs(rest[3, 3]) > _ZERO_MASS * total[3, 3]:
            place = float(self._along(rest[:3, 3] / rest[3, 3]))
        self._moments = np.array([rest * (place < s) for s in self.positions])
        self.sections = np.full((len(self.positions), 5), np.nan)
        for i, s in enumerate(self.positions):
            strips = []
            for plate, outline in plates:
                before, crossings = _clip(outline, self._along(outline) - s)
                if len(before):
                    self._moments[i] += factor * _mass_moments(plate, before)
                heights = np.sort((crossings - self._first) @ self._up).reshape(-1, 2)
                strips += [(plate.thickness, *pair, plate.reach) for pair in heights]
            if strips:
                self.sections[i] = _section(np.array(strips))

    def evaluate(
        self,
        q: ArrayLike,
        v: ArrayLike,
        a: ArrayLike,
        wrenches: Mapping[str, ArrayLike] | None = None,
        friction: bool = False,
    ) -> Array:
        """N [N], Q [N] and M [N m] at the positions, (N, S, 3).

        Args:
            q: (N, nq) closed configurations [m], [rad].
            v: (N, nq) velocities [m/s], [rad/s].
            a: (N, nq) accelerations [m/s2], [rad/s2].
            wrenches: External wrenches (N, 6) by link, see `Reactions.joint_wrenches`.
            friction: See `Reactions.joint_wrenches`.
        """
        q, v, a = (np.asarray(x, dtype=np.float64) for x in (q, v, a))
        found = self._reactions.joint_wrenches(q, v, a, wrenches, friction)
        acting = [sign * found[:, k] for k, sign, *_ in self._loads]
        outside = []
        for link, given in (wrenches or {}).items():
            joint, placement = frame_placement(self.machine, link)
            if joint == self._joint:
                acting.append(np.broadcast_to(given, (len(q), 6)))
                outside.append(placement.translation)
        out = np.empty((len(q), len(self.positions), 3))
        for i, at in enumerate(self.machine.coordinates.configuration(q)):
            pin.forwardKinematics(self._model, self._data, at, v[i], a[i])
            turn = self._data.oMi[self._joint].rotation
            speed, rate = self._data.v[self._joint], self._data.a[self._joint]
            spin = pin.skew(speed.angular)
            field = np.column_stack([
                pin.skew(rate.angular) + spin @ spin,
                rate.linear + spin @ speed.linear - turn.T @ self._model.gravity.linear,
            ])  # fmt: skip
            sums = field @ self._moments  # integrals of a r^T and of a
            force, moment = sums[:, :, 3], sums[:, 0, 2] - sums[:, 2, 0]
            for wrench, point in zip(acting, [*self._load_points(), *outside], strict=True):
                push, about = turn.T @ wrench[i, :3], turn.T @ wrench[i, 3:]
                before = self._along(point) < self.positions
                force = force - before[:, None] * push
                moment = moment - before * (about + np.cross(point, push))[1]
            centres = self._first + self.positions[:, None] * self._axis
            moment = moment - np.cross(centres, force)[:, 1]
            out[i] = np.column_stack([force @ self._axis, -force @ self._up, -moment])
        return out

    def stresses(self, forces: Array) -> Array:
        """Stress [Pa] at the lower and at the upper side, (..., S, 2), of forces (..., S, 3)."""
        area, centroid, second, *sides = self.sections.T
        bending = (forces[..., 2] + forces[..., 0] * centroid) / second
        axial = forces[..., 0] / area
        return np.stack([axial - bending * (side - centroid) for side in sides], axis=-1)

    def _along(self, points: Array) -> Array:
        return np.asarray((points - self._first) @ self._axis)

    def _load_points(self) -> list[Array]:
        """Where the joints act, in the frame of the body, at the present configuration."""
        body = self._data.oMi[self._joint]
        return [body.actInv(self._data.oMi[k].act(point)) for _, _, k, point in self._loads]


def _mass_moments(plate: PlateShape, outline: Array) -> Array:
    """Integral (4, 4) of (r, 1) (r, 1)^T over the mass of a plate within an outline."""
    area, centroid, moments = polygon_moments(outline[:, _PLANE])
    place = np.insert(centroid, 1, outline[0, 1])
    out = area * np.outer([*place, 1.0], [*place, 1.0])
    out[np.ix_(_PLANE, _PLANE)] += moments
    return plate.density * plate.thickness * out


def _clip(outline: Array, heights: Array) -> tuple[Array, Array]:
    """The part of an outline with negative heights, and where it crosses 0."""
    after = np.roll(heights, -1)
    crosses = (heights < 0) != (after < 0)
    shares = heights / np.where(crosses, heights - after, 1.0)
    places = outline + shares[:, None] * (np.roll(outline, -1, axis=0) - outline)
    both = np.stack([outline, places], axis=1).reshape(-1, 3)
    kept = np.stack([heights < 0, crosses], axis=1).ravel()
    return both[kept], places[crosses]


def _section(strips: Array) -> Array:
    """Area, centroid, second moment, lowest and highest point of strips (k, 4)."""
    thickness, low, high, reach = strips.T
    heights, centres = high - low, (low + high) / 2
    areas = thickness * heights
    centroid = areas @ centres / areas.sum()
    second = areas @ (heights**2 / 12 + (centres - centroid) ** 2)
    outer = reach * heights / 2
    return np.array(
        [areas.sum(), centroid, second, (centres - outer).min(), (centres + outer).max()]
    )


@dataclass(eq=False, repr=False)
class SectionChart(Result):
    """Lowest and highest section forces and stresses along a body over a run.

    Attributes:
        machine_name: Name of the machine.
        body: Name of the body.
        positions: (S,) along its axis from the first pin [m].
        envelopes: Lowest and highest (2, S) axial force, shear force [N], bending moment [N m],
            stress at the lower and at the upper side [Pa], by name.
        instants: When the largest absolute value of each occurs [s].
    """

    machine_name: str
    body: str
    positions: Array
    envelopes: Mapping[str, Array]
    instants: Mapping[str, float]

    def to_csv(self, path: str | Path) -> None:
        """Write the envelopes along the axis.

        Raises:
            OutputError: The file cannot be written.
        """
        units = {"position": "m"}
        units |= {
            f"{x}_{side}": SECTION_UNITS[x] for x in self.envelopes for side in ("min", "max")
        }
        columns = [row for envelope in self.envelopes.values() for row in envelope]
        write_columns(path, units, [self.positions, *columns], {"machine": self.machine_name})

    def to_markdown(self) -> str:
        """A table of the largest values, with their positions and instants."""
        rows = [
            "| | lowest | highest | largest at | at time |",
            "| --- | ---: | ---: | ---: | ---: |",
        ]
        for name, envelope in self.envelopes.items():
            peak = np.nan_to_num(np.abs(envelope)).max(axis=0)
            unit, scale = section_unit(SECTION_UNITS[name], float(peak.max()))
            low, high = (
                round(float(scale * x), 6) + 0.0
                for x in (np.nanmin(envelope), np.nanmax(envelope))
            )
            place = self.positions[peak.argmax()]
            rows.append(
                f"| {name.replace('_', ' ')} | {low:.4g} {unit} | {high:.4g} {unit} "
                f"| {place:.3f} m | {self.instants[name]:.4g} s |"
            )
        return "\n".join([f"# Sections of {self.body}, {self.machine_name}", "", *rows, ""])


def section_unit(unit: str, peak: float) -> tuple[str, float]:
    """Display unit of a value up to a peak (in SI), and its number per SI unit."""
    return ("MPa", 1e-6) if unit == "Pa" else display_unit(unit, peak)


def section_chart(machine: Machine, recording: Recording, body: str) -> SectionChart:
    """Evaluate `SectionForces` at every sample of a run.

    Accelerations are differences of the recorded velocities; recorded external forces act where
    the machine has them.

    Args:
        machine: The machine, of a file with a drawing.
        recording: The run.
        body: The body.

    Raises:
        InputError: See `SectionForces`.
    """
    sections, closure = SectionForces(machine, body), machine.closure
    q, v_a = closure.solve(recording.q), recording.v
    gamma, a_a = closure.gamma(q), np.gradient(v_a, recording.time, axis=0)
    v = np.einsum("nij,nj->ni", gamma, v_a)
    a = np.einsum("nij,nj->ni", gamma, a_a) + closure.drift(q, v)
    wrenches: dict[str, Array] = {}
    for force in machine.external_forces:
        names = [f"load_{force.name}_{x}" for x in WRENCH_COMPONENTS]  # those that are not 0
        parts = [recording.channels.get(x, 0.0 * recording.time) for x in names]
        wrenches[force.frame] = wrenches.get(force.frame, 0.0) + np.column_stack(parts)
    forces = sections.evaluate(q, v, a, wrenches)
    values = np.concatenate([forces, sections.stresses(forces)], axis=2)
    instants = np.nan_to_num(np.abs(values)).max(axis=1).argmax(axis=0)
    envelopes = np.stack([values.min(axis=0), values.max(axis=0)]).transpose(2, 0, 1)
    return SectionChart(
        machine.name, body, sections.positions, dict(zip(SECTION_UNITS, envelopes, strict=True)),
        dict(zip(SECTION_UNITS, recording.time[instants].tolist(), strict=True)),
    )  # fmt: skip
