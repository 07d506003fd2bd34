"""What a recording does not tell, said in one line with what to do about it."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from crane.common.errors import RecordingError
from crane.machine import Machine
from crane.recordings.sensor_tolerances import HELD_JOINT_TOLERANCE, tolerance
from crane.recordings.timeseries import Table, table_column


class MissingMeasurementError(RecordingError):
    """Nothing tells where joints are, or what drives them.

    Args:
        message: What to give.
        joints: That may have been held instead.
    """

    def __init__(self, message: str, joints: Iterable[str]):
        super().__init__(message)
        self.joints = tuple(joints)


def check_columns_present(required: Iterable[Sequence[str]], present: Collection[str]) -> None:
    """See that of each of these columns any one is there.

    Raises:
        RecordingError: The message has all that are not.
    """
    absent = [" or ".join(map(repr, names)) for names in required if not set(names) & set(present)]
    if absent:
        raise RecordingError(f"columns are missing: {', '.join(absent)}")


class MissingMeasurements:
    """Collects what is missing, and refuses it at once.

    Args:
        machine: What was recorded.
        table: What there is.
    """

    def __init__(self, machine: Machine, table: Table):
        self._machine, self._table = machine, table
        self._errors: list[RecordingError] = []

    @contextmanager
    def collect_errors(self) -> Iterator[None]:
        """What goes wrong within is told later."""
        try:
            yield
        except RecordingError as error:
            self._errors.append(error)

    def collect_missing_columns(self, required: Iterable[Sequence[str]]) -> None:
        """Note which columns are not there, of each of these any one."""
        with self.collect_errors():
            check_columns_present(required, self._table.units)

    def raise_collected(self) -> None:
        """Tell all that was noted.

        Raises:
            RecordingError: Something was.
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
        """Where a joint may have been held: as recorded, or at home; "" of one that moved."""
        machine, unit = self._machine, self._machine.unit(joint)
        if self._table.units.get(joint) != unit:
            return f"{machine.home[machine.column(joint)]:.4g} (home)"
        low, place, high = np.quantile(table_column(self._table, joint), [0.005, 0.5, 0.995])
        return (
            f"{place:.4g}"
            if high - low <= 2 * tolerance(HELD_JOINT_TOLERANCE, machine, unit)
            else ""
        )
