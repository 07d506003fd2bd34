"""Autoregressive noise models of residuals, and the jackknife covariance of an estimate."""

import math
from dataclasses import dataclass

import numpy as np

from crane.common.samples import Array

_FREQUENCY_COUNT = 1 << 14  # frequencies of a spectrum
_MAX_ORDER = 60  # largest order of the autoregressive model
_MIN_CORRELATION_TIMES = 4.0  # least length of a segment, in mean correlation times of the noise
_MIN_SEGMENTS, _MAX_SEGMENTS = 20, 200  # segments
_MIN_REMAINING_SHARE = 1e-8  # least share of the information of a direction outside of one segment


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Autoregressive noise model a_0 e_k + a_1 e_k-1 + ... = u_k of one joint, a_0 = 1.

    Attributes:
        a: Coefficients.
        innovations: u (T,) at all instants from the first to the last, nan where unknown.
        first_instant: Number of the first instant.
        correlation_time: Correlation time in samples, the sum of the squared autocorrelations at
            all lags (Bartlett 1946), mean S^2 / (mean S)^2 of the spectrum S: 1 for white noise,
            (1 + c^2) / (1 - c^2) for a = (1, -c).
        memory_length: Length of the impulse response in samples.
    """

    a: Array
    innovations: Array
    first_instant: int
    correlation_time: float
    memory_length: int

    @classmethod
    def fit(cls, e: Array, samples: np.ndarray) -> "NoiseModel":
        """Fit by Burg's method to all runs without missing rows, order by Schwarz's criterion.

        Burg's method needs no window, which would smear the steep spectrum of filtered noise, and
        is always stable. For filtered noise that is not decimated (a passband of a tenth of the
        Nyquist frequency), valid intervals need some thousand rows.
        """
        breaks = np.flatnonzero(np.diff(samples) != 1) + 1
        runs = np.split(e, breaks)
        a = _burg_coefficients(runs)
        series = np.full(int(samples[-1] - samples[0]) + 1, np.nan)
        for run, start in zip(runs, samples[np.append(0, breaks)] - samples[0], strict=True):
            if len(run) >= len(a):
                series[start + len(a) - 1 : start + len(run)] = np.convolve(run, a, mode="valid")
        largest = np.abs(np.roots(a)).max() if len(a) > 1 else 0.0
        # for predictable signals, rounding may put a root on the unit circle or beyond
        rate = -math.log(min(max(largest, 1e-3), 1.0))
        memory = len(series) if rate * len(series) <= 20 else math.ceil(20 / rate)
        gain = np.abs(np.fft.fft(a, _FREQUENCY_COUNT)) ** 2
        correlated = float(len(series))  # of a spectral line
        if gain.min():
            spectrum = gain.min() / gain
            correlated = float(np.mean(spectrum**2) / spectrum.mean() ** 2)
        return cls(a, series, int(samples[0]), correlated, memory)


def _burg_coefficients(runs: list[Array]) -> Array:
    """Coefficients 1, a_1, ... of the order with the smallest Bayesian information criterion."""
    count = sum(map(len, runs))
    power = sum(run @ run for run in runs) / count
    a = best = np.ones(1)
    if power == 0:
        return best
    lowest = math.log(power)
    forward, backward = list(runs), list(runs)
    for order in range(1, min(_MAX_ORDER, count // 10) + 1):
        forward, backward = (
            [f[1:] for f in forward if len(f) > 1],
            [b[:-1] for b in backward if len(b) > 1],
        )
        cross = sum(f @ b for f, b in zip(forward, backward, strict=True))
        energy = sum(f @ f + b @ b for f, b in zip(forward, backward, strict=True))
        if not forward or energy <= 0:
            break
        k = -2 * cross / energy
        a = np.append(a, 0) + k * np.append(0, a[::-1])
        power *= 1 - k * k
        forward, backward = (
            [f + k * b for f, b in zip(forward, backward, strict=True)],
            [b + k * f for f, b in zip(forward, backward, strict=True)],
        )
        if power <= 0:
            break
        criterion = math.log(power) + order * math.log(count) / count
        if criterion < lowest:
            lowest, best = criterion, a
    return best


def innovation_covariance(noises: list[NoiseModel]) -> Array:
    """Covariance matrix (g, g) of the innovations of all groups at the same instants."""
    start = min(noise.first_instant for noise in noises)
    end = max(noise.first_instant + len(noise.innovations) for noise in noises)
    u = np.full((len(noises), end - start), np.nan)
    for row, noise in zip(u, noises, strict=True):
        row[noise.first_instant - start :][: len(noise.innovations)] = noise.innovations
    is_known = np.isfinite(u).astype(np.float64)
    u = np.nan_to_num(u)
    values, vectors = np.linalg.eigh((u @ u.T) / np.maximum(is_known @ is_known.T, 1))
    return (vectors * np.maximum(values, 0)) @ vectors.T


class Jackknife:
    """Delete-one jackknife covariance over K segments of time.

    With rows W' = W / s of unit noise, W' = Q R, the weighted residuals e' and the share H_k =
    Q_k^T Q_k of segment k in the information, removing the segment changes R theta exactly by

        d_k = (1 - H_k)^-1 Q_k^T e'_k,   cov(R theta) = (K - 1) / K sum_k (d_k - mean d)^2

    This needs no noise model: the noise may be correlated within segments and between joints,
    depend on configuration and speed, and contain model errors. The factor (1 - H_k)^-1 restores
    residuals that the fit has reduced where few rows determine a parameter, so the variance tends
    to be too large, not too small.

    Args:
        samples: Number of the instant of each row (m,), not decreasing.
        noises: Noise models of the joints, for their correlation times.
        size: Number of parameters p.

    Attributes:
        degrees_of_freedom: K - 1.

    Source: MacKinnon, Nielsen, Webb 2023, J. Applied Econometrics 38(5): CV3; Kuensch 1989, Annals
    of Statistics 17(3), for blocks of time.
    """

    def __init__(self, samples: np.ndarray, noises: list[NoiseModel], size: int):
        longest = _MIN_CORRELATION_TIMES * np.mean([noise.correlation_time for noise in noises])
        span = int(samples[-1] - samples[0]) + 1
        wanted = int(np.clip(span / longest, _MIN_SEGMENTS, _MAX_SEGMENTS))
        self._segment_starts = np.unique(
            samples[np.arange(wanted) * len(samples) // wanted]
        )  # an instant belongs to one segment
        self._H = np.zeros((len(self._segment_starts), size, size))
        self._c = np.zeros((len(self._segment_starts), size))
        self.degrees_of_freedom = len(self._c) - 1

    def add(self, samples: np.ndarray, Q: Array, e: Array, unclipped: np.ndarray) -> None:
        """Add the rows (N,) of complete instants.

        Args:
            samples: Numbers of their instants.
            Q: (p, N).
            e: Weighted residuals (N,).
            unclipped: Mask of the rows that are not clipped.
        """
        cuts = [0, *np.searchsorted(samples, self._segment_starts[1:]).tolist(), len(samples)]
        for k, rows in enumerate(map(slice, cuts[:-1], cuts[1:])):
            here = Q[:, rows][:, unclipped[rows]]
            self._H[k] += here @ here.T
            self._c[k] += Q[:, rows] @ e[rows]

    def covariance(self) -> Array:
        """Covariance (p, p) of R theta, of rank K - 1 at most."""
        shares, U = np.linalg.eigh(self._H)
        rest = np.maximum(1 - shares, _MIN_REMAINING_SHARE)
        changes = np.einsum("kij,kj->ki", U, np.einsum("kji,kj->ki", U, self._c) / rest)
        changes -= changes.mean(axis=0)
        return self.degrees_of_freedom / len(changes) * changes.T @ changes
