"""Motion through dead centres: in other coordinates where those at hand fail."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Protocol

import numpy as np

from crane.codegen import Number, Tape
from crane.common.samples import Array
from crane.common.threads import one_thread
from crane.control import At, Controller, TracedController, ValveDrive
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.halt import HaltedError
from crane.simulation.integration.passage import (
    BEFORE,
    BEHIND,
    CROSSING,
    FINE,
    NODES,
    Path,
    ahead,
    corrected,
    rank,
)
from crane.simulation.integration.state import row_layout
from crane.simulation.integration.stepwise import Progress, PythonStepper

_WIDER = np.array([2.0, 0.1])  # how limits move where nothing is better
_RECENT = 500  # states that are kept
_SAME = 1e-6  # rad, machine's size, between a posture as foreseen and as closed
_DEAD = 10.0  # how many times better others are at a dead centre
_AT_A_HALT = 1.5  # how many times better other coordinates are that are tried where it halts


class Way(Protocol):
    """What integrates in one chart: `Steps`, `StiffSteps`, `ExplicitSteps`, `AdaptiveSteps`."""

    done: int
    offset: float  # when the state is, after the next instant without a row [s]
    slow: PythonStepper

    @property
    def reached(self) -> int:
        """See `Steps`."""

    def run(
        self, times: Array, state: Array, step: float, rows: Array, progress: Progress = None
    ) -> int:
        """See `Steps.run`."""

    def last(self, time: float, state: Array) -> Array:
        """See `Steps.last`."""

    def finer(self, times: Array, rows: Array, step: float) -> float:
        """See `Steps.finer`."""

    def limit(self, limits: Array) -> None:
        """See `Steps.limit`."""


class ChartedSteps:
    """Steps in the user's coordinates, and in others where these come to a dead centre.

    Rows are in the user's coordinates throughout: a velocity of theirs is C v_B, a friction of
    theirs C^-T times that of the chart, see `crane.simulation.integration.charts`.

    Args:
        chart: The machine in the user's coordinates.
        control: Its controller.
        own: Number of the controller's states.
        make: What integrates in a chart.

    Attributes:
        done: Number of instants that have their row, after a run or where it halted.
        notes: What is to be said of the motion.
    """

    def __init__(self, chart: Chart, control: Controller, own: int, make: Callable[[Chart], Way]):
        self._make, self._control = make, control
        self._chart, self._way = chart, make(chart)
        self._limits = chart.limits
        self._made = [(chart, self._way)]
        self._layout = row_layout(chart.machine, control, own)
        self._first = self.done = 0
        self._recent = np.zeros((0, self._layout.start("tau")))
        self.notes: list[str] = []
        self._side, self._turned_back = 1.0, False

    def run(
        self, times: Array, state: Array, step: float, rows: Array, progress: Progress = None
    ) -> None:
        """Integrate from each of the times to the next; see `Steps.run` for arguments.

        Raises:
            HaltedError: The machine cannot go on, in no coordinates.
        """
        with one_thread(self._chart.machine.model.nv):
            self._run(times, state, step, rows, progress)

    def _run(
        self, times: Array, state: Array, step: float, rows: Array, progress: Progress
    ) -> None:
        i = self.done = 0
        while i < len(times) or self._way.offset < 0:
            self._first, halt = i, None
            made = self._way.done = 0
            try:
                made = self._way.run(times[i:], state, step, rows[i:], self._from(i, progress))
            except HaltedError as error:
                made, halt = self._way.reached, error
            finally:  # also where it is interrupted
                self.done = i + self._way.done
                last = rows[i + max(made - _RECENT, 0) : i + made, : len(state)]
                self._recent = np.vstack([self._recent, last])[-_RECENT:]
                self._seen(times[i : self.done], rows[i : self.done])
            i += made
            if i == len(times) and not self._way.offset < 0:
                continue
            if self._turned(times[0] + i * step, state, halt):
                continue
            behind = self._crossed(times, i, state, step, rows)
            if behind is not None:
                i = behind
            elif halt is not None:
                raise halt
            else:
                self._limits = self._limits * _WIDER
                self._way.limit(self._limits)

    def last(self, time: float, state: Array) -> Array:
        """See `Steps.last`."""
        row = self._way.last(time, state)
        self._seen(np.array([time]), row[None])
        return row

    def finer(self, times: Array, rows: Array, step: float) -> float:
        """See `Steps.finer`."""
        if not self._chart.own:
            return 0.0
        return self._way.finer(times[self._first :], rows[self._first :], step)

    def _from(self, first: int, progress: Progress) -> Progress:
        return None if progress is None else lambda done: progress(first + done)

    def _turned(self, time: float, state: Array, halt: HaltedError | None) -> bool:
        """Whether there are better coordinates, which the state then is in."""
        at = self._layout.view(np.resize(state, self._layout.size))
        chart = self._chart
        other = chart.other(at.q) if halt is None else chart.other(at.q, _AT_A_HALT)
        if other is None:
            return False
        if self._inverted:
            if halt is not None and chart.other(at.q, _DEAD) is not None:
                raise self._dead(time, at.q, other)
            return False
        before = self._side * self._facing(at.q)
        self._enter(self._known(other, at.q), self._way.offset)
        self._side = before * self._facing(at.q)
        self._recent = self._moved(np.vstack([self._recent, state]), chart)
        state[:], self._recent = self._recent[-1], self._recent[:-1]
        return True

    def _crossed(self, times: Array, i: int, state: Array, step: float, rows: Array) -> int | None:
        """Go on across a posture where branches of motion cross, if there is one ahead.

        Args:
            times: See `run`.
            i: The first instant not before the state.
            state: Replaced by that at the instant that is returned, if it is one.
            step: [s].
            rows: See `run`.

        Returns:
            The first instant behind the crossing.
        """
        chart, way, size, recent = self._chart, self._way, len(state), self._recent
        machine, now = chart.machine, times[0] + i * step + way.offset
        ahead_of = self._ahead(now, state, times[0] + (i - 1) * step)
        if ahead_of is None:
            return None
        crossing, speed = ahead_of
        share = max(1, int(np.ceil(step * speed / FINE)))
        stride = max(1, min(int(np.ceil(FINE / (step * speed))), len(recent) // (NODES + BEFORE)))
        fine = step / share
        until = crossing - BEFORE * stride * fine
        first = int((until - NODES * stride * fine - times[0]) // step)
        if not i - len(recent) <= first < i:
            return None
        # again up to it, with nodes far enough from it
        kept, offset = state.copy(), way.offset
        state[:], way.offset = recent[first - i], 0.0
        way.limit(np.array([np.inf, -np.inf]))
        instants = np.arange(times[first], until, fine)
        near = np.empty((len(instants), rows.shape[1]))
        made = 0
        with suppress(HaltedError):
            made = way.run(instants, state, fine, near)
        way.limit(self._limits)
        behind = float(crossing + BEHIND * stride * fine)
        if made == len(instants):
            nodes = slice(len(instants) - 1 - (NODES - 1) * stride, None, stride)
            path = ahead(instants[nodes], near[nodes, :size], way.slow.observe)
            q = self._layout.view(np.resize(path.state(behind), self._layout.size)).q
            other = chart.moved(q, machine.closure.active)
            units = machine.closure.units
            if other is not None and np.abs((other.machine.home - q) / units).max() < _SAME:
                self._enter(self._known(other, q), 0.0)
                path = corrected(path, behind, self._way.slow.observe)
                return self._behind(path, behind, fine, times, state, step, rows)
        state[:], way.offset = kept, offset
        return None

    def _ahead(self, now: float, state: Array, before: float) -> tuple[float, float] | None:
        """When branches cross ahead of a state, and how fast the fastest joint moves there.

        Args:
            now: Time of the state [s].
            state: The state.
            before: Time of the last of the recent states [s].
        """
        chart, closure = self._chart, self._chart.machine.closure
        if not closure.compiled or not len(self._recent):
            return None
        at, last = (
            self._layout.view(np.resize(one, self._layout.size))
            for one in (state, self._recent[-1])
        )
        here, there = closure.fast.edge(at.q), closure.fast.edge(last.q)
        if not (now > before and 0.0 < here < there):
            return None
        left = here / (there - here) * (now - before)
        v = closure.gamma(at.q) @ at.v_a
        speed = float(np.abs(v / closure.units).max())
        home = self._made[0][0].machine
        flat = rank(chart.machine, at.q + left * v) < CROSSING * rank(home, home.home)
        return (now + left, speed) if flat and left * speed < 3.0 * FINE else None

    def _behind(
        self,
        path: Path,
        behind: float,
        fine: float,
        times: Array,
        state: Array,
        step: float,
        rows: Array,
    ) -> int:
        """Record a path across a crossing, and go on to the first instant behind it.

        Raises:
            HaltedError: It does not go on there.
        """
        first = int(np.searchsorted(times, path.times[path.before - 1], side="right"))
        i = int(np.searchsorted(times, behind))
        for k in range(first, i):
            rows[k] = [*path.state(times[k]), *path.observed(times[k])]
        self.done = i
        self._seen(times[first:i], rows[first:i])
        self._recent = self._recent[:0]
        until = times[0] + i * step
        state[:] = path.state(behind)
        if until - behind > 1e-6 * fine:
            part = (until - behind) / np.ceil((until - behind) / fine)
            instants = np.arange(behind, until - 0.5 * part, part)
            self._way.run(instants, state, part, np.empty((len(instants), rows.shape[1])))
            if self._way.offset < 0:
                raise self._way.slow.stopped(behind, state)
        self.notes.append(
            f"at t = {behind:.4g} s the linkage passes a posture from which it could go on in "
            "several ways: it goes on as it moves"
        )
        return i

    def _enter(self, known: tuple[Chart, Way], offset: float) -> None:
        """Go on in a chart, from so long after the next instant [s]."""
        self._chart, self._way = known
        self._limits, self._way.offset = self._chart.limits, offset
        self._way.limit(self._limits)

    def _moved(self, states: Array, before: Chart) -> Array:
        """States (N, .) in the present chart that are in the one before."""
        nq, n = before.machine.model.nv, len(before.seen)
        out = states.copy()
        gamma = before.machine.closure.gamma(states[:, :nq])[:, self._chart.machine.closure.active]
        out[:, nq : nq + n] = np.einsum("nij,nj->ni", gamma, states[:, nq : nq + n])
        return out

    def _known(self, chart: Chart, q: Array) -> tuple[Chart, Way]:
        """A chart of the same coordinates and branch that was there before, or this one."""
        active = chart.machine.closure.active
        for before, way in self._made:
            closure = before.machine.closure
            if np.array_equal(closure.active, active) and closure.on_branch(q):
                return before, way
        made = chart, self._make(chart)
        self._made.append(made)
        return made

    def _facing(self, q: Array) -> float:
        """The sign of det C at a closed posture (nq,): it changes at the user's dead centres."""
        return 1.0 if self._chart.own else float(np.linalg.slogdet(self._chart.turns(q))[0])

    def _seen(self, times: Array, rows: Array) -> None:
        """Put rows (N, .) at times (N,) [s] into the user's coordinates."""
        chart = self._chart
        if chart.own or not len(rows):
            return
        at = self._layout.view(rows)
        turns = chart.turns(at.q)
        behind = np.flatnonzero(self._side * np.linalg.slogdet(turns)[0] < 0)
        if len(behind) and not self._turned_back:
            self._turned_back, user = True, self._made[0][0].machine
            gone = np.setdiff1d(user.closure.active, chart.machine.closure.active)
            names = " and ".join(f"'{user.joints[i]}'" for i in gone)
            verb = "pass" if len(gone) > 1 else "passes"
            self.notes.append(
                f"{names} {verb} a dead centre at t = {times[behind[0]]:.4g} s: from there on "
                "active coordinates alone do not tell the posture, take passive joints with them"
            )
        at.v_a[:] = np.einsum("nij,nj->ni", turns, at.v_a)
        back = np.swapaxes(turns, 1, 2)
        at.friction[:] = np.einsum("nij,nj->ni", np.linalg.pinv(back), at.friction)

    @property
    def _inverted(self) -> bool:
        """Whether the controller asks for inverse dynamics or weight, of its own coordinates."""
        control, asked = self._control, 0
        if isinstance(control, ValveDrive) or not isinstance(control, TracedController):
            return False
        n, tape = len(self._chart.seen), Tape()

        def inverse(a_a: Sequence[Number], friction: bool) -> list[Number]:
            nonlocal asked
            asked += 1
            return tape.loads(5, n * asked, n)  # others each time: laws divide by differences

        def gravity() -> list[Number]:
            return inverse([], False)

        columns = control.references(np.zeros(1)).shape[1]
        sizes = n, n, self._layout.parts["own"], len(control.settings), columns
        q_a, v_a, state, settings, reference = (tape.loads(i, 0, x) for i, x in enumerate(sizes))
        control.trace(At(q_a, v_a, state, settings, reference, inverse, gravity))
        return asked > 0

    def _dead(self, time: float, q: Array, other: Chart) -> HaltedError:
        """What to say of coordinates that the controller cannot do without."""
        machine = self._chart.machine
        gone = np.setdiff1d(machine.closure.active, other.machine.closure.active)
        names = " and ".join(f"'{machine.joints[i]}'" for i in gone)
        verb = "come" if len(gone) > 1 else "comes"
        return HaltedError(
            time,
            q[self._chart.seen],
            f": {names} {verb} to a dead centre, where inverse dynamics has no answer",
            ": keep the reference away from there, or drive other joints",
        )
