"""Jobs of a study: here, in processes, or on a cluster."""

import multiprocessing
import os
import pickle
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from crane.common.errors import InputError
from crane.common.samples import as_count
from crane.formats import load
from crane.machine import Machine
from crane.studies.dask_cluster import compute_on_cluster

_PROCESSES_PER_CORE = (
    8  # processes: more would wait for each other, and each has the machine in memory
)
# What of a machine its files describe.
_COMPARED_ATTRIBUTES = (
    "tree", "active", "free", "friction", "forces", "gas_springs", "ropes", "end_stops",
    "hydraulics",
)  # fmt: skip

J = TypeVar("J")
R = TypeVar("R")


def machine_from_files(machine: Machine | str | Path) -> tuple[Machine, str]:
    """The machine as its files and the changes given to `load` describe it, and what loads it.

    Raises:
        InputError: It is another one: variants are loaded from files.
    """
    if not isinstance(machine, Machine):
        loaded = load(machine)
        is_same_reference = loaded.load_name == str(machine)
        return loaded, loaded.load_name if is_same_reference else str(loaded.path.resolve())
    reloaded = load(machine.path, machine.parameter_changes, machine.locked_joints)
    is_unchanged = all(
        getattr(machine, name) == getattr(reloaded, name) for name in _COMPARED_ATTRIBUTES
    )
    if not is_unchanged or _tasks_without_loads(machine) != _tasks_without_loads(reloaded):
        raise InputError(
            f"'{machine.name}' is not what its files describe, variants are loaded from them: "
            "write it with write_machine, and load that"
        )
    is_bundled = machine.load_name != str(machine.path)
    return reloaded, machine.load_name if is_bundled else str(machine.path.resolve())


def _tasks_without_loads(machine: Machine) -> dict[str, tuple[object, int]]:
    """Its tasks but for their loads, which are counted."""
    return {
        name: (replace(task, loads=()), len(task.loads)) for name, task in machine.tasks.items()
    }


def check_process_count(count: int) -> int:
    """How many processes compute, at most eight per core.

    Raises:
        InputError: It is no such number.
    """
    max_processes = _PROCESSES_PER_CORE * (os.cpu_count() or 1)
    return as_count(count, "the number of processes", 1, max_processes)


def compute_jobs(
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
        yield from compute_on_cluster(function, jobs, scheduler)
    elif processes <= 1 or len(jobs) == 1:
        for index, job in enumerate(jobs):
            yield index, function(job)
    else:
        yield from _compute_in_processes(function, jobs, min(processes, len(jobs)))


def _exit_with_parent() -> None:
    """Let this process end when the one that started it has, however that was."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _compute_in_processes(
    function: Callable[[J], R], jobs: Sequence[J], processes: int
) -> Iterator[tuple[int, R]]:
    # threads would wait for each other: most of a variant is computed in Python
    try:
        pickle.dumps(jobs[0])
    except (AttributeError, TypeError, pickle.PicklingError) as error:
        raise InputError(
            "measures that are lambdas or local functions stay in one process: give a Python "
            f"file, functions of a module, or processes=1 ({error})"
        ) from None
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(processes, context, initializer=_exit_with_parent)
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
