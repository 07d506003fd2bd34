"""Curves of data sheets over a spool's stroke, as a machine file has them."""

import csv
import io
import math
from pathlib import Path

from crane.common.errors import InputError
from crane.common.file_contents import read_plain_file
from crane.formats.machine_file.yaml_parser import MAX_FILE_SIZE
from crane.formats.machine_file.yaml_section import YamlSection
from crane.hydraulics.opening_curve import OpeningCurve


def read_curve(item: YamlSection, key: str) -> tuple[float, OpeningCurve] | None:
    """A valve's edge: its coefficient when wide open, and its share over |u|.

    `[[u, c], ...]`, or a mapping with `flow: [[u, Q], ...]` at a pressure `drop`,
    c = Q / sqrt(drop), or `area: [[u, A], ...]`, c = discharge A sqrt(2 / density), or `file`, a
    CSV with the columns u and flow (with `drop`), area or coefficient; or `coefficient` and
    `shape`. None where it is a number.

    Raises:
        DescriptionError: With file and line.
    """
    value = item.raw_value(key)
    if not isinstance(value, list | dict):
        return None
    try:
        if isinstance(value, list):
            return _normalize_curve(_read_pairs(item, key))
        inner = item.section(key, f"'{key}' of {item.title}")
        assert inner is not None
        if "shape" in inner:
            return inner.number("coefficient"), OpeningCurve(_read_pairs(inner, "shape"))
        quantity, points = _read_table(inner)
        return _normalize_curve([(u, x * _coefficient_factor(inner, quantity)) for u, x in points])
    except InputError as error:
        raise item.error_at(key, f"'{key}' of {item.title}: {error}") from None


def curve_data(coefficient: float, curve: OpeningCurve) -> dict[str, object]:
    """A curve as a machine file has it, to the last bit."""
    return {"coefficient": coefficient, "shape": [list(point) for point in curve.points]}


def _normalize_curve(points: list[tuple[float, float]] | tuple) -> tuple[float, OpeningCurve]:
    coefficient = max((value for _, value in points), default=0.0)
    curve = OpeningCurve(
        tuple((u, value / coefficient if coefficient > 0 else value) for u, value in points)
    )
    return coefficient, curve


def _read_pairs(item: YamlSection, key: str) -> tuple[tuple[float, float], ...]:
    rows = item.rows(key)
    if any(len(row) != 2 for row in rows):
        raise InputError("give pairs [u, value]")
    return tuple((u, value) for u, value in rows)


def _read_table(section: YamlSection) -> tuple[str, list[tuple[float, float]]]:
    """What is given over |u|, and its points."""
    given_keys = [name for name in ("flow", "area", "file") if name in section]
    if len(given_keys) != 1:
        raise InputError("give one of flow, area, file, or coefficient and shape")
    if given_keys[0] != "file":
        return given_keys[0], list(_read_pairs(section, given_keys[0]))
    path = section.file("file")
    return _read_csv_table(path)


def _read_csv_table(path: Path) -> tuple[str, list[tuple[float, float]]]:
    try:
        text = read_plain_file(path, MAX_FILE_SIZE).decode("utf-8-sig")
        rows = list(csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path.name} cannot be read ({error}), give a CSV file") from None
    names = [name for name in ("flow", "area", "coefficient") if rows and name in rows[0]]
    if len(names) != 1 or "u" not in rows[0]:
        raise InputError(
            f"{path.name} has no columns u and flow, area or coefficient, name them in line 1"
        )
    points = []
    for number, row in enumerate(rows, 2):
        try:
            pair = float(row["u"]), float(row[names[0]])
        except (TypeError, ValueError):
            pair = math.nan, math.nan
        if not all(map(math.isfinite, pair)):
            raise InputError(f"{path.name}:{number} has no two finite numbers, correct it")
        points.append(pair)
    return names[0], points


def _coefficient_factor(section: YamlSection, quantity: str) -> float:
    """Coefficient per what is given."""
    if quantity == "coefficient":
        return 1.0
    if quantity == "flow":
        drop = section.number("drop")
        if not drop > 0:
            raise InputError("'drop' is 0, give the pressure drop that the flows were measured at")
        return 1.0 / math.sqrt(drop)
    discharge = section.number("discharge")
    return discharge * math.sqrt(2.0 / section.number("density"))
