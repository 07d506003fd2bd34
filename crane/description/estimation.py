"""What an identification estimates of a machine, and what is known of it before."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from crane.common.errors import InputError

Numbers = tuple[float, ...]
_SUREST = 1e-12  # least deviation, which weights can still be made of
_SHARES = 1e-7, 1e6  # of those that are relative


@dataclass(frozen=True)
class Known:
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
        least, most = _SHARES if self.relative else (_SUREST, math.inf)
        if not least <= self.std < most:
            raise InputError(
                f"a standard deviation of {self.std:g} is none to estimate with, give {least:g} "
                f"or more{' as a share' if self.relative else ''}"
            )

    @classmethod
    def read(cls, given: object) -> "Known":
        """From a number, or "50", "10 %", "609 +- 60", "609 +- 10 %".

        Raises:
            InputError: It is none of these, or the deviation is next to nothing.
        """
        text = str(given)
        mean, sign, std = text.rpartition("+-")
        try:
            share = std.strip().endswith("%")
            value = float(std.strip().removesuffix("%")) * (0.01 if share else 1.0)
            centre = float(mean) if sign else None
        except ValueError:
            value, share, centre = math.nan, False, None
        if not (_SUREST <= value < math.inf) or not math.isfinite(centre or 0.0):
            raise InputError(
                f"'{text}' says no standard deviation of {_SUREST:g} or more, write 50, 10 %, "
                "609 +- 60 or 609 +- 10 %"
            )
        return cls(value, share, centre)

    def __str__(self) -> str:
        """As it is read."""
        std = f"{100 * self.std:.12g} %" if self.relative else f"{self.std!r}"
        return std if self.mean is None else f"{self.mean!r} +- {std}"


@dataclass(frozen=True)
class Estimation:
    """What `identify` does with a machine unless it is told otherwise.

    Attributes:
        terms: By name or pattern, such as "q*.presliding", the numbers of a term that the model
            has besides or instead of the usual ones; None: it does not have it.
        prior: What is known of parameters by name or pattern, such as "q1.viscous", or of all of a
            body, by its link.
        bandwidth: [Hz] of the low-pass; None: by the motion.
        slow: Velocities by joint or pattern below which its rows are left out [m/s], [rad/s].
    """

    terms: Mapping[str, Numbers | None] = field(default_factory=dict)
    prior: Mapping[str, Known] = field(default_factory=dict)
    bandwidth: float | None = None
    slow: Mapping[str, float] = field(default_factory=dict)
