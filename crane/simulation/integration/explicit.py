"""Steps of an explicit method of eighth order in machine code, of a length that its error chooses.

Dormand and Prince's method of order 8 with its embedded methods of order 5 and 3 and its
interpolant of order 7 (Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I,
II.5 and II.6; the coefficients are scipy's).
"""

import numpy as np

from crane.closure.traced import largest_share
from crane.codegen import Number, Program, Tape, Value, select
from crane.codegen.representation import Array as Place
from crane.codegen.scalar import add, apply, dot, maximum, minimum, scale, subtract
from crane.common.samples import Array
from crane.control import TracedController
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.sticking import NEAR
from crane.simulation.integration.traced import HELD, Stepper, beyond, wrapped

STAGES, MORE = 12, 3  # of a step, and for what is between its ends
TOLERANCE = 1e-11  # error of a step, per size of the state
_LEAST = 0.1  # what is taken for no smaller: rad, machine's size, per `Closure.pace`
_FOLLOWED = 0.02  # way of a step beyond whose end the loops may not close, likewise
SPACING = 5e-4  # [s] between the instants that references are known at, at most
_ROWS = 2000  # of references of a call
_FASTER, _SLOWER, _SAFETY = 5.0, 0.2, 0.9  # change of the step's length from one to the next
_SHORTEST = 1e-9  # part of a recorded step that is given up on
_EVENTS = 6  # of the bounds, whether to stop where a joint starts or stops
_NEARLY = 1.0 - 2.0**-41  # of what is left: all of it


class ExplicitStepper(Stepper):
    """Many steps at once in machine code, with references and recorded instants within them.

    Args:
        chart: The machine.
        control: Its controller.
        states: Number of the controller's states.
        tolerance: Error of a step, per size of the state.

    Attributes:
        tolerance: (k + 1,) least error that matters of coordinates, velocities and the
            controller's states; error of a step, per size of the state.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(self, chart: Chart, control: TracedController, states: int, tolerance: float):
        from scipy.integrate import DOP853

        self._method = DOP853
        super().__init__(chart, control, states, ("explicit",), fold=False)
        closure = chart.machine.closure
        rates = closure.units[closure.active] / closure.pace
        least = _LEAST * np.concatenate([closure.units, rates, np.ones(states), [1.0 / _LEAST]])
        self.tolerance = tolerance * least
        self.bounds = np.append(self.bounds, 1.0)
        self._lengths = np.zeros(6)

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
        lengths, parts = self._lengths, 2 * max(1, int(np.ceil(0.5 * step / SPACING)))
        lengths[5] = 0.0
        if lengths[0] != step:
            lengths[:2] = step, 0.01 * min(step, SPACING)
        length, done = max(1, _ROWS // parts), 0
        out = np.empty((min(length, len(rows)), rows.shape[1]))
        while done < len(rows) or offset < 0:
            count = min(length, len(rows) - done)
            # references from a step before on, where the state may be
            places = np.arange(-parts, count * parts + 1, dtype=np.float64)
            grid = first + step * done + step / parts * places
            references = np.ascontiguousarray(self._control.references(grid))
            lengths[2:] = offset, 2.0 * step / parts, count * step, 0.0
            made = self._program.call(
                "run", count, self._fast.close_address, *self._arguments, references, state,
                out, lengths, self.bounds, self.tolerance,
            )  # fmt: skip
            rows[done : done + made] = out[:made]
            done, offset = done + made, float(lengths[2])
            if made < count or offset < 0:
                lengths[0] = 0.0  # it may have got as short as can be
                break
        return done, offset

    @property
    def event(self) -> float:
        """Whether a joint starts or stops in the next step."""
        return float(self._lengths[5])

    def advance(self, time: float, state: Array, length: float) -> tuple[Array, float]:
        """The state a step later, whatever starts or stops, and its margin (`Moved.margin`)."""
        state = state.copy()
        self._lengths[:2] = length, length
        self.bounds[_EVENTS] = 0.0
        _, offset = self.run(time + length, state, -length, length, np.empty((0, 0)))
        self.bounds[_EVENTS] = 1.0
        self._lengths[0] = 0.0
        if offset < 0:
            return state, -np.inf
        return state, self.observe(time + length, state)[1]

    def _build(self, program: Program) -> None:
        for added, rest in self._rests:
            for name in ("observe", "rate"):
                machine, tau, own_rate = self._driven(Tape())
                moved = machine.moved(tau, rest)
                if name == "observe":
                    out = {"seen": machine.observed(tau, rest)}
                else:
                    slopes, powers = machine.sweep.slopes, machine.powers(tau)
                    out = {"rate": [*slopes, *moved.a_a, *own_rate, *powers]}
                program.add(name + added, 5, {**out, "margin": [moved.margin]})
        # the parabola through rows at 0, 1/2, 1
        tape = Tape()
        s, columns = tape.load(1, 0), self._columns
        rows = [tape.loads(0, columns * row, columns) for row in range(3)]
        shares = ((2.0 * s - 1.0) * (s - 1.0), 4.0 * s * (1.0 - s), s * (2.0 * s - 1.0))
        program.add("reference", 2, [dot(shares, values) for values in zip(*rows, strict=True)])
        self._add_sums(program)
        self._add_run(program)

    def _add_sums(self, program: Program) -> None:
        """stage1(s, k, h) to stage11, more0 to more2; finish(numbers, s, k, h, tol); dense; ..."""
        size, method = self._state.size, self._method

        def mixed(tape: Tape, weights: Array, array: int = 1) -> list[Number]:
            out: list[Number] = [0.0] * size
            for j in np.flatnonzero(weights).tolist():
                out = add(out, scale(float(weights[j]), tape.loads(array, j * size, size)))
            return out

        stages = {f"stage{i}": method.A[i] for i in range(1, STAGES)}
        stages |= {f"more{i}": row for i, row in enumerate(method.A_EXTRA)}
        for name, weights in stages.items():
            tape = Tape()
            moved = scale(tape.load(2, 0), mixed(tape, weights))
            program.add(name, 3, add(tape.loads(0, 0, size), moved))
        tape = Tape()
        state, h = tape.loads(1, 0, size), tape.load(3, 0)
        after = add(state, scale(h, mixed(tape, method.B, 2)))
        used = self._state.start("own") + self._state.parts["own"]
        fifth: Number = 0.0
        third: Number = 0.0
        gaps = mixed(tape, method.E5, 2), mixed(tape, method.E3, 2)
        for i, (one, other) in enumerate(zip(*gaps, strict=True)):
            if i >= used:
                break
            size_of = maximum(apply("abs", state[i]), apply("abs", after[i]))
            share = 1.0 / maximum(tape.load(4, i), tape.load(4, used) * size_of)
            fifth = fifth + one * share * (one * share)
            third = third + other * share * (other * share)
        below = maximum(fifth + 0.01 * third, 1e-300)
        error = apply("abs", h) * fifth / apply("sqrt", below * float(used))
        usable = minimum(maximum(error, 1e-9), 1e9)
        change = _SAFETY * apply("exp", (-1.0 / 8.0) * apply("log", usable))
        change = minimum(maximum(change, _SLOWER), _FASTER)
        long = [not turns for turns in self._fast.geometry.revolute[1:]]
        rates = tape.loads(2, 0, self._state.parts["q"])
        move = h * largest_share(rates, long, self._fast.per_size(tape))
        outputs = {"state": after, "error": [error], "change": [change], "move": [move]}
        program.add("finish", 5, outputs)
        tape = Tape()
        program.add("wrap", 1, wrapped(self._chart, tape.loads(0, 0, size)))
        # between the ends: state, slopes there, behind it
        tape = Tape()
        state, h, after = tape.loads(0, 0, size), tape.load(2, 0), tape.loads(3, 0, size)
        first, last = tape.loads(1, 0, size), tape.loads(1, STAGES * size, size)
        way = subtract(after, state)
        parts = [
            *way,
            *subtract(scale(h, first), way),
            *subtract(scale(2.0, way), scale(h, add(first, last))),
        ]
        for weights in method.D:
            parts += scale(h, mixed(tape, weights))
        program.add("dense", 4, parts)
        tape = Tape()
        state, x = tape.loads(0, 0, size), tape.load(2, 0)
        out: list[Number] = [0.0] * size
        for i, at in enumerate(reversed(range(3 + len(method.D)))):
            out = add(out, tape.loads(1, at * size, size))
            out = scale(x if i % 2 == 0 else 1.0 - x, out)
        program.add("interpolate", 3, wrapped(self._chart, add(state, out)))

    def _add_run(self, program: Program) -> None:
        """run: steps and recorded instants until the last of these, or one needs a closer look.

        h: recorded step; length to try; when the state is, after the first instant, and behind,
        after the next one; length of three references; when the last recorded step ends; whether
        a joint starts or stops in the next step.
        """
        size, seen, columns = self._state.size, self._seen.size, self._columns
        method, floating = self._method, self._chart.machine.coordinates.floating
        names = ("geometry", "numbers", "control", "refs", "state", "out", "h", "bounds", "tol")
        with program.routine("run", counts=("steps",), functions=("close",), arrays=names) as r:
            following = r.array("following", program.outputs("finish"))
            # a rate has its margin behind it, which the next one replaces
            k = r.array("k", (STAGES + 1 + MORE) * size + 1)
            ending = r.array("ending", program.outputs("rate"))
            looked = r.array("looked", program.outputs("observe"))
            stage, inside = r.array("stage", size), r.array("inside", 7 * size)
            result = r.array("result", self._fast.outputs("newton"))
            found = r.array("found", self._fast.outputs("newton"))
            theta, part = r.array("theta", 1), r.array("part", 1)
            reference = r.array("reference", max(1, columns))
            machine = r.geometry, r.numbers, r.control, reference
            whole, pair, end = r.let(r.h[0]), r.let(r.h[3]), r.let(r.h[4])
            t = r.let(r.h[2])
            recorded, due = r.let(0), r.let(0.0)
            base, before = r.let(0), r.let(whole * -1.0)  # the references a step begins among

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

            def call(formula: str, time: Value, at: Place, out: Place) -> None:
                if columns:
                    refer(time)
                self._call(r, formula, *machine, at, out)

            def stop() -> None:
                r.store(r.h, 2, t - due)
                r.give(recorded)

            call("rate", t, r.state, k)
            with r.forever():
                left, proposed = r.let(end - t), r.let(r.h[1])
                with r.when(~(left > whole * _SHORTEST)):
                    r.leave()
                if self._sticks:  # what is at rest does not tell how soon it starts
                    with r.when((r.bounds[HELD] > 0.5) & (proposed > whole)):
                        r.set(proposed, whole)
                last = r.let(proposed >= left * _NEARLY)
                length = r.let(select(last, left, proposed))
                with r.when(~(length >= whole * _SHORTEST)):
                    stop()
                if columns:
                    with r.forever():
                        with r.when(~(t >= before + pair)):
                            r.leave()
                        r.set(base, base + 1)
                        r.set(before, before + pair)
                r.store(part, 0, length)
                for i in range(1, STAGES):
                    r.call(f"stage{i}", r.state, k, part, stage)
                    call("rate", t + length * float(method.C[i]), stage, k.at(i * size))
                r.call("finish", r.geometry, r.state, k, part, r.tol, following)
                change = following["change"]
                wanted = r.let(length * select(change > 0.0, change, _SLOWER))  # NaN: slower
                with r.when(following["error"] <= 1.0):
                    closed = r.call("close", r.geometry, following, result, r.bounds)
                    with r.when(closed < 1):
                        # nearer to where the branch ends, if it does
                        r.store(r.h, 1, length * _SLOWER)
                        with r.when(following["move"] < _FOLLOWED):
                            stop()
                    with r.otherwise():
                        call("rate", t + length, following, ending)
                        if self._sticks:
                            looking = r.bounds[_EVENTS] > 0.5
                            with r.when((ending["margin"] < -NEAR) & looking):
                                r.store(r.h, 5, 1.0)
                                stop()
                        r.copy(k.at(STAGES * size), ending, size)
                        with r.when(due < (t + length) * _NEARLY):
                            for i in range(MORE):
                                r.call(f"more{i}", r.state, k, part, stage)
                                at = k.at((STAGES + 1 + i) * size)
                                call("rate", t + length * float(method.C_EXTRA[i]), stage, at)
                            r.call("dense", r.state, k, part, following, inside)
                        count, since = r.let(recorded), r.let(due)
                        with r.forever():
                            with r.when(~(due < (t + length) * _NEARLY)):
                                r.leave()
                            row = r.out.row(recorded, size + seen)
                            r.store(theta, 0, (due - t) / length)
                            r.call("interpolate", r.state, inside, theta, stage)
                            closed = r.call("close", r.geometry, stage, found, r.bounds)
                            with r.when(closed < 1):
                                stop()
                            call("observe", due, stage, looked)
                            if self._sticks:
                                with r.when((looked["margin"] < -NEAR) & looking & (due > t)):
                                    r.store(r.h, 5, 1.0)
                                    r.set(recorded, count)
                                    r.set(due, since)
                                    stop()
                            r.copy(row.at(size), looked, seen)
                            r.copy(row, stage, size)
                            r.set(recorded, recorded + 1)
                            r.set(due, due + whole)
                        r.store(r.h, 1, select(last & (proposed > wanted), proposed, wanted))
                        r.set(t, select(last, end, t + length))
                        if floating:  # other coordinates have other slopes
                            r.call("wrap", following, r.state)
                            call("rate", t, r.state, k)
                        else:
                            r.copy(r.state, following, size)
                            r.copy(k, k.at(STAGES * size), size)
                        with r.when(beyond(r, result)):
                            stop()
                with r.otherwise():
                    r.store(r.h, 1, wanted)
            r.store(r.h, 2, 0.0)
            r.give(recorded)
