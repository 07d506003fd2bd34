"""Compiled methods: base class, and the classical Runge-Kutta method."""

import numpy as np

from crane.closure.kinematics_formulas import largest_scaled_value
from crane.codegen import (
    ArrayPointer,
    LayoutView,
    Program,
    Routine,
    RoutineValue,
    Tape,
    max_abs,
    maximum,
)
from crane.codegen.symbolic import add_vectors, scale_vector
from crane.common.samples import Array
from crane.dynamics import external_forces
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.machine_formulas import (
    AT_REST_SUFFIX,
    MachineFormulas,
    controller_formula_key,
    controller_settings,
    machine_program,
    reference_count,
    reference_samples,
    trace_machine,
    wrap_rotations,
)
from crane.simulation.integration.stick_slip_modes import EVENT_TOLERANCE

HELD_INDEX = 5  # index in `MachineCodeStepper.bounds`: whether joints are at rest


def exceeds_chart_limits(bounds: ArrayPointer, closure_result: ArrayPointer) -> RoutineValue:
    """Whether a closed configuration is outside of the limits of a chart."""
    return (closure_result["largest_gamma"] > bounds[3]) | (
        closure_result["determinant"] < bounds[4]
    )


class MachineCodeStepper:
    """Base class of compiled methods: machine code of a machine with its controller.

    A method implements `_build`, which adds formulas `observe` with the parts `outputs` and
    `margin` and `rate` with the part `rate`, and `observe_rest` and `rate_rest` where joints can
    stick.

    Args:
        chart: The machine in a chart.
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

    _step_state: Array  # the argument h of the routine `run`, see `StepLoop`

    def __init__(self, chart: Chart, method: tuple, fold_settings: bool):
        machine, control = chart.machine, chart.control
        self._chart, self._control, self._fold_settings = chart, control, fold_settings
        self.closure_code = machine.closure.compiled_closure
        self._dynamics_constants = chart.dynamics.formula_constants
        self.bounds = np.concatenate([self.closure_code.tolerances, chart.chart_limits, [0.0]])
        self.controller_columns = reference_count(control)
        self.reference_columns = self.controller_columns + sum(
            external_forces.reference_counts(machine.external_forces)
        )
        self.external_callback = (
            None
            if machine.has_traceable_forces
            else external_forces.ExternalForceCallback(machine.external_forces)
        )
        self.has_stick_slip = bool(chart.stick_slip.columns)
        self.state_layout, self.output_layout = chart.state_layout, chart.output_layout
        key = (
            *method,
            controller_formula_key(chart, fold_settings),
            chart.controller_state_count,
            bool(machine.supports),
            *chart.formula_key,
        )
        self._program = machine_program(chart, key, self._build)

    def new_program(self) -> Program:
        """Its functions, not compiled, for other targets."""
        program = Program()
        self._build(program)
        return program

    def _build(self, program: Program) -> None:
        """Add the formulas and routines."""

    def trace_controlled_machine(self, tape: Tape) -> MachineFormulas:
        """The machine with its controller; references and state are the arguments 3 and 4."""
        references = tape.load_vector(3, 0, self.reference_columns)
        settings = controller_settings(self._control, tape, 2, self._fold_settings)
        return trace_machine(self._chart, tape, 4, references, settings)

    @property
    def event(self) -> float:
        """Not 0 at a stick-slip transition: the last element of the argument h."""
        return float(self._step_state[-1])

    @property
    def has_rotation_vectors(self) -> bool:
        """Whether coordinates are rotation vectors."""
        return bool(self._chart.machine.coordinates.rotation_columns)

    def adopt_modes(self) -> None:
        """Adopt the stick-slip modes of the chart."""
        if self.has_stick_slip:
            self._chart.stick_slip.apply_to(self._chart.dynamics)
            self.note_joints_at_rest()

    def note_joints_at_rest(self) -> None:
        """Note whether joints are held at rest, in the modes that the dynamics have already."""
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
        at = self._evaluate("observe", time, state)
        return at.outputs, float(at.margin[0])

    def rate_and_outputs(self, time: float, state: Array) -> tuple[Array, Array]:
        """Rate of a state at a time [s], and outputs."""
        return self._evaluate("rate", time, state).rate, self.observe(time, state)[0]

    def _evaluate(self, formula: str, time: float, state: Array) -> LayoutView:
        """Outputs of `observe` or `rate` at a time [s] and a state."""
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
        layout = self._program.formula_outputs(formula)
        out = np.empty(layout.size)
        name = formula + AT_REST_SUFFIX * bool(self.bounds[HELD_INDEX])
        self._program.call(name, *self._common_arguments, reference, state, out)
        return layout.view(out)


class RungeKuttaStepper(MachineCodeStepper):
    """Compiled steps of the classical Runge-Kutta method, with a traced controller.

    Args:
        chart: The machine in a chart.

    Raises:
        FormulaTooLongError: The formulas are too long to be compiled.
    """

    def __init__(self, chart: Chart):
        self._step_state = np.zeros(3)
        super().__init__(chart, ("rk4",), fold_settings=False)

    def _build(self, program: Program) -> None:
        for suffix, with_joints_at_rest in self._rest_variants:
            machine = self.trace_controlled_machine(Tape())
            rate, margin = machine.state_rate(with_joints_at_rest)
            outputs = machine.outputs(with_joints_at_rest)
            parts = {"rate": rate, "outputs": outputs, "margin": [margin]}
            program.add_formula("observe" + suffix, 5, parts)
            program.add_formula("rate" + suffix, 5, {"rate": rate})
        self._add_sum_formulas(program)
        names = ("geometry", "numbers", "control", "refs", "state", "out", "h", "bounds")
        with program.add_routine(
            "run", counts=("steps",), functions=("close",), arrays=names
        ) as r:
            self._write_steps(program, r)

    def _write_steps(self, program: Program, r: Routine) -> None:
        """Write the loop over steps, each recorded before it is made, until one fails.

        Elements of the argument h: step size; half of it; interval with a stick-slip transition.
        """
        size, output_size = self.state_layout.size, self.output_layout.size
        columns = self.reference_columns
        stage = r.local_array("stage", program.formula_outputs("finish"))
        k1 = r.local_array("k1", program.formula_outputs("observe"))
        k2, k3, k4 = (r.local_array(f"k{i}", size) for i in (2, 3, 4))
        result = r.local_array("result", self.closure_code.formula_outputs("newton"))
        machine, half = (r.geometry, r.numbers, r.control), r.h.element_pointer(1)
        with r.loop(r.steps) as i:
            first = r.refs.row_pointer(i, 2 * columns)
            middle, last = first.element_pointer(columns), first.element_pointer(2 * columns)
            self.call_formula(r, "observe", *machine, first, r.state, k1)
            if self.has_stick_slip:
                with r.if_then(k1["margin"] < -EVENT_TOLERANCE):
                    r.store(r.h, 2, r.h[0])
                    r.return_value(i)
            row = r.out.row_pointer(i, size + output_size)
            r.copy(row, r.state, size)
            r.copy(row.element_pointer(size), k1.element_pointer("outputs"), output_size)
            for rate, length, references, next_rate in (
                (k1, half, middle, k2), (k2, half, middle, k3), (k3, r.h, last, k4),
            ):  # fmt: skip
                r.call("displaced", r.state, rate, length, stage)
                self.call_formula(r, "rate", *machine, references, stage, next_rate)
            r.call("finish", r.geometry, r.state, k1, k2, k3, k4, r.h, stage)
            with r.if_then(~(stage["move"] < 1.0)):
                r.return_value(i)
            with r.if_then(r.call("close", r.geometry, stage, result, r.bounds) < 1):
                r.return_value(i)
            r.copy(r.state, stage, size)
            with r.if_then(exceeds_chart_limits(r.bounds, result)):
                r.return_value(i + 1)
        r.return_value(r.steps)

    def run(self, times: Array, state: Array, step: float, rows: Array) -> int:
        """Make a step from each of the times, and record a row before each step.

        Args:
            times: (steps,) at equal intervals [s].
            state: State at the first time, replaced by that after the last step.
            step: Step size [s].
            rows: (steps, row size) in any memory order, filled with state and outputs.

        Returns:
            Number of steps. Fewer than all are made where a step fails, another chart is needed,
            or at an `event`.
        """
        self._step_state[:] = step, 0.5 * step, 0.0
        half_steps = times[0] + 0.5 * step * np.arange(2 * len(times) + 1)
        references = reference_samples(self._chart.machine, self._control, half_steps)
        out = np.empty((len(times), rows.shape[1]))
        done = self._program.call(
            "run", len(times), self.closure_code.close_address, *self._common_arguments,
            references, state, out, self._step_state, self.bounds,
        )  # fmt: skip
        rows[:done] = out[:done]
        return done

    def _add_sum_formulas(self, program: Program) -> None:
        """displaced(s, k, h) = s + h k; finish(geometry, s, k1, ..., k4, h) = s + h/6 (...).

        `finish` also has the largest displacement [rad], [characteristic lengths].
        """
        size, coordinates = self.state_layout.size, self.state_layout["q"]
        tape = Tape()
        state, rate = tape.load_vector(0, 0, size), tape.load_vector(1, 0, size)
        program.add_formula(
            "displaced", 3, add_vectors(state, scale_vector(tape.load(2, 0), rate))
        )
        tape = Tape()
        state = tape.load_vector(1, 0, size)
        k1, k2, k3, k4 = (tape.load_vector(array, 0, size) for array in range(2, 6))
        h = tape.load(6, 0)
        mean = add_vectors(k1, scale_vector(2.0, add_vectors(k2, k3)), k4)
        after = wrap_rotations(
            self._chart, add_vectors(state, scale_vector(h * (1.0 / 6.0), mean))
        )
        rates = [*k1[coordinates], *k2[coordinates], *k3[coordinates]]
        is_length = 3 * [not turns for turns in self.closure_code.geometry.is_revolute[1:]]
        largest_rate = largest_scaled_value(
            rates, is_length, self.closure_code.inverse_characteristic_length(tape)
        )
        # the other rates only have to be finite
        largest_move = h * maximum(largest_rate, max_abs(scale_vector(1e-30, mean)))
        program.add_formula("finish", 7, {"state": after, "move": [largest_move]})
