"""Motion in time by scipy's adaptive methods."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from crane.common.errors import ClosureError
from crane.common.samples import Array
from crane.control import Controller
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.halt import HaltedError
from crane.simulation.integration.stepwise import Progress
from crane.simulation.integration.sticking import NEAR, located
from crane.simulation.integration.switching import Switching

# of a passive joint in rad and shares of the machine's size per `Closure.pace`: where the branch
# ends they grow beyond bounds
_FASTEST = 300.0
TOLERANCE = 1e-9  # error of a step, per size of the state
_ACCURACY = 1e-2  # of that what matters, likewise; of all else in SI units
ADAPTIVE = ("RK23", "RK45", "DOP853", "Radau", "BDF", "LSODA")


class AdaptiveSteps(Switching):
    """An adaptive method with dense output, loops closed to rounding at the recorded instants.

    Args:
        chart: The machine.
        control: Its controller.
        own: Number of the controller's states.
        method: One of `ADAPTIVE`.
        tolerance: Error of a step, per size of the state.
    """

    def __init__(
        self,
        chart: Chart,
        control: Controller,
        own: int,
        method: str,
        tolerance: float = TOLERANCE,
    ):
        self._tolerance = tolerance
        super().__init__(chart, control, own, None)
        self._chart, self._closure, self._method = chart, chart.machine.closure, method
        self._next = 0.0

    def run(
        self, times: Array, state: Array, step: float, rows: Array, progress: Progress = None
    ) -> int:
        """See `Steps.run`.

        Raises:
            HaltedError: The method gives up, or the loops cannot be closed any more.
        """
        first = times[0] if len(times) else self._next
        self.done = self.reached = 0
        self._begin(first + self.offset, state)
        self._next = first + step * len(times)
        instants = np.append(times, self._next)
        while self.reached < len(times) or self.offset < 0:
            begun = instants[self.reached] + self.offset
            if not self._until(begun, instants, state, rows, progress):
                break
            self.offset = self._left(self.offset, step)
        return self.reached

    def _until(
        self, begun: float, instants: Array, state: Array, rows: Array, progress: Progress
    ) -> bool:
        """Integrate to the last instant, or to where a joint starts or stops.

        Returns:
            False where other coordinates are better.
        """
        from scipy import integrate

        closure, end = self._closure, instants[-1]
        units, pace, view = closure.units, closure.pace, self.slow.layout.view

        def rate(time: float, state: Array) -> Array:
            closed = state.copy()  # at postures that are none gamma is not that of the machine
            q = view(closed).q
            with suppress(ClosureError):  # of a trial beyond where they close
                q[:] = closure.solve(q[closure.active])
            return self.slow.observe(time, closed)[0]

        enough = np.full(len(state), _ACCURACY * self._tolerance)
        view(enough).q[:] *= units
        view(enough).v_a[:] *= units[closure.active] / pace
        method: Any = getattr(integrate, self._method)
        solver = method(rate, begun, state.copy(), end, rtol=self._tolerance, atol=enough)
        rate(begun, state)  # the solver's last look may have been beside
        before = self.slow.margin
        while solver.status == "running":
            with np.errstate(all="ignore"):  # where a trial explodes the method gives up by itself
                message = solver.step()
            if message is not None:
                what = f" {self._method} gives up: {message.rstrip('.').lower()}"
                here = self.slow.here(solver.y)
                raise HaltedError(float(solver.t), here, what, ", try another method")
            self._calm(solver.t, solver.y)
            within, start = solver.dense_output(), float(solver.t_old)

            def trial(part: float, within: Any = within, start: float = start) -> Any:
                there = within(start + part)
                rate(start + part, there)
                return there, self.slow.margin

            rate(solver.t, solver.y)
            after, until, stop = self.slow.margin, float(solver.t), None
            if after < -NEAR and self._sticking.columns:
                later, stop = located(trial, before, until - start, after)
                until = start + later
            self._record(instants, until, within, state, rows)
            if progress is not None:
                progress(self.reached)
            if stop is not None:
                state[:] = stop
                self._close(until, state)
                self._settle(until, state)
                self.reached = self.done
                self.offset = until - instants[self.reached]
                return True
            before = after
            if min(self.slow.limits[0] - self._chart.steepest(view(solver.y).q), 1.0) < 0:
                return False
        return True

    def _calm(self, time: float, state: Array) -> None:
        """See that no passive joint moves beyond bounds.

        Raises:
            HaltedError: One does.
        """
        closure, at = self._closure, self.slow.layout.view(state)
        speed = np.inf
        with suppress(ClosureError):
            rates = closure.gamma(at.q)[closure.passive] @ at.v_a / closure.units[closure.passive]
            speed = closure.pace * float(np.abs(rates).max(initial=0.0))
        if not speed < _FASTEST:
            pace = closure.pace
            fastest = f"{_FASTEST / pace:.3g} rad/s or {_FASTEST * closure.size / pace:.3g} m/s"
            what = f" the motion explodes (a passive joint exceeds {fastest})"
            here = self.slow.here(state)
            raise HaltedError(time, here, what, ": look at its forces and gains")

    def _record(
        self,
        instants: Array,
        until: float,
        within: Callable[[float], Array],
        state: Array,
        rows: Array,
    ) -> None:
        """Fill the rows of the instants up to one [s], and go on to the last of them."""
        for k in range(self.done, len(instants)):
            time = instants[k]
            if time > until:
                break
            sample = within(time)
            self._close(time, sample)
            state[:] = sample
            self.reached, self.offset = k, 0.0
            if k < len(rows):
                rows[k] = [*sample, *self.slow.observe(time, sample)[1]]
                self.done = k + 1

    def _close(self, time: float, state: Array) -> None:
        """Close a state's loops.

        Raises:
            HaltedError: They do not close.
        """
        q, closure = self.slow.layout.view(state).q, self._closure
        try:
            q[:] = closure.solve(q[closure.active], guess=q)
        except ClosureError as error:
            raise HaltedError(time, self.slow.here(state), f": {error}") from None
