"""What is kept of a program between runs: how to call it, and where its machine code is.

It is found by what the program's formulas depend on, so that a later process need not trace them.
"""

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from crane.codegen.intermediate_representation import ArgumentKind
from crane.codegen.layout import Layout
from crane.codegen.llvm import compiler_settings
from crane.codegen.package_digest import package_digest, package_files_changed
from crane.common import file_cache
from crane.common.serialization import serialize


@dataclass(frozen=True)
class FunctionSignature:
    """How a compiled function is called.

    Attributes:
        argument_kinds: Of its arguments.
        outputs: Parts of what a formula writes, None of a routine.
    """

    argument_kinds: tuple[ArgumentKind, ...]
    outputs: Layout | None


def cache_entry_name(dependencies: Any, kind: str = "note") -> str | None:
    """The name of a program's note, or None where it cannot be kept.

    A program also depends on the package's files, on what traces it and on what compiles it.

    Args:
        dependencies: Numbers, texts, bytes, arrays, dataclasses and tuples of them, which say all
            that the program's formulas depend on besides; None where they depend on other code.
        kind: Of what is kept.

    Raises:
        TypeError: Something else, which may mean another thing to another process.
    """
    if dependencies is None:
        return None
    content = serialize(dependencies)
    package = package_digest()
    if package is None:
        return None
    tracing = sys.version, np.__version__
    return file_cache.entry_name(repr((package, tracing, compiler_settings(), content)), kind)


@dataclass(frozen=True)
class ProgramRecord:
    """What is kept of a program beside its machine code.

    Attributes:
        code_name: Name of the machine code, none of a program that is too long to compile.
        max_formula_length: Operations of its longest formula.
        signatures: How each function is called, by name.
    """

    code_name: str
    max_formula_length: int
    signatures: Mapping[str, FunctionSignature]

    @classmethod
    def from_cache(cls, entry_name: str | None) -> "ProgramRecord | None":
        """The note at a place, if there is one."""
        text = None if entry_name is None else file_cache.read_entry(entry_name)
        if text is None:
            return None
        stored = json.loads(text)
        functions = {
            name: FunctionSignature(tuple(kinds), None if parts is None else Layout(**parts))
            for name, (kinds, parts) in stored["functions"].items()
        }
        return cls(stored["code"], stored["longest"], functions)

    def write_to_cache(self, entry_name: str | None) -> None:
        """Keep it, unless the package has changed while the program was made."""
        if entry_name is None or package_files_changed():
            return
        functions = {
            name: (
                function.argument_kinds,
                None if function.outputs is None else function.outputs.parts,
            )
            for name, function in self.signatures.items()
        }
        stored = {
            "code": self.code_name,
            "longest": self.max_formula_length,
            "functions": functions,
        }
        file_cache.write_entry(entry_name, json.dumps(stored).encode())
