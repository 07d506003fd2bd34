"""A machine's numbers from recordings, through the simulation of what drove it."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from crane.common.errors import InputError, RecordingError, at
from crane.common.errors import known as known_names
from crane.common.samples import Array
from crane.common.threads import on_one_thread
from crane.common.waiting import telling
from crane.description.number_units import number_unit
from crane.description.sensors import (
    SENSOR,
    SIGNAL,
    Sensor,
    named_numbers,
    unit_of,
    with_numbers,
)
from crane.formats import load
from crane.formats.loading import Variants
from crane.identification.calibration.automatic import told
from crane.identification.calibration.candidates import candidates
from crane.identification.calibration.ends import Found, found_by
from crane.identification.calibration.problem import Case, Problem, case_of
from crane.identification.calibration.result import Calibration, Channel, Fitted
from crane.identification.calibration.search import Progress, Search
from crane.identification.calibration.states import states
from crane.identification.calibration.unknowns import Unknown, unknowns_of
from crane.machine import Machine
from crane.recordings.logs import lines_of
from crane.recordings.reading import ALWAYS, Span, known_sensors, readings, within
from crane.recordings.recording import IDEAL, SENSORS
from crane.recordings.timeseries import Table, heading_of
from crane.simulation.readings import sensors_of

AUTO = "auto"  # what is fitted if nobody says what
_COUPLED = 0.95  # correlation of two numbers of which the data know a combination alone
_VAGUE = 0.5  # standard deviation, of a number's size, that says nothing


@on_one_thread
def calibrate(
    machine: Machine | str | Path,
    recordings: Sequence[str | Path] | str | Path,
    fit: Mapping[str, object] | Sequence[str],
    *,
    train: Span = ALWAYS,
    validation: Sequence[str | Path] = (),
    columns: str | Path | None = None,
    span: Span = ALWAYS,
    sensors: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Fit numbers of a machine to recordings of it, driven by its measured valve signals.

    The simulation of each recording's signals (see `crane.simulation.replay`) is compared with
    what was measured. Least squares over the numbers and over each recording's start,

        min sum_c sum_t ((y_c(t) - m_c(t)) / s_c)^2 + sum (start / its deviation)^2,

    by Levenberg and Marquardt's method within bounds, at first with friction that is smoothed over
    millimetres per second, for what sticks when depends on everything before. A channel's s_c is
    what is left of it, found in rounds, but no more than a fifth of its variation or its noise: no
    channel outweighs others because its noise is small where the model is not that good, and none
    is given up. Intervals take blocks of instants as what is independent, since what is left is no
    white noise (Huber's sandwich over blocks).

    Args:
        machine: The machine, or what `crane.load` takes; joints that were held are locked in it.
        recordings: Of measured valve signals, CSV or npz.
        fit: Numbers by name: None, a start, or (start, low, high). Names are those of
            `crane.description.parameters`; with `*` a common factor of all that match;
            `sensor.COLUMN.zero`, `.scale` and `.delay` of what was measured. "auto" adds all
            that the recordings may tell, with what is usually known of it before, and keeps what
            they do tell.
        train: From when to when [s], by the files' own clocks, recordings are fitted; the rest
            is held out.
        validation: Recordings that are held out whole.
        columns: A file that says which columns of raw logs are which, if not as the machine's
            sensors say, see `crane.recordings.logs`.
        span: From when to when [s], by the files' own clocks, recordings count at all; those of
            `validation` count whole.
        sensors: Columns to compare; all that can be if not given.
        progress: Called with the finished share, 0 to 1.

    Returns:
        The numbers with their intervals, channels before and after, the fitted machine, and what
        else it lacks.

    Raises:
        InputError: Names, bounds or windows that cannot be.
        RecordingError: A recording is malformed, or has no signals.
        SimulationError: The machine as it is cannot follow a recording.
    """
    progress = telling(progress)
    if not isinstance(machine, Machine):
        machine = load(machine)
    paths = [recordings] if isinstance(recordings, str | Path) else list(recordings)
    if not paths:
        raise InputError("no recording is given, name at least one")
    if not train[0] < train[1]:
        raise InputError(f"the window from {train[0]:g} to {train[1]:g} s is empty")
    if train[0] < span[0] and train[0] > -np.inf or train[1] > span[1] and train[1] < np.inf:
        raise InputError(
            f"what is fitted, {train[0]:g} to {train[1]:g} s, is not within {span[0]:g} to "
            f"{span[1]:g} s, which is read"
        )
    tables = [within(readings(path, machine, columns), span, path) for path in paths]
    tables += [readings(path, machine, columns) for path in validation]
    cases = [
        _case(machine, path, table, sensors, train if i < len(paths) else (np.inf, np.inf))
        for i, (path, table) in enumerate(zip((*paths, *validation), tables, strict=True))
    ]
    if not any(case.train.any() for case in cases):
        raise InputError(f"no instant lies within {train[0]:g} to {train[1]:g} s")
    given = dict(fit) if isinstance(fit, Mapping) else dict.fromkeys(fit)
    auto = AUTO in given
    if given.pop(AUTO, None) is not None:
        raise InputError(f"'{AUTO}' chooses numbers by itself, give it no start")
    for path, table in zip((*paths, *validation), tables, strict=True):
        _check_readings(path, table, given)
    variants = Variants(machine)
    numbers = variants.values | named_numbers(cases[0].known)
    units = {
        name: table.units[name]
        for case, table in zip(cases, tables, strict=True)
        for name in (*case.sensors, *(SIGNAL + joint for joint in case.inputs.signals))
    }

    def asked(which: Mapping[str, object] | Sequence[str]) -> list[Unknown]:
        return unknowns_of(which, variants.spec, numbers, units)

    unknowns = [] if auto and not given else asked(given)
    taken = {name for x in unknowns for name in (x.name, *dict(x.members))}
    proposed = {x.name: x for x in candidates(machine, cases, numbers)}
    extras = [
        replace(x, scale=proposed[x.name].deviation, prior=1.0)
        for x in asked({x.name: (x.start, x.low, x.high) for x in proposed.values()})
        if not taken & {x.name, *dict(x.members)}
    ]
    problem = Problem(machine, unknowns, cases)
    before = [problem.residuals(case, np.zeros(problem.size)) for case in problem.cases]
    search, left = Search(problem, progress), list[str]()
    if auto:
        problem, search, left = told(Problem(machine, [*unknowns, *extras], cases), progress)
    end = found_by(search, len(problem.unknowns))
    found = replace(_result(problem, search, end, before, units), left=tuple(left))
    if not auto:
        here = [x for x in extras if dict(x.members).get(x.name, x.start) == x.start]
        found = replace(found, lacking=tuple(search.lacking(here, end.z)))
    known = dict(machine.sensors) | dict(cases[0].known)
    return replace(found, machine=_sensing(found.machine, known, columns, found.changes))


def _check_readings(path: str | Path, table: Table, fit: Iterable[str]) -> None:
    """See that numbers of sensors are fitted to what they read."""
    for name in fit:
        if name.startswith(SENSOR) and table.notes.get(SENSORS) == IDEAL:
            raise InputError(
                f"{path}: '{name}' cannot be fitted to quantities, which its note '{SENSORS}: "
                f"{IDEAL}' says they are: give the readings, or remove the note if they are"
            )


def _sensing(
    fitted: Machine,
    known: Mapping[str, Sensor],
    columns: str | Path | None,
    changes: Mapping[str, float],
) -> Machine:
    """The fitted machine with all that is known of its sensors, and of their columns in logs."""
    sensors = dict(known)
    for line in lines_of(Path(columns))[1] if columns is not None else ():
        name, unit = heading_of(line.heading)
        if unit_of(fitted.tree, name) is not None:
            known_as = sensors.get(name, Sensor())
            sensors[name] = replace(known_as, column=line.expression, unit=unit)
    own = {name: value for name, value in changes.items() if name.startswith(SENSOR)}
    return fitted.replace(sensors=with_numbers(sensors, own))


def _case(
    machine: Machine,
    path: str | Path,
    table: Table,
    sensors: Sequence[str] | None,
    window: tuple[float, float],
) -> Case:
    try:
        found = sensors_of(machine, table)
        for name in sensors or ():
            if name not in found:
                raise InputError(f"'{name}' cannot be compared, {known_names(found, name)}")
        found = found if sensors is None else list(sensors)
        known = known_sensors(table, machine)
        return case_of(machine, Path(path).name, table, known, found, window)
    except RecordingError as error:
        raise RecordingError(at(str(path), error)) from None


def _result(
    problem: Problem,
    search: Search,
    end: Found,
    before: list[Array],
    units: Mapping[str, str],
) -> Calibration:
    unknowns, z, covariance = problem.unknowns, end.z, end.covariance
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    values = problem.values(z)
    fitted = []
    for i, unknown in enumerate(unknowns):
        value, scale = values[unknown.name], unknown.scale
        bound = z[i] <= search.low[i] + 1e-9 or z[i] >= search.high[i] - 1e-9
        size = max(abs(value), abs(unknown.start)) if not unknown.sensor else np.inf
        fitted.append(Fitted(
            unknown.name, unknown.start, value, float(end.widths[i]) * scale, bool(bound),
            bool(not bound and deviations[i] * scale > _VAGUE * size),
            number_unit(problem.machine.tree, unknown.name), unknown.members, end.ends[i],
        ))  # fmt: skip
    after = [problem.residuals(case, z) for case in problem.cases]
    seen = [
        Channel(case.name, name, units[name], case.clock, case.train, case.measured[:, k],
               old[:, k] + case.measured[:, k], new[:, k] + case.measured[:, k])
        for case, old, new in zip(problem.cases, before, after, strict=True)
        for k, name in enumerate(case.sensors)
    ]  # fmt: skip
    return Calibration(
        problem.fitted(z), tuple(fitted), tuple(seen), problem.changes(z),
        tuple(_coupled(unknowns, covariance)), problem.runs,
        correlation=_correlation(covariance, len(unknowns)), states=states(problem, z),
        lowest=end.lowest,
    )  # fmt: skip


def _correlation(covariance: Array, count: int) -> Array:
    """(n, n) of the first n, 0 of what is known exactly."""
    deviations = np.sqrt(np.maximum(np.diag(covariance)[:count], 0.0))
    ones = np.where(deviations > 0, deviations, np.inf)
    found: Array = covariance[:count, :count] / np.outer(ones, ones)
    return found


def _coupled(unknowns: Sequence[Unknown], covariance: Array) -> list[tuple[str, str, float]]:
    """Pairs of numbers that the data tell apart badly, with their correlation."""
    count = len(unknowns)
    deviations = np.sqrt(np.diag(covariance))[:count]
    found = []
    for i in range(count):
        for j in range(i):
            if deviations[i] and deviations[j]:
                share = float(covariance[i, j] / (deviations[i] * deviations[j]))
                if abs(share) > _COUPLED:
                    found.append((unknowns[j].name, unknowns[i].name, share))
    return sorted(found, key=lambda pair: -abs(pair[2]))
