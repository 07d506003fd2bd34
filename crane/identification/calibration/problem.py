"""What is left between recordings and the simulation of their inputs, and its derivatives."""

import warnings
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from crane.common.errors import CraneError, InputError
from crane.common.samples import Array
from crane.description import Friction
from crane.description.sensors import SENSOR, SIGNAL, Sensor, with_numbers
from crane.dynamics import Dynamics
from crane.dynamics.joint_forces import sticking
from crane.formats.loading import Variants
from crane.identification.calibration.unknowns import FITTED, Unknown
from crane.machine import Machine
from crane.recordings.reading import ALWAYS, Span, corrected
from crane.recordings.timeseries import TIME, Table, column
from crane.simulation.readings import read_off
from crane.simulation.recorded import recorded as recording_of
from crane.simulation.replays import Inputs, inputs_of
from crane.simulation.run import simulate, start_of
from crane.simulation.sensitivity.follow import follow
from crane.simulation.sensitivity.rate import frames_of
from crane.simulation.sensitivity.setup import Setup, setup_of
from crane.simulation.sensitivity.track import Motion

ROUGH = 1e-4  # error of derivatives
_NUDGE = 1e-5  # of an unknown's scale, for differences of the numbers of a simulation
_FEWEST = 20  # instants of a recording
_SMOOTH = {"rad": 5e-3, "m": 2e-3}  # [rad/s], [m/s] over which friction changes its sign
_SHARPEST, _FINEST = 1e-2, 2e-3  # [s] of a step of a simulation, and with derivatives, at most
_NORMAL = 0.6745  # median of the size of what has a normal distribution, in deviations
_KEPT = 100  # machines with numbers that were asked for last
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
        table: As it was read.
        starts: (s,) standard deviations of the start's deviations: q_A, v_A, pressures A and B.
        first: Where its start is among all unknowns.
    """

    name: str
    inputs: Inputs
    clock: Array
    sensors: list[str]
    measured: Array
    known: Mapping[str, Sensor]
    train: NDArray[np.bool_]
    table: Table
    starts: Array
    first: int = 0

    def parts(self, machine: Machine, length: float) -> list["Case"]:
        """Parts of what is fitted [s], each of which starts where it was measured.

        The way from one to the next is left open: this is multiple shooting whose gaps weigh
        nothing, for a search that is far from its end (Bock 1981).
        """
        time = self.inputs.time
        fitted = np.flatnonzero(self.train)
        span = time[fitted[-1]] - time[fitted[0]]
        count = int(min(span / length, len(fitted) / _FEWEST))
        if count < 2:
            return []
        found = []
        for some in np.array_split(fitted, count):
            table = Table(self.table.units, self.table.values[some], self.table.notes)
            part = case_of(machine, self.name, table, self.known, self.sensors, ALWAYS)
            # what comes late began before the part
            inputs = replace(part.inputs, signals=self.inputs.signals, logged=time - time[some[0]])
            found.append(replace(part, inputs=inputs))
        return found


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
    # what starts is read off without delays
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
    return Case(name, inputs, clock, sensors, measured, known, train, table, np.array(starts))


def noise_of(x: Array) -> float:
    """Standard deviation of a channel's noise, by the median of its third differences.

    Which shocks do not change. By their mean square where half of them are zero, the readings
    having few digits.
    """
    jumps = np.diff(x, 3)
    size = float(np.median(np.abs(jumps))) / _NORMAL or float(np.sqrt(np.mean(jumps**2)))
    return size / np.sqrt(20.0)


class Problem:
    """Residuals over all unknowns z, each in its scale: fitted numbers, then starts.

    Args:
        machine: As it was loaded.
        unknowns: What is fitted.
        cases: Recordings.

    Attributes:
        smooth: Over which share of a few millimetres per second friction that sticks is smoothed:
            where and when something sticks depends on everything before, and what a small change
            does then tells little of larger ones.
        slopes: Share by which derivatives are smoothed at least.
        rough: Error of derivatives.
    """

    def __init__(self, machine: Machine, unknowns: Sequence[Unknown], cases: Sequence[Case]):
        self.machine, self.unknowns = machine, list(unknowns)
        self._variants = Variants(machine)
        self.cases, count = [], len(self.unknowns)
        for case in cases:
            self.cases.append(replace(case, first=count))
            count += len(case.starts)
        self.size, self.runs = count, 0
        self.smooth = self.slopes = 0.0
        self.rough = ROUGH
        self._made: dict[tuple[float, ...], Machine] = {}

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

    def variant(self, z: Array, smooth: float) -> Machine:
        """The machine with these numbers, to be simulated, its friction smoothed by a share."""
        changes = {x: value for x, value in self.changes(z).items() if not x.startswith(SENSOR)}
        key = smooth, *changes.values()
        if key not in self._made:
            if len(self._made) >= _KEPT:
                self._made.clear()
            self._made[key] = self._varied(changes, smooth)
        return self._made[key]

    def _varied(self, changes: Mapping[str, float], smooth: float) -> Machine:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            made = self._variants.machine(changes) if changes else self.machine
        if not smooth:
            return made
        friction = dict(made.friction)
        for joint in (made.joints[i] for i in sticking(made)):
            law = friction.get(joint, Friction())
            friction[joint] = replace(law, smoothing=smooth * _SMOOTH[made.unit(joint)])
        return made.replace(friction=friction)

    def simulated(self, case: Case, z: Array, fitted: bool) -> CubicSpline:
        """Readings of a case's sensors over time, but for what is amiss with these.

        Args:
            case: The recording.
            z: Unknowns.
            fitted: Whether only up to the last instant that is fitted.

        Raises:
            CraneError: The machine cannot be, or its simulation fails.
        """
        self.runs += 1
        inputs = self._started(case, z)
        machine = self.variant(z, self.smooth)
        step, steps = _steps(case, _SHARPEST, fitted)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            run = simulate(machine, inputs.drive(machine), inputs.initial, steps * step, step)
        return CubicSpline(run.time, read_off(machine, run, case.sensors))

    def _started(self, case: Case, z: Array) -> Inputs:
        """Inputs with another start."""
        moved = case.starts * z[case.first : case.first + len(case.starts)]
        inputs, n = case.inputs, len(self.machine.active)
        values = self.values(z)
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
        signals = {
            name: self._sensor(case, SIGNAL + name, values).out(x)
            for name, x in inputs.signals.items()
        }
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
        last = curve.x[-1]
        plain = np.empty((len(time), len(delays)))
        for k, delay in enumerate(delays):
            plain[:, k] = curve(np.clip(time - delay, 0.0, last))[:, k]
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
                late = np.clip(time - delays[k], 0.0, last)
                slope[:, k] = -scales[k] * curve.derivative()(late)[:, k] * (time > delays[k])
            slopes[i] = slope * unknown.scale
        return plain * scales + zeros, slopes

    def residuals(self, case: Case, z: Array, fitted: bool = False) -> Array:
        """(N, k) simulated less measured.

        Args:
            case: The recording.
            z: Unknowns.
            fitted: Whether only up to the last instant that is fitted; what is behind it says
                nothing.

        Raises:
            CraneError: See `simulated`.
        """
        return self._sensed(case, self.simulated(case, z, fitted), z)[0] - case.measured

    def linearized(
        self, case: Case, z: Array, fixed: Set[int] = frozenset()
    ) -> tuple[Array, Array]:
        """Residuals (N, k) and their derivatives (N, k, p), see `crane.sensitivities`.

        Up to the last instant that is fitted.

        Args:
            case: The recording.
            z: Unknowns.
            fixed: Indices of those whose derivatives are left 0.

        Raises:
            CraneError: See `simulated`.
        """
        self.runs += 1
        smooth = max(self.smooth, self.slopes)
        machine, inputs = self.variant(z, smooth), self._started(case, z)
        drive, dynamics = inputs.drive(machine), Dynamics(machine)
        step, steps = _steps(case, _FINEST, True)
        own = case.first + np.flatnonzero(case.starts)
        numbers = [i for i in range(len(self.unknowns)) if i not in fixed]
        moving = [i for i in numbers if self._acts(case, self.unknowns[i].sensor)]
        moving += own.tolist()
        links = [link for link, _ in frames_of(machine, case.sensors)]
        initial = start_of(machine, inputs.initial)

        def setup(times: Array) -> tuple[Setup, Setup]:
            base = setup_of(dynamics, drive, initial, links, times)
            every = [
                self._direction(case, z, i, smooth, base, links, times, machine) for i in moving
            ]
            return base, Setup(*(np.array(x) for x in zip(*every, strict=True)))

        motion = Motion(dynamics, drive, initial, steps, step)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = follow(motion, case.sensors, setup, np.ones(len(moving)), self.rough)
            run = recording_of(machine, drive, found.time, found.parts, "")
        curve = CubicSpline(found.time, read_off(machine, run, case.sensors))
        here, slopes = self._sensed(case, curve, z)
        out = np.zeros((*here.shape, self.size))
        sensors = [self._sensor(case, name, self.values(z)) for name in case.sensors]
        changes, last = CubicSpline(found.time, found.slopes), found.time[-1]
        for k, sensor in enumerate(sensors):
            late = np.clip(case.inputs.time - sensor.delay, 0.0, last)
            out[:, k, moving] = sensor.scale * changes(late)[:, k]
        for i in slopes.keys() & set(numbers):
            out[:, :, i] += slopes[i]
        if smooth > self.smooth and sticking(self.variant(z, self.smooth)):
            return self.residuals(case, z, fitted=True), out
        return here - case.measured, out

    def _acts(self, case: Case, sensor: str) -> bool:
        """Whether a number of the machine, "", or of a sensor changes the simulation."""
        return not sensor or sensor not in case.sensors or self._starts(sensor)

    def _direction(
        self,
        case: Case,
        z: Array,
        i: int,
        smooth: float,
        base: Setup,
        links: Sequence[str],
        times: Array,
        machine: Machine,
    ) -> Setup:
        """How the numbers of a simulation change with an unknown.

        By a difference of the numbers alone, which are smooth: backwards where it cannot go on.
        """
        starts = i >= len(self.unknowns)
        sides = (1.0, -1.0)
        if not starts:
            unknown = self.unknowns[i]
            if unknown.start + unknown.scale * (z[i] + _NUDGE) > unknown.high:
                sides = (-1.0, 1.0)
        for last, side in enumerate(sides):
            there = z.copy()
            there[i] += side * _NUDGE
            try:
                other = machine if starts else self.variant(there, smooth)
                inputs = self._started(case, there)
                initial = start_of(other, inputs.initial)
                dynamics, drive = Dynamics(other), inputs.drive(other)
                found = setup_of(dynamics, drive, initial, links, times)
            except CraneError:
                if last:
                    raise
                continue
            if any(np.shape(one) != np.shape(two) for one, two in zip(found, base, strict=True)):
                unknown = self.unknowns[i]
                raise InputError(
                    f"'{unknown.name}' cannot be varied about "
                    f"{unknown.start + unknown.scale * z[i]:g}, where the machine has other "
                    "equations: begin it elsewhere"
                )
            return found.difference(base, side * _NUDGE)
        raise AssertionError


def _steps(case: Case, longest: float, fitted: bool) -> tuple[float, int]:
    """Length [s], at most some, and number of steps up to the last instant, or that is fitted."""
    time = case.inputs.time
    step = float(np.median(np.diff(time)))
    step /= np.ceil(step / longest)
    last = time[case.train][-1] if fitted else time[-1]
    return step, max(int(np.ceil(last / step - 1e-9)), 1)
