"""What every thread has for itself."""

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

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
