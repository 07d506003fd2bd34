"""Stick-slip modes in machine code: the routine `find_modes`.

It determines the modes as `crane.simulation.integration.stick_slip_modes`, which explains the
problem, by other algorithms, so that each checks the other: least squares by Jacobi rotations of
the columns (Hestenes 1958), bounds by an active set (Stark and Parker 1995), independent columns
by orthogonalization with pivoting. Columns that do not take part are zero.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

import numpy as np

from crane.codegen import ArrayPointer, Layout, Program, Routine, RoutineValue, Tape, select
from crane.codegen.routine_statements import as_value, magnitude
from crane.codegen.symbolic import apply_function, copysign
from crane.common.samples import Array
from crane.dynamics.joint_forces import REST_VELOCITY
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.machine_formulas import MachineFormulas
from crane.simulation.integration.stick_slip_modes import (
    MAX_LIMIT_SHARE,
    MAX_VELOCITY_CHANGE,
    RANK_TOLERANCE,
)

_MAX_SWEEPS = 40  # of Jacobi rotations, which converge quadratically
_NO_ROTATION = 1e-32  # squared cosine of columns that count as orthogonal
_LEAST_SIZE = 2.2e-16  # relative size of columns that count as zero, times their number
_NO_RELEASE = 1e-13  # relative gradient by which no bound is released


def _sign(x: RoutineValue) -> RoutineValue:
    return select(x > 0.0, 1.0, select(x < 0.0, -1.0, 0.0))


class _ColumnLoops:
    """Loops over vectors and over the columns of a matrix, which lie one after another.

    Args:
        routine: The routine to write.
        rows: Length n of a column.
        columns: Number k of columns.
    """

    def __init__(self, routine: Routine, rows: int, columns: int):
        self.routine, self.rows, self.columns = routine, rows, columns

    def each_row(self) -> AbstractContextManager[RoutineValue]:
        """Loop over 0 to n - 1."""
        return self.routine.loop(as_value(self.rows, "integer"))

    def each_column(self) -> AbstractContextManager[RoutineValue]:
        """Loop over 0 to k - 1."""
        return self.routine.loop(as_value(self.columns, "integer"))

    def column(self, matrix: ArrayPointer, index: RoutineValue) -> ArrayPointer:
        """A column."""
        return matrix.row_pointer(index, self.rows)

    def dot(self, one: ArrayPointer, other: ArrayPointer) -> RoutineValue:
        """Variable with the product of two vectors (n,)."""
        total = self.routine.new_variable(0.0)
        with self.each_row() as i:
            self.routine.assign(total, total + one[i] * other[i])
        return total

    def add_multiple(
        self, target: ArrayPointer, factor: RoutineValue, other: ArrayPointer
    ) -> None:
        """Add factor other to target, vectors (n,)."""
        with self.each_row() as i:
            self.routine.store(target, i, target[i] + factor * other[i])

    def copy_scaled(self, target: ArrayPointer, factor: RoutineValue, other: ArrayPointer) -> None:
        """Copy factor other to target, vectors (n,)."""
        with self.each_row() as i:
            self.routine.store(target, i, factor * other[i])

    def fill(self, target: ArrayPointer, count: int, value: float = 0.0) -> None:
        """target[:count] = value."""
        with self.routine.loop(as_value(count, "integer")) as i:
            self.routine.store(target, i, value)

    @contextmanager
    def each_column_where(self, marks: ArrayPointer) -> Iterator[RoutineValue]:
        """Loop over the columns with marks (k,) that are not zero."""
        with self.each_column() as j, self.routine.if_then(marks[j] > 0.0):
            yield j


def add_stick_slip_routines(program: Program, chart: Chart, machine: MachineFormulas) -> None:
    """Add the routine `find_modes`(geometry, numbers, control, refs, state).

    It sets the modes among the numbers and stops joints at rest in the state; 1 if the mass matrix
    is definite, else 0.

    Args:
        program: A program.
        chart: The machine with k joints that have stiction.
        machine: Its formulas, on a tape of their own.
    """
    columns, closure = chart.stick_slip.columns, chart.machine.closure
    active, state_layout = closure.active.tolist(), chart.state_layout
    n, k, times = len(active), len(columns), closure.characteristic_time / closure.units
    parts = machine.stiction_problem(times[columns].tolist())
    problem = program.add_formula("stiction", 5, parts)
    active_of_joint = [active.index(x) if x in active else None for x in columns]
    _add_least_squares(program, n, k)
    _add_bounded_least_squares(program, n, k)
    arrays = ("geometry", "numbers", "control", "refs", "state")
    with program.add_routine("find_modes", arrays=arrays) as r:
        m = _ColumnLoops(r, n, k)
        found = r.local_array("problem", problem)
        arguments = r.geometry, r.numbers, r.control, r.refs, r.state
        r.call("stiction", *arguments, found)
        with r.if_then(~(found["size"] < np.inf)):
            r.return_value(0)
        resting = r.local_array("resting", k)
        resting_count = r.new_variable(0)
        *places, moving = chart.dynamics.formula_structure.stick_slip_mode_indices
        for joint in range(k):  # rounding moves held ones
            is_held = r.numbers[places[3 * joint + 1]] > 0.0
            limit = select(is_held, MAX_VELOCITY_CHANGE, REST_VELOCITY)
            r.store(resting, joint, 0.0)
            with r.if_then(magnitude(found.element_pointer("speeds")[joint]) <= limit):
                r.store(resting, joint, 1.0)
                r.assign(resting_count, resting_count + 1)
        v_a = r.state.element_pointer(state_layout.start_index("v_a"))
        with r.if_then((resting_count > 0) & (found["motion"] > 0.0)):
            _write_stop(m, found, resting, v_a, times[active], active_of_joint)
            r.call("stiction", *arguments, found)
        # modes without joints at rest, in which the forces are evaluated
        for joint in range(k):
            sign = _sign(found.element_pointer("speeds")[joint])
            r.store(r.numbers, places[3 * joint], select(resting[joint] > 0.0, 0.0, sign))
            r.store(r.numbers, places[3 * joint + 1], 0.0)
        r.store(r.numbers, moving, 1.0)
        with r.if_then(resting_count < 1):
            r.return_value(1)
        r.call("stiction", *arguments, found)
        shares, held = r.local_array("shares", k), r.local_array("held", k)
        rank = _write_holding(m, found, resting, shares, held)
        for joint in range(k):
            with r.if_then(resting[joint] > 0.0):
                share = shares[joint]
                below = magnitude(share) < MAX_LIMIT_SHARE
                sign = select(below, select(held[joint] > 0.0, 0.0, share), _sign(share))
                r.store(r.numbers, places[3 * joint], sign)
                r.store(r.numbers, places[3 * joint + 1], held[joint])
        stands = (rank >= n) & ~(found["motion"] > 0.0)
        r.store(r.numbers, moving, select(stands, 0.0, 1.0))
        r.return_value(1)


def _write_stop(
    m: _ColumnLoops,
    found: ArrayPointer,
    resting: ArrayPointer,
    v_a: ArrayPointer,
    rates: Array,
    active_of_joint: list[int | None],
) -> None:
    """Stop the joints at rest by least impulses, unless that changes the motion."""
    r, n = m.routine, m.rows
    directions, inverse = (found.element_pointer(x) for x in ("directions", "inverse_root"))
    momentum, speeds = found.element_pointer("momentum"), found.element_pointer("velocities")
    columns, vector = r.local_array("stopping", m.columns * n), r.local_array("vector", n)
    fitted, unused = r.local_array("fitted", n), r.local_array("unused", m.columns)
    stopped, rate = r.local_array("stopped", n), r.local_array("rates", n)
    is_stopped = r.local_array("is_stopped", m.columns)
    for index, value in enumerate(rates.tolist()):
        r.store(rate, index, value)

    def largest_change(momentum_change: ArrayPointer) -> RoutineValue:
        largest = r.new_variable(0.0)
        with m.each_row() as i:
            change = m.dot(inverse.row_pointer(i, n), momentum_change)
            size = r.new_variable(magnitude(change) * rate[i])
            with r.if_then(~(size <= largest)):
                r.assign(largest, size)
        return largest

    count = r.new_variable(0)
    m.fill(columns, m.columns * n)
    with m.each_column() as j:
        r.store(is_stopped, j, 0.0)
        with r.if_then(resting[j] > 0.0):
            direction = m.column(directions, j)
            size = m.dot(direction, direction)
            r.assign(size, select(size > 1e-300, size, 1e-300))
            m.copy_scaled(vector, speeds[j] / size, direction)
            with r.if_then(largest_change(vector) <= MAX_VELOCITY_CHANGE):
                m.copy_scaled(m.column(columns, j), as_value(1.0, "real"), direction)
                r.store(is_stopped, j, 1.0)
                r.assign(count, count + 1)
    with r.if_then(count > 0):
        threshold = r.local_array("threshold", 1)
        r.store(threshold, 0, RANK_TOLERANCE)
        rank = r.call("least_squares", columns, momentum, threshold, unused, fitted)
        with m.each_row() as i:
            r.store(vector, i, momentum[i] - fitted[i])
        with m.each_row() as i:
            still = select(rank < n, m.dot(inverse.row_pointer(i, n), vector), 0.0)
            r.store(stopped, i, still)
        pairs = [(joint, i) for joint, i in enumerate(active_of_joint) if i is not None]
        for joint, position in pairs:
            with r.if_then(is_stopped[joint] > 0.0):
                r.store(stopped, position, 0.0)
        change = r.new_variable(0.0)
        with m.each_row() as i:
            size = r.new_variable(magnitude(stopped[i] - v_a[i]) * rate[i])
            with r.if_then(~(size <= change)):
                r.assign(change, size)
        with r.if_then(change <= MAX_VELOCITY_CHANGE):
            r.copy(v_a, stopped, n)


def _write_holding(
    m: _ColumnLoops,
    found: ArrayPointer,
    resting: ArrayPointer,
    shares: ArrayPointer,
    held: ArrayPointer,
) -> RoutineValue:
    """Shares (k,) of the breakaway forces, and which joints (k,) are held; returns their rank."""
    r, n, k = m.routine, m.rows, m.columns
    directions, limits = found.element_pointer("directions"), found.element_pointer("limits")
    net, drift = found.element_pointer("net"), found.element_pointer("drift")
    columns, right = r.local_array("holding", k * n), r.local_array("right", n)
    drift_terms, threshold = r.local_array("drift_terms", k), r.local_array("least", 1)
    m.fill(columns, k * n)
    m.fill(drift_terms, k)
    with m.each_column_where(resting) as j:
        m.copy_scaled(m.column(columns, j), limits[j], m.column(directions, j))
        r.store(drift_terms, j, limits[j] * drift[j])
    r.store(threshold, 0, _LEAST_SIZE * max(n, k))
    # the shortest vector x with columns^T x = drift terms
    r.call("transposed_least_squares", columns, drift_terms, threshold, right)
    with m.each_row() as i:
        r.store(right, i, right[i] + net[i])
    r.call("bounded_least_squares", columns, right, threshold, shares)
    # of those below their limits, a set of independent ones
    norms, rank = r.local_array("norms", k), r.new_variable(0)
    with m.each_column() as j:
        r.store(held, j, 0.0)
        size = r.new_variable(magnitude(shares[j]))
        factor = select((resting[j] > 0.0) & (size < MAX_LIMIT_SHARE), size * -1.0 + 1.0, 0.0)
        column = m.column(columns, j)
        m.copy_scaled(column, r.new_variable(factor), column)
        r.store(norms, j, m.dot(column, column))
    with r.loop(as_value(min(n, k), "integer")):
        best, largest = r.new_variable(-1), r.new_variable(0.0)
        with m.each_column() as j, r.if_then((held[j] <= 0.0) & (norms[j] > 0.0)):
            column = m.column(columns, j)
            size = m.dot(column, column)
            with r.if_then(size > largest):
                r.assign(largest, size)
                r.assign(best, j)
        with r.if_then(best < 0):
            r.break_loop()
        with r.if_then(~(largest > norms[best] * RANK_TOLERANCE**2)):
            r.break_loop()
        r.store(held, best, 1.0)
        r.assign(rank, rank + 1)
        chosen = m.column(columns, best)
        with m.each_column() as j, r.if_then(held[j] <= 0.0):
            column = m.column(columns, j)
            share = r.new_variable(m.dot(chosen, column) / largest)
            m.add_multiple(column, r.new_variable(share * -1.0), chosen)
    return rank


def _add_least_squares(program: Program, n: int, k: int) -> None:
    """least_squares(columns, right, threshold, x, fitted) and transposed_least_squares.

    The first finds the shortest x (k,) of least |right - columns x| and `fitted`, columns x (n,),
    and returns the rank; the second the shortest x (n,) of least |right - columns^T x|.
    """
    _add_rotation(program)
    with program.add_routine("orthogonalize", arrays=("columns", "turns")) as r:
        _write_jacobi(_ColumnLoops(r, n, k))
    with program.add_routine(
        "least_squares", arrays=("columns", "right", "threshold", "x", "fitted")
    ) as r:
        m = _ColumnLoops(r, n, k)
        work, turns, least = _write_orthogonal(m)
        rank = r.new_variable(0)
        m.fill(r.x, k)
        m.fill(r.fitted, n)
        with m.each_column() as p:
            column = m.column(work, p)
            size = m.dot(column, column)
            with r.if_then(size > least):
                r.assign(rank, rank + 1)
                factor = r.new_variable(m.dot(column, r.right) / size)
                m.add_multiple(r.fitted, factor, column)
                with m.each_column() as j:
                    r.store(r.x, j, r.x[j] + factor * turns.row_pointer(p, k)[j])
        r.return_value(rank)
    with program.add_routine(
        "transposed_least_squares", arrays=("columns", "right", "threshold", "x")
    ) as r:
        m = _ColumnLoops(r, n, k)
        work, turns, least = _write_orthogonal(m)
        m.fill(r.x, n)
        with m.each_column() as p:
            column = m.column(work, p)
            size = m.dot(column, column)
            with r.if_then(size > least):
                total = r.new_variable(0.0)
                with m.each_column() as j:
                    r.assign(total, total + turns.row_pointer(p, k)[j] * r.right[j])
                m.add_multiple(r.x, r.new_variable(total / size), column)
        r.return_value(1)


def _add_rotation(program: Program) -> None:
    """rotation(products): the rotation that makes two columns orthogonal."""
    tape = Tape()
    alpha, beta, gamma = (tape.load(0, i) for i in range(3))
    ratio = (beta - alpha) / (2.0 * gamma)
    size = apply_function("abs", ratio) + apply_function("sqrt", 1.0 + ratio * ratio)
    tangent = copysign(1.0, ratio) / size
    cosine = 1.0 / apply_function("sqrt", 1.0 + tangent * tangent)
    program.add_formula("rotation", 1, {"cosine": [cosine], "sine": [cosine * tangent]})


def _write_orthogonal(m: _ColumnLoops) -> tuple[ArrayPointer, ArrayPointer, RoutineValue]:
    """Orthogonal combinations of the columns, their factors, and the square of the least size."""
    r, n, k = m.routine, m.rows, m.columns
    work, turns = r.local_array("work", k * n), r.local_array("turns", k * k)
    r.copy(work, r.columns, k * n)
    r.call("orthogonalize", work, turns)
    largest = r.new_variable(0.0)
    with m.each_column() as p:
        column = m.column(work, p)
        size = m.dot(column, column)
        with r.if_then(size > largest):
            r.assign(largest, size)
    return work, turns, r.new_variable(largest * r.threshold[0] * r.threshold[0])


def _write_jacobi(m: _ColumnLoops) -> None:
    """Make the columns orthogonal in place; `turns` (k, k) has the factors of each."""
    r, k = m.routine, m.columns
    products, turn = r.local_array("products", 3), r.local_array("turn", Layout(cosine=1, sine=1))
    m.fill(r.turns, k * k)
    with m.each_column() as p:
        r.store(r.turns.row_pointer(p, k), p, 1.0)

    def rotate(one: ArrayPointer, other: ArrayPointer, count: int) -> None:
        with r.loop(as_value(count, "integer")) as i:
            a, b = r.new_variable(one[i]), r.new_variable(other[i])
            r.store(one, i, turn["cosine"] * a - turn["sine"] * b)
            r.store(other, i, turn["sine"] * a + turn["cosine"] * b)

    with r.loop(as_value(_MAX_SWEEPS, "integer")):
        turned = r.new_variable(0)
        with m.each_column() as p, m.each_column() as q, r.if_then(q > p):
            one, other = m.column(r.columns, p), m.column(r.columns, q)
            alpha, beta, gamma = m.dot(one, one), m.dot(other, other), m.dot(one, other)
            with r.if_then(gamma * gamma > alpha * beta * _NO_ROTATION):
                for index, value in enumerate((alpha, beta, gamma)):
                    r.store(products, index, value)
                r.call("rotation", products, turn)
                rotate(one, other, m.rows)
                rotate(r.turns.row_pointer(p, k), r.turns.row_pointer(q, k), k)
                r.assign(turned, turned + 1)
        with r.if_then(turned < 1):
            r.break_loop()


def _add_bounded_least_squares(program: Program, n: int, k: int) -> None:
    """bounded_least_squares(columns, right, threshold, x): x (k,) within -1 and 1."""
    arrays = ("columns", "right", "threshold", "x")
    with program.add_routine("bounded_least_squares", arrays=arrays) as r:
        m = _ColumnLoops(r, n, k)
        bound, trial = r.local_array("bound", k), r.local_array("trial", k)
        free, rest = r.local_array("free", k * n), r.local_array("rest", n)
        fitted = r.local_array("fitted", n)
        r.call("least_squares", r.columns, r.right, r.threshold, r.x, fitted)
        violated = r.new_variable(0)
        with m.each_column() as j:
            r.store(bound, j, 0.0)
            with r.if_then(magnitude(r.x[j]) > 1.0):
                r.store(bound, j, _sign(r.x[j]))
                r.store(r.x, j, bound[j])
                r.assign(violated, violated + 1)
        with r.if_then(violated < 1):
            r.return_value(1)
        with r.loop(as_value(10 + 4 * k, "integer")):
            r.copy(rest, r.right, n)
            with m.each_column() as j:
                column = m.column(r.columns, j)
                is_free = r.new_variable(select(magnitude(bound[j]) > 0.0, 0.0, 1.0))
                m.copy_scaled(m.column(free, j), is_free, column)
                m.add_multiple(rest, r.new_variable(bound[j] * -1.0), column)
            r.call("least_squares", free, rest, r.threshold, trial, fitted)
            # the part of the way to the trial on which all stay within their bounds
            share, first = r.new_variable(1.0), r.new_variable(-1)
            with m.each_column() as j, r.if_then(magnitude(trial[j]) > 1.0):
                way = (_sign(trial[j]) - r.x[j]) / (trial[j] - r.x[j])
                part = r.new_variable(way)
                with r.if_then((part < share) | (first < 0)):
                    r.assign(share, part)
                    r.assign(first, j)
            with m.each_column() as j, r.if_then(~(magnitude(bound[j]) > 0.0)):
                r.store(r.x, j, r.x[j] + share * (trial[j] - r.x[j]))
            with r.if_then(first >= 0):
                r.store(bound, first, _sign(trial[first]))
                r.store(r.x, first, bound[first])
            with r.if_else():
                released, worst = r.new_variable(-1), r.new_variable(0.0)
                with m.each_row() as i:
                    r.store(rest, i, rest[i] - fitted[i])
                with m.each_column() as j, r.if_then(magnitude(bound[j]) > 0.0):
                    column = m.column(r.columns, j)
                    gradient = r.new_variable(m.dot(column, rest) * bound[j])
                    limit = r.new_variable(gradient * gradient)
                    scale = m.dot(column, column)
                    r.assign(limit, limit - scale * m.dot(r.right, r.right) * _NO_RELEASE**2)
                    with r.if_then((gradient < worst) & (limit > 0.0)):
                        r.assign(worst, gradient)
                        r.assign(released, j)
                with r.if_then(released < 0):
                    r.return_value(1)
                r.store(bound, released, 0.0)
        r.return_value(1)
