"""Jobs of a study: in this process, in several processes, or on a Dask cluster."""

import multiprocessing
import os
import pickle
import re
import threading
import uuid
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from crane.common.errors import CraneWarning, InputError
from crane.common.optional_libraries import import_optional_library
from crane.common.samples import as_count
from crane.formats.machine_loading import load
from crane.machine.machine import Machine

_CONNECTION_TIMEOUT = 10.0  # [s] for the scheduler to answer

J = TypeVar("J")
R = TypeVar("R")


def compute_on_cluster(
    function: Callable[[J], R], jobs: Sequence[J], scheduler: str
) -> Iterator[tuple[int, Any]]:
    """Yield indices and results of jobs on a Dask cluster as they finish.

    Jobs of a worker that dies are computed by the other workers.

    Args:
        function: Function of a job; workers import it from this package.
        jobs: Arguments of the function.
        scheduler: Address of the scheduler.

    Raises:
        InputError: Dask is not installed, the scheduler does not answer, or workers keep dying.
    """
    dask = import_optional_library("distributed", "a scheduler")
    if not re.fullmatch(r"(\w+://)?[^\s/]+:\d+/?", scheduler):
        raise InputError(
            f"'{scheduler}' is no address of a scheduler, give one such as tcp://HOST:8786"
        )
    try:
        client = dask.Client(scheduler, timeout=_CONNECTION_TIMEOUT, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"no scheduler answers at '{scheduler}' ({error}), start one with 'dask scheduler' "
            "and give the address that it prints"
        ) from None
    with client:
        if not client.scheduler_info()["workers"]:
            warnings.warn(
                f"the scheduler at {scheduler} has no workers yet, start some with "
                f"'dask worker {scheduler}'",
                CraneWarning,
                stacklevel=2,
            )
        run = uuid.uuid4().hex
        futures = client.map(
            function,
            jobs,
            key=[f"crane-study-{run}-{index}" for index in range(len(jobs))],
            pure=False,
        )
        indices = {future.key: index for index, future in enumerate(futures)}
        for future in dask.as_completed(futures, loop=client.loop):
            yield indices[future.key], _job_result(future, indices[future.key], scheduler)


def _job_result(future: Any, index: int, scheduler: str) -> Any:
    from distributed import KilledWorker

    if future.status == "finished":
        return future.result()
    failure = future.exception() if future.status == "error" else None
    if isinstance(failure, KilledWorker):
        raise InputError(
            f"variant {index} was begun by several workers and all of them died, see "
            "their logs: give them more memory or fewer threads"
        )
    if isinstance(failure, ImportError | AttributeError):
        raise InputError(
            f"the workers cannot run this version of crane ({failure}), install it there"
        )
    if failure is None:
        raise InputError(f"the scheduler at {scheduler} is gone, start it again")
    raise failure


_PROCESSES_PER_CORE = 8  # more would wait for each other, and each keeps the machine in memory
# attributes of a machine that its files describe
_COMPARED_ATTRIBUTES = (
    "tree", "active", "free", "friction", "forces", "gas_springs", "ropes", "end_stops",
    "hydraulics", "gravity",
)  # fmt: skip


def machine_from_files(machine: Machine | str | Path) -> tuple[Machine, str]:
    """Return a machine as its files and changes describe it, and the argument that loads it.

    Raises:
        InputError: The machine differs from its files, from which variants are loaded.
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
    return {
        name: (replace(task, loads=()), len(task.loads)) for name, task in machine.tasks.items()
    }


def check_process_count(count: int) -> int:
    """Return a number of processes, at most eight per core.

    Raises:
        InputError: The number is not valid.
    """
    return as_count(
        count, "the number of processes", 1, _PROCESSES_PER_CORE * (os.cpu_count() or 1)
    )


def compute_jobs(
    function: Callable[[J], R],
    jobs: Sequence[J],
    processes: int,
    scheduler: str | None,
    report: Callable[[int], object],
) -> list[R]:
    """Return the results of jobs.

    Args:
        function: Function of a job; other processes import it from this package.
        jobs: Arguments of the function.
        processes: Number of processes.
        scheduler: Address of a Dask scheduler whose workers compute instead.
        report: Called with the number of finished jobs after each.
    """
    if scheduler is not None:
        finished = compute_on_cluster(function, jobs, scheduler)
    elif processes <= 1 or len(jobs) == 1:
        finished = ((index, function(job)) for index, job in enumerate(jobs))
    else:
        finished = _compute_in_processes(function, jobs, min(processes, len(jobs)))
    results: dict[int, R] = {}
    for index, result in finished:
        results[index] = result
        report(len(results))
    return [results[index] for index in range(len(jobs))]


def _exit_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _compute_in_processes(
    function: Callable[[J], R], jobs: Sequence[J], processes: int
) -> Iterator[tuple[int, R]]:
    # processes, because most of a variant is computed in Python, under the interpreter lock
    try:
        pickle.dumps(jobs[0])
    except (AttributeError, TypeError, pickle.PicklingError) as error:
        raise InputError(
            "measures that are lambdas or local functions stay in one process: give a Python "
            f"file, functions of a module, or processes=1 ({error})"
        ) from None
    pool = ProcessPoolExecutor(
        processes, multiprocessing.get_context("spawn"), initializer=_exit_with_parent
    )
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
