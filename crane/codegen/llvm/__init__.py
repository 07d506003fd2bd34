"""Translation of programs to LLVM's intermediate language and to machine code."""

from crane.codegen.llvm.machine_code import MachineCode, compiler_settings

__all__ = ["MachineCode", "compiler_settings"]
