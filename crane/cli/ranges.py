"""Parameters and their values as they are written on the command line."""

from collections.abc import Sequence

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array

_MOST = 10_000  # values of one parameter


def ranges(texts: Sequence[str], draws: int | None = None) -> dict[str, Array]:
    """What `study` varies, from "NAME=start:stop:count" or, for draws, "NAME=low~high".

    Raises:
        InputError: Something else is written.
    """
    out: dict[str, Array] = {}
    for text in texts:
        name, equals, values = text.partition("=")
        name = name.strip()
        if not (equals and name and values.strip()):
            raise InputError(f"--vary {text}: give NAME=start:stop:count, or NAME=low~high")
        if name in out:
            raise InputError(f"--vary {text}: '{name}' is varied twice, give it once")
        if "~" in values and draws is None:
            raise InputError(f"--vary {text}: a range is drawn from, say how often with --draws")
        if "~" not in values and draws is not None:
            raise InputError(f"--vary {text}: give a range, {name}=low~high")
        out[name] = _drawn(text, values) if draws is not None else _values(text, values)
    return out


def drawn(texts: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Ranges by name, from "NAME=low~high".

    Raises:
        InputError: Something else is written.
    """
    found = {}
    for name, ends in ranges(texts, draws=1).items():
        low, high = ends.tolist()
        found[name] = low, high
    return found


def _numbers(text: str, words: list[str], form: str) -> list[float]:
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = [np.nan]
    if not np.isfinite(numbers).all():
        raise InputError(f"--vary {text}: '{':'.join(words)}' are no numbers, give {form}")
    return numbers


def _drawn(text: str, values: str) -> Array:
    words = values.split("~")
    if len(words) != 2:
        raise InputError(f"--vary {text}: a range has two ends, give NAME=low~high")
    low, high = _numbers(text, words, "NAME=low~high")
    if not low < high:
        raise InputError(f"--vary {text}: {low:g} is not below {high:g}, give NAME=low~high")
    return np.array([low, high])


def _values(text: str, values: str) -> Array:
    words, form = values.split(":"), "NAME=start:stop:count"
    if len(words) != 3:
        raise InputError(f"--vary {text}: '{values}' is no grid, give {form}")
    start, stop = _numbers(text, words[:2], form)
    count = int(words[2]) if words[2].strip().isdecimal() else 0
    if not 1 <= count <= _MOST:
        raise InputError(f"--vary {text}: '{words[2]}' is no count of 1 to {_MOST}, give {form}")
    if count == 1 and start != stop:
        raise InputError(f"--vary {text}: one value cannot be both ends, give a larger count")
    return np.linspace(start, stop, count)
