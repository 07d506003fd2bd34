"""Independent coordinates of a motion: those of the user, or others where these fail.

A machine's active coordinates q_A do not describe it everywhere: at a dead centre they turn back
and gamma = dq/dq_A is infinite, though the motion goes on as if nothing were there. In other
independent coordinates q_B, with gamma_B = dq/dq_B and C its rows that belong to q_A,

    v_A = C v_B,    tau_B = C^T tau_A.

A set of coordinates with an assembly branch around a posture is a chart of the machine's closed
postures (generalized coordinate partitioning, Wehage and Haug 1982).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from crane.closure.choice import choose, motions
from crane.closure.structure import Indices
from crane.closure.traced import folded
from crane.codegen.scalar import Expression, Number, dot
from crane.common.errors import ClosureError, InputError, MechanismError
from crane.common.samples import Array
from crane.dynamics import Dynamics
from crane.dynamics.external import AppliedAt, ExternalForces, form_of
from crane.machine import Machine
from crane.simulation.integration.sticking import Sticking

STEEP = 5.0  # entries of gamma, in shares of the machine's size, from which others are looked for
_BETTER = 3.0  # times smaller has a condition to be that changes coordinates
_EDGE = 1e-2  # share of the determinant at home, where the edge of a branch is near
_SINGULAR = 1e-12  # share of the largest singular value that counts as zero


@dataclass(frozen=True, eq=False)
class Chart:
    """A machine in independent coordinates, and those that its controller and its user see.

    Attributes:
        dynamics: Of the machine in the chart's coordinates.
        seen: (n,) columns of the joints whose coordinates and forces are the user's.
        sticking: What the joints do whose friction sticks, the same in all charts of a run.
        free: Those of the user's joints that nothing drives.
    """

    dynamics: Dynamics
    seen: Indices
    sticking: Sticking
    free: tuple[str, ...]

    @classmethod
    def of(cls, dynamics: Dynamics) -> "Chart":
        """The user's coordinates of a machine."""
        machine = dynamics.machine
        sticking = Sticking(machine, dynamics.forces.sticking)
        return cls(dynamics, machine.closure.active, sticking, machine.free)

    @property
    def machine(self) -> Machine:
        """The machine in the chart's coordinates."""
        return self.dynamics.machine

    @cached_property
    def own(self) -> bool:
        """Whether the chart's coordinates are the user's."""
        return np.array_equal(self.machine.closure.active, self.seen)

    @property
    def formulas(self) -> tuple:
        """What formulas of the chart depend on besides its loops."""
        dynamics = self.dynamics
        outside = form_of(self.machine)
        return folded(dynamics.pattern), dynamics.form, tuple(self.seen.tolist()), outside

    def check_free(self, tau: Sequence[Number], when: str = "") -> None:
        """See that no free joint gets a force (n,), in numbers or formulas.

        Raises:
            InputError: One does.
        """
        for column, force in zip(self.seen.tolist(), tau, strict=True):
            joint = self.machine.joints[column]
            if joint not in self.free or (not isinstance(force, Expression) and force == 0):
                continue
            size = "" if isinstance(force, Expression) else f" of {force:.3g}"
            raise InputError(
                f"the controller gives the free joint '{joint}' a force{size}{when}: give "
                "it 0.0, or name it under active if something drives it"
            )

    def turns(self, q: Array) -> Array:
        """C (n, n) of closed postures (nq,) or (N, nq): v_A = C v_B."""
        rows: Array = self.machine.closure.gamma(q)[..., self.seen, :]
        return rows

    def velocities(self, q: Array, v: Array) -> Array:
        """v_A, (n,) or (N, n), of the chart's velocities at closed postures."""
        return v if self.own else np.einsum("...ij,...j->...i", self.turns(q), v)

    def forces(self, q: Array, tau: Array) -> Array:
        """Forces (n,) along the chart's coordinates of the user's at a closed posture."""
        return tau if self.own else self.turns(q).T @ tau

    def outside(self, time: float, q: Array, v: Array, states: Array) -> AppliedAt:
        """What forces from outside do along the chart's coordinates.

        At a time [s], a closed posture (nq,), velocities (n,) and states of theirs.
        """
        if not self.machine.external:
            none: Array = np.zeros(0)
            return AppliedAt(np.zeros(len(v)), none, none, none)
        gamma = self.machine.closure.gamma(q)
        applied = self._external.along(time, q, gamma @ v, states)
        return applied._replace(forces=gamma.T @ applied.forces)

    @cached_property
    def _external(self) -> ExternalForces:
        return ExternalForces(self.machine, self.machine.external)

    def traced_forces(self, gamma: dict[int, list[Number]], tau: Sequence[Number]) -> list[Number]:
        """`forces` as formulas, with rows of gamma by body."""
        if self.own:
            return list(tau)
        rows = [gamma[column + 1] for column in self.seen.tolist()]
        return [dot(column, tau) for column in zip(*rows, strict=True)]

    @cached_property
    def limits(self) -> Array:
        """(2,) what is much for `steepest`, and a determinant that is little."""
        closure = self.machine.closure
        least = closure.fast.edge(closure.home) if closure.compiled else 0.0
        return np.array([max(STEEP, 2.0 * self.steepest(closure.home)), _EDGE * least])

    def steepest(self, q: Array) -> float:
        """The largest entry of gamma at a closed posture (nq,), in rad and the machine's size."""
        closure = self.machine.closure
        try:
            gamma = closure.gamma(q)
        except ClosureError:
            return np.inf
        shares = gamma / closure.units[:, None] * closure.units[closure.active]
        return float(np.abs(shares[closure.passive]).max(initial=0.0))

    def other(self, q: Array, better: float = _BETTER) -> "Chart | None":
        """A chart around a closed posture (nq,) whose condition is that many times smaller.

        Joints that are independent and move no other one much stay.
        """
        machine = self.machine
        closure, scale = machine.closure, machine.closure.equations.scales
        jacobian = closure.equations.evaluate(q)[1]
        basis = motions(jacobian, scale, _SINGULAR)
        active = closure.active
        if basis.shape[1] != len(active):
            return None

        def condition(columns: Indices) -> float:
            least = np.linalg.svd(basis[columns], compute_uv=False).min(initial=1.0)
            return 1.0 / max(float(least), 1e-300)

        now, everything = condition(active), range(machine.model.nv)
        # of the present coordinates those that move the others little
        try:
            moved = np.abs(basis @ np.linalg.inv(basis[active])).max(axis=0)
        except np.linalg.LinAlgError:
            moved = np.full(len(active), np.inf)
        floating = {c for first in machine.coordinates.floating for c in range(first, first + 6)}
        kept = [
            int(column)
            for column, size in zip(active, moved, strict=True)
            if column in floating or size < STEEP / 2
        ]
        for stay in (kept, sorted(floating & set(active.tolist()))):
            found = choose(basis, everything, stay)
            if found is not None and condition(found) * better < now:
                return self.moved(q, found)
        return None

    def moved(self, q: Array, columns: Indices) -> "Chart | None":
        """The chart of some coordinates around a closed posture (nq,), None where it has none."""
        names = tuple(self.machine.joints[i] for i in columns)
        try:
            machine = self.machine.seen_from(q, names)
        except MechanismError:
            return None
        # cylinders act, and grip, whatever the coordinates
        machine = replace(machine, hydraulics=self.machine.hydraulics)
        dynamics = Dynamics(machine, self.dynamics.formulation, self.dynamics.backend)
        return Chart(dynamics, self.seen, self.sticking, self.free)
