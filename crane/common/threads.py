"""What every thread has for itself, and how many threads compute."""

import functools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Generic, ParamSpec, TypeVar

_SMALL = 33  # order of the matrices from which on libraries take several threads

P = ParamSpec("P")
T = TypeVar("T")


class PerThread(threading.local, Generic[T]):
    """Memory of an object that several threads may use at once: each thread has its own.

    Args:
        make: Makes it, here and wherever another thread first asks.

    Attributes:
        own: This thread's.
    """

    def __init__(self, make: Callable[[], T]):  # runs once in every thread
        self.own = make()


@contextmanager
def one_thread(order: int = _SMALL) -> Iterator[None]:
    """Within, the linear algebra of the libraries that are loaded computes on one thread.

    Of many small matrices: threads wait for each other longer than they compute, on a busy machine
    a hundred times. What is found does not depend on how many there are, to the last digit.

    Args:
        order: Of the matrices; where libraries take one thread anyway, nothing is done.
    """
    if order < _SMALL:
        yield
        return
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1, "blas"):
        yield


def on_one_thread(function: Callable[P, T]) -> Callable[P, T]:
    """The function with the linear algebra of numpy and scipy on one thread, see `one_thread`."""

    @functools.wraps(function)
    def alone(*args: P.args, **kwargs: P.kwargs) -> T:
        import scipy.linalg  # noqa: F401 - brings its own library, which has to be there to be told

        with one_thread():
            return function(*args, **kwargs)

    return alone
