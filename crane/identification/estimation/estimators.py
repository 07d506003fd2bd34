"""Estimators of theta in y = W theta + noise: least squares, Huber, instrumental variables.

Rows belong to joints (`groups`) at instants (`samples`); rows may be missing. The noise of a joint
may be correlated in time, and with that of other joints at the same instant. The regressor is read
in blocks of rows, see `regressor.Regressor`, and may exceed the memory.
"""

import math
from dataclasses import dataclass

import numpy as np

from crane.common.errors import InputError
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array, root_mean_square, solve_linear
from crane.identification.estimation.noise_model import (
    Jackknife,
    NoiseModel,
    innovation_covariance,
)
from crane.identification.estimation.regressor import (
    Regressor,
    StoredRegressor,
    triangular_factor,
    triangular_factors,
)

Prior = tuple[Array, Array]
"""Means (p,) and standard deviations (p,) of the parameters; infinite where nothing is known."""
# robust standard deviations: 95 % efficiency on normal noise (Huber 1964)
_HUBER_THRESHOLD = 1.345
# standard deviation over median absolute deviation of normal noise
_MAD_TO_STD = 1.482602218505602
_CONVERGENCE_TOLERANCE = 1e-6  # standard deviations
_ROUNDING_SHARE = 1e-8  # relative to the forces, error of the base parameters by rounding
_MAX_ITERATIONS = 100
_GAP_BLOCK = 4096  # instants without rows per block


class EstimatedValues(OneLineRepr):
    """Values (p,) with their covariance (p, p) and its degrees of freedom, () or (p,)."""

    values: Array
    covariance: Array
    degrees_of_freedom: float | Array

    @property
    def std(self) -> Array:
        """Standard deviations (p,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))  # negative by rounding only

    def confidence_interval(self, level: float = 0.95) -> Array:
        """Confidence intervals (p, 2) of a level, 0 to 1: values -+ t std with Student's t."""
        from scipy.stats import t

        half = t.ppf(0.5 + 0.5 * level, self.degrees_of_freedom) * self.std
        return np.column_stack([self.values - half, self.values + half])


@dataclass(frozen=True, eq=False, repr=False)
class Estimate(EstimatedValues):
    """Estimated parameters with their covariance.

    Attributes:
        values: (p,) parameters.
        covariance: (p, p) covariance for correlated noise.
        residuals: (m,) y - W values.
        noise: (g,) standard deviation of the noise of each group.
        degrees_of_freedom: Degrees of freedom behind the standard deviations, see `Jackknife`.
        condition: Condition number of W.
        scaled_condition: Condition number of W with columns of length one.
    """

    values: Array
    covariance: Array
    residuals: Array
    noise: Array
    degrees_of_freedom: float
    condition: float
    scaled_condition: float


class RegressionProblem:
    """Weighted linear regression problem: the common part of all estimators.

    With weights D = diag(1 / s^2) and prior rows L, such as diag(1 / std), appended to W, Z and y,
    the estimate solves Q^T W' theta = Q^T y', where Q R = Z' is the factorization of the appended
    and weighted Z. Only the triangular factors of the rows of each group are stored: if all rows
    of a group have the same weight, they determine everything but the single residuals.
    """

    def __init__(
        self,
        W: Array | Regressor,
        Z: Array | None,
        y: Array,
        groups: np.ndarray | None,
        samples: np.ndarray | None,
        prior: Prior | None,
        prior_root: Array | None = None,
    ):
        count, size = np.shape(W) if isinstance(W, np.ndarray) else W.shape
        groups = np.zeros(count, int) if groups is None else np.asarray(groups)
        samples = np.arange(count) if samples is None else np.asarray(samples)
        shapes = {"y": np.shape(y), "groups": groups.shape, "samples": samples.shape}
        for name, shape in shapes.items():
            if shape != (count,):
                raise InputError(f"{name} has the shape {shape}, give ({count},)")
        if Z is not None and np.shape(Z) != (count, size):
            raise InputError(f"instruments have the shape {np.shape(Z)}, give {(count, size)}")
        self._order: np.ndarray | None = None  # order of the rows by time
        if isinstance(W, np.ndarray):
            if (np.diff(samples) < 0).any():
                self._order = np.argsort(samples, kind="stable")
                W, y = W[self._order], y[self._order]
                groups, samples = groups[self._order], samples[self._order]
                Z = None if Z is None else Z[self._order]
            W = StoredRegressor(W, samples)
        self.W, self.y, self.samples = W, y, samples
        self.Z = W if Z is None else StoredRegressor(Z, samples)
        self.group_rows = [np.flatnonzero(groups == g) for g in range(int(groups.max()) + 1)]
        self.groups = groups
        for g, rows in enumerate(self.group_rows):
            if len(rows) < 2:
                raise InputError(f"group {g} has {len(rows)} row, give two at least")
            if (np.diff(samples[rows]) <= 0).any():
                raise InputError(f"samples of group {g} do not increase, sort its rows by time")
        self.mean = np.zeros(size)
        self.prior_root = np.zeros((0, size)) if prior_root is None else prior_root
        if prior is not None:
            prior_mean, std = (np.asarray(x, dtype=np.float64) for x in prior)
            if prior_mean.shape != (size,) or std.shape != (size,):
                raise InputError(
                    f"the prior has means of the shape {prior_mean.shape} and deviations of the "
                    f"shape {std.shape}, give ({size},) each, one per column of the regressor"
                )
            if not (std > 0).all():
                raise InputError(f"the prior has the deviation {std.min():g}, give one above 0")
            self.mean, self.prior_root = prior_mean, np.diag(1 / std)
        if count + np.count_nonzero(self.prior_root) <= size:
            raise InputError(f"{count} rows for {size} parameters are too few, record longer")
        # unweighted factors (g, k, k)
        self.plain = (
            W.triangular_factors(y, groups)
            if Z is None
            else triangular_factors(W, y, groups, Z=self.Z)
        )
        if not np.isfinite(self.plain).all():
            self._raise_not_finite()
        # lower bound of the noise, for convergence if equations hold to rounding
        self.min_noise = _ROUNDING_SHARE * max(root_mean_square(y), np.finfo(float).tiny)

    def _raise_not_finite(self) -> None:
        order = np.arange(len(self.y)) if self._order is None else self._order
        for name, matrix in (("regressor", self.W), ("instruments", self.Z)):
            bad = [order[rows][~np.isfinite(W).all(axis=1)] for rows, W in matrix.blocks()]
            if (at := np.concatenate(bad)).size:
                raise InputError(f"{name} not finite in row {at.min()}, leave such rows out")
        at = order[~np.isfinite(self.y)]
        raise InputError(f"forces not finite in row {at.min()}, leave such rows out")

    def _noise(self, theta: Array, per_group: bool) -> Array:
        """Standard deviations of the groups (g,), from the triangular factors; or a common one."""
        W = self.plain[:, :, -1 - len(theta) : -1]
        norms = np.linalg.norm(self.plain[:, :, -1] - W @ theta, axis=1)
        if per_group:
            counts = np.array([len(rows) for rows in self.group_rows])
            return np.maximum(norms / np.sqrt(counts), self.min_noise)
        common = float(np.linalg.norm(norms) / math.sqrt(len(self.y)))
        return np.full(len(norms), max(common, self.min_noise))

    def _robust_group_noise(self, e: Array) -> Array:
        """Robust standard deviations of the groups (g,) from medians of residuals (m,)."""
        found = [_MAD_TO_STD * float(np.median(np.abs(e[rows]))) for rows in self.group_rows]
        return np.maximum(found, self.min_noise)

    def residuals(self, theta: Array) -> Array:
        """Residuals y - W theta (m,)."""
        e = np.array(self.y, dtype=np.float64)
        for rows, W in self.W.blocks():
            e[rows] -= W @ theta
        return e

    def estimate(self, per_group: bool = True, is_robust: bool = False) -> Estimate:
        """Alternate between the estimate and the noise until convergence.

        Args:
            per_group: Whether each group has its own noise.
            is_robust: Whether rows are reweighted by their residuals, see `huber`.
        """
        theta, e, R = np.zeros(len(self.mean)), self.y, self.plain
        s = self._robust_group_noise(e) if is_robust else self._noise(theta, per_group)
        for round_ in range(_MAX_ITERATIONS):
            before = theta
            theta, _, A = self._solve(R, s)
            e = self.residuals(theta) if is_robust else e
            if round_ and np.abs(A @ (theta - before)).max() < _CONVERGENCE_TOLERANCE:
                break
            if is_robust:
                s = self._robust_group_noise(e)
                clip = _HUBER_THRESHOLD * s[self.groups]
                shares = np.minimum(1, clip / np.maximum(np.abs(e), self.min_noise))
                R = triangular_factors(self.W, self.y, self.groups, np.sqrt(shares))
            else:
                s = self._noise(theta, per_group)
        if is_robust:
            return self.evaluate_estimate(theta, e, s, _HUBER_THRESHOLD)
        return self.evaluate_estimate(theta, self.residuals(theta), s, math.inf)

    def _solve(self, group_factors: Array, s: Array) -> tuple[Array, Array, Array]:
        """theta, R (p, p) of the weighted instruments with the rows of the prior, and Q^T W.

        Args:
            group_factors: Triangular factors (g, k, k) of [W y], or of [Z W y], of the groups.
            s: Standard deviations (g,) of the groups.
        """
        size = len(self.mean)
        copies = [self.prior_root] * ((group_factors.shape[2] - 1) // size)
        prior = np.column_stack([*copies, self.prior_root @ self.mean])
        stacked_factor = triangular_factor(np.vstack([*(group_factors / s[:, None, None]), prior]))
        R, A = stacked_factor[:size, :size], stacked_factor[:size, -1 - size : -1]
        length = np.linalg.norm(R, axis=0)
        length[length == 0] = 1.0
        values = np.linalg.svd(A / length, compute_uv=False)
        if values[-1] < np.finfo(float).eps * len(A) * values[0]:
            raise InputError(
                f"the {A.shape[1]} columns of the regressor depend on each other (condition "
                f"{values[0] / max(values[-1], 1e-300):.1g}), take base parameters, or a prior "
                "with finite deviations of those that do"
            )
        return solve_linear(A, stacked_factor[:size, -1]), R, A

    def evaluate_estimate(self, theta: Array, e: Array, s: Array, threshold: float) -> Estimate:
        """Estimate with the covariance A^-1 (sum of Q^T noise) A^-T for correlated noise.

        The noise of joint i is autoregressive, a_i(z) e_i = u_i, with covariances S_ij of the
        innovations u between joints at one instant; its covariance matrix over time is a_i^-1 S_ij
        a_j^-T, and Q^T (...) Q is computed by filtering Q by a_i^-1 backwards in time. Missing
        rows are zero in Q.

        Residuals underestimate the noise at low frequencies, where the parameters take many
        degrees of freedom, and the noise may not be stationary. So the standard deviations are
        those of the `Jackknife` if these are larger, with unchanged correlations between
        parameters. R and A are factors of the unclipped rows, which alone change the estimate, Q
        of all rows. Residuals have a lower bound by rounding errors of the rows and the base
        parameters.
        """
        limit = threshold * s[self.groups]
        clipped, unclipped = np.clip(e, -limit, limit), np.abs(e) <= limit
        del limit
        count, inflated = len(e), math.sqrt(len(e) / max(len(e) - len(theta), 1))
        noise = inflated * np.array([root_mean_square(clipped[rows]) for rows in self.group_rows])
        for group_indices in self.group_rows:
            if 0 < (group_rms := root_mean_square(clipped[group_indices])) < self.min_noise:
                clipped[group_indices] *= self.min_noise / group_rms
        clipped /= s[self.groups]
        noises = [NoiseModel.fit(clipped[rows], self.samples[rows]) for rows in self.group_rows]
        factors = self.plain
        if not unclipped.all():
            factors = triangular_factors(self.W, self.y, self.groups, unclipped)
        _, R, A = self._solve(factors, s)
        jackknife = Jackknife(self.samples, noises, len(theta))
        middle = self._noise_covariance_product(R, s, noises, jackknife, clipped, unclipped)
        del clipped, unclipped
        prior = np.linalg.solve(R.T, self.prior_root.T)
        inverse = np.linalg.inv(A)
        covariance, jackknife_covariance = (
            inverse @ (x + prior @ prior.T) @ inverse.T
            for x in (0.5 * (middle + middle.T), jackknife.covariance())
        )
        inflation = np.sqrt(np.maximum(np.diag(jackknife_covariance) / np.diag(covariance), 1.0))
        plain, scaled = condition_numbers(np.vstack(list(self.plain[:, :, -1 - len(theta) : -1])))
        if self._order is not None:
            e, ordered = np.empty(count), e
            e[self._order] = ordered
        return Estimate(
            values=theta,
            covariance=covariance * np.outer(inflation, inflation),
            residuals=e,
            noise=noise,
            degrees_of_freedom=jackknife.degrees_of_freedom,
            condition=plain,
            scaled_condition=scaled,
        )

    def _noise_covariance_product(
        self,
        R: Array,
        s: Array,
        noises: list[NoiseModel],
        jackknife: Jackknife,
        e: Array,
        unclipped: np.ndarray,
    ) -> Array:
        """Product Q^T (covariance of the noise) Q (p, p), Q = Z / s R^-1, backwards in time.

        The rows are also added to a jackknife, with their weighted residuals e (m,) and the mask
        of unclipped rows.
        """
        from scipy.linalg import solve_triangular
        from scipy.signal import lfilter

        S, size = innovation_covariance(noises), len(R)
        filter_states = [np.zeros((size, len(noise.a) - 1)) for noise in noises]
        middle = np.zeros((size, size))

        def filter_instants(count: int, at: np.ndarray, groups: np.ndarray, Q: Array) -> None:
            """Filter instants with rows Q (p, rows) at positions `at` from the last one."""
            filtered = []
            for i, noise in enumerate(noises):
                dense = np.zeros((size, count))
                dense[:, at[groups == i]] = Q[:, groups == i]
                out, filter_states[i] = lfilter([1.0], noise.a, dense, zi=filter_states[i])
                filtered.append(out)
            for i, one in enumerate(filtered):
                middle[:] += one @ sum(S[i, j] * other.T for j, other in enumerate(filtered))

        def skip_instants(count: int) -> None:
            nothing = np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp), np.zeros((size, 0))
            for start in range(0, count, _GAP_BLOCK):
                filter_instants(min(_GAP_BLOCK, count - start), *nothing)

        last = int(self.samples[-1]) + 1
        for rows, block in self.Z.blocks(backwards=True):
            at, groups = self.samples[rows], self.groups[rows]
            Q = solve_triangular(R, (block / s[groups, None]).T, trans="T")
            jackknife.add(self.samples[rows], Q, e[rows], unclipped[rows])
            skip_instants(last - 1 - int(at[-1]))
            filter_instants(int(at[-1] - at[0]) + 1, at[-1] - at, groups, Q)
            last = int(at[0])
        skip_instants(max(noise.memory_length for noise in noises))
        return middle


def condition_numbers(W: Array) -> tuple[float, float]:
    """Condition numbers of W, or of its triangular factor: plain, and with unit columns."""
    scaled = W / np.maximum(np.linalg.norm(W, axis=0), 1e-300)
    plain, of_scaled = (float(np.linalg.cond(np.linalg.qr(x, mode="r"))) for x in (W, scaled))
    return plain, of_scaled


def least_squares(
    W: Array | Regressor,
    y: Array,
    groups: np.ndarray | None = None,
    samples: np.ndarray | None = None,
    prior: Prior | None = None,
) -> Estimate:
    """Ordinary least squares: min |y - W theta|^2 (/ noise^2 + |(theta - mean) / std|^2).

    The noise that a prior is weighted against is common to all rows and estimated from the
    residuals.

    Args:
        W: Regressor (m, p), as an array or in blocks.
        y: Forces (m,).
        groups: Joint of each row (m,), 0, 1, ..., with its own noise.
        samples: Number of the instant of each row (m,), increasing within a group.
        prior: See `Prior`.

    Raises:
        InputError: Shapes differ, there are too few rows, or columns are linearly dependent.
    """
    return RegressionProblem(W, None, y, groups, samples, prior).estimate(per_group=False)


def weighted_least_squares(
    W: Array | Regressor,
    y: Array,
    groups: np.ndarray,
    samples: np.ndarray | None = None,
    prior: Prior | None = None,
) -> Estimate:
    """Weighted least squares with the rows of each joint divided by its estimated noise.

    Arguments and errors as for `least_squares`.
    """
    return RegressionProblem(W, None, y, groups, samples, prior).estimate()


def huber(
    W: Array | Regressor,
    y: Array,
    groups: np.ndarray | None = None,
    samples: np.ndarray | None = None,
    prior: Prior | None = None,
) -> Estimate:
    """Huber's M-estimate by iteratively reweighted least squares.

    Rows are weighted by min(1, k sigma / |e|) / sigma^2 with k = 1.345 and the robust standard
    deviation sigma of each joint, 1.4826 median |e|. The covariance is that of sum_i w_i psi(e_i),
    with psi clipping at k sigma, over the information sum_i w_i psi'(e_i) w_i^T of the unclipped
    rows, whose share may depend on the motion.

    Arguments and errors as for `least_squares`.
    """
    return RegressionProblem(W, None, y, groups, samples, prior).estimate(is_robust=True)


def instrumental_variables(
    W: Array,
    y: Array,
    Z: Array,
    groups: np.ndarray | None = None,
    samples: np.ndarray | None = None,
    prior: Prior | None = None,
) -> Estimate:
    """Instrumental variables: theta from Z^T D (y - W theta) = 0, D = 1 / noise^2 of each joint.

    Noise of the measured motion in W biases least squares. It does not bias this estimate if the
    instruments Z (m, p) are independent of it, such as the regressor of a simulated or commanded
    motion. Rows of a prior belong to both. Other arguments and errors are those of
    `least_squares`.

    Source: Janot, Vandanjon, Gautier 2014, IEEE Trans. Control Systems Technology 22(1).
    """
    return RegressionProblem(W, Z, y, groups, samples, prior).estimate()
