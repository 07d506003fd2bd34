"""Steps of the classical Runge-Kutta method in machine code."""

import numpy as np

from crane.closure.kinematics_formulas import largest_scaled_value
from crane.codegen import Program, Tape, max_abs, maximum
from crane.codegen.symbolic import add_vectors, scale_vector
from crane.common.samples import Array
from crane.control import TracedController
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.machine_formulas import (
    MachineCodeStepper,
    exceeds_chart_limits,
    wrap_rotations,
)
from crane.simulation.integration.step_blocks import run_in_blocks
from crane.simulation.integration.stick_slip_modes import EVENT_TOLERANCE


class RungeKuttaStepper(MachineCodeStepper):
    """Many steps at once in machine code, with a controller that is traced along.

    Args:
        chart: The machine.
        control: Its controller.
        controller_state_count: Number of the controller's states.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(self, chart: Chart, control: TracedController, controller_state_count: int):
        self._step_state = np.zeros(3)
        super().__init__(chart, control, controller_state_count, ("rk4",), fold_settings=False)

    @property
    def event(self) -> float:
        """How far behind the last recorded instant a joint has started or stopped [s], else 0."""
        return float(self._step_state[2])

    def _build(self, program: Program) -> None:
        for suffix, with_joints_at_rest in self._rest_variants:
            for name in ("observe", "rate"):
                machine, _, tau, controller_rate = self._trace_controlled_machine(Tape())
                accelerations = machine.accelerations(tau, with_joints_at_rest)
                coordinate_rates, powers = (
                    machine.dynamics_formulas.coordinate_derivatives,
                    machine.powers(tau),
                )
                contact_rates = machine.external_forces.state_rates
                outputs = {
                    "rate": [
                        *coordinate_rates,
                        *accelerations.a_a,
                        *contact_rates,
                        *controller_rate,
                        *powers,
                    ]
                }
                if name == "observe":
                    outputs["seen"] = machine.outputs(tau, with_joints_at_rest)
                    outputs["margin"] = [accelerations.transition_margin]
                program.add_formula(name + suffix, 5, outputs)
        self._add_sum_formulas(program)
        self._add_run(program)

    def _add_run(self, program: Program) -> None:
        """run: steps, each recorded before it is made, until one needs a closer look.

        h: length of a step, half of it; then how far behind the last recorded instant a joint has
        started or stopped, if one has.
        """
        size, seen, columns = (
            self.state_layout.size,
            self.output_layout.size,
            self.reference_columns,
        )
        names = ("geometry", "numbers", "control", "refs", "state", "out", "h", "bounds")
        with program.add_routine(
            "run", counts=("steps",), functions=("close",), arrays=names
        ) as r:
            following = r.local_array("following", program.formula_outputs("finish"))
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
                row = r.out.row_pointer(i, size + seen)
                r.copy(row, r.state, size)
                r.copy(row.element_pointer(size), k1.element_pointer("seen"), seen)
                r.call("blend", r.state, k1, half, following)
                self.call_formula(r, "rate", *machine, middle, following, k2)
                r.call("blend", r.state, k2, half, following)
                self.call_formula(r, "rate", *machine, middle, following, k3)
                r.call("blend", r.state, k3, r.h, following)
                self.call_formula(r, "rate", *machine, last, following, k4)
                r.call("finish", r.geometry, r.state, k1, k2, k3, k4, r.h, following)
                with r.if_then(~(following["move"] < 1.0)):
                    r.return_value(i)
                closed = r.call("close", r.geometry, following, result, r.bounds)
                with r.if_then(closed < 1):
                    r.return_value(i)
                r.copy(r.state, following, size)
                with r.if_then(exceeds_chart_limits(r, result)):
                    r.return_value(i + 1)
            r.return_value(r.steps)

    def run(self, times: Array, state: Array, step: float, rows: Array) -> int:
        """Steps from the first of `times` on, one row before each.

        Args:
            times: (steps,) [s].
            state: The state at the first time; replaced by that after the last step done.
            step: [s].
            rows: (steps, size + seen), state and observations at each of the times.

        Returns:
            How many steps were done; the one after them needs a closer look, or other
            coordinates, or see `event`.
        """
        arguments = self._common_arguments
        self._step_state[:] = step, 0.5 * step, 0.0

        def call(count: int, references: Array, out: Array) -> int:
            return self._program.call(
                "run", count, self.closure_code.close_address, *arguments, references, state,
                out, self._step_state, self.bounds,
            )  # fmt: skip

        return run_in_blocks(call, self._chart.machine, self._control, times, step, rows)

    def _add_sum_formulas(self, program: Program) -> None:
        """blend(s, k, h) = s + h k; finish(geometry, s, k1, k2, k3, k4, h) = s + h/6 (...).

        With the largest move [rad], [machine's size].
        """
        size, coordinates = self.state_layout.size, self.state_layout["q"]
        tape = Tape()
        state, rate = tape.load_vector(0, 0, size), tape.load_vector(1, 0, size)
        program.add_formula("blend", 3, add_vectors(state, scale_vector(tape.load(2, 0), rate)))
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
        share = largest_scaled_value(
            rates, is_length, self.closure_code.inverse_characteristic_length(tape)
        )
        # the others count only so far as that NaN and infinity anywhere show
        largest_move = h * maximum(share, max_abs(scale_vector(1e-30, mean)))
        program.add_formula("finish", 7, {"state": after, "move": [largest_move]})
