"""Motion in time by scipy's adaptive methods."""

from collections.abc import Callable
from typing import Any

import numpy as np

from crane.control import Controller
from crane.dynamics import Dynamics
from crane.errors import SimulationError
from crane.integration.stepwise import PythonStepper
from crane.samples import Array

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

    chosen: Any = method
    result = solve_ivp(
        rate, (0.0, times[-1]), state, method=chosen, t_eval=times, rtol=1e-9, atol=1e-11
    )
    if not result.success:
        raise SimulationError(
            f"at t = {result.t[-1] if len(result.t) else 0.0:.6g} s {method} gives up: "
            f"{result.message.rstrip('.').lower()}, try another method"
        )
    closure, nq = dynamics.machine.closure, dynamics.machine.model.nq
    rows = []
    for time, sample in zip(times, result.y.T, strict=True):
        sample[:nq] = closure.solve(sample[:nq][closure.active], guess=sample[:nq])
        rows.append(np.concatenate([sample, stepper.observe(time, sample)[1]]))
    return np.array(rows)
