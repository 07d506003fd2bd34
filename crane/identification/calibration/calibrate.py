"""Calibration of machines: parameters fitted to recordings through the simulation."""

import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from crane.common.checkpoint import open_checkpoint
from crane.common.errors import CraneError, InputError, RecordingError, check_name, prefix_location
from crane.common.progress import Progress, progress_reporter
from crane.common.samples import Array
from crane.common.threads import with_single_threaded_blas
from crane.description.machine_parameters import parameter_unit
from crane.description.sensors import (
    PRESSURE_PREFIX,
    SENSOR_PREFIX,
    VALVE_SIGNAL_PREFIX,
    VELOCITY_SUFFIX,
    Sensor,
    quantity_unit,
    sensor_parameters,
    with_sensor_parameters,
)
from crane.formats.machine_loading import MachineVariants, load
from crane.identification.calibration.calibration_problem import CalibrationProblem
from crane.identification.calibration.calibration_result import (
    Calibration,
    CalibrationChannel,
    FittedParameter,
)
from crane.identification.calibration.calibration_statistics import (
    CalibrationEstimate,
    estimate_with_profiles,
    score_tests,
)
from crane.identification.calibration.levenberg_marquardt import (
    LOG_COLUMNS,
    LevenbergMarquardt,
    SearchLog,
)
from crane.identification.calibration.model_selection import (
    SelectedModel,
    block_errors,
    select_parameters,
)
from crane.identification.calibration.multi_start import minimize_from_starts
from crane.identification.calibration.plausibility import (
    PAYLOAD_MASS,
    implausible_values,
    near_minima,
    static_payload,
)
from crane.identification.calibration.recording_case import RecordingCase, recording_case
from crane.identification.calibration.unknowns import Unknown, build_unknowns, candidate_parameters
from crane.machine.machine import Machine
from crane.recordings.logs import read_log_columns
from crane.recordings.recording import IDEAL_SENSORS, SENSORS_NOTE
from crane.recordings.recording_reader import (
    FULL_TIME_SPAN,
    TimeSpan,
    known_sensors,
    read_sensor_readings,
    select_time_span,
)
from crane.recordings.sensor_discrepancy import displaced_pins
from crane.recordings.sensor_kinematics import cylinder_pins
from crane.recordings.timeseries import Table, parse_heading
from crane.simulation.recorded_run import simulated_columns

AUTO = "auto"  # selects parameters automatically
_MAX_CORRELATION = 0.95  # correlation of pairs that are reported
_MAX_STD_SHARE = 0.5  # standard deviation per value, above which a parameter is unidentifiable


@with_single_threaded_blas
def calibrate(
    machine: Machine | str | Path,
    recordings: Sequence[str | Path] | str | Path,
    fit: Mapping[str, object] | Sequence[str],
    *,
    train: TimeSpan = FULL_TIME_SPAN,
    validation: Sequence[str | Path] = (),
    columns: str | Path | None = None,
    span: TimeSpan = FULL_TIME_SPAN,
    sensors: Sequence[str] | None = None,
    checkpoint: str | Path | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate parameters of a machine to recordings with measured valve signals.

    The simulation of the signals of each recording (see `crane.simulation.replay`) is compared
    with the measurements by least squares over the parameters and the start of each recording,

        min sum_c sum_t ((y_c(t) - m_c(t)) / s_c)^2 / r_c + sum (start / deviation)^2,

    The method is Levenberg-Marquardt within bounds, first with friction smoothed over some
    millimetres per second, because the instants of sticking depend on the whole motion before. The
    scale s_c of a channel is its residual, updated in rounds, at least its noise and at most a
    two-hundredth of the range of its unit, so that no channel dominates by low noise or is
    neglected; r_c is the number of its samples per independent residual. Confidence
    intervals take blocks of instants as independent, since the residuals are not white (Huber's
    sandwich estimator over blocks).

    Args:
        machine: The machine, or an argument of `crane.load`, with joints locked that were held.
        recordings: Files with measured valve signals, CSV or npz.
        fit: Parameters by name: None, a start, or (start, low, high). Names are those of
            `crane.description.parameters`; with `*` a common factor of all that match;
            `sensor.COLUMN.zero`, `.scale` and `.delay` of sensors. "auto" adds all parameters that
            the recordings may determine, with usual priors, and keeps those that they do.
        train: Start and end [s], by the clocks of the files, of the training data; the rest is
            held out.
        validation: Recordings that are held out completely.
        columns: Column file of raw logs, see `crane.recordings.logs`; default by the sensors of
            the machine.
        span: Start and end [s], by the clocks of the files, of the samples that are read from
            `recordings`.
        sensors: Columns to compare; default all that can be simulated.
        checkpoint: File to which the state of the search is appended after each iteration; it goes
            on from there, to the same result. It stays until it is removed, as by
            `Calibration.write` into its folder, where it is named "unfinished.csv".
        progress: Called with the finished share, 0 to 1.

    Returns:
        Parameters with confidence intervals, channels before and after, the fitted machine, and
        score tests of other parameters.

    Raises:
        InputError: Names, bounds or spans are not valid, or the checkpoint is of another
            calibration.
        OutputError: The checkpoint cannot be written.
        RecordingError: A recording is malformed, or has no valve signals.
        SimulationError: The simulation of a recording fails with the initial parameters.
    """
    progress = progress_reporter(progress)
    if not isinstance(machine, Machine):
        machine = load(machine)
    paths = [recordings] if isinstance(recordings, str | Path) else list(recordings)
    cases = _read_cases(machine, paths, validation, columns, train, span, sensors)
    requested = dict(fit) if isinstance(fit, Mapping) else dict.fromkeys(fit)
    automatic = AUTO in requested
    if requested.pop(AUTO, None) is not None:
        raise InputError(f"'{AUTO}' chooses parameters by itself, give it no start")
    _check_readings(requested, (*paths, *validation), cases)
    variants = MachineVariants(machine)
    parameters = variants.values | sensor_parameters(cases[0].known_sensors)
    units = _sensor_units(cases)
    unknowns_for = partial(
        build_unknowns, spec=variants.spec, parameters=parameters, sensor_units=units
    )
    unknowns = [] if automatic and not requested else unknowns_for(requested)
    known_mass = parameters.get(PAYLOAD_MASS, 0.0)
    pins = {k: v for case in cases for k, v in displaced_pins(machine, case.table).items()}
    statics = static_payload(variants, pins, cases) if PAYLOAD_MASS in parameters else None
    candidates = candidate_parameters(machine, cases, parameters, pins)
    if statics is not None:
        candidates = [
            *(x for x in candidates if x.name != PAYLOAD_MASS), *statics.candidates(known_mass)
        ]  # fmt: skip
    complete = unknowns_for({x.name: (x.start, x.low, x.high) for x in candidates})
    extras = _other_unknowns(unknowns, complete, candidates)
    problem = CalibrationProblem(machine, unknowns, cases)
    initial_residuals = [
        problem.residuals(x, np.zeros(problem.unknown_count)) for x in problem.cases
    ]
    dependencies = {
        "machine data": (variants.spec, machine.locked_joints),
        "recordings": [x.contents for x in cases],
        "settings": (unknowns, extras, automatic),
    }
    problem = problem.variant([*unknowns, *(extras if automatic else [])])
    unknown_payload = [x for x in extras if x.name == PAYLOAD_MASS and x.start != known_mass]
    kept = [x.name for x in (*unknowns, *unknown_payload)]
    with open_checkpoint(checkpoint, dependencies, LOG_COLUMNS, 1) as table:
        search = LevenbergMarquardt(problem, progress, SearchLog(table))
        if automatic:
            selected = select_parameters(search, kept, _reserve(machine, {*pins, *kept}))
        else:
            selected = SelectedModel(search, search, minimize_from_starts(search))
        first, search, problem = selected.first, selected.search, selected.search.problem
        estimate = estimate_with_profiles(search, selected.minimum, selected.left_out)
        errors = block_errors(search, estimate.z) if automatic else {}
    applicable = [x for x in extras if dict(x.members).get(x.name, x.start) == x.start]
    with warnings.catch_warnings(action="ignore"):
        fitted = variants.machine(problem.changes(estimate.z))
    found = _calibration_result(problem, fitted, search, estimate, initial_residuals, units)
    known = dict(machine.sensors) | dict(cases[0].known_sensors)
    return replace(
        found,
        machine=_machine_with_sensors(fitted, known, columns, found.changes),
        score_tests=() if automatic else tuple(score_tests(search, applicable, estimate.z)),
        selection=selected.steps,
        unselected_parameters=tuple(x.name for x in selected.left_out),
        block_errors=errors,
        minima=tuple(x.cost / first.minima[0].cost for x in first.minima),
        findings=(
            *filter(None, [statics.finding(known_mass) if statics is not None else ""]),
            *implausible_values(search, estimate.z),
            *near_minima(first.problem, first.minima),
        ),
    )


def _reserve(machine: Machine, known: Collection[str]) -> dict[str, Collection[str]]:
    """Channels by candidates that are needed only if the others leave more than noise in them.

    Friction, load and pins of the drawing explain each other, as damping and delay of a spool do.

    Args:
        machine: The machine.
        known: Names that are candidates in any case.
    """
    circuit, found = machine.hydraulics, dict[str, Collection[str]]()
    for joint in circuit.joints if circuit else ():
        channels = {joint, *(f"{PRESSURE_PREFIX}{joint}_{side}" for side in "ab")}
        found |= dict.fromkeys((
            *cylinder_pins(machine, joint),
            f"valve.{joint}.damping", f"valve.{joint}.spool_b.damping",
        ), channels)  # fmt: skip
    return {name: channels for name, channels in found.items() if name not in known}


def _sensor_units(cases: Sequence[RecordingCase]) -> dict[str, str]:
    """Units of the compared columns and of the valve signals."""
    return {
        name: case.table.units[name]
        for case in cases
        for name in (*case.sensors, *(VALVE_SIGNAL_PREFIX + x for x in case.inputs.signals))
    }


def _other_unknowns(
    unknowns: Sequence[Unknown], complete: Sequence[Unknown], candidates: Sequence[Unknown]
) -> list[Unknown]:
    """Candidates that change other parameters than some unknowns, with their priors."""
    used_names = {name for x in unknowns for name in (x.name, *dict(x.members))}
    return [
        replace(x, scale=candidate.scale, prior=1.0)
        for x, candidate in zip(complete, candidates, strict=True)
        if not used_names & {x.name, *dict(x.members)}
    ]


def _check_readings(
    requested: Iterable[str], paths: Sequence[str | Path], cases: Sequence[RecordingCase]
) -> None:
    """Refuse parameters of sensors where recordings have quantities instead of readings."""
    sensor_names = [name for name in requested if name.startswith(SENSOR_PREFIX)]
    for path, case in zip(paths, cases, strict=True):
        if sensor_names and case.table.notes.get(SENSORS_NOTE) == IDEAL_SENSORS:
            raise InputError(
                f"{path}: '{sensor_names[0]}' cannot be fitted to quantities, which its note "
                f"'{SENSORS_NOTE}: {IDEAL_SENSORS}' says they are: give the readings, or remove "
                "the note if they are"
            )


def _read_cases(
    machine: Machine,
    paths: Sequence[str | Path],
    validation: Sequence[str | Path],
    columns: str | Path | None,
    train: TimeSpan,
    span: TimeSpan,
    sensors: Sequence[str] | None,
) -> list[RecordingCase]:
    """Read the recordings of a calibration, those of the validation last; see `calibrate`."""
    if not paths:
        raise InputError("no recording is given, name at least one")
    if not train[0] < train[1]:
        raise InputError(f"the window from {train[0]:g} to {train[1]:g} s is empty")
    if train[0] < span[0] and train[0] > -np.inf or train[1] > span[1] and train[1] < np.inf:
        raise InputError(
            f"the training data, {train[0]:g} to {train[1]:g} s, are not within the span "
            f"{span[0]:g} to {span[1]:g} s that is read: widen the span"
        )
    tables = [
        select_time_span(read_sensor_readings(path, machine, columns), span, path)
        for path in paths
    ]
    tables += [read_sensor_readings(path, machine, columns) for path in validation]
    cases = [
        _read_case(machine, path, table, sensors, train if i < len(paths) else (np.inf, np.inf))
        for i, (path, table) in enumerate(zip((*paths, *validation), tables, strict=True))
    ]
    if not any(case.train_mask.any() for case in cases):
        raise InputError(f"no instant lies within {train[0]:g} to {train[1]:g} s")
    return cases


def _machine_with_sensors(
    machine: Machine,
    known: Mapping[str, Sensor],
    columns: str | Path | None,
    changes: Mapping[str, float],
) -> Machine:
    """The fitted machine with the known and fitted sensor parameters and log columns."""
    sensors = dict(known)
    for line in read_log_columns(Path(columns))[1] if columns is not None else ():
        name, unit = parse_heading(line.heading)
        if quantity_unit(machine.tree, name) is not None:
            sensors[name] = replace(sensors.get(name, Sensor()), column=line.expression, unit=unit)
    return machine.replace(
        sensors=with_sensor_parameters(
            sensors, {name: x for name, x in changes.items() if name.startswith(SENSOR_PREFIX)}
        )
    )


def _read_case(
    machine: Machine,
    path: str | Path,
    table: Table,
    sensors: Sequence[str] | None,
    window: tuple[float, float],
) -> RecordingCase:
    try:
        compared = simulated_columns(machine, table)
        for name in sensors or ():
            check_name(name, compared, f"'{name}' cannot be compared")
        compared = compared if sensors is None else list(sensors)
        return recording_case(
            machine, Path(path).name, table, known_sensors(table, machine), compared, window
        )
    except RecordingError as error:
        raise RecordingError(prefix_location(str(path), error)) from None


def _calibration_result(
    problem: CalibrationProblem,
    fitted: Machine,
    search: LevenbergMarquardt,
    estimate: CalibrationEstimate,
    initial_residuals: list[Array],
    units: Mapping[str, str],
) -> Calibration:
    unknowns, z, covariance = problem.unknowns, estimate.z, estimate.covariance
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    values = problem.values(z)
    divisors = np.where(deviations > 0, deviations, np.inf)[: len(unknowns)]
    finite = np.nan_to_num(covariance[: len(unknowns), : len(unknowns)], posinf=0.0)
    correlation = finite / np.outer(divisors, divisors)
    correlated = [
        (unknowns[j].name, unknowns[i].name, float(correlation[i, j]))
        for i, j in np.argwhere(np.abs(np.tril(correlation, -1)) > _MAX_CORRELATION).tolist()
    ]
    final_residuals = [problem.residuals(case, z) for case in problem.cases]
    channels = [
        CalibrationChannel(
            case.name,
            name,
            units[name],
            case.file_time,
            case.train_mask,
            case.measured[:, k],
            old[:, k] + case.measured[:, k],
            new[:, k] + case.measured[:, k],
        )
        for case, old, new in zip(problem.cases, initial_residuals, final_residuals, strict=True)
        for k, name in enumerate(case.sensors)
    ]
    parameters = []
    for i, unknown in enumerate(unknowns):
        value, scale = values[unknown.name], unknown.scale
        bound = z[i] <= search.low[i] + 1e-9 or z[i] >= search.high[i] - 1e-9
        size = max(abs(value), abs(unknown.start)) if not unknown.sensor else np.inf
        parameters.append(
            FittedParameter(
                unknown.name,
                unknown.start,
                value,
                float(estimate.interval_half_widths[i] * scale),
                bool(bound),
                bool(not bound and deviations[i] * scale > _MAX_STD_SHARE * size),
                parameter_unit(problem.machine.tree, unknown.name),
                unknown.members,
                estimate.profile_ends[i],
                any(x.exceeds_noise for x in channels),
                float(estimate.candidate_half_widths[i] * scale),
            )
        )
    return Calibration(
        fitted,
        tuple(parameters),
        tuple(channels),
        problem.changes(z),
        tuple(sorted(correlated, key=lambda pair: -abs(pair[2]))),
        search.log.simulations,
        correlation=correlation,
        states=simulated_states(problem, z),
        is_lowest_minimum=estimate.is_lowest_minimum,
    )


def simulated_states(problem: CalibrationProblem, z: Array) -> dict[str, Mapping[str, Array]]:
    """Simulated velocities and chamber pressures (N,) of the valve-driven joints by recording.

    They are those of the fitted machine, without noise.

    Args:
        problem: The calibration problem.
        z: (p,) unknowns.
    """
    hydraulics = problem.machine.hydraulics
    joints = () if hydraulics is None else hydraulics.joints
    names = [
        name
        for x in joints
        for name in (x + VELOCITY_SUFFIX, f"{PRESSURE_PREFIX}{x}_a", f"{PRESSURE_PREFIX}{x}_b")
    ]
    found: dict[str, Mapping[str, Array]] = {}
    for case in problem.cases if names else ():
        try:
            curve = problem.simulate_readings(replace(case, sensors=names), z, False)
        except CraneError:  # the channels of the recording report the error
            continue
        found[case.name] = dict(zip(names, curve(case.inputs.time).T, strict=True))
    return found
