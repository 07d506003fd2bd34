"""Logs of other programs, converted into tables by a file of column expressions.

A column file has one line per column of the recording, with its name, its unit and an expression
in the arrays of the log, and notes as in a recording:

    # machine: kr300
    time [s] = time
    q2 [deg] = motor_position_deg[1] - 90
    q2_force [N m] = gear_ratio[1] * motor_torque[1]

Arrays are those of an npz file, or the columns of a CSV by the names in its header row; names that
are no identifiers are quoted. '#2' is the second column of a CSV. a[i] is column i of a table a,
counted from 0, or element i of a list. Operators are + - * /, parentheses, numbers and pi. Notes
such as `# sensor.q2.delay: 0.02` are sensor parameters, see crane.description.sensors. The note
`# samples from line: 30` is for a CSV with other rows between its names and its numbers.
"""

import ast
import math
import re
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.errors import RecordingError, suggest_names
from crane.common.number_text import parse_expression
from crane.common.package_search import read_plain_file
from crane.recordings import table_reader, timeseries
from crane.recordings.timeseries import TIME, Table

_MAX_BYTES = 2_000_000  # bytes of a column file
_MAX_EXPRESSION_LENGTH = 1000  # characters of an expression
_LINE_PATTERN = re.compile(r"\s*([^=\[\]]+?\s*(?:\[[^\]]*\])?)\s*=\s*(.+?)\s*")
# fmt: skip
_OPERATORS = {ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide}


@dataclass(frozen=True)
class LogColumn:
    """Column of a recording, computed from the columns of a log.

    Attributes:
        source_location: File and line of the definition.
        heading: Name and unit, such as 'q2 [deg]'.
        expression: Expression in the columns of the log.
    """

    source_location: str
    heading: str
    expression: str


def read_log(path: str | Path, columns: str | Path) -> Table:
    """Read a log as the table of a recording.

    Args:
        path: Log, CSV or npz.
        columns: Column file, see the module's documentation.

    Returns:
        Table in SI units with strictly increasing time.

    Raises:
        RecordingError: A file is missing or malformed, or columns cannot be computed; the message
            names files and lines.
    """
    notes, lines = read_log_columns(Path(columns))
    arrays = table_reader.read_log_arrays(
        Path(path),
        wanted=[name for line in lines for name in expression_names(line.expression)],
        first_line=notes.pop("samples from line", ""),
    )
    missing = [(line, name) for line in lines for name in missing_names(line.expression, arrays)]
    if missing:
        messages = [f"{line.source_location}: the log has no '{name}'" for line, name in missing]
        hint = suggest_names(arrays, missing[0][1] if len(missing) == 1 else None)
        raise RecordingError(f"{'; '.join(messages)}, {hint}")
    return assemble_table(Path(path), Path(columns), arrays, lines, notes)


def assemble_table(
    path: Path,
    columns: Path,
    arrays: Mapping[str, np.ndarray],
    lines: Sequence[LogColumn],
    notes: dict[str, str],
) -> Table:
    """Compute a table from the arrays of a log.

    Args:
        path: The log.
        columns: File of the column definitions, for messages.
        arrays: Arrays of the log by name.
        lines: Column definitions.
        notes: Notes of the table.

    Raises:
        RecordingError: A column cannot be computed, or its values are not valid in a recording.
    """
    if all(timeseries.parse_heading(line.heading)[0] != TIME for line in lines):
        raise RecordingError(
            f"{columns}: does not say which column of {path.name} is '{TIME}', "
            f"{suggest_names(arrays)}"
        )
    found: dict[str, np.ndarray] = {}
    for line in lines:
        if line.heading in found:
            raise RecordingError(
                f"{line.source_location}: column '{line.heading}' is there twice, remove one"
            )
        with timeseries.located_errors(line.source_location):
            found[line.heading] = _evaluate_expression(line.expression, arrays)
    count = max((len(x) for x in found.values() if x.ndim), default=1)
    for line in lines:
        if found[line.heading].shape not in ((), (count,)):
            raise RecordingError(
                f"{line.source_location}: '{line.heading}' has {len(found[line.heading])} "
                f"samples, others have {count}, choose a column of a table by its number, as in "
                "a[0]"
            )
    values = np.column_stack([np.broadcast_to(x, (count,)) for x in found.values()])
    table = table_reader.build_table(columns, found, values, notes)
    for name, column in zip(table.units, table.values.T, strict=True):
        bad = ~np.isfinite(column)
        if name == TIME:
            bad |= np.append(False, np.diff(column) <= 0)
        if bad.any():
            at = int(bad.argmax())
            what = "strictly increasing times" if name == TIME else "finite numbers"
            raise RecordingError(f"{path}: '{name}' is {column[at]} at sample {at}, give {what}")
    return table


def missing_names(expression: str, arrays: Container[str]) -> list[str]:
    """Names in an expression that a log does not contain."""
    return [name for name in expression_names(expression) if name not in arrays and name != "pi"]


def expression_names(expression: str) -> list[str]:
    """Names of log columns in an expression; empty if it cannot be parsed."""
    try:
        nodes = list(ast.walk(parse_expression(expression)))
    except ValueError:
        return []
    if any(isinstance(node, ast.Call | ast.Attribute) for node in nodes):
        return []
    names = [node.id for node in nodes if isinstance(node, ast.Name)]
    names += [x.value for x in nodes if isinstance(x, ast.Constant) and isinstance(x.value, str)]
    return list(dict.fromkeys(names))


def read_log_columns(path: Path) -> tuple[dict[str, str], list[LogColumn]]:
    """Read notes and column definitions from a column file.

    Raises:
        RecordingError: The file is missing or malformed.
    """
    with timeseries.located_errors(path, "a file of columns"):
        text = read_plain_file(path, _MAX_BYTES).decode("utf-8-sig")
    notes, found = {}, []
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip().startswith("#"):
            key, _, value = line.strip().removeprefix("#").partition(":")
            notes[key.strip()] = value.strip()
        elif line.strip():
            match = _LINE_PATTERN.fullmatch(line)
            if match is None or len(line) > _MAX_EXPRESSION_LENGTH:
                raise RecordingError(
                    f"{path}:{number}: is no column, write 'name [unit] = expression', as in "
                    "'q1 [deg] = angle[0] - 90'"
                )
            found.append(LogColumn(f"{path}:{number}", match[1], match[2]))
    if not found:
        raise RecordingError(f"{path}: names no columns, write 'name [unit] = expression'")
    return notes, found


def _evaluate_expression(expression: str, arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """Value () or samples (N,) of an expression."""
    try:
        tree = parse_expression(expression)
        with np.errstate(all="ignore"):  # non-finite values are reported with their name later
            value = np.asarray(_evaluate_node(tree, arrays), dtype=np.float64)
    except (ValueError, OverflowError, RecursionError):
        raise RecordingError(
            f"'{expression}' cannot be computed, combine columns by + - * / and numbers"
        ) from None
    if value.ndim > 1:
        raise RecordingError(
            f"'{expression}' has the shape {value.shape}, choose a column by its number: a[0]"
        )
    return value


def _evaluate_node(node: ast.expr, arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
        return _OPERATORS[type(node.op)](
            _evaluate_node(node.left, arrays), _evaluate_node(node.right, arrays)
        )
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        return -_evaluate_node(node.operand, arrays)
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        return np.asarray(node.value, dtype=np.float64)
    if isinstance(node, ast.Subscript):
        whole, at = _evaluate_node(node.value, arrays), node.slice
        if not (isinstance(at, ast.Constant) and type(at.value) is int) or not whole.ndim:
            raise ValueError
        if at.value >= whole.shape[-1]:
            raise RecordingError(
                f"'{ast.unparse(node)}' is not there, give numbers from 0 to {whole.shape[-1] - 1}"
            )
        return whole[..., at.value]
    if isinstance(node, ast.Name) or isinstance(node, ast.Constant) and type(node.value) is str:
        name = node.id if isinstance(node, ast.Name) else str(node.value)
        if name in arrays:
            if arrays[name].dtype.kind not in "biuf":
                raise RecordingError(f"'{name}' of the log is {arrays[name].dtype}, no numbers")
            return arrays[name].astype(np.float64, copy=False)
        if name == "pi":
            return np.asarray(math.pi)
        raise RecordingError(f"the log has no '{name}', {suggest_names(arrays, name)}")
    raise ValueError
