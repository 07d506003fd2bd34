"""The command on how hard a machine digs: breakout."""

from typing import Annotated

import typer

from crane.cli.shared import (
    BY_COMMAND,
    Active,
    Argument,
    Change,
    Floating,
    Force,
    Free,
    Lock,
    MachineName,
    Out,
    Packages,
    app,
    load,
    status,
)
from crane.common.errors import InputError


@app.command()
def breakout(
    machine: MachineName,
    direction: Annotated[
        str | None,
        typer.Option(
            metavar="WAY",
            help="Draw the largest force over the reach instead: where the tool pushes up, down, "
            "in, out, tangent or normal to its path (or =-tangent, =-normal), or X,Y,Z.",
        ),
    ] = None,
    frame: Annotated[
        str | None, typer.Option(metavar="LINK", help="The lip; the tip if not given.")
    ] = None,
    bucket: Annotated[
        str | None, typer.Option(metavar="JOINT", help="The joint whose drive curls the bucket.")
    ] = None,
    arm: Annotated[
        str | None, typer.Option(metavar="JOINT", help="The joint whose drive moves the arm.")
    ] = None,
    weights: Annotated[
        bool, typer.Option("--weights", help="With the machine's weight, and tipping.")
    ] = False,
    step: Annotated[
        float | None, typer.Option(metavar="M", help="Between places of the reach, in m.")
    ] = None,
    out: Out = BY_COMMAND,
    change: Change = None,
    lock: Lock = None,
    active: Active = None,
    free: Free = None,
    floating: Floating = False,
    packages: Packages = None,
    argument: Argument = None,
    force: Force = False,
) -> None:
    """Compute break-out forces of bucket and arm (ISO 6015), or any force of the tool."""
    from crane.cli.runs import check_folder, write_breakout, write_tool_force
    from crane.ratings import breakout as dig
    from crane.ratings import tool_force

    check_folder(out, force)
    if direction is None and step is not None:
        raise InputError("--step is for the reach, add --direction")
    if direction is not None and arm is not None:
        raise InputError("--arm is for break-out forces, leave it out with --direction")
    loaded = load(machine, lock, change, active, free, floating, packages, argument)
    if direction is None:
        with status("digging"):
            found = dig(loaded, frame, bucket=bucket, arm=arm, weights=weights)
        print(f"{write_breakout(out, found, force)}\nwritten to {out}")
        return
    with status("digging"):
        field = tool_force(
            loaded, _way(direction), frame, joint=bucket, weights=weights, step=step
        )
    with status("drawing"):
        text = write_tool_force(out, field, force)
    print(f"{text}\nwritten to {out}")


def _way(text: str) -> str | list[float]:
    if "," not in text:
        return text
    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise InputError(f"--direction {text} is no X,Y,Z, give three numbers") from None
