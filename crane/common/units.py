"""Formatting of quantities and tables."""

import math
from collections.abc import Mapping, Sequence

# SI unit: display units, their number per SI unit, and the value (in SI) from which they are used.
DISPLAY_UNITS: Mapping[str, tuple[tuple[str, float, float], ...]] = {
    "rad": (("deg", 180 / math.pi, 0.0),),
    "rad/s": (("deg/s", 180 / math.pi, 0.0),),
    "m": (("m", 1.0, 5.0), ("mm", 1e3, 0.0)),
    "m/s": (("m/s", 1.0, 2.0), ("mm/s", 1e3, 0.0)),
    "N": (("kN", 1e-3, 1e3),),
    "N m": (("kN m", 1e-3, 1e4),),
    "Pa": (("bar", 1e-5, 0.0),),
    "J": (("kJ", 1e-3, 1e4),),
    "W": (("kW", 1e-3, 1e3),),
    "m3/s": (("l/min", 6e4, 0.0),),
    "m3": (("l", 1e3, 0.0),),
    "kg": (("t", 1e-3, 1e4),),
}
_ZERO_TOLERANCE = 1e-6  # rounding noise in any of these units


def display_unit(unit: str, peak: float) -> tuple[str, float]:
    """Display unit of values up to `peak` (in SI), and its number per SI unit."""
    for name, scale, start in DISPLAY_UNITS.get(unit, ()):
        if abs(peak) >= start:
            return name, scale
    return unit, 1.0


def format_number(value: float, digits: int = 3) -> str:
    """A number with `digits` significant digits, without exponent; 0 for rounding noise."""
    if abs(value) < _ZERO_TOLERANCE:
        return "0"
    places = max(digits - 1 - math.floor(math.log10(abs(value))), 0)
    text = f"{value:.{places}f}"
    return text.rstrip("0").rstrip(".") if places else text


def format_quantity(value: float, unit: str, digits: int = 3) -> str:
    """A value (in SI) with its display unit: 13.36 t, 4.2 kN, 350 bar."""
    name, scale = display_unit(unit, value)
    return f"{format_number(scale * value, digits)} {name}"


def format_table(rows: Sequence[Sequence[str]], left_aligned: Sequence[int] = (0,)) -> list[str]:
    """Lines of a table with columns as wide as their cells, separated by two spaces.

    Args:
        rows: Cells, the same number in each row.
        left_aligned: Columns that are left-aligned; others are right-aligned.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = [
            cell.ljust(width) if i in left_aligned else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    return lines
