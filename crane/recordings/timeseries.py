"""Tables of time series: columns with names and units, their checks, and how they are written.

A CSV file has comment lines `# key: value`, then one header row `time [s],name [unit],...`, then
one row per sample. The comment `# crane samples: N` gives the number of samples, so that a
truncated file is recognized. A unit may be omitted, except that of time. Numbers are written with
the fewest digits that give the same float64 again.
"""

import csv
import re
import stat
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from crane.common import scratch_arrays
from crane.common.atomic_output import replace_file
from crane.common.errors import RecordingError, check_name, prefix_location
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.common.unit_conversions import accepted_units as accepted_units
from crane.description.sensors import (
    FORCE_SUFFIX,
    FORCE_UNITS,
    VELOCITY_SUFFIX,
    VELOCITY_UNITS,
)
from crane.description.sensors import TIME as TIME
from crane.recordings import npz

_NAME_PATTERN = re.compile(r'[^\s,\[\]"#](?:[^,\[\]"]*[^\s,\[\]"])?')
SAMPLE_COUNT_NOTE = "crane samples"  # note with the number of samples
BLOCK_ROWS = 4096
_MAX_LISTED = 40  # names in a message


@dataclass(frozen=True, eq=False, repr=False)
class Table(OneLineRepr):
    """Table of columns with units and notes.

    Attributes:
        units: Unit of each column by name, in the order of the columns; "" if none is given. A
            table that was read has SI units, except for units that are not converted.
        values: Samples (N, columns).
        notes: Comment lines by key.
    """

    units: dict[str, str]
    values: Array
    notes: dict[str, str]


@contextmanager
def located_errors(path: str | Path, wanted: str = "another file") -> Iterator[None]:
    """Context in which errors about a file name it.

    Args:
        path: The file.
        wanted: What to give instead of a file that cannot be read.

    Raises:
        RecordingError: The block raises a `RecordingError`, or cannot read the file.
    """
    try:
        yield
    except RecordingError as error:
        raise RecordingError(prefix_location(str(path), error)) from None
    except csv.Error as error:
        raise RecordingError(f"{path}: no table of numbers ({error}), correct it") from None
    except UnicodeError:
        raise RecordingError(f"{path}: is not text, give a file in UTF-8") from None
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise RecordingError(f"{path}: {reason}, give {wanted}") from None


def check_regular_file(path: Path) -> None:
    """Check that a path is a regular file, no device or pipe.

    Raises:
        OSError: It does not exist.
        RecordingError: It is not a regular file.
    """
    if not stat.S_ISREG(mode := path.stat().st_mode) and not stat.S_ISDIR(mode):
        raise RecordingError("is no plain file, copy it into one")


def check_column_name(name: str, unit: str) -> None:
    """Check that a header can contain a name and a unit.

    Raises:
        RecordingError: They contain invalid characters.
    """
    for what, text in ({"name": name, "unit": unit} if unit else {"name": name}).items():
        if not _NAME_PATTERN.fullmatch(text) or not text.isprintable():
            raise RecordingError(
                f"column '{name}': {text!r} cannot be the {what} of a column, "
                f"use no commas, brackets, quotes or outer blanks"
            )


def table_column(table: Table, name: str, unit: str | None = None) -> Array:
    """Column (N,) of a table, optionally with a check of its unit.

    Raises:
        RecordingError: It has another unit.
    """
    if unit is not None:
        check_unit(name, table.units[name], accepted_units(unit))
    return table.values[:, list(table.units).index(name)]


def write_table(path: str | Path, table: Table) -> None:
    """Write a table as CSV; NaN becomes an empty cell.

    Raises:
        OutputError: The file cannot be written.
    """
    write_columns(path, table.units, list(table.values.T), table.notes)


def write_columns(
    path: str | Path, units: Mapping[str, str], columns: Sequence[Array], notes: Mapping[str, str]
) -> None:
    """Write columns (N,) as CSV, without assembling a table.

    Raises:
        OutputError: The file cannot be written.
    """
    head = [
        *_comment_lines({**notes, SAMPLE_COUNT_NOTE: str(len(columns[0]))}),
        ",".join(_column_headings(units)),
    ]
    with (
        replace_file(path) as part,
        part.open("w", encoding="utf-8", errors="surrogateescape", newline="\n") as file,
    ):
        file.write("\n".join(head) + "\n")
        for start in range(0, len(columns[0]), BLOCK_ROWS):
            rows = np.column_stack([x[start : start + BLOCK_ROWS] for x in columns])
            scratch_arrays.release_pages()
            # formatting takes most of the time: constant columns are formatted once per block
            bits = rows.view(np.int64)
            same = (bits == bits[0]).all(axis=0)
            first = zip(rows[0].tolist(), same, strict=True)
            cells = [repr(x) if one else "%r" for x, one in first]
            line = ",".join(cells) + "\n"
            text = line * len(rows) % tuple(rows[:, ~same].ravel().tolist())
            file.write(text.replace("nan", "") if np.isnan(rows).any() else text)


def write_npz(
    path: str | Path, units: Mapping[str, str], columns: Sequence[Array], notes: Mapping[str, str]
) -> None:
    """Write columns (N,) as npz: arrays with CSV headings as names, notes in the comment.

    Raises:
        OutputError: The file cannot be written.
    """
    with replace_file(path) as part:
        npz.write_columns(part, _column_headings(units), columns, "\n".join(_comment_lines(notes)))


def _comment_lines(notes: Mapping[str, str]) -> list[str]:
    return [f"# {key}: {value}" if value else f"# {key}" for key, value in notes.items()]


def _column_headings(units: Mapping[str, str]) -> list[str]:
    return [f"{x} [{unit}]" if unit else x for x, unit in units.items()]


def parse_heading(cell: str) -> tuple[str, str]:
    """Name and unit of a heading 'name [unit]'; empty if it is malformed."""
    name, bracket, unit = cell.strip().partition("[")
    if bracket:
        if not unit.endswith("]"):
            return "", ""
        unit = unit[:-1]
    if any(mark in part for part in (name, unit) for mark in "[]"):
        return "", ""
    return name.strip(), unit.strip()


def check_unit(column: str, unit: str, allowed: Iterable[str]) -> None:
    """Check that a column has one of the allowed units.

    Raises:
        RecordingError: It has not.
    """
    if unit not in allowed:
        found = f"is in [{unit}]" if unit else "has no unit"
        wanted = " or ".join(f"'{column} [{x}]'" for x in allowed)
        raise RecordingError(f"column '{column}' {found}, give {wanted}")


def check_columns_present(required: Iterable[Sequence[str]], present: Collection[str]) -> None:
    """Check that one of each group of alternative columns is present.

    Raises:
        RecordingError: Groups are missing; the message lists them.
    """
    absent = [" or ".join(map(repr, names)) for names in required if not set(names) & set(present)]
    if absent:
        raise RecordingError(f"columns are missing: {', '.join(absent)}")


def time_derivative(x: Array, time: Array) -> Array:
    """Central differences (N,) of x (N,); zero if time does not increase."""
    scratch_arrays.release_pages()
    if len(x) < 2 or not (np.diff(time) > 0).all():
        return np.zeros_like(x)
    return np.gradient(x, time)


def check_finite(columns: Mapping[str, Array]) -> None:
    """Check that columns (N,) contain finite numbers.

    Raises:
        RecordingError: A column does not.
    """
    for name, values in columns.items():
        if not np.isfinite(values).all():
            sample = int(np.argmin(np.isfinite(values)))
            raise RecordingError(
                f"'{name}' is {values[sample]} at sample {sample}, give finite numbers"
            )


def checked_array(
    what: str, value: ArrayLike, shape: tuple[int, ...], copy: bool, names: Sequence[str] = ()
) -> Array:
    """Convert to a float64 array of a shape, copied to contiguous memory if `copy` is set."""
    try:
        order: Literal["C", "K"] = "C" if copy or len(shape) == 1 else "K"
        array = np.array(value, dtype=np.float64, order=order, copy=copy or None)
    except (TypeError, ValueError):
        raise RecordingError(f"{what} is not an array of numbers, give {shape}") from None
    if array.shape != shape:
        columns = f", a column each for {quoted_list(names)}" if names else ""
        raise RecordingError(f"{what} has the shape {array.shape}, give {shape}{columns}")
    return array


def quoted_list(names: Iterable[str]) -> str:
    """List of quoted names for a message, with at most 40 of them."""
    names = list(names)
    more = [f"{len(names) - _MAX_LISTED} more"] if len(names) > _MAX_LISTED else []
    return ", ".join([f"'{name}'" for name in names[:_MAX_LISTED]] + more) or "none"


def free_force_message(joint: str, tau: Array) -> str:
    """Message about a force (N,) of a free joint that is not zero."""
    sample = int(np.argmax(tau != 0))
    return (
        f"'{joint}' is free and has the force {tau[sample]:.3g} at sample {sample}: leave the "
        "force out, or name the joint as active"
    )


def require_active_joints(names: Sequence[str], free: Sequence[str]) -> tuple[str, ...]:
    """Active joints among columns, at least one: those with a force column, and free joints.

    Raises:
        RecordingError: There is none, or a joint has velocity and force, but no coordinate.
    """
    available = set(names)
    for stem in (x.removesuffix(FORCE_SUFFIX) for x in names if x.endswith(FORCE_SUFFIX)):
        if stem not in available and stem + VELOCITY_SUFFIX in available:
            raise RecordingError(
                f"column '{stem}' is missing beside '{stem}{VELOCITY_SUFFIX}', "
                f"'{stem}{FORCE_SUFFIX}', add it, or rename those if '{stem}' is not an active "
                "joint"
            )
    for x in free:
        check_name(x, names, f"column '{x}' of a free joint is missing", RecordingError)
    joints = tuple(x for x in names if x + FORCE_SUFFIX in available or x in free)
    if not joints:
        raise RecordingError(
            f"no active joint among the columns {quoted_list(names)}, give for each joint "
            f"its displacement, force and perhaps velocity, as in q1, q1{FORCE_SUFFIX}, "
            f"q1{VELOCITY_SUFFIX}"
        )
    return joints


def matching_units(joint: str, units: Mapping[str, str]) -> list[str]:
    """Units of a joint that match the units of its velocity and force columns."""
    return [
        unit
        for unit, rate in VELOCITY_UNITS.items()
        if units.get(joint + VELOCITY_SUFFIX, rate) == rate
        and units.get(joint + FORCE_SUFFIX, FORCE_UNITS[unit]) == FORCE_UNITS[unit]
    ]
