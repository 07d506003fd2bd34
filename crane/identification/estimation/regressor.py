"""Regressors that are read in blocks of rows, and their triangular factors."""

from abc import ABC, abstractmethod
from collections.abc import Iterator

import numpy as np

from crane.common.samples import Array

_BLOCK_ROWS = 8192  # rows of a block


class Regressor(ABC):
    """Regressor W (m, p) in blocks of rows with increasing instants.

    Attributes:
        shape: (m, p).
    """

    shape: tuple[int, int]

    @abstractmethod
    def blocks(self, backwards: bool = False) -> Iterator[tuple[slice, Array]]:
        """Row slices and blocks of W; no instant is in two blocks. Optionally in reverse order."""

    def triangular_factors(self, y: Array, groups: np.ndarray) -> Array:
        """See `triangular_factors`."""
        return triangular_factors(self, y, groups)


class StoredRegressor(Regressor):
    """Regressor that is stored as one array.

    Args:
        W: (m, p).
        samples: Number of the instant of each row (m,), not decreasing.
        rows: Approximate number of rows of a block.
    """

    def __init__(self, W: Array, samples: np.ndarray, rows: int = _BLOCK_ROWS):
        self.shape = W.shape
        self._W = W
        starts = np.unique(np.searchsorted(samples, samples[np.arange(0, len(W), rows)])).tolist()
        ends = [*starts[1:], len(W)]
        self._row_slices = [slice(*ends) for ends in zip(starts, ends, strict=True)]

    def blocks(self, backwards: bool = False) -> Iterator[tuple[slice, Array]]:
        """See `Regressor`."""
        for span in reversed(self._row_slices) if backwards else self._row_slices:
            yield span, self._W[span]


def triangular_factors(
    W: Regressor,
    y: Array,
    groups: np.ndarray,
    weights: Array | None = None,
    Z: Regressor | None = None,
) -> Array:
    """Triangular factors R_g (k, k) of [W y], or of [Z W y], of the rows of each group.

    They satisfy |R x| = |[W y] x| and are computed by QR updates: R of [R; block] is the factor of
    all rows so far (Golub, Van Loan, Matrix Computations, 6.5).

    Args:
        W: (m, p).
        y: (m,).
        groups: Group of each row (m,), 0, 1, ...
        weights: (m,) factors of the rows.
        Z: Instruments of the same shape, in the same blocks.

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
    """Update a triangular factor (k, k) in place by further rows (m, k)."""
    if len(rows):
        R[:] = np.linalg.qr(np.vstack([R, rows]), mode="r")


def triangular_factor(rows: Array) -> Array:
    """Triangular factor (k, k) of a matrix (m, k), with zero rows if m < k."""
    out = np.zeros((rows.shape[-1],) * 2)
    update_triangular_factor(out, rows)
    return out
