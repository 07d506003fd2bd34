"""Physical feasibility of a mass and an inertia, and the nearest feasible inertia."""

from dataclasses import dataclass

import numpy as np

from crane.common.samples import Array

# Violations below these shares of the largest principal moment are rounding of a few digits.
_ROUNDING_TOLERANCE = 1e-4
_NEGATIVE_MOMENT_TOLERANCE = 0.05  # of a negative moment, as by rounding to two digits
_MIN_GYRATION_RADIUS = 1e-10  # [m] of a body with inertia
_TENSOR_ATTRIBUTES = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


@dataclass(frozen=True)
class InertiaProblem:
    """Why a mass and an inertia are not physically feasible.

    Attributes:
        problem: Description of the problem.
        advice: How to correct it.
        is_formal: Whether computation is possible in spite of it: a planar, rounded or missing
            inertia, of which no principal moment is negative by more than rounding.
        is_negative: Whether a principal moment is negative by more than the last digits, so that
            some motion would have negative kinetic energy and only the nearest feasible inertia
            can be used.
    """

    problem: str
    advice: str = "correct it"
    is_formal: bool = False
    is_negative: bool = False

    def __str__(self) -> str:
        return f"{self.problem}, {self.advice}"


def inertia_problem(mass: float, tensor: np.ndarray) -> InertiaProblem | None:
    """Return the problem of a mass [kg] and a central inertia (3, 3) [kg m2], None if feasible.

    The principal moments of a body are non-negative, and none exceeds the sum of the others. A
    mass of zero with an inertia is a rotor whose mass belongs to another body.
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
    """Return the physically feasible inertia (3, 3) [kg m2] nearest to a tensor.

    The second moments of mass about the centre of mass, Sigma = tr(I) / 2 1 - I, have no negative
    eigenvalue. The nearest such matrix in the Frobenius norm has zeros in place of the negative
    eigenvalues (Higham 1988). With the eigenvalues J_i of Sigma along principal axes e_i,

        I' = sum_i max(J_i, 0) (1 - e_i e_i^T)

    If only the largest principal moment exceeds the sum of the others, it stays, and the others
    rise by half of the difference each: a flat body.
    """
    second_moments = np.trace(tensor) / 2 * np.eye(3) - tensor
    values, axes = np.linalg.eigh(second_moments)
    feasible_moments = (axes * np.maximum(values, 0.0)) @ axes.T
    return np.asarray(np.trace(feasible_moments) * np.eye(3) - feasible_moments)


def format_inertia(tensor: Array) -> str:
    """Return a tensor as attributes of a URDF, in five digits."""
    rounding = float(np.abs(tensor).max()) * 1e-9
    values = [x if abs(x) > rounding else 0.0 for x in tensor[np.triu_indices(3)].tolist()]
    return " ".join(f'{key}="{x:.5g}"' for key, x in zip(_TENSOR_ATTRIBUTES, values, strict=True))
