"""How far a load can grow: what is affine in it, against the length of a vector that is, too."""

import numpy as np

from crane.common.samples import Array


def largest_feasible_magnitude(
    a: Array, b: Array, c: Array | None = None, d: Array | None = None
) -> Array:
    """The largest x >= 0 up to which a + b x + |c + d x| <= 0 holds all the way.

    Where it holds at 0, the least positive root of

        (b^2 - |d|^2) x^2 + 2 (a b - c.d) x + a^2 - |c|^2 = 0

    at which a + b x is not above 0. Its two solutions and its discriminant,
    |a d - b c|^2 - |c x d|^2, are taken in forms that do not cancel.

    Args:
        a: Below 0 where there is room [.], any shape.
        b: The same shape.
        c: That shape and one more axis (3,); nothing if not given.
        d: Likewise.

    Returns:
        Of a's shape; 0 where nothing is left at x = 0, infinite where nothing ends.
    """
    if c is None or d is None:
        with np.errstate(divide="ignore", invalid="ignore"):
            out = np.where(b > 0, -a / b, np.inf)
        return np.where(a >= 0, 0.0, out)
    quadratic_coefficient = b * b - (d * d).sum(axis=-1)
    half_linear_coefficient = a * b - (c * d).sum(axis=-1)
    constant_coefficient = a * a - (c * c).sum(axis=-1)
    # its discriminant in the form that does not cancel, by Lagrange's identity
    cross_terms = a[..., None] * d - b[..., None] * c
    discriminant = (cross_terms * cross_terms).sum(axis=-1) - (np.cross(c, d) ** 2).sum(axis=-1)
    discriminant_root, is_real = np.sqrt(np.maximum(discriminant, 0.0)), discriminant >= 0
    stable_sum = -(
        half_linear_coefficient + np.copysign(discriminant_root, half_linear_coefficient)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        roots = np.stack([constant_coefficient / stable_sum, stable_sum / quadratic_coefficient])
        is_valid = is_real & (roots > 0) & np.isfinite(roots)
        is_valid &= a + b * roots <= 1e-9 * np.abs(a)
        smallest_root = np.where(is_valid, roots, np.inf).min(axis=0)
    is_exceeded_at_zero = a + np.sqrt((c * c).sum(axis=-1)) >= 0
    return np.asarray(np.where(is_exceeded_at_zero, 0.0, smallest_root))
