"""Commands that draw machines: sketch."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crane.cli.shared import (
    Active,
    Argument,
    Change,
    Floating,
    Force,
    Free,
    Lock,
    MachineName,
    OutFile,
    Packages,
    app,
    by_joint,
    load,
)
from crane.common.errors import InputError, suggest_names

if TYPE_CHECKING:
    from crane.common.samples import Array
    from crane.machine import Machine


@app.command()
def sketch(
    machine: MachineName,
    at: Annotated[
        str | None,
        typer.Option(
            metavar="JOINT=VALUE,...",
            help="Active coordinates in m or rad; home for those that are not named.",
        ),
    ] = None,
    plane: Annotated[
        str | None,
        typer.Option(help="xy, xz or yz of the world; the machine's own plane if not given."),
    ] = None,
    com: Annotated[bool, typer.Option("--com", help="Mark centres of mass.")] = False,
    circuit: Annotated[
        bool, typer.Option("--circuit", help="Draw the hydraulic circuit instead.")
    ] = False,
    out: OutFile = None,
    change: Change = None,
    lock: Lock = None,
    active: Active = None,
    free: Free = None,
    floating: Floating = False,
    packages: Packages = None,
    argument: Argument = None,
    force: Force = False,
) -> None:
    """Draw the mechanism of a machine, or its hydraulic circuit (png, svg or pdf)."""
    from crane.cli.runs import check_free
    from crane.common.atomic_output import portable_file_name
    from crane.formats.assembly_warnings import alternative_configurations
    from crane.view.sketch.circuit import sketch_circuit
    from crane.view.sketch.sketch_figure import sketch as draw

    if circuit:
        for option, given in (("--at", at), ("--plane", plane), ("--com", com)):
            if given:
                raise InputError(f"{option} is for the mechanism, leave it out with --circuit")
    loaded = load(machine, lock, change, active, free, floating, packages, argument)
    figure = out or Path(
        portable_file_name(loaded.name) + ("_circuit.png" if circuit else "_sketch.png")
    )
    check_free(figure, force)
    if circuit:
        sketch_circuit(loaded, figure)
        print(f"written to {figure}")
        return
    others = [] if at else alternative_configurations(loaded)
    draw(loaded, figure, posture(loaded, at), plane, com, others)
    if others:
        many = f"{len(others)} other assemblies" if len(others) > 1 else "the other assembly"
        print(f"dashed: {many} that the file does not rule out; crane check tells how to choose")
    print(f"written to {figure}")


def posture(machine: "Machine", at: str | None) -> "Array":
    """(n,) home with the active coordinates of --at in place of its own."""
    q_a = machine.home[machine.closure.active].copy()
    named = by_joint(
        "--at", at.split(",") if at else None, "JOINT=VALUE,..., as in q1=0.1,X1=0.02"
    )
    for joint, value in named.items():
        if joint not in machine.active:
            raise InputError(
                f"--at: '{joint}' is no active joint, {suggest_names(machine.active, joint)}"
            )
        q_a[machine.active.index(joint)] = value
    return q_a
