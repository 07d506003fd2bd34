"""Forces of the drives as inputs."""

from collections.abc import Sequence

import numpy as np

from crane.codegen import Scalar
from crane.common.samples import Array
from crane.control.control_law import ControlLaw, ControllerInputs
from crane.description.sensors import FORCE_UNITS
from crane.machine.machine import Machine


class ForceInputs(ControlLaw):
    """Forces of the k driven joints that come from outside, one reference each [N], [N m].

    They are 0; forces over time are those of `interpolate_references`.
    """

    def __init__(self, machine: Machine):
        super().__init__(machine)
        self.reference_units = {
            f"force_{joint}": FORCE_UNITS[machine.unit(joint)] for joint in machine.driven_joints
        }

    def references(self, times: Array) -> Array:
        """See `ControlLaw`."""
        return np.zeros((len(times), len(self.reference_units)))

    def law(self, inputs: ControllerInputs) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """See `ControlLaw`."""
        return self.expand_driven(inputs.reference), []
