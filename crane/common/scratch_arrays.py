"""Large arrays in scratch files, so that long time series do not fill the memory.

An array of `empty_array` is like any other. The system writes its pages to the file and reads them
again as they are asked for; `release_pages` takes those out of memory that are in it, and is
called by whoever goes through a whole series, in between. Nothing is lost by it.
"""

import contextlib
import math
import mmap
import os
import tempfile
import weakref
from collections.abc import Callable

import numpy as np

from crane.common.samples import Array

_MIN_FILE_ELEMENTS = 1 << 20  # numbers, 8 MiB
BLOCK_SIZE = 1 << 16  # samples that are worked on between two releases
_memory_maps: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()


def empty_array(count: int, columns: int) -> Array:
    """An array (count, columns) whose columns are contiguous.

    A large one is in a scratch file without a name in the system's folder for such files (TMPDIR),
    which is gone with the array. Where there is no room it is in memory.
    """
    shape = count, columns
    if math.prod(shape) >= _MIN_FILE_ELEMENTS:
        with contextlib.suppress(OSError):
            scratch = _map_temporary_file(math.prod(shape) * 8)
            _memory_maps.add(scratch)
            return np.ndarray(shape, np.float64, scratch, order="F")
    return np.empty(shape, order="F")


def _map_temporary_file(size: int) -> mmap.mmap:
    """So many bytes of a file, all of which have a place on the disk."""
    with tempfile.TemporaryFile(prefix="crane-") as file:
        if hasattr(os, "posix_fallocate"):  # what has no place later ends the program
            os.posix_fallocate(file.fileno(), 0, size)
        else:
            file.truncate(size)
        return mmap.mmap(file.fileno(), size)


def release_pages() -> None:
    """Take the pages of all such arrays out of memory; their numbers stay."""
    for scratch in list(_memory_maps):
        scratch.madvise(mmap.MADV_DONTNEED)


def compute_in_blocks(compute: Callable[[slice], Array], count: int) -> Array:
    """What a function computes (m, columns) of m consecutive samples, of all (count, columns).

    Args:
        compute: Called with the slices of up to `BLOCK_SIZE` samples, in their order.
        count: Number of samples, at least one.
    """
    found: Array | None = None
    for start in range(0, count, BLOCK_SIZE):
        part = slice(start, min(start + BLOCK_SIZE, count))
        values = compute(part)
        if found is None:
            found = empty_array(count, values.shape[1])
        found[part] = values
        release_pages()
    assert found is not None
    return found
