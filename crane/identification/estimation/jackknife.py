"""How far an estimate moves when stretches of the recording are left out."""

import numpy as np

from crane.common.samples import Array
from crane.identification.estimation.noise import Noise

_CORRELATED = 4.0  # mean correlation times of the joints' noise in a stretch, at least
_FEWEST, _MOST = 20, 200  # stretches
_ALONE = 1e-8  # of a direction's information, what others than one stretch have at least


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

    def __init__(self, samples: np.ndarray, noises: list[Noise], size: int):
        longest = _CORRELATED * np.mean([noise.correlated for noise in noises])
        span = int(samples[-1] - samples[0]) + 1
        wanted = int(np.clip(span / longest, _FEWEST, _MOST))
        starts = samples[np.arange(wanted) * len(samples) // wanted]
        self._starts = np.unique(starts)  # an instant belongs to one stretch
        self._H = np.zeros((len(self._starts), size, size))
        self._c = np.zeros((len(self._starts), size))

    def add(self, samples: np.ndarray, Q: Array, e: Array, counted: np.ndarray) -> None:
        """Rows of whole instants (N,).

        Args:
            samples: Number of their instants.
            Q: (p, N).
            e: Weighted residuals.
            counted: Whose small changes change the estimate: not those that are clipped.
        """
        cuts = [0, *np.searchsorted(samples, self._starts[1:]).tolist(), len(samples)]
        for k, rows in enumerate(map(slice, cuts[:-1], cuts[1:])):
            here = Q[:, rows][:, counted[rows]]
            self._H[k] += here @ here.T
            self._c[k] += Q[:, rows] @ e[rows]

    @property
    def freedom(self) -> int:
        """K - 1."""
        return len(self._c) - 1

    def covariance(self) -> Array:
        """Of R theta (p, p), of rank K - 1 at most."""
        shares, U = np.linalg.eigh(self._H)
        rest = np.maximum(1 - shares, _ALONE)
        turned = np.einsum("kji,kj->ki", U, self._c) / rest
        moved = np.einsum("kij,kj->ki", U, turned)
        moved -= moved.mean(axis=0)
        return self.freedom / len(moved) * moved.T @ moved
