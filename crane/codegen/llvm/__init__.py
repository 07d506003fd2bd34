"""Programs in LLVM's language, and from there to machine code."""

from crane.codegen.llvm.engine import Code, settings

__all__ = ["Code", "settings"]
