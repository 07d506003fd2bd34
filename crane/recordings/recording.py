"""What a machine did: time series of its active joints, and whatever else was recorded.

As a file it is a CSV of SI units (see crane.recordings.timeseries):

    # crane recording
    # machine: mini_forwarder
    # task: loading
    # controller: PI
    time [s],q1 [rad],X1 [m],q1_velocity [rad/s],X1_velocity [m/s],q1_force [N m],X1_force [N],...

A column X is an active joint if X_force exists, or if the line `# free: X, Y` names it: nothing
drives such a joint, its force is zero and has no column. X_velocity may be missing and is the
derivative of X then. X_velocity and X_force without X is an error. Every other column is a
channel, such as the angle q2 of a joint that is not active, with q2_velocity beside it or without.
The order of the columns is any, the joints come in the order of their displacements. The comment
lines may be left out where no joint is free; `machine name` is there where the machine calls
itself something else than its file, `stopped` where a run ended before its time. Other units are
converted where crane.recordings.timeseries knows them. An npz file serves, too: one array per
column, named like those of the CSV, and the comment lines as the comment of the archive. What a
crane's sensors tell instead of displacements and forces, crane.recordings.measured_recordings
turns into them.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import InitVar, dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from crane.common import scratch_arrays
from crane.common.errors import InputError, RecordingError, prefix_location, suggest_names
from crane.common.one_line_repr import format_count
from crane.common.result import Result
from crane.common.samples import Array, as_number, as_seed
from crane.description.machine_lookup import without_changes
from crane.description.sensors import FORCE_SUFFIX as FORCE_SUFFIX
from crane.description.sensors import FORCE_UNITS as FORCE_UNITS
from crane.description.sensors import VELOCITY_SUFFIX as VELOCITY_SUFFIX
from crane.description.sensors import VELOCITY_UNITS as VELOCITY_UNITS
from crane.recordings import timeseries
from crane.recordings.timeseries import TIME, Table, check_unit

REFERENCE_PREFIX = "reference_"  # before the name of what a channel is the reference of
SENSORS_NOTE, IDEAL_SENSORS = "sensors", "ideal"  # a note of quantities themselves
FREE_JOINTS_NOTE = "free"  # a note of joints that nothing drives
MACHINE_NAME_NOTE = "machine name"  # a note where the machine's own is not that of its file
START = "start"  # a note of a run that starts elsewhere than its machine's file says
STOPPED = "stopped"  # a note of a run that ended before its time
_ACCELERATION_SUFFIX = "_acceleration"
_MAX_LISTED = 40  # names in a message


@dataclass(frozen=True, eq=False, repr=False)
class Recording(Result):
    """Samples of N instants of a machine with n active joints.

    The arrays are copied to contiguous float64 and checked: shapes, finite numbers, time
    strictly increasing. Treat them as constants. With `copy=False`, for arrays that nobody else
    will change, those that are contiguous float64 already are kept.

    Attributes:
        time: Instants (N,) [s], N >= 1.
        joints: Names of the active joints, in the order of the columns below.
        q: Active coordinates (N, n) [rad or m].
        v: Their velocities (N, n) [rad/s or m/s].
        tau: Their generalized forces (N, n) [N m or N].
        units: Unit of each joint's coordinate, "rad" or "m".
        channels: Further columns (N,) by name.
        channel_units: Their units; "" where none is given.
        machine: Name of the bundled machine or path of the machine file, "" if not known.
        task: What it was doing, "" if not known.
        controller: What drove it, "" if not known.
        ideal: Whether the columns are the quantities themselves, simulated or corrected by what
            is known of the sensors, which a file says in its note `sensors`.
        free: Those of the joints that nothing drives, whose forces are zero.
        machine_name: What the machine calls itself, "" if not known.
        stopped: When and why it ended before its time, "at t = 1.2 s: ..."; "" if it did not.
        start: How it starts where that is not what the machine's file says, "" if it is.
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
    copy: InitVar[bool] = True

    def __post_init__(self, copy: bool) -> None:
        joints = tuple(self.joints)
        count = np.size(self.time)
        shape = (count, len(joints))
        for name in self.channel_units:
            if name not in self.channels:
                raise RecordingError(
                    f"unit of the channel '{name}', {suggest_names(self.channels, name)}"
                )
        if set(self.units) != set(joints):
            raise RecordingError(
                f"units are for {_quoted_list(self.units)}, give {_quoted_list(joints)}"
            )
        for name in self.free:
            if name not in joints:
                raise RecordingError(
                    f"free joint '{name}' is not recorded, {suggest_names(joints, name)}"
                )
        checked = {
            "joints": joints,
            "free": tuple(x for x in joints if x in self.free),
            "units": {x: self.units[x] for x in joints},
            "time": _checked_array(TIME, self.time, (count,), copy),
            "q": _checked_array("q", self.q, shape, copy, joints),
            "v": _checked_array("v", self.v, shape, copy, joints),
            "tau": _checked_array("tau", self.tau, shape, copy, joints),
            "channels": {
                name: _checked_array(f"channel '{name}'", values, (count,), copy)
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
        if _require_active_joints(names, self.free) != self.joints:
            raise RecordingError(
                f"channels {_quoted_list(self.channels)} hold an active joint, "
                f"rename those that end in {VELOCITY_SUFFIX} and {FORCE_SUFFIX}"
            )
        units = self._column_units()
        for name, unit in units.items():
            timeseries.check_column_name(name, unit)
        for name in ("machine", "task", "controller", "machine_name", "stopped", "start"):
            text = getattr(self, name)
            if text != text.strip() or not text.isprintable():
                raise RecordingError(f"{name} {text!r} is not one line of text, give one")

    def _check_values(self) -> None:
        if not len(self.time):
            raise RecordingError("no samples, give at least one")
        for i, joint in enumerate(self.joints):
            if joint in self.free and self.tau[:, i].any():
                raise RecordingError(free_force_message(joint, self.tau[:, i]))
        arrays = (self.time, self.q, self.v, self.tau, *self.channels.values())
        for values in arrays:
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
        """What it is of, how long, how many samples, and its columns."""
        what = ": ".join(word for word in (self.machine, self.task) if word)
        joints = ", ".join(f"{joint} [{self.units[joint]}]" for joint in self.joints)
        return (
            f"Recording of {what or 'a machine'}, {self.time[-1] - self.time[0]:.6g} s in "
            f"{format_count(len(self.time), 'sample')}: "
            f"{format_count(len(self.channels), 'channel')} "
            f"beside {joints or 'no joints'}{'; stopped ' * bool(self.stopped)}{self.stopped}"
        )

    def _column_names(self) -> list[str]:
        """Names of all columns, in the order in which they are written."""
        joints = [x + suffix for suffix in ("", VELOCITY_SUFFIX) for x in self.joints]
        return [TIME, *joints, *(x + FORCE_SUFFIX for x in self._driven_joints), *self.channels]

    @property
    def _driven_joints(self) -> list[str]:
        return [x for x in self.joints if x not in self.free]

    def _column_units(self) -> dict[str, str]:
        """Units of all columns.

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
        """A column (N,) by its name, as it is written: "X1", "X1_velocity", "tip_z".

        Raises:
            InputError: There is none of this name.
        """
        columns = self.columns()
        if not isinstance(name, str):
            raise InputError(
                f"a recording's columns go by names such as '{TIME}', give one; samples are "
                "chosen by 'between' and 'at'"
            )
        if name not in columns:
            raise InputError(
                f"column '{name}' is not in the recording, {suggest_names(columns, name)}"
            )
        return columns[name]

    def __iter__(self) -> Iterator[str]:
        """Names of all columns, in the order in which they are written."""
        return iter(self._column_names())

    def columns(self) -> dict[str, Array]:
        """All columns (N,) by name, as they are written; views, not copies."""
        forces = (
            x
            for x, joint in zip(self.tau.T, self.joints, strict=True)
            if joint in self._driven_joints
        )
        columns = [self.time, *self.q.T, *self.v.T, *forces, *self.channels.values()]
        return dict(zip(self._column_names(), columns, strict=True))

    def between(self, start: float, end: float) -> "Recording":
        """What was recorded from `start` to `end` [s], both included.

        Raises:
            RecordingError: Nothing was.
        """
        mask = (self.time >= start) & (self.time <= end)
        if not mask.any():
            raise RecordingError(
                f"nothing lies between {start:g} and {end:g} s, the recording goes from "
                f"{self.time[0]:g} to {self.time[-1]:g} s"
            )
        return self.at(mask)

    def at(self, mask: np.ndarray) -> "Recording":
        """Only the samples of a mask (N,)."""
        return replace(
            self, time=self.time[mask], q=self.q[mask], v=self.v[mask], tau=self.tau[mask],
            channels={name: values[mask] for name, values in self.channels.items()},
        )  # fmt: skip

    def with_noise(self, deviations: Mapping[str, float], seed: int = 0) -> "Recording":
        """What sensors with white, normally distributed noise would have read.

        Velocities and accelerations are not kept: they would tell the motion without noise.
        Velocities of joints are derivatives of the noisy coordinates instead, unless they have a
        deviation, too.

        Args:
            deviations: Standard deviations by column, as {"X1": 1e-6, "X1_force": 0.05}, in the
                units of `columns`; others stay as they are.
            seed: Of the random numbers.

        Raises:
            InputError: There is no such column, or a deviation is no number or negative.
        """
        columns, rng = self.columns(), np.random.default_rng(as_seed(seed))
        del columns[TIME]
        for name, deviation in deviations.items():
            if name not in columns:
                raise InputError(f"noise of the column '{name}', {suggest_names(columns, name)}")
            if as_number(deviation, f"the noise of '{name}'", "") < 0:
                raise InputError(
                    f"the noise of '{name}' is {deviation:g}, it must not be negative"
                )
        for name in [name for name in columns if name in deviations]:  # whatever order is given
            columns[name] = columns[name] + deviations[name] * rng.normal(size=len(self.time))
        for joint in self.joints:
            if joint + VELOCITY_SUFFIX not in deviations:
                columns[joint + VELOCITY_SUFFIX] = time_derivative(columns[joint], self.time)
        none = np.zeros_like(self.time)
        q, v, tau = (
            np.column_stack([columns.get(x + suffix, none) for x in self.joints])
            for suffix in ("", VELOCITY_SUFFIX, FORCE_SUFFIX)
        )
        channels = {
            name: columns[name]
            for name in self.channels
            if name in deviations or not name.endswith((VELOCITY_SUFFIX, _ACCELERATION_SUFFIX))
        }
        units = {name: self.channel_units[name] for name in channels}
        return replace(self, q=q, v=v, tau=tau, channels=channels, channel_units=units)

    def error(self, joint: str) -> Array:
        """Tracking error (N,) of a joint [rad or m]: its reference less its coordinate.

        Args:
            joint: A joint with the channel reference_<joint>, active or with a channel of its own.

        Raises:
            RecordingError: It has no reference, or is not recorded.
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

    def to_csv(self, path: str | Path) -> None:
        """Write the recording as CSV, whole or not at all.

        Raises:
            OutputError: It cannot be written there.
        """
        columns = list(self.columns().values())
        timeseries.write_columns(path, self._column_units(), columns, self._notes())

    def to_npz(self, path: str | Path) -> None:
        """Write the recording as npz, whole or not at all: smaller than a CSV, and read faster.

        Raises:
            OutputError: It cannot be written there.
        """
        columns = list(self.columns().values())
        timeseries.write_npz(path, self._column_units(), columns, self._notes())

    def _notes(self) -> dict[str, str]:
        notes = {"crane recording": "", "machine": self.machine, "task": self.task}
        if self.machine_name not in ("", Path(without_changes(self.machine)).stem):
            notes[MACHINE_NAME_NOTE] = self.machine_name
        if self.controller:
            notes["controller"] = self.controller
        if self.ideal:
            notes[SENSORS_NOTE] = IDEAL_SENSORS
        if self.free:
            notes[FREE_JOINTS_NOTE] = ", ".join(self.free)
        if self.stopped:
            notes[STOPPED] = self.stopped
        if self.start:
            notes[START] = self.start
        return notes

    @classmethod
    def from_csv(cls, path: str | Path) -> "Recording":
        """Read a recording.

        Raises:
            RecordingError: The file does not exist or is not such a CSV; the message names the
                file, the line or column, and what to change.
        """
        return cls.from_table(timeseries.read_csv(path), path)

    @classmethod
    def read(cls, path: str | Path) -> "Recording":
        """Read a recording from a CSV or npz file.

        Raises:
            RecordingError: As `from_csv`, or the suffix is another one.
        """
        return cls.from_table(timeseries.read_table(path), path)

    @classmethod
    def from_table(cls, table: Table, path: str | Path) -> "Recording":
        """The recording in a table that was read from a path.

        Raises:
            RecordingError: A column is missing, in a wrong unit, or not a recording's.
        """
        try:
            return cls._from_table(table)
        except RecordingError as error:
            raise RecordingError(prefix_location(str(path), error)) from None

    @classmethod
    def _from_table(cls, table: Table) -> "Recording":
        units, column = table.units, dict(zip(table.units, table.values.T, strict=True))
        free = tuple(
            filter(None, (x.strip() for x in table.notes.get(FREE_JOINTS_NOTE, "").split(",")))
        )
        joints = _require_active_joints(list(units), free)
        for joint in joints:
            unit = units[joint]
            if unit not in VELOCITY_UNITS:
                check_unit(joint, unit, _matching_units(joint, units) or VELOCITY_UNITS)
            if joint + VELOCITY_SUFFIX in units:
                check_unit(
                    joint + VELOCITY_SUFFIX, units[joint + VELOCITY_SUFFIX], [VELOCITY_UNITS[unit]]
                )
            else:
                column[joint + VELOCITY_SUFFIX] = time_derivative(column[joint], column[TIME])
            if joint + FORCE_SUFFIX in units:
                check_unit(joint + FORCE_SUFFIX, units[joint + FORCE_SUFFIX], [FORCE_UNITS[unit]])
            elif joint in free:
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
            machine=table.notes.get("machine", ""),
            task=table.notes.get("task", ""),
            controller=table.notes.get("controller", ""),
            ideal=table.notes.get(SENSORS_NOTE) == IDEAL_SENSORS,
            free=free,
            machine_name=table.notes.get(MACHINE_NAME_NOTE, ""),
            stopped=table.notes.get(STOPPED, ""),
            start=table.notes.get(START, ""),
            copy=False,
        )


def time_derivative(x: Array, time: Array) -> Array:
    """Central differences (N,) of x (N,); zero where time does not tell (it is refused later)."""
    if len(x) < 2 or not (np.diff(time) > 0).all():
        return np.zeros_like(x)
    return np.asarray(np.gradient(x, time))


def check_finite(columns: Mapping[str, Array]) -> None:
    """See that columns (N,) hold finite numbers.

    Raises:
        RecordingError: One does not.
    """
    for name, values in columns.items():
        if not np.isfinite(values).all():
            sample = int(np.argmin(np.isfinite(values)))
            raise RecordingError(
                f"'{name}' is {values[sample]} at sample {sample}, give finite numbers"
            )


def _checked_array(
    what: str, value: ArrayLike, shape: tuple[int, ...], copy: bool, names: Sequence[str] = ()
) -> Array:
    """A float64 array of that shape: a contiguous copy, or as it lies where none is asked for."""
    try:
        order: Literal["C", "K"] = "C" if copy or len(shape) == 1 else "K"
        array = np.array(value, dtype=np.float64, order=order, copy=copy or None)
    except (TypeError, ValueError):
        raise RecordingError(f"{what} is not an array of numbers, give {shape}") from None
    if array.shape != shape:
        columns = f", a column each for {_quoted_list(names)}" if names else ""
        raise RecordingError(f"{what} has the shape {array.shape}, give {shape}{columns}")
    return array


def _quoted_list(names: Iterable[str]) -> str:
    names = list(names)
    more = [f"{len(names) - _MAX_LISTED} more"] if len(names) > _MAX_LISTED else []
    return ", ".join([f"'{name}'" for name in names[:_MAX_LISTED]] + more) or "none"


def free_force_message(joint: str, tau: Array) -> str:
    """What to say of a free joint's force (N,) that is not zero."""
    sample = int(np.argmax(tau != 0))
    return (
        f"'{joint}' is free and has the force {tau[sample]:.3g} at sample {sample}: leave the "
        "force out, or name the joint as active"
    )


def find_active_joints(names: Sequence[str], free: Sequence[str] = ()) -> tuple[str, ...]:
    """The active joints among columns, by the rule in the module's docstring.

    Raises:
        RecordingError: There are velocity and force of a joint without its displacement.
    """
    available = set(names)
    for stem in (x.removesuffix(FORCE_SUFFIX) for x in names if x.endswith(FORCE_SUFFIX)):
        if stem not in available and stem + VELOCITY_SUFFIX in available:
            raise RecordingError(
                f"column '{stem}' is missing beside '{stem}{VELOCITY_SUFFIX}', "
                f"'{stem}{FORCE_SUFFIX}', "
                f"add it, or rename those if '{stem}' is not an active joint"
            )
    for x in free:
        if x not in available:
            raise RecordingError(
                f"column '{x}' of a free joint is missing, {suggest_names(names, x)}"
            )
    return tuple(x for x in names if x + FORCE_SUFFIX in available or x in free)


def _matching_units(joint: str, units: Mapping[str, str]) -> list[str]:
    """Units of a joint that fit its velocity and force, as far as these have columns."""
    return [
        unit
        for unit, rate in VELOCITY_UNITS.items()
        if units.get(joint + VELOCITY_SUFFIX, rate) == rate
        and units.get(joint + FORCE_SUFFIX, FORCE_UNITS[unit]) == FORCE_UNITS[unit]
    ]


def _require_active_joints(names: Sequence[str], free: Sequence[str]) -> tuple[str, ...]:
    joints = find_active_joints(names, free)
    if not joints:
        raise RecordingError(
            f"no active joint among the columns {_quoted_list(names)}, give for each joint "
            f"its displacement, force and perhaps velocity, as in q1, q1{FORCE_SUFFIX}, "
            f"q1{VELOCITY_SUFFIX}"
        )
    return joints
