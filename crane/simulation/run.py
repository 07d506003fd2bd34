"""Motion in time: Runge-Kutta of fourth order on the active coordinates."""

import warnings
from collections.abc import Callable
from contextlib import suppress

import numpy as np
from numpy.typing import ArrayLike

from crane.codegen import TooLongError
from crane.control import (
    Command,
    Controller,
    Feedback,
    Free,
    Signals,
    StiffController,
    TracedController,
    ValveDrive,
)
from crane.dynamics import Dynamics
from crane.errors import ClosureError, CraneWarning, InputError, SimulationError, known
from crane.integration import (
    ADAPTIVE,
    CompiledStepper,
    PythonStepper,
    StiffStepper,
    integrate_adaptively,
)
from crane.machine import Machine
from crane.paths import Path
from crane.recording import Recording
from crane.samples import Array, as_number, as_sample
from crane.simulation.recorded import ENERGIES, imbalance, recorded

_MOST = 4_000_000  # steps of one recording
_CHUNK = 1000  # steps between reports of progress

Force = Callable[[float, Array, Array], Array]
Progress = Callable[[float], None]


def simulate(
    machine: Machine,
    controller: Controller | Command | Force | None = None,
    initial: ArrayLike | tuple[ArrayLike, ArrayLike] | None = None,
    duration: float | None = None,
    step: float = 1e-3,
    *,
    task: str = "",
    path: str = "compiled",
    method: str | None = None,
    formulation: str = "exact",
    progress: Progress | None = None,
) -> Recording:
    """Simulate a machine with its friction, passive forces and end stops.

    M_A a_A = tau_A - bias - friction, integrated as an ordinary differential equation in
    (q_A, v_A), the controller's states and the energies by the classical fourth-order
    Runge-Kutta method with a fixed step (as the reduced-scale forwarder paper does). Within a
    step the passive joints move with gamma v_A; after every step the loops are closed to
    rounding.

    Args:
        machine: The machine.
        controller: A controller, a function (t, q_a, v_a) -> tau_a, or what commands the valves
            of a hydraulic machine (`ValvePD`, `joystick`, `Signals`, `Sampled`). None is no
            force, and valves at their neutral signal where the machine has any.
        initial: Active coordinates (n,) to start at rest from, or a pair (q_a, v_a); the start of
            the controller's path, at rest, or else the home posture.
        duration: [s]; that of the controller's path if not given.
        step: [s].
        task: Name to put into the recording.
        path: "compiled" or "pinocchio", see `Dynamics`.
        method: "rk4"; "rosenbrock" for hydraulic machines, see `StiffStepper`; or one of scipy's
            adaptive methods ("DOP853", "Radau", "LSODA", ...) with relative tolerance 1e-9, whose
            dense output is recorded every `step`. If not given, the one that the controller asks
            for.
        formulation: "exact" or "decoupled", see `Dynamics`.
        progress: Called with the finished share, 0 to 1.

    Returns:
        Recording with channels for every passive joint, the tip, the references of the path,
        friction_<joint>, and the energies kinetic, potential, work (of the active forces) and
        dissipated [J]; work = change of (kinetic + potential) + dissipated, of the exact
        formulation only.

    Raises:
        InputError: Arguments of wrong shape or value.
        LimitError: The start lies outside of the limits.
        SimulationError: The machine reached a posture it cannot go on from.
    """
    if not (isinstance(task, str) and task.isprintable()):
        raise InputError(f"task {task!r} is not one line of text")
    control = _as_controller(controller, machine)
    dynamics = Dynamics(machine, formulation, path)
    _, states, seen = trajectory(dynamics, control, initial, duration, step, method, progress)
    # the energies are integrated with the motion, so they tell when the step is too long
    n = len(machine.active)
    text = imbalance(states[:, -2], seen[:, 2 * n : 2 * n + 2], states[:, -1], step)
    if text and formulation == "exact":
        warnings.warn(text, CraneWarning, stacklevel=2)
    return recorded(machine, control, step, states, seen, task)


def trajectory(
    dynamics: Dynamics,
    controller: Controller | Command | Force | None,
    initial: ArrayLike | tuple[ArrayLike, ArrayLike] | None,
    duration: float | None,
    step: float,
    method: str | None = None,
    progress: Progress | None = None,
) -> tuple[Array, Array, Array]:
    """What `simulate` computes, without channels; see there for arguments and errors.

    Returns:
        Times (N,); states (N, .) of q (nq), v_A (n), the controller's, work, dissipated;
        observations (N, 2 n + 2) of tau, friction, kinetic, potential.
    """
    machine = dynamics.machine
    control = _as_controller(controller, machine)
    if duration is None:
        if control.path is None:
            raise InputError("no duration and no path to take it from, give a duration")
        duration = control.path.duration
    steps = _count(duration, step)
    q_a, v_a = _start(machine, initial, control.path)
    state = np.concatenate(
        [machine.closure.solve(q_a), v_a, control.start(q_a), np.zeros(ENERGIES)]
    )
    if method is None:
        method = "rosenbrock" if isinstance(control, StiffController) else "rk4"
    if method != "rosenbrock" and isinstance(control, StiffController) and control.period:
        raise InputError(
            f"method '{method}' does not call the valves' program, leave the method out"
        )
    if method == "rosenbrock" and isinstance(control, StiffController):
        rows = _integrate_stiff(dynamics, control, state, steps, step, progress)
    elif method == "rk4":
        rows = _integrate(dynamics, control, state, steps, step, progress)
    elif method in ADAPTIVE:
        rows = integrate_adaptively(dynamics, control, state, steps, step, method, progress)
    else:
        raise InputError(f"method '{method}' is unknown, {known(('rk4', *ADAPTIVE), method)}")
    times = step * np.arange(steps + 1, dtype=np.float64)
    return times, rows[:, : len(state)], rows[:, len(state) :]


def _integrate(
    dynamics: Dynamics,
    control: Controller,
    state: Array,
    steps: int,
    step: float,
    progress: Progress | None,
) -> Array:
    """States and observations [tau, friction, kinetic, potential] at all instants."""
    n = len(dynamics.machine.active)
    size, times = len(state), step * np.arange(steps + 1, dtype=np.float64)
    width = 2 * n + ENERGIES + len(getattr(control, "channels", ()))
    rows = np.empty((steps + 1, size + width))
    slow = PythonStepper(dynamics, control)
    fast = None
    if (
        dynamics.path == "compiled"
        and isinstance(control, TracedController)
        and not isinstance(control, StiffController)
    ):
        try:
            own = size - dynamics.machine.model.nq - n - ENERGIES
            fast = CompiledStepper(dynamics, control, own)
        except TooLongError:
            fast = None
    done = 0
    while done < steps:
        stopped = True
        if fast is not None:
            chunk = times[done : min(done + _CHUNK, steps)]
            count = fast.run(chunk, state, step, rows[done:])
            done, stopped = done + count, count < len(chunk)
        if stopped:
            # machine code stops where a step needs a closer look: it succeeds here or says why
            rate, seen = slow.observe(times[done], state)
            rows[done] = [*state, *seen]
            state = slow.advance(times[done], state, rate, step)
            done += 1
        if progress is not None:
            progress(done / (steps + 1))
    _, seen = slow.observe(times[steps], state)
    rows[steps] = [*state, *seen]
    if progress is not None:
        progress(1.0)
    return rows


def _integrate_stiff(
    dynamics: Dynamics,
    control: StiffController,
    state: Array,
    steps: int,
    step: float,
    progress: Progress | None,
) -> Array:
    """As `_integrate`, for a controller whose own states are stiff."""
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
    rows = np.empty((steps + 1, fast.width))
    nq, n = dynamics.machine.model.nq, len(dynamics.machine.active)
    done = 0
    while done < steps:
        if period:
            control.update(times[done], state[:nq], state[nq : nq + n], state[nq + n : -2])
        chunk = times[done : min(done + (period or _CHUNK), steps)]
        count = fast.run(chunk, state, step, rows[done:])
        if count < len(chunk):
            raise _stopped(dynamics, times[done + count], state)
        done += count
        if progress is not None:
            progress(done / (steps + 1))
    slow = PythonStepper(dynamics, control)
    rows[steps] = [*state, *slow.observe(times[steps], state)[1]]
    if progress is not None:
        progress(1.0)
    return rows


def _stopped(dynamics: Dynamics, time: float, state: Array) -> SimulationError:
    """Why the machine cannot go on from a state."""
    machine = dynamics.machine
    nq, n = machine.model.nq, len(machine.active)
    speed = np.abs(state[nq : nq + n]).max()
    # as far as it would have come
    q = state[:nq][machine.closure.active] + 1e-3 * state[nq : nq + n]
    try:
        machine.closure.solve(q, guess=state[:nq])
    except ClosureError as error:
        return SimulationError(f"at t = {time:.6g} s: {error}")
    return SimulationError(
        f"at t = {time:.6g} s the motion cannot be followed, the fastest joint moves at "
        f"{speed:.3g} m/s or rad/s: give its end stops damping, or smooth the friction more"
    )


def _as_controller(
    controller: Controller | Command | Force | None, machine: Machine
) -> Controller:
    if not isinstance(machine, Machine):
        raise InputError(f"{machine!r} is not a machine, load it with crane.load")
    if controller is None:
        if machine.hydraulics is not None:
            return ValveDrive(machine, Signals(machine, [0.0], {}))
        return Free(machine)
    if isinstance(controller, Command):
        return ValveDrive(machine, controller)
    if hasattr(controller, "start"):
        return controller  # type: ignore[return-value]
    if not callable(controller) or isinstance(controller, type):
        raise InputError(
            f"the controller is a {type(controller).__name__}, give a function (t, q_a, v_a) -> "
            "tau_a or a controller object"
        )
    return Feedback(controller, machine)


def _count(duration: float, step: float) -> int:
    duration = as_number(duration, "the duration", "s", above=0)
    step = as_number(step, "the step", "s", above=0)
    if duration / step > _MOST:
        raise InputError(
            f"{duration:g} s are {duration / step:.3g} steps of {step:g} s, at most {_MOST}: "
            "simulate less, or go on from the last sample of a first part"
        )
    steps = round(duration / step)
    if steps < 1 or abs(steps * step - duration) > 1e-9 * duration:
        raise InputError(
            f"the duration {duration:g} s is no whole number of steps of {step:g} s, change one"
        )
    return steps


def _start(
    machine: Machine, initial: ArrayLike | tuple[ArrayLike, ArrayLike] | None, path: Path | None
) -> tuple[Array, Array]:
    size, rest = len(machine.active), np.zeros(len(machine.active))
    if initial is None:
        if path is not None:
            return machine.check_limits(path(0.0)[0], "the start of the path"), rest
        return np.array(machine.home[machine.closure.active]), rest
    if isinstance(initial, tuple) and len(initial) == 2 and np.ndim(initial[0]) == 1:
        q_a = machine.check_limits(initial[0], "initial q_a")
        v_a = as_sample(initial[1], size, "initial v_a", machine.active)
    else:
        q_a, v_a = machine.check_limits(initial, "initial"), rest  # type: ignore[arg-type]
    if q_a.ndim != 1:
        raise InputError(
            f"initial is a stack, give one sample ({size},) or a pair as a tuple (q_a, v_a)"
        )
    return q_a, v_a
