"""Steps of a Rosenbrock method in machine code, for stiff circuits."""

from ctypes import c_int64, c_void_p

import numpy as np

from crane.closure.traced import Constants, folded
from crane.control import StiffController, Traced
from crane.dynamics import Dynamics
from crane.dynamics.traced import Sweep
from crane.samples import Array
from crane.straight import Expression, Number, Program, Tape, largest, maximum
from crane.straight.derivative import derivatives
from crane.straight.factors import eliminated, loaded, stored, substituted
from crane.straight.scalar import add, apply, dot, minimum, scale, subtract, times

# ROS34PW2 of Rang and Angermann (2005): order 3 with any Jacobian, L-stable, stiffly accurate,
# with an embedded method of order 2.
GAMMA = 4.3586652150845900e-01
ALPHA = np.array([
    [0.0, 0.0, 0.0, 0.0],
    [8.7173304301691801e-01, 0.0, 0.0, 0.0],
    [8.4457060015369423e-01, -1.1299064236484185e-01, 0.0, 0.0],
    [0.0, 0.0, 1.0, 0.0],
])  # fmt: skip
LOWER = np.array([
    [GAMMA, 0.0, 0.0, 0.0],
    [-8.7173304301691801e-01, GAMMA, 0.0, 0.0],
    [-9.0338057013044082e-01, 5.4180672388095326e-02, GAMMA, 0.0],
    [2.4212380706095346e-01, -1.2232505839045147e00, 5.4526025533510214e-01, GAMMA],
])  # fmt: skip
WEIGHTS = np.array([2.4212380706095346e-01, -1.2232505839045147e00, 1.5452602553351020e00, GAMMA])
EMBEDDED = np.array([3.7810903145819369e-01, -9.6042292212423178e-02, 0.5, 2.1793326075422950e-01])
STAGES = len(WEIGHTS)

_RELATIVE = 1e-8  # accuracy of a step, per size of the state
_COORDINATE, _VELOCITY = 1e-11, 1e-9  # accuracy that matters [m], [rad], and per second
_FASTER, _SLOWER, _SAFETY = 6.0, 0.2, 0.9  # change of the step's length from one to the next
_SHORTEST = 1e-9  # part of a recorded step that is given up on

# Recorded steps of length whole = h[0], each in as many parts as their error asks for;
# h[1] is the length to try next. prepare, rate, solve, finish see `StiffStepper`.
_RUN = """
define i64 @run(i64 %steps, ptr %close_loops, ptr %geometry, ptr %numbers, ptr %control, ptr %refs,
                ptr %state, ptr %work, ptr %out, ptr %h, ptr %bounds, ptr %scales) {{
entry:
  %next = getelementptr double, ptr %work, i64 0
  %error_at = getelementptr double, ptr %next, i64 {size}
  %change_at = getelementptr double, ptr %next, i64 {size_1}
  %u = getelementptr double, ptr %next, i64 {size_2}
  %stage = getelementptr double, ptr %u, i64 {all}
  %slope = getelementptr double, ptr %stage, i64 {size}
  %factors = getelementptr double, ptr %slope, i64 {size}
  %result = getelementptr double, ptr %factors, i64 {factors}
  %theta = alloca double
  %part = alloca double
  %whole = load double, ptr %h
  %try_at = getelementptr double, ptr %h, i64 1
  %shortest = fmul double %whole, {shortest}
  br label %step
step:
  %i = phi i64 [0, %entry], [%i1, %recorded]
  %more = icmp slt i64 %i, %steps
  br i1 %more, label %look, label %done
look:
  %r0 = mul i64 %i, {two_refs}
  %ref = getelementptr double, ptr %refs, i64 %r0
  %o0 = mul i64 %i, {row}
  %o = getelementptr double, ptr %out, i64 %o0
  %o1 = getelementptr double, ptr %o, i64 {size}
  call void @llvm.memcpy.p0.p0.i64(ptr %o, ptr %state, i64 {size_bytes}, i1 false)
  call void @observe(ptr %geometry, ptr %numbers, ptr %control, ptr %ref, ptr %state, ptr %o1)
  br label %piece
piece:
  %t = phi double [0.0, %look], [%t, %refuse], [%t1, %accept]
  %left = fsub double %whole, %t
  %try = load double, ptr %try_at
  %nearly = fmul double %left, 0x3FEFFFFFFFFFF000
  %last = fcmp oge double %try, %nearly
  %length = select i1 %last, double %left, double %try
  %enough = fcmp oge double %length, %shortest
  br i1 %enough, label %stages, label %done
stages:
  store double %length, ptr %part
  %begun = fdiv double %t, %whole
  store double %begun, ptr %theta
  call void @prepare(ptr %geometry, ptr %numbers, ptr %control, ptr %ref, ptr %theta, ptr %state,
                     ptr %part, ptr %factors)
{stages}
  call void @finish(ptr %state, ptr %u, ptr %scales, ptr %next)
  %error = load double, ptr %error_at
  %change = load double, ptr %change_at
  %known = fcmp ord double %change, 0.0
  %factor = select i1 %known, double %change, double {slower}
  %wanted = fmul double %length, %factor
  %good = fcmp ole double %error, 1.0
  br i1 %good, label %close, label %refuse
refuse:
  store double %wanted, ptr %try_at
  br label %piece
close:
  %got = call i64 %close_loops(ptr %geometry, ptr %next, ptr %result, ptr %bounds)
  %ok = icmp eq i64 %got, 1
  br i1 %ok, label %accept, label %done
accept:
  call void @llvm.memcpy.p0.p0.i64(ptr %state, ptr %next, i64 {size_bytes}, i1 false)
  ; a last part that was cut short says nothing against the length it was cut from
  %longer = fcmp ogt double %try, %wanted
  %keep = and i1 %last, %longer
  %goal = select i1 %keep, double %try, double %wanted
  store double %goal, ptr %try_at
  %t1 = fadd double %t, %length
  br i1 %last, label %recorded, label %piece
recorded:
  %i1 = add i64 %i, 1
  br label %step
done:
  ret i64 %i
}}
"""
_STAGE = """
  %at{i} = fadd double %t, {moved}
  %share{i} = fdiv double %at{i}, %whole
  store double %share{i}, ptr %theta
  call void @combine{i}(ptr %state, ptr %u, ptr %stage)
  call void @rate(ptr %geometry, ptr %numbers, ptr %control, ptr %ref, ptr %theta, ptr %stage,
                  ptr %slope)
  %u{i} = getelementptr double, ptr %u, i64 {start}
  call void @solve{i}(ptr %slope, ptr %u, ptr %factors, ptr %part, ptr %u{i})
"""


class StiffStepper:
    """Many steps at once in machine code, by a method that stiff circuits do not shorten.

    y' = f(y) is stepped by ROS34PW2 with its own choice of length within each recorded step. The
    Jacobian is exact for the controller's states and for what forces, friction and passive forces
    do to the velocities, and zero for the rest (coordinates, centrifugal forces, integrals):
    the order does not depend on it. In the transformed variables u = sum gamma_ij k_j, stage i
    solves

        (1 / (h gamma) - J) u_i = f(y + sum a_ij u_j) + sum c_ij / h u_j.

    (Hairer and Wanner, Solving Ordinary Differential Equations II, IV.7.)

    Args:
        dynamics: The machine.
        control: Its controller.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(self, dynamics: Dynamics, control: StiffController):
        machine = dynamics.machine
        self._fast, self._numbers = machine.closure.fast, dynamics.numbers
        self._carriers, self._control = dynamics.carriers, control
        self._nq, self._n = machine.model.nq, len(machine.active)
        self._own = len(control.scales)
        self._stiff = int(np.isfinite(control.scales).sum())
        self._size = self._nq + self._n + self._own + 2
        self.seen = 2 * self._n + 2 + len(control.channels)
        key = (
            "stiff",
            type(control),
            control.columns,
            folded(control.settings),
            control.form,
            folded(self._numbers),
            dynamics.carriers,
        )
        if key not in self._fast.programs:
            self._fast.programs[key] = self._compile()
        self._program = self._fast.programs[key]
        self._run = self._program.function("run", c_int64, *[c_void_p] * 11, result=c_int64)
        sizes = self._program.sizes
        room = (3 + STAGES) * self._size + 2 + sizes["prepare"]
        self._work = np.zeros(room + 4 + 2 * self._nq * (self._n + 1))
        self._scales = np.concatenate(
            [
                np.full(self._nq, 1.0 / _COORDINATE),
                np.full(self._n, 1.0 / _VELOCITY),
                1.0 / control.scales,
            ]
        )
        self._lengths = np.zeros(2)

    def run(self, times: Array, state: Array, step: float, out: Array) -> int:
        """See `CompiledStepper.run`."""
        halves = times[0] + 0.5 * step * np.arange(2 * len(times) + 1)
        references = np.ascontiguousarray(self._control.references(halves))
        settings = np.ascontiguousarray(self._control.settings)
        if self._lengths[0] != step:
            self._lengths[:] = step, 0.01 * step
        arrays = (self._fast.geometry.numbers, self._numbers, settings, references)
        return int(
            self._run(
                len(times), self._fast.close_address, *(array.ctypes.data for array in arrays),
                state.ctypes.data, self._work.ctypes.data, out.ctypes.data,
                self._lengths.ctypes.data, self._fast.bounds.ctypes.data,
                self._scales.ctypes.data,
            )
        )  # fmt: skip

    def _trace(self, tape: Tape, state: int, theta: int | None) -> tuple[Sweep, Traced]:
        """The machine at a state, its references between three rows or in one."""
        control, nq, n = self._control, self._nq, self._n
        q, posture, loops = self._fast.trace(tape, 0, state)
        v_a, own = tape.loads(state, nq, n), tape.loads(state, nq + n, self._own)
        constants = Constants(tape, 1, self._numbers)
        sweep = Sweep(posture, loops, constants, q, v_a, self._carriers)
        settings = Constants(tape, 2, control.settings).vector(0, len(control.settings))
        rows = [tape.loads(3, control.columns * row, control.columns) for row in range(3)]
        reference = rows[0]
        if theta is not None:
            # the parabola through the rows at 0, 1/2, 1
            s = tape.load(theta, 0)
            shares = ((2.0 * s - 1.0) * (s - 1.0), 4.0 * s * (1.0 - s), s * (2.0 * s - 1.0))
            reference = [dot(shares, values) for values in zip(*rows, strict=True)]
        return sweep, Traced(sweep, q, v_a, own, settings, reference)

    def _compile(self) -> Program:
        program, control = Program(), self._control
        tape = Tape()
        sweep, at = self._trace(tape, 5, 4)
        tau, own_rate = control.trace(at)
        a_a = sweep.forward(tau, friction=True)
        powers = [dot(tau, at.v_a), sweep.dissipation]
        program.add("rate", 6, [*sweep.rates[1:], *a_a, *own_rate, *powers])
        tape = Tape()
        sweep, at = self._trace(tape, 4, None)
        tau, _ = control.trace(at)
        seen = [*tau, *sweep.friction, sweep.kinetic, sweep.potential, *control.look(at)]
        program.add("observe", 5, seen)
        factors, mass = self._add_prepare(program)
        self._add_sums(program, factors, mass)
        stages = "".join(
            _STAGE.format(
                i=i,
                start=i * self._size,
                moved="0.0" if not ALPHA[i].sum() else f"%moved{i}",
            ).replace(
                f"  %at{i} =",
                f"  %moved{i} = fmul double %length, {_word(ALPHA[i].sum())}\n  %at{i} =",
                1,
            )
            for i in range(STAGES)
        )
        columns = control.columns
        program.add_text(
            _RUN.format(
                size=self._size,
                size_1=self._size + 1,
                size_2=self._size + 2,
                all=STAGES * self._size,
                factors=program.sizes["prepare"],
                row=self._size + self.seen,
                size_bytes=8 * self._size,
                two_refs=2 * columns,
                shortest=_word(_SHORTEST),
                slower=_word(_SLOWER),
                stages=stages,
            )
        )
        program.compile()
        return program

    def _add_prepare(self, program: Program) -> tuple[list[list[Number]], list[list[Number]]]:
        """prepare(..., h): elimination of 1 - h gamma J, rows of the velocities times M_A."""
        tape = Tape()
        sweep, at = self._trace(tape, 5, 4)
        tau, own_rate = self._control.trace(at)
        net = subtract(add(tau, sweep.passive), sweep.friction)
        unknown = [x for x in (*at.state[: self._stiff], *at.v_a) if isinstance(x, Expression)]
        jacobian = derivatives([*own_rate[: self._stiff], *net], unknown)
        reach = GAMMA * tape.load(6, 0)
        matrix = [[-1.0 * (reach * entry) for entry in row] for row in jacobian]
        for i in range(self._stiff):
            matrix[i][i] = matrix[i][i] + 1.0
        for i, row in enumerate(sweep.mass):
            for j, entry in enumerate(row):
                at_row = matrix[self._stiff + i]
                at_row[self._stiff + j] = at_row[self._stiff + j] + entry
        factors = eliminated(matrix)
        program.add("prepare", 7, [*stored(factors), *stored(sweep.mass)])
        return factors, sweep.mass

    def _add_sums(
        self, program: Program, factors: list[list[Number]], mass: list[list[Number]]
    ) -> None:
        """combine(s, u), solve(rate, u, factors, h) of each stage, and finish(s, u, scales)."""
        inverse = np.linalg.inv(LOWER)
        forward = ALPHA @ inverse
        backward = np.diag(np.diag(inverse)) - inverse
        final, second = WEIGHTS @ inverse, EMBEDDED @ inverse
        size, nq, n, stiff = self._size, self._nq, self._n, self._stiff

        def mixed(tape: Tape, array: int, weights: Array) -> list[Number]:
            out: list[Number] = [0.0] * size
            for j, weight in enumerate(weights):
                if weight:
                    out = add(out, scale(float(weight), tape.loads(array, j * size, size)))
            return out

        for i in range(STAGES):
            tape = Tape()
            state = tape.loads(0, 0, size)
            program.add(f"combine{i}", 2, add(state, mixed(tape, 1, forward[i])))
            tape = Tape()
            right = scale(GAMMA * tape.load(3, 0), tape.loads(0, 0, size))
            right = add(right, scale(GAMMA, mixed(tape, 1, backward[i])))
            count = len(stored(factors))
            there = loaded(factors, tape, 2, 0)
            inertia = loaded(mass, tape, 2, count)
            speeds, own = right[nq : nq + n], right[nq + n :]
            x = substituted(there, [*own[:stiff], *times(inertia, speeds)])
            program.add(f"solve{i}", 4, [*right[:nq], *x[stiff:], *x[:stiff], *own[stiff:]])
        tape = Tape()
        state = tape.loads(0, 0, size)
        after = add(state, mixed(tape, 1, final))
        gap = mixed(tape, 1, final - second)
        used = nq + n + stiff
        shares = [
            gap[i] / (1.0 / tape.load(2, i) + _RELATIVE * apply("abs", after[i]))
            for i in range(used)
        ]
        # the integrals count only so far as that NaN and infinity anywhere show
        error = maximum(largest(shares), largest(scale(1e-30, gap[used:])))
        usable = minimum(maximum(error, 1e-9), 1e9)
        change = _SAFETY * apply("exp", (-1.0 / 3.0) * apply("log", usable))
        change = minimum(maximum(change, _SLOWER), _FASTER)
        program.add("finish", 3, [*after, error, change])


def _word(value: float) -> str:
    """A number in LLVM's language."""
    bits = int(np.array(value, dtype=np.float64).view(np.uint64))
    return f"0x{bits:016X}"
