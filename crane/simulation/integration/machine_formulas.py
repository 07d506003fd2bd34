"""Formulas of a machine with its controller, and their machine code."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from crane.closure.kinematics_formulas import FormulaConstants, wrap_rotation_vector
from crane.codegen import (
    LayoutView,
    Program,
    Scalar,
    SymbolicExpression,
    Tape,
    max_abs,
)
from crane.codegen.differentiation import differentiate
from crane.codegen.symbolic import add_vectors, dot, matvec, subtract_vectors
from crane.codegen.symbolic_linear_algebra import LdltFactorization
from crane.common.errors import InputError
from crane.common.samples import Array
from crane.control.control_law import ControlLaw, ControllerInputs
from crane.control.valve_drive import ValveDrive
from crane.dynamics import external_forces
from crane.dynamics.dynamics_formulas import DynamicsFormulas, StickSlipAccelerations
from crane.machine.machine import Machine
from crane.simulation.integration.charts import Chart

AT_REST_SUFFIX = "_rest"  # of formulas for machines with joints at rest


def reference_samples(machine: Machine, control: ControlLaw, times: Array) -> Array:
    """References (N, c), which depend on time alone: of the controller, then of loads."""
    samples = control.references(times)
    if machine.external_forces:
        external_samples = external_forces.reference_samples(machine.external_forces, times)
        samples = np.hstack([samples, external_samples])
    return np.ascontiguousarray(samples)


def reference_count(control: ControlLaw) -> int:
    """Number of references of a controller."""
    return control.references(np.zeros(1)).shape[1]


@dataclass(frozen=True)
class MachineFormulas:
    """Formulas of a machine with its controller at a state.

    Attributes:
        chart: Chart of the state.
        dynamics_formulas: Dynamics of the machine, with the friction of a circuit.
        state_parts: Parts of the state.
        q_a: (n,) active coordinates of the user.
        v_a: (n,) their velocities.
        external_forces: External forces.
        inputs: Inputs of the controller.
        tau: (n,) its forces.
        controller_rate: (k,) rates of its states.
    """

    chart: Chart
    dynamics_formulas: DynamicsFormulas
    state_parts: LayoutView
    q_a: list[Scalar]
    v_a: list[Scalar]
    external_forces: external_forces.ExternalForceFormulas
    inputs: ControllerInputs
    tau: Sequence[Scalar]
    controller_rate: Sequence[Scalar]

    def accelerations(self, with_joints_at_rest: bool) -> StickSlipAccelerations:
        """Accelerations under the forces of the controller, with or without joints at rest."""
        return self.dynamics_formulas.accelerations_with_stick_slip(
            self._applied_forces, with_joints_at_rest
        )

    def state_rate(self, with_joints_at_rest: bool) -> tuple[list[Scalar], Scalar]:
        """Rate of the state, and the margin of stick-slip transitions."""
        accelerations = self.accelerations(with_joints_at_rest)
        rate = [
            *self.dynamics_formulas.coordinate_derivatives,
            *accelerations.a_a,
            *self.external_forces.state_rates,
            *self.controller_rate,
            dot(self.tau, self.v_a),
            *self.external_forces.powers,
            self.dynamics_formulas.dissipated_power,
        ]
        return rate, accelerations.transition_margin

    @property
    def _applied_forces(self) -> list[Scalar]:
        """Forces of the controller and external forces along the coordinates of the chart."""
        return add_vectors(
            self.chart.trace_chart_forces(self.dynamics_formulas.gamma, self.tau),
            self.external_forces.active_forces,
        )

    def stiction_problem(self, inverse_velocities: Sequence[float]) -> dict[str, list[Scalar]]:
        """The problem of joints at rest, with momenta p = C^T v_A, M_A = C C^T.

        Args:
            inverse_velocities: (k,) one over the velocities that speeds are compared with.

        Returns:
            directions (k, n), C^-1 Gamma^T of each joint with stiction; inverse_root (n, n),
            C^-T; net (n,) C^-1 f; momentum (n,); velocities, drift and limits (k,) of the joints;
            speeds (k,) relative to those given; motion, the largest velocity v_A; size, the
            largest absolute value of all, not finite where M_A is singular.
        """
        dynamics, v_a = self.dynamics_formulas, self.state_parts.v_a
        n, k = len(v_a), len(inverse_velocities)
        entries = dynamics.stick_slip_equations(self._applied_forces)
        mass = [entries[n * i : n * (i + 1)] for i in range(n)]
        rows = [entries[n * (n + i) : n * (n + i + 1)] for i in range(k)]
        root = LdltFactorization(mass)
        velocities = matvec(rows, v_a)
        parts = {
            "directions": [x for row in rows for x in root.root_solve(row)],
            "inverse_root": [
                x for i in range(n) for x in root.root_solve([float(i == j) for j in range(n)])
            ],
            "net": root.root_solve(entries[-n:]),
            "momentum": root.root_multiply(v_a),
            "velocities": velocities,
            "drift": entries[n * (n + k) : -n],
            "limits": dynamics.breakaway_forces,
            "speeds": [x * s for x, s in zip(velocities, inverse_velocities, strict=True)],
            "motion": [max_abs(v_a)],
        }
        return {**parts, "size": [max_abs([x for part in parts.values() for x in part])]}

    def outputs(self, with_joints_at_rest: bool) -> list[Scalar]:
        """Outputs without the channels of circuits; see `output_layout`."""
        accelerations = self.accelerations(with_joints_at_rest)
        dynamics = self.dynamics_formulas
        a: list[Scalar] = []
        if self.chart.machine.supports:
            a = [
                dot(row, accelerations.a_a) + dynamics.drift[i]
                for i, row in sorted(dynamics.gamma.items())
            ]
        return [
            *self.tau,
            *accelerations.active_friction,
            dynamics.kinetic,
            dynamics.potential,
            *accelerations.friction_at_rest,
            *self.external_forces.outputs,
            *a,
        ]

    def forces_without_gravity(self) -> list[Scalar]:
        """All forces along the coordinates of the chart except for inertia and gravity."""
        return subtract_vectors(
            add_vectors(self._applied_forces, self.dynamics_formulas.passive_force),
            self.dynamics_formulas.friction_force,
        )

    def stiffness(self, state_count: int) -> list[list[Scalar]]:
        """Derivatives of rates and forces of the controller by the coordinates q_B of the chart.

        They are taken at constant gamma, without gravity and velocity-dependent forces.

        Args:
            state_count: Number k of the first states of the controller, whose rates are taken.

        Returns:
            (k + n, n).
        """
        gamma = self.dynamics_formulas.gamma
        user_coordinates = [x for x in self.q_a if isinstance(x, SymbolicExpression)]
        forces = self.chart.trace_chart_forces(gamma, self.tau)
        rows = differentiate([*self.controller_rate[:state_count], *forces], user_coordinates)
        if not self.chart.has_user_coordinates:
            columns = list(
                zip(*(gamma[i + 1] for i in self.chart.user_columns.tolist()), strict=True)
            )
            rows = [[dot(row, column) for column in columns] for row in rows]
        passive = zip(rows[state_count:], self.dynamics_formulas.stiffness, strict=True)
        return [*rows[:state_count], *(add_vectors(one, other) for one, other in passive)]


def raise_undetermined(a_a: Sequence[Scalar] = (), friction: bool = False) -> list[Scalar]:
    """Inverse dynamics and gravity of a controller that must not ask for them."""
    raise InputError("inverse dynamics of coordinates that do not determine the motion")


def trace_machine(
    chart: Chart,
    tape: Tape,
    state_argument: int,
    references: list[Scalar],
    settings: list[Scalar],
    folded_constants: tuple[Array, Array] | None = None,
) -> MachineFormulas:
    """Trace the formulas of a machine with its controller.

    Args:
        chart: The machine in a chart.
        tape: The tape; its arguments 0 and 1 are geometry and constants of the dynamics.
        state_argument: Number of the argument that holds the state.
        references: References of the controller, then of the external forces.
        settings: Settings of the controller.
        folded_constants: Geometry and constants that become part of the formulas, with NaN for
            those that remain arguments; those of the machine if not given.
    """
    geometry, pattern = folded_constants or (None, chart.dynamics.constant_pattern)
    structure, control = chart.dynamics.formula_structure, chart.control
    columns, layout = reference_count(control), chart.state_layout
    q, kinematics, loops = chart.machine.closure.compiled_closure.trace_kinematics(
        tape, 0, state_argument, geometry
    )
    parts = layout.view(tape.load_vector(state_argument, 0, layout.size))
    dynamics = DynamicsFormulas(
        kinematics, loops, FormulaConstants(tape, 1, pattern), q, parts.v_a, structure,
        use_modes=True,
    )  # fmt: skip
    q_a, v_a = [q[i] for i in chart.user_columns], parts.v_a
    functions: tuple[Callable[..., list[Scalar]], ...] = (
        dynamics.inverse_dynamics, lambda: list(dynamics.gravity_force),
    )  # fmt: skip
    if not chart.has_user_coordinates:
        v_a = [dynamics.joint_velocities[i + 1] for i in chart.user_columns]
        functions = raise_undetermined, raise_undetermined
    applied = external_forces.trace_external_forces(
        chart.machine, dynamics, references[columns:], parts.contacts
    )
    inputs = ControllerInputs(
        q_a, v_a, parts.controller, settings, references[:columns], *functions
    )
    tau, rates = control.law(inputs)
    if isinstance(control, ValveDrive) and structure.circuit_friction_columns:
        dynamics = dynamics.with_circuit_friction(control.circuit_friction(inputs))
    return MachineFormulas(chart, dynamics, parts, q_a, v_a, applied, inputs, tau, rates)


def wrap_rotations(chart: Chart, state: Sequence[Scalar]) -> list[Scalar]:
    """A state with rotation vectors of at most pi; its first part is q."""
    out = list(state)
    for column in chart.machine.coordinates.rotation_columns:
        out[column : column + 3] = wrap_rotation_vector(out[column : column + 3])
    return out


def trace_law(
    chart: Chart,
    tape: Tape,
    functions: tuple[Callable[..., list[Scalar]], Callable[..., list[Scalar]]],
    fold_settings: bool = False,
) -> tuple[ControllerInputs, Sequence[Scalar], Sequence[Scalar]]:
    """Trace a control law without the machine.

    Args:
        chart: The machine in a chart.
        tape: The tape; coordinates, velocities, states, settings and references are its arguments.
        functions: Inverse dynamics and gravity, see `ControllerInputs`.
        fold_settings: Whether zeros and ones among the settings become part of the formulas.

    Returns:
        Its inputs, forces (n,), and rates (k,) of its states.
    """
    n, control = len(chart.user_columns), chart.control
    inputs = ControllerInputs(
        tape.load_vector(0, 0, n),
        tape.load_vector(1, 0, n),
        tape.load_vector(2, 0, chart.controller_state_count),
        controller_settings(control, tape, 3, fold_settings),
        tape.load_vector(4, 0, reference_count(control)),
        *functions,
    )
    return inputs, *control.law(inputs)


def controller_formula_key(chart: Chart, fold_settings: bool) -> Hashable:
    """Formulas of a controller as a key, so that equal ones share their machine code.

    The controller is traced without the machine: the results of inverse dynamics and gravity are
    arguments.

    Args:
        chart: The machine in a chart.
        fold_settings: Whether zeros and ones among the settings become part of the formulas.

    Raises:
        InputError: The number of forces or rates is wrong, or a free joint gets a force.
    """
    tape, n, control = Tape(), len(chart.user_columns), chart.control
    requested_accelerations: list[Scalar] = []

    def inverse(a_a: Sequence[Scalar], friction: bool) -> list[Scalar]:
        forces = tape.load_vector(5, len(requested_accelerations), n)
        requested_accelerations.extend([*a_a, float(friction)])
        return forces

    functions = inverse, lambda: tape.load_vector(6, 0, n)
    inputs, tau, rates = trace_law(chart, tape, functions, fold_settings)
    if (len(tau), len(rates)) != (n, chart.controller_state_count):
        raise InputError(
            f"the law of {type(control).__name__} gives {len(tau)} forces and {len(rates)} rates, "
            f"give {n} and {chart.controller_state_count}: one per active joint, one per state"
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
    return repr((len(inputs.reference), len(control.settings), tape.operations, outputs))


def machine_program(chart: Chart, key: tuple, build: Callable[[Program], None]) -> Program:
    """Machine code of a machine with its controller, kept by the loops of the machine.

    It is cached only if controller and external forces are classes of this package: the code of a
    class of the user may depend on more than the key.

    Args:
        chart: The machine in a chart.
        key: Properties on which the code depends, with `controller_formula_key`.
        build: Function that adds formulas and routines.

    Raises:
        FormulaTooLongError: The formulas are too long to be compiled.
    """
    closure, control = chart.machine.closure.compiled_closure, chart.control
    parts = (control, getattr(control, "command", control), *chart.machine.external_forces)
    if all(type(part).__module__.startswith("crane.") for part in parts):
        return closure.cached_program(key, build)
    if key not in closure.programs:
        closure.programs[key] = Program.from_cache(None, build)
    return closure.programs[key]


def controller_settings(
    control: ControlLaw, tape: Tape, argument: int, fold_settings: bool
) -> list[Scalar]:
    """Settings of a controller, read from an argument."""
    size = len(control.settings)
    if fold_settings:
        return FormulaConstants(tape, argument, control.settings).vector(0, size)
    return tape.load_vector(argument, 0, size)
