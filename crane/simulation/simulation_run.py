"""Simulation of a machine with its controller."""

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
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
    check_name,
    is_one_line,
)
from crane.common.progress import ignore_progress, progress_reporter
from crane.common.samples import Array, as_number
from crane.common.threads import single_threaded_blas
from crane.control.control_law import (
    ControlLaw,
    Controller,
    controller_reference,
)
from crane.control.valve_commands import ValveCommand
from crane.control.valve_drive import ValveDrive
from crane.description.external_forces import ExternalForce
from crane.dynamics.dynamics import Dynamics
from crane.dynamics.external_forces import state_count
from crane.formats.machine_loading import load
from crane.machine.machine import Machine
from crane.recordings.recording import Recording
from crane.recordings.recording_summary import tipping_message
from crane.simulation.integration.chart_switching import ChartSwitchingIntegrator
from crane.simulation.integration.charts import KEPT_CHART_RELAXATION, Chart
from crane.simulation.integration.error_controlled_stepper import (
    DormandPrinceStepper,
    ErrorControlledStepper,
)
from crane.simulation.integration.integrators import (
    ErrorControlledIntegrator,
    FixedStepIntegrator,
    StickSlipIntegrator,
)
from crane.simulation.integration.python_stepper import IntegrationHaltError, explain_halt
from crane.simulation.integration.radau import RadauStepper
from crane.simulation.integration.rosenbrock import RosenbrockStepper
from crane.simulation.integration.scipy_integrator import SCIPY_METHODS, ScipyIntegrator
from crane.simulation.recorded_run import IntegrationResult, record_run, stop_with_recording
from crane.simulation.run_checks import (
    buried_contact_text,
    closed_counterbalance_text,
    find_invalid_motion,
    passed_limits_text,
    run_warnings,
)
from crane.simulation.simulation_setup import (
    Force,
    count_steps,
    initial_motion,
    machine_under_control,
    reference_limits_text,
    resolve_controller,
)
from crane.simulation.static_equilibrium import RestState, rest_state

_MIN_TOLERANCE, _MAX_TOLERANCE = 1e-13, 1e-2

Progress = Callable[[float], None]
_COMPILED_METHODS: dict[str, Callable[..., ErrorControlledStepper]] = {
    "DOP853": DormandPrinceStepper,
    "Radau": RadauStepper,
    "rosenbrock": RosenbrockStepper,
}


class _CommandFinishedError(Exception):
    """The command of the valves has ended."""


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
    (q_A, v_A), the states of the controller and the energies. Within a step the passive joints
    move by gamma v_A; after every step the loops are closed to rounding errors.

    At a dead centre of the active coordinates the run continues in other coordinates, with the
    forces of the same drives. Where branches of motion cross, it continues on its own branch. Both
    give a warning (see `crane.simulation.integration.charts`).

    Args:
        machine: The machine, or an argument of `crane.load`.
        controller: A controller, a function (t, q_a, v_a) -> tau_a, or a valve command of a
            hydraulic machine (`ValvePD`, `joystick`, `ValveSignals`, `SampledCommand`). None for
            no force, or for valves at their neutral signals.
        initial: Initial active coordinates (n,) [m], [rad] at rest, or a pair (q_a, v_a) with
            velocities [m/s], [rad/s]. The default is the start of the reference or levers of the
            controller, or else home. By default a machine that stands on contacts starts in static
            equilibrium, see `crane.simulation.static_equilibrium`.
        duration: Duration [s]; that of the reference or levers of the controller if not given,
            which ends with the last phase.
        step: Interval of the output instants, and step size of "rk4" [s].
        label: Name of the motion, the `task` of the recording.
        backend: "compiled" or "pinocchio", see `Dynamics`.
        method: "DOP853", explicit of order 8 (`DormandPrinceStepper`); "Radau", implicit of order
            5 for stiff machines (`RadauStepper`); "rosenbrock", of order 3, for circuits
            (`RosenbrockStepper`): these control their step size and record every `step` by dense
            output. "rk4", of order 4 with fixed steps. "RK23", "RK45", "BDF", "LSODA" are
            those of scipy, as are DOP853 and Radau for controllers in Python. The default is
            rosenbrock with valves, DOP853 in machine code, rk4 in Python.
        tolerance: Error of a step relative to the size of the state; 1e-12 for DOP853, 1e-8 for
            rosenbrock, 1e-9 for others if not given.
        formulation: "exact" or "decoupled", see `Dynamics`.
        loads: External forces besides those of the machine file: `crane.Wrench` over time,
            `crane.description.WrenchFunction` by a function in Python,
            `crane.description.ExternalForce` in machine code.
        progress: Function that is called with the finished share, 0 to 1.

    Returns:
        A recording with channels for every passive joint, the tip, the references,
        friction_<joint>, rest_<joint> of joints with stiction (friction at rest, 0 where the joint
        slips), and the energies kinetic, potential, work (of the active forces),
        work_<load> (of each external force, with load_<load>_force_x and so on, in the axes of
        the world) and dissipated [J]; all work = change of (kinetic + potential) + dissipated,
        of the exact formulation only.

    Raises:
        InputError: Arguments of wrong shape or value.
        LimitError: The start lies outside of the limits.
        SimulationError: The simulation halts: the loops do not close, or the motion diverges. The
            message names the time, and the joint beyond its limit or a sufficient step size. Its
            attribute `recording` has the run up to there, as that of every error which a
            controller in Python raises.
        InterruptedRun: The run was interrupted; a `KeyboardInterrupt` with the `recording`.

    A reference outside of the limits of a joint gives a warning before the first step.
    """
    progress = progress_reporter(progress)
    if not (isinstance(label, str) and is_one_line(label)):
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
    run = integrate(
        dynamics,
        control,
        initial,
        steps,
        step,
        method,
        progress,
        tolerance,
        ends_with_command=duration is None,
    )
    for note in run.notes:
        warnings.warn(note, CraneWarning, stacklevel=2)
    if run.stop is not None:
        interrupted = isinstance(run.stop, KeyboardInterrupt) and len(run.time)
        if interrupted and (text := passed_limits_text(machine, run.time, run.rows.q)):
            warnings.warn(text, CraneWarning, stacklevel=2)
        raise stop_with_recording(machine, control, run, run.stop, label, steps * step)
    recording = record_run(machine, control, run.time, run.rows, label, start_text=run.start_text)
    every_step, is_exact = has_fixed_steps(dynamics, control, method), formulation == "exact"
    texts = run_warnings(machine, run.time, run.rows, step, every_step, is_exact)
    texts += [tipping_message(recording), closed_counterbalance_text(machine, recording)]
    for text in filter(None, texts):
        warnings.warn(text, CraneWarning, stacklevel=2)
    return recording


def integrate(
    dynamics: Dynamics,
    control: Controller,
    initial: ArrayLike | tuple[ArrayLike, ArrayLike] | None,
    step_count: int,
    step: float,
    method: str | None = None,
    progress: Progress = ignore_progress,
    tolerance: float | None = None,
    records_transitions: bool = False,
    ends_with_command: bool = False,
    earlier: IntegrationResult | None = None,
    keeps_chart: bool = False,
) -> IntegrationResult:
    """Integrate a run without computing its channels; see `simulate`.

    Args:
        dynamics: Dynamics of the machine.
        control: See `resolve_controller`.
        initial: See `simulate`.
        step_count: See `count_steps`.
        step: [s].
        method: See `simulate`.
        progress: See `simulate`.
        tolerance: See `simulate`.
        records_transitions: Whether the stick-slip modes of the chart record their transitions.
        ends_with_command: Whether the run ends with the command of the valves.
        earlier: A run of a variant of the machine, whose last state is the initial one.
        keeps_chart: Whether the active coordinates are kept, also near their dead centres.

    Returns:
        The run; it is shorter where it was stopped, or where the command ended.

    Raises:
        InputError: As `simulate`.
        LimitError: As `simulate`.
        SimulationError: The run cannot start.
    """
    machine = dynamics.machine
    start_text, first = "", 0
    if earlier is None:
        state, controller_states, start_text = _initial_state(dynamics, control, initial)
    else:
        layout = earlier.chart.state_layout
        state = earlier.array[-1, : layout.size].copy()
        controller_states, first = layout.parts["controller"], round(earlier.time[-1] / step)
    chart = Chart.from_dynamics(dynamics, control, controller_states)
    if records_transitions:
        chart.stick_slip.transitions = []
    if keeps_chart:
        chart.chart_limits[:] *= KEPT_CHART_RELAXATION
    integrator = ChartSwitchingIntegrator(chart, integrator_factory(chart, method, tolerance))
    times = step * np.arange(first, first + step_count + 1, dtype=np.float64)
    # stored by columns, so that channels are views
    rows = scratch_arrays.empty_array(step_count + 1, chart.row_layout.size)
    released_until = 0  # instants whose memory pages are released

    def report(done: int) -> None:
        nonlocal released_until
        if not released_until <= done < released_until + scratch_arrays.BLOCK_SIZE:
            released_until = done
            scratch_arrays.release_pages()
        progress(done / (step_count + 1))
        if (
            ends_with_command
            and done
            and (isinstance(control, ValveDrive) and control.command.is_finished)
        ):
            raise _CommandFinishedError

    run = IntegrationResult(times, rows, chart, integrator.notes, start_text)
    try:
        with single_threaded_blas(machine.model.nv):
            integrator.run(times[:-1], state, step, rows, report)
        rows[-1] = integrator.final_row(times[-1], state)
    except _CommandFinishedError:
        run = run.first_instants(integrator.done, None)
    except IntegrationHaltError as halt:
        finer_step, done = integrator.find_finer_step(times[:-1], rows, step), integrator.done
        q_a = chart.row_layout.view(rows[:done]).q[:, machine.closure.active]
        stop = explain_halt(
            machine, halt, times[:done], q_a, controller_reference(control, machine), finer_step
        )
        return run.first_instants(done, stop)
    except (Exception, KeyboardInterrupt) as stop:  # a controller in Python may raise anything
        return run.first_instants(integrator.done, stop)
    else:
        run = run._replace(notes=[*run.notes, *chart.stick_slip.notes])
        progress(1.0)
    is_exact = dynamics.formulation == "exact"
    invalid_motion = find_invalid_motion(machine, run.time, run.rows, step, is_exact)
    if invalid_motion is not None:
        return run.first_instants(invalid_motion[0], SimulationError(invalid_motion[1]))
    return run


def _initial_state(
    dynamics: Dynamics,
    control: Controller,
    initial: ArrayLike | tuple[ArrayLike, ArrayLike] | None,
) -> tuple[Array, int, str]:
    """Initial state, the number of states of the controller, and a note about the state."""
    machine = dynamics.machine
    q_a, v_a = initial_motion(machine, initial, control)
    rest = RestState(q_a, np.zeros(state_count(machine.external_forces)))
    if initial is None:
        rest = rest_state(dynamics, q_a)
    try:
        # from home, so that a run does not depend on earlier solutions
        configuration = machine.closure.solve(rest.q_a, initial_guess=machine.home)
        if isinstance(control, ControlLaw) and dynamics.formulation == "exact":
            controller_state = control.start_closed(dynamics, configuration, rest.contact_states)
        else:
            controller_state = control.start(configuration[machine.closure.active])
    except ClosureError as error:
        raise SimulationError(f"at t = 0 s, where the motion starts: {error}") from None
    if text := buried_contact_text(machine, configuration):
        raise SimulationError(f"at t = 0 s, where the motion starts: {text}")
    energies = np.zeros(2 + len(machine.external_forces))
    state = np.concatenate([configuration, v_a, rest.contact_states, controller_state, energies])
    return state, len(controller_state), rest.text


def has_fixed_steps(dynamics: Dynamics, control: Controller, method: str | None) -> bool:
    """Whether the steps of a method are the output intervals."""
    return (method or _default_method(dynamics, control)) == "rk4"


def _default_method(dynamics: Dynamics, control: Controller) -> str:
    if isinstance(control, ValveDrive):
        return "rosenbrock"
    return (
        "DOP853" if (dynamics.backend == "compiled" and isinstance(control, ControlLaw)) else "rk4"
    )


def integrator_factory(
    chart: Chart, requested_method: str | None, tolerance: float | None
) -> Callable[[Chart], StickSlipIntegrator]:
    """Function that creates the integrator of a method in a chart.

    Args:
        chart: The machine in the coordinates of the user.
        requested_method: See `simulate`.
        tolerance: See `simulate`.

    Raises:
        InputError: The method is unknown or does not support the machine.
    """
    dynamics, control = chart.dynamics, chart.control
    drive = control if isinstance(control, ValveDrive) else None
    method = requested_method or _default_method(dynamics, control)
    check_name(method, ("rk4", "rosenbrock", *SCIPY_METHODS), f"method '{method}' is unknown")
    period = control.period if isinstance(control, ControlLaw) else 0.0
    if period and method not in (("rosenbrock",) if drive is not None else _COMPILED_METHODS):
        raise InputError(
            f"method '{method}' does not call the sampled program, leave the method out"
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
        return FixedStepIntegrator
    stepper_factory = None
    if drive is None or method == "rosenbrock":
        stepper_factory = _COMPILED_METHODS.get(method)

    def make(chart: Chart) -> StickSlipIntegrator:
        """A compiled integrator, or one of scipy where the formulas cannot be compiled."""
        compiled = chart.dynamics.backend == "compiled"
        if compiled and stepper_factory is not None and isinstance(control, ControlLaw):
            with suppress(FormulaTooLongError):
                return ErrorControlledIntegrator(chart, partial(stepper_factory, **options))
        if period:
            raise InputError("a program with a period runs on the compiled backend alone")
        if requested_method is None and drive is None:
            return FixedStepIntegrator(chart)
        name = "BDF" if method == "rosenbrock" else method
        return ScipyIntegrator(chart, name, **options)

    return make
