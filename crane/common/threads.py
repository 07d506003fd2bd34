"""What every thread has for itself, and how many threads compute."""

import functools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Generic, ParamSpec, TypeVar

_MIN_THREADED_ORDER = 33  # order of the matrices from which on libraries take several threads

P = ParamSpec("P")
T = TypeVar("T")


class ThreadLocal(threading.local, Generic[T]):
    """Memory of an object that several threads may use at once: each thread has its own.

    Args:
        create: Makes it, here and wherever another thread first asks.

    Attributes:
        value: This thread's.
    """

    def __init__(self, create: Callable[[], T]):  # runs once in every thread
        self.value = create()


@contextmanager
def single_threaded_blas(matrix_order: int = _MIN_THREADED_ORDER) -> Iterator[None]:
    """Within, the linear algebra of the libraries that are loaded computes on one thread.

    Of many small matrices: threads wait for each other longer than they compute, on a busy machine
    a hundred times. What is found does not depend on how many there are, to the last digit.

    Args:
        matrix_order: Of the matrices; where libraries take one thread anyway, nothing is done.
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
        import scipy.linalg  # noqa: F401 - brings its own library, which has to be there to be told

        with single_threaded_blas():
            return function(*args, **kwargs)

    return wrapper
