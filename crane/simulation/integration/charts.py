"""Independent coordinates of a simulation: those of the user, or others where these fail.

The active coordinates q_A of a machine are not valid everywhere: at a dead centre they turn back
and gamma = dq/dq_A is infinite, although the motion is regular. In other independent coordinates
q_B, with gamma_B = dq/dq_B and C the rows of gamma_B that belong to q_A,

    v_A = C v_B,    tau_B = C^T tau_A.

A set of coordinates together with a branch around a configuration is a chart of the closed
configurations of a machine (generalized coordinate partitioning, Wehage and Haug 1982).

Where links become collinear (a folded parallelogram, a slider crank of equal lengths) the loop
equations lose rank: several branches of motion cross, and no chart is regular. The motion is
smooth along its own branch, so state and outputs are polynomials of time (`CrossingPolynomial`):
their rates at instants before the crossing, and then also behind it, are integrated across it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from crane.closure.active_joint_selection import null_space_basis, select_columns
from crane.closure.coordinates import Indices
from crane.closure.kinematics_formulas import folding_pattern
from crane.codegen import Layout
from crane.codegen.symbolic import Scalar, SymbolicExpression, dot
from crane.common.errors import ClosureError, InputError, MechanismError
from crane.common.samples import Array
from crane.control.control_law import Controller
from crane.control.valve_drive import ValveDrive
from crane.description.external_forces import WRENCH_COMPONENTS
from crane.dynamics.dynamics import Dynamics
from crane.dynamics.external_forces import (
    ExternalForces,
    ExternalForceValues,
    formula_key,
    state_count,
)
from crane.dynamics.joint_forces import find_stick_slip_columns
from crane.machine.machine import Machine
from crane.simulation.integration.stick_slip_modes import StickSlipModes

MAX_GAMMA_ENTRY = 5.0  # entry of gamma in coordinate units from which another chart is sought
MIN_IMPROVEMENT = 3.0  # least ratio of the condition numbers of the present and a new chart
# factors of the limits of a chart that is kept, also near its dead centres
KEPT_CHART_RELAXATION = np.array([2.0**12, 1e-12])
_SINGULAR_DETERMINANT_SHARE = 1e-2  # share of the determinant at home near the end of a branch
_RANK_TOLERANCE = 1e-12  # share of the largest singular value that counts as zero


@dataclass(frozen=True, eq=False)
class Chart:
    """A controlled machine in independent coordinates, with those of its user and controller.

    Attributes:
        dynamics: Dynamics of the machine in the coordinates of the chart.
        control: Its `Controller`; a `ControlLaw` where it is traced.
        controller_state_count: Number of states of the controller.
        user_columns: (n,) columns of the active joints of the user.
        stick_slip: Stick-slip modes of the joints, shared by all charts of a run.
        free_joints: Free joints among the active joints of the user.
    """

    dynamics: Dynamics
    control: Any
    controller_state_count: int
    user_columns: Indices
    stick_slip: StickSlipModes
    free_joints: tuple[str, ...]

    @classmethod
    def from_dynamics(
        cls, dynamics: Dynamics, control: Controller, controller_state_count: int
    ) -> "Chart":
        """The chart of the coordinates of the user."""
        machine = dynamics.machine
        return cls(
            dynamics,
            control,
            controller_state_count,
            machine.closure.active,
            StickSlipModes(machine, dynamics.forces.stick_slip_columns),
            machine.free,
        )

    @property
    def machine(self) -> Machine:
        """The machine in the coordinates of the chart."""
        return self.dynamics.machine

    @cached_property
    def has_user_coordinates(self) -> bool:
        """Whether the coordinates of the chart are those of the user."""
        return np.array_equal(self.machine.closure.active, self.user_columns)

    @property
    def formula_key(self) -> tuple:
        """Properties on which the formulas of the chart depend, besides its loops."""
        dynamics = self.dynamics
        return (
            folding_pattern(dynamics.constant_pattern),
            dynamics.formula_structure,
            tuple(self.user_columns.tolist()),
            formula_key(self.machine),
        )

    def check_free_joints(self, tau: Sequence[Scalar], when: str = "") -> None:
        """Check that no free joint has a force.

        Args:
            tau: (n,) forces, floats or formulas.
            when: End of the message.

        Raises:
            InputError: One does.
        """
        for column, force in zip(self.user_columns.tolist(), tau, strict=True):
            joint = self.machine.joints[column]
            if joint not in self.free_joints or (
                not isinstance(force, SymbolicExpression) and force == 0
            ):
                continue
            size = "" if isinstance(force, SymbolicExpression) else f" of {force:.3g}"
            raise InputError(
                f"the controller gives the free joint '{joint}' a force{size}{when}: give "
                "it 0.0, or name it under active if something drives it"
            )

    def velocity_map(self, q: Array) -> Array:
        """C (n, n) at closed configurations (nq,) or (N, nq): v_A = C v_B."""
        return self.machine.closure.gamma(q)[..., self.user_columns, :]

    def user_velocities(self, q: Array, v: Array) -> Array:
        """v_A, (n,) or (N, n), from velocities of the chart at closed configurations."""
        return (
            v
            if self.has_user_coordinates
            else np.einsum("...ij,...j->...i", self.velocity_map(q), v)
        )

    def chart_forces(self, q: Array, tau: Array) -> Array:
        """Forces (n,) along coordinates of the chart, from those of the user."""
        return tau if self.has_user_coordinates else self.velocity_map(q).T @ tau

    def external_forces(
        self, time: float, q: Array, v: Array, contact_states: Array
    ) -> ExternalForceValues:
        """External forces along the coordinates of the chart.

        Args:
            time: [s].
            q: (nq,) closed configuration.
            v: (n,) velocities of the chart.
            contact_states: States of the external forces.
        """
        if not self.machine.external_forces:
            empty: Array = np.zeros(0)
            return ExternalForceValues(np.zeros(len(v)), empty, empty, empty)
        gamma = self.machine.closure.gamma(q)
        applied = self._external_forces.generalized_forces(time, q, gamma @ v, contact_states)
        return applied._replace(generalized_forces=gamma.T @ applied.generalized_forces)

    @cached_property
    def _external_forces(self) -> ExternalForces:
        return ExternalForces(self.machine, self.machine.external_forces)

    def trace_chart_forces(
        self, gamma: dict[int, list[Scalar]], tau: Sequence[Scalar]
    ) -> list[Scalar]:
        """`chart_forces` as formulas, with rows of gamma by body."""
        if self.has_user_coordinates:
            return list(tau)
        rows = [gamma[column + 1] for column in self.user_columns.tolist()]
        return [dot(column, tau) for column in zip(*rows, strict=True)]

    @cached_property
    def chart_limits(self) -> Array:
        """(2,) largest accepted `largest_gamma_entry`, and least accepted determinant."""
        closure = self.machine.closure
        home_determinant = (
            closure.compiled_closure.least_determinant(closure.home)
            if closure.is_compiled
            else 0.0
        )
        return np.array(
            [
                max(MAX_GAMMA_ENTRY, 2.0 * self.largest_gamma_entry(closure.home)),
                _SINGULAR_DETERMINANT_SHARE * home_determinant,
            ]
        )

    def largest_gamma_entry(self, q: Array) -> float:
        """Largest entry of gamma at a closed configuration (nq,), in coordinate units."""
        closure = self.machine.closure
        try:
            gamma = closure.gamma(q)
        except ClosureError:
            return np.inf
        shares = gamma / closure.units[:, None] * closure.units[closure.active]
        return float(np.abs(shares[closure.passive]).max(initial=0.0))

    def find_better_chart(
        self, q: Array, min_improvement: float = MIN_IMPROVEMENT
    ) -> "Chart | None":
        """A chart at a closed configuration (nq,) whose condition number is smaller by a factor.

        Independent coordinates with small entries of gamma are kept.
        """
        machine = self.machine
        closure, scale = machine.closure, machine.closure.equations.motion_scales
        basis = null_space_basis(closure.equations.evaluate(q)[1], scale, _RANK_TOLERANCE)
        active = closure.active
        if basis.shape[1] != len(active):
            return None

        def condition(columns: Indices) -> float:
            return 1.0 / max(
                float(np.linalg.svd(basis[columns], compute_uv=False).min(initial=1.0)), 1e-300
            )

        now, everything = condition(active), range(machine.model.nv)
        # keep those of the present coordinates that have small entries of gamma
        try:
            largest_motions = np.abs(basis @ np.linalg.inv(basis[active])).max(axis=0)
        except np.linalg.LinAlgError:
            largest_motions = np.full(len(active), np.inf)
        floating = {
            c
            for first in machine.coordinates.floating_base_columns
            for c in range(first, first + 6)
        }
        required = [
            int(column)
            for column, size in zip(active, largest_motions, strict=True)
            if column in floating or size < MAX_GAMMA_ENTRY / 2
        ]
        for required_columns in (required, sorted(floating & set(active.tolist()))):
            chosen_columns = select_columns(basis, everything, required_columns)
            if chosen_columns is not None and condition(chosen_columns) * min_improvement < now:
                return self.chart_with_columns(q, chosen_columns)
        return None

    def chart_with_columns(self, q: Array, columns: Indices) -> "Chart | None":
        """The chart of some coordinates at a configuration (nq,); None if it is singular."""
        names = tuple(self.machine.joints[i] for i in columns)
        try:
            machine = self.machine.with_home_configuration(q, names)
        except MechanismError:
            return None
        # the circuit acts in any coordinates
        machine = replace(machine, hydraulics=self.machine.hydraulics)
        dynamics = Dynamics(machine, self.dynamics.formulation, self.dynamics.backend)
        return replace(self, dynamics=dynamics)

    @cached_property
    def state_layout(self) -> Layout:
        """Layout of the state: q (nv), v_a (n), contacts, controller, work, dissipated [J].

        `contacts` are the states of external forces: tangential deformations of tyres. `work` is
        that of the active forces, then of each external force.
        """
        machine = self.machine
        return Layout(
            q=machine.model.nv,
            v_a=len(machine.active),
            contacts=state_count(machine.external_forces),
            controller=self.controller_state_count,
            work=1 + len(machine.external_forces),
            dissipated=1,
        )

    @cached_property
    def output_layout(self) -> Layout:
        """Layout of the outputs.

        They are tau (n), friction (n), kinetic and potential energy [J], friction of joints at
        rest, wrench and channels of each external force, accelerations of all joints where the
        machine has supports, and channels of circuits.
        """
        machine, n = self.machine, len(self.machine.active)
        external_force_outputs = sum(
            len(WRENCH_COMPONENTS) + len(force.channels) for force in machine.external_forces
        )
        return Layout(
            tau=n, friction=n, kinetic=1, potential=1,
            friction_at_rest=len(find_stick_slip_columns(machine)),
            external=external_force_outputs, a=machine.model.nv if machine.supports else 0,
            channels=len(self.control.channels) if isinstance(self.control, ValveDrive) else 0,
        )  # fmt: skip

    @cached_property
    def row_layout(self) -> Layout:
        """Layout of a recorded row: the state, then the outputs."""
        return Layout(**self.state_layout.parts, **self.output_layout.parts)


NODES_BEFORE = 7  # nodes before the crossing
STEPS_BEFORE, STEPS_BEHIND = 2, 4  # steps from the last node to the crossing, and from there
NODES_BEHIND = 3  # nodes behind the crossing
MAX_MOTION_PER_STEP = 1e-2  # displacement of the fastest joint in coordinate units
MAX_RELATIVE_RANK = 0.05  # `relative_rank` at a crossing, as a share of that at home
_CORRECTIONS = 6

RateFunction = Callable[[float, Array], tuple[Array, Array]]
"""(time, state) -> rate of the state, outputs."""


def relative_rank(machine: Machine, q: Array) -> float:
    """Least over largest singular value of the loop equations at a configuration (nq,)."""
    equations, rows = machine.closure.equations, machine.closure.structure.independent_rows
    values = np.linalg.svd(
        equations.evaluate(q)[1][rows] * equations.motion_scales, compute_uv=False
    )
    return float(values[-1] / values[0]) if len(values) else 1.0


@dataclass(frozen=True)
class CrossingPolynomial:
    """State and outputs as polynomials of time.

    Attributes:
        times: (k,) nodes [s].
        start_state: State at the last node before the crossing.
        rates: (k, size) rates of the state at the nodes.
        outputs: (k, .) outputs at the nodes.
        nodes_before: Number of nodes before the crossing.
    """

    times: Array
    start_state: Array
    rates: Array
    outputs: Array
    nodes_before: int

    def rows(self, times: Array) -> Array:
        """States and outputs (N, .) at instants (N,) [s]."""
        origin = self.times[self.nodes_before - 1]
        unit = origin - self.times[self.nodes_before - 2]
        nodes, at = (self.times - origin) / unit, (np.asarray(times) - origin) / unit
        powers = np.arange(len(nodes))
        values = at[:, None] ** powers
        integrals = unit * values * at[:, None] / (powers + 1)
        weights = np.linalg.solve((nodes[:, None] ** powers).T, np.vstack([integrals, values]).T).T
        states = self.start_state + weights[: len(at)] @ self.rates
        return np.hstack([states, weights[len(at) :] @ self.outputs])

    def states(self, times: Array) -> Array:
        """States (N, size) at instants (N,) [s]."""
        return self.rows(times)[:, : len(self.start_state)]


def extrapolate_states(times: Array, states: Array, rate: RateFunction) -> CrossingPolynomial:
    """Extrapolation from states (k, size) at times (k,) [s]."""
    return CrossingPolynomial(times, states[-1], *_evaluate(times, states, rate), len(times))


def correct_polynomial(
    polynomial: CrossingPolynomial, time: float, rate: RateFunction
) -> CrossingPolynomial:
    """The polynomial with further nodes from an instant [s] behind the crossing on.

    It interpolates across the crossing; errors of an extrapolation would grow.
    """
    original, unit = polynomial, polynomial.times[1] - polynomial.times[0]
    node_times_behind = time + unit * np.arange(NODES_BEHIND)
    times = np.append(polynomial.times, node_times_behind)
    for _ in range(_CORRECTIONS):
        states = polynomial.states(node_times_behind)
        rates, outputs = _evaluate(node_times_behind, states, rate)
        polynomial = CrossingPolynomial(
            times,
            original.start_state,
            np.vstack([original.rates, rates]),
            np.vstack([original.outputs, outputs]),
            original.nodes_before,
        )
    return polynomial


def _evaluate(times: Array, states: Array, rate: RateFunction) -> tuple[Array, Array]:
    """Rates and outputs at times and states."""
    found = [rate(time, state) for time, state in zip(times, states, strict=True)]
    rates, outputs = (np.array(part) for part in zip(*found, strict=True))
    return rates, outputs
