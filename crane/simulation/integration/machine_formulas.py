"""A machine and its controller as formulas of the state."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from crane.closure import rotation_vector_formulas
from crane.closure.compiled_closure import CompiledClosure
from crane.closure.kinematics_formulas import FormulaConstants
from crane.codegen import (
    Layout,
    LayoutView,
    Program,
    RoutineValue,
    Scalar,
    SymbolicExpression,
    Tape,
)
from crane.codegen.differentiation import differentiate
from crane.codegen.intermediate_representation import ArrayPointer as Place
from crane.codegen.intermediate_representation import Routine
from crane.codegen.symbolic import add_vectors, dot, subtract_vectors
from crane.common.errors import InputError
from crane.common.samples import Array
from crane.control import ControllerInputs, TracedController, ValveDrive
from crane.dynamics import external_forces
from crane.dynamics.dynamics_formulas import DynamicsFormulas, StickSlipAccelerations
from crane.machine import Machine
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.state_layouts import output_layout, state_layout

HELD_INDEX = 5  # of `MachineCodeStepper.bounds`, whether joints are at rest
_AT_REST_SUFFIX = "_rest"


def exceeds_chart_limits(routine: Routine, closure_result: Place) -> RoutineValue:
    """Whether a closed posture is beyond a chart's limits, see `MachineCodeStepper.bounds`."""
    return (closure_result["steepest"] > routine.bounds[3]) | (
        closure_result["edge"] < routine.bounds[4]
    )


def reference_samples(machine: Machine, control: TracedController, times: Array) -> Array:
    """All that depends on time alone (N, c): the controller's, then those of `external`."""
    external_samples = external_forces.reference_samples(machine.external_forces, times)
    return np.ascontiguousarray(np.hstack([control.references(times), external_samples]))


def reference_count(control: TracedController) -> int:
    """Length of a controller's row of references."""
    return control.references(np.zeros(1)).shape[1]


@dataclass(frozen=True)
class MachineFormulas:
    """A machine at a state.

    Attributes:
        chart: What the state is in.
        dynamics_formulas: Its dynamics.
        state_parts: Of the state.
        q_a: (n,) coordinates that the controller sees.
        v_a: (n,) their velocities.
        external_forces: What forces from outside do.
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
        """What a controller sees."""
        inverse = (
            self.dynamics_formulas.inverse_dynamics
            if self.chart.has_user_coordinates
            else _raise_undetermined
        )
        gravity = (
            (lambda: list(self.dynamics_formulas.gravity_force))
            if self.chart.has_user_coordinates
            else _raise_undetermined
        )
        return ControllerInputs(
            self.q_a, self.v_a, self.state_parts.own, settings, reference, inverse, gravity
        )

    def with_circuit_friction(
        self, control: TracedController, inputs: ControllerInputs
    ) -> "MachineFormulas":
        """The machine with the Coulomb friction that seals and brakes of a circuit add."""
        if not self.dynamics_formulas.formula_structure.circuit_friction_columns or not isinstance(
            control, ValveDrive
        ):
            return self
        return replace(
            self,
            dynamics_formulas=self.dynamics_formulas.with_circuit_friction(
                control.circuit_friction(inputs)
            ),
        )

    def accelerations(
        self, tau: Sequence[Scalar], with_joints_at_rest: bool
    ) -> StickSlipAccelerations:
        """What it does under a controller's forces, with joints at rest or without."""
        return self.dynamics_formulas.accelerations_with_stick_slip(
            self._applied_forces(tau), with_joints_at_rest
        )

    def _applied_forces(self, tau: Sequence[Scalar]) -> list[Scalar]:
        """Forces along the chart's coordinates, a controller's and those from outside."""
        return add_vectors(
            self.chart.trace_chart_forces(self.dynamics_formulas.gamma, tau),
            self.external_forces.active_forces,
        )

    def outputs(self, tau: Sequence[Scalar], with_joints_at_rest: bool) -> list[Scalar]:
        """What is seen, but for a circuit's channels; see `output_layout`."""
        moved, sweep = self.accelerations(tau, with_joints_at_rest), self.dynamics_formulas
        base_outputs = [
            *tau,
            *moved.active_friction,
            sweep.kinetic,
            sweep.potential,
            *moved.friction_at_rest,
        ]
        a: list[Scalar] = []
        if self.chart.machine.supports:
            rows = sorted(sweep.gamma.items())
            a = [dot(row, moved.a_a) + sweep.drift[i] for i, row in rows]
        return [*base_outputs, *self.external_forces.outputs, *a]

    def forces_without_gravity(self, tau: Sequence[Scalar]) -> list[Scalar]:
        """What acts along the chart's coordinates, inertia and weight apart."""
        return subtract_vectors(
            add_vectors(self._applied_forces(tau), self.dynamics_formulas.passive_force),
            self.dynamics_formulas.friction_force,
        )

    def stiffness(
        self, controller_rate: Sequence[Scalar], tau: Sequence[Scalar]
    ) -> list[list[Scalar]]:
        """What rates of a controller's states and forces along the chart change with q_B.

        At frozen gamma, without weight and what moves.

        Args:
            controller_rate: (k,) of the controller.
            tau: (n,) of the controller.

        Returns:
            (k + n, n).
        """
        gamma, user_coordinates = (
            self.dynamics_formulas.gamma,
            [x for x in self.q_a if isinstance(x, SymbolicExpression)],
        )
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

    def powers(self, tau: Sequence[Scalar]) -> list[Scalar]:
        """What forces put in, a controller's and each from outside, and what is taken out [W]."""
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
    """The machine at the state in an argument.

    Geometry and numbers of the machine are the arguments 0 and 1; `external_references` are
    references of forces from there; `folded_constants` has geometry and numbers with NaN where
    none may become part of the formulas, the machine's own if not given.
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
        else [dynamics_formulas.rates[i + 1] for i in chart.user_columns]
    )
    applied = external_forces.trace_external_forces(
        chart.machine, dynamics_formulas, external_references, parts.shear
    )
    return MachineFormulas(
        chart, dynamics_formulas, parts, [q[i] for i in chart.user_columns], v_a, applied
    )


class MachineCodeStepper:
    """A machine and its controller in machine code: what all methods have in common.

    A method writes `_build`, which adds formulas `observe` with the parts `seen` and `margin`,
    and `observe_rest` where joints can stick.

    Args:
        chart: The machine.
        control: Its controller.
        controller_state_count: Number of the controller's states.
        method: What the method's code depends on besides them.
        fold_settings: Whether zeros and ones among the controller's settings become part of the
            code.

    Attributes:
        bounds: See `CompiledClosure`; where other coordinates are better, see
            `Chart.chart_limits`; whether joints are at rest.
        external_callback: What calls those external forces that are functions in Python, if there
            are some.
        state_layout: Parts of the state.
        output_layout: Parts of what a row has besides.
        reference_columns: Length of a row of references.
        controller_columns: Of these, the first ones that are the controller's.
        has_stick_slip: Whether joints have friction that sticks.
        closure_code: The loops in machine code.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(
        self,
        chart: Chart,
        control: TracedController,
        controller_state_count: int,
        method: tuple,
        fold_settings: bool,
    ):
        machine = chart.machine
        self.closure_code, self._dynamics_constants = (
            machine.closure.compiled_closure,
            chart.dynamics.numbers,
        )
        self._chart, self._control = chart, control
        self.bounds = np.concatenate([self.closure_code.tolerances, chart.chart_limits, [0.0]])
        controller_columns = self.controller_columns = reference_count(control)
        self.reference_columns, self._fold_settings = (
            controller_columns + sum(external_forces.reference_counts(machine.external_forces)),
            fold_settings,
        )
        self.external_callback = (
            None
            if machine.has_traceable_forces
            else external_forces.ExternalForceCallback(machine.external_forces)
        )
        self.has_stick_slip = bool(chart.stick_slip.columns)
        self.state_layout, self.output_layout = (
            state_layout(machine, controller_state_count),
            output_layout(machine, control),
        )
        formula_key = controller_formula_key(
            control, controller_columns, chart, controller_state_count, fold_settings
        )
        key = (
            *method,
            formula_key,
            controller_state_count,
            bool(machine.supports),
            *chart.formula_key,
        )
        if key not in self.closure_code.programs:
            self.closure_code.programs[key] = machine_program(
                machine, control, self.closure_code, key, self._build
            )
        self._program = self.closure_code.programs[key]

    def _build(self, program: Program) -> None:
        """Add formulas and routines."""
        raise NotImplementedError

    def _trace_controlled_machine(
        self, tape: Tape
    ) -> tuple[MachineFormulas, ControllerInputs, Sequence[Scalar], Sequence[Scalar]]:
        """Machine, what the controller sees, its forces and rates.

        References and state are the arguments 3 and 4.
        """
        references, controller_columns = (
            tape.load_vector(3, 0, self.reference_columns),
            reference_count(self._control),
        )
        machine = trace_machine(
            self._chart, tape, self.state_layout, 4, references[controller_columns:]
        )
        settings = controller_settings(self._control, tape, 2, self._fold_settings)
        inputs = machine.controller_inputs(settings, references[:controller_columns])
        tau, rates = self._control.trace(inputs)
        return machine.with_circuit_friction(self._control, inputs), inputs, tau, rates

    @property
    def has_floating_base(self) -> bool:
        """Whether a body floats."""
        return bool(self._chart.machine.coordinates.floating_base_columns)

    @property
    def row_size(self) -> int:
        """Length of a row."""
        return self.state_layout.size + self.output_layout.size

    def adopt_modes(self) -> None:
        """Take over what the joints do whose friction sticks."""
        if self.has_stick_slip:
            self._chart.stick_slip.apply_to(self._chart.dynamics)
            self.bounds[HELD_INDEX] = self._chart.stick_slip.is_held.any()

    @property
    def _rest_variants(self) -> tuple[tuple[str, bool], ...]:
        """What to add to a formula's name without joints at rest, and with some."""
        return (("", False), (_AT_REST_SUFFIX, True)) if self.has_stick_slip else (("", False),)

    def call_formula(self, routine: Routine, formula: str, *arguments: Place) -> None:
        """Call a formula for what the joints do that stick."""
        if not self.has_stick_slip:
            routine.call(formula, *arguments)
            return
        with routine.if_then(routine.bounds[HELD_INDEX] > 0.5):
            routine.call(formula + _AT_REST_SUFFIX, *arguments)
        with routine.if_else():
            routine.call(formula, *arguments)

    @property
    def _common_arguments(self) -> tuple[Array, Array, Array]:
        """What all formulas begin with: geometry, numbers of the machine, settings."""
        settings = np.ascontiguousarray(self._control.settings)
        return self.closure_code.geometry.constants, self._dynamics_constants, settings

    def observe(self, time: float, state: Array) -> tuple[Array, float]:
        """Outputs (.,) and the transition margin at a time [s] and a state."""
        reference = reference_samples(self._chart.machine, self._control, np.array([time]))
        if self.external_callback is not None:
            callback_inputs = np.empty(self._program.formula_outputs("asked").size)
            self._program.call("asked", *self._common_arguments, reference, state, callback_inputs)
            controller_columns = reference_count(self._control)
            self._program.call(
                "ask",
                self.external_callback.address,
                callback_inputs,
                reference[0, controller_columns:],
            )
            self.external_callback.raise_pending()
        layout = self._program.formula_outputs("observe")
        out = np.empty(layout.size)
        name = "observe" + _AT_REST_SUFFIX if self.bounds[HELD_INDEX] else "observe"
        self._program.call(name, *self._common_arguments, reference, state, out)
        return out[layout["seen"]], float(out[layout.start_index("margin")])


def wrap_rotations(chart: Chart, state: Sequence[Scalar]) -> list[Scalar]:
    """A state, q first, with rotation vectors of at most pi."""
    out = list(state)
    for column in chart.machine.coordinates.floating_base_columns:
        out[column + 3 : column + 6] = rotation_vector_formulas.wrap_rotation_vector(
            out[column + 3 : column + 6]
        )
    return out


def controller_formula_key(
    control: TracedController,
    reference_columns: int,
    chart: Chart,
    controller_state_count: int,
    fold_settings: bool,
) -> Hashable:
    """All that a controller's formulas are, so that equal ones share their machine code.

    They are traced by themselves, for rows of so many references, the active joints of a chart's
    user and so many states, what the machine makes of accelerations left open. With
    `fold_settings`, zeros and ones of the settings become part of them.

    Raises:
        InputError: There are too few or too many of them, or a free joint gets a force.
    """
    tape, n = Tape(), len(chart.user_columns)
    requested_accelerations: list[Scalar] = []

    def inverse(a_a: Sequence[Scalar], friction: bool) -> list[Scalar]:
        answer = tape.load_vector(5, len(requested_accelerations), n)
        requested_accelerations.extend([*a_a, float(friction)])
        return answer

    q_a, v_a, controller_state = (
        tape.load_vector(0, 0, n),
        tape.load_vector(1, 0, n),
        tape.load_vector(2, 0, controller_state_count),
    )
    settings, reference = (
        controller_settings(control, tape, 3, fold_settings),
        tape.load_vector(4, 0, reference_columns),
    )
    inputs = ControllerInputs(
        q_a, v_a, controller_state, settings, reference, inverse, lambda: tape.load_vector(6, 0, n)
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
    """Machine code of a machine and its controller.

    Found by what it depends on only where the package wrote the controller and the forces from
    outside: what a user's class does with a machine may depend on more than its formulas tell.

    Args:
        machine: The machine.
        control: The controller.
        compiled_closure: Of the machine.
        key: What the code depends on, `controller_formula_key` among it.
        build: Adds formulas and routines.

    Raises:
        TooLongError: It would take too long to compile.
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
    """The controller's settings, read from an argument."""
    size = len(control.settings)
    if fold_settings:
        return FormulaConstants(tape, argument, control.settings).vector(0, size)
    return tape.load_vector(argument, 0, size)
