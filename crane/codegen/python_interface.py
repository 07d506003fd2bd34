"""Interfaces of Python and machine code: callbacks, fallbacks where machine code stops."""

import ctypes
from collections.abc import Callable

import numpy as np

from crane.common.samples import Array


class PythonCallback:
    """A Python function that machine code calls; it reads one array and writes another.

    Exceptions cannot pass through machine code: the output array is then NaN, and `raise_pending`
    raises the exception.

    Args:
        function: Takes its inputs (n,) and outputs (m,).
        input_size: n.
        output_size: m.

    Attributes:
        address: Address of the function for machine code, valid for the lifetime of this object.
    """

    def __init__(
        self, function: Callable[[Array, Array], None], input_size: int, output_size: int
    ):
        self._function, self._sizes, self._exception = function, (input_size, output_size), None
        self._c_function = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p, ctypes.c_void_p)(
            self._call_from_machine_code
        )
        self.address = int(ctypes.cast(self._c_function, ctypes.c_void_p).value or 0)

    _exception: BaseException | None

    def raise_pending(self) -> None:
        """Raise the exception of the function since the last call of this method, if any."""
        raised, self._exception = self._exception, None
        if raised is not None:
            raise raised

    def _call_from_machine_code(self, input_address: int, output_address: int) -> int:
        inputs, outputs = (
            np.ctypeslib.as_array((ctypes.c_double * count).from_address(address))
            for address, count in zip((input_address, output_address), self._sizes, strict=True)
        )
        if self._exception is not None:
            outputs[:] = np.nan
            return 0
        try:
            self._function(inputs, outputs)
        except BaseException as error:  # an interrupt, too
            self._exception = error
            outputs[:] = np.nan
        return 0


def run_with_fallback(
    count: int,
    run_compiled: Callable[[int, int], int] | None,
    run_fallback: Callable[[int], None],
    max_chunk: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> None:
    """Process items one after another by machine code, with a fallback where that stops.

    Machine code only completes items that succeed at once; the fallback completes the others or
    raises an error with the reason.

    Args:
        count: Number of items.
        run_compiled: (first, end) -> number of completed items from the first on; None if there is
            no machine code.
        run_fallback: Processes one item.
        max_chunk: Largest number of items per call of `run_compiled`.
        progress: Called with the number of completed items.
    """
    done = 0
    while done < count:
        chunk_end = min(done + (max_chunk or count), count)
        if run_compiled is not None:
            done += run_compiled(done, chunk_end)
        if done < chunk_end:
            run_fallback(done)
            done += 1
        if progress is not None:
            progress(done)
