"""Simulation of measured valve signals, and comparison with the measurement."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.errors import (
    CraneWarning,
    RecordingError,
    check_name,
    prefix_location,
    warn,
)
from crane.common.one_line_repr import OneLineRepr
from crane.common.progress import progress_reporter
from crane.common.result import Result
from crane.common.samples import Array, as_number
from crane.control.control_law import ControlLaw
from crane.control.valve_commands import ValveSignals, require_circuit
from crane.control.valve_drive import ValveDrive
from crane.description.sensors import SUPPLY_PRESSURE, TANK_PRESSURE, VALVE_SIGNAL_PREFIX
from crane.machine.machine import Machine
from crane.recordings.measured_configurations import (
    MissingMeasurements,
    add_inclination_angles,
    determining_joints,
    joint_motion,
)
from crane.recordings.measured_recordings import (
    check_pressures,
    check_strokes,
    locked_joint_conflicts,
)
from crane.recordings.recording import (
    IDEAL_SENSORS,
    SENSORS_NOTE,
    VELOCITY_SUFFIX,
    Recording,
)
from crane.recordings.recording_reader import FULL_TIME_SPAN, TimeSpan, read_quantities
from crane.recordings.sensor_discrepancy import warn_discrepancies
from crane.recordings.timeseries import (
    TIME,
    Table,
    table_column,
    time_derivative,
)
from crane.simulation.parameter_schedule import ParameterSchedule
from crane.simulation.recorded_inputs import add_recorded_tip_force, recorded_references
from crane.simulation.recorded_run import read_simulation, simulated_columns
from crane.simulation.simulation_run import Progress, simulate

_PUMP_STATE = "share_supply"  # of the regulator of the main pump, which no sensor reads
_START_FIT_DURATION = 0.1  # interval of the fit of the initial state [s]
_MAX_REST_DURATION = 1.0  # longest interval that is tested for rest [s]
_MIN_FIT_SAMPLES = 5  # samples of that fit
_LIMIT_TOLERANCE = 0.01  # share of the range by which measured coordinates may pass limits
_REST_TOLERANCE = 1e-12  # relative variation of a constant channel


@dataclass(frozen=True, eq=False, repr=False)
class ChannelComparison(OneLineRepr):
    """One channel, measured and simulated at the measured instants.

    Attributes:
        name: Name of the column.
        unit: Its unit.
        measured: (N,) measured values.
        simulated: (N,) simulated values.
    """

    name: str
    unit: str
    measured: Array
    simulated: Array

    @property
    def rms(self) -> float:
        """Root of the mean square of the difference, in the channel's unit."""
        return float(np.sqrt(np.mean((self.simulated - self.measured) ** 2)))

    @property
    def relative_rms(self) -> float:
        """RMS error over the standard deviation of the measurement; infinite if that is 0."""
        deviation = float(np.std(self.measured))
        if deviation < _REST_TOLERANCE * float(np.abs(self.measured).max()):
            deviation = 0.0
        return self.rms / deviation if deviation > 0 else (0.0 if self.rms == 0 else np.inf)


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Result):
    """A recording beside the simulation of the same inputs.

    Attributes:
        time: Instants (N,) [s] from the start.
        channels: What both hold.
        recording: The simulation, which `write` writes, too; None if it is not at hand.
    """

    time: Array
    channels: tuple[ChannelComparison, ...]
    recording: Recording | None = None

    def _one_line(self) -> str:
        return (
            f"Comparison over {self.time[-1] - self.time[0]:.6g} s in {len(self.time)} samples: "
            + ", ".join(channel.name for channel in self.channels)
        )

    def to_markdown(self) -> str:
        """A table with a row per channel."""
        lines = [
            "| channel | unit | RMS error | relative to its variation |",
            "|---|---|---:|---:|",
        ]
        lines += [
            f"| {x.name} | {x.unit} | {x.rms:.4g} | {100 * x.relative_rms:.2f} % |"
            for x in self.channels
        ]
        return "\n".join(lines) + "\n"


def replay(
    machine: Machine,
    path: str | Path,
    step: float = 1e-3,
    progress: Progress | None = None,
    columns: str | Path | None = None,
    span: TimeSpan = FULL_TIME_SPAN,
    controller: str | None = None,
) -> tuple[Recording, Comparison]:
    """Simulate a machine with measured valve signals, or without a circuit with measured forces.

    The file has a column voltage_X [V] for every valve that was moved, pressures of pump and tank
    where they were measured (pressure_supply, pressure_tank), and whatever else is to be compared:
    strokes or angles, velocities, pressures (see `crane.recordings.measured_recordings`). The
    simulation starts from the measured configuration and velocity, at rest or fitted over the
    first tenth of a second, and from the measured pressures. Where they are not measured, it
    starts at home and rest, and with pressures that hold the machine. Parameters change where the
    file says so, see `crane.simulation.parameter_schedule`.

    A force at the tip that the file has (load_tip_force_x [N]) acts on it. With a controller the
    references of the file are followed in place of the signals.

    Args:
        machine: The machine.
        path: A CSV or npz file.
        step: Output interval of the simulation [s].
        progress: Called with the finished share, 0 to 1.
        columns: Assignment of the columns of a log, if not that of the sensors of the machine,
            see `crane.recordings.logs`.
        span: Time span [s] by the clock of the file; the simulation starts at zero.
        controller: Name of a built-in controller whose references the file has.

    Returns:
        The simulated recording, and its comparison with the file.

    Raises:
        RecordingError: The file is malformed, or has no signals.
        InputError: A parameter that changes is unknown.
    """
    progress = progress_reporter(progress)
    step = as_number(step, "the step", "s", greater_than=0)
    table = read_quantities(path, machine, columns, span)
    try:
        machine = add_recorded_tip_force(machine, table)
        schedule = ParameterSchedule.from_notes(table.notes)
        time, drive, initial = _recorded_drive(machine, table, controller)
        steps = int(time[-1] / step + 1e-9)
        if steps < 1:
            raise RecordingError(f"is shorter than a step of {step:g} s, shorten the step")
        label = Path(path).stem
        if schedule.changes or schedule.keeps_chart:
            recording = schedule.simulate(machine, drive, initial, steps, step, label, progress)
        else:
            recording = simulate(
                machine, drive, initial, steps * step, step, label=label, progress=progress
            )
        names = simulated_columns(machine, table, recording)
    except RecordingError as error:
        raise RecordingError(prefix_location(str(path), error)) from None
    inside = time <= recording.time[-1] * (1 + 1e-12)
    channels = [
        ChannelComparison(
            name,
            table.units[name],
            table_column(table, name)[inside],
            np.interp(time[inside], recording.time, simulated),
        )
        for name, simulated in zip(
            names, read_simulation(machine, recording, names).T, strict=True
        )
    ]
    return recording, Comparison(time[inside], tuple(channels), recording)


def _recorded_drive(
    machine: Machine, table: Table, controller: str | None
) -> tuple[Array, ControlLaw, tuple[Array, Array] | None]:
    """Instants (N,) [s] from zero, the recorded references, signals or forces, and the start."""
    if controller is not None or machine.hydraulics is None:
        return recorded_references(machine, table, controller)
    inputs = replay_inputs(machine, table)
    return inputs.time, inputs.valve_drive(machine), inputs.initial


@dataclass(frozen=True, eq=False)
class ReplayInputs:
    """Inputs and initial state of a measured machine.

    Attributes:
        time: (N,) [s] from zero.
        signals: (k,) measured signals of spools by name [V].
        supply: (N,) pressure of the supply [Pa]; None if it was not measured.
        tank: (N,) pressure of the tank [Pa]; None if it was not measured.
        pressures: Measured initial pressures in A and B [Pa] by joint.
        initial: Initial q_A and v_A; None if they were not measured.
        signal_times: (k,) times of the signals [s], which may be negative; None for `time`.
    """

    time: Array
    signals: dict[str, Array]
    supply: Array | None
    tank: Array | None
    pressures: dict[str, tuple[float, float]]
    initial: tuple[Array, Array] | None
    signal_times: Array | None = None

    def valve_drive(self, machine: Machine) -> ValveDrive:
        """The valve drive of a machine."""
        time, line_pressures = self.time, [self.supply, self.tank]
        if self.signal_times is not None:
            time = self.signal_times
            line_pressures = [
                None if x is None else np.interp(time, self.time, x) for x in line_pressures
            ]
        return ValveDrive(
            machine, ValveSignals(machine, time, self.signals, *line_pressures), self.pressures
        )


def replay_inputs(machine: Machine, table: Table) -> ReplayInputs:
    """Inputs and initial state of a machine, from a measured table.

    Raises:
        RecordingError: The table has no signals, or is malformed.
        InputError: The machine has no valves.
    """
    circuit = require_circuit(machine)
    time = table_column(table, TIME)
    time = time - time[0]
    if len(time) < 2:
        raise RecordingError("has one sample, give at least two")
    signals, pressures, missing = {}, {}, MissingMeasurements(machine, table)
    with missing.collect_errors():
        signals = _spool_signals(machine, tuple(circuit.spools), table)
    gap = int(np.argmax(np.diff(time)))  # of many steps: samples may be lost
    changed = [name for name, x in signals.items() if x[gap] != x[gap + 1]]
    if changed and np.diff(time)[gap] > 10.0 * np.median(np.diff(time)):
        warn(
            "no samples between {:.6g} and {:.6g} s".format(
                *table_column(table, TIME)[gap : gap + 2]
            )
            + f", over which the signal of '{changed[0]}' is interpolated: end before, or start "
            "behind (--until, --from)",
            stacklevel=3,
        )
    check_pressures(machine, table)
    supply, tank = (
        table_column(table, name, "Pa") if name in table.units else None
        for name in (SUPPLY_PRESSURE, TANK_PRESSURE)
    )
    # a run of this package has a pump of its own, and no noise
    is_simulated = _PUMP_STATE in table.units and table.notes.get(SENSORS_NOTE) == IDEAL_SENSORS
    if is_simulated:
        supply = tank = None
    with missing.collect_errors():
        pressures = _initial_pressures(circuit.joints, table, time, is_simulated)
    table_with_angles = add_inclination_angles(machine, table)
    has_joint_motion = any(joint in table_with_angles.units for joint in machine.joints)
    if has_joint_motion:
        with missing.collect_errors():
            determining_joints(machine, list(table_with_angles.units))
    missing.raise_collected()
    if has_joint_motion:
        check_strokes(machine, table)
        warn_discrepancies(machine, table)
    initial = (
        _initial_motion(machine, table_with_angles, time, list(signals.values()), is_simulated)
        if has_joint_motion
        else None
    )
    return ReplayInputs(time, signals, supply, tank, pressures, initial)


def _spool_signals(machine: Machine, spools: Sequence[str], table: Table) -> dict[str, Array]:
    """Measured signals of spools by name [V]."""
    signals = {}
    for name in (name for name in table.units if name.startswith(VALVE_SIGNAL_PREFIX)):
        spool = name.removeprefix(VALVE_SIGNAL_PREFIX)
        if spool in machine.locked_joints or spool.removesuffix("_b") in machine.locked_joints:
            continue  # the valve of a locked joint has no effect
        check_name(spool, spools, f"column '{name}' is of no valve", RecordingError)
        signals[spool] = table_column(table, name, "V")
    if not signals:
        names = ", ".join(f"'{VALVE_SIGNAL_PREFIX}{joint} [V]'" for joint in spools)
        raise RecordingError(f"no signal of a valve, give at least one of {names}")
    return signals


def _initial_pressures(
    joints: Sequence[str], table: Table, time: Array, is_exact: bool
) -> dict[str, tuple[float, float]]:
    """Initial pressures in A and B by joint [Pa], from the first samples."""
    pressures: dict[str, tuple[float, float]] = {}
    for joint in joints:
        pair = [f"pressure_{joint}_{side}" for side in "ab"]
        measured = [name for name in pair if name in table.units]
        if len(measured) == 1:
            missing = pair[pair[0] in measured]
            raise RecordingError(
                f"'{missing}' is missing beside '{measured[0]}', add or remove one"
            )
        if measured:
            columns = (table_column(table, name) for name in pair)
            a, b = (
                float(x[0]) if is_exact else _value_at_first_sample(time, x, 0) for x in columns
            )
            pressures[joint] = max(a, 0.0), max(b, 0.0)
    return pressures


def _initial_motion(
    machine: Machine, table: Table, time: Array, signals: list[Array], is_exact: bool
) -> tuple[Array, Array]:
    for text in locked_joint_conflicts(
        machine, dict(zip(table.units, table.values.T, strict=True)), table.units
    ):
        raise RecordingError(f"{text}, do not lock it, or lock it where it is")
    q_a, v_a = joint_motion(machine, table)
    span = machine.upper - machine.lower
    excess = np.maximum(machine.lower - q_a, q_a - machine.upper)
    excess /= np.where(np.isfinite(span), span, 1.0)
    for i, joint in enumerate(machine.active):
        k = int(np.argmax(excess[:, i]))
        if excess[k, i] > _LIMIT_TOLERANCE:
            limit = machine.lower[i] if q_a[k, i] < machine.lower[i] else machine.upper[i]
            unit = machine.unit(joint)
            warnings.warn(
                f"measured '{joint}' goes to {q_a[k, i]:.6g} {unit} at t = {time[k]:.4g} s, "
                f"beyond its limit {limit:.6g} {unit}: look at the limits and the sensor's zero",
                CraneWarning,
                stacklevel=4,
            )
    if is_exact:
        return q_a[0], v_a[0]
    has_moved = [np.abs(x - x[0]) > 1e-9 * max(float(np.ptp(x)), 1e-300) for x in signals]
    # at rest until a valve moves, within bounds
    first = min(float(time[x.argmax()]) if x.any() else np.inf for x in has_moved)
    fit_duration = max(_START_FIT_DURATION, float(time[min(_MIN_FIT_SAMPLES, len(time)) - 1]))
    steady = time <= max(min(first, _MAX_REST_DURATION), fit_duration)
    has_velocities = [
        joint + VELOCITY_SUFFIX in table.units or joint not in table.units
        for joint in machine.active
    ]
    states = [
        _start_of_joint(time, x, v if has_velocity else None, steady)
        for x, v, has_velocity in zip(q_a.T, v_a.T, has_velocities, strict=True)
    ]
    q_start, v_start = np.array(states).reshape(-1, 2).T
    return q_start, v_start


def _start_of_joint(
    time: Array, x: Array, v: Array | None, is_steady: np.ndarray
) -> tuple[float, float]:
    """Coordinate and velocity of a joint at the first sample, from the first samples.

    The joint is at rest if a line through the steady interval rises by at most three standard
    deviations of its residual. Else parabolas are fitted, see `_value_at_first_sample`: to the
    velocities (N,) if recorded, else to the coordinates.
    """
    steady_times, steady_positions = time[is_steady], x[is_steady]
    if len(x) < _MIN_FIT_SAMPLES:
        return float(x[0]), float(time_derivative(x, time)[0] if v is None else v[0])
    line = np.polyfit(steady_times, steady_positions, 1)
    residual_std = float(np.std(steady_positions - np.polyval(line, steady_times)))
    if (
        abs(line[0]) * (steady_times[-1] - steady_times[0]) <= 3 * residual_std
        or np.ptp(steady_positions) == 0
    ):
        return float(steady_positions.mean()), 0.0
    return _value_at_first_sample(time, x, 0), _value_at_first_sample(
        time, x, 1
    ) if v is None else _value_at_first_sample(time, v, 0)


def _value_at_first_sample(time: Array, x: Array, order: int) -> float:
    """Value (order 0) or rate (1) at the first sample, of parabolas over ever longer stretches.

    Longer ones have less noise, as long as they agree with all shorter ones within two standard
    deviations of both (Lepski 1990).
    """
    lowest, highest, estimate = -np.inf, np.inf, 0.0
    last = max(
        int(np.searchsorted(time, time[0] + _START_FIT_DURATION, side="right")), _MIN_FIT_SAMPLES
    )
    if (
        order == 0 and len(x) > _MIN_FIT_SAMPLES
    ):  # the sample itself, its noise by third differences
        std = float(np.sqrt(np.mean(np.diff(x[:last], 3) ** 2) / 20))
        estimate, lowest, highest = float(x[0]), x[0] - 2 * std, x[0] + 2 * std
    count = _MIN_FIT_SAMPLES
    while count <= last:
        value, std = _fit_parabola(time[:count], x[:count], order)
        if value + 2 * std < lowest or value - 2 * std > highest:
            break
        lowest, highest = max(lowest, value - 2 * std), min(highest, value + 2 * std)
        estimate, count = value, count + max(1, count // 2)
    return estimate


def _fit_parabola(time: Array, x: Array, order: int) -> tuple[float, float]:
    """Value or rate of a parabola at the first instant, and its standard deviation."""
    values, covariance = np.polyfit(time - time[0], x, 2, cov=True)
    return float(values[2 - order]), float(np.sqrt(covariance[2 - order, 2 - order]))
