"""Payloads: rigid loads on a frame of a machine."""

from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import as_sample, as_samples
from crane.description.force_elements import as_nonnegative_number
from crane.description.kinematic_tree import inertia_problem


@dataclass(frozen=True, repr=False)
class Payload(OneLineRepr):
    """A rigid load on a frame.

    Attributes:
        frame: A link of the machine.
        mass: [kg].
        com: Centre of mass in the frame [m].
        inertia: (3, 3) about the centre of mass, in the frame's axes [kg m2]; zero for a point
            mass.
    """

    frame: str
    mass: float
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    inertia: ArrayLike = field(default_factory=lambda: np.zeros((3, 3)))

    def rigid_body(self) -> pin.Inertia:
        """Its inertia in the frame.

        Raises:
            InputError: Infeasible mass and inertia.
        """
        com = as_sample(self.com, 3, "the payload's com")
        tensor = as_samples(self.inertia, 3, "the payload's inertia")
        mass = as_nonnegative_number(self.mass, "the payload's mass", "kg")
        asymmetry = np.abs(tensor - tensor.T).max() if tensor.shape == (3, 3) else np.inf
        if asymmetry > 1e-9 * np.abs(tensor).max():
            raise InputError("the payload's inertia is not a symmetric (3, 3) matrix")
        if not mass and tensor.any():
            raise InputError("the payload has an inertia but no mass, give it a mass")
        problem = inertia_problem(mass, tensor)
        if problem and tensor.any():
            raise InputError(f"the payload has {problem}")
        return pin.Inertia(mass, com, tensor)
