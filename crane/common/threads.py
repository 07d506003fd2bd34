"""Thread-local values, and the number of threads of linear algebra."""

import functools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Generic, ParamSpec, TypeVar

_MIN_THREADED_ORDER = 33  # order from which libraries use several threads

P = ParamSpec("P")
T = TypeVar("T")


class ThreadLocal(threading.local, Generic[T]):
    """A value that every thread creates for itself.

    Args:
        create: Creates the value, on first access in each thread.

    Attributes:
        value: The value of this thread.
    """

    def __init__(self, create: Callable[[], T]):  # called once in every thread
        self.value = create()


@contextmanager
def single_threaded_blas(matrix_order: int = _MIN_THREADED_ORDER) -> Iterator[None]:
    """Context in which the loaded linear algebra libraries use one thread.

    For many small matrices threads wait for each other longer than they compute, a hundred times
    longer on a busy machine. Results do not depend on the number of threads.

    Args:
        matrix_order: Order of the matrices; small ones are computed on one thread anyway.
    """
    if matrix_order < _MIN_THREADED_ORDER:
        yield
        return
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1, "blas"):
        yield


def with_single_threaded_blas(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a function to run under `single_threaded_blas`."""

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> T:
        import scipy.linalg  # noqa: F401 - loads the BLAS library to limit

        with single_threaded_blas():
            return function(*args, **kwargs)

    return wrapper
