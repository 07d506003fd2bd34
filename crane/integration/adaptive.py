"""Motion in time by scipy's adaptive methods."""

from typing import Any

from crane.control import Controller
from crane.dynamics import Dynamics
from crane.errors import SimulationError
from crane.integration.stepwise import Progress, PythonStepper
from crane.samples import Array

ADAPTIVE = ("RK23", "RK45", "DOP853", "Radau", "BDF", "LSODA")


class AdaptiveSteps:
    """An adaptive method with dense output, loops closed to rounding at the recorded instants.

    Args:
        dynamics: The machine.
        control: Its controller.
        own: Number of the controller's states.
        method: One of `ADAPTIVE`.

    Attributes:
        slow: Observes.
    """

    def __init__(self, dynamics: Dynamics, control: Controller, own: int, method: str):
        self.slow = PythonStepper(dynamics, control, own)
        self._closure, self._method = dynamics.machine.closure, method

    def run(
        self, times: Array, state: Array, step: float, rows: Array, progress: Progress = None
    ) -> None:
        """See `Steps.run`.

        Raises:
            SimulationError: The method gives up, or the loops cannot be closed any more.
        """
        from scipy.integrate import solve_ivp

        end = times[0] + step * len(times)

        def rate(time: float, state: Array) -> Array:
            if progress is not None:
                progress(int(min(max(time - times[0], 0.0) / step, len(times))))
            return self.slow.observe(time, state)[0]

        method: Any = self._method
        result = solve_ivp(
            rate, (times[0], end), state, method=method, t_eval=[*times, end],
            rtol=1e-9, atol=1e-11,
        )  # fmt: skip
        if not result.success:
            raise SimulationError(
                f"at t = {result.t[-1] if len(result.t) else 0.0:.6g} s {self._method} gives up: "
                f"{result.message.rstrip('.').lower()}, try another method"
            )
        for i, sample in enumerate(result.y.T):
            q = self.slow.layout.view(sample).q
            q[:] = self._closure.solve(q[self._closure.active], guess=q)
            if i < len(times):
                rows[i] = [*sample, *self.slow.observe(times[i], sample)[1]]
        state[:] = result.y[:, -1]
