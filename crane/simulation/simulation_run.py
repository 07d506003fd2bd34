"""Motion in time: Runge-Kutta of fourth order on the active coordinates."""

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from crane.codegen import FormulaTooLongError
from crane.common import scratch_arrays
from crane.common.errors import (
    ClosureError,
    CraneWarning,
    InputError,
    SimulationError,
    suggest_names,
)
from crane.common.progress import progress_reporter
from crane.common.samples import Array, as_number, as_sample
from crane.control import (
    ControlLaw,
    Controller,
    FunctionController,
    TracedController,
    ValveCommand,
    ValveDrive,
    ValveSignals,
    ZeroForce,
    controller_reference,
)
from crane.description.external_forces import ExternalForce
from crane.dynamics import Dynamics
from crane.dynamics.external_forces import state_count
from crane.formats import load
from crane.machine import Machine
from crane.motion.limit_violations import limit_violation_message, passive_limit_violation_message
from crane.recordings.recording import Recording
from crane.recordings.recording_summary import tipping_message
from crane.simulation.integration.chart_switching import ChartIntegrator, ChartSwitchingIntegrator
from crane.simulation.integration.charts import Chart, row_layout
from crane.simulation.integration.error_controlled_stepper import (
    DormandPrinceStepper,
    ErrorControlledStepper,
)
from crane.simulation.integration.integrators import ErrorControlledIntegrator, FixedStepIntegrator
from crane.simulation.integration.python_stepper import IntegrationHaltError, explain_halt
from crane.simulation.integration.radau import RadauStepper
from crane.simulation.integration.rosenbrock import RosenbrockStepper
from crane.simulation.integration.scipy_integrator import SCIPY_METHODS, ScipyIntegrator
from crane.simulation.recorded_run import IntegrationResult, record_run, stop_with_recording
from crane.simulation.run_checks import (
    buried_contact_text,
    find_invalid_motion,
    passed_limits_text,
    run_warnings,
)
from crane.simulation.static_equilibrium import equilibrium_on_contacts

_MAX_STEPS = 4_000_000  # steps of one recording
_MIN_TOLERANCE, _MAX_TOLERANCE = 1e-13, 1e-2  # tolerances

Force = Callable[[float, Array, Array], Array]
StepperFactory = Callable[..., ErrorControlledStepper]
Progress = Callable[[float], None]
_COMPILED_METHODS: dict[str, StepperFactory] = {
    "DOP853": DormandPrinceStepper,
    "Radau": RadauStepper,
    "rosenbrock": RosenbrockStepper,
}


class _CommandFinishedError(Exception):
    """What commands the valves has no more to do."""


def simulate(
    machine: Machine | str | Path,
    controller: Controller | ValveCommand | Force | None = None,
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
            of a hydraulic machine (`ValvePD`, `joystick`, `ValveSignals`, `SampledCommand`). None
            is no force, and valves at their neutral signal where the machine has any.
        initial: Active coordinates (n,) [m], [rad] to start at rest from, or a pair (q_a, v_a)
            with velocities [m/s], [rad/s]; the start of the controller's reference, or of its
            levers, at rest, or else the home posture. If not given, what stands on contacts
            starts in static equilibrium on them, see `crane.simulation.static_equilibrium`.
        duration: [s]; that of the controller's reference or levers if not given, which ends where
            the last of their phases does.
        step: [s].
        label: Name of the motion to put into the recording, as its `task`.
        backend: "compiled" or "pinocchio", see `Dynamics`.
        method: "DOP853", explicit of order 8 (`DormandPrinceStepper`); "Radau", implicit of order
            5 for what is stiff (`RadauStepper`); "rosenbrock", of order 3, the one for circuits
            (`RosenbrockStepper`): their steps are as long as the error allows, and what is between
            them is recorded every `step`. "rk4", of order 4 with this step. "RK23", "RK45", "BDF",
            "LSODA" are scipy's, as are DOP853 and Radau for controllers in Python. If not given,
            rosenbrock with valves, DOP853 in machine code, rk4 in Python.
        tolerance: Error of a step per size of the state; 1e-12 for DOP853, 1e-8 for rosenbrock,
            1e-9 for others if not given.
        formulation: "exact" or "decoupled", see `Dynamics`.
        loads: Forces from outside besides those of its file: `crane.Wrench` by time,
            `crane.WrenchFunction` from a function in Python, `crane.ExternalForce` in machine
            code.
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
    progress = progress_reporter(progress)
    if not (isinstance(label, str) and label.isprintable()):
        raise InputError(f"label {label!r} is not one line of text")
    if not isinstance(machine, Machine):
        machine = load(machine)
    machine = machine.with_external_forces(*loads)
    control = resolve_controller(controller, machine)
    machine = machine_under_control(machine, control)
    steps = count_steps(control, duration, step)
    if text := reference_limits_text(machine, control, steps * step):
        warnings.warn(text, CraneWarning, stacklevel=2)
    dynamics = Dynamics(machine, formulation, backend)
    ends_with_command = duration is None
    run = integrate(
        dynamics,
        control,
        initial,
        steps,
        step,
        method,
        progress,
        tolerance,
        ends_with_command=ends_with_command,
    )
    for note in run.notes:
        warnings.warn(note, CraneWarning, stacklevel=2)
    if run.stop is not None:
        interrupted = isinstance(run.stop, KeyboardInterrupt) and len(run.time)
        if interrupted and (text := passed_limits_text(machine, run.time, run.rows.q)):
            warnings.warn(text, CraneWarning, stacklevel=2)
        raise stop_with_recording(machine, control, run, label, steps * step)
    every_step = has_fixed_steps(dynamics, control, method)
    for text in run_warnings(
        machine, run.time, run.rows, step, every_step, formulation == "exact"
    ):
        warnings.warn(text, CraneWarning, stacklevel=2)
    recording = record_run(machine, control, run.time, run.rows, label, start_text=run.start_text)
    if text := tipping_message(recording):
        warnings.warn(text, CraneWarning, stacklevel=2)
    return recording


def integrate(
    dynamics: Dynamics,
    control: Controller,
    initial: ArrayLike | tuple[ArrayLike, ArrayLike] | None,
    step_count: int,
    step: float,
    method: str | None = None,
    progress: Progress | None = None,
    tolerance: float | None = None,
    chart: Chart | None = None,
    ends_with_command: bool = False,
) -> IntegrationResult:
    """What `simulate` computes, without channels; see there for arguments.

    Args:
        dynamics: The machine.
        control: See `resolve_controller`.
        initial: See `simulate`.
        step_count: See `count_steps`.
        step: [s].
        method: See `simulate`.
        progress: See `simulate`.
        tolerance: See `simulate`.
        chart: The machine in its own coordinates, for who wants to know when what stuck.
        ends_with_command: Whether to end where what commands the valves has no more to do.

    Returns:
        The run, shorter than asked for where something stopped it, or where levers have ended.

    Raises:
        InputError: As `simulate`.
        LimitError: Likewise.
        SimulationError: It cannot begin.
    """
    machine = dynamics.machine
    q_a, v_a = initial_motion(machine, initial, control)
    start_text = ""
    if initial is None:
        q_a, start_text = equilibrium_on_contacts(dynamics, q_a)
    try:
        # from home, whatever was solved before: a run is the same to the last bit
        configuration = machine.closure.solve(q_a, initial_guess=machine.home)
        controller_state = _initial_controller_state(control, dynamics, configuration)
    except ClosureError as error:
        raise SimulationError(f"at t = 0 s, where the motion starts: {error}") from None
    if text := buried_contact_text(machine, configuration):
        raise SimulationError(f"at t = 0 s, where the motion starts: {text}")
    contact_states, energies = (
        np.zeros(state_count(machine.external_forces)),
        np.zeros(2 + len(machine.external_forces)),
    )
    state = np.concatenate([configuration, v_a, contact_states, controller_state, energies])
    make_integrator = integrator_factory(
        dynamics, control, len(controller_state), method, tolerance
    )
    chart = chart or Chart.from_dynamics(dynamics)
    integrator = ChartSwitchingIntegrator(chart, control, len(controller_state), make_integrator)
    layout = row_layout(machine, control, len(controller_state))
    times = step * np.arange(step_count + 1, dtype=np.float64)
    rows = scratch_arrays.empty_array(
        step_count + 1, layout.size
    )  # recorded by columns, without a copy
    released_until = 0  # instants until the last release

    def report(done: int) -> None:
        nonlocal released_until
        if not released_until <= done < released_until + scratch_arrays.BLOCK_SIZE:
            released_until = done
            scratch_arrays.release_pages()
        if progress is not None:
            progress(done / (step_count + 1))
        if ends_with_command and done and _is_command_finished(control):
            raise _CommandFinishedError

    run = IntegrationResult(times, rows, layout, integrator.notes, start_text)
    try:
        integrator.run(times[:-1], state, step, rows, report)
        rows[-1] = integrator.final_row(times[-1], state)
    except _CommandFinishedError:
        run = run.first_instants(integrator.done, None)
    except IntegrationHaltError as halt:
        finer_step, done = integrator.find_finer_step(times[:-1], rows, step), integrator.done
        q_a = layout.view(rows[:done]).q[:, machine.closure.active]
        stop = explain_halt(
            machine, halt, times[:done], q_a, controller_reference(control, machine), finer_step
        )
        return run.first_instants(done, stop)
    except (Exception, KeyboardInterrupt) as stop:  # a controller in Python may raise anything
        return run.first_instants(integrator.done, stop)
    else:
        run.notes.extend(chart.stick_slip.notes)
        if progress is not None:
            progress(1.0)
    if invalid_motion := find_invalid_motion(
        machine, run.time, run.rows, step, dynamics.formulation == "exact"
    ):
        return run.first_instants(invalid_motion[0], SimulationError(invalid_motion[1]))
    return run


def _is_command_finished(control: Controller) -> bool:
    return isinstance(control, ValveDrive) and control.command.is_finished


def has_fixed_steps(dynamics: Dynamics, control: Controller, method: str | None) -> bool:
    """Whether a method makes steps of the recorded length."""
    return (method or _default_method(dynamics, control)) == "rk4"


def _default_method(dynamics: Dynamics, control: Controller) -> str:
    """The method if none is named."""
    if isinstance(control, ValveDrive):
        return "rosenbrock"
    traced = dynamics.backend == "compiled" and isinstance(control, TracedController)
    return "DOP853" if traced else "rk4"


def _initial_controller_state(control: Controller, dynamics: Dynamics, q: Array) -> Array:
    """The controller's states at a closed posture; laws look at the machine as it is there."""
    if isinstance(control, ControlLaw) and dynamics.formulation == "exact":
        return control.start_closed(dynamics, q)
    return control.start(q[dynamics.machine.closure.active])


def integrator_factory(
    dynamics: Dynamics,
    control: Controller,
    controller_state_count: int,
    requested_method: str | None,
    tolerance: float | None,
) -> Callable[[Chart], ChartIntegrator]:
    """What integrates by a method, or by the usual one."""
    valves, method = (
        isinstance(control, ValveDrive),
        requested_method or _default_method(dynamics, control),
    )
    if method not in ("rk4", "rosenbrock", *SCIPY_METHODS):
        methods_text = suggest_names(("rk4", "rosenbrock", *SCIPY_METHODS), method)
        raise InputError(f"method '{method}' is unknown, {methods_text}")
    if isinstance(control, ValveDrive) and control.period and method != "rosenbrock":
        raise InputError(
            f"method '{method}' does not call the valves' program, leave the method out"
        )
    if method == "Radau" and state_count(dynamics.machine.external_forces):
        raise InputError(
            "method 'Radau' does not follow how tyres give way along the ground, take DOP853"
        )
    options: dict[str, float] = {}
    if tolerance is not None:
        options["tolerance"] = as_number(tolerance, "the tolerance", "", greater_than=0)
        if method == "rk4" or not _MIN_TOLERANCE <= tolerance <= _MAX_TOLERANCE:
            raise InputError(
                "method 'rk4' has no tolerance, its error is that of its step: name another"
                if method == "rk4"
                else f"the tolerance is {tolerance:g}, give {_MIN_TOLERANCE:g} to "
                f"{_MAX_TOLERANCE:g}"
            )
    if method == "rk4":
        return lambda chart: FixedStepIntegrator(chart, control, controller_state_count)
    stepper_factory = (
        _COMPILED_METHODS.get(method) if not valves or method == "rosenbrock" else None
    )

    def make(chart: Chart) -> ChartIntegrator:
        """Machine code, or scipy where there is none."""
        compiled = stepper_factory is not None and chart.dynamics.backend == "compiled"
        if compiled and isinstance(control, TracedController):
            assert stepper_factory is not None
            with suppress(FormulaTooLongError):
                return ErrorControlledIntegrator(
                    chart, control, controller_state_count, partial(stepper_factory, **options)
                )
        if isinstance(control, ValveDrive) and control.period:
            raise InputError("a program with a period runs on the compiled backend alone")
        if requested_method is None and not valves:
            return FixedStepIntegrator(chart, control, controller_state_count)
        if chart.machine.coordinates.floating_base_columns:
            raise InputError("scipy's methods do not go round with a body that floats, take rk4")
        scipys = "BDF" if method == "rosenbrock" else method
        return ScipyIntegrator(chart, control, controller_state_count, scipys, **options)

    return make


def resolve_controller(
    controller: Controller | ValveCommand | Force | None, machine: Machine
) -> Controller:
    """What drives a machine, from what `simulate` takes.

    Raises:
        InputError: It is none of that, or the machine is no machine.
    """
    if not isinstance(machine, Machine):
        raise InputError(f"{machine!r} is not a machine, load it with crane.load")
    if isinstance(controller, ControlLaw):
        return controller
    if controller is None:
        if machine.hydraulics is not None:
            neutral = ValveSignals(machine, [0.0], {})
            neutral.title = "neutral valves"
            return ValveDrive(machine, neutral)
        return ZeroForce(machine)
    if isinstance(controller, ValveCommand):
        return ValveDrive(machine, controller)
    if hasattr(controller, "start"):
        return controller  # type: ignore[return-value]
    if not callable(controller) or isinstance(controller, type):
        raise InputError(
            f"the controller is a {type(controller).__name__}, give a function (t, q_a, v_a) -> "
            "tau_a or a controller object"
        )
    return FunctionController(controller, machine)


def machine_under_control(machine: Machine, control: Controller) -> Machine:
    """The machine with what acts on it by the controller's clock.

    And without seals and brakes where no circuit says what presses them.

    Raises:
        InputError: A load counts phases, and the controller has none.
    """
    clock = control.command.clock if isinstance(control, ValveDrive) else None
    machine = machine.with_clock(clock)
    hydraulics = machine.hydraulics
    if (
        hydraulics is None
        or not hydraulics.circuit_friction_joints
        or isinstance(control, ValveDrive)
    ):
        return machine
    without_friction = {
        joint: replace(cylinder, seal_friction=0.0, brake=0.0)
        for joint, cylinder in hydraulics.cylinders.items()
    }
    return machine.replace(hydraulics=replace(hydraulics, cylinders=without_friction))


def count_steps(control: Controller, duration: float | None, step: float) -> int:
    """Steps [s] in a duration [s], that of the controller's reference or levers if not given.

    Levers last to the end of a step.

    Raises:
        InputError: There is no duration, there are too many steps, or no whole number of them.
    """
    levers = False
    if duration is None:
        duration_source = getattr(control, "reference", None)
        if (
            duration_source is None
            and isinstance(control, ValveDrive)
            and control.command.duration
        ):
            duration_source, levers = control.command, True
        if duration_source is None:
            raise InputError("no duration and no reference to take it from, give a duration")
        duration = duration_source.duration
    duration = as_number(duration, "the duration", "s", greater_than=0)
    step = as_number(step, "the step", "s", greater_than=0)
    if duration / step > _MAX_STEPS:
        raise InputError(
            f"{duration:g} s are {duration / step:.3g} steps of {step:g} s, at most {_MAX_STEPS}: "
            "simulate less, or go on from the last sample of a first part"
        )
    steps = int(np.ceil(duration / step - 1e-9)) if levers else round(duration / step)
    if steps < 1 or not levers and abs(steps * step - duration) > 1e-9 * duration:
        raise InputError(
            f"the duration {duration:g} s is no whole number of steps of {step:g} s, change one"
        )
    return steps


def reference_limits_text(machine: Machine, control: Controller, end_time: float) -> str:
    """What to say of a reference that leaves the limits before a time [s], else nothing."""
    reference = controller_reference(control, machine)
    if reference is None:
        return ""
    return limit_violation_message(
        machine, reference, end_time
    ) or passive_limit_violation_message(machine, reference, end_time)


def initial_motion(
    machine: Machine,
    initial: ArrayLike | tuple[ArrayLike, ArrayLike] | None,
    control: Controller | None = None,
) -> tuple[Array, Array]:
    """Active coordinates and velocities (n,) that a simulation starts from, see `simulate`."""
    size, rest = len(machine.active), np.zeros(len(machine.active))
    if initial is None:
        reference = None if control is None else controller_reference(control, machine)
        if isinstance(control, ValveDrive) and control.command.initial_coordinates is not None:
            return np.array(control.command.initial_coordinates), rest
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
