"""Steps of a simulation, and why they end before its time."""

from collections.abc import Callable
from contextlib import suppress

import numpy as np

from crane.control import Controller, StiffController, TracedController
from crane.dynamics import Dynamics
from crane.errors import ClosureError, InputError
from crane.integration import (
    CompiledStepper,
    HaltedError,
    PythonStepper,
    StiffStepper,
    explained,
    integrate_adaptively,
)
from crane.samples import Array
from crane.simulation.recorded import ENERGIES
from crane.straight import TooLongError

Progress = Callable[[float], None]

_CHUNK = 1000  # steps between reports of progress
_BACK, _AHEAD = 40, 20  # steps before and after a halt that are done anew with finer ones
_FINER = (2, 8)  # how much finer


def integrate(
    dynamics: Dynamics,
    control: Controller,
    state: Array,
    steps: int,
    step: float,
    progress: Progress | None,
) -> Array:
    """States and observations [tau, friction, kinetic, potential] at all instants.

    Raises:
        SimulationError: The motion cannot go on, with the cause.
    """
    size = len(state)
    width = 2 * len(dynamics.machine.active) + ENERGIES + len(getattr(control, "channels", ()))
    rows = np.empty((steps + 1, size + width))
    run = _Fixed(dynamics, control, size)
    try:
        run.steps(0.0, state, step, rows, progress)
    except HaltedError as halt:
        done = run.done
        finer = 0.0
        for share in _FINER:
            back = max(0, done - _BACK)
            count = share * (min(done + _AHEAD, steps) - back)
            again = np.empty((count + 1, size + width))
            with suppress(HaltedError):
                run.steps(back * step, rows[back, :size].copy(), step / share, again, None)
                finer = step / share
                break
        q_a = rows[: done + 1, :size][:, dynamics.machine.closure.active]
        times = step * np.arange(done + 1, dtype=np.float64)
        raise explained(dynamics.machine, halt, times, q_a, control.path, finer) from None
    return rows


class _Fixed:
    """Steps of one length, in machine code where that can be.

    Args:
        dynamics: The machine.
        control: Its controller.
        size: Of a state.

    Attributes:
        done: Number of steps done, the last of which has its row.
    """

    def __init__(self, dynamics: Dynamics, control: Controller, size: int):
        self.done = 0
        self._slow = PythonStepper(dynamics, control)
        self._fast: CompiledStepper | None = None
        if (
            dynamics.path == "compiled"
            and isinstance(control, TracedController)
            and not isinstance(control, StiffController)
        ):
            own = size - dynamics.machine.model.nq - len(dynamics.machine.active) - ENERGIES
            with suppress(TooLongError):
                self._fast = CompiledStepper(dynamics, control, own)

    def steps(
        self, start: float, state: Array, step: float, rows: Array, progress: Progress | None
    ) -> None:
        """Fill the rows (steps + 1, .) from a time and a state on.

        Raises:
            HaltedError: A step cannot be taken.
        """
        steps, size = len(rows) - 1, len(state)
        times = start + step * np.arange(steps + 1, dtype=np.float64)
        self.done = 0
        while self.done < steps:
            done = self.done
            rows[done, :size] = state
            stopped = True
            if self._fast is not None:
                chunk = times[done : min(done + _CHUNK, steps)]
                count = self._fast.run(chunk, state, step, rows[done:])
                self.done, stopped = done + count, count < len(chunk)
            if stopped:
                # machine code stops where a step needs a closer look: it succeeds here or says why
                done = self.done
                rows[done, :size] = state
                rate, seen = self._slow.observe(times[done], state)
                rows[done, size:] = seen
                state = self._slow.advance(times[done], state, rate, step)
                self.done += 1
            if progress is not None:
                progress(self.done / (steps + 1))
        rows[steps, :size] = state
        rows[steps, size:] = self._slow.observe(times[steps], state)[1]
        if progress is not None:
            progress(1.0)


def integrate_stiff(
    dynamics: Dynamics,
    control: StiffController,
    state: Array,
    steps: int,
    step: float,
    progress: Progress | None,
) -> Array:
    """As `integrate`, for a controller whose own states are stiff.

    Raises:
        InputError: The controller's period does not go with the step or the path.
        SimulationError: The motion cannot go on, with the cause.
    """
    period = round(control.period / step) if control.period else 0
    if control.period and abs(period * step - control.period) > 1e-9 * control.period:
        raise InputError(
            f"the period {control.period:g} s of the valves' program is no whole number of steps "
            f"of {step:g} s, change one"
        )
    fast = None
    if dynamics.path == "compiled":
        with suppress(TooLongError):
            fast = StiffStepper(dynamics, control)
    if fast is None:
        if period:
            raise InputError("a program with a period runs on the compiled path alone")
        return integrate_adaptively(dynamics, control, state, steps, step, "BDF", progress)
    times = step * np.arange(steps + 1, dtype=np.float64)
    rows = np.empty((steps + 1, len(state) + fast.seen))
    machine = dynamics.machine
    active, nq = machine.closure.active, machine.model.nq
    done = 0
    try:
        while done < steps:
            if period:
                _update(dynamics, control, times[done], state)
            chunk = times[done : min(done + (period or _CHUNK), steps)]
            count = fast.run(chunk, state, step, rows[done:])
            done += count
            if count < len(chunk):
                raise _stopped(dynamics, times[done], state)
            if progress is not None:
                progress(done / (steps + 1))
        slow = PythonStepper(dynamics, control)
        rows[steps] = [*state, *slow.observe(times[steps], state)[1]]
    except HaltedError as halt:
        before = times[:done], rows[:done, :nq][:, active]
        raise explained(machine, halt, *before, control.path) from None
    if progress is not None:
        progress(1.0)
    return rows


def _update(dynamics: Dynamics, control: StiffController, time: float, state: Array) -> None:
    """Let a program look at the machine, which may ask where no posture is."""
    nq, n = dynamics.machine.model.nq, len(dynamics.machine.active)
    try:
        control.update(time, state[:nq], state[nq : nq + n], state[nq + n : -ENERGIES])
    except ClosureError as error:
        q_a = state[:nq][dynamics.machine.closure.active]
        raise HaltedError(time, q_a, f": {error}") from None


def _stopped(dynamics: Dynamics, time: float, state: Array) -> HaltedError:
    """Why the machine cannot go on from a state, whatever the step."""
    machine = dynamics.machine
    nq, n = machine.model.nq, len(machine.active)
    here = state[:nq][machine.closure.active]
    speed = np.abs(state[nq : nq + n]).max()
    # as far as it would have come
    q = here + 1e-3 * state[nq : nq + n]
    try:
        machine.closure.solve(q, guess=state[:nq])
    except ClosureError as error:
        return HaltedError(time, here, f": {error}")
    return HaltedError(
        time,
        here,
        f" the motion cannot be followed, the fastest joint moves at {speed:.3g} m/s or rad/s",
        ": give its end stops damping, or smooth the friction more",
    )
