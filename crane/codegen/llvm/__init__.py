"""Programs in LLVM's language, and from there to machine code."""

from crane.codegen.llvm.engine import Code

__all__ = ["Code"]
