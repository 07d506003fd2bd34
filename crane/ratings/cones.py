"""How far a load can grow: what is affine in it, against the length of a vector that is, too."""

import numpy as np

from crane.common.samples import Array


def largest(a: Array, b: Array, c: Array | None = None, d: Array | None = None) -> Array:
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
    square = b * b - (d * d).sum(axis=-1)
    half = a * b - (c * d).sum(axis=-1)
    rest = a * a - (c * c).sum(axis=-1)
    # its discriminant in the form that does not cancel, by Lagrange's identity
    mixed = a[..., None] * d - b[..., None] * c
    disc = (mixed * mixed).sum(axis=-1) - (np.cross(c, d) ** 2).sum(axis=-1)
    root, real = np.sqrt(np.maximum(disc, 0.0)), disc >= 0
    larger = -(half + np.copysign(root, half))
    with np.errstate(divide="ignore", invalid="ignore"):
        roots = np.stack([rest / larger, larger / square])
        fits = real & (roots > 0) & np.isfinite(roots)
        fits &= a + b * roots <= 1e-9 * np.abs(a)
        found = np.where(fits, roots, np.inf).min(axis=0)
    full = a + np.sqrt((c * c).sum(axis=-1)) >= 0
    return np.asarray(np.where(full, 0.0, found))
