"""Parameters that a calibration may fit, and their selection by what recordings determine."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from crane.common.errors import InputError
from crane.description.sensors import INCLINATION_PREFIX, SENSOR_PREFIX
from crane.hydraulics.components import Spool, Valve
from crane.hydraulics.hydraulic_circuit import Hydraulics
from crane.identification.calibration.calibration_problem import CalibrationProblem
from crane.identification.calibration.levenberg_marquardt import LevenbergMarquardt, Progress
from crane.identification.calibration.recording_case import RecordingCase
from crane.machine.machine import Machine

_MIN_SPOOL_STROKE = 0.05  # of the stroke of a spool, from which a valve counts as open
_MIN_BANDWIDTH, _MAX_BANDWIDTH = 5.0, 200.0  # bandwidths of spools [1/s]
_DELAY_STD, _MAX_DELAY = 0.1, 0.6  # standard deviation and largest value of delays [s]
_INCLINATION_ZERO_STD = 0.05  # standard deviation of inclinometer zeros [rad]
_PRESSURE_ZERO_STD = 2e5  # standard deviation of pressure sensor zeros [Pa]
_GAS_VOLUME_SHARE = 5e-3  # of the volume of a chamber
_LEAKAGE_FLOW_SHARE = 1e-2  # of the full flow of a valve at supply pressure
# orifices of the spools of A and B, by direction
_ORIFICES_BY_DIRECTION = {1: ("c1", "c2"), -1: ("c3", "c4")}
# bounds of a stiffness, relative to that of the oil or the known one
_MAX_STIFFNESS_REDUCTION, _MAX_STIFFNESS_INCREASE = 20.0, 4.0
_FRICTION_FORCE_SHARE = 2e-2  # of the force of a cylinder at supply pressure
# without stiffness the damping has no effect
_STIFFNESS_SUFFIX, _DAMPING_SUFFIX = ".stiffness", ".damping"


@dataclass(frozen=True)
class CandidateParameter:
    """Candidate for a calibration, with its prior.

    Attributes:
        name: Name, see `Unknown`.
        start: Initial guess.
        std: Standard deviation of the value in a file.
        low: Lower bound.
        high: Upper bound.
    """

    name: str
    start: float
    std: float
    low: float = -np.inf
    high: float = np.inf


def candidate_parameters(
    machine: Machine, cases: Sequence[RecordingCase], parameters: Mapping[str, float]
) -> list[CandidateParameter]:
    """Candidates that recordings of a machine may determine.

    Args:
        machine: The machine.
        cases: The recordings.
        parameters: Parameters of the machine and its sensors by name.
    """
    found: list[CandidateParameter] = []
    for sensor in dict.fromkeys(name for case in cases for name in case.sensors):
        found += _sensor_candidates(sensor, parameters)
    hydraulics = machine.hydraulics
    if hydraulics is None:
        return found
    for joint, valve in hydraulics.valves.items():
        directions = {name: _opening_directions(name, hydraulics, cases) for name in valve.spools}
        for name, spool in valve.spools.items():
            if directions[name]:
                orifice_slice = slice(None)
                if len(directions) > 1:  # each spool has its own chamber
                    orifice_slice = slice(0, 1) if spool is valve else slice(1, 2)
                found += _spool_candidates(spool, parameters, directions[name], orifice_slice)
        if any(directions.values()):
            found += _cylinder_candidates(joint, machine, hydraulics, parameters)
    if parameters.get("payload.mass", 0.0):
        found.append(_positive_candidate("payload.mass", parameters["payload.mass"], 0.5, 3.0))
    found.append(_positive_candidate("oil.bulk_modulus", hydraulics.oil.bulk_modulus, 0.5, 5.0))
    return found


def _positive_candidate(
    name: str, start: float, relative_std: float, factor: float
) -> CandidateParameter:
    """Positive candidate with a relative standard deviation, bounded by a factor."""
    return CandidateParameter(name, start, relative_std * start, start / factor, start * factor)


def _opening_directions(
    name: str, hydraulics: Hydraulics, cases: Sequence[RecordingCase]
) -> set[int]:
    """Directions in which a spool opens, 1 and -1."""
    spool = hydraulics.spools[name]
    signals = [
        case.inputs.signals[by]
        for case in cases
        for by in [name if name in case.inputs.signals else spool.joint]
        if by in case.inputs.signals
    ]
    if not signals:
        return set()
    u = (np.concatenate(signals) - spool.neutral) / (spool.full - spool.neutral)
    return {way for way, most in ((1, u.max()), (-1, -u.min())) if most > _MIN_SPOOL_STROKE}


def _sensor_candidates(name: str, parameters: Mapping[str, float]) -> Iterator[CandidateParameter]:
    zero, delay = (f"{SENSOR_PREFIX}{name}.{what}" for what in ("zero", "delay"))
    if name.startswith(INCLINATION_PREFIX):
        yield CandidateParameter(zero, parameters.get(zero, 0.0), _INCLINATION_ZERO_STD)
    if name.startswith("pressure_"):  # pressure sensors have little delay
        yield CandidateParameter(zero, parameters.get(zero, 0.0), _PRESSURE_ZERO_STD)
    else:
        yield CandidateParameter(delay, parameters.get(delay, 0.0), _DELAY_STD, 0.0, _MAX_DELAY)


def _spool_candidates(
    spool: Valve | Spool,
    parameters: Mapping[str, float],
    directions: set[int],
    orifice_slice: slice,
) -> Iterator[CandidateParameter]:
    """Candidates of a spool and of the orifices that it opened."""
    name = f"valve.{spool.joint}" + ("" if isinstance(spool, Valve) else ".spool_b")
    stroke = abs(spool.full - spool.neutral)
    drift, dead = 0.02 * stroke, spool.dead_band
    if len(directions) == 2:  # in one direction neutral and dead band are not separable
        least, most = spool.neutral - 3.0 * drift, spool.neutral + 3.0 * drift
        yield CandidateParameter(f"{name}.neutral", spool.neutral, drift, least, most)
    yield CandidateParameter(f"{name}.dead_band", dead, 0.05, max(dead - 0.15, 0.0), dead + 0.15)
    for orifice in (
        x
        for way in sorted(directions, reverse=True)
        for x in _ORIFICES_BY_DIRECTION[way][orifice_slice]
    ):
        parameter = f"valve.{spool.joint}.{orifice}"
        if parameters[parameter]:
            yield _positive_candidate(parameter, parameters[parameter], 0.3, 2.5)
    if spool.bandwidth:
        low, high = min(spool.bandwidth, _MIN_BANDWIDTH), max(spool.bandwidth, _MAX_BANDWIDTH)
        yield CandidateParameter(f"{name}.bandwidth", spool.bandwidth, spool.bandwidth, low, high)
    delay = spool.delay
    yield CandidateParameter(f"{name}.delay", delay, _DELAY_STD, 0.0, max(delay, _MAX_DELAY))


def _cylinder_candidates(
    joint: str, machine: Machine, hydraulics: Hydraulics, parameters: Mapping[str, float]
) -> Iterator[CandidateParameter]:
    cylinder, valve = hydraulics.cylinders[joint], hydraulics.valves[joint]
    pressure = hydraulics.supply.pressure
    index = machine.active.index(joint)
    stroke = 0.0 if cylinder.motor else float(machine.upper[index] - machine.lower[index])
    friction_force = _FRICTION_FORCE_SHARE * pressure * cylinder.area_a
    max_speed = valve.c1 * np.sqrt(pressure) / cylinder.area_a
    for what, size in (("coulomb", friction_force), ("viscous", friction_force / max_speed)):
        name = f"friction.{joint}.{what}"
        if name in parameters:
            start = parameters[name]
            std = max(3.0 * start, size)
            yield CandidateParameter(name, start, std, 0.0, start + 5.0 * std)
    volumes = (
        cylinder.area_a * stroke + cylinder.hose_a,
        cylinder.area_b * stroke + cylinder.hose_b,
    )
    leakage_coefficient = _LEAKAGE_FLOW_SHARE * valve.c1 / np.sqrt(pressure)
    for side, volume in zip("ab", volumes, strict=True):
        hose = f"cylinder.{joint}.hose_{side}"
        yield _positive_candidate(hose, parameters[hose], 0.5, 3.0)
        for what, size in (("gas", _GAS_VOLUME_SHARE * volume), ("leakage", leakage_coefficient)):
            name = f"cylinder.{joint}.{what}_{side}"
            start = parameters[name]
            yield CandidateParameter(name, start, max(start, size), 0.0)
    name = f"cylinder.{joint}.leakage"
    yield CandidateParameter(
        name, parameters[name], max(parameters[name], leakage_coefficient), 0.0
    )
    if cylinder.motor:  # a motor has no structural compliance
        return
    oil = hydraulics.oil.bulk_modulus
    oil_stiffness = sum(
        oil * area**2 / volume
        for area, volume in zip((cylinder.area_a, cylinder.area_b), volumes, strict=True)
    )
    name = f"cylinder.{joint}.stiffness"
    start = parameters[name] or oil_stiffness
    yield CandidateParameter(
        name, start, start, start / _MAX_STIFFNESS_REDUCTION, start * _MAX_STIFFNESS_INCREASE
    )
    name = f"cylinder.{joint}.damping"
    yield _positive_candidate(name, parameters[name], 1.0, 20.0)


def select_parameters(
    problem: CalibrationProblem, progress: Progress | None
) -> tuple[CalibrationProblem, LevenbergMarquardt, list[str]]:
    """Fit all parameters with their priors, and remove those without an effect.

    A parameter is removed if it stays on a bound at the value of the machine: no air, no leakage,
    no delay, or a rigid structure.

    Args:
        problem: Problem of all candidates; parameters without a prior are always kept.
        progress: See `calibrate`.

    Returns:
        Problem of the kept parameters, a search that continues from the fit, and names of the
        removed parameters.

    Raises:
        InputError: No parameter is kept.
    """
    search = LevenbergMarquardt(problem, progress)
    z, unknowns = search.smoothed_minimum(), problem.unknowns
    excluded = set()
    for i, unknown in enumerate(unknowns):
        rigid = dict(unknown.members).get(unknown.name) == 0.0 and unknown.start > 0.0
        if unknown.prior and (z[i] == 0.0 or rigid and z[i] >= search.high[i]):
            excluded.add(unknown.name)
    excluded_springs = [
        name.removesuffix(_STIFFNESS_SUFFIX)
        for name in excluded
        if name.endswith(_STIFFNESS_SUFFIX)
    ]
    excluded |= {x.name for x in unknowns if x.prior} & {
        name + _DAMPING_SUFFIX for name in excluded_springs
    }
    included = [i for i, unknown in enumerate(unknowns) if unknown.name not in excluded]
    if not included:
        raise InputError("the recordings determine no parameter: move more, or name parameters")
    reduced_problem = CalibrationProblem(
        problem.machine, [unknowns[i] for i in included], problem.cases
    )
    reduced_problem.simulation_count = problem.simulation_count
    initial_unknowns = np.concatenate([z[included], z[len(unknowns) :]])
    names = [unknown.name for unknown in unknowns if unknown.name in excluded]
    return reduced_problem, search.restricted_search(reduced_problem, initial_unknowns), names
