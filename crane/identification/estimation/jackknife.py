"""How far an estimate moves when stretches of the recording are left out."""

import numpy as np

from crane.common.samples import Array
from crane.identification.estimation.noise_model import NoiseModel

_MIN_CORRELATION_TIMES = 4.0  # mean correlation times of the joints' noise in a stretch, at least
_MIN_SEGMENTS, _MAX_SEGMENTS = 20, 200  # stretches
_MIN_REMAINING_SHARE = (
    1e-8  # of a direction's information, what others than one stretch have at least
)


class Jackknife:
    """Covariance by leaving out one of K stretches of time after the other.

    With rows W' = W / s of unit noise, W' = Q R, e' the weighted residuals and H_k = Q_k^T Q_k the
    share of stretch k in all information, leaving it out moves R theta by

        d_k = (1 - H_k)^-1 Q_k^T e'_k,   cov(R theta) = (K - 1) / K sum_k (d_k - mean d)^2

    exactly. That needs no model of the noise: it may be correlated within stretches and between
    joints, depend on posture and speed, and hold what the model does not explain. Residuals that
    the fit has made small where few rows tell a parameter are taken back by (1 - H_k)^-1, so the
    variance is rather too large than too small.

    Args:
        samples: Number of the instant of each row (m,), not decreasing.
        noises: Of the joints, for how long they are correlated.
        size: Number of parameters p.

    Source: MacKinnon, Nielsen, Webb 2023, J. Applied Econometrics 38(5): CV3; Kuensch 1989, Annals
    of Statistics 17(3), for blocks of time.
    """

    def __init__(self, samples: np.ndarray, noises: list[NoiseModel], size: int):
        longest = _MIN_CORRELATION_TIMES * np.mean([noise.correlation_time for noise in noises])
        span = int(samples[-1] - samples[0]) + 1
        wanted = int(np.clip(span / longest, _MIN_SEGMENTS, _MAX_SEGMENTS))
        starts = samples[np.arange(wanted) * len(samples) // wanted]
        self._segment_starts = np.unique(starts)  # an instant belongs to one stretch
        self._H = np.zeros((len(self._segment_starts), size, size))
        self._c = np.zeros((len(self._segment_starts), size))

    def add(self, samples: np.ndarray, Q: Array, e: Array, unclipped: np.ndarray) -> None:
        """Rows of whole instants (N,).

        Args:
            samples: Number of their instants.
            Q: (p, N).
            e: Weighted residuals.
            unclipped: Whose small changes change the estimate: not those that are clipped.
        """
        cuts = [0, *np.searchsorted(samples, self._segment_starts[1:]).tolist(), len(samples)]
        for k, rows in enumerate(map(slice, cuts[:-1], cuts[1:])):
            here = Q[:, rows][:, unclipped[rows]]
            self._H[k] += here @ here.T
            self._c[k] += Q[:, rows] @ e[rows]

    @property
    def degrees_of_freedom(self) -> int:
        """K - 1."""
        return len(self._c) - 1

    def covariance(self) -> Array:
        """Of R theta (p, p), of rank K - 1 at most."""
        shares, U = np.linalg.eigh(self._H)
        rest = np.maximum(1 - shares, _MIN_REMAINING_SHARE)
        rotated_changes = np.einsum("kji,kj->ki", U, self._c) / rest
        parameter_changes = np.einsum("kij,kj->ki", U, rotated_changes)
        parameter_changes -= parameter_changes.mean(axis=0)
        return (
            self.degrees_of_freedom
            / len(parameter_changes)
            * parameter_changes.T
            @ parameter_changes
        )
