"""From tapes to machine code, through LLVM."""

import ctypes
import struct
from collections.abc import Sequence
from typing import Any

from crane.straight.functions import VECTOR, WIDEST, definitions
from crane.straight.scalar import Expression, Number

# Products may be fused with sums. Reordering sums would gain nothing and let NaN cancel.
_FAST = "nsz arcp contract"
_CALLS = {
    "sqrt": "@llvm.sqrt.f64", "abs": "@llvm.fabs.f64", "maximum": "@larger",
    "copysign": "@llvm.copysign.f64", "positive": "@chosen",
}  # fmt: skip
_DECLARATIONS = """
declare double @llvm.sqrt.f64(double)
declare double @llvm.fabs.f64(double)
declare double @llvm.copysign.f64(double, double)
declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)
define internal double @chosen(double %x, double %yes, double %no) alwaysinline {
  %positive = fcmp ogt double %x, 0.0
  %out = select i1 %positive, double %yes, double %no
  ret double %out
}
define internal double @larger(double %a, double %b) alwaysinline {
  %more = fcmp oge double %a, %b
  %out = select i1 %more, double %a, double %b
  %odd = fcmp uno double %a, %a
  %seen = select i1 %odd, double %a, double %out
  ret double %seen
}
"""


MOST = 60_000  # operations of a function; longer ones take minutes to compile


class TooLongError(Exception):
    """A function has more than `MOST` operations."""


class Program:
    """Straight-line functions f(in_0, in_1, ..., out) of arrays, and loops that call them.

    Attributes:
        sizes: Number of outputs of each function.
    """

    def __init__(self) -> None:
        self._texts = [_DECLARATIONS]
        self._functions: set[tuple[str, int]] = set()
        self.sizes: dict[str, int] = {}
        self._engine: Any = None

    def add(self, name: str, arrays: int, outputs: Sequence[Number]) -> None:
        """Add a function: `arrays` arguments that are read, and one that takes the outputs.

        Raises:
            TooLongError: It has too many operations.
        """
        self._texts.append(_function(name, arrays, outputs, self._functions))
        self.sizes[name] = len(outputs)

    def add_text(self, text: str) -> None:
        """Add a function written in LLVM's language."""
        self._texts.append(text)

    def compile(self) -> None:
        """Translate everything that was added."""
        llvm, target = _target()
        module = llvm.parse_assembly("\n".join([*self._texts, definitions(self._functions)]))
        module.verify()
        options = llvm.create_pipeline_tuning_options(speed_level=2)
        options.slp_vectorization = False  # takes long and gains nothing here
        passes = llvm.create_pass_builder(target, options)
        passes.getModulePassManager().run(module, passes)
        self._engine = llvm.create_mcjit_compiler(module, target)
        self._engine.finalize_object()

    def function(self, name: str, *arguments: Any, result: Any = None) -> Any:
        """A compiled function as one of ctypes, which lets other threads run meanwhile."""
        return ctypes.CFUNCTYPE(result, *arguments)(self.address(name))

    def address(self, name: str) -> int:
        """Where a compiled function is, for as long as the program lives."""
        return int(self._engine.get_function_address(name))


def _target() -> tuple[Any, Any]:
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    # one per program: its engine owns it
    target = llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=2
    )
    return llvm, target


def _function(
    name: str, arrays: int, outputs: Sequence[Number], functions: set[tuple[str, int]]
) -> str:
    """LLVM's text; adds to `functions` what it calls of `definitions`."""
    arguments = [f"ptr noalias readonly %in{i}" for i in range(arrays)]
    lines = [f"define void @{name}({', '.join([*arguments, 'ptr noalias %out'])}) {{"]
    tapes = {value.tape for value in outputs if isinstance(value, Expression)}
    operations = tapes.pop().operations if tapes else []
    needed = _needed(operations, outputs)
    if len(needed) > MOST:
        raise TooLongError
    for level in _levels(operations, needed):
        lines += _at_once([(i, operations[i]) for i in level if _vector(operations[i])], functions)
        for index in level:
            if not _vector(operations[index]):
                lines += _single(index, *operations[index])
    for i, value in enumerate(outputs):
        word = _operand(value.index if isinstance(value, Expression) else float(value))
        lines.append(f"  %q{i} = getelementptr double, ptr %out, i64 {i}")
        lines.append(f"  store double {word}, ptr %q{i}")
    return "\n".join([*lines, "  ret void", "}"])


def _vector(operation: tuple) -> bool:
    return operation[0] in VECTOR


def _levels(operations: Sequence[tuple], needed: Sequence[int]) -> list[list[int]]:
    """Operations by how many of `VECTOR` come after each other on the way to them."""
    level: dict[int, int] = {}
    out: list[list[int]] = []
    for index in needed:
        operation = operations[index]
        used = [] if operation[0] == "load" else [x for x in operation[1:] if isinstance(x, int)]
        level[index] = max((level[x] for x in used), default=0) + _vector(operation)
        while len(out) <= level[index]:
            out.append([])
        out[level[index]].append(index)
    return out


def _at_once(calls: list[tuple[int, tuple]], functions: set[tuple[str, int]]) -> list[str]:
    """Functions of `VECTOR`, each of as many numbers as there are."""
    lines = []
    for name in sorted({operation[0] for _, operation in calls}):
        same = [(index, operand) for index, (kind, operand) in calls if kind == name]
        for start in range(0, len(same), WIDEST):
            part = same[start : start + WIDEST]
            width = 1 << (len(part) - 1).bit_length()
            functions.add((name, width))
            kind, vector = f"<{width} x double>", "poison"
            for lane in range(width):  # the first once more where there are too few
                index, operand = part[lane] if lane < len(part) else part[0]
                word, made = _operand(operand), f"%{name}{part[0][0]}_{lane}"
                lines.append(
                    f"  {made} = insertelement {kind} {vector}, double {word}, i32 {lane}"
                )
                vector = made
            result = f"%{name}{part[0][0]}"
            lines.append(f"  {result} = call {kind} @{name}{width}({kind} {vector})")
            lines += [
                f"  %v{index} = extractelement {kind} {result}, i32 {lane}"
                for lane, (index, _) in enumerate(part)
            ]
    return lines


def _single(index: int, kind: str, *operands: Any) -> list[str]:
    """One operation of one number."""
    if kind == "load":
        array, at = operands
        return [
            f"  %p{index} = getelementptr double, ptr %in{array}, i64 {at}",
            f"  %v{index} = load double, ptr %p{index}",
        ]
    words = [_operand(operand) for operand in operands]
    if kind == "fneg":
        return [f"  %v{index} = fneg double {words[0]}"]
    if kind in _CALLS:
        typed = ", ".join(f"double {word}" for word in words)
        return [f"  %v{index} = call double {_CALLS[kind]}({typed})"]
    return [f"  %v{index} = {kind} {_FAST} double {words[0]}, {words[1]}"]


def _needed(operations: Sequence[tuple], outputs: Sequence[Number]) -> list[int]:
    """Indices of the operations that the outputs depend on, in order."""
    needed: set[int] = set()
    waiting = [value.index for value in outputs if isinstance(value, Expression)]
    while waiting:
        index = waiting.pop()
        if index not in needed:
            needed.add(index)
            kind, *operands = operations[index]
            if kind != "load":
                waiting += [operand for operand in operands if isinstance(operand, int)]
    return sorted(needed)


def _operand(operand: float | int) -> str:
    if isinstance(operand, int):
        return f"%v{operand}"
    (bits,) = struct.unpack(">Q", struct.pack(">d", operand))
    return f"0x{bits:016X}"
