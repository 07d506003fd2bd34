"""The command that changes parameters: study."""

import os
from pathlib import Path
from typing import Annotated

import typer

from crane.cli.shared import (
    Change,
    Force,
    Lock,
    MachineName,
    Out,
    app,
    load,
    progress_bar,
)


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
        list[str] | None,
        typer.Option(help="What to report: peak_X2, load(4, 0) / mass; all if not given."),
    ] = None,
    require: Annotated[
        list[str] | None, typer.Option(metavar="A>=B", help="What has to hold, or A<=B.")
    ] = None,
    measures: Annotated[
        Path | None,
        typer.Option(metavar="FILE.py", help="Measures of your own: functions of a machine."),
    ] = None,
    frame: Annotated[
        str | None, typer.Option(metavar="LINK", help="Where loads hang; the tip if not given.")
    ] = None,
    rule: Annotated[str, typer.Option(help="By which loads are rated.")] = "none",
    draws: Annotated[int | None, typer.Option(help="Number of random variants.")] = None,
    seed: Annotated[int, typer.Option(help="Of the random variants.")] = 0,
    processes: Annotated[
        int | None, typer.Option(help="To compute with; one per core if not given.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Of a Dask cluster to compute on.")
    ] = None,
    change: Change = None,
    lock: Lock = None,
    force: Force = False,
) -> None:
    """Measure variants of a machine: any parameters over a grid or at random."""
    from crane.cli.ranges import ranges
    from crane.cli.runs import check_folder, write_study
    from crane.studies import study as run

    check_folder(out, force)
    axes = ranges(vary, draws)
    with progress_bar("computing variants") as progress:
        result = run(
            load(machine, lock, change), axes, task, measure, require=require or (),
            own=measures, frame=frame, rule=rule, draws=draws, seed=seed, scheduler=scheduler,
            processes=(os.cpu_count() or 1) if processes is None else processes,
            progress=progress,
        )  # fmt: skip
    write_study(out, result, force)
    print(f"{result.to_text()}\nwritten to {out}")
