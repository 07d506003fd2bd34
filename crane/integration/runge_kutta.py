"""Steps of the classical Runge-Kutta method in machine code."""

from ctypes import c_int64, c_void_p

import numpy as np

from crane.closure.traced import Constants, folded
from crane.control import Traced, TracedController
from crane.dynamics import Dynamics
from crane.dynamics.traced import Sweep
from crane.samples import Array
from crane.straight import Program, Tape, largest
from crane.straight.scalar import add, dot, scale

# State: q (nq), v_A (n), the controller's (k), work, dissipated energy.
# observe gives the state's rate and then [tau, friction, kinetic, potential]; finish the next
# state and by how much a joint moves at most; close_loops see `FastClosure`.
_RUN = """
define i64 @run(i64 %steps, ptr %close_loops, ptr %geometry, ptr %numbers, ptr %control, ptr %refs,
                ptr %state, ptr %work, ptr %out, ptr %h, ptr %bounds) {{
entry:
  %next = getelementptr double, ptr %work, i64 0
  %peak_at = getelementptr double, ptr %work, i64 {size}
  %k1 = getelementptr double, ptr %peak_at, i64 1
  %seen = getelementptr double, ptr %k1, i64 {size}
  %k2 = getelementptr double, ptr %seen, i64 {seen}
  %k3 = getelementptr double, ptr %k2, i64 {size}
  %k4 = getelementptr double, ptr %k3, i64 {size}
  %result = getelementptr double, ptr %k4, i64 {size}
  %half = getelementptr double, ptr %h, i64 1
  br label %step
step:
  %i = phi i64 [0, %entry], [%i1, %accept]
  %more = icmp slt i64 %i, %steps
  br i1 %more, label %stages, label %done
stages:
  %r0 = mul i64 %i, {two_refs}
  %ref0 = getelementptr double, ptr %refs, i64 %r0
  %ref1 = getelementptr double, ptr %ref0, i64 {refs}
  %ref2 = getelementptr double, ptr %ref1, i64 {refs}
  call void @observe(ptr %geometry, ptr %numbers, ptr %control, ptr %ref0, ptr %state, ptr %k1)
  %o0 = mul i64 %i, {row}
  %o = getelementptr double, ptr %out, i64 %o0
  %o1 = getelementptr double, ptr %o, i64 {size}
  call void @llvm.memcpy.p0.p0.i64(ptr %o, ptr %state, i64 {size_bytes}, i1 false)
  call void @llvm.memcpy.p0.p0.i64(ptr %o1, ptr %seen, i64 {seen_bytes}, i1 false)
  call void @blend(ptr %state, ptr %k1, ptr %half, ptr %next)
  call void @rate(ptr %geometry, ptr %numbers, ptr %control, ptr %ref1, ptr %next, ptr %k2)
  call void @blend(ptr %state, ptr %k2, ptr %half, ptr %next)
  call void @rate(ptr %geometry, ptr %numbers, ptr %control, ptr %ref1, ptr %next, ptr %k3)
  call void @blend(ptr %state, ptr %k3, ptr %h, ptr %next)
  call void @rate(ptr %geometry, ptr %numbers, ptr %control, ptr %ref2, ptr %next, ptr %k4)
  call void @finish(ptr %state, ptr %k1, ptr %k2, ptr %k3, ptr %k4, ptr %h, ptr %next)
  %peak = load double, ptr %peak_at
  %calm = fcmp olt double %peak, 1.0
  br i1 %calm, label %close, label %done
close:
  %got = call i64 %close_loops(ptr %geometry, ptr %next, ptr %result, ptr %bounds)
  %ok = icmp eq i64 %got, 1
  br i1 %ok, label %accept, label %done
accept:
  call void @llvm.memcpy.p0.p0.i64(ptr %state, ptr %next, i64 {size_bytes}, i1 false)
  %i1 = add i64 %i, 1
  br label %step
done:
  ret i64 %i
}}
"""


class CompiledStepper:
    """Many steps at once in machine code, with a controller that is traced along.

    Args:
        dynamics: The machine.
        control: Its controller.
        states: Number of the controller's states.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(self, dynamics: Dynamics, control: TracedController, states: int):
        machine = dynamics.machine
        self._fast, self._numbers = machine.closure.fast, dynamics.numbers
        self._carriers = dynamics.carriers
        self._control = control
        nq, n = machine.model.nq, len(machine.active)
        self._size, self._seen = nq + n + states + 2, 2 * n + 2
        key = (
            type(control),
            control.columns,
            len(control.settings),
            states,
            folded(self._numbers),
            dynamics.carriers,
        )
        if key not in self._fast.programs:
            self._fast.programs[key] = self._compile(nq, n, states)
        self._program = self._fast.programs[key]
        self._run = self._program.function("run", c_int64, *[c_void_p] * 10, result=c_int64)
        self._work = np.zeros(5 * self._size + self._seen + 4 + 2 * nq * (n + 1))

    def _compile(self, nq: int, n: int, states: int) -> Program:
        program, control = Program(), self._control
        for name in ("observe", "rate"):
            tape = Tape()
            q, posture, loops = self._fast.trace(tape, 0, 4)
            v_a, own = tape.loads(4, nq, n), tape.loads(4, nq + n, states)
            constants = Constants(tape, 1, self._numbers)
            sweep = Sweep(posture, loops, constants, q, v_a, self._carriers)
            settings = tape.loads(2, 0, len(control.settings))
            reference = tape.loads(3, 0, control.columns)
            tau, own_rate = control.trace(Traced(sweep, q, v_a, own, settings, reference))
            a_a = sweep.forward(tau, friction=True)
            powers = [dot(tau, v_a), sweep.dissipation]
            outputs = [*sweep.rates[1:], *a_a, *own_rate, *powers]
            if name == "observe":
                outputs += [*tau, *sweep.friction, sweep.kinetic, sweep.potential]
            program.add(name, 5, outputs)
        self._add_sums(program, nq)
        program.add_text(
            _RUN.format(
                size=self._size,
                seen=self._seen,
                row=self._size + self._seen,
                size_bytes=8 * self._size,
                seen_bytes=8 * self._seen,
                refs=control.columns,
                two_refs=2 * control.columns,
            )
        )
        program.compile()
        return program

    def run(self, times: Array, state: Array, step: float, out: Array) -> int:
        """Steps from the first of `times` on, one row of `out` before each.

        Args:
            times: (steps,) [s].
            state: The state at the first time; replaced by that after the last step done.
            step: [s].
            out: (steps, size + seen), state and observations at each of the times.

        Returns:
            How many steps were done; the one after them needs a closer look.
        """
        halves = times[0] + 0.5 * step * np.arange(2 * len(times) + 1)
        references = np.ascontiguousarray(self._control.references(halves))
        settings = np.ascontiguousarray(self._control.settings)
        steps = np.array([step, 0.5 * step])
        arrays = (self._fast.geometry.numbers, self._numbers, settings, references)
        return int(
            self._run(
                len(times), self._fast.close_address, *(array.ctypes.data for array in arrays),
                state.ctypes.data, self._work.ctypes.data, out.ctypes.data, steps.ctypes.data,
                self._fast.bounds.ctypes.data,
            )
        )  # fmt: skip

    def _add_sums(self, program: Program, nq: int) -> None:
        """blend(s, k, h) = s + h k; finish(s, k1, k2, k3, k4, h) = s + h/6 (...), largest move."""
        tape = Tape()
        state, rate = tape.loads(0, 0, self._size), tape.loads(1, 0, self._size)
        program.add("blend", 3, add(state, scale(tape.load(2, 0), rate)))
        tape = Tape()
        state = tape.loads(0, 0, self._size)
        k1, k2, k3, k4 = (tape.loads(array, 0, self._size) for array in range(1, 5))
        h = tape.load(5, 0)
        mean = add(k1, scale(2.0, add(k2, k3)), k4)
        after = add(state, scale(h * (1.0 / 6.0), mean))
        # the largest of all changes, so that NaN and infinity anywhere show
        move = h * largest([*k1[:nq], *k2[:nq], *k3[:nq], *scale(1e-9, mean)])
        program.add("finish", 6, [*after, move])
