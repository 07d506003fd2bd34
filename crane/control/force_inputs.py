"""Forces of the drives as inputs."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from crane.codegen import Scalar
from crane.common.errors import InputError
from crane.common.samples import Array
from crane.control.control_law import ControlLaw, ControllerInputs
from crane.description.sensors import FORCE_UNITS
from crane.machine.machine import Machine


class ForceInputs(ControlLaw):
    """Forces of the driven joints that come from outside, one reference each [N], [N m].

    Args:
        machine: The machine.
        time: Instants (N,) [s], increasing; one instant if not given.
        forces: Forces (N, k) of the k driven joints there, linear in between and constant outside;
            0 if not given.

    Raises:
        InputError: Times do not increase, or forces have another shape.
    """

    def __init__(
        self, machine: Machine, time: ArrayLike = (0.0,), forces: ArrayLike | None = None
    ):
        super().__init__(machine)
        self._instants = np.array(time, dtype=np.float64)
        shape = len(self._instants), int(machine.is_driven.sum())
        self._forces = np.zeros(shape) if forces is None else np.array(forces, dtype=np.float64)
        self.reference_units = {
            f"force_{joint}": FORCE_UNITS[machine.unit(joint)] for joint in machine.driven_joints
        }
        if self._forces.shape != shape or not (np.diff(self._instants) > 0).all():
            raise InputError(f"give increasing times and {shape} forces at them")

    def for_machine(self, machine: Machine) -> "ForceInputs":
        """The same forces for another machine."""
        return ForceInputs(machine, self._instants, self._forces)

    def references(self, times: Array) -> Array:
        """See `ControlLaw`: the forces."""
        columns = [np.interp(times, self._instants, column) for column in self._forces.T]
        return np.column_stack([np.zeros((len(times), 0)), *columns])

    def breaks(self) -> Array:
        """Times (N,) [s] at which slopes of forces change."""
        return self._instants

    def law(self, inputs: ControllerInputs) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """See `ControlLaw`."""
        return self.expand_driven(inputs.reference), []
