"""Settings of an identification: model terms, priors of parameters, and their units."""

import fnmatch
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from crane.common.errors import InputError
from crane.common.unit_conversions import UnitError, is_quantity, parse_number, parse_quantity

OPEN_PRIOR = "auto"  # text of a prior whose width an identification selects
_OPEN_STD = 0.01  # relative
TermValues = tuple[float, ...]
_MIN_STD = 1e-12  # with a finite weight
_RELATIVE_STD_RANGE = 1e-7, 1e6
# by the last part of the name of a parameter
_PARAMETERS = {
    **dict.fromkeys(
        ("coulomb", "coulomb_offset", "stiction", "stiction_2", "presliding", "memory"),
        ("N", "N m"),
    ),
    **dict.fromkeys(("viscous", "viscous_offset"), ("N s/m", "N m s/rad")),
    "root": ("N s^0.5/m^0.5", "N m s^0.5/rad^0.5"),
    "m": ("kg", "kg"),
    **dict.fromkeys(("mx", "my", "mz"), ("kg m", "kg m")),
    **dict.fromkeys(("Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz"), ("kg m2", "kg m2")),
    "rotor_inertia": ("kg", "kg m2"),
    "gas_scale": ("", ""),
}
_TERM_VALUES = {  # by the kind of a model term
    "stiction": [("m/s", "rad/s")] * 2,
    "presliding": [("m", "rad")],
    "memory": [("s", "s"), ("m/s", "rad/s")],
}


def estimation_units(
    name: str, turns: Mapping[str, bool], position: int | None = None
) -> tuple[str, ...]:
    """SI units that an estimated parameter, or a value of a model term, may have.

    They are several where a pattern matches more.

    Args:
        name: Its name, or a pattern, as in "q1.viscous" or "q*.coulomb".
        turns: Whether each joint turns.
        position: Position among the values of a term; None: of the parameter.
    """
    where, _, kind = name.rpartition(".")
    names = [where] if where in turns else fnmatch.filter(turns, where)
    sides = {turns[joint] for joint in names} or {False, True}
    if position is not None:
        matching = _TERM_VALUES.get(kind, ())[position : position + 1] or [("", "")]
    else:
        matching = [units for known, units in _PARAMETERS.items() if fnmatch.fnmatch(known, kind)]
    return tuple(dict.fromkeys(units[side] for units in matching for side in sorted(sides)))


@dataclass(frozen=True)
class ParameterPrior:
    """Prior knowledge of a parameter.

    Attributes:
        std: Standard deviation, in the unit of the parameter or relative to the mean.
        relative: Whether `std` is relative.
        mean: In the unit of the parameter; None: the value of the machine's description.
        text: The text that it was read from, with its units.
    """

    std: float
    relative: bool = False
    mean: float | None = None
    text: str = field(default="", compare=False)

    @property
    def is_open(self) -> bool:
        """Whether an identification selects the standard deviation."""
        return self.text == OPEN_PRIOR

    def __post_init__(self) -> None:
        lower, upper = _RELATIVE_STD_RANGE if self.relative else (_MIN_STD, math.inf)
        if not lower <= self.std < upper:
            raise InputError(
                f"a standard deviation of {self.std:g} is none to estimate with, give {lower:g} "
                f"or more{' as a share' if self.relative else ''}"
            )

    @classmethod
    def parse(cls, text_or_number: object, units: Sequence[str] = ()) -> "ParameterPrior":
        """Return the prior of a number or a text: "50", "10 %", "609 +- 60", "10 %", "auto".

        Both numbers may have a unit; of two, a unit at the end is that of both, as in
        "0.6 +- 0.1 kN".

        Args:
            text_or_number: See above.
            units: SI units that the parameter may have.

        Raises:
            UnitError: A unit is one of something else.
            InputError: The text is malformed, or the standard deviation is too small.
        """
        text = str(text_or_number)
        if text == OPEN_PRIOR:
            return cls(_OPEN_STD, True, None, text)
        mean, sign, std = (part.strip() for part in text.rpartition("+-"))
        try:
            is_relative = std.endswith("%")
            if not is_relative and is_quantity(mean) and not is_quantity(std):
                raise UnitError("give the standard deviation a unit, too")
            if sign and is_quantity(std) and not (is_relative or is_quantity(mean)):
                mean = f"{mean} {parse_quantity(std, units).unit}"
            value = parse_number(std, ("",) if is_relative else units)
            mean_value = parse_number(mean, units) if sign else None
        except UnitError as error:
            raise UnitError(f"it is '{text}', {error}") from None
        except ValueError:
            value, is_relative, mean_value = math.nan, False, None
        if not (_MIN_STD <= value < math.inf) or not math.isfinite(mean_value or 0.0):
            raise InputError(
                f"'{text}' says no standard deviation of {_MIN_STD:g} or more, write 50, 10 %, "
                "609 +- 60 or 609 +- 10 %"
            )
        return cls(value, is_relative, mean_value, text)

    def __str__(self) -> str:
        """Return it in the notation that `parse` reads."""
        if self.text:
            return self.text
        std = f"{100 * self.std:.12g} %" if self.relative else f"{self.std!r}"
        return std if self.mean is None else f"{self.mean!r} +- {std}"


@dataclass(frozen=True)
class EstimationSettings:
    """Defaults of `identify` for a machine.

    Attributes:
        terms: Parameters of additional model terms by name or pattern, such as "q*.presliding";
            None: the model does not have the term.
        prior: Priors by name or pattern of parameters, such as "q1.viscous", or by link for all
            inertial parameters of a body.
        bandwidth: Cut-off frequency of the low-pass filter [Hz]; None: from the motion.
        min_speed: Velocities [m/s], [rad/s] by joint or pattern below which rows are left out.
    """

    terms: Mapping[str, TermValues | None] = field(default_factory=dict)
    prior: Mapping[str, ParameterPrior] = field(default_factory=dict)
    bandwidth: float | None = None
    min_speed: Mapping[str, float] = field(default_factory=dict)
