"""Derivatives of traced formulas and their sparse elimination."""

import numpy as np
import pytest

from crane.codegen import Program, Tape
from crane.codegen.differentiation import differentiate, weighted_gradient
from crane.codegen.symbolic import (
    apply_function,
    copysign,
    dot_products,
    maximum,
    minimum,
    where_positive,
)
from crane.codegen.symbolic_linear_algebra import (
    load_matrix,
    lu_factorize,
    lu_solve,
    symbolic_entries,
)
from crane.studies.optimization.measure_expressions import DUAL_FUNCTIONS, DualNumber


def compiled(arrays, outputs):
    program = Program()
    program.add_formula("f", arrays, outputs)
    program.compile()

    def call(*inputs):
        out = np.zeros(len(outputs))
        inputs = [np.ascontiguousarray(x, dtype=np.float64) for x in inputs]
        program.call("f", *inputs, out)
        return out

    return call


def formulas(x, y, z):
    return [
        apply_function("sin", x * y) + apply_function("cos", y) / (1.5 + z * z),
        apply_function("exp", -0.3 * x) * apply_function("log", 2.0 + y * y)
        - apply_function("tanh", z - x),
        apply_function("sqrt", 1.0 + x * x)
        * apply_function("abs", y - 0.2)
        / (2.0 - apply_function("sin", z)),
        maximum(x * z, y) + minimum(z, 0.3 * y) * x,
        where_positive(x - y, x * x, y * z) + copysign(x * y, z - 0.1),
        -(z / x) + 3.0 * x - 2.0 / y,
        *dot_products([x, 2.0, z * y], [[y, x, 1.5], [0.0, apply_function("sin", z), x * x]]),
    ]


def test_derivatives_are_central_differences():
    """At 300 points, none of them within a step of a kink."""
    tape = Tape()
    variables = tape.load_vector(0, 0, 3)
    outputs = formulas(*variables)
    jacobian = differentiate(outputs, variables)
    value = compiled(1, outputs)
    slope = compiled(1, [entry for row in jacobian for entry in row])
    rng = np.random.default_rng(3)
    checked, h = 0, 1e-6
    for point in rng.uniform(-2, 2, (300, 3)):
        x, y, z = point
        kinks = (y - 0.2, x * z - y, z - 0.3 * y, x - y, z - 0.1, x * y, x, y)
        if min(abs(kink) for kink in kinks) < 0.05:
            continue
        rows = [(value(point + h * e) - value(point - h * e)) / (2 * h) for e in np.eye(3)]
        found = slope(point).reshape(8, 3)
        np.testing.assert_allclose(found, np.column_stack(rows), rtol=2e-7, atol=2e-8)
        checked += 1
    assert checked > 100


def test_one_pass_back_is_the_transpose():
    """Of the same derivatives, to rounding, at kinks too, where one of two sides counts."""
    tape = Tape()
    variables, weights = tape.load_vector(0, 0, 3), tape.load_vector(1, 0, 8)
    outputs = formulas(*variables)
    jacobian = differentiate(outputs, variables)
    slope = compiled(1, [entry for row in jacobian for entry in row])
    gradient = compiled(2, weighted_gradient(outputs, weights, variables))
    rng = np.random.default_rng(6)
    for point in [*rng.uniform(-2, 2, (100, 3)), np.array([0.5, 0.2, 0.4]), np.full(3, 0.1)]:
        w = rng.normal(size=8)
        rows = slope(point).reshape(8, 3)
        size = np.abs(w) @ np.abs(rows)
        assert (np.abs(gradient(point, w) - w @ rows) <= 1e-13 * size).all()


def test_one_pass_back_takes_few_operations():
    """However many variables there are; forwards it is one pass each."""
    tape = Tape()
    variables = tape.load_vector(0, 0, 40)
    total = 0.0
    for i, x in enumerate(variables):
        total = apply_function("sin", total + x * variables[i - 1])
    before = len(tape.operations)
    weighted_gradient([total], [1.0], variables)
    assert len(tape.operations) - before < 6 * before


def test_what_no_output_depends_on_has_no_gradient():
    tape = Tape()
    x, y = tape.load_vector(0, 0, 2)
    assert weighted_gradient([y * y, 3.0], [1.0, 1.0], [x]) == [0.0]
    assert (
        weighted_gradient([3.0], [1.0], [x]) == [0.0] and weighted_gradient([x], [2.0], []) == []
    )
    assert weighted_gradient([x, x], [2.0, 3.0], [x]) == [5.0]


def test_formulas_are_the_same_in_floats():
    tape = Tape()
    value = compiled(1, formulas(*tape.load_vector(0, 0, 3)))
    for point in np.random.default_rng(4).uniform(-2, 2, (50, 3)):
        np.testing.assert_allclose(value(point), formulas(*point.tolist()), rtol=1e-13)


def test_what_does_not_depend_is_zero():
    tape = Tape()
    x, y = tape.load_vector(0, 0, 2)
    assert differentiate([y * y, 3.0, x], [x]) == [[0.0], [0.0], [1.0]]


@pytest.mark.parametrize("seed", range(5))
def test_sparse_elimination_solves(seed):
    """Against numpy; entries that are zero while tracing cost nothing."""
    rng = np.random.default_rng(seed)
    size = 7
    matrix = rng.normal(size=(size, size)) * (rng.random((size, size)) < 0.4)
    matrix += np.diag(3.0 + rng.random(size))
    right = rng.normal(size=size)
    tape = Tape()
    traced = [
        [tape.load(0, size * i + j) if matrix[i, j] else 0.0 for j in range(size)]
        for i in range(size)
    ]
    factors = lu_factorize(traced)
    keep = compiled(1, symbolic_entries(factors))(matrix)
    other = Tape()
    x = lu_solve(load_matrix(factors, other, 0, 0), other.load_vector(1, 0, size))
    found = compiled(2, x)(keep, right)
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right), rtol=1e-11, atol=1e-13)
    assert len(symbolic_entries(factors)) <= size * size


def test_a_block_diagonal_matrix_stays_one():
    tape = Tape()
    a, b, c, d, e = tape.load_vector(0, 0, 5)
    factors = lu_factorize([[a, b, 0.0], [c, d, 0.0], [0.0, 0.0, e]])
    assert factors[0][2] == factors[1][2] == factors[2][0] == factors[2][1] == 0.0


def test_a_square_root_at_zero_is_steep_where_its_argument_changes():
    found = DUAL_FUNCTIONS["sqrt"](DualNumber(0.0, np.array([0.0, 1.0, -2.0])))
    assert found.value == 0.0 and found.derivatives.tolist() == [0.0, np.inf, -np.inf]
