"""The command that finds numbers of a machine: design."""

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
def design(
    machine: MachineName,
    vary: Annotated[
        list[str], typer.Option(metavar="NAME=LOW~HIGH", help="A number and its range.")
    ],
    out: Out = BY_COMMAND,
    minimise: Annotated[
        list[str] | None, typer.Option(metavar="EXPRESSION", help="What shall be the least.")
    ] = None,
    maximise: Annotated[
        list[str] | None, typer.Option(metavar="EXPRESSION", help="What shall be the largest.")
    ] = None,
    require: Require = None,
    measures: OwnMeasures = None,
    frame: LoadFrame = None,
    rule: LoadRule = "none",
    task: Annotated[
        list[str] | None, typer.Option(help="A task for forces and energy; all if not given.")
    ] = None,
    starts: Annotated[int, typer.Option(help="Number of searches.")] = 10,
    points: Annotated[int, typer.Option(help="Of the front, with several goals.")] = 15,
    seed: Annotated[int, typer.Option(help="Of the starts.")] = 0,
    processes: Processes = None,
    scheduler: Scheduler = None,
    change: Change = None,
    lock: Lock = None,
    force: Force = False,
) -> None:
    """Find the numbers of a machine that are best for loads, forces or measures of your own."""
    from crane.cli.ranges import drawn
    from crane.cli.runs import check_folder, write_design
    from crane.studies.design import design as run

    check_folder(out, force)
    loaded = load(machine, lock, change)
    with progress_bar("searching") as progress:
        found = run(
            loaded, drawn(vary), minimise=minimise or (), maximise=maximise or (),
            require=require or (), measures=measures, frame=frame, rule=rule, tasks=task,
            starts=starts, points=points, seed=seed, scheduler=scheduler,
            processes=(os.cpu_count() or 1) if processes is None else processes,
            progress=progress,
        )  # fmt: skip
    write_design(out, found, force)
    print(f"{found.to_markdown()}\nwritten to {out}")
