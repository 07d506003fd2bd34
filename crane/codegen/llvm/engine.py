"""From LLVM's text to functions that can be called."""

import ctypes
from collections.abc import Iterable
from typing import Any

from crane.codegen.llvm.text import ENTRY, text_of
from crane.codegen.representation import Formula, Routine


class Code:
    """Machine code of a program.

    Args:
        functions: What to translate.
    """

    def __init__(self, functions: Iterable[Formula | Routine]):
        llvm, target = _target()
        module = llvm.parse_assembly(text_of(functions))
        module.verify()
        options = llvm.create_pipeline_tuning_options(speed_level=2)
        options.slp_vectorization = False  # takes long and gains nothing here
        passes = llvm.create_pass_builder(target, options)
        passes.getModulePassManager().run(module, passes)
        self._engine = llvm.create_mcjit_compiler(module, target)
        self._engine.finalize_object()
        self._entries: dict[str, Any] = {}

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


def _target() -> tuple[Any, Any]:
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    # one per program: its engine owns it
    target = llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=2
    )
    return llvm, target
