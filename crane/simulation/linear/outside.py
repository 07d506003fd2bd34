"""Forces from outside about an operating point: constant, or going with place and velocity."""

import warnings

import numpy as np

from crane.common.errors import CraneWarning
from crane.common.samples import Array
from crane.dynamics.external import ExternalForces
from crane.machine import Machine

_STEP = 2e-4  # of the machine's units of strokes and angles: nine digits are left


class Outside:
    """A machine's external forces along its active joints, as they are at time 0.

    Those that remember something (`ExternalForce.states`) are left out, with a warning.

    Args:
        machine: The machine.
    """

    def __init__(self, machine: Machine):
        kept = [force for force in machine.external if not force.states]
        left = [force.name for force in machine.external if force.states]
        if left:
            warnings.warn(
                f"{machine.name}: forces that remember their way have no linear model, left out: "
                f"{', '.join(left)}",
                CraneWarning,
                stacklevel=3,
            )
        self._closure, self._some = machine.closure, bool(kept)
        self._forces = ExternalForces(machine, kept)
        units = self._closure.units[self._closure.active]
        self._steps = np.concatenate([units, units / self._closure.pace]) * _STEP

    def at(self, q_a: Array, v_a: Array) -> Array:
        """gamma^T J^T w (n,)."""
        if not self._some:
            return np.zeros(len(q_a))
        q = self._closure.solve(q_a)
        gamma = self._closure.gamma(q)
        return np.asarray(gamma.T @ self._forces.along(0.0, q, gamma @ v_a, np.zeros(0)).forces)

    def slopes(self, q_a: Array, v_a: Array) -> Array:
        """Its derivatives (n, 2 n) by q_A and v_A, by differences of fourth order."""
        n, x = len(q_a), np.concatenate([q_a, v_a])
        found = np.zeros((n, 2 * n))
        for i, step in enumerate(self._steps if self._some else ()):
            way = step * np.eye(2 * n)[i]

            def away(steps: int, way: Array = way) -> Array:
                there = x + steps * way
                return self.at(there[:n], there[n:])

            found[:, i] = (8 * (away(1) - away(-1)) - (away(2) - away(-2))) / (12 * step)
        return found
