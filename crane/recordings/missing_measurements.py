"""Missing measurements, collected into one error, and tolerances of sensors."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np

from crane.common.errors import RecordingError
from crane.machine.machine import Machine
from crane.recordings.timeseries import Table, table_column

AGREEMENT_TOLERANCE = {"rad": 5e-3, "m": 5e-4}  # between sensors of one quantity
HELD_JOINT_TOLERANCE = {"rad": 0.02, "m": 2e-3}  # of a joint that is held


class MissingMeasurementError(RecordingError):
    """Coordinates or forces of joints are not determined by a recording.

    Args:
        message: Message with the required columns.
        joints: Joints that may have been held.
    """

    def __init__(self, message: str, joints: Iterable[str]):
        super().__init__(message)
        self.joints = tuple(joints)


def check_columns_present(required: Iterable[Sequence[str]], present: Collection[str]) -> None:
    """Check that one of each group of alternative columns is present.

    Raises:
        RecordingError: Groups are missing; the message lists them.
    """
    absent = [" or ".join(map(repr, names)) for names in required if not set(names) & set(present)]
    if absent:
        raise RecordingError(f"columns are missing: {', '.join(absent)}")


class MissingMeasurements:
    """Collector of errors about missing measurements, raised as one error.

    Args:
        machine: The recorded machine.
        table: Table of quantities.
    """

    def __init__(self, machine: Machine, table: Table):
        self._machine, self._table = machine, table
        self._errors: list[RecordingError] = []

    @contextmanager
    def collect_errors(self) -> Iterator[None]:
        """Collect a recording error of the block, to be raised later."""
        try:
            yield
        except RecordingError as error:
            self._errors.append(error)

    def collect_missing_columns(self, required: Iterable[Sequence[str]]) -> None:
        """Collect missing groups of alternative columns."""
        with self.collect_errors():
            check_columns_present(required, self._table.units)

    def raise_collected(self) -> None:
        """Raise all collected errors as one.

        Raises:
            RecordingError: There are collected errors.
        """
        if not self._errors:
            return
        joints = dict.fromkeys(
            joint for error in self._errors if isinstance(error, MissingMeasurementError)
            for joint in error.joints
        )  # fmt: skip
        message = "; ".join(map(str, self._errors))
        lock_options = [
            f"--lock {joint}={place}" for joint in joints if (place := self._held_position(joint))
        ]
        if lock_options:
            message += f"; or lock what was held, where it was: {' '.join(lock_options)}"
        raise RecordingError(message)

    def _held_position(self, joint: str) -> str:
        """Text of the coordinate at which a joint may have been held; "" if it moved."""
        machine, unit = self._machine, self._machine.unit(joint)
        if self._table.units.get(joint) != unit:
            return f"{machine.home[machine.column(joint)]:.4g} (home)"
        low, place, high = np.quantile(table_column(self._table, joint), [0.005, 0.5, 0.995])
        return (
            f"{place:.4g}"
            if high - low <= 2 * tolerance(HELD_JOINT_TOLERANCE, machine, unit)
            else ""
        )


def tolerance(tolerances: Mapping[str, float], machine: Machine, unit: str) -> float:
    """Tolerance in a unit, scaled by the characteristic length for machines below 1 m."""
    return tolerances[unit] * (
        min(machine.closure.characteristic_length, 1.0) if unit == "m" else 1.0
    )
