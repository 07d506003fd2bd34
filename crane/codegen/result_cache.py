"""Results that are kept between runs, so that a process need not import what finds them."""

import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, TypeVar

from crane.codegen.package_digest import package_files_changed
from crane.codegen.program_cache import cache_entry_name
from crane.common import file_cache
from crane.common.serialization import deserialize, serialize

Result = TypeVar("Result")


def cached_result(
    dependencies: Any, compute: Callable[[], Result], avoided_import: str, classes: Sequence[type]
) -> Result:
    """What a function finds, or what it has found in an earlier process.

    A process that has imported the module already finds it anew: of thousands of machines that a
    study makes one is kept.

    Args:
        dependencies: All that it depends on besides code, see `cache_entry_name`.
        compute: Finds it; a value that `crane.common.serialization` writes.
        avoided_import: The module of scipy, slow to import, that this spares.
        classes: Of the objects in it.
    """
    if avoided_import in sys.modules:
        return compute()
    entry_name = cache_entry_name(
        (dependencies, file_cache.package_build("scipy"), file_cache.package_build("pinocchio")),
        "result",
    )
    cached = None if entry_name is None else file_cache.read_entry(entry_name)
    if cached is not None:
        with suppress(ValueError, KeyError):
            found: Result = deserialize(cached, classes)
            return found
    result = compute()
    if entry_name is not None and not package_files_changed():
        file_cache.write_entry(entry_name, serialize(result, classes))
    return result
