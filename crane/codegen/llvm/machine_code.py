"""LLVM modules of programs, and their compilation to functions that can be called."""

import ctypes
import functools
from collections.abc import Iterable
from typing import Any

from crane.codegen.llvm.formula_emitter import emit_formula
from crane.codegen.llvm.routine_emitter import emit_routine
from crane.codegen.llvm.vector_functions import define_functions
from crane.codegen.routine_statements import Routine
from crane.codegen.vector_layout import Formula
from crane.common.file_cache import cached_object_code, entry_name, read_entry

ENTRY_POINT_NAME = "{}.entry"  # the function that takes all arguments by one pointer
DECLARATIONS = """
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


def emit_module(functions: Iterable[Formula | Routine]) -> str:
    """The LLVM IR of formulas and routines."""
    vector_functions: set[tuple[str, int]] = set()
    texts = [DECLARATIONS]
    for function in functions:
        if isinstance(function, Formula):
            texts += [
                emit_formula(function, vector_functions),
                _emit_entry_point(function, "void"),
            ]
        else:
            texts += [emit_routine(function), _emit_entry_point(function, "i64")]
    return "\n".join([*texts, define_functions(vector_functions)])


def _emit_entry_point(function: Formula | Routine, return_type: str) -> str:
    """A function that takes one pointer to all arguments."""
    lines, words = [f"define i64 @{ENTRY_POINT_NAME.format(function.name)}(ptr %a) {{"], []
    for i, argument in enumerate(function.argument_kinds):
        kind = "i64" if argument == "count" else "ptr"
        lines.append(f"  %p{i} = getelementptr i64, ptr %a, i64 {i}")
        lines.append(f"  %v{i} = load {kind}, ptr %p{i}")
        words.append(f"{kind} %v{i}")
    call = f"call {return_type} @{function.name}({', '.join(words)})"
    if return_type == "void":
        return "\n".join([*lines, f"  {call}", "  ret i64 0", "}"])
    return "\n".join([*lines, f"  %answer = {call}", "  ret i64 %answer", "}"])


# LLVM optimization level; higher ones take longer and gain nothing here
_OPTIMIZATION_LEVEL = 1
_TUNING_OPTIONS = {"slp_vectorization": False}  # takes long and gains nothing here


class MachineCode:
    """Machine code of a program.

    Args:
        name: Name of the cache entry, see `crane.common.file_cache`.
        object_code: Object file from LLVM.

    Attributes:
        cache_name: Name of the cache entry.
    """

    def __init__(self, name: str, object_code: bytes):
        import llvmlite.binding as llvm

        self.cache_name = name
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _target_machine())
        self._engine.add_object_file(llvm.ObjectFileRef.from_data(object_code))
        self._engine.finalize_object()
        self._entry_points: dict[str, Any] = {}

    @classmethod
    def compile_functions(cls, functions: Iterable[Formula | Routine]) -> "MachineCode":
        """Compile functions, or read their machine code from the cache."""
        return cls.compile_text(emit_module(functions))

    @classmethod
    def compile_text(cls, text: str) -> "MachineCode":
        """Compile LLVM IR, or read its machine code from the cache."""
        depends = f"{compiler_settings()} {text}"
        return cls(
            entry_name(depends),
            cached_object_code(depends, lambda: compile_to_object_code(text, _target_machine())),
        )

    @classmethod
    def from_cache(cls, name: str) -> "MachineCode | None":
        """The machine code of a cache entry; None if there is none, or the name is empty."""
        code = read_entry(name) if name else None
        return None if code is None else cls(name, code)

    def function_address(self, name: str) -> int:
        """Address of a function."""
        return int(self._engine.get_function_address(name))

    def entry_point(self, name: str) -> Any:
        """The function that takes the address of its arguments' addresses."""
        found = self._entry_points.get(name)
        if found is None:
            # ctypes releases the global interpreter lock
            kind = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p)
            found = self._entry_points[name] = kind(
                self.function_address(ENTRY_POINT_NAME.format(name))
            )
        return found


@functools.cache
def compiler_settings() -> str:
    """Everything that machine code depends on besides the program: LLVM, processor, options."""
    import llvmlite
    import llvmlite.binding as llvm

    version = llvmlite.__version__, llvm.llvm_version_info
    return (
        f"{version} {llvm.get_default_triple()} {host_cpu()} {_OPTIMIZATION_LEVEL} "
        f"{_TUNING_OPTIONS}"
    )


@functools.cache
def host_cpu() -> tuple[str, str]:
    """Name and features of the processor."""
    import llvmlite.binding as llvm

    return llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()


def _target_machine() -> Any:
    """A target machine; one per program, because the engine of the program owns it."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    name, features = host_cpu()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=name, features=features, opt=_OPTIMIZATION_LEVEL
    )


def compile_to_object_code(text: str, target: Any) -> bytes:
    """Compile LLVM IR for a target machine."""
    import llvmlite.binding as llvm

    module = llvm.parse_assembly(text)
    module.verify()
    options = llvm.create_pipeline_tuning_options(speed_level=_OPTIMIZATION_LEVEL)
    for name, value in _TUNING_OPTIONS.items():
        setattr(options, name, value)
    passes = llvm.create_pass_builder(target, options)
    passes.getModulePassManager().run(module, passes)
    return bytes(target.emit_object(module))
