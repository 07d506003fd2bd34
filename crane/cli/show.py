"""Commands that show machines and runs: view, plot, sketch, live, draw."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import crane
from crane.cli.command import command, refuse_options
from crane.cli.options import (
    Configuration,
    MachineName,
    MachineOptions,
    OutputFile,
    ParameterOptions,
    RecordingOptions,
)
from crane.cli.parsing import joint_units, parse_configuration
from crane.cli.simulate import ExportedController
from crane.cli.terminal import hide_activity_line
from crane.common.atomic_output import check_file_is_writable, portable_file_name
from crane.common.errors import InputError, check_name

if TYPE_CHECKING:
    from crane.common.samples import Array

ShownName = Annotated[
    str,
    typer.Argument(
        metavar="WHAT", help="A machine, the folder of a run, or a recording (CSV or npz)."
    ),
]
RunMachine = Annotated[
    str | None,
    typer.Option(
        metavar="MACHINE", help="Machine to use instead of the one named in the recording."
    ),
]

Host = Annotated[
    str,
    typer.Option(metavar="ADDRESS", help="Address to listen on; 0.0.0.0 accepts all computers."),
]
Port = Annotated[
    int | None,
    typer.Option(
        min=0, max=65535, help="Port to listen on; the first free one from 8080 by default."
    ),
]
NoOpen = Annotated[bool, typer.Option("--no-open", help="Do not open a browser.")]


@command()
def view(
    what: ShownName,
    options: ParameterOptions,
    recording: RecordingOptions,
    output: OutputFile,
    machine: RunMachine = None,
    over: Annotated[
        Path | None,
        typer.Option(metavar="RUN", help="A second run of the machine, drawn over the first."),
    ] = None,
    drive: Annotated[
        bool, typer.Option("--drive", help="A page on which the machine is driven by its levers.")
    ] = False,
    controller: ExportedController = None,
    no_open: NoOpen = False,
) -> None:
    """Write a 3D page of a machine or run, and open it.

    The page of a run plays its motion, and plots its forces and all recorded quantities. With
    --drive the page computes the machine while keys, sliders or a gamepad move its levers.
    """
    from crane.recordings.recording_summary import joint_differences
    from crane.view.page.report_page import open_in_browser
    from crane.view.result_files import PAGE

    if not _is_run(what):
        text = f"is for runs, and '{what}' is none, leave it out"
        refuse_options({"--over": over, "--machine": machine}, text)
        recording.refuse(text)
    loaded, first = _load(what, machine, options, recording)
    second = None if over is None else recording.read(over, loaded)
    if not drive:
        refuse_options({"--controller": controller}, "is for --drive, add it")
    if drive and first is not None:
        raise InputError(f"--drive is for machines, and '{what}' is a run, leave it out")
    if drive:
        page = output.path(Path(portable_file_name(f"{loaded.name}_drive") + ".html"))
    elif first is None:
        page = output.path(Path(portable_file_name(loaded.name) + ".html"))
    else:
        page = output.path(_folder(Path(what)) / PAGE)
    if drive:
        crane.view.drive_page(loaded, page, controller)
    else:
        crane.report(loaded, first, page, second)
    if first is not None and second is not None:
        for one in joint_differences(first, second):
            print(f"{one.joint} differs by at most {' at '.join(one.formatted)}")
    print(f"written to {page}")
    if not no_open and not open_in_browser(page):
        print("no browser found here, open the page yourself")


@command()
def plot(
    run: Annotated[
        Path,
        typer.Argument(metavar="RUN", help="The folder of a run, or a recording (CSV or npz)."),
    ],
    options: ParameterOptions,
    recording: RecordingOptions,
    output: OutputFile,
    machine: RunMachine = None,
) -> None:
    """Plot coordinates, velocities and forces of a run.

    The path of the tip is drawn beside them. The suffix of the file
    determines the format: png, svg or pdf.
    """
    from crane.view.result_files import FIGURE, plot_result

    result = recording.read(run, _run_machine(machine, options))
    figure = output.path(_folder(run) / FIGURE)
    plot_result(result, figure)
    print(f"written to {figure}")


@command()
def sketch(
    machine: MachineName,
    options: MachineOptions,
    output: OutputFile,
    at: Configuration = None,
    plane: Annotated[
        str | None,
        typer.Option(
            metavar="PLANE", help="xy, xz or yz of the world; the machine's plane by default."
        ),
    ] = None,
    com: Annotated[bool, typer.Option("--com", help="Mark centres of mass.")] = False,
    circuit: Annotated[
        bool, typer.Option("--circuit", help="Draw the hydraulic circuit instead.")
    ] = False,
) -> None:
    """Draw the mechanism or the hydraulic circuit.

    The suffix of the file determines the format: png, svg or pdf.
    """
    from crane.formats.assembly_warnings import alternative_configurations

    if circuit:
        refuse_options(
            {"--at": at, "--plane": plane, "--com": com},
            "is for the mechanism, leave it out with --circuit",
        )
    loaded = options.load(machine)
    figure = output.path(
        Path(portable_file_name(loaded.name) + ("_circuit.png" if circuit else "_sketch.png"))
    )
    if circuit:
        crane.view.sketch_circuit(loaded, figure)
    else:
        others = [] if at else alternative_configurations(loaded)
        crane.sketch(loaded, figure, active_coordinates(loaded, at), plane, com, others)
        if others:
            many = f"{len(others)} other assemblies" if len(others) > 1 else "the other assembly"
            print(
                f"dashed: {many} that the file does not rule out; crane check shows how to choose"
            )
    print(f"written to {figure}")


@command()
def live(
    what: ShownName,
    options: MachineOptions,
    recording: RecordingOptions,
    machine: RunMachine = None,
    run: Annotated[
        Path | None, typer.Option(metavar="RUN", help="A run of the machine to play.")
    ] = None,
    host: Host = "127.0.0.1",
    port: Port = None,
) -> None:
    """Move a machine with sliders in a browser.

    The loops are closed at every move; a run is played.
    """
    from crane.view.live.live_session import Playback

    if _is_run(what):
        if run is not None:
            raise InputError(f"'{what}' is a run already, leave --run out")
        if options.given_options():
            raise InputError(
                "--set, --lock, --active and --free are for machines, name the run with --run"
            )
    else:
        refuse_options({"--machine": machine}, f"is for runs, and '{what}' is none, leave it out")
        if run is None:
            recording.refuse("is for runs, name one by --run")
    loaded, played = _load(what, machine, options, recording, run)
    playback = None if played is None else Playback(loaded, played)
    with hide_activity_line():
        crane.view.serve_live_view(crane.view.Session(loaded), playback, host, port)


@command()
def draw(
    output: OutputFile,
    machine: Annotated[
        Path | None,
        typer.Argument(
            metavar="MACHINE", help="A machine file with a drawing; a new one by default."
        ),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A side view to draw on: PNG, JPEG or PDF."),
    ] = None,
    page: Annotated[int, typer.Option(help="Page of a PDF.")] = 1,
    host: Host = "127.0.0.1",
    port: Port = None,
    no_open: NoOpen = False,
) -> None:
    """Draw a machine by its pins in a browser.

    Bodies, cylinders and slides are drawn over a side view, the linkage moves, and the machine
    file is written, by default the one that is read.
    """
    from crane.view.draw.drawing_file import DrawingFile
    from crane.view.draw.drawing_server import serve_drawing
    from crane.view.draw.drawing_session import DrawingSession
    from crane.view.draw.side_view_picture import place_picture

    if picture is None:
        refuse_options({"--page": page != 1 or None}, "is for --picture, add it")
    if machine is not None and output.out in (None, machine):
        check_file_is_writable(machine)
        file = DrawingFile(machine, machine)
    else:
        file = DrawingFile(output.path(Path("drawing.yaml")), machine)
    model, content = place_picture(file, machine, picture, page)
    with hide_activity_line():
        serve_drawing(DrawingSession(file), model, content, host, port, not no_open)


def active_coordinates(machine: "crane.Machine", at: str | None) -> "Array":
    """Active coordinates (n,): those of the home configuration, or of --at.

    Raises:
        InputError: --at has another form, or names something that is no active joint.
    """
    q_a = machine.home[machine.closure.active].copy()
    for joint, value in parse_configuration("--at", at, joint_units(machine)).items():
        check_name(joint, machine.active, f"--at: '{joint}' is no active joint")
        q_a[machine.active.index(joint)] = value
    return q_a


def _is_run(what: str) -> bool:
    from crane.description.machine_lookup import FOLDER_FILES

    if any((Path(what) / name).is_file() for name in FOLDER_FILES):  # a machine in a folder
        return False
    return Path(what).is_dir() or Path(what).suffix.lower() in (".csv", ".npz")


def _folder(run: Path) -> Path:
    return run if run.is_dir() else run.parent


def _load(
    what: str,
    machine: str | None,
    options: ParameterOptions,
    recording: RecordingOptions,
    run: Path | None = None,
) -> "tuple[crane.Machine, crane.Recording | None]":
    """The machine, and the recording of what is a run, or of a run of the machine."""
    from crane.recordings.measured_recordings import recorded_machine

    if not _is_run(what):
        loaded = options.load(what)
        return loaded, None if run is None else recording.read(run, loaded)
    given = _run_machine(machine, options)
    read = recording.read(Path(what), given)
    return given or recorded_machine(what, read.machine), read


def _run_machine(name: str | None, options: ParameterOptions) -> "crane.Machine | None":
    """The machine that is given beside a run; None if the recorded one is meant."""
    if name is None:
        options.refuse("is for a machine, name it by --machine")
        return None
    return options.load(name)
