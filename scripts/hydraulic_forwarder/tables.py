"""Format tables and numbers in Markdown."""

from collections.abc import Iterable

import numpy as np

from crane.identification.hydraulics.orifice_coefficients import OrificeCoefficients
from hydraulic_forwarder.circuit import TRUE

KIND = {"paper": "paper's crane", "rigid": "with the spool", "orifices": "the machine"}


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """As Markdown, the first column to the left."""
    head = list(head)
    marks = ["---", *["---:"] * (len(head) - 1)]
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, marks, *rows))


def percent(x: float) -> str:
    """A share in words."""
    return f"{100 * x:.2g} %"


def span(low: float, high: float, digits: int = 3) -> str:
    """Least and largest."""
    return f"{low:.{digits}g} to {high:.{digits}g}"


def errors(X: OrificeCoefficients) -> list[str]:
    """Relative errors of X against `TRUE`, bold outside of the 95 % interval."""
    low, high = X.confidence_interval().T
    out = []
    for x, true, a, b in zip(X.values, TRUE, low, high, strict=True):
        text = f"{100 * (x / true - 1):+.2f} %"
        out.append(text if a < true < b else f"**{text}**")
    return out


def inside(X: OrificeCoefficients, level: float = 0.95) -> np.ndarray:
    """Which of the intervals (5,) hold the truth."""
    low, high = X.confidence_interval(level).T
    return (low < TRUE) & (high > TRUE)
