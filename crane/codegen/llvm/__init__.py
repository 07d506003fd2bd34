"""Translation of programs to LLVM's intermediate language and to machine code."""
