"""Machines whose joints accelerate with a reference and something more; see `recursion`."""

from collections.abc import Sequence
from dataclasses import dataclass

from crane.closure.screws import Pair, Vector, by, carried, plus, shifted
from crane.closure.traced import Bodies, Loops, MovingBodies
from crane.codegen.scalar import Number
from crane.dynamics.inertia import Inertia

Hanging = tuple[Inertia, Pair]  # an inertia, and the wrench that it asks for at rest
Hung = dict[int, Hanging]  # what hangs on bodies, by their number, at their origin


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

    def force(self, i: int) -> Number:
        """What is left along a joint for more than the reference."""
        return self.forces[i] - self.rotors[i] * self.reference[i]

    def all_on(self, i: int, hung: Hung) -> Hanging:
        """A body and what hangs on it, at its origin."""
        mass, lever, tensor = self.masses[i - 1]
        inertia = Inertia.rigid(mass, lever, tensor)
        wrench = carried(self.wrenches[i - 1], lever)
        if i not in hung:
            return inertia, wrench
        return inertia + hung[i][0], plus(wrench, hung[i][1])

    def moved(self, i: int, carrier: Pair, rate: Number) -> Pair:
        """What a body accelerates more, from what its parent does."""
        return plus(shifted(carrier, self.posture.arms[i]), by(rate, self.posture.axes(i)))


def hang(hung: Hung, body: int, inertia: Inertia, bias: Pair) -> None:
    """Let something hang on a body."""
    if body in hung:
        inertia, bias = hung[body][0] + inertia, plus(hung[body][1], bias)
    hung[body] = inertia, bias
