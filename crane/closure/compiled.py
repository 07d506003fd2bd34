"""Closing loops in machine code made for one machine."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from weakref import WeakValueDictionary

import numpy as np

from crane.closure.branch import Posture
from crane.closure.clusters import Cluster, clusters_of
from crane.closure.equations import LoopEquations
from crane.closure.structure import Indices, Structure
from crane.closure.traced import (
    Bodies,
    Constants,
    Loops,
    folded,
    geometry_of,
    largest_share,
)
from crane.codegen import Layout, Number, Program, Tape, largest, maximum
from crane.codegen.scalar import minimum
from crane.common.samples import Array

# All in rad and shares of the machine's size, as `Branch` has them.
_STEEP = 1e3  # an entry of gamma above this is looked at closely by `Branch`
_NEAR = 1e-6  # residual of a guess that is as good as closed
_EVALUATIONS = 8  # of Newton's method, which doubles its digits


@dataclass(frozen=True, eq=False)
class Cursor:
    """Where following a stack has got to; every thread and every formula has its own.

    Attributes:
        at: (nq + entries,) posture and entries of gamma that the next sample starts from.
        entries: Rows (passive joints) and columns of these entries; the others are zero.
    """

    at: Array
    entries: tuple[Indices, Indices]

    def start(self, posture: Posture) -> None:
        """Let the next sample start from a posture."""
        self.at[: len(posture.q)] = posture.q
        self.at[len(posture.q) :] = posture.gamma[self.entries]


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
        far: How much larger than the machine's size is what rounds, see `Branch.far`.

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
        home: Posture,
        far: float,
    ):
        self.geometry = geometry_of(equations)
        self._equations, self._structure = equations, structure
        self._active, self._passive = active, passive
        self._nq, self._n = equations.model.nv, len(active)
        self._entries = self._moving()
        signs = self._signs(home)
        key = self._key(signs)
        shared = _SHARED.get(key)
        if shared is None:
            loops = Program.kept(("loops", key), lambda program: self._build(program, signs))
            shared = _SHARED[key] = _Shared(loops)
        self._shared = shared  # the functions live as long as it
        self._formulas = key
        program, self.programs = shared.loops, shared.programs
        self._loops = program
        self.address = program.address("follow")
        self.close_address = program.address("close")
        self._home = home
        self.bounds = np.array([1e-15 * far, 1e-13 * far, 1e-9])

    def _moving(self) -> tuple[Indices, Indices]:
        """Passive joints and active ones that move them: others of their cluster."""
        rows, columns = [], []
        for cluster in self.clusters:
            joints = np.array(cluster.joints) - 1
            passive = np.flatnonzero(np.isin(self._passive, joints))
            active = np.flatnonzero(np.isin(self._active, joints))
            rows.append(np.repeat(passive, len(active)))
            columns.append(np.tile(active, len(passive)))
        return np.concatenate(rows), np.concatenate(columns)

    @cached_property
    def clusters(self) -> list[Cluster]:
        """Of its joints, each behind the one that carries it."""
        return clusters_of(self._equations)

    @property
    def _pairs(self) -> list[tuple[int, int]]:
        """The same, one by one."""
        rows, columns = self._entries
        return list(zip(rows.tolist(), columns.tolist(), strict=True))

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
            geometry.flyers,
            geometry.frame_bodies,
            folded(geometry.numbers),
            tuple(loop.type for loop in equations.loops),
            structure.surplus.allowed,
            tuple((tuple(rows), tuple(columns)) for rows, columns in structure.blocks),
            *(np.asarray(array).tobytes() for array in arrays),
        )

    def _build(self, program: Program, signs: Array) -> None:
        self.add_newton(program, signs)
        self._add_moves(program)
        self._add_close(program)
        self._add_follow(program)
        self._add_settle(program)
        self._add_gamma(program)

    def kept(self, key: tuple, build: Callable[[Program], None]) -> Program:
        """Further machine code for this machine, see `Program.kept`.

        Args:
            key: What it depends on besides the loops.
            build: Adds formulas and routines.

        Raises:
            TooLongError: It would take too long to compile.
        """
        return Program.kept((self._formulas, key), build)

    def outputs(self, formula: str) -> Layout:
        """Parts of what a formula of the loops' own program writes."""
        return self._loops.outputs(formula)

    def cursor(self) -> "Cursor":
        """A place to follow stacks from, at home."""
        cursor = Cursor(np.empty(self._nq + len(self._entries[0])), self._entries)
        cursor.start(self._home)
        return cursor

    def start_near(self, cursor: "Cursor", q: Array) -> bool:
        """Put a cursor on a posture (nq,) that is closed to 1e-6 or better.

        Returns:
            Whether it is, and on the home branch.
        """
        q = np.ascontiguousarray(q)
        layout = self.outputs("newton")
        result = np.empty(layout.size)
        self._loops.call("newton", self.geometry.numbers, q, result)
        found = layout.view(result)
        if not (found.residual[0] <= _NEAR and found.regular[0] > 0):
            return False
        cursor.at[: self._nq] = q
        cursor.at[self._nq :] = found.gamma
        return True

    def edge(self, q: Array) -> float:
        """The least determinant at a posture (nq,), positive on the home branch."""
        layout = self.outputs("newton")
        result = np.empty(layout.size)
        self._loops.call("newton", self.geometry.numbers, np.ascontiguousarray(q), result)
        return float(layout.view(result).edge[0])

    def follow(self, cursor: "Cursor", targets: Array, out: Array) -> int:
        """Close the loops at targets (N, n) into out (N, nq) until one needs more than a step.

        Returns:
            How many were closed.
        """
        targets = np.ascontiguousarray(targets)
        arrays = (self.geometry.numbers, targets, cursor.at, out, self.bounds)
        return self._loops.call("follow", len(targets), *arrays)

    def settle(self, q: Array) -> int:
        """Close the loops of postures (N, nq) in place, each from itself, until one does not.

        Returns:
            How many were closed.
        """
        return self._loops.call("settle", len(q), self.geometry.numbers, q, self.bounds)

    def gamma(self, q: Array, out: Array) -> int:
        """Evaluate gamma at closed postures (N, nq) into out (N, nv, n), while they are regular.

        Returns:
            How many were done.
        """
        q = np.ascontiguousarray(q)
        return self._loops.call("gammas", len(q), self.geometry.numbers, q, out)

    def trace(
        self, tape: Tape, geometry: int, q: int, folding: Array | None = None
    ) -> tuple[list[Number], Bodies, Loops]:
        """Coordinates, bodies and loops, read from two arguments of a function to be.

        Args:
            tape: Where to.
            geometry: Which argument has the geometry's numbers.
            q: Which has the coordinates.
            folding: The geometry's numbers, NaN where none may become part of the formulas.
        """
        coordinates = tape.loads(q, 0, self._nq)
        numbers = self.geometry.numbers if folding is None else folding
        constants = Constants(tape, geometry, numbers)
        posture = Bodies(self.geometry, constants, coordinates)
        loops = Loops(self._equations, self._structure, self._active, self._passive, posture)
        return coordinates, posture, loops

    def add_newton(self, program: Program, signs: Array) -> None:
        """newton(numbers, q) -> residual, change, regular, steepest, edge, corrected q, gamma.

        regular is positive on the home branch away from its edge, with surplus equations closed;
        steepest is the largest entry of gamma, whose rows are those of passive joints; edge the
        least determinant of a block, with its sign on the home branch.
        """
        q, posture, loops = self.trace(Tape(), 0, 1)
        steps = loops.correction
        long = [not posture.geometry.revolute[joint] for joint in steps]
        corrected = [x + steps.get(i, 0.0) for i, x in enumerate(q, start=1)]
        rows = [loops.gamma[loops.passive_joints[row]][k] for row, k in self._pairs]
        steepest = self._steepest(rows, posture.per_size)
        worst = maximum(steepest - _STEEP, loops.surplus - self._structure.surplus.allowed)
        edge: Number = 1.0
        for sign, determinant in zip(signs, loops.determinants, strict=True):
            edge = minimum(edge, float(sign) * determinant)
        worst = maximum(worst, -1.0 * edge)
        for alignment in loops.alignments:
            worst = maximum(worst, -1.0 * alignment)
        program.add(
            "newton",
            2,
            {
                "residual": [loops.residual],
                "change": [largest_share(list(steps.values()), long, posture.per_size)],
                "regular": [-1.0 * worst],
                "steepest": [steepest],
                "edge": [edge],
                "q": corrected,
                "gamma": rows,
            },
        )

    def _steepest(self, rows: Sequence[Number], per_size: Number) -> Number:
        """The largest entry of gamma."""
        turns = self.geometry.revolute
        powers: dict[int, list[Number]] = {0: [], 1: [], -1: []}  # of a length in an entry
        for (row, k), entry in zip(self._pairs, rows, strict=True):
            one, two = turns[self._passive[row] + 1], turns[self._active[k] + 1]
            powers[int(two) - int(one)].append(entry)
        worst = largest(powers[0])
        if powers[1]:
            worst = maximum(worst, per_size * largest(powers[1]))
        if powers[-1]:
            worst = maximum(worst, largest(powers[-1]) / per_size)
        return worst

    def _add_close(self, program: Program) -> None:
        """Newton's method in place: 1 where it closes the loops on the home branch, else 0.

        A change so small that its square is rounding is the last one.
        """
        arrays = {"numbers": None, "q": None, "result": program.outputs("newton"), "bounds": None}
        with program.routine("close", arrays=arrays) as r:
            q, result = r.q, r.result
            rounded, closed, small = (r.let(r.bounds[i]) for i in range(3))
            before = r.let(np.inf)
            evaluations = r.let(0)
            with r.forever():
                r.call("newton", r.numbers, q, result)
                residual, change = r.let(result["residual"]), r.let(result["change"])
                stalled = (residual <= closed) & (residual > before * 0.25)
                with r.when((residual <= rounded) | stalled):
                    r.leave()
                r.set(evaluations, evaluations + 1)
                with r.when(~((change < 1.0) & (evaluations < _EVALUATIONS))):
                    r.give(0)
                r.copy(q, result.at("q"), self._nq)
                with r.when(change <= small):
                    r.leave()
                r.set(before, residual)
            with r.when(result["regular"] > 0.0):
                r.give(1)
            r.give(0)

    def _add_follow(self, program: Program) -> None:
        """Follow a stack of targets as `Branch` does while one step leads from each to the next.

        Stops where it does not: `Branch` takes that sample. `at` holds [q, gamma] of the last
        sample.
        """
        nq, n = self._nq, self._n
        at = Layout(q=nq, gamma=len(self._pairs))
        arrays = {"numbers": None, "targets": None, "at": at, "out": None, "bounds": None}
        with program.routine("follow", counts=("count",), arrays=arrays) as r:
            guess, verdict = r.array("guess", nq), r.array("verdict", program.outputs("distance"))
            first = r.array("first", program.outputs("predict"))
            result = r.array("result", program.outputs("newton"))
            with r.loop(r.count) as i:
                r.call("predict", r.numbers, r.at, r.targets.row(i, n), first)
                move = r.let(first["move"])
                with r.when(~(move < 1.0)):
                    r.give(i)
                r.copy(guess, first.at("q"), nq)
                closed = r.call("close", r.numbers, guess, result, r.bounds)
                with r.when(closed < 1):
                    r.give(i)
                r.call("distance", r.numbers, first, guess, verdict)
                with r.when(~(verdict["all"] <= move * 0.5 + 0.02)):
                    r.give(i)
                r.copy(r.at, guess, nq)
                r.copy(r.at.at("gamma"), result.at("gamma"), at.parts["gamma"])
                r.copy(r.out.row(i, nq), guess, nq)
            r.give(r.count)

    def _add_settle(self, program: Program) -> None:
        """Close one posture after the other in place, each from itself."""
        arrays = ("numbers", "q", "bounds")
        with program.routine("settle", counts=("count",), arrays=arrays) as r:
            result = r.array("result", program.outputs("newton"))
            with r.loop(r.count) as i:
                closed = r.call("close", r.numbers, r.q.row(i, self._nq), result, r.bounds)
                with r.when(closed < 1):
                    r.give(i)
            r.give(r.count)

    def _add_gamma(self, program: Program) -> None:
        """whole(result of newton) -> gamma of all joints, and `gammas` over postures."""
        tape, n, result = Tape(), self._n, program.outputs("newton")
        at = {pair: result.start("gamma") + i for i, pair in enumerate(self._pairs)}
        rows: list[list[Number]] = [[0.0] * n for _ in range(self._nq)]
        for k, column in enumerate(self._active):
            rows[column][k] = 1.0
        for row, column in enumerate(self._passive):
            for k in range(n):
                if (row, k) in at:
                    rows[column][k] = tape.load(0, at[row, k])
        program.add("whole", 1, [entry for row in rows for entry in row])
        arrays = ("numbers", "q", "out")
        with program.routine("gammas", counts=("count",), arrays=arrays) as r:
            work = r.array("work", result)
            with r.loop(r.count) as sample:
                r.call("newton", r.numbers, r.q.row(sample, self._nq), work)
                with r.when(~(work["regular"] > 0.0)):
                    r.give(sample)
                r.call("whole", work, r.out.row(sample, self._nq * n))
            r.give(r.count)

    def _signs(self, home: Posture) -> Array:
        """Of the blocks' determinants on the home branch."""
        blocks = (
            home.jacobian[np.ix_(rows, self._passive[columns])]
            for rows, columns in self._structure.blocks
        )
        return np.array([np.linalg.slogdet(block)[0] for block in blocks])

    def _add_moves(self, program: Program) -> None:
        """predict(numbers, at, target) -> q, largest move of a passive joint; distance likewise.

        distance(numbers, q, q').
        """
        long = [not self.geometry.revolute[column + 1] for column in self._passive]
        tape = Tape()
        q, n = tape.loads(1, 0, self._nq), self._n
        target = tape.loads(2, 0, n)
        change = [target[k] - q[column] for k, column in enumerate(self._active)]
        moves: list[Number] = [0.0] * len(self._passive)
        for i, (row, k) in enumerate(self._pairs):
            moves[row] = moves[row] + tape.load(1, self._nq + i) * change[k]
        for column, move in zip(self._passive, moves, strict=True):
            q[column] = q[column] + move
        for column, value in zip(self._active, target, strict=True):
            q[column] = value
        move = largest_share(moves, long, self.per_size(tape))
        program.add("predict", 3, {"q": q, "move": [move]})
        tape = Tape()
        one, two = tape.loads(1, 0, self._nq), tape.loads(2, 0, self._nq)
        apart = [one[i] - two[i] for i in self._passive]
        program.add("distance", 3, [largest_share(apart, long, self.per_size(tape))])

    def per_size(self, tape: Tape) -> Number:
        """One over the machine's size, from the numbers as the first argument."""
        return Constants(tape, 0, self.geometry.numbers)[len(self.geometry.numbers) - 1]
