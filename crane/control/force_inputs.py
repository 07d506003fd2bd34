"""Forces of the drives as inputs."""

from collections.abc import Sequence

import numpy as np

from crane.codegen import Scalar
from crane.common.samples import Array
from crane.control.control_law import ControlLaw, ControllerInputs
from crane.control.valve_commands import SampledCommand
from crane.description.sensors import FORCE_UNITS
from crane.machine.machine import Machine


class ForceInputs(ControlLaw):
    """Forces of the k driven joints that come from outside, one reference each [N], [N m].

    They are 0; forces over time are those of `interpolate_references`.

    Args:
        machine: The machine.
        command: What sets them once per period, if anything.
    """

    def __init__(self, machine: Machine, command: SampledCommand | None = None):
        super().__init__(machine)
        self._command, self.period = command, 0.0 if command is None else command.period
        self.reference_units = {
            f"force_{joint}": FORCE_UNITS[machine.unit(joint)] for joint in machine.driven_joints
        }

    def update(self, time: float, q: Array, v_a: Array, state: Array) -> None:
        """See `ControlLaw`."""
        if self._command is not None:
            self._command.update(time, q, v_a, np.zeros((0, 2)))

    def references(self, times: Array) -> Array:
        """See `ControlLaw`."""
        if self._command is not None:
            return self._command.references(times)
        return np.zeros((len(times), len(self.reference_units)))

    def law(self, inputs: ControllerInputs) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """See `ControlLaw`."""
        return self.expand_driven(inputs.reference), []
