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
from crane.description.sensors import (
    SENSOR_PREFIX,
    VALVE_SIGNAL_PREFIX,
    Sensor,
    with_sensor_parameters,
)
from crane.dynamics import Dynamics
from crane.dynamics.joint_forces import find_stick_slip_columns
from crane.formats.machine_loading import MachineVariants
from crane.identification.calibration.unknowns import SENSOR_PARAMETER_DEFAULTS, Unknown
from crane.machine import Machine
from crane.recordings.recording_reader import FULL_TIME_SPAN, TimeSpan, correct_readings
from crane.recordings.timeseries import TIME, Table, table_column
from crane.simulation.recorded_run import read_simulation
from crane.simulation.recorded_run import record_run as recording_of
from crane.simulation.recording_replay import ReplayInputs, replay_inputs
from crane.simulation.sensitivity.rate_formulas import observed_frames
from crane.simulation.sensitivity.simulated_motion import SimulationProblem
from crane.simulation.sensitivity.simulation_constants import (
    SimulationConstants,
    simulation_constants_of,
)
from crane.simulation.sensitivity.variational_integration import integrate_sensitivities
from crane.simulation.simulation_run import simulate
from crane.simulation.simulation_setup import initial_motion

DERIVATIVE_TOLERANCE = 1e-4  # error of derivatives
_DIFFERENCE_STEP = 1e-5  # of an unknown's scale, for differences of the numbers of a simulation
_MIN_SAMPLES = 20  # instants of a recording
_FRICTION_SMOOTHING = {
    "rad": 5e-3,
    "m": 2e-3,
}  # [rad/s], [m/s] over which friction changes its sign
_MAX_STEP, _MAX_SENSITIVITY_STEP = (
    1e-2,
    2e-3,
)  # [s] of a step of a simulation, and with derivatives, at most
_NORMAL_MEDIAN = 0.6745  # median of the size of what has a normal distribution, in deviations
_MAX_CACHED_MACHINES = 100  # machines with numbers that were asked for last
# What starts may be off by, one standard deviation, where nothing measures them: rad, m, rates.
_START_POSITION_STD, _START_VELOCITY_STD = {"rad": 5e-3, "m": 5e-3}, {"rad": 0.01, "m": 5e-3}
_START_NOISE_FACTOR = (
    2.0  # noises of a sensor that the start is off by, which is the mean of several samples
)
_MIN_START_STD = {"rad": 1e-4, "m": 1e-5, "Pa": 1e3}


@dataclass(frozen=True, eq=False)
class RecordingCase:
    """One recording.

    Attributes:
        name: Of its file.
        inputs: What drove the machine.
        file_time: (N,) instants as the file has them [s].
        sensors: Columns that are compared.
        measured: (N, k) their readings.
        known_sensors: What was known of the recording's sensors.
        train_mask: (N,) which instants are fitted, true or false.
        table: As it was read.
        start_std: (s,) standard deviations of the start's deviations: q_A, v_A, pressures A and B.
        first_start_index: Where its start is among all unknowns.
    """

    name: str
    inputs: ReplayInputs
    file_time: Array
    sensors: list[str]
    measured: Array
    known_sensors: Mapping[str, Sensor]
    train_mask: NDArray[np.bool_]
    table: Table
    start_std: Array
    first_start_index: int = 0

    def split_training(self, machine: Machine, part_duration: float) -> list["RecordingCase"]:
        """Parts of what is fitted [s], each of which starts where it was measured.

        The way from one to the next is left open: this is multiple shooting whose gaps weigh
        nothing, for a search that is far from its end (Bock 1981).
        """
        time = self.inputs.time
        train_indices = np.flatnonzero(self.train_mask)
        span = time[train_indices[-1]] - time[train_indices[0]]
        count = int(min(span / part_duration, len(train_indices) / _MIN_SAMPLES))
        if count < 2:
            return []
        cases = []
        for indices in np.array_split(train_indices, count):
            table = Table(self.table.units, self.table.values[indices], self.table.notes)
            part = recording_case(
                machine, self.name, table, self.known_sensors, self.sensors, FULL_TIME_SPAN
            )
            # what comes late began before the part
            inputs = replace(
                part.inputs, signals=self.inputs.signals, signal_times=time - time[indices[0]]
            )
            cases.append(replace(part, inputs=inputs))
        return cases


def recording_case(
    machine: Machine,
    name: str,
    table: Table,
    known_sensors: Mapping[str, Sensor],
    sensors: list[str],
    window: TimeSpan,
) -> RecordingCase:
    """A recording of a machine, of which the instants within a window [s] are fitted.

    Args:
        machine: The machine.
        name: Of the file.
        table: Its readings.
        known_sensors: What is known of its sensors.
        sensors: Columns to compare.
        window: By the file's clock.

    Raises:
        RecordingError: See `replay_inputs`.
        InputError: Too few instants, or nothing to compare.
    """
    # what starts is read off without delays
    undelayed_sensors = {
        x: replace(s, delay=0.0)
        for x, s in known_sensors.items()
        if not x.startswith(VALVE_SIGNAL_PREFIX)
    }
    inputs = replay_inputs(machine, correct_readings(table, undelayed_sensors))
    if not sensors:
        raise InputError(f"{name}: nothing of it can be compared with the machine")
    file_time = table_column(table, TIME)
    after_start, before_end = file_time >= window[0] - 1e-9, file_time <= window[1] + 1e-9
    train_mask = np.logical_and(after_start, before_end)
    if len(train_mask) < _MIN_SAMPLES:
        raise InputError(f"{name}: {len(train_mask)} instants, give at least {_MIN_SAMPLES}")
    measured = np.column_stack([table_column(table, x) for x in sensors])
    joint_units = [machine.unit(joint) for joint in machine.active]
    start_std: list[float] = []

    def initial_std(name: str, unit: str, otherwise: float) -> float:
        if name not in table.units:
            return otherwise
        return max(
            _START_NOISE_FACTOR * noise_std(table_column(table, name)), _MIN_START_STD[unit]
        )

    if inputs.initial:
        pairs = zip(machine.active, joint_units, strict=True)
        start_std += [initial_std(joint, kind, _START_POSITION_STD[kind]) for joint, kind in pairs]
    if inputs.initial:  # what rests at first rests
        start_std += [
            _START_VELOCITY_STD[kind] if v else 0.0
            for kind, v in zip(joint_units, inputs.initial[1], strict=True)
        ]
    for joint in inputs.pressures:
        start_std += [initial_std(f"pressure_{joint}_{side}", "Pa", 0.0) for side in "ab"]
    return RecordingCase(
        name,
        inputs,
        file_time,
        sensors,
        measured,
        known_sensors,
        train_mask,
        table,
        np.array(start_std),
    )


def noise_std(x: Array) -> float:
    """Standard deviation of a channel's noise, by the median of its third differences.

    Which shocks do not change. By their mean square where half of them are zero, the readings
    having few digits.
    """
    differences = np.diff(x, 3)
    size = float(np.median(np.abs(differences))) / _NORMAL_MEDIAN or float(
        np.sqrt(np.mean(differences**2))
    )
    return size / np.sqrt(20.0)


class CalibrationProblem:
    """Residuals over all unknowns z, each in its scale: fitted numbers, then starts.

    Args:
        machine: As it was loaded.
        unknowns: What is fitted.
        cases: Recordings.

    Attributes:
        friction_smoothing: Over which share of a few millimetres per second friction that sticks
            is
            smoothed: where and when something sticks depends on everything before, and what a
                small
            change does then tells little of larger ones.
        min_derivative_smoothing: Share by which derivatives are smoothed at least.
        derivative_tolerance: Error of derivatives.
    """

    def __init__(
        self, machine: Machine, unknowns: Sequence[Unknown], cases: Sequence[RecordingCase]
    ):
        self.machine, self.unknowns = machine, list(unknowns)
        self._variants = MachineVariants(machine)
        self.cases, count = [], len(self.unknowns)
        for case in cases:
            self.cases.append(replace(case, first_start_index=count))
            count += len(case.start_std)
        self.unknown_count, self.simulation_count = count, 0
        self.smooth = self.slopes = 0.0
        self.derivative_tolerance = DERIVATIVE_TOLERANCE
        self._machine_cache: dict[tuple[float, ...], Machine] = {}

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

    def fitted_machine(self, z: Array) -> Machine:
        """The machine and its sensors with these numbers."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return self._variants.machine(self.changes(z))

    def simulated_machine(self, z: Array, friction_smoothing: float) -> Machine:
        """The machine with these numbers, to be simulated, its friction smoothed by a share."""
        changes = {
            x: value for x, value in self.changes(z).items() if not x.startswith(SENSOR_PREFIX)
        }
        key = friction_smoothing, *changes.values()
        if key not in self._machine_cache:
            if len(self._machine_cache) >= _MAX_CACHED_MACHINES:
                self._machine_cache.clear()
            self._machine_cache[key] = self._build_machine(changes, friction_smoothing)
        return self._machine_cache[key]

    def _build_machine(self, changes: Mapping[str, float], friction_smoothing: float) -> Machine:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            machine = self._variants.machine(changes) if changes else self.machine
        if not friction_smoothing:
            return machine
        friction = dict(machine.friction)
        for joint in (machine.joints[i] for i in find_stick_slip_columns(machine)):
            law = friction.get(joint, Friction())
            friction[joint] = replace(
                law, smoothing=friction_smoothing * _FRICTION_SMOOTHING[machine.unit(joint)]
            )
        return machine.replace(friction=friction)

    def simulate_readings(self, case: RecordingCase, z: Array, training_only: bool) -> CubicSpline:
        """Readings of a case's sensors over time, but for what is amiss with these.

        Args:
            case: The recording.
            z: Unknowns.
            training_only: Whether only up to the last instant that is fitted.

        Raises:
            CraneError: The machine cannot be, or its simulation fails.
        """
        self.simulation_count += 1
        inputs = self._inputs_with_start(case, z)
        machine = self.simulated_machine(z, self.smooth)
        step, steps = _step_size_and_count(case, _MAX_STEP, training_only)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            run = simulate(
                machine, inputs.valve_drive(machine), inputs.initial, steps * step, step
            )
        return CubicSpline(run.time, read_simulation(machine, run, case.sensors))

    def _inputs_with_start(self, case: RecordingCase, z: Array) -> ReplayInputs:
        """Inputs with another start."""
        start_changes = (
            case.start_std
            * z[case.first_start_index : case.first_start_index + len(case.start_std)]
        )
        inputs, n = case.inputs, len(self.machine.active)
        values = self.values(z)
        initial = inputs.initial
        if initial is not None:
            low, high = self.machine.lower, self.machine.upper
            positions = [
                self._corrected_quantity(case, joint, float(x), values)
                for joint, x in zip(self.machine.active, initial[0], strict=True)
            ]
            clipped_positions = np.clip(np.array(positions) + start_changes[:n], low, high)
            initial = clipped_positions, initial[1] + start_changes[n : 2 * n]
            start_changes = start_changes[2 * n :]
        signals = {
            name: self._fitted_sensor(case, VALVE_SIGNAL_PREFIX + name, values).apply(x)
            for name, x in inputs.signals.items()
        }
        pairs = start_changes.reshape(-1, 2)
        pressures = {
            joint: (
                max(
                    self._corrected_quantity(case, f"pressure_{joint}_a", a, values) + float(da),
                    0.0,
                ),
                max(
                    self._corrected_quantity(case, f"pressure_{joint}_b", b, values) + float(db),
                    0.0,
                ),
            )
            for (joint, (a, b)), (da, db) in zip(inputs.pressures.items(), pairs, strict=True)
        }
        return replace(inputs, initial=initial, pressures=pressures, signals=signals)

    def _fitted_sensor(
        self, case: RecordingCase, name: str, values: Mapping[str, float]
    ) -> Sensor:
        """With the numbers that are fitted."""
        known = case.known_sensors.get(name, Sensor())
        names = [f"{SENSOR_PREFIX}{name}.{what}" for what in SENSOR_PARAMETER_DEFAULTS]
        fitted_parameters = {x: values[x] for x in names if x in values}
        return (
            with_sensor_parameters({name: known}, fitted_parameters)[name]
            if fitted_parameters
            else known
        )

    def _corrected_quantity(
        self, case: RecordingCase, name: str, x: float, values: Mapping[str, float]
    ) -> float:
        """What stands for a quantity x by what was known of its sensor, by what is known now."""
        reading = case.known_sensors.get(name, Sensor()).apply(x)
        return self._fitted_sensor(case, name, values).invert(reading)

    def _start_depends_on(self, name: str) -> bool:
        """Whether the start depends on a sensor."""
        return name in self.machine.active or name.startswith("pressure_")

    def _sensor_readings(
        self, case: RecordingCase, curve: CubicSpline, z: Array
    ) -> tuple[Array, dict[int, Array]]:
        """Readings (N, k) as sensors give them, and their slopes (N, k) by sensors' unknowns."""
        time, values = case.inputs.time, self.values(z)
        sensors = [self._fitted_sensor(case, name, values) for name in case.sensors]
        delays, scales, zeros = np.array([(s.delay, s.scale, s.zero) for s in sensors]).T
        last = curve.x[-1]
        undistorted = np.empty((len(time), len(delays)))
        for k, delay in enumerate(delays):
            undistorted[:, k] = curve(np.clip(time - delay, 0.0, last))[:, k]
        min_derivative_smoothing: dict[int, Array] = {}
        for i, unknown in enumerate(self.unknowns):
            if unknown.sensor not in case.sensors:
                continue
            k, derivative = case.sensors.index(unknown.sensor), np.zeros_like(undistorted)
            if unknown.sensor_parameter == "zero":
                derivative[:, k] = 1.0
            elif unknown.sensor_parameter == "scale":
                derivative[:, k] = undistorted[:, k]
            else:
                delayed_time = np.clip(time - delays[k], 0.0, last)
                derivative[:, k] = (
                    -scales[k] * curve.derivative()(delayed_time)[:, k] * (time > delays[k])
                )
            min_derivative_smoothing[i] = derivative * unknown.scale
        return undistorted * scales + zeros, min_derivative_smoothing

    def residuals(self, case: RecordingCase, z: Array, training_only: bool = False) -> Array:
        """(N, k) simulated less measured.

        Args:
            case: The recording.
            z: Unknowns.
            training_only: Whether only up to the last instant that is fitted; what is behind it
                says nothing.

        Raises:
            CraneError: See `simulate_readings`.
        """
        return (
            self._sensor_readings(case, self.simulate_readings(case, z, training_only), z)[0]
            - case.measured
        )

    def linearize(
        self, case: RecordingCase, z: Array, fixed_unknowns: Set[int] = frozenset()
    ) -> tuple[Array, Array]:
        """Residuals (N, k) and their derivatives (N, k, p), see `crane.sensitivities`.

        Up to the last instant that is fitted.

        Args:
            case: The recording.
            z: Unknowns.
            fixed_unknowns: Indices of those whose derivatives are left 0.

        Raises:
            CraneError: See `simulate_readings`.
        """
        self.simulation_count += 1
        friction_smoothing = max(self.smooth, self.slopes)
        machine, inputs = (
            self.simulated_machine(z, friction_smoothing),
            self._inputs_with_start(case, z),
        )
        drive, dynamics = inputs.valve_drive(machine), Dynamics(machine)
        step, steps = _step_size_and_count(case, _MAX_SENSITIVITY_STEP, True)
        start_unknowns = case.first_start_index + np.flatnonzero(case.start_std)
        varied_unknowns = [i for i in range(len(self.unknowns)) if i not in fixed_unknowns]
        simulated_unknowns = [
            i for i in varied_unknowns if self._affects_simulation(case, self.unknowns[i].sensor)
        ]
        simulated_unknowns += start_unknowns.tolist()
        links = [link for link, _ in observed_frames(machine, case.sensors)]
        initial = initial_motion(machine, inputs.initial)

        def setup(times: Array) -> tuple[SimulationConstants, SimulationConstants]:
            base = simulation_constants_of(dynamics, drive, initial, links, times)
            every = [
                self._setup_derivative(case, z, i, friction_smoothing, base, links, times, machine)
                for i in simulated_unknowns
            ]
            return base, SimulationConstants(*(np.array(x) for x in zip(*every, strict=True)))

        motion = SimulationProblem(dynamics, drive, initial, steps, step)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            solution = integrate_sensitivities(
                motion,
                case.sensors,
                setup,
                np.ones(len(simulated_unknowns)),
                self.derivative_tolerance,
            )
            run = recording_of(machine, drive, solution.time, solution.parts, "")
        curve = CubicSpline(solution.time, read_simulation(machine, run, case.sensors))
        readings, sensor_derivatives = self._sensor_readings(case, curve, z)
        jacobian = np.zeros((*readings.shape, self.unknown_count))
        sensors = [self._fitted_sensor(case, name, self.values(z)) for name in case.sensors]
        sensitivity_curve, last = (
            CubicSpline(solution.time, solution.derivatives),
            solution.time[-1],
        )
        for k, sensor in enumerate(sensors):
            delayed_time = np.clip(case.inputs.time - sensor.delay, 0.0, last)
            jacobian[:, k, simulated_unknowns] = (
                sensor.scale * sensitivity_curve(delayed_time)[:, k]
            )
        for i in sensor_derivatives.keys() & set(varied_unknowns):
            jacobian[:, :, i] += sensor_derivatives[i]
        if friction_smoothing > self.smooth and find_stick_slip_columns(
            self.simulated_machine(z, self.smooth)
        ):
            return self.residuals(case, z, training_only=True), jacobian
        return readings - case.measured, jacobian

    def _affects_simulation(self, case: RecordingCase, sensor: str) -> bool:
        """Whether a number of the machine, "", or of a sensor changes the simulation."""
        return not sensor or sensor not in case.sensors or self._start_depends_on(sensor)

    def _setup_derivative(
        self,
        case: RecordingCase,
        z: Array,
        i: int,
        friction_smoothing: float,
        base: SimulationConstants,
        links: Sequence[str],
        times: Array,
        machine: Machine,
    ) -> SimulationConstants:
        """How the numbers of a simulation change with an unknown.

        By a difference of the numbers alone, which are smooth: backwards where it cannot go on.
        """
        is_start = i >= len(self.unknowns)
        sides = (1.0, -1.0)
        if not is_start:
            unknown = self.unknowns[i]
            if unknown.start + unknown.scale * (z[i] + _DIFFERENCE_STEP) > unknown.high:
                sides = (-1.0, 1.0)
        for last, side in enumerate(sides):
            perturbed = z.copy()
            perturbed[i] += side * _DIFFERENCE_STEP
            try:
                other = (
                    machine if is_start else self.simulated_machine(perturbed, friction_smoothing)
                )
                inputs = self._inputs_with_start(case, perturbed)
                initial = initial_motion(other, inputs.initial)
                dynamics, drive = Dynamics(other), inputs.valve_drive(other)
                found = simulation_constants_of(dynamics, drive, initial, links, times)
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
            return found.difference_quotient(base, side * _DIFFERENCE_STEP)
        raise AssertionError


def _step_size_and_count(
    case: RecordingCase, max_step: float, training_only: bool
) -> tuple[float, int]:
    """Length [s], at most some, and number of steps up to the last instant, or that is fitted."""
    time = case.inputs.time
    step = float(np.median(np.diff(time)))
    step /= np.ceil(step / max_step)
    last = time[case.train_mask][-1] if training_only else time[-1]
    return step, max(int(np.ceil(last / step - 1e-9)), 1)
