"""What makes a mass and an inertia impossible."""

import numpy as np

# Inertias are printed with a few digits: a violation below this share of the largest principal
# moment is rounding.
_ROUNDING = 1e-4
_ATOM = 1e-10  # [m] radius of gyration that no body is below


def inertia_problem(mass: float, tensor: np.ndarray) -> str | None:
    """What makes a mass [kg] and an inertia about the COM (3, 3) [kg m2] impossible, if anything.

    The principal moments of a body are non-negative and none exceeds the sum of the others. A mass
    of zero with an inertia is a rotor whose mass stands elsewhere.
    """
    if not (np.isfinite(mass) and np.isfinite(tensor).all()):
        return "a mass or an inertia beyond all numbers, give smaller ones"
    moments = np.linalg.eigvalsh(tensor)
    largest = float(np.abs(moments).max())
    if largest <= _ATOM**2 * mass:
        return "a mass but no inertia, give at least a small sphere's" if mass > 0 else None
    if moments[0] < -_ROUNDING * largest:
        return f"the negative principal moment of inertia {moments[0]:.4g} kg m2, correct it"
    if moments[0] + moments[1] < moments[2] * (1 - _ROUNDING):
        return (
            "an inertia of no possible body: principal moments "
            f"{moments[0]:.4g} + {moments[1]:.4g} < {moments[2]:.4g} kg m2, correct it"
        )
    return None
