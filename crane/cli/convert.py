"""Commands between formats: convert for machines, import for recordings."""

import warnings
from pathlib import Path
from typing import Annotated

import typer

from crane.cli.shared import (
    Active,
    Argument,
    Change,
    Floating,
    Force,
    Free,
    From,
    Lock,
    MachineName,
    Packages,
    Until,
    _place,
    app,
    load,
    span_of,
)
from crane.common.errors import CraneError, CraneWarning, InputError, suggest_names

_FORMATS = ("urdf+", "urdf", "mjcf", "machine")
_SUFFIXES = {".urdf": "urdf+", ".xml": "mjcf", ".mjcf": "mjcf"}


@app.command()
def convert(
    machine: MachineName,
    out: Annotated[
        Path,
        typer.Argument(
            metavar="OUT", help="A .urdf or .xml file, or a folder for a machine file."
        ),
    ],
    to: Annotated[
        str | None,
        typer.Option(
            metavar="FORMAT", help="urdf+, urdf, mjcf or machine; from the suffix otherwise."
        ),
    ] = None,
    change: Change = None,
    lock: Lock = None,
    active: Active = None,
    free: Free = None,
    floating: Floating = False,
    packages: Packages = None,
    argument: Argument = None,
    force: Force = False,
) -> None:
    """Write a machine as one URDF with loops or with them cut, as MJCF, or as machine file."""
    from crane.cli.runs import check_folder, check_free
    from crane.common.atomic_output import replace_file
    from crane.formats import robot_description, write_machine, write_mjcf, write_urdf_plus

    suffix = out.suffix.lower()
    kind = to or _SUFFIXES.get(suffix, "machine")
    if kind not in _FORMATS:
        raise InputError(f"--to is '{kind}', {suggest_names(_FORMATS, kind)}")
    if kind == "machine" and suffix in {*_SUFFIXES, ".yaml", ".yml"}:
        raise InputError(f"{out}: a machine file comes with its URDFs, give the name of a folder")
    if to is None and suffix and suffix not in _SUFFIXES:
        raise InputError(
            f"{out}: {suffix} is not written, give a .urdf or .xml file, or a folder; where the "
            "folder shall have this name, --to machine"
        )
    if kind == "machine":
        check_folder(out, force)
    else:
        check_free(out, force)
    loaded = load(machine, lock, change, active, free, floating, packages, argument)
    if kind == "machine":
        written = write_machine(loaded, out, overwrite=force)
    elif kind == "urdf":
        written = out
        with replace_file(out) as part:
            part.write_text(robot_description(loaded), encoding="utf-8")
    else:
        written = out
        (write_urdf_plus if kind == "urdf+" else write_mjcf)(loaded, out)
    print(f"written to {written}")


@app.command("import")
def import_log(
    log: Annotated[
        Path, typer.Argument(metavar="LOG", help="A CSV or npz file of another program.")
    ],
    columns: Annotated[
        Path,
        typer.Argument(metavar="COLUMNS", help="A text file, a line per column of the recording."),
    ],
    out: Annotated[
        Path,
        typer.Option("--out", metavar="FILE", parser=_place, help="The recording, a .csv file."),
    ],
    since: From = None,
    until: Until = None,
    force: Force = False,
) -> None:
    """Write the recording that is in the log of another program."""
    from crane.cli.runs import check_free
    from crane.formats import load_from_expression
    from crane.recordings import timeseries
    from crane.recordings.logs import read_log_columns
    from crane.recordings.recording_reader import read_sensor_readings, select_time_span

    if out.suffix.lower() != ".csv":
        raise InputError(f"{out}: a recording is written as .csv, name it so")
    span = span_of(since, until)
    check_free(out, force)
    machine, named = None, read_log_columns(columns)[0].get("machine", "")
    try:
        machine = load_from_expression(named) if named else None
    except CraneError as error:
        text = f"{columns}: names of columns are not checked, its machine cannot be read: {error}"
        warnings.warn(text, CraneWarning, stacklevel=2)
    table = select_time_span(read_sensor_readings(log, machine, columns), span, log)
    timeseries.write_table(out, table)
    print(f"{len(table.values)} samples of {len(table.units)} columns written to {out}")
