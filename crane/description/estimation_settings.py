"""Settings of a machine for identification: model terms, priors, filters."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from crane.common.errors import InputError

TermValues = tuple[float, ...]
_MIN_STD = 1e-12  # with a finite weight
_RELATIVE_STD_RANGE = 1e-7, 1e6


@dataclass(frozen=True)
class ParameterPrior:
    """Prior knowledge of a parameter.

    Attributes:
        std: Standard deviation, in the unit of the parameter or relative to the mean.
        relative: Whether `std` is relative.
        mean: In the unit of the parameter; None: the value of the machine's description.
    """

    std: float
    relative: bool = False
    mean: float | None = None

    def __post_init__(self) -> None:
        lower, upper = _RELATIVE_STD_RANGE if self.relative else (_MIN_STD, math.inf)
        if not lower <= self.std < upper:
            raise InputError(
                f"a standard deviation of {self.std:g} is none to estimate with, give {lower:g} "
                f"or more{' as a share' if self.relative else ''}"
            )

    @classmethod
    def parse(cls, text_or_number: object) -> "ParameterPrior":
        """Return the prior of a number or a text: "50", "10 %", "609 +- 60", "609 +- 10 %".

        Raises:
            InputError: The text is malformed, or the standard deviation is too small.
        """
        text = str(text_or_number)
        mean, sign, std = text.rpartition("+-")
        try:
            is_relative = std.strip().endswith("%")
            value = float(std.strip().removesuffix("%")) * (0.01 if is_relative else 1.0)
            mean_value = float(mean) if sign else None
        except ValueError:
            value, is_relative, mean_value = math.nan, False, None
        if not (_MIN_STD <= value < math.inf) or not math.isfinite(mean_value or 0.0):
            raise InputError(
                f"'{text}' says no standard deviation of {_MIN_STD:g} or more, write 50, 10 %, "
                "609 +- 60 or 609 +- 10 %"
            )
        return cls(value, is_relative, mean_value)

    def __str__(self) -> str:
        """Return it in the notation that `parse` reads."""
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
        slow: Velocities [m/s], [rad/s] by joint or pattern below which rows are left out.
    """

    terms: Mapping[str, TermValues | None] = field(default_factory=dict)
    prior: Mapping[str, ParameterPrior] = field(default_factory=dict)
    bandwidth: float | None = None
    slow: Mapping[str, float] = field(default_factory=dict)
