"""Commands that rate machines: workspace, ranges, forces, capacity, stability, rest, power."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import radians
from pathlib import Path
from typing import Annotated, Any

import typer

import crane
from crane.cli.command import OptionBlock, command, number_option, refuse_options
from crane.cli.options import (
    Bucket,
    Configuration,
    Frame,
    MachineName,
    MachineOptions,
    OptionalParameters,
    OutputFolder,
    RecordingFile,
    RecordingOptions,
    Rule,
    Seed,
    Task,
)
from crane.cli.parsing import joint_units, parse_configuration, parse_numbers, parse_slew_angles
from crane.cli.show import active_coordinates
from crane.cli.terminal import status
from crane.common.errors import CraneWarning, InputError
from crane.common.result import Result
from crane.common.units import format_quantity

Posture = Annotated[
    str | None,
    typer.Option(
        "--at",
        metavar="NAME=VALUE,...",
        help="Posture: active coordinates in m or rad, angle=VALUE of the frame's x axis above "
        "the horizontal, its height=VALUE; e.g. X_tilt=0.4, or angle=-45deg.",
    ),
]
ChartStep = Annotated[float | None, number_option("m", "Grid spacing in m.", "--step")]


@command()
def workspace(
    machine: MachineName,
    options: MachineOptions,
    output: OutputFolder,
    samples: Annotated[int, typer.Option(help="Approximate number of configurations.")] = 10_000,
    frame: Frame = None,
    seed: Seed = 0,
) -> None:
    """Compute the reachable workspace and its singular curves."""
    loaded = options.load(machine)
    with status("exploring"):
        result = crane.workspace(loaded, samples, frame, seed)
    output.write(result)


@command("working-range")
def working_range(
    machine: MachineName,
    options: MachineOptions,
    output: OutputFolder,
    frame: Frame = None,
    bucket: Bucket = None,
    level: Annotated[
        float, typer.Option(metavar="M", help="Length of the level bottom in m.")
    ] = 2.44,
) -> None:
    """Compute reach, digging depth and dump height (ISO 7135)."""
    loaded = options.load(machine)
    with status("measuring"):
        result = crane.working_range(loaded, frame, bucket=bucket, level=level)
    output.write(result)


@command()
def breakout(
    machine: MachineName,
    options: MachineOptions,
    output: OutputFolder,
    frame: Frame = None,
    bucket: Bucket = None,
    arm: Annotated[
        str | None, typer.Option(metavar="JOINT", help="The joint whose drive moves the arm.")
    ] = None,
    weights: Annotated[
        bool, typer.Option("--weights", help="Include the weight of the machine and its tipping.")
    ] = False,
    direction: Annotated[
        str | None,
        typer.Option(
            metavar="DIRECTION",
            help="Chart the maximum tool force in this direction instead: up, down, in, out, "
            "tangent or normal to the path of the tool (=-tangent, =-normal), or X,Y,Z.",
        ),
    ] = None,
    step: ChartStep = None,
    at: Posture = None,
) -> None:
    """Compute break-out forces (ISO 6015) or tool forces."""
    if at is not None:
        refuse_options({"--step": step}, "is for the reach, leave out --at")
    elif direction is None and step is not None:
        raise InputError("--step is for the reach, add --direction")
    if direction is not None and arm is not None and at is None:
        raise InputError("--arm is for break-out forces, leave it out with --direction")
    loaded = options.load(machine)
    vector: str | list[float] | None = direction
    if direction is not None and "," in direction:
        message = f"--direction {direction} is no X,Y,Z, give three numbers"
        vector = parse_numbers(direction.split(","), message, ("",))
    result: Result
    with status("computing forces"):
        if vector is None or at is not None:
            result = crane.ratings.breakout(
                loaded, frame, bucket=bucket, arm=arm, weights=weights,
                direction=vector or "tangent",
                at=None if at is None else parse_configuration("--at", at, joint_units(loaded)),
            )  # fmt: skip
        else:
            result = crane.ratings.tool_force(
                loaded, vector, frame, joint=bucket, weights=weights, step=step
            )
    output.write(result)


@dataclass(frozen=True, kw_only=True)
class RatingOptions(OptionBlock):
    """The conditions of rated loads."""

    panel = "Rating options"
    rule: Rule = "none"
    hydraulic: Annotated[
        float | None,
        number_option(
            "", "Rated fraction of the hydraulic lifting load; overrides that of --rule."
        ),
    ] = None
    tipping: Annotated[
        float | None,
        number_option("", "Rated fraction of the tipping load; overrides that of --rule."),
    ] = None
    raising: Annotated[
        list[str] | None,
        typer.Option(
            metavar="JOINT",
            help="Joint whose drive raises the load at pump pressure, while all other drives hold "
            "it behind closed valves; by default all, or the one that --rule selects. May be "
            "repeated.",
        ),
    ] = None
    slew: Annotated[
        str | None,
        typer.Option(
            metavar="DEG,...",
            help="Slew angles; by default that of home, and also a quarter turn from home if the "
            "machine can tip.",
        ),
    ] = None
    slope: Annotated[
        float, number_option("deg", "Slope of the ground in the most unfavourable direction.")
    ] = 0.0
    friction: Annotated[
        bool,
        typer.Option("--friction", help="Include the joint friction of the raising drives."),
    ] = False

    def arguments(self) -> dict[str, Any]:
        """Arguments of `crane.capacity` and `crane.ratings.torques` by name.

        Raises:
            InputError: The rule is unknown, or a number is out of range.
        """
        from crane.common.samples import as_number
        from crane.ratings.rating_rules import find_rule

        rule, words = find_rule(self.rule), []
        for what, share in (("hydraulic", self.hydraulic), ("tipping", self.tipping)):
            if share is not None:
                share = as_number(share, f"--{what}", "", greater_than=0.0, max_magnitude=1.0)
                rule = replace(rule, **{what: share})  # type: ignore[arg-type]
                words.append(f"{100 * share:g} % of the {what} load")
        if words:
            rule = replace(rule, description=f"{rule.description}; here {' and '.join(words)}")
        slope = radians(as_number(self.slope, "--slope", "degrees", max_magnitude=45.0))
        slews = None if self.slew is None else [radians(x) for x in parse_slew_angles(self.slew)]
        return {
            "rule": rule, "raising": self.raising or None, "slope": slope, "slews": slews,
            "friction": self.friction,
        }  # fmt: skip


@command()
def capacity(
    machine: MachineName,
    rating: RatingOptions,
    options: MachineOptions,
    output: OutputFolder,
    frame: Frame = None,
    step: ChartStep = None,
    torque: Annotated[
        float | None,
        number_option(
            "m", "Also compute lifting torques at this radius in m, and the slewing torque."
        ),
    ] = None,
    by: OptionalParameters = None,
    over: Annotated[
        str | None,
        typer.Option(
            metavar="JOINT,...",
            help="Chart the loads over one stroke (lift curve) or two instead of the reach; the "
            "others stay at --at. By default where one stroke is left.",
        ),
    ] = None,
    at: Posture = None,
    zones: Annotated[
        str | None,
        typer.Option(metavar="KG,...", help="Loads of zones over two strokes; default: round."),
    ] = None,
) -> None:
    """Compute rated loads over the reach (load chart)."""
    from crane.dynamics.tipping_stability import has_supports
    from crane.ratings.strokes import Strokes

    conditions = rating.arguments()
    loaded, tipping_share = options.load(machine), conditions["rule"].tipping
    if tipping_share < 1 and not has_supports(loaded):
        warnings.warn(
            f"'{loaded.name}' has no supports, so that nothing tips and the rule's "
            f"{100 * tipping_share:.3g} % of the tipping load are left out: name what it stands "
            "on under 'supports' of the machine file",
            CraneWarning,
            stacklevel=2,
        )
    if over is None and at is None and len(Strokes(loaded, frame).moving) != 1:
        refuse_options({"--zones": zones}, "are over two strokes, name them with --over")
    else:
        refuse_options(
            {"--step": step, "--torque": torque, "--by": by}, "is for the reach, not over strokes"
        )
        loads = None if zones is None else parse_numbers(
            zones.split(","), f"--zones {zones} are no loads, give numbers in kg", ("kg",)
        )  # fmt: skip
        with status("rating"):
            lift = crane.ratings.lift_chart(
                loaded, None if over is None else over.split(","), frame,
                at=parse_configuration("--at", at, joint_units(loaded)), zones=loads, **conditions,
            )  # fmt: skip
        output.write(lift)
        return
    with status("rating"):
        chart, lifting = crane.capacity(loaded, frame, step=step, **conditions), None
        if torque is not None:
            lifting = crane.ratings.torques(loaded, frame, radius=torque, **conditions)
    output.write(chart, torques=lifting, parameters=by or ())


@command()
def stability(
    machine: MachineName,
    options: MachineOptions,
    at: Configuration = None,
    frame: Frame = None,
    task: Task = None,
) -> None:
    """Compute stability margins and tipping loads.

    With --task, also the payload that tips the machine during the task.
    """
    loaded = options.load(machine)
    tipping, q_a = crane.dynamics.TippingStability(loaded), active_coordinates(loaded, at)
    found = None
    if task is not None:
        with status("simulating"):
            found = crane.studies.tipping_load(loaded, task)
    (moments,), (shares,) = tipping.static_margins(q_a)
    load_text = ""
    if loaded.tip is not None or frame is not None:
        ((mass,), (line,)), name = tipping.tipping_load(q_a, frame), frame or loaded.tip
        load_text = f"no load at '{name}' tips it"
        if line:
            load_text = f"{mass:.5g} kg at '{name}' tip it about {line}"
    print("| tipping line | held by | of the weight |\n| --- | ---: | ---: |")
    for names, moment, share in zip(tipping.line_names, moments, shares, strict=True):
        print(
            f"| {' to '.join(names)} | {format_quantity(moment, 'N m', 4)} | {100 * share:.1f} % |"
        )
    if load_text:
        print(f"\n{load_text}")
    if found is not None:
        print(
            f"in '{task}' a payload of {found.mass:.5g} kg tips it, at t = {found.time:.4g} s; "
            f"at rest {found.static_mass:.5g} kg would"
        )


@command()
def settle(
    machine: MachineName,
    options: MachineOptions,
    at: Configuration = None,
    write_home: Annotated[
        bool,
        typer.Option(
            "--write", help="Write the coordinates at rest into the machine file, as home."
        ),
    ] = False,
) -> None:
    """Compute the equilibrium in which a machine stands.

    Driven joints stay where they are; free joints, contacts, tyres, springs and
    pressures come to rest.
    """
    loaded = options.load(machine)
    if write_home:
        refuse_options(
            {"--set": options.changes, "--lock": options.lock},
            "does not go with --write, write it into the file first",
        )
    found = crane.simulation.settle(loaded, active_coordinates(loaded, at))
    print(found.to_markdown(), end="")
    if write_home:
        values = options.assembly()
        values.pop("floating")
        print(f"home written to {crane.formats.write_home(machine, **values, q=found.q)}")


@command()
def sections(
    machine: MachineName,
    recording: RecordingFile,
    options: MachineOptions,
    reading: RecordingOptions,
    output: OutputFolder,
    body: Annotated[
        str, typer.Option(metavar="NAME", help="A body of the drawing, with plates or tubes.")
    ],
) -> None:
    """Compute section forces and stresses of a body in a run.

    Axial force, shear force, bending moment and stress of a body of `drawing:`.
    """
    loaded = options.load(machine)
    run = reading.read(recording, loaded)
    with status("computing forces"):
        result = crane.dynamics.section_chart(loaded, run, body)
    output.write(result)


@command()
def power(
    machine: MachineName,
    recording: RecordingFile,
    options: MachineOptions,
    reading: RecordingOptions,
    output: OutputFolder,
    compare: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="RECORDING",
            help="A run for comparison, with the machine recorded in it; may be repeated.",
        ),
    ] = None,
    moved_mass: Annotated[
        float | None, number_option("kg", "Mass that each run moves, for the work per kg.")
    ] = None,
) -> None:
    """Compute the power balance of a hydraulic run.

    It distributes the power of the pumps over losses of components, loads and stored energy.
    """
    from crane.control.valve_commands import require_circuit
    from crane.recordings.measured_recordings import recorded_machine

    if not compare:
        refuse_options(
            {"--moved-mass": moved_mass}, "is for a comparison, name the other runs with --compare"
        )
    names = _run_names([recording, *(compare or ())])
    loaded = options.load(machine)
    require_circuit(loaded)  # before anything is read
    run = reading.read(recording, loaded)
    with status("adding up"):
        balances = {names[0]: crane.power_balance(loaded, run)}
    for name, path in zip(names[1:], compare or (), strict=True):
        other = reading.read(path)
        other_machine = recorded_machine(path, other.machine)
        require_circuit(other_machine)
        with status("adding up"):
            balances[name] = crane.power_balance(other_machine, other)
    output.write(
        crane.studies.PowerComparison(balances, moved_mass) if compare else balances[names[0]]
    )


def _run_names(paths: Sequence[Path]) -> list[str]:
    """Names of runs: of their folders or files, or whole paths if those are not unique.

    Raises:
        InputError: A run is given twice.
    """
    short = [path.stem if path.suffix else path.name for path in paths]
    names = short if len(set(short)) == len(paths) else [str(path) for path in paths]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"the run '{name}' is given twice, leave one out")
    return names
