"""Programs: straight-line formulas, and routines that call them in loops.

A formula reads arrays and writes one, without branches; its operations come from a `Tape`. A
routine adds sequences, loops over samples, conditions and local arrays. `crane.codegen.llvm`
translates both.

    with program.add_loop("each", arrays=("inputs", "out")) as (r, i):
        r.call("formula", r.inputs.row_pointer(i, 3), r.out.row_pointer(i, 2))
"""

import ctypes
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from ctypes import addressof, c_char
from struct import pack
from typing import Any

import numpy as np

from crane.codegen.llvm.machine_code import MachineCode
from crane.codegen.llvm.sample_function import SampleFunction, make_sample_function
from crane.codegen.program_cache import FunctionSignature, ProgramRecord, cache_entry_name
from crane.codegen.routine_statements import Routine, RoutineValue
from crane.codegen.symbolic import Scalar, required_operations
from crane.codegen.vector_layout import Formula, Layout
from crane.common.samples import Array

MAX_OPERATIONS = 200_000  # operations of a formula; longer ones take minutes to compile


class FormulaTooLongError(Exception):
    """A formula has more than `MAX_OPERATIONS` operations.

    Args:
        operations: Number of operations, if known.
    """

    def __init__(self, operations: int = 0):
        super().__init__(operations)
        self.operation_count = operations


class Program:
    """Formulas and routines that are compiled together.

    Attributes:
        functions: By name, in the order in which they were added; empty if loaded from the cache.
        max_formula_length: Number of operations of the longest formula.
        dependent_programs: Programs that call its functions, by what they depend on.
    """

    def __init__(self) -> None:
        self.functions: dict[str, Formula | Routine] = {}
        self.max_formula_length = 0
        self.dependent_programs: dict[tuple, Program] = {}
        self._signatures: dict[str, FunctionSignature] = {}
        self._machine_code: Any = None

    @classmethod
    def from_cache(cls, dependencies: Any, build: Callable[["Program"], None]) -> "Program":
        """A compiled program from the cache, or else built and compiled.

        Args:
            dependencies: Everything that it depends on besides the package's files, see
                `cache_entry_name`; None if that cannot be given.
            build: Adds its formulas and routines.

        Raises:
            FormulaTooLongError: A formula has too many operations.
        """
        entry_name = cache_entry_name(dependencies)
        record = ProgramRecord.from_cache(entry_name)
        if record is not None and record.max_formula_length > MAX_OPERATIONS:
            raise FormulaTooLongError(record.max_formula_length)
        code = None if record is None else MachineCode.from_cache(record.code_name)
        program = cls()
        if record is not None and code is not None:
            program.max_formula_length, program._machine_code = record.max_formula_length, code
            program._signatures = dict(record.signatures)
            return program
        try:
            build(program)
        except FormulaTooLongError as error:
            ProgramRecord("", error.operation_count, {}).write_to_cache(entry_name)
            raise
        program.compile()
        ProgramRecord(
            program._machine_code.cache_name, program.max_formula_length, program._signatures
        ).write_to_cache(entry_name)
        return program

    def add_formula(
        self,
        name: str,
        input_count: int,
        outputs: Sequence[Scalar] | Mapping[str, Sequence[Scalar]],
    ) -> Layout:
        """Add a formula.

        Args:
            name: Its name.
            input_count: Number of input arguments; one more receives the outputs.
            outputs: (m,), or parts of them by name.

        Returns:
            Layout of the outputs; one part `all` where they have no names.

        Raises:
            FormulaTooLongError: It has too many operations.
        """
        parts = outputs if isinstance(outputs, Mapping) else {"all": outputs}
        flat = [value for part in parts.values() for value in part]
        operations = len(required_operations(flat))
        if operations > MAX_OPERATIONS:
            raise FormulaTooLongError(operations)
        self.max_formula_length = max(self.max_formula_length, operations)
        layout = Layout(**{part: len(values) for part, values in parts.items()})
        formula = self.functions[name] = Formula(name, input_count, flat, layout)
        self._signatures[name] = len(formula.argument_kinds), layout
        return layout

    @contextmanager
    def add_routine(
        self,
        name: str,
        *,
        counts: Sequence[str] = (),
        functions: Sequence[str] = (),
        arrays: Sequence[str] | Mapping[str, Layout | None],
    ) -> Iterator[Routine]:
        """Add a routine, which is built in the context."""
        named = arrays if isinstance(arrays, Mapping) else dict.fromkeys(arrays)
        routine = Routine(name, self.functions, counts, functions, named)
        yield routine
        self.functions[name] = routine
        self._signatures[name] = len(routine.argument_kinds), None

    @contextmanager
    def add_loop(
        self,
        name: str,
        *,
        functions: Sequence[str] = (),
        arrays: Sequence[str] | Mapping[str, Layout | None],
    ) -> Iterator[tuple[Routine, RoutineValue]]:
        """Add a routine that repeats `count` times what is built in the context.

        It returns `count`, or what the context returns. The context gets the index as well.
        """
        with self.add_routine(name, counts=("count",), functions=functions, arrays=arrays) as r:
            with r.loop(r.count) as i:
                yield r, i
            r.return_value(r.count)

    def add_formula_loop(
        self, name: str, formula: str, row_lengths: Mapping[str, int | None]
    ) -> None:
        """Add a routine that evaluates a formula `count` times.

        Args:
            name: Its name.
            formula: Name of the formula.
            row_lengths: Length of the rows of each array; None: the same array each time.
        """
        with self.add_loop(name, arrays=tuple(row_lengths)) as (r, i):
            arrays = {array: getattr(r, array) for array in row_lengths}
            r.call(
                formula,
                *(
                    arrays[array] if length is None else arrays[array].row_pointer(i, length)
                    for array, length in row_lengths.items()
                ),
            )

    def formula_outputs(self, name: str) -> Layout:
        """Layout of the outputs of a formula."""
        _, layout = self._signatures[name]
        assert layout is not None
        return layout

    def compile(self) -> None:
        """Compile everything that was added."""
        self._machine_code = MachineCode.compile_functions(self.functions.values())

    def function_address(self, name: str) -> int:
        """Address of a compiled function, valid for the lifetime of the program."""
        return int(self._machine_code.function_address(name))

    def call(self, name: str, *arguments: "int | np.ndarray") -> int:
        """Call a compiled formula or routine once, without the global interpreter lock.

        Args:
            name: Name of the function.
            arguments: Counts, addresses of functions, and arrays, which must be contiguous.

        Returns:
            The integer that a routine returns, 0 for a formula.
        """
        result: int = self._entry_point(name, arguments)(
            pack(f"{len(arguments)}q", *map(_argument_address, arguments))
        )
        return result

    def sample_function(
        self, name: str, *arguments: "int | np.ndarray", inputs: Array, output: Array
    ) -> SampleFunction:
        """A function of one sample in machine code that Python calls directly.

        It takes up to k arrays (n,) and returns a new array of the shape of `output`; None where
        an argument is not a float64 array (n,) of finite numbers, or the routine does not return
        1. It holds the global interpreter lock; the routine must not call Python.

        Args:
            name: Name of the routine.
            arguments: See `call`.
            inputs: (k, n) that the routine reads, all or rows of it among the arguments.
            output: Array among the arguments that the routine writes.
        """
        addresses = np.array([*map(_argument_address, arguments)], dtype=np.int64)
        return make_sample_function(
            self._entry_point(name, arguments), addresses, inputs, output, self, arguments
        )

    def _entry_point(self, name: str, arguments: Sequence["int | np.ndarray"]) -> Any:
        expected, _ = self._signatures[name]
        if len(arguments) != expected:
            raise TypeError(f"'{name}' takes {expected} arguments, not {len(arguments)}")
        return self._machine_code.entry_point(name)


def _argument_address(argument: "int | np.ndarray") -> int:
    if isinstance(argument, int):
        return argument
    try:  # ten times faster than array.ctypes.data
        return addressof(c_char.from_buffer(argument.data))
    except (TypeError, ValueError):  # not writable, or empty
        if not argument.flags.c_contiguous:
            raise TypeError("an array is not contiguous, machine code would read others") from None
        return int(argument.ctypes.data)


class PythonCallback:
    """A Python function that machine code calls; it reads one array and writes another.

    Exceptions cannot pass through machine code: the output array is then NaN, and `raise_pending`
    raises the exception.

    Args:
        function: Takes its inputs (n,) and outputs (m,).
        input_size: n.
        output_size: m.

    Attributes:
        address: Address of the function for machine code, valid for the lifetime of this object.
    """

    def __init__(
        self, function: Callable[[Array, Array], None], input_size: int, output_size: int
    ):
        self._function, self._sizes, self._exception = function, (input_size, output_size), None
        self._c_function = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p, ctypes.c_void_p)(
            self._call_from_machine_code
        )
        self.address = int(ctypes.cast(self._c_function, ctypes.c_void_p).value or 0)

    _exception: BaseException | None

    def raise_pending(self) -> None:
        """Raise the exception of the function since the last call of this method, if any."""
        raised, self._exception = self._exception, None
        if raised is not None:
            raise raised

    def _call_from_machine_code(self, input_address: int, output_address: int) -> int:
        inputs, outputs = (
            np.ctypeslib.as_array((ctypes.c_double * count).from_address(address))
            for address, count in zip((input_address, output_address), self._sizes, strict=True)
        )
        if self._exception is not None:
            outputs[:] = np.nan
            return 0
        try:
            self._function(inputs, outputs)
        except BaseException as error:  # an interrupt, too
            self._exception = error
            outputs[:] = np.nan
        return 0


def run_with_fallback(
    count: int,
    run_compiled: Callable[[int], int] | None,
    run_fallback: Callable[[int], None],
) -> None:
    """Process items one after another by machine code, with a fallback where that stops.

    Machine code only completes items that succeed at once; the fallback completes the others or
    raises an error with the reason.

    Args:
        count: Number of items.
        run_compiled: Processes the items from one on and returns how many it completed; None if
            there is no machine code.
        run_fallback: Processes one item.
    """
    done = 0
    while done < count:
        if run_compiled is not None:
            done += run_compiled(done)
        if done < count:
            run_fallback(done)
            done += 1
