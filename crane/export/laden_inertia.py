"""Inertia of a body with a payload, as symbolic formulas."""

from collections.abc import Sequence
from itertools import combinations_with_replacement

import pinocchio as pin

from crane.codegen.symbolic import (
    Scalar,
    add_vectors,
    dot,
    matmul,
    matvec,
    maximum,
    scale_vector,
    subtract_vectors,
    transpose,
)

_LEAST_MASS = 1e-30  # by which moments are divided [kg]


def laden_inertia(
    unladen: Sequence[Scalar], payload: Sequence[Scalar], frame: pin.SE3
) -> list[Scalar]:
    """Inertia of a body with a payload on one of its frames.

    With masses m_i, centres c_i and inertias I_i about them, d = c_2 - c_1 and
    mu = m_1 m_2 / (m_1 + m_2),

        m = m_1 + m_2,    c = c_1 + m_2 / m d,    I = I_1 + I_2 + mu (d.d 1 - d d^T).

    Args:
        unladen: (10,) mass, centre of mass (3), inertia about it (xx, xy, xz, yy, yz, zz) in the
            axes of the body.
        payload: (10,) the same in the frame.
        frame: The frame in the body.

    Returns:
        (10,) like `unladen`.
    """
    turn = frame.rotation.tolist()
    mass = unladen[0] + payload[0]
    share = payload[0] / maximum(mass, _LEAST_MASS)
    centre = add_vectors(matvec(turn, payload[1:4]), frame.translation.tolist())
    distance = subtract_vectors(centre, unladen[1:4])
    xx, xy, xz, yy, yz, zz = payload[4:]
    tensor = matmul(matmul(turn, [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), transpose(turn))
    square, reduced = dot(distance, distance), unladen[0] * share
    moments = [
        inertia
        + tensor[i][k]
        + reduced * ((square if i == k else 0.0) - distance[i] * distance[k])
        for inertia, (i, k) in zip(
            unladen[4:], combinations_with_replacement(range(3), 2), strict=True
        )
    ]
    moved = add_vectors(unladen[1:4], scale_vector(share, distance))
    return [mass, *moved, *moments]
