"""Steps of an implicit method of fifth order in machine code, which nothing stiff shortens.

Radau IIA of three stages with its embedded method of order 3 (Hairer and Wanner, Solving Ordinary
Differential Equations II, IV.8, from where the coefficients are).
"""

import numpy as np

from crane.closure.kinematics_formulas import largest_scaled_value
from crane.codegen import Layout, Program, RoutineValue, Scalar, Tape, select
from crane.codegen.intermediate_representation import ArrayPointer as Place
from crane.codegen.matrix_factorization import Matrix, lu_factorize, lu_solve
from crane.codegen.symbolic import (
    add_vectors,
    apply_function,
    dot,
    matvec,
    maximum,
    minimum,
    scale_vector,
    subtract_vectors,
)
from crane.common.samples import Array
from crane.control import TracedController
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.error_controlled_stepper import (
    ErrorControlledStepper,
    error_tolerances,
)
from crane.simulation.integration.step_loop import MIN_STEP_RATIO, StepCode, StepWriter

RADAU_TOLERANCE = 1e-9  # error of a step, per size of the state
_ROOT_OF_SIX = np.sqrt(6.0)
NODES = np.array([(4.0 - _ROOT_OF_SIX) / 10.0, (4.0 + _ROOT_OF_SIX) / 10.0, 1.0])
# of the inverse of the method's matrix the eigenvalues, and in whose basis
REAL_EIGENVALUE = 3.0 + 3.0 ** (2 / 3) - 3.0 ** (1 / 3)
COMPLEX_EIGENVALUE = (
    3.0 + 0.5 * (3.0 ** (1 / 3) - 3.0 ** (2 / 3)),
    -0.5 * (3.0 ** (5 / 6) + 3.0 ** (7 / 6)),
)
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
# the stages' polynomial: x, x^2, x^3 by stage
INTERPOLATION_WEIGHTS = np.array(
    [
        [
            13.0 / 3.0 + 7.0 * _ROOT_OF_SIX / 3.0,
            -23.0 / 3.0 - 22.0 * _ROOT_OF_SIX / 3.0,
            10.0 / 3.0 + 5.0 * _ROOT_OF_SIX,
        ],
        [
            13.0 / 3.0 - 7.0 * _ROOT_OF_SIX / 3.0,
            -23.0 / 3.0 + 22.0 * _ROOT_OF_SIX / 3.0,
            10.0 / 3.0 - 5.0 * _ROOT_OF_SIX,
        ],
        [1.0 / 3.0, -8.0 / 3.0, 10.0 / 3.0],
    ]
)
STAGES = 3
ComplexNumber = tuple[Scalar, Scalar]
"""A complex number."""
# of rad, machine's size, per `Closure.characteristic_time`, by which derivatives are taken
_DIFFERENCE_STEP = 1e-7
_MAX_NEWTON_ITERATIONS, _NEWTON_TOLERANCE = (
    8,
    1e-3,
)  # of Newton's method; what is left then, per error of a step
_MAX_CONVERGENCE_RATE = 1e-3  # rate of its convergence with which derivatives stay as they are
_MAX_STEP_RATIO, _SAFETY_FACTOR = 8.0, 0.9  # change of the step's length from one to the next
_INTERPOLATION_ERROR_FACTOR = (
    0.07  # of how far slopes at the beginning are off, what interpolation is
)


class EigenvalueShift:
    """An eigenvalue over the length of a step, as formulas, and one over it.

    Args:
        name: "real" or "complex".
        h: Length of the step.

    Attributes:
        is_complex: Whether it is.
        value: Real and imaginary part.
        inverse: Likewise.
    """

    def __init__(self, name: str, h: Scalar):
        self.is_complex = name == "complex"
        a, b = COMPLEX_EIGENVALUE if self.is_complex else (REAL_EIGENVALUE, 0.0)
        size = a * a + b * b
        per: Scalar = 1.0 / h
        self.value: ComplexNumber = (a * per, b * per)
        self.inverse: ComplexNumber = (a / size * h, -b / size * h)


class RadauStepper(ErrorControlledStepper):
    """See above; `tolerance` is that of `error_tolerances`, and the nudges of v_A, q_A, own.

    Derivatives are differences of the compiled rates along v_A, along the ways dq/dv_A that it
    moves the joints, and along the controller's states. With T = dq'/dv_A, G = dq'/dq_A and a
    shift mu the linear systems (mu - J) x = r are

        mu x_q = r_q + T x_v + G xi,    mu xi = r_qA + x_v,
        [mu M - M J_vv - M J_vq / mu] x_v - M J_vo x_o = M (r_v + J_vq r_qA / mu)

    and the rows of the controller's states o, solved as formulas for the real and the complex
    eigenvalue over the length of the step.

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
        tolerance: float = RADAU_TOLERANCE,
    ):
        closure = chart.machine.closure
        active = closure.units[closure.active]
        rates = active / closure.characteristic_time
        self._mobility, self._controller_state_count = len(active), controller_state_count
        difference_steps = _DIFFERENCE_STEP * np.concatenate(
            [rates, active, np.ones(controller_state_count)]
        )
        tolerances_and_steps = np.concatenate(
            [error_tolerances(chart, controller_state_count, tolerance), difference_steps]
        )
        super().__init__(
            chart, control, controller_state_count, ("radau",), False, tolerances_and_steps
        )

    @property
    def _jacobian_layout(self) -> Layout:
        """What the derivatives are, as formulas pass them on."""
        n, k, nq = self._mobility, self._controller_state_count, self.state_layout.parts["q"]
        return Layout(
            ways=nq * n, bends=nq * n, oo=k * k, ov=k * n, oq=k * n, vo=n * k, vv=n * n,
            vq=n * n, mass=n * n, free=n,
        )  # fmt: skip

    def _add_method(self, program: Program) -> None:
        size, n = self.state_layout.size, self._mobility
        for added, rest in self._rest_variants:
            sweep = self._trace_controlled_machine(Tape())[0].dynamics_formulas
            mass = [x for row in sweep.mass_matrix for x in row]
            program.add_formula(
                "mass" + added, 5, [*mass, *(sweep.active_motion_factors if rest else [1.0] * n)]
            )
        tape = Tape()
        moved = add_vectors(tape.load_vector(0, 0, size), tape.load_vector(1, 0, size))
        program.add_formula("moved", 2, moved)
        # directions(tol): v_A and own by their nudges; bent(first, bumped, tol): q_A along ways
        start = self._difference_steps_start
        tape = Tape()
        along: list[Scalar] = []
        for j in range(n):
            row: list[Scalar] = [0.0] * size
            row[self.state_layout.start_index("v_a") + j] = tape.load(0, start + j)
            along += row
        for j in range(self._controller_state_count):
            row = [0.0] * size
            row[self.state_layout.start_index("own") + j] = tape.load(0, start + 2 * n + j)
            along += row
        program.add_formula("directions", 1, along)
        tape = Tape()
        along = []
        for j in range(n):
            reach = tape.load(2, start + n + j) / tape.load(2, start + j)
            now = tape.load_vector(0, 0, self.state_layout.parts["q"])
            there = tape.load_vector(1, j * size, self.state_layout.parts["q"])
            row = [0.0] * size
            row[: len(now)] = scale_vector(reach, subtract_vectors(there, now))
            along += row
        program.add_formula("bent", 3, along)
        self._add_jacobian(program)
        for name in ("real", "complex"):
            tape = Tape()
            parts = self._load_jacobian(tape, 0)
            rows = self._newton_matrix(parts, EigenvalueShift(name, tape.load(1, 0)))
            program.add_formula(
                f"{name}_factors", 2, [x for row in lu_factorize(rows) for x in row]
            )
        self._add_newton(program)
        self._add_error_and_output(program)

    @property
    def _difference_steps_start(self) -> int:
        """Where the nudges are in `tolerance`."""
        return self.state_layout.size + 1

    def _add_jacobian(self, program: Program) -> None:
        """jacobian(first, by v and own, by q, mass, tol)."""
        size, n, k, start = (
            self.state_layout.size,
            self._mobility,
            self._controller_state_count,
            self._difference_steps_start,
        )
        tape = Tape()
        first = self.state_layout.view(tape.load_vector(0, 0, size))

        def slopes(array: int, column: int, nudge: int) -> list[list[Scalar]]:
            there = self.state_layout.view(tape.load_vector(array, column * size, size))
            by = 1.0 / tape.load(4, start + nudge)
            return [
                scale_vector(by, subtract_vectors(getattr(there, part), getattr(first, part)))
                for part in ("q", "v_a", "own")
            ]

        by_v = [slopes(1, j, j) for j in range(n)]
        by_o = [slopes(1, n + j, 2 * n + j) for j in range(k)]
        by_q = [slopes(2, j, n + j) for j in range(n)]
        mass = [tape.load_vector(3, i * n, n) for i in range(n)]

        def rows(columns: list[list[list[Scalar]]], part: int) -> Matrix:
            return [list(row) for row in zip(*(column[part] for column in columns), strict=True)]

        def weighed(columns: list[list[list[Scalar]]]) -> Matrix:
            found = rows(columns, 1)
            across = [list(column) for column in zip(*found, strict=True)]
            return [[dot(row, column) for column in across] for row in mass]

        outputs = {
            "ways": rows(by_v, 0), "bends": rows(by_q, 0), "oo": rows(by_o, 2),
            "ov": rows(by_v, 2), "oq": rows(by_q, 2), "vo": weighed(by_o), "vv": weighed(by_v),
            "vq": weighed(by_q), "mass": mass, "free": [tape.load_vector(3, n * n, n)],
        }  # fmt: skip
        flat = {name: [x for row in table for x in row] for name, table in outputs.items()}
        program.add_formula("jacobian", 5, flat)

    def _load_jacobian(self, tape: Tape, argument: int) -> dict[str, Matrix]:
        """`jacobian`, read from an argument."""
        n, k, layout = self._mobility, self._controller_state_count, self._jacobian_layout
        columns = {"oo": k, "vo": k}
        out = {}
        for name, count in layout.parts.items():
            width = columns.get(name, n)
            flat = tape.load_vector(argument, layout.start_index(name), count)
            out[name] = [flat[i : i + width] for i in range(0, count, width)] if width else []
        return out

    def _newton_matrix(self, parts: dict[str, Matrix], shift: EigenvalueShift) -> Matrix:
        """The rows of own and v_A, real; the complex one as twice as many real ones."""
        n, k = self._mobility, self._controller_state_count
        real: Matrix = []
        imaginary: Matrix = []
        along: list[ComplexNumber]
        own: list[ComplexNumber]
        for i in range(k):
            along = [
                _add_complex((-1.0 * one, 0.0), _multiply_complex(shift.inverse, -1.0 * other))
                for one, other in zip(parts["ov"][i], parts["oq"][i], strict=True)
            ]
            own = [(-1.0 * x, 0.0) for x in parts["oo"][i]]
            own[i] = _add_complex(own[i], shift.value)
            real.append([x for x, _ in (*own, *along)])
            imaginary.append([y for _, y in (*own, *along)])
        for i in range(n):
            own = [(-1.0 * x, 0.0) for x in parts["vo"][i]] if k else []
            along = [
                _add_complex(
                    _add_complex((-1.0 * v, 0.0), _multiply_complex(shift.inverse, -1.0 * q)),
                    _multiply_complex(shift.value, m),
                )
                for v, q, m in zip(parts["vv"][i], parts["vq"][i], parts["mass"][i], strict=True)
            ]
            real.append([x for x, _ in (*own, *along)])
            imaginary.append([y for _, y in (*own, *along)])
        if not shift.is_complex:
            return real
        return [
            *([*a, *scale_vector(-1.0, b)] for a, b in zip(real, imaginary, strict=True)),
            *([*b, *a] for a, b in zip(real, imaginary, strict=True)),
        ]

    def _solve_shifted(
        self,
        parts: dict[str, Matrix],
        factors: Matrix,
        shift: EigenvalueShift,
        right_sides: list[list[Scalar]],
    ) -> list[list[Scalar]]:
        """The x of (mu - J) x = r; real and imaginary parts of both where mu is complex."""
        n, k, active = (
            self._mobility,
            self._controller_state_count,
            self._chart.machine.closure.active.tolist(),
        )
        views = [self.state_layout.view(one) for one in right_sides]

        def turned(values: list[list[Scalar]]) -> list[list[Scalar]]:
            """Over mu."""
            if not shift.is_complex:
                return [scale_vector(shift.inverse[0], values[0])]
            a, b = shift.inverse
            one, other = values
            return [
                subtract_vectors(scale_vector(a, one), scale_vector(b, other)),
                add_vectors(scale_vector(b, one), scale_vector(a, other)),
            ]

        here = turned([[view.q[i] for i in active] for view in views])
        wanted: list[Scalar] = []
        for view, rho in zip(views, here, strict=True):
            wanted += add_vectors(list(view.own), matvec(parts["oq"], rho)) if k else []
            wanted += add_vectors(matvec(parts["mass"], view.v_a), matvec(parts["vq"], rho))
        x = lu_solve(factors, wanted)
        m = n + k
        own = [x[i * m : i * m + k] for i in range(len(views))]
        v_a = [
            [w * y for w, y in zip(parts["free"][0], x[i * m + k : (i + 1) * m], strict=True)]
            for i in range(len(views))
        ]
        xi = [
            add_vectors(rho, one) for rho, one in zip(here, turned(v_a), strict=True)
        ]  # (r_qA + x_v) / mu
        ways = [
            add_vectors(view.q, matvec(parts["ways"], one), matvec(parts["bends"], other))
            for view, one, other in zip(views, v_a, xi, strict=True)
        ]
        q = turned([list(row) for row in ways])
        rest = turned([[*view.work, *view.lost] for view in views])
        return [[*a, *b, *c, *d] for a, b, c, d in zip(q, v_a, own, rest, strict=True)]

    def _load_factors(self, tape: Tape, argument: int, real_per_complex: int) -> Matrix:
        m = real_per_complex * (self._mobility + self._controller_state_count)
        flat = tape.load_vector(argument, 0, m * m)
        return [flat[i : i + m] for i in range(0, m * m, m)]

    def _add_newton(self, program: Program) -> None:
        """start(state, Z before, ratio); newton(state, J, real, complex, F, W, h, tol)."""
        size = self.state_layout.size
        tape = Tape()
        state, ratio = tape.load_vector(0, 0, size), tape.load(2, 0)
        before = [tape.load_vector(1, i * size, size) for i in range(STAGES)]
        guess = []
        for node in NODES.tolist():
            x = 1.0 + node * ratio
            weights = [dot(row, [x, x * x, x * x * x]) for row in INTERPOLATION_WEIGHTS.tolist()]
            weights[2] = weights[2] - 1.0
            guess.append([dot(weights, column) for column in zip(*before, strict=True)])
        outputs = self._stage_outputs(state, guess, _combine_rows(INVERSE_TRANSFORMATION, guess))
        program.add_formula("start", 3, outputs)
        tape = Tape()
        state, h = tape.load_vector(0, 0, size), tape.load(6, 0)
        parts = self._load_jacobian(tape, 1)
        rates = [tape.load_vector(4, i * size, size) for i in range(STAGES)]
        W = [tape.load_vector(5, i * size, size) for i in range(STAGES)]
        real, other = EigenvalueShift("real", h), EigenvalueShift("complex", h)
        turned = _combine_rows(INVERSE_TRANSFORMATION, rates)
        right = subtract_vectors(turned[0], scale_vector(real.value[0], W[0]))
        a, b = other.value
        pair = [
            subtract_vectors(
                turned[1], subtract_vectors(scale_vector(a, W[1]), scale_vector(b, W[2]))
            ),
            subtract_vectors(turned[2], add_vectors(scale_vector(b, W[1]), scale_vector(a, W[2]))),
        ]
        change = self._solve_shifted(parts, self._load_factors(tape, 2, 1), real, [right])
        change += self._solve_shifted(parts, self._load_factors(tape, 3, 2), other, pair)
        W = [add_vectors(one, by) for one, by in zip(W, change, strict=True)]
        norm: Scalar = 0.0
        shares = self._inverse_error_scales(tape, 7, state, state)
        for row in change:
            for x, share in zip(row, shares, strict=False):
                norm = norm + (x * share) * (x * share)
        norm = apply_function("sqrt", norm * (1.0 / (3.0 * len(shares))))
        outputs = self._stage_outputs(state, _combine_rows(TRANSFORMATION, W), W)
        program.add_formula("newton", 8, {**outputs, "norm": [norm]})

    def _stage_outputs(
        self, state: list[Scalar], Z: list[list[Scalar]], W: list[list[Scalar]]
    ) -> dict[str, list[Scalar]]:
        return {
            "W": [x for row in W for x in row],
            "Z": [x for row in Z for x in row],
            "stages": [x for row in Z for x in add_vectors(state, row)],
        }

    def _add_error_and_output(self, program: Program) -> None:
        """estimate(J, real, rate, Z, h); finish(numbers, state, Z, e, first, h, tol); dense(Z)."""
        size, nq = self.state_layout.size, self.state_layout.parts["q"]
        tape = Tape()
        h = tape.load(4, 0)
        Z = [tape.load_vector(3, i * size, size) for i in range(STAGES)]
        rate = tape.load_vector(2, 0, size)
        sums = [dot(ERROR_WEIGHTS.tolist(), column) for column in zip(*Z, strict=True)]
        right = add_vectors(rate, scale_vector(1.0 / h, sums))
        parts, factors = self._load_jacobian(tape, 0), self._load_factors(tape, 1, 1)
        (error,) = self._solve_shifted(parts, factors, EigenvalueShift("real", h), [right])
        program.add_formula("estimate", 5, error)
        tape = Tape()
        state, h = tape.load_vector(1, 0, size), tape.load(5, 0)
        Z = [tape.load_vector(2, i * size, size) for i in range(STAGES)]
        error, first = tape.load_vector(3, 0, size), tape.load_vector(4, 0, size)
        after = add_vectors(state, Z[2])
        shares = self._inverse_error_scales(tape, 6, state, after)
        total: Scalar = 0.0
        for x, share in zip(error, shares, strict=False):
            total = total + (x * share) * (x * share)
        norm = apply_function("sqrt", total * (1.0 / len(shares)))
        # what is between: the stages' polynomial against the cubic that begins as the motion does
        # and ends where the stages do
        middle: Scalar = 0.0
        for i in range(nq):
            c = [
                dot([Z[j][i] for j in range(STAGES)], column)
                for column in INTERPOLATION_WEIGHTS.T.tolist()
            ]
            gap = c[0] - h * first[i]
            middle = middle + (gap * shares[i] * _INTERPOLATION_ERROR_FACTOR) * (
                gap * shares[i] * _INTERPOLATION_ERROR_FACTOR
            )
        norm = maximum(norm, apply_function("sqrt", middle * (1.0 / nq)))
        long = [not turns for turns in self.closure_code.geometry.is_revolute[1:]]
        move = largest_scaled_value(
            Z[2][:nq], long, self.closure_code.inverse_characteristic_length(tape)
        )
        norm = self._limit_rotation(norm, move)
        usable = minimum(maximum(norm, 1e-9), 1e9)
        change = _SAFETY_FACTOR * apply_function(
            "exp", (-1.0 / 4.0) * apply_function("log", usable)
        )
        change = minimum(maximum(change, MIN_STEP_RATIO), _MAX_STEP_RATIO)
        outputs = {"state": after, "error": [norm], "change": [change], "move": [move]}
        program.add_formula("finish", 7, outputs)
        # x (Q0 + Q1 x + Q2 x^2) as x (c0 + (1 - x) (c1 + x c2))
        tape = Tape()
        Z = [tape.load_vector(0, i * size, size) for i in range(STAGES)]
        Q = [
            [dot(column, z) for z in zip(*Z, strict=True)]
            for column in INTERPOLATION_WEIGHTS.T.tolist()
        ]
        parts_of = [
            add_vectors(*Q),
            scale_vector(-1.0, add_vectors(Q[1], Q[2])),
            scale_vector(-1.0, Q[2]),
        ]
        program.add_formula("dense", 1, [x for row in parts_of for x in row])

    def _write_step(self, program: Program, step: StepCode) -> tuple[StepWriter, StepWriter]:
        """See `ErrorControlledStepper`."""
        r, size, n, k = (
            step.routine,
            self.state_layout.size,
            self._mobility,
            self._controller_state_count,
        )
        columns, m = n + k, n + k
        directions = r.local_array("directions", columns * size)
        coordinate_directions = r.local_array("bent", max(1, n * size))
        # a rate has more behind it, which the next one replaces
        more = program.formula_outputs("rate").size - size
        rates_along_directions, rates_along_coordinates = (
            r.local_array(x, columns * size + more) for x in ("bumped", "curved")
        )
        mass, stage = r.local_array("mass", n * n + n), r.local_array("stage", size)
        jacobian = r.local_array("jacobian", program.formula_outputs("jacobian"))
        real, pair = r.local_array("real", m * m), r.local_array("pair", 4 * m * m)
        rates = r.local_array("rates", STAGES * size + more)
        slope = r.local_array("slope", size + more)
        iterate = r.local_array("iterate", program.formula_outputs("newton"))
        previous_stages, ratio = r.local_array("kept", STAGES * size), r.local_array("ratio", 1)
        error_estimate = r.local_array("wrong", size)
        jacobian_time, convergence_rate, previous_length = (
            r.new_variable(-np.inf),
            r.new_variable(1.0),
            r.new_variable(0.0),
        )
        r.call("directions", r.tol, directions)
        with r.loop(r.new_variable(STAGES * size)) as i:
            r.store(previous_stages, i, 0.0)

        def along(t: RoutineValue, count: int, ways: Place, out: Place) -> None:
            with r.loop(r.new_variable(count)) as i:
                r.call("moved", r.state, ways.row_pointer(i, size), stage)
                step.call("rate", t, stage, out.row_pointer(i, size))

        def attempt(t: RoutineValue, length: RoutineValue) -> None:
            with r.if_then((t > jacobian_time) & (convergence_rate > _MAX_CONVERGENCE_RATE)):
                step.call("mass", t, r.state, mass)
                along(t, columns, directions, rates_along_directions)
                r.call(
                    "bent", step.start_rate, rates_along_directions, r.tol, coordinate_directions
                )
                along(t, n, coordinate_directions, rates_along_coordinates)
                r.call(
                    "jacobian",
                    step.start_rate,
                    rates_along_directions,
                    rates_along_coordinates,
                    mass,
                    r.tol,
                    jacobian,
                )
                r.assign(jacobian_time, t)
            r.call("real_factors", jacobian, step.length, real)
            r.call("complex_factors", jacobian, step.length, pair)
            r.store(ratio, 0, select(previous_length > 0.0, length / previous_length, 0.0))
            r.call("start", r.state, previous_stages, ratio, iterate)
            tries, done, norm = r.new_variable(0), r.new_variable(0), r.new_variable(0.0)
            with r.loop_forever():
                for i in range(STAGES):
                    at = iterate.element_pointer("stages").element_pointer(i * size)
                    step.call(
                        "rate", t + length * float(NODES[i]), at, rates.element_pointer(i * size)
                    )
                r.call(
                    "newton",
                    r.state,
                    jacobian,
                    real,
                    pair,
                    rates,
                    iterate.element_pointer("W"),
                    step.length,
                    r.tol,
                    iterate,
                )
                r.assign(tries, tries + 1)
                last = r.new_variable(norm)
                r.assign(norm, iterate["norm"])
                with r.if_then(tries > 1):
                    r.assign(convergence_rate, norm / last)
                    with r.if_then(
                        convergence_rate * norm
                        < (convergence_rate * -1.0 + 1.0) * _NEWTON_TOLERANCE
                    ):
                        r.assign(done, 1)
                    with r.if_then(~(convergence_rate < 1.0)):
                        r.assign(done, 0)
                        r.assign(tries, _MAX_NEWTON_ITERATIONS)
                with r.if_then(norm < 1e-3 * _NEWTON_TOLERANCE):
                    r.assign(done, 1)
                with r.if_then((done > 0) | (tries >= _MAX_NEWTON_ITERATIONS)):
                    r.break_loop()
            Z = iterate.element_pointer("Z")
            r.call("estimate", jacobian, real, step.start_rate, Z, step.length, error_estimate)
            ends = Z, error_estimate, step.start_rate, step.length, r.tol, step.step_result
            r.call("finish", r.geometry, r.state, *ends)
            with r.if_then(step.step_result["error"] > 1.0):
                r.call("moved", r.state, error_estimate, stage)
                step.call("rate", t, stage, slope)
                r.call("estimate", jacobian, real, slope, Z, step.length, error_estimate)
                r.call("finish", r.geometry, r.state, *ends)
            with r.if_then(done < 1):
                r.store(step.step_result.element_pointer("error"), 0, 2.0)
                r.store(step.step_result.element_pointer("change"), 0, 0.25)
                r.assign(convergence_rate, 1.0)
                r.assign(jacobian_time, select(jacobian_time < t, -np.inf, jacobian_time))
            with r.if_else():
                r.copy(previous_stages, Z, STAGES * size)
                r.assign(previous_length, select(step.step_result["error"] <= 1.0, length, 0.0))

        def interpolate(t: RoutineValue, length: RoutineValue) -> None:
            r.call("dense", iterate.element_pointer("Z"), step.dense_output)

        return attempt, interpolate


def _add_complex(one: ComplexNumber, other: ComplexNumber) -> ComplexNumber:
    return one[0] + other[0], one[1] + other[1]


def _multiply_complex(one: ComplexNumber, by: Scalar) -> ComplexNumber:
    return one[0] * by, one[1] * by


def _combine_rows(weights: Array, rows: list[list[Scalar]]) -> list[list[Scalar]]:
    """Sums of rows by weights."""
    columns = list(zip(*rows, strict=True))
    return [[dot(row, column) for column in columns] for row in weights.tolist()]
