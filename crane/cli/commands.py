"""Commands on machines and runs: list, info, simulate, view, plot, demo."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crane.cli.shared import (
    BY_COMMAND,
    Active,
    Argument,
    Columns,
    Floating,
    Force,
    Free,
    From,
    Lock,
    MachineName,
    NoOpen,
    Out,
    OutFile,
    Packages,
    Until,
    app,
    arguments,
    load,
    progress_bar,
    span_of,
)
from crane.common.errors import InputError

if TYPE_CHECKING:
    from crane.machine import Machine

RunMachine = Annotated[
    str | None, typer.Option(metavar="MACHINE", help="The machine of a run, if not as recorded.")
]


@app.command("list")
def list_machines(
    robots: Annotated[
        bool, typer.Option("--robots", help="List the robots of example-robot-data instead.")
    ] = False,
) -> None:
    """List the machines that can be named."""
    from crane.common.one_line_repr import format_count
    from crane.description import bundled_machines, example_robots
    from crane.description.machine_lookup import machine_summary

    others = example_robots()
    if robots:
        if not others:
            raise InputError("there are no robots here, install example-robot-data")
        print("Robots of example-robot-data, open chains; some are refused by the strict reading:")
        print("\n".join(f"  {name}" for name in others))
        return
    machines = bundled_machines()
    width = max(map(len, machines))
    print("Bundled machines; crane info NAME says more of one:")
    for name, path in machines.items():
        print(f"  {name:{width}}  {machine_summary(path)}")
    if others:
        number = format_count(len(others), "robot")
        print(f"{number} of example-robot-data can be named likewise: crane list --robots")


@app.command()
def info(
    machine: MachineName,
    pattern: Annotated[
        str | None,
        typer.Argument(
            metavar="[PATTERN]",
            help="List its joints, frames, columns and parameters of such names: a part of one, "
            "or with * and ? all of it.",
        ),
    ] = None,
    parameters: Annotated[
        bool,
        typer.Option(
            "--parameters",
            "--names",
            help="List the names that --set, --vary and --fit take, and their values; those of a "
            "PATTERN, as above.",
        ),
    ] = False,
    active: Active = None,
    free: Free = None,
    floating: Floating = False,
    packages: Packages = None,
    argument: Argument = None,
) -> None:
    """Show what a machine consists of, or what of it has a name."""
    if parameters or pattern is not None:
        from crane.common.package_search import check_package_folders, use_load_options
        from crane.description import parameters as parameters_of
        from crane.description.name_search import names_by_kind, search_names
        from crane.formats import read_machine_spec

        with use_load_options(check_package_folders(packages or ()), arguments(argument)):
            spec = read_machine_spec(machine)
        every = {"parameter": {name: f"{x:.6g}" for name, x in parameters_of(spec).items()}}
        if pattern is not None:
            every = search_names(names_by_kind(spec), pattern)
        width = max((len(name) for values in every.values() for name in values), default=0)
        for kind, values in every.items():
            before = f"{kind:<11}" * (pattern is not None)
            for name, text in values.items():
                print(f"{before}{name:{width}}  {text}".rstrip())
        return
    loaded = load(machine, None, None, active, free, floating, packages, argument)
    for line in _describe(loaded):
        print(line)


@app.command()
def view(
    what: Annotated[
        str, typer.Argument(metavar="WHAT", help="A machine, a run's folder, or a recording.")
    ],
    machine: RunMachine = None,
    over: Annotated[
        Path | None,
        typer.Option(metavar="RUN", help="A second run of the machine, laid over the first."),
    ] = None,
    lock: Lock = None,
    columns: Columns = None,
    since: From = None,
    until: Until = None,
    out: OutFile = None,
    no_open: NoOpen = False,
    force: Force = False,
) -> None:
    """Write a page that shows a machine, or a run with its forces and numbers, and open it."""
    from crane.cli.runs import PAGE, check_free, machine_of, read_run
    from crane.common.atomic_output import portable_file_name
    from crane.recordings.recording_summary import joint_differences
    from crane.view.page.report_page import open_in_browser, report

    recording = other = None
    if is_run(what):
        path = Path(what)
        given, span = _machine_of_run(machine, lock), span_of(since, until)
        recording = read_run(path, given, columns, span)
        loaded = given or machine_of(what, recording.machine)
        if over is not None:
            other = read_run(over, loaded, columns, span)
        page = out or (path if path.is_dir() else path.parent) / PAGE
    else:
        of_runs = {
            "--over": over, "--machine": machine, "--lock": lock, "--columns": columns,
            "--from": since, "--until": until,
        }  # fmt: skip
        for option, value in of_runs.items():
            if value is not None:
                raise InputError(f"{option} is for runs, and '{what}' is none, leave it out")
        loaded = load(what)
        page = out or Path(portable_file_name(loaded.name) + ".html")
    check_free(page, force)
    report(loaded, recording, page, other)
    if recording is not None and other is not None:
        for one in joint_differences(recording, other):
            print(f"{one.joint} differs by at most {' at '.join(one.formatted)}")
    print(f"written to {page}")
    if not no_open and not open_in_browser(page):
        print("no browser found here, open the page yourself")


@app.command()
def plot(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run's folder or a recording.")],
    machine: RunMachine = None,
    lock: Lock = None,
    columns: Columns = None,
    since: From = None,
    until: Until = None,
    out: OutFile = None,
    force: Force = False,
) -> None:
    """Plot displacements, velocities, forces and tip path of a run (png, svg or pdf)."""
    from crane.cli.runs import FIGURE, check_free, read_run
    from crane.view.plots.recording_figure import plot_recording

    recording = read_run(run, _machine_of_run(machine, lock), columns, span_of(since, until))
    figure = out or (run if run.is_dir() else run.parent) / FIGURE
    check_free(figure, force)
    plot_recording(recording, figure)
    print(f"written to {figure}")


@app.command()
def demo(out: Out = BY_COMMAND, force: Force = False) -> None:
    """Simulate the three published trajectories of the reduced-scale forwarder."""
    from crane.cli.demo import run_demo
    from crane.cli.runs import FIGURE, PAGE, check_folder

    check_folder(out, force)
    with progress_bar("simulating") as progress:
        text = run_demo(out, progress, force)
    print(text)
    print(f"figures:    {out}/*/{FIGURE}\nanimations: {out}/*/{PAGE} (open them in a browser)")


def _machine_of_run(name: str | None, lock: list[str] | None) -> "Machine | None":
    if name is None and lock:
        raise InputError("--lock is for a machine, name it by --machine")
    return None if name is None else load(name, lock)


def is_run(what: str) -> bool:
    """Whether a run is meant and no machine."""
    from crane.description.machine_lookup import FOLDER_FILES

    if any((Path(what) / name).is_file() for name in FOLDER_FILES):  # a machine in a folder
        return False
    return Path(what).is_dir() or Path(what).suffix.lower() in (".csv", ".npz")


def _describe(machine: "Machine") -> Iterator[str]:
    """Its facts; rows of their tables below them, without cells that say nothing."""
    from crane.view.machine_facts import machine_facts

    facts = list(machine_facts(machine))
    width = max(10, 1 + max((len(row[0]) for fact in facts for row in fact.rows), default=0))
    yield machine.name
    for fact in facts:
        yield f"  {fact.name:<12}{fact.text}"
        for row in fact.rows:
            cells = zip(fact.heading[1:], row[1:], strict=True)
            words = ", ".join(f"{head} {cell}".strip() for head, cell in cells if cell)
            yield f"    {row[0]:<{width}}{words}"
