"""Curves of the edges of a valve: coefficients, flows or areas over the stroke of the spool."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path

from crane.common.errors import InputError
from crane.common.package_search import read_plain_file
from crane.common.unit_conversions import UnitError, parse_quantity
from crane.formats.machine_file.yaml_section import YamlSection
from crane.formats.machine_file.yaml_text import MAX_FILE_SIZE
from crane.hydraulics.components import OpeningCurve

_TABLE_UNITS = {"flow": "m3/s", "area": "m2", "coefficient": "m3/(s Pa^0.5)"}


def read_edge_curve(item: YamlSection, key: str) -> tuple[float, OpeningCurve] | None:
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
            return inner.number("coefficient"), OpeningCurve(tuple(_read_pairs(inner, "shape")))
        given_keys = [name for name in ("flow", "area", "file") if name in inner]
        if len(given_keys) != 1:
            raise InputError("give one of flow, area, file, or coefficient and shape")
        quantity = given_keys[0]
        if quantity == "file":
            quantity, points = _read_csv_table(inner.file("file"))
        else:
            points = _read_pairs(inner, quantity)
        return _normalize_curve([(u, x * _coefficient_factor(inner, quantity)) for u, x in points])
    except InputError as error:
        raise item.error_at(key, f"'{key}' of {item.title}: {error}") from None


def _normalize_curve(points: Sequence[tuple[float, float]]) -> tuple[float, OpeningCurve]:
    coefficient = max((value for _, value in points), default=0.0)
    return coefficient, OpeningCurve(
        tuple((u, value / coefficient if coefficient > 0 else value) for u, value in points)
    )


def _read_pairs(item: YamlSection, key: str) -> Sequence[tuple[float, float]]:
    rows = item.rows(key)
    if any(len(row) != 2 for row in rows):
        raise InputError("give pairs [u, value]")
    return tuple((u, value) for u, value in rows)


def _read_csv_table(path: Path) -> tuple[str, Sequence[tuple[float, float]]]:
    try:
        text = read_plain_file(path, MAX_FILE_SIZE).decode("utf-8-sig")
        heads, *rows = csv.reader(text.splitlines(), skipinitialspace=True)
    except (OSError, UnicodeDecodeError, csv.Error, ValueError) as error:
        raise InputError(f"{path.name} cannot be read ({error}), give a CSV file") from None
    columns = {head.partition("[")[0].strip(): i for i, head in enumerate(heads)}
    units = [head.partition("[")[2].strip("] ") for head in heads]
    names = [name for name in ("flow", "area", "coefficient") if name in columns]
    if len(names) != 1 or "u" not in columns:
        raise InputError(
            f"{path.name} has no columns u and flow, area or coefficient, name them in line 1"
        )
    si_units = {"u": "", names[0]: _TABLE_UNITS[names[0]]}
    points = []
    for number, row in enumerate(filter(None, rows), 2):
        try:
            u, value = (
                parse_quantity(f"{row[columns[name]]} {units[columns[name]]}", (unit,)).value
                for name, unit in si_units.items()
            )
        except IndexError:
            raise InputError(f"{path.name}:{number} has no two numbers, correct it") from None
        except UnitError as error:
            raise InputError(f"{path.name}:{number} has '{', '.join(row)}', {error}") from None
        points.append((u, value))
    return names[0], points


def _coefficient_factor(section: YamlSection, quantity: str) -> float:
    if quantity == "coefficient":
        return 1.0
    if quantity == "flow":
        drop = section.number("drop")
        if not drop > 0:
            raise InputError("'drop' is 0, give the pressure drop that the flows were measured at")
        return 1.0 / math.sqrt(drop)
    return section.number("discharge") * math.sqrt(2.0 / section.number("density"))
