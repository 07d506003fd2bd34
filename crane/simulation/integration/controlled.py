"""Steps in machine code of a length that their error chooses: what such methods have in common."""

from abc import abstractmethod
from collections.abc import Hashable
from typing import Any

import numpy as np

from crane.codegen import Number, Program, Tape
from crane.codegen.scalar import add, apply, dot, maximum, minimum, scale, with_sign_of
from crane.common.samples import Array
from crane.control import TracedController, ValveDrive
from crane.dynamics.external import states_of
from crane.machine import Machine
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.step_loop import Attempt, StepLoop, Way
from crane.simulation.integration.traced import Stepper, references_of, wrapped

SPACING = 5e-4  # [s] between the instants that references are known at, at most
LEAST = 0.1  # what is taken for no smaller: rad, machine's size, per `Closure.pace`
ENERGY = 10.0  # times the tolerance, of energies
_ROUND = 2.5  # [rad] of a step, of bodies that float
_ROWS = 1000  # pairs of references of a call
_AFTER = 0.2  # of a step's length, the first behind an event
_SAME = 1e-9  # of a recorded step, between instants that are one


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
        functions = [self.closure_code.close_address]
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
        s, columns = tape.load(1, 0), self.reference_columns
        rows = [tape.loads(0, columns * row, columns) for row in range(3)]
        shares = ((2.0 * s - 1.0) * (s - 1.0), 4.0 * s * (1.0 - s), s * (2.0 * s - 1.0))
        program.add("reference", 2, [dot(shares, values) for values in zip(*rows, strict=True)])
        self._add_method(program)
        # s + x (c0 + (1 - x) (c1 + x (c2 + ...)))
        tape, size = Tape(), self.state_layout.size
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
            size = size if i < self.state_layout.start("work") else ENERGY * size
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
        functions = ("close",) if self.asks is None else ("close", "answer")
        names = ("geometry", "numbers", "control", "refs", "state", "out", "h", "bounds", "tol")
        with program.routine("run", counts=("steps",), functions=functions, arrays=names) as r:
            loop = StepLoop(self, program, r, self._short)
            loop.write(self._made)


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
