"""A hydraulic cylinder of steel: its masses and what is drawn, from bore, rod and stroke."""

import math
import warnings
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common.errors import CraneWarning, InputError
from crane.common.plausible_ranges import LONGEST, implausible_value_text, suggested_units_text
from crane.common.samples import as_number
from crane.description.kinematic_tree import Inertial
from crane.description.pinocchio_conversion import inertial_from_inertia
from crane.formats.urdf_output import format_numbers

STEEL_DENSITY = 7850.0  # [kg/m3]
RELIEF_PRESSURE = (
    35e6  # [Pa] of a mobile machine's relief valve: with the bore the effort of the joint
)
_WALL_SHARE = 0.1  # of the tube, as a share of the bore: 35 MPa stress its steel by 35 / 0.2 MPa


@dataclass(frozen=True)
class SteelCylinder:
    """A tube with a cap at its eye and a gland at the other end, a rod with a piston.

    Cap, piston, gland and what of the rod stays outside are each `part_length` long, which is one
    bore, or a fourth of what the retracted cylinder has beside its stroke where that is less. The
    tube's wall is a tenth of the bore, all is steel of 7850 kg/m3, oil is left out.

    Attributes:
        bore: D, of the tube inside [m].
        rod: d, diameter of the rod [m].
        stroke: S [m].
        retracted_length: L0, pin to pin with the rod in [m]; S + 4 D where it is not said.

    Raises:
        InputError: A length is not positive, or they do not fit into each other.
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
                f"it has "
                f"to be more than the stroke of {self.stroke:g} m"
            )

    @classmethod
    def from_dimensions(
        cls, bore: float, rod: float, stroke: float, dead_length: float | None = None
    ) -> "SteelCylinder":
        """A cylinder from numbers of a user."""
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
                warnings.warn(f"the {label} {warning}", CraneWarning, stacklevel=4)
        bore, rod, stroke = float(bore), float(rod), float(stroke)
        return cls(bore, rod, stroke, stroke + 4 * bore if dead_length is None else dead_length)

    @property
    def part_length(self) -> float:
        """Length of cap, piston, gland and the rod outside [m]."""
        return min(self.bore, (self.retracted_length - self.stroke) / 4)

    @property
    def max_force(self) -> float:
        """Force at `RELIEF_PRESSURE` on the piston [N]."""
        return RELIEF_PRESSURE * math.pi / 4 * self.bore**2

    @property
    def barrel_inertial(self) -> Inertial:
        """Of tube, cap and gland; x from its eye to the rod's."""
        barrel_end, part = self.retracted_length - self.part_length, self.part_length
        return _total_inertial(
            _tube_inertia(0, barrel_end, self.bore, (1 + 2 * _WALL_SHARE) * self.bore),
            _tube_inertia(0, part, 0, self.bore),
            _tube_inertia(barrel_end - part, barrel_end, self.rod, self.bore),
        )

    @property
    def rod_inertial(self) -> Inertial:
        """Of rod and piston; x as the barrel's, from the rod's eye."""
        back = 2 * self.part_length - self.retracted_length
        return _total_inertial(
            _tube_inertia(back, 0, 0, self.rod),
            _tube_inertia(back - self.part_length, back, 0, self.bore),
        )

    def add_visuals(self, barrel_link: etree._Element, rod_link: etree._Element) -> None:
        """Put cylinders of the true diameters into two `<link>`s."""
        _add_cylinder_visual(
            barrel_link,
            0,
            self.retracted_length - self.part_length,
            (1 + 2 * _WALL_SHARE) * self.bore,
        )
        _add_cylinder_visual(rod_link, 2 * self.part_length - self.retracted_length, 0, self.rod)


def _tube_inertia(start: float, end: float, inner: float, outer: float) -> pin.Inertia:
    """Inertia of a tube along x between two places, with these diameters [m]."""
    length, squares = end - start, (inner**2 + outer**2) / 4
    mass = STEEL_DENSITY * math.pi / 4 * (outer**2 - inner**2) * length
    transverse_moment = mass * (3 * squares + length**2) / 12
    tensor = np.diag([mass * squares / 2, transverse_moment, transverse_moment])
    return pin.Inertia(mass, np.array([(start + end) / 2, 0, 0]), tensor)


def _total_inertial(*inertias: pin.Inertia) -> Inertial:
    whole = inertias[0]
    for part in inertias[1:]:
        whole = whole + part
    found = inertial_from_inertia(whole)
    assert found is not None
    return found


def _add_cylinder_visual(link: etree._Element, start: float, end: float, diameter: float) -> None:
    visual = etree.SubElement(link, "visual")
    etree.SubElement(
        visual,
        "origin",
        xyz=format_numbers([(start + end) / 2, 0, 0]),
        rpy=format_numbers([0, math.pi / 2, 0]),
    )
    geometry = etree.SubElement(visual, "geometry")
    etree.SubElement(
        geometry,
        "cylinder",
        radius=format_numbers([diameter / 2]),
        length=format_numbers([end - start]),
    )
