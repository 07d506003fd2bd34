"""What loads at rest depend on: weight, tip and passive forces, linear in the load."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crane.codegen import Layout
from crane.common.errors import ClosureError, InputError
from crane.common.samples import Array
from crane.dynamics.dynamics import Dynamics
from crane.machine import Machine


class AtRest(NamedTuple):
    """A machine at N postures, all in the world's directions.

    Attributes:
        moment: (N, 3) first moment of all masses, s = sum m c, about the origin [kg m].
        slopes: (N, 3, n) ds/dq_A.
        mass: (N,) of the machine [kg].
        passive: (N, n) gamma^T f, see `Dynamics.passive`.
        tip: (N, 3) [m].
        ways: (N, 3, n) dtip/dq_A.
    """

    moment: Array
    slopes: Array
    mass: Array
    passive: Array
    tip: Array
    ways: Array

    def held(self, gravity: Array) -> Array:
        """Active forces (N, n) that hold the machine: -(ds/dq_A)^T g - gamma^T f."""
        return -np.asarray(gravity @ self.slopes) - self.passive

    def under(self, force: Array) -> Array:
        """Active forces (N, n) against a force (3,) or (N, 3) at the tip: -(dtip/dq_A)^T F."""
        return -np.asarray(np.einsum("...i,...in->...n", force, self.ways))

    def some(self, which: NDArray[Any]) -> "AtRest":
        """Some of the postures, by index or mask."""
        return AtRest(*(x[which] for x in self))


class Statics:
    """A machine at rest, as machine code.

    With gravity g, a force F at the tip and forces tau_A of the active joints it is at rest where

        tau_A = -(ds/dq_A)^T g - gamma^T f - (dtip/dq_A)^T F.

    Args:
        machine: The machine; its free joints stay where the postures have them.
        frame: Where forces act; the tip if not given.

    Raises:
        InputError: There is no tip, or no such frame.
    """

    def __init__(self, machine: Machine, frame: str | None = None):
        frame = machine.tip if frame is None else frame
        if frame is None:
            raise InputError(f"'{machine.name}' has no tip, name a frame")
        machine.frame(frame)
        self.frame, self.machine = frame, dataclasses.replace(machine, tip=frame)
        self.dynamics = Dynamics(self.machine)
        self._n = len(machine.active)
        n = self._n
        self.layout = Layout(moment=3, slopes=3 * n, mass=1, passive=n, tip=3, ways=3 * n)

    def at(self, q: Array) -> AtRest:
        """At closed postures (N, nq), which are not checked."""
        still = np.zeros((len(q), self._n))
        return self._parts(self.dynamics.at("statics", np.ascontiguousarray(q), still, still))

    def closed(self, q: Array) -> tuple[Array, Array]:
        """Close the loops at the active coordinates of postures (N, nq) that are nearly closed.

        Returns:
            Postures (N, nq), and whether each is closed on the branch of home (N,).
        """
        closure = self.machine.closure
        q = np.array(q, order="C")
        done, good = 0, np.zeros(len(q), dtype=bool)
        while done < len(q):
            if closure.compiled:
                count = closure.fast.settle(q[done:])
                good[done : done + count] = True
                done += count + 1
                continue
            try:
                q[done] = closure.solve(q[done, closure.active], guess=q[done])
                good[done] = True
            except ClosureError:
                pass
            done += 1
        return q, good

    def derivatives(self, q: Array) -> AtRest:
        """By q_A, of all at closed postures (N, nq): each with one more axis (n,) at the end."""
        q_a = np.ascontiguousarray(q[:, self.machine.closure.active])
        found = self.dynamics.derivatives("statics", q_a, by=["q_a"])["q_a"]
        return self._parts(found)

    def by_numbers(self, q: Array, names: Sequence[str]) -> AtRest:
        """The same by named numbers of the machine, at the same q_A."""
        q_a = np.ascontiguousarray(q[:, self.machine.closure.active])
        found = self.dynamics.derivatives("statics", q_a, by=names)
        return self._parts(np.stack([found[name] for name in names], axis=-1))

    def _parts(self, rows: Array) -> AtRest:
        """Of rows (N, size, ...)."""
        parts, (count, _, *more) = self.layout, rows.shape

        def part(name: str, *shape: int) -> Array:
            return rows[:, parts[name]].reshape(count, *shape, *more)

        n = self._n
        return AtRest(
            part("moment", 3), part("slopes", 3, n), part("mass"), part("passive", n),
            part("tip", 3), part("ways", 3, n),
        )  # fmt: skip
