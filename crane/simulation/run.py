"""Motion in time: Runge-Kutta of fourth order on the active coordinates."""

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from crane.codegen import TooLongError
from crane.common import scratch
from crane.common.errors import ClosureError, CraneWarning, InputError, SimulationError, known
from crane.common.samples import Array, as_number, as_sample
from crane.common.waiting import telling
from crane.control import (
    Command,
    Controller,
    Feedback,
    Free,
    Law,
    Signals,
    TracedController,
    ValveDrive,
    reference_of,
)
from crane.description.external import ExternalForce
from crane.dynamics import Dynamics
from crane.dynamics.external import states_of
from crane.formats import load
from crane.machine import Machine
from crane.motion.limits import beyond_limits, carried_beyond
from crane.recordings.recording import Recording
from crane.recordings.summary import tipping
from crane.simulation.integration.adaptive import ADAPTIVE, AdaptiveSteps
from crane.simulation.integration.charted import ChartedSteps, Way
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.controlled import ControlledStepper
from crane.simulation.integration.controlled_steps import ControlledSteps
from crane.simulation.integration.explicit import ExplicitStepper
from crane.simulation.integration.halt import HaltedError, explained
from crane.simulation.integration.radau import RadauStepper
from crane.simulation.integration.rosenbrock import StiffStepper
from crane.simulation.integration.state import row_layout
from crane.simulation.integration.steps import Steps
from crane.simulation.judgement import buried, fault, limits_passed, said
from crane.simulation.recorded import Run, recorded, stopped
from crane.simulation.static_equilibrium import on_contacts

_MOST = 4_000_000  # steps of one recording
_FINEST, _COARSEST = 1e-13, 1e-2  # tolerances

Force = Callable[[float, Array, Array], Array]
Stepper = Callable[..., ControlledStepper]
Progress = Callable[[float], None]
_CONTROLLED: dict[str, Stepper] = {
    "DOP853": ExplicitStepper,
    "Radau": RadauStepper,
    "rosenbrock": StiffStepper,
}


class _EndedError(Exception):
    """What commands the valves has no more to do."""


def simulate(
    machine: Machine | str | Path,
    controller: Controller | Command | Force | None = None,
    initial: ArrayLike | tuple[ArrayLike, ArrayLike] | None = None,
    duration: float | None = None,
    step: float = 1e-3,
    *,
    label: str = "",
    backend: str = "compiled",
    method: str | None = None,
    tolerance: float | None = None,
    formulation: str = "exact",
    loads: Sequence[ExternalForce] = (),
    progress: Progress | None = None,
) -> Recording:
    """Simulate a machine with its friction, passive forces and end stops.

    M_A a_A = tau_A - bias - friction, integrated as an ordinary differential equation in
    (q_A, v_A), the controller's states and the energies. Within a step the passive joints move
    with gamma v_A; after every step the loops are closed to rounding.

    Where the active coordinates come to a dead centre the run goes on in others, with the forces
    of the same drives, and where branches of motion cross it keeps to its own; both are told in a
    warning (see `crane.simulation.integration.charts` and `passage`).

    Args:
        machine: The machine, or what `crane.load` takes.
        controller: A controller, a function (t, q_a, v_a) -> tau_a, or what commands the valves
            of a hydraulic machine (`ValvePD`, `joystick`, `Signals`, `Sampled`). None is no
            force, and valves at their neutral signal where the machine has any.
        initial: Active coordinates (n,) [m], [rad] to start at rest from, or a pair (q_a, v_a)
            with velocities [m/s], [rad/s]; the start of the controller's reference, or of its
            levers, at rest, or else the home posture. If not given, what stands on contacts
            starts in static equilibrium on them, see `crane.simulation.static_equilibrium`.
        duration: [s]; that of the controller's reference or levers if not given, which ends where
            the last of their phases does.
        step: [s].
        label: Name of the motion to put into the recording, as its `task`.
        backend: "compiled" or "pinocchio", see `Dynamics`.
        method: "DOP853", explicit of order 8 (`ExplicitStepper`); "Radau", implicit of order 5 for
            what is stiff (`RadauStepper`); "rosenbrock", of order 3, the one for circuits
            (`StiffStepper`): their steps are as long as the error allows, and what is between them
            is recorded every `step`. "rk4", of order 4 with this step. "RK23", "RK45", "BDF",
            "LSODA" are scipy's, as are DOP853 and Radau for controllers in Python. If not given,
            rosenbrock with valves, DOP853 in machine code, rk4 in Python.
        tolerance: Error of a step per size of the state; 1e-12 for DOP853, 1e-8 for rosenbrock,
            1e-9 for others if not given.
        formulation: "exact" or "decoupled", see `Dynamics`.
        loads: Forces from outside besides those of its file: `crane.Wrench` by time,
            `crane.Pushing` from a function in Python, `crane.ExternalForce` in machine code.
        progress: Called with the finished share, 0 to 1.

    Returns:
        Recording with channels for every passive joint, the tip, the references,
        friction_<joint>, rest_<joint> where friction sticks (what holds the joint at rest, 0
        where it slips), and the energies kinetic, potential, work (of the active forces),
        work_<load> (of each force from outside, with load_<load>_force_x and so on, in the
        world's axes) and dissipated [J]; all work = change of (kinetic + potential) + dissipated,
        of the exact formulation only.

    Raises:
        InputError: Arguments of wrong shape or value.
        LimitError: The start lies outside of the limits.
        SimulationError: The machine cannot go on: the loops do not close any more, or the motion
            explodes. Names the time, and the joint beyond its limit or a step that is short
            enough. What there is of the run is its `recording`, as that of every error which a
            controller in Python raises.
        InterruptedRun: It was interrupted; a `KeyboardInterrupt` with its `recording`, likewise.

    A reference that leaves the limits of a joint is a warning before the first step: with an end
    stop it can be meant.
    """
    progress = telling(progress)
    if not (isinstance(label, str) and label.isprintable()):
        raise InputError(f"label {label!r} is not one line of text")
    if not isinstance(machine, Machine):
        machine = load(machine)
    machine = machine.under(*loads)
    control = as_controller(controller, machine)
    machine = as_driven(machine, control)
    steps = count_steps(control, duration, step)
    if text := reference_beyond(machine, control, steps * step):
        warnings.warn(text, CraneWarning, stacklevel=2)
    dynamics = Dynamics(machine, formulation, backend)
    ends = duration is None
    run = integrate(
        dynamics, control, initial, steps, step, method, progress, tolerance, ends=ends
    )
    for note in run.notes:
        warnings.warn(note, CraneWarning, stacklevel=2)
    if run.stop is not None:
        interrupted = isinstance(run.stop, KeyboardInterrupt) and len(run.time)
        if interrupted and (text := limits_passed(machine, run.time, run.rows.q)):
            warnings.warn(text, CraneWarning, stacklevel=2)
        raise stopped(machine, control, run, label, steps * step)
    every_step = fixed(dynamics, control, method)
    for text in said(machine, run.time, run.rows, step, every_step, formulation == "exact"):
        warnings.warn(text, CraneWarning, stacklevel=2)
    found = recorded(machine, control, run.time, run.rows, label, start=run.start)
    if text := tipping(found):
        warnings.warn(text, CraneWarning, stacklevel=2)
    return found


def integrate(
    dynamics: Dynamics,
    control: Controller,
    initial: ArrayLike | tuple[ArrayLike, ArrayLike] | None,
    steps: int,
    step: float,
    method: str | None = None,
    progress: Progress | None = None,
    tolerance: float | None = None,
    chart: Chart | None = None,
    ends: bool = False,
) -> Run:
    """What `simulate` computes, without channels; see there for arguments.

    Args:
        dynamics: The machine.
        control: See `as_controller`.
        initial: See `simulate`.
        steps: See `count_steps`.
        step: [s].
        method: See `simulate`.
        progress: See `simulate`.
        tolerance: See `simulate`.
        chart: The machine in its own coordinates, for who wants to know when what stuck.
        ends: Whether to end where what commands the valves has no more to do.

    Returns:
        The run, shorter than asked for where something stopped it, or where levers have ended.

    Raises:
        InputError: As `simulate`.
        LimitError: Likewise.
        SimulationError: It cannot begin.
    """
    machine = dynamics.machine
    q_a, v_a = start_of(machine, initial, control)
    start = ""
    if initial is None:
        q_a, start = on_contacts(dynamics, q_a)
    try:
        # from home, whatever was solved before: a run is the same to the last bit
        posture = machine.closure.solve(q_a, guess=machine.home)
        own = _own_start(control, dynamics, posture)
    except ClosureError as error:
        raise SimulationError(f"at t = 0 s, where the motion starts: {error}") from None
    if text := buried(machine, posture):
        raise SimulationError(f"at t = 0 s, where the motion starts: {text}")
    shear, energies = np.zeros(states_of(machine.external)), np.zeros(2 + len(machine.external))
    state = np.concatenate([posture, v_a, shear, own, energies])
    make = integration_of(dynamics, control, len(own), method, tolerance)
    chart = chart or Chart.of(dynamics)
    integration = ChartedSteps(chart, control, len(own), make)
    layout = row_layout(machine, control, len(own))
    times = step * np.arange(steps + 1, dtype=np.float64)
    rows = scratch.empty(steps + 1, layout.size)  # recorded by columns, without a copy
    kept = 0  # instants until the last release

    def report(done: int) -> None:
        nonlocal kept
        if not kept <= done < kept + scratch.AT_ONCE:
            kept = done
            scratch.release()
        if progress is not None:
            progress(done / (steps + 1))
        if ends and done and _has_ended(control):
            raise _EndedError

    run = Run(times, rows, layout, integration.notes, start)
    try:
        integration.run(times[:-1], state, step, rows, report)
        rows[-1] = integration.last(times[-1], state)
    except _EndedError:
        run = run.until(integration.done, None)
    except HaltedError as halt:
        finer, done = integration.finer(times[:-1], rows, step), integration.done
        q_a = layout.view(rows[:done]).q[:, machine.closure.active]
        stop = explained(machine, halt, times[:done], q_a, reference_of(control, machine), finer)
        return run.until(done, stop)
    except (Exception, KeyboardInterrupt) as stop:  # a controller in Python may raise anything
        return run.until(integration.done, stop)
    else:
        run.notes.extend(chart.sticking.notes)
        if progress is not None:
            progress(1.0)
    if found := fault(machine, run.time, run.rows, step, dynamics.formulation == "exact"):
        return run.until(found[0], SimulationError(found[1]))
    return run


def _has_ended(control: Controller) -> bool:
    return isinstance(control, ValveDrive) and control.command.ended


def fixed(dynamics: Dynamics, control: Controller, method: str | None) -> bool:
    """Whether a method makes steps of the recorded length."""
    return (method or _usual(dynamics, control)) == "rk4"


def _usual(dynamics: Dynamics, control: Controller) -> str:
    """The method if none is named."""
    if isinstance(control, ValveDrive):
        return "rosenbrock"
    traced = dynamics.backend == "compiled" and isinstance(control, TracedController)
    return "DOP853" if traced else "rk4"


def _own_start(control: Controller, dynamics: Dynamics, q: Array) -> Array:
    """The controller's states at a closed posture; laws look at the machine as it is there."""
    if isinstance(control, Law) and dynamics.formulation == "exact":
        return control.start_at(dynamics, q)
    return control.start(q[dynamics.machine.closure.active])


def integration_of(
    dynamics: Dynamics, control: Controller, own: int, named: str | None, tolerance: float | None
) -> Callable[[Chart], Way]:
    """What integrates by a method, or by the usual one."""
    valves, method = isinstance(control, ValveDrive), named or _usual(dynamics, control)
    if method not in ("rk4", "rosenbrock", *ADAPTIVE):
        every = known(("rk4", "rosenbrock", *ADAPTIVE), method)
        raise InputError(f"method '{method}' is unknown, {every}")
    if isinstance(control, ValveDrive) and control.period and method != "rosenbrock":
        raise InputError(
            f"method '{method}' does not call the valves' program, leave the method out"
        )
    if method == "Radau" and states_of(dynamics.machine.external):
        raise InputError(
            "method 'Radau' does not follow how tyres give way along the ground, take DOP853"
        )
    options: dict[str, float] = {}
    if tolerance is not None:
        options["tolerance"] = as_number(tolerance, "the tolerance", "", above=0)
        if method == "rk4" or not _FINEST <= tolerance <= _COARSEST:
            raise InputError(
                "method 'rk4' has no tolerance, its error is that of its step: name another"
                if method == "rk4"
                else f"the tolerance is {tolerance:g}, give {_FINEST:g} to {_COARSEST:g}"
            )
    if method == "rk4":
        return lambda chart: Steps(chart, control, own)
    stepper = _CONTROLLED.get(method) if not valves or method == "rosenbrock" else None

    def make(chart: Chart) -> Way:
        """Machine code, or scipy where there is none."""
        compiled = stepper is not None and chart.dynamics.backend == "compiled"
        if compiled and isinstance(control, TracedController):
            assert stepper is not None
            with suppress(TooLongError):
                return ControlledSteps(chart, control, own, partial(stepper, **options))
        if isinstance(control, ValveDrive) and control.period:
            raise InputError("a program with a period runs on the compiled backend alone")
        if named is None and not valves:
            return Steps(chart, control, own)
        if chart.machine.coordinates.floating:
            raise InputError("scipy's methods do not go round with a body that floats, take rk4")
        scipys = "BDF" if method == "rosenbrock" else method
        return AdaptiveSteps(chart, control, own, scipys, **options)

    return make


def as_controller(controller: Controller | Command | Force | None, machine: Machine) -> Controller:
    """What drives a machine, from what `simulate` takes.

    Raises:
        InputError: It is none of that, or the machine is no machine.
    """
    if not isinstance(machine, Machine):
        raise InputError(f"{machine!r} is not a machine, load it with crane.load")
    if isinstance(controller, Law):
        return controller
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


def as_driven(machine: Machine, control: Controller) -> Machine:
    """The machine with what acts on it by the controller's clock.

    And without seals and brakes where no circuit says what presses them.

    Raises:
        InputError: A load counts phases, and the controller has none.
    """
    clock = control.command.clock if isinstance(control, ValveDrive) else None
    machine = machine.timed(clock)
    hydraulics = machine.hydraulics
    if hydraulics is None or not hydraulics.gripped or isinstance(control, ValveDrive):
        return machine
    free = {
        joint: replace(cylinder, seal_friction=0.0, brake=0.0)
        for joint, cylinder in hydraulics.cylinders.items()
    }
    return machine.replace(hydraulics=replace(hydraulics, cylinders=free))


def count_steps(control: Controller, duration: float | None, step: float) -> int:
    """Steps [s] in a duration [s], that of the controller's reference or levers if not given.

    Levers last to the end of a step.

    Raises:
        InputError: There is no duration, there are too many steps, or no whole number of them.
    """
    levers = False
    if duration is None:
        known_by = getattr(control, "reference", None)
        if known_by is None and isinstance(control, ValveDrive) and control.command.duration:
            known_by, levers = control.command, True
        if known_by is None:
            raise InputError("no duration and no reference to take it from, give a duration")
        duration = known_by.duration
    duration = as_number(duration, "the duration", "s", above=0)
    step = as_number(step, "the step", "s", above=0)
    if duration / step > _MOST:
        raise InputError(
            f"{duration:g} s are {duration / step:.3g} steps of {step:g} s, at most {_MOST}: "
            "simulate less, or go on from the last sample of a first part"
        )
    steps = int(np.ceil(duration / step - 1e-9)) if levers else round(duration / step)
    if steps < 1 or not levers and abs(steps * step - duration) > 1e-9 * duration:
        raise InputError(
            f"the duration {duration:g} s is no whole number of steps of {step:g} s, change one"
        )
    return steps


def reference_beyond(machine: Machine, control: Controller, until: float) -> str:
    """What to say of a reference that leaves the limits before a time [s], else nothing."""
    reference = reference_of(control, machine)
    if reference is None:
        return ""
    return beyond_limits(machine, reference, until) or carried_beyond(machine, reference, until)


def start_of(
    machine: Machine,
    initial: ArrayLike | tuple[ArrayLike, ArrayLike] | None,
    control: Controller | None = None,
) -> tuple[Array, Array]:
    """Active coordinates and velocities (n,) that a simulation starts from, see `simulate`."""
    size, rest = len(machine.active), np.zeros(len(machine.active))
    if initial is None:
        reference = None if control is None else reference_of(control, machine)
        if isinstance(control, ValveDrive) and control.command.start is not None:
            return np.array(control.command.start), rest
        if reference is not None:
            return machine.check_limits(
                reference.position(0.0), "the start of the reference"
            ), rest
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
