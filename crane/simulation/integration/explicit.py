"""Steps of an explicit method of eighth order in machine code.

Dormand and Prince's method of order 8 with its embedded methods of order 5 and 3 and its
interpolant of order 7 (Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I,
II.5 and II.6; the coefficients are scipy's).
"""

from typing import Any

from crane.closure.traced import largest_share
from crane.codegen import Number, Program, Tape, Value
from crane.codegen.scalar import add, apply, maximum, minimum, scale, subtract
from crane.control import TracedController
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.controlled import ControlledStepper, errors_of, mixed
from crane.simulation.integration.step_loop import SLOWER, Attempt, Way

STAGES, MORE = 12, 3  # of a step, and for what is between its ends
TOLERANCE = 1e-12  # error of a step, per size of the state
_FASTER, _SAFETY = 5.0, 0.9  # change of the step's length from one to the next


def _method() -> Any:
    """What has the coefficients, which only a program that is not kept has to be made of."""
    from scipy.integrate import DOP853  # slow to import

    return DOP853


class ExplicitStepper(ControlledStepper):
    """See above; `tolerance` is that of `errors_of`.

    Args:
        chart: The machine.
        control: Its controller.
        states: Number of the controller's states.
        tolerance: Error of a step, per size of the state.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(
        self, chart: Chart, control: TracedController, states: int, tolerance: float = TOLERANCE
    ):
        errors = errors_of(chart, states, tolerance)
        super().__init__(chart, control, states, ("explicit",), False, errors)

    def _add_method(self, program: Program) -> None:
        """stage1(s, k, h) to stage11, more0 to more2; finish(numbers, s, k, h, tol); dense."""
        size, method = self.state_layout.size, _method()
        stages = {f"stage{i}": method.A[i] for i in range(1, STAGES)}
        stages |= {f"more{i}": row for i, row in enumerate(method.A_EXTRA)}
        for name, weights in stages.items():
            tape = Tape()
            moved = scale(tape.load(2, 0), mixed(tape, 1, size, weights))
            program.add(name, 3, add(tape.loads(0, 0, size), moved))
        tape = Tape()
        state, h = tape.loads(1, 0, size), tape.load(3, 0)
        after = add(state, scale(h, mixed(tape, 2, size, method.B)))
        fifth: Number = 0.0
        third: Number = 0.0
        gaps = mixed(tape, 2, size, method.E5), mixed(tape, 2, size, method.E3)
        for one, other, share in zip(*gaps, self._shares(tape, 4, state, after), strict=True):
            fifth = fifth + one * share * (one * share)
            third = third + other * share * (other * share)
        below = maximum(fifth + 0.01 * third, 1e-300)
        error = apply("abs", h) * fifth / apply("sqrt", below * float(size))
        long = [not turns for turns in self.closure_code.geometry.revolute[1:]]
        rates = tape.loads(2, 0, self.state_layout.parts["q"])
        move = h * largest_share(rates, long, self.closure_code.per_size(tape))
        error = self._followed(error, move)
        usable = minimum(maximum(error, 1e-9), 1e9)
        change = _SAFETY * apply("exp", (-1.0 / 8.0) * apply("log", usable))
        change = minimum(maximum(change, SLOWER), _FASTER)
        outputs = {"state": after, "error": [error], "change": [change], "move": [move]}
        program.add("finish", 5, outputs)
        # between the ends: state, slopes there, behind it
        tape = Tape()
        state, h, after = tape.loads(0, 0, size), tape.load(2, 0), tape.loads(3, 0, size)
        first, last = tape.loads(1, 0, size), tape.loads(1, STAGES * size, size)
        way = subtract(after, state)
        parts = [
            *way,
            *subtract(scale(h, first), way),
            *subtract(scale(2.0, way), scale(h, add(first, last))),
        ]
        for weights in method.D:
            parts += scale(h, mixed(tape, 1, size, weights))
        program.add("dense", 4, parts)

    def _made(self, program: Program, step: Attempt) -> tuple[Way, Way]:
        """See `ControlledStepper`."""
        r, size, method = step.r, self.state_layout.size, _method()
        # a rate has more behind it, which the next one replaces
        more = program.outputs("rate").size - size
        k, stage = r.array("k", (STAGES + 1 + MORE) * size + more), r.array("stage", size)

        def attempt(t: Value, length: Value) -> None:
            r.copy(k, step.first, size)
            for i in range(1, STAGES):
                r.call(f"stage{i}", r.state, k, step.length, stage)
                step.call("rate", t + length * float(method.C[i]), stage, k.at(i * size))
            r.call("finish", r.geometry, r.state, k, step.length, r.tol, step.following)

        def interpolate(t: Value, length: Value) -> None:
            r.copy(k.at(STAGES * size), step.ending, size)
            for i in range(MORE):
                r.call(f"more{i}", r.state, k, step.length, stage)
                at = k.at((STAGES + 1 + i) * size)
                step.call("rate", t + length * float(method.C_EXTRA[i]), stage, at)
            r.call("dense", r.state, k, step.length, step.following, step.inside)

        return attempt, interpolate
