"""Motion in time by scipy's adaptive methods."""

from collections.abc import Callable
from typing import Any

import numpy as np

from crane.control import Controller
from crane.dynamics import Dynamics
from crane.errors import ClosureError
from crane.integration.halt import HaltedError, explained
from crane.integration.stepwise import PythonStepper
from crane.samples import Array

_FASTEST = (
    300.0  # [rad/s], [m/s] of a passive joint: where the branch ends they grow beyond bounds
)
ADAPTIVE = ("RK23", "RK45", "DOP853", "Radau", "BDF", "LSODA")


def integrate_adaptively(
    dynamics: Dynamics,
    control: Controller,
    state: Array,
    steps: int,
    step: float,
    method: str,
    progress: Callable[[float], None] | None = None,
) -> Array:
    """States and observations every `step` by an adaptive method with dense output.

    The loops are closed to rounding at the recorded instants.

    Args:
        dynamics: The machine.
        control: Its controller.
        state: At the start.
        steps: Number of recorded intervals.
        step: [s].
        method: One of `ADAPTIVE`.
        progress: Called with the finished share, 0 to 1.

    Returns:
        (steps + 1, .) rows as `CompiledStepper.run` writes them.

    Raises:
        SimulationError: The method gives up, or the loops cannot be closed any more.
    """
    from scipy.integrate import solve_ivp

    stepper = PythonStepper(dynamics, control)
    times = step * np.arange(steps + 1, dtype=np.float64)

    def rate(time: float, state: Array) -> Array:
        if progress is not None:
            progress(min(time / times[-1], 1.0))
        return stepper.observe(time, state)[0]

    machine = dynamics.machine
    closure, nq = machine.closure, machine.model.nq

    def calm(time: float, state: Array) -> float:
        try:
            gamma = closure.gamma(state[:nq])[closure.passive]
        except ClosureError:
            return -_FASTEST
        speeds = gamma @ state[nq : nq + len(machine.active)]
        return _FASTEST - float(np.abs(speeds).max(initial=0.0))

    calm.terminal = True  # type: ignore[attr-defined]
    chosen: Any = method
    try:
        result: Any = solve_ivp(
            rate, (0.0, times[-1]), state, method=chosen, t_eval=times, rtol=1e-9, atol=1e-11,
            events=calm,
        )  # fmt: skip
        if result.status == 1:
            q_a = result.y_events[0][0][:nq][closure.active]
            what = f" the motion explodes (a passive joint exceeds {_FASTEST:g} m/s or rad/s)"
            raise HaltedError(result.t_events[0][0], q_a, what, ": look at its forces and gains")
        if not result.success:
            last = float(result.t[-1]) if len(result.t) else 0.0
            q = result.y[:nq, -1] if len(result.t) else state[:nq]
            reason = result.message.rstrip(".").lower()
            what = f" {method} gives up: {reason}"
            raise HaltedError(last, q[closure.active], what, ", try another method")
        rows = []
        for time, sample in zip(times, result.y.T, strict=True):
            q_a = sample[:nq][closure.active]
            try:
                sample[:nq] = closure.solve(q_a, guess=sample[:nq])
            except ClosureError as error:
                raise HaltedError(time, q_a, f": {error}") from None
            rows.append(np.concatenate([sample, stepper.observe(time, sample)[1]]))
    except HaltedError as halt:
        before = np.zeros(0), np.zeros((0, len(machine.active)))
        raise explained(machine, halt, *before, control.path) from None
    return np.array(rows)
