"""The loop over the steps of a method with step-size control, as a routine in machine code."""

from collections.abc import Callable
from dataclasses import dataclass

from crane.codegen import Program, Value, select
from crane.codegen.representation import Array as Place
from crane.codegen.representation import Routine
from crane.simulation.integration.sticking import NEAR
from crane.simulation.integration.traced import HELD, Stepper, beyond

SLOWER = 0.2  # least ratio of a step size to the one before
_FOLLOWED = 0.02  # move of a step beyond whose end the loops may not close: rad, machine's size
_SHORTEST = 1e-9  # of the output interval: the least step size
_LEAST, _BISECTED = 0.02, 8  # share of a step that is tried to find an event; trials until halving
_NEARLY = 1.0 - 2.0**-41  # of what is left: all of it

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


@dataclass(frozen=True)
class _StepVariables:
    """Variables of one step.

    Attributes:
        length: Step size.
        last: Whether it ends at its goal.
        goal: The time at which it has to end at the latest.
        sure: 1 where an event is taken for located.
        proposed: The step size that error control proposes.
    """

    length: Value
    last: Value
    goal: Value
    sure: Value
    proposed: Value


class StepLoop:
    """Writer of the routine `run`: steps and output instants until an end or an event.

    Elements of its argument h: output interval; step size to try; time of the state, relative to
    the first output instant before, and to the next one behind; spacing of references; end;
    whether a joint starts or stops there.

    A step that passes an event is rejected. The secant method locates the event; steps that end
    before it are accepted.

    Args:
        stepper: The method with its machine and controller.
        program: The program with its formulas.
        r: The routine to write.
        short: Whether steps end at output instants.
    """

    def __init__(self, stepper: Stepper, program: Program, r: Routine, short: bool):
        self._stepper, self._program, self._r, self._short = stepper, program, r, short
        self._size, self._seen = stepper.state_layout.size, stepper.output_layout.size
        self._columns, self._sticks = stepper.reference_columns, stepper.sticks
        self._following = r.array("following", program.outputs("finish"))
        self._first, self._ending = (
            r.array(x, program.outputs("rate")) for x in ("first", "ending")
        )
        self._looked = r.array("looked", program.outputs("observe"))
        self._inside = r.array("inside", program.outputs("dense"))
        self._between = r.array("between", self._size)
        self._result = r.array("result", stepper.closure_code.outputs("newton"))
        self._found = r.array("found", stepper.closure_code.outputs("newton"))
        self._theta, self._part = r.array("theta", 1), r.array("part", 1)
        self._reference = r.array("reference", max(1, self._columns))
        self._machine = r.geometry, r.numbers, r.control, self._reference
        if stepper.asks is not None:
            self._asked = r.array("asked", program.outputs("asked"))
            self._outside = self._reference.at(stepper.controller_columns)
        self._whole, self._pair, self._end = r.let(r.h[0]), r.let(r.h[3]), r.let(r.h[4])
        self._t = r.let(r.h[2])
        self._recorded, self._due = r.let(0), r.let(0.0)
        # the references that a step begins among
        self._base, self._before = r.let(0), r.let(self._t)
        self._edges = program.outputs("rate").parts["edges"]

    def write(self, make_step: Callable[[Program, Attempt], tuple[Way, Way]]) -> None:
        """Write the routine.

        Args:
            make_step: Returns what makes a step up to `finish`, and what calls `dense` behind one.
        """
        r = self._r
        self._attempt, self._interpolate = make_step(
            self._program,
            Attempt(
                r, self._call, self._first, self._ending, self._part, self._following, self._inside
            ),
        )
        self._call("rate", self._t, r.state, self._first)
        self._begin_location()
        with r.forever():
            self._write_step()
        self._stop()

    def _begin_location(self) -> None:
        """Variables of event location: how far ahead the event is, margins here and there."""
        r = self._r
        self._ahead, self._low, self._high = r.let(0.0), r.let(1.0), r.let(0.0)
        self._tries = r.let(0)
        self._sides, self._crossed = r.array("sides", max(1, self._edges)), r.array("crossed", 1)
        if self._edges:
            r.call("sides", self._first, self._sides)
        if self._sticks:
            r.set(self._low, self._first["margin"])
            with r.when(self._low < -NEAR):
                r.store(r.h, 5, 1.0)
                self._stop()

    def _write_step(self) -> None:
        r = self._r
        step = self._propose()
        if self._columns:
            self._advance(self._base, self._before, self._t)
        r.store(self._part, 0, step.length)
        self._attempt(self._t, step.length)
        change = self._following["change"]
        # NaN: slower
        wanted = r.let(step.length * select(change > 0.0, change, SLOWER))
        with r.when(self._following["error"] <= 1.0):
            closed = r.call("close", r.geometry, self._following, self._result, r.bounds)
            with r.when(closed < 1):
                # nearer to where the branch ends, if it does
                r.store(r.h, 1, step.length * SLOWER)
                with r.when(self._following["move"] < _FOLLOWED):
                    self._stop()
            with r.otherwise():
                self._finish(step, wanted)
        with r.otherwise():
            r.store(r.h, 1, wanted)

    def _propose(self) -> _StepVariables:
        """Size and end of the next step; leaves the loop at the end."""
        r, whole = self._r, self._whole
        left, proposed = r.let(self._end - self._t), r.let(r.h[1])
        with r.when(~(left > whole * _SHORTEST)):
            r.leave()
        sure, goal = r.let(0), r.let(self._end)
        if self._short:
            due = self._due
            r.set(goal, select(due > self._t + whole * _SHORTEST, due, due + whole))
            with r.when(goal > self._end):
                r.set(goal, self._end)
            r.set(left, goal - self._t)
        if self._sticks:
            with r.when((r.bounds[HELD] > 0.5) & (proposed > whole)):
                r.set(proposed, whole)  # what is at rest does not tell how soon it starts
        if self._sticks or self._edges:
            with r.when(self._ahead > 0.0):
                self._locate(left, sure)
        last = r.let(proposed >= left * _NEARLY)
        length = r.let(select(last, left, proposed))
        with r.when(~(length >= whole * _SHORTEST) & (self._ahead <= 0.0)):
            self._stop()
        return _StepVariables(length, last, goal, sure, proposed)

    def _locate(self, left: Value, sure: Value) -> None:
        """Shorten what is left to where the secant method expects the event."""
        r, ahead = self._r, self._ahead
        share = r.let((self._low + 1.5 * NEAR) / (self._low - self._high))
        with r.when(self._tries > _BISECTED):
            r.set(share, 0.5)
        with r.when(~(share > _LEAST)):
            r.set(share, _LEAST)
        with r.when(share > 1.0 - _LEAST):
            r.set(share, 1.0 - _LEAST)
        with r.when(ahead < self._whole * _SHORTEST):  # a margin that jumps
            r.set(share, 1.0)
            r.set(sure, 1)
        r.set(left, ahead * share)
        r.set(self._tries, self._tries + 1)

    def _finish(self, step: _StepVariables, wanted: Value) -> None:
        """Behind a step whose error is small and whose end is closed."""
        r = self._r
        self._call("rate", self._t + step.length, self._following, self._ending)
        beyond_it, event = r.let(0), r.let(0)
        worst = r.let(1.0)
        self._detect(step, beyond_it, event, worst)
        self._record(step, beyond_it, event)
        with r.when(beyond_it < 1):
            self._accept(step, wanted, event, worst)

    def _detect(self, step: _StepVariables, beyond_it: Value, event: Value, worst: Value) -> None:
        """Whether an event lies within the step (beyond_it) or at its end."""
        r = self._r
        if self._sticks:
            r.set(worst, self._ending["margin"])
            with r.when(worst < -NEAR):
                r.set(event, 1)
        if self._edges:
            r.call("crossed", self._ending, self._sides, self._crossed)
            with r.when(self._crossed[0] < worst):
                r.set(worst, self._crossed[0])
        if self._sticks or self._edges:
            with r.when((worst < -2.0 * NEAR) & (step.sure < 1)):
                r.set(beyond_it, 1)
                r.set(event, 0)
                r.set(self._ahead, step.length)
                r.set(self._high, worst)

    def _record(self, step: _StepVariables, beyond_it: Value, event: Value) -> None:
        """Write the rows of the output instants within the step."""
        r, due, length = self._r, self._due, step.length
        count, since = r.let(self._recorded), r.let(due)
        with r.when((beyond_it < 1) & (due < (self._t + length) * _NEARLY)):
            self._interpolate(self._t, length)
        with r.forever():
            with r.when((beyond_it > 0) | ~(due < (self._t + length) * _NEARLY)):
                r.leave()
            row = r.out.row(self._recorded, self._size + self._seen)
            r.store(self._theta, 0, (due - self._t) / length)
            r.call("interpolate", r.state, self._inside, self._theta, self._between)
            closed = r.call("close", r.geometry, self._between, self._found, r.bounds)
            with r.when(closed < 1):
                self._stop()
            self._call("observe", due, self._between, self._looked)
            if self._sticks:
                margin = self._looked["margin"]
                with r.when((margin < -2.0 * NEAR) & (due > self._t) & (event < 1)):
                    r.set(beyond_it, 1)
                    r.set(self._ahead, due - self._t)
                    r.set(self._high, margin)
                    r.set(self._recorded, count)
                    r.set(due, since)
                    r.leave()
            r.copy(row.at(self._size), self._looked, self._seen)
            r.copy(row, self._between, self._size)
            r.set(self._recorded, self._recorded + 1)
            r.set(due, due + self._whole)

    def _accept(self, step: _StepVariables, wanted: Value, event: Value, worst: Value) -> None:
        """Go on from the end of the step."""
        r, ahead = self._r, self._ahead
        # a part that was cut short says nothing against the length it was cut from
        kept = step.last & (step.proposed > wanted)
        r.store(r.h, 1, select(kept, step.proposed, wanted))
        at_goal = step.last & (ahead <= 0.0)
        r.set(self._t, select(at_goal, step.goal, self._t + step.length))
        if self._stepper.floats:  # other coordinates have other slopes
            r.call("wrap", self._following, r.state)
            self._call("rate", self._t, r.state, self._first)
        else:
            r.copy(r.state, self._following, self._size)
            r.copy(self._first, self._ending, self._size)
        with r.when(event > 0):
            r.store(r.h, 5, 1.0)
            self._stop()
        with r.when(ahead > 0.0):
            r.set(ahead, ahead - step.length)
            r.set(self._low, worst)
        if self._edges:
            r.call("sides", self._ending, self._sides)
            with r.when(worst < -NEAR):  # an edge, behind which it goes on
                r.set(ahead, 0.0)
                r.set(self._tries, 0)
                r.set(self._low, 1.0)
        with r.when(beyond(r, self._result)):
            self._stop()

    def _advance(self, index: Value, begins: Value, time: Value) -> None:
        """Move the references that are interpolated to those around a time."""
        r = self._r
        with r.forever():
            with r.when(
                ~((time >= begins + self._pair) & (begins + self._pair * 1.5 < self._end))
            ):
                r.leave()
            r.set(index, index + 1)
            r.set(begins, begins + self._pair)

    def _refer(self, time: Value) -> None:
        """Put the references at a time behind the step's beginning into `reference`."""
        r = self._r
        index, begins = r.let(self._base), r.let(self._before)
        self._advance(index, begins, time)
        r.store(self._theta, 0, (time - begins) / self._pair)
        row = r.refs.row(index, 2 * self._columns)
        r.call("reference", row, self._theta, self._reference)

    def _call(self, formula: str, time: Value, *arrays: Place) -> None:
        r = self._r
        if self._columns:
            self._refer(time)
        if self._stepper.asks is not None:
            r.call("asked", *self._machine, arrays[0], self._asked)
            r.call("answer", self._asked, self._outside)
        self._stepper.call_formula(r, formula, *self._machine, *arrays)

    def _stop(self) -> None:
        self._r.store(self._r.h, 2, self._t - self._due)
        self._r.give(self._recorded)
