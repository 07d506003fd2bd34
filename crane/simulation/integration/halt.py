"""Why a motion cannot go on: the step, a limit that was passed, or loops that do not close."""

import numpy as np

from crane.common.errors import SimulationError
from crane.common.samples import Array
from crane.machine import Machine
from crane.motion.curves import Trajectory
from crane.motion.limits import limit_slack


class HaltedError(SimulationError):
    """A step that cannot be taken.

    Args:
        time: When [s].
        q_a: (n,) active coordinates there.
        what: What happened, to be read after the time.
        otherwise: What to do where no limit was passed and no shorter step helps.

    Attributes:
        time: See above.
        q_a: See above.
        otherwise: See above.
    """

    def __init__(
        self,
        time: float,
        q_a: Array,
        what: str,
        otherwise: str = ", with all active joints within their limits: keep away from there, "
        "'crane workspace' shows where the loops close",
    ):
        super().__init__(f"at t = {time:.6g} s{what}")
        self.time, self.q_a, self.otherwise = time, np.array(q_a), otherwise


def explained(
    machine: Machine,
    halt: HaltedError,
    times: Array,
    q_a: Array,
    reference: Trajectory | None = None,
    finer: float = 0.0,
) -> SimulationError:
    """A halt with its cause, as far as it can be told.

    Args:
        machine: The machine.
        halt: What happened.
        times: (N,) of the motion so far [s]; empty where it is not known.
        q_a: (N, n) active coordinates then.
        reference: The reference, if there is one.
        finer: A step with which the motion goes on [s]; 0 where that has not been found.
    """
    if finer:
        hint = f"; with a step of {finer:g} s it goes on: shorten the step"
        return SimulationError(f"{halt}{hint}")
    passed = _passed(machine, halt, times, q_a, reference)
    return SimulationError(f"{halt}{passed or halt.otherwise}")


def _passed(
    machine: Machine, halt: HaltedError, times: Array, q_a: Array, reference: Trajectory | None
) -> str:
    """The active joint that is farthest beyond its limit, and since when; perhaps nothing."""
    lower, upper = machine.lower, machine.upper
    excess = np.maximum(lower - halt.q_a, halt.q_a - upper)
    active = machine.closure.active
    span = np.where(np.isfinite(upper - lower), upper - lower, machine.closure.units[active])
    i = int(np.argmax(excess / span))
    slack = limit_slack(machine)[active[i]]
    if not excess[i] > slack:
        return ""
    joint, unit, value = machine.active[i], machine.unit(machine.active[i]), halt.q_a[i]
    limit = lower[i] if value < lower[i] else upper[i]
    text = f"; '{joint}' is at {value:.6g} {unit}, beyond its limit {limit:.6g} {unit}"
    if len(times):
        outside = (q_a[:, i] < lower[i] - slack) | (q_a[:, i] > upper[i] + slack)
        inside = np.flatnonzero(~outside)
        first = int(inside[-1]) + 1 if len(inside) else 0
        since = times[first] if first < len(times) else halt.time
        text += f" since t = {since:.4g} s"
    stopped = any(stop.joint == joint for stop in machine.end_stops)
    remedy = "stiffen its end stop" if stopped else "give it an end stop"
    if reference is not None:
        wanted = float(reference.position(halt.time)[i])
        if not lower[i] - slack <= wanted <= upper[i] + slack:
            remedy = f"keep its reference ({wanted:.6g} {unit}) within the limits, or {remedy}"
    return f"{text}: {remedy}"
