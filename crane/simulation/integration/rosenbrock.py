"""Compiled steps of ROS34PW2, a Rosenbrock method of order 3 for stiff machines and circuits."""

import numpy as np

from crane.codegen import Program, RoutineValue, Scalar, SymbolicExpression, Tape, max_abs, maximum
from crane.codegen.differentiation import differentiate
from crane.codegen.symbolic import (
    add_vectors,
    apply_function,
    matvec,
    scale_vector,
    subtract_vectors,
)
from crane.codegen.symbolic_linear_algebra import (
    Matrix,
    load_matrix,
    lu_factorize,
    lu_solve,
    symbolic_entries,
)
from crane.control.valve_drive import ValveDrive
from crane.dynamics.external_forces import state_count
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.error_controlled_stepper import (
    ENERGY_TOLERANCE_FACTOR,
    MIN_SCALE,
    ErrorControlledStepper,
    characteristic_energy,
    weighted_sum,
)
from crane.simulation.integration.step_loop import StepLoop, StepWriter

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

# coefficients in the transformed variables; tril removes rounding errors above the diagonal
_INVERSE_GAMMA_MATRIX = np.tril(np.linalg.inv(GAMMA_MATRIX))
_STAGE_COEFFICIENTS = ALPHA @ _INVERSE_GAMMA_MATRIX
_RIGHT_SIDE_COEFFICIENTS = np.diag(np.diag(_INVERSE_GAMMA_MATRIX)) - _INVERSE_GAMMA_MATRIX
_FINAL_WEIGHTS, _EMBEDDED_WEIGHTS = (
    WEIGHTS @ _INVERSE_GAMMA_MATRIX,
    EMBEDDED_WEIGHTS @ _INVERSE_GAMMA_MATRIX,
)

ROSENBROCK_TOLERANCE = 1e-8  # error of a step, relative to the size of the state
# required accuracy [rad], [characteristic lengths], of velocities per characteristic time, and of
# the states of a control law
_COORDINATE_ACCURACY, _VELOCITY_ACCURACY, _CONTROLLER_ACCURACY = 1e-11, 1e-9, 1e-9
_MAX_STEP_RATIO = 6.0


class RosenbrockStepper(ErrorControlledStepper):
    """Compiled steps of ROS34PW2.

    The Jacobian of y' = f(y) is exact for the states of the controller, and for the effect of
    forces, friction and passive forces on the velocities. For coordinates it has the effect of
    springs, end stops, gas springs and the controller, along the active coordinates and at
    constant gamma; it neglects gravity, velocity-dependent terms and integrals, on which the order
    does not depend. In the transformed variables u = sum gamma_ij k_j, stage i solves

        (1 / (h gamma) - J) u_i = f(y + sum a_ij u_j) + sum c_ij / h u_j,

    where u_q = h gamma (r_q + Gamma u_v) with the right side r leaves

        [M_A - h gamma D - (h gamma)^2 K] u_v - h gamma B u_o = h gamma (M_A r_v + h gamma K r_qA)

    and the rows of the states o of the controller. With circuits J has no derivatives by
    coordinates. (Hairer and Wanner, Solving Ordinary Differential Equations II, IV.7.)

    Args:
        chart: The machine in a chart.
        tolerance: Error of a step, relative to the size of the state.

    Raises:
        FormulaTooLongError: The formulas are too long to be compiled.
    """

    def __init__(self, chart: Chart, tolerance: float = ROSENBROCK_TOLERANCE):
        scales = (
            chart.control.scales
            if isinstance(chart.control, ValveDrive)
            else np.full(chart.controller_state_count, _CONTROLLER_ACCURACY)
        )
        self._stiff_state_count = int(np.isfinite(scales).sum())
        closure = chart.machine.closure
        contact_accuracy = _COORDINATE_ACCURACY * closure.characteristic_length
        accuracies = np.concatenate(
            [
                _COORDINATE_ACCURACY * closure.units,
                _VELOCITY_ACCURACY * closure.units[closure.active] / closure.characteristic_time,
                np.full(state_count(chart.machine.external_forces), contact_accuracy),
                scales,
            ]
        )
        method = ("stiff", self._stiff_state_count)
        energy = (
            MIN_SCALE * ENERGY_TOLERANCE_FACTOR * tolerance * characteristic_energy(chart.machine)
        )
        errors = np.append(
            ROSENBROCK_TOLERANCE / tolerance / accuracies, [tolerance, 1.0 / energy]
        )
        super().__init__(chart, method, True, errors)

    def _add_method(self, program: Program) -> None:
        """combine(state, u), prepare(..., h), solve(rate, u, factors, h), finish, dense."""
        for suffix, with_joints_at_rest in self._rest_variants:
            self._add_stage_solvers(program, suffix, with_joints_at_rest)
        size = self.state_layout.size
        for i in range(1, STAGES):
            tape = Tape()
            state = tape.load_vector(0, 0, size)
            program.add_formula(
                f"combine{i}",
                2,
                add_vectors(state, weighted_sum(tape, 1, size, _STAGE_COEFFICIENTS[i])),
            )
        self._add_finish(program)
        # dense output: the cubic through both ends and their slopes
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

    def _add_finish(self, program: Program) -> None:
        """finish(constants, state, u, tol)."""
        size, q = self.state_layout.size, self.state_layout.parts["q"]
        tape = Tape()
        state = tape.load_vector(1, 0, size)
        after = add_vectors(state, weighted_sum(tape, 2, size, _FINAL_WEIGHTS))
        errors = weighted_sum(tape, 2, size, _FINAL_WEIGHTS - _EMBEDDED_WEIGHTS)
        checked_count = self.state_layout.start_index("controller") + self._stiff_state_count
        energies = self.state_layout.start_index("work")
        tolerance = tape.load(3, energies)

        def share(i: int, inverse_accuracy: int, relative: Scalar) -> Scalar:
            return errors[i] / (
                (1.0 / tape.load(3, inverse_accuracy)) + relative * apply_function("abs", after[i])
            )

        shares = [share(i, i, tolerance) for i in range(checked_count)]
        if not self._steps_end_at_outputs:
            shares += [
                share(i, energies + 1, ENERGY_TOLERANCE_FACTOR * tolerance)
                for i in range(energies, size)
            ]
        # the errors of other integrals only have to be finite
        error = maximum(max_abs(shares), max_abs(scale_vector(1e-30, errors[checked_count:])))
        largest_move = self._largest_move(tape, subtract_vectors(after[:q], state[:q]))
        program.add_formula(
            "finish", 4, self._finish_outputs(after, error, largest_move, 3.0, _MAX_STEP_RATIO)
        )

    def _add_stage_solvers(self, program: Program, suffix: str, with_joints_at_rest: bool) -> None:
        """Add prepare(..., h), which factorizes 1 - h gamma J, and the solvers of the stages.

        Joints at rest keep the accelerations that they have in `rate`: each adds an equation
        Gamma x = Gamma b.
        """
        tape = Tape()
        machine = self.trace_controlled_machine(tape)
        dynamics, n = machine.dynamics_formulas, len(machine.state_parts.v_a)
        mass, k = dynamics.mass_matrix, self._stiff_state_count
        step_gamma = GAMMA * tape.load(5, 0)
        parts = machine.state_parts
        variables = [
            x for x in (*parts.controller[:k], *parts.v_a) if isinstance(x, SymbolicExpression)
        ]
        jacobian = differentiate(
            [*machine.controller_rate[:k], *machine.forces_without_gravity()], variables
        )
        # the balances of oil and strokes stay exact where J has derivatives of neither
        by_coordinates: Matrix = [[0.0] * n for _ in range(k + n)]
        coordinate_directions: Matrix = [[0.0] * n for _ in machine.state_parts.q]
        if not self._steps_end_at_outputs:
            by_coordinates = [scale_vector(step_gamma, row) for row in machine.stiffness(k)]
            coordinate_directions = [
                scale_vector(step_gamma, row) for row in dynamics.rate_jacobian
            ]
        # 1 - h gamma J of stiff controller states and velocities, the latter times M_A
        matrix = [scale_vector(-1.0 * step_gamma, row) for row in jacobian]
        for i in range(k):
            matrix[i][i] = matrix[i][i] + 1.0
        for row, mass_row in zip(matrix[k:], mass, strict=True):
            row[k:] = add_vectors(row[k:], mass_row)
        for row, derivatives in zip(matrix, by_coordinates, strict=True):
            for j, derivative in enumerate(derivatives):
                row[k + j] = row[k + j] - step_gamma * derivative
        constraints = dynamics.stick_slip_rows if with_joints_at_rest else []
        constraint_rows = [scale_vector(held, row) for held, row in constraints]
        _append_constraints(matrix, k, constraint_rows, [held - 1.0 for held, _ in constraints])
        tables: dict[str, Matrix] = {
            "factors": lu_factorize(matrix),
            "mass": mass,
            "rows": constraint_rows,
            "by_coordinates": by_coordinates,
            "directions": coordinate_directions,
            "free": [dynamics.active_motion_factors if with_joints_at_rest else [1.0] * n],
        }
        program.add_formula(
            f"prepare{suffix}",
            6,
            {name: symbolic_entries(table) for name, table in tables.items()},
        )
        for i in range(STAGES):
            self._add_stage_solver(program, i, suffix, tables)

    def _add_stage_solver(
        self, program: Program, stage: int, suffix: str, tables: dict[str, Matrix]
    ) -> None:
        """solve(rate, u, factors, h) of a stage."""
        size, k = self.state_layout.size, self._stiff_state_count
        active, starts = (
            self._chart.machine.closure.active,
            program.formula_outputs(f"prepare{suffix}"),
        )
        tape = Tape()
        right = scale_vector(GAMMA * tape.load(3, 0), tape.load_vector(0, 0, size))
        previous = weighted_sum(tape, 1, size, _RIGHT_SIDE_COEFFICIENTS[stage])
        part = self.state_layout.view(add_vectors(right, scale_vector(GAMMA, previous)))
        loaded = {
            name: load_matrix(table, tape, 2, starts.start_index(name))
            for name, table in tables.items()
        }
        by_coordinates = matvec(loaded["by_coordinates"], [part.q[i] for i in active])
        right_side = add_vectors(
            [*part.controller[:k], *matvec(loaded["mass"], part.v_a)], by_coordinates
        )
        solution = lu_solve(loaded["factors"], [*right_side, *matvec(loaded["rows"], part.v_a)])
        free = loaded["free"][0]
        v_a = [factor * x for factor, x in zip(free, solution[k : k + len(free)], strict=True)]
        q = add_vectors(part.q, matvec(loaded["directions"], v_a))
        outputs = [
            *q,
            *v_a,
            *part.contacts,
            *[*solution[:k], *part.controller[k:]],
            *part.work,
            *part.dissipated,
        ]
        program.add_formula(f"solve{stage}{suffix}", 4, outputs)

    def _write_step(self, program: Program, step: StepLoop) -> tuple[StepWriter, StepWriter]:
        r, size = step.routine, self.state_layout.size
        u, stage = r.local_array("u", STAGES * size), r.local_array("stage", size)
        stage_rate = r.local_array("slope", program.formula_outputs("rate"))
        # the last variant has the most outputs
        factors = r.local_array(
            "factors", program.formula_outputs("prepare" + self._rest_variants[-1][0])
        )

        def attempt(t: RoutineValue, length: RoutineValue) -> None:
            step.call("prepare", t, r.state, step.length, factors)
            rate = step.start_rate
            for i in range(STAGES):
                if i:
                    rate = stage_rate
                    r.call(f"combine{i}", r.state, u, stage)
                    step.call("rate", t + length * float(ALPHA[i].sum()), stage, rate)
                self.call_formula(
                    r, f"solve{i}", rate, u, factors, step.length, u.element_pointer(i * size)
                )
            r.call("finish", r.geometry, r.state, u, r.tol, step.step_result)

        def interpolate(t: RoutineValue, length: RoutineValue) -> None:
            r.call(
                "dense",
                r.state,
                *(step.start_rate, step.length, step.step_result, step.end_rate),
                step.dense_output,
            )

        return attempt, interpolate


def _append_constraints(
    matrix: Matrix, first_column: int, rows: list[list[Scalar]], diagonal: list[Scalar]
) -> None:
    """Append equations of joints at rest to a matrix, with their multipliers."""
    for row in matrix:
        row += [0.0] * len(rows)
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            matrix[first_column + j][first_column + len(row) + i] = entry
        multipliers: list[Scalar] = [0.0] * len(rows)
        multipliers[i] = diagonal[i]
        matrix.append([*([0.0] * first_column), *row, *multipliers])
