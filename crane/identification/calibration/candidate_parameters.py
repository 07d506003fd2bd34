"""Numbers that recordings may tell, and how far files are usually off."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from crane.description.sensors import INCLINATION_PREFIX, SENSOR_PREFIX
from crane.hydraulics import Hydraulics, Spool, Valve
from crane.identification.calibration.calibration_problem import RecordingCase
from crane.machine import Machine

_MIN_SPOOL_STROKE = 0.05  # of a spool's stroke, by which a valve is opened
_MIN_BANDWIDTH, _MAX_BANDWIDTH = 5.0, 200.0  # of spools [1/s]
_DELAY_STD, _MAX_DELAY = 0.1, 0.6  # [s] of signals
_INCLINATION_ZERO_STD = 0.05  # [rad] that inclinometers are mounted off
_PRESSURE_ZERO_STD = 2e5  # [Pa] that pressure sensors are off
_GAS_VOLUME_SHARE = 5e-3  # of a chamber's volume
_LEAKAGE_FLOW_SHARE = 1e-2  # of a valve's full flow at the supply's pressure
_ORIFICES_BY_DIRECTION = {
    1: ("c1", "c2"),
    -1: ("c3", "c4"),
}  # orifices of the spools of A and of B, by way
_MAX_STIFFNESS_REDUCTION, _MAX_STIFFNESS_INCREASE = (
    20.0,
    4.0,
)  # of the oil's stiffness or what is known, beyond which it is rigid
_FRICTION_FORCE_SHARE = 2e-2  # of a cylinder's force at the supply's pressure


@dataclass(frozen=True)
class CandidateParameter:
    """A number that may be fitted.

    Attributes:
        name: See `Unknown`.
        start: Where it begins.
        std: Standard deviation of what a file says of it.
        low: Least value.
        high: Largest.
    """

    name: str
    start: float
    std: float
    low: float = -np.inf
    high: float = np.inf


def candidate_parameters(
    machine: Machine, cases: Sequence[RecordingCase], parameters: Mapping[str, float]
) -> list[CandidateParameter]:
    """What recordings of a machine may tell.

    Args:
        machine: The machine.
        cases: Its recordings.
        parameters: Of the machine and its sensors by name.
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
                if len(directions) > 1:  # each has its own chamber
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
    """A positive number that a file knows to a share of itself, and by a factor at most."""
    return CandidateParameter(name, start, relative_std * start, start / factor, start * factor)


def _opening_directions(
    name: str, hydraulics: Hydraulics, cases: Sequence[RecordingCase]
) -> set[int]:
    """In which ways a spool is opened, 1 and -1."""
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
    if name.startswith("pressure_"):  # which hardly are late
        yield CandidateParameter(zero, parameters.get(zero, 0.0), _PRESSURE_ZERO_STD)
    else:
        yield CandidateParameter(delay, parameters.get(delay, 0.0), _DELAY_STD, 0.0, _MAX_DELAY)


def _spool_candidates(
    spool: Valve | Spool,
    parameters: Mapping[str, float],
    directions: set[int],
    orifice_slice: slice,
) -> Iterator[CandidateParameter]:
    """What moves a spool, and orifices that it opened."""
    name = f"valve.{spool.joint}" + ("" if isinstance(spool, Valve) else ".spool_b")
    stroke = abs(spool.full - spool.neutral)
    drift, dead = 0.02 * stroke, spool.dead_band
    if len(directions) == 2:  # else neutral and dead band cannot be told apart
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
    if cylinder.motor:  # which no boom is in series with
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
