"""Results that are kept between runs, so that a process need not import what finds them."""

import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, TypeVar

from crane.codegen.kept import place_of
from crane.codegen.package import changed
from crane.common import cache
from crane.common.serialization import deserialize, serialize

Result = TypeVar("Result")


def kept_result(
    depends: Any, find: Callable[[], Result], spares: str, classes: Sequence[type]
) -> Result:
    """What a function finds, or what it has found in an earlier process.

    A process that has imported the module already finds it anew: of thousands of machines that a
    study makes one is kept.

    Args:
        depends: All that it depends on besides code, see `place_of`.
        find: Finds it; a value that `crane.common.serialization` writes.
        spares: The module of scipy, slow to import, that this spares.
        classes: Of the objects in it.
    """
    if spares in sys.modules:
        return find()
    place = place_of((depends, cache.build_of("scipy"), cache.build_of("pinocchio")), "result")
    kept = None if place is None else cache.read(place)
    if kept is not None:
        with suppress(ValueError, KeyError):
            found: Result = deserialize(kept, classes)
            return found
    result = find()
    if place is not None and not changed():
        cache.write(place, serialize(result, classes))
    return result
