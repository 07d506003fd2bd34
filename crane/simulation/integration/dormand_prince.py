"""Steps of an explicit method of eighth order in machine code.

Dormand and Prince's method of order 8 with its embedded methods of order 5 and 3 and its
interpolant of order 7 (Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I,
II.5 and II.6; the coefficients are scipy's).
"""

from typing import Any

from crane.closure.kinematics_formulas import largest_scaled_value
from crane.codegen import Program, RoutineValue, Scalar, Tape
from crane.codegen.symbolic import (
    add_vectors,
    apply_function,
    maximum,
    minimum,
    scale_vector,
    subtract_vectors,
)
from crane.control import TracedController
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.error_controlled_stepper import (
    ErrorControlledStepper,
    error_tolerances,
    weighted_sum,
)
from crane.simulation.integration.step_loop import MIN_STEP_RATIO, StepCode, StepWriter

STAGES, INTERPOLATION_STAGES = 12, 3  # of a step, and for what is between its ends
DORMAND_PRINCE_TOLERANCE = 1e-12  # error of a step, per size of the state
_MAX_STEP_RATIO, _SAFETY_FACTOR = 5.0, 0.9  # change of the step's length from one to the next


def _scipy_method() -> Any:
    """What has the coefficients, which only a program that is not kept has to be made of."""
    from scipy.integrate import DOP853  # slow to import

    return DOP853


class DormandPrinceStepper(ErrorControlledStepper):
    """See above; `tolerance` is that of `error_tolerances`.

    Args:
        chart: The machine.
        control: Its controller.
        controller_state_count: Number of the controller's states.
        tolerance: Error of a step, per size of the state.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(
        self,
        chart: Chart,
        control: TracedController,
        controller_state_count: int,
        tolerance: float = DORMAND_PRINCE_TOLERANCE,
    ):
        errors = error_tolerances(chart, controller_state_count, tolerance)
        super().__init__(chart, control, controller_state_count, ("explicit",), False, errors)

    def _add_method(self, program: Program) -> None:
        """stage1(s, k, h) to stage11, more0 to more2; finish(numbers, s, k, h, tol); dense."""
        size, method = self.state_layout.size, _scipy_method()
        stages = {f"stage{i}": method.A[i] for i in range(1, STAGES)}
        stages |= {f"more{i}": row for i, row in enumerate(method.A_EXTRA)}
        for name, weights in stages.items():
            tape = Tape()
            displaced = scale_vector(tape.load(2, 0), weighted_sum(tape, 1, size, weights))
            program.add_formula(name, 3, add_vectors(tape.load_vector(0, 0, size), displaced))
        tape = Tape()
        state, h = tape.load_vector(1, 0, size), tape.load(3, 0)
        after = add_vectors(state, scale_vector(h, weighted_sum(tape, 2, size, method.B)))
        fifth: Scalar = 0.0
        third: Scalar = 0.0
        gaps = weighted_sum(tape, 2, size, method.E5), weighted_sum(tape, 2, size, method.E3)
        for one, other, share in zip(
            *gaps, self._inverse_error_scales(tape, 4, state, after), strict=True
        ):
            fifth = fifth + one * share * (one * share)
            third = third + other * share * (other * share)
        denominator = maximum(fifth + 0.01 * third, 1e-300)
        error = (
            apply_function("abs", h) * fifth / apply_function("sqrt", denominator * float(size))
        )
        is_length = [not turns for turns in self.closure_code.geometry.is_revolute[1:]]
        rates = tape.load_vector(2, 0, self.state_layout.parts["q"])
        largest_move = h * largest_scaled_value(
            rates, is_length, self.closure_code.inverse_characteristic_length(tape)
        )
        error = self._limit_rotation(error, largest_move)
        clipped_error = minimum(maximum(error, 1e-9), 1e9)
        step_ratio = _SAFETY_FACTOR * apply_function(
            "exp", (-1.0 / 8.0) * apply_function("log", clipped_error)
        )
        step_ratio = minimum(maximum(step_ratio, MIN_STEP_RATIO), _MAX_STEP_RATIO)
        outputs = {
            "state": after,
            "error": [error],
            "change": [step_ratio],
            "move": [largest_move],
        }
        program.add_formula("finish", 5, outputs)
        # between the ends: state, slopes there, behind it
        tape = Tape()
        state, h, after = (
            tape.load_vector(0, 0, size),
            tape.load(2, 0),
            tape.load_vector(3, 0, size),
        )
        first, last = tape.load_vector(1, 0, size), tape.load_vector(1, STAGES * size, size)
        displacement = subtract_vectors(after, state)
        parts = [
            *displacement,
            *subtract_vectors(scale_vector(h, first), displacement),
            *subtract_vectors(
                scale_vector(2.0, displacement), scale_vector(h, add_vectors(first, last))
            ),
        ]
        for weights in method.D:
            parts += scale_vector(h, weighted_sum(tape, 1, size, weights))
        program.add_formula("dense", 4, parts)

    def _write_step(self, program: Program, step: StepCode) -> tuple[StepWriter, StepWriter]:
        """See `ErrorControlledStepper`."""
        r, size, method = step.routine, self.state_layout.size, _scipy_method()
        # a rate has more behind it, which the next one replaces
        more = program.formula_outputs("rate").size - size
        k, stage = (
            r.local_array("k", (STAGES + 1 + INTERPOLATION_STAGES) * size + more),
            r.local_array("stage", size),
        )

        def attempt(t: RoutineValue, length: RoutineValue) -> None:
            r.copy(k, step.start_rate, size)
            for i in range(1, STAGES):
                r.call(f"stage{i}", r.state, k, step.length, stage)
                step.call(
                    "rate", t + length * float(method.C[i]), stage, k.element_pointer(i * size)
                )
            r.call("finish", r.geometry, r.state, k, step.length, r.tol, step.step_result)

        def interpolate(t: RoutineValue, length: RoutineValue) -> None:
            r.copy(k.element_pointer(STAGES * size), step.end_rate, size)
            for i in range(INTERPOLATION_STAGES):
                r.call(f"more{i}", r.state, k, step.length, stage)
                at = k.element_pointer((STAGES + 1 + i) * size)
                step.call("rate", t + length * float(method.C_EXTRA[i]), stage, at)
            r.call("dense", r.state, k, step.length, step.step_result, step.dense_output)

        return attempt, interpolate
