"""Derivatives of formula constants by the parameters of a machine description."""

from collections.abc import Callable, Sequence

import numpy as np

from crane.common.errors import CraneError, InputError
from crane.common.samples import Array
from crane.description.machine_parameters import unknown_parameter_text
from crane.formats.machine_loading import MachineVariants
from crane.machine.machine import Machine

UNIT_OF_ZERO_PARAMETER = 0.1  # magnitude assumed for a parameter that is 0
_RELATIVE_STEP = 1e-3  # step as a fraction of the parameter
_LINEARITY_TOLERANCE = 1e-11  # second over first difference of linear constants
# f'(0) h from f(h) - f(0), ... f(5 h) - f(0), of order 5
_FORWARD_DIFFERENCE_WEIGHTS = np.array([5.0, -5.0, 10 / 3, -5 / 4, 1 / 5], dtype=np.float64)


class ConstantDerivatives:
    """Derivatives of constants by named parameters, in which most constants are linear.

    Constants are elementary functions of a parameter: itself, its inverse, sine and cosine of an
    angle. The derivative of a linear one is a finite difference, exact to rounding; of others the
    one-sided difference of order 5, exact to about 1e-11.

    Args:
        machine: The machine, as loaded.
    """

    def __init__(self, machine: Machine):
        self._variants = MachineVariants(machine)
        self._values = self._variants.values

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of all parameters."""
        return tuple(self._values)

    def parameter_value(self, name: str) -> float:
        """Value of a parameter.

        Raises:
            InputError: Unknown name.
        """
        if name not in self._values:
            raise InputError(unknown_parameter_text(self._variants.spec, self._values, name))
        return self._values[name]

    def jacobian(self, names: Sequence[str], constants: Callable[[Machine], Array]) -> Array:
        """Derivatives (k, m) of constants (m,) by k parameters.

        Raises:
            InputError: Unknown name, or a parameter that no neighbouring machine can be built for.
        """
        nominal = self.nominal_constants(constants)
        return np.array([self.derivative(name, constants, nominal) for name in names])

    def nominal_constants(self, constants: Callable[[Machine], Array]) -> Array:
        """Constants (m,) of the machine itself."""
        return constants(self._variants.perturbed_machine({}))

    def derivative(
        self, name: str, constants: Callable[[Machine], Array], nominal: Array
    ) -> Array:
        """Derivatives (m,) by one parameter, given the nominal constants; see `jacobian`."""
        value = self.parameter_value(name)
        unit = value if value else UNIT_OF_ZERO_PARAMETER

        def constants_at(steps: int) -> Array:
            try:
                found = constants(
                    self._variants.perturbed_machine({name: value + steps * _RELATIVE_STEP * unit})
                )
            except CraneError as error:
                raise InputError(f"'{name}' cannot be varied about {value:g}: {error}") from error
            if len(found) != len(nominal):
                raise InputError(
                    f"'{name}' cannot be varied about {value:g}, where the machine has other "
                    "equations: give it another value"
                )
            return found

        one_step = constants_at(1)
        if (one_step == nominal).all():
            return np.zeros_like(nominal)
        two_steps = constants_at(2)
        first = two_steps - nominal
        if (
            np.abs(two_steps - 2.0 * one_step + nominal)
            <= _LINEARITY_TOLERANCE * np.abs(first) + 4e-16 * np.abs(nominal)
        ).all():
            return first / (2.0 * _RELATIVE_STEP * unit)
        rows = [
            one_step,
            two_steps,
            *map(constants_at, range(3, len(_FORWARD_DIFFERENCE_WEIGHTS) + 1)),
        ]
        return np.asarray(
            _FORWARD_DIFFERENCE_WEIGHTS @ (np.array(rows) - nominal) / (_RELATIVE_STEP * unit)
        )
