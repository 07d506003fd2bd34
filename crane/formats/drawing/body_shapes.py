"""Shapes of the bodies of a drawing: bars and plates."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from crane.common.samples import Array
from crane.formats.drawing.body_inertia import bar_axes


@dataclass(frozen=True)
class BarShape:
    """A straight part of the shape of a body.

    Attributes:
        ends: (2, 3) centres of its end faces [m].
        height: In the plane of the drawing [m].
        width: Across it [m]; None: it is round.
    """

    ends: Array
    height: float
    width: float | None = None


@dataclass(frozen=True)
class PlateShape:
    """A plate in the plane of the drawing, or one with the section of a tube.

    Attributes:
        outline: (k, 3) points around it [m].
        thickness: [m].
        density: [kg/m3].
        reach: Height of the tube over that of its plate, which has the same area and moment.
    """

    outline: Array
    thickness: float
    density: float
    reach: float = 1.0


def equivalent_plate(bar: BarShape, inertia: pin.Inertia, density: float) -> PlateShape:
    """Return the plate with the mass, area A and moment I of a tube: height root(12 I / A)."""
    length, _, side, up = bar_axes(bar.ends)
    height = float(np.sqrt(12.0 * side @ inertia.inertia @ side / inertia.mass - length**2))
    outline = bar.ends[[0, 1, 1, 0]] + height / 2 * np.array([-up, -up, up, up])
    thickness = inertia.mass / (density * length * height)
    return PlateShape(outline, thickness, density, bar.height / height)
