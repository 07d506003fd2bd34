"""Residuals between recordings and simulations of their inputs, and their derivatives."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.interpolate import CubicSpline

from crane.common.errors import CraneError, InputError
from crane.common.samples import Array
from crane.description.force_elements import Friction
from crane.description.sensors import (
    SENSOR_PREFIX,
    VALVE_SIGNAL_PREFIX,
    Sensor,
    with_sensor_parameters,
)
from crane.dynamics.dynamics import Dynamics
from crane.dynamics.joint_forces import find_stick_slip_columns
from crane.formats.machine_loading import MachineVariants
from crane.identification.calibration.recording_case import RecordingCase
from crane.identification.calibration.unknowns import SENSOR_PARAMETER_DEFAULTS, Unknown
from crane.machine.machine import Machine
from crane.simulation.recorded_run import read_simulation
from crane.simulation.recorded_run import record_run as recording_of
from crane.simulation.recording_replay import ReplayInputs
from crane.simulation.sensitivity.rate_formulas import observed_frames
from crane.simulation.sensitivity.simulated_motion import SimulatedMotion
from crane.simulation.sensitivity.simulation_constants import (
    SimulationConstants,
    simulation_constants_of,
)
from crane.simulation.sensitivity.variational_integration import VariationalIntegrator
from crane.simulation.simulation_run import simulate
from crane.simulation.simulation_setup import initial_motion

DERIVATIVE_TOLERANCE = 1e-4  # relative error of derivatives
_DIFFERENCE_STEP = 1e-5  # of the scale of an unknown, for differences of simulation constants
# [rad/s], [m/s] over which smoothed friction changes its sign
_FRICTION_SMOOTHING = {"rad": 5e-3, "m": 2e-3}
# largest steps [s] of a simulation, of one with derivatives, and with coarse ones
_MAX_STEP, _MAX_SENSITIVITY_STEP, _MAX_COARSE_STEP = 1e-2, 2e-3, 5e-3
# machines with changed parameters, and residuals at the last unknowns, that are kept
_MAX_CACHED_MACHINES, _MAX_CACHED_RESIDUALS = 100, 8


class CalibrationProblem:
    """Residuals as functions of the scaled unknowns z: parameters, then starts of recordings.

    Args:
        machine: The machine before the calibration.
        unknowns: Unknown parameters.
        cases: The recordings.

    Attributes:
        smooth: Smoothing of friction with stiction, relative to some millimetres per second. The
            instants of sticking depend on the whole motion before, so derivatives without
            smoothing are valid for small changes only.
        slopes: Least smoothing for derivatives, likewise.
        derivative_tolerance: Relative error of derivatives.
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
        self.unknown_count = count
        self.smooth = self.slopes = 0.0
        self.derivative_tolerance = DERIVATIVE_TOLERANCE
        # keep their last results, by their arguments
        self._changed_machine = lru_cache(_MAX_CACHED_MACHINES)(self._build_machine)
        self._recent_residuals = lru_cache(_MAX_CACHED_RESIDUALS)(self._simulate_residuals)

    def variant(
        self, unknowns: Sequence[Unknown], cases: Sequence[RecordingCase] | None = None
    ) -> "CalibrationProblem":
        """The problem with other unknowns or recordings, smoothed like this one."""
        problem = CalibrationProblem(self.machine, unknowns, cases or self.cases)
        problem.smooth, problem.slopes, problem.derivative_tolerance = (
            self.smooth, self.slopes, self.derivative_tolerance,
        )  # fmt: skip
        return problem

    def values(self, z: Array) -> dict[str, float]:
        """Values of the unknown parameters by name."""
        return {
            unknown.name: unknown.start + unknown.scale * float(x)
            for unknown, x in zip(self.unknowns, z, strict=False)
        }

    def changes(self, z: Array) -> dict[str, float]:
        """Changed parameters of the machine and its sensors by name."""
        found: dict[str, float] = {}
        for unknown, value in zip(self.unknowns, self.values(z).values(), strict=True):
            found |= unknown.changes(value)
        return found

    def simulated_machine(self, z: Array, friction_smoothing: float) -> Machine:
        """The machine for simulation, with changed parameters and smoothed friction."""
        changes = self.changes(z).items()
        return self._changed_machine(
            friction_smoothing, *(x for x in changes if not x[0].startswith(SENSOR_PREFIX))
        )

    def _build_machine(self, friction_smoothing: float, *changes: tuple[str, float]) -> Machine:
        with warnings.catch_warnings(action="ignore"):
            machine = self._variants.machine(dict(changes)) if changes else self.machine
        if friction_smoothing:
            friction = dict(machine.friction)
            for joint in (machine.joints[i] for i in find_stick_slip_columns(machine)):
                width = friction_smoothing * _FRICTION_SMOOTHING[machine.unit(joint)]
                friction[joint] = replace(friction.get(joint, Friction()), smoothing=width)
            machine = machine.replace(friction=friction)
        return machine

    def simulate_readings(self, case: RecordingCase, z: Array, training_only: bool) -> CubicSpline:
        """Simulated ideal readings of a recording's sensors over time.

        Args:
            case: The recording.
            z: Unknowns.
            training_only: Whether to stop at the last training instant.

        Raises:
            CraneError: The machine is not valid, or its simulation fails.
        """
        inputs = self._inputs_with_start(case, z)
        machine = self.simulated_machine(z, self.smooth)
        step, steps = _step_size_and_count(case, _MAX_STEP, training_only)
        with warnings.catch_warnings(action="ignore"):
            run = simulate(
                machine, inputs.valve_drive(machine), inputs.initial, steps * step, step
            )
        return CubicSpline(run.time, read_simulation(machine, run, case.sensors))

    def _inputs_with_start(self, case: RecordingCase, z: Array) -> ReplayInputs:
        """Inputs with the start and the sensors of the unknowns."""
        start = slice(case.first_start_index, case.first_start_index + len(case.start_std))
        start_changes = case.start_std * z[start]
        inputs, n, values = case.inputs, len(self.machine.active), self.values(z)
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

        def pressure(name: str, measured: float, change: float) -> float:
            corrected = self._corrected_quantity(case, f"pressure_{name}", measured, values)
            return max(corrected + change, 0.0)

        pairs = start_changes.reshape(-1, 2).tolist()
        pressures = {
            joint: (pressure(f"{joint}_a", a, da), pressure(f"{joint}_b", b, db))
            for (joint, (a, b)), (da, db) in zip(inputs.pressures.items(), pairs, strict=True)
        }
        return replace(inputs, initial=initial, pressures=pressures, signals=signals)

    def _fitted_sensor(
        self, case: RecordingCase, name: str, values: Mapping[str, float]
    ) -> Sensor:
        known = case.known_sensors.get(name, Sensor())
        names = [f"{SENSOR_PREFIX}{name}.{what}" for what in SENSOR_PARAMETER_DEFAULTS]
        fitted = {x: values[x] for x in names if x in values}
        return with_sensor_parameters({name: known}, fitted)[name] if fitted else known

    def _corrected_quantity(
        self, case: RecordingCase, name: str, x: float, values: Mapping[str, float]
    ) -> float:
        """Quantity x, corrected from the known sensor to the fitted one."""
        reading = case.known_sensors.get(name, Sensor()).apply(x)
        return self._fitted_sensor(case, name, values).invert(reading)

    def _sensor_readings(
        self, case: RecordingCase, curve: CubicSpline, z: Array
    ) -> tuple[Array, dict[int, Array]]:
        """Readings (N, k) of the fitted sensors, and derivatives (N, k) by sensor unknowns."""
        time, values = case.inputs.time, self.values(z)
        sensors = [self._fitted_sensor(case, name, values) for name in case.sensors]
        delays, scales, zeros = np.array([(s.delay, s.scale, s.zero) for s in sensors]).T
        last = curve.x[-1]
        undistorted = np.empty((len(time), len(delays)))
        for k, delay in enumerate(delays):
            undistorted[:, k] = curve(np.clip(time - delay, 0.0, last))[:, k]
        derivatives: dict[int, Array] = {}
        for i, unknown in enumerate(self.unknowns):
            if unknown.sensor not in case.sensors:
                continue
            k, derivative = case.sensors.index(unknown.sensor), np.zeros_like(undistorted)
            if unknown.sensor_parameter == "zero":
                derivative[:, k] = 1.0
            if unknown.sensor_parameter == "scale":
                derivative[:, k] = undistorted[:, k]
            if unknown.sensor_parameter == "delay":
                delayed_time = np.clip(time - delays[k], 0.0, last)
                derivative[:, k] = (
                    -scales[k] * curve.derivative()(delayed_time)[:, k] * (time > delays[k])
                )
            derivatives[i] = derivative * unknown.scale
        return undistorted * scales + zeros, derivatives

    def residuals(self, case: RecordingCase, z: Array, training_only: bool = False) -> Array:
        """Residuals (N, k): simulated minus measured readings.

        Args:
            case: The recording.
            z: Unknowns.
            training_only: Whether to stop at the last training instant; later residuals are
                invalid.

        Raises:
            CraneError: See `simulate_readings`.
        """
        ends_early = training_only and not case.train_mask[-1]
        return self._recent_residuals(case, tuple(z.tolist()), self.smooth, ends_early)

    def _simulate_residuals(
        self, case: RecordingCase, unknowns: tuple[float, ...], _smooth: float, ends_early: bool
    ) -> Array:
        z = np.array(unknowns)
        curve = self.simulate_readings(case, z, ends_early)
        return self._sensor_readings(case, curve, z)[0] - case.measured

    def linearize(self, case: RecordingCase, z: Array) -> tuple[Array, Array]:
        """Residuals (N, k) and their derivatives (N, k, p), see `crane.sensitivities`.

        They are valid up to the last training instant.

        Args:
            case: The recording.
            z: Unknowns.

        Raises:
            CraneError: See `simulate_readings`.
        """
        friction_smoothing = max(self.smooth, self.slopes)
        machine = self.simulated_machine(z, friction_smoothing)
        inputs = self._inputs_with_start(case, z)
        drive, dynamics = inputs.valve_drive(machine), Dynamics(machine)
        is_coarse = self.derivative_tolerance > DERIVATIVE_TOLERANCE
        largest_step = _MAX_COARSE_STEP if is_coarse else _MAX_SENSITIVITY_STEP
        step, steps = _step_size_and_count(case, largest_step, True)
        start_unknowns = case.first_start_index + np.flatnonzero(case.start_std)
        # compared sensors affect the simulation only if its start depends on them
        output_sensors = {
            x for x in case.sensors if x not in machine.active and not x.startswith("pressure_")
        }
        simulated_unknowns = [
            i for i, x in enumerate(self.unknowns) if x.sensor not in output_sensors
        ]
        simulated_unknowns += start_unknowns.tolist()
        links = [link for link, _ in observed_frames(machine, case.sensors)]
        initial = initial_motion(machine, inputs.initial)

        with warnings.catch_warnings(action="ignore"):
            motion = SimulatedMotion(dynamics, drive, initial, steps, step)
            q = machine.closure.solve(initial[0], initial_guess=machine.home)
            constants = simulation_constants_of(dynamics, drive, initial, links, motion.time, q)
            setup = (friction_smoothing, constants, links, motion.time, dynamics, q)
            every = [self._setup_derivative(case, z, i, *setup) for i in simulated_unknowns]
            integrator = VariationalIntegrator(
                motion,
                case.sensors,
                constants,
                SimulationConstants(*(np.array(x) for x in zip(*every, strict=True))),
                np.ones(len(simulated_unknowns)),
                self.derivative_tolerance,
            )
            derivatives, run_time = integrator.integrate(), motion.time[::2]
            run = recording_of(machine, drive, run_time, motion.parts, "")
        curve = CubicSpline(run_time, read_simulation(machine, run, case.sensors))
        readings, sensor_derivatives = self._sensor_readings(case, curve, z)
        jacobian = np.zeros((*readings.shape, self.unknown_count))
        sensitivity_curve = CubicSpline(run_time, derivatives)
        for k, name in enumerate(case.sensors):
            sensor = self._fitted_sensor(case, name, self.values(z))
            delayed_time = np.clip(case.inputs.time - sensor.delay, 0.0, run_time[-1])
            jacobian[:, k, simulated_unknowns] = (
                sensor.scale * sensitivity_curve(delayed_time)[:, k]
            )
        for i, derivative in sensor_derivatives.items():
            jacobian[:, :, i] += derivative
        if friction_smoothing > self.smooth and find_stick_slip_columns(
            self.simulated_machine(z, self.smooth)
        ):
            return self.residuals(case, z, training_only=True), jacobian
        return readings - case.measured, jacobian

    def _setup_derivative(
        self,
        case: RecordingCase,
        z: Array,
        i: int,
        friction_smoothing: float,
        base: SimulationConstants,
        links: Sequence[str],
        times: Array,
        nominal_dynamics: Dynamics,
        start: Array,
    ) -> SimulationConstants:
        """Derivative of the simulation constants by an unknown.

        It is a difference quotient of the constants, which are smooth, backwards at a bound.
        """
        unknown = self.unknowns[i] if i < len(self.unknowns) else None
        reaches_bound = unknown is not None and (
            unknown.start + unknown.scale * (z[i] + _DIFFERENCE_STEP) > unknown.high
        )
        sides = (-1.0, 1.0) if reaches_bound else (1.0, -1.0)
        for last, side in enumerate(sides):
            perturbed = z.copy()
            perturbed[i] += side * _DIFFERENCE_STEP
            try:
                other = self.simulated_machine(perturbed, friction_smoothing)
                inputs = self._inputs_with_start(case, perturbed)
                is_nominal = other is nominal_dynamics.machine
                dynamics = nominal_dynamics if is_nominal else Dynamics(other)
                drive, initial = inputs.valve_drive(other), initial_motion(other, inputs.initial)
                found = simulation_constants_of(dynamics, drive, initial, links, times, start)
            except CraneError:
                if last:
                    raise
                continue
            if any(np.shape(one) != np.shape(two) for one, two in zip(found, base, strict=True)):
                unknown = self.unknowns[i]
                raise InputError(
                    f"'{unknown.name}' cannot be varied about "
                    f"{unknown.start + unknown.scale * z[i]:g}, where the machine has other "
                    "equations: choose another start"
                )
            return found.difference_quotient(base, side * _DIFFERENCE_STEP)
        raise AssertionError


def _step_size_and_count(
    case: RecordingCase, max_step: float, training_only: bool
) -> tuple[float, int]:
    """Step size [s] and number of steps up to the last instant, or the last training instant."""
    time = case.inputs.time
    step = float(np.median(np.diff(time)))
    step /= np.ceil(step / max_step)
    last = time[case.train_mask][-1] if training_only else time[-1]
    return step, max(int(np.ceil(last / step - 1e-9)), 1)
