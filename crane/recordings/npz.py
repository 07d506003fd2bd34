"""Columns in npz files, written sequentially and read with bounds.

An npz file is a zip archive of arrays, each with a header that declares type and shape. numpy
trusts the headers; here declared sizes are compared with the actual ones, and no objects are
unpickled.
"""

import lzma
import math
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np

from crane.common import scratch_arrays
from crane.common.errors import RecordingError
from crane.common.samples import Array

MAX_NUMBERS = 1 << 29  # numbers in a file: 4 GiB, in scratch files
MAX_COLUMNS = 4096
NUMERIC_KINDS = "biuf"  # kinds of numpy's types
_BLOCK_NUMBERS = 1 << 20  # numbers
_MAX_COMMENT_BYTES = 65535  # largest comment of a zip archive
_Header = tuple[tuple[int, ...], bool, np.dtype]  # shape, whether in Fortran order, type
_DAMAGE_ERRORS = (
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, RuntimeError, ValueError,
)  # fmt: skip


def write_columns(
    path: Path, names: Sequence[str], columns: Sequence[Array], comment: str
) -> None:
    """Write columns (N,) by name, and a comment.

    Raises:
        OSError: The file cannot be written.
    """
    with zipfile.ZipFile(path, "w") as archive:
        archive.comment = comment.encode(errors="surrogateescape")[:_MAX_COMMENT_BYTES]
        for name, column in zip(names, columns, strict=True):
            header = {"descr": "<f8", "fortran_order": False, "shape": column.shape}
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array_header_1_0(file, header)
                for start in range(0, len(column), scratch_arrays.BLOCK_SIZE):
                    file.write(
                        column[start : start + scratch_arrays.BLOCK_SIZE].astype("<f8").tobytes()
                    )
            scratch_arrays.release_pages()


def read_columns(path: Path) -> tuple[list[str], Array, str]:
    """Read names and values (N, columns) in the order of the file, and the comment.

    Raises:
        OSError: The file cannot be opened.
        RecordingError: The file is no npz file, is damaged or encrypted, or holds other than
            columns of equal length, or too many numbers. The message does not name the file.
    """
    with _open_archive(path) as archive:
        types = _declared_types(archive)
        count = max((shape[0] for shape, *_ in types.values() if len(shape) == 1), default=0)
        others = [
            f"'{name}' has the shape {shape} of {str(dtype)[:40]}"
            for name, (shape, _, dtype) in types.items()
            if shape != (count,) or dtype.kind not in NUMERIC_KINDS
        ]
        if others:
            raise RecordingError(f"{others[0]}, give ({count},) numbers per column")
        if not count:
            raise RecordingError("holds no samples, give an array per column")
        if count * len(types) > MAX_NUMBERS:
            raise RecordingError(
                f"declares {count} samples of {len(types)} columns, give at most {MAX_NUMBERS} "
                "numbers"
            )
        _check_sizes(archive, types)
        values = scratch_arrays.empty_array(count, len(types))
        for column, entry in zip(values.T, archive.infolist(), strict=True):
            _read_array(archive, entry, column)
            scratch_arrays.release_pages()
        return list(types), values, archive.comment.decode(errors="surrogateescape")


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read arrays of any shape by name; non-numeric arrays are returned empty, with their type.

    Raises:
        OSError: The file cannot be opened.
        RecordingError: The file is no npz file, is damaged or encrypted, or holds too many
            numbers. The message does not name the file.
    """
    with _open_archive(path) as archive:
        types = _declared_types(archive)
        numeric = {name: x for name, x in types.items() if x[2].kind in NUMERIC_KINDS}
        if (count := sum(math.prod(shape) for shape, *_ in numeric.values())) > MAX_NUMBERS:
            raise RecordingError(f"declares {count} numbers, give at most {MAX_NUMBERS}")
        _check_sizes(archive, numeric)
        found: dict[str, np.ndarray] = {name: np.empty(0, x[2]) for name, x in types.items()}
        entries = dict(zip(types, archive.infolist(), strict=True))
        for name, (shape, is_fortran, _) in numeric.items():
            values = scratch_arrays.empty_array(math.prod(shape), 1)[:, 0]
            _read_array(archive, entries[name], values)
            found[name] = values.reshape(shape, order="F" if is_fortran else "C")
        return found


@contextmanager
def _open_archive(path: Path) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except _DAMAGE_ERRORS as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0][:80]
        raise RecordingError(
            f"is no npz file of arrays ({reason}), give one as numpy.savez writes it"
        ) from None


def _declared_types(archive: zipfile.ZipFile) -> dict[str, _Header]:
    entries = archive.infolist()
    if len(entries) > MAX_COLUMNS:
        raise RecordingError(f"holds {len(entries)} arrays, give at most {MAX_COLUMNS}")
    types: dict[str, _Header] = {}
    for entry in entries:
        name = _entry_name(entry)
        if name in types:
            raise RecordingError(f"column '{name}' is there twice, rename or remove one")
        if entry.flag_bits & 1:
            raise RecordingError(f"'{name}' is encrypted, save the file without a password")
        with archive.open(entry) as file:
            types[name] = _read_header(name, file)
    return types


def _check_sizes(archive: zipfile.ZipFile, types: Mapping[str, _Header]) -> None:
    """Compare the sizes in the headers with the actual ones."""
    for entry in archive.infolist():
        shape, _, dtype = types.get(_entry_name(entry), ((0,), False, np.dtype(float)))
        if entry.file_size < math.prod(shape) * dtype.itemsize:
            raise RecordingError(f"'{_entry_name(entry)}' is cut short, save the file again")


def _read_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, values: Array) -> None:
    """Fill an array (N,) with the numbers of an entry."""
    name = _entry_name(entry)
    with archive.open(entry) as file:
        _, _, dtype = _read_header(name, file)
        for start in range(0, len(values), _BLOCK_NUMBERS):
            part = values[start : start + _BLOCK_NUMBERS]
            data = file.read(len(part) * dtype.itemsize)
            if len(data) != len(part) * dtype.itemsize:
                raise RecordingError(f"'{name}' is cut short, save the file again")
            with np.errstate(over="ignore", invalid="ignore"):  # reported when values are checked
                part[:] = np.frombuffer(data, dtype)
        if file.read(1):
            raise RecordingError(f"'{name}' holds more than it declares, save the file again")


def _entry_name(entry: zipfile.ZipInfo) -> str:
    return entry.filename.removesuffix(".npy")


def _read_header(name: str, file: IO[bytes]) -> _Header:
    """The header of an array; the data follow in the file."""
    try:
        if np.lib.format.read_magic(file) != (1, 0):  # other versions have long headers
            raise ValueError("not of numbers alone")
        shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(file)
    except (*_DAMAGE_ERRORS, OSError):
        raise
    except Exception as error:  # any error from evaluating a literal
        raise ValueError(type(error).__name__) from None
    if any(length < 0 for length in shape):
        raise RecordingError(f"'{name}' has the shape {shape}, save the file again")
    return shape, is_fortran, dtype
