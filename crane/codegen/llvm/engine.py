"""From LLVM's text to functions that can be called."""

import ctypes
import functools
from collections.abc import Iterable
from typing import Any

from crane.codegen.llvm.text import ENTRY, text_of
from crane.codegen.representation import Formula, Routine
from crane.common.cache import named, object_code, read

_SPEED = 1  # of LLVM's levels of optimisation; higher ones take longer and gain nothing here
_TUNING = {"slp_vectorization": False}  # takes long and gains nothing here


class Code:
    """Machine code of a program.

    Args:
        name: Under which it is kept, see `crane.common.cache`.
        code: As LLVM put it out.
    """

    def __init__(self, name: str, code: bytes):
        import llvmlite.binding as llvm

        self.name = name
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _target())
        self._engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        self._engine.finalize_object()
        self._entries: dict[str, Any] = {}

    @classmethod
    def of(cls, functions: Iterable[Formula | Routine]) -> "Code":
        """Translate functions, or read what became of them before."""
        text = text_of(functions)
        depends = f"{settings()} {text}"
        return cls(named(depends), object_code(depends, lambda: _translated(text, _target())))

    @classmethod
    def kept(cls, name: str) -> "Code | None":
        """What is kept under a name; None if nothing is, or the name is empty."""
        code = read(name) if name else None
        return None if code is None else cls(name, code)

    def address(self, name: str) -> int:
        """Where a function is."""
        return int(self._engine.get_function_address(name))

    def entry(self, name: str) -> Any:
        """The function that takes the address of its arguments' addresses."""
        found = self._entries.get(name)
        if found is None:
            # ctypes lets other threads run meanwhile
            kind = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p)
            found = self._entries[name] = kind(self.address(ENTRY.format(name)))
        return found


@functools.cache
def settings() -> str:
    """All that machine code depends on besides the program: LLVM, the processor, what is asked."""
    import llvmlite
    import llvmlite.binding as llvm

    version = llvmlite.__version__, llvm.llvm_version_info
    return f"{version} {llvm.get_default_triple()} {_cpu()} {_SPEED} {_TUNING}"


def _cpu() -> tuple[str, str]:
    """Name and features of this processor."""
    import llvmlite.binding as llvm

    return llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()


def _target() -> Any:
    """What to translate for; one per program, because its engine owns it."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    name, features = _cpu()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=name, features=features, opt=_SPEED
    )


def _translated(text: str, target: Any) -> bytes:
    import llvmlite.binding as llvm

    module = llvm.parse_assembly(text)
    module.verify()
    options = llvm.create_pipeline_tuning_options(speed_level=_SPEED)
    for name, value in _TUNING.items():
        setattr(options, name, value)
    passes = llvm.create_pass_builder(target, options)
    passes.getModulePassManager().run(module, passes)
    return bytes(target.emit_object(module))
