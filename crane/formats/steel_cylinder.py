"""Hydraulic cylinders of steel: dimensions, masses and shapes of barrel and rod."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common.errors import InputError, warn
from crane.common.plausible_ranges import LONGEST, implausible_value_text, suggested_units_text
from crane.common.samples import as_number
from crane.description.drawing_schema import STEEL_DENSITY
from crane.formats.drawing.body_inertia import tube_inertia
from crane.formats.xml_file import add_origin, format_numbers

RELIEF_PRESSURE = 35e6  # [Pa] usual in mobile machines; determines the effort of the joint
_WALL_SHARE = 0.1  # of the bore: at 35 MPa the stress in the tube is 35 / 0.2 MPa


@dataclass(frozen=True)
class SteelCylinder:
    """A tube with a cap at its eye and a gland at the other end, and a rod with a piston.

    Cap, piston, gland and the outer part of the rod have the length `part_length` each: one bore,
    or a fourth of the retracted length without the stroke if that is less. The wall of the tube is
    a tenth of the bore. All parts are steel of 7850 kg/m3; oil is neglected.

    Attributes:
        bore: D, inner diameter of the tube [m].
        rod: d, diameter of the rod [m].
        stroke: S [m].
        retracted_length: L0, pin to pin with the rod retracted [m]; S + 4 D by default.

    Raises:
        InputError: A length is not positive, or the parts do not fit into each other.
    """

    bore: float
    rod: float
    stroke: float
    retracted_length: float

    def __post_init__(self) -> None:
        if self.rod >= self.bore:
            raise InputError(
                f"the rod of {self.rod:g} m does not fit into the bore of {self.bore:g} m, "
                "choose a thinner one"
            )
        if self.retracted_length <= self.stroke:
            raise InputError(
                f"the dead length of {self.retracted_length:g} m is pin to pin with the rod in, "
                f"it has to be more than the stroke of {self.stroke:g} m"
            )

    @classmethod
    def from_dimensions(
        cls, bore: float, rod: float, stroke: float, dead_length: float | None = None
    ) -> "SteelCylinder":
        """Return a cylinder from dimensions of a user, which are checked."""
        dimensions = {"bore": bore, "rod": rod, "stroke": stroke}
        if dead_length is not None:
            dimensions["dead length"] = dead_length
        for label, value in dimensions.items():
            if as_number(value, f"the {label}", "m") <= 0:
                raise InputError(f"the {label} is {value:g} m, it must be positive")
            range_name = "stroke" if label == "dead length" else label
            if value > LONGEST:
                unit_hint = (
                    suggested_units_text(range_name, value)
                    or ", longer than any part of a machine, give metres"
                )
                raise InputError(f"the {label} is {value:g} m{unit_hint}")
            if warning := implausible_value_text(range_name, value):
                warn(f"the {label} {warning}", stacklevel=4)
        bore, rod, stroke = float(bore), float(rod), float(stroke)
        return cls(bore, rod, stroke, stroke + 4 * bore if dead_length is None else dead_length)

    @property
    def part_length(self) -> float:
        """Length of cap, piston, gland and the outer part of the rod [m]."""
        return min(self.bore, (self.retracted_length - self.stroke) / 4)

    @property
    def max_force(self) -> float:
        """Force at `RELIEF_PRESSURE` on the piston [N]."""
        return RELIEF_PRESSURE * math.pi / 4 * self.bore**2

    @property
    def barrel_inertia(self) -> pin.Inertia:
        """Inertia of tube, cap and gland; x points from the barrel's eye to the rod's."""
        barrel_end, part = self.retracted_length - self.part_length, self.part_length
        return sum_inertias(
            _round_inertia(0, barrel_end, self.bore, (1 + 2 * _WALL_SHARE) * self.bore),
            _round_inertia(0, part, 0, self.bore),
            _round_inertia(barrel_end - part, barrel_end, self.rod, self.bore),
        )

    @property
    def rod_inertia(self) -> pin.Inertia:
        """Inertia of rod and piston in the rod's eye, with x as for the barrel."""
        back = 2 * self.part_length - self.retracted_length
        return sum_inertias(
            _round_inertia(back, 0, 0, self.rod),
            _round_inertia(back - self.part_length, back, 0, self.bore),
        )


def sum_inertias(*inertias: pin.Inertia) -> pin.Inertia:
    """Return the inertia of several bodies together."""
    return sum(inertias[1:], start=inertias[0])


def _round_inertia(start: float, end: float, inner: float, outer: float) -> pin.Inertia:
    """Return the inertia of a round tube along x with two diameters [m]."""
    ends = np.array([[start, 0.0, 0.0], [end, 0.0, 0.0]])
    return tube_inertia(ends, outer, None, (outer - inner) / 2, STEEL_DENSITY)


def add_cylinder_visuals(
    barrel: etree._Element,
    rod: etree._Element,
    cylinder: SteelCylinder,
    offsets: Sequence[float] = (0.0,),
) -> None:
    """Add the shapes of tube and rod to their links, of several beside each other along y."""
    length, part = cylinder.retracted_length, cylinder.part_length
    for y in offsets:
        _add_bar_visual(barrel, 0, length - part, y, (1 + 2 * _WALL_SHARE) * cylinder.bore)
        _add_bar_visual(rod, 2 * part - length, 0, y, cylinder.rod)


def _add_bar_visual(
    link: etree._Element, start: float, end: float, y: float, diameter: float
) -> None:
    visual = etree.SubElement(link, "visual")
    add_origin(visual, ((start + end) / 2, y, 0), (0, math.pi / 2, 0))
    etree.SubElement(
        etree.SubElement(visual, "geometry"),
        "cylinder",
        {"radius": format_numbers([diameter / 2]), "length": format_numbers([end - start])},
    )
