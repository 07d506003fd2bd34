"""Differential equations without derivatives of what was measured: test functions.

    int phi f' dt = -int phi' f dt    for phi that vanishes at both ends of its window.

phi(s) = (1 - s^2)^6 on a window, s from -1 to 1. Its first five derivatives vanish at the ends, so
sums over equidistant samples are integrals to the order of (pi samples)^-7 of a smooth integrand.
"""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from crane.common.errors import RecordingError
from crane.common.samples import Array

_EXPONENT = 6
_MIN_HALF_WIDTH = 32  # steps to either side of a centre, at least
_WINDOWS_PER_LENGTH = 8  # windows begin in one


@dataclass(frozen=True, eq=False)
class WeakFormWindows:
    """Test functions around every few samples, twice: on even offsets, and on odd ones.

    White noise of the samples of one half is independent of that of the other, so each half is
    an instrument for the other.

    Attributes:
        centres: Their samples (K,).
        phi: Weights (2, 2 n + 1) of a half's mean over a window; their sum is 1.
        phi_derivative: Weights (2, 2 n + 1) of a half's mean derivative [1/s].
    """

    centres: np.ndarray
    phi: Array
    phi_derivative: Array

    @classmethod
    def create(cls, count: int, step: float, length: float) -> "WeakFormWindows":
        """Windows of `length` [s], and at least 64 steps, over `count` samples.

        Raises:
            RecordingError: Not one window fits.
        """
        half_width = 4 * max(round(length / step / 8), _MIN_HALF_WIDTH // 4)
        spacing = 2 * max(2 * half_width // _WINDOWS_PER_LENGTH // 2, 1)
        if count < 2 * half_width + 1:
            raise RecordingError(
                f"{count} samples are fewer than the {2 * half_width + 1} of one window, record "
                f"longer"
            )
        offsets = np.arange(-half_width, half_width + 1.0)
        s = offsets / half_width
        half = np.stack([offsets % 2 == 0, offsets % 2 == 1])
        phi = (1 - s**2) ** _EXPONENT * half
        phi_derivative = s * (1 - s**2) ** (_EXPONENT - 1) * half
        return cls(
            np.arange(half_width, count - half_width, spacing),
            phi / phi.sum(axis=1, keepdims=True),
            phi_derivative / (phi_derivative @ offsets * step)[:, None],
        )

    @property
    def half_width(self) -> int:
        """Steps from a centre to either end of its window."""
        return self.phi.shape[1] // 2

    def integrate(self, weights: Array, f: Array) -> Array:
        """Weighted sums (2, K) of a signal (N,) over all windows."""
        view = sliding_window_view(f, weights.shape[1])[self.centres - self.half_width]
        return np.asarray(weights @ view.T)

    def apply_transpose(self, weights: Array, rows: Array, count: int) -> Array:
        """The transpose: what (N, p) of each sample goes to the sums with rows (2, K, p)."""
        out = np.zeros((count, rows.shape[2]))
        for half in range(2):
            for offset in np.flatnonzero(weights[half]):
                out[self.centres - self.half_width + offset] += weights[half, offset] * rows[half]
        return out

    def are_uniform(self, labels: np.ndarray) -> np.ndarray:
        """Which windows (K,) have one label throughout; labels (N,)."""
        changes = np.append(0, np.cumsum(np.diff(labels) != 0))
        return np.asarray(
            changes[self.centres + self.half_width] == changes[self.centres - self.half_width]
        )
