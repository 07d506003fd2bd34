"""The command that fits a machine to recordings of it: calibrate."""

from pathlib import Path
from typing import Annotated

import typer

from crane.cli.shared import (
    Change,
    Columns,
    Force,
    From,
    Lock,
    MachineName,
    Train,
    Until,
    Validation,
    app,
    load,
    names,
    progress_bar,
    span_of,
    window,
)
from crane.common.errors import InputError

_FORM = "NAME, NAME=START, or NAME=START,LOW~HIGH"


@app.command()
def calibrate(
    machine: MachineName,
    recording: Annotated[
        list[Path],
        typer.Argument(
            metavar="RECORDING...", help="Recordings (CSV or npz) with signals of the valves."
        ),
    ],
    fit: Annotated[
        list[str],
        typer.Option(
            metavar="NAME[=START,LOW~HIGH]",
            help="A number to fit, as payload.mass, friction.*.viscous, sensor.q2.zero; auto: all "
            "that the recordings tell.",
        ),
    ],
    train: Train = None,
    validation: Validation = None,
    columns: Columns = None,
    since: From = None,
    until: Until = None,
    sensors: Annotated[
        str | None,
        typer.Option(metavar="COLUMNS", help="What is compared, as X_lift,pressure_X_lift_a."),
    ] = None,
    change: Change = None,
    lock: Lock = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="FOLDER", help="Folder for machine, page, report and picture."
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Fit numbers of a machine to recordings, through the simulation of its valve signals."""
    from crane.cli.runs import check_folder, write_calibration
    from crane.identification.calibration.calibrate import calibrate as run

    if out is not None:
        check_folder(out, force)
    wanted = fits(fit)
    fitted, span = window(train), span_of(since, until)
    loaded = load(machine, lock, change)
    with progress_bar("simulating") as progress:
        found = run(
            loaded, recording, wanted, train=fitted, validation=validation or (), columns=columns,
            span=span, sensors=names(sensors), progress=progress,
        )  # fmt: skip
    text = found.to_text()
    if out is not None:
        write_calibration(out, found, force)
        text += f"\nwritten to {out}; see {out}/report.html"
    print(text)


def fits(words: list[str]) -> dict[str, object]:
    """What is to be fitted: by name nothing, a start, or start, least and largest.

    Raises:
        InputError: Something else is written, or a name twice.
    """
    found: dict[str, object] = {}
    for word in words:
        name, equals, text = word.partition("=")
        name = name.strip()
        if not name:
            raise InputError(f"--fit is '{word}', write {_FORM}")
        if name in found:
            raise InputError(f"--fit names '{name}' twice, give it once")
        start, comma, span = text.partition(",")
        low, tilde, high = span.partition("~")
        try:
            if not equals:
                found[name] = None
            elif not comma:
                found[name] = float(start)
            elif tilde:
                found[name] = float(start), float(low), float(high)
            else:
                raise ValueError
        except ValueError:
            raise InputError(f"--fit is '{word}', write {_FORM}") from None
    return found
