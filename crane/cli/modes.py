"""The command on small motions of a machine: modes."""

from pathlib import Path
from typing import Annotated

import typer

from crane.cli.shared import (
    Active,
    Argument,
    Change,
    Floating,
    Force,
    Free,
    Lock,
    MachineName,
    Packages,
    app,
    by_joint,
    load,
    names,
    progress_bar,
    status,
)

_FORM = "JOINT=VALUE,..., as in q1=0.1,X1=0.02"


@app.command()
def modes(
    machine: MachineName,
    at: Annotated[
        str | None,
        typer.Option(
            metavar="JOINT=VALUE,...",
            help="Active coordinates in m or rad; home for those that are not named.",
        ),
    ] = None,
    velocity: Annotated[
        str | None,
        typer.Option(
            metavar="JOINT=VALUE,...",
            help="Their velocities in m/s or rad/s, which opens valves; at rest if not given.",
        ),
    ] = None,
    drive: Annotated[
        str | None, typer.Option(help="valves or forces; valves where there are any.")
    ] = None,
    outputs: Annotated[
        str | None,
        typer.Option(metavar="NAMES", help="What the model gives, as tip_z,pressure_lift_a."),
    ] = None,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUES",
            help="A joint or parameter over start:stop:count, drawn instead; may be repeated.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FOLDER", help="Folder for model, pictures and page."),
    ] = None,
    change: Change = None,
    lock: Lock = None,
    active: Active = None,
    free: Free = None,
    floating: Floating = False,
    packages: Packages = None,
    argument: Argument = None,
    force: Force = False,
) -> None:
    """Show how a machine moves in small: frequencies, damping, shapes, responses."""
    from crane.cli.ranges import ranges
    from crane.cli.runs import check_folder, write_modes
    from crane.simulation.linear import linear_models, linearize

    if out is not None:
        check_folder(out, force)
    axes = ranges(vary or [])
    loaded = load(machine, lock, change, active, free, floating, packages, argument)
    place = by_joint("--at", at.split(",") if at else None, _FORM)
    pace = by_joint("--velocity", velocity.split(",") if velocity else None, _FORM)
    with status("linearizing"):
        model = linearize(loaded, place, velocity=pace, drive=drive, outputs=names(outputs))
    found = []
    if axes:
        with progress_bar("linearizing") as progress:
            found = linear_models(loaded, axes, place, drive=drive, progress=progress)
    text = model.to_text()
    if out is not None:
        with status("drawing"):
            write_modes(out, model, found, force)
        text += f"\nwritten to {out}"
    print(text)
