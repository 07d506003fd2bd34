"""Functions in Python that machine code calls."""

import ctypes
from collections.abc import Callable

import numpy as np

from crane.common.samples import Array


class Callback:
    """A function in Python for machine code to call; it reads one array and fills another.

    What it raises cannot pass through machine code: the array that it fills is NaN then, and
    `check` raises it.

    Args:
        function: Takes what it reads (n,) and what it fills (m,).
        reads: n.
        fills: m.

    Attributes:
        address: Of what machine code calls, for as long as this lives.
    """

    def __init__(self, function: Callable[[Array, Array], None], reads: int, fills: int):
        self._function, self._shape, self._raised = function, (reads, fills), None
        kind = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p, ctypes.c_void_p)
        self._entry = kind(self._enter)
        self.address = int(ctypes.cast(self._entry, ctypes.c_void_p).value or 0)

    _raised: BaseException | None

    def check(self) -> None:
        """Raise what the function has raised since this was called last."""
        raised, self._raised = self._raised, None
        if raised is not None:
            raise raised

    def _enter(self, read: int, fill: int) -> int:
        reads, fills = (
            np.ctypeslib.as_array((ctypes.c_double * count).from_address(address))
            for address, count in zip((read, fill), self._shape, strict=True)
        )
        if self._raised is not None:
            fills[:] = np.nan
            return 0
        try:
            self._function(reads, fills)
        except BaseException as error:  # an interrupt, too
            self._raised = error
            fills[:] = np.nan
        return 0
