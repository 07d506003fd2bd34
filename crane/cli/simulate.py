"""Commands that compute motions: demo, simulate, sway, modes, sensitivities."""

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import crane
from crane.cli.command import OptionBlock, command, number_option, refuse_options
from crane.cli.options import (
    ChangeOptions,
    Configuration,
    MachineName,
    MachineOptions,
    OptionalOutputFolder,
    OutputFolder,
    Outputs,
    ParameterOptions,
    Parameters,
    RecordingOptions,
    Task,
)
from crane.cli.parsing import (
    joint_units,
    parameter_units,
    parse_configuration,
    parse_grids,
    parse_load,
    parse_names,
    parse_numbers,
)
from crane.cli.terminal import INTERRUPTED, print_message, progress_bar, status
from crane.common.atomic_output import replace_folder
from crane.common.errors import CraneError, InputError, SimulationError, check_name
from crane.common.result import Result

if TYPE_CHECKING:
    Control = crane.control.Controller | crane.control.ValveCommand

DEMO_MACHINES = "mini_forwarder", "excavator"
DRIVEN_MACHINES = "excavator", "mini_forwarder", "patu655"
_SIMULATED_SHARE = 0.3  # of the time of a task of the demonstration; drawing takes the rest

ControllerName = Annotated[
    str | None,
    typer.Option(
        "--controller",
        metavar="NAME",
        help="Controller: pi, computed-torque, valve-pd, valve-feedforward or tip-velocity; by "
        "default the one whose gains the machine file contains, otherwise computed-torque. "
        "If neither --task nor --path is given: with --controller the machine holds the home "
        "configuration; without it, drive forces are zero and valves stay at neutral.",
    ),
]
ExportedController = Annotated[
    str | None,
    typer.Option(
        "--controller",
        metavar="NAME",
        help="Controller whose references are the inputs: pi, computed-torque, valve-pd or "
        "valve-feedforward; by default forces of drives or signals of valves are.",
    ),
]
Duration = Annotated[
    float | None, number_option("s", "Duration; that of the task or path by default.")
]
Step = Annotated[float, number_option("s", "Step of the recorded samples.")]


@command()
def demo(output: OutputFolder) -> None:
    """Simulate two bundled machines; pages to drive three.

    The tasks of the machines are simulated and shown.
    """
    from crane.view.result_files import FIGURE, PAGE

    with progress_bar("simulating") as progress, replace_folder(output.out, output.force) as part:
        text = write_demo(part, progress)
    folder = output.out
    print(f"{text}\nfigures:    {folder}/*/{FIGURE}")
    print(f"animations: {folder}/*/{PAGE} (open them in a browser)")
    print(f"to drive:   {folder}/*_drive.html (levers by keys, touch and gamepad)")


def write_demo(folder: Path, progress: Callable[[float], None]) -> str:
    """Simulate the tasks of the demonstration, and write a folder of each into a folder.

    Pages on which machines are driven are beside them.

    Returns:
        The summaries of all tasks, Markdown.
    """
    from crane.view.result_files import SUMMARY

    tasks = [
        (machine, task) for machine in map(crane.load, DEMO_MACHINES) for task in machine.tasks
    ]
    texts = []
    for i, (machine, task) in enumerate(tasks):

        def report(share: float, done: int = i) -> None:
            progress((done + _SIMULATED_SHARE * share) / len(tasks))

        control = task_control(machine, task, None)
        recording = crane.simulate(
            add_task_loads(machine, task), control, label=task, progress=report
        )
        texts.append(recording.write(folder / task, views=True))
    for name in DRIVEN_MACHINES:
        crane.view.drive_page(crane.load(name), folder / f"{name}_drive.html")
    progress(1.0)
    text = "\n".join(texts)
    (folder / SUMMARY).write_text(text, encoding="utf-8", errors="backslashreplace")
    return text


@dataclass(frozen=True, kw_only=True)
class MotionOptions(OptionBlock):
    """The motion that is simulated."""

    panel = "Motion options"
    task: Task = None
    path: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="A motion to follow instead of a task: a CSV file with columns time and the "
            "driven joints, or time, x, y, z of the tip and optionally inclination, or roll, "
            "pitch, yaw, of its frame.",
        ),
    ] = None
    controller: ControllerName = None
    sway: Annotated[
        str | None,
        typer.Option(
            metavar="METHOD",
            help="Method that suppresses sway after the motion: flat (differential flatness), zv "
            "or zvd (input shapers); none: reference unchanged, free joints start in "
            "equilibrium. With valves, add --controller valve-feedforward.",
        ),
    ] = None
    duration: Duration = None

    def control(
        self, machine: "crane.Machine", step: float
    ) -> "tuple[Control | None, float | None]":
        """Controller and duration [s] of the motion, as `task_control` and `task_duration`."""
        if self.path is None:
            control = task_control(machine, self.task, self.controller, self.sway)
            return control, task_duration(machine, self.task, self.duration)
        refuse_options({"--task": self.task}, "does not go with --path, leave one out")
        reference, duration = crane.motion.read_path(machine, self.path), self.duration
        if duration is None and step > 0:
            duration = math.ceil(reference.duration / step - 1e-9) * step  # whole steps
        return tracking_control(machine, reference, self.controller, self.sway), duration


@dataclass(frozen=True, kw_only=True)
class IntegrationOptions(OptionBlock):
    """How a motion is integrated."""

    panel = "Integration options"
    method: Annotated[
        str | None,
        typer.Option(
            metavar="METHOD",
            help="Integration method. With error control: DOP853 (default without valve "
            "control), rosenbrock (default with valve control), Radau (for stiff machines), BDF "
            "or LSODA (of scipy). With fixed steps of --step: rk4.",
        ),
    ] = None
    tolerance: Annotated[
        float | None,
        typer.Option(
            help="Permitted relative error per step, for methods with error control, e.g. 1e-8."
        ),
    ] = None


@command()
def simulate(
    machine: MachineName,
    motion: MotionOptions,
    integration: IntegrationOptions,
    options: MachineOptions,
    reading: RecordingOptions,
    output: OutputFolder,
    inputs: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="A recording whose valve signals, or forces of a machine without valves, are "
            "replayed, or with --controller whose references are followed; its other columns are "
            "compared with the simulation.",
        ),
    ] = None,
    load: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FRAME=WRENCH",
            help="An external force: FX,FY,FZ in N, followed by MX,MY,MZ in N m if needed, or a "
            "CSV file with columns time, force_x ... moment_z. FRAME=... keeps its direction in "
            "the world, FRAME@frame=... rotates with the frame. May be repeated.",
        ),
    ] = None,
    step: Step = 1e-3,
    npz: Annotated[
        bool,
        typer.Option(
            "--npz",
            help="Write the recording as npz, which is smaller than CSV and faster to read.",
        ),
    ] = False,
) -> None:
    """Simulate a task, a path, or measured valve signals.

    Without --task, --path and --inputs, the machine starts at home and is held
    there (--controller) or moves freely. --from, --until and --columns apply to
    --inputs.
    """
    loaded = add_task_loads(options.load(machine), motion.task)
    loaded = loaded.with_external_forces(*map(parse_load, load or ()))
    result: Result
    if inputs is not None:
        for block in (replace(motion, controller=None), integration):
            block.refuse("does not go with --inputs, leave it out")
        with _write_stopped_run(output, npz), progress_bar("simulating") as progress:
            _, result = crane.replay(
                loaded, inputs, step, progress, reading.columns, reading.span, motion.controller
            )
    else:
        reading.refuse("is for --inputs, leave it out")
        control, duration = motion.control(loaded, step)
        uncontrolled = "free motion" if loaded.hydraulics is None else "valves at rest"
        path = None if motion.path is None else motion.path.stem
        label = motion.task or path or ("hold" if control else uncontrolled)
        with _write_stopped_run(output, npz), progress_bar("simulating") as progress:
            result = crane.simulate(
                loaded, control, duration=duration, step=step, label=label,
                method=integration.method, tolerance=integration.tolerance, progress=progress,
            )  # fmt: skip
    output.write(result, f"; see it with: crane view {output.out}", npz=npz)


@contextmanager
def _write_stopped_run(output: OutputFolder, npz: bool) -> Iterator[None]:
    """Write the run until it is stopped in the block, by an error or by the user.

    Raises:
        CraneError: The error, with the folder of the run.
    """
    try:
        yield
    except (CraneError, crane.simulation.InterruptedRun) as stop:
        recording = getattr(stop, "recording", None)
        if recording is None:
            raise
        recording.write(output.out, output.force, npz=npz)
        text = f"{stop}; results until t = {recording.time[-1]:.6g} s are written to {output.out}"
        if isinstance(stop, CraneError):
            raise SimulationError(text) from stop
        print_message(text)
        sys.exit(INTERRUPTED)


def task_control(
    machine: "crane.Machine", task: str | None, controller: str | None, sway: str | None = None
) -> "Control | None":
    """The controller of a task, by the controller's name and a method of `suppress_sway`.

    Raises:
        InputError: There is no such task or controller.
    """
    if task is None:
        refuse_options({"--sway": sway}, "changes a reference, name a --task or a --path")
        return None if controller is None else crane.control.make_controller(controller, machine)
    check_name(task, machine.tasks, f"machine '{machine.name}' has no task '{task}'")
    if machine.tasks[task].space == "joystick":
        text = f"does not go with task '{task}', which moves levers, leave it out"
        refuse_options({"--controller": controller, "--sway": sway}, text)
        return crane.joystick(machine, task)
    return tracking_control(machine, crane.task_trajectory(machine, task), controller, sway)


def tracking_control(
    machine: "crane.Machine",
    reference: "crane.motion.Trajectory",
    controller: str | None,
    sway: str | None = None,
) -> "Control":
    """The controller that tracks a reference, see `task_control`."""
    if sway is not None:
        reference = crane.motion.suppress_sway(machine, reference, sway)
    name = controller or crane.control.default_controller_name(machine)
    return crane.control.make_controller(name, machine, reference)


def add_task_loads(machine: "crane.Machine", task: str | None) -> "crane.Machine":
    """The machine with the external forces of a task; unchanged if there is no such task."""
    if task is None or task not in machine.tasks:
        return machine
    return machine.with_external_forces(*machine.tasks[task].loads)


def task_duration(
    machine: "crane.Machine", task: str | None, duration: float | None
) -> float | None:
    """Duration [s] of a simulation; None if it ends by itself.

    Raises:
        InputError: There is neither a task nor a duration.
    """
    if duration is not None:
        return duration
    if task is None:
        raise InputError(
            f"no task: name a --task ({', '.join(machine.tasks) or 'none'}), or a --duration to "
            "let it go"
        )
    return None if machine.tasks[task].phases else machine.tasks[task].duration


@command()
def sway(
    machine: MachineName,
    options: ChangeOptions,
    task: Annotated[
        str, typer.Option(metavar="TASK", help="A task of the machine file, from rest to rest.")
    ],
    payload: Annotated[
        str, typer.Option(metavar="KG,...", help="Masses of the payload.")
    ] = "0,100,200,300,400,500",
    damping: Annotated[
        float, typer.Option(help="Damping ratio of the sway feedback; 0: no feedback.")
    ] = 0.2,
) -> None:
    """Compare methods that suppress the sway of a load."""
    message = f"--payload {payload}: give masses as 0,200,500"
    masses = parse_numbers(payload.split(","), message, ("kg",))
    with progress_bar("simulating") as progress:
        result = crane.studies.sway_study(
            machine, task, masses, damping, options.changed_values(), progress
        )
    print(result.to_text())


@command()
def modes(
    machine: MachineName,
    options: MachineOptions,
    output: OptionalOutputFolder,
    at: Configuration = None,
    velocity: Annotated[
        str | None,
        typer.Option(
            metavar="JOINT=VALUE,...",
            help="Active velocities in m/s or rad/s, which open valves; zero by default.",
        ),
    ] = None,
    drive: Annotated[
        str | None,
        typer.Option(
            metavar="INPUTS", help="Inputs: valves or forces; valves by default if there are any."
        ),
    ] = None,
    outputs: Outputs = None,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUES",
            help="A joint or parameter and its values start:stop:count, over which modes are "
            "plotted; may be repeated.",
        ),
    ] = None,
) -> None:
    """Compute frequencies, damping and shapes of modes."""
    loaded = options.load(machine)
    axes = parse_grids(vary, parameter_units(loaded))
    q_a = parse_configuration("--at", at, joint_units(loaded))
    v_a = parse_configuration("--velocity", velocity, joint_units(loaded, "/s"))
    with status("linearizing"):
        model = crane.linearize(
            loaded, q_a, velocity=v_a, drive=drive, outputs=parse_names(outputs)
        )
    models = []
    if axes:
        with progress_bar("linearizing") as progress:
            models = crane.simulation.linear_models(
                loaded, axes, q_a, drive=drive, progress=progress
            )
    output.write(model, models=models)


@command()
def sensitivities(
    machine: MachineName,
    options: ParameterOptions,
    output: OptionalOutputFolder,
    by: Parameters,
    task: Task = None,
    controller: ControllerName = None,
    duration: Duration = None,
    step: Step = 1e-3,
    outputs: Outputs = None,
) -> None:
    """Compute sensitivities of a motion to parameters."""
    loaded = add_task_loads(options.load(machine), task)
    control = task_control(loaded, task, controller)
    with progress_bar("simulating") as progress:
        result = crane.sensitivities(
            loaded, control, duration=task_duration(loaded, task, duration), step=step,
            parameters=by, outputs=parse_names(outputs), progress=progress,
        )  # fmt: skip
    output.write(result)
