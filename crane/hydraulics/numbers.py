"""Numbers of a circuit's parts: which there are, and which of them can be."""

from dataclasses import field, fields

from crane.common.errors import InputError
from crane.common.samples import as_number

_LEAST = 1e-50  # of what must be positive: one over its square is still a number


class PartError(InputError):
    """A number of a part of the circuit that cannot be.

    Args:
        key: Its name.
        message: See `CraneError`.
    """

    def __init__(self, key: str, message: str):
        super().__init__(message)
        self.key = key


class PlacedError(InputError):
    """A part of the circuit that cannot be beside the others.

    Args:
        path: Where it stands, as in a machine file.
        message: See `CraneError`.
    """

    def __init__(self, path: tuple[str, ...], message: str):
        super().__init__(message)
        self.path = path


def number_names(kind: type) -> list[str]:
    """Names of the numbers of a kind of part."""
    return [entry.name for entry in fields(kind) if entry.type in (float, "float")]


def check_numbers(item: object, what: str) -> None:
    """Raise for numbers of a part that are not finite, negative, or zero where that cannot be.

    What a field allows is in its metadata: "above" (0) or "signed"; anything else is at least 0.
    """
    for entry in fields(item):  # type: ignore[arg-type]
        if entry.type not in (float, "float"):
            continue
        number = as_number(getattr(item, entry.name), f"{entry.name} of {what}", "")
        positive = bool(entry.metadata.get("positive"))
        if entry.metadata.get("signed") or number >= (_LEAST if positive else 0.0):
            continue
        wanted = "must be positive" if positive else "must not be < 0"
        if number > 0:
            wanted = f"must be at least {_LEAST:g}"
        raise PartError(entry.name, f"{entry.name} of {what} is {number:g}, it {wanted}")


def positive() -> float:
    """A field without a default that must be above 0."""
    return field(metadata={"positive": True})


def above(default: float) -> float:
    """A field with a default that must be above 0."""
    return field(default=default, metadata={"positive": True})


def signed(default: float) -> float:
    """A field with a default, of either sign."""
    return field(default=default, metadata={"signed": True})
