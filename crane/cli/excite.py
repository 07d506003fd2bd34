"""The command that finds what tells most about a machine: excite."""

from typing import Annotated

import typer

from crane.cli.shared import (
    BY_COMMAND,
    Change,
    Force,
    Lock,
    MachineName,
    Out,
    app,
    by_joint,
    load,
    names,
    progress_bar,
)
from crane.common.errors import InputError

_MOTION = ("period", "harmonics", "periods", "acceleration")  # options without --fit, and with it
_SIGNALS = ("duration", "sensors", "rate", "margin")


@app.command()
def excite(
    context: typer.Context,
    machine: MachineName,
    out: Out = BY_COMMAND,
    fit: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[=START,LOW~HIGH]",
            help="A number that calibrate will fit: signals of the valves instead of a motion.",
        ),
    ] = None,
    duration: Annotated[float, typer.Option(help="Of the signals, in seconds.")] = 20.0,
    sensors: Annotated[
        str | None,
        typer.Option(
            metavar="COLUMNS",
            help="What is measured while signals play; strokes and pressures if not given.",
        ),
    ] = None,
    rate: Annotated[
        float, typer.Option(help="Of signals, at most, in strokes of the spool per second.")
    ] = 2.0,
    margin: Annotated[
        float, typer.Option(help="Share of strokes that signals leave unused at both ends.")
    ] = 0.1,
    period: Annotated[float, typer.Option(help="Of the motion, in seconds.")] = 10.0,
    harmonics: Annotated[int, typer.Option(help="Of the period.")] = 5,
    periods: Annotated[int, typer.Option(help="How many steady ones.")] = 3,
    criterion: Annotated[str, typer.Option(help="logdet or condition.")] = "logdet",
    seed: Annotated[int, typer.Option(help="Of the random starts.")] = 0,
    noise: Annotated[
        list[str] | None,
        typer.Option(
            metavar="JOINT=VALUE",
            help="Deviation of its force, 1 % of the limit if not given; with --fit of a column.",
        ),
    ] = None,
    acceleration: Annotated[
        list[str] | None, typer.Option(metavar="JOINT=VALUE", help="A limit beside the URDF's.")
    ] = None,
    step: Annotated[float, typer.Option(help="Of the recording in seconds.")] = 0.01,
    change: Change = None,
    lock: Lock = None,
    force: Force = False,
) -> None:
    """Find a periodic motion, or with --fit signals of valves, that tell most about a machine."""
    from crane.cli.calibrate import fits
    from crane.cli.runs import check_folder
    from crane.common.atomic_output import replace_folder
    from crane.description.machine_lookup import command_line_arguments
    from crane.identification.excitation.periodic_excitation import excite as find_motion
    from crane.identification.excitation.signal_excitation import excite_valves
    from crane.view.plots.excitation_figure import plot_excitation, plot_signals

    _check_options(context, fit is not None)
    check_folder(out, force)
    wanted = None if fit is None else fits(fit)
    deviations = by_joint("--noise", noise, "JOINT=VALUE, as in X1=0.5")
    limits = by_joint("--acceleration", acceleration)
    loaded = load(machine, lock, change)
    with progress_bar("optimising") as progress:
        if wanted is None:
            motion = find_motion(
                loaded, period=period, harmonics=harmonics, periods=periods, criterion=criterion,
                noise=deviations, acceleration=limits, step=step, seed=seed, progress=progress,
            )  # fmt: skip
        else:
            signals = excite_valves(
                loaded, wanted, duration=duration, sensors=names(sensors), noise=deviations,
                criterion=criterion, rate=rate, margin=margin, step=step, seed=seed,
                progress=progress,
            )  # fmt: skip
    with replace_folder(out, force) as part:
        if wanted is None:
            motion.to_csv(part / "reference.csv")
            motion.to_yaml(part / "coefficients.yaml")
            plot_excitation(motion, part / "reference.png")
        else:
            signals.to_csv(part / "signals.csv")
            plot_signals(signals, part / "signals.png")
    text = motion.to_text() if wanted is None else signals.to_text()
    view = f"see it with: crane view {out}/reference.csv"
    same = command_line_arguments(
        machine, changes=loaded.parameter_changes, lock=loaded.locked_joints
    )
    play = f"play it with: crane simulate {same} --inputs {out}/signals.csv --out run"
    print(f"{text}\n\nwritten to {out}; {view if wanted is None else play}")


def _check_options(context: typer.Context, fit: bool) -> None:
    """See that no option is given that says nothing here.

    Raises:
        InputError: One is.
    """
    strangers, text = _SIGNALS, "only goes with --fit, name numbers to fit or leave it out"
    if fit:
        strangers, text = _MOTION, "does not go with --fit, leave it out"
    for name in strangers:
        source = context.get_parameter_source(name)
        if source is not None and source.name != "DEFAULT":
            raise InputError(f"--{name} {text}")
