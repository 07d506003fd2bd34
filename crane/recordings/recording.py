"""Recordings: time series of the active joints of a machine and of further channels.

A recording is written as a CSV file in SI units (see crane.recordings.timeseries):

    # crane recording
    # machine: mini_forwarder
    # task: loading
    # controller: PI
    time [s],q1 [rad],X1 [m],q1_velocity [rad/s],X1_velocity [m/s],q1_force [N m],X1_force [N],...

A column X is an active joint if X_force exists, or if the line `# free: X, Y` names it: a free
joint has no drive, its force is zero and has no column. If X_velocity is missing, it is the
derivative of X. X_velocity and X_force without X are an error. Every other column is a channel,
such as the angle q2 of a passive joint, with or without q2_velocity. Columns may be in any order;
the joints have the order of their coordinates. The comment lines are optional if no joint is free;
`machine name` is written if the machine's name is not that of its file, `stopped` if a run ended
early. Other units are converted by crane.recordings.table_reader. An npz file has one array per
column, with the headings of the CSV as names, and the comment lines as the comment of the archive.
crane.recordings.measured_recordings completes recordings of other sensors.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import InitVar, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from crane.common import scratch_arrays
from crane.common.errors import InputError, RecordingError, check_name, is_one_line, suggest_names
from crane.common.one_line_repr import format_count
from crane.common.result import Result
from crane.common.samples import Array, as_number, as_seed
from crane.description.machine_lookup import without_changes
from crane.description.sensors import FORCE_SUFFIX as FORCE_SUFFIX
from crane.description.sensors import FORCE_UNITS as FORCE_UNITS
from crane.description.sensors import VELOCITY_SUFFIX as VELOCITY_SUFFIX
from crane.description.sensors import VELOCITY_UNITS as VELOCITY_UNITS
from crane.recordings import table_reader, timeseries
from crane.recordings.timeseries import (
    TIME,
    Table,
    check_finite,
    check_unit,
    checked_array,
    free_force_message,
    matching_units,
    quoted_list,
    require_active_joints,
    time_derivative,
)

# before the name of the quantity that a channel is the reference of
REFERENCE_PREFIX = "reference_"
SENSORS_NOTE, IDEAL_SENSORS = "sensors", "ideal"  # note of ideal quantities
FREE_JOINTS_NOTE = "free"  # note of free joints
MACHINE_NAME_NOTE = "machine name"  # note of a name that is not that of the file
# of a run that does not start at home, ended early, whose parameters change
START, STOPPED, CHANGES_NOTE = "start", "stopped", "changes"
_TEXTS = ("machine", "task", "controller", START, STOPPED, CHANGES_NOTE)  # attributes, too
_ACCELERATION_SUFFIX = "_acceleration"


@dataclass(frozen=True, eq=False, repr=False)
class Recording(Result):
    """Samples of a machine with n active joints at N instants.

    The arrays are copied to contiguous float64 and checked: shapes, finite numbers, strictly
    increasing time. Treat them as constants. With `copy=False` contiguous float64 arrays are not
    copied; the caller must not change them.

    Attributes:
        time: Instants (N,) [s], N >= 1.
        joints: Names of the active joints, in the order of the columns below.
        q: Active coordinates (N, n) [rad], [m].
        v: Velocities (N, n) [rad/s], [m/s].
        tau: Generalized forces (N, n) [N m], [N].
        units: Unit of each joint's coordinate, "rad" or "m".
        channels: Further columns (N,) by name.
        channel_units: Units of the channels; "" if none is given.
        machine: Name of the bundled machine or path of the machine file, "" if unknown.
        task: Name of the task, "" if unknown.
        controller: Name of the controller, "" if unknown.
        ideal: Whether the columns are ideal quantities, simulated or with corrected sensor errors
            (note `sensors` of a file).
        free: Names of the free joints, whose forces are zero.
        machine_name: Name of the machine, "" if unknown.
        stopped: Time and reason of an early end, "at t = 1.2 s: ..."; "" if there is none.
        start: Description of a start other than that of the machine file, else "".
        changes: Parameters that change, see `crane.simulation.parameter_schedule`; else "".
    """

    time: Array
    joints: tuple[str, ...]
    q: Array
    v: Array
    tau: Array
    units: dict[str, str]
    channels: dict[str, Array] = field(default_factory=dict)
    channel_units: dict[str, str] = field(default_factory=dict)
    machine: str = ""
    task: str = ""
    controller: str = ""
    ideal: bool = False
    free: tuple[str, ...] = ()
    machine_name: str = ""
    stopped: str = ""
    start: str = ""
    changes: str = ""
    copy: InitVar[bool] = True

    def __post_init__(self, copy: bool) -> None:
        joints = tuple(self.joints)
        count = np.size(self.time)
        shape = (count, len(joints))
        for name in self.channel_units:
            check_name(name, self.channels, f"unit of the channel '{name}'", RecordingError)
        if set(self.units) != set(joints):
            raise RecordingError(
                f"units are for {quoted_list(self.units)}, give {quoted_list(joints)}"
            )
        for name in self.free:
            check_name(name, joints, f"free joint '{name}' is not recorded", RecordingError)
        checked = {
            "joints": joints,
            "free": tuple(x for x in joints if x in self.free),
            "units": {x: self.units[x] for x in joints},
            "time": checked_array(TIME, self.time, (count,), copy),
            "q": checked_array("q", self.q, shape, copy, joints),
            "v": checked_array("v", self.v, shape, copy, joints),
            "tau": checked_array("tau", self.tau, shape, copy, joints),
            "channels": {
                name: checked_array(f"channel '{name}'", values, (count,), copy)
                for name, values in self.channels.items()
            },
            "channel_units": {name: self.channel_units.get(name, "") for name in self.channels},
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        self._check_names()
        self._check_values()

    def _check_names(self) -> None:
        names = self._column_names()
        for name, count in Counter(names).items():
            if count > 1:
                raise RecordingError(f"column '{name}' is there twice, rename or remove one")
        if require_active_joints(names, self.free) != self.joints:
            raise RecordingError(
                f"channels {quoted_list(self.channels)} hold an active joint, "
                f"rename those that end in {VELOCITY_SUFFIX} and {FORCE_SUFFIX}"
            )
        for name, unit in self.column_units().items():
            timeseries.check_column_name(name, unit)
        for name in (*_TEXTS, "machine_name"):
            text = getattr(self, name)
            if text != text.strip() or not is_one_line(text):
                raise RecordingError(f"{name} {text!r} is not one line of text, give one")

    def _check_values(self) -> None:
        if not len(self.time):
            raise RecordingError("no samples, give at least one")
        for i, joint in enumerate(self.joints):
            if joint in self.free and self.tau[:, i].any():
                raise RecordingError(free_force_message(joint, self.tau[:, i]))
        for values in (self.time, self.q, self.v, self.tau, *self.channels.values()):
            scratch_arrays.release_pages()
            if not np.isfinite(values).all():
                check_finite(self.columns())
        if (back := np.diff(self.time) <= 0).any():
            sample = int(np.argmax(back)) + 1
            before, now = self.time[sample - 1 : sample + 1]
            raise RecordingError(
                f"time goes from {before} to {now} s at sample {sample}, "
                f"give strictly increasing times"
            )

    def _one_line(self) -> str:
        """Machine, duration, number of samples, and columns."""
        what = ": ".join(word for word in (self.machine, self.task) if word)
        joints = ", ".join(f"{joint} [{self.units[joint]}]" for joint in self.joints)
        return (
            f"Recording of {what or 'a machine'}, {self.time[-1] - self.time[0]:.6g} s in "
            f"{format_count(len(self.time), 'sample')}: "
            f"{format_count(len(self.channels), 'channel')} "
            f"beside {joints or 'no joints'}{'; stopped ' * bool(self.stopped)}{self.stopped}"
        )

    def _column_names(self) -> list[str]:
        joints = [x + suffix for suffix in ("", VELOCITY_SUFFIX) for x in self.joints]
        return [TIME, *joints, *(x + FORCE_SUFFIX for x in self._driven_joints), *self.channels]

    @property
    def _driven_joints(self) -> list[str]:
        return [x for x in self.joints if x not in self.free]

    def column_units(self) -> dict[str, str]:
        """Units of all columns by name.

        Raises:
            RecordingError: A joint has a unit other than rad or m.
        """
        for joint, unit in self.units.items():
            check_unit(joint, unit, VELOCITY_UNITS)
        return (
            {TIME: "s"}
            | self.units
            | {x + VELOCITY_SUFFIX: VELOCITY_UNITS[unit] for x, unit in self.units.items()}
            | {x + FORCE_SUFFIX: FORCE_UNITS[self.units[x]] for x in self._driven_joints}
            | self.channel_units
        )

    def __getitem__(self, name: str) -> Array:
        """Column (N,) by its name in a file, such as "X1", "X1_velocity" or "tip_z".

        Raises:
            InputError: There is no column of this name.
        """
        columns = self.columns()
        if not isinstance(name, str):
            raise InputError(
                f"a recording's columns go by names such as '{TIME}', give one; samples are "
                "chosen by 'between' and 'at'"
            )
        check_name(name, columns, f"column '{name}' is not in the recording")
        return columns[name]

    def __iter__(self) -> Iterator[str]:
        """Names of all columns in the order of a file."""
        return iter(self._column_names())

    def columns(self) -> dict[str, Array]:
        """All columns (N,) by name, in the order of a file; views, not copies."""
        forces = (x for x, y in zip(self.tau.T, self.joints, strict=True) if y not in self.free)
        columns = [self.time, *self.q.T, *self.v.T, *forces, *self.channels.values()]
        return dict(zip(self._column_names(), columns, strict=True))

    def between(self, start: float, end: float) -> "Recording":
        """The samples from `start` to `end` [s], both included.

        Raises:
            RecordingError: There are none.
        """
        mask = (self.time >= start) & (self.time <= end)
        if not mask.any():
            raise RecordingError(
                f"nothing lies between {start:g} and {end:g} s, the recording goes from "
                f"{self.time[0]:g} to {self.time[-1]:g} s"
            )
        return self.at(mask)

    def at(self, mask: np.ndarray) -> "Recording":
        """The samples that a mask (N,) selects."""
        masked = {} if mask.all() else {name: x[mask] for name, x in self.columns().items()}
        return self.with_columns(masked) if masked else self

    def with_columns(self, columns: Mapping[str, Array]) -> "Recording":
        """The recording with other values (M,) of its columns; channels without any are left out.

        Args:
            columns: Columns by name, those of the time and the joints, and some of the channels.
        """
        none = np.zeros_like(columns[TIME])
        q, v, tau = (
            np.column_stack([columns.get(x + suffix, none) for x in self.joints])
            for suffix in ("", VELOCITY_SUFFIX, FORCE_SUFFIX)
        )
        channels = {name: columns[name] for name in self.channels if name in columns}
        units = {name: self.channel_units[name] for name in channels}
        return replace(
            self, time=columns[TIME], q=q, v=v, tau=tau, channels=channels, channel_units=units
        )

    def with_noise(self, deviations: Mapping[str, float], seed: int = 0) -> "Recording":
        """Add white, normally distributed noise to columns.

        Velocities and accelerations without noise are removed. Velocities of joints become
        derivatives of the noisy coordinates, unless they have a deviation of their own.

        Args:
            deviations: Standard deviations by column, such as {"X1": 1e-6, "X1_force": 0.05}, in
                the units of `columns`; other columns do not change.
            seed: Seed of the random numbers.

        Raises:
            InputError: A column does not exist, or a deviation is negative or no number.
        """
        columns, rng = self.columns(), np.random.default_rng(as_seed(seed))
        names = [name for name in columns if name != TIME]
        for name, deviation in deviations.items():
            check_name(name, names, f"noise of the column '{name}'")
            if as_number(deviation, f"the noise of '{name}'", "") < 0:
                raise InputError(
                    f"the noise of '{name}' is {deviation:g}, it must not be negative"
                )
        for name in [name for name in names if name in deviations]:  # in the order of columns
            columns[name] = columns[name] + deviations[name] * rng.normal(size=len(self.time))
        for joint in self.joints:
            if joint + VELOCITY_SUFFIX not in deviations:
                columns[joint + VELOCITY_SUFFIX] = time_derivative(columns[joint], self.time)
        rates = {x for x in self.channels if x.endswith((VELOCITY_SUFFIX, _ACCELERATION_SUFFIX))}
        for name in rates - deviations.keys():
            del columns[name]
        return self.with_columns(columns)

    def error(self, joint: str) -> Array:
        """Tracking error (N,) of a joint [rad], [m]: reference minus coordinate.

        Args:
            joint: Joint with the channel reference_<joint>, active or recorded in a channel.

        Raises:
            RecordingError: The joint has no reference, or is not recorded.
        """
        columns = {**self.channels, **dict(zip(self.joints, self.q.T, strict=True))}
        with_reference = [x for x in columns if REFERENCE_PREFIX + x in self.channels]
        if joint not in with_reference:
            text = (
                suggest_names(with_reference, joint) if with_reference else "the run followed none"
            )
            raise RecordingError(f"'{joint}' has no reference in this recording, {text}")
        reference, actual = self.channels[REFERENCE_PREFIX + joint], columns[joint]
        return scratch_arrays.compute_in_blocks(
            lambda part: (reference[part] - actual[part])[:, None], len(self.time)
        )[:, 0]

    def rotations(self, joint: str) -> Any:
        """Rotations (N,) of a ball joint or floating base, as `scipy.spatial.transform.Rotation`.

        Raises:
            InputError: The recording has no rotation vector of this joint.
        """
        from scipy.spatial.transform import Rotation  # slow to import

        return Rotation.from_rotvec(np.column_stack([self[f"{joint}_r{x}"] for x in "xyz"]))

    def to_csv(self, path: str | Path) -> None:
        """Write the recording as CSV; an incomplete file is never left.

        Raises:
            OutputError: The file cannot be written.
        """
        columns = list(self.columns().values())
        timeseries.write_columns(path, self.column_units(), columns, self._notes())

    def to_npz(self, path: str | Path) -> None:
        """Write the recording as npz, smaller than a CSV and faster to read.

        Raises:
            OutputError: The file cannot be written.
        """
        columns = list(self.columns().values())
        timeseries.write_npz(path, self.column_units(), columns, self._notes())

    def _notes(self) -> dict[str, str]:
        is_name_of_file = self.machine_name == Path(without_changes(self.machine)).stem
        optional = {
            MACHINE_NAME_NOTE: "" if is_name_of_file else self.machine_name,
            "controller": self.controller,
            SENSORS_NOTE: IDEAL_SENSORS if self.ideal else "",
            FREE_JOINTS_NOTE: ", ".join(self.free),
            STOPPED: self.stopped,
            START: self.start,
            CHANGES_NOTE: self.changes,
        }
        notes = {"crane recording": "", "machine": self.machine, "task": self.task}
        return notes | {key: text for key, text in optional.items() if text}

    @classmethod
    def from_csv(cls, path: str | Path) -> "Recording":
        """Read a recording from a CSV file.

        Raises:
            RecordingError: The file does not exist or is not valid; the message names the file,
                the line or column, and the remedy.
        """
        return cls.from_table(table_reader.read_csv(path), path)

    @classmethod
    def read(cls, path: str | Path) -> "Recording":
        """Read a recording from a CSV or npz file.

        Raises:
            RecordingError: As for `from_csv`, or the file has another suffix.
        """
        return cls.from_table(table_reader.read_table(path), path)

    @classmethod
    def from_table(cls, table: Table, path: str | Path) -> "Recording":
        """Convert a table that was read from a path.

        Raises:
            RecordingError: A column is missing, has a wrong unit, or is not valid in a recording.
        """
        with timeseries.located_errors(path):
            return cls._from_table(table)

    @classmethod
    def _from_table(cls, table: Table) -> "Recording":
        units, column = table.units, dict(zip(table.units, table.values.T, strict=True))
        free = tuple(
            filter(None, (x.strip() for x in table.notes.get(FREE_JOINTS_NOTE, "").split(",")))
        )
        joints = require_active_joints(list(units), free)
        for joint in joints:
            unit = units[joint]
            if unit not in VELOCITY_UNITS:
                check_unit(joint, unit, matching_units(joint, units) or VELOCITY_UNITS)
            if joint + VELOCITY_SUFFIX in units:
                check_unit(
                    joint + VELOCITY_SUFFIX, units[joint + VELOCITY_SUFFIX], [VELOCITY_UNITS[unit]]
                )
            else:
                column[joint + VELOCITY_SUFFIX] = time_derivative(column[joint], column[TIME])
            if joint + FORCE_SUFFIX in units:
                check_unit(joint + FORCE_SUFFIX, units[joint + FORCE_SUFFIX], [FORCE_UNITS[unit]])
            if joint in free and joint + FORCE_SUFFIX not in units:
                column[joint + FORCE_SUFFIX] = np.zeros_like(column[TIME])

        def stacked(suffix: str) -> Array:
            columns = [column[x + suffix] for x in joints]
            return scratch_arrays.compute_in_blocks(
                lambda part: np.column_stack([x[part] for x in columns]), len(column[TIME])
            )

        q, v, tau = (stacked(suffix) for suffix in ("", VELOCITY_SUFFIX, FORCE_SUFFIX))
        used = {TIME} | {
            x + suffix for x in joints for suffix in ("", VELOCITY_SUFFIX, FORCE_SUFFIX)
        }
        channels = {x: values for x, values in column.items() if x not in used}
        return cls(
            time=column[TIME],
            joints=joints,
            q=q,
            v=v,
            tau=tau,
            units={x: units[x] for x in joints},
            channels=channels,
            channel_units={x: units[x] for x in channels},
            ideal=table.notes.get(SENSORS_NOTE) == IDEAL_SENSORS,
            free=free,
            machine_name=table.notes.get(MACHINE_NAME_NOTE, ""),
            **{name: table.notes.get(name, "") for name in _TEXTS},
            copy=False,
        )
