"""Traced arithmetic and its machine code against numpy."""

import functools
import gc
import math
import pickle
import subprocess
import sys
import tracemalloc
import weakref
from decimal import Decimal, localcontext

import numpy as np
import pytest

from crane.codegen import Program, SymbolicExpression, Tape, max_abs, maximum
from crane.codegen.llvm import formula_emitter as llvm_formulas
from crane.codegen.llvm import sample_function
from crane.codegen.llvm.machine_code import emit_module
from crane.codegen.symbolic import (
    add_vectors,
    apply_function,
    copysign,
    cross,
    dot,
    dot_products,
    matmul,
    matvec,
    scale_vector,
    subtract_vectors,
)
from crane.codegen.symbolic_linear_algebra import LdltFactorization, solve_linear_system

NAN, INF = math.nan, math.inf
X = (0.7, -1.9, 3.1, 0.25, -0.6, 12.0, 1.0, -1.0)


class Function:
    """f(in) -> out of one array, which keeps its program."""

    def __init__(self, *functions):
        self.program = Program()
        self.sizes = []
        for i, outputs in enumerate(functions):
            self.program.add_formula(f"f{i}", 1, outputs)
            self.sizes.append(len(outputs))
        self.program.compile()

    def __call__(self, x, which=0):
        x, out = np.array(x, dtype=np.float64), np.empty(self.sizes[which])
        self.program.call(f"f{which}", x, out)
        return out


def run(formulas, x):
    """formulas(list of loads) -> outputs, evaluated at x."""
    return Function(formulas(Tape().load_vector(0, 0, len(x))))(x)


# --- single operations -----------------------------------------------------------------------

OPERATIONS = {
    "x + y": lambda x, y: x + y,
    "x + 2.5": lambda x, y: x + 2.5,
    "2.5 + x": lambda x, y: 2.5 + x,
    "x - y": lambda x, y: x - y,
    "x - 2.5": lambda x, y: x - 2.5,
    "2.5 - x": lambda x, y: 2.5 - x,
    "0 - x": lambda x, y: 0.0 - x,
    "x * y": lambda x, y: x * y,
    "x * 2.5": lambda x, y: x * 2.5,
    "2.5 * x": lambda x, y: 2.5 * x,
    "-1 * x": lambda x, y: -1.0 * x,
    "x / y": lambda x, y: x / y,
    "x / 2.5": lambda x, y: x / 2.5,
    "x / -1": lambda x, y: x / -1,
    "2.5 / x": lambda x, y: 2.5 / x,
    "-x": lambda x, y: -x,
    "x x": lambda x, y: x * x,
    "x / x": lambda x, y: x / x,
    "integers": lambda x, y: 3 * x + 2 - y / 4 + (7 - x) + 5 / y,
    "numpy": lambda x, y: np.float64(3) * x + np.float64(2) - y / np.float64(4),
    "mixed": lambda x, y: (x + y) * (x - y) / (1.0 + x * x) - 0.5 * y * -x,
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_operations_equal_those_of_numpy(name):
    pairs = [(a, b) for a in X for b in X]
    found = run(
        lambda x: [OPERATIONS[name](x[i], x[j]) for i in range(len(X)) for j in range(len(X))], X
    )
    wanted = [OPERATIONS[name](a, b) for a, b in pairs]
    np.testing.assert_allclose(found, wanted, rtol=1e-15, atol=1e-15)


def test_signs_are_copied():
    x = [3.0, -2.0, 0.0, -0.0]
    found = run(lambda x: [copysign(m, s) for m in (*x, 5.0, -5.0, 2) for s in x], x)
    wanted = [math.copysign(m, s) for m in (*x, 5.0, -5.0, 2) for s in x]
    np.testing.assert_array_equal(found, wanted)
    np.testing.assert_array_equal(np.signbit(found), np.signbit(wanted))


def test_vectors_equal_those_of_numpy():
    random = np.random.default_rng(0)
    x = random.normal(size=24)
    a, b, matrix = x[:3], x[3:6], x[6:15].reshape(3, 3)
    other = x[15:].reshape(3, 3)

    def formulas(x):
        rows, more = ([x[s + 3 * r : s + 3 * r + 3] for r in range(3)] for s in (6, 15))
        return [
            dot(x[:3], x[3:6]),
            *cross(x[:3], x[3:6]),
            *add_vectors(x[:3], x[3:6], x[6:9]),
            *scale_vector(x[0], x[3:6]),
            *subtract_vectors(x[:3], x[3:6]),
            *matvec(rows, x[:3]),
            *(value for row in matmul(rows, more) for value in row),
        ]

    wanted = np.concatenate(
        [[a @ b], np.cross(a, b), a + b + x[6:9], x[0] * b, a - b, matrix @ a]
        + [(matrix @ other).ravel()]
    )
    np.testing.assert_allclose(run(formulas, x), wanted, rtol=1e-14, atol=1e-15)
    with pytest.raises(ValueError):
        dot([1.0, 2.0], [1.0])


# --- what is folded --------------------------------------------------------------------------


def test_what_is_known_is_folded():
    tape = Tape()
    x, y = tape.load_vector(0, 0, 2)
    before = len(tape.operations)
    minus = -x
    assert (-minus).index == x.index
    for same in (x + 0, 0 + x, x - 0, x + 0.0, x * 1, 1.0 * x, x / 1, x + np.float64(0)):
        assert same.index == x.index
    for nothing in (x * 0, 0.0 * x, 0 / x, x - x, dot([0.0, x], [y, 0.0])):
        assert nothing == 0.0 and not isinstance(nothing, SymbolicExpression)
    assert dot([1.0, 0.0, 0.0], [x, y, y]).index == x.index
    assert len(tape.operations) == before + 1  # the one negation
    assert (x * -1).index == (-x).index == (0 - x).index == (x / -1).index


def test_equal_operations_are_done_once():
    tape = Tape()
    x, y = tape.load_vector(0, 0, 2)
    assert tape.load(0, 1).index == y.index
    first = apply_function("sin", x * y + 2.0) * x
    count = len(tape.operations)
    assert (x * apply_function("sin", 2.0 + y * x)).index == first.index
    assert len(tape.operations) == count
    assert (x - y).index != (y - x).index
    assert (x / y).index != (y / x).index


def test_constants_and_operations_of_the_same_number_differ():
    """Operation number 1 is not the constant 1."""

    def formulas(x, largest=maximum, signed=copysign):
        return [
            value
            for k in range(len(x))
            for pair in (
                (x[0] + float(k), x[0] + x[k]),
                (x[0] * float(k), x[0] * x[k]),
                (float(k) - x[3], x[k] - x[3]),
                (float(k) / x[3], x[k] / x[3]),
                (largest(x[0], float(k)), largest(x[0], x[k])),
                (signed(float(k), x[1]), signed(x[k], x[1])),
            )
            for value in pair
        ]

    x = [10.5, -20.5, 30.5, 40.5, 50.5]
    wanted = formulas(x, max, math.copysign)
    np.testing.assert_allclose(run(formulas, x), wanted, rtol=1e-15)
    backwards = run(lambda x: formulas(x)[::-1], x)
    np.testing.assert_allclose(backwards, wanted[::-1], rtol=1e-15)


# --- sin, cos, exp, log and tanh of several numbers at once -----------------------------------

PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459230781640629")
VECTOR = ("sin", "cos", "exp", "log", "tanh")


def sine(x):
    """To some 40 digits, by Taylor's series."""
    turns = (2 * x / PI).to_integral_value()
    x -= turns * PI / 2
    odd = int(turns) % 2
    term, total, k = (Decimal(1), Decimal(1), 0) if odd else (x, x, 1)
    while abs(term) > Decimal("1e-60") * abs(total):
        k += 2
        term *= -x * x / (k * (k - 1))
        total += term
    return -total if int(turns) % 4 >= 2 else total


def hyperbolic(x):
    if abs(x) < Decimal("1e-45"):
        return x
    power = (2 * x).exp()
    return (power - 1) / (power + 1)


EXACT = {
    "sin": sine,
    "cos": lambda x: sine(x + PI / 2),
    "exp": Decimal.exp,
    "log": Decimal.ln,
    "tanh": hyperbolic,
}


@functools.cache
def drawn(name):
    """Arguments of a function, and what it is there: tiny to large, and where it changes."""
    random = np.random.default_rng(0)
    x = [random.uniform(-1, 1, 600), 10.0 ** random.uniform(-12, 0, 200), [1e-300, -1e-300]]
    if name == "tanh":
        edges = np.array([0.625, 20.0, *(0.25 * math.log(2.0) * np.arange(1, 40, 2))])
        x += [random.uniform(-25, 25, 600), np.nextafter(edges, 0), np.nextafter(edges, 99)]
    elif name == "exp":
        x += [random.uniform(-705, 705, 600), 0.5 * math.log(2.0) * np.arange(-99.0, 99.0, 2)]
    elif name == "log":
        x = [10.0 ** random.uniform(-307, 308, 600), random.uniform(0.5, 2.0, 600)]
        x += [np.nextafter([0.5, 1.0, 2.0, 0.5**0.5], 9), [0.5, 1.0, 2.0, 0.5**0.5, 2.0**-1022]]
    else:
        turns = np.concatenate([np.arange(-40, 41), random.integers(2**47, size=300)])
        right = 0.5 * math.pi * turns[np.abs(turns) < 2**47.3]
        x += [right, np.nextafter(right, 0), right + 1e-7, 0.5 * right]
        x += [random.uniform(-10, 10, 600), 2.0 ** random.uniform(0, 48, 300)]
    x = np.concatenate(x)
    with localcontext(prec=110):
        return x, [EXACT[name](Decimal(value)) for value in x.tolist()]


def units_off(found, wanted):
    """Largest error in units in the last place."""
    return max(
        float(abs(Decimal(a) - b) / Decimal(math.ulp(float(b))))
        for a, b in zip(np.asarray(found).tolist(), wanted, strict=True)
    )


@pytest.mark.parametrize("count", [1, 2, 3, 5, 8, 9, 17])
@pytest.mark.parametrize("name", VECTOR)
def test_functions_are_correct_to_one_and_a_half_units(name, count):
    x, wanted = drawn(name)
    function = Function([apply_function(name, value) for value in Tape().load_vector(0, 0, count)])
    rows = np.resize(x, (-(-len(x) // count), count))  # the first ones again at the end
    found = np.concatenate([function(row) for row in rows])[: len(x)]
    assert units_off(found, wanted) <= 1.5


@pytest.mark.parametrize("name", ["sin", "cos"])
def test_angles_that_doubles_do_not_know_are_not_numbers(name):
    odd = np.array([NAN, INF, -INF, 2.0**48, -(2.0**48), 1e300, -1e300])
    function = Function([apply_function(name, x) for x in Tape().load_vector(0, 0, 5)])
    for at in range(5):
        for value in odd:
            x = np.array([0.3, -1.0, 2.0, 5.0, 2.0**48 - 1])
            x[at] = value
            found = function(x)
            assert math.isnan(found[at])
            others = np.arange(5) != at  # no number touches another
            np.testing.assert_array_equal(found[others], function(np.where(others, x, 0))[others])
            assert np.isfinite(found[others]).all()


def test_tanh_ends_at_one_and_begins_with_its_argument():
    tiny = [0.0, 5e-324, -5e-324, 1e-310, 1e-300, -1e-160, 1e-20, -1e-9]
    large = [INF, -INF, 1e308, -1e308, 800.0, -20.0, 19.5, NAN]
    x = np.array([*tiny, *large])
    found = run(lambda x: [apply_function("tanh", value) for value in x], x)
    np.testing.assert_array_equal(found[:8], tiny)
    np.testing.assert_array_equal(found[8:], [1, -1, 1, -1, 1, -1, 1, NAN])
    assert run(lambda x: [apply_function("tanh", x[0])], [18.0])[0] < 1.0


def test_exp_and_log_end_where_they_must():
    x = np.array([-INF, -1e300, -708.5, 0.0, 709.5, 1e300, INF, NAN])
    found = run(lambda x: [apply_function("exp", value) for value in x], x)
    np.testing.assert_array_equal(found, [0, 0, 0, 1, INF, INF, INF, NAN])
    x = np.array([-INF, -1.0, -0.0, 0.0, 5e-324, 1.0, INF, NAN])
    found = run(lambda x: [apply_function("log", value) for value in x], x)
    np.testing.assert_array_equal(found, [NAN, NAN, NAN, NAN, NAN, 0, NAN, NAN])


def test_functions_of_functions_are_taken_in_order():
    """A program of many levels, some of them wider than a register, with operations between."""

    def formulas(x, do):
        sines, cosines = ([do(name, value) for value in x] for name in ("sin", "cos"))
        return [
            *sines, *cosines,
            *(do("tanh", s) for s in sines),
            *(do("sin", c + value) for c, value in zip(cosines, x, strict=True)),
            *(do("cos", do("tanh", do("sin", 2.0 * s) + s)) for s in sines),
            do("tanh", x[0]) * sines[1] + do("tanh", do("cos", do("cos", do("cos", x[2])))),
        ]  # fmt: skip

    x = np.random.default_rng(4).uniform(-3, 3, 11)
    wanted = formulas(x, lambda name, value: getattr(np, name)(value))
    np.testing.assert_allclose(
        run(lambda x: formulas(x, apply_function), x), wanted, rtol=3e-15, atol=1e-15
    )
    backwards = run(lambda x: formulas(x, apply_function)[::-1], x)
    np.testing.assert_allclose(backwards[::-1], wanted, rtol=3e-15, atol=1e-15)


# --- dot products of one vector with several --------------------------------------------------


def dotted(x, take, do):
    """Fifteen dots with one vector, numbers among what is multiplied, then dots of these."""
    first = [x[0], x[1] * x[2], 3.0, 0.0, do("sin", x[3])]
    others = [[x[(3 * k + i) % 8] * x[k % 8] for i in range(5)] for k in range(12)]
    some = [[0.0, 0.0, 0.0, x[5], 0.0], [0.0, x[1], 2.0, x[0], 1.0], [1.0, 2.0, -1.0, 5.0, 0.5]]
    row = take(first, [*others, *some])
    again = take(row[:3], [row[3:6], row[6:9], [do("cos", value) for value in row[9:12]]])
    return [*row, x[4], *again, 1.5, *row[2:7], again[0] * row[1], *take([x[6]], [[x[7]], [x[6]]])]


@pytest.mark.parametrize("length", [None, 9])
def test_dots_are_sums_of_products(length, monkeypatch):
    """In one piece and in several; side by side in the outputs, and not."""
    if length is not None:
        monkeypatch.setattr(llvm_formulas, "MAX_SINGLE_FUNCTION_LENGTH", length)
        monkeypatch.setattr(llvm_formulas, "PIECE_LENGTH", length)
    for x in np.random.default_rng(11).uniform(-2, 2, (20, 8)):
        wanted = dotted(
            x,
            lambda first, others: [np.dot(first, other) for other in others],
            lambda name, value: getattr(np, name)(value),
        )
        found = run(lambda x: dotted(x, dot_products, apply_function), x)
        np.testing.assert_allclose(found, wanted, rtol=1e-13, atol=1e-13)


def test_dots_of_what_is_known_are_folded():
    x = Tape().load(0, 0)
    assert dot_products([1.0, 2.0], [[3.0, 4.0]]) == [11.0]
    assert dot_products([x, 0.0], [[0.0, x], [0.0, 3.0]]) == [0.0, 0.0]
    assert dot_products([], [[], []]) == [0.0, 0.0] and dot_products([x], []) == []


def test_a_product_of_matrices_takes_an_instruction_for_eight_of_its_products():
    tape = Tape()
    rows = [tape.load_vector(0, 6 * r, 6) for r in range(6)]
    columns = [tape.load_vector(0, 36 + 6 * c, 6) for c in range(12)]
    values = [value for row in rows for value in dot_products(row, columns)]
    program = Program()
    program.add_formula("f", 1, values)
    text = emit_module(program.functions.values())
    assert text.count(" fmul ") == 6 * 6 * 2  # 432 one by one
    assert text.count(" fadd ") == 5 * 6 * 2
    assert text.count(" store ") == 6 * 2
    program.compile()
    x, out = np.random.default_rng(2).normal(size=108), np.empty(72)
    program.call("f", x, out)
    wanted = x[:36].reshape(6, 6) @ x[36:].reshape(12, 6).T
    np.testing.assert_allclose(out.reshape(6, 12), wanted, rtol=1e-13, atol=1e-14)


# --- what is not finite ----------------------------------------------------------------------

ODD = (NAN, INF, -INF, 0.0, 1.0, -2.0)


def honest(a, b):
    return NAN if math.isnan(a) or math.isnan(b) else max(a, b)


def test_nan_wins_among_maxima():
    found = run(lambda x: [maximum(a, b) for a in x for b in x], ODD)
    np.testing.assert_array_equal(found, [honest(a, b) for a in ODD for b in ODD])
    for constant in ODD:
        found = run(
            lambda x, c=constant: [m for a in x for m in (maximum(a, c), maximum(c, a))], ODD
        )
        np.testing.assert_array_equal(found, np.repeat([honest(a, constant) for a in ODD], 2))


def test_nan_wins_among_constants():
    for a in ODD:
        for b in ODD:
            np.testing.assert_equal(float(maximum(a, b)), honest(a, b))
    np.testing.assert_equal(float(max_abs([NAN])), NAN)
    np.testing.assert_equal(float(max_abs([3.0, NAN, 1.0])), NAN)


def test_largest_is_of_absolute_values_and_lets_nothing_pass():
    assert max_abs([]) == 0.0 and max_abs([-3.0, 2.0]) == 3.0
    function = Function([max_abs(Tape().load_vector(0, 0, 5))])
    random = np.random.default_rng(1)
    for _ in range(20):
        x = random.normal(size=5)
        assert function(x)[0] == np.abs(x).max()
    for at in range(5):
        for odd, wanted in ((NAN, NAN), (INF, INF), (-INF, INF), (-1e308, 1e308)):
            x = np.linspace(-1, 1, 5)
            x[at] = odd
            np.testing.assert_equal(function(x)[0], wanted)
            x[(at + 2) % 5] = NAN
            assert math.isnan(function(x)[0])


def test_what_is_not_finite_survives_sums_and_products():
    x = (NAN, INF, -INF)
    found = run(lambda x: [f(v) for v in x for f in CARRIED], x)
    np.testing.assert_array_equal(found, [f(v) for v in x for f in CARRIED])
    assert np.isnan(run(lambda x: [(x[0] - x[1]) + 1.0], (INF, INF))).all()
    assert np.isnan(run(lambda x: [x[0] * x[1], x[0] / x[0]], (INF, 0.0))).all()
    assert run(lambda x: [1.0 / x[0]], (0.0,))[0] == INF
    constants = run(lambda x: [x[0] + INF, x[0] * NAN, INF - x[0], NAN], (1.0,))
    np.testing.assert_array_equal(constants, [INF, NAN, INF, NAN])


CARRIED = (
    lambda v: v + 1.0,
    lambda v: v * 2.0,
    lambda v: 1.0 - v,
    lambda v: -v,
    lambda v: 3 * v - 5,
)


def test_nan_does_not_cancel():
    def formulas(x):
        return [(x[0] + x[1]) - x[0], x[0] - (x[0] - x[1]), (2.0 * x[0] + x[1]) - x[0] * 2.0]

    assert np.isnan(run(formulas, (NAN, 1.0))).all()


# --- linear systems --------------------------------------------------------------------------


def solved(matrix, right):
    """X and the determinant by traced formulas."""
    k, width = right.shape

    def formulas(x):
        rows = [x[k * i : k * i + k] for i in range(k)]
        sides = [x[k * k + width * i : k * k + width * (i + 1)] for i in range(k)]
        found, determinant = solve_linear_system(rows, sides)
        return [*(value for row in found for value in row), determinant]

    return Function(formulas(Tape().load_vector(0, 0, k * k + k * width)))


def check(function, matrix, right, tolerance=1e-12):
    out = function([*matrix.ravel(), *right.ravel()])
    wanted = np.linalg.solve(matrix, right)
    bound = tolerance * max(1.0, np.linalg.cond(matrix) / 1e2) * np.abs(wanted).max()
    assert np.abs(out[:-1].reshape(right.shape) - wanted).max() <= bound
    assert out[-1] == pytest.approx(np.linalg.det(matrix), rel=1e-12 * np.linalg.cond(matrix))
    assert np.sign(out[-1]) == np.linalg.slogdet(matrix)[0]


@pytest.mark.parametrize("k", range(1, 9))
def test_solve_equals_numpy(k):
    random = np.random.default_rng(k)
    width = 1 + k % 3
    function = solved(np.eye(k), np.zeros((k, width)))
    signs = set()
    for trial in range(60):
        matrix, right = random.normal(size=(k, k)), random.normal(size=(k, width))
        if np.linalg.cond(matrix) > 1e3:
            continue
        if trial % 3 == 0:
            matrix *= 10.0 ** random.integers(-3, 4)
        check(function, matrix, right)
        signs.add(np.linalg.slogdet(matrix)[0])
    assert signs == {1.0, -1.0}


@pytest.mark.parametrize("k", range(2, 9))
def test_solve_needs_no_pivots(k):
    random = np.random.default_rng(10 + k)
    function = solved(np.eye(k), np.zeros((k, 2)))
    right = random.normal(size=(k, 2))
    well = np.eye(k) + 0.3 * random.normal(size=(k, k))
    signs = random.choice([-1.0, 1.0], k)
    for matrix in (
        np.eye(k), -np.eye(k), np.diag(signs), np.fliplr(np.eye(k)),
        np.roll(np.eye(k), 1, axis=0), np.eye(k)[random.permutation(k)] * signs,
        np.triu(well), np.tril(well), -np.triu(well), np.roll(np.triu(well), 1, axis=0),
        well - np.diag(np.diag(well)) + np.roll(np.eye(k), 1, axis=1),
    ):  # fmt: skip
        if abs(np.linalg.det(matrix)) > 1e-6:
            check(function, matrix, right)
    zero_first = well.copy()
    zero_first[0, 0] = 0.0  # a zero leading pivot, then one that is nearly zero
    check(function, zero_first, right)
    zero_first[0, 0] = 1e-17
    check(function, zero_first, right)


@pytest.mark.parametrize("k", range(1, 7))
def test_solve_folds_what_it_knows(k):
    """Constants of every sign among the entries, as the loops of machines have them."""
    random = np.random.default_rng(20 + k)
    tested = 0
    while tested < 6:
        matrix, right = random.normal(size=(k, k)), random.normal(size=(k, 2))
        known = random.random((k, k)) < 0.5
        matrix[known] = random.choice([-1.0, 0.0, 1.0, 0.5], known.sum())
        if np.linalg.cond(matrix) > 50:
            continue
        right[random.random((k, 2)) < 0.4] = 0.0

        def formulas(x, matrix=matrix, right=right, known=known):
            rows = [
                [float(matrix[i, j]) if known[i, j] else x[k * i + j] for j in range(k)]
                for i in range(k)
            ]
            found, determinant = solve_linear_system(rows, right.tolist())
            return [*(value for row in found for value in row), determinant]

        out = run(formulas, matrix.ravel())
        wanted = np.linalg.solve(matrix, right)
        np.testing.assert_allclose(out[:-1].reshape(k, 2), wanted, rtol=0, atol=1e-12)
        assert out[-1] == pytest.approx(np.linalg.det(matrix), rel=1e-12)
        tested += 1


@pytest.mark.parametrize("small", [0.0, 1e-12, 1e-9, 1e-5, 0.3])
@pytest.mark.parametrize("pivot", [-1.0, 1.0])
def test_a_constant_pivot_above_small_entries(pivot, small):
    matrix = np.array([[pivot, 0.3, 0.2], [small, 2.0, 0.5], [-small, 0.1, 3.0]])

    def formulas(x):
        rows = [[pivot, x[1], x[2]], x[3:6], x[6:9]]
        found, determinant = solve_linear_system(rows, [[1.0], [2.0], [3.0]])
        return [*(row[0] for row in found), determinant]

    out = run(formulas, matrix.ravel())
    np.testing.assert_allclose(out[:3], np.linalg.solve(matrix, [1.0, 2.0, 3.0]), rtol=1e-12)
    assert out[3] == pytest.approx(np.linalg.det(matrix), rel=1e-12)


def test_solve_of_constants_needs_no_tape():
    random = np.random.default_rng(3)
    for k in range(1, 6):
        matrix, right = random.normal(size=(k, k)) - 2 * np.eye(k), random.normal(size=(k, 2))
        found, determinant = solve_linear_system(matrix.tolist(), right.tolist())
        np.testing.assert_allclose(found, np.linalg.solve(matrix, right), rtol=1e-11)
        assert determinant == pytest.approx(np.linalg.det(matrix), rel=1e-12)


def test_singular_matrices_are_not_finite():
    for k in range(1, 6):
        function = solved(np.eye(k), np.zeros((k, 1)))
        for fill in (0.0, NAN):
            out = function([fill] * (k * k) + [1.0] * k)
            assert not np.isfinite(out[:-1]).any()
            assert not abs(out[-1]) > 0
        matrix = np.eye(k)
        matrix[k - 1, 0] = NAN
        assert np.isnan(function([*matrix.ravel(), *np.ones(k)])).any()


@pytest.mark.parametrize("k", range(1, 9))
def test_positive_matrices_are_solved_as_by_numpy(k):
    random = np.random.default_rng(k)

    def formulas(x):
        return LdltFactorization([x[k * i : k * i + k] for i in range(k)]).solve(x[k * k :])

    function = Function(formulas(Tape().load_vector(0, 0, k * k + k)))
    for trial in range(30):
        root = random.normal(size=(k, k))
        matrix, right = root @ root.T + 0.1 * np.eye(k), random.normal(size=k)
        scales = 10.0 ** random.uniform(-2, 2, k) if trial % 2 else np.ones(k)
        matrix = scales[:, None] * matrix * scales
        wanted = np.linalg.solve(matrix, right)
        found = function([*matrix.ravel(), *right])
        assert np.abs((found - wanted) * scales).max() <= 1e-12 * np.abs(wanted * scales).max()
    exact = LdltFactorization(matrix.tolist()).solve(right.tolist())
    np.testing.assert_allclose(exact, found, rtol=1e-10)


# --- programs --------------------------------------------------------------------------------


def test_functions_of_constants_and_of_nothing():
    assert Function([2.0, 0.0, -1, NAN])([])[:3].tolist() == [2.0, 0.0, -1.0]
    assert len(Function([])([])) == 0
    x = Tape().load(0, 3)
    np.testing.assert_array_equal(Function([1e-310, x, x, -0.0])([0, 0, 0, 7]), [1e-310, 7, 7, 0])


def test_arguments_are_told_apart():
    tape = Tape()
    program = Program()
    program.add_formula("f", 3, [tape.load(2, 0) - tape.load(0, 1) * tape.load(1, 2)])
    program.compile()
    arrays = [np.arange(3) + 10.0 * i for i in range(3)]
    out = np.empty(1)
    assert program.call("f", *arrays, out) == 0
    assert out[0] == 20.0 - 1.0 * 12.0


def test_functions_of_one_program_share_it_and_programs_do_not_mix():
    x, y = Tape().load(0, 0), Tape().load(0, 0)
    one = Function([x + 1.5], [x * 3.0, x * x])
    two = Function([y - 1.5])
    for _ in range(2):
        assert one([2.0])[0] == 3.5
        np.testing.assert_array_equal(one([2.0], 1), [6.0, 4.0])
        assert two([2.0])[0] == 0.5
        many = [Function([Tape().load(0, 0) * (i + 0.5)]) for i in range(20)]
        assert [f([2.0])[0] for f in many] == [2 * i + 1.0 for i in range(20)]
        del many
        gc.collect()


def test_a_program_may_end_before_others():
    code = """
import gc
import numpy as np
import crane
machine = crane.load("mini_forwarder")
home = np.array(machine.home[machine.closure.active])
rest = np.zeros(3)
first = crane.Dynamics(machine)
wanted = first.inverse(home, rest, rest)
for _ in range(3):
    other = crane.Dynamics(machine)
    other.gravity(home)
    other.gravity(home[None])
    del other
    gc.collect()
    assert (first.inverse(home, rest, rest) == wanted).all()
del first
gc.collect()
second = crane.Dynamics(machine.with_payload(crane.Payload("link7_tip", 0.1)))
del machine
gc.collect()
assert np.abs(second.inverse(home, rest, rest) - wanted).max() > 0.1
"""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr


# --- functions of one sample, which Python calls directly ---------------------------------------


def sums():
    """f(a, b) -> [[a_0 + b_0, 2 a_1], [a_2 - b_2, b_1]], None where a_0 + b_0 is not below 100.

    With its program and its output array.
    """
    tape, program = Tape(), Program()
    a, b = tape.load_vector(0, 0, 3), tape.load_vector(1, 0, 3)
    program.add_formula("formula", 2, [a[0] + b[0], a[1] * 2.0, a[2] - b[2], b[1]])
    with program.add_routine("one", counts=("count",), arrays=("a", "b", "out")) as r:
        r.call("formula", r.a, r.b, r.out)
        with r.if_then(r.out[0] < 100.0):
            r.return_value(r.count)
        r.return_value(0)
    program.compile()
    inputs, out = np.zeros((2, 3)), np.zeros((2, 2))
    arguments = 1, inputs[0], inputs[1], out
    return program.sample_function("one", *arguments, inputs=inputs, output=out), program, out


A, B = np.array([0.7, -1.9, 3.1]), np.array([0.25, -0.6, 12.0])
SUMS = [[A[0] + B[0], 2 * A[1]], [A[2] - B[2], B[1]]]
READ_ONLY = A.copy()
READ_ONLY.flags.writeable = False
UNALIGNED = np.zeros(25, dtype=np.uint8)[1:].view(np.float64)
UNALIGNED[:] = A
SAME_AS_A = {
    "reversed": A[::-1].copy()[::-1],
    "column": np.column_stack([B, A, B])[:, 1],
    "read-only": READ_ONLY,
    "not aligned": UNALIGNED,
    "unpickled": pickle.loads(pickle.dumps(A)),
    "little-endian": A.astype("<f8"),
}


@pytest.mark.parametrize("name", SAME_AS_A)
def test_a_sample_function_reads_all_vectors_of_doubles(name):
    function, _, out = sums()
    for first, second in ((SAME_AS_A[name], B), (A, SAME_AS_A[name])):
        wanted = SUMS if second is B else [[2 * A[0], 2 * A[1]], [0.0, A[1]]]
        one, two = function(first, second), function(first, second)
        np.testing.assert_array_equal(one, wanted)
        assert one.flags.owndata and one.flags.writeable and one.dtype == np.float64
        one[:] = 7.0
        np.testing.assert_array_equal(two, wanted)
        np.testing.assert_array_equal(out, wanted)
    np.testing.assert_array_equal(function(B), function(B, SAME_AS_A[name]))  # as the last time


REFUSED = {
    "list": [*A],
    "nothing": None,
    "number": 0.7,
    "object": object(),
    "type": np.ndarray,
    "float32": A.astype(np.float32),
    "integers": np.array([1, 2, 3]),
    "other byte order": A.astype(np.dtype(np.float64).newbyteorder()),
    "complex": A.astype(complex),
    "objects": A.astype(object),
    "long double": A.astype(np.longdouble),
    "times": np.array([1, 2, 3], dtype="m8[s]"),
    "record": np.array([(1.0,)] * 3, dtype=[("x", float)]),
    "subclass": np.ma.masked_array(A),
    "short": A[:2],
    "empty": A[:0],
    "long": np.append(A, A),
    "scalar": np.array(0.7),
    "row": A[None],
    "not a number": np.array([0.7, NAN, 3.1]),
    "infinite": np.array([0.7, -1.9, -INF]),
    "too large": np.array([100.0, 0.0, 0.0]),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_sample_function_leaves_everything_else(name):
    function, _, _ = sums()
    bad = REFUSED[name]
    assert function(bad, B) is None and function(A, bad) is None
    assert function(A, B, A) is None and function(*[bad] * 30) is None
    np.testing.assert_array_equal(function(A, B), SUMS)


def test_a_sample_function_keeps_the_counts_of_references():
    function, program, _ = sums()
    given = [A, B, *REFUSED.values(), np.ndarray, A.dtype, None, function]
    calls = [(A, B)]
    for bad in REFUSED.values():
        calls += [(bad, B), (A, bad)]

    def call_all(function, count):
        for _ in range(count):
            for arguments in calls:
                function(*arguments)

    tracemalloc.start()
    call_all(function, 10)
    before, memory = [*map(sys.getrefcount, given)], tracemalloc.get_traced_memory()[0]
    call_all(function, 2000)
    grown = tracemalloc.get_traced_memory()[0] - memory
    tracemalloc.stop()
    assert np.abs(np.subtract([*map(sys.getrefcount, given)], before)).max() < 100
    assert grown < 10_000
    owned = weakref.ref(program)
    del program
    gc.collect()
    assert owned() is not None  # its machine code is called
    np.testing.assert_array_equal(function(A, B), SUMS)
    del function, given
    gc.collect()
    assert owned() is None


def test_sample_functions_do_nothing_where_they_do_not_know_the_objects(monkeypatch):
    monkeypatch.setattr(sample_function, "_OBJECT_SIZE", 32)
    assert sums()[0](A, B) is None
