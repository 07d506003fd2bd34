"""The command on how far a machine works: working-range."""

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


@app.command("working-range")
def working_range(
    machine: MachineName,
    frame: Annotated[
        str | None, typer.Option(metavar="LINK", help="The lip; the tip if not given.")
    ] = None,
    bucket: Annotated[
        str | None, typer.Option(metavar="JOINT", help="The joint whose drive curls the bucket.")
    ] = None,
    level: Annotated[
        float, typer.Option(metavar="M", help="Length of the level bottom, in m.")
    ] = 2.44,
    out: Out = BY_COMMAND,
    change: Change = None,
    lock: Lock = None,
    active: Active = None,
    free: Free = None,
    floating: Floating = False,
    packages: Packages = None,
    argument: Argument = None,
    force: Force = False,
) -> None:
    """Compute reach, digging depth, dump height and more, and draw them as brochures do."""
    from crane.cli.runs import check_folder, write_working_range
    from crane.ratings import working_range as measure

    check_folder(out, force)
    loaded = load(machine, lock, change, active, free, floating, packages, argument)
    with status("measuring"):
        found = measure(loaded, frame, bucket=bucket, level=level)
    with status("drawing"):
        text = write_working_range(out, found, force)
    print(f"{text}\nwritten to {out}")
