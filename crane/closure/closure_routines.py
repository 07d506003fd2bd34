"""Routines that close loops by Newton's method in machine code, sample by sample.

They call the formulas of `CompiledClosure`: "newton", "predict", "distance" and "gamma".
"""

import numpy as np

from crane.codegen import Layout, Program

_MAX_NEWTON_ITERATIONS = 8  # Newton's method converges quadratically
# least determinant, as a share of that at home, over the correction of a prediction, below which
# another branch may be as near
_MIN_REGULARITY = 0.02


def add_closure_routines(
    program: Program, nq: int, n: int, has_partly_active_rotations: bool, wraps_rotations: bool
) -> None:
    """Add the routines "close", "follow", "close_each" and "gamma_each" to a program.

    Args:
        program: Program with the formulas.
        nq: Number of coordinates.
        n: Number of active coordinates.
        has_partly_active_rotations: Whether to add "project" as well, which closes the loops
            without a motion of the active joints instead of a change of their coordinates.
        wraps_rotations: Whether passive rotation vectors are wrapped by the formula "wrap".
    """
    _add_close(program, nq, "close", "newton")
    if has_partly_active_rotations:
        _add_close(program, nq, "project", "newton_motion")
    _add_follow(program, nq, n, wraps_rotations)
    _add_loops_over_configurations(program, nq, n)


def _add_close(program: Program, nq: int, name: str, newton: str) -> None:
    """Add "close": Newton's method in place; 1 if closed on the branch of home, else 0.

    A step whose square is below rounding is the last one.
    """
    arrays = {
        "constants": None, "q": None, "result": program.formula_outputs("newton"),
        "tolerances": None,
    }  # fmt: skip
    with program.add_routine(name, arrays=arrays) as r:
        q, result = r.q, r.result
        rounded, closed, small = (r.new_variable(r.tolerances[i]) for i in range(3))
        before = r.new_variable(np.inf)
        evaluations = r.new_variable(0)
        with r.loop_forever():
            r.call(newton, r.constants, q, result)
            residual, step = (r.new_variable(result[name]) for name in ("residual", "step"))
            stalled = (residual <= closed) & (residual > before * 0.25)
            with r.if_then((residual <= rounded) | stalled):
                r.break_loop()
            r.assign(evaluations, evaluations + 1)
            with r.if_then(~((step < 1.0) & (evaluations < _MAX_NEWTON_ITERATIONS))):
                r.return_value(0)
            r.copy(q, result.element_pointer("q"), nq)
            with r.if_then(step <= small):
                r.break_loop()
            r.assign(before, residual)
        with r.if_then(result["regular"] > 0.0):
            r.return_value(1)
        r.return_value(0)


def _add_follow(program: Program, nq: int, n: int, wraps_rotations: bool) -> None:
    """Add "follow": one Newton continuation step per target.

    It stops at the first target where a step fails; `NewtonContinuation` solves that one. "cursor"
    holds [q, gamma] of the last sample.
    """
    entries = program.formula_outputs("newton").parts["gamma"]
    cursor = Layout(q=nq, gamma=entries)
    arrays = {
        "constants": None, "targets": None, "cursor": cursor, "out": None, "tolerances": None,
    }  # fmt: skip
    with program.add_loop("follow", arrays=arrays) as (r, i):
        guess = r.local_array("guess", nq)
        correction = r.local_array("correction", program.formula_outputs("distance"))
        predicted = r.local_array("predicted", program.formula_outputs("predict"))
        result = r.local_array("result", program.formula_outputs("newton"))
        r.call("predict", r.constants, r.cursor, r.targets.row_pointer(i, n), predicted)
        move = r.new_variable(predicted["move"])
        with r.if_then(~(move < 1.0)):
            r.return_value(i)
        r.copy(guess, predicted.element_pointer("q"), nq)
        closed = r.call("close", r.constants, guess, result, r.tolerances)
        with r.if_then(closed < 1):
            r.return_value(i)
        r.call("distance", r.constants, predicted, guess, correction)
        with r.if_then(~(correction["all"] <= move * 0.5 + 0.02)):
            r.return_value(i)
        with r.if_then(~(correction["all"] * _MIN_REGULARITY < result["determinant"])):
            r.return_value(i)
        if wraps_rotations:
            r.copy(predicted.element_pointer("q"), guess, nq)
            r.call("wrap", predicted, guess)
        r.copy(r.cursor, guess, nq)
        r.copy(r.cursor.element_pointer("gamma"), result.element_pointer("gamma"), entries)
        r.copy(r.out.row_pointer(i, nq), guess, nq)


def _add_loops_over_configurations(program: Program, nq: int, n: int) -> None:
    """Add "close_each", which closes configurations in place, and "gamma_each"."""
    newton = program.formula_outputs("newton")
    with program.add_loop("close_each", arrays=("constants", "q", "tolerances")) as (r, i):
        result = r.local_array("result", newton)
        closed = r.call("close", r.constants, r.q.row_pointer(i, nq), result, r.tolerances)
        with r.if_then(closed < 1):
            r.return_value(i)
    with program.add_loop("gamma_each", arrays=("constants", "q", "out")) as (r, i):
        result = r.local_array("result", newton)
        r.call("newton", r.constants, r.q.row_pointer(i, nq), result)
        with r.if_then(~(result["regular"] > 0.0)):
            r.return_value(i)
        r.call("gamma", result, r.out.row_pointer(i, nq * n))
