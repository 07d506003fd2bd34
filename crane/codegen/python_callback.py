"""Functions in Python that machine code calls."""

import ctypes
from collections.abc import Callable

import numpy as np

from crane.common.samples import Array


class PythonCallback:
    """A function in Python for machine code to call; it reads one array and fills another.

    What it raises cannot pass through machine code: the array that it fills is NaN then, and
    `raise_pending` raises it.

    Args:
        function: Takes what it reads (n,) and what it fills (m,).
        input_size: n.
        output_size: m.

    Attributes:
        address: Of what machine code calls, for as long as this lives.
    """

    def __init__(
        self, function: Callable[[Array, Array], None], input_size: int, output_size: int
    ):
        self._function, self._sizes, self._exception = function, (input_size, output_size), None
        kind = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p, ctypes.c_void_p)
        self._c_function = kind(self._call_from_machine_code)
        self.address = int(ctypes.cast(self._c_function, ctypes.c_void_p).value or 0)

    _exception: BaseException | None

    def raise_pending(self) -> None:
        """Raise what the function has raised since this was called last."""
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
