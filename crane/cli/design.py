"""Commands that change or find parameters: study, excite, identify, payload."""

import os
from typing import Annotated

import typer

from crane.cli.shared import (
    Force,
    MachineName,
    Out,
    app,
    by_joint,
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
def excite(
    machine: MachineName,
    out: Out,
    period: Annotated[float, typer.Option(help="In seconds.")] = 10.0,
    harmonics: Annotated[int, typer.Option(help="Of the period.")] = 5,
    periods: Annotated[int, typer.Option(help="How many steady ones.")] = 3,
    criterion: Annotated[str, typer.Option(help="logdet or condition.")] = "logdet",
    seed: Annotated[int, typer.Option(help="Of the random starts.")] = 0,
    noise: Annotated[
        list[str] | None,
        typer.Option(
            metavar="JOINT=VALUE", help="Deviation of its force; 1 % of the limit if not given."
        ),
    ] = None,
    acceleration: Annotated[
        list[str] | None, typer.Option(metavar="JOINT=VALUE", help="A limit beside the URDF's.")
    ] = None,
    step: Annotated[float, typer.Option(help="Of the recording in seconds.")] = 0.01,
    force: Force = False,
) -> None:
    """Find a periodic motion that tells most about a machine's parameters."""
    # its matrices are small: threads would only wait for each other
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from crane.cli.runs import check_folder
    from crane.common.output import staging
    from crane.identification.excitation.excite import excite as run
    from crane.view.plots.excitation import plot_excitation

    check_folder(out, force)
    loaded = load(machine)
    with progress_bar("optimising") as progress:
        found = run(
            loaded, period=period, harmonics=harmonics, periods=periods, criterion=criterion,
            noise=by_joint("--noise", noise), acceleration=by_joint(
                "--acceleration", acceleration
            ), step=step, seed=seed, progress=progress,
        )  # fmt: skip
    with staging(out) as part:
        found.to_csv(part / "reference.csv")
        found.to_yaml(part / "coefficients.yaml")
        plot_excitation(found, part / "reference.png")
    print(f"{found.to_text()}\n\nwritten to {out}; see it with: crane view {out}/reference.csv")
