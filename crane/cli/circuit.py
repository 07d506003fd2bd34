"""The command that finds a cylinder's valve, oil and friction: circuit."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crane.cli.shared import (
    Change,
    Columns,
    Force,
    From,
    Lock,
    MachineName,
    Until,
    app,
    load,
    span_of,
    status,
)
from crane.common.errors import InputError, suggest_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from crane.machine import Machine
    from crane.recordings.recording import Recording

MODELS = ("orifices", "valve", "friction")


@app.command()
def circuit(
    machine: MachineName,
    recording: Annotated[
        list[Path],
        typer.Argument(
            metavar="RECORDING...", help="Recordings (CSV or npz) with voltages and pressures."
        ),
    ],
    joint: Annotated[str, typer.Option(metavar="JOINT", help="The cylinder's.")],
    model: Annotated[
        str,
        typer.Option(
            help="orifices (bulk modulus, c1 to c4), valve (neutral signal, dead band of a "
            "compensated one), or friction."
        ),
    ] = "orifices",
    method: Annotated[
        str | None, typer.Option(help="Of orifices: weak, chambers or ls; weak if not given.")
    ] = None,
    period: Annotated[
        float | None,
        typer.Option(help="Of a periodic motion in seconds, averaged first; of orifices."),
    ] = None,
    validation: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A recording to be judged by; of orifices.")
    ] = None,
    change: Change = None,
    lock: Lock = None,
    columns: Columns = None,
    since: From = None,
    until: Until = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FOLDER", help="Folder for the table and its figure."),
    ] = None,
    force: Force = False,
) -> None:
    """Find bulk modulus and orifices, the valve's curve, or the friction of one cylinder."""
    from crane.cli.runs import check_folder, read_run
    from crane.common.atomic_output import replace_folder
    from crane.identification.hydraulics.cylinder_signals import required_channels

    if model not in MODELS:
        raise InputError(f"model '{model}' is unknown, {suggest_names(MODELS, model)}")
    of_orifices = {"--method": method, "--period": period, "--validation": validation}
    given = [option for option, value in of_orifices.items() if value is not None]
    if model != "orifices" and given:
        raise InputError(f"{given[0]} is for --model orifices, leave it out")
    if model != "orifices" and len(recording) > 1:
        raise InputError(f"--model {model} takes one recording, {len(recording)} are given")
    if out is not None:
        check_folder(out, force)
    span = span_of(since, until)
    loaded = load(machine, lock, change)
    if joint not in loaded.active:
        raise InputError(
            f"'{joint}' is not an active joint, {suggest_names(loaded.active, joint)}"
        )
    needs = required_channels(joint) if model == "orifices" else []
    if model == "valve":
        needs.append((f"voltage_{joint}",))
    runs = [read_run(path, loaded, columns, span, needs) for path in recording]
    judge = None if validation is None else read_run(validation, loaded, columns, needs=needs)
    with status("identifying"):
        if model == "orifices":
            text, figure = _orifices(loaded, runs, joint, method or "weak", period, judge)
        elif model == "valve":
            text, figure = _valve(loaded, runs[0], joint)
        else:
            text, figure = _friction(loaded, runs[0], joint)
    print(text, end="")
    if out is None:
        return
    with replace_folder(out, force) as part:
        (part / f"{model}.txt").write_text(text, encoding="utf-8")
        figure.savefig(part / f"{model}.png", format="png", dpi=200)
    print(f"\nwritten to {out}")


def _orifices(
    machine: "Machine",
    runs: "list[Recording]",
    joint: str,
    method: str,
    period: float | None,
    judge: "Recording | None",
) -> "tuple[str, Figure]":
    from crane.identification.hydraulics.orifice_coefficients import identify_orifices
    from crane.view.plots.identification_figures import equation_sides_figure

    found = identify_orifices(machine, runs, joint, method, period=period)
    shown = {f"recording {i + 1}": both for i, both in enumerate(found.training_sides)}
    text = found.to_text()
    if judge is not None:
        both = found.predict(judge, period)
        shown["validation"] = both
        text += f"validation: relative error of (29) {100 * both.relative_error:.3g} %\n"
    return text, equation_sides_figure(shown, machine.unit(joint))


def _valve(machine: "Machine", run: "Recording", joint: str) -> "tuple[str, Figure]":
    from crane.identification.hydraulics.valve_curve import identify_valve
    from crane.view.plots.identification_figures import valve_curve_figure

    curve = identify_valve(machine, run, joint)
    unit = machine.unit(joint)
    return curve.to_text(unit), valve_curve_figure(curve, unit)


def _friction(machine: "Machine", run: "Recording", joint: str) -> "tuple[str, Figure]":
    from crane.identification.hydraulics.cylinder_friction import identify_cylinder_friction
    from crane.view.plots.identification_figures import friction_figure

    found = identify_cylinder_friction(machine, run, joint)
    unit = machine.unit(joint)
    return found.to_text(unit), friction_figure(found, unit)
