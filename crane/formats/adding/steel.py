"""A hydraulic cylinder of steel: its masses and what is drawn, from bore, rod and stroke."""

import math
import warnings
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common.errors import CraneWarning, InputError
from crane.common.magnitudes import LONGEST, doubt, meant
from crane.common.samples import as_number
from crane.description.rigid import inertial
from crane.description.tree import Inertial
from crane.formats.parts import text

DENSITY = 7850.0  # [kg/m3]
PRESSURE = 35e6  # [Pa] of a mobile machine's relief valve: with the bore the effort of the joint
_WALL = 0.1  # of the tube, as a share of the bore: 35 MPa stress its steel by 35 / 0.2 MPa


@dataclass(frozen=True)
class SteelCylinder:
    """A tube with a cap at its eye and a gland at the other end, a rod with a piston.

    Cap, piston, gland and what of the rod stays outside are each `part` long, which is one bore,
    or a fourth of what the retracted cylinder has beside its stroke where that is less. The tube's
    wall is a tenth of the bore, all is steel of 7850 kg/m3, oil is left out.

    Attributes:
        bore: D, of the tube inside [m].
        rod: d, diameter of the rod [m].
        stroke: S [m].
        retracted: L0, pin to pin with the rod in [m]; S + 4 D where it is not said.

    Raises:
        InputError: A length is not positive, or they do not fit into each other.
    """

    bore: float
    rod: float
    stroke: float
    retracted: float

    def __post_init__(self) -> None:
        if self.rod >= self.bore:
            raise InputError(
                f"the rod of {self.rod:g} m does not fit into the bore of {self.bore:g} m, "
                "choose a thinner one"
            )
        if self.retracted <= self.stroke:
            raise InputError(
                f"the dead length of {self.retracted:g} m is pin to pin with the rod in, it has "
                f"to be more than the stroke of {self.stroke:g} m"
            )

    @classmethod
    def of(
        cls, bore: float, rod: float, stroke: float, dead_length: float | None = None
    ) -> "SteelCylinder":
        """A cylinder from numbers of a user."""
        given = {"bore": bore, "rod": rod, "stroke": stroke}
        if dead_length is not None:
            given["dead length"] = dead_length
        for what, value in given.items():
            if as_number(value, f"the {what}", "m") <= 0:
                raise InputError(f"the {what} is {value:g} m, it must be positive")
            usual = "stroke" if what == "dead length" else what
            if value > LONGEST:
                looks = meant(usual, value) or ", longer than any part of a machine, give metres"
                raise InputError(f"the {what} is {value:g} m{looks}")
            if text := doubt(usual, value):
                warnings.warn(f"the {what} {text}", CraneWarning, stacklevel=4)
        bore, rod, stroke = float(bore), float(rod), float(stroke)
        return cls(bore, rod, stroke, stroke + 4 * bore if dead_length is None else dead_length)

    @property
    def part(self) -> float:
        """Length of cap, piston, gland and the rod outside [m]."""
        return min(self.bore, (self.retracted - self.stroke) / 4)

    @property
    def effort(self) -> float:
        """Force at `PRESSURE` on the piston [N]."""
        return PRESSURE * math.pi / 4 * self.bore**2

    @property
    def barrel(self) -> Inertial:
        """Of tube, cap and gland; x from its eye to the rod's."""
        end, part = self.retracted - self.part, self.part
        return _sum(
            _round(0, end, self.bore, (1 + 2 * _WALL) * self.bore),
            _round(0, part, 0, self.bore),
            _round(end - part, end, self.rod, self.bore),
        )

    @property
    def piston_rod(self) -> Inertial:
        """Of rod and piston; x as the barrel's, from the rod's eye."""
        back = 2 * self.part - self.retracted
        return _sum(_round(back, 0, 0, self.rod), _round(back - self.part, back, 0, self.bore))

    def draw(self, barrel: etree._Element, rod: etree._Element) -> None:
        """Put cylinders of the true diameters into two `<link>`s."""
        _drawn(barrel, 0, self.retracted - self.part, (1 + 2 * _WALL) * self.bore)
        _drawn(rod, 2 * self.part - self.retracted, 0, self.rod)


def _round(start: float, end: float, inner: float, outer: float) -> pin.Inertia:
    """Inertia of a tube along x between two places, with these diameters [m]."""
    length, squares = end - start, (inner**2 + outer**2) / 4
    mass = DENSITY * math.pi / 4 * (outer**2 - inner**2) * length
    across = mass * (3 * squares + length**2) / 12
    tensor = np.diag([mass * squares / 2, across, across])
    return pin.Inertia(mass, np.array([(start + end) / 2, 0, 0]), tensor)


def _sum(*parts: pin.Inertia) -> Inertial:
    whole = parts[0]
    for part in parts[1:]:
        whole = whole + part
    found = inertial(whole)
    assert found is not None
    return found


def _drawn(link: etree._Element, start: float, end: float, diameter: float) -> None:
    visual = etree.SubElement(link, "visual")
    etree.SubElement(
        visual, "origin", xyz=text([(start + end) / 2, 0, 0]), rpy=text([0, math.pi / 2, 0])
    )
    geometry = etree.SubElement(visual, "geometry")
    etree.SubElement(geometry, "cylinder", radius=text([diameter / 2]), length=text([end - start]))
