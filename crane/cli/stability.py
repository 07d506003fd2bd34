"""The command on whether a machine tips: stability."""

from typing import Annotated

import typer

from crane.cli.pictures import posture
from crane.cli.shared import (
    Active,
    Argument,
    Change,
    Free,
    Lock,
    MachineName,
    Packages,
    app,
    load,
    status,
)


@app.command()
def stability(
    machine: MachineName,
    at: Annotated[
        str | None,
        typer.Option(metavar="JOINT=VALUE,...", help="Where it stands, if not at home."),
    ] = None,
    frame: Annotated[
        str | None,
        typer.Option(metavar="LINK", help="What a load hangs from; the tip if not given."),
    ] = None,
    task: Annotated[
        str | None, typer.Option(help="A task, during which its payload may tip it.")
    ] = None,
    change: Change = None,
    lock: Lock = None,
    active: Active = None,
    free: Free = None,
    packages: Packages = None,
    argument: Argument = None,
) -> None:
    """Tell how far a machine is from tipping, and under which load it does."""
    from crane.dynamics.tipping_stability import TippingStability
    from crane.studies.task_tipping_load import tipping_load

    loaded = load(machine, lock, change, active, free, False, packages, argument)
    stands, q_a = TippingStability(loaded), posture(loaded, at)
    found = None
    if task is not None:
        with status("tipping"):
            found = tipping_load(loaded, task)
    (moments,), (shares,) = stands.static_margins(q_a)
    hangs = None
    if loaded.tip is not None or frame is not None:
        (mass,), (about,) = stands.tipping_load(q_a, frame)
        hangs = mass, about
    print("| tipping line | held by | of the weight |\n| --- | ---: | ---: |")
    for line, moment, share in zip(stands.line_names, moments, shares, strict=True):
        print(f"| {' to '.join(line)} | {moment:.4g} N m | {100 * share:.1f} % |")
    if hangs is not None:
        (mass, about), name = hangs, frame or loaded.tip
        print(
            f"\n{mass:.5g} kg at '{name}' tip it about {about}"
            if about
            else f"\nno load at '{name}' tips it"
        )
    if found is not None:
        print(
            f"in '{task}' a payload of {found.mass:.5g} kg tips it, at t = {found.time:.4g} s; "
            f"at rest {found.static_mass:.5g} kg would"
        )
