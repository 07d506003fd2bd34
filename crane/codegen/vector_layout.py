"""Layouts: names of the parts of a vector; formulas, which compute one."""

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

from crane.codegen.symbolic import Scalar, SymbolicExpression, required_operations

ArgumentKind = Literal["count", "array"]  # a number, or the address of an array or function


class Layout:
    """Named consecutive parts of a vector.

    Args:
        parts: Lengths by name; a length may be 0.

    Attributes:
        parts: Lengths by name.
        size: Length of the vector.
    """

    def __init__(self, **parts: int):
        self.parts: Mapping[str, int] = parts
        starts = itertools.accumulate(parts.values(), initial=0)
        self._slices = {
            name: slice(start, start + parts[name])
            for name, start in zip(parts, starts, strict=False)
        }
        self.size = sum(parts.values())

    def __repr__(self) -> str:
        return f"Layout({', '.join(f'{name}={length}' for name, length in self.parts.items())})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Layout) and [*self.parts.items()] == [*other.parts.items()]

    def __hash__(self) -> int:
        return hash(tuple(self.parts.items()))

    def __getitem__(self, name: str) -> slice:
        """Where a part is."""
        return self._slices[name]

    def start_index(self, name: str) -> int:
        """Index of a part's first element."""
        return int(self._slices[name].start)

    def indices(self, name: str) -> range:
        """Indices of a part's elements."""
        return range(self._slices[name].start, self._slices[name].stop)

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


@dataclass(frozen=True, eq=False)
class Formula:
    """f(in_0, in_1, ..., out), straight-line code.

    Attributes:
        name: Its name.
        input_count: Number of input arguments.
        outputs: Output expressions, (m,).
        layout: Layout of the outputs.
    """

    name: str
    input_count: int
    outputs: Sequence[Scalar]
    layout: Layout

    @property
    def argument_kinds(self) -> tuple[ArgumentKind, ...]:
        """Kinds of the arguments."""
        return tuple("array" for _ in range(self.input_count + 1))

    @property
    def operations(self) -> Sequence[tuple]:
        """All operations of its tape."""
        tapes = (x.tape for x in self.outputs if isinstance(x, SymbolicExpression))
        return next((tape.operations for tape in tapes), ())

    @cached_property
    def order(self) -> list[int]:
        """Indices of the operations that it computes, in order."""
        operations = self.operations
        return [i for i in required_operations(self.outputs) if operations[i][0] != "load"]

    @property
    def loads(self) -> set[tuple[int, int]]:
        """Elements that it reads: indices of the input argument and in it."""
        operations = self.operations
        used = [operations[i] for i in required_operations(self.outputs)]
        return {(x[1], x[2]) for x in used if x[0] == "load"}


def operand_indices(operation: tuple) -> list[int]:
    """Indices of the operations whose values an operation takes."""
    return [] if operation[0] == "load" else [x for x in operation[1:] if isinstance(x, int)]


def assign_memory_slots(
    pieces: Sequence[Collection[int]], operations: Sequence[tuple]
) -> dict[int, int]:
    """Memory slots of values that later pieces of a formula need, reused after the last use.

    Args:
        pieces: Indices of the operations of each piece.
        operations: All operations.
    """
    piece_of = {index: number for number, piece in enumerate(pieces) for index in piece}
    last = {
        x: number
        for number, piece in enumerate(pieces)
        for index in piece
        for x in operand_indices(operations[index])
        if piece_of.get(x, number) < number
    }
    slots: dict[int, int] = {}
    free: list[int] = []
    count = 0
    for number, piece in enumerate(pieces):
        for index in sorted(last.keys() & piece):
            if not free:
                free, count = [count], count + 1
            slots[index] = free.pop()
        free += sorted(slots[x] for x, end in last.items() if end == number)
    return slots
