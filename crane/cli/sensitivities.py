"""The command on what a motion depends on: sensitivities."""

from pathlib import Path
from typing import Annotated

import typer

from crane.cli.shared import (
    Change,
    Force,
    Lock,
    MachineName,
    app,
    load,
    names,
    progress_bar,
)
from crane.cli.simulate import control_of, duration_of, under_task


@app.command()
def sensitivities(
    machine: MachineName,
    by: Annotated[
        list[str],
        typer.Option(
            metavar="NAME",
            help="A number, as payload.mass, oil.bulk_modulus, lift_eye.x, start.X_lift; may be "
            "repeated.",
        ),
    ],
    task: Annotated[str | None, typer.Option(help="A task of the machine.")] = None,
    controller: Annotated[
        str | None, typer.Option(help="As of simulate; the usual one if not given.")
    ] = None,
    duration: Annotated[
        float | None, typer.Option(help="In seconds; that of the task if not given.")
    ] = None,
    step: Annotated[float, typer.Option(help="Between recorded instants in seconds.")] = 1e-3,
    outputs: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="What is looked at, as X_lift,tip_z,pressure_X_lift_a; joints and pressures if "
            "not given.",
        ),
    ] = None,
    change: Change = None,
    lock: Lock = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FOLDER", help="Folder for table, derivatives, picture."),
    ] = None,
    force: Force = False,
) -> None:
    """Show which numbers of a machine a motion depends on, exactly."""
    from crane.cli.runs import check_folder, write_sensitivities
    from crane.simulation.sensitivity import sensitivities as run

    if out is not None:
        check_folder(out, force)
    loaded = under_task(load(machine, lock, change), task)
    control = control_of(loaded, task, controller)
    with progress_bar("simulating") as progress:
        found = run(
            loaded,
            control,
            duration=duration_of(loaded, task, duration),
            step=step,
            parameters=by,
            outputs=names(outputs),
            progress=progress,
        )
    text = found.to_text()
    if out is not None:
        write_sensitivities(out, found, force)
        text += f"\n\nwritten to {out}"
    print(text)
