"""Base class of compiled methods: machine code of a machine with its controller."""

from collections.abc import Sequence

import numpy as np

from crane.codegen import (
    Program,
    RoutineValue,
    Scalar,
    Tape,
)
from crane.codegen.llvm.routine_builder import ArrayPointer, Routine
from crane.common.samples import Array
from crane.control.control_law import ControllerInputs, TracedController
from crane.dynamics import external_forces
from crane.simulation.integration.charts import Chart, output_layout, state_layout
from crane.simulation.integration.machine_formulas import (
    AT_REST_SUFFIX,
    MachineFormulas,
    controller_formula_key,
    controller_settings,
    machine_program,
    reference_count,
    reference_samples,
    trace_machine,
)

HELD_INDEX = 5  # index in `MachineCodeStepper.bounds`: whether joints are at rest


def exceeds_chart_limits(routine: Routine, closure_result: ArrayPointer) -> RoutineValue:
    """Whether a closed configuration is outside of the limits of a chart."""
    return (closure_result["largest_gamma"] > routine.bounds[3]) | (
        closure_result["determinant"] < routine.bounds[4]
    )


class MachineCodeStepper:
    """Base class of compiled methods: machine code of a machine with its controller.

    A method implements `_build`, which adds formulas `observe` with the parts `outputs` and
    `margin`, and `observe_rest` where joints can stick.

    Args:
        chart: The machine in a chart.
        control: Its controller.
        controller_state_count: Number of states of the controller.
        method: Further properties on which the code depends.
        fold_settings: Whether zeros and ones among the settings of the controller become part of
            the code.

    Attributes:
        bounds: Tolerances of the closure, see `CompiledClosure`; `Chart.chart_limits`; whether
            joints are at rest.
        external_callback: Callback of external forces in Python; None without them.
        state_layout: Layout of the state.
        output_layout: Layout of the outputs.
        reference_columns: Number of references.
        controller_columns: Number of references of the controller, which are the first ones.
        has_stick_slip: Whether joints have friction with stiction.
        closure_code: The loops in machine code.

    Raises:
        FormulaTooLongError: The formulas are too long to be compiled.
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
        self._chart, self._control, self._fold_settings = chart, control, fold_settings
        self.closure_code = machine.closure.compiled_closure
        self._dynamics_constants = chart.dynamics.formula_constants
        self.bounds = np.concatenate([self.closure_code.tolerances, chart.chart_limits, [0.0]])
        self.controller_columns = reference_count(control)
        external_counts = external_forces.reference_counts(machine.external_forces)
        self.reference_columns = self.controller_columns + sum(external_counts)
        self.external_callback = (
            None
            if machine.has_traceable_forces
            else external_forces.ExternalForceCallback(machine.external_forces)
        )
        self.has_stick_slip = bool(chart.stick_slip.columns)
        self.state_layout = state_layout(machine, controller_state_count)
        self.output_layout = output_layout(machine, control)
        key = (
            *method,
            controller_formula_key(
                control, self.controller_columns, chart, controller_state_count, fold_settings
            ),
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
        """Formulas of the machine, inputs, forces and state rates of the controller.

        References and state are the arguments 3 and 4.
        """
        references = tape.load_vector(3, 0, self.reference_columns)
        external_references = references[self.controller_columns :]
        machine = trace_machine(self._chart, tape, self.state_layout, 4, external_references)
        settings = controller_settings(self._control, tape, 2, self._fold_settings)
        inputs = machine.controller_inputs(settings, references[: self.controller_columns])
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
        """Adopt the stick-slip modes of the chart."""
        if self.has_stick_slip:
            self._chart.stick_slip.apply_to(self._chart.dynamics)
            self.bounds[HELD_INDEX] = self._chart.stick_slip.is_held.any()

    @property
    def _rest_variants(self) -> tuple[tuple[str, bool], ...]:
        """Suffixes of formulas, and whether they are for joints at rest."""
        return (("", False), (AT_REST_SUFFIX, True)) if self.has_stick_slip else (("", False),)

    def call_formula(self, routine: Routine, formula: str, *arguments: ArrayPointer) -> None:
        """Write the call of a formula for the present stick-slip modes."""
        if not self.has_stick_slip:
            routine.call(formula, *arguments)
            return
        with routine.if_then(routine.bounds[HELD_INDEX] > 0.5):
            routine.call(formula + AT_REST_SUFFIX, *arguments)
        with routine.if_else():
            routine.call(formula, *arguments)

    @property
    def _common_arguments(self) -> tuple[Array, Array, Array]:
        """First arguments of all formulas: geometry, constants of the dynamics, settings."""
        settings = np.ascontiguousarray(self._control.settings)
        return self.closure_code.geometry.constants, self._dynamics_constants, settings

    def observe(self, time: float, state: Array) -> tuple[Array, float]:
        """Outputs and the margin of stick-slip transitions at a time [s] and a state."""
        reference = reference_samples(self._chart.machine, self._control, np.array([time]))
        if self.external_callback is not None:
            callback_inputs = np.empty(self._program.formula_outputs("callback_inputs").size)
            self._program.call(
                "callback_inputs", *self._common_arguments, reference, state, callback_inputs
            )
            external_references = reference[0, self.controller_columns :]
            self._program.call(
                "external", self.external_callback.address, callback_inputs, external_references
            )
            self.external_callback.raise_pending()
        layout = self._program.formula_outputs("observe")
        out = np.empty(layout.size)
        name = "observe" + AT_REST_SUFFIX * bool(self.bounds[HELD_INDEX])
        self._program.call(name, *self._common_arguments, reference, state, out)
        return out[layout["outputs"]], float(out[layout.start_index("margin")])
