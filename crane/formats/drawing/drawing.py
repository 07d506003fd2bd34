"""A machine as a drawing has it: points, bodies between them, pins, cylinders, slides."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin

from crane.common.errors import DescriptionError, suggest_names, warn
from crane.common.samples import Array
from crane.description.drawing_schema import PIN_AXES, STEEL_DENSITY
from crane.description.findings import FollowUpError, error_recovery
from crane.description.kinematic_tree import Limits
from crane.formats.drawing.body_inertia import (
    plate_inertia,
    polygon_moments,
    rigid_inertia,
    scale_inertia,
    spread_inertia,
    tube_inertia,
)
from crane.formats.drawing.body_placement import place_bodies, read_point
from crane.formats.drawing.body_shapes import BarShape, PlateShape, equivalent_plate
from crane.formats.machine_file.yaml_section import YamlSection
from crane.formats.steel_cylinder import SteelCylinder, sum_inertias

# Of a body without mass: times the section of the largest pistons that act on it, over its length.
# Boom and arm of the bundled excavator have 1.6 and 1.9, the lift boom of the log crane 0.8.
_ESTIMATED_SECTION = 1.5
_BAR_SHARE = 0.05  # of the size of a body, as the thickness of lines between its points
# Angles count counterclockwise in the drawing, whose z points up: about -y.
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, -1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class DrawnBody:
    """A rigid body.

    Attributes:
        points: Names of its points.
        bars: Its shape: tubes, the edges of plates, or lines between its points.
        plates: Its plates and tubes.
        inertia: About its centre, along the axes of the drawing; the lever counts from the
            origin of the drawing.
        location: File and line.
    """

    points: tuple[str, ...]
    bars: tuple[BarShape, ...]
    inertia: pin.Inertia
    location: str
    plates: tuple[PlateShape, ...] = ()


@dataclass(frozen=True)
class DrawnPin:
    """What a pin permits.

    Attributes:
        axis: Unit vector (3,); None: a ball joint.
        is_driven: Whether a motor turns it.
        limits: Of its angle from the posture drawn.
        location: File and line.
    """

    axis: Array | None
    is_driven: bool = False
    limits: Limits = field(default_factory=Limits)
    location: str = ""


@dataclass(frozen=True)
class DrawnSlide:
    """A body that slides in another, or the rod of a cylinder in its barrel.

    Attributes:
        points: A point of each.
        shortest: Their distance at coordinate zero [m].
        stroke: Largest coordinate [m].
        location: File and line.
        bodies: Outer and inner body; none for a cylinder.
        is_driven: Whether a drive acts along it.
        cylinder: Dimensions of a cylinder.
        offsets: Positions of its cylinders across [m].
    """

    points: tuple[str, ...]
    shortest: float
    stroke: float
    location: str
    bodies: tuple[str, ...] = ()
    is_driven: bool = True
    cylinder: SteelCylinder | None = None
    offsets: tuple[float, ...] = (0.0,)

    @property
    def limits(self) -> Limits:
        """Limits of its coordinate."""
        return Limits(0.0, self.stroke)


@dataclass(frozen=True)
class Drawing:
    """A machine in the posture in which it is drawn.

    Attributes:
        base: The body that stands on the world.
        points: (3,) by name [m].
        bodies: By name.
        pins: What distinguishes some pins, by point.
        slides: By name of the joint; those of cylinders, too.
        location: File and line.
    """

    base: str
    points: Mapping[str, Array]
    bodies: Mapping[str, DrawnBody]
    pins: Mapping[str, DrawnPin]
    slides: Mapping[str, DrawnSlide]
    location: str

    def bodies_at(self, point: str) -> list[str]:
        """Return the bodies that have a point."""
        return [name for name, body in self.bodies.items() if point in body.points]

    def frame_name(self, body: str, point: str) -> str:
        """Return the name of the frame that a body has at a point."""
        return f"{body}_{point}" if len(self.bodies_at(point)) > 1 else point

    def distance(self, points: Sequence[str]) -> float:
        """Return the distance of two points [m]."""
        first, second = (self.points[name] for name in points)
        return float(np.linalg.norm(second - first))


def read_drawing(section: YamlSection) -> Drawing:
    """Read the section `drawing` of a machine file.

    Raises:
        DescriptionError: With file and line, in the terms of the drawing.
    """
    reader = _DrawingReader(section)
    with error_recovery():
        return reader.read()
    raise FollowUpError("the drawing is not complete")


class _DrawingReader:
    """Reads the parts of a drawing."""

    def __init__(self, section: YamlSection):
        self._section = section
        self._points: dict[str, Array] = {}
        self._placements: dict[str, pin.SE3] = {}  # of bodies with coordinates of their own
        self._piston_areas: dict[str, float] = {}  # by point the largest of cylinders there
        self._estimates: list[str] = []

    def read(self) -> Drawing:
        """Return the drawing."""
        section = self._section
        self._points = section.value_map("points", read_point)
        self._placements = place_bodies(section, self._points)
        cylinders = section.read_map("cylinders", self._read_cylinder)
        bodies = section.read_map("bodies", self._read_body)
        base = section.text("base")
        section.check_name("base", base, bodies, f"'base' is the unknown body '{base}'")
        slides = section.read_map("slides", lambda _, item: self._read_slide(item, bodies))
        pins = section.read_map("pins", lambda _, item: _read_pin(item), self._check_pin)
        parts: Mapping[str, Mapping[str, object]] = {
            "points": self._points, "cylinders": cylinders, "bodies": bodies, "slides": slides,
            "pins": pins,
        }  # fmt: skip
        if any(len(found) < len(section.item_names(key)) for key, found in parts.items()):
            raise FollowUpError("a part of the drawing is missing")
        if self._estimates:
            warn(
                f"{section.source_location('bodies')}: masses are estimated of "
                f"{', '.join(self._estimates)}, give mass, plates or tubes",
                stacklevel=4,
            )
        drawing = Drawing(
            base, self._points, bodies, pins, cylinders | slides, section.source_location()
        )
        for name in cylinders:
            with error_recovery():
                _check_reach(drawing, name)
        return drawing

    def _check_pin(self, name: str, location: str) -> None:
        if name not in self._points:
            problem = f"pin '{name}' is no point, {suggest_names(self._points, name)}"
            raise DescriptionError(f"{location}: {problem}")

    def _point_names(self, item: YamlSection, key: str, least: int = 2) -> tuple[str, ...]:
        """Names of known points."""
        names = item.names(key)
        for name in names:
            problem = f"{item.title} has the unknown point '{name}'"
            if name not in self._points and name in self._section.item_names("points"):
                raise FollowUpError("the point has been refused")
            item.check_name(key, name, self._points, problem)
        size = getattr(item.schema.keys[key], "size", None)
        if len(names) < least or (size is not None and len(names) != size):
            raise item.error_at(
                key, f"{item.title} has {len(names)} points under '{key}', give {size or least}"
            )
        return names

    def _coordinates(self, names: Sequence[str]) -> Array:
        return np.array([self._points[name] for name in names])

    def _read_cylinder(self, _: str, item: YamlSection) -> DrawnSlide:
        points = self._point_names(item, "points")
        values = item.values("points")
        count, spacing = values.pop("count", 1), values.pop("spacing", 0.0)
        shortest, stroke = self._range(item, points)
        if count < 1 or count % 1:
            raise item.error_at("count", f"{item.title} is there {count:g} times, give 1, 2, ...")
        cylinder = item.create(
            SteelCylinder.from_dimensions, values["bore"], values["rod"], stroke, shortest
        )
        for point in points:
            area = count * np.pi / 4 * cylinder.bore**2
            self._piston_areas[point] = max(self._piston_areas.get(point, 0.0), area)
        offsets = tuple(np.linspace(-spacing / 2, spacing / 2, int(count)).tolist())
        return DrawnSlide(
            points, shortest, stroke, item.source_location(), cylinder=cylinder,
            offsets=(0.0,) if count == 1 else offsets,
        )  # fmt: skip

    def _range(self, item: YamlSection, points: Sequence[str]) -> tuple[float, float]:
        """Return shortest length and stroke, between which the drawing has to be."""
        shortest, longest = item.number("shortest"), item.number("longest")
        if not longest > shortest:
            raise item.error_at(
                "longest", f"{item.title} is {shortest:g} to {longest:g} m long, exchange them"
            )
        first, second = self._coordinates(points)
        drawn = float(np.linalg.norm(second - first))
        if not shortest <= drawn <= longest:
            raise item.error_at(
                "points",
                f"{item.title} is {drawn:.4g} m from {' to '.join(points)} in the drawing, and "
                f"{shortest:g} to {longest:g} m long: move a point, or correct its lengths",
            )
        return shortest, longest - shortest

    def _read_slide(self, item: YamlSection, bodies: Mapping[str, DrawnBody]) -> DrawnSlide:
        names, points = item.names("bodies"), self._point_names(item, "points")
        if len(names) != 2:
            raise item.error_at("bodies", f"{item.title} is between two bodies, name both")
        for body, point in zip(names, points, strict=True):
            problem = f"{item.title} is of the unknown body '{body}'"
            item.check_name("bodies", body, bodies, problem)
            if point not in bodies[body].points:
                raise item.error_at(
                    "points",
                    f"point {point} of {item.title} is not on '{body}', "
                    f"{suggest_names(bodies[body].points, point)}",
                )
        is_driven = "driven" in item and item.boolean("driven")
        return DrawnSlide(
            points, *self._range(item, points), item.source_location(), names, is_driven
        )

    def _read_body(self, name: str, item: YamlSection) -> DrawnBody:
        placement = self._placements.get(name)
        points = (
            self._point_names(item, "points", least=1)
            if placement is None
            else item.item_names("points")
        )
        self._plates: list[PlateShape] = []
        parts = [*self._read_plates(item), *self._read_tubes(item)]
        mass = item.number("mass") if "mass" in item else None
        width = item.number("width") if "width" in item else 0.0
        bars = [bar for bars, _ in parts for bar in bars]
        if parts:
            body = sum_inertias(*(inertia for _, inertia in parts))
            body = body if mass is None else scale_inertia(body, mass)
        else:
            if mass is None:  # the base does not move
                is_base = name == self._section.text("base")
                mass = 0.0 if is_base else self._estimate_mass(name, item, points)
            body = spread_inertia(mass, self._coordinates(points), width)
        centre, tensor = body.lever, body.inertia
        if "centre" in item:
            centre = self._read_centre(item, placement or pin.SE3.Identity())
        if "inertia" in item:
            turn = np.eye(3) if placement is None else placement.rotation
            tensor = turn @ _read_tensor(item) @ turn.T
        if not np.isfinite([body.mass, width, *centre, *tensor.ravel()]).all():
            raise FollowUpError("a number of the body has been refused")
        return DrawnBody(
            points,
            tuple(bars or self._outline_bars(points)),
            rigid_inertia(body.mass, centre, tensor),
            item.source_location(),
            tuple(self._plates),
        )

    def _outline_bars(
        self, points: Sequence[str], width: float | None = None, y: float = 0.0
    ) -> list[BarShape]:
        """Return bars along a polygon, or a line of two points."""
        places = self._coordinates(points) + [0.0, y, 0.0]
        size = _BAR_SHARE * float(np.linalg.norm(np.ptp(places, axis=0)))
        last = len(places) if len(places) > 2 else len(places) - 1
        pairs = (np.array([places[i], places[(i + 1) % len(places)]]) for i in range(last))
        return [BarShape(ends, size, width) for ends in pairs if np.ptp(ends, axis=0).any()]

    def _read_plates(self, item: YamlSection) -> Iterator[tuple[list[BarShape], pin.Inertia]]:
        for plate in item.list_items("plates", f"a plate of {item.title}"):
            names = self._point_names(plate, "outline", least=3)
            outline = self._coordinates(names)
            values: dict[str, Any] = {"density": STEEL_DENSITY, "y": (0.0,)}
            values |= plate.values("outline")
            if polygon_moments(outline[:, [0, 2]])[0] == 0:
                raise plate.error_at("outline", f"{plate.title} has no area, order its points")
            for y in values["y"]:
                place = outline + [0.0, y, 0.0]
                self._plates.append(PlateShape(place, values["thickness"], values["density"]))
                yield (
                    self._outline_bars(names, values["thickness"], y),
                    plate_inertia(outline, values["thickness"], y, values["density"]),
                )

    def _read_tubes(self, item: YamlSection) -> Iterator[tuple[list[BarShape], pin.Inertia]]:
        for tube in item.list_items("tubes", f"a tube of {item.title}"):
            ends = self._coordinates(self._point_names(tube, "points"))
            if not np.ptp(ends, axis=0).any():
                raise tube.error_at("points", f"{tube.title} has no length, name other points")
            values: dict[str, Any] = {
                "width": None,
                "wall": None,
                "density": STEEL_DENSITY,
                "y": (0.0,),
            }
            values |= tube.values("points")
            for y in values.pop("y"):
                bar = BarShape(ends + [0.0, y, 0.0], values["height"], values["width"])
                inertia = tube_inertia(bar.ends, **values)
                self._plates.append(equivalent_plate(bar, inertia, values["density"]))
                yield [bar], inertia

    def _estimate_mass(self, name: str, item: YamlSection, points: Sequence[str]) -> float:
        known = self._piston_areas
        area = max([known[x] for x in points if x in known] or known.values(), default=0.0)
        places = self._coordinates(points)
        length = max(float(np.linalg.norm(a - b)) for a in places for b in places)
        mass = _ESTIMATED_SECTION * STEEL_DENSITY * area * length
        if not mass:
            raise item.error_at(None, f"{item.title} has no mass, give it mass, plates or tubes")
        self._estimates.append(f"'{name}' ({mass:.3g} kg)")
        return float(mass)

    def _read_centre(self, item: YamlSection, placement: pin.SE3) -> Array:
        if isinstance(item.raw_value("centre"), str):
            name = item.text("centre")
            problem = f"the centre of {item.title} is the unknown point '{name}'"
            item.check_name("centre", name, self._points, problem)
            return self._points[name]
        return np.asarray(placement.act(read_point(item, "centre")))


def _check_reach(drawing: Drawing, name: str) -> None:
    """Raise where a cylinder is shorter or longer than its ends can be apart.

    Ends with the arms a and b about the one pin of their bodies are |a - b| to a + b apart.
    """
    slide = drawing.slides[name]
    bodies = {body for point in slide.points for body in drawing.bodies_at(point)[:1]}
    pivots = [x for x in drawing.points if bodies <= {*drawing.bodies_at(x)}]
    names = (*pivots, *slide.points)
    is_planar = np.ptp([drawing.points[x][1] for x in names]) == 0
    if len(bodies) != 2 or len(pivots) != 1 or pivots[0] in drawing.pins or not is_planar:
        return
    arms = [drawing.distance((pivots[0], point)) for point in slide.points]
    least, most, longest = abs(arms[0] - arms[1]), sum(arms), slide.shortest + slide.stroke
    if slide.shortest < least or longest > most:
        raise DescriptionError(
            f"{slide.location}: cylinder '{name}' is {slide.shortest:g} to {longest:g} m long, "
            f"but its ends, which turn about {pivots[0]}, are {least:.4g} to {most:.4g} m "
            "apart: correct its lengths, or move a point"
        )


def _read_tensor(item: YamlSection) -> Array:
    """Return an inertia (3, 3) that is given by one, three or six numbers.

    One number is that about the y axis, of a flat body: xx = zz = yy / 2.
    """
    value = item.raw_value("inertia")
    numbers = item.numbers("inertia") if isinstance(value, list) else (item.number("inertia"),)
    if len(numbers) == 1:
        numbers = (numbers[0] / 2, numbers[0], numbers[0] / 2)
    if len(numbers) == 3:
        numbers = (*numbers, 0.0, 0.0, 0.0)
    if len(numbers) != 6:
        raise item.error_at(
            "inertia", f"the inertia of {item.title} has {len(numbers)} numbers, give 1, 3 or 6"
        )
    xx, yy, zz, xy, yz, xz = numbers
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _read_pin(item: YamlSection) -> DrawnPin:
    values, direction = item.values(), _read_axis(item)
    is_driven = values.pop("driven", False)
    if direction is None and (values or is_driven):
        raise item.error_at(
            None, f"{item.title} is a ball joint, which has no motor and no limits"
        )
    return DrawnPin(
        direction, is_driven, Limits(**values, source_location=item.source_location()),
        item.source_location(),
    )  # fmt: skip


def _read_axis(item: YamlSection) -> Array | None:
    """Return the unit vector (3,) of a pin, None for a ball joint."""
    if "axis" in item and isinstance(item.raw_value("axis"), list):
        axis = np.array(item.numbers("axis"))
        if len(axis) != 3 or not axis.any():
            raise item.error_at(
                "axis", f"the axis of {item.title} is no direction, give [x, y, z] or a name"
            )
        return np.asarray(axis / np.linalg.norm(axis))
    name = item.text("axis")
    if name not in PIN_AXES:
        raise FollowUpError("the axis has been refused")
    return None if name == "ball" else np.array(_AXES[name])
