"""What is left between recordings and the simulation of their inputs, and its derivatives."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from crane.common.errors import CraneError, InputError, SimulationError
from crane.common.samples import Array
from crane.description.sensors import SENSOR, SIGNAL, Sensor, with_numbers
from crane.formats.loading import Variants
from crane.identification.calibration.unknowns import FITTED, Unknown
from crane.machine import Machine
from crane.recordings.reading import Span, corrected
from crane.recordings.timeseries import TIME, Table, column
from crane.simulation.readings import read_off
from crane.simulation.replays import Inputs, inputs_of
from crane.simulation.run import simulate

_NUDGE, _LARGEST = 1e-3, 0.1  # of an unknown's scale, for differences
# Change of a reading, in the sizes of the channels, that differences aim at: far above what the
# steps of the simulation leave undetermined, and too small to bend.
_SEEN, _CLEAR = 0.02, 0.2
_FEWEST = 20  # instants of a recording
_SMOOTH = {"rad": 5e-3, "m": 2e-3}  # [rad/s], [m/s] over which friction changes its sign
_SHARPEST = 1e-2  # [s] of a step of the simulation at most
# What starts may be off by, one standard deviation, where nothing measures them: rad, m, rates.
_PLACE, _PACE = {"rad": 5e-3, "m": 5e-3}, {"rad": 0.01, "m": 5e-3}
_SURE = 2.0  # noises of a sensor that the start is off by, which is the mean of several samples
_LEAST = {"rad": 1e-4, "m": 1e-5, "Pa": 1e3}


@dataclass(frozen=True, eq=False)
class Case:
    """One recording.

    Attributes:
        name: Of its file.
        inputs: What drove the machine.
        clock: (N,) instants as the file has them [s].
        sensors: Columns that are compared.
        measured: (N, k) their readings.
        known: What was known of the recording's sensors.
        train: (N,) which instants are fitted, true or false.
        first: Where its start is among all unknowns.
        starts: (s,) standard deviations of the start's deviations: q_A, v_A, pressures A and B.
    """

    name: str
    inputs: Inputs
    clock: Array
    sensors: list[str]
    measured: Array
    known: Mapping[str, Sensor]
    train: NDArray[np.bool_]
    first: int = 0
    starts: Array = field(default_factory=lambda: np.zeros(0))


def case_of(
    machine: Machine,
    name: str,
    table: Table,
    known: Mapping[str, Sensor],
    sensors: list[str],
    window: Span,
) -> Case:
    """A recording of a machine, of which the instants within a window [s] are fitted.

    Args:
        machine: The machine.
        name: Of the file.
        table: Its readings.
        known: What is known of its sensors.
        sensors: Columns to compare.
        window: By the file's clock.

    Raises:
        RecordingError: See `inputs_of`.
        InputError: Too few instants, or nothing to compare.
    """
    # what starts is read off without delays, signals stay as they were logged
    at_once = {x: replace(s, delay=0.0) for x, s in known.items() if not x.startswith(SIGNAL)}
    inputs = inputs_of(machine, corrected(table, at_once))
    if not sensors:
        raise InputError(f"{name}: nothing of it can be compared with the machine")
    clock = column(table, TIME)
    after, until = clock >= window[0] - 1e-9, clock <= window[1] + 1e-9
    train = np.logical_and(after, until)
    if len(train) < _FEWEST:
        raise InputError(f"{name}: {len(train)} instants, give at least {_FEWEST}")
    measured = np.column_stack([column(table, x) for x in sensors])
    kinds = [machine.unit(joint) for joint in machine.active]
    starts: list[float] = []

    def near(name: str, unit: str, otherwise: float) -> float:
        if name not in table.units:
            return otherwise
        return max(_SURE * noise_of(column(table, name)), _LEAST[unit])

    if inputs.initial:
        pairs = zip(machine.active, kinds, strict=True)
        starts += [near(joint, kind, _PLACE[kind]) for joint, kind in pairs]
    if inputs.initial:  # what rests at first rests
        starts += [
            _PACE[kind] if v else 0.0 for kind, v in zip(kinds, inputs.initial[1], strict=True)
        ]
    for joint in inputs.pressures:
        starts += [near(f"pressure_{joint}_{side}", "Pa", 0.0) for side in "ab"]
    return Case(name, inputs, clock, sensors, measured, known, train, starts=np.array(starts))


def noise_of(x: Array) -> float:
    """Standard deviation of a channel's noise, by its third differences."""
    return float(np.sqrt(np.mean(np.diff(x, 3) ** 2) / 20.0))


class Problem:
    """Residuals over all unknowns z, each in its scale: fitted numbers, then starts.

    Args:
        machine: As it was loaded.
        unknowns: What is fitted.
        cases: Recordings.

    Attributes:
        smooth: Whether friction that sticks is smoothed, so that small changes do little: where
            and when something sticks depends on everything before.
    """

    def __init__(self, machine: Machine, unknowns: Sequence[Unknown], cases: Sequence[Case]):
        self.machine, self.unknowns = machine, list(unknowns)
        self._variants = Variants(machine)
        self.cases, count = [], len(self.unknowns)
        for case in cases:
            self.cases.append(replace(case, first=count))
            count += len(case.starts)
        self.size, self.runs = count, 0
        self._nudges = np.full(count, _NUDGE)
        self.smooth = False

    def widen(self, deviations: Array) -> None:
        """Take differences over standard deviations (p,), where these are small enough."""
        self._nudges = np.clip(deviations, 1e-6, _LARGEST)

    def values(self, z: Array) -> dict[str, float]:
        """Of the unknowns, by name."""
        return {
            unknown.name: unknown.start + unknown.scale * float(x)
            for unknown, x in zip(self.unknowns, z, strict=False)
        }

    def changes(self, z: Array) -> dict[str, float]:
        """Numbers of the machine and its sensors."""
        found: dict[str, float] = {}
        for unknown, value in zip(self.unknowns, self.values(z).values(), strict=True):
            found |= unknown.changes(value)
        return found

    def fitted(self, z: Array) -> Machine:
        """The machine and its sensors with these numbers."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return self._variants.machine(self.changes(z))

    def variant(self, z: Array) -> Machine:
        """The machine with these numbers, to be simulated."""
        changes = {x: value for x, value in self.changes(z).items() if not x.startswith(SENSOR)}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            made = self._variants.machine(changes) if changes else self.machine
        if not self.smooth:
            return made
        friction = {
            joint: replace(law, smoothing=_SMOOTH[made.unit(joint)]) if law.sticks else law
            for joint, law in made.friction.items()
        }
        return made.replace(friction=friction)

    def simulated(self, case: Case, z: Array, machine: Machine | None = None) -> CubicSpline:
        """Readings of a case's sensors over time, but for what is amiss with these.

        Raises:
            CraneError: The machine cannot be, or its simulation fails.
        """
        self.runs += 1
        inputs = self._started(case, z)
        machine = self.variant(z) if machine is None else machine
        time = inputs.time
        step = min(float(np.median(np.diff(time))), _SHARPEST)
        steps = int(np.ceil(time[-1] / step - 1e-9))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            run = simulate(machine, inputs.drive(machine), inputs.initial, steps * step, step)
        return CubicSpline(run.time, read_off(machine, run, case.sensors))

    def _started(self, case: Case, z: Array) -> Inputs:
        """Inputs with another start."""
        moved = case.starts * z[case.first : case.first + len(case.starts)]
        inputs, n = case.inputs, len(self.machine.active)
        values, signals = self.values(z), dict(inputs.signals)
        initial = inputs.initial
        if initial is not None:
            low, high = self.machine.lower, self.machine.upper
            places = [
                self._true(case, joint, float(x), values)
                for joint, x in zip(self.machine.active, initial[0], strict=True)
            ]
            place = np.clip(np.array(places) + moved[:n], low, high)
            initial = place, initial[1] + moved[n : 2 * n]
            moved = moved[2 * n :]
        for joint, x in inputs.signals.items():
            name = SIGNAL + joint
            signals[joint] = self._sensor(case, name, values).quantity(name, inputs.time, x)
        pairs = moved.reshape(-1, 2)
        pressures = {
            joint: (
                max(self._true(case, f"pressure_{joint}_a", a, values) + float(da), 0.0),
                max(self._true(case, f"pressure_{joint}_b", b, values) + float(db), 0.0),
            )
            for (joint, (a, b)), (da, db) in zip(inputs.pressures.items(), pairs, strict=True)
        }
        return replace(inputs, initial=initial, pressures=pressures, signals=signals)

    def _sensor(self, case: Case, name: str, values: Mapping[str, float]) -> Sensor:
        """With the numbers that are fitted."""
        known = case.known.get(name, Sensor())
        names = [f"{SENSOR}{name}.{what}" for what in FITTED]
        fitted = {x: values[x] for x in names if x in values}
        return with_numbers({name: known}, fitted)[name] if fitted else known

    def _true(self, case: Case, name: str, x: float, values: Mapping[str, float]) -> float:
        """What stands for a quantity x by what was known of its sensor, by what is known now."""
        reading = case.known.get(name, Sensor()).out(x)
        return self._sensor(case, name, values).into(reading)

    def _starts(self, name: str) -> bool:
        """Whether the start depends on a sensor."""
        return name in self.machine.active or name.startswith("pressure_")

    def _sensed(self, case: Case, curve: CubicSpline, z: Array) -> tuple[Array, dict[int, Array]]:
        """Readings (N, k) as sensors give them, and their slopes (N, k) by sensors' unknowns."""
        time, values = case.inputs.time, self.values(z)
        sensors = [self._sensor(case, name, values) for name in case.sensors]
        delays, scales, zeros = np.array([(s.delay, s.scale, s.zero) for s in sensors]).T
        plain = curve(time) if not delays.any() else np.empty((len(time), len(delays)))
        if delays.any():
            for k, delay in enumerate(delays):
                plain[:, k] = curve(np.maximum(time - delay, 0.0))[:, k]
        slopes: dict[int, Array] = {}
        for i, unknown in enumerate(self.unknowns):
            if unknown.sensor not in case.sensors:
                continue
            k, slope = case.sensors.index(unknown.sensor), np.zeros_like(plain)
            if unknown.what == "zero":
                slope[:, k] = 1.0
            elif unknown.what == "scale":
                slope[:, k] = plain[:, k]
            else:
                late = np.maximum(time - delays[k], 0.0)
                slope[:, k] = -scales[k] * curve.derivative()(late)[:, k] * (time > delays[k])
            slopes[i] = slope * unknown.scale
        return plain * scales + zeros, slopes

    def residuals(self, case: Case, z: Array) -> Array:
        """(N, k) simulated less measured.

        Raises:
            CraneError: See `simulated`.
        """
        return self._sensed(case, self.simulated(case, z), z)[0] - case.measured

    def linearized(self, case: Case, z: Array, sizes: Array) -> tuple[Array, Array]:
        """Residuals (N, k) and their derivatives (N, k, p), by differences from one side.

        Args:
            case: The recording.
            z: Unknowns.
            sizes: (k,) what matters in each channel.

        Raises:
            CraneError: See `simulated`.
        """
        machine = self.variant(z)
        curve = self.simulated(case, z, machine)
        here, slopes = self._sensed(case, curve, z)
        out = np.zeros((*here.shape, self.size))
        own = case.first + np.flatnonzero(case.starts)
        for i in (*range(len(self.unknowns)), *own.tolist()):
            sensor = self.unknowns[i].sensor if i < len(self.unknowns) else ""
            if sensor in case.sensors and not self._starts(sensor):
                out[:, :, i] = slopes.get(i, 0.0)
                continue
            change = self._difference(case, z, i, here, machine)
            nudge = self._nudges[i]
            seen = float(np.sqrt(np.mean((change * nudge / sizes)[case.train] ** 2)))
            if seen < _SEEN and nudge < _LARGEST:
                more = min(nudge * np.clip(_CLEAR / max(seen, 1e-12), 10.0, 1e3), _LARGEST)
                self._nudges[i] = more
                change = self._difference(case, z, i, here, machine)
            elif seen > 10 * _CLEAR:
                self._nudges[i] = max(nudge * _CLEAR / seen, 1e-6)
            if not np.isfinite(change).all():
                name = self.unknowns[i].name if i < len(self.unknowns) else "the start"
                raise SimulationError(f"{case.name}: the simulation is not smooth over {name}")
            out[:, :, i] = change
        return here - case.measured, out

    def _difference(self, case: Case, z: Array, i: int, here: Array, machine: Machine) -> Array:
        """Of one unknown, forwards, or backwards where it cannot go on."""
        starts = i >= len(self.unknowns)
        sides = (1.0, -1.0)
        if not starts:
            unknown = self.unknowns[i]
            if unknown.start + unknown.scale * (z[i] + self._nudges[i]) > unknown.high:
                sides = (-1.0, 1.0)
        nudge = self._nudges[i]
        for last, side in enumerate(sides):
            there = z.copy()
            there[i] += side * nudge
            try:
                curve = self.simulated(case, there, machine if starts else None)
            except CraneError:
                if last:
                    raise
                continue
            slope: Array = (self._sensed(case, curve, there)[0] - here) / (side * nudge)
            return slope
        raise AssertionError
