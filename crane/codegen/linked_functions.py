"""Functions of several programs under names of their own, for targets outside of this process."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from crane.codegen.routine_statements import (
    ArrayPointer,
    CallStatement,
    Routine,
    RoutineStatement,
    RoutineValue,
)
from crane.codegen.vector_layout import Formula

Argument = RoutineValue | ArrayPointer
FunctionName = tuple[str, str]
"""Name of a program, and of its function."""


def statements_of(block: Sequence[RoutineStatement]) -> Iterator[RoutineStatement]:
    """All statements of a block, those within loops and conditions included."""
    for statement in block:
        yield statement
        for inner in statement.blocks:
            yield from statements_of(inner)


def calls_of(routine: Routine) -> list[CallStatement]:
    """All calls of a routine."""
    return [x for x in statements_of(routine.statements) if isinstance(x, CallStatement)]


@dataclass(frozen=True, eq=False)
class LinkedFunction:
    """A formula or routine with its name among those of all programs.

    Attributes:
        name: Its name.
        function: The formula or routine.
        callees: What it calls, by the names in its statements.
    """

    name: str
    function: Formula | Routine
    callees: "Mapping[str, LinkedFunction]"

    @cached_property
    def arguments(self) -> tuple[str, ...]:
        """Names of its arguments, without linked functions and what no formula reads."""
        if isinstance(self.function, Formula):
            return (*sorted(self.loads, key=lambda name: int(name[2:])), "out")
        return tuple(x for x in self.function.arguments if x not in self.function.functions)

    def passed(self, values: Sequence[Argument]) -> list[Argument]:
        """The values of `arguments` among those of a call."""
        function = self.function
        if isinstance(function, Formula):
            names = [*(f"in{i}" for i in range(function.input_count)), "out"]
        else:
            names = [*function.arguments]
            if len(values) < len(names):
                return list(values)
        return [x for name, x in zip(names, values, strict=True) if name in self.arguments]

    def _passed_arrays(self) -> "Iterator[tuple[LinkedFunction, str, ArrayPointer]]":
        """What it calls, with each array argument there and the array that is passed."""
        assert isinstance(self.function, Routine)
        for call in calls_of(self.function):
            callee = self.callees[call.function]
            for name, x in zip(callee.arguments, callee.passed(call.arguments), strict=True):
                if isinstance(x, ArrayPointer):
                    yield callee, name, x

    @cached_property
    def written(self) -> frozenset[str]:
        """Names of the array arguments that it writes to."""
        if isinstance(self.function, Formula):
            return frozenset(("out",))
        targets = (x.writes for x in statements_of(self.function.statements))
        found = {x.name for x in targets if x is not None}
        found |= {x.name for callee, name, x in self._passed_arrays() if name in callee.written}
        return frozenset(found & {*self.function.arguments})

    @cached_property
    def formula_lengths(self) -> dict[str, int]:
        """Operations of the formulas that it is or calls, by name."""
        if isinstance(self.function, Formula):
            return {self.name: len(self.function.order)}
        return {k: n for x in self.callees.values() for k, n in x.formula_lengths.items()}

    @cached_property
    def stack_numbers(self) -> int:
        """Most elements of local arrays of routines, while it is executed."""
        if isinstance(self.function, Formula):
            return 0
        inner = max((x.stack_numbers for x in self.callees.values()), default=0)
        return sum(self.function.local_arrays.values()) + inner

    @cached_property
    def loads(self) -> dict[str, frozenset[int]]:
        """Elements that formulas read, which it is or calls, by array argument."""
        found: dict[str, set[int]] = {}
        if isinstance(self.function, Formula):
            for array, index in self.function.loads:
                found.setdefault(f"in{array}", set()).add(index)
        else:
            for callee, name, x in self._passed_arrays():
                start = x.offset.operands[0] if x.offset.operation == "constant" else 0
                indices = {start + i for i in callee.loads.get(name, ())}
                found.setdefault(x.name, set()).update(indices)
        return {name: frozenset(indices) for name, indices in found.items()}


def link_functions(
    programs: Mapping[str, Mapping[str, Formula | Routine]],
    roots: Sequence[FunctionName],
    bindings: Mapping[str, FunctionName],
) -> list[LinkedFunction]:
    """Link functions with all that they call, each after what it calls.

    Args:
        programs: Functions of each program; the name of a linked function is that of its program,
            an underscore, and its own.
        roots: Functions to link.
        bindings: Functions that the function arguments of routines stand for.
    """
    linked: dict[FunctionName, LinkedFunction] = {}
    owners: dict[int, FunctionName] = {}  # of functions that several programs have
    for program, functions in programs.items():
        for own, function in functions.items():
            owners.setdefault(id(function), (program, own))

    def add(name: FunctionName) -> LinkedFunction:
        name = owners[id(programs[name[0]][name[1]])]
        if name not in linked:
            program, own = name
            function = programs[program][own]
            callees: dict[str, LinkedFunction] = {}
            for call in calls_of(function) if isinstance(function, Routine) else ():
                target = bindings[call.function] if call.is_argument else (program, call.function)
                callees[call.function] = add(target)
            linked[name] = LinkedFunction(f"{program}_{own}", function, callees)
        return linked[name]

    for root in roots:
        add(root)
    return list(linked.values())


def variables_read(routine: Routine) -> set[str]:
    """Names of the variables whose value is used."""
    statements = statements_of(routine.statements)
    return {name for x in statements for value in x.reads for name in _variables_in(value)}


def _variables_in(value: RoutineValue | ArrayPointer | int) -> Iterator[str]:
    if isinstance(value, ArrayPointer):
        value = value.offset
    if not isinstance(value, RoutineValue) or value.operation in ("constant", "argument"):
        return
    if value.operation == "variable":
        yield value.operands[0]
    else:
        yield from (name for x in value.operands for name in _variables_in(x))
