"""Commands that describe machines: new, list, info, check, add."""

import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated

import typer

import crane
from crane.cli.command import app, command, number_option
from crane.cli.options import (
    AssemblyOptions,
    MachineName,
    OutputFile,
    PackageOptions,
)
from crane.common.atomic_output import portable_file_name, replace_file
from crane.common.errors import InputError, check_name
from crane.common.one_line_repr import format_count
from crane.common.package_search import (
    NEAREST_ASSEMBLY,
    check_package_folders,
    use_load_options,
)


@command()
def new(
    output: OutputFile,
    template: Annotated[
        str | None,
        typer.Argument(
            metavar="[TEMPLATE]", help="Kind of machine, see --list; a terminal is asked for it."
        ),
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(
            metavar="SIZE", help="Class of the machine, e.g. 20t; a terminal is asked for it."
        ),
    ] = None,
    list_templates: Annotated[
        bool, typer.Option("--list", help="List the templates and their sizes.")
    ] = False,
) -> None:
    """Write a machine file from a template.

    The file is that of a typical machine of a class, with hydraulics and a task, to be changed
    into yours. It is named TEMPLATE.yaml by default.
    """
    from crane.description.machine_lookup import machine_summary

    templates = crane.description.machine_templates()
    if list_templates:
        for name, sizes in templates.items():
            for each, path in sizes.items():
                print(f"  {name:15} {each:5} {machine_summary(path)}")
        return
    name = template or _ask("template", templates)
    check_name(name, templates, f"template '{name}' is unknown")
    sizes = templates[name]
    size = size or (next(iter(sizes)) if len(sizes) == 1 else _ask("size", sizes, "--size "))
    check_name(size, sizes, f"template '{name}' has no size '{size}'")
    path = output.path(Path(f"{name}.yaml"))
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise InputError(f"{path}: a machine file ends in .yaml, name it so")
    title = f"name: '{portable_file_name(path.stem)}'"
    text = re.sub(r"(?m)^name: .*$", title, sizes[size].read_text("utf-8"), count=1)
    with replace_file(path) as part:
        part.write_text(text, "utf-8")
    print(f"written to {path}, its numbers are those of {name} {size}")
    print(crane.check(path))


def _ask(what: str, known: Iterable[str], option: str = "") -> str:
    """Return what the user types, of known names.

    Raises:
        InputError: There is no terminal.
    """
    if sys.stdin is None or not sys.stdin.isatty():
        raise InputError(f"no {what}, give one: {option}{', '.join(known)}")
    return str(typer.prompt(f"{what} ({', '.join(known)})"))


@command("list")
def list_machines(
    robots: Annotated[
        bool, typer.Option("--robots", help="List the robots of example-robot-data instead.")
    ] = False,
) -> None:
    """List the bundled machines."""
    from crane.description.machine_lookup import machine_summary

    others = crane.description.example_robots()
    if robots:
        if not others:
            raise InputError("there are no robots here, install example-robot-data")
        print("Robots of example-robot-data, open chains; some are refused by the strict reading:")
        print("\n".join(f"  {name}" for name in others))
        return
    machines = crane.description.bundled_machines()
    width = max(map(len, machines))
    print("Bundled machines; crane info NAME says more of one:")
    for name, path in machines.items():
        print(f"  {name:{width}}  {machine_summary(path)}")
    if others:
        number = format_count(len(others), "robot")
        print(f"{number} of example-robot-data can be named likewise: crane list --robots")


@command()
def info(
    machine: MachineName,
    assembly: AssemblyOptions,
    pattern: Annotated[
        str | None,
        typer.Argument(
            metavar="[PATTERN]",
            help="List joints, frames, columns and parameters whose names contain this text, or "
            "match it if it contains * or ?.",
        ),
    ] = None,
    parameters: Annotated[
        bool,
        typer.Option(
            "--parameters",
            "--names",
            help="List the parameters that --set, --vary and --fit take, with their values.",
        ),
    ] = False,
) -> None:
    """Show joints, loops, forces and parameters of a machine."""
    if parameters or pattern is not None:
        _print_names(machine, assembly, pattern)
        return
    for line in _describe(crane.load(machine, **assembly.assembly())):
        print(line)


def _print_names(machine: str, assembly: AssemblyOptions, pattern: str | None) -> None:
    from crane.description.machine_parameters import names_by_kind, search_names

    files = assembly.package_values()
    with use_load_options(check_package_folders(files["packages"]), files["arguments"]):
        spec = crane.formats.read_machine_spec(machine)
    names = {
        "parameter": {name: f"{x:.6g}" for name, x in crane.description.parameters(spec).items()}
    }
    if pattern is not None:
        names = search_names(names_by_kind(spec), pattern)
    width = max((len(name) for values in names.values() for name in values), default=0)
    for kind, values in names.items():
        before = f"{kind:<11}" * (pattern is not None)
        for name, text in values.items():
            print(f"{before}{name:{width}}  {text}".rstrip())


def _describe(machine: "crane.Machine") -> Iterator[str]:
    """Facts of a machine, each followed by the rows of its table without empty cells."""
    from crane.view.machine_facts import machine_facts

    facts = list(machine_facts(machine))
    width = max(10, 1 + max((len(row[0]) for fact in facts for row in fact.rows), default=0))
    yield machine.name
    for fact in facts:
        yield f"  {fact.name:<12}{fact.text}"
        for row in fact.rows:
            cells = zip(fact.heading[1:], row[1:], strict=True)
            words = ", ".join(f"{head} {cell}".strip() for head, cell in cells if cell)
            yield f"    {row[0]:<{width}}{words}"


@command()
def check(
    machine: MachineName,
    assembly: AssemblyOptions,
    write_home: Annotated[
        bool,
        typer.Option(
            "--write-home", help="Write the closed home configuration into the machine file."
        ),
    ] = False,
) -> None:
    """Check the description of a machine for errors.

    The exit status is 0 without errors and warnings, 1 with warnings only, 2 with errors.
    """
    values = assembly.assembly()
    driven = values["active"], values["free"]
    packages, arguments = values["packages"], values["arguments"]
    options = {**arguments, NEAREST_ASSEMBLY: True} if write_home else arguments
    report = crane.check(machine, *driven, assembly.floating, packages, options)
    if write_home and not report.errors:
        print(f"home written to {crane.formats.write_home(machine, *driven, packages, arguments)}")
        report = crane.check(machine, *driven, assembly.floating, packages, arguments)
    print(report)
    raise typer.Exit(report.status)


add = typer.Typer(no_args_is_help=True, help="Add a cylinder or loop joints to a description.")
app.add_typer(add, name="add")


@command(registry=add)
def cylinder(
    machine: MachineName,
    output: OutputFile,
    between: Annotated[
        tuple[str, str],
        typer.Option(
            metavar="FRAME FRAME",
            help="Attachment points of barrel and rod: LINK, or LINK:x,y,z in m.",
        ),
    ],
    bore: Annotated[float, number_option("m", "Diameter of the piston in m.")],
    rod: Annotated[float, number_option("m", "Diameter of the rod in m.")],
    stroke: Annotated[float, number_option("m", "Stroke in m.")],
    name: Annotated[
        str, typer.Option(help="Name of the cylinder and of its stroke.")
    ] = "cylinder",
    dead_length: Annotated[
        float | None,
        number_option(
            "m", "Retracted length between the pins in m; by default the stroke plus four bores."
        ),
    ] = None,
) -> None:
    """Add a hydraulic steel cylinder between two points.

    The cylinder becomes the actuator, instead of the joint that it rotates.
    """
    print(
        crane.formats.add_cylinder(
            machine, between, bore, rod, stroke,
            name=name, dead_length=dead_length, out=output.out, force=output.force,
        )
    )  # fmt: skip


@command(registry=add)
def loops(machine: MachineName, packages: PackageOptions, output: OutputFile) -> None:
    """Add the loop joints that `crane check` proposes."""
    print(
        crane.formats.add_loops(
            machine, out=output.out, force=output.force, **packages.package_values()
        )
    )
