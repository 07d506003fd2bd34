"""The command that simulates a machine."""

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crane.cli.loads import Load, loads_of
from crane.cli.shared import (
    BY_COMMAND,
    INTERRUPTED,
    Active,
    Argument,
    Change,
    Columns,
    Floating,
    Force,
    Free,
    From,
    Lock,
    MachineName,
    Out,
    Packages,
    Until,
    app,
    load,
    progress_bar,
    say,
    span_of,
)
from crane.common.errors import CraneError, InputError, SimulationError, suggest_names

if TYPE_CHECKING:
    from crane.control import Controller, ValveCommand
    from crane.machine import Machine
    from crane.motion import Trajectory


@app.command()
def simulate(
    machine: MachineName,
    out: Out = BY_COMMAND,
    task: Annotated[str | None, typer.Option(help="A task of the machine.")] = None,
    controller: Annotated[
        str | None,
        typer.Option(
            help="pi, computed-torque, valve-pd, valve-feedforward, tip-velocity; along a task or "
            "path, if not given, the one that the machine has gains for, else computed-torque. "
            "Without both it holds the home posture; if not given then, no drive acts: forces "
            "are zero, valves at their neutral signals."
        ),
    ] = None,
    sway: Annotated[
        str | None,
        typer.Option(
            metavar="METHOD",
            help="Change the task's reference so that what hangs does not sway after it: flat, "
            "zv, zvd; none only lets it hang still at the start. Through valves goes with "
            "--controller valve-feedforward.",
        ),
    ] = None,
    path: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="A motion to follow in the place of a task: time and the driven joints, or x, y, "
            "z of the tip, and inclination or roll, pitch, yaw of its frame.",
        ),
    ] = None,
    inputs: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Measured valve signals to replay, and to compare with what else was measured.",
        ),
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option(help="In seconds; that of the task or path if not given."),
    ] = None,
    step: Annotated[float, typer.Option(help="Between recorded instants in seconds.")] = 1e-3,
    npz: Annotated[
        bool,
        typer.Option(
            "--npz", help="Record as npz, of a long run: under half of a CSV, and read at once."
        ),
    ] = False,
    columns: Columns = None,
    since: From = None,
    until: Until = None,
    method: Annotated[
        str | None,
        typer.Option(
            help="DOP853, if not given, or Radau for what is stiff: their steps are as long as "
            "their error allows, and recorded every --step; rosenbrock, of circuits; rk4, with "
            "this step; BDF, LSODA of scipy."
        ),
    ] = None,
    tolerance: Annotated[
        float | None, typer.Option(help="Error of a step per size of the state, such as 1e-8.")
    ] = None,
    load_: Load = None,
    change: Change = None,
    lock: Lock = None,
    active: Active = None,
    free: Free = None,
    floating: Floating = False,
    packages: Packages = None,
    argument: Argument = None,
    force: Force = False,
) -> None:
    """Simulate a task, a path, measured inputs, or the home posture, held or let go."""
    from crane.cli.runs import check_folder, write_run
    from crane.motion.path_reader import read_path
    from crane.simulation import simulate as run

    check_folder(out, force)
    loaded = load(machine, lock, change, active, free, floating, packages, argument)
    loaded = under_task(loaded, task).with_external_forces(*loads_of(load_))
    if inputs is not None:
        named = {"--task": task, "--path": path, "--controller": controller, "--sway": sway}
        given = [option for option, value in named.items() if value is not None]
        if given:
            raise InputError(f"{given[0]} does not go with --inputs, leave one out")
        if duration is not None:
            raise InputError("--duration does not go with --inputs, the file ends by itself")
        for option, value in {"--method": method, "--tolerance": tolerance}.items():
            if value is not None:
                raise InputError(f"{option} does not go with --inputs, leave it out")
        _replay(loaded, inputs, out, step, npz, columns, span_of(since, until), force)
        return
    of_inputs = {"--columns": columns, "--from": since, "--until": until}
    for option in [option for option, given in of_inputs.items() if given is not None]:
        raise InputError(f"{option} is for --inputs, leave it out")
    if path is not None and task is not None:
        raise InputError("--task does not go with --path, leave one out")
    control: Controller | ValveCommand | None
    if path is not None:
        reference = read_path(loaded, path)
        control = follower_of(loaded, reference, controller, sway)
        if duration is None and step > 0:
            duration = math.ceil(reference.duration / step - 1e-9) * step  # whole steps
    else:
        control = control_of(loaded, task, controller, sway)
        duration = duration_of(loaded, task, duration)
    left = "free motion" if loaded.hydraulics is None else "valves at rest"
    label = task or (path.stem if path else "hold" if control else left)
    with kept_in(out, npz, force), progress_bar("simulating") as progress:
        recording = run(
            loaded, control, duration=duration, step=step, label=label, method=method,
            tolerance=tolerance, progress=progress,
        )  # fmt: skip
    print(write_run(out, recording, npz, force), end="")
    print(f"\nwritten to {out}; see it with: crane view {out}")


@contextmanager
def kept_in(folder: Path, npz: bool, force: bool) -> Iterator[None]:
    """Write what there is of a run that is stopped in the block, by an error or by its user.

    Raises:
        CraneError: What stopped it, with where what there is of it lies.
    """
    from crane.cli.runs import write_run
    from crane.simulation import InterruptedRun

    try:
        yield
    except (CraneError, InterruptedRun) as stop:
        recording = getattr(stop, "recording", None)
        if recording is None:
            raise
        write_run(folder, recording, npz, force)
        told = f"{stop}; the run until t = {recording.time[-1]:.6g} s is in {folder}"
        if isinstance(stop, CraneError):
            raise SimulationError(told) from stop
        say(told)
        sys.exit(INTERRUPTED)


def control_of(
    machine: "Machine", task: str | None, name: str | None, sway: str | None = None
) -> "Controller | ValveCommand | None":
    """What drives a machine along a task, by a controller's name and a method of `suppress_sway`.

    Raises:
        InputError: There is no such task or controller.
    """
    from crane.control import joystick, make_controller
    from crane.motion.task_trajectories import task_trajectory
    from crane.motion.trajectory import point_to_point

    if task is None:
        if sway is not None:
            raise InputError("--sway changes a reference, name a --task or a --path")
        if name is None:
            return None
        home = machine.home[machine.closure.active]
        return make_controller(name, machine, point_to_point(home, home, 1.0))
    if task not in machine.tasks:
        raise InputError(
            f"machine '{machine.name}' has no task '{task}', {suggest_names(machine.tasks, task)}"
        )
    if machine.tasks[task].space == "joystick":
        if name is not None:
            raise InputError(f"task '{task}' moves levers, leave --controller out")
        if sway is not None:
            raise InputError(f"task '{task}' moves levers, leave --sway out")
        return joystick(machine, task)
    return follower_of(machine, task_trajectory(machine, task), name, sway)


def follower_of(
    machine: "Machine", reference: "Trajectory", name: str | None, sway: str | None = None
) -> "Controller | ValveCommand":
    """What drives a machine along a reference, see `control_of`."""
    from crane.control import default_controller_name, make_controller
    from crane.motion.sway_suppression import suppress_sway

    if sway is not None:
        reference = suppress_sway(machine, reference, sway)
    return make_controller(name or default_controller_name(machine), machine, reference)


def under_task(machine: "Machine", task: str | None) -> "Machine":
    """A machine under what acts from outside while a task is done; others tell of unknown ones."""
    if task is None or task not in machine.tasks:
        return machine
    return machine.with_external_forces(*machine.tasks[task].loads)


def duration_of(machine: "Machine", task: str | None, duration: float | None) -> float | None:
    """How long a simulation takes [s], None of what ends by itself.

    Raises:
        InputError: Nothing tells.
    """
    if duration is not None:
        return duration
    if task is None:
        tasks = ", ".join(machine.tasks) or "none"
        raise InputError(f"no task: name a --task ({tasks}), or a --duration to let it go")
    return None if machine.tasks[task].phases else machine.tasks[task].duration


def _replay(
    machine: "Machine",
    inputs: Path,
    out: Path,
    step: float,
    npz: bool,
    columns: Path | None,
    span: tuple[float, float],
    force: bool,
) -> None:
    from crane.cli.runs import write_comparison
    from crane.simulation.recording_replay import replay

    with kept_in(out, npz, force), progress_bar("simulating") as progress:
        recording, comparison = replay(machine, inputs, step, progress, columns, span)
    print(write_comparison(out, recording, comparison, npz, force), end="")
    print(f"\nwritten to {out}; see it with: crane view {out}")
