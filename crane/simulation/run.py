"""Motion in time: Runge-Kutta of fourth order on the active coordinates."""

import warnings
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from crane.control import (
    Command,
    Controller,
    Feedback,
    Free,
    Signals,
    StiffController,
    ValveDrive,
)
from crane.dynamics import Dynamics
from crane.errors import ClosureError, CraneWarning, InputError, SimulationError, known
from crane.integration import ADAPTIVE, integrate_adaptively
from crane.machine import Machine
from crane.paths import Path, beyond_limits
from crane.recording import Recording
from crane.samples import Array, as_number, as_sample
from crane.simulation.recorded import ENERGIES, imbalance, recorded
from crane.simulation.steps import Progress, integrate, integrate_stiff

_MOST = 4_000_000  # steps of one recording

Force = Callable[[float, Array, Array], Array]


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
        SimulationError: The machine cannot go on: the loops do not close any more, or the motion
            explodes. Names the time, and the joint beyond its limit or a step that is short
            enough.

    A reference that leaves the limits of a joint is a warning before the first step: with an end
    stop it can be meant.
    """
    if not (isinstance(task, str) and task.isprintable()):
        raise InputError(f"task {task!r} is not one line of text")
    control = _as_controller(controller, machine)
    if control.path is not None:
        until = np.inf if duration is None else as_number(duration, "the duration", "s", above=0)
        if text := beyond_limits(machine, control.path, until):
            warnings.warn(text, CraneWarning, stacklevel=2)
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
    try:
        posture, own = machine.closure.solve(q_a), control.start(q_a)
    except ClosureError as error:
        raise SimulationError(f"at t = 0 s, where the motion starts: {error}") from None
    state = np.concatenate([posture, v_a, own, np.zeros(ENERGIES)])
    if method is None:
        method = "rosenbrock" if isinstance(control, StiffController) else "rk4"
    if method != "rosenbrock" and isinstance(control, StiffController) and control.period:
        raise InputError(
            f"method '{method}' does not call the valves' program, leave the method out"
        )
    if method == "rosenbrock" and isinstance(control, StiffController):
        rows = integrate_stiff(dynamics, control, state, steps, step, progress)
    elif method == "rk4":
        rows = integrate(dynamics, control, state, steps, step, progress)
    elif method in ADAPTIVE:
        rows = integrate_adaptively(dynamics, control, state, steps, step, method, progress)
    else:
        raise InputError(f"method '{method}' is unknown, {known(('rk4', *ADAPTIVE), method)}")
    times = step * np.arange(steps + 1, dtype=np.float64)
    return times, rows[:, : len(state)], rows[:, len(state) :]


def _as_controller(
    controller: Controller | Command | Force | None, machine: Machine
) -> Controller:
    if not isinstance(machine, Machine):
        raise InputError(f"{machine!r} is not a machine, load it with crane.load")
    if controller is None:
        if machine.hydraulics is not None:
            neutral = Signals(machine, [0.0], {})
            neutral.title = "neutral valves"
            return ValveDrive(machine, neutral)
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
