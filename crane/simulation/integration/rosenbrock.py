"""Steps of a Rosenbrock method in machine code, which nothing stiff shortens."""

import numpy as np

from crane.closure.kinematics_formulas import largest_scaled_value
from crane.codegen import Program, RoutineValue, Scalar, SymbolicExpression, Tape, max_abs, maximum
from crane.codegen.differentiation import differentiate
from crane.codegen.matrix_factorization import (
    Matrix,
    load_matrix,
    lu_factorize,
    lu_solve,
    symbolic_entries,
)
from crane.codegen.symbolic import (
    add_vectors,
    apply_function,
    matvec,
    minimum,
    scale_vector,
    subtract_vectors,
)
from crane.control import TracedController, ValveDrive
from crane.dynamics.external_forces import state_count
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.error_controlled_stepper import (
    ENERGY_TOLERANCE_FACTOR,
    MIN_SCALE,
    ErrorControlledStepper,
    characteristic_energy,
    weighted_sum,
)
from crane.simulation.integration.step_loop import MIN_STEP_RATIO, StepCode, StepWriter

# ROS34PW2 of Rang and Angermann (2005): order 3 with any Jacobian, L-stable, stiffly accurate,
# with an embedded method of order 2.
GAMMA = 4.3586652150845900e-01
ALPHA = np.array([
    [0.0, 0.0, 0.0, 0.0],
    [8.7173304301691801e-01, 0.0, 0.0, 0.0],
    [8.4457060015369423e-01, -1.1299064236484185e-01, 0.0, 0.0],
    [0.0, 0.0, 1.0, 0.0],
])  # fmt: skip
GAMMA_MATRIX = np.array([
    [GAMMA, 0.0, 0.0, 0.0],
    [-8.7173304301691801e-01, GAMMA, 0.0, 0.0],
    [-9.0338057013044082e-01, 5.4180672388095326e-02, GAMMA, 0.0],
    [2.4212380706095346e-01, -1.2232505839045147e00, 5.4526025533510214e-01, GAMMA],
])  # fmt: skip
WEIGHTS = np.array([2.4212380706095346e-01, -1.2232505839045147e00, 1.5452602553351020e00, GAMMA])
EMBEDDED_WEIGHTS = np.array(
    [3.7810903145819369e-01, -9.6042292212423178e-02, 0.5, 2.1793326075422950e-01]
)
STAGES = len(WEIGHTS)

# in the transformed variables; rounding above the diagonal would read what is not there
_INVERSE_GAMMA_MATRIX = np.tril(np.linalg.inv(GAMMA_MATRIX))
_STAGE_COEFFICIENTS = ALPHA @ _INVERSE_GAMMA_MATRIX
_RIGHT_SIDE_COEFFICIENTS = np.diag(np.diag(_INVERSE_GAMMA_MATRIX)) - _INVERSE_GAMMA_MATRIX
_FINAL_WEIGHTS, _EMBEDDED_WEIGHTS = (
    WEIGHTS @ _INVERSE_GAMMA_MATRIX,
    EMBEDDED_WEIGHTS @ _INVERSE_GAMMA_MATRIX,
)

ROSENBROCK_TOLERANCE = 1e-8  # error of a step, per size of the state
# accuracy that matters [rad], [machine's size], that per `Closure.characteristic_time`, and of a
# law's states
_COORDINATE_ACCURACY, _VELOCITY_ACCURACY, _CONTROLLER_ACCURACY = 1e-11, 1e-9, 1e-9
_MAX_STEP_RATIO, _SAFETY_FACTOR = 6.0, 0.9  # change of the step's length from one to the next


class RosenbrockStepper(ErrorControlledStepper):
    """Steps of ROS34PW2.

    The Jacobian of y' = f(y) is exact for the controller's states and for what forces, friction
    and passive forces do to the velocities; of coordinates it has what springs, stops, gas and
    the controller do with them, along the active ones and at frozen gamma; and none for the rest
    (weight, centrifugal forces, integrals): the order does not depend on it. In the transformed
    variables u = sum gamma_ij k_j, stage i solves

        (1 / (h gamma) - J) u_i = f(y + sum a_ij u_j) + sum c_ij / h u_j,

    where u_q = h gamma (r_q + Gamma u_v) with the right side r leaves

        [M_A - h gamma D - (h gamma)^2 K] u_v - h gamma B u_o = h gamma (M_A r_v + h gamma K r_qA)

    and the rows of the controller's states o. With circuits J has nothing of coordinates. (Hairer
    and Wanner, Solving Ordinary Differential Equations II, IV.7.)

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
        tolerance: float = ROSENBROCK_TOLERANCE,
    ):
        scales = (
            control.scales
            if isinstance(control, ValveDrive)
            else np.full(controller_state_count, _CONTROLLER_ACCURACY)
        )
        self._stiff_state_count = int(np.isfinite(scales).sum())
        closure = chart.machine.closure
        accuracies = np.concatenate(
            [
                _COORDINATE_ACCURACY * closure.units,
                _VELOCITY_ACCURACY * closure.units[closure.active] / closure.characteristic_time,
                np.full(
                    state_count(chart.machine.external_forces),
                    _COORDINATE_ACCURACY * closure.characteristic_length,
                ),
                scales,
            ]
        )
        method = ("stiff", self._stiff_state_count)
        energy = MIN_SCALE * ENERGY_TOLERANCE_FACTOR * tolerance * characteristic_energy(chart)
        errors = np.append(
            ROSENBROCK_TOLERANCE / tolerance / accuracies, [tolerance, 1.0 / energy]
        )
        super().__init__(chart, control, controller_state_count, method, True, errors)

    def _add_method(self, program: Program) -> None:
        """combine(s, u), prepare(..., h), solve(rate, u, factors, h) of stages; finish; dense."""
        for added, rest in self._rest_variants:
            self._add_stage_solvers(program, added, rest)
        size, q = self.state_layout.size, self.state_layout.parts["q"]
        for i in range(1, STAGES):
            tape = Tape()
            state = tape.load_vector(0, 0, size)
            program.add_formula(
                f"combine{i}",
                2,
                add_vectors(state, weighted_sum(tape, 1, size, _STAGE_COEFFICIENTS[i])),
            )
        tape = Tape()
        state = tape.load_vector(1, 0, size)
        after = add_vectors(state, weighted_sum(tape, 2, size, _FINAL_WEIGHTS))
        error_vector = weighted_sum(tape, 2, size, _FINAL_WEIGHTS - _EMBEDDED_WEIGHTS)
        checked_states, energies = (
            self.state_layout.start_index("own") + self._stiff_state_count,
            self.state_layout.start_index("work"),
        )
        relative = tape.load(3, energies)
        shares = [
            error_vector[i] / (1.0 / tape.load(3, i) + relative * apply_function("abs", after[i]))
            for i in range(checked_states)
        ]
        if not self._steps_end_at_outputs:
            shares += [
                error_vector[i]
                / (
                    1.0 / tape.load(3, energies + 1)
                    + ENERGY_TOLERANCE_FACTOR * relative * apply_function("abs", after[i])
                )
                for i in range(energies, size)
            ]
        # the other integrals count only so far as that NaN and infinity anywhere show
        error = maximum(
            max_abs(shares), max_abs(scale_vector(1e-30, error_vector[checked_states:]))
        )
        is_length = [not turns for turns in self.closure_code.geometry.is_revolute[1:]]
        displacement = subtract_vectors(after[:q], state[:q])
        largest_move = largest_scaled_value(
            displacement, is_length, self.closure_code.inverse_characteristic_length(tape)
        )
        error = self._limit_rotation(error, largest_move)
        clipped_error = minimum(maximum(error, 1e-9), 1e9)
        step_ratio = _SAFETY_FACTOR * apply_function(
            "exp", (-1.0 / 3.0) * apply_function("log", clipped_error)
        )
        step_ratio = minimum(maximum(step_ratio, MIN_STEP_RATIO), _MAX_STEP_RATIO)
        outputs = {
            "state": after,
            "error": [error],
            "change": [step_ratio],
            "move": [largest_move],
        }
        program.add_formula("finish", 4, outputs)
        # the cubic through both ends and their slopes
        tape = Tape()
        h = tape.load(2, 0)
        displacement = subtract_vectors(tape.load_vector(3, 0, size), tape.load_vector(0, 0, size))
        slopes = [scale_vector(h, tape.load_vector(array, 0, size)) for array in (1, 4)]
        parts = (
            *displacement,
            *subtract_vectors(slopes[0], displacement),
            *subtract_vectors(scale_vector(2.0, displacement), add_vectors(*slopes)),
        )
        program.add_formula("dense", 5, list(parts))

    def _add_stage_solvers(self, program: Program, suffix: str, with_joints_at_rest: bool) -> None:
        """prepare(..., h): elimination of 1 - h gamma J, rows of the velocities times M_A.

        And solve(rate, u, factors, h) of each stage. Joints at rest get the accelerations that
        they have in `rate`, whatever the Jacobian says: a row Gamma x = Gamma b for each of them.
        """
        tape = Tape()
        machine, _, tau, own_rate = self._trace_controlled_machine(tape)
        sweep, parts, stiff_state_count = (
            machine.dynamics_formulas,
            machine.state_parts,
            self._stiff_state_count,
        )
        own_rate, mass, n = list(own_rate[:stiff_state_count]), sweep.mass_matrix, len(parts.v_a)
        step_gamma = GAMMA * tape.load(5, 0)
        unknown = [
            x
            for x in (*parts.own[:stiff_state_count], *parts.v_a)
            if isinstance(x, SymbolicExpression)
        ]
        jacobian = differentiate([*own_rate, *machine.forces_without_gravity(tau)], unknown)
        coordinate_jacobian: Matrix = [[0.0] * n for _ in range(stiff_state_count + n)]
        coordinate_directions: Matrix = [[0.0] * n for _ in parts.q]
        if (
            not self._steps_end_at_outputs
        ):  # sums of oil and strokes stay what they are where J has neither
            coordinate_jacobian = [
                scale_vector(step_gamma, row) for row in machine.stiffness(own_rate, tau)
            ]
            coordinate_directions = [scale_vector(step_gamma, row) for row in sweep.rate_jacobian]
        matrix = [scale_vector(-1.0 * step_gamma, row) for row in jacobian]
        for i in range(stiff_state_count):
            matrix[i][i] = matrix[i][i] + 1.0
        for i, row in enumerate(mass):
            for j, entry in enumerate(row):
                matrix[stiff_state_count + i][stiff_state_count + j] = (
                    matrix[stiff_state_count + i][stiff_state_count + j] + entry
                )
        for row, slopes in zip(matrix, coordinate_jacobian, strict=True):
            for j, slope in enumerate(slopes):
                row[stiff_state_count + j] = row[stiff_state_count + j] - step_gamma * slope
        constraints = sweep.stick_slip_rows if with_joints_at_rest else []
        constraint_rows = [scale_vector(held, row) for held, row in constraints]
        for row in matrix:
            row += [0.0] * len(constraint_rows)
        for k, row in enumerate(constraint_rows):
            for j, entry in enumerate(row):
                matrix[stiff_state_count + j][stiff_state_count + n + k] = entry
            others: list[Scalar] = [0.0] * len(constraint_rows)
            others[k] = constraints[k][0] - 1.0
            matrix.append([*([0.0] * stiff_state_count), *row, *others])
        factors = lu_factorize(matrix)
        tables: dict[str, Matrix] = {
            "factors": factors,
            "mass": mass,
            "rows": constraint_rows,
            "by_q": coordinate_jacobian,
            "ways": coordinate_directions,
            "free": [sweep.active_motion_factors] if with_joints_at_rest else [[1.0] * n],
        }
        outputs = {name: symbolic_entries(table) for name, table in tables.items()}
        program.add_formula(f"prepare{suffix}", 6, outputs)
        starts = program.formula_outputs(f"prepare{suffix}")
        size, active = self.state_layout.size, self._chart.machine.closure.active
        for i in range(STAGES):
            tape = Tape()
            right = scale_vector(GAMMA * tape.load(3, 0), tape.load_vector(0, 0, size))
            right = add_vectors(
                right,
                scale_vector(GAMMA, weighted_sum(tape, 1, size, _RIGHT_SIDE_COEFFICIENTS[i])),
            )
            there = {
                name: load_matrix(table, tape, 2, starts.start_index(name))
                for name, table in tables.items()
            }
            part = self.state_layout.view(right)
            pulls = matvec(there["by_q"], [part.q[column] for column in active])
            wanted = add_vectors(
                [*part.own[:stiff_state_count], *matvec(there["mass"], part.v_a)], pulls
            )
            x = lu_solve(there["factors"], [*wanted, *matvec(there["rows"], part.v_a)])
            v_a = [
                w * y
                for w, y in zip(
                    there["free"][0], x[stiff_state_count : stiff_state_count + n], strict=True
                )
            ]
            own = [*x[:stiff_state_count], *part.own[stiff_state_count:]]
            q = add_vectors(part.q, matvec(there["ways"], v_a))
            program.add_formula(
                f"solve{i}{suffix}", 4, [*q, *v_a, *part.shear, *own, *part.work, *part.lost]
            )

    def _write_step(self, program: Program, step: StepCode) -> tuple[StepWriter, StepWriter]:
        """See `ErrorControlledStepper`."""
        r, size = step.routine, self.state_layout.size
        u, stage = r.local_array("u", STAGES * size), r.local_array("stage", size)
        slope = r.local_array("slope", program.formula_outputs("rate"))
        # the last has the most
        factors = r.local_array(
            "factors", program.formula_outputs("prepare" + self._rest_variants[-1][0])
        )

        def attempt(t: RoutineValue, length: RoutineValue) -> None:
            step.call("prepare", t, r.state, step.length, factors)
            for k in range(STAGES):
                now = step.start_rate
                if k:
                    now = slope
                    r.call(f"combine{k}", r.state, u, stage)
                    step.call("rate", t + length * float(ALPHA[k].sum()), stage, slope)
                self.call_formula(
                    r, f"solve{k}", now, u, factors, step.length, u.element_pointer(k * size)
                )
            r.call("finish", r.geometry, r.state, u, r.tol, step.step_result)

        def interpolate(t: RoutineValue, length: RoutineValue) -> None:
            ends = step.start_rate, step.length, step.step_result, step.end_rate
            r.call("dense", r.state, *ends, step.dense_output)

        return attempt, interpolate
