"""Curves of data sheets over a spool's stroke, as a machine file has them."""

import csv
import io
import math
from pathlib import Path

from crane.common.errors import InputError
from crane.common.inputs import content
from crane.formats.machine_file.section import LARGEST, Section
from crane.hydraulics.curve import Curve

_KEYS = ("coefficient", "shape", "flow", "drop", "area", "discharge", "density", "file")
_DISCHARGE, _DENSITY = 0.7, 870.0  # of an orifice; of oil [kg/m3]


def read_curve(item: Section, key: str) -> tuple[float, Curve] | None:
    """A valve's edge: its coefficient when wide open, and its share over |u|.

    `[[u, c], ...]`, or a mapping with `flow: [[u, Q], ...]` at a pressure `drop`,
    c = Q / sqrt(drop), or `area: [[u, A], ...]`, c = discharge A sqrt(2 / density), or `file`, a
    CSV with the columns u and flow (with `drop`), area or coefficient; or `coefficient` and
    `shape`. None where it is a number.

    Raises:
        DescriptionError: With file and line.
    """
    value = item.raw(key)
    if not isinstance(value, list | dict):
        return None
    try:
        if isinstance(value, list):
            return _scaled(_pairs(item, key))
        inner = item.section(key, f"'{key}' of {item.title}")
        assert inner is not None
        inner.only(*_KEYS)
        if "shape" in inner:
            return inner.number("coefficient", minimum=0.0), Curve(_pairs(inner, "shape"))
        what, points = _tabled(inner)
        return _scaled([(u, x * _factor(inner, what)) for u, x in points])
    except InputError as error:
        raise item.fail(key, f"'{key}' of {item.title}: {error}") from None


def curve_data(coefficient: float, curve: Curve) -> dict[str, object]:
    """A curve as a machine file has it, to the last bit."""
    return {"coefficient": coefficient, "shape": [list(point) for point in curve.points]}


def _scaled(points: list[tuple[float, float]] | tuple) -> tuple[float, Curve]:
    most = max((value for _, value in points), default=0.0)
    curve = Curve(tuple((u, value / most if most > 0 else value) for u, value in points))
    return most, curve


def _pairs(item: Section, key: str) -> tuple[tuple[float, float], ...]:
    rows = item.rows(key)
    if any(len(row) != 2 for row in rows):
        raise InputError("give pairs [u, value]")
    return tuple((u, value) for u, value in rows)


def _tabled(inner: Section) -> tuple[str, list[tuple[float, float]]]:
    """What is given over |u|, and its points."""
    given = [name for name in ("flow", "area", "file") if name in inner]
    if len(given) != 1:
        raise InputError("give one of flow, area, file, or coefficient and shape")
    if given[0] != "file":
        return given[0], list(_pairs(inner, given[0]))
    path = inner.file("file")
    return _of_file(path)


def _of_file(path: Path) -> tuple[str, list[tuple[float, float]]]:
    try:
        text = content(path, LARGEST).decode("utf-8-sig")
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


def _factor(inner: Section, what: str) -> float:
    """Coefficient per what is given."""
    if what == "coefficient":
        return 1.0
    if what == "flow":
        drop = inner.number("drop", minimum=0.0)
        if not drop > 0:
            raise InputError("'drop' is 0, give the pressure drop that the flows were measured at")
        return 1.0 / math.sqrt(drop)
    discharge = inner.number("discharge", _DISCHARGE, minimum=0.0)
    return discharge * math.sqrt(2.0 / inner.number("density", _DENSITY, minimum=1.0))
