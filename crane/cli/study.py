"""The command that changes parameters: study."""

import os
from typing import Annotated

import typer

from crane.cli.shared import (
    BY_COMMAND,
    Change,
    Force,
    LoadFrame,
    LoadRule,
    Lock,
    MachineName,
    Out,
    OwnMeasures,
    Processes,
    Require,
    Scheduler,
    app,
    load,
    progress_bar,
)


@app.command()
def study(
    machine: MachineName,
    vary: Annotated[
        list[str],
        typer.Option(
            metavar="NAME=VALUES",
            help="A parameter and its values start:stop:count, or with --draws low~high.",
        ),
    ],
    out: Out = BY_COMMAND,
    task: Annotated[
        list[str] | None, typer.Option(help="A task to measure with; all if not given.")
    ] = None,
    measure: Annotated[
        list[str] | None,
        typer.Option(help="What to report: peak_X2, load(4, 0) / mass; all if not given."),
    ] = None,
    require: Require = None,
    measures: OwnMeasures = None,
    frame: LoadFrame = None,
    rule: LoadRule = "none",
    draws: Annotated[int | None, typer.Option(help="Number of random variants.")] = None,
    seed: Annotated[int, typer.Option(help="Of the random variants.")] = 0,
    processes: Processes = None,
    scheduler: Scheduler = None,
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
            load(machine, lock, change),
            axes,
            task,
            measure,
            require=require or (),
            user_measures=measures,
            frame=frame,
            rule=rule,
            draws=draws,
            seed=seed,
            scheduler=scheduler,
            processes=(os.cpu_count() or 1) if processes is None else processes,
            progress=progress,
        )
    write_study(out, result, force)
    print(f"{result.to_text()}\nwritten to {out}")
