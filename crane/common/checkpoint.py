"""Checkpoints: finished parts of a long computation in a CSV file, from which it can go on.

A row is appended as soon as it is known, and it belongs to the file as soon as its line is
complete: the process may end at any instant. The file begins with digests of everything that the
rows depend on, so that rows of another computation are refused. A computation holds a lock on its
file.
"""

import csv
import hashlib
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import numpy as np

import crane
from crane.common.atomic_output import writing_error
from crane.common.errors import CraneError, InputError, OutputError, TerminatedWorkerError
from crane.common.temporary_files import try_lock

_PASSING_ERRORS = TerminatedWorkerError, OutputError  # of this run, not of what is computed


class Checkpoint:
    """Rows of a result that is being computed; a context that holds their file open.

    The file stays, also after an interruption. It is removed if it has no row, by an error that
    would come again, and by `Result.write`, which replaces it by the result.

    Args:
        path: The file; its rows are read if it exists.
        dependencies: All that the rows depend on by what it is called in an error: data classes,
            mappings, sequences, arrays, numbers, texts, functions.
        columns: Headings.
        key_size: Number of the first cells of a row that say what it is the result of.

    Attributes:
        rows: The other cells of each row, by the first ones.

    Raises:
        InputError: The file is no checkpoint of this computation, or another process is at it.
        OutputError: The file cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        dependencies: Mapping[str, Any],
        columns: Iterable[str],
        key_size: int,
    ):
        self._path, self._key_size, self._has_rows = Path(path), key_size, False
        self.rows: dict[tuple[str, ...], list[str]] = {}
        self._missing_folders = [x for x in self._path.absolute().parents if not x.exists()]
        notes = {
            name: hashlib.sha256(json.dumps(_plain(value)).encode()).hexdigest()
            for name, value in dependencies.items()
        }
        notes["version of crane"] = crane.__version__
        lines = [f"# {name}: {text}\n" for name, text in notes.items()]
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._file = open(self._path, "a+b", buffering=0)  # noqa: SIM115  see `__exit__`
            with ExitStack() as stack:
                stack.callback(self._file.close)
                self._read("".join([_FIRST_LINE, *lines, _csv_line(columns)]).encode())
                stack.pop_all()
        except OSError as error:
            raise writing_error(self._path, error) from error

    def _read(self, head: bytes) -> None:
        if not self._path.is_file():
            raise InputError(f"{self._path}: is no plain file, give another name")
        if not try_lock(self._file.fileno()):
            raise InputError(f"{self._path}: another process computes this, wait for its end")
        self._file.seek(0)
        content = self._file.read()
        content = content[: content.rfind(b"\n") + 1]  # without a line that was cut short
        if head.startswith(content):  # new, or killed before it was complete
            self._file.truncate(0)
            self._file.write(head)
            return
        self._check_head(head.decode(), content.decode(errors="replace"))
        self._file.truncate(len(content))
        for line in content[len(head) :].decode(errors="replace").splitlines():
            row = next(csv.reader([line]))
            self.rows[tuple(row[: self._key_size])] = row[self._key_size :]
        self._has_rows = bool(self.rows)

    def _check_head(self, head: str, content: str) -> None:
        if content.startswith(head):
            return
        if not content.startswith(_FIRST_LINE):
            raise InputError(f"{self._path}: is no unfinished result, give another file")
        lines = content.splitlines()
        name, colon, _ = next(x for x in head.splitlines() if x not in lines).partition(": ")
        raise InputError(
            f"{self._path}: was begun with other {name[2:] if colon else 'columns'}: go on with "
            "the same, or begin anew with --force or in another place"
        )

    def append(self, key: Sequence[object], cells: Sequence[object]) -> None:
        """Append a row.

        Raises:
            OutputError: It cannot be written.
        """
        try:
            self._file.write(_csv_line((*key, *cells)).encode())
        except OSError as error:
            raise writing_error(self._path, error) from error
        self._has_rows = True

    def __enter__(self) -> "Checkpoint":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, _: object) -> None:
        would_repeat = isinstance(error, CraneError) and not isinstance(error, _PASSING_ERRORS)
        with self._file, suppress(OSError):  # or something else is in a folder
            if self._has_rows and not would_repeat:
                return
            self._path.unlink()
            for folder in self._missing_folders:
                folder.rmdir()


class NoCheckpoint(Checkpoint):
    """A checkpoint without a file: it has no rows, and forgets those that it is given."""

    def __init__(self) -> None:
        self.rows = {}

    def append(self, key: Sequence[object], cells: Sequence[object]) -> None:
        """See `Checkpoint`."""

    def __exit__(self, kind: type | None, error: BaseException | None, _: object) -> None:
        """Leave no file."""


def open_checkpoint(
    path: str | Path | None, dependencies: Mapping[str, Any], columns: Iterable[str], key_size: int
) -> Checkpoint:
    """A `Checkpoint`, in no file for the path None."""
    return NoCheckpoint() if path is None else Checkpoint(path, dependencies, columns, key_size)


_FIRST_LINE = "# unfinished: the command that began this goes on with --resume\n"


def _csv_line(cells: Iterable[object]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(cells)
    return line.getvalue()


def _plain(value: Any) -> Any:
    """What determines a value, as JSON knows it."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray):
        return [value.dtype.str, value.shape, hashlib.sha256(value.tobytes()).hexdigest()]
    if isinstance(value, Mapping):
        return [[_plain(key), _plain(item)] for key, item in value.items()]
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, frozenset):
        return sorted(map(repr, value))
    if isinstance(value, FunctionType):
        return _plain(value.__code__)
    if isinstance(value, CodeType):
        return _plain((value.co_name, value.co_code.hex(), value.co_names, value.co_consts))
    if is_dataclass(value):
        return [_plain(getattr(value, field.name)) for field in fields(value)]
    return (
        [type(value).__name__, _plain(vars(value))] if hasattr(value, "__dict__") else repr(value)
    )
