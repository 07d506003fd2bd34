"""Forces from outside about an operating point: constant, or going with place and velocity."""

import warnings

import numpy as np

from crane.common.errors import CraneWarning
from crane.common.samples import Array
from crane.dynamics.external_forces import ExternalForces
from crane.machine import Machine

_DIFFERENCE_STEP = 2e-4  # of the machine's units of strokes and angles: nine digits are left


class LinearizedExternalForces:
    """A machine's external forces along its active joints, as they are at time 0.

    Those that remember something (`ExternalForce.state_count`) are left out, with a warning.

    Args:
        machine: The machine.
    """

    def __init__(self, machine: Machine):
        memoryless = [force for force in machine.external_forces if not force.state_count]
        excluded_names = [force.name for force in machine.external_forces if force.state_count]
        if excluded_names:
            warnings.warn(
                f"{machine.name}: forces that remember their way have no linear model, left out: "
                f"{', '.join(excluded_names)}",
                CraneWarning,
                stacklevel=3,
            )
        self._closure, self._has_forces = machine.closure, bool(memoryless)
        self._forces = ExternalForces(machine, memoryless)
        units = self._closure.units[self._closure.active]
        self._steps = (
            np.concatenate([units, units / self._closure.characteristic_time]) * _DIFFERENCE_STEP
        )

    def active_forces(self, q_a: Array, v_a: Array) -> Array:
        """gamma^T J^T w (n,)."""
        if not self._has_forces:
            return np.zeros(len(q_a))
        q = self._closure.solve(q_a)
        gamma = self._closure.gamma(q)
        return np.asarray(
            gamma.T
            @ self._forces.generalized_forces(0.0, q, gamma @ v_a, np.zeros(0)).generalized_forces
        )

    def jacobian(self, q_a: Array, v_a: Array) -> Array:
        """Its derivatives (n, 2 n) by q_A and v_A, by differences of fourth order."""
        n, x = len(q_a), np.concatenate([q_a, v_a])
        derivatives = np.zeros((n, 2 * n))
        for i, step in enumerate(self._steps if self._has_forces else ()):
            displacement = step * np.eye(2 * n)[i]

            def away(steps: int, way: Array = displacement) -> Array:
                there = x + steps * way
                return self.active_forces(there[:n], there[n:])

            derivatives[:, i] = (8 * (away(1) - away(-1)) - (away(2) - away(-2))) / (12 * step)
        return derivatives
