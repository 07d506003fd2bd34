"""Motion in time by scipy's adaptive methods."""

from contextlib import suppress
from typing import Any

import numpy as np

from crane.common.errors import ClosureError
from crane.common.samples import Array
from crane.control import Controller
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.halt import HaltedError
from crane.simulation.integration.stepwise import Progress, PythonStepper

# of a passive joint in rad and shares of the machine's size per `Closure.pace`: where the branch
# ends they grow beyond bounds
_FASTEST = 300.0
_ACCURACY = 1e-11  # that matters, likewise; of all else in SI units
ADAPTIVE = ("RK23", "RK45", "DOP853", "Radau", "BDF", "LSODA")


class AdaptiveSteps:
    """An adaptive method with dense output, loops closed to rounding at the recorded instants.

    Args:
        chart: The machine.
        control: Its controller.
        own: Number of the controller's states.
        method: One of `ADAPTIVE`.

    Attributes:
        slow: Observes.
        done: Number of instants that have their row.
        reached: Index of the instant of the state.
    """

    done = reached = 0
    offset = 0.0

    def __init__(self, chart: Chart, control: Controller, own: int, method: str):
        self.slow = PythonStepper(chart, control, own)
        self._chart, self._closure, self._method = chart, chart.machine.closure, method

    def limit(self, limits: Array) -> None:
        """See `Steps.limit`."""
        self.slow.limits = limits

    def last(self, time: float, state: Array) -> Array:
        """See `Steps.last`."""
        return np.concatenate([state, self.slow.observe(time, state)[1]])

    def finer(self, times: Array, rows: Array, step: float) -> float:
        """No step: the method has found the finest itself."""
        return 0.0

    def run(
        self, times: Array, state: Array, step: float, rows: Array, progress: Progress = None
    ) -> int:
        """See `Steps.run`.

        Raises:
            HaltedError: The method gives up, or the loops cannot be closed any more.
        """
        from scipy.integrate import solve_ivp

        closure, end = self._closure, times[0] + step * len(times)
        units, pace = closure.units, closure.pace
        view = self.slow.layout.view

        def rate(time: float, state: Array) -> Array:
            if progress is not None:
                progress(int(min(max(time - times[0], 0.0) / step, len(times))))
            closed = state.copy()  # at postures that are none gamma is not that of the machine
            q = view(closed).q
            with suppress(ClosureError):  # of a trial beyond where they close
                q[:] = closure.solve(q[closure.active])
            return self.slow.observe(time, closed)[0]

        def calm(time: float, state: Array) -> float:
            at = view(state)
            try:
                gamma = closure.gamma(at.q)[closure.passive]
            except ClosureError:
                return -_FASTEST
            rates = gamma @ at.v_a / units[closure.passive]
            return _FASTEST - pace * float(np.abs(rates).max(initial=0.0))

        def gentle(time: float, state: Array) -> float:
            return min(self.slow.limits[0] - self._chart.steepest(view(state).q), 1.0)

        enough = np.full(len(state), _ACCURACY)
        view(enough).q[:] *= units
        view(enough).v_a[:] *= units[closure.active] / pace
        calm.terminal = gentle.terminal = True  # type: ignore[attr-defined]
        gentle.direction = -1.0  # type: ignore[attr-defined]
        self.done = self.reached = 0
        method: Any = self._method
        with np.errstate(all="ignore"):  # where a trial explodes the method gives up by itself
            result: Any = solve_ivp(
                rate, (times[0], end), state, method=method, t_eval=[*times, end],
                rtol=1e-9, atol=enough, events=(calm, gentle),
            )  # fmt: skip
        if result.status == 1 and len(result.t_events[0]):
            q_a = self.slow.here(result.y_events[0][0])
            fastest = f"{_FASTEST / pace:.3g} rad/s or {_FASTEST * closure.size / pace:.3g} m/s"
            what = f" the motion explodes (a passive joint exceeds {fastest})"
            raise HaltedError(result.t_events[0][0], q_a, what, ": look at its forces and gains")
        if not result.success:
            last = float(result.t[-1]) if len(result.t) else 0.0
            here = self.slow.here(result.y[:, -1] if len(result.t) else state)
            what = f" {self._method} gives up: {result.message.rstrip('.').lower()}"
            raise HaltedError(last, here, what, ", try another method")
        for time, row, sample in zip([*times, end], [*rows, None], result.y.T, strict=False):
            q = view(sample).q
            try:
                q[:] = closure.solve(q[closure.active], guess=q)
            except ClosureError as error:
                raise HaltedError(time, self.slow.here(sample), f": {error}") from None
            state[:] = sample
            self.reached = self.done
            if row is not None:
                row[:] = [*sample, *self.slow.observe(time, sample)[1]]
                self.done += 1
        return self.reached
