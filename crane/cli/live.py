"""The command that shows a machine to play with: live."""

from pathlib import Path
from typing import Annotated

import typer

from crane.cli.shared import (
    Active,
    Argument,
    Change,
    Columns,
    Floating,
    Free,
    From,
    Lock,
    Packages,
    Until,
    app,
    load,
    span_of,
)
from crane.cli.waiting import shown
from crane.common.errors import InputError


@app.command()
def live(
    what: Annotated[
        str, typer.Argument(metavar="WHAT", help="A machine, a run's folder, or a recording.")
    ],
    machine: Annotated[
        str | None,
        typer.Option(metavar="MACHINE", help="The machine of a run, if not as recorded."),
    ] = None,
    run: Annotated[
        Path | None, typer.Option(metavar="RUN", help="A run of the machine to play.")
    ] = None,
    columns: Columns = None,
    since: From = None,
    until: Until = None,
    host: Annotated[
        str, typer.Option(metavar="ADDRESS", help="To listen on; 0.0.0.0 for all computers.")
    ] = "127.0.0.1",
    port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="To listen on; the first free one from 8080."),
    ] = None,
    change: Change = None,
    lock: Lock = None,
    active: Active = None,
    free: Free = None,
    floating: Floating = False,
    packages: Packages = None,
    argument: Argument = None,
) -> None:
    """Move a machine with sliders in a browser, its loops closed at every move."""
    from crane.cli.commands import is_run
    from crane.cli.runs import machine_of, read_run
    from crane.view.live.live_server import serve_live_view
    from crane.view.live.live_session import Playback, Session

    recording = None
    if is_run(what):
        if run is not None:
            raise InputError(f"'{what}' is a run already, leave --run out")
        if change or lock or active or free or floating or packages or argument:
            raise InputError(
                "--set, --lock, --active and --free are for machines, name the run with --run"
            )
        given = None if machine is None else load(machine)
        recording = read_run(Path(what), given, columns, span_of(since, until))
        loaded = given or machine_of(what, recording.machine)
    elif machine is not None:
        raise InputError(f"--machine is for runs, and '{what}' is none, leave it out")
    else:
        loaded = load(what, lock, change, active, free, floating, packages, argument)
        of_runs = {"--columns": columns, "--from": since, "--until": until}
        for option in [x for x, given in of_runs.items() if given is not None and run is None]:
            raise InputError(f"{option} is for runs, name one by --run")
        if run is not None:
            recording = read_run(run, loaded, columns, span_of(since, until))
    playback = None if recording is None else Playback(loaded, recording)
    with shown():
        serve_live_view(Session(loaded), playback, host, port)
