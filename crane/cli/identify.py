"""Commands that estimate parameters: excite, identify, payload, circuit, calibrate."""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import crane
from crane.cli.command import OptionBlock, command, number_option, refuse_options
from crane.cli.options import (
    Bandwidth,
    CentreOfMass,
    ComparedColumns,
    Fit,
    Frame,
    MachineName,
    Method,
    OptionalFit,
    OptionalOutputFolder,
    OutputFolder,
    ParameterOptions,
    RecordingFile,
    RecordingFiles,
    RecordingOptions,
    Seed,
    ShiftedRecordingOptions,
    TrainingWindow,
    Trust,
    Validation,
)
from crane.cli.parsing import (
    joint_units,
    parameter_units,
    parse_fits,
    parse_names,
    parse_numbers,
    parse_priors,
    parse_terms,
    parse_trials,
    parse_values,
    parse_window,
)
from crane.cli.resumable_output import OptionalResumableFolder
from crane.cli.terminal import progress_bar, status
from crane.common.errors import CraneWarning, InputError, RecordingError, check_name
from crane.common.result import Result

if TYPE_CHECKING:
    from crane.identification.signals.signal_processing import Motion

_MIN_HELD_OUT_SAMPLES = 50
_CIRCUIT_MODELS = ("orifices", "valve", "friction")


@dataclass(frozen=True, kw_only=True)
class PeriodicMotionOptions(OptionBlock):
    """A periodic excitation motion."""

    panel = "Options of a motion"
    period: Annotated[float, number_option("s", "Period of the motion.")] = 10.0
    harmonics: Annotated[int, typer.Option(help="Harmonics of the motion.")] = 5
    periods: Annotated[int, typer.Option(help="Number of steady periods.")] = 3
    acceleration: Annotated[
        list[str] | None,
        typer.Option(
            metavar="JOINT=VALUE", help="Maximum acceleration of a joint; may be repeated."
        ),
    ] = None

    def arguments(self, machine: "crane.Machine") -> dict[str, Any]:
        """Arguments of `crane.excite` by name."""
        units_of = joint_units(machine, "/s2")
        return {
            "period": self.period, "harmonics": self.harmonics, "periods": self.periods,
            "acceleration": parse_values("--acceleration", self.acceleration, units_of),
        }  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class SignalOptions(OptionBlock):
    """Valve signals for calibration."""

    panel = "Options of valve signals (with --fit)"
    duration: Annotated[float, number_option("s", "Duration of the signals.")] = 20.0
    sensors: ComparedColumns = None
    rate: Annotated[
        float, typer.Option(help="Maximum rate of the signals, in spool strokes per second.")
    ] = 2.0
    margin: Annotated[float, number_option("", "Fraction of a stroke kept free at both ends.")] = (
        0.1
    )

    def arguments(self) -> dict[str, Any]:
        """Arguments of `crane.identification.excite_valves` by name."""
        return {
            "duration": self.duration, "sensors": parse_names(self.sensors), "rate": self.rate,
            "margin": self.margin,
        }  # fmt: skip


@command()
def excite(
    machine: MachineName,
    motion: PeriodicMotionOptions,
    signals: SignalOptions,
    options: ParameterOptions,
    output: OutputFolder,
    fit: OptionalFit = None,
    criterion: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Criterion: logdet or condition, of the information or regressor matrix.",
        ),
    ] = "logdet",
    seed: Seed = 0,
    noise: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="Standard deviation of the noise of a joint's force, by default 1 % of its "
            "limit, or with --fit of a column; may be repeated.",
        ),
    ] = None,
    step: Annotated[float, number_option("s", "Interval of the written samples.")] = 0.01,
) -> None:
    """Design an excitation: a motion or valve signals.

    A motion is optimized for the base parameters. With --fit, valve signals are optimized for the
    parameters that crane calibrate fits.
    """
    from crane.description.machine_lookup import command_line_arguments
    from crane.description.sensors import FORCE_SUFFIX, quantity_unit

    if fit is None:
        signals.refuse("only goes with --fit, name parameters to fit or leave it out")
    else:
        motion.refuse("does not go with --fit, leave it out")
    loaded = options.load(machine)
    fits = None if fit is None else parse_fits(fit, parameter_units(loaded))
    suffix = FORCE_SUFFIX if fit is None else ""
    deviations = parse_values(
        "--noise", noise, lambda name: (quantity_unit(loaded.tree, name + suffix) or "",)
    )
    common: dict[str, Any] = {
        "criterion": criterion,
        "noise": deviations,
        "step": step,
        "seed": seed,
    }
    result: Result
    with progress_bar("optimising") as progress:
        if fits is None:
            result = crane.excite(loaded, **motion.arguments(loaded), **common, progress=progress)
            note = f"see it with: crane view {output.out}/reference.csv"
        else:
            result = crane.identification.excite_valves(
                loaded, fits, **signals.arguments(), **common, progress=progress
            )
            same = command_line_arguments(
                machine, changes=loaded.parameter_changes, lock=loaded.locked_joints
            )
            inputs = f"--inputs {output.out}/signals.csv"
            note = f"play it with: crane simulate {same} {inputs} --out run"
    output.write(result, f"; {note}")


@dataclass(frozen=True, kw_only=True)
class ModelOptions(OptionBlock):
    """The model that is identified."""

    panel = "Model options"
    term: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[=NUMBERS]",
            help="A term of the model, e.g. q*.rotor_inertia, q1.presliding=1e-4, q5+q6.viscous; "
            "NAME=off removes it; may be repeated.",
        ),
    ] = None
    prior: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[NAME=]STD",
            help="Prior standard deviation: relative, e.g. 0.3, or by name, e.g. bodies=10%, "
            "q1.viscous=200+-50; bodies=auto: by cross-validation, with the bandwidth; or none.",
        ),
    ] = None
    feasible: Annotated[
        bool | None,
        typer.Option(help="Require physically feasible parameters; default if a prior is auto."),
    ] = None


@command()
def identify(
    machine: MachineName,
    recording: RecordingFiles,
    model: ModelOptions,
    options: ParameterOptions,
    reading: ShiftedRecordingOptions,
    output: OutputFolder,
    train: TrainingWindow = None,
    validation: Validation = None,
    method: Method = "wls",
    bandwidth: Bandwidth = None,
    min_speed: Annotated[
        list[str] | None,
        typer.Option(
            metavar="JOINT=VALUE",
            help="Velocity in m/s or rad/s below which samples of a joint are excluded; may be "
            "repeated.",
        ),
    ] = None,
    tried: Annotated[
        list[str] | None,
        typer.Option(
            "--try",
            metavar="NAME=VALUES",
            help="Candidate values, e.g. bandwidth=5,10 or, for a prior, bodies=1%,10%; the best "
            "is selected by cross-validation on the training data. May be repeated.",
        ),
    ] = None,
    trust: Trust = False,
) -> None:
    """Estimate inertial parameters and joint friction.

    The recordings contain coordinates and forces. The estimate is validated
    with the data that --train leaves out, or with another file (--validation).
    """
    from crane.common.samples import as_number
    from crane.identification.mechanics.cross_validation import format_trials, identify_options

    window, loaded = parse_window(train), options.load(machine)
    terms = parse_terms(model.term, turns := {x: loaded.unit(x) == "rad" for x in loaded.joints})
    priors, trials = parse_priors(model.prior, turns), parse_trials(tried, turns)
    min_speeds = parse_values("--min-speed", min_speed, joint_units(loaded, "/s"))
    if priors is None:
        loaded = loaded.replace(estimation=replace(loaded.estimation, prior={}))
    recordings = _read(recording, loaded, reading)
    inside = [x.between(*window) for x in recordings]
    outside = [
        x.at(part)
        for x in recordings
        for part in (x.time < window[0], x.time > window[1])
        if part.sum() >= _MIN_HELD_OUT_SAMPLES
    ]
    judges: list[crane.Recording | Motion] = [*_usable_motions(loaded, outside, trust)]
    if train is not None and not outside:
        warnings.warn(
            f"nothing of use lies outside of --train {train}, so nothing judges",
            CraneWarning,
            stacklevel=1,
        )
    names = _recording_names(recording, validation, train, bool(judges))
    judges += _read(validation or [], loaded, replace(reading, since=None, until=None))
    if bandwidth is not None:
        shortest = max(min(float(x.time[-1] - x.time[0]) for x in inside), 1e-3)
        as_number(bandwidth, "the bandwidth", "Hz", greater_than=5 / shortest)
    settings: dict[str, Any] = {
        "method": method, "prior": priors, "feasible": model.feasible, "terms": terms,
        "bandwidth": bandwidth, "min_speed": min_speeds, "trust": trust,
    }  # fmt: skip
    if trials:
        with progress_bar("cross-validating") as progress:
            tried_settings = crane.identification.cross_validate(
                loaded, inside, trials, progress, **settings
            )
        print(f"{format_trials(tried_settings)}\n")
        settings = identify_options(loaded, tried_settings[0].settings, settings)
    with progress_bar("identifying") as progress:
        result = crane.identify(loaded, inside, judges or None, progress=progress, **settings)
    if result.validation is None:
        names["validation"] = ""
    output.write(result, f"; see {output.out}/report.html", **names)


def _recording_names(
    recordings: Sequence[Path], validation: Sequence[Path] | None, train: str | None, rest: bool
) -> dict[str, str]:
    trained, held_out = (
        ", ".join(x.name for x in paths or ()) for paths in (recordings, validation)
    )
    if train is not None:
        trained = f"{trained}, {train} s"
        held_out = ", ".join(filter(None, ["the rest" if rest else "", held_out]))
    return {"recordings": trained, "validation": held_out}


def _read(
    paths: Sequence[Path],
    machine: "crane.Machine",
    reading: RecordingOptions,
    needs: Sequence[Sequence[str]] = (),
) -> "list[crane.Recording]":
    recordings = []
    for path in paths:
        with status(f"reading {path.name}"):
            recordings.append(reading.read(path, machine, needs))
    return recordings


def _usable_motions(
    machine: "crane.Machine", recordings: "list[crane.Recording]", trust: bool
) -> "Iterator[Motion]":
    """Motions of recordings; with a warning about each that cannot be used."""
    from crane.identification.mechanics.smoothed_motion import smoothed_motion

    for recording in recordings:
        try:
            yield smoothed_motion(machine, recording, trust=trust)
        except RecordingError as error:
            where = "{:.4g} to {:.4g} s".format(*recording.time[[0, -1]])
            warnings.warn(
                f"what lies outside of --train, {where}, judges nothing: {error}",
                CraneWarning,
                stacklevel=1,
            )


@command()
def payload(
    machine: MachineName,
    recording: RecordingFile,
    options: ParameterOptions,
    reading: ShiftedRecordingOptions,
    frame: Frame = None,
    centre: CentreOfMass = None,
    method: Method = "wls",
    trust: Trust = False,
) -> None:
    """Estimate mass and centre of mass of the payload."""
    message = f"--centre is '{centre}', write X,Y,Z in m, as 0.2,0,0"
    com = None if centre is None else parse_numbers(centre.split(","), message, ("m",))
    (carried,) = _read([recording], loaded := options.load(machine), reading)
    with progress_bar("estimating") as progress:
        estimate = crane.identification.identify_payload(
            loaded, carried, frame, method, trust=trust, progress=progress, com=com
        )
    print(estimate.to_text(), end="")


@command()
def circuit(
    machine: MachineName,
    recording: RecordingFiles,
    options: ParameterOptions,
    reading: RecordingOptions,
    output: OptionalOutputFolder,
    joint: Annotated[
        str, typer.Option(metavar="JOINT", help="The joint that the cylinder drives.")
    ],
    model: Annotated[
        str,
        typer.Option(
            metavar="MODEL",
            help="orifices (bulk modulus and c1 to c4), valve (neutral signal and dead band of a "
            "compensated valve), or friction.",
        ),
    ] = "orifices",
    method: Annotated[
        str | None,
        typer.Option(
            metavar="METHOD",
            help="Method for orifices: weak (the default; force equation, integrated over "
            "windows), chambers (pressure equations of both chambers, integrated likewise) or ls "
            "(force equation at every sample, by least squares).",
        ),
    ] = None,
    period: Annotated[
        float | None,
        number_option("s", "Period over which a periodic motion is averaged, for orifices."),
    ] = None,
    validation: Validation = None,
) -> None:
    """Estimate valve parameters or friction of one cylinder.

    The recordings contain valve signals and pressures. The model 'orifices' also
    estimates the bulk modulus.
    """
    from crane.identification.hydraulics.cylinder_equations import required_channels

    check_name(model, _CIRCUIT_MODELS, f"model '{model}' is unknown")
    if model != "orifices":
        refuse_options(
            {"--method": method, "--period": period, "--validation": validation or None},
            "is for --model orifices, leave it out",
        )
        if len(recording) > 1:
            raise InputError(f"--model {model} takes one recording, {len(recording)} are given")
    loaded = options.load(machine)
    check_name(joint, loaded.active, f"'{joint}' is not an active joint")
    needs_by_model: dict[str, list[tuple[str, ...]]] = {
        "orifices": required_channels(joint), "valve": [(f"voltage_{joint}",)], "friction": [],
    }  # fmt: skip
    needs = needs_by_model[model]
    runs = _read(recording, loaded, reading, needs)
    held_out = _read(validation or [], loaded, RecordingOptions(columns=reading.columns), needs)
    result: Result
    options_of_write: dict[str, Any] = {"unit": loaded.unit(joint)}
    with status("identifying"):
        if model == "valve":
            result = crane.identification.identify_valve(loaded, runs[0], joint)
        if model == "friction":
            result = crane.identification.identify_cylinder_friction(loaded, runs[0], joint)
        if model == "orifices":
            result = crane.identification.identify_orifices(
                loaded, runs, joint, method or "weak", period=period
            )
            options_of_write["validation"] = [result.predict(x, period) for x in held_out]
    output.write(result, **options_of_write)


@command()
def calibrate(
    machine: MachineName,
    recording: RecordingFiles,
    options: ParameterOptions,
    reading: RecordingOptions,
    output: OptionalResumableFolder,
    fit: Fit,
    train: TrainingWindow = None,
    validation: Validation = None,
    sensors: ComparedColumns = None,
) -> None:
    """Fit parameters by simulation of recorded valve signals."""
    from crane.recordings.measured_recordings import recording_file

    window, loaded = parse_window(train), options.load(machine)
    fits = parse_fits(fit, parameter_units(loaded))
    paths, held_out = (
        [recording_file(x) for x in given or ()] for given in (recording, validation)
    )
    with output.checkpoint() as checkpoint:
        with progress_bar("simulating") as progress:
            result = crane.calibrate(
                loaded, paths, fits, train=window, validation=held_out,
                columns=reading.columns, span=reading.span, sensors=parse_names(sensors),
                checkpoint=checkpoint, progress=progress,
            )  # fmt: skip
        output.write(result, f"; see {output.out}/report.html")
