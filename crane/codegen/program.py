"""Programs: straight-line formulas, and routines that call them in loops.

A formula reads arrays and writes one, without branches; its operations come from a `Tape`. A
routine has what formulas have not: sequences, loops over samples with strides, conditions that
stop, and arrays of its own. Nothing here is written in a machine's language: an emitter
(`crane.codegen.llvm`) translates.

    with program.routine("each", counts=("count",), arrays=("inputs", "out")) as r:
        with r.loop(r.count) as i:
            r.call("formula", r.inputs.row(i, 3), r.out.row(i, 2))
        r.give(r.count)
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from ctypes import addressof, c_char
from functools import partial
from struct import pack
from typing import Any

import numpy as np

from crane.codegen.layout import Layout, laid_out
from crane.codegen.llvm.engine import Code
from crane.codegen.representation import Formula, Routine
from crane.codegen.scalar import Number, needed

MOST = 400_000  # operations of a formula; longer ones take minutes to compile


class TooLongError(Exception):
    """A formula has more than `MOST` operations."""


class Program:
    """Formulas and routines, compiled together.

    Attributes:
        functions: By name, in the order in which they were added.
    """

    def __init__(self) -> None:
        self.functions: dict[str, Formula | Routine] = {}
        self._code: Any = None

    def add(
        self, name: str, arrays: int, outputs: Sequence[Number] | Mapping[str, Sequence[Number]]
    ) -> Layout:
        """Add a formula.

        Args:
            name: Its name.
            arrays: Number of arguments that are read; one more takes the outputs.
            outputs: (m,), or parts of them by name.

        Returns:
            The outputs' parts; one `all` where they have no names.

        Raises:
            TooLongError: It has too many operations.
        """
        parts = outputs if isinstance(outputs, Mapping) else {"all": outputs}
        flat = [value for part in parts.values() for value in part]
        if len(needed(flat)) > MOST:
            raise TooLongError
        formula = self.functions[name] = Formula(name, arrays, flat, laid_out(parts))
        return formula.layout

    @contextmanager
    def routine(
        self,
        name: str,
        *,
        counts: Sequence[str] = (),
        functions: Sequence[str] = (),
        arrays: Sequence[str] | Mapping[str, Layout | None],
    ) -> Iterator[Routine]:
        """Add a routine, which is built inside."""
        named = arrays if isinstance(arrays, Mapping) else dict.fromkeys(arrays)
        routine = Routine(name, self.functions, counts, functions, named)
        yield routine
        self.functions[name] = routine

    def outputs(self, name: str) -> Layout:
        """Parts of what a formula writes."""
        formula = self.functions[name]
        assert isinstance(formula, Formula)
        return formula.layout

    def compile(self) -> None:
        """Translate everything that was added."""
        self._code = Code(self.functions.values())

    def address(self, name: str) -> int:
        """Where a compiled function is, for as long as the program lives."""
        return int(self._code.address(name))

    def call(self, name: str, *arguments: "int | np.ndarray") -> int:
        """Call a compiled formula or routine once, other threads running meanwhile.

        Args:
            name: Which.
            arguments: Counts, addresses of functions, and arrays, which must be contiguous.

        Returns:
            What a routine returns, 0 of a formula.
        """
        answer: int = self._entry(name, arguments)(_addresses(arguments))
        return answer

    def bound(self, name: str, *arguments: "int | np.ndarray") -> "Bound":
        """A function with its arguments, for many calls that must cost little."""
        return Bound(self, self._entry(name, arguments), arguments)

    def _entry(self, name: str, arguments: Sequence["int | np.ndarray"]) -> Any:
        expected = len(self.functions[name].kinds)
        if len(arguments) != expected:
            raise TypeError(f"'{name}' takes {expected} arguments, not {len(arguments)}")
        return self._code.entry(name)


class Bound(partial[int]):
    """A compiled function together with its arguments, which it keeps alive; see `Program.call`.

    One pointer costs a call from Python far less than a dozen.

    Args:
        program: Where the function is, kept alive.
        entry: Takes the address of the arguments' addresses.
        arguments: See `Program.call`.
    """

    _kept: tuple[Any, ...]

    def __new__(
        cls, program: Program, entry: Any, arguments: Sequence["int | np.ndarray"]
    ) -> "Bound":
        """Keep all of it."""
        addresses = np.frombuffer(_addresses(arguments), dtype=np.int64)
        self = super().__new__(cls, entry, addresses.ctypes.data)
        self._kept = program, addresses, arguments
        return self


def _addresses(arguments: Sequence["int | np.ndarray"]) -> bytes:
    return pack(f"{len(arguments)}q", *map(_address, arguments))


def _address(argument: "int | np.ndarray") -> int:
    if isinstance(argument, int):
        return argument
    try:  # takes a tenth of the time of numpy's own way
        return addressof(c_char.from_buffer(argument.data))
    except (TypeError, ValueError):  # not writable, or empty
        if not argument.flags.c_contiguous:
            raise TypeError("an array is not contiguous, machine code would read others") from None
        return int(argument.ctypes.data)
