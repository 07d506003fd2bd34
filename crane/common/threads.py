"""What every thread has for itself."""

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class PerThread(threading.local, Generic[T]):
    """Memory of an object that several threads may use at once: each thread has its own.

    Args:
        make: Makes it, when a thread first asks.
    """

    def __init__(self, make: Callable[[], T]):  # runs once in every thread
        self._make = make

    @property
    def own(self) -> T:
        """This thread's."""
        try:
            return self._own
        except AttributeError:
            self._own: T = self._make()
            return self._own
