"""Commands that change or find parameters: study, identify, payload."""

import os
from pathlib import Path
from typing import Annotated

import typer

from crane.cli.shared import (
    Columns,
    Force,
    From,
    Lock,
    MachineName,
    Method,
    Out,
    RecordingFile,
    Trust,
    Until,
    app,
    by_joint,
    load,
    progress_bar,
    span_of,
    status,
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
        list[str] | None, typer.Option(help="What to report, such as peak_X2; all if not given.")
    ] = None,
    draws: Annotated[int | None, typer.Option(help="Number of random variants.")] = None,
    seed: Annotated[int, typer.Option(help="Of the random variants.")] = 0,
    processes: Annotated[
        int | None, typer.Option(help="To compute with; one per core if not given.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Of a Dask cluster to compute on.")
    ] = None,
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
            machine, axes, task, measure, draws=draws, seed=seed, scheduler=scheduler,
            processes=(os.cpu_count() or 1) if processes is None else processes,
            progress=progress,
        )  # fmt: skip
    write_study(out, result)
    print(f"{result.to_text()}\nwritten to {out}")


@app.command()
def identify(
    machine: MachineName,
    recording: RecordingFile,
    out: Out,
    validation: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A recording to be judged by.")
    ] = None,
    method: Method = "wls",
    prior: Annotated[
        float | None,
        typer.Option(help="Relative standard deviation of the described bodies, such as 0.3."),
    ] = None,
    feasible: Annotated[
        bool, typer.Option("--feasible", help="Only bodies and friction that can exist.")
    ] = False,
    bandwidth: Annotated[
        float | None,
        typer.Option(metavar="HZ", help="Of the low-pass; by the motion if not given."),
    ] = None,
    slow: Annotated[
        list[str] | None,
        typer.Option(
            metavar="JOINT=VALUE",
            help="Velocity below which its rows are left out, in m/s or rad/s.",
        ),
    ] = None,
    lock: Lock = None,
    columns: Columns = None,
    since: From = None,
    until: Until = None,
    trust: Trust = False,
    force: Force = False,
) -> None:
    """Find a machine's parameters from a recording, and how well they predict."""
    from crane.cli.runs import check_folder, read_run, write_identification
    from crane.common.samples import as_number
    from crane.identification.mechanics.identify import identify as run
    from crane.identification.mechanics.write import check_rewritable

    check_folder(out, force)
    span = span_of(since, until)
    loaded = load(machine, lock)
    if feasible:
        check_rewritable(loaded)
    with status(f"reading {recording.name}"):
        learned = read_run(recording, loaded, columns, span)
    if bandwidth is not None:
        longest = max(float(learned.time[-1] - learned.time[0]), 1e-3)
        as_number(bandwidth, "the bandwidth", "Hz", above=5 / longest)
    judge = None
    if validation is not None:
        with status(f"reading {validation.name}"):
            judge = read_run(validation, loaded, columns)
    with progress_bar("identifying") as progress:
        result = run(
            loaded,
            learned,
            judge,
            method,
            prior,
            feasible,
            bandwidth=bandwidth,
            slow=by_joint("--slow", slow),
            trust=trust,
            progress=progress,
        )
    with status("writing the report"):
        name = "" if validation is None else validation.name
        write_identification(out, result, recording.name, name)
    print(f"{result.to_text()}\nwritten to {out}; see {out}/report.html")


@app.command()
def payload(
    machine: MachineName,
    recording: RecordingFile,
    frame: Annotated[
        str | None, typer.Option(help="Link that carries the load; the tip if not given.")
    ] = None,
    method: Method = "wls",
    lock: Lock = None,
    columns: Columns = None,
    since: From = None,
    until: Until = None,
    trust: Trust = False,
) -> None:
    """Estimate mass and centre of mass of what a machine carries from a recording."""
    from crane.cli.runs import read_run
    from crane.identification.mechanics.payload import identify_payload

    span = span_of(since, until)
    loaded = load(machine, lock)
    with status(f"reading {recording.name}"):
        carried = read_run(recording, loaded, columns, span)
    with progress_bar("estimating") as progress:
        estimate = identify_payload(loaded, carried, frame, method, trust=trust, progress=progress)
    print(estimate.to_text(), end="")
