"""What an identification estimates of a machine, and what is known of it before."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from crane.common.errors import InputError

TermValues = tuple[float, ...]
_MIN_STD = 1e-12  # least deviation, which weights can still be made of
_RELATIVE_STD_RANGE = 1e-7, 1e6  # of those that are relative


@dataclass(frozen=True)
class ParameterPrior:
    """What is known of a parameter before anything is measured.

    Attributes:
        std: Standard deviation, in the parameter's unit or as a share of the mean.
        relative: Whether it is a share.
        mean: In the parameter's unit; None: the value that the machine's description has.
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
        """From a number, or "50", "10 %", "609 +- 60", "609 +- 10 %".

        Raises:
            InputError: It is none of these, or the deviation is next to nothing.
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
        """As it is read."""
        std = f"{100 * self.std:.12g} %" if self.relative else f"{self.std!r}"
        return std if self.mean is None else f"{self.mean!r} +- {std}"


@dataclass(frozen=True)
class EstimationSettings:
    """What `identify` does with a machine unless it is told otherwise.

    Attributes:
        terms: By name or pattern, such as "q*.presliding", the numbers of a term that the model
            has besides or instead of the usual ones; None: it does not have it.
        prior: What is known of parameters by name or pattern, such as "q1.viscous", or of all of a
            body, by its link.
        bandwidth: [Hz] of the low-pass; None: by the motion.
        slow: Velocities by joint or pattern below which its rows are left out [m/s], [rad/s].
    """

    terms: Mapping[str, TermValues | None] = field(default_factory=dict)
    prior: Mapping[str, ParameterPrior] = field(default_factory=dict)
    bandwidth: float | None = None
    slow: Mapping[str, float] = field(default_factory=dict)
