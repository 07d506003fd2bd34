"""Parameters theta of y = W theta + noise, and how well they are known.

Rows come from joints (`groups`) at instants (`samples`); rows may be missing. The noise of a
joint may be correlated in time, and with that of the other joints at the same instant.
"""

import math
from dataclasses import dataclass

import numpy as np

from crane.errors import InputError
from crane.identification.noise import Noise, between
from crane.samples import Array, Brief

Prior = tuple[Array, Array]
"""Means (p,) and standard deviations (p,) of the parameters; infinite where nothing is known."""

_TURN = 1.345  # robust standard deviations: 95 % efficiency on normal noise (Huber 1964)
_MAD = 1.482602218505602  # standard deviation over median absolute deviation of normal noise
_CONVERGED = 1e-6  # standard deviations
_ROUNDING = 1e-10  # of the forces
_ROUNDS = 100
_LEAST_SHARE = 0.2  # of the degrees of freedom, however many parameters take theirs


@dataclass(frozen=True, eq=False, repr=False)
class Estimate(Brief):
    """Estimated parameters.

    Attributes:
        values: (p,).
        covariance: (p, p), with the correlations of the noise.
        residuals: y - W values (m,).
        noise: Standard deviation of the noise of each group (g,).
        effective: Number of independent rows that tell the mean of a group's noise as well as
            its N correlated rows, N variance / spectral density at zero (g,).
        freedom: Degrees of freedom behind the standard deviations.
        condition: Condition number of W.
        scaled_condition: The same with columns of length one.
    """

    values: Array
    covariance: Array
    residuals: Array
    noise: Array
    effective: Array
    freedom: float
    condition: float
    scaled_condition: float

    @property
    def std(self) -> Array:
        """Standard deviations (p,)."""
        return np.sqrt(np.diag(self.covariance))

    def interval(self, level: float = 0.95) -> Array:
        """Lower and upper ends (p, 2) of what covers the truth with this probability.

        values -+ t std with Student's t for `freedom`.
        """
        from scipy.stats import t

        half = t.ppf(0.5 + 0.5 * level, self.freedom) * self.std
        return np.column_stack([self.values - half, self.values + half])


def least_squares(
    W: Array,
    y: Array,
    groups: np.ndarray | None = None,
    samples: np.ndarray | None = None,
    prior: Prior | None = None,
) -> Estimate:
    """Ordinary least squares: min |y - W theta|^2 (/ noise^2 + |(theta - mean) / std|^2).

    The noise against which a prior counts is one number for all rows, taken from the residuals.

    Args:
        W: Regressor (m, p).
        y: Forces (m,).
        groups: Joint of each row (m,), 0, 1, ...; they differ in what their noise is like.
        samples: Number of the instant of each row (m,), increasing within a group.
        prior: See `Prior`.

    Raises:
        InputError: Shapes, too few rows, or columns that depend on each other.
    """
    rows = _Rows(W, W, y, groups, samples, prior)
    return rows.estimate(lambda e: np.full(len(e), max(_rms(e), rows.smallest)))


def weighted(
    W: Array,
    y: Array,
    groups: np.ndarray,
    samples: np.ndarray | None = None,
    prior: Prior | None = None,
) -> Estimate:
    """Least squares with the rows of each joint divided by its noise, until both agree.

    Arguments and errors as for `least_squares`.
    """
    rows = _Rows(W, W, y, groups, samples, prior)
    return rows.estimate(rows.scales)


def huber(
    W: Array,
    y: Array,
    groups: np.ndarray | None = None,
    samples: np.ndarray | None = None,
    prior: Prior | None = None,
) -> Estimate:
    """Huber's M-estimate by iteratively reweighted least squares.

    Beyond k = 1.345 robust standard deviations sigma (1.4826 median |e|, of each joint) a row
    counts by its sign alone: weight min(1, k sigma / |e|) / sigma^2. The covariance is that of
    sum_i w_i psi(e_i), psi clipping at k sigma, divided by the share of unclipped rows.

    Arguments and errors as for `least_squares`.
    """
    rows = _Rows(W, W, y, groups, samples, prior)
    return rows.estimate(rows.robust_scales, _TURN)


def instrumental(
    W: Array,
    y: Array,
    Z: Array,
    groups: np.ndarray | None = None,
    samples: np.ndarray | None = None,
    prior: Prior | None = None,
) -> Estimate:
    """Instrumental variables: theta from Z^T D (y - W theta) = 0, D = 1 / noise^2 of each joint.

    Noise of the measured motion in W biases least squares, and does not bias this as long as
    the instruments have none of it: Z (m, p) is the regressor of a simulated or commanded
    motion. With a prior, its rows belong to both. Other arguments and errors as for
    `least_squares`.

    Source: Janot, Vandanjon, Gautier 2014, IEEE Trans. Control Systems Technology 22(1).
    """
    rows = _Rows(W, Z, y, groups, samples, prior)
    return rows.estimate(rows.scales)


def essential(estimate: Estimate, level: float = 0.05) -> np.ndarray:
    """Parameters without which the model would be significantly worse.

    The one with the largest relative standard deviation is set to zero, the others follow by
    their covariances, and so on, as long as an F-test of all that are set to zero against the
    full estimate does not reject at `level`:

        F = theta_d^T C_dd^-1 theta_d / d.

    For least squares with independent noise that is (RSS_reduced - RSS) / (d sigma^2), and the
    others come out as if estimated anew; for correlated noise it stays valid.

    Returns:
        Indices of the kept parameters, increasing.

    Source: Pham, Gautier 1991, essential parameters of robots, IEEE CDC.
    """
    from scipy.stats import f

    kept, dropped = list(range(len(estimate.values))), list[int]()
    values, covariance = estimate.values, estimate.covariance
    while len(kept) > 1:
        std = np.sqrt(np.diag(covariance))
        worst = int(np.argmax(std / np.maximum(np.abs(values), np.finfo(float).tiny)))
        trial = [*dropped, kept[worst]]
        theta = estimate.values[trial]
        C = estimate.covariance[np.ix_(trial, trial)]
        F = theta @ np.linalg.solve(C, theta) / len(trial)
        if f.sf(F, len(trial), estimate.freedom) < level:
            break
        gain = covariance[:, worst] / covariance[worst, worst]
        rest = np.arange(len(kept)) != worst
        values = (values - gain * values[worst])[rest]
        covariance = (covariance - np.outer(gain, covariance[worst]))[np.ix_(rest, rest)]
        dropped.append(kept.pop(worst))
    return np.array(kept)


class _Rows:
    """Equations and how to solve them: one engine for all estimators.

    With weights D = diag(1 / s^2) and prior rows L = diag(1 / std) appended to W, Z and y, the
    estimate solves Q^T W' theta = Q^T y', where Q R = Z' are the appended and weighted Z.
    """

    def __init__(
        self,
        W: Array,
        Z: Array,
        y: Array,
        groups: np.ndarray | None,
        samples: np.ndarray | None,
        prior: Prior | None,
    ):
        count, size = np.shape(W)
        groups = np.zeros(count, int) if groups is None else np.asarray(groups)
        samples = np.arange(count) if samples is None else np.asarray(samples)
        shapes = {"y": np.shape(y), "groups": groups.shape, "samples": samples.shape}
        for name, shape in shapes.items():
            if shape != (count,):
                raise InputError(f"{name} has the shape {shape}, give ({count},)")
        if np.shape(Z) != (count, size):
            raise InputError(f"instruments have the shape {np.shape(Z)}, give {(count, size)}")
        for name, array in (("regressor", W), ("instruments", Z), ("forces", y)):
            if not np.isfinite(array).all():
                at = int(np.argwhere(~np.isfinite(array))[0, 0])
                raise InputError(f"{name} not finite in row {at}, leave such rows out")
        self.W, self.Z, self.y = W, Z, y
        self.members = [np.flatnonzero(groups == g) for g in range(int(groups.max()) + 1)]
        self.samples = samples
        for g, rows in enumerate(self.members):
            if len(rows) < 2 or (np.diff(samples[rows]) <= 0).any():
                raise InputError(f"samples of group {g} do not increase, sort its rows by time")
        self.mean, self.weight = np.zeros(size), np.zeros(size)
        if prior is not None:
            mean, std = (np.asarray(x, dtype=np.float64) for x in prior)
            if mean.shape != (size,) or std.shape != (size,):
                raise InputError(
                    f"the prior has means of the shape {mean.shape} and deviations of the shape "
                    f"{std.shape}, give ({size},) each, one per column of the regressor"
                )
            if not (std > 0).all():
                raise InputError(f"the prior has the deviation {std.min():g}, give one above 0")
            self.mean, self.weight = mean, 1 / std
        if count + np.count_nonzero(self.weight) <= size:
            raise InputError(f"{count} rows for {size} parameters are too few, record longer")
        # of what counts as noise, so that equations that hold to rounding settle
        self.smallest = _ROUNDING * max(_rms(y), np.finfo(float).tiny)

    def scales(self, e: Array) -> Array:
        """Standard deviation of each row's group (m,)."""
        return self._per_group(e, _rms)

    def robust_scales(self, e: Array) -> Array:
        """The same from medians."""
        return self._per_group(e, lambda x: _MAD * float(np.median(np.abs(x))))

    def _per_group(self, e: Array, scale) -> Array:  # type: ignore[no-untyped-def]
        out = np.empty(len(e))
        for rows in self.members:
            out[rows] = max(scale(e[rows]), self.smallest)
        return out

    def estimate(self, scales, turn: float = math.inf) -> Estimate:  # type: ignore[no-untyped-def]
        """Solve with the scales that the residuals ask for, until nothing changes."""
        s = scales(self.y)
        shares = np.ones(len(s))
        theta = np.full(len(self.mean), np.inf)
        for _ in range(_ROUNDS):
            before = theta
            theta, Q, A = self._solve(s / np.sqrt(shares))
            e = self.y - self.W @ theta
            with np.errstate(invalid="ignore"):
                if np.abs(A @ (theta - before)).max() < _CONVERGED:
                    break
            s = scales(e)
            shares = np.minimum(1, turn * s / np.maximum(np.abs(e), self.smallest))
        return self._judge(theta, e, s, turn)

    def _solve(self, s: Array) -> tuple[Array, Array, Array]:
        """theta, orthonormal Q of the instruments (m + p, p), and Q^T W."""
        prior = np.diag(self.weight)
        W, Z = (np.vstack([X / s[:, None], prior]) for X in (self.W, self.Z))
        y = np.concatenate([self.y / s, self.weight * self.mean])
        length = np.linalg.norm(Z, axis=0)
        length[length == 0] = 1.0
        Q, R = np.linalg.qr(Z / length)
        A = R * length if self.W is self.Z else Q.T @ W
        values = np.linalg.svd(A / length, compute_uv=False)
        if values[-1] < np.finfo(float).eps * len(A) * values[0]:
            raise InputError(
                f"the {A.shape[1]} columns of the regressor depend on each other (condition "
                f"{values[0] / max(values[-1], 1e-300):.1g}), take base parameters, or a prior "
                "with finite deviations of those that do"
            )
        return np.linalg.solve(A, Q.T @ y), Q, A

    def _judge(self, theta: Array, e: Array, s: Array, turn: float) -> Estimate:
        """Covariance of theta: A^-1 (sum of Q^T noise) A^-T with the noise's correlations.

        The noise of joint i is modelled as autoregressive, a_i(z) e_i = u_i, with covariances
        S_ij of the innovations u between joints at one instant; its covariance matrix over time
        is then a_i^-1 S_ij a_j^-T, and Q^T (...) Q comes from filtering Q by a_i^-1 backwards
        in time. Rows that are missing are zero in Q.

        The spectral densities at low frequencies, where motions are, are known with some degrees
        of freedom f (`Noise.known`, m for white noise), of which the fit takes p: the
        covariance is multiplied by f / (f - p), and f - p are those of the intervals.
        """
        clipped = np.clip(e, -turn * s, turn * s) / s
        unclipped = float(np.mean(np.abs(e) <= turn * s))
        Q, A = self._solve(s / math.sqrt(unclipped))[1:]
        inner = Q[: len(e)]
        noises = [Noise.of(clipped[rows], self.samples[rows]) for rows in self.members]
        span = int(self.samples.min()), int(self.samples.max())
        memory = max(noise.memory for noise in noises)
        filtered = [
            noise.spread(inner[rows], self.samples[rows] - span[0], span[1] - span[0] + 1, memory)
            for noise, rows in zip(noises, self.members, strict=True)
        ]
        S = between(noises)
        middle = np.zeros((len(theta), len(theta)))
        for i, one in enumerate(filtered):
            other = sum(S[i, j] * filtered[j] for j in range(len(filtered)))
            middle += one.T @ other
        known = sum(noise.known for noise in noises)
        freedom = max(known - len(theta), _LEAST_SHARE * known)
        middle *= known / freedom / unclipped
        middle += Q[len(e) :].T @ Q[len(e) :]
        inverse = np.linalg.inv(A)
        plain, scaled = conditions(self.W)
        inflated = math.sqrt(len(e) / max(len(e) - len(theta), 1))
        return Estimate(
            values=theta,
            covariance=inverse @ (0.5 * (middle + middle.T)) @ inverse.T,
            residuals=e,
            noise=inflated * np.array([_rms((clipped * s)[rows]) for rows in self.members]),
            effective=np.array([noise.effective for noise in noises]),
            freedom=freedom,
            condition=plain,
            scaled_condition=scaled,
        )


def _rms(e: Array) -> float:
    return math.sqrt(np.mean(np.square(e)))


def _lengths(W: Array) -> Array:
    return np.linalg.norm(W, axis=0)


def conditions(W: Array) -> tuple[float, float]:
    """Condition numbers of W, and of W with columns of length one."""
    return _condition(W), _condition(W / np.maximum(_lengths(W), 1e-300))


def _condition(W: Array) -> float:
    return float(np.linalg.cond(np.linalg.qr(W, mode="r")))
