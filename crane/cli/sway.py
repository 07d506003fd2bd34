"""The command on what sways: sway."""

from typing import Annotated

import typer

from crane.cli.shared import Change, MachineName, app, by_joint, progress_bar
from crane.common.errors import InputError


@app.command()
def sway(
    machine: MachineName,
    task: Annotated[str, typer.Option(help="A task of the machine, from rest to rest.")],
    payload: Annotated[
        str, typer.Option(metavar="KG,...", help="Masses that hang from the tip.")
    ] = "0,100,200,300,400,500",
    damping: Annotated[
        float, typer.Option(help="Damping ratio that feedback of sway asks for; 0 for none.")
    ] = 0.2,
    change: Change = None,
) -> None:
    """Tell how much sway a task leaves through the valves, with and without each method."""
    from crane.studies import sway_study

    try:
        masses = [float(word) for word in payload.split(",")]
    except ValueError:
        raise InputError(f"--payload {payload}: give masses as 0,200,500") from None
    changes = by_joint("--set", change, "NAME=VALUE, as in payload.mass=200")
    with progress_bar("simulating") as progress:
        found = sway_study(machine, task, masses, damping, changes, progress)
    print(found.to_text())
