"""The command on where a hydraulic run's power goes: power."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from crane.cli.shared import (
    BY_COMMAND,
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
from crane.common.errors import InputError


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
    out: Out = BY_COMMAND,
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
    beside: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="RECORDING",
            help="Another run to compare with, of the machine that it names: one table, one "
            "picture. May be repeated.",
        ),
    ] = None,
    moved: Annotated[
        float | None,
        typer.Option(metavar="KG", help="Mass that each run moves, for the work per kg."),
    ] = None,
    force: Force = False,
) -> None:
    """Tell where the power of a run's pumps goes: losses by part, loads, what is stored, fuel."""
    from crane.cli.runs import (
        check_folder,
        machine_of,
        read_run,
        write_power,
        write_power_comparison,
    )
    from crane.control.valve_commands import require_circuit
    from crane.studies.hydraulic_power_balance import power_balance
    from crane.studies.power_balance_result import PowerComparison

    check_folder(out, force)
    if moved is not None and not beside:
        raise InputError("--moved is for a comparison, name the other runs with --beside")
    names = _names([recording, *(beside or ())])
    span = span_of(since, until)
    loaded = load(machine, lock, change, active, free, floating, packages, argument)
    require_circuit(loaded)  # before anything is read
    run = read_run(recording, loaded, columns, span)
    with status("adding up"):
        account = power_balance(loaded, run)
    if not beside:
        print(write_power(out, account, force), end="")
        print(f"\nwritten to {out}")
        return
    accounts = {names[0]: account}
    for name, path in zip(names[1:], beside, strict=True):
        other = read_run(path, None, columns, span)
        machine_ = machine_of(path, other.machine)
        require_circuit(machine_)
        with status("adding up"):
            accounts[name] = power_balance(machine_, other)
    print(write_power_comparison(out, PowerComparison(accounts, moved), force), end="")
    print(f"\nwritten to {out}")


def _names(paths: Sequence[Path]) -> list[str]:
    """What runs are called: by their folders or files, whole paths where two are alike.

    Raises:
        InputError: A run is given twice.
    """
    short = [path.stem if path.suffix else path.name for path in paths]
    found = short if len(set(short)) == len(paths) else [str(path) for path in paths]
    for name in found:
        if found.count(name) > 1:
            raise InputError(f"the run '{name}' is given twice, leave one out")
    return found
