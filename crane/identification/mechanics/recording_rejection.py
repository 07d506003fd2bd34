"""Rejection of recordings that are probably wrong."""

import warnings
from collections.abc import Mapping

from crane.common.errors import CraneWarning, RecordingError


def reject_unless_trusted(
    text: str, trust: bool, remedy: str = "if the recording is right, trust it (trust)"
) -> None:
    """Reject a recording that is probably wrong, or warn if it is trusted.

    Raises:
        RecordingError: It is not trusted.
    """
    if not trust:
        raise RecordingError(f"{text}; {remedy}")
    warnings.warn(f"{text}: trusted", CraneWarning, stacklevel=3)


def reject_delay(name: str, delay: float, reference: str, trust: bool) -> None:
    """Reject a column with a delay [s] with respect to another, or warn if it is trusted.

    Raises:
        RecordingError: It is not trusted.
    """
    side = "behind" if delay > 0 else "ahead of"
    reject_unless_trusted(
        f"'{name}' is {abs(delay) * 1e3:.0f} ms {side} {reference}, record them with one clock",
        trust,
        f"or {shift_remedy({name: delay})}",
    )


def shift_remedy(delays: Mapping[str, float]) -> str:
    """Text that offers to take delays [s] out of columns."""
    options = " ".join(f"--shift '{name}={delay:.3g}'" for name, delay in delays.items())
    return f"take that out ({options}, in Python crane.recordings.shift_columns)"
