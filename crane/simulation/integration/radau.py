"""Compiled steps of Radau IIA, an implicit method of order 5 for stiff machines.

The method has three stages and an embedded method of order 3 (Hairer and Wanner, Solving Ordinary
Differential Equations II, IV.8, which has the coefficients).
"""

from types import SimpleNamespace

import numpy as np

from crane.codegen import ArrayPointer, Layout, Program, RoutineValue, Scalar, Tape, select
from crane.codegen.symbolic import (
    add_vectors,
    apply_function,
    dot,
    maximum,
    scale_vector,
    subtract_vectors,
)
from crane.codegen.symbolic_linear_algebra import lu_factorize
from crane.common.samples import Array
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.error_controlled_stepper import (
    ErrorControlledStepper,
    error_tolerances,
)
from crane.simulation.integration.radau_linear_system import EigenvalueShift, RadauLinearSystem
from crane.simulation.integration.step_loop import StepLoop, StepWriter

RADAU_TOLERANCE = 1e-9  # error of a step, relative to the size of the state
_ROOT_OF_SIX = np.sqrt(6.0)
NODES = np.array([(4.0 - _ROOT_OF_SIX) / 10.0, (4.0 + _ROOT_OF_SIX) / 10.0, 1.0])
# basis of the eigenvectors of the inverse of the matrix of the method
TRANSFORMATION = np.array([
    [0.09443876248897524, -0.14125529502095421, 0.03002919410514742],
    [0.25021312296533332, 0.20412935229379994, -0.38294211275726192],
    [1.0, 1.0, 0.0],
])  # fmt: skip
INVERSE_TRANSFORMATION = np.array([
    [4.17871859155190428, 0.32768282076106237, 0.52337644549944951],
    [-4.17871859155190428, -0.32768282076106237, 0.47662355450055044],
    [0.50287263494578682, -2.57192694985560522, 0.59603920482822492],
])  # fmt: skip
ERROR_WEIGHTS = np.array([-13.0 - 7.0 * _ROOT_OF_SIX, -13.0 + 7.0 * _ROOT_OF_SIX, -1.0]) / 3.0
# coefficients of x, x^2, x^3 of the polynomial through the stages, by stage
INTERPOLATION_WEIGHTS = np.array([
    [13.0 / 3.0 + 7.0 * _ROOT_OF_SIX / 3.0, -23.0 / 3.0 - 22.0 * _ROOT_OF_SIX / 3.0,
     10.0 / 3.0 + 5.0 * _ROOT_OF_SIX],
    [13.0 / 3.0 - 7.0 * _ROOT_OF_SIX / 3.0, -23.0 / 3.0 + 22.0 * _ROOT_OF_SIX / 3.0,
     10.0 / 3.0 - 5.0 * _ROOT_OF_SIX],
    [1.0 / 3.0, -8.0 / 3.0, 10.0 / 3.0],
])  # fmt: skip
STAGES = 3
# step of difference quotients in rad, characteristic lengths, per characteristic time
_DIFFERENCE_STEP = 1e-7
_MAX_NEWTON_ITERATIONS = 8
_NEWTON_TOLERANCE = 1e-3  # remaining error of Newton's method, relative to that of a step
_MAX_CONVERGENCE_RATE = 1e-3  # rate of convergence up to which the Jacobian is reused
_MAX_STEP_RATIO = 8.0
_INTERPOLATION_ERROR_FACTOR = 0.07  # error of the dense output per error of its initial slope


class RadauStepper(ErrorControlledStepper):
    """Compiled steps of Radau IIA.

    The Jacobian is approximated by differences of the compiled rates: along v_A, along the motions
    dq/dv_A of all joints, and along the states of the controller. `tolerances` are those of
    `error_tolerances`, then the displacements of v_A, q_A and controller states.

    Args:
        chart: The machine in a chart.
        tolerance: Error of a step, relative to the size of the state.

    Raises:
        FormulaTooLongError: The formulas are too long to be compiled.
    """

    def __init__(self, chart: Chart, tolerance: float = RADAU_TOLERANCE):
        closure, controller_state_count = chart.machine.closure, chart.controller_state_count
        active = closure.units[closure.active]
        self._mobility, self._controller_state_count = len(active), controller_state_count
        difference_steps = _DIFFERENCE_STEP * np.concatenate(
            [active / closure.characteristic_time, active, np.ones(controller_state_count)]
        )
        tolerances_and_steps = np.concatenate(
            [error_tolerances(chart, tolerance), difference_steps]
        )
        super().__init__(chart, ("radau",), False, tolerances_and_steps)

    def _add_method(self, program: Program) -> None:
        self._system = RadauLinearSystem(self._chart)
        for suffix, with_joints_at_rest in self._rest_variants:
            dynamics = self.trace_controlled_machine(Tape()).dynamics_formulas
            mass = [x for row in dynamics.mass_matrix for x in row]
            free = (
                dynamics.active_motion_factors if with_joints_at_rest else [1.0] * self._mobility
            )
            program.add_formula("mass" + suffix, 5, [*mass, *free])
        self._add_difference_formulas(program)
        for name in ("real", "complex"):
            tape = Tape()
            matrix = self._system.matrix(
                self._system.load_blocks(tape, 0), EigenvalueShift(name, tape.load(1, 0))
            )
            program.add_formula(
                f"{name}_factors", 2, [x for row in lu_factorize(matrix) for x in row]
            )
        self._add_newton(program)
        self._add_error_estimate(program)
        self._add_finish(program)
        self._add_dense_output(program)

    def _stages(self, tape: Tape, argument: int) -> list[list[Scalar]]:
        """Vectors of the three stages, read from an argument."""
        size = self.state_layout.size
        return [tape.load_vector(argument, i * size, size) for i in range(STAGES)]

    def _add_difference_formulas(self, program: Program) -> None:
        """Add displacements of the state, and the Jacobian by differences of rates.

        displaced(state, displacement), velocity_directions(tol) along v_A and controller states,
        coordinate_directions(rate, displaced rates, tol) along q_A, jacobian.
        """
        size, n, layout = self.state_layout.size, self._mobility, self.state_layout
        start = size + 1  # of the displacements in `tolerances`
        tape = Tape()
        program.add_formula(
            "displaced", 2, add_vectors(tape.load_vector(0, 0, size), tape.load_vector(1, 0, size))
        )
        tape = Tape()
        first_state = layout.start_index("controller")
        columns = [layout.start_index("v_a") + j for j in range(n)]
        columns += [first_state + j for j in range(self._controller_state_count)]
        steps = [*range(n), *range(2 * n, 2 * n + self._controller_state_count)]
        directions: list[Scalar] = []
        for column, step in zip(columns, steps, strict=True):
            row: list[Scalar] = [0.0] * size
            row[column] = tape.load(0, start + step)
            directions += row
        program.add_formula("velocity_directions", 1, directions)
        tape = Tape()
        directions = []
        for j in range(n):
            ratio = tape.load(2, start + n + j) / tape.load(2, start + j)
            rate = tape.load_vector(0, 0, layout.parts["q"])
            directions += scale_vector(
                ratio, subtract_vectors(tape.load_vector(1, j * size, layout.parts["q"]), rate)
            )
            directions += [0.0] * (size - len(rate))
        program.add_formula("coordinate_directions", 3, directions)
        program.add_formula("jacobian", 5, self._system.blocks_from_differences(Tape()))

    def _add_newton(self, program: Program) -> None:
        """predict(state, Z before, ratio); newton(state, J, real, complex, F, W, h, tol)."""
        size = self.state_layout.size
        tape = Tape()
        state, ratio = tape.load_vector(0, 0, size), tape.load(2, 0)
        previous = self._stages(tape, 1)
        prediction = []
        for node in NODES.tolist():
            x = 1.0 + node * ratio
            weights = [dot(row, [x, x * x, x * x * x]) for row in INTERPOLATION_WEIGHTS.tolist()]
            weights[2] = weights[2] - 1.0
            prediction.append([dot(weights, column) for column in zip(*previous, strict=True)])
        outputs = _stage_outputs(
            state, prediction, _combine_rows(INVERSE_TRANSFORMATION, prediction)
        )
        program.add_formula("predict", 3, outputs)
        tape = Tape()
        state, h = tape.load_vector(0, 0, size), tape.load(6, 0)
        blocks, rates, W = (
            self._system.load_blocks(tape, 1),
            self._stages(tape, 4),
            self._stages(tape, 5),
        )
        real, pair = EigenvalueShift("real", h), EigenvalueShift("complex", h)
        transformed = _combine_rows(INVERSE_TRANSFORMATION, rates)
        real_side = subtract_vectors(transformed[0], scale_vector(real.value[0], W[0]))
        a, b = pair.value
        pair_sides = [
            subtract_vectors(
                transformed[1], subtract_vectors(scale_vector(a, W[1]), scale_vector(b, W[2]))
            ),
            subtract_vectors(
                transformed[2], add_vectors(scale_vector(b, W[1]), scale_vector(a, W[2]))
            ),
        ]
        solve, load_factors = self._system.solve, self._system.load_factors
        change = solve(blocks, load_factors(tape, 2, real), real, [real_side])
        change += solve(blocks, load_factors(tape, 3, pair), pair, pair_sides)
        W = [add_vectors(w, dw) for w, dw in zip(W, change, strict=True)]
        scales = self._inverse_error_scales(tape, 7, state, state)
        total = _sum_of_squares([x for row in change for x in row], scales * STAGES)
        norm = apply_function("sqrt", total * (1.0 / (3.0 * len(scales))))
        outputs = _stage_outputs(state, _combine_rows(TRANSFORMATION, W), W)
        program.add_formula("newton", 8, {**outputs, "norm": [norm]})

    def _add_error_estimate(self, program: Program) -> None:
        """estimate(J, real, rate, Z, h)."""
        tape = Tape()
        h, Z, rate = (
            tape.load(4, 0),
            self._stages(tape, 3),
            tape.load_vector(2, 0, self.state_layout.size),
        )
        sums = [dot(ERROR_WEIGHTS.tolist(), column) for column in zip(*Z, strict=True)]
        right_side = add_vectors(rate, scale_vector(1.0 / h, sums))
        blocks, shift = self._system.load_blocks(tape, 0), EigenvalueShift("real", h)
        (error,) = self._system.solve(
            blocks, self._system.load_factors(tape, 1, shift), shift, [right_side]
        )
        program.add_formula("estimate", 5, error)

    def _add_finish(self, program: Program) -> None:
        """finish(constants, state, Z, error, rate, h, tol)."""
        size, nq = self.state_layout.size, self.state_layout.parts["q"]
        tape = Tape()
        state, h, Z = tape.load_vector(1, 0, size), tape.load(5, 0), self._stages(tape, 2)
        error, rate = tape.load_vector(3, 0, size), tape.load_vector(4, 0, size)
        after = add_vectors(state, Z[2])
        scales = self._inverse_error_scales(tape, 6, state, after)
        norm = apply_function("sqrt", _sum_of_squares(error, scales) * (1.0 / len(scales)))
        # error of the dense output: the polynomial through the stages against the cubic that has
        # the rate at the start and the end of the stages
        gaps = [
            dot([row[i] for row in Z], INTERPOLATION_WEIGHTS[:, 0].tolist()) - h * rate[i]
            for i in range(nq)
        ]
        scaled_gaps = [gap * scale for gap, scale in zip(gaps, scales, strict=False)]
        interpolation_error = _sum_of_squares(scaled_gaps, [_INTERPOLATION_ERROR_FACTOR] * nq)
        norm = maximum(norm, apply_function("sqrt", interpolation_error * (1.0 / nq)))
        program.add_formula(
            "finish",
            7,
            self._finish_outputs(
                after, norm, self._largest_move(tape, Z[2][:nq]), 4.0, _MAX_STEP_RATIO
            ),
        )

    def _add_dense_output(self, program: Program) -> None:
        """dense(Z): x (Q0 + Q1 x + Q2 x^2) in the form x (c0 + (1 - x) (c1 + x c2))."""
        Z = self._stages(Tape(), 0)
        Q = [
            [dot(weights, z) for z in zip(*Z, strict=True)]
            for weights in INTERPOLATION_WEIGHTS.T.tolist()
        ]
        coefficients = (
            add_vectors(*Q),
            scale_vector(-1.0, add_vectors(Q[1], Q[2])),
            scale_vector(-1.0, Q[2]),
        )
        program.add_formula("dense", 1, [x for row in coefficients for x in row])

    def _write_step(self, program: Program, step: StepLoop) -> tuple[StepWriter, StepWriter]:
        writer = _RadauStepCode(program, step, self._chart)
        return writer.write_attempt, writer.write_interpolation


class _RadauStepCode:
    """Writer of the code of one step.

    Args:
        program: The program with its formulas.
        step: The loop over steps.
        chart: The machine in a chart.
    """

    def __init__(self, program: Program, step: StepLoop, chart: Chart):
        r, size, mobility = step.routine, chart.state_layout.size, len(chart.machine.active)
        self._r = r
        self._step, self._mobility, self._size = step, mobility, size
        m = self._direction_count = mobility + chart.controller_state_count
        # rates have further outputs, which the next rate overwrites
        further = program.formula_outputs("rate").size - size
        sizes: dict[str, Layout | int] = {
            "velocity_directions": m * size, "coordinate_directions": max(1, mobility * size),
            "velocity_rates": m * size + further, "coordinate_rates": m * size + further,
            "mass": mobility * mobility + mobility, "stage": size,
            "jacobian": program.formula_outputs("jacobian"), "real_factors": m * m,
            "complex_factors": 4 * m * m, "rates": STAGES * size + further,
            "error_rate": size + further, "iterate": program.formula_outputs("newton"),
            "previous_stages": STAGES * size, "ratio": 1, "error_estimate": size,
        }  # fmt: skip
        self._arrays = SimpleNamespace(**{x: r.local_array(x, n) for x, n in sizes.items()})
        self._jacobian_time = r.new_variable(-np.inf)
        self._convergence_rate = r.new_variable(1.0)
        self._previous_length = r.new_variable(0.0)
        r.call("velocity_directions", r.tol, self._arrays.velocity_directions)
        with r.loop(r.new_variable(STAGES * size)) as i:
            r.store(self._arrays.previous_stages, i, 0.0)

    def write_attempt(self, t: RoutineValue, length: RoutineValue) -> None:
        """Write an attempt of a step from a time on, up to `finish`."""
        r, step, arrays, result = self._r, self._step, self._arrays, self._step.step_result
        with r.if_then(
            (t > self._jacobian_time) & (self._convergence_rate > _MAX_CONVERGENCE_RATE)
        ):
            self._update_jacobian(t)
        r.call("real_factors", arrays.jacobian, step.length, arrays.real_factors)
        r.call("complex_factors", arrays.jacobian, step.length, arrays.complex_factors)
        r.store(
            arrays.ratio,
            0,
            select(self._previous_length > 0.0, length / self._previous_length, 0.0),
        )
        r.call("predict", r.state, arrays.previous_stages, arrays.ratio, arrays.iterate)
        converged = self._iterate_newton(t, length)
        Z = arrays.iterate.element_pointer("Z")
        self._estimate_error(step.start_rate, Z)
        with r.if_then(result["error"] > 1.0):
            r.call("displaced", r.state, arrays.error_estimate, arrays.stage)
            step.call("rate", t, arrays.stage, arrays.error_rate)
            self._estimate_error(arrays.error_rate, Z)
        with r.if_then(converged < 1):
            r.store(result.element_pointer("error"), 0, 2.0)
            r.store(result.element_pointer("change"), 0, 0.25)
            r.assign(self._convergence_rate, 1.0)
            is_old = self._jacobian_time < t
            r.assign(self._jacobian_time, select(is_old, -np.inf, self._jacobian_time))
        with r.if_else():
            r.copy(arrays.previous_stages, Z, STAGES * self._size)
            r.assign(self._previous_length, select(result["error"] <= 1.0, length, 0.0))

    def write_interpolation(self, t: RoutineValue, length: RoutineValue) -> None:
        """Write the dense output behind a step."""
        self._r.call("dense", self._arrays.iterate.element_pointer("Z"), self._step.dense_output)

    def _update_jacobian(self, t: RoutineValue) -> None:
        r, step, a = self._r, self._step, self._arrays
        step.call("mass", t, r.state, a.mass)
        self._write_rates(t, self._direction_count, a.velocity_directions, a.velocity_rates)
        r.call(
            "coordinate_directions", step.start_rate, a.velocity_rates, r.tol,
            a.coordinate_directions,
        )  # fmt: skip
        self._write_rates(t, self._mobility, a.coordinate_directions, a.coordinate_rates)
        r.call(
            "jacobian",
            *(step.start_rate, a.velocity_rates, a.coordinate_rates),
            a.mass,
            r.tol,
            a.jacobian,
        )
        r.assign(self._jacobian_time, t)

    def _write_rates(
        self, t: RoutineValue, count: int, directions: ArrayPointer, rates: ArrayPointer
    ) -> None:
        """Rates at states that are displaced along some directions."""
        r, stage, size = self._r, self._arrays.stage, self._size
        with r.loop(r.new_variable(count)) as i:
            r.call("displaced", r.state, directions.row_pointer(i, size), stage)
            self._step.call("rate", t, stage, rates.row_pointer(i, size))

    def _iterate_newton(self, t: RoutineValue, length: RoutineValue) -> RoutineValue:
        """Iterations of Newton's method; returns 1 if it converges."""
        r, step, a = self._r, self._step, self._arrays
        tries, converged, norm = r.new_variable(0), r.new_variable(0), r.new_variable(0.0)
        rate = self._convergence_rate
        with r.loop_forever():
            for i in range(STAGES):
                stage = a.iterate.element_pointer("stages").element_pointer(i * self._size)
                step.call(
                    "rate",
                    t + length * float(NODES[i]),
                    stage,
                    a.rates.element_pointer(i * self._size),
                )
            r.call(
                "newton", r.state, a.jacobian, a.real_factors, a.complex_factors, a.rates,
                a.iterate.element_pointer("W"), step.length, r.tol, a.iterate,
            )  # fmt: skip
            r.assign(tries, tries + 1)
            previous_norm = r.new_variable(norm)
            r.assign(norm, a.iterate["norm"])
            with r.if_then(tries > 1):
                r.assign(rate, norm / previous_norm)
                with r.if_then(rate * norm < (rate * -1.0 + 1.0) * _NEWTON_TOLERANCE):
                    r.assign(converged, 1)
                with r.if_then(~(rate < 1.0)):
                    r.assign(converged, 0)
                    r.assign(tries, _MAX_NEWTON_ITERATIONS)
            with r.if_then(norm < 1e-3 * _NEWTON_TOLERANCE):
                r.assign(converged, 1)
            with r.if_then((converged > 0) | (tries >= _MAX_NEWTON_ITERATIONS)):
                r.break_loop()
        return converged

    def _estimate_error(self, rate: ArrayPointer, Z: ArrayPointer) -> None:
        """Estimate of the error with a rate at the start of the step, and `finish`."""
        r, step, a = self._r, self._step, self._arrays
        r.call("estimate", a.jacobian, a.real_factors, rate, Z, step.length, a.error_estimate)
        r.call(
            "finish", r.geometry, r.state, Z, a.error_estimate, step.start_rate, step.length,
            r.tol, step.step_result,
        )  # fmt: skip


def _stage_outputs(
    state: list[Scalar], Z: list[list[Scalar]], W: list[list[Scalar]]
) -> dict[str, list[Scalar]]:
    return {
        "W": [x for row in W for x in row],
        "Z": [x for row in Z for x in row],
        "stages": [x for row in Z for x in add_vectors(state, row)],
    }


def _sum_of_squares(values: list[Scalar], scales: list[Scalar]) -> Scalar:
    total: Scalar = 0.0
    for x, scale in zip(values, scales, strict=True):
        total = total + (x * scale) * (x * scale)
    return total


def _combine_rows(weights: Array, rows: list[list[Scalar]]) -> list[list[Scalar]]:
    return [[dot(row, column) for column in zip(*rows, strict=True)] for row in weights.tolist()]
