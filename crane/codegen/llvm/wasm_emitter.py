"""Linked functions as a WebAssembly module (core specification 1.0, and bulk memory), by LLVM.

Arrays are addresses in the memory of the module, which is exported as `memory`; numbers are
doubles. Local arrays lie on a stack at the end of the memory. Functions are imported from `math`:
sin, cos, exp, log and tanh.

LLVM writes an object file, which is a module that imports its memory and its stack and exports
nothing; its indices stay where these are its own (WebAssembly tool conventions, Linking.md).
"""

from collections.abc import Iterator, Mapping, Sequence

from crane.codegen.linked_functions import LinkedFunction
from crane.codegen.llvm.formula_emitter import emit_formula
from crane.codegen.llvm.machine_code import DECLARATIONS, compile_to_object_code, compiler_settings
from crane.codegen.llvm.routine_emitter import emit_routine
from crane.codegen.llvm.vector_functions import call_functions
from crane.codegen.vector_layout import Formula
from crane.common.file_cache import cached_object_code

PAGE_SIZE = 65_536
_TARGET, _FEATURES = "wasm32-unknown-unknown", "+bulk-memory"
_NUMBER_SIZE, _ALIGNMENT = 8, 64
_HEADER = b"\x00asm\x01\x00\x00\x00"
_CUSTOM, _IMPORTS, _MEMORIES, _GLOBALS, _EXPORTS = 0, 2, 5, 6, 7  # sections
_DATA = 11
_SYMBOL_TABLE = 8  # part of the section "linking"
_FUNCTION, _UNDEFINED, _EXPLICIT_NAME, _LOCAL = 0, 0x10, 0x40, 0x02  # kind and flags of symbols


def emit_wasm_module(
    functions: Sequence[LinkedFunction], exports: Mapping[str, LinkedFunction], data_size: int
) -> bytes:
    """A module with linked functions, of which some are exported.

    Args:
        functions: All functions, each after what it calls.
        exports: Exported functions by name; their arguments are arrays.
        data_size: Number of doubles at the start of the memory that callers may use.
    """
    text = _emit_text(functions, exports)
    settings = f"{compiler_settings()} {_TARGET} {_FEATURES}"
    code = cached_object_code(f"{settings} {text}", lambda: _compile(text))
    stack = sum(map(_stack_size, functions))  # no function is on the stack twice
    pages = 2 + (_NUMBER_SIZE * data_size + stack) // PAGE_SIZE
    return _link(code, pages)


def _emit_text(functions: Sequence[LinkedFunction], exports: Mapping[str, LinkedFunction]) -> str:
    """LLVM IR, with functions of 32 bit integers for what is exported."""
    vector_functions: set[tuple[str, int]] = set()
    texts = [DECLARATIONS]
    for linked in functions:
        texts.append(
            emit_formula(linked.function, vector_functions, linked)
            if isinstance(linked.function, Formula)
            else emit_routine(linked.function, linked)
        )
    for name, linked in exports.items():
        arguments = ", ".join(f"ptr %{x}" for x in linked.arguments)
        texts.append(
            f"define i32 @{name}({arguments}) {{\n  %1 = call i64 @{linked.name}({arguments})\n"
            "  %2 = trunc i64 %1 to i32\n  ret i32 %2\n}"
        )
    return "\n".join([*texts, call_functions(vector_functions)])


def _compile(text: str) -> bytes:
    import llvmlite.binding as llvm

    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple(_TARGET).create_target_machine(features=_FEATURES, opt=1)
    head = f'target datalayout = "{target.target_data}"\ntarget triple = "{_TARGET}"\n'
    return compile_to_object_code(head + text, target)


def _stack_size(linked: LinkedFunction) -> int:
    """Most bytes of local arrays of a function."""
    if isinstance(linked.function, Formula):
        return _NUMBER_SIZE * len(linked.function.order) + _ALIGNMENT
    sizes = linked.function.local_arrays.values()
    return sum(_NUMBER_SIZE * size + _ALIGNMENT for size in sizes)


class _WasmModuleReader:
    """Reads numbers and texts of a module."""

    def __init__(self, data: bytes):
        self._data, self._at = data, 0

    def __bool__(self) -> bool:
        return self._at < len(self._data)

    def number(self) -> int:
        """A number in LEB128, or a byte below 128."""
        value, shift = 0, 0
        while True:
            byte = self._data[self._at]
            self._at += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    def content(self) -> bytes:
        """Bytes after their number."""
        size = self.number()
        self._at += size
        return self._data[self._at - size : self._at]

    def rest(self) -> bytes:
        """What was not read yet."""
        return self._data[self._at :]


def _link(code: bytes, pages: int) -> bytes:
    """A module from an object file: with a memory, a stack and exports of all global functions."""
    found: dict[int, bytes] = {}
    symbols = b""
    reader = _WasmModuleReader(code[len(_HEADER) :])
    while reader:
        number, content = reader.number(), reader.content()
        if number != _CUSTOM:
            found[number] = content
        elif (custom := _WasmModuleReader(content)).content() == b"linking":
            symbols = custom.rest()
    assert _DATA not in found, "formulas have no data"
    functions = [_sized(b"math") + _sized(name) + b"\x00" + _number(kind)
                 for name, kind in _imported_functions(found[_IMPORTS])]  # fmt: skip
    exports = [_sized(b"memory") + b"\x02\x00"]
    exports += [_sized(name) + b"\x00" + _number(x) for name, x in _global_functions(symbols)]
    end_of_stack = b"\x41" + _number(pages * PAGE_SIZE) + b"\x0b"
    found |= {
        _IMPORTS: _vector(functions),
        _MEMORIES: _vector([b"\x00" + _number(pages)]),
        _GLOBALS: _vector([b"\x7f\x01" + end_of_stack]),
        _EXPORTS: _vector(exports),
    }
    parts = (bytes([number]) + _sized(found[number]) for number in sorted(found))
    return _HEADER + b"".join(parts)


def _imported_functions(section: bytes) -> Iterator[tuple[bytes, int]]:
    """Names and types of functions; not the memory and the stack, of two numbers each."""
    reader = _WasmModuleReader(section)
    for _ in range(reader.number()):
        reader.content()  # its module
        name, kind, number = reader.content(), reader.number(), reader.number()
        if kind == _FUNCTION:
            yield name, number
        else:
            reader.number()


def _global_functions(linking: bytes) -> Iterator[tuple[bytes, int]]:
    """Names and indices of defined functions that other object files may call."""
    reader = _WasmModuleReader(linking)
    reader.number()  # version
    while reader:
        part, content = reader.number(), _WasmModuleReader(reader.content())
        for _ in range(content.number() if part == _SYMBOL_TABLE else 0):
            kind, flags, index = content.number(), content.number(), content.number()
            has_name = not flags & _UNDEFINED or flags & _EXPLICIT_NAME
            name = content.content() if has_name else b""
            if kind == _FUNCTION and not flags & (_UNDEFINED | _LOCAL):
                yield name, index


def _number(value: int) -> bytes:
    """A number below 2^31 in LEB128 of five bytes, the same with and without a sign."""
    return bytes([*(value >> shift & 0x7F | 0x80 for shift in range(0, 28, 7)), value >> 28])


def _sized(content: bytes) -> bytes:
    return _number(len(content)) + content


def _vector(items: Sequence[bytes]) -> bytes:
    return _number(len(items)) + b"".join(items)
