"""Linked functions as a WebAssembly module (core specification 1.0, and bulk memory).

Arrays are addresses in the memory of the module, which is exported as `memory`; numbers are
doubles. Local arrays lie on a stack at the end of the memory. Functions are imported from `math`:
sin, cos, exp, log and tanh.
"""

import struct
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from crane.codegen.linked_functions import LinkedFunction
from crane.codegen.routine_statements import (
    ArrayPointer,
    AssignmentStatement,
    BreakStatement,
    CallStatement,
    ConditionStatement,
    CopyStatement,
    LoopStatement,
    ReturnStatement,
    Routine,
    RoutineStatement,
    RoutineValue,
    StoreStatement,
)
from crane.codegen.symbolic import SymbolicExpression
from crane.codegen.vector_layout import Formula, operand_indices

IMPORTED_FUNCTIONS = ("sin", "cos", "exp", "log", "tanh")
PAGE_SIZE = 65_536
_MAX_DEPTH = 30  # of nested operations without a local variable
_NUMBER_SIZE = 8
_I32, _F64, _EMPTY = b"\x7f", b"\x7c", b"\x40"
_OPERATIONS = {
    "add": b"\xa0", "subtract": b"\xa1", "multiply": b"\xa2", "divide": b"\xa3",
    "maximum": b"\xa5", "copysign": b"\xa6", "abs": b"\x99", "negate": b"\x9a", "sqrt": b"\x9f",
}  # fmt: skip
_OPERATORS = {
    "real": {"+": b"\xa0", "-": b"\xa1", "*": b"\xa2", "/": b"\xa3",
             "<": b"\x63", ">": b"\x64", "<=": b"\x65", ">=": b"\x66"},
    "integer": {"+": b"\x6a", "-": b"\x6b", "*": b"\x6c",
                "<": b"\x48", ">": b"\x4a", "<=": b"\x4c", ">=": b"\x4e"},
    "truth": {"and": b"\x71", "or": b"\x72"},
}  # fmt: skip
_GET, _SET, _GET_GLOBAL, _SET_GLOBAL = b"\x20", b"\x21", b"\x23", b"\x24"
_BLOCK, _LOOP, _IF, _ELSE, _END = b"\x02", b"\x03", b"\x04", b"\x05", b"\x0b"
_BRANCH, _BRANCH_IF, _RETURN, _CALL, _SELECT = b"\x0c", b"\x0d", b"\x0f", b"\x10", b"\x1b"
_IS_ZERO, _ADD_INTEGER, _SUBTRACT_INTEGER = b"\x45", b"\x6a", b"\x6b"
_MEMORY_COPY = b"\xfc\x0a\x00\x00"
_STACK = b"\x00"  # index of the global with the end of the free memory


def unsigned(value: int) -> bytes:
    """A number in LEB128."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def signed(value: int) -> bytes:
    """A number with a sign in LEB128."""
    out = bytearray()
    while not -64 <= value < 64:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value & 0x7F)
    return bytes(out)


def _vector(items: Sequence[bytes]) -> bytes:
    return unsigned(len(items)) + b"".join(items)


def _sized(content: bytes) -> bytes:
    return unsigned(len(content)) + content


def _text(text: str) -> bytes:
    return _sized(text.encode())


def _real(value: float) -> bytes:
    return b"\x44" + struct.pack("<d", value)


def _integer(value: int) -> bytes:
    return b"\x41" + signed(value)


def _load(index: int) -> bytes:
    return b"\x2b\x03" + unsigned(_NUMBER_SIZE * index)


def _store(index: int) -> bytes:
    return b"\x39\x03" + unsigned(_NUMBER_SIZE * index)


def emit_wasm_module(
    functions: Sequence[LinkedFunction], exports: Mapping[str, LinkedFunction], data_size: int
) -> bytes:
    """A module with linked functions, of which some are exported.

    Args:
        functions: All functions, each after what it calls.
        exports: Exported functions by name.
        data_size: Number of doubles at the start of the memory that callers may use.
    """
    first = len(IMPORTED_FUNCTIONS)
    indices = {linked.name: first + i for i, linked in enumerate(functions)}
    types = [b"\x60" + _vector([_F64]) + _vector([_F64])]
    bodies = []
    for linked in functions:
        results = [] if isinstance(linked.function, Formula) else [_I32]
        types.append(b"\x60" + _vector([_I32] * len(linked.arguments)) + _vector(results))
        bodies.append(_sized(_emit_function(linked, indices)))
    stack = 4 * PAGE_SIZE + max(_stack_size(linked) for linked in functions)
    pages = -(-(_NUMBER_SIZE * data_size + stack) // PAGE_SIZE)
    imports = [_text("math") + _text(name) + b"\x00\x00" for name in IMPORTED_FUNCTIONS]
    exported = [_text("memory") + b"\x02\x00"]
    exported += [_text(name) + b"\x00" + unsigned(indices[x.name]) for name, x in exports.items()]
    sections = {
        1: _vector(types),
        2: _vector(imports),
        3: _vector([unsigned(1 + i) for i in range(len(functions))]),
        5: _vector([b"\x00" + unsigned(pages)]),
        6: _vector([_I32 + b"\x01" + _integer(pages * PAGE_SIZE) + _END]),
        7: _vector(exported),
        10: _vector(bodies),
    }
    parts = (bytes([number]) + _sized(content) for number, content in sections.items())
    return b"\x00asm\x01\x00\x00\x00" + b"".join(parts)


def _stack_size(linked: LinkedFunction) -> int:
    """Bytes of local arrays of a function and what it calls."""
    if isinstance(linked.function, Formula):
        return 0
    own = sum(_array_size(n) for n in linked.function.local_arrays.values())
    return own + max((_stack_size(x) for x in linked.callees.values()), default=0)


def _array_size(count: int) -> int:
    return _NUMBER_SIZE * max(1, count)


def _emit_function(linked: LinkedFunction, indices: Mapping[str, int]) -> bytes:
    if isinstance(linked.function, Formula):
        return _FormulaEmitter(linked, linked.function).body()
    return _WasmRoutineEmitter(linked, linked.function, indices).body()


def _locals(kinds: Iterable[tuple[int, bytes]]) -> bytes:
    return _vector([unsigned(count) + kind for count, kind in kinds if count])


class _FormulaEmitter:
    """Writes a formula; values that are used once are computed where they are used."""

    def __init__(self, linked: LinkedFunction, formula: Formula):
        self._arguments = {name: unsigned(i) for i, name in enumerate(linked.arguments)}
        self._formula = formula
        self._operations = formula.operations
        uses = Counter(x.index for x in formula.outputs if isinstance(x, SymbolicExpression))
        for index in formula.order:
            uses.update(operand_indices(self._operations[index]))
        self._uses, self._depth = uses, dict[int, int]()
        self._local_of: dict[int, bytes] = {}

    def body(self) -> bytes:
        """Local variables and instructions."""
        code, first = bytearray(), len(self._arguments)
        for index in self._formula.order:
            operation = self._operations[index]
            inner = [self._depth.get(x, 0) for x in operand_indices(operation)]
            self._depth[index] = 1 + max(inner, default=0)
            is_deep = self._depth[index] > _MAX_DEPTH
            if self._uses[index] > 1 or is_deep or operation[0] == "positive":
                code += self._compute(index)
                self._local_of[index] = unsigned(first + len(self._local_of))
                code += _SET + self._local_of[index]
                self._depth[index] = 0
        out = _GET + self._arguments["out"]
        for i, value in enumerate(self._formula.outputs):
            code += out
            if isinstance(value, SymbolicExpression):
                code += self._value(value.index)
            else:
                code += _real(float(value))
            code += _store(i)
        return _locals([(len(self._local_of), _F64)]) + bytes(code) + _END

    def _value(self, operand: int | float) -> bytes:
        if not isinstance(operand, int):
            return _real(operand)
        local = self._local_of.get(operand)
        return self._compute(operand) if local is None else _GET + local

    def _compute(self, index: int) -> bytes:
        kind, *operands = self._operations[index]
        if kind == "load":
            return _GET + self._arguments[f"in{operands[0]}"] + _load(operands[1])
        values = [self._value(x) for x in operands]
        if kind == "positive":
            return values[1] + values[2] + values[0] + _real(0.0) + b"\x64" + _SELECT
        if kind == "dot":
            half = len(values) // 2
            products = [x + y + b"\xa2" for x, y in zip(values[:half], values[half:], strict=True)]
            return products[0] + b"".join(x + b"\xa0" for x in products[1:])
        code = b"".join(values)
        if kind in IMPORTED_FUNCTIONS:
            return code + _CALL + unsigned(IMPORTED_FUNCTIONS.index(kind))
        return code + _OPERATIONS[kind]


class _WasmRoutineEmitter:
    """Writes a routine."""

    def __init__(self, linked: LinkedFunction, routine: Routine, indices: Mapping[str, int]):
        self._linked, self._routine, self._indices = linked, routine, indices
        self._local_of: dict[str, bytes] = {}
        for name in (*linked.arguments, *routine.local_arrays):
            self._local_of[name] = unsigned(len(self._local_of))
        integers = [x.operands[0] for x in routine.variables if x.kind != "real"]
        reals = [x.operands[0] for x in routine.variables if x.kind == "real"]
        for name in (*integers, *reals):
            self._local_of[name] = unsigned(len(self._local_of))
        count = len(routine.local_arrays) + len(integers)
        self._declarations = _locals([(count, _I32), (len(reals), _F64)])
        self._code = bytearray()
        self._depth = 0  # of blocks
        self._loop_ends: list[int] = []  # depths behind the enclosing loops

    def body(self) -> bytes:
        """Local variables and instructions."""
        for name, count in self._routine.local_arrays.items():
            self._code += _GET_GLOBAL + _STACK + _integer(_array_size(count)) + _SUBTRACT_INTEGER
            self._code += _SET_GLOBAL + _STACK + _GET_GLOBAL + _STACK + _SET + self._local_of[name]
        self._emit_block(self._routine.statements)
        self._emit_return(_integer(0))
        return self._declarations + bytes(self._code) + _END

    def _emit_return(self, value: bytes) -> None:
        sizes = map(_array_size, self._routine.local_arrays.values())
        self._code += _GET_GLOBAL + _STACK + _integer(sum(sizes)) + _ADD_INTEGER
        self._code += _SET_GLOBAL + _STACK + value + _RETURN

    def _emit_block(self, statements: Sequence[RoutineStatement]) -> None:
        for statement in statements:
            self._emit(statement)

    def _emit(self, statement: RoutineStatement) -> None:
        match statement:
            case AssignmentStatement(variable, value):
                self._code += self._value(value) + self._set(variable)
            case StoreStatement(pointer, value):
                self._code += self._pointer(pointer) + self._value(value) + _store(0)
            case CopyStatement(target, source, count):
                pointers = self._pointer(target) + self._pointer(source)
                self._code += pointers + _integer(_NUMBER_SIZE * count) + _MEMORY_COPY
            case CallStatement(function, arguments, result):
                callee = self._linked.callees[function]
                for x in callee.passed(arguments):
                    word = self._pointer(x) if isinstance(x, ArrayPointer) else self._value(x)
                    self._code += word
                self._code += _CALL + unsigned(self._indices[callee.name])
                if result is not None:
                    self._code += self._set(result)
            case LoopStatement(index, count, body):
                if index is not None:
                    self._code += _integer(0) + self._set(index)
                self._code += _BLOCK + _EMPTY + _LOOP + _EMPTY
                self._depth += 2
                self._loop_ends.append(self._depth - 2)
                if index is not None and count is not None:
                    self._code += self._value(index < count) + _IS_ZERO + _BRANCH_IF + unsigned(1)
                self._emit_block(body)
                if index is not None:
                    self._code += self._value(index + 1) + self._set(index)
                self._code += _BRANCH + unsigned(0) + _END + _END
                self._loop_ends.pop()
                self._depth -= 2
            case ConditionStatement(test, body, otherwise):
                self._code += self._value(test) + _IF + _EMPTY
                self._depth += 1
                self._emit_block(body)
                if otherwise:
                    self._code += _ELSE
                    self._emit_block(otherwise)
                self._code += _END
                self._depth -= 1
            case BreakStatement():
                self._code += _BRANCH + unsigned(self._depth - self._loop_ends[-1] - 1)
            case ReturnStatement(value):
                self._emit_return(self._value(value))

    def _set(self, variable: RoutineValue) -> bytes:
        return _SET + self._local_of[variable.operands[0]]

    def _pointer(self, array: ArrayPointer) -> bytes:
        base, offset = _GET + self._local_of[array.name], array.offset
        if offset.operation == "constant":
            start = offset.operands[0]
            return base + (_integer(_NUMBER_SIZE * start) + _ADD_INTEGER if start else b"")
        scaled = self._value(offset) + _integer(_NUMBER_SIZE) + _OPERATORS["integer"]["*"]
        return base + scaled + _ADD_INTEGER

    def _value(self, value: RoutineValue) -> bytes:
        operands = value.operands
        match value.operation:
            case "constant":
                return _real(operands[0]) if value.kind == "real" else _integer(operands[0])
            case "argument" | "variable":
                return _GET + self._local_of[operands[0]]
            case "element":
                return self._pointer(operands[0].element_pointer(operands[1])) + _load(0)
            case "select":
                test, yes, no = (self._value(x) for x in operands)
                return yes + no + test + _SELECT
            case "not":
                return self._value(operands[0]) + _IS_ZERO
        kind = "truth" if value.operation in ("and", "or") else operands[0].kind
        code = b"".join(self._value(x) for x in operands)
        return code + _OPERATORS[kind][value.operation]
