"""Programs in LLVM's language, and from there to machine code."""

from crane.codegen.llvm.machine_code import MachineCode, compiler_settings

__all__ = ["MachineCode", "compiler_settings"]
