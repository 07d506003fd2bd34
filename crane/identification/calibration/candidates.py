"""Numbers that recordings may tell, and how far files are usually off."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from crane.description.sensors import INCLINATION, SENSOR
from crane.hydraulics import Hydraulics, Spool, Valve
from crane.identification.calibration.problem import Case
from crane.machine import Machine

_MOVED = 0.05  # of a spool's stroke, by which a valve is opened
_SLOW, _FAST = 5.0, 200.0  # of spools [1/s]
_LATE, _LATEST = 0.1, 0.6  # [s] of signals
_TILTED = 0.05  # [rad] that inclinometers are mounted off
_PRESSED = 2e5  # [Pa] that pressure sensors are off
_GAS = 5e-3  # of a chamber's volume
_LEAKED = 1e-2  # of a valve's full flow at the supply's pressure
_OPEN = {1: ("c1", "c2"), -1: ("c3", "c4")}  # orifices of the spools of A and of B, by way
_SOFT, _STIFF = 20.0, 4.0  # of the oil's stiffness or what is known, beyond which it is rigid
_BRAKED = 2e-2  # of a cylinder's force at the supply's pressure


@dataclass(frozen=True)
class Candidate:
    """A number that may be fitted.

    Attributes:
        name: See `Unknown`.
        start: Where it begins.
        deviation: Standard deviation of what a file says of it.
        low: Least value.
        high: Largest.
    """

    name: str
    start: float
    deviation: float
    low: float = -np.inf
    high: float = np.inf


def candidates(
    machine: Machine, cases: Sequence[Case], numbers: Mapping[str, float]
) -> list[Candidate]:
    """What recordings of a machine may tell.

    Args:
        machine: The machine.
        cases: Its recordings.
        numbers: Of the machine and its sensors by name.
    """
    found: list[Candidate] = []
    for sensor in dict.fromkeys(name for case in cases for name in case.sensors):
        found += _of_sensor(sensor, numbers)
    hydraulics = machine.hydraulics
    if hydraulics is None:
        return found
    for joint, valve in hydraulics.valves.items():
        ways = {name: _ways(name, hydraulics, cases) for name in valve.spools}
        for name, spool in valve.spools.items():
            if ways[name]:
                edges = slice(None)
                if len(ways) > 1:  # each has its own chamber
                    edges = slice(0, 1) if spool is valve else slice(1, 2)
                found += _of_spool(spool, numbers, ways[name], edges)
        if any(ways.values()):
            found += _of_cylinder(joint, machine, hydraulics, numbers)
    if numbers.get("payload.mass", 0.0):
        found.append(_scaled("payload.mass", numbers["payload.mass"], 0.5, 3.0))
    found.append(_scaled("oil.bulk_modulus", hydraulics.oil.bulk_modulus, 0.5, 5.0))
    return found


def _scaled(name: str, start: float, share: float, most: float) -> Candidate:
    """A positive number that a file knows to a share of itself, and by a factor at most."""
    return Candidate(name, start, share * start, start / most, start * most)


def _ways(name: str, hydraulics: Hydraulics, cases: Sequence[Case]) -> set[int]:
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
    return {way for way, most in ((1, u.max()), (-1, -u.min())) if most > _MOVED}


def _of_sensor(name: str, numbers: Mapping[str, float]) -> Iterator[Candidate]:
    zero, delay = (f"{SENSOR}{name}.{what}" for what in ("zero", "delay"))
    if name.startswith(INCLINATION):
        yield Candidate(zero, numbers.get(zero, 0.0), _TILTED)
    if name.startswith("pressure_"):  # which hardly are late
        yield Candidate(zero, numbers.get(zero, 0.0), _PRESSED)
    else:
        yield Candidate(delay, numbers.get(delay, 0.0), _LATE, 0.0, _LATEST)


def _of_spool(
    spool: Valve | Spool, numbers: Mapping[str, float], ways: set[int], edges: slice
) -> Iterator[Candidate]:
    """What moves a spool, and orifices that it opened."""
    name = f"valve.{spool.joint}" + ("" if isinstance(spool, Valve) else ".spool_b")
    stroke = abs(spool.full - spool.neutral)
    drift, dead = 0.02 * stroke, spool.dead_band
    if len(ways) == 2:  # else neutral and dead band cannot be told apart
        least, most = spool.neutral - 3.0 * drift, spool.neutral + 3.0 * drift
        yield Candidate(f"{name}.neutral", spool.neutral, drift, least, most)
    yield Candidate(f"{name}.dead_band", dead, 0.05, max(dead - 0.15, 0.0), dead + 0.15)
    for orifice in (x for way in sorted(ways, reverse=True) for x in _OPEN[way][edges]):
        one = f"valve.{spool.joint}.{orifice}"
        if numbers[one]:
            yield _scaled(one, numbers[one], 0.3, 2.5)
    if spool.bandwidth:
        low, high = min(spool.bandwidth, _SLOW), max(spool.bandwidth, _FAST)
        yield Candidate(f"{name}.bandwidth", spool.bandwidth, spool.bandwidth, low, high)
    late = spool.delay
    yield Candidate(f"{name}.delay", late, _LATE, 0.0, max(late, _LATEST))


def _of_cylinder(
    joint: str, machine: Machine, hydraulics: Hydraulics, numbers: Mapping[str, float]
) -> Iterator[Candidate]:
    cylinder, valve = hydraulics.cylinders[joint], hydraulics.valves[joint]
    pressure = hydraulics.supply.pressure
    at = machine.active.index(joint)
    stroke = 0.0 if cylinder.motor else float(machine.upper[at] - machine.lower[at])
    brake = _BRAKED * pressure * cylinder.area_a
    pace = valve.c1 * np.sqrt(pressure) / cylinder.area_a
    for what, size in (("coulomb", brake), ("viscous", brake / pace)):
        name = f"friction.{joint}.{what}"
        if name in numbers:
            start = numbers[name]
            deviation = max(3.0 * start, size)
            yield Candidate(name, start, deviation, 0.0, start + 5.0 * deviation)
    volumes = (
        cylinder.area_a * stroke + cylinder.hose_a,
        cylinder.area_b * stroke + cylinder.hose_b,
    )
    leak = _LEAKED * valve.c1 / np.sqrt(pressure)
    for side, volume in zip("ab", volumes, strict=True):
        hose = f"cylinder.{joint}.hose_{side}"
        yield _scaled(hose, numbers[hose], 0.5, 3.0)
        for what, size in (("gas", _GAS * volume), ("leakage", leak)):
            name = f"cylinder.{joint}.{what}_{side}"
            start = numbers[name]
            yield Candidate(name, start, max(start, size), 0.0)
    name = f"cylinder.{joint}.leakage"
    yield Candidate(name, numbers[name], max(numbers[name], leak), 0.0)
    if cylinder.motor:  # which no boom is in series with
        return
    oil = hydraulics.oil.bulk_modulus
    spring = sum(
        oil * area**2 / volume
        for area, volume in zip((cylinder.area_a, cylinder.area_b), volumes, strict=True)
    )
    name = f"cylinder.{joint}.stiffness"
    start = numbers[name] or spring
    yield Candidate(name, start, start, start / _SOFT, start * _STIFF)
    name = f"cylinder.{joint}.damping"
    yield _scaled(name, numbers[name], 1.0, 20.0)
