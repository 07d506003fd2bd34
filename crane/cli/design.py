"""Commands that vary parameters: study, design."""

from typing import Annotated

import typer

import crane
from crane.cli.command import command
from crane.cli.options import (
    Frame,
    MachineName,
    ParallelOptions,
    ParameterOptions,
    Requirements,
    Rule,
    Seed,
    Tasks,
    UserMeasures,
)
from crane.cli.parsing import parameter_units, parse_grids, parse_ranges
from crane.cli.resumable_output import ResumableFolder
from crane.cli.terminal import progress_bar


@command()
def study(
    machine: MachineName,
    options: ParameterOptions,
    parallel: ParallelOptions,
    output: ResumableFolder,
    vary: Annotated[
        list[str],
        typer.Option(
            metavar="NAME=VALUES",
            help="A parameter and its values start:stop:count, or with --draws its range "
            "low~high; may be repeated.",
        ),
    ],
    task: Tasks = None,
    measure: Annotated[
        list[str] | None,
        typer.Option(
            metavar="EXPRESSION",
            help="A measure, e.g. peak_X2 or load(4, 0) / mass; may be repeated; all by default.",
        ),
    ] = None,
    require: Requirements = None,
    measures: UserMeasures = None,
    frame: Frame = None,
    rule: Rule = "none",
    draws: Annotated[int | None, typer.Option(help="Number of random variants.")] = None,
    seed: Seed = 0,
) -> None:
    """Evaluate measures for parameter values (grid, random)."""
    loaded = options.load(machine)
    units_of = parameter_units(loaded)
    axes = parse_grids(vary, units_of) if draws is None else parse_ranges(vary, units_of)
    with output.checkpoint() as checkpoint:
        with progress_bar("computing variants") as progress:
            result = crane.study(
                loaded, axes, task, measure, require=require or (),
                user_measures=measures, frame=frame, rule=rule, draws=draws, seed=seed,
                checkpoint=checkpoint, progress=progress, **parallel.arguments(),
            )  # fmt: skip
        output.write(result)


@command()
def design(
    machine: MachineName,
    options: ParameterOptions,
    parallel: ParallelOptions,
    output: ResumableFolder,
    vary: Annotated[
        list[str],
        typer.Option(metavar="NAME=LOW~HIGH", help="A parameter and its range; may be repeated."),
    ],
    minimise: Annotated[
        list[str] | None,
        typer.Option(metavar="EXPRESSION", help="An objective to minimise; may be repeated."),
    ] = None,
    maximise: Annotated[
        list[str] | None,
        typer.Option(metavar="EXPRESSION", help="An objective to maximise; may be repeated."),
    ] = None,
    require: Requirements = None,
    measures: UserMeasures = None,
    frame: Frame = None,
    rule: Rule = "none",
    task: Tasks = None,
    starts: Annotated[int, typer.Option(help="Number of local searches.")] = 10,
    points: Annotated[
        int, typer.Option(help="Points of the Pareto front of several objectives.")
    ] = 15,
    seed: Seed = 0,
) -> None:
    """Optimize parameters for objectives and constraints."""
    loaded = options.load(machine)
    with output.checkpoint() as checkpoint:
        with progress_bar("searching") as progress:
            result = crane.design(
                loaded, parse_ranges(vary, parameter_units(loaded)),
                minimise=minimise or (), maximise=maximise or (),
                require=require or (), measures=measures, frame=frame, rule=rule, tasks=task,
                starts=starts, points=points, seed=seed, checkpoint=checkpoint, progress=progress,
                **parallel.arguments(),
            )  # fmt: skip
        output.write(result)
