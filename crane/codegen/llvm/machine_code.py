"""From LLVM's text to functions that can be called."""

import ctypes
import functools
from collections.abc import Iterable
from typing import Any

from crane.codegen.intermediate_representation import Formula, Routine
from crane.codegen.llvm.module_emitter import ENTRY_POINT_NAME, emit_module
from crane.common.file_cache import cached_object_code, entry_name, read_entry

_OPTIMIZATION_LEVEL = (
    1  # of LLVM's levels of optimisation; higher ones take longer and gain nothing here
)
_TUNING_OPTIONS = {"slp_vectorization": False}  # takes long and gains nothing here


class MachineCode:
    """Machine code of a program.

    Args:
        cache_name: Under which it is kept, see `crane.common.file_cache`.
        object_code: As LLVM put it out.
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
        """Translate functions, or read what became of them before."""
        text = emit_module(functions)
        depends = f"{compiler_settings()} {text}"
        return cls(
            entry_name(depends),
            cached_object_code(depends, lambda: _compile_to_object_code(text, _target_machine())),
        )

    @classmethod
    def from_cache(cls, name: str) -> "MachineCode | None":
        """What is kept under a name; None if nothing is, or the name is empty."""
        code = read_entry(name) if name else None
        return None if code is None else cls(name, code)

    def function_address(self, name: str) -> int:
        """Where a function is."""
        return int(self._engine.get_function_address(name))

    def entry_point(self, name: str) -> Any:
        """The function that takes the address of its arguments' addresses."""
        found = self._entry_points.get(name)
        if found is None:
            # ctypes lets other threads run meanwhile
            kind = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p)
            found = self._entry_points[name] = kind(
                self.function_address(ENTRY_POINT_NAME.format(name))
            )
        return found


@functools.cache
def compiler_settings() -> str:
    """All that machine code depends on besides the program: LLVM, the processor, what is asked."""
    import llvmlite
    import llvmlite.binding as llvm

    version = llvmlite.__version__, llvm.llvm_version_info
    return (
        f"{version} {llvm.get_default_triple()} {_host_cpu()} {_OPTIMIZATION_LEVEL} "
        f"{_TUNING_OPTIONS}"
    )


def _host_cpu() -> tuple[str, str]:
    """Name and features of this processor."""
    import llvmlite.binding as llvm

    return llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()


def _target_machine() -> Any:
    """What to translate for; one per program, because its engine owns it."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    name, features = _host_cpu()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=name, features=features, opt=_OPTIMIZATION_LEVEL
    )


def _compile_to_object_code(text: str, target: Any) -> bytes:
    import llvmlite.binding as llvm

    module = llvm.parse_assembly(text)
    module.verify()
    options = llvm.create_pipeline_tuning_options(speed_level=_OPTIMIZATION_LEVEL)
    for name, value in _TUNING_OPTIONS.items():
        setattr(options, name, value)
    passes = llvm.create_pass_builder(target, options)
    passes.getModulePassManager().run(module, passes)
    return bytes(target.emit_object(module))
