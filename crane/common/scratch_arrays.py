"""Large arrays in scratch files, so that long time series do not fill the memory.

An array of `empty_array` is a normal array whose pages the system writes to a file and reads on
access; `release_pages` removes its pages from memory, and is called repeatedly by code that goes
through a whole series. No data are lost.
"""

import contextlib
import math
import mmap
import os
import tempfile
import weakref
from collections.abc import Callable, Iterable

import numpy as np

from crane.common.samples import Array

MIN_FILE_ELEMENTS = 1 << 20  # elements, 8 MiB
BLOCK_SIZE = 1 << 16  # samples between two releases
_memory_maps: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()


def empty_array(count: int, columns: int) -> Array:
    """An array (count, columns) whose columns are contiguous.

    A large one is in an unnamed scratch file in the system's folder for temporary files (TMPDIR),
    which is removed with the array; in memory if the disk is full.
    """
    shape = count, columns
    if math.prod(shape) >= MIN_FILE_ELEMENTS:
        with contextlib.suppress(OSError):
            scratch = _map_temporary_file(math.prod(shape) * 8)
            _memory_maps.add(scratch)
            return np.ndarray(shape, np.float64, scratch, order="F")
    return np.empty(shape, order="F")


def stack_columns(columns: Iterable[Array], count: int) -> Array:
    """An array (N, columns) as of `empty_array` from columns (N,), which may be computed in turn.

    Args:
        columns: The columns.
        count: Number of columns.
    """
    found: Array | None = None
    for i, column in enumerate(columns):
        if found is None:
            found = empty_array(len(column), count)
        found[:, i] = column
        release_pages()
    assert found is not None
    return found


def _map_temporary_file(size: int) -> mmap.mmap:
    with tempfile.TemporaryFile(prefix="crane-") as file:
        if hasattr(os, "posix_fallocate"):  # a full disk would later kill the process
            os.posix_fallocate(file.fileno(), 0, size)
        else:
            file.truncate(size)
        return mmap.mmap(file.fileno(), size)


def release_pages() -> None:
    """Remove the pages of all such arrays from memory; their values stay."""
    for scratch in list(_memory_maps):
        scratch.madvise(mmap.MADV_DONTNEED)


def compute_in_blocks(compute: Callable[[slice], Array], count: int) -> Array:
    """Evaluate a function of blocks of samples for a whole series.

    Args:
        compute: Returns (m, columns) for a slice of m <= `BLOCK_SIZE` samples; called in order.
        count: Number of samples, at least one.

    Returns:
        (count, columns).
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
