"""Equations of motion in machine code made for one machine."""

from collections.abc import Callable
from typing import Any

import numpy as np

from crane.closure.compiled import FastClosure
from crane.closure.traced import Constants, folded
from crane.codegen import Number, Program, Tape, largest
from crane.common.samples import Array
from crane.dynamics.recursion import Plan
from crane.dynamics.traced import Moved, Spans, Sweep
from crane.machine import Machine


def _rates(sweep: Sweep, moved: Moved) -> list[Number]:
    return [*sweep.slopes, *moved.a_a, sweep.dissipation, moved.margin]


def _observed(sweep: Sweep, moved: Moved) -> list[Number]:
    return [*moved.friction, sweep.kinetic, sweep.potential, *moved.rest]


MOVES = ("rates", "observation", "resting")  # what depends on `JointForces.set_modes`
# What can be asked of a sweep, given a second argument x (n,): a_A for inverse and regressor,
# tau_A for the others.
QUANTITIES: dict[str, Callable[[Sweep, list[Number]], list[Number]]] = {
    "inverse": lambda sweep, x: sweep.inverse(x, friction=False),
    "inverse with friction": lambda sweep, x: sweep.inverse(x, friction=True),
    "forward": lambda sweep, x: sweep.forward(x, friction=False),
    "forward with friction": lambda sweep, x: sweep.forward(x, friction=True),
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
    "regressor": lambda sweep, x: [entry for row in sweep.regressor(x) for entry in row],
}
_FLOAT = np.dtype(np.float64)


class QuantityCode:
    """One quantity as machine code.

    Args:
        quantity: A key of `QUANTITIES`.
        machine: The machine.
        numbers: See `numbers_of`; read when a quantity is asked for.
        pattern: What of them is part of the formulas.
        carriers: See `crane.dynamics.formulation`.
        plan: See `crane.dynamics.recursion`.
        spans: See `crane.dynamics.traced.spans_of`.
        sticking: Of `JointForces`.

    Attributes:
        size: Length of the result of one sample.
        cursor: Where it has got to.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(
        self,
        quantity: str,
        machine: Machine,
        numbers: Array,
        pattern: Array,
        carriers: tuple[int, ...],
        plan: Plan,
        spans: Spans,
        sticking: tuple[int, ...],
    ):
        fast = self._fast = machine.closure.fast
        self._numbers = numbers
        nq, n = machine.model.nv, len(machine.active)
        key = (quantity, folded(pattern), carriers, plan, spans, sticking)
        if key not in fast.programs:
            fast.programs[key] = fast.kept(
                ("quantity", *key),
                lambda program: _build(
                    program, quantity, fast, pattern, n, carriers, plan, spans, sticking
                ),
            )
        self._program = program = fast.programs[key]
        self.size = program.outputs("formula").size
        self.cursor = fast.cursor()
        self._q, self._out = np.zeros(nq), np.zeros(self.size)
        self._target, self._input = np.zeros(n), np.zeros(2 * n)
        self._first, self._second = self._input[:n], self._input[n:]
        self._shape = (n,)
        self._once = program.bound("once", *self._arguments(self._target, self._input, self._out))

    def one(self, q_a: Any, v_a: Any, x: Any) -> Array | None:
        """The quantity of one sample without delay, or None where arguments need a closer look.

        Args:
            q_a: (n,).
            v_a: (n,), or None where the quantity does not ask for it.
            x: Likewise.
        """
        shape = self._shape
        for buffer, array in ((self._second, x), (self._first, v_a), (self._target, q_a)):
            if array is not None:
                if (
                    array.__class__ is not np.ndarray
                    or array.shape != shape
                    or array.dtype is not _FLOAT
                ):
                    return None
                buffer[:] = array
        return self._out.copy() if self._once() == 1 else None

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
        arguments = self._arguments(targets, inputs, out)
        return self._program.call("each", len(targets), *arguments)

    def along(self, q: Array, inputs: Array, out: Array) -> None:
        """The quantity at closed postures (N, nq) with inputs (N, 2 n) into out (N, size)."""
        geometry = self._fast.geometry.numbers
        self._program.call("along", len(q), geometry, self._numbers, q, inputs, out)

    def _arguments(self, targets: Array, inputs: Array, out: Array) -> tuple[int | Array, ...]:
        fast = self._fast
        arrays = (fast.geometry.numbers, self._numbers, targets, inputs)
        return (fast.address, *arrays, self.cursor.at, self._q, out, fast.bounds)


def _build(
    program: Program,
    quantity: str,
    fast: FastClosure,
    numbers: Array,
    n: int,
    carriers: tuple[int, ...],
    plan: Plan,
    spans: Spans,
    sticking: tuple[int, ...],
) -> None:
    tape = Tape()
    q, posture, loops = fast.trace(tape, 0, 2)
    constants = Constants(tape, 1, numbers)
    v_a = tape.loads(3, 0, n)
    modes = quantity in MOVES
    sweep = Sweep(posture, loops, constants, q, v_a, carriers, plan, spans, sticking, modes)
    outputs = QUANTITIES[quantity](sweep, tape.loads(3, n, n))
    program.add("formula", 4, outputs)
    tape = Tape()  # what is not finite is left to the checks that name it
    program.add("scan", 2, [largest([*tape.loads(0, 0, n), *tape.loads(1, 0, 2 * n)])])
    _add_loop(program, len(q), n)


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
