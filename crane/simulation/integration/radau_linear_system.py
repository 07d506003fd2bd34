"""Linear systems of the Newton iteration of Radau IIA, as formulas in block form."""

from crane.codegen import Layout, Scalar, Tape
from crane.codegen.symbolic import (
    add_vectors,
    dot,
    matvec,
    scale_vector,
    subtract_vectors,
    transpose,
)
from crane.codegen.symbolic_linear_algebra import Matrix, lu_solve
from crane.simulation.integration.charts import Chart

# eigenvalues of the inverse of the matrix of the method
REAL_EIGENVALUE = 3.0 + 3.0 ** (2 / 3) - 3.0 ** (1 / 3)
COMPLEX_EIGENVALUE = (
    3.0 + 0.5 * (3.0 ** (1 / 3) - 3.0 ** (2 / 3)),
    -0.5 * (3.0 ** (5 / 6) + 3.0 ** (7 / 6)),
)
ComplexNumber = tuple[Scalar, Scalar]
"""Real and imaginary part."""


class EigenvalueShift:
    """An eigenvalue of the method divided by the step size, mu, and 1 / mu.

    Args:
        name: "real" or "complex".
        h: Step size.

    Attributes:
        is_complex: Whether the eigenvalue is complex.
        value: mu.
        inverse: 1 / mu.
    """

    def __init__(self, name: str, h: Scalar):
        self.is_complex = name == "complex"
        a, b = COMPLEX_EIGENVALUE if self.is_complex else (REAL_EIGENVALUE, 0.0)
        size = a * a + b * b
        inverse_h: Scalar = 1.0 / h
        self.value: ComplexNumber = (a * inverse_h, b * inverse_h)
        self.inverse: ComplexNumber = (a / size * h, -b / size * h)

    def divide(self, values: list[list[Scalar]]) -> list[list[Scalar]]:
        """Vectors divided by mu; of a complex mu real and imaginary part of one vector."""
        if not self.is_complex:
            return [scale_vector(self.inverse[0], values[0])]
        a, b = self.inverse
        real, imaginary = values
        return [
            subtract_vectors(scale_vector(a, real), scale_vector(b, imaginary)),
            add_vectors(scale_vector(b, real), scale_vector(a, imaginary)),
        ]


class RadauLinearSystem:
    """The linear systems (mu - J) x = r in block form.

    With T = dq'/dv_A, G = dq'/dq_A and the mass matrix M, they are

        mu x_q = r_q + T x_v + G xi,    mu xi = r_qA + x_v,
        [mu M - M J_vv - M J_vq / mu] x_v - M J_vo x_o = M (r_v + J_vq r_qA / mu)

    and the rows of the states o of the controller. The blocks are named by row and column: "q_v",
    "q_q", "o_o", "o_v", "o_q", and multiplied by M "v_o", "v_v", "v_q"; then "mass" and "free",
    factors that are 0 for the velocities of joints at rest.

    Args:
        chart: The machine in a chart.
    """

    def __init__(self, chart: Chart):
        self._state_layout = chart.state_layout
        self._active = chart.machine.closure.active.tolist()
        k, n, nq = chart.controller_state_count, len(self._active), chart.machine.model.nv
        self._mobility, self._controller_state_count = n, k
        self.layout = Layout(
            q_v=nq * n, q_q=nq * n, o_o=k * k, o_v=k * n, o_q=k * n, v_o=n * k, v_v=n * n,
            v_q=n * n, mass=n * n, free=n,
        )  # fmt: skip

    def blocks_from_differences(self, tape: Tape) -> dict[str, list[Scalar]]:
        """Elements of the blocks from difference quotients of the rate.

        Args:
            tape: The tape. Its arguments are the rate, the rates with displacements along
                velocities and controller states, those along coordinates, the mass matrix with
                the factors "free", and the displacements.
        """
        size, n, k = self._state_layout.size, self._mobility, self._controller_state_count
        step_start = size + 1  # difference steps behind the tolerances
        start_rate = self._state_layout.view(tape.load_vector(0, 0, size))

        def derivative(argument: int, column: int, step: int) -> list[list[Scalar]]:
            rate = self._state_layout.view(tape.load_vector(argument, column * size, size))
            inverse_step = 1.0 / tape.load(4, step_start + step)
            return [
                scale_vector(
                    inverse_step, subtract_vectors(getattr(rate, part), getattr(start_rate, part))
                )
                for part in ("q", "v_a", "controller")
            ]

        by_v = [derivative(1, j, j) for j in range(n)]
        by_o = [derivative(1, n + j, 2 * n + j) for j in range(k)]
        by_q = [derivative(2, j, n + j) for j in range(n)]
        mass = [tape.load_vector(3, i * n, n) for i in range(n)]

        def rows(columns: list[list[list[Scalar]]], part: int) -> Matrix:
            return [list(row) for row in zip(*(column[part] for column in columns), strict=True)]

        def mass_times(columns: list[list[list[Scalar]]]) -> Matrix:
            v_columns = transpose(rows(columns, 1))
            return [[dot(row, column) for column in v_columns] for row in mass]

        blocks = {
            "q_v": rows(by_v, 0), "q_q": rows(by_q, 0), "o_o": rows(by_o, 2),
            "o_v": rows(by_v, 2), "o_q": rows(by_q, 2), "v_o": mass_times(by_o),
            "v_v": mass_times(by_v), "v_q": mass_times(by_q), "mass": mass,
            "free": [tape.load_vector(3, n * n, n)],
        }  # fmt: skip
        return {name: [x for row in block for x in row] for name, block in blocks.items()}

    def load_blocks(self, tape: Tape, argument: int) -> dict[str, Matrix]:
        """The blocks, read from an argument."""
        widths = {"o_o": self._controller_state_count, "v_o": self._controller_state_count}
        blocks = {}
        for name, count in self.layout.parts.items():
            width = widths.get(name, self._mobility)
            flat = tape.load_vector(argument, self.layout.start_index(name), count)
            blocks[name] = [flat[i : i + width] for i in range(0, count, width)] if width else []
        return blocks

    def load_factors(self, tape: Tape, argument: int, shift: EigenvalueShift) -> Matrix:
        """The factors of `matrix`, read from an argument."""
        m = (1 + shift.is_complex) * (self._mobility + self._controller_state_count)
        flat = tape.load_vector(argument, 0, m * m)
        return [flat[i : i + m] for i in range(0, m * m, m)]

    def matrix(self, blocks: dict[str, Matrix], shift: EigenvalueShift) -> Matrix:
        """Rows of controller states and velocities; of a complex shift in the form [A -B; B A]."""
        real: Matrix = []
        imaginary: Matrix = []
        for i in range(self._controller_state_count):
            by_v = [
                _add(_negative(v), _multiply(shift.inverse, -1.0 * q))
                for v, q in zip(blocks["o_v"][i], blocks["o_q"][i], strict=True)
            ]
            by_o = [_negative(x) for x in blocks["o_o"][i]]
            by_o[i] = _add(by_o[i], shift.value)
            real.append([x for x, _ in (*by_o, *by_v)])
            imaginary.append([y for _, y in (*by_o, *by_v)])
        rows = zip(blocks["v_v"], blocks["v_q"], blocks["mass"], strict=True)
        for i, row in enumerate(rows):
            by_o = [_negative(x) for x in blocks["v_o"][i]] if self._controller_state_count else []
            by_v = [
                _add(
                    _add(_negative(v), _multiply(shift.inverse, -1.0 * q)),
                    _multiply(shift.value, mass),
                )
                for v, q, mass in zip(*row, strict=True)
            ]
            real.append([x for x, _ in (*by_o, *by_v)])
            imaginary.append([y for _, y in (*by_o, *by_v)])
        if not shift.is_complex:
            return real
        return [
            *([*a, *scale_vector(-1.0, b)] for a, b in zip(real, imaginary, strict=True)),
            *([*b, *a] for a, b in zip(real, imaginary, strict=True)),
        ]

    def solve(
        self,
        blocks: dict[str, Matrix],
        factors: Matrix,
        shift: EigenvalueShift,
        right_sides: list[list[Scalar]],
    ) -> list[list[Scalar]]:
        """The solution x of (mu - J) x = r.

        Args:
            blocks: See `load_blocks`.
            factors: See `load_factors`.
            shift: mu.
            right_sides: r; its real and imaginary part for a complex shift.

        Returns:
            x, or its real and imaginary part.
        """
        k, m = self._controller_state_count, self._controller_state_count + self._mobility
        views = [self._state_layout.view(r) for r in right_sides]
        rho = shift.divide([[view.q[i] for i in self._active] for view in views])
        reduced: list[Scalar] = []
        for view, part in zip(views, rho, strict=True):
            if k:
                reduced += add_vectors(list(view.controller), matvec(blocks["o_q"], part))
            reduced += add_vectors(matvec(blocks["mass"], view.v_a), matvec(blocks["v_q"], part))
        parts = [lu_solve(factors, reduced)[i * m : (i + 1) * m] for i in range(len(views))]
        v_a = [
            [factor * x for factor, x in zip(blocks["free"][0], part[k:], strict=True)]
            for part in parts
        ]
        # xi = (r_qA + x_v) / mu
        xi = [add_vectors(a, b) for a, b in zip(rho, shift.divide(v_a), strict=True)]
        q = shift.divide([
            add_vectors(view.q, matvec(blocks["q_v"], a), matvec(blocks["q_q"], b))
            for view, a, b in zip(views, v_a, xi, strict=True)
        ])  # fmt: skip
        energies = shift.divide([[*view.work, *view.dissipated] for view in views])
        return [
            [*a, *b, *part[:k], *c] for a, b, part, c in zip(q, v_a, parts, energies, strict=True)
        ]


def _negative(x: Scalar) -> ComplexNumber:
    return -1.0 * x, 0.0


def _add(one: ComplexNumber, other: ComplexNumber) -> ComplexNumber:
    return one[0] + other[0], one[1] + other[1]


def _multiply(one: ComplexNumber, factor: Scalar) -> ComplexNumber:
    return one[0] * factor, one[1] * factor
