"""Commands that find parameters from strokes and forces: identify, payload."""

import dataclasses
import warnings
from collections.abc import Iterator, Sequence
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from crane.cli.shared import (
    BY_COMMAND,
    Columns,
    Force,
    From,
    Lock,
    MachineName,
    Method,
    Out,
    RecordingFile,
    Recordings,
    Train,
    Trust,
    Until,
    Validation,
    app,
    by_joint,
    load,
    progress_bar,
    span_of,
    status,
    window,
)
from crane.common.errors import CraneWarning, InputError, RecordingError

if TYPE_CHECKING:
    from crane.description.estimation_settings import ParameterPrior, TermValues
    from crane.identification.signals.signal_processing import Motion
    from crane.machine import Machine
    from crane.recordings.recording import Recording

_FEWEST = 50  # samples of a part that is held out
_TERM = "NAME, NAME=NUMBERS or NAME=off, as in q1.presliding=1e-4"
_TRY = "each NAME=VALUES once, as bandwidth=2,5,10 or bodies=1%,10%"
_PRIOR = "NAME=STD, as in bodies=10%, q1.viscous=50 or q1.viscous=200+-50, a share, or none"


@app.command()
def identify(
    machine: MachineName,
    recording: Recordings,
    out: Out = BY_COMMAND,
    train: Train = None,
    validation: Validation = None,
    columns: Columns = None,
    since: From = None,
    until: Until = None,
    method: Method = "wls",
    term: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[=NUMBERS]",
            help="A term of the model, as q*.rotor_inertia, q1.presliding=1e-4, q5+q6.viscous; "
            "NAME=off leaves it out.",
        ),
    ] = None,
    prior: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[NAME=]STD",
            help="What is known before: a share of all that is described, as 0.3; or by name, as "
            "bodies=10%, q1.viscous=200+-50; none: nothing.",
        ),
    ] = None,
    feasible: Annotated[
        bool, typer.Option("--feasible", help="Only bodies and friction that can exist.")
    ] = False,
    bandwidth: Annotated[
        float | None,
        typer.Option(metavar="HZ", help="Of the low-pass; by the motion if not given."),
    ] = None,
    slow: Annotated[
        list[str] | None,
        typer.Option(
            metavar="JOINT=VALUE",
            help="Velocity below which its rows are left out, in m/s or rad/s.",
        ),
    ] = None,
    tried: Annotated[
        list[str] | None,
        typer.Option(
            "--try",
            metavar="NAME=VALUES",
            help="Values of which cross-validation in the training chooses one, as bandwidth=5,10 "
            "or, of a prior, bodies=1%,10%.",
        ),
    ] = None,
    lock: Lock = None,
    trust: Trust = False,
    force: Force = False,
) -> None:
    """Find a machine's parameters from recordings, and how well they predict."""
    from crane.cli.runs import check_folder, write_identification
    from crane.common.samples import as_number
    from crane.identification.mechanics.cross_validation import (
        cross_validate,
        format_trials,
        identify_options,
    )
    from crane.identification.mechanics.identify import identify as run
    from crane.identification.mechanics.write_identified import check_rewritable

    check_folder(out, force)
    fitted, changes, known = window(train), terms(term), priors(prior)
    span = span_of(since, until)
    slowest, grid = by_joint("--slow", slow), values_tried(tried)
    loaded = load(machine, lock)
    if known is None:
        estimation = dataclasses.replace(loaded.estimation, prior={})
        loaded = loaded.replace(estimation=estimation)
    if feasible:
        check_rewritable(loaded)
    learned, outside = _divided(_read(recording, loaded, columns, span), fitted)
    judges: list[Recording | Motion] = [*_moving(loaded, outside, trust)]
    if train is not None and not outside:
        warnings.warn(
            f"nothing of use lies outside of --train {train}, so nothing judges",
            CraneWarning,
            stacklevel=1,
        )
    rest = "the rest" if judges else ""
    judges += _read(validation or [], loaded, columns)
    if bandwidth is not None:
        shortest = max(min(float(x.time[-1] - x.time[0]) for x in learned), 1e-3)
        as_number(bandwidth, "the bandwidth", "Hz", greater_than=5 / shortest)
    options: dict[str, Any] = {
        "method": method, "prior": known, "feasible": feasible, "terms": changes,
        "bandwidth": bandwidth, "slow": slowest, "trust": trust,
    }  # fmt: skip
    if grid:
        with progress_bar("cross-validating") as progress:
            trials = cross_validate(loaded, learned, grid, progress, **options)
        print(f"{format_trials(trials)}\n")
        options = identify_options(trials[0], options)
    with progress_bar("identifying") as progress:
        result = run(loaded, learned, judges or None, progress=progress, **options)
    with status("writing the report"):
        named = [", ".join(path.name for path in paths or ()) for paths in (recording, validation)]
        if train is not None:
            named = [f"{named[0]}, {train} s", ", ".join(filter(None, [rest, named[1]]))]
        if result.validation is None:
            named[1] = ""
        write_identification(out, result, named[0], named[1], force)
    print(f"{result.to_text()}\nwritten to {out}; see {out}/report.html")


def terms(words: Sequence[str] | None) -> "dict[str, TermValues | None]":
    """Terms by name: their numbers, None of those that are off.

    Raises:
        InputError: Something else is written, or a name twice.
    """
    found: dict[str, TermValues | None] = {}
    for word in words or ():
        name, equals, text = word.partition("=")
        try:
            is_word = not equals or text in ("on", "off")
            numbers = () if is_word else tuple(map(float, text.split(",")))
        except ValueError:
            raise InputError(f"--term is '{word}', write {_TERM}") from None
        if name in found:
            raise InputError(f"--term names '{name}' twice, give it once")
        found[name] = None if text == "off" else numbers
    return found


def priors(words: Sequence[str] | None) -> "dict[str, ParameterPrior] | None":
    """What is known by name, "*" of a share without one; None of `none`.

    Raises:
        InputError: Something else is written, or a name twice.
    """
    from crane.description.estimation_settings import ParameterPrior

    found: dict[str, ParameterPrior] = {}
    if words and list(words) == ["none"]:
        return None
    for word in words or ():
        name, equals, text = word.rpartition("=")
        name = name.strip() if equals else "*"
        try:
            known = ParameterPrior.parse(text)
        except InputError:
            raise InputError(f"--prior is '{word}', write {_PRIOR}") from None
        if name in found:
            raise InputError(f"--prior says two things of '{name}', give one")
        found[name] = known if equals else dataclasses.replace(known, relative=True)
    return found


def values_tried(words: Sequence[str] | None) -> "dict[str, list[float | ParameterPrior]]":
    """Values by name: bandwidths, or what is known of parameters.

    Raises:
        InputError: Something else is written, or a name twice.
    """
    from crane.description.estimation_settings import ParameterPrior

    found: dict[str, list[float | ParameterPrior]] = {}
    for word in words or ():
        name, _, text = word.rpartition("=")
        name = name.strip()
        try:
            one = float if name == "bandwidth" else ParameterPrior.parse
            values = [one(each) for each in text.split(",")]
        except (ValueError, InputError):
            name = ""
        if not name or name in found:
            raise InputError(f"--try is '{word}', write {_TRY}")
        found[name] = values
    return found


def _read(
    paths: Sequence[Path],
    machine: "Machine",
    columns: Path | None,
    span: "tuple[float, float]" = (-inf, inf),
) -> "list[Recording]":
    from crane.cli.runs import read_run

    found = []
    for path in paths:
        with status(f"reading {path.name}"):
            found.append(read_run(path, machine, columns, span))
    return found


def _divided(
    recordings: "list[Recording]", span: tuple[float, float]
) -> "tuple[list[Recording], list[Recording]]":
    """What lies within a window [s], and what of use lies before and after it."""
    inside = [recording.between(*span) for recording in recordings]
    outside = [
        recording.at(part)
        for recording in recordings
        for part in (recording.time < span[0], recording.time > span[1])
        if part.sum() >= _FEWEST
    ]
    return inside, outside


def _moving(machine: "Machine", recordings: "list[Recording]", trust: bool) -> "Iterator[Motion]":
    """Motions of those that can be judged by; of others it is told why they cannot."""
    from crane.identification.mechanics.smoothed_motion import smoothed_motion

    for recording in recordings:
        try:
            yield smoothed_motion(machine, recording, trust=trust)
        except RecordingError as error:
            where = "{:.4g} to {:.4g} s".format(*recording.time[[0, -1]])
            text = f"what lies outside of --train, {where}, judges nothing: {error}"
            warnings.warn(text, CraneWarning, stacklevel=1)


@app.command()
def payload(
    machine: MachineName,
    recording: RecordingFile,
    columns: Columns = None,
    since: From = None,
    until: Until = None,
    frame: Annotated[
        str | None, typer.Option(help="Link that carries the load; the tip if not given.")
    ] = None,
    method: Method = "wls",
    lock: Lock = None,
    trust: Trust = False,
) -> None:
    """Estimate mass and centre of mass of what a machine carries from a recording."""
    from crane.identification.mechanics.identify_payload import identify_payload

    span = span_of(since, until)
    loaded = load(machine, lock)
    (carried,) = _read([recording], loaded, columns, span)
    with progress_bar("estimating") as progress:
        estimate = identify_payload(loaded, carried, frame, method, trust=trust, progress=progress)
    print(estimate.to_text(), end="")
