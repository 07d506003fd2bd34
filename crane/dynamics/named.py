"""How the numbers of a machine's description change the constants of its formulas."""

from collections.abc import Callable, Sequence

import numpy as np

from crane.common.errors import CraneError, InputError
from crane.common.samples import Array
from crane.description.changes import unknown_parameter
from crane.formats.loading import Variants
from crane.machine import Machine

SMALL = 0.1  # what counts as large of a number that is 0
_SHARE = 1e-3  # of a number
_STRAIGHT = 1e-11  # second difference of what is straight, as a share of the first
# f'(0) h from f(h) - f(0), ... f(5 h) - f(0), of order 5
_FORWARD = np.array([5.0, -5.0, 10 / 3, -5 / 4, 1 / 5], dtype=np.float64)


class Named:
    """Derivatives of constants by named numbers, which most constants are linear in.

    Constants are elementary functions of one number: itself, its inverse, sine and cosine of an
    angle. Where they are straight, their difference is the derivative to rounding; elsewhere it is
    the one-sided difference of order 5, to about 1e-11.

    Args:
        machine: The machine, as it was loaded.
    """

    def __init__(self, machine: Machine):
        self._variants = Variants(machine)
        self._values = self._variants.values

    @property
    def names(self) -> tuple[str, ...]:
        """Of all numbers."""
        return tuple(self._values)

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
        here = self.here(constants)
        return np.array([self.slope(name, constants, here) for name in names])

    def here(self, constants: Callable[[Machine], Array]) -> Array:
        """Constants (m,) of the machine itself."""
        return constants(self._variants.near({}))

    def slope(self, name: str, constants: Callable[[Machine], Array], here: Array) -> Array:
        """Derivatives (m,) by one number, given `here`; see `slopes`."""
        value = self.value(name)
        unit = value if value else SMALL

        def at(steps: int) -> Array:
            try:
                found = constants(self._variants.near({name: value + steps * _SHARE * unit}))
            except CraneError as error:
                raise InputError(f"'{name}' cannot be varied about {value:g}: {error}") from error
            if len(found) != len(here):
                raise InputError(
                    f"'{name}' cannot be varied about {value:g}, where the machine has other "
                    "equations: give it another value"
                )
            return found

        near = at(1)
        if (near == here).all():
            return np.zeros_like(here)
        far = at(2)
        first = far - here
        if (
            np.abs(far - 2.0 * near + here) <= _STRAIGHT * np.abs(first) + 4e-16 * np.abs(here)
        ).all():
            return first / (2.0 * _SHARE * unit)
        rows = [near, far, *map(at, range(3, len(_FORWARD) + 1))]
        slope: Array = _FORWARD @ (np.array(rows) - here) / (_SHARE * unit)
        return slope
