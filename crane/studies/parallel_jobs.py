"""Jobs of a study: in this process, in several processes, or on a Dask cluster."""

import os
import re
import uuid
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from crane.common.checkpoint import Checkpoint
from crane.common.errors import CraneWarning, InputError, TerminatedWorkerError
from crane.common.optional_libraries import import_optional_library
from crane.common.samples import as_count
from crane.formats.machine_loading import load
from crane.machine.machine import Machine
from crane.studies.worker_processes import WorkerPool

_CONNECTION_TIMEOUT = 10.0  # [s] for the scheduler to answer

J = TypeVar("J")
R = TypeVar("R")


def compute_on_cluster(
    function: Callable[[J], R], jobs: Mapping[int, J], scheduler: str
) -> Iterator[tuple[int, R]]:
    """Yield indices and results of jobs on a Dask cluster as they finish.

    Jobs of a worker that dies are computed by the other workers.

    Args:
        function: Function of a job; workers import it from this package.
        jobs: Arguments of the function by index.
        scheduler: Address of the scheduler.

    Raises:
        InputError: Dask is not installed, or the scheduler does not answer.
        TerminatedWorkerError: The scheduler ends, or the workers of some jobs died repeatedly;
            the other jobs are finished then.
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
    lost: list[int] = []
    with client:
        if not client.scheduler_info()["workers"]:
            warnings.warn(
                f"the scheduler at {scheduler} has no workers yet, start some with "
                f"'dask worker {scheduler}'",
                CraneWarning,
                stacklevel=2,
            )
        run = uuid.uuid4().hex
        indices = {f"crane-study-{run}-{index}": index for index in jobs}
        futures = client.map(function, list(jobs.values()), key=list(indices), pure=False)
        for future in dask.as_completed(futures, loop=client.loop):
            try:
                _check_future(future, scheduler)
                result: Any = future.result() if future.status == "finished" else None
            except dask.comm.CommClosedError:  # the scheduler ends while it hands over a result
                raise _scheduler_error(scheduler) from None
            if future.status == "finished":
                yield indices[future.key], result
            else:
                lost.append(indices[future.key])
    if lost:
        raise TerminatedWorkerError(
            f"{len(lost)} of {len(jobs)} could not be computed: all workers that began number "
            f"{lost[0]} died, see their logs: give them more memory or fewer threads"
        )


def _check_future(future: Any, scheduler: str) -> None:
    """Raise the error of a job, unless its workers died."""
    from distributed import KilledWorker

    failure = future.exception() if future.status == "error" else None
    if future.status == "finished" or isinstance(failure, KilledWorker):
        return
    if isinstance(failure, ImportError | AttributeError):
        raise InputError(
            f"the workers cannot run this version of crane ({failure}), install it there"
        )
    if failure is None:
        raise _scheduler_error(scheduler)
    raise failure


def _scheduler_error(scheduler: str) -> TerminatedWorkerError:
    return TerminatedWorkerError(f"the scheduler at {scheduler} is gone, start it again")


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


@dataclass(frozen=True)
class StoredResults(Generic[R]):
    """Results of jobs as rows of a checkpoint.

    Attributes:
        checkpoint: The checkpoint.
        keys: First cells of the row of each job.
        to_cells: Returns the other cells for a result.
        from_cells: Returns the result for these cells.
    """

    checkpoint: Checkpoint
    keys: Sequence[tuple[str, ...]]
    to_cells: Callable[[R], Sequence[object]]
    from_cells: Callable[[list[str]], R]

    def results(self) -> dict[int, R]:
        """Return the results that are kept, by index of the job."""
        found = {}
        for index, key in enumerate(self.keys):
            with suppress(KeyError, ValueError):  # none, or damaged: it is computed again
                found[index] = self.from_cells(self.checkpoint.rows[key])
        return found

    def add(self, index: int, result: R) -> None:
        """Keep a result.

        Raises:
            OutputError: It cannot be written.
        """
        self.checkpoint.append(self.keys[index], self.to_cells(result))


def compute_jobs(
    function: Callable[[J], R],
    jobs: Sequence[J],
    processes: int,
    scheduler: str | None,
    report: Callable[[int], object],
    kept: StoredResults[R],
) -> list[R]:
    """Return the results of jobs.

    Args:
        function: Function of a job; other processes import it from this package.
        jobs: Arguments of the function.
        processes: Number of processes.
        scheduler: Address of a Dask scheduler whose workers compute instead.
        report: Called with the number of finished jobs after each.
        kept: Results that need not be computed, to which each new one is added.
    """
    results = kept.results()
    missing = {index: job for index, job in enumerate(jobs) if index not in results}
    with closing(_finished_jobs(function, missing, processes, scheduler)) as finished:
        for index, result in finished:
            results[index] = result
            kept.add(index, result)
            report(len(results))
    return [results[index] for index in range(len(jobs))]


def _finished_jobs(
    function: Callable[[J], R], jobs: Mapping[int, J], processes: int, scheduler: str | None
) -> Generator[tuple[int, R], None, None]:
    """Yield indices and results of jobs as they finish."""
    if scheduler is not None and jobs:
        yield from compute_on_cluster(function, jobs, scheduler)
    elif processes > 1 and len(jobs) > 1:
        with closing(WorkerPool(function, jobs, processes)) as pool:
            yield from pool.results()
    else:
        for index, job in jobs.items():
            yield index, function(job)
