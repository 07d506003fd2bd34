"""Jobs of a study: here, in processes, or on a cluster."""

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from crane.common.errors import InputError
from crane.studies.cluster import by_workers

J = TypeVar("J")
R = TypeVar("R")


def computed(
    function: Callable[[J], R], jobs: Sequence[J], processes: int, scheduler: str | None
) -> Iterator[tuple[int, R]]:
    """Indices and results of jobs as they get ready, here or elsewhere.

    Args:
        function: What is computed; other processes import it from this package.
        jobs: Its arguments.
        processes: How many compute.
        scheduler: Address of a Dask scheduler whose workers compute instead.
    """
    if scheduler is not None:
        yield from by_workers(function, jobs, scheduler)
    elif processes <= 1 or len(jobs) == 1:
        for index, job in enumerate(jobs):
            yield index, function(job)
    else:
        yield from _by_processes(function, jobs, min(processes, len(jobs)))


def _end_with_parent() -> None:
    """Let this process end when the one that started it has, however that was."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _by_processes(
    function: Callable[[J], R], jobs: Sequence[J], processes: int
) -> Iterator[tuple[int, R]]:
    # threads would wait for each other: most of a variant is computed in Python
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(processes, context, initializer=_end_with_parent)
    try:
        futures = {pool.submit(function, job): index for index, job in enumerate(jobs)}
        for future in as_completed(futures):
            yield futures[future], future.result()
    except BrokenProcessPool:
        raise InputError(
            "a process ended before its time: guard what your script runs with "
            "if __name__ == '__main__':, or take one process"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)
