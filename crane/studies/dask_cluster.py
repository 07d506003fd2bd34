"""Variants on the workers of a Dask cluster."""

import re
import uuid
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from crane.common.errors import CraneWarning, InputError
from crane.common.optional_libraries import import_optional_library

_CONNECTION_TIMEOUT = 10.0  # [s] for the scheduler to answer

J = TypeVar("J")
R = TypeVar("R")


def compute_on_cluster(
    function: Callable[[J], R], jobs: Sequence[J], scheduler: str
) -> Iterator[tuple[int, Any]]:
    """Indices and results of jobs as they get ready.

    What a worker had, or had begun, when it died is computed by the others.

    Args:
        function: What the workers compute; they import it from this package.
        jobs: Its arguments.
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
            "and give the address that it tells"
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
        keys = [f"crane-study-{run}-{index}" for index in range(len(jobs))]
        futures = client.map(function, jobs, key=keys, pure=False)
        indices = {future.key: index for index, future in enumerate(futures)}
        for future in dask.as_completed(futures, loop=client.loop):
            yield indices[future.key], _job_result(future, indices[future.key], scheduler)


def _job_result(future: Any, index: int, scheduler: str) -> Any:
    """What a job that has ended gave, or why it gave nothing."""
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
