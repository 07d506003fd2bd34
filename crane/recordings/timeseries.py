"""Tables of time series: columns with names and units, and how they are written.

A CSV file has comment lines `# key: value`, then one header row `time [s],name [unit],...`, then
one row per sample. The comment `# crane samples: N` gives the number of samples, so that a
truncated file is recognized. A unit may be omitted, except that of time. Numbers are written with
the fewest digits that give the same float64 again.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common import scratch_arrays
from crane.common.atomic_output import replace_file
from crane.common.errors import RecordingError
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.common.units import accepted_units as accepted_units
from crane.description.sensors import TIME as TIME
from crane.recordings import npz

_NAME_PATTERN = re.compile(r'[^\s,\[\]"#](?:[^,\[\]"]*[^\s,\[\]"])?')
SAMPLE_COUNT_NOTE = "crane samples"  # note with the number of samples
BLOCK_ROWS = 4096


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
    with replace_file(path) as part, part.open("w", encoding="utf-8", newline="\n") as file:
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
