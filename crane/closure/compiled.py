"""Closing loops in machine code made for one machine."""

from ctypes import c_int64, c_void_p
from dataclasses import dataclass
from weakref import WeakValueDictionary

import numpy as np

from crane.closure.branch import Posture as ClosedPosture
from crane.closure.equations import LoopEquations
from crane.closure.structure import Indices, Structure
from crane.closure.traced import Constants, Loops, Posture, folded, geometry_of
from crane.samples import Array
from crane.straight import Number, Program, Tape, largest, maximum
from crane.straight.scalar import dot

_STEEP = 1e3  # an entry of gamma above this is looked at closely by `Branch`
_NEAR = 1e-6  # residual of a guess that is as good as closed
_SURPLUS = 1e-9  # residual of redundant equations, likewise

# Newton's method in place: 1 where it closes the loops on the home branch, else 0. newton gives
# [residual, change, regular, corrected q, gamma]. A change so small that its square is rounding is
# the last one.
_CLOSE = """
define i64 @close(ptr %numbers, ptr %q, ptr %result, ptr %bounds) {{
entry:
  %closed_at = getelementptr double, ptr %bounds, i64 1
  %small_at = getelementptr double, ptr %bounds, i64 2
  %rounded = load double, ptr %bounds
  %closed = load double, ptr %closed_at
  %small = load double, ptr %small_at
  %change_at = getelementptr double, ptr %result, i64 1
  %good_at = getelementptr double, ptr %result, i64 2
  %next_at = getelementptr double, ptr %result, i64 3
  br label %newton
newton:
  %k = phi i64 [0, %entry], [%k1, %again]
  %before = phi double [0x7FF0000000000000, %entry], [%residual, %again]
  call void @newton(ptr %numbers, ptr %q, ptr %result)
  %residual = load double, ptr %result
  %tight = fcmp ole double %residual, %rounded
  br i1 %tight, label %judge, label %maybe
maybe:
  %near = fcmp ole double %residual, %closed
  %quarter = fmul double %before, 0.25
  %slow = fcmp ogt double %residual, %quarter
  %stalled = and i1 %near, %slow
  br i1 %stalled, label %judge, label %step
step:
  %change = load double, ptr %change_at
  %fine = fcmp olt double %change, 1.0
  %k1 = add i64 %k, 1
  %time = icmp slt i64 %k1, 8
  %on = and i1 %fine, %time
  br i1 %on, label %again, label %fail
again:
  call void @llvm.memcpy.p0.p0.i64(ptr %q, ptr %next_at, i64 {bytes}, i1 false)
  %last = fcmp ole double %change, %small
  br i1 %last, label %judge, label %newton
judge:
  %good = load double, ptr %good_at
  %regular = fcmp ogt double %good, 0.0
  br i1 %regular, label %pass, label %fail
pass:
  ret i64 1
fail:
  ret i64 0
}}
"""

# Follows a stack of targets as `Branch` does while a single step leads from one to the next, and
# stops where it does not: `Branch` takes that sample. `at` holds [q, gamma] of the last sample.
_FOLLOW = """
define i64 @follow(i64 %count, ptr %numbers, ptr %targets, ptr %at, ptr %work, ptr %out,
                   ptr %bounds) {{
entry:
  %guess = getelementptr double, ptr %work, i64 0
  %first = getelementptr double, ptr %work, i64 {nq}
  %move_at = getelementptr double, ptr %first, i64 {nq}
  %verdict = getelementptr double, ptr %move_at, i64 1
  %result = getelementptr double, ptr %verdict, i64 1
  %next_at = getelementptr double, ptr %result, i64 3
  %gamma_new = getelementptr double, ptr %next_at, i64 {nq}
  %gamma_at = getelementptr double, ptr %at, i64 {nq}
  br label %sample
sample:
  %i = phi i64 [0, %entry], [%i1, %accept]
  %more = icmp slt i64 %i, %count
  br i1 %more, label %begin, label %done
begin:
  %t0 = mul i64 %i, {n}
  %target = getelementptr double, ptr %targets, i64 %t0
  call void @predict(ptr %at, ptr %target, ptr %first)
  %move = load double, ptr %move_at
  %small = fcmp olt double %move, 1.0
  br i1 %small, label %start, label %done
start:
  call void @llvm.memcpy.p0.p0.i64(ptr %guess, ptr %first, i64 {bytes}, i1 false)
  %got = call i64 @close(ptr %numbers, ptr %guess, ptr %result, ptr %bounds)
  %ok = icmp eq i64 %got, 1
  br i1 %ok, label %compare, label %done
compare:
  call void @distance(ptr %first, ptr %guess, ptr %verdict)
  %off = load double, ptr %verdict
  %half = fmul double %move, 0.5
  %bound = fadd double %half, 0.02
  %follows = fcmp ole double %off, %bound
  br i1 %follows, label %accept, label %done
accept:
  call void @llvm.memcpy.p0.p0.i64(ptr %at, ptr %guess, i64 {bytes}, i1 false)
  call void @llvm.memcpy.p0.p0.i64(ptr %gamma_at, ptr %gamma_new, i64 {gamma_bytes}, i1 false)
  %o0 = mul i64 %i, {nq}
  %o = getelementptr double, ptr %out, i64 %o0
  call void @llvm.memcpy.p0.p0.i64(ptr %o, ptr %guess, i64 {bytes}, i1 false)
  %i1 = add i64 %i, 1
  br label %sample
done:
  ret i64 %i
}}
"""


_GAMMAS = """
define i64 @gammas(i64 %count, ptr %numbers, ptr %q, ptr %out, ptr %work) {{
entry:
  %good_at = getelementptr double, ptr %work, i64 2
  br label %sample
sample:
  %i = phi i64 [0, %entry], [%i1, %accept]
  %more = icmp slt i64 %i, %count
  br i1 %more, label %look, label %done
look:
  %q0 = mul i64 %i, {nq}
  %here = getelementptr double, ptr %q, i64 %q0
  call void @newton(ptr %numbers, ptr %here, ptr %work)
  %good = load double, ptr %good_at
  %regular = fcmp ogt double %good, 0.0
  br i1 %regular, label %accept, label %done
accept:
  %o0 = mul i64 %i, {size}
  %o = getelementptr double, ptr %out, i64 %o0
  call void @whole(ptr %work, ptr %o)
  %i1 = add i64 %i, 1
  br label %sample
done:
  ret i64 %i
}}
"""


@dataclass(frozen=True, eq=False)
class Cursor:
    """Where following a stack has got to; every thread and every formula has its own.

    Attributes:
        at: (nq + m n,) posture and passive rows of gamma that the next sample starts from.
        work: Memory to work in.
    """

    at: Array
    work: Array

    def start(self, posture: ClosedPosture) -> None:
        """Let the next sample start from a posture."""
        self.at[: len(posture.q)] = posture.q
        self.at[len(posture.q) :] = posture.gamma.ravel()


class _Shared:
    """Machine code of all machines whose formulas are the same.

    Attributes:
        loops: What closes loops.
        programs: Further machine code, by what it depends on.
    """

    def __init__(self, loops: Program):
        self.loops = loops
        self.programs: dict[tuple, Program] = {}


# As long as one of these machines is in use. Two threads may both make one; either serves.
_SHARED: WeakValueDictionary[tuple, _Shared] = WeakValueDictionary()


class FastClosure:
    """Machine code for the loops of one machine.

    Machines with the same formulas, which may have different numbers in them, share it.

    Args:
        equations: All equations.
        structure: Which of them count.
        active: Columns of the active joints.
        passive: Columns of the others.
        home: The home posture, whose branch is followed.
        size: Of the machine [m], to which tolerances refer.

    Attributes:
        geometry: What the formulas were traced from.
        programs: Further machine code for this machine, by what it depends on.
        bounds: Residuals that count as rounding, and as closed if they no longer fall; a small
            change.
        address: Of the function `follow`, for other machine code to call.
        close_address: Likewise of `close`.
    """

    def __init__(
        self,
        equations: LoopEquations,
        structure: Structure,
        active: Indices,
        passive: Indices,
        home: ClosedPosture,
        size: float,
    ):
        self.geometry = geometry_of(equations)
        self._equations, self._structure = equations, structure
        self._active, self._passive = active, passive
        nq, n, rows = equations.model.nq, len(active), len(passive)
        self._nq, self._n = nq, n
        signs = self._signs(home)
        key = self._key(signs)
        shared = _SHARED.get(key)
        if shared is None:
            shared = _SHARED[key] = _Shared(self._compile(signs))
        self._shared = shared  # the functions live as long as it
        program, self.programs = shared.loops, shared.programs
        kinds = [c_int64, *[c_void_p] * 6]
        self._follow = program.function("follow", *kinds, result=c_int64)
        self._gamma = program.function("gammas", c_int64, *[c_void_p] * 4, result=c_int64)
        self._newton = program.function("newton", *[c_void_p] * 3)
        self.address = program.address("follow")
        self.close_address = program.address("close")
        self._rows = rows
        self._home = home
        self.bounds = np.array([1e-15 * size, 1e-13 * size, 1e-9 * min(1.0, size)])

    def _key(self, signs: Array) -> tuple:
        """All that the formulas depend on."""
        geometry, equations, structure = self.geometry, self._equations, self._structure
        arrays = (
            geometry.turns, equations.axis1, equations.axis2, equations.is_translation,
            equations.loop_of_row, equations.sign, equations.factors, equations.offsets,
            structure.rows, structure.redundant,
            self._active, self._passive, signs,
        )  # fmt: skip
        return (
            geometry.parents,
            geometry.revolute,
            geometry.frame_bodies,
            folded(geometry.numbers),
            tuple(loop.type for loop in equations.loops),
            tuple((tuple(rows), tuple(columns)) for rows, columns in structure.blocks),
            *(np.asarray(array).tobytes() for array in arrays),
        )

    def _compile(self, signs: Array) -> Program:
        nq, n = self._nq, self._n
        program = Program()
        self.add_newton(program, signs)
        self._add_moves(program)
        program.add_text(_CLOSE.format(bytes=8 * nq))
        gamma_bytes = 8 * len(self._passive) * n
        program.add_text(_FOLLOW.format(n=n, nq=nq, bytes=8 * nq, gamma_bytes=gamma_bytes))
        self._add_gamma(program)
        program.compile()
        return program

    def cursor(self) -> "Cursor":
        """A place to follow stacks from, at home."""
        cursor = Cursor(
            np.empty(self._nq + self._rows * self._n),
            np.empty(3 * self._nq + 5 + self._rows * self._n),
        )
        cursor.start(self._home)
        return cursor

    def start_near(self, cursor: "Cursor", q: Array) -> bool:
        """Put a cursor on a posture (nq,) that is closed to 1e-6 or better.

        Returns:
            Whether it is, and on the home branch.
        """
        result = np.empty(3 + len(cursor.at))
        q = np.ascontiguousarray(q)
        self._newton(self.geometry.numbers.ctypes.data, q.ctypes.data, result.ctypes.data)
        residual, _, regular = result[:3]
        if not (residual <= _NEAR and regular > 0):
            return False
        cursor.at[: self._nq] = q
        cursor.at[self._nq :] = result[3 + self._nq :]
        return True

    def follow(self, cursor: "Cursor", targets: Array, out: Array) -> int:
        """Close the loops at targets (N, n) into out (N, nq) until one needs more than a step.

        Returns:
            How many were closed.
        """
        numbers, targets = self.geometry.numbers, np.ascontiguousarray(targets)
        return int(
            self._follow(
                len(targets), numbers.ctypes.data, targets.ctypes.data, cursor.at.ctypes.data,
                cursor.work.ctypes.data, out.ctypes.data, self.bounds.ctypes.data,
            )
        )  # fmt: skip

    def gamma(self, q: Array, out: Array) -> int:
        """Evaluate gamma at closed postures (N, nq) into out (N, nv, n), while they are regular.

        Returns:
            How many were done.
        """
        work = self.cursor().work  # held until the call is over
        numbers, q = self.geometry.numbers, np.ascontiguousarray(q)
        arrays = (numbers, q, out, work)
        return int(self._gamma(len(q), *(array.ctypes.data for array in arrays)))

    def trace(self, tape: Tape, geometry: int, q: int) -> tuple[list[Number], Posture, Loops]:
        """Coordinates, bodies and loops, read from two arguments of a function to be."""
        coordinates = tape.loads(q, 0, self._nq)
        constants = Constants(tape, geometry, self.geometry.numbers)
        posture = Posture(self.geometry, constants, coordinates)
        loops = Loops(self._equations, self._structure, self._active, self._passive, posture)
        return coordinates, posture, loops

    def add_newton(self, program: Program, signs: Array) -> None:
        """newton(numbers, q) -> residual, change, regular, corrected q, passive rows of gamma.

        regular is positive on the home branch away from its edge, with surplus equations closed.
        """
        q, _, loops = self.trace(Tape(), 0, 1)
        steps = loops.correction
        corrected = [x + steps.get(i, 0.0) for i, x in enumerate(q, start=1)]
        rows = [entry for joint in loops.passive_joints for entry in loops.gamma[joint]]
        worst = maximum(largest(rows) - _STEEP, loops.surplus - _SURPLUS)
        for sign, determinant in zip(signs, loops.determinants, strict=True):
            worst = maximum(worst, -(float(sign) * determinant))
        for alignment in loops.alignments:
            worst = maximum(worst, -1.0 * alignment)
        outputs = [loops.residual, largest(steps.values()), -1.0 * worst, *corrected, *rows]
        program.add("newton", 2, outputs)

    def _add_gamma(self, program: Program) -> None:
        """whole(result of newton) -> gamma of all joints, and the loop `gammas` over postures."""
        tape, n = Tape(), self._n
        rows: list[list[Number]] = [[0.0] * n for _ in range(self._nq)]
        for k, column in enumerate(self._active):
            rows[column][k] = 1.0
        for i, column in enumerate(self._passive):
            rows[column] = tape.loads(0, 3 + self._nq + i * n, n)
        program.add("whole", 1, [entry for row in rows for entry in row])
        program.add_text(_GAMMAS.format(nq=self._nq, size=self._nq * n))

    def _signs(self, home: ClosedPosture) -> Array:
        """Of the blocks' determinants on the home branch."""
        blocks = (
            home.jacobian[np.ix_(rows, self._passive[columns])]
            for rows, columns in self._structure.blocks
        )
        return np.array([np.linalg.slogdet(block)[0] for block in blocks])

    def _add_moves(self, program: Program) -> None:
        """predict(at, target) -> q, largest move of a passive joint; distance(q, q')."""
        tape = Tape()
        q, n = tape.loads(0, 0, self._nq), self._n
        target = tape.loads(1, 0, n)
        change = [target[k] - q[column] for k, column in enumerate(self._active)]
        moves = [
            dot(tape.loads(0, self._nq + row * n, n), change) for row in range(len(self._passive))
        ]
        for column, move in zip(self._passive, moves, strict=True):
            q[column] = q[column] + move
        for column, value in zip(self._active, target, strict=True):
            q[column] = value
        program.add("predict", 2, [*q, largest(moves)])
        tape = Tape()
        one, two = tape.loads(0, 0, self._nq), tape.loads(1, 0, self._nq)
        program.add("distance", 2, [largest(one[i] - two[i] for i in self._passive)])
