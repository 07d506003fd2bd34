"""Numbers with units, as people write them: 200 bar, 45 cm3/rev, 60 %, 3:1.

Angles have a dimension of their own: 45 cm3 is no displacement per angle and 50 1/s no angular
frequency, while 45 cm3/rev and 50 Hz (revolutions or cycles per second) are. Pressures have no
offset: whether one is absolute is said of the key, not by the unit; temperatures are not read.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from decimal import Context, Decimal
from fractions import Fraction
from functools import cache
from typing import Any, NamedTuple

from crane.common.errors import InputError
from crane.common.number_text import parse_float

KeyPath = tuple[str | int, ...]  # keys and indices down to a number of a machine file
_TURN = 2 * Fraction(math.pi)  # 180 deg are math.pi to the last bit
# unit: SI unit, and its size in it; usual ones, which are known without the library of units
COMMON_UNITS: dict[str, tuple[str, Fraction]] = {
    "ms": ("s", Fraction(1, 1000)),
    "deg": ("rad", _TURN / 360),
    "rpm": ("rad/s", _TURN / 60),
    "deg/s": ("rad/s", _TURN / 360),
    "cm": ("m", Fraction(1, 100)),
    "mm": ("m", Fraction(1, 1000)),
    "cm/s": ("m/s", Fraction(1, 100)),
    "mm/s": ("m/s", Fraction(1, 1000)),
    "cm2": ("m2", Fraction(1, 10**4)),
    "cm3": ("m3", Fraction(1, 10**6)),
    "l": ("m3", Fraction(1, 1000)),
    "cm3/rev": ("m3/rad", Fraction(1, 10**6) / _TURN),
    "t": ("kg", Fraction(1000)),
    "kN": ("N", Fraction(1000)),
    "Nm": ("N m", Fraction(1)),
    "kN m": ("N m", Fraction(1000)),
    "kJ": ("J", Fraction(1000)),
    "kPa": ("Pa", Fraction(1000)),
    "MPa": ("Pa", Fraction(10**6)),
    "bar": ("Pa", Fraction(10**5)),
    "l/min": ("m3/s", Fraction(1, 60000)),
    "kW": ("W", Fraction(1000)),
    "mV": ("V", Fraction(1, 1000)),
    "%": ("", Fraction(1, 100)),
}
# SI units of columns of recordings, to which columns in other units are converted; g is no mass
_COLUMN_UNITS = (
    "s", "m", "rad", "m/s", "rad/s", "m/s2", "rad/s2", "N", "N m", "Pa", "m3/s", "m3", "W", "J",
    "V",
)  # fmt: skip
UNIT_DEFINITIONS = f"""
nano- = 1e-9 = n-
micro- = 1e-6 = u- = \N{MICRO SIGN}- = \N{GREEK SMALL LETTER MU}-
milli- = 1e-3 = m-
centi- = 1e-2 = c-
deci- = 1e-1 = d-
hecto- = 1e2 = h-
kilo- = 1e3 = k-
mega- = 1e6 = M-
giga- = 1e9 = G-
meter = [length] = m
second = [time] = s
gram = [mass] = g
radian = [angle] = rad
volt = [voltage] = V
minute = 60 * second = min
hour = 60 * minute = h
revolution = {_TURN.numerator} / {_TURN.denominator} * radian = rev = turn
degree = revolution / 360 = deg = \N{DEGREE SIGN}
revolution_per_minute = revolution / minute = rpm
hertz = revolution / second = Hz
inch = 0.0254 * meter = in
foot = 12 * inch = ft
liter = 1e-3 * meter ** 3 = l = L
gallon = 231 * inch ** 3 = gal
gallon_per_minute = gallon / minute = gpm
tonne = 1000 * kilogram = t
pound = 0.45359237 * kilogram = lb
newton = kilogram * meter / second ** 2 = N
newton_meter = newton * meter = Nm
kilopond = 9.80665 * newton = kp = kgf
pound_force = 4.4482216152605 * newton = lbf
pascal = newton / meter ** 2 = Pa
bar = 1e5 * pascal
psi = pound_force / inch ** 2
joule = newton * meter = J
watt = joule / second = W
watt_hour = watt * hour = Wh
horsepower = 745.69987158227022 * watt = hp
metric_horsepower = 75 * kilopond * meter / second = PS
"""
NUMBER_PATTERN = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]{1,3})?"
_QUANTITY_PATTERN = rf"\s*({NUMBER_PATTERN})\s*(\S.*?)?\s*"
_RATIO_PATTERN = r":\s*([1-9][0-9]{0,8})"
# names with exponents of one digit, so that no text takes long
_FACTOR = r"(?:1(?=\s*/)|(?:[^\W\d_]+|\N{DEGREE SIGN})(?:\^?-?[0-9](?:\.[0-9])?|[²³])?)"
_UNIT_PATTERN = rf"[\s(]*{_FACTOR}(?:[\s()*/·]+{_FACTOR})*[\s)]*"
_MAX_LENGTH = 60  # characters of a number with its unit
_MAX_DIGITS = 25  # more than tell any two float64 apart


class UnitError(InputError):
    """A text is no number in a wanted unit; the message says what to give."""


class WrittenNumber(NamedTuple):
    """A number with the unit in which it is written.

    Attributes:
        value: The number in the SI unit.
        unit: Its unit, as written; "" of a plain number, ":4" of a ratio 3:4.
        size: The unit in the SI unit.
    """

    value: float
    unit: str = ""
    size: Fraction = Fraction(1)

    def write(self, value: float) -> Any:
        """Another value in this unit, in the fewest digits that read to the same float64."""
        if not self.unit or not math.isfinite(value):
            return value
        exact = Fraction(value) / self.size
        number = next(
            text
            for digits in range(1, _MAX_DIGITS)
            if float(Fraction(text := _decimal_text(exact, digits)) * self.size) == value
        )
        return f"{number}{'' if self.unit.startswith(':') else ' '}{self.unit}"


def _decimal_text(number: Fraction, digits: int) -> str:
    rounded = Context(digits).divide(Decimal(number.numerator), Decimal(number.denominator))
    return repr(float(rounded)).removesuffix(".0") if digits <= 15 else str(rounded)


def shortest_number(estimate: float, is_exact: Callable[[float], bool]) -> float | None:
    """The number of fewest digits near an estimate that fulfils an equation to the last bit."""
    near = (estimate, math.nextafter(estimate, 0.0), math.nextafter(estimate, math.inf))
    numbers = (float(f"{x:.{digits}g}") for digits in range(1, 18) for x in near)
    return next((x for x in numbers if is_exact(x)), None)


def is_quantity(text: str) -> bool:
    """Whether a text is a number with a unit, whichever that is."""
    match = re.fullmatch(_QUANTITY_PATTERN, text[: _MAX_LENGTH + 1])
    return match is not None and bool(match[2])


def parse_number(text: str, units: Sequence[str]) -> float:
    """A plain number, or one with a unit.

    Raises:
        UnitError: See `parse_quantity`.
        ValueError: It is neither.
    """
    return parse_quantity(text, units).value if is_quantity(text) else parse_float(text)


def parse_quantity(text: str, units: Sequence[str] = ("",)) -> WrittenNumber:
    """A number with a unit or without, in which case it is in the SI unit.

    Args:
        text: As in "200 bar", "1.5e5", "60 %" or "3:1".
        units: SI units of which one is wanted; "" for a number without one.

    Raises:
        UnitError: It is no number, its unit is not known or is one of something else.
    """
    match = re.fullmatch(_QUANTITY_PATTERN, text[: _MAX_LENGTH + 1])
    if match is None or len(text) > _MAX_LENGTH:
        raise UnitError(f"give a number{_unit_hint(units)}")
    number, unit = Fraction(match[1]), match[2] or ""
    for si_unit in units:
        size = Fraction(1) if not unit else unit_size(unit, si_unit)
        if size is not None:
            return WrittenNumber(_as_float(number * size), unit, size)
    is_known = re.fullmatch(_RATIO_PATTERN, unit) or unit == "%" or _dimension(unit)
    problem = f"'{unit}' is {'a unit of something else' if is_known else 'no known unit'}"
    names = *COMMON_UNITS, *(si_unit for si_unit, _ in COMMON_UNITS.values()), *unit_names()
    if not is_known and (meant := [name for name in names if name.lower() == unit.lower()]):
        problem += f", did you mean '{meant[0]}'?"
    raise UnitError(f"and {problem}, give a number{_unit_hint(units)}")


def _as_float(number: Fraction) -> float:
    try:
        return float(number)
    except OverflowError:
        raise UnitError("give a smaller number") from None


def _unit_hint(units: Sequence[str]) -> str:
    """What a number may be in, with an example."""
    if not any(units):
        return " without a unit, as in 0.6, 60 % or 3:1"
    others = [accepted_units(unit)[-1] for unit in units if accepted_units(unit)[1:]]
    example = f", as in {' or '.join(f'5 {unit}' for unit in others)}" if others else ""
    return f" in {' or '.join(units)}{example}"


@cache
def unit_size(unit: str, si_unit: str) -> Fraction | None:
    """Size of a unit in an SI unit, None if it is one of something else, or is not known."""
    if unit == si_unit:
        return Fraction(1)
    if unit in COMMON_UNITS and COMMON_UNITS[unit][0] == si_unit:
        return COMMON_UNITS[unit][1]
    if not si_unit:
        ratio = re.fullmatch(_RATIO_PATTERN, unit)
        return Fraction(1, int(ratio[1])) if ratio else None
    size, wanted = _dimension(unit), _dimension(si_unit)
    if size is None or wanted is None or size[1] != wanted[1]:
        return None
    return size[0] / wanted[0]


@cache
def _registry() -> Any:
    """The library of units, which takes a tenth of a second, with the units of machines."""
    import pint

    registry: Any = pint.UnitRegistry(None, non_int_type=Fraction, cache_folder=None)
    registry.load_definitions(UNIT_DEFINITIONS.strip().splitlines())
    return registry


def unit_dimension(unit: str) -> Mapping[str, float] | None:
    """Exponents of a unit's dimension, of "[mass]" and so on; None of one that is not known."""
    found = _dimension(unit)
    return None if found is None else found[1]


@cache
def _dimension(unit: str) -> tuple[Fraction, Any] | None:
    """Size of a unit in base units, and its dimension; None of one that is not known."""
    if not re.fullmatch(_UNIT_PATTERN, unit):
        return None
    text = re.sub(r"(?<=[^\W\d])\^?(-?[0-9](?:\.[0-9])?)", r"**(\1)", unit.replace("·", "*"))
    try:
        size, base = _registry().get_base_units(text)
    except Exception:  # of the library, of Python's tokens and operators
        return None
    return Fraction(size), base.dimensionality


def unit_names() -> list[str]:
    """Names and symbols of all units, without prefixes."""
    lines = [line for line in UNIT_DEFINITIONS.splitlines() if line and "- =" not in line]
    words = [[word.strip() for word in line.split("=")] for line in lines]
    return [name for first, _, *others in words for name in (first, *others)]


def accepted_units(unit: str) -> list[str]:
    """An SI unit and usual units that are converted to it."""
    return [unit, *(other for other, (si, _) in COMMON_UNITS.items() if si == unit)]


@cache
def column_conversion(unit: str) -> tuple[str, Fraction]:
    """SI unit of a column, and the size of its unit in it; a unit that is not known stays."""
    if unit in COMMON_UNITS:
        return COMMON_UNITS[unit]
    for si_unit in () if not unit or unit in _COLUMN_UNITS else _COLUMN_UNITS:
        size = unit_size(unit, si_unit)
        if size is not None:
            return si_unit, size
    return unit, Fraction(1)
