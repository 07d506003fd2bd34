"""The command on where a hydraulic run's power goes: power."""

from pathlib import Path
from typing import Annotated

import typer

from crane.cli.shared import (
    Active,
    Argument,
    Change,
    Columns,
    Floating,
    Force,
    Free,
    From,
    Lock,
    MachineName,
    Out,
    Packages,
    Until,
    app,
    load,
    span_of,
    status,
)


@app.command()
def power(
    machine: MachineName,
    recording: Annotated[
        Path,
        typer.Argument(
            metavar="RECORDING",
            help="A run's folder, or a recording (CSV or npz) with pressures and spools.",
        ),
    ],
    out: Out,
    change: Change = None,
    lock: Lock = None,
    active: Active = None,
    free: Free = None,
    floating: Floating = False,
    packages: Packages = None,
    argument: Argument = None,
    columns: Columns = None,
    since: From = None,
    until: Until = None,
    force: Force = False,
) -> None:
    """Tell where the power of a run's pumps goes: losses by part, loads, what is stored, fuel."""
    from crane.cli.runs import check_folder, read_run, write_power
    from crane.control.valves import circuit_of
    from crane.studies.power import power_account

    check_folder(out, force)
    span = span_of(since, until)
    loaded = load(machine, lock, change, active, free, floating, packages, argument)
    circuit_of(loaded)  # before anything is read
    run = read_run(recording, loaded, columns, span)
    with status("adding up"):
        account = power_account(loaded, run)
    print(write_power(out, account, force), end="")
    print(f"\nwritten to {out}")
