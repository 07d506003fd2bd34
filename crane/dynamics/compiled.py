"""Equations of motion and their derivatives in machine code made for one machine."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from crane.closure.bending import Bending
from crane.closure.compiled import Cursor, FastClosure
from crane.closure.traced import Constants, folded
from crane.codegen import Expression, Number, Program, Tape, largest
from crane.codegen.derivative import along
from crane.codegen.program import Bound
from crane.common.samples import Array
from crane.common.threads import PerThread
from crane.dynamics.inertia import Matrix
from crane.dynamics.sensitivity import Sensitivity
from crane.dynamics.traced import Form, Moved, Sweep
from crane.machine import Machine


def _rates(sweep: Sweep, moved: Moved) -> list[Number]:
    return [*sweep.slopes, *moved.a_a, sweep.dissipation, moved.margin]


def _observed(sweep: Sweep, moved: Moved) -> list[Number]:
    return [*moved.friction, sweep.kinetic, sweep.potential, *moved.rest]


FRICTION = " with friction"
MOVES = ("rates", "observation", "resting")  # what depends on `set_modes`, `set_grip`
# What can be asked of a sweep, given a second argument x (n,): a_A for inverse and regressor,
# tau_A for the others.
QUANTITIES: dict[str, Callable[[Sweep, list[Number]], list[Number]]] = {
    "inverse": lambda sweep, x: sweep.inverse(x, friction=False),
    "inverse" + FRICTION: lambda sweep, x: sweep.inverse(x, friction=True),
    "forward": lambda sweep, x: sweep.forward(x, friction=False),
    "forward" + FRICTION: lambda sweep, x: sweep.forward(x, friction=True),
    "mass matrix": lambda sweep, x: [entry for row in sweep.mass for entry in row],
    "bias": lambda sweep, x: [
        b - f for b, f in zip(sweep.inertial_bias, sweep.passive, strict=True)
    ],
    "gravity": lambda sweep, x: sweep.weight,
    "friction": lambda sweep, x: sweep.friction,
    "passive": lambda sweep, x: sweep.passive,
    "energy": lambda sweep, x: [sweep.kinetic, sweep.potential],
    "rates": lambda sweep, x: _rates(sweep, sweep.moved(x, rest=True)),
    "observation": lambda sweep, x: _observed(sweep, sweep.moved(x, rest=True)),
    "resting": lambda sweep, x: sweep.resting(x),
    "statics": lambda sweep, x: sweep.statics,
    "regressor": lambda sweep, x: [entry for row in sweep.regressor(x) for entry in row],
}
_Analytic = Callable[[Sensitivity, list[Number]], tuple[Matrix, Matrix, Matrix]]
_ANALYTIC: dict[str, _Analytic] = {
    "inverse": lambda found, x: (*found.inverse(x), found.mass),
    "forward": lambda found, x: found.forward(x),
}
SLOPES = "slopes of "  # before a quantity: its derivatives by q_A, v_A and the second argument
_FLOAT = np.dtype(np.float64)


class _Memory(NamedTuple):
    """What evaluating a quantity writes.

    Attributes:
        cursor: Where it has got to.
        q: (nq,) the last posture.
        single: Of one sample second argument, v_A and q_A (n,) each, the result (size,), and what
            evaluates it.
    """

    cursor: Cursor
    q: Array
    single: tuple[Array, Array, Array, Array, Bound]


class QuantityCode:
    """One quantity as machine code.

    Args:
        quantity: A key of `QUANTITIES`, perhaps behind `SLOPES`.
        machine: The machine.
        numbers: See `numbers_of`; read when a quantity is asked for.
        pattern: What of them is part of the formulas.
        form: What they depend on besides.

    Attributes:
        size: Length of the result of one sample.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(
        self,
        quantity: str,
        machine: Machine,
        numbers: Array,
        pattern: Array,
        form: Form,
    ):
        fast = self._fast = machine.closure.fast
        self._numbers = numbers
        nq, n = machine.model.nv, len(machine.active)
        key = (quantity, folded(pattern), form)
        if key not in fast.programs:
            fast.programs[key] = fast.kept(
                ("quantity", *key),
                lambda program: _build(program, quantity, fast, pattern, n, form),
            )
        program = self._program = fast.programs[key]
        size = self.size = program.outputs("formula").size
        self._shape = (n,)

        def memory() -> _Memory:
            cursor, q, target = fast.cursor(), np.zeros(nq), np.zeros(n)
            inputs, out = np.zeros(2 * n), np.zeros(size)
            arrays = (fast.geometry.numbers, numbers, target, inputs, cursor.at, q, out)
            once = program.bound("once", fast.address, *arrays, fast.bounds)
            return _Memory(cursor, q, (inputs[n:], inputs[:n], target, out, once))

        self._memory = PerThread(memory)

    @property
    def cursor(self) -> Cursor:
        """Where this thread has got to."""
        return self._memory.own.cursor

    def one(self, q_a: Any, v_a: Any, x: Any) -> Array | None:
        """The quantity of one sample without delay, or None where arguments need a closer look.

        Args:
            q_a: (n,).
            v_a: (n,), or None where the quantity does not ask for it.
            x: Likewise.
        """
        shape = self._shape
        second, first, target, out, once = self._memory.own.single
        for buffer, array in ((second, x), (first, v_a), (target, q_a)):
            if array is not None:
                if (
                    array.__class__ is not np.ndarray
                    or array.shape != shape
                    or array.dtype != _FLOAT
                ):
                    return None
                buffer[:] = array
        return out.copy() if once() == 1 else None

    def at(self, q: Array, inputs: Array) -> Array:
        """The quantity at one closed posture (nq,), inputs [v_A, x] (2 n,)."""
        out = np.empty(self.size)
        geometry = self._fast.geometry.numbers
        self._program.call("formula", geometry, self._numbers, q, inputs, out)
        return out

    def each(self, targets: Array, inputs: Array, out: Array) -> int:
        """The quantity at q_A (N, n) with inputs (N, 2 n), until one is too far from the last.

        Returns:
            How many were done.
        """
        fast, memory = self._fast, self._memory.own
        arrays = (fast.geometry.numbers, self._numbers, targets, inputs, memory.cursor.at)
        return self._program.call(
            "each", len(targets), fast.address, *arrays, memory.q, out, fast.bounds
        )

    def along(self, q: Array, inputs: Array, out: Array) -> None:
        """The quantity at closed postures (N, nq) with inputs (N, 2 n) into out (N, size)."""
        geometry = self._fast.geometry.numbers
        self._program.call("along", len(q), geometry, self._numbers, q, inputs, out)


def _build(
    program: Program,
    quantity: str,
    fast: FastClosure,
    numbers: Array,
    n: int,
    form: Form,
) -> None:
    tape = Tape()
    q, posture, loops = fast.trace(tape, 0, 2)
    constants = Constants(tape, 1, numbers)
    v_a, x = tape.loads(3, 0, n), tape.loads(3, n, n)
    modes, of = quantity in MOVES, quantity.removeprefix(SLOPES)
    geometry = fast.geometry
    holonomic = not geometry.flyers and form.carriers == geometry.parents
    plain = of.removesuffix(FRICTION)
    if of != quantity and plain in _ANALYTIC and holonomic:
        bending = Bending(posture, loops, fast.clusters, v_a)
        sweep = Sweep(posture, loops, constants, q, v_a, form, drift=bending.drift)
        matrices = _ANALYTIC[plain](Sensitivity(sweep, bending, of != plain), x)
        outputs = [entry for matrix in matrices for row in matrix for entry in row]
    else:
        sweep = Sweep(posture, loops, constants, q, v_a, form, modes)
        if modes:
            sweep = sweep.gripped(sweep.told)
        outputs = QUANTITIES[of](sweep, x)
        if of != quantity:
            outputs = _slopes(sweep, outputs, x)
    program.add("formula", 4, outputs)
    tape = Tape()  # what is not finite is left to the checks that name it
    program.add("scan", 2, [largest([*tape.loads(0, 0, n), *tape.loads(1, 0, 2 * n)])])
    _add_loop(program, len(q), n)


class NamedCode:
    """Derivatives of one quantity by numbers of the machine, as machine code.

    With numbers p of the machine, and phi(q, p) = 0 of its loops, at given q_A, v_A and second
    argument,

        d y / d p = dy/dp + dy/dq dq/dp,    J_P dq_P/dp = -dphi/dp.

    Args:
        quantity: A key of `QUANTITIES`.
        machine: The machine.
        numbers: See `numbers_of`.
        pattern: What of them is part of the formulas.
        form: What the formulas depend on besides.
        geometry: (k, .) how the geometry's numbers change with each number of the machine.
        slopes: (k, .) how `numbers` do.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(
        self,
        quantity: str,
        machine: Machine,
        numbers: Array,
        pattern: Array,
        form: Form,
        geometry: Array,
        slopes: Array,
    ):
        fast = self._fast = machine.closure.fast
        self._numbers, self._geometry, self._slopes = numbers, geometry, slopes
        bent, moved = np.any(geometry != 0, axis=0), np.any(slopes != 0, axis=0)
        folds = np.where(bent, np.nan, fast.geometry.numbers), np.where(moved, np.nan, pattern)
        key = ("named", quantity, *map(folded, folds), bent.tobytes(), moved.tobytes(), form)
        n = len(machine.active)

        def build(program: Program) -> None:
            tape = Tape()
            q, posture, loops = fast.trace(tape, 0, 2, folds[0])
            constants, v_a = Constants(tape, 1, folds[1]), tape.loads(3, 0, n)
            sweep = Sweep(posture, loops, constants, q, v_a, form)
            values = QUANTITIES[quantity](sweep, tape.loads(3, n, n))
            seeds: dict[int, Number] = {}
            for i in np.flatnonzero(bent).tolist():
                seeds[tape.load(0, i).index] = tape.load(4, i)
            opened = along([row.phi for row in loops.rows], seeds)
            held: dict[int, list[Number]] = {joint: [0.0] for joint in loops.active_joints}
            moving, _ = loops.solve(held, [[-1.0 * x] for x in opened])
            seeds |= {_index(q[i - 1]): rate for i, (rate,) in moving.items()}
            for i in np.flatnonzero(moved).tolist():
                seeds[tape.load(1, i).index] = tape.load(5, i)
            program.add("formula", 6, along(values, seeds))

        if key not in fast.programs:
            fast.programs[key] = fast.kept(key, build)
        self._program = fast.programs[key]
        self.size = self._program.outputs("formula").size

    def at(self, q: Array, inputs: Array) -> Array:
        """(size, k) at one closed posture (nq,), inputs [v_A, x] (2 n,)."""
        out = np.empty((len(self._slopes), self.size))
        geometry = self._fast.geometry.numbers
        for row, bent, moved in zip(out, self._geometry, self._slopes, strict=True):
            self._program.call("formula", geometry, self._numbers, q, inputs, bent, moved, row)
        return out.T


def _slopes(sweep: Sweep, values: list[Number], x: list[Number]) -> list[Number]:
    """Derivatives (3, k, n) of values (k,) by q_A, v_A and x."""
    n = len(x)
    seeds = [dict(zip(map(_index, sweep.q), sweep.way(k), strict=True)) for k in range(n)]
    for entry in (*sweep.v_a, *x):
        seeds.append({_index(entry): 1.0})
    columns = [along(values, seed) for seed in seeds]
    return [
        columns[n * part + k][i] for part in range(3) for i in range(len(values)) for k in range(n)
    ]


def _index(loaded: Number) -> int:
    """Of a number that was loaded."""
    assert isinstance(loaded, Expression)
    return loaded.index


def _add_loop(program: Program, nq: int, n: int) -> None:
    """each: close the loops sample by sample and evaluate there; once: the same of one sample.

    along: evaluate at postures that are closed already.

    Like `follow` of `FastClosure`, it stops at the first sample that is too far from the one
    before it.
    """
    arrays = ("geometry", "numbers", "targets", "inputs", "at", "q", "out", "bounds")
    outputs = program.outputs("formula").size
    with program.routine("each", counts=("count",), functions=("follow",), arrays=arrays) as r:
        with r.loop(r.count) as i:
            target = r.targets.row(i, n)
            got = r.call("follow", 1, r.geometry, target, r.at, r.q, r.bounds)
            with r.when(got < 1):
                r.give(i)
            out = r.out.row(i, outputs)
            r.call("formula", r.geometry, r.numbers, r.q, r.inputs.row(i, 2 * n), out)
        r.give(r.count)
    closed = ("geometry", "numbers", "postures", "inputs", "out")
    with program.routine("along", counts=("count",), arrays=closed) as r:
        with r.loop(r.count) as i:
            q, inputs, out = r.postures.row(i, nq), r.inputs.row(i, 2 * n), r.out.row(i, outputs)
            r.call("formula", r.geometry, r.numbers, q, inputs, out)
        r.give(r.count)
    with program.routine("once", functions=("follow",), arrays=arrays) as r:
        scanned = r.array("scanned", program.outputs("scan"))
        r.call("scan", r.targets, r.inputs, scanned)
        with r.when(~(scanned["all"] < np.inf)):
            r.give(0)
        r.give(
            r.call(
                "each", 1, r.follow, r.geometry, r.numbers, r.targets, r.inputs, r.at, r.q, r.out,
                r.bounds,
            )
        )  # fmt: skip
