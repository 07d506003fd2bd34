"""The command that writes a machine in another format."""

from pathlib import Path
from typing import Annotated

import typer

from crane.cli.shared import Change, Force, Lock, MachineName, app, load
from crane.errors import InputError, known

_FORMATS = ("urdf+", "mjcf", "machine")
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
        typer.Option(metavar="FORMAT", help="urdf+, mjcf or machine; from the suffix otherwise."),
    ] = None,
    change: Change = None,
    lock: Lock = None,
    force: Force = False,
) -> None:
    """Write a machine as one URDF with loops, as MJCF, or as machine file with sub-chains."""
    from crane.formats import write_machine, write_mjcf, write_urdf_plus
    from crane.runs import check_folder, check_free

    kind = to or _SUFFIXES.get(out.suffix.lower(), "machine")
    if kind not in _FORMATS:
        raise InputError(f"--to is '{kind}', {known(_FORMATS, kind)}")
    if kind == "machine" and out.suffix.lower() in {*_SUFFIXES, ".yaml", ".yml"}:
        raise InputError(f"{out}: a machine file comes with its URDFs, give the name of a folder")
    if kind == "machine":
        check_folder(out, force)
    else:
        check_free(out, force)
    loaded = load(machine, lock, change)
    if kind == "machine":
        written = write_machine(loaded, out)
    else:
        written = out
        (write_urdf_plus if kind == "urdf+" else write_mjcf)(loaded, out)
    print(f"written to {written}")
