"""Derivatives and sparse elimination of traced formulas."""

import numpy as np
import pytest

from crane.codegen import Program, Tape
from crane.codegen.derivative import against, derivatives
from crane.codegen.factors import eliminated, loaded, stored, substituted
from crane.codegen.scalar import (
    apply,
    dots,
    maximum,
    minimum,
    where_positive,
    with_sign_of,
)


def compiled(arrays, outputs):
    program = Program()
    program.add("f", arrays, outputs)
    program.compile()

    def call(*inputs):
        out = np.zeros(len(outputs))
        inputs = [np.ascontiguousarray(x, dtype=np.float64) for x in inputs]
        program.call("f", *inputs, out)
        return out

    return call


def formulas(x, y, z):
    return [
        apply("sin", x * y) + apply("cos", y) / (1.5 + z * z),
        apply("exp", -0.3 * x) * apply("log", 2.0 + y * y) - apply("tanh", z - x),
        apply("sqrt", 1.0 + x * x) * apply("abs", y - 0.2) / (2.0 - apply("sin", z)),
        maximum(x * z, y) + minimum(z, 0.3 * y) * x,
        where_positive(x - y, x * x, y * z) + with_sign_of(x * y, z - 0.1),
        -(z / x) + 3.0 * x - 2.0 / y,
        *dots([x, 2.0, z * y], [[y, x, 1.5], [0.0, apply("sin", z), x * x]]),
    ]


def test_derivatives_are_central_differences():
    """At 300 points, none of them within a step of a kink."""
    tape = Tape()
    variables = tape.loads(0, 0, 3)
    outputs = formulas(*variables)
    jacobian = derivatives(outputs, variables)
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
    variables, weights = tape.loads(0, 0, 3), tape.loads(1, 0, 8)
    outputs = formulas(*variables)
    jacobian = derivatives(outputs, variables)
    slope = compiled(1, [entry for row in jacobian for entry in row])
    gradient = compiled(2, against(outputs, weights, variables))
    rng = np.random.default_rng(6)
    for point in [*rng.uniform(-2, 2, (100, 3)), np.array([0.5, 0.2, 0.4]), np.full(3, 0.1)]:
        w = rng.normal(size=8)
        rows = slope(point).reshape(8, 3)
        size = np.abs(w) @ np.abs(rows)
        assert (np.abs(gradient(point, w) - w @ rows) <= 1e-13 * size).all()


def test_one_pass_back_takes_few_operations():
    """However many variables there are; forwards it is one pass each."""
    tape = Tape()
    variables = tape.loads(0, 0, 40)
    total = 0.0
    for i, x in enumerate(variables):
        total = apply("sin", total + x * variables[i - 1])
    before = len(tape.operations)
    against([total], [1.0], variables)
    assert len(tape.operations) - before < 6 * before


def test_what_no_output_depends_on_has_no_gradient():
    tape = Tape()
    x, y = tape.loads(0, 0, 2)
    assert against([y * y, 3.0], [1.0, 1.0], [x]) == [0.0]
    assert against([3.0], [1.0], [x]) == [0.0] and against([x], [2.0], []) == []
    assert against([x, x], [2.0, 3.0], [x]) == [5.0]


def test_formulas_are_the_same_in_floats():
    tape = Tape()
    value = compiled(1, formulas(*tape.loads(0, 0, 3)))
    for point in np.random.default_rng(4).uniform(-2, 2, (50, 3)):
        np.testing.assert_allclose(value(point), formulas(*point.tolist()), rtol=1e-13)


def test_what_does_not_depend_is_zero():
    tape = Tape()
    x, y = tape.loads(0, 0, 2)
    assert derivatives([y * y, 3.0, x], [x]) == [[0.0], [0.0], [1.0]]


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
    factors = eliminated(traced)
    keep = compiled(1, stored(factors))(matrix)
    other = Tape()
    x = substituted(loaded(factors, other, 0, 0), other.loads(1, 0, size))
    found = compiled(2, x)(keep, right)
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right), rtol=1e-11, atol=1e-13)
    assert len(stored(factors)) <= size * size


def test_a_block_diagonal_matrix_stays_one():
    tape = Tape()
    a, b, c, d, e = tape.loads(0, 0, 5)
    factors = eliminated([[a, b, 0.0], [c, d, 0.0], [0.0, 0.0, e]])
    assert factors[0][2] == factors[1][2] == factors[2][0] == factors[2][1] == 0.0
