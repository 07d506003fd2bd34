"""Buckling of hydraulic cylinders: columns of rod and tube, pressed between two pins."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array, as_samples
from crane.hydraulics.components import Cylinder
from crane.machine import Machine

YOUNGS_MODULUS_STEEL = 2.1e11  # [Pa] Young's modulus
_PIN_LOOP_TYPES = ("revolute", "spherical", "cylindrical")  # loops that hold an end as a pin does
_SAME_PIN_TOLERANCE = 1e-6  # of the machine's size, that joints of one pin lie apart
_BISECTION_STEPS = 60
_MIN_ROD_RATIO = 1e-9  # of the whole length, that a rod sticks out at least


@dataclass(frozen=True)
class CylinderColumn:
    """A cylinder between two pins, or several side by side.

    Attributes:
        joint: Its joint.
        count: How many there are side by side.
        bore: Of one of them [m].
        rod: Diameter of its rod [m].
        tube: Outer diameter of its tube [m]; 0 where it is not known.
        pin_offset: From one pin to the other at q = 0, in the frame of what carries the joint [m].
        slide_axis: Of the slide in that frame, a unit vector.
        lower_limit: Least coordinate of the joint [m].
        upper_limit: Largest.
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
        """Pin to pin [m] at coordinates x of the joint [m], any shape."""
        pin_vector = self.pin_offset + np.asarray(x, dtype=np.float64)[..., None] * self.slide_axis
        return np.asarray(np.linalg.norm(pin_vector, axis=-1))

    @property
    def compression_sign(self) -> float:
        """1 where a force in the joint's direction presses the rod, -1 where it pulls it."""
        first, last = self.pin_distance([self.lower_limit, self.upper_limit])
        return 1.0 if last > first else -1.0

    @property
    def tube_length(self) -> float:
        """From the tube's pin to its gland [m].

        With the rod in, all but what sticks out then: one bore, or a fourth of what the cylinder
        has beside its stroke where that is less, as `crane.add_cylinder` builds them.
        """
        ends = self.pin_distance([self.lower_limit, self.upper_limit])
        least, stroke = float(ends.min()), self.upper_limit - self.lower_limit
        return least - min(self.bore, (least - stroke) / 4)

    def euler_load(self, x: ArrayLike) -> Array:
        """Euler's load of a rod that reaches from pin to pin: pi^2 E I / L^2.

        On the safe side wherever the tube is the stiffer part.

        Args:
            x: Coordinates of the joint [m], any shape.

        Returns:
            The same shape, of all side by side [N].
        """
        return np.pi**2 * self.count * _bending_stiffness(self.rod) / self.pin_distance(x) ** 2

    def buckling_load(self, x: ArrayLike) -> Array:
        """The load that buckles it: of rod and tube where the tube is known, else Euler's.

        Both parts bend as y'' = -k_i^2 y, k_i = sqrt(P / (E I_i)), from pins that hold no moment.
        At the gland y and y' are the same, so the least P > 0 with

            tan(k_1 L_1) / k_1 + tan(k_2 L_2) / k_2 = 0.

        It is the only zero of k_1 cot(k_1 L_1) + k_2 cot(k_2 L_2), which falls from 1/L_1 + 1/L_2
        without end, below the load of either part between pins of its own. Gland and piston are
        stiff and without play, the column straight, its weight left out.

        Args:
            x: Coordinates of the joint [m], any shape.

        Returns:
            The same shape, of all side by side [N].

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
    """Whether a machine's cylinders buckle.

    A cylinder counts that lies in a loop and has one pin at either end, so that what its ends are
    pressed with goes along it. One within a telescope is no body of the machine: where its pins
    are is not known.

    Args:
        machine: With a hydraulic circuit, whose bores, rods and tubes count.

    Attributes:
        columns: Those that count, by joint.
        unsupported: The others, and why, by joint.

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
        """The loads that buckle the cylinders, see `CylinderColumn.buckling_load`.

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
        """How many times the force that presses a cylinder buckles it.

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            tau_a: The same shape, forces of the active joints, as of `Dynamics.inverse` or
                `Reactions.drive_forces` [N], [N m].

        Returns:
            (c,) or (N, c) in the order of `columns`: 1 at the load that buckles it, more below it,
            infinite where it is pulled.

        Raises:
            InputError: Shapes that do not go together.
        """
        active = self.machine.active
        loads = self.buckling_loads(q_a)
        forces = as_samples(tau_a, len(active), "tau_a", active)
        if forces.shape[:-1] != loads.shape[:-1]:
            raise InputError(
                f"q_a and tau_a have the shapes {np.shape(q_a)} and {forces.shape}, give the same"
            )
        active_indices = [active.index(joint) for joint in self.columns]
        compressive_forces = forces[..., active_indices] * [
            column.compression_sign for column in self.columns.values()
        ]
        out = np.full_like(loads, np.inf)
        np.divide(loads, compressive_forces, out=out, where=compressive_forces > 0)
        return out


def _bending_stiffness(outer: float, inner: float = 0.0) -> float:
    """E I of a round bar or tube [N m2]."""
    return YOUNGS_MODULUS_STEEL * np.pi / 64 * (outer**4 - inner**4)


def _cylinder_column(machine: Machine, cylinder: Cylinder) -> CylinderColumn | str:
    """A cylinder as a column, or why it is none."""
    index = machine.column(cylinder.joint)
    if machine.unit(cylinder.joint) != "m":
        return "it turns its joint"
    if cylinder.rod == 0:
        return "its areas are the same, so its rod is not known"
    if not machine.closure.equations.sign[:, index].any():
        return "it is in no loop, so it has no pin at either end"
    joint = int(machine.coordinates.joints[index])
    carrier = int(machine.model.parents[joint])
    for body in (carrier, joint):
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
    """Where the joints and loops of a body are but its slide, and whether they are pins."""
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
