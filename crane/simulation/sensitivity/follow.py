"""Sensitivities along a simulated motion."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from crane.codegen import Parts, TooLongError
from crane.common.errors import InputError, SimulationError
from crane.common.samples import Array
from crane.control import TracedController, ValveDrive
from crane.dynamics import Dynamics
from crane.simulation.integration.charted import Way
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.state import row_layout
from crane.simulation.integration.sticking import Switch
from crane.simulation.run import integrate, integration_of
from crane.simulation.sensitivity.setup import Setup
from crane.simulation.sensitivity.tangent import Tangent
from crane.simulation.sensitivity.variational import bent, steps

_CHUNK = 400  # steps at once
ACCURACY = 1e-6  # error of a step, per size of what it is of
_LEAST = 1e-6  # of the states, what matters of what a number as a whole changes
_FINER, _DEEPEST = 16, 3  # parts of a step that is too rough, how often
_SAME = 1e-9  # of a step, between times that are one
_LOOKED = 500  # postures that are asked for a dead centre
_MOMENT = 1e-6  # of a step, over which references change at an event


class Followed(NamedTuple):
    """A motion and how it changes.

    Attributes:
        time: (N + 1,) [s].
        parts: Of the rows (N + 1, .), see `crane.simulation.run.integrate`.
        slopes: (N + 1, k, p) of k outputs in p directions.
        notes: What is to be said of the motion.
    """

    time: Array
    parts: Parts
    slopes: Array
    notes: list[str]


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


def follow(
    motion: Motion,
    outputs: Sequence[str],
    setup: Callable[[Array], tuple[Setup, Setup]],
    sizes: Array,
    accuracy: float = ACCURACY,
    progress: Callable[[float], None] | None = None,
) -> Followed:
    """Simulate a machine, and how its outputs change in some directions.

    Args:
        motion: What is simulated.
        outputs: What is observed, see `Tangent`.
        setup: Numbers of the simulation, and p directions of them with a leading axis each, given
            the times (2 N + 1,) at which references are asked.
        sizes: (p,) how long directions are that change much.
        accuracy: Error of a step, per size of what it is of.
        progress: See `simulate`.

    Raises:
        InputError: A machine that has no formulas, or floats; an output that is not there.
        SimulationError: It comes to a dead centre; else as `simulate`.
    """
    dynamics, control, count, step = motion.dynamics, motion.control, motion.steps, motion.step
    machine, chart = dynamics.machine, Chart.of(dynamics)
    if dynamics.backend != "compiled" or not isinstance(control, TracedController):
        raise InputError(
            f"'{machine.name}' with its controller has no formulas to differentiate: lock joints, "
            "or write the controller as a Law"
        )
    if machine.coordinates.floating:
        raise InputError(f"'{machine.name}' floats, sensitivities are of machines that stand")
    made = (dynamics, control, motion.initial, 2 * count, 0.5 * step, motion.method)
    time, parts, notes = integrate(*made, progress, motion.tolerance, chart)
    if len(time) <= 2 * count:
        raise KeyboardInterrupt
    _beside_dead_centres(chart, time, parts.q)
    base, directions = setup(time)
    own = parts.own.shape[1]
    stiff = control.circuit.stiff if isinstance(control, ValveDrive) else own
    try:
        tangent = Tangent(chart, control, own, stiff, outputs, _moved(directions))
    except TooLongError:
        raise InputError(
            f"the formulas of '{machine.name}' are too long to differentiate: lock joints"
        ) from None
    layout = row_layout(machine, control, own)
    rows = np.hstack([getattr(parts, name) for name in layout.parts])
    states = rows[:, : layout.start("tau")]
    way = integration_of(dynamics, control, own, motion.method, motion.tolerance)(chart)
    minimal = np.hstack([parts.q[:, chart.seen], parts.v_a, parts.own[:, :stiff]])
    units = machine.closure.units[chart.seen]
    least = np.abs(minimal).max(axis=0)
    least[: 2 * len(units)] = np.maximum(
        least[: 2 * len(units)], np.concatenate([units, units / machine.closure.pace])
    )
    scale = _LEAST * np.outer(least, 1.0 / sizes)
    follower = _Follower(tangent, base, directions, chart, way, time, states, scale, accuracy)
    return Followed(time[::2], layout.view(rows[::2]), follower.run(), notes)


def _beside_dead_centres(chart: Chart, time: Array, q: Array) -> None:
    """Raise where active coordinates do not describe a motion (N, nq)."""
    every = max(1, len(q) // _LOOKED)
    for at, posture in zip(time[::every], q[::every], strict=True):
        if chart.steepest(posture) > chart.limits[0]:
            raise SimulationError(
                f"at t = {at:.4g} s the active coordinates come near a dead centre, where nothing "
                "depends on them smoothly: drive other joints, or end before"
            )


def _moved(directions: Setup) -> Setup:
    """Which numbers change in some of p directions, 1 or 0."""
    flat = (np.any(part != 0, axis=tuple(range(part.ndim - 1))) for part in directions)
    return Setup(*(part.astype(np.float64) for part in flat))


class _Nodes(NamedTuple):
    """Where a stretch of n steps is looked at: their ends and their middles.

    Attributes:
        times: (2 n + 1,) [s].
        states: (2 n + 1, .).
        references: (2 n + 1, c).
        moved: (p, 2 n + 1, c) how these change.
    """

    times: Array
    states: Array
    references: Array
    moved: Array

    @property
    def lengths(self) -> Array:
        """(n,) of the steps [s]."""
        lengths: Array = self.times[2::2] - self.times[:-2:2]
        return lengths


class _Follower:
    """The variational equations along a recorded motion, stretch by stretch.

    Steps over which A or B bend too much for the method are taken in parts, along states that are
    simulated anew: where a valve opens or a compensator closes they jump.

    Args:
        tangent: Derivatives of the rate.
        base: Numbers of the simulation.
        directions: p directions of them.
        chart: The machine.
        way: What integrates it.
        times: (2 N + 1,) of instants and the middles between them [s].
        states: (2 N + 1, .) there.
        scale: (m, p) what is taken for no smaller.
        accuracy: See `follow`.
    """

    def __init__(
        self,
        tangent: Tangent,
        base: Setup,
        directions: Setup,
        chart: Chart,
        way: Way,
        times: Array,
        states: Array,
        scale: Array,
        accuracy: float,
    ):
        self._tangent, self._base, self._directions = tangent, base, directions
        self._chart, self._way, self._times, self._states = chart, way, times, states
        self._sticking, self._step = chart.sticking, float(times[2] - times[0])
        self._scale = np.maximum(np.abs(directions.start.T), scale)
        self._accuracy = accuracy
        self._switches = [*chart.sticking.switches[1:]]
        self._rest = False
        if chart.sticking.switches:
            self._adopt(chart.sticking.switches[0])

    def run(self) -> Array:
        """Derivatives (N + 1, k, p) of the outputs."""
        count, k = len(self._times) // 2, len(self._tangent.outputs)
        now = self._directions.start.T.copy()
        out = np.empty((count + 1, k, now.shape[1]))
        first = 0
        while first < count:
            last, switch = min(first + _CHUNK, count), None
            if self._switches:
                switch = self._switches[0]
                at = int((switch.time - self._times[0]) / self._step + _SAME)
                last = min(last, at)
            if last > first:
                nodes = self._recorded(first, last)
                every, seen = self._followed(nodes, now, _DEEPEST)
                out[first : last + 1] = self._observed(seen[::2, :k], every)
                now, first = every[-1], last
                continue
            nodes = self._recorded(first, first + 1)
            out[first] = self._observed(self._along(nodes)[1][:1, :k], now[None])[0]
            now, first = self._switched(nodes, now), first + 1
            if first == count:
                seen = self._along(self._recorded(count - 1, count))[1]
                out[count] = self._observed(seen[-1:, :k], now[None])[0]
        return out

    def _observed(self, seen: Array, every: Array) -> Array:
        m = self._tangent.size
        out: Array = seen[..., :m] @ every + seen[..., m:]
        return out

    def _recorded(self, first: int, last: int) -> _Nodes:
        """The steps between two instants."""
        some = slice(2 * first, 2 * last + 1)
        references, moved = self._base.references[some], self._directions.references[:, some]
        return _Nodes(self._times[some], self._states[some], references, moved)

    def _simulated(self, state: Array, begins: float, ends: float, last: Array | None) -> _Nodes:
        """Nodes of `_FINER` steps between two times [s], from a state on.

        Args:
            state: At the beginning.
            begins: [s].
            ends: [s].
            last: State at the end, where something starts or stops.
        """
        times = np.linspace(begins, ends, 2 * _FINER + 1)
        state, sticking = state.copy(), self._sticking
        kept = sticking.slip.copy(), sticking.held.copy(), sticking.moving
        rows = np.empty((2 * _FINER, len(self._way.last(begins, state))))
        self._way.offset = 0.0
        self._way.run(times[:-1], state, times[1] - times[0], rows)
        sticking.slip[:], sticking.held[:], sticking.moving = kept
        sticking.tell(self._chart.dynamics)
        whole = np.vstack([rows[:, : len(state)], state if last is None else last])
        return _Nodes(times, whole, *self._referred(times))

    def _referred(self, times: Array) -> tuple[Array, Array]:
        """References (n, c) at other times, and how they change (p, n, c)."""
        own, moved = self._base.references, self._directions.references
        at = np.clip(np.searchsorted(self._times, times) - 1, 0, len(self._times) - 2)
        share = ((times - self._times[at]) / (self._times[at + 1] - self._times[at]))[:, None]
        return (
            own[at] + share * (own[at + 1] - own[at]),
            moved[:, at] + share * (moved[:, at + 1] - moved[:, at]),
        )

    def _along(self, nodes: _Nodes) -> tuple[Array, Array]:
        """A and B, derivatives of outputs and margin; see `Tangent.along`."""
        base = self._base._replace(
            numbers=self._chart.dynamics.numbers, references=nodes.references
        )
        directions = self._directions._replace(references=nodes.moved)
        return self._tangent.along(base, nodes.states, directions, self._rest)

    def _followed(self, nodes: _Nodes, now: Array, depth: int) -> tuple[Array, Array]:
        """S (n + 1, m, p) at the ends of a stretch's steps, and what is seen at its nodes."""
        m, (both, seen) = self._tangent.size, self._along(nodes)
        stages = np.stack([both[i : len(both) - 2 + i : 2] for i in range(3)], axis=1)
        phi, psi = steps(stages[..., :m], stages[..., m:], nodes.lengths)
        every = _propagated(phi, psi, now)
        self._scale = np.maximum(self._scale, np.abs(every).max(axis=0))
        if not depth:
            return every, seen
        rough = np.arange(len(phi))
        if len(phi) > 1:
            curve = bent(both)
            error = np.abs(curve[..., :m] @ every[:-1] + curve[..., m:])
            error = error * nodes.lengths[:, None, None]
            rough = np.flatnonzero((error > self._accuracy * self._scale).any(axis=(1, 2)))
        for i in rough.tolist():
            begins, ends = nodes.times[2 * i], nodes.times[2 * i + 2]
            finer = self._simulated(nodes.states[2 * i], begins, ends, nodes.states[2 * i + 2])
            last = self._followed(finer, every[i], depth - 1)[0][-1]
            every[i + 1 :] = _propagated(phi[i + 1 :], psi[i + 1 :], last)
        return every, seen

    def _adopt(self, switch: Switch) -> None:
        """From there on, joints do what a switch says."""
        sticking = self._sticking
        sticking.slip[:], sticking.held[:] = switch.slip, switch.held
        sticking.moving = switch.moving
        sticking.tell(self._chart.dynamics)
        self._rest = bool(switch.held.any())

    def _switched(self, nodes: _Nodes, now: Array) -> Array:
        """S behind a step within which joints start or stop."""
        begins, state = nodes.times[0], nodes.states[0]
        while self._switches and self._switches[0].time < nodes.times[2] - _SAME * self._step:
            switch = self._switches.pop(0)
            if switch.time - begins > _SAME * self._step:
                part = self._simulated(state, begins, switch.time, switch.state)
                now = self._followed(part, now, _DEEPEST - 1)[0][-1]
                begins = switch.time
            now, state = self._jumped(switch, now), switch.state
        part = self._simulated(state, begins, nodes.times[2], nodes.states[2])
        return self._followed(part, now, _DEEPEST - 1)[0][-1]

    def _jumped(self, switch: Switch, now: Array) -> Array:
        """S behind an instant at which joints start or stop.

        With g = 0 what tells when, r the rate before and r_+ behind,

            S_+ = S + (r - r_+) dt/dp,    (g_s r + g_t) dt/dp = -(g_s S + g_p).
        """
        times = switch.time + _MOMENT * self._step * np.array([-1.0, 0.0, 1.0])
        states = np.tile(switch.state, (3, 1))
        nodes = _Nodes(times, states, *self._referred(times))
        paced = (nodes.references[2] - nodes.references[0]) / (times[2] - times[0])
        m, before = self._tangent.size, self._rated(nodes)
        slopes = self._along(nodes)[1][1, -1]
        directions = Setup(*(np.zeros((1, *part.shape[1:])) for part in self._directions))
        directions = directions._replace(references=np.tile(paced, (1, 3, 1)))
        by_time = self._tangent.along(
            self._base._replace(
                numbers=self._chart.dynamics.numbers, references=nodes.references
            ), states, directions, self._rest,
        )[1][1, -1, m]  # fmt: skip
        pace = float(slopes[:m] @ before + by_time)
        self._adopt(switch)
        if not pace:
            return now
        later = -(slopes[:m] @ now + slopes[m:]) / pace
        return now + np.outer(before - self._rated(nodes), later)

    def _rated(self, nodes: _Nodes) -> Array:
        """The rate (m,) at the middle one of three nodes."""
        base = self._base._replace(
            numbers=self._chart.dynamics.numbers,
            references=np.ascontiguousarray(nodes.references[1]),
        )
        return self._tangent.rate(base, np.ascontiguousarray(nodes.states[1]), self._rest)


def _propagated(phi: Array, psi: Array, now: Array) -> Array:
    """S (n + 1, m, p) from one on."""
    every = [now]
    for one, more in zip(phi, psi, strict=True):
        every.append(one @ every[-1] + more)
    return np.array(every)
