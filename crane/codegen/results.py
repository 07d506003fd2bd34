"""Results that are kept between runs, so that a process need not import what finds them."""

import os
import pickle
import sys
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, TypeVar

from crane.codegen.kept import place_of
from crane.codegen.llvm import objects
from crane.codegen.package import changed

Result = TypeVar("Result")


def kept_result(depends: Any, find: Callable[[], Result], spares: str) -> Result:
    """What a function finds, or what it has found in an earlier process.

    A process that has imported the module already finds it anew: of thousands of machines that a
    study makes one is kept.

    Args:
        depends: All that it depends on besides code, see `place_of`.
        find: Finds it; what can be pickled.
        spares: The module of scipy, slow to import, that this spares.
    """
    if spares in sys.modules:
        return find()
    place = place_of((depends, _build_of("scipy"), _build_of("pinocchio")), "result")
    kept = None if place is None else objects.read(place)
    if kept is not None:
        result: Result = pickle.loads(kept)
        return result
    result = find()
    if place is not None and not changed():
        objects.write(place, pickle.dumps(result))
    return result


def _build_of(package: str) -> tuple[int, int]:
    """What differs between builds of a package, of which it need not be imported."""
    spec = find_spec(package)
    assert spec is not None and spec.origin is not None
    about = os.stat(spec.origin)
    return about.st_mtime_ns, about.st_size
