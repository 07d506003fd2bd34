"""What a recording does not tell, said in one line with what to do about it."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from crane.common.errors import RecordingError
from crane.machine import Machine
from crane.recordings.timeseries import Table, column
from crane.recordings.tolerances import HELD, allowed


class MissingError(RecordingError):
    """Nothing tells where joints are, or what drives them.

    Args:
        message: What to give.
        joints: That may have been held instead.
    """

    def __init__(self, message: str, joints: Iterable[str]):
        super().__init__(message)
        self.joints = tuple(joints)


def check_there(needs: Iterable[Sequence[str]], there: Collection[str]) -> None:
    """See that of each of these columns any one is there.

    Raises:
        RecordingError: The message has all that are not.
    """
    absent = [" or ".join(map(repr, names)) for names in needs if not set(names) & set(there)]
    if absent:
        raise RecordingError(f"columns are missing: {', '.join(absent)}")


class Missing:
    """Collects what is missing, and refuses it at once.

    Args:
        machine: What was recorded.
        table: What there is.
    """

    def __init__(self, machine: Machine, table: Table):
        self._machine, self._table = machine, table
        self._errors: list[RecordingError] = []

    @contextmanager
    def noted(self) -> Iterator[None]:
        """What goes wrong within is told later."""
        try:
            yield
        except RecordingError as error:
            self._errors.append(error)

    def note_absent(self, needs: Iterable[Sequence[str]]) -> None:
        """Note which columns are not there, of each of these any one."""
        with self.noted():
            check_there(needs, self._table.units)

    def refuse(self) -> None:
        """Tell all that was noted.

        Raises:
            RecordingError: Something was.
        """
        if not self._errors:
            return
        joints = dict.fromkeys(
            joint for error in self._errors if isinstance(error, MissingError)
            for joint in error.joints
        )  # fmt: skip
        told = "; ".join(map(str, self._errors))
        held = [f"--lock {joint}={place}" for joint in joints if (place := self._place(joint))]
        if held:
            told += f"; or lock what was held, where it was: {' '.join(held)}"
        raise RecordingError(told)

    def _place(self, joint: str) -> str:
        """Where a joint may have been held: as recorded, or at home; "" of one that moved."""
        machine, unit = self._machine, self._machine.unit(joint)
        if self._table.units.get(joint) != unit:
            return f"{machine.home[machine.column(joint)]:.4g} (home)"
        low, place, high = np.quantile(column(self._table, joint), [0.005, 0.5, 0.995])
        return f"{place:.4g}" if high - low <= 2 * allowed(HELD, machine, unit) else ""
