"""Formulas of a machine with its controller, and their machine code."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from crane.closure.compiled_closure import CompiledClosure
from crane.closure.kinematics_formulas import FormulaConstants, wrap_rotation_vector
from crane.codegen import (
    Layout,
    LayoutView,
    Program,
    Scalar,
    SymbolicExpression,
    Tape,
)
from crane.codegen.differentiation import differentiate
from crane.codegen.symbolic import add_vectors, dot, subtract_vectors
from crane.common.errors import InputError
from crane.common.samples import Array
from crane.control.control_law import ControllerInputs, TracedController
from crane.control.valve_drive import ValveDrive
from crane.dynamics import external_forces
from crane.dynamics.dynamics_formulas import DynamicsFormulas, StickSlipAccelerations
from crane.machine.machine import Machine
from crane.simulation.integration.charts import Chart

AT_REST_SUFFIX = "_rest"  # of formulas for machines with joints at rest


def reference_samples(machine: Machine, control: TracedController, times: Array) -> Array:
    """References (N, c), which depend on time alone: of the controller, then of loads."""
    external_samples = external_forces.reference_samples(machine.external_forces, times)
    return np.ascontiguousarray(np.hstack([control.references(times), external_samples]))


def reference_count(control: TracedController) -> int:
    """Number of references of a controller."""
    return control.references(np.zeros(1)).shape[1]


@dataclass(frozen=True)
class MachineFormulas:
    """Formulas of a machine at a state.

    Attributes:
        chart: Chart of the state.
        dynamics_formulas: Dynamics of the machine.
        state_parts: Parts of the state.
        q_a: (n,) active coordinates of the user.
        v_a: (n,) their velocities.
        external_forces: External forces.
    """

    chart: Chart
    dynamics_formulas: DynamicsFormulas
    state_parts: LayoutView
    q_a: list[Scalar]
    v_a: list[Scalar]
    external_forces: external_forces.ExternalForceFormulas

    def controller_inputs(
        self, settings: list[Scalar], reference: list[Scalar]
    ) -> ControllerInputs:
        """Inputs of a controller."""
        states = self.q_a, self.v_a, self.state_parts.controller
        if not self.chart.has_user_coordinates:
            return ControllerInputs(
                *states, settings, reference, _raise_undetermined, _raise_undetermined
            )
        dynamics = self.dynamics_formulas
        return ControllerInputs(
            *states,
            settings,
            reference,
            dynamics.inverse_dynamics,
            lambda: list(dynamics.gravity_force),
        )

    def with_circuit_friction(
        self, control: TracedController, inputs: ControllerInputs
    ) -> "MachineFormulas":
        """The machine with the Coulomb friction of seals and brakes of a circuit."""
        dynamics = self.dynamics_formulas
        has_friction = bool(dynamics.formula_structure.circuit_friction_columns)
        if not has_friction or not isinstance(control, ValveDrive):
            return self
        friction = control.circuit_friction(inputs)
        return replace(self, dynamics_formulas=dynamics.with_circuit_friction(friction))

    def accelerations(
        self, tau: Sequence[Scalar], with_joints_at_rest: bool
    ) -> StickSlipAccelerations:
        """Accelerations under the forces of a controller, with or without joints at rest."""
        return self.dynamics_formulas.accelerations_with_stick_slip(
            self._applied_forces(tau), with_joints_at_rest
        )

    def state_rate(
        self, tau: Sequence[Scalar], controller_rate: Sequence[Scalar], with_joints_at_rest: bool
    ) -> tuple[list[Scalar], Scalar]:
        """Rate of the state, and the margin of stick-slip transitions.

        Args:
            tau: (n,) forces of the controller.
            controller_rate: (k,) rates of its states.
            with_joints_at_rest: Whether joints can be at rest.
        """
        accelerations = self.accelerations(tau, with_joints_at_rest)
        rate = [
            *self.dynamics_formulas.coordinate_derivatives,
            *accelerations.a_a,
            *self.external_forces.state_rates,
            *controller_rate,
            *self._powers(tau),
        ]
        return rate, accelerations.transition_margin

    def _applied_forces(self, tau: Sequence[Scalar]) -> list[Scalar]:
        """Forces of a controller and external forces along the coordinates of the chart."""
        return add_vectors(
            self.chart.trace_chart_forces(self.dynamics_formulas.gamma, tau),
            self.external_forces.active_forces,
        )

    def outputs(self, tau: Sequence[Scalar], with_joints_at_rest: bool) -> list[Scalar]:
        """Outputs without the channels of circuits; see `output_layout`."""
        accelerations = self.accelerations(tau, with_joints_at_rest)
        dynamics = self.dynamics_formulas
        a: list[Scalar] = []
        if self.chart.machine.supports:
            rows = sorted(dynamics.gamma.items())
            a = [dot(row, accelerations.a_a) + dynamics.drift[i] for i, row in rows]
        return [
            *tau,
            *accelerations.active_friction,
            dynamics.kinetic,
            dynamics.potential,
            *accelerations.friction_at_rest,
            *self.external_forces.outputs,
            *a,
        ]

    def forces_without_gravity(self, tau: Sequence[Scalar]) -> list[Scalar]:
        """All forces along the coordinates of the chart except for inertia and gravity."""
        return subtract_vectors(
            add_vectors(self._applied_forces(tau), self.dynamics_formulas.passive_force),
            self.dynamics_formulas.friction_force,
        )

    def stiffness(
        self, controller_rate: Sequence[Scalar], tau: Sequence[Scalar]
    ) -> list[list[Scalar]]:
        """Derivatives of controller rates and forces by the coordinates q_B of the chart.

        They are taken at constant gamma, without gravity and velocity-dependent forces.

        Args:
            controller_rate: (k,) rates of the states of the controller.
            tau: (n,) forces of the controller.

        Returns:
            (k + n, n).
        """
        gamma = self.dynamics_formulas.gamma
        user_coordinates = [x for x in self.q_a if isinstance(x, SymbolicExpression)]
        outputs = [*controller_rate, *self.chart.trace_chart_forces(gamma, tau)]
        rows = differentiate(outputs, user_coordinates)
        if not self.chart.has_user_coordinates:
            columns = list(
                zip(*(gamma[i + 1] for i in self.chart.user_columns.tolist()), strict=True)
            )
            rows = [[dot(row, column) for column in columns] for row in rows]
        passive = zip(rows[len(controller_rate) :], self.dynamics_formulas.stiffness, strict=True)
        return [
            *rows[: len(controller_rate)],
            *(add_vectors(one, other) for one, other in passive),
        ]

    def _powers(self, tau: Sequence[Scalar]) -> list[Scalar]:
        """Power of the controller, of each external force, and dissipated power [W]."""
        return [
            dot(tau, self.v_a),
            *self.external_forces.powers,
            self.dynamics_formulas.dissipated_power,
        ]


def _raise_undetermined(a_a: Sequence[Scalar] = (), friction: bool = False) -> list[Scalar]:
    raise InputError("inverse dynamics of coordinates that do not determine the motion")


def trace_machine(
    chart: Chart,
    tape: Tape,
    layout: Layout,
    state_argument: int,
    external_references: Sequence[Scalar],
    folded_constants: tuple[Array, Array] | None = None,
) -> MachineFormulas:
    """Trace the formulas of a machine.

    Args:
        chart: The machine in a chart.
        tape: The tape; its arguments 0 and 1 are geometry and constants of the dynamics.
        layout: Layout of the state.
        state_argument: Number of the argument that holds the state.
        external_references: References of the external forces.
        folded_constants: Geometry and constants that become part of the formulas, with NaN for
            those that remain arguments; those of the machine if not given.
    """
    dynamics, closure = chart.dynamics, chart.machine.closure
    geometry, pattern = folded_constants or (None, dynamics.constant_pattern)
    q, kinematics, loops = closure.compiled_closure.trace_kinematics(
        tape, 0, state_argument, geometry
    )
    parts = layout.view(tape.load_vector(state_argument, 0, layout.size))
    constants = FormulaConstants(tape, 1, pattern)
    dynamics_formulas = DynamicsFormulas(
        kinematics, loops, constants, q, parts.v_a, dynamics.formula_structure, use_modes=True
    )
    v_a = (
        parts.v_a
        if chart.has_user_coordinates
        else [dynamics_formulas.joint_velocities[i + 1] for i in chart.user_columns]
    )
    applied = external_forces.trace_external_forces(
        chart.machine, dynamics_formulas, external_references, parts.contacts
    )
    return MachineFormulas(
        chart, dynamics_formulas, parts, [q[i] for i in chart.user_columns], v_a, applied
    )


def wrap_rotations(chart: Chart, state: Sequence[Scalar]) -> list[Scalar]:
    """A state with rotation vectors of at most pi; its first part is q."""
    out = list(state)
    for column in chart.machine.coordinates.floating_base_columns:
        out[column + 3 : column + 6] = wrap_rotation_vector(out[column + 3 : column + 6])
    return out


def controller_formula_key(
    control: TracedController,
    reference_columns: int,
    chart: Chart,
    controller_state_count: int,
    fold_settings: bool,
) -> Hashable:
    """Formulas of a controller as a key, so that equal ones share their machine code.

    The controller is traced without the machine: the results of inverse dynamics and gravity are
    arguments.

    Args:
        control: The controller.
        reference_columns: Number of its references.
        chart: The machine in a chart.
        controller_state_count: Number of states of the controller.
        fold_settings: Whether zeros and ones among the settings become part of the formulas.

    Raises:
        InputError: The number of forces or rates is wrong, or a free joint gets a force.
    """
    tape, n = Tape(), len(chart.user_columns)
    requested_accelerations: list[Scalar] = []

    def inverse(a_a: Sequence[Scalar], friction: bool) -> list[Scalar]:
        forces = tape.load_vector(5, len(requested_accelerations), n)
        requested_accelerations.extend([*a_a, float(friction)])
        return forces

    inputs = ControllerInputs(
        q_a=tape.load_vector(0, 0, n),
        v_a=tape.load_vector(1, 0, n),
        state=tape.load_vector(2, 0, controller_state_count),
        settings=controller_settings(control, tape, 3, fold_settings),
        reference=tape.load_vector(4, 0, reference_columns),
        inverse=inverse,
        gravity=lambda: tape.load_vector(6, 0, n),
    )
    tau, rates = control.trace(inputs)
    if (len(tau), len(rates)) != (n, controller_state_count):
        raise InputError(
            f"the law of {type(control).__name__} gives {len(tau)} forces and {len(rates)} rates, "
            f"give {n} and {controller_state_count}: one per active joint, one per state"
        )
    chart.check_free_joints(tau)
    channels: list[Scalar] = []
    if isinstance(control, ValveDrive):
        channels = [*control.channel_values(inputs), *control.circuit_friction(inputs)]
    outputs = [
        [x.index if isinstance(x, SymbolicExpression) else float(x) for x in part]
        for part in (tau, rates, channels, requested_accelerations)
    ]
    # as text, in which the constant 2.0 and operation number 2 differ
    return repr((reference_columns, len(control.settings), tape.operations, outputs))


def machine_program(
    machine: Machine,
    control: TracedController,
    compiled_closure: CompiledClosure,
    key: tuple,
    build: Callable[[Program], None],
) -> Program:
    """Machine code of a machine with its controller.

    It is cached only if controller and external forces are classes of this package: the code of a
    class of the user may depend on more than the key.

    Args:
        machine: The machine.
        control: The controller.
        compiled_closure: The compiled closure of the machine.
        key: Properties on which the code depends, with `controller_formula_key`.
        build: Function that adds formulas and routines.

    Raises:
        FormulaTooLongError: The formulas are too long to be compiled.
    """
    parts: list[object] = [control, *machine.external_forces]
    if isinstance(control, ValveDrive):
        parts.append(control.command)
    if all(type(part).__module__.startswith("crane.") for part in parts):
        return compiled_closure.cached_program(key, build)
    return Program.from_cache(None, build)


def controller_settings(
    control: TracedController, tape: Tape, argument: int, fold_settings: bool
) -> list[Scalar]:
    """Settings of a controller, read from an argument."""
    size = len(control.settings)
    if fold_settings:
        return FormulaConstants(tape, argument, control.settings).vector(0, size)
    return tape.load_vector(argument, 0, size)
