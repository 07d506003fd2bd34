"""A recording as a calibration uses it: inputs, start, compared channels and training mask."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import InputError
from crane.common.samples import Array, root_mean_square
from crane.description.sensors import VALVE_SIGNAL_PREFIX, Sensor
from crane.machine.machine import Machine
from crane.recordings.recording_reader import TimeSpan, correct_readings
from crane.recordings.timeseries import TIME, Table, table_column
from crane.simulation.recording_replay import ReplayInputs, replay_inputs

MIN_SAMPLES = 20  # least number of instants of a recording
_NORMAL_MEDIAN = 0.6745  # median absolute value of a standard normal variable
# standard deviations of starts that are not measured [rad], [m], and rates
_START_POSITION_STD, _START_VELOCITY_STD = {"rad": 5e-3, "m": 5e-3}, {"rad": 0.01, "m": 5e-3}
NOISE_LEVEL = 1.5  # noises of a channel, up to which nothing is left to explain
_START_NOISE_FACTOR = 2.0  # standard deviation of the start, per noise of its sensor
_MIN_START_STD = {"rad": 1e-4, "m": 1e-5, "Pa": 1e3}


@dataclass(frozen=True, eq=False)
class RecordingCase:
    """One recording as the calibration compares it with a simulation.

    Attributes:
        name: Name of the file.
        inputs: Inputs of the simulation.
        file_time: (N,) instants by the clock of the file [s].
        sensors: Names of the compared columns.
        measured: (N, k) readings of these columns.
        known_sensors: Known sensors of the recording.
        train_mask: (N,) mask of the training data.
        table: Table that was read.
        start_std: (s,) standard deviations of the start: q_A, v_A, pressures A and B.
        first_start_index: Index of its start among all unknowns.
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

    @property
    def contents(self) -> tuple[object, ...]:
        """What its residuals depend on besides the machine."""
        table = self.table
        return table.units, table.values, self.sensors, self.train_mask, self.known_sensors


def recording_case(
    machine: Machine,
    name: str,
    table: Table,
    known_sensors: Mapping[str, Sensor],
    sensors: list[str],
    window: TimeSpan,
) -> RecordingCase:
    """Recording of a machine with the training data in a window.

    Args:
        machine: The machine.
        name: Name of the file.
        table: Readings of the sensors.
        known_sensors: Known sensors.
        sensors: Columns to compare.
        window: Start and end of the training data by the clock of the file [s].

    Raises:
        RecordingError: See `replay_inputs`.
        InputError: There are too few instants, or no columns to compare.
    """
    # the start is read without delays
    undelayed_sensors = {
        x: replace(s, delay=0.0)
        for x, s in known_sensors.items()
        if not x.startswith(VALVE_SIGNAL_PREFIX)
    }
    inputs = replay_inputs(machine, correct_readings(table, undelayed_sensors))
    if not sensors:
        raise InputError(f"{name}: nothing of it can be compared with the machine")
    file_time = table_column(table, TIME)
    train_mask = (file_time >= window[0] - 1e-9) & (file_time <= window[1] + 1e-9)
    if len(train_mask) < MIN_SAMPLES:
        raise InputError(f"{name}: {len(train_mask)} instants, give at least {MIN_SAMPLES}")
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
        start_std += [
            initial_std(joint, kind, _START_POSITION_STD[kind])
            for joint, kind in zip(machine.active, joint_units, strict=True)
        ]
        start_std += [  # joints at rest start at rest
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
    """Standard deviation of the noise of a channel, by the median of third differences.

    The median is robust against shocks. The mean square is used if half of the differences are
    zero because readings have few digits.
    """
    differences = np.diff(x, 3)
    size = float(np.median(np.abs(differences))) / _NORMAL_MEDIAN or root_mean_square(differences)
    return size / np.sqrt(20.0)
