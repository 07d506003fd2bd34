"""Buckling of hydraulic cylinders: columns of rod and tube under compression between two pins."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array, as_samples
from crane.hydraulics.components import Cylinder
from crane.machine.machine import Machine

YOUNGS_MODULUS_STEEL = 2.1e11  # [Pa] Young's modulus
_PIN_LOOP_TYPES = ("revolute", "spherical", "cylindrical")  # loop types that act like a pin
_SAME_PIN_TOLERANCE = 1e-6  # scaled distance of joints of one pin
_BISECTION_STEPS = 60
_MIN_ROD_RATIO = 1e-9  # least visible length of a rod, as a fraction of the whole


@dataclass(frozen=True)
class CylinderColumn:
    """A cylinder between two pins, or several in parallel.

    Attributes:
        joint: Name of its joint.
        count: Number of cylinders in parallel.
        bore: Bore of one cylinder [m].
        rod: Diameter of its rod [m].
        tube: Outer diameter of its tube [m]; 0 if unknown.
        pin_offset: From one pin to the other at q = 0, in the frame of the joint's carrier [m].
        slide_axis: Axis of the joint in that frame, a unit vector.
        lower_limit: Lower limit of the joint [m].
        upper_limit: Upper limit of the joint [m].
    """

    joint: str
    count: int
    bore: float
    rod: float
    tube: float
    pin_offset: Array
    slide_axis: Array
    lower_limit: float
    upper_limit: float

    def pin_distance(self, x: ArrayLike) -> Array:
        """Distance of the pins [m] at coordinates x of the joint [m], any shape."""
        pin_vector = self.pin_offset + np.asarray(x, dtype=np.float64)[..., None] * self.slide_axis
        return np.asarray(np.linalg.norm(pin_vector, axis=-1))

    @property
    def compression_sign(self) -> float:
        """1 if a positive joint force compresses the rod, -1 if it pulls it."""
        first, last = self.pin_distance([self.lower_limit, self.upper_limit])
        return 1.0 if last > first else -1.0

    @property
    def tube_length(self) -> float:
        """Length from the tube's pin to its gland [m].

        The retracted length without what sticks out: one bore, or a quarter of the dead length if
        that is less, as `crane.formats.add_cylinder` builds cylinders.
        """
        ends = self.pin_distance([self.lower_limit, self.upper_limit])
        least, stroke = float(ends.min()), self.upper_limit - self.lower_limit
        return least - min(self.bore, (least - stroke) / 4)

    def euler_load(self, x: ArrayLike) -> Array:
        """Euler load of a rod between the pins: pi^2 E I / L^2.

        A lower bound wherever the tube is the stiffer part.

        Args:
            x: Coordinates of the joint [m], any shape.

        Returns:
            The same shape, of all cylinders in parallel [N].
        """
        return np.pi**2 * self.count * _bending_stiffness(self.rod) / self.pin_distance(x) ** 2

    def buckling_load(self, x: ArrayLike) -> Array:
        """Buckling load: of rod and tube where the tube is known, else the Euler load.

        Both parts bend as y'' = -k_i^2 y, k_i = sqrt(P / (E I_i)), between frictionless pins. At
        the gland y and y' are continuous, which gives the least P > 0 with

            tan(k_1 L_1) / k_1 + tan(k_2 L_2) / k_2 = 0.

        It is the only zero of k_1 cot(k_1 L_1) + k_2 cot(k_2 L_2), which decreases from 1/L_1 +
        1/L_2 without bound, below the load of either part between its own pins. Gland and piston
        are rigid and without play, the column is straight, its weight is neglected.

        Args:
            x: Coordinates of the joint [m], any shape.

        Returns:
            The same shape, of all cylinders in parallel [N].

        Source: ISO/TS 13725:2021, after Hoblit, Critical buckling load for hydraulic actuating
        cylinders, Product Engineering, July 1950; the column: Timoshenko and Gere, Theory of
        Elastic Stability, 2.14.
        """
        if not self.tube:
            return self.euler_load(x)
        total_length = self.pin_distance(x)
        rod_length = np.maximum(total_length - self.tube_length, _MIN_ROD_RATIO * total_length)
        parts = (
            (_bending_stiffness(self.tube, self.bore), np.asarray(total_length - rod_length)),
            (_bending_stiffness(self.rod), rod_length),
        )
        low = np.zeros_like(total_length)
        high = np.minimum(*(np.pi**2 * stiff / length**2 for stiff, length in parts))
        for _ in range(_BISECTION_STEPS):
            middle = 0.5 * (low + high)
            characteristic = np.zeros_like(total_length)
            for bending_stiffness, length in parts:
                k = np.sqrt(middle / bending_stiffness)
                characteristic += k / np.tan(k * length)
            low, high = (
                np.where(characteristic > 0, middle, low),
                np.where(characteristic > 0, high, middle),
            )
        return np.asarray(self.count * 0.5 * (low + high))


class Buckling(OneLineRepr):
    """Buckling loads and margins of a machine's cylinders.

    Cylinders in a loop with one pin at either end are included: their end forces act along them.
    Cylinders within a telescope are not bodies of the machine, so that their pins are unknown.

    Args:
        machine: With a hydraulic circuit, which gives bores, rods and tubes.

    Attributes:
        columns: Included cylinders, by joint.
        unsupported: Reason why a cylinder is not included, by joint.

    Raises:
        InputError: It has no circuit.
    """

    def __init__(self, machine: Machine):
        if machine.hydraulics is None:
            raise InputError(
                f"'{machine.name}' has no cylinders, give it a circuit under 'hydraulics'"
            )
        self.machine = machine
        self.columns: dict[str, CylinderColumn] = {}
        self.unsupported: dict[str, str] = {}
        for joint, cylinder in machine.hydraulics.cylinders.items():
            made = _cylinder_column(machine, cylinder)
            if isinstance(made, str):
                self.unsupported[joint] = made
            else:
                self.columns[joint] = made

    def buckling_loads(self, q_a: ArrayLike) -> Array:
        """Loads at which the cylinders buckle, see `CylinderColumn.buckling_load`.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            (c,) or (N, c) in the order of `columns` [N].
        """
        active = self.machine.active
        given = as_samples(q_a, len(active), "q_a", active)
        out = np.empty((*given.shape[:-1], len(self.columns)))
        for i, (joint, column) in enumerate(self.columns.items()):
            out[..., i] = column.buckling_load(given[..., active.index(joint)])
        return out

    def buckling_margins(self, q_a: ArrayLike, tau_a: ArrayLike) -> Array:
        """Buckling load divided by the compressive force of each cylinder.

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            tau_a: The same shape, forces of the active joints, from `Dynamics.inverse` or
                `Reactions.drive_forces` [N], [N m].

        Returns:
            (c,) or (N, c) in the order of `columns`: 1 at the buckling load, more below it,
            infinite under tension.

        Raises:
            InputError: Shapes that do not match.
        """
        active = self.machine.active
        loads = self.buckling_loads(q_a)
        forces = as_samples(tau_a, len(active), "tau_a", active)
        if forces.shape[:-1] != loads.shape[:-1]:
            raise InputError(
                f"q_a and tau_a have the shapes {np.shape(q_a)} and {forces.shape}, give the same"
            )
        compressive_forces = forces[..., [active.index(joint) for joint in self.columns]] * [
            column.compression_sign for column in self.columns.values()
        ]
        out = np.full_like(loads, np.inf)
        np.divide(loads, compressive_forces, out=out, where=compressive_forces > 0)
        return out


def _bending_stiffness(outer: float, inner: float = 0.0) -> float:
    """E I of a round bar or tube [N m2]."""
    return YOUNGS_MODULUS_STEEL * np.pi / 64 * (outer**4 - inner**4)


def _cylinder_column(machine: Machine, cylinder: Cylinder) -> CylinderColumn | str:
    """A cylinder as a column, or the reason why it is not included."""
    index = machine.column(cylinder.joint)
    if machine.unit(cylinder.joint) != "m":
        return "it turns its joint"
    if cylinder.rod == 0:
        return "its areas are the same, so its rod is not known"
    if not machine.closure.equations.sign[:, index].any():
        return "it is in no loop, so it has no pin at either end"
    joint = int(machine.coordinates.joints[index])
    for body in (int(machine.model.parents[joint]), joint):
        places, turns = (
            zip(*_pins_of_body(machine, body, joint), strict=True) if body else ((), ())
        )
        if not places or not all(turns):
            return "one of its ends is no pin"
        if (
            np.ptp(places, axis=0).max()
            > _SAME_PIN_TOLERANCE * machine.closure.characteristic_length
        ):
            return "one of its ends has more than one pin"
    slide, limits = machine.tree.joints[cylinder.joint], machine.coordinates
    placed = machine.model.jointPlacements[joint]
    return CylinderColumn(
        cylinder.joint,
        cylinder.count,
        cylinder.bore,
        cylinder.rod,
        cylinder.tube,
        placed.act(places[0]),  # the carrier's own joint is where its frame is
        placed.rotation @ np.array(slide.axis),
        float(limits.lower[index]),
        float(limits.upper[index]),
    )


def _pins_of_body(machine: Machine, body: int, slide_joint: int) -> Iterator[tuple[Array, bool]]:
    """Positions of a body's joints and loops except one slide, and whether they are pins."""
    model, equations = machine.model, machine.closure.equations
    for joint in range(1, model.njoints):
        turns = "JointModelR" in model.joints[joint].shortname()
        if joint != slide_joint and joint == body:
            yield np.zeros(3), turns
        if joint != slide_joint and model.parents[joint] == body:
            yield model.jointPlacements[joint].translation.copy(), turns
    for i, (of, place) in enumerate(equations.frames):
        if of == body:
            yield place.translation.copy(), equations.loops[i // 2].type in _PIN_LOOP_TYPES
