"""Hybrid dynamics: given accelerations of driven joints, unknown ones of free joints."""

from collections.abc import Callable, Sequence

from crane.codegen import Scalar
from crane.codegen.matrix_factorization import LdltFactorization
from crane.codegen.symbolic import add_vectors, scale_vector, subtract_vectors

Vector = list[Scalar]


def hybrid_dynamics(
    inverse: Callable[[Sequence[Scalar], bool], Vector],
    driven: Sequence[bool],
    a_d: Sequence[Scalar],
    friction: bool,
) -> tuple[Vector, Vector]:
    """`Dynamics.hybrid` from a function of inverse dynamics, for numbers or formulas.

    Columns of M_A are differences of inverse dynamics, which share all but the accelerations.

    Args:
        inverse: (a_A (n,), friction) -> tau_A (n,).
        driven: (n,) whether a joint is driven.
        a_d: (k,) accelerations of the driven joints [m/s2], [rad/s2].
        friction: Whether friction is included.

    Returns:
        Forces (k,) of the driven joints and accelerations (n - k,) of the others.
    """
    n, given = len(driven), iter(a_d)
    forces_without_free_motion = inverse(
        [next(given) if moved else 0.0 for moved in driven], friction
    )
    free = [i for i in range(n) if not driven[i]]
    if not free:
        return forces_without_free_motion, []
    bias = inverse([0.0] * n, False)
    columns = [
        subtract_vectors(inverse([float(k == i) for k in range(n)], False), bias) for i in free
    ]
    mass = [[column[i] for column in columns] for i in free]
    a_f = LdltFactorization(mass).solve([-forces_without_free_motion[i] for i in free])
    tau = add_vectors(
        forces_without_free_motion,
        *(scale_vector(a, column) for a, column in zip(a_f, columns, strict=True)),
    )
    return [x for x, moved in zip(tau, driven, strict=True) if moved], a_f
