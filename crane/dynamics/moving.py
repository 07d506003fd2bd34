"""Machines whose joints accelerate with a reference and something more; see `recursion`."""

from collections.abc import Sequence
from dataclasses import dataclass

from crane.closure.traced import Bodies, Loops, MovingBodies
from crane.codegen.scalar import Number, add
from crane.dynamics.inertia import Inertia, Pair, Vector, by, carried, plus, shifted

Hanging = tuple[Inertia, Pair]  # an inertia, and the wrench that it asks for at rest
Hung = dict[int, Hanging]  # what hangs on bodies, by their number, at their origin
NONE: Pair = ([0.0] * 3, [0.0] * 3)


@dataclass(frozen=True)
class Moving:
    """A machine in motion, whose joints accelerate with `reference` and something more.

    Attributes:
        posture: Its bodies.
        loops: Its loops.
        motion: Velocities, for the loops' second derivatives.
        reference: (nb + 1,) accelerations of the joints that `wrenches` belong to: what the loops
            ask for at a_A = 0 where clusters are projected, else 0.
        masses: Of every body mass, lever from its origin to the COM, inertia about the COM.
        wrenches: Of every body, about its COM, what it takes to accelerate it so, weight included.
        rotors: (nb + 1,) rotor inertias of the joints.
        forces: (nb + 1,) forces along the joints, those of the drives included.
    """

    posture: Bodies
    loops: Loops
    motion: MovingBodies
    reference: Vector
    masses: Sequence[tuple[Number, Vector, list[Vector]]]
    wrenches: Sequence[Pair]
    rotors: Vector
    forces: Vector

    def axis(self, i: int) -> Pair:
        """How the origin and the directions of a body move per unit of its joint's motion."""
        along = self.posture.axis(i)
        return (NONE[0], along) if self.posture.geometry.revolute[i] else (along, NONE[0])

    def force(self, i: int) -> Number:
        """What is left along a joint for more than the reference."""
        return self.forces[i] - self.rotors[i] * self.reference[i]

    def rigid(self, i: int, arm: Vector) -> Hanging:
        """Inertia and wrench of a body, referred to the point from which `arm` leads to it."""
        mass, lever, tensor = self.masses[i - 1]
        lever = add(arm, lever)
        return Inertia.rigid(mass, lever, tensor), carried(self.wrenches[i - 1], lever)

    def all_on(self, i: int, arm: Vector, hung: Hung) -> Hanging:
        """A body and what hangs on it, referred to the point from which `arm` leads to it."""
        inertia, wrench = self.rigid(i, arm)
        if i not in hung:
            return inertia, wrench
        return inertia + hung[i][0].carried(arm), plus(wrench, carried(hung[i][1], arm))

    def moved(self, i: int, carrier: Pair, rate: Number) -> Pair:
        """What a body accelerates more, from what its parent does."""
        return plus(shifted(carrier, self.posture.arms[i]), by(rate, self.axis(i)))


def hang(hung: Hung, body: int, inertia: Inertia, bias: Pair) -> None:
    """Let something hang on a body."""
    if body in hung:
        inertia, bias = hung[body][0] + inertia, plus(hung[body][1], bias)
    hung[body] = inertia, bias
