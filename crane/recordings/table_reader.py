"""Reading of tables from CSV and npz files, with bounds and messages that name the line.

Tables are in SI units: columns in bar, deg, mm and other units of
`crane.common.unit_conversions` are converted, those in units that are not known stay as they are.
"""

import codecs
import csv
import io
import itertools
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from crane.common import scratch_arrays
from crane.common.errors import RecordingError, warn
from crane.common.number_text import parse_float
from crane.common.samples import Array
from crane.common.unit_conversions import accepted_units, column_conversion
from crane.description.sensors import TIME
from crane.recordings.npz import MAX_COLUMNS, MAX_NUMBERS, read_arrays, read_columns
from crane.recordings.rotation_columns import convert_quaternions
from crane.recordings.timeseries import (
    BLOCK_ROWS,
    SAMPLE_COUNT_NOTE,
    Table,
    check_column_name,
    check_regular_file,
    check_unit,
    located_errors,
    parse_heading,
)

_PATH_ERRORS = "surrogateescape"  # how Python reads bytes of a path that are no text
_UTF8_ENCODING = "utf-8-sig"  # with or without a byte order mark
_BLOCK_BYTES = 1 << 20  # bytes of a block, and largest length of a line
_MAX_HEADING_LENGTH, _MAX_NAME_LENGTH = 1 << 16, 200  # characters
_TRUNCATION_HINT = f"copy it again, or remove '# {SAMPLE_COUNT_NOTE}' if that is meant"
_MAX_VALUE = 1e30  # in SI units; computations with larger values overflow


def read_table(path: str | Path) -> Table:
    """Read a table from a CSV or npz file.

    Raises:
        RecordingError: As for `read_csv` and `read_npz`, or the file has another suffix.
    """
    path = Path(path)
    if path.suffix.lower() == ".csv":
        return read_csv(path)
    if path.suffix.lower() != ".npz":
        missing = "" if path.exists() else "no such file, "
        raise RecordingError(f"{path}: {missing}a recording is a .csv or .npz file, name one")
    return read_npz(path)


def read_csv(path: str | Path) -> Table:
    """Read a CSV table with unique column names, finite numbers and strictly increasing time.

    Raises:
        RecordingError: The file does not exist or is not valid; the message names the file, the
            line or column, and the remedy.
    """
    path = Path(path)
    with located_errors(path, "the path of a CSV file"):
        check_regular_file(path)
        lines = _count_lines(path)
        notes, heading, line = _read_header(path)
        units = _parse_header(heading)
        if (lines - line) * len(units) > MAX_NUMBERS:
            raise RecordingError(
                f"holds {lines - line} lines of {len(units)} columns, give at most "
                f"{MAX_NUMBERS} numbers"
            )
        _check_last_line(path, notes)
        rows = partial(_text_rows, path, _UTF8_ENCODING, line)
        values = _read_values(rows, line, lines, list(units), ",", units[TIME])
        _check_sample_count(values, notes)
        return _convert_to_si(
            Table(units, values, {key: x for key, x in notes.items() if key != SAMPLE_COUNT_NOTE})
        )


def read_npz(path: Path) -> Table:
    """Read an npz table of arrays (N,) of equal length, with CSV headings as names.

    Raises:
        RecordingError: The file does not exist, or as for `crane.recordings.npz.read_columns`.
    """
    with located_errors(path, "the path of an npz file"):
        check_regular_file(path)
        names, values, comment = read_columns(path)
    lines = (line.strip() for line in comment.splitlines())
    return build_table(
        path, names, values, dict(_parse_note(x) for x in lines if x.startswith("#"))
    )


def read_log_arrays(
    path: Path, wanted: Iterable[str], first_line: str = ""
) -> dict[str, np.ndarray]:
    """Read arrays of an npz file or CSV of another program by name, without conversion.

    A CSV has columns separated by commas, semicolons or tabs. If the separator is no comma and no
    number has a point, commas are decimal separators. The encoding is UTF-8, UTF-16 with a byte
    order mark, or else Windows-1252. Only the wanted columns need to hold numbers in every row.

    Args:
        path: The file.
        wanted: Names of columns that are used, or their numbers, as in '#2'; others are empty.
        first_line: Line on which the samples begin, and above which any row may name columns;
            default below the first row, which is the header row.

    Raises:
        RecordingError: The file does not exist or is not valid.
    """
    with located_errors(path, "the path of a CSV or npz file"):
        check_regular_file(path)
        if path.suffix.lower() == ".npz":
            return read_arrays(path)
        lines = _count_lines(path)
        encoding = _detect_encoding(path)
        if not first_line:
            notes, *headings, line = _read_header(path, encoding)
        elif first_line.isdecimal() and 0 < int(first_line) <= lines:
            notes, line = {}, int(first_line) - 1
            headings = list(itertools.islice(_text_rows(path, encoding, 0), line))
        else:
            raise RecordingError(f"has {lines} lines, samples cannot begin on line {first_line}")
        _check_last_line(path, notes, encoding)
        text_rows = partial(_text_rows, path, encoding, line)
        first_row = next(filter(str.strip, text_rows()), "").rstrip("\r\n")
        separator = max(",;\t", key=("".join(headings) or first_row).count)
        positions = _column_positions(headings, first_row, separator)
        if not first_line and '"' not in first_row:
            _check_width(
                path,
                next(csv.reader(headings, delimiter=separator)),
                cells=first_row.rstrip(separator).count(separator) + 1,
            )
        used = {name: min(positions[name]) for name in wanted if name in positions}
        ambiguous = next((name for name in used if len(positions[name]) > 1), None)
        if ambiguous:
            raise RecordingError(
                f"'{ambiguous}' heads {len(positions[ambiguous])} columns, give the number of one "
                f"instead, as in '#{used[ambiguous] + 1}'"
            )
        rows: Callable[[], Iterator[str]] = text_rows
        if separator != "," and not any("." in x for x in text_rows()):  # decimal commas
            rows = lambda: (x.replace(",", ".") for x in text_rows())  # noqa: E731
        arrays = dict.fromkeys(filter(None, positions), np.zeros(0))
        if used:
            values = _read_values(rows, line, lines, list(used), separator, None, [*used.values()])
            _check_sample_count(values, notes)
            arrays |= dict(zip(used, values.T, strict=True))
        return arrays


def _check_width(path: Path, names: Sequence[str], cells: int) -> None:
    """Refuse a first row with more cells than names; warn of one with fewer."""
    if cells > (count := len(names)):
        raise RecordingError(f"{count} names head {cells} columns, name each in the header row")
    if 1 < cells < count:
        warn(f"{path}: {count} names head {cells} columns, '{names[-1]}' is taken as empty", 5)


def _column_positions(
    headings: Sequence[str], first_row: str, separator: str
) -> dict[str, set[int]]:
    """Positions of columns, counted from 0, by number and by the names above the samples."""
    positions = {f"#{i + 1}": {i} for i in range(first_row.count(separator) + 1)}
    for position, cell in itertools.chain.from_iterable(
        map(enumerate, csv.reader(headings, delimiter=separator))
    ):
        positions.setdefault(cell.strip(), set()).add(position)
    return positions


def build_table(path: Path, names: Iterable[str], values: Array, notes: dict[str, str]) -> Table:
    """Table in SI units of columns (N, columns) named 'name [unit]'; the path is for messages.

    Raises:
        RecordingError: A name is no valid heading.
    """
    heading = io.StringIO()
    csv.writer(heading).writerow(names)
    with located_errors(path):
        return _convert_to_si(Table(_parse_header(heading.getvalue().rstrip()), values, notes))


def _count_lines(path: Path) -> int:
    """Number of lines of a text file; raises an error for a line that is too long."""
    line_count, line_bytes = 0, 0  # complete lines, bytes of the incomplete one
    with path.open("rb") as file:
        while block := file.read(_BLOCK_BYTES):
            ends = block.replace(b"\r", b"\n")
            first, last = ends.find(b"\n"), ends.rfind(b"\n")
            line_bytes += first if first >= 0 else len(block)
            if line_bytes > _BLOCK_BYTES:
                raise RecordingError(
                    f"line {line_count + 1} has more than {_BLOCK_BYTES} bytes, write one line "
                    "per sample"
                )
            line_count += block.count(b"\n") or block.count(b"\r")
            if last >= 0:
                line_bytes = len(block) - last - 1
    return line_count + (line_bytes > 0)


def _check_last_line(path: Path, notes: Mapping[str, str], encoding: str = _UTF8_ENCODING) -> None:
    """Check that the last line of a file with a sample count is complete.

    Raises:
        RecordingError: It has no line end, so a number may be truncated.
    """
    if SAMPLE_COUNT_NOTE not in notes:
        return
    with path.open("rb") as file:
        file.seek(-2 if encoding == "utf-16" else -1, os.SEEK_END)
        if file.read().strip(b"\0") not in (b"\r", b"\n"):
            raise RecordingError(f"is cut short in its last line, {_TRUNCATION_HINT}")


def _check_sample_count(values: Array, notes: Mapping[str, str]) -> None:
    """Check the number of samples against the sample count of the file.

    Raises:
        RecordingError: They differ.
    """
    declared = notes.get(SAMPLE_COUNT_NOTE, str(len(values)))
    if declared != str(len(values)):
        raise RecordingError(
            f"has {len(values)} of the {declared[:20]} samples that it says, {_TRUNCATION_HINT}"
        )


@np.errstate(over="ignore")  # infinite values are reported with their name later
def _convert_to_si(table: Table) -> Table:
    units, values = dict(table.units), table.values
    for i, (name, unit) in enumerate(table.units.items()):
        scratch_arrays.release_pages()
        units[name], size = column_conversion(unit)
        if size != 1:  # two factors, so that 12.3 mm is 0.0123 m exactly
            values[:, i] = values[:, i] * float(size.numerator) / float(size.denominator)
        column = values[:, i]
        is_too_large = np.isfinite(column) & (np.abs(column) > _MAX_VALUE)
        if is_too_large.any():
            sample = int(np.argmax(is_too_large))
            raise RecordingError(
                f"'{name}' is {column[sample]:.3g} at sample {sample}, beyond all that is "
                "measured, correct it"
            )
    return convert_quaternions(Table(units, values, table.notes))


def _detect_encoding(path: Path) -> str:
    with path.open("rb") as file:
        if file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
            return "utf-16"
    try:
        with path.open(encoding=_UTF8_ENCODING) as text:
            for _ in text:
                pass
    except UnicodeDecodeError:
        return "cp1252"
    return _UTF8_ENCODING


def _text_rows(path: Path, encoding: str, header: int) -> Iterator[str]:
    """Lines of a file below its header row."""
    with path.open(encoding=encoding, errors=_PATH_ERRORS) as file:
        yield from itertools.islice(file, header, None)


def _read_header(path: Path, encoding: str = _UTF8_ENCODING) -> tuple[dict[str, str], str, int]:
    """Read notes, the header row, and its line number."""
    notes: dict[str, str] = {}
    character_count = 0  # characters
    with path.open(encoding=encoding, errors=_PATH_ERRORS) as file:
        for line, text in enumerate(file, start=1):
            character_count += len(text)
            text = text.strip()
            if text.startswith("#"):
                key, value = _parse_note(text)
                notes[key] = value
            elif text:
                if len(text) > _MAX_HEADING_LENGTH:
                    raise RecordingError(
                        f"line {line}, the header row, has {len(text)} characters, give at most "
                        f"{_MAX_HEADING_LENGTH}"
                    )
                text.encode()  # only notes may hold paths that are no text
                return notes, text, line
            if character_count > _BLOCK_BYTES:
                raise RecordingError(
                    f"has no header row within {_BLOCK_BYTES} characters, name the columns before"
                )
    raise RecordingError("is empty, write a header row and one row per sample")


def _parse_note(text: str) -> tuple[str, str]:
    key, _, value = text.removeprefix("#").partition(":")
    return key.strip(), value.strip()


def _parse_header(heading: str) -> dict[str, str]:
    """Names and units of the columns from the header row."""
    for other in (";", "\t"):
        if other in heading and "," not in heading:
            raise RecordingError(f"separates columns by {other!r}, use commas")
    try:
        cells = next(csv.reader([heading]))
    except csv.Error as error:
        raise RecordingError(f"has an invalid header row ({error}), correct it") from None
    if len(cells) > MAX_COLUMNS:
        raise RecordingError(f"has {len(cells)} columns, give at most {MAX_COLUMNS}")
    if all(_parse_number(cell) is not None for cell in cells):
        raise RecordingError(
            "has no header, name the columns in the first row (without '#'), "
            "as in 'time [s],q1 [rad],q1_velocity [rad/s],q1_force [N m]'"
        )
    units: dict[str, str] = {}
    for position, cell in enumerate(cells, start=1):
        name, unit = parse_heading(cell)
        if not name or len(cell) > _MAX_NAME_LENGTH:
            hint = f", at most {_MAX_NAME_LENGTH} characters" if name else ""
            raise RecordingError(
                f"column {position} is headed '{_shortened(cell)}', write 'name [unit]'{hint}"
            )
        if name in units:
            raise RecordingError(f"column '{name}' is there twice, rename or remove one")
        check_column_name(name, unit)
        units[name] = unit
    if TIME not in units:
        raise RecordingError(
            f"no column '{TIME}' in the header, add '{TIME} [s]', or say by a file of columns "
            "(--columns) which column of a log is which"
        )
    check_unit(TIME, column_conversion(units[TIME])[0], accepted_units("s"))
    return units


def _shortened(cell: str) -> str:
    cell = cell.strip()
    return cell if len(cell) < 60 else cell[:60] + "..."


def _read_values(
    rows: Callable[[], Iterator[str]],
    header: int,
    lines: int,
    names: Sequence[str],
    separator: str,
    time_unit: str | None = None,
    positions: Sequence[int] | None = None,
) -> Array:
    """Read numbers (N, columns) below the header row, line `header` of `lines`.

    Args:
        rows: Returns the lines below the header row.
        header: Number of the header row.
        lines: Number of lines of the file, at least.
        names: Names of the columns.
        separator: Between cells.
        time_unit: Unit of the time of a recording, whose times increase and whose numbers are
            finite; None for a log.
        positions: Positions of the columns in the rows of a log, counted from 0.
    """
    values, count, remaining = scratch_arrays.empty_array(lines - header, len(names)), 0, rows()
    raise_fault = partial(_raise_first_fault, rows, header, names, separator, time_unit, positions)
    try:
        with warnings.catch_warnings(action="ignore"):  # numpy warns of blank lines
            for line in remaining:
                block = itertools.chain([line], itertools.islice(remaining, BLOCK_ROWS - 1))
                part = np.loadtxt(
                    block, delimiter=separator, comments=None, ndmin=2,
                    usecols=positions, quotechar=None if positions is None else '"',
                )  # fmt: skip
                if not part.size:
                    continue
                if part.shape[1] != len(names):
                    raise_fault()
                if time_unit is not None and not np.isfinite(part).all():
                    raise_fault()
                values[count : count + len(part)] = part
                count += len(part)
                scratch_arrays.release_pages()
    except ValueError as error:
        raise_fault()
        reason = " ".join(str(error).split())[:120].rstrip(".")
        raise RecordingError(f"no table of numbers ({reason}), correct it") from None
    if not count:
        raise RecordingError("has a header and no samples, write one row per sample")
    values = values[:count]
    if time_unit is not None and (np.diff(values[:, names.index(TIME)]) <= 0).any():
        raise_fault()
    return values


def _parse_number(cell: str) -> float | None:
    try:
        return parse_float(cell)
    except ValueError:
        return None


def _raise_first_fault(
    rows: Callable[[], Iterator[str]],
    header: int,
    names: Sequence[str],
    separator: str,
    time_unit: str | None,
    positions: Sequence[int] | None,
) -> None:
    is_recording, last = time_unit is not None, -np.inf
    for line, text in enumerate(rows(), start=header + 1):
        if not text.strip():
            continue
        text.encode()  # only notes may hold paths that are no text
        cells = text.rstrip("\n").split(separator)
        if is_recording and len(cells) != len(names):
            raise RecordingError(
                f"line {line} has {len(cells)} cells, give {len(names)} as in the header"
            )
        if positions is not None:
            cells = next(csv.reader([text], delimiter=separator))
            if max(positions) >= len(cells):
                raise RecordingError(
                    f"line {line} has {len(cells)} cells, none for "
                    f"'{names[positions.index(max(positions))]}'"
                )
            cells = [cells[position] for position in positions]
        for name, cell in zip(names, cells, strict=False):
            value = _parse_number(cell)
            if value is None or (is_recording and not np.isfinite(value)):
                raise RecordingError(
                    f"line {line}, column '{name}': '{_shortened(cell)}' is not a "
                    f"{'finite ' * is_recording}number, correct or remove the line"
                )
        now = float(cells[names.index(TIME)]) if is_recording else np.inf
        if is_recording and now <= last:
            raise RecordingError(
                f"line {line}: time goes from {last} to {now} {time_unit}, "
                f"give strictly increasing times"
            )
        last = now
