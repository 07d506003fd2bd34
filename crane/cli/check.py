"""The command that says what is wrong with a machine."""

from typing import Annotated

import typer

from crane.cli.shared import (
    Active,
    Argument,
    Floating,
    Free,
    MachineName,
    Packages,
    app,
    arguments,
    names,
)
from crane.common.package_search import NEAREST_ASSEMBLY


@app.command()
def check(
    file: MachineName,
    write_home: Annotated[
        bool,
        typer.Option(
            "--write-home", help="Write the closed home posture into the machine's file."
        ),
    ] = False,
    active: Active = None,
    free: Free = None,
    floating: Floating = False,
    packages: Packages = None,
    argument: Argument = None,
) -> None:
    """Say all that is wrong with a machine; exit status 0, 1 with warnings only, 2 with errors."""
    from crane.formats.check import check as check_machine

    driven, found = (names(active), names(free)), (packages or (), arguments(argument))
    anyway = {**found[1], NEAREST_ASSEMBLY: True} if write_home else found[1]
    report = check_machine(file, *driven, floating, found[0], anyway)
    if write_home and not report.errors:
        from crane.formats import write_home as write

        print(f"home written to {write(file, *driven, *found)}")
        report = check_machine(file, *driven, floating, *found)
    print(report)
    raise typer.Exit(report.status)
