"""Tall matrices that are read in blocks of rows, and their triangular factors."""

from collections.abc import Iterator
from typing import Protocol

import numpy as np

from crane.common.samples import Array

_BLOCK_ROWS = 8192  # of a block


class Regressor(Protocol):
    """A matrix W (m, p), whose rows come in blocks of increasing instants.

    Attributes:
        shape: (m, p).
    """

    shape: tuple[int, int]

    def blocks(self, backwards: bool = False) -> Iterator[tuple[slice, Array]]:
        """Which rows, and W there; no instant is in two blocks. The last first if asked for."""

    def triangular_factors(self, y: Array, groups: np.ndarray) -> Array:
        """See `triangular_factors`."""


class StoredRegressor:
    """A matrix that is held as a whole.

    Args:
        W: (m, p).
        samples: Number of the instant of each row (m,), not decreasing.
        rows: Of a block, about.
    """

    def __init__(self, W: Array, samples: np.ndarray, rows: int = _BLOCK_ROWS):
        self.shape = W.shape
        self._W = W
        wanted = np.arange(0, len(W), rows)
        starts = np.unique(np.searchsorted(samples, samples[wanted])).tolist()
        ends = [*starts[1:], len(W)]
        self._row_slices = [slice(*ends) for ends in zip(starts, ends, strict=True)]

    def blocks(self, backwards: bool = False) -> Iterator[tuple[slice, Array]]:
        """See `Regressor`."""
        for span in reversed(self._row_slices) if backwards else self._row_slices:
            yield span, self._W[span]

    def triangular_factors(self, y: Array, groups: np.ndarray) -> Array:
        """See `triangular_factors`."""
        return triangular_factors(self, y, groups)


def triangular_factors(
    W: Regressor,
    y: Array,
    groups: np.ndarray,
    weights: Array | None = None,
    Z: Regressor | None = None,
) -> Array:
    """Triangular R_g (k, k) of [W y], or of [Z W y], of the rows of each group: |R x| = |[W y] x|.

    By QR updates: R of [R; block] is that of all rows so far, as exact as of all at once
    (Golub, Van Loan, Matrix Computations, 6.5).

    Args:
        W: (m, p).
        y: (m,).
        groups: Of each row (m,), 0, 1, ...
        weights: (m,) by which rows are multiplied.
        Z: Another matrix of the same shape, and in the same blocks.

    Returns:
        (g, k, k).
    """
    size = W.shape[1] * (1 if Z is None else 2) + 1
    out = np.zeros((int(groups.max()) + 1, size, size))
    others = None if Z is None else Z.blocks()
    for rows, block in W.blocks():
        parts = [block, y[rows]]
        if others is not None:
            parts.insert(0, next(others)[1])
        whole = np.column_stack(parts)
        if weights is not None:
            whole *= weights[rows, None]
        for g in range(len(out)):
            update_triangular_factor(out[g], whole[groups[rows] == g])
    return out


def update_triangular_factor(R: Array, rows: Array) -> None:
    """Make a triangular factor (k, k) that of its rows and of others (m, k)."""
    if len(rows):
        R[:] = np.linalg.qr(np.vstack([R, rows]), mode="r")


def triangular_factor(rows: Array) -> Array:
    """Triangular factor (k, k) of a matrix (m, k), with rows of zeros where m < k."""
    out = np.zeros((rows.shape[-1],) * 2)
    update_triangular_factor(out, rows)
    return out
