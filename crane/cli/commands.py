"""Commands on machines and runs: list, info, check, simulate, view, plot, demo."""

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crane.cli.shared import (
    Force,
    MachineName,
    NoOpen,
    Out,
    OutFile,
    app,
    load,
    progress_bar,
    say,
)
from crane.errors import CraneWarning, DescriptionError, InputError

if TYPE_CHECKING:
    from crane.machine import Machine
    from crane.recording import Recording


@app.command("list")
def list_machines() -> None:
    """List the machines that can be named."""
    from crane.description import bundled, examples

    print("Bundled machines:")
    for name in bundled():
        print(f"  {name}")
    if examples():
        print(
            "Robots of example-robot-data (open chains; some are refused by the strict reading):"
        )
        print(f"  {', '.join(examples())}")


@app.command()
def info(machine: MachineName) -> None:
    """Show what a machine consists of."""
    for line in _describe(load(machine)):
        print(line)


@app.command()
def check(file: MachineName) -> None:
    """Read a machine and say what is wrong; exit status 0, 1 with warnings, 2 with an error."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CraneWarning)
        loaded = load(file)
    for warning in caught:
        say(f"warning: {warning.message}")
    residual = float(loaded.closure.residual(loaded.home))
    loops = len(loaded.closure.equations.loops)
    freedom = loaded.closure.degrees_of_freedom
    print(
        f"{loaded.name}: {len(loaded.joints)} joints, {loops} loops, {freedom} "
        f"degrees of freedom, loops closed to {residual:.1e} m at home"
    )
    if caught:
        raise typer.Exit(1)


@app.command()
def simulate(
    machine: MachineName,
    out: Out,
    task: Annotated[str | None, typer.Option(help="A task of the machine.")] = None,
    controller: Annotated[
        str | None, typer.Option(help="pi or computed-torque; pi if the machine has gains.")
    ] = None,
    duration: Annotated[
        float | None, typer.Option(help="In seconds; that of the task if not given.")
    ] = None,
    step: Annotated[float, typer.Option(help="Step of the integration in seconds.")] = 1e-3,
    force: Force = False,
) -> None:
    """Simulate a task, or without one the free motion from the home posture."""
    from crane.control import controller as make_controller
    from crane.paths import task_path
    from crane.runs import check_folder, write_run
    from crane.simulation import simulate as run

    check_folder(out, force)
    loaded = load(machine)
    control = None
    if task is not None:
        name = controller or ("pi" if loaded.control else "computed-torque")
        control = make_controller(name, loaded, task_path(loaded, task))
    elif controller is not None:
        raise InputError(f"controller '{controller}' has nothing to follow, name a --task")
    elif duration is None:
        tasks = ", ".join(loaded.tasks) or "none"
        raise InputError(f"no task: name a --task ({tasks}), or a --duration to let it go")
    with progress_bar("simulating") as progress:
        recording = run(
            loaded, control, duration=duration, step=step, task=task or "", progress=progress
        )
    title = f"{loaded.name}: {task or 'free motion'}"
    print(write_run(out, recording, title), end="")
    print(f"\nwritten to {out}; see it with: crane view {out}")


@app.command()
def view(
    what: Annotated[
        str, typer.Argument(metavar="WHAT", help="A machine, a run's folder, or a recording.")
    ],
    machine: Annotated[
        str | None,
        typer.Option(metavar="MACHINE", help="The machine of a run, if not as recorded."),
    ] = None,
    out: OutFile = None,
    no_open: NoOpen = False,
    force: Force = False,
) -> None:
    """Write a page that shows a machine or plays a run, and open it."""
    from crane.output import file_name
    from crane.runs import PAGE, check_free
    from crane.view.page import open_in_browser, write_page

    folder, recording = _run_of(what)
    if recording is not None:
        loaded = _machine_of(recording, what, machine)
    elif machine is None:
        loaded = load(what)
    else:
        raise InputError(f"--machine is for runs, and '{what}' is none, leave it out")
    page = out or (folder / PAGE if folder else Path(file_name(loaded.name) + ".html"))
    check_free(page, force)
    write_page(loaded, page, recording)
    print(f"written to {page}")
    if not no_open and not open_in_browser(page):
        print("no browser found here, open the page yourself")


@app.command()
def plot(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run's folder or a recording.")],
    out: OutFile = None,
    force: Force = False,
) -> None:
    """Plot displacements, velocities, forces and tip path of a run (png, svg or pdf)."""
    from crane.runs import FIGURE, check_free, read_run
    from crane.view.plots import plot_recording

    recording = read_run(run)
    figure = out or (run if run.is_dir() else run.parent) / FIGURE
    check_free(figure, force)
    plot_recording(recording, figure)
    print(f"written to {figure}")


@app.command()
def demo(out: Out = Path("demo-output"), force: Force = False) -> None:
    """Simulate the three published trajectories of the reduced-scale forwarder."""
    from crane.demo import run_demo
    from crane.runs import FIGURE, PAGE, check_folder

    check_folder(out, force)
    with progress_bar("simulating") as progress:
        text = run_demo(out, progress)
    print(text)
    print(f"figures:    {out}/*/{FIGURE}\nanimations: {out}/*/{PAGE} (open them in a browser)")


def _run_of(what: str) -> tuple[Path | None, "Recording | None"]:
    """Folder and recording where a run is meant; nothing where a machine is."""
    from crane.runs import read_run

    path = Path(what)
    if path.is_dir():
        return path, read_run(path)
    if path.suffix.lower() == ".csv":
        return path.parent, read_run(path)
    return None, None


def _machine_of(recording: "Recording", what: str, given: str | None) -> "Machine":
    from crane.description.sources import find

    if given is not None:
        return load(given)
    if not recording.machine:
        raise InputError(
            f"{what}: does not name its machine, add --machine, or write '# machine: NAME' above "
            "its header row"
        )
    try:
        find(recording.machine)
    except DescriptionError as error:
        raise DescriptionError(
            f"{what}: its machine is not found ({error}); add --machine to say where it is"
        ) from None
    return load(recording.machine)


def _describe(machine: "Machine") -> Iterator[str]:
    from crane.dynamics import Dynamics

    closure = machine.closure
    structure = closure.structure
    mass = sum(inertia.mass for inertia in list(machine.model.inertias)[1:])
    yield f"{machine.name}"
    if machine.source:
        yield f"  source      {machine.source}"
    yield f"  file        {machine.path}"
    yield f"  chains      {', '.join(chain.name for chain in machine.chains)}"
    yield (
        f"  joints      {len(machine.joints)}, of which {len(machine.active)} active; "
        f"moving mass {mass:.4g} kg"
    )
    for i, joint in enumerate(machine.active):
        home = machine.home[closure.active[i]]
        yield (
            f"    {joint:<10}{machine.lower[i]:.5g} to {machine.upper[i]:.5g} "
            f"{machine.unit(joint)}, home {home:.5g}"
        )
    for i in closure.passive:
        joint = machine.joints[i]
        yield f"    {joint:<10}passive, home {machine.home[i]:.5g} {machine.unit(joint)}"
    loops = closure.equations.loops
    yield (
        f"  loops       {len(loops)}: {len(structure.rows)} independent equations, "
        f"{len(structure.redundant)} redundant"
    )
    for loop in loops:
        yield f"    {loop.name:<10}{loop.type}, {loop.predecessor} to {loop.successor}"
    if structure.blocks:
        order = [
            "+".join(machine.joints[closure.passive[i]] for i in columns)
            for _, columns in structure.blocks
        ]
        yield f"  solved as   {', then '.join(order)}"
    path = Dynamics(machine).path_of("forward")
    reason = "" if path == "compiled" else ", too large for machine code"
    yield f"  computed    {path}{reason}"
    yield f"  tip         {machine.tip or 'none'}"
    for task in machine.tasks.values():
        yield f"  task        {task.name}, {task.duration:g} s: {task.description}"
