"""Steps of the classical Runge-Kutta method in machine code."""

import numpy as np

from crane.closure.traced import largest_share
from crane.codegen import Program, Tape, largest, maximum
from crane.codegen.scalar import add, scale
from crane.common.samples import Array
from crane.control import TracedController
from crane.simulation.integration.blocks import in_blocks
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.sticking import NEAR
from crane.simulation.integration.traced import (
    Stepper,
    beyond,
    wrapped,
)


class CompiledStepper(Stepper):
    """Many steps at once in machine code, with a controller that is traced along.

    Args:
        chart: The machine.
        control: Its controller.
        states: Number of the controller's states.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(self, chart: Chart, control: TracedController, states: int):
        self._lengths = np.zeros(3)
        super().__init__(chart, control, states, ("rk4",), fold=False)

    @property
    def event(self) -> float:
        """How far behind the last recorded instant a joint has started or stopped [s], else 0."""
        return float(self._lengths[2])

    def _build(self, program: Program) -> None:
        for added, rest in self._rests:
            for name in ("observe", "rate"):
                machine, _, tau, own_rate = self._driven(Tape())
                moved = machine.moved(tau, rest)
                slopes, powers = machine.sweep.slopes, machine.powers(tau)
                shear = machine.outside.rates
                outputs = {"rate": [*slopes, *moved.a_a, *shear, *own_rate, *powers]}
                if name == "observe":
                    outputs["seen"] = machine.observed(tau, rest)
                    outputs["margin"] = [moved.margin]
                program.add(name + added, 5, outputs)
        self._add_sums(program)
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
        with program.routine("run", counts=("steps",), functions=("close",), arrays=names) as r:
            following = r.array("following", program.outputs("finish"))
            k1 = r.array("k1", program.outputs("observe"))
            k2, k3, k4 = (r.array(f"k{i}", size) for i in (2, 3, 4))
            result = r.array("result", self.closure_code.outputs("newton"))
            machine, half = (r.geometry, r.numbers, r.control), r.h.at(1)
            with r.loop(r.steps) as i:
                first = r.refs.row(i, 2 * columns)
                middle, last = first.at(columns), first.at(2 * columns)
                self.call_formula(r, "observe", *machine, first, r.state, k1)
                if self.sticks:
                    with r.when(k1["margin"] < -NEAR):
                        r.store(r.h, 2, r.h[0])
                        r.give(i)
                row = r.out.row(i, size + seen)
                r.copy(row, r.state, size)
                r.copy(row.at(size), k1.at("seen"), seen)
                r.call("blend", r.state, k1, half, following)
                self.call_formula(r, "rate", *machine, middle, following, k2)
                r.call("blend", r.state, k2, half, following)
                self.call_formula(r, "rate", *machine, middle, following, k3)
                r.call("blend", r.state, k3, r.h, following)
                self.call_formula(r, "rate", *machine, last, following, k4)
                r.call("finish", r.geometry, r.state, k1, k2, k3, k4, r.h, following)
                with r.when(~(following["move"] < 1.0)):
                    r.give(i)
                closed = r.call("close", r.geometry, following, result, r.bounds)
                with r.when(closed < 1):
                    r.give(i)
                r.copy(r.state, following, size)
                with r.when(beyond(r, result)):
                    r.give(i + 1)
            r.give(r.steps)

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
        arguments = self._arguments
        self._lengths[:] = step, 0.5 * step, 0.0

        def call(count: int, references: Array, out: Array) -> int:
            return self._program.call(
                "run", count, self.closure_code.close_address, *arguments, references, state,
                out, self._lengths, self.bounds,
            )  # fmt: skip

        return in_blocks(call, self._chart.machine, self._control, times, step, rows)

    def _add_sums(self, program: Program) -> None:
        """blend(s, k, h) = s + h k; finish(geometry, s, k1, k2, k3, k4, h) = s + h/6 (...).

        With the largest move [rad], [machine's size].
        """
        size, coordinates = self.state_layout.size, self.state_layout["q"]
        tape = Tape()
        state, rate = tape.loads(0, 0, size), tape.loads(1, 0, size)
        program.add("blend", 3, add(state, scale(tape.load(2, 0), rate)))
        tape = Tape()
        state = tape.loads(1, 0, size)
        k1, k2, k3, k4 = (tape.loads(array, 0, size) for array in range(2, 6))
        h = tape.load(6, 0)
        mean = add(k1, scale(2.0, add(k2, k3)), k4)
        after = wrapped(self._chart, add(state, scale(h * (1.0 / 6.0), mean)))
        rates = [*k1[coordinates], *k2[coordinates], *k3[coordinates]]
        long = 3 * [not turns for turns in self.closure_code.geometry.revolute[1:]]
        share = largest_share(rates, long, self.closure_code.per_size(tape))
        # the others count only so far as that NaN and infinity anywhere show
        move = h * maximum(share, largest(scale(1e-30, mean)))
        program.add("finish", 7, {"state": after, "move": [move]})
