"""What is kept of a program between runs: how to call it, and where its machine code is.

It is found by what the program's formulas depend on, so that a later process need not trace them.
"""

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from crane.codegen.layout import Layout
from crane.codegen.llvm import settings
from crane.codegen.package import changed, package_digest
from crane.codegen.representation import ArgumentKind
from crane.common import cache
from crane.common.serialization import serialize


@dataclass(frozen=True)
class Signature:
    """How a compiled function is called.

    Attributes:
        kinds: Of its arguments.
        outputs: Parts of what a formula writes, None of a routine.
    """

    kinds: tuple[ArgumentKind, ...]
    outputs: Layout | None


def place_of(depends: Any, kind: str = "note") -> str | None:
    """The name of a program's note, or None where it cannot be kept.

    A program also depends on the package's files, on what traces it and on what compiles it.

    Args:
        depends: Numbers, texts, bytes, arrays, dataclasses and tuples of them, which say all that
            the program's formulas depend on besides; None where they depend on other code.
        kind: Of what is kept.

    Raises:
        TypeError: Something else, which may mean another thing to another process.
    """
    if depends is None:
        return None
    content = serialize(depends)
    package = package_digest()
    if package is None:
        return None
    tracing = sys.version, np.__version__
    return cache.named(repr((package, tracing, settings(), content)), kind)


@dataclass(frozen=True)
class Note:
    """What is kept of a program beside its machine code.

    Attributes:
        code: Name of the machine code, none of a program that is too long to compile.
        longest: Operations of its longest formula.
        functions: How each function is called, by name.
    """

    code: str
    longest: int
    functions: Mapping[str, Signature]

    @classmethod
    def read(cls, place: str | None) -> "Note | None":
        """The note at a place, if there is one."""
        text = None if place is None else cache.read(place)
        if text is None:
            return None
        said = json.loads(text)
        functions = {
            name: Signature(tuple(kinds), None if parts is None else Layout(**parts))
            for name, (kinds, parts) in said["functions"].items()
        }
        return cls(said["code"], said["longest"], functions)

    def write(self, place: str | None) -> None:
        """Keep it, unless the package has changed while the program was made."""
        if place is None or changed():
            return
        functions = {
            name: (function.kinds, None if function.outputs is None else function.outputs.parts)
            for name, function in self.functions.items()
        }
        said = {"code": self.code, "longest": self.longest, "functions": functions}
        cache.write(place, json.dumps(said).encode())
