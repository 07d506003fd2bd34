"""Noise that remembers: autoregressive models of residuals."""

import math
from dataclasses import dataclass

import numpy as np

from crane.common.samples import Array

_FREQUENCY_COUNT = 1 << 14  # at which a spectrum is known
_MAX_ORDER = 60  # samples in the autoregressive model of the noise


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Autoregressive noise a_0 e_k + a_1 e_k-1 + ... = u_k of one joint, a_0 = 1.

    Attributes:
        a: Coefficients.
        innovations: u (T,) over all instants from the first to the last, nan where unknown.
        first_instant: Number of the first instant.
        effective_samples: See `Estimate`.
        correlation_time: Samples over which it is correlated, the sum of its squared
            autocorrelations at all lags (Bartlett 1946), mean S^2 / (mean S)^2 of its spectrum S:
            1 for white noise, (1 + c^2) / (1 - c^2) where a = (1, -c).
        memory_length: Samples until the noise has forgotten its past.
    """

    a: Array
    innovations: Array
    first_instant: int
    effective_samples: float
    correlation_time: float
    memory_length: int

    @classmethod
    def fit(cls, e: Array, samples: np.ndarray) -> "NoiseModel":
        """Burg's estimate from all runs without missing rows, order by Schwarz's criterion.

        Burg's needs no window, which would smear the steep spectrum of filtered noise, and is
        stable always. Where filtered noise was not thinned (a pass band of a tenth of the band
        that the samples can tell), some thousand rows are needed for intervals that hold.
        """
        from scipy.signal import lfilter

        runs = np.split(e, np.flatnonzero(np.diff(samples) != 1) + 1)
        a = _burg_coefficients(runs)
        series = np.full(int(samples[-1] - samples[0]) + 1, np.nan)
        for run, start in zip(runs, _run_starts(samples), strict=True):
            if len(run) >= len(a):
                u = np.convolve(run, a, mode="valid")
                series[start + len(a) - 1 : start + len(run)] = u
        largest = np.abs(np.roots(a)).max() if len(a) > 1 else 0.0
        # of what can be predicted to rounding a root may lie on the unit circle, or beyond
        rate = -math.log(min(max(largest, 1e-3), 1.0))
        memory = len(series) if rate * len(series) <= 20 else math.ceil(20 / rate)
        impulse_response = lfilter([1.0], a, np.eye(1, 4 * memory)[0])  # of e to an impulse in u
        # mean of its spectrum, by Parseval, over the spectrum at zero
        effective = float(
            len(e) * (impulse_response @ impulse_response) / impulse_response.sum() ** 2
        )
        gain = np.abs(np.fft.fft(a, _FREQUENCY_COUNT)) ** 2
        spectrum = gain.min() / gain if gain.min() else np.zeros(0)  # of a line all is correlated
        correlated = (
            float(np.mean(spectrum**2) / spectrum.mean() ** 2)
            if len(spectrum)
            else float(len(series))
        )
        return cls(a, series, int(samples[0]), effective, correlated, memory)

    def zero_state(self, count: int) -> Array:
        """What `apply_filter` starts from, for so many signals."""
        return np.zeros((count, len(self.a) - 1))

    def apply_filter(self, x: Array, state: Array) -> tuple[Array, Array]:
        """a^-1 of signals (count, N), and the state to go on from."""
        from scipy.signal import lfilter

        if len(self.a) == 1:
            return x, state
        out, state = lfilter([1.0], self.a, x, zi=state)
        return out, state


def _burg_coefficients(runs: list[Array]) -> Array:
    """Coefficients 1, a_1, ... of the order with the smallest Bayesian information criterion."""
    count = sum(map(len, runs))
    longest = min(_MAX_ORDER, count // 10)
    power = sum(run @ run for run in runs) / count
    a = best = np.ones(1)
    if power == 0:
        return best
    lowest = math.log(power)
    forward, backward = list(runs), list(runs)
    for order in range(1, longest + 1):
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
    """Covariances (g, g) of innovations at the same instants."""
    start = min(noise.first_instant for noise in noises)
    end = max(noise.first_instant + len(noise.innovations) for noise in noises)
    u = np.full((len(noises), end - start), np.nan)
    for row, noise in zip(u, noises, strict=True):
        row[noise.first_instant - start :][: len(noise.innovations)] = noise.innovations
    is_known = np.isfinite(u).astype(np.float64)
    u = np.nan_to_num(u)
    S = (u @ u.T) / np.maximum(is_known @ is_known.T, 1)
    values, vectors = np.linalg.eigh(S)
    return (vectors * np.maximum(values, 0)) @ vectors.T


def _run_starts(samples: np.ndarray) -> np.ndarray:
    """Where runs without missing rows start, counted from the first instant."""
    breaks = np.flatnonzero(np.diff(samples) != 1) + 1
    return samples[np.append(0, breaks)] - samples[0]
