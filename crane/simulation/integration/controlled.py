"""Steps in machine code of a length that their error chooses: what such methods have in common."""

from abc import abstractmethod
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

import numpy as np

from crane.codegen import Number, Program, Tape, Value, select
from crane.codegen.representation import Array as Place
from crane.codegen.representation import Routine
from crane.codegen.scalar import add, apply, dot, maximum, minimum, scale, with_sign_of
from crane.common.samples import Array
from crane.control import TracedController, ValveDrive
from crane.dynamics.external import states_of
from crane.machine import Machine
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.sticking import NEAR
from crane.simulation.integration.traced import (
    HELD,
    Stepper,
    beyond,
    columns_of,
    references_of,
    wrapped,
)

SPACING = 5e-4  # [s] between the instants that references are known at, at most
LEAST = 0.1  # what is taken for no smaller: rad, machine's size, per `Closure.pace`
ENERGY = 10.0  # times the tolerance, of energies
SLOWER = 0.2  # change of the step's length from one to the next, at least
_ROUND = 2.5  # [rad] of a step, of bodies that float
_ROWS = 1000  # pairs of references of a call
_FOLLOWED = 0.02  # way of a step beyond whose end the loops may not close: rad, machine's size
_AFTER = 0.2  # of a step's length, the first behind an event
_SHORTEST = 1e-9  # part of a recorded step that is given up on
_LEAST, _BISECTED = 0.02, 8  # share of a step that is tried to find an event; trials until halving
_NEARLY = 1.0 - 2.0**-41  # of what is left: all of it
_SAME = 1e-9  # of a recorded step, between instants that are one

Rate = Callable[..., None]
"""Calls a formula by its name, at a time relative to that of `run`, with a state and arrays."""


Way = Callable[[Value, Value], None]
"""Adds what happens from a time on, over a length."""


@dataclass(frozen=True)
class Attempt:
    """What a step is made of, in machine code.

    Attributes:
        r: What it is added to.
        call: See `Rate`.
        first: Rate at its beginning.
        ending: Rate at its end.
        length: (1,) its length.
        following: Outputs of the formula `finish`.
        inside: Outputs of the formula `dense`.
    """

    r: Routine
    call: Rate
    first: Place
    ending: Place
    length: Place
    following: Place
    inside: Place


def energy_of(chart: Chart) -> float:
    """Of a machine as heavy and as fast as this one [J]."""
    closure = chart.machine.closure
    mass = sum(inertia.mass for inertia in chart.machine.model.inertias)
    return float(mass * (closure.size / closure.pace) ** 2)


def errors_of(chart: Chart, states: int, tolerance: float) -> Array:
    """(k + 1,) least errors that matter of all states, and the tolerance they are of.

    Work and dissipation, which nothing depends on, count `ENERGY` times less.
    """
    closure = chart.machine.closure
    rates = closure.units[closure.active] / closure.pace
    energies = np.full(2 + len(chart.machine.external), ENERGY * energy_of(chart))
    shear = np.full(states_of(chart.machine.external), closure.size)
    every = np.concatenate([closure.units, rates, shear, np.ones(states), energies])
    return tolerance * np.append(LEAST * every, 1.0)


def mixed(tape: Tape, array: int, size: int, weights: Array) -> list[Number]:
    """A weighted sum of vectors of some size that are in an argument one after the other."""
    out: list[Number] = [0.0] * size
    for j, weight in enumerate(weights):
        if weight:
            out = add(out, scale(float(weight), tape.loads(array, j * size, size)))
    return out


class ControlledStepper(Stepper):
    """Many steps at once in machine code, with references and recorded instants within them.

    A method writes `_add_method` and `_made`. Steps end at the controller's breaks, those of
    circuits at recorded instants, too: what is between keeps no balance of oil.

    Args:
        chart: The machine.
        control: Its controller.
        states: Number of the controller's states.
        method: What the method's code depends on besides them.
        fold: Whether zeros and ones among the controller's settings become part of the code.
        tolerance: What tells the method which error matters.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(
        self,
        chart: Chart,
        control: TracedController,
        states: int,
        method: tuple[Hashable, ...],
        fold: bool,
        tolerance: Array,
    ):
        self._short = isinstance(control, ValveDrive)
        super().__init__(chart, control, states, method, fold)
        self.tolerance = np.ascontiguousarray(tolerance)
        self._lengths, self._breaks = (
            np.zeros(6),
            np.append(breaks_of(chart.machine, control), np.inf),
        )

    def forget(self) -> None:
        """Begin with a short step, whatever was integrated before."""
        self._lengths[0] = 0.0

    def run(
        self, first: float, state: Array, offset: float, step: float, rows: Array
    ) -> tuple[int, float]:
        """Steps up to the instant behind the last of some that are recorded.

        Args:
            first: The first instant that is recorded [s].
            state: The state; replaced by that where it has got to.
            offset: When that is, after the first instant and at most a step before [s].
            step: [s] between instants.
            rows: (N, .) in any order, filled; none to come to the next instant.

        Returns:
            How many have their row, and when the state is, after the next of them [s]. Fewer than
            all where the next step needs a closer look or other coordinates.
        """
        lengths, pair = self._lengths, min(step, 2.0 * SPACING)
        lengths[5] = 0.0
        if lengths[0] != step:
            lengths[:2] = step, 0.01 * min(step, SPACING)
        functions = [self._fast.close_address]
        if self.asks is not None:
            functions.append(self.asks.address)
        most, done = max(1, int(_ROWS * pair / step)), 0
        out = np.empty((min(most, len(rows)), rows.shape[1]))
        while done < len(rows) or offset < 0:
            count = min(most, len(rows) - done)
            now, begins, ends = first + step * done, offset, count * step
            behind = now + begins + _SAME * step
            ahead = self._breaks[np.searchsorted(self._breaks, behind)] - now
            if isinstance(self._control, ValveDrive) and self._control.period:
                ahead = min(ahead, self._control.jumps(behind) - now)
            if ahead < ends - _SAME * step:
                ends = ahead
            pairs = max(1, int(np.ceil((ends - begins) / pair - _SAME)))
            lengths[2:5] = begins, (ends - begins) / pairs, ends
            made = self._program.call(
                "run", count, *functions, *self._arguments,
                self._references(now + begins, now + ends, pairs), state, out, lengths,
                self.bounds, self.tolerance,
            )  # fmt: skip
            if self.asks is not None:
                self.asks.check()
            rows[done : done + made] = out[:made]
            done, offset = done + made, float(lengths[2])
            left = ends - (made * step + offset)
            if abs(offset) < _SAME * step:
                offset = 0.0
            if lengths[5]:
                lengths[1] *= _AFTER
                break
            if left > _SAME * step:
                lengths[0] = 0.0  # it may have got as short as can be
                break
        return done, offset

    def _references(self, begins: float, ends: float, pairs: int) -> Array:
        """Rows (2 pairs + 1, c) between two times [s], at the ends as between them."""
        grid = np.linspace(begins, ends, 2 * pairs + 1)
        grid[[0, -1]] += _SAME * (grid[1] - begins) * np.array([1.0, -1.0])
        return references_of(self._chart.machine, self._control, grid)

    @property
    def event(self) -> float:
        """Whether a joint starts or stops at the state."""
        return float(self._lengths[5])

    def _build(self, program: Program) -> None:
        for added, rest in self._rests:
            machine, at, tau, _ = self._driven(Tape())
            look = self._control.look(at) if isinstance(self._control, ValveDrive) else []
            seen, margin = machine.observed(tau, rest), machine.moved(tau, rest).margin
            program.add("observe" + added, 5, {"seen": [*seen, *look], "margin": [margin]})
            machine, _, tau, own_rate = self._driven(Tape())
            moved, slopes = machine.moved(tau, rest), machine.sweep.slopes
            shear = machine.outside.rates
            rate = [*slopes, *moved.a_a, *shear, *own_rate, *machine.powers(tau)]
            closure = self._chart.machine.closure
            edges = machine.sweep.edges(closure.units.tolist(), closure.size)
            edges += scale(1.0 / closure.size, machine.outside.edges)
            outputs = {"rate": rate, "margin": [moved.margin], "edges": edges}
            program.add("rate" + added, 5, outputs)
        if self.asks is not None:
            program.add("asked", 5, machine.outside.asked)
            with program.routine("ask", functions=("answer",), arrays=("asked", "outside")) as r:
                r.give(r.call("answer", r.asked, r.outside))
        self._add_edges(program, len(edges))
        # the parabola through rows at 0, 1/2, 1
        tape = Tape()
        s, columns = tape.load(1, 0), self._columns
        rows = [tape.loads(0, columns * row, columns) for row in range(3)]
        shares = ((2.0 * s - 1.0) * (s - 1.0), 4.0 * s * (1.0 - s), s * (2.0 * s - 1.0))
        program.add("reference", 2, [dot(shares, values) for values in zip(*rows, strict=True)])
        self._add_method(program)
        # s + x (c0 + (1 - x) (c1 + x (c2 + ...)))
        tape, size = Tape(), self._state.size
        state, x = tape.loads(0, 0, size), tape.load(2, 0)
        out: list[Number] = [0.0] * size
        for i in reversed(range(program.outputs("dense").size // size)):
            out = add(out, tape.loads(1, i * size, size))
            out = scale(x if i % 2 == 0 else 1.0 - x, out)
        program.add("interpolate", 3, wrapped(self._chart, add(state, out)))
        tape = Tape()
        program.add("wrap", 1, wrapped(self._chart, tape.loads(0, 0, size)))
        self._add_run(program)

    def _shares(
        self, tape: Tape, array: int, one: list[Number], other: list[Number]
    ) -> list[Number]:
        """One over the errors that matter of all states between two, by `errors_of`."""
        out: list[Number] = []
        for i, (x, y) in enumerate(zip(one, other, strict=True)):
            size = maximum(apply("abs", x), apply("abs", y))
            size = size if i < self._state.start("work") else ENERGY * size
            out.append(1.0 / maximum(tape.load(array, i), tape.load(array, len(one)) * size))
        return out

    def _followed(self, error: Number, move: Number) -> Number:
        """An error, above 1 where a floating body turns so far that nobody knows how often."""
        floating = self._chart.machine.coordinates.floating
        return maximum(error, move * (1.0 / _ROUND)) if floating else error

    def _add_edges(self, program: Program, count: int) -> None:
        """sides(rate): the signs of edges; crossed(rate, sides): the least of edge times sign."""
        start = program.outputs("rate").start("edges")
        if not count:
            return
        tape = Tape()
        signs = [with_sign_of(1.0, x) for x in tape.loads(0, start, count)]
        program.add("sides", 1, signs)
        tape = Tape()
        least: Number = 1.0
        for edge, side in zip(tape.loads(0, start, count), tape.loads(1, 0, count), strict=True):
            least = minimum(least, edge * side)
        program.add("crossed", 2, [least])

    @abstractmethod
    def _add_method(self, program: Program) -> None:
        """Add formulas, among them `finish` and `dense`.

        `finish` has the parts state; error, at most 1; change of the length for the next; move.
        `dense` has the c of what is between two states.
        """

    @abstractmethod
    def _made(self, program: Program, step: Attempt) -> tuple[Way, Way]:
        """What makes a step up to `finish`, and what calls `dense` behind one."""

    def _add_run(self, program: Program) -> None:
        """run: steps and recorded instants until an end, or one needs a closer look.

        h: recorded step; length to try; when the state is, after the first instant, and behind,
        after the next one; length of three references; when to end; whether a joint starts or
        stops there.

        A step behind which one has is not made. How long it takes to where the margin is just
        beyond is found by the secant method; steps that fall short are made.
        """
        size, seen, columns = self._state.size, self._seen.size, self._columns
        floating = self._chart.machine.coordinates.floating
        names = ("geometry", "numbers", "control", "refs", "state", "out", "h", "bounds", "tol")
        functions = ("close",) if self.asks is None else ("close", "answer")
        with program.routine("run", counts=("steps",), functions=functions, arrays=names) as r:
            following = r.array("following", program.outputs("finish"))
            first, ending = (r.array(x, program.outputs("rate")) for x in ("first", "ending"))
            looked = r.array("looked", program.outputs("observe"))
            inside = r.array("inside", program.outputs("dense"))
            between = r.array("between", size)
            result = r.array("result", self._fast.outputs("newton"))
            found = r.array("found", self._fast.outputs("newton"))
            theta, part = r.array("theta", 1), r.array("part", 1)
            reference = r.array("reference", max(1, columns))
            machine = r.geometry, r.numbers, r.control, reference
            if self.asks is not None:
                asked = r.array("asked", program.outputs("asked"))
                outside = reference.at(columns_of(self._control))
            whole, pair, end = r.let(r.h[0]), r.let(r.h[3]), r.let(r.h[4])
            t = r.let(r.h[2])
            recorded, due = r.let(0), r.let(0.0)
            base, before = r.let(0), r.let(t)  # the references a step begins among

            def refer(time: Value) -> None:
                """Put the references at a time behind the step's beginning into `reference`."""
                here, begins = r.let(base), r.let(before)
                with r.forever():
                    with r.when(~((time >= begins + pair) & (begins + pair * 1.5 < end))):
                        r.leave()
                    r.set(here, here + 1)
                    r.set(begins, begins + pair)
                r.store(theta, 0, (time - begins) / pair)
                r.call("reference", r.refs.row(here, 2 * columns), theta, reference)

            def call(formula: str, time: Value, *arrays: Place) -> None:
                if columns:
                    refer(time)
                if self.asks is not None:
                    r.call("asked", *machine, arrays[0], asked)
                    r.call("answer", asked, outside)
                self._call(r, formula, *machine, *arrays)

            def stop() -> None:
                r.store(r.h, 2, t - due)
                r.give(recorded)

            step = Attempt(r, call, first, ending, part, following, inside)
            attempt, interpolate = self._made(program, step)
            call("rate", t, r.state, first)
            # where a joint starts or stops, or a stop begins or ends: how far ahead, and margins
            # here and there
            ahead, low, high, tries = r.let(0.0), r.let(1.0), r.let(0.0), r.let(0)
            edges = program.outputs("rate").parts["edges"]
            sides, crossed = r.array("sides", max(1, edges)), r.array("crossed", 1)
            if edges:
                r.call("sides", first, sides)
            if self._sticks:
                r.set(low, first["margin"])
                with r.when(low < -NEAR):
                    r.store(r.h, 5, 1.0)
                    stop()
            with r.forever():
                left, proposed = r.let(end - t), r.let(r.h[1])
                with r.when(~(left > whole * _SHORTEST)):
                    r.leave()
                sure, goal = r.let(0), r.let(end)
                if self._short:
                    r.set(goal, select(due > t + whole * _SHORTEST, due, due + whole))
                    with r.when(goal > end):
                        r.set(goal, end)
                    r.set(left, goal - t)
                if self._sticks:
                    with r.when((r.bounds[HELD] > 0.5) & (proposed > whole)):
                        r.set(proposed, whole)  # what is at rest does not tell how soon it starts
                if self._sticks or edges:
                    with r.when(ahead > 0.0):
                        share = r.let((low + 1.5 * NEAR) / (low - high))
                        with r.when(tries > _BISECTED):
                            r.set(share, 0.5)
                        with r.when(~(share > _LEAST)):
                            r.set(share, _LEAST)
                        with r.when(share > 1.0 - _LEAST):
                            r.set(share, 1.0 - _LEAST)
                        with r.when(ahead < whole * _SHORTEST):  # a margin that jumps
                            r.set(share, 1.0)
                            r.set(sure, 1)
                        r.set(left, ahead * share)
                        r.set(tries, tries + 1)
                last = r.let(proposed >= left * _NEARLY)
                length = r.let(select(last, left, proposed))
                with r.when(~(length >= whole * _SHORTEST) & (ahead <= 0.0)):
                    stop()
                if columns:
                    with r.forever():
                        with r.when(~((t >= before + pair) & (before + pair * 1.5 < end))):
                            r.leave()
                        r.set(base, base + 1)
                        r.set(before, before + pair)
                r.store(part, 0, length)
                attempt(t, length)
                change = following["change"]
                wanted = r.let(length * select(change > 0.0, change, SLOWER))  # NaN: slower
                with r.when(following["error"] <= 1.0):
                    closed = r.call("close", r.geometry, following, result, r.bounds)
                    with r.when(closed < 1):
                        # nearer to where the branch ends, if it does
                        r.store(r.h, 1, length * SLOWER)
                        with r.when(following["move"] < _FOLLOWED):
                            stop()
                    with r.otherwise():
                        call("rate", t + length, following, ending)
                        beyond_it, event = r.let(0), r.let(0)
                        worst = r.let(1.0)
                        if self._sticks:
                            r.set(worst, ending["margin"])
                            with r.when(worst < -NEAR):
                                r.set(event, 1)
                        if edges:
                            r.call("crossed", ending, sides, crossed)
                            with r.when(crossed[0] < worst):
                                r.set(worst, crossed[0])
                        if self._sticks or edges:
                            with r.when((worst < -2.0 * NEAR) & (sure < 1)):
                                r.set(beyond_it, 1)
                                r.set(event, 0)
                                r.set(ahead, length)
                                r.set(high, worst)
                        count, since = r.let(recorded), r.let(due)
                        with r.when((beyond_it < 1) & (due < (t + length) * _NEARLY)):
                            interpolate(t, length)
                        with r.forever():
                            with r.when((beyond_it > 0) | ~(due < (t + length) * _NEARLY)):
                                r.leave()
                            row = r.out.row(recorded, size + seen)
                            r.store(theta, 0, (due - t) / length)
                            r.call("interpolate", r.state, inside, theta, between)
                            closed = r.call("close", r.geometry, between, found, r.bounds)
                            with r.when(closed < 1):
                                stop()
                            call("observe", due, between, looked)
                            if self._sticks:
                                with r.when(
                                    (looked["margin"] < -2.0 * NEAR) & (due > t) & (event < 1)
                                ):
                                    r.set(beyond_it, 1)
                                    r.set(ahead, due - t)
                                    r.set(high, looked["margin"])
                                    r.set(recorded, count)
                                    r.set(due, since)
                                    r.leave()
                            r.copy(row.at(size), looked, seen)
                            r.copy(row, between, size)
                            r.set(recorded, recorded + 1)
                            r.set(due, due + whole)
                        with r.when(beyond_it < 1):
                            # a part that was cut short says nothing against the length it was
                            # cut from
                            r.store(r.h, 1, select(last & (proposed > wanted), proposed, wanted))
                            r.set(t, select(last & (ahead <= 0.0), goal, t + length))
                            if floating:  # other coordinates have other slopes
                                r.call("wrap", following, r.state)
                                call("rate", t, r.state, first)
                            else:
                                r.copy(r.state, following, size)
                                r.copy(first, ending, size)
                            with r.when(event > 0):
                                r.store(r.h, 5, 1.0)
                                stop()
                            with r.when(ahead > 0.0):
                                r.set(ahead, ahead - length)
                                r.set(low, worst)
                            if edges:
                                r.call("sides", ending, sides)
                                with r.when(worst < -NEAR):  # an edge, behind which it goes on
                                    r.set(ahead, 0.0)
                                    r.set(tries, 0)
                                    r.set(low, 1.0)
                            with r.when(beyond(r, result)):
                                stop()
                with r.otherwise():
                    r.store(r.h, 1, wanted)
            stop()


def breaks_of(machine: Machine, control: TracedController) -> Array:
    """Times (k,) [s] at which what a controller or a force refers to turns sharply, in order.

    As they say themselves (`breaks`), or its reference.
    """
    outside = [force.breaks() for force in machine.external]
    sources: tuple[Any, ...] = control, getattr(control, "reference", None)
    for one in sources:
        if hasattr(one, "breaks"):
            outside.append(np.asarray(one.breaks(), dtype=np.float64))
            break
    return np.array(sorted({time for times in outside for time in times.tolist()}), dtype=float)
