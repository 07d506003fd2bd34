"""Recordings with valve signals: Fisher information about parameters, and limits."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from crane.common.errors import InputError, check_name
from crane.common.samples import Array, as_number
from crane.control.valve_commands import ValveSignals, require_circuit
from crane.description.sensors import INCLINATION_PREFIX, VALVE_SIGNAL_PREFIX, VELOCITY_SUFFIX
from crane.dynamics.joint_forces import find_stick_slip_columns
from crane.formats.machine_loading import MachineVariants
from crane.identification.calibration.calibration_problem import CalibrationProblem
from crane.identification.calibration.recording_case import RecordingCase, recording_case
from crane.identification.calibration.unknowns import build_unknowns
from crane.identification.excitation.fisher_information import (
    InformationMeasures,
    information_measures,
)
from crane.machine.machine import Machine
from crane.recordings.recording import Recording
from crane.recordings.timeseries import TIME, Table
from crane.simulation.recorded_run import read_simulation, simulated_columns, simulated_units
from crane.simulation.simulation_run import simulate

# standard deviations of usual sensors, by unit
_DEFAULT_NOISE = {"rad": 1e-3, "m": 5e-4, "rad/s": 5e-3, "m/s": 2e-3, "Pa": 3e4}
_DEFAULT_DEVIATION = 0.3  # relative deviation of a parameter without bounds
# [s] before the end, and share of the largest speed that counts as rest
_FINAL_DURATION, _REST_SPEED_SHARE = 0.5, 0.1
_MIN_SENSITIVITY = 1e-6  # change of all readings per scale of a parameter, in standard deviations


class SignalInformation:
    """Fisher information of recordings about the parameters p of `crane.calibrate`.

    Readings y with white noise sigma depend on the scaled parameters p and on the start s of the
    recording, in units of its prior standard deviations:

        M = J_p^T (1 - J_s (J_s^T J_s + 1)^-1 J_s^T) J_p,    J = sigma^-1 dy/d(p, s),

    The inverse of M is the covariance of the best fit. With [J_s J_p; 1 0] = Q R, the rows of R
    that belong to p alone are a root of M.

    Args:
        machine: The machine.
        fit: Parameters by name, see `crane.calibrate`.
        sensors: Measured columns; default the valve-driven joints and their pressures.
        noise: Standard deviations by column; default those of usual sensors.
        seed: Seed of the noise of virtual recordings, which only affects the prior of starts.

    Attributes:
        machine: The machine with the initial parameters.
        units: Units of the sensors by column.
        noise: (k,) standard deviations of the sensors.
        unknowns: See `crane.identification.calibration.unknowns.Unknown`.

    Raises:
        InputError: Names are not valid, or the noise of a sensor is unknown.
        RecordingError: An inclination has no link.

    Source: Ljung 1999, System Identification, section 7.4.
    """

    def __init__(
        self,
        machine: Machine,
        fit: Mapping[str, object] | Sequence[str],
        sensors: Sequence[str] | None,
        noise: Mapping[str, float] | None,
        seed: int,
    ):
        self.machine, self._seed = machine, seed
        joints = require_circuit(machine).joints
        default_sensors = [
            *joints,
            *(f"pressure_{joint}_{side}" for joint in joints for side in "ab"),
        ]
        available_units = simulated_units(machine)
        self.units: dict[str, str] = {}
        for name in default_sensors if sensors is None else sensors:
            unit = "rad/s" if name.endswith(VELOCITY_SUFFIX) else "rad"
            if not name.startswith(INCLINATION_PREFIX):
                check_name(name, available_units, f"'{name}' cannot be compared")
                unit = available_units[name]
            self.units[name] = unit
        if not self.units:
            raise InputError(f"no sensor is named, choose among {', '.join(available_units)}")
        given = {x: y.noise for x, y in machine.sensors.items() if y.noise and x in self.units}
        given |= noise or {}
        for name in given:
            check_name(name, self.units, f"noise of '{name}', which is not measured")
        noise_std = []
        for name, unit in self.units.items():
            if name not in given and unit not in _DEFAULT_NOISE:
                raise InputError(
                    f"noise of '{name}' is not known, give its deviation in {unit or '1'}"
                )
            std = given.get(name, _DEFAULT_NOISE.get(unit))
            noise_std.append(as_number(std, f"noise of '{name}'", unit, greater_than=0))
        self.noise = np.array(noise_std)
        signals = {VALVE_SIGNAL_PREFIX + joint: "V" for joint in joints}
        simulated_columns(machine, Table(self.units, np.zeros((0, len(self.units))), {}))
        variants = MachineVariants(machine)
        self.unknowns = build_unknowns(fit, variants.spec, variants.values, self.units | signals)
        initial_values = {x: y for one in self.unknowns for x, y in one.changes(one.start).items()}
        if any(variants.values[name] != value for name, value in initial_values.items()):
            self.machine = variants.machine(initial_values)
        # instants of sticking depend on the whole motion before
        self._has_stiction = bool(find_stick_slip_columns(machine))
        self._problem = self._smoothed_problem([])

    def perturbed_machine(self, values: Mapping[str, float]) -> Machine:
        """The machine with changed parameters and smoothed friction."""
        z = [(values.get(one.name, one.start) - one.start) / one.scale for one in self.unknowns]
        return self._problem.simulated_machine(np.array(z), self._problem.smooth)

    def expected_readings(self, run: Recording, noisy: bool = False) -> Table:
        """Recording of a run: signals and readings, with noise or without."""
        values = read_simulation(self.machine, run, list(self.units))
        if noisy:
            random = np.random.default_rng(self._seed)
            values = values + self.noise * random.normal(size=values.shape)
            pressures = [unit == "Pa" for unit in self.units.values()]
            values[:, pressures] = np.maximum(values[:, pressures], 0.0)
        joints = require_circuit(self.machine).joints
        sensor_units = (
            {TIME: "s"} | {VALVE_SIGNAL_PREFIX + joint: "V" for joint in joints} | self.units
        )
        columns = [run.channels[VALVE_SIGNAL_PREFIX + joint] for joint in joints]
        return Table(sensor_units, np.column_stack([run.time, *columns, values]), {})

    def information_factor(self, run: Recording, estimate_start: bool = True) -> Array:
        """Root of M as an upper triangular matrix (p, p).

        Args:
            run: A simulation of the machine with the signals.
            estimate_start: Whether the start is estimated as well; faster without.

        Raises:
            CraneError: The simulation of a perturbed machine fails.
        """
        names, table = list(self.units), self.expected_readings(run, noisy=True)
        with warnings.catch_warnings(action="ignore"):
            case = recording_case(self.machine, "the design", table, {}, names, (0.0, np.inf))
        if not self._problem.cases:
            self._problem = self._smoothed_problem([case])
        problem, case = self._problem, replace(case, first_start_index=len(self.unknowns))
        if not estimate_start:
            case = replace(case, start_std=np.zeros_like(case.start_std))
        _, derivatives = problem.linearize(case, np.zeros(problem.unknown_count))
        J = (derivatives / self.noise[:, None]).reshape(-1, problem.unknown_count)
        count = len(self.unknowns)
        start_count = problem.unknown_count - count
        prior = np.hstack([np.eye(start_count), np.zeros((start_count, count))])
        stacked = np.vstack([np.roll(J, start_count, axis=1), prior])
        return np.asarray(np.linalg.qr(stacked, mode="r"))[start_count:, start_count:]

    def measures(self, run: Recording) -> InformationMeasures:
        """Information measures of a recording of a run; standard deviations in SI units."""
        rows = self.information_factor(run)
        result = information_measures(rows, np.eye(len(rows)), 0.0)
        is_identifiable = np.linalg.norm(rows, axis=0) > _MIN_SENSITIVITY
        std = np.full(len(rows), np.inf)
        if is_identifiable.any():
            root = np.asarray(np.linalg.qr(rows[:, is_identifiable], mode="r"))
            std[is_identifiable] = information_measures(root, np.eye(len(root)), 0.0).std
        return replace(result, std=std * [unknown.scale for unknown in self.unknowns])

    def _smoothed_problem(self, cases: list[RecordingCase]) -> CalibrationProblem:
        problem = CalibrationProblem(self.machine, self.unknowns, cases)
        problem.smooth = self._has_stiction
        return problem


class SignalLimits:
    """Limits of a run that starts at home and is driven by valve signals.

    Strokes keep a margin to both ends, or half of the margin of home if that is less; the demand
    of flow is within the pump's flow, pressures are below those of the relief valves by the
    margin, and in the last half second all speeds are below a tenth of their maxima. With each
    unknown at its bounds, or 30 % off if it has one sign, strokes do not reach their ends.

    Args:
        information: Information of the machine and the unknowns.
        margin: Margin relative to strokes, relief pressures and the pump's flow.

    Attributes:
        machine: The machine of the information.
        low: (m,) lower limits [m], [rad].
        high: (m,) upper limits [m], [rad].
        flow: Largest demand of pump flow [m3/s].
    """

    def __init__(self, information: SignalInformation, margin: float):
        machine = self.machine = information.machine
        self._circuit, self._margin = require_circuit(machine), margin
        which = [machine.active.index(joint) for joint in self._circuit.joints]
        self._lower, self._upper = machine.lower[which], machine.upper[which]
        self._stroke_lengths = self._upper - self._lower
        home = np.array([machine.home[machine.column(joint)] for joint in self._circuit.joints])
        below, above = np.minimum(
            margin * self._stroke_lengths, [(home - self._lower) / 2, (self._upper - home) / 2]
        )
        self.low, self.high = self._lower + below, self._upper - above
        supply = self._circuit.supply
        if supply.control != "pressure":
            raise InputError(
                f"signals are designed for a pump that keeps its pressure, that of "
                f"'{machine.name}' has {supply.control} control: record a task instead"
            )
        for joint, cylinder in self._circuit.cylinders.items():
            if cylinder.motor:
                raise InputError(
                    f"signals are designed for cylinders, '{joint}' has a motor: lock it"
                )
        max_flow = supply.flow
        self.flow = (1 - margin) * max_flow if max_flow else np.inf
        self._perturbed_machines: list[Machine] = []  # with one unknown at an end
        for one in information.unknowns:
            ends = one.low, one.high
            if not np.isfinite(ends).all():
                deviation = _DEFAULT_DEVIATION * one.start if np.isfinite(ends).any() else 0.0
                ends = one.start - deviation, one.start + deviation
            self._perturbed_machines += [
                information.perturbed_machine({one.name: end})
                for end in ends
                if end != one.start and not one.sensor
            ]

    def exceeded_limit(self, run: Recording) -> str:
        """Name of a limit that a run exceeds, "" if it exceeds none."""
        q = self._strokes(run)
        for i, joint in enumerate(self._circuit.joints):
            if q[:, i].min() < self.low[i] - 1e-9 or q[:, i].max() > self.high[i] + 1e-9:
                return f"the stroke of '{joint}'"
        if self.pump_flow_share(run) > 1:
            return "the pump's flow"
        for joint, pressure in zip(self._circuit.joints, self.peak_pressures(run), strict=True):
            relief = self._circuit.cylinders[joint].relief
            if relief and pressure > (1 - self._margin) * relief:
                return f"the relief pressure of '{joint}'"
        speeds = np.abs(run.v)
        last = speeds[run.time > run.time[-1] - _FINAL_DURATION].max(axis=0)
        # free joints sway
        moving = (last > _REST_SPEED_SHARE * speeds.max(axis=0)) & ~np.isin(run.joints, run.free)
        if moving.any():
            return f"the rest of '{run.joints[int(np.argmax(moving))]}' at the end"
        return ""

    def stroke_margins(self, run: Recording) -> Array:
        """Smallest distances (m,) to the ends of the strokes, per stroke."""
        q = self._strokes(run)
        ends = np.minimum(q.min(axis=0) - self._lower, self._upper - q.max(axis=0))
        return ends / self._stroke_lengths

    def worst_case_stroke_margins(self, run: Recording) -> Array:
        """Stroke margins (m,) of the worst machine with deviating parameters and the same signals.

        Raises:
            CraneError: A simulation fails.
        """
        runs = [replay_signals(machine, run) for machine in self._perturbed_machines]
        return np.min([self.stroke_margins(other) for other in (run, *runs)], axis=0)

    def pump_flow_share(self, run: Recording) -> float:
        """Largest share of the pump's flow, 0 if it has no limit."""
        supply = self._circuit.supply
        if not supply.flow:
            return 0.0
        return float(((supply.pressure - run.channels["pressure_supply"]) / supply.droop).max())

    def peak_pressures(self, run: Recording) -> Array:
        """Largest pressures (m,) in the cylinders [Pa]."""
        return np.array([
            max(run.channels[f"pressure_{joint}_{side}"].max() for side in "ab")
            for joint in self._circuit.joints
        ])  # fmt: skip

    def _strokes(self, run: Recording) -> Array:
        return run.q[:, [run.joints.index(joint) for joint in self._circuit.joints]]


def replay_signals(machine: Machine, run: Recording) -> Recording:
    """Simulate a machine from home with the valve signals of another run.

    Raises:
        CraneError: The simulation fails.
    """
    joints, step = require_circuit(machine).joints, float(run.time[1] - run.time[0])
    signals = {joint: run.channels[VALVE_SIGNAL_PREFIX + joint] for joint in joints}
    return simulate(
        machine, ValveSignals(machine, run.time, signals), None, step * (len(run.time) - 1), step
    )
