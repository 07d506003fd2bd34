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
        self._start_indices: dict[str, int] = {}
        at = 0
        for name, length in parts.items():
            self._start_indices[name] = at
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
        return slice(self._start_indices[name], self._start_indices[name] + self.parts[name])

    def start_index(self, name: str) -> int:
        """Index of a part's first element."""
        return self._start_indices[name]

    def view(self, array: Any) -> "LayoutView":
        """The parts of an array (..., size) or of a sequence, by name."""
        return LayoutView(self, array)


class LayoutView:
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


def layout_of(parts: Mapping[str, Sequence]) -> Layout:
    """The layout of sequences one after the other."""
    return Layout(**{name: len(values) for name, values in parts.items()})
