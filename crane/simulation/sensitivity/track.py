"""A recorded motion, and where along it the variational equations are looked at."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from crane.closure.structure import Indices
from crane.common.errors import InputError, SimulationError
from crane.common.samples import Array
from crane.control import TracedController, ValveDrive
from crane.dynamics import Dynamics
from crane.dynamics.external import states_of
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.state import row_layout
from crane.simulation.integration.sticking import Switch
from crane.simulation.run import integrate, integration_of
from crane.simulation.sensitivity.setup import Setup
from crane.simulation.sensitivity.tangent import Tangent

_CHUNK = 400  # steps at once
FINER, DEEPEST = 16, 3  # parts of a step that is too rough, how often
_SAME = 1e-9  # of a step, between times that are one
_LOOKED = 500  # postures that are asked for a dead centre
_MOMENT = 1e-6  # of a step, over which references change at an event


class Motion(NamedTuple):
    """A simulation to be.

    Attributes:
        dynamics: The machine.
        control: Its controller.
        initial: q_A and v_A at first.
        steps: How many.
        step: [s] between instants.
        method: See `simulate`.
        tolerance: See `simulate`.
    """

    dynamics: Dynamics
    control: TracedController
    initial: tuple[Array, Array]
    steps: int
    step: float
    method: str | None = None
    tolerance: float | None = None


class Nodes(NamedTuple):
    """Where a stretch of n steps is looked at: their ends and their middles.

    Attributes:
        times: (2 n + 1,) [s].
        states: (2 n + 1, .).
        before: (2 n + 1,) which of the recorded instants and middles is the last one.
        share: (2 n + 1,) of the way to the next one.
    """

    times: Array
    states: Array
    before: Indices
    share: Array

    @property
    def lengths(self) -> Array:
        """(n,) of the steps [s]."""
        lengths: Array = self.times[2::2] - self.times[:-2:2]
        return lengths

    def between(self, values: Array) -> Array:
        """Values (..., 2 n + 1, c) at the nodes of those (..., 2 N + 1, c) that are recorded."""
        behind = np.minimum(self.before + 1, values.shape[-2] - 1)
        share, one = self.share[:, None], values[..., self.before, :]
        return np.ascontiguousarray((1.0 - share) * one + share * values[..., behind, :])


class Stretch(NamedTuple):
    """Recorded steps between two instants; none from an instant to itself, where things switch.

    What is observed at an instant is so in the last of the stretches that have it.

    Attributes:
        mode: Behind which of the switches.
        first: Instant.
        last: Instant.
    """

    mode: int
    first: int
    last: int


class Part(NamedTuple):
    """A part of a step, which is simulated anew.

    Attributes:
        mode: Behind which of the switches.
        state: At the beginning.
        begins: [s].
        ends: [s].
        last: State at the end.
    """

    mode: int
    state: Array
    begins: float
    ends: float
    last: Array


class Jump(NamedTuple):
    """An instant at which joints start or stop.

    Attributes:
        mode: Behind which of the switches, before it.
        switch: What happens.
    """

    mode: int
    switch: Switch


class Track:
    """A motion simulated with the middles of its steps, which are nodes like their ends.

    Args:
        motion: What is simulated.
        progress: See `simulate`.

    Attributes:
        chart: The machine.
        control: Its controller.
        own: Number of the controller's states.
        stiff: Number of those that act back, the first.
        time: (2 N + 1,) of instants and the middles between them [s].
        rows: (2 N + 1, .) there, see `integrate`.
        layout: Of a row.
        notes: What is to be said of the motion.
        largest: (m,) of the minimal state, at least what a machine moves by; 1 of what stays 0.
        switches: What started and stopped, the start first.
        rest: Whether some joint is at rest.

    Raises:
        InputError: A machine that has no formulas, or floats.
        SimulationError: It comes to a dead centre; else as `simulate`.
    """

    def __init__(self, motion: Motion, progress: Callable[[float], None] | None):
        dynamics, control, count, step = motion.dynamics, motion.control, motion.steps, motion.step
        machine, self.chart, self.control = dynamics.machine, Chart.of(dynamics), control
        compiled = dynamics.backend == "compiled" and machine.traced
        if not compiled or not isinstance(control, TracedController):
            raise InputError(
                f"'{machine.name}' with its controller has no formulas to differentiate: lock "
                "joints, or write the controller as a Law, and loads as ExternalForce"
            )
        if machine.coordinates.floating:
            raise InputError(f"'{machine.name}' floats, sensitivities are of machines that stand")
        if states_of(machine.external):
            raise InputError(
                f"'{machine.name}' has contacts that give way along the ground, sensitivities "
                "are of those without lateral stiffness"
            )
        self.chart.sticking.switches = []
        made = (dynamics, control, motion.initial, 2 * count, 0.5 * step, motion.method)
        run = integrate(*made, progress, motion.tolerance, self.chart)
        if run.stop is not None:
            raise run.stop
        time, parts, self.notes = run.time, run.rows, run.notes
        self.time, self.own, self._step, self.rest = time, parts.own.shape[1], step, False
        _beside_dead_centres(self.chart, time, parts.q)
        self.stiff = control.circuit.stiff if isinstance(control, ValveDrive) else self.own
        self.layout = row_layout(machine, control, self.own)
        self.rows = np.hstack([getattr(parts, name) for name in self.layout.parts])
        self._states = self.rows[:, : self.layout.start("tau")]
        make = integration_of(dynamics, control, self.own, motion.method, motion.tolerance)
        self._way = make(self.chart)
        self.switches: list[Switch] = self.chart.sticking.switches
        self.chart.sticking.switches = None  # parts that are simulated anew are no news
        seen, closure = self.chart.seen, machine.closure
        minimal = np.hstack([parts.q[:, seen], parts.v_a, parts.own[:, : self.stiff]])
        units = np.concatenate([closure.units[seen], closure.units[seen] / closure.pace])
        self.largest: Array = np.abs(minimal).max(axis=0)
        self.largest[self.largest == 0.0] = 1.0
        self.largest[: len(units)] = np.maximum(self.largest[: len(units)], units)

    def course(self) -> list[Stretch | Part | Jump]:
        """What the motion consists of, in its order."""
        out: list[Stretch | Part | Jump] = []
        count, mode, first = len(self.time) // 2, 0, 0
        switches = self.switches[1:]
        while first < count:
            last = min(first + _CHUNK, count)
            if mode < len(switches):
                at = int((switches[mode].time - self.time[0]) / self._step + _SAME)
                last = min(last, at)
            if last > first:
                out.append(Stretch(mode, first, last))
                first = last
                continue
            out.append(Stretch(mode, first, first))
            begins, ends = self.time[2 * first], self.time[2 * first + 2]
            state = self._states[2 * first]
            while mode < len(switches) and switches[mode].time < ends - _SAME * self._step:
                switch = switches[mode]
                if switch.time - begins > _SAME * self._step:
                    out.append(Part(mode, state, begins, switch.time, switch.state))
                    begins = switch.time
                out.append(Jump(mode, switch))
                mode, state = mode + 1, switch.state
            out.append(Part(mode, state, begins, ends, self._states[2 * first + 2]))
            first += 1
        return [*out, Stretch(mode, count, count)]

    def adopt(self, mode: int) -> None:
        """Joints do what they do behind one of the switches, the start being the first."""
        sticking = self.chart.sticking
        if self.switches:
            switch = self.switches[mode]
            sticking.slip[:], sticking.held[:] = switch.slip, switch.held
            sticking.moving = switch.moving
            sticking.tell(self.chart.dynamics)
            self.rest = bool(switch.held.any())

    def recorded(self, stretch: Stretch) -> Nodes:
        """The nodes of recorded steps."""
        which = np.arange(2 * stretch.first, 2 * stretch.last + 1)
        return Nodes(self.time[which], self._states[which], which, np.zeros(len(which)))

    def simulated(self, state: Array, begins: float, ends: float, last: Array) -> Nodes:
        """Nodes of `FINER` steps between two times [s], from one state to another."""
        times = np.linspace(begins, ends, 2 * FINER + 1)
        state, sticking = state.copy(), self.chart.sticking
        kept = sticking.slip.copy(), sticking.held.copy(), sticking.moving
        rows = np.empty((2 * FINER, len(self._way.last(begins, state))))
        self._way.offset = 0.0
        if self._way.run(times[:-1], state, times[1] - times[0], rows) < len(rows):
            raise SimulationError(
                f"at t = {begins:.4g} s the motion jumps and cannot be followed, shorten the step"
            )
        sticking.slip[:], sticking.held[:], sticking.moving = kept
        sticking.tell(self.chart.dynamics)
        return Nodes(times, np.vstack([rows[:, : len(state)], last]), *self._placed(times))

    def within(self, nodes: Nodes, step: int) -> Nodes:
        """Nodes within one step of others."""
        begin, end = 2 * step, 2 * step + 2
        times, states = nodes.times, nodes.states
        return self.simulated(states[begin], times[begin], times[end], states[end])

    def moment(self, switch: Switch) -> Nodes:
        """Three nodes around a switch, at its state."""
        times = switch.time + _MOMENT * self._step * np.array([-1.0, 0.0, 1.0])
        return Nodes(times, np.tile(switch.state, (3, 1)), *self._placed(times))

    def _placed(self, times: Array) -> tuple[Indices, Array]:
        before = np.clip(np.searchsorted(self.time, times) - 1, 0, len(self.time) - 2)
        share = (times - self.time[before]) / (self.time[before + 1] - self.time[before])
        return before, share

    def numbers(self, base: Setup, nodes: Nodes) -> Setup:
        """The simulation's numbers at some nodes, with what sticks."""
        references = nodes.between(base.references)
        return base._replace(numbers=self.chart.dynamics.numbers, references=references)

    def leap(self, tangent: Tangent, base: Setup, jump: Jump) -> tuple[Array, Array]:
        """How S jumps where joints start or stop; what they do behind is adopted.

        With g = 0 what tells when, r the rate before and r_+ behind,

            S_+ = S + (r - r_+) dt/dp,    (g_s r + g_t) dt/dp = -(g_s S + g_p).

        Returns:
            g_s (m,), and (r - r_+) / (g_s r + g_t) (m,), 0 where nothing paces g.
        """
        nodes, m = self.moment(jump.switch), tangent.size
        numbers = self.numbers(base, nodes)
        rows = numbers.references
        paced = (rows[2] - rows[0]) / (nodes.times[2] - nodes.times[0])
        still = Setup(*(np.zeros((1, part.shape[-1])) for part in base))
        later = still._replace(references=np.tile(paced, (1, 3, 1)))
        slopes = tangent.along(numbers, nodes.states, later, self.rest)[1][1, -1]
        before = self._rated(tangent, base, nodes)
        pace = float(slopes[:m] @ before + slopes[m])
        self.adopt(jump.mode + 1)
        if not pace:
            return slopes[:m], np.zeros(m)
        return slopes[:m], (before - self._rated(tangent, base, nodes)) / pace

    def _rated(self, rate: Tangent, base: Setup, nodes: Nodes) -> Array:
        """The rate (m,) at the middle one of three nodes."""
        numbers = self.numbers(base, nodes)
        row = np.ascontiguousarray(numbers.references[1])
        return rate.rate(numbers._replace(references=row), nodes.states[1].copy(), self.rest)


def _beside_dead_centres(chart: Chart, time: Array, q: Array) -> None:
    """Raise where active coordinates do not describe a motion (N, nq)."""
    every = max(1, len(q) // _LOOKED)
    for at, posture in zip(time[::every], q[::every], strict=True):
        if chart.steepest(posture) > chart.limits[0]:
            raise SimulationError(
                f"at t = {at:.4g} s the active coordinates come near a dead centre, where nothing "
                "depends on them smoothly: drive other joints, or end before"
            )
