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

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from ctypes import addressof, c_char
from functools import partial
from struct import pack
from typing import Any

import numpy as np

from crane.codegen.kept import Note, Signature, place_of
from crane.codegen.layout import Layout, laid_out
from crane.codegen.llvm.engine import Code
from crane.codegen.representation import Formula, Routine
from crane.codegen.scalar import Number, needed

MOST = 200_000  # operations of a formula; longer ones take minutes to compile


class TooLongError(Exception):
    """A formula has more than `MOST` operations.

    Args:
        operations: How many, where it is known.
    """

    def __init__(self, operations: int = 0):
        super().__init__(operations)
        self.operations = operations


class Program:
    """Formulas and routines, compiled together.

    Attributes:
        functions: By name, in the order in which they were added; none of a program that was kept.
        longest: Operations of the longest formula.
    """

    def __init__(self) -> None:
        self.functions: dict[str, Formula | Routine] = {}
        self.longest = 0
        self._signatures: dict[str, Signature] = {}
        self._code: Any = None

    @classmethod
    def kept(cls, depends: Any, build: Callable[["Program"], None]) -> "Program":
        """A compiled program, which is built only where none is kept between runs.

        Args:
            depends: All that it depends on besides the package's own files, see `place_of`; None
                where it depends on more.
            build: Adds its formulas and routines.

        Raises:
            TooLongError: A formula has too many operations.
        """
        place = place_of(depends)
        note = Note.read(place)
        if note is not None and note.longest > MOST:
            raise TooLongError(note.longest)
        code = None if note is None else Code.kept(note.code)
        if note is not None and code is not None:
            return cls._of(note, code)
        program = cls()
        try:
            build(program)
        except TooLongError as error:
            Note("", error.operations, {}).write(place)
            raise
        program.compile()
        Note(program._code.name, program.longest, program._signatures).write(place)
        return program

    @classmethod
    def _of(cls, note: Note, code: Code) -> "Program":
        program = cls()
        program.longest, program._code = note.longest, code
        program._signatures = dict(note.functions)
        return program

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
        operations = len(needed(flat))
        if operations > MOST:
            raise TooLongError(operations)
        self.longest = max(self.longest, operations)
        formula = self.functions[name] = Formula(name, arrays, flat, laid_out(parts))
        self._signatures[name] = Signature(formula.kinds, formula.layout)
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
        self._signatures[name] = Signature(routine.kinds, None)

    def outputs(self, name: str) -> Layout:
        """Parts of what a formula writes."""
        layout = self._signatures[name].outputs
        assert layout is not None
        return layout

    def compile(self) -> None:
        """Translate everything that was added."""
        self._code = Code.of(self.functions.values())

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
        expected = len(self._signatures[name].kinds)
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
