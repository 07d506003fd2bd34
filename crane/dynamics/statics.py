"""Statics: holding forces under gravity, passive forces and a load at the tip."""

import dataclasses
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crane.codegen import Layout, run_with_fallback
from crane.common.errors import ClosureError, InputError
from crane.common.samples import Array
from crane.dynamics.dynamics import Dynamics
from crane.machine.machine import Machine


class StaticQuantities(NamedTuple):
    """Static quantities of a machine at N configurations, in the world's axes.

    Attributes:
        first_moment: (N, 3) first moment of all masses, s = sum m c, about the origin [kg m].
        moment_jacobian: (N, 3, n) ds/dq_A.
        total_mass: (N,) of the machine [kg].
        passive_forces: (N, n) gamma^T f, see `Dynamics.passive`.
        tip_positions: (N, 3) [m].
        tip_jacobian: (N, 3, n) dtip/dq_A.
    """

    first_moment: Array
    moment_jacobian: Array
    total_mass: Array
    passive_forces: Array
    tip_positions: Array
    tip_jacobian: Array

    def holding_forces(self, gravity: Array) -> Array:
        """Active forces (N, n) that hold the machine: -(ds/dq_A)^T g - gamma^T f."""
        return -np.asarray(gravity @ self.moment_jacobian) - self.passive_forces

    def tip_load_forces(self, force: Array) -> Array:
        """Active forces (N, n) against a force (3,) or (N, 3) at the tip: -(dtip/dq_A)^T F."""
        return -np.asarray(np.einsum("...i,...in->...n", force, self.tip_jacobian))

    def select(self, index: NDArray[Any]) -> "StaticQuantities":
        """The quantities of some configurations, by index or mask."""
        return StaticQuantities(*(x[index] for x in self))


class StaticsEvaluator:
    """Evaluates static quantities of a machine in machine code.

    With gravity g, a force F at the tip and forces tau_A of the active joints, equilibrium is

        tau_A = -(ds/dq_A)^T g - gamma^T f - (dtip/dq_A)^T F.

    Args:
        machine: The machine; its free joints stay at their coordinates.
        frame: Frame on which forces act; the tip if not given.

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
        n = self._n = len(machine.active)
        self.layout = Layout(
            moment=3, moment_jacobian=3 * n, mass=1, passive=n, tip=3, tip_jacobian=3 * n
        )

    def evaluate(self, q: Array) -> StaticQuantities:
        """Static quantities at closed configurations (N, nq), without checks."""
        still = np.zeros((len(q), self._n))
        return self._split_quantities(
            self.dynamics.evaluate_closed("statics", np.ascontiguousarray(q), still, still)
        )

    def close_loops(self, q: Array) -> tuple[Array, Array]:
        """Close the loops at the active coordinates of nearly closed configurations (N, nq).

        Returns:
            Configurations (N, nq), and whether each is closed on the branch of home (N,).
        """
        closure = self.machine.closure
        q, is_closed = np.array(q, order="C"), np.ones(len(q), dtype=bool)
        compiled = closure.compiled_closure if closure.is_compiled else None

        def close(i: int) -> None:
            is_closed[i] = False
            if compiled is None:
                with suppress(ClosureError):
                    q[i] = closure.solve(q[i, closure.active], initial_guess=q[i])
                    is_closed[i] = True

        run_with_fallback(
            len(q), None if compiled is None else lambda i: compiled.close_in_place(q[i:]), close
        )
        return q, is_closed

    def coordinate_derivatives(self, q: Array) -> StaticQuantities:
        """Derivatives by q_A at closed configurations (N, nq), along one more last axis (n,)."""
        q_a = np.ascontiguousarray(q[:, self.machine.closure.active])
        return self._split_quantities(self.dynamics.derivatives("statics", q_a, by=["q_a"])["q_a"])

    def parameter_derivatives(self, q: Array, names: Sequence[str]) -> StaticQuantities:
        """Derivatives by named parameters of the machine, at the same q_A."""
        found = self.dynamics.derivatives(
            "statics", np.ascontiguousarray(q[:, self.machine.closure.active]), by=names
        )
        return self._split_quantities(np.stack([found[name] for name in names], axis=-1))

    def _split_quantities(self, rows: Array) -> StaticQuantities:
        """Static quantities from rows (N, size, ...)."""
        parts, (count, _, *more) = self.layout, rows.shape

        def part(name: str, *shape: int) -> Array:
            return rows[:, parts[name]].reshape(count, *shape, *more)

        n = self._n
        return StaticQuantities(
            part("moment", 3), part("moment_jacobian", 3, n), part("mass"), part("passive", n),
            part("tip", 3), part("tip_jacobian", 3, n),
        )  # fmt: skip
