"""Routines, loops around formulas, against the same computation in Python."""

import math
import re
import threading
from pathlib import Path

import numpy as np
import pytest

from crane.codegen import Layout, Program, Tape, run_with_fallback, select
from crane.codegen.symbolic import apply_function


def squares():
    """A program with square(x (2,)) -> [x_0^2 + x_1, x_1]."""
    program, tape = Program(), Tape()
    x, y = tape.load_vector(0, 0, 2)
    program.add_formula("square", 1, {"first": [x * x + y], "second": [y]})
    return program


# --- loops, strides, arrays --------------------------------------------------------------------


def test_a_loop_goes_through_rows_with_strides():
    program = squares()
    with program.add_routine("all", counts=("count",), arrays=("inputs", "out")) as r:
        with r.loop(r.count) as i:
            r.call(
                "square", r.inputs.row_pointer(i, 5).element_pointer(1), r.out.row_pointer(i, 3)
            )
        r.return_value(r.count)
    program.compile()
    inputs = np.random.default_rng(0).normal(size=(7, 5))
    out = np.full((7, 3), 9.0)
    assert program.call("all", 7, inputs, out) == 7
    np.testing.assert_array_equal(out[:, 1], inputs[:, 2])
    np.testing.assert_allclose(out[:, 0], inputs[:, 1] ** 2 + inputs[:, 2], atol=1e-15)
    assert (out[:, 2] == 9.0).all()
    assert program.call("all", 0, inputs, out) == 0


def test_arrays_that_are_not_contiguous_are_refused():
    program = squares()
    program.compile()
    wide, out = np.ones((2, 6)), np.empty(2)
    for array in (wide[0, ::3], np.asfortranarray(np.ones((2, 2)))):
        with pytest.raises(TypeError, match="not contiguous"):
            program.call("square", array, out)
    fixed = np.array([2.0, 5.0])
    fixed.setflags(write=False)
    program.call("square", fixed, out)
    np.testing.assert_array_equal(out, [9.0, 5.0])


def test_loops_within_loops_and_what_leaves_them():
    """For every row the index of the first entry above a bound, -1 where there is none."""
    program = Program()
    arrays = ("table", "bound", "out")
    with program.add_routine("first", counts=("rows", "columns"), arrays=arrays) as r:
        found = r.new_variable(0)
        with r.loop(r.rows) as i:
            r.store(r.out, i, -1.0)
            position = r.new_variable(0.0)
            with r.loop(r.columns) as k:
                with r.if_then(r.table.element_pointer(i * r.columns)[k] > r.bound[0]):
                    r.store(r.out, i, position)
                    r.assign(found, found + 1)
                    r.break_loop()
                r.assign(position, position + 1.0)
        r.return_value(found)
    program.compile()
    table = np.random.default_rng(1).uniform(size=(50, 4))
    out = np.empty(50)
    wanted = [next((k for k, x in enumerate(row) if x > 0.7), -1) for row in table]
    assert program.call("first", 50, 4, table, np.array([0.7]), out) == sum(k >= 0 for k in wanted)
    np.testing.assert_array_equal(out, wanted)


def test_conditions_stop_and_choose():
    """Newton's method for a square root, with every kind of statement."""
    program, tape = Program(), Tape()
    a, x = tape.load(0, 0), tape.load(1, 0)
    program.add_formula(
        "newton", 2, {"x": [0.5 * (x + a / x)], "gap": [apply_function("abs", a - x * x)]}
    )
    with program.add_routine("root", arrays=("a", "out")) as r:
        work = r.local_array("work", program.formula_outputs("newton"))
        r.store(work, "x", select(r.a[0] > 1.0, r.a[0], 1.0))
        steps = r.new_variable(0)
        with r.loop_forever():
            with r.if_then(~(r.a[0] >= 0.0)):  # negative or no number
                r.return_value(-1)
            r.call("newton", r.a, work.element_pointer("x"), work)
            r.assign(steps, steps + 1)
            with r.if_then((work["gap"] <= r.a[0] * 1e-15) | (steps >= 60)):
                r.break_loop()
        with r.if_then((steps > 0) & (steps < 60)):
            r.copy(r.out, work.element_pointer("x"), 1)
        with r.if_else():
            r.store(r.out, 0, math.nan)
        r.return_value(steps)
    program.compile()
    out = np.zeros(1)
    for value in (2.0, 1e-6, 1.0, 3e9):
        steps = program.call("root", np.array([value]), out)
        assert 0 < steps < 60
        assert out[0] == pytest.approx(math.sqrt(value), rel=1e-14)
    out[0] = 7.0
    assert program.call("root", np.array([-1.0]), out) == -1
    assert program.call("root", np.array([math.nan]), out) == -1
    assert out[0] == 7.0


@pytest.mark.parametrize("sign", ["<", "<=", ">", ">="])
def test_comparisons_are_false_of_no_number(sign):
    compare = {
        "<": lambda a, b: a < b,
        "<=": lambda a, b: a <= b,
        ">": lambda a, b: a > b,
        ">=": lambda a, b: a >= b,
    }[sign]
    program = Program()
    with program.add_routine("compare", arrays=("x",)) as r:
        answer = r.new_variable(0)
        with r.if_then(compare(r.x[0], r.x[1])):
            r.assign(answer, answer + 1)
        with r.if_then(~compare(r.x[0], r.x[1])):
            r.assign(answer, answer + 10)
        r.return_value(answer)
    program.compile()
    for a in (-1.0, 0.0, 2.0, math.inf, math.nan):
        for b in (-1.0, 0.0, 2.0, math.nan):
            assert program.call("compare", np.array([a, b])) == (1 if compare(a, b) else 10)


def test_arithmetic_of_routines_equals_that_of_python():
    program = Program()
    with program.add_routine("sums", counts=("k", "m"), arrays=("x", "out")) as r:
        x = [r.x[i] for i in range(3)]
        r.store(r.out, 0, (x[0] + x[1]) * x[2] - x[0] / x[1])
        r.store(r.out, 1, select(x[0] > x[1], x[2], 5))
        r.return_value(r.k * 3 + r.m - 4)
    program.compile()
    x, out = np.array([1.7, -0.3, 2.9]), np.empty(2)
    assert program.call("sums", 5, 7, x, out) == 5 * 3 + 7 - 4
    assert out[0] == (1.7 - 0.3) * 2.9 - 1.7 / -0.3
    assert out[1] == 2.9


def test_routines_call_routines_and_functions_of_other_programs():
    program = squares()
    with program.add_routine("twice", arrays=("x", "out")) as r:
        between = r.local_array("between", program.formula_outputs("square"))
        r.call("square", r.x, between)
        r.call("square", between, r.out)
        r.return_value(2)
    program.compile()
    other = Program()
    with other.add_routine(
        "each", counts=("count",), functions=("what",), arrays=("x", "out")
    ) as r:
        total = r.new_variable(0)
        with r.loop(r.count) as i:
            r.assign(total, total + r.call("what", r.x.row_pointer(i, 2), r.out.row_pointer(i, 2)))
        r.return_value(total)
    other.compile()
    x, out = np.array([[2.0, 1.0], [3.0, -1.0]]), np.empty((2, 2))
    assert other.call("each", 2, program.function_address("twice"), x, out) == 4
    np.testing.assert_array_equal(out, [[26.0, 1.0], [63.0, -1.0]])


def test_a_routine_has_arrays_of_its_own_in_every_thread():
    """A long loop through its own array, which a shared one would mix up."""
    program, tape = Program(), Tape()
    program.add_formula("next", 1, [1.1 * x + 0.25 for x in tape.load_vector(0, 0, 8)])
    with program.add_routine("run", counts=("count",), arrays=("x", "out")) as r:
        own = r.local_array("own", 8)
        r.copy(own, r.x, 8)
        with r.loop(r.count):
            r.call("next", own, r.out)
            r.copy(own, r.out, 8)
        r.return_value(0)
    program.compile()
    starts = np.random.default_rng(2).normal(size=(4, 8)) * 1e-3

    def run(start):
        out = np.empty(8)
        program.call("run", 5000, start, out)
        return out

    alone, together = [run(x) for x in starts], [None] * 4

    def work(i):
        for _ in range(20):
            together[i] = run(starts[i])
            np.testing.assert_array_equal(together[i], alone[i])

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    np.testing.assert_array_equal(together, alone)


def test_what_does_not_fit_is_told_while_building():
    program = squares()
    with program.add_routine("r", counts=("count",), arrays=("x",)) as r:
        with pytest.raises(ValueError, match="'nothing', which is not there yet"):
            r.call("nothing", r.x)
        with pytest.raises(ValueError, match="'square' takes 2 arguments"):
            r.call("square", r.x)
        with pytest.raises(ValueError, match="two arrays 'x'"):
            r.local_array("x", 3)
        with pytest.raises(TypeError, match="integer where real is needed"):
            r.store(r.x, 0, r.count)
        with pytest.raises(AttributeError, match="'r' has no argument 'y'"):
            r.y  # noqa: B018
        r.return_value(0)
    program.compile()
    with pytest.raises(TypeError, match="'r' takes 2 arguments, not 1"):
        program.call("r", 1)


# --- layouts -----------------------------------------------------------------------------------


def test_a_layout_names_the_parts_of_arrays_and_lists():
    layout = Layout(q=3, v_a=2, own=0, work=1)
    assert layout.size == 6
    assert layout["v_a"] == slice(3, 5)
    assert layout.start_index("work") == 5
    stack = np.arange(12.0).reshape(2, 6)
    parts = layout.view(stack)
    np.testing.assert_array_equal(parts.v_a, [[3, 4], [9, 10]])
    assert parts.own.shape == (2, 0)
    parts.work[:] = -1.0  # a view, not a copy
    assert (stack[:, 5] == -1.0).all()
    assert layout.view(["a", "b", "c", "d", "e", "f"]).q == ["a", "b", "c"]
    with pytest.raises(AttributeError, match="no part 'v', there are q, v_a, own, work"):
        parts.v  # noqa: B018


# --- machine code, and a careful step where it stops ---------------------------------------------


def test_every_thing_is_done_once_and_in_order():
    hard = {0, 5, 6, 19}
    done = []

    def fast(first):
        count = 0
        while first + count < 20 and first + count not in hard:
            done.append(first + count)
            count += 1
        return count

    run_with_fallback(20, fast, lambda i: done.append(i))
    assert done == list(range(20))
    done.clear()
    run_with_fallback(20, None, lambda i: done.append(i))
    assert done == list(range(20))


def test_a_careful_step_that_fails_ends_it():
    def slow(i):
        raise ValueError(i)

    with pytest.raises(ValueError, match="3"):
        run_with_fallback(10, lambda first: 3 - first, slow)


# --- the language of the machine stays in one place ----------------------------------------------


def test_nothing_of_llvm_stands_outside_of_its_emitter():
    root = Path(__file__).parents[1]
    words = re.compile(r"getelementptr|\bdefine (void|i64|double)\b|\bfcmp\b|\bllvmlite\b.*import")
    emitter = root / "crane" / "codegen" / "llvm"
    found = [
        path.relative_to(root).as_posix()
        for folder in ("crane", "scripts")
        for path in (root / folder).rglob("*.py")
        if emitter not in path.parents and words.search(path.read_text(encoding="utf-8"))
    ]
    assert not found
