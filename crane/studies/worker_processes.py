"""Worker processes, each of which computes one job after the other; one that dies is replaced."""

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, TypeVar

from crane.common.errors import CraneWarning, InputError, TerminatedWorkerError

MAX_TRIES = 3  # of a job whose process dies
_MAX_DEATHS = 10  # of processes in succession while no job is finished
_OUT_OF_MEMORY = 101  # exit status of a process that is refused memory

J = TypeVar("J")
R = TypeVar("R")


class WorkerPool(Generic[J, R]):
    """Processes that compute jobs. A job whose process dies is computed again, a few times.

    There are no locks or queues that a killed process could leave behind: a connection to each
    process, which ends with it.

    Args:
        function: Function of a job, which processes import.
        jobs: Arguments of the function by index, at least one.
        processes: Number of processes.

    Raises:
        InputError: Jobs cannot be sent to processes.
    """

    def __init__(self, function: Callable[[J], R], jobs: Mapping[int, J], processes: int):
        _check_transferable(next(iter(jobs.values())))
        self._function, self._jobs = function, jobs
        self._waiting, self._tries = deque(jobs), Counter[int]()
        self._lost: dict[int, str] = {}  # causes by index of jobs that are given up
        self._deaths = 0  # since a job was finished
        self._workers = [_WorkerProcess(function) for _ in range(min(processes, len(jobs)))]

    def results(self) -> Iterator[tuple[int, R]]:
        """Yield indices and results as jobs finish.

        Raises:
            InputError: The main module cannot be imported.
            TerminatedWorkerError: All processes die, or those of some jobs; the others are
                finished then.
        """
        while self._waiting or any(worker.job is not None for worker in self._workers):
            ready = wait([worker.connection for worker in self._workers])
            for worker in [x for x in self._workers if x.connection in ready]:
                yield from self._take_answer(worker)
        for index, cause in self._lost.items():
            raise TerminatedWorkerError(
                f"{len(self._lost)} of {len(self._jobs)} could not be computed, number {index} "
                f"first: {MAX_TRIES} processes were begun with it, the last was {cause}; take "
                "fewer processes"
            )

    def _take_answer(self, worker: "_WorkerProcess") -> Iterator[tuple[int, R]]:
        """Yield the result of a worker, if it has one, and let it begin the next job."""
        index, worker.job = worker.job, None
        try:
            answer = worker.answer()
        except EOFError:
            self._replace(worker, index)
            return
        if answer is not None and index is not None:
            self._deaths = 0
            result, error = answer
            if error is not None:
                raise error
            yield index, result
        if self._waiting:
            next_index = self._waiting.popleft()
            worker.begin(next_index, self._jobs[next_index])

    def _replace(self, worker: "_WorkerProcess", index: int | None) -> None:
        """Start another process for one that has died with a job, and the job again."""
        self._workers.remove(worker)
        status = worker.exit_status()
        if status > 0 and not worker.is_ready:
            raise InputError(
                "a process could not import your script: guard what it runs with "
                "if __name__ == '__main__':, or take one process"
            )
        cause, self._deaths = _cause_of_death(status), self._deaths + 1
        if self._deaths >= _MAX_DEATHS:
            raise TerminatedWorkerError(
                f"{_MAX_DEATHS} processes died in succession, the last was {cause}"
            )
        warnings.warn(
            f"a process was {cause}; what it was computing is computed again",
            CraneWarning,
            stacklevel=2,
        )
        if index is not None:
            self._tries[index] += 1
            if self._tries[index] < MAX_TRIES:
                self._waiting.append(index)
            else:
                self._lost[index] = cause
        if self._waiting:
            self._workers.append(_WorkerProcess(self._function))

    def close(self) -> None:
        """End all processes."""
        for worker in self._workers:
            worker.end()


class _WorkerProcess:
    """A process, and the connection over which it gets jobs.

    Attributes:
        connection: Readable when the process has begun, has the answer to a job, or has died.
        job: Index of the job that it computes; None if it has none.
        is_ready: Whether it has begun.
    """

    def __init__(self, function: Callable[[Any], Any]):
        context = multiprocessing.get_context("spawn")
        self.connection, other_end = context.Pipe()
        self.job: int | None = None
        self.is_ready = False
        self._process = context.Process(target=_work, args=(function, other_end), daemon=True)
        with _interrupts_blocked():
            self._process.start()
        other_end.close()

    def begin(self, index: int, job: Any) -> None:
        """Let the process compute a job."""
        self.job = index
        try:
            self.connection.send(job)
        except OSError:  # it has died, which `answer` tells
            return

    def answer(self) -> tuple[Any, Exception | None] | None:
        """Result and error of the job; None from a process that has begun.

        Raises:
            EOFError: The process has died.
        """
        try:
            found: tuple[Any, Exception | None] | None = self.connection.recv()
        except OSError as error:  # within its answer
            raise EOFError from error
        self.is_ready = True
        return found

    def exit_status(self) -> int:
        """Exit status of a process that has died; minus the number of a signal."""
        self.connection.close()
        self._process.join()
        return self._process.exitcode or 0

    def end(self) -> None:
        """End the process."""
        self._process.terminate()
        self.exit_status()


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block SIGINT, also in processes that are started: the terminal sends it to all of a group.

    It reaches this process after the block, which then ends the others.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # it unblocks SIGINT as it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _work(function: Callable[[Any], Any], connection: Connection) -> None:
    """Compute jobs, in a process of its own, until its parent ends."""
    _exit_with_parent()
    connection.send(None)
    while True:
        job = connection.recv()
        try:
            answer: tuple[Any, Exception | None] = function(job), None
        except MemoryError:
            os._exit(_OUT_OF_MEMORY)
        except Exception as error:
            answer = None, error
        connection.send(answer)


def _exit_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait_for_end() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait_for_end, daemon=True).start()


def _check_transferable(job: object) -> None:
    try:
        pickle.dumps(job)
    except (AttributeError, TypeError, pickle.PicklingError) as error:
        raise InputError(
            "measures that are lambdas or local functions stay in one process: give a Python "
            f"file, functions of a module, or processes=1 ({error})"
        ) from None


def _cause_of_death(status: int) -> str:
    """How a process died, by its exit status, after "was"."""
    if status == _OUT_OF_MEMORY:
        return f"refused more memory{_largest_size()}"
    if status >= 0:
        return f"ended with status {status}"
    name = signal.Signals(-status).name
    hint = ", as the system does when memory is short" if status == -signal.SIGKILL else ""
    return f"killed by signal {-status} ({name}){hint}{_largest_size()}"


def _largest_size() -> str:
    """Text on the largest of the processes that have ended, where the system tells."""
    if sys.platform == "win32":
        return ""
    import resource

    largest = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    unit = 1 if sys.platform == "darwin" else 1024  # bytes
    return f" (the largest process used {largest * unit / 1e9:.1f} GB)"
