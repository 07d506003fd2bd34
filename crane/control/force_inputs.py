"""Forces of the drives from outside."""

from collections.abc import Sequence

import numpy as np

from crane.codegen import Scalar
from crane.common.samples import Array
from crane.control.control_law import ControlLaw, ControllerInputs
from crane.control.valve_commands import SampledCommand
from crane.machine.machine import Machine


class ForceInputs(ControlLaw):
    """Forces of the driven joints that come from outside, one reference each [N], [N m].

    Args:
        machine: The machine.
        command: What sets them once per period; without it they are zero.
    """

    def __init__(self, machine: Machine, command: SampledCommand | None = None):
        super().__init__(machine)
        self._command, self.period = command, 0.0 if command is None else command.period

    def update(self, time: float, q: Array, v_a: Array, state: Array) -> None:
        """See `ControlLaw`."""
        if self._command is not None:
            self._command.update(time, q, v_a, np.zeros((0, 2)))

    def references(self, times: Array) -> Array:
        """See `ControlLaw`."""
        if self._command is not None:
            return self._command.references(times)
        return np.zeros((len(times), int(self.machine.is_driven.sum())))

    def law(self, inputs: ControllerInputs) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """See `ControlLaw`."""
        return self.expand_driven(inputs.reference), []
