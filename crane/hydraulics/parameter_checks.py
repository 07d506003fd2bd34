"""Numbers of a circuit's parts: which there are, and which of them can be."""

from dataclasses import field, fields

from crane.common.errors import InputError
from crane.common.samples import as_number

_MIN_POSITIVE = 1e-50  # of what must be positive: one over its square is still a number


class ComponentParameterError(InputError):
    """A number of a part of the circuit that cannot be.

    Args:
        key: Its name.
        message: See `CraneError`.
    """

    def __init__(self, key: str, message: str):
        super().__init__(message)
        self.key = key


class CircuitPathError(InputError):
    """A part of the circuit that cannot be beside the others.

    Args:
        path: Where it stands, as in a machine file.
        message: See `CraneError`.
    """

    def __init__(self, path: tuple[str, ...], message: str):
        super().__init__(message)
        self.path = path


def parameter_names(component_type: type) -> list[str]:
    """Names of the numbers of a kind of part."""
    return [entry.name for entry in fields(component_type) if entry.type in (float, "float")]


def check_parameters(component: object, label: str) -> None:
    """Raise for numbers of a part that are not finite, negative, or zero where that cannot be.

    What a field allows is in its metadata: "above" (0) or "signed"; anything else is at least 0.
    """
    for entry in fields(component):  # type: ignore[arg-type]
        if entry.type not in (float, "float"):
            continue
        value = as_number(getattr(component, entry.name), f"{entry.name} of {label}", "")
        positive = bool(entry.metadata.get("positive"))
        if entry.metadata.get("signed") or value >= (_MIN_POSITIVE if positive else 0.0):
            continue
        requirement = "must be positive" if positive else "must not be < 0"
        if value > 0:
            requirement = f"must be at least {_MIN_POSITIVE:g}"
        raise ComponentParameterError(
            entry.name, f"{entry.name} of {label} is {value:g}, it {requirement}"
        )


def positive_field() -> float:
    """A field without a default that must be above 0."""
    return field(metadata={"positive": True})


def positive_field_with_default(default: float) -> float:
    """A field with a default that must be above 0."""
    return field(default=default, metadata={"positive": True})


def signed_field(default: float) -> float:
    """A field with a default, of either sign."""
    return field(default=default, metadata={"signed": True})
