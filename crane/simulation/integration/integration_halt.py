"""Why a motion cannot go on: the step, a limit that was passed, or loops that do not close."""

import numpy as np

from crane.common.errors import SimulationError
from crane.common.samples import Array
from crane.machine import Machine
from crane.motion.limit_violations import limit_tolerances
from crane.motion.trajectory import Trajectory


class IntegrationHaltError(SimulationError):
    """A step that cannot be taken.

    Args:
        time: When [s].
        q_a: (n,) active coordinates there.
        description: What happened, to be read after the time.
        default_remedy: What to do where no limit was passed and no shorter step helps.

    Attributes:
        time: See above.
        q_a: See above.
        default_remedy: See above.
    """

    def __init__(
        self,
        time: float,
        q_a: Array,
        description: str,
        default_remedy: str = ", with all active joints within their limits: keep away "
        "from there, 'crane workspace' shows where the loops close",
    ):
        super().__init__(f"at t = {time:.6g} s{description}")
        self.time, self.q_a, self.default_remedy = time, np.array(q_a), default_remedy


def explain_halt(
    machine: Machine,
    halt: IntegrationHaltError,
    times: Array,
    q_a: Array,
    reference: Trajectory | None = None,
    finer_step: float = 0.0,
) -> SimulationError:
    """A halt with its cause, as far as it can be told.

    Args:
        machine: The machine.
        halt: What happened.
        times: (N,) of the motion so far [s]; empty where it is not known.
        q_a: (N, n) active coordinates then.
        reference: The reference, if there is one.
        finer_step: A step with which the motion goes on [s]; 0 where that has not been found.
    """
    if finer_step:
        hint = f"; with a step of {finer_step:g} s it goes on: shorten the step"
        return SimulationError(f"{halt}{hint}")
    limit_text = _passed_limit_text(machine, halt, times, q_a, reference)
    return SimulationError(f"{halt}{limit_text or halt.default_remedy}")


def _passed_limit_text(
    machine: Machine,
    halt: IntegrationHaltError,
    times: Array,
    q_a: Array,
    reference: Trajectory | None,
) -> str:
    """The active joint that is farthest beyond its limit, and since when; perhaps nothing."""
    lower, upper = machine.lower, machine.upper
    excess = np.maximum(lower - halt.q_a, halt.q_a - upper)
    active = machine.closure.active
    span = np.where(np.isfinite(upper - lower), upper - lower, machine.closure.units[active])
    i = int(np.argmax(excess / span))
    slack = limit_tolerances(machine)[active[i]]
    if not excess[i] > slack:
        return ""
    joint, unit, value = machine.active[i], machine.unit(machine.active[i]), halt.q_a[i]
    limit = lower[i] if value < lower[i] else upper[i]
    text = f"; '{joint}' is at {value:.6g} {unit}, beyond its limit {limit:.6g} {unit}"
    if len(times):
        outside = (q_a[:, i] < lower[i] - slack) | (q_a[:, i] > upper[i] + slack)
        inside = np.flatnonzero(~outside)
        first = int(inside[-1]) + 1 if len(inside) else 0
        passed_time = times[first] if first < len(times) else halt.time
        text += f" since t = {passed_time:.4g} s"
    has_end_stop = any(stop.joint == joint for stop in machine.end_stops)
    remedy = "stiffen its end stop" if has_end_stop else "give it an end stop"
    if reference is not None:
        reference_value = float(reference.position(halt.time)[i])
        if not lower[i] - slack <= reference_value <= upper[i] + slack:
            remedy = (
                f"keep its reference ({reference_value:.6g} {unit}) within the limits, or {remedy}"
            )
    return f"{text}: {remedy}"
