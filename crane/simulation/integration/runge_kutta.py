"""Compiled steps of the classical Runge-Kutta method."""

import numpy as np

from crane.closure.kinematics_formulas import largest_scaled_value
from crane.codegen import Program, Scalar, Tape, max_abs, maximum
from crane.codegen.llvm.routine_builder import Routine
from crane.codegen.symbolic import add_vectors, scale_vector
from crane.common.samples import Array
from crane.control.control_law import TracedController
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.machine_code_stepper import (
    MachineCodeStepper,
    exceeds_chart_limits,
)
from crane.simulation.integration.machine_formulas import reference_samples, wrap_rotations
from crane.simulation.integration.stick_slip_modes import EVENT_TOLERANCE

_BLOCK_STEPS = 1000  # steps of a call, whose rows stay in the cache until they are copied


class RungeKuttaStepper(MachineCodeStepper):
    """Compiled steps of the classical Runge-Kutta method, with a traced controller.

    Args:
        chart: The machine in a chart.
        control: Its controller.
        controller_state_count: Number of states of the controller.

    Raises:
        FormulaTooLongError: The formulas are too long to be compiled.
    """

    def __init__(self, chart: Chart, control: TracedController, controller_state_count: int):
        self._step_state = np.zeros(3)
        super().__init__(chart, control, controller_state_count, ("rk4",), fold_settings=False)

    @property
    def event(self) -> float:
        """Interval after the last row within which a stick-slip transition is [s]; else 0."""
        return float(self._step_state[2])

    def _build(self, program: Program) -> None:
        for suffix, with_joints_at_rest in self._rest_variants:
            for name in ("observe", "rate"):
                machine, _, tau, controller_rate = self._trace_controlled_machine(Tape())
                rate, margin = machine.state_rate(tau, controller_rate, with_joints_at_rest)
                parts: dict[str, list[Scalar]] = {"rate": rate}
                if name == "observe":
                    parts["outputs"] = machine.outputs(tau, with_joints_at_rest)
                    parts["margin"] = [margin]
                program.add_formula(name + suffix, 5, parts)
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
            closed = r.call("close", r.geometry, stage, result, r.bounds)
            with r.if_then(closed < 1):
                r.return_value(i)
            r.copy(r.state, stage, size)
            with r.if_then(exceeds_chart_limits(r, result)):
                r.return_value(i + 1)
        r.return_value(r.steps)

    def run(self, times: Array, state: Array, step: float, rows: Array) -> int:
        """Make a step from each of the times, and record a row before each step.

        Args:
            times: (steps,) at equal intervals [s].
            state: State at the first time, replaced by that after the last step.
            step: Step size [s].
            rows: (steps, row_size) in any memory order, filled with state and outputs.

        Returns:
            Number of steps. Fewer than all are made where a step fails, another chart is needed,
            or at an `event`.
        """
        self._step_state[:] = step, 0.5 * step, 0.0
        length = min(_BLOCK_STEPS, len(times))
        half_step_times = times[::length, None] + 0.5 * step * np.arange(2 * length + 1)
        block_starts = range(0, len(times), length)
        instants = half_step_times.ravel()[: 2 * len(times) + len(block_starts)]
        references = reference_samples(self._chart.machine, self._control, instants)
        out = np.empty((length, rows.shape[1]))
        arguments = self._common_arguments
        for i, first in enumerate(block_starts):
            count = min(length, len(times) - first)
            done = self._program.call(
                "run", count, self.closure_code.close_address, *arguments,
                references[i * half_step_times.shape[1] :], state, out, self._step_state,
                self.bounds,
            )  # fmt: skip
            rows[first : first + done] = out[:done]
            if done < count:
                return first + done
        return len(times)

    def _add_sum_formulas(self, program: Program) -> None:
        """displaced(s, k, h) = s + h k; finish(geometry, s, k1, ..., k4, h) = s + h/6 (...).

        `finish` also has the largest displacement [rad], [characteristic lengths].
        """
        size, coordinates = self.state_layout.size, self.state_layout["q"]
        tape = Tape()
        state, rate = tape.load_vector(0, 0, size), tape.load_vector(1, 0, size)
        displaced = add_vectors(state, scale_vector(tape.load(2, 0), rate))
        program.add_formula("displaced", 3, displaced)
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
        inverse_length = self.closure_code.inverse_characteristic_length(tape)
        largest_rate = largest_scaled_value(rates, is_length, inverse_length)
        # the other rates only have to be finite
        largest_move = h * maximum(largest_rate, max_abs(scale_vector(1e-30, mean)))
        program.add_formula("finish", 7, {"state": after, "move": [largest_move]})
