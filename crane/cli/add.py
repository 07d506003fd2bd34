"""Commands that complete a machine: a cylinder between two points, loops left open."""

from typing import Annotated

import typer

from crane.cli.shared import Argument, Force, MachineName, OutFile, Packages, app, arguments

add = typer.Typer(no_args_is_help=True, help="Put a part into a machine, and write it.")
app.add_typer(add, name="add")


@add.command()
def cylinder(
    machine: MachineName,
    between: Annotated[
        tuple[str, str],
        typer.Option(
            metavar="FRAME FRAME", help="Eyes of barrel and rod: LINK, or LINK:x,y,z in metres."
        ),
    ],
    bore: Annotated[float, typer.Option(help="Diameter of the piston in m.")],
    rod: Annotated[float, typer.Option(help="Diameter of the rod in m.")],
    stroke: Annotated[float, typer.Option(help="In m.")],
    name: Annotated[str, typer.Option(help="Of the cylinder and its stroke.")] = "cylinder",
    dead_length: Annotated[
        float | None,
        typer.Option(help="Pin to pin with the rod in, in m; stroke and four bores otherwise."),
    ] = None,
    out: OutFile = None,
    force: Force = False,
) -> None:
    """Put barrel and rod of steel between two points, driven in place of the joint they turn."""
    from crane.formats.additions import add_cylinder

    print(
        add_cylinder(
            machine, between, bore, rod, stroke,
            name=name, dead_length=dead_length, out=out, force=force,
        )
    )  # fmt: skip


@add.command()
def loops(
    machine: MachineName,
    out: OutFile = None,
    packages: Packages = None,
    argument: Argument = None,
    force: Force = False,
) -> None:
    """Close the loops that `crane check` proposes, and write the closed machine."""
    from crane.formats.additions import add_loops

    values = arguments(argument)
    print(add_loops(machine, out=out, force=force, packages=packages or (), arguments=values))
