"""What makes a mass and an inertia impossible, and the possible inertia that is nearest."""

from dataclasses import dataclass

import numpy as np

from crane.common.samples import Array

# Inertias are printed with a few digits: a violation below this share of the largest principal
# moment is rounding.
_ROUNDING_TOLERANCE = 1e-4
_NEGATIVE_MOMENT_TOLERANCE = 0.05  # the same of a negative moment, as two digits round it
_MIN_GYRATION_RADIUS = 1e-10  # [m] radius of gyration that no body is below
_TENSOR_ATTRIBUTES = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


@dataclass(frozen=True)
class InertiaProblem:
    """Why a mass and an inertia are no body's.

    Attributes:
        problem: What they are.
        advice: What to do about it.
        is_formal: Whether it is one of form, planar, rounded or left out, with which it can be
            computed: no principal moment is below zero by more than rounding.
        is_negative: Whether one is by more than the last digits, so that some motion would have a
            negative kinetic energy: then only the nearest possible inertia can be computed with.
    """

    problem: str
    advice: str = "correct it"
    is_formal: bool = False
    is_negative: bool = False

    def __str__(self) -> str:
        return f"{self.problem}, {self.advice}"


def inertia_problem(mass: float, tensor: np.ndarray) -> InertiaProblem | None:
    """What makes a mass [kg] and an inertia about the COM (3, 3) [kg m2] impossible, if anything.

    The principal moments of a body are non-negative and none exceeds the sum of the others. A mass
    of zero with an inertia is a rotor whose mass stands elsewhere.
    """
    if not (np.isfinite(mass) and np.isfinite(tensor).all()):
        problem = "a mass or an inertia beyond all numbers"
        return InertiaProblem(problem, "give smaller ones")
    moments = np.linalg.eigvalsh(tensor)
    largest = float(np.abs(moments).max())
    if largest <= _MIN_GYRATION_RADIUS**2 * mass:
        problem, advice = "a mass but no inertia", "give at least a small sphere's"
        return InertiaProblem(problem, advice, is_formal=True) if mass > 0 else None
    if moments[0] < -_ROUNDING_TOLERANCE * largest:
        problem = f"the negative principal moment of inertia {moments[0]:.4g} kg m2"
        if mass < 0 or moments[0] < -_NEGATIVE_MOMENT_TOLERANCE * largest:
            return InertiaProblem(problem)
        return InertiaProblem(
            problem, _nearest_inertia_advice(tensor), is_formal=True, is_negative=True
        )
    if moments[0] + moments[1] < moments[2] * (1 - _ROUNDING_TOLERANCE):
        problem = (
            "an inertia of no possible body: principal moments "
            f"{moments[0]:.4g} + {moments[1]:.4g} < {moments[2]:.4g} kg m2"
        )
        return InertiaProblem(problem, _nearest_inertia_advice(tensor), is_formal=mass >= 0)
    return None


def _nearest_inertia_advice(tensor: Array) -> str:
    return f"the nearest possible is {format_inertia(nearest_inertia(tensor))}, correct it"


def nearest_inertia(tensor: Array) -> Array:
    """The inertia (3, 3) [kg m2] of a possible body nearest to a tensor.

    A body's second moments of mass about its COM, Sigma = tr(I) / 2 1 - I, have no negative
    eigenvalue. The nearest such matrix in Frobenius' norm has zeros in place of the negative ones
    (Higham 1988), so that with J_i the eigenvalues of Sigma along principal axes e_i

        I' = sum_i max(J_i, 0) (1 - e_i e_i^T)

    Where only the largest principal moment is above the sum of the others, it stays, and both
    others rise by half of what is missing: a flat body.
    """
    second_moments = np.trace(tensor) / 2 * np.eye(3) - tensor
    values, axes = np.linalg.eigh(second_moments)
    feasible_moments = (axes * np.maximum(values, 0.0)) @ axes.T
    return np.asarray(np.trace(feasible_moments) * np.eye(3) - feasible_moments)


def format_inertia(tensor: Array) -> str:
    """A tensor as a URDF has it, in five digits."""
    rounding = float(np.abs(tensor).max()) * 1e-9
    values = [x if abs(x) > rounding else 0.0 for x in tensor[np.triu_indices(3)].tolist()]
    return " ".join(f'{key}="{x:.5g}"' for key, x in zip(_TENSOR_ATTRIBUTES, values, strict=True))
