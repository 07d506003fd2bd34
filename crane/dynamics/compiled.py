"""Equations of motion in machine code made for one machine."""

from collections.abc import Callable
from ctypes import c_int64, c_void_p
from typing import Any

import numpy as np

from crane.closure.compiled import FastClosure
from crane.closure.traced import Constants, folded
from crane.dynamics.traced import Sweep
from crane.machine import Machine
from crane.samples import Array
from crane.straight import Number, Program, Tape, largest

# What can be asked of a sweep, given a second argument x (n,): a_A for inverse and regressor,
# tau_A for forward.
QUANTITIES: dict[str, Callable[[Sweep, list[Number]], list[Number]]] = {
    "inverse": lambda sweep, x: sweep.inverse(x, friction=False),
    "inverse with friction": lambda sweep, x: sweep.inverse(x, friction=True),
    "forward": lambda sweep, x: sweep.forward(x, friction=False),
    "forward with friction": lambda sweep, x: sweep.forward(x, friction=True),
    "mass matrix": lambda sweep, x: [entry for row in sweep.mass for entry in row],
    "bias": lambda sweep, x: [b - f for b, f in zip(sweep.bias, sweep.passive, strict=True)],
    "gravity": lambda sweep, x: sweep.weight,
    "friction": lambda sweep, x: sweep.friction,
    "passive": lambda sweep, x: sweep.passive,
    "energy": lambda sweep, x: [sweep.kinetic, sweep.potential],
    "rates": lambda sweep, x: [
        *sweep.rates[1:],
        *sweep.forward(x, friction=True),
        sweep.dissipation,
    ],
    "observation": lambda sweep, x: [*sweep.friction, sweep.kinetic, sweep.potential],
    "regressor": lambda sweep, x: [entry for row in sweep.regressor(x) for entry in row],
}
_FLOAT = np.dtype(np.float64)

# Closes the loops sample by sample and evaluates there; like `follow`, stops at the first sample
# that is too far from the one before it.
_EACH = """
define i64 @each(i64 %count, ptr %follow, ptr %geometry, ptr %numbers, ptr %targets, ptr %inputs,
                 ptr %at, ptr %work, ptr %q, ptr %out, ptr %bounds) {{
entry:
  br label %sample
sample:
  %i = phi i64 [0, %entry], [%i1, %evaluate]
  %more = icmp slt i64 %i, %count
  br i1 %more, label %close, label %done
close:
  %t0 = mul i64 %i, {n}
  %target = getelementptr double, ptr %targets, i64 %t0
  %got = call i64 %follow(i64 1, ptr %geometry, ptr %target, ptr %at, ptr %work, ptr %q,
                          ptr %bounds)
  %ok = icmp eq i64 %got, 1
  br i1 %ok, label %evaluate, label %done
evaluate:
  %x0 = mul i64 %i, {inputs}
  %x = getelementptr double, ptr %inputs, i64 %x0
  %o0 = mul i64 %i, {outputs}
  %o = getelementptr double, ptr %out, i64 %o0
  call void @formula(ptr %geometry, ptr %numbers, ptr %q, ptr %x, ptr %o)
  %i1 = add i64 %i, 1
  br label %sample
done:
  ret i64 %i
}}
define i64 @once(ptr %a) {{
  {loads}
  call void @scan(ptr %v4, ptr %v5, ptr %v9)
  %most = load double, ptr %v9
  %finite = fcmp olt double %most, 0x7FF0000000000000
  br i1 %finite, label %go, label %stop
stop:
  ret i64 0
go:
  %done = call i64 @each(i64 1, {passed})
  ret i64 %done
}}
"""
_LOADS = "\n  ".join(
    f"%p{i} = getelementptr i64, ptr %a, i64 {i}\n  %v{i} = load ptr, ptr %p{i}"
    for i in range(1, 11)
)
_PASSED = ", ".join(f"ptr %v{i}" for i in range(1, 11))


class Formula:
    """One quantity as machine code.

    Args:
        quantity: A key of `QUANTITIES`.
        machine: The machine.
        numbers: See `numbers_of`.
        carriers: See `crane.dynamics.formulation`.

    Attributes:
        size: Length of the result of one sample.
        cursor: Where it has got to.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(self, quantity: str, machine: Machine, numbers: Array, carriers: tuple[int, ...]):
        fast = self._fast = machine.closure.fast
        self._numbers = numbers
        nq, n = machine.model.nq, len(machine.active)
        key = (quantity, folded(numbers), carriers)
        if key not in fast.programs:
            fast.programs[key] = _compile(quantity, fast, numbers, n, carriers)
        self._program = program = fast.programs[key]
        self.size = program.sizes["formula"]
        kinds = [c_int64, *[c_void_p] * 10]
        self._each = program.function("each", *kinds, result=c_int64)
        self._formula = program.function("formula", *[c_void_p] * 5)
        self.cursor = fast.cursor()
        self._q, self._out = np.zeros(nq), np.zeros(self.size)
        self._target, self._input = np.zeros(n), np.zeros(2 * n)
        self._first, self._second = self._input[:n], self._input[n:]
        self._shape = (n,)
        # a single pointer costs a call from Python far less than twelve arguments
        self._once = program.function("once", c_void_p, result=c_int64)
        arguments = self._arguments(self._target[None], self._input[None], self._out[None])
        self._packed = np.array(arguments)
        self._packed_at = self._packed.ctypes.data

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
        return self._out.copy() if self._once(self._packed_at) == 1 else None

    def at(self, q: Array, inputs: Array) -> Array:
        """The quantity at one closed posture (nq,), inputs [v_A, x] (2 n,)."""
        out = np.empty(self.size)
        self._formula(
            self._fast.geometry.numbers.ctypes.data, self._numbers.ctypes.data,
            q.ctypes.data, inputs.ctypes.data, out.ctypes.data,
        )  # fmt: skip
        return out

    def each(self, targets: Array, inputs: Array, out: Array) -> int:
        """The quantity at q_A (N, n) with inputs (N, 2 n), until one is too far from the last.

        Returns:
            How many were done.
        """
        return int(self._each(*self._arguments(targets, inputs, out)))

    def _arguments(self, targets: Array, inputs: Array, out: Array) -> tuple[int, ...]:
        fast = self._fast
        arrays = (fast.geometry.numbers, self._numbers, targets, inputs)
        memory = (self.cursor.at, self.cursor.work, self._q, out, fast.bounds)
        addresses = [array.ctypes.data for array in (*arrays, *memory)]
        return (len(targets), fast.address, *addresses)


def _compile(
    quantity: str, fast: FastClosure, numbers: Array, n: int, carriers: tuple[int, ...]
) -> Program:
    tape = Tape()
    q, posture, loops = fast.trace(tape, 0, 2)
    constants = Constants(tape, 1, numbers)
    sweep = Sweep(posture, loops, constants, q, tape.loads(3, 0, n), carriers)
    outputs = QUANTITIES[quantity](sweep, tape.loads(3, n, n))
    program = Program()
    program.add("formula", 4, outputs)
    tape = Tape()  # what is not finite is left to the checks that name it
    program.add("scan", 2, [largest([*tape.loads(0, 0, n), *tape.loads(1, 0, 2 * n)])])
    program.add_text(
        _EACH.format(n=n, inputs=2 * n, outputs=len(outputs), loads=_LOADS, passed=_PASSED)
    )
    program.compile()
    return program
