"""Where the named parts of a vector are."""

from collections.abc import Mapping, Sequence
from typing import Any


class Layout:
    """Parts of a vector, one after the other.

    Args:
        parts: Lengths by name; those of length 0 exist.

    Attributes:
        parts: The same.
        size: Length of the whole.
    """

    def __init__(self, **parts: int):
        self.parts: Mapping[str, int] = parts
        self._starts: dict[str, int] = {}
        at = 0
        for name, length in parts.items():
            self._starts[name] = at
            at += length
        self.size = at

    def __repr__(self) -> str:
        return f"Layout({', '.join(f'{name}={length}' for name, length in self.parts.items())})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Layout) and [*self.parts.items()] == [*other.parts.items()]

    def __hash__(self) -> int:
        return hash(tuple(self.parts.items()))

    def __getitem__(self, name: str) -> slice:
        """Where a part is."""
        return slice(self._starts[name], self._starts[name] + self.parts[name])

    def start(self, name: str) -> int:
        """Index of a part's first element."""
        return self._starts[name]

    def view(self, array: Any) -> "Parts":
        """The parts of an array (..., size) or of a sequence, by name."""
        return Parts(self, array)


class Parts:
    """Parts of one array as attributes; see `Layout.view`."""

    def __init__(self, layout: Layout, array: Any):
        self.__dict__.update(
            {
                name: array[layout[name]] if isinstance(array, list) else array[..., layout[name]]
                for name in layout.parts
            }
        )

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"no part '{name}', there are {', '.join(vars(self))}")


def laid_out(parts: Mapping[str, Sequence]) -> Layout:
    """The layout of sequences one after the other."""
    return Layout(**{name: len(values) for name, values in parts.items()})
