"""The command on where a machine reaches: workspace."""

from typing import Annotated

import typer

from crane.cli.shared import (
    BY_COMMAND,
    Active,
    Argument,
    Change,
    Floating,
    Force,
    Free,
    Lock,
    MachineName,
    Out,
    Packages,
    app,
    load,
    status,
)


@app.command()
def workspace(
    machine: MachineName,
    out: Out = BY_COMMAND,
    samples: Annotated[int, typer.Option(help="About how many postures.")] = 10_000,
    frame: Annotated[
        str | None, typer.Option(metavar="LINK", help="What moves; the tip if not given.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of what is drawn for many strokes.")] = 0,
    change: Change = None,
    lock: Lock = None,
    active: Active = None,
    free: Free = None,
    floating: Floating = False,
    packages: Packages = None,
    argument: Argument = None,
    force: Force = False,
) -> None:
    """Map what the tip reaches, which strokes close, and where they are singular."""
    from crane.cli.runs import check_folder, write_workspace
    from crane.motion.workspaces import workspace as explore

    check_folder(out, force)
    loaded = load(machine, lock, change, active, free, floating, packages, argument)
    with status("exploring"):
        space = explore(loaded, samples, frame, seed)
    with status("drawing"):
        text = write_workspace(out, space, force)
    print(f"{text}\nwritten to {out}")
