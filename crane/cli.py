"""The command line: crane list, info, check, simulate, study, identify, payload, view, ..."""

import os
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import crane
from crane.errors import CraneError, CraneWarning, DescriptionError, InputError, OutputError

if TYPE_CHECKING:
    from crane.machine import Machine
    from crane.recording import Recording

# Commands import what they need when they run, so that `crane --help` answers at once.

_INTERRUPTED = 130

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _place(text: str | Path) -> Path:
    if not str(text):
        raise OutputError("the name after --out is empty, give one")
    return Path(text)


MachineName = Annotated[
    str,
    typer.Argument(metavar="MACHINE", help="A bundled name, a machine file, or a URDF."),
]
Force = Annotated[bool, typer.Option("--force", help="Overwrite what is there.")]
Out = Annotated[
    Path,
    typer.Option("--out", metavar="FOLDER", parser=_place, help="Folder for the results."),
]
OutFile = Annotated[
    Path | None,
    typer.Option("--out", metavar="FILE", parser=_place, help="The file to write."),
]
RecordingFile = Annotated[
    Path, typer.Argument(metavar="RECORDING", help="A recording (CSV or npz), with forces.")
]
Method = Annotated[
    str, typer.Option(help="wls (joints by their noise), ols, or huber (robust to outliers).")
]
NoOpen = Annotated[bool, typer.Option("--no-open", help="Do not open the browser.")]


def main() -> None:
    """Run the command line: errors are one line, exit status 2."""
    arguments = [word for word in sys.argv[1:] if word != "--debug"]
    debug = len(arguments) < len(sys.argv) - 1
    warnings.showwarning = _show_warning
    warnings.simplefilter("once", CraneWarning)
    try:
        status = app(args=arguments, standalone_mode=False, prog_name="crane")
        if status == _INTERRUPTED:  # what the parser makes of KeyboardInterrupt
            raise KeyboardInterrupt
        if sys.stdout is not None:  # it is where the shell has closed it
            sys.stdout.flush()
    except CraneError as error:
        if debug:
            raise
        _say(f"error: {error}")
        sys.exit(2)
    except KeyboardInterrupt:
        _say("error: interrupted, nothing was written")
        sys.exit(_INTERRUPTED)
    except OSError as error:
        if debug:
            raise
        _abandon_output()
        if isinstance(error, BrokenPipeError):  # whoever read it has seen enough
            sys.exit(1)
        place = error.filename or "output"
        _say(f"error: {place}: {error.strerror or error}, check the place and try again")
        sys.exit(2)
    except Exception as error:
        # the command line parser's own errors, whose class is not public
        message = getattr(error, "format_message", None)
        if debug or message is None:
            raise
        if text := message():
            _say(f"error: {' '.join(text.split())} (crane --help shows the commands)")
        sys.exit(2)
    sys.exit(status if isinstance(status, int) else 0)


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"crane {crane.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", is_eager=True, callback=_show_version, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Machines with closed kinematic chains: simulate, identify and show.

    Add --debug to any command to see where an error comes from.
    """


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
    for line in _describe(_load(machine)):
        print(line)


@app.command()
def check(file: MachineName) -> None:
    """Read a machine and say what is wrong; exit status 0, 1 with warnings, 2 with an error."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CraneWarning)
        loaded = _load(file)
    for warning in caught:
        _say(f"warning: {warning.message}")
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
    loaded = _load(machine)
    control = None
    if task is not None:
        name = controller or ("pi" if loaded.control else "computed-torque")
        control = make_controller(name, loaded, task_path(loaded, task))
    elif controller is not None:
        raise InputError(f"controller '{controller}' has nothing to follow, name a --task")
    elif duration is None:
        tasks = ", ".join(loaded.tasks) or "none"
        raise InputError(f"no task: name a --task ({tasks}), or a --duration to let it go")
    with _progress("simulating") as progress:
        recording = run(
            loaded, control, duration=duration, step=step, task=task or "", progress=progress
        )
    title = f"{loaded.name}: {task or 'free motion'}"
    print(write_run(out, recording, title), end="")
    print(f"\nwritten to {out}; see it with: crane view {out}")


@app.command()
def study(
    machine: MachineName,
    out: Out,
    vary: Annotated[
        list[str],
        typer.Option(
            metavar="NAME=VALUES",
            help="A parameter and its values start:stop:count, or with --draws low~high.",
        ),
    ],
    task: Annotated[
        list[str] | None, typer.Option(help="A task to measure with; all if not given.")
    ] = None,
    measure: Annotated[
        list[str] | None, typer.Option(help="What to report, such as peak_X2; all if not given.")
    ] = None,
    draws: Annotated[int | None, typer.Option(help="Number of random variants.")] = None,
    seed: Annotated[int, typer.Option(help="Of the random variants.")] = 0,
    processes: Annotated[
        int | None, typer.Option(help="To compute with; one per core if not given.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Of a Dask cluster to compute on.")
    ] = None,
    force: Force = False,
) -> None:
    """Measure variants of a machine: any parameters over a grid or at random."""
    from crane.runs import check_folder, write_study
    from crane.studies import ranges
    from crane.studies import study as run

    check_folder(out, force)
    axes = ranges(vary, draws)
    with _progress("computing variants") as progress:
        result = run(
            machine, axes, task, measure, draws=draws, seed=seed, scheduler=scheduler,
            processes=(os.cpu_count() or 1) if processes is None else processes,
            progress=progress,
        )  # fmt: skip
    write_study(out, result)
    print(f"{result.to_text()}\nwritten to {out}")


@app.command()
def excite(
    machine: MachineName,
    out: Out,
    period: Annotated[float, typer.Option(help="In seconds.")] = 10.0,
    harmonics: Annotated[int, typer.Option(help="Of the period.")] = 5,
    periods: Annotated[int, typer.Option(help="How many steady ones.")] = 3,
    criterion: Annotated[str, typer.Option(help="logdet or condition.")] = "logdet",
    seed: Annotated[int, typer.Option(help="Of the random starts.")] = 0,
    noise: Annotated[
        list[str] | None,
        typer.Option(
            metavar="JOINT=VALUE", help="Deviation of its force; 1 % of the limit if not given."
        ),
    ] = None,
    acceleration: Annotated[
        list[str] | None, typer.Option(metavar="JOINT=VALUE", help="A limit beside the URDF's.")
    ] = None,
    step: Annotated[float, typer.Option(help="Of the recording in seconds.")] = 0.01,
    force: Force = False,
) -> None:
    """Find a periodic motion that tells most about a machine's parameters."""
    # its matrices are small: threads would only wait for each other
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from crane.identification.excitation import excite as run
    from crane.output import staging
    from crane.runs import check_folder
    from crane.view.excitation_plots import plot_excitation

    check_folder(out, force)
    loaded = _load(machine)
    with _progress("optimising") as progress:
        found = run(
            loaded, period=period, harmonics=harmonics, periods=periods, criterion=criterion,
            noise=_by_joint("--noise", noise), acceleration=_by_joint(
                "--acceleration", acceleration
            ), step=step, seed=seed, progress=progress,
        )  # fmt: skip
    with staging(out) as part:
        found.to_csv(part / "reference.csv")
        found.to_yaml(part / "coefficients.yaml")
        plot_excitation(found, part / "reference.png")
    print(f"{found.to_text()}\n\nwritten to {out}; see it with: crane view {out}/reference.csv")


@app.command()
def identify(
    machine: MachineName,
    recording: RecordingFile,
    out: Out,
    validation: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A recording to be judged by.")
    ] = None,
    method: Method = "wls",
    prior: Annotated[
        float | None,
        typer.Option(help="Relative standard deviation of the described bodies, such as 0.3."),
    ] = None,
    feasible: Annotated[
        bool, typer.Option("--feasible", help="Only bodies and friction that can exist.")
    ] = False,
    bandwidth: Annotated[
        float | None,
        typer.Option(metavar="HZ", help="Of the low-pass; by the motion if not given."),
    ] = None,
    slow: Annotated[
        list[str] | None,
        typer.Option(
            metavar="JOINT=VALUE",
            help="Velocity below which its rows are left out [m/s], [rad/s].",
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Find a machine's parameters from a recording, and how well they predict."""
    from crane.identification.identify import identify as run
    from crane.recording import Recording
    from crane.runs import check_folder, write_identification
    from crane.samples import as_number

    check_folder(out, force)
    loaded, learned = _load(machine), Recording.read(recording)
    if bandwidth is not None:
        span = max(float(learned.time[-1] - learned.time[0]), 1e-3)
        as_number(bandwidth, "the bandwidth", "Hz", above=5 / span)
    judge = None if validation is None else Recording.read(validation)
    with _status("identifying"):
        result = run(
            loaded,
            learned,
            judge,
            method,
            prior,
            feasible,
            bandwidth=bandwidth,
            slow=_by_joint("--slow", slow),
        )
    with _status("writing the report"):
        name = "" if validation is None else validation.name
        write_identification(out, result, recording.name, name)
    print(f"{result.to_text()}\nwritten to {out}; see {out}/report.html")


@app.command()
def payload(
    machine: MachineName,
    recording: RecordingFile,
    frame: Annotated[
        str | None, typer.Option(help="Link that carries the load; the tip if not given.")
    ] = None,
    method: Method = "wls",
) -> None:
    """Estimate mass and centre of mass of what a machine carries from a recording."""
    from crane.identification.payload import estimate_payload
    from crane.recording import Recording

    loaded, carried = _load(machine), Recording.read(recording)
    with _status("estimating"):
        estimate = estimate_payload(loaded, carried, frame, method)
    print(estimate.to_text(), end="")


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
        loaded = _load(what)
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
    with _progress("simulating") as progress:
        text = run_demo(out, progress)
    print(text)
    print(f"figures:    {out}/*/{FIGURE}\nanimations: {out}/*/{PAGE} (open them in a browser)")


def _by_joint(option: str, words: list[str] | None) -> dict[str, float]:
    """Numbers by joint, from JOINT=VALUE."""
    out = {}
    for word in words or ():
        joint, _, text = word.rpartition("=")
        try:
            out[joint] = float(text)
        except ValueError:
            joint = ""
        if not joint:
            raise InputError(f"{option} is '{word}', write JOINT=VALUE, as in X1=0.5")
    return out


def _load(name: str) -> "Machine":
    from crane.machine import load

    return load(name)


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
        return _load(given)
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
    return _load(recording.machine)


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


@contextmanager
def _progress(what: str) -> Iterator[Callable[[float], None]]:
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        job = bar.add_task("compiling the machine's formulas", total=1.0)

        def report(share: float) -> None:
            bar.update(job, description=what, completed=share)

        yield report


@contextmanager
def _status(what: str) -> Iterator[None]:
    """Say what takes a while, where somebody watches."""
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        yield
        return
    with console.status(what):
        yield


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    _say(f"warning: {message}")


def _abandon_output() -> None:
    """Let the interpreter end without a word on what could not be written."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _say(text: str) -> None:
    print(text, file=sys.stderr)
