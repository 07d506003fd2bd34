"""How the numbers of a machine's description change the constants of its formulas."""

from collections.abc import Callable, Sequence

import numpy as np

from crane.common.errors import CraneError, InputError
from crane.common.samples import Array
from crane.description.changes import unknown_parameter
from crane.formats.loading import Variants
from crane.machine import Machine

SMALL = 0.1  # what counts as large of a number that is 0
_SHARE, _STEP = 1e-3, 3e-3  # of a number
_STRAIGHT = 1e-11  # second difference of what is straight, as a share of the first
# f'(0) h from f(0), f(h), ... f(8 h), of order 8
_FORWARD = np.array(
    [-761 / 280, 8.0, -14.0, 56 / 3, -35 / 2, 56 / 5, -14 / 3, 8 / 7, -1 / 8], dtype=np.float64
)


class Named:
    """Derivatives of constants by named numbers, which most constants are linear in.

    Constants are elementary functions of one number: itself, its inverse, sine and cosine of an
    angle. Where they are straight, their difference is the derivative to rounding; elsewhere it is
    the one-sided difference of order 8, to about 1e-11.

    Args:
        machine: The machine, as it was loaded.
    """

    def __init__(self, machine: Machine):
        self._variants = Variants(machine)
        self._values = self._variants.values

    def value(self, name: str) -> float:
        """A number.

        Raises:
            InputError: There is none of this name.
        """
        if name not in self._values:
            raise InputError(unknown_parameter(self._variants.spec, self._values, name))
        return self._values[name]

    def slopes(self, names: Sequence[str], constants: Callable[[Machine], Array]) -> Array:
        """Derivatives (k, m) of constants (m,) of a machine by k of its numbers.

        Raises:
            InputError: An unknown name, or a number that no machine can be made with beside it.
        """
        for name in names:
            self.value(name)
        return np.array([self._slope(name, constants) for name in names])

    def _slope(self, name: str, constants: Callable[[Machine], Array]) -> Array:
        value = self._values[name]
        unit = value if value else SMALL

        def at(share: float) -> Array:
            try:
                return constants(self._variants.machine({name: value + share * unit}))
            except CraneError as error:
                raise InputError(f"'{name}' cannot be varied about {value:g}: {error}") from error

        here, near, far = at(0.0), at(_SHARE), at(2.0 * _SHARE)
        first = far - here
        if (
            np.abs(far - 2.0 * near + here) <= _STRAIGHT * np.abs(first) + 4e-16 * np.abs(here)
        ).all():
            return first / (2.0 * _SHARE * unit)
        rows = [here, *(at(i * _STEP) for i in range(1, len(_FORWARD)))]
        slope: Array = _FORWARD @ np.array(rows) / (_STEP * unit)
        return slope
