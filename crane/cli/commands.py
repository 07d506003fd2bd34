"""Commands on machines and runs: list, info, simulate, view, plot, demo."""

from collections.abc import Iterator
from math import isinf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crane.cli.shared import (
    Active,
    Argument,
    Columns,
    Floating,
    Force,
    Free,
    From,
    Lock,
    MachineName,
    NoOpen,
    Out,
    OutFile,
    Packages,
    Until,
    app,
    arguments,
    load,
    progress_bar,
    span_of,
)
from crane.common.errors import InputError

if TYPE_CHECKING:
    from crane.machine import Machine

RunMachine = Annotated[
    str | None, typer.Option(metavar="MACHINE", help="The machine of a run, if not as recorded.")
]


@app.command("list")
def list_machines() -> None:
    """List the machines that can be named."""
    from crane.description import bundled, examples

    print("Bundled machines:")
    for name in bundled():
        print(f"  {name}")
    if examples():
        print(
            "Robots of example-robot-data (open chains; some are refused by the strict reading):"
        )
        print(f"  {', '.join(examples())}")


@app.command()
def info(
    machine: MachineName,
    parameters: Annotated[
        bool,
        typer.Option(
            "--parameters",
            "--names",
            help="List the names that --set, --vary and --fit take, and their values.",
        ),
    ] = False,
    active: Active = None,
    free: Free = None,
    floating: Floating = False,
    packages: Packages = None,
    argument: Argument = None,
) -> None:
    """Show what a machine consists of."""
    if parameters:
        from crane.common.packages import giving, package_folders
        from crane.description import parameters as parameters_of
        from crane.formats import read

        with giving(package_folders(packages or ()), arguments(argument)):
            values = parameters_of(read(machine))
        width = max(map(len, values), default=0)
        for name, value in values.items():
            print(f"{name:{width}}  {value:.6g}")
        return
    loaded = load(machine, None, None, active, free, floating, packages, argument)
    for line in _describe(loaded):
        print(line)


@app.command()
def view(
    what: Annotated[
        str, typer.Argument(metavar="WHAT", help="A machine, a run's folder, or a recording.")
    ],
    machine: RunMachine = None,
    over: Annotated[
        Path | None,
        typer.Option(metavar="RUN", help="A second run of the machine, laid over the first."),
    ] = None,
    lock: Lock = None,
    columns: Columns = None,
    since: From = None,
    until: Until = None,
    out: OutFile = None,
    no_open: NoOpen = False,
    force: Force = False,
) -> None:
    """Write a page that shows a machine, or a run with its forces and numbers, and open it."""
    from crane.cli.runs import PAGE, check_free, machine_of, read_run
    from crane.common.output import file_name
    from crane.view.page.build import open_in_browser, report

    recording = other = None
    if is_run(what):
        path = Path(what)
        given, span = _machine_of_run(machine, lock), span_of(since, until)
        recording = read_run(path, given, columns, span)
        loaded = given or machine_of(what, recording.machine)
        if over is not None:
            other = read_run(over, loaded, columns, span)
        page = out or (path if path.is_dir() else path.parent) / PAGE
    else:
        of_runs = {
            "--over": over, "--machine": machine, "--lock": lock, "--columns": columns,
            "--from": since, "--until": until,
        }  # fmt: skip
        for option, value in of_runs.items():
            if value is not None:
                raise InputError(f"{option} is for runs, and '{what}' is none, leave it out")
        loaded = load(what)
        page = out or Path(file_name(loaded.name) + ".html")
    check_free(page, force)
    report(loaded, recording, page, other)
    print(f"written to {page}")
    if not no_open and not open_in_browser(page):
        print("no browser found here, open the page yourself")


@app.command()
def plot(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run's folder or a recording.")],
    machine: RunMachine = None,
    lock: Lock = None,
    columns: Columns = None,
    since: From = None,
    until: Until = None,
    out: OutFile = None,
    force: Force = False,
) -> None:
    """Plot displacements, velocities, forces and tip path of a run (png, svg or pdf)."""
    from crane.cli.runs import FIGURE, check_free, read_run
    from crane.view.plots.recording import plot_recording

    recording = read_run(run, _machine_of_run(machine, lock), columns, span_of(since, until))
    figure = out or (run if run.is_dir() else run.parent) / FIGURE
    check_free(figure, force)
    plot_recording(recording, figure)
    print(f"written to {figure}")


@app.command()
def demo(out: Out = Path("demo-output"), force: Force = False) -> None:
    """Simulate the three published trajectories of the reduced-scale forwarder."""
    from crane.cli.demo import run_demo
    from crane.cli.runs import FIGURE, PAGE, check_folder

    check_folder(out, force)
    with progress_bar("simulating") as progress:
        text = run_demo(out, progress, force)
    print(text)
    print(f"figures:    {out}/*/{FIGURE}\nanimations: {out}/*/{PAGE} (open them in a browser)")


def _machine_of_run(name: str | None, lock: list[str] | None) -> "Machine | None":
    if name is None and lock:
        raise InputError("--lock is for a machine, name it by --machine")
    return None if name is None else load(name, lock)


def is_run(what: str) -> bool:
    """Whether a run is meant and no machine."""
    from crane.description.sources import FOLDERS

    if any((Path(what) / name).is_file() for name in FOLDERS):  # a machine in a folder
        return False
    return Path(what).is_dir() or Path(what).suffix.lower() in (".csv", ".npz")


def _describe(machine: "Machine") -> Iterator[str]:
    from crane.common.units import quantity
    from crane.description.sensors import Sensor
    from crane.dynamics import Dynamics
    from crane.dynamics.lengths import Lengths

    closure, ideal = machine.closure, Sensor().numbers()
    structure = closure.structure
    mass = sum(inertia.mass for inertia in list(machine.model.inertias)[1:])
    yield f"{machine.name}"
    if machine.source:
        yield f"  source      {machine.source}"
    yield f"  file        {machine.path}"
    yield f"  chains      {', '.join(chain.name for chain in machine.chains)}"
    yield (
        f"  joints      {len(machine.joints)}, of which {len(machine.driven_joints)} active"
        f"{f' and {len(machine.free)} free' if machine.free else ''}; "
        f"moving mass {quantity(mass, 'kg', 4)}"
    )
    width = max(10, 1 + max(map(len, (*machine.joints, *closure.equations.names))))
    for i, joint in enumerate(machine.active):
        home = machine.home[closure.active[i]]
        free = ", free" if joint in machine.free else ""
        unit = machine.unit(joint)
        limits = _limits(machine.lower[i], machine.upper[i], unit)
        yield f"    {joint:<{width}}{limits}, home {home:.5g} {unit}{free}"
    for i in closure.passive:
        joint = machine.joints[i]
        yield f"    {joint:<{width}}passive, home {machine.home[i]:.5g} {machine.unit(joint)}"
    loops = closure.equations.loops
    yield (
        f"  loops       {len(loops)}: {len(structure.rows)} independent equations, "
        f"{len(structure.redundant)} redundant"
    )
    for loop in loops:
        yield f"    {loop.name:<{width}}{loop.type}, {loop.predecessor} to {loop.successor}"
    for coupling in closure.equations.couplings:
        terms = " + ".join(f"{factor:g} {joint}" for joint, factor in coupling.factors.items())
        yield f"    {coupling.name:<{width}}coupling, {terms} = {coupling.offset:g}"
    if structure.blocks:
        order = [
            "+".join(machine.joints[closure.passive[i]] for i in columns)
            for _, columns in structure.blocks
        ]
        yield f"  solved as   {', then '.join(order)}"
    elements = [item for item in machine.elements if item.between is not None]
    lengths, _ = Lengths(machine, [item.between for item in elements if item.between]).at(
        machine.home
    )
    for item, length in zip(elements, lengths, strict=True):
        one, two = item.between or ("", "")
        yield f"  between     {one} and {two}: {item.kind}, ends {length:.5g} m apart at home"
    for motor in machine.motors:
        terms = " + ".join(f"{factor:g} {joint}" for joint, factor in motor.factors.items())
        yield f"  drive       {motor.name}, along {terms}"
    if loops:
        drive = float(closure.condition(machine.home))
        better = [c for c in closure.proposals if drive > 10 and c.condition < drive / 2]
        others = f"; better with {better[0]}" if better else ""
        yield f"  driven      condition {drive:.3g} at home{others}"
    if mass:
        backend = Dynamics(machine).backend_of("forward")
        reason = "" if backend == "compiled" else ", too large for machine code"
        yield f"  computed    {backend}{reason}"
    yield f"  tip         {machine.tip or 'none'}"
    if machine.hydraulics is not None:
        supply = machine.hydraulics.supply
        flow = f", {6e4 * supply.flow:.4g} l/min at most" if supply.flow else ""
        yield f"  hydraulics  {1e-5 * supply.pressure:.4g} bar{flow}"
        for joint, cylinder in machine.hydraulics.cylinders.items():
            valve = machine.hydraulics.valves[joint]
            kind = "sharing" if valve.sharing else "compensated" if valve.margin else "orifice"
            unit = "cm2" if machine.unit(joint) == "m" else "cm3/rad"
            size = 1e4 if unit == "cm2" else 1e6
            kind += " valve of two spools" if valve.spool_b else " valve"
            yield (
                f"    {joint:<{width}}{kind}, {size * cylinder.area_a:.4g} and "
                f"{size * cylinder.area_b:.4g} {unit}"
            )
    for name, sensor in machine.sensors.items():
        known = [f"{what} {x:g}" for what, x in sensor.numbers().items() if x != ideal[what]]
        where = [f"{sensor.column} [{sensor.unit}]" if sensor.unit else sensor.column]
        yield f"  sensor      {name}: {', '.join([x for x in where if x] + known) or 'ideal'}"
    for task in machine.tasks.values():
        most = "at most " * bool(task.phases)
        yield f"  task        {task.name}, {most}{task.duration:g} s: {task.description}"


def _limits(lower: float, upper: float, unit: str) -> str:
    """A range in words, which may have no end."""
    if isinf(lower) and isinf(upper):
        return "unlimited"
    if isinf(lower):
        return f"at most {upper:.5g} {unit}"
    return f"at least {lower:.5g} {unit}" if isinf(upper) else f"{lower:.5g} to {upper:.5g} {unit}"
