"""Kalman smoother: position, velocity and acceleration of a noisy coordinate."""

import math

import numpy as np

from crane.common.samples import Array, solve_linear
from crane.common.scratch_arrays import empty_array, release_pages

_SEARCH_BOUNDS = (8.0, 10.0)  # of h N and of h in the search for the noise ratio
_BLOCK_SAMPLES = 1 << 16  # samples per block of complex modes


def kalman_smooth(y: Array, step: float) -> tuple[Array, Array, float, float]:
    """Rauch-Tung-Striebel smoother of the constant-jerk model with an unknown initial state.

    The state x = (p, p', p'', p''') follows p'''' = white noise of intensity s; the measurement is
    y_k = p_k + noise of standard deviation sigma. With time in units of 1/w, w^8 = s / (sigma^2
    dt), and p in units of sigma, one parameter remains, h = w dt:

        z_k+1 = F z_k + noise,   F = exp(h N),   Q = h integral_0^h e^(Nt) b b^T e^(N^T t) dt

    Far from the ends this is the zero-phase filter 1 / (1 + (omega/w)^8), and the smoothing spline
    of degree seven: h / (2 pi dt) is the frequency in Hz at which half of the amplitude passes.

    If z_0 had the distribution N(mu, P) with the stationary covariance P of the predictions, all
    gains would be constant. The innovations are e(mu) = e(0) - U mu, U_k = H Phi^k. As the
    integral of p(y | mu) over mu equals that of p(y | z_0) over z_0, mu as an unknown constant
    gives the filter for unknown z_0 exactly: mu is the least-squares solution of U mu = e(0), and
    the likelihood with sigma at its maximum is

        -2 log L = (N - 4) log |e(mu)|^2 + log det U^T U - 12 log h

    (the last term converts mu to physical units), minimized over h. The smoothed covariance is
    that for known mu plus G_k cov(mu) G_k^T with the smoothed response G_k to mu.

    Args:
        y: Measured coordinate (N,).
        step: dt [s].

    Returns:
        Position, velocity and acceleration (N, 3), their standard deviations (N, 3), sigma, and
        the frequency at which half of the amplitude passes [Hz].

    Source: Rauch, Tung, Striebel 1965; de Jong 1991 (unknown initial states).
    """
    from scipy.linalg import solve_discrete_lyapunov
    from scipy.optimize import minimize_scalar

    if np.ptp(y) == 0:
        return np.column_stack([y, 0 * y, 0 * y]), np.zeros((len(y), 3)), 0.0, math.inf
    mean = y.mean()
    y = y - mean

    def cost(log_h: float) -> float:
        return likelihood(y, math.exp(log_h))[0]

    grid = np.linspace(math.log(_SEARCH_BOUNDS[0] / len(y)), math.log(_SEARCH_BOUNDS[1]), 13)
    best = int(np.argmin([cost(x) for x in grid]))
    bounds = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    found = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 1e-3})
    h = math.exp(found.x)

    _, mu, cov_mu, variance = likelihood(y, h)
    F, P, K = _stationary_filter(h)
    update = np.eye(4)
    update[:, 0] -= K
    filtered = _linear_recursion(F @ update, F @ K[:, None], y[:-1, None], mu)  # predictions first
    innovations = y - filtered[:, 0]
    for column, gain in zip(filtered.T, K, strict=True):
        column += gain * innovations
    C = solve_linear(P, F @ update @ P).T  # P_filtered F^T P^-1
    states = _backward_recursion(C, F, filtered)[:, :3]
    del filtered, innovations  # saves some 100 MB for an hour at 1 kHz

    # The covariance is stationary in the interior; the end and mu change it near the ends.
    end = update @ P
    interior = solve_discrete_lyapunov(C, end - C @ P @ C.T)
    reach = _decay_length(np.linalg.eigvals(C), len(y))
    powers = _matrix_powers(C, reach)
    covariance = empty_array(len(y), 3)
    covariance[:] = np.diag(interior)[:3]
    at_end = np.einsum("kij,jl,kil->ki", powers, end - interior, powers)[:, :3]
    covariance[len(y) - reach :] += at_end[::-1]
    forced = update @ _matrix_powers(F @ update, reach)
    G = np.stack([_backward_recursion(C, F, forced[:, :, i]) for i in range(4)], axis=2)
    covariance[:reach] += np.einsum("kij,jl,kil->ki", G, cov_mu, G)[:, :3]

    release_pages()
    units = (h / step) ** np.arange(3)
    sigma = math.sqrt(variance)
    states *= units
    states[:, 0] += mean
    std = np.sqrt(np.maximum(covariance, 0, out=covariance), out=covariance)
    std *= sigma * units
    return states, std, sigma, h / (2 * math.pi * step)


def _stationary_filter(h: float) -> tuple[Array, Array, Array]:
    """F, stationary covariance of the predictions P (4, 4), and filter gain K (4,).

    P = F P (1 + H^T H P)^-1 F^T + Q is solved by doubling (Chu, Fan, Lin, Wang 2004). The general
    solver of scipy takes as long as the rest of the smoother.
    """
    i, j = np.indices((4, 4))
    factorial = np.array([1.0, 1.0, 2.0, 6.0])
    F = np.where(j >= i, h ** np.abs(j - i) / factorial[np.abs(j - i)], 0.0)
    Q = h ** (8 - i - j) / (factorial[3 - i] * factorial[3 - j] * (7 - i - j))
    A, G, P = F.T, np.diag([1.0, 0, 0, 0]), Q
    while np.abs(A).max() > 1e-30:
        step = np.linalg.inv(np.eye(4) + G @ P) @ A
        A, G, P = (
            A @ step,
            G + A @ np.linalg.solve(np.eye(4) + G @ P, G) @ A.T,
            P + A.T @ P @ step,
        )
    return F, P, P[:, 0] / (P[0, 0] + 1)


def likelihood(y: Array, h: float) -> tuple[float, Array, Array, float]:
    """-2 log L, mu (4,), cov(mu) / sigma^2 (4, 4) and sigma^2, see `kalman_smooth`.

    The filter from y to e(0) is (1 - 1/z)^4 / det(1 - Phi/z).
    """
    from scipy.signal import sosfilt, zpk2sos

    F, P, K = _stationary_filter(h)
    values, V = np.linalg.eig(F - np.outer(F @ K, [1, 0, 0, 0]))
    free = sosfilt(zpk2sos(np.ones(4), values, 1.0), y)
    reach, inverse_modes = _decay_length(values, len(y)), np.linalg.inv(V)
    stacked_factor = np.zeros((0, 5))  # triangular factor of [U e(0)]
    for start in range(0, reach, _BLOCK_SAMPLES):
        k = np.arange(start, min(start + _BLOCK_SAMPLES, reach))
        U = np.real((V[0] * _eigenvalue_powers(values, k)) @ inverse_modes)
        rows = np.vstack([stacked_factor, np.column_stack([U, free[k]])])
        stacked_factor = np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64)
    R, rest = stacked_factor[:4, :4], stacked_factor[4:, 4]
    mu = solve_linear(R, stacked_factor[:4, 4])
    squares = max(float(free[reach:] @ free[reach:] + rest @ rest), float(np.finfo(float).tiny))
    freedom = len(y) - 4
    cost = freedom * math.log(squares) + 2 * np.linalg.slogdet(R)[1] - 12 * math.log(h)
    inverse = np.linalg.inv(R)
    innovation = P[0, 0] + 1
    return cost, mu, innovation * inverse @ inverse.T, squares / freedom / innovation


def _decay_length(values: np.ndarray, count: int) -> int:
    """Samples, at most `count`, after which modes of these eigenvalues have decayed by e^-40."""
    return min(count, math.ceil(-40 / math.log(np.abs(values).max())))


def _eigenvalue_powers(values: np.ndarray, k: np.ndarray) -> Array:
    """Powers values^k (N, n) for k (N,)."""
    return np.exp(k[:, None] * np.log(values.astype(complex)))


def _matrix_powers(A: Array, count: int) -> Array:
    """Powers A^0, ..., A^(count - 1) as (count, n, n)."""
    values, V = np.linalg.eig(A)
    return np.real((V * _eigenvalue_powers(values, np.arange(count))[:, None]) @ np.linalg.inv(V))


def _linear_recursion(A: Array, B: Array, u: Array, start: Array) -> Array:
    """Solution (N + 1, n) of x_k+1 = A x_k + B u_k, x_0 = start, for u (N, m), mode by mode."""
    from scipy.signal import lfilter

    values, V = np.linalg.eig(A)
    inverse_modes = np.linalg.inv(V)
    out = empty_array(len(u) + 1, len(A))
    out[0], state = start, inverse_modes @ start.astype(complex)
    for at in range(0, len(u), _BLOCK_SAMPLES):
        modes = (inverse_modes @ B) @ u[at : at + _BLOCK_SAMPLES].T.astype(complex)
        for i, (mode, value) in enumerate(zip(modes, values, strict=True)):
            mode[:] = lfilter([1.0], [1.0, -value], mode, zi=[value * state[i]])[0]
        out[at + 1 : at + 1 + modes.shape[1]] = np.real(V @ modes).T
        state = modes[:, -1]
        release_pages()
    return out


def _backward_recursion(C: Array, F: Array, filtered: Array) -> Array:
    """Backward recursion x_k = filtered_k + C (x_k+1 - F filtered_k)."""
    return _linear_recursion(C, np.eye(4) - C @ F, filtered[-2::-1], filtered[-1])[::-1]
