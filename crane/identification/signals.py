"""From recorded samples to velocities, accelerations and thinned equations.

`check` and `check_forces` find recordings that would mislead an identification, and say why.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from crane.errors import InputError, RecordingError
from crane.samples import Array, as_number, solve

_FEWEST = 50  # samples
_LONGEST_GAP = 5.0  # steps
_JITTER = 0.01  # steps
_BOUNDS = (8.0, 10.0)  # of h N and h in the search for the smoother's noise ratio
_COMPARED = 10.0  # [Hz] up to which recorded velocities and positions are compared
_EQUAL = 0.01  # of a correlation
_SEARCHED = 1.0  # [s] longest delay that is looked for
_OTHER = {"rad": ("deg", 180 / math.pi), "m": ("mm", 1e3)}  # units that are taken for SI


@dataclass(frozen=True, eq=False)
class Motion:
    """What an identification starts from: N samples of n active joints.

    Attributes:
        time: Instants (N,) [s].
        q: Coordinates (N, n) [rad or m].
        v: Velocities (N, n) [rad/s or m/s].
        a: Accelerations (N, n) [rad/s2 or m/s2].
        tau: Generalized forces (N, n) [N m or N].
    """

    time: Array
    q: Array
    v: Array
    a: Array
    tau: Array


@dataclass(frozen=True, eq=False)
class Derivatives:
    """Smoothed coordinates and their derivatives (N, n).

    Attributes:
        q: Coordinates [rad or m].
        v: Velocities [rad/s or m/s].
        a: Accelerations [rad/s2 or m/s2].
        std_v: Standard deviation of the velocities, None where the method knows none.
        std_a: Standard deviation of the accelerations, likewise.
        noise: Estimated standard deviation (n,) of the measured coordinates, likewise.
    """

    q: Array
    v: Array
    a: Array
    std_v: Array | None = None
    std_a: Array | None = None
    noise: Array | None = None


def differentiate(
    time: Array, q: Array, method: str = "kalman", cutoff: float | None = None
) -> Derivatives:
    """Velocities and accelerations from measured coordinates.

    Args:
        time: Equidistant instants (N,) [s].
        q: Measured coordinates (N, n) [rad or m].
        method: "kalman" smooths each joint as described at `_smooth`; "lowpass" takes central
            differences, twice for the acceleration, of what `low_pass` lets through.
        cutoff: [Hz] of "lowpass".

    Raises:
        InputError: An unknown method, or a cutoff too much or too little.
        RecordingError: Samples are not equidistant, or too few.
    """
    step = sampling(time)
    if method not in ("kalman", "lowpass"):
        raise InputError(f"method '{method}' is unknown, known: kalman, lowpass")
    if (method == "lowpass") != (cutoff is not None):
        verb = "needs" if cutoff is None else "estimates its own and takes no"
        raise InputError(f"method '{method}' {verb} cutoff, give one to 'lowpass' alone")
    if cutoff is not None:
        smooth = low_pass(time, q, cutoff)
        v = central_differences(time, smooth)
        return Derivatives(smooth, v, central_differences(time, v))
    joints = [_smooth(column, step) for column in q.T]
    states, stds, noise = (np.array(part) for part in zip(*joints, strict=True))
    position, v, a = (np.ascontiguousarray(states[:, :, i].T) for i in range(3))
    std_v, std_a = (np.ascontiguousarray(stds[:, :, i].T) for i in (1, 2))
    return Derivatives(position, v, a, std_v, std_a, noise)


def _smooth(y: Array, step: float) -> tuple[Array, Array, float]:
    """Rauch-Tung-Striebel smoother of the constant-jerk model with an unknown initial state.

    The state x = (p, p', p'', p''') follows p'''' = white noise of intensity s, measured is
    y_k = p_k + noise of standard deviation sigma. Time in units of 1/w, w^8 = s / (sigma^2 dt),
    and p in units of sigma leave one number, h = w dt:

        z_k+1 = F z_k + noise,   F = exp(h N),   Q = h integral_0^h e^(Nt) b b^T e^(N^T t) dt

    Far from the ends this is the zero-phase filter 1 / (1 + (omega/w)^8), and the smoothing
    spline of degree seven: h / (2 pi dt) is the frequency in Hz at which half of a movement
    passes.

    Were z_0 distributed as N(mu, P) with the stationary covariance P of the predictions, all
    gains were constant. Its innovations are e(mu) = e(0) - U mu, U_k = H Phi^k. As the integral
    of p(y | mu) over mu is that of p(y | z_0) over z_0, taking mu as an unknown constant gives
    the filter with unknown z_0 exactly: mu is the least-squares solution of U mu = e(0), the
    likelihood with sigma at its maximum is

        -2 log L = (N - 4) log |e(mu)|^2 + log det U^T U - 12 log h

    (the last term turns mu to physical units; minimised over h), and the smoothed covariance is
    the one for known mu plus G_k cov(mu) G_k^T, G_k the smoothed answer to mu.

    Args:
        y: Measured coordinate (N,).
        step: dt [s].

    Returns:
        Position, velocity and acceleration (N, 3), their standard deviations (N, 3), sigma.

    Source: Rauch, Tung, Striebel 1965; de Jong 1991 (unknown initial states).
    """
    from scipy.optimize import minimize_scalar

    if np.ptp(y) == 0:
        return np.column_stack([y, 0 * y, 0 * y]), np.zeros((len(y), 3)), 0.0
    mean = y.mean()
    y = y - mean

    def cost(log_h: float) -> float:
        return _likelihood(y, math.exp(log_h))[0]

    grid = np.linspace(math.log(_BOUNDS[0] / len(y)), math.log(_BOUNDS[1]), 13)
    best = int(np.argmin([cost(x) for x in grid]))
    bounds = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    found = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 1e-3})
    h = math.exp(found.x)

    _, mu, cov_mu, variance = _likelihood(y, h)
    F, P, K = _stationary(h)
    update = np.eye(4)
    update[:, 0] -= K
    predicted = _recursion(F @ update, np.outer(y[:-1], F @ K), mu)
    filtered = predicted + np.outer(y - predicted[:, 0], K)
    C = solve(P, F @ update @ P).T  # P_filtered F^T P^-1
    states = _backwards(C, F, filtered)

    # Away from the ends the covariance is stationary; there, add what the end and mu do.
    end = update @ P
    interior = _stein(C, end - C @ P @ C.T)
    reach = _reach(np.linalg.eigvals(C), len(y))
    powers = _powers(C, reach)
    covariance = np.repeat(np.diag(interior)[None], len(y), axis=0)
    at_end = np.einsum("kij,jl,kil->ki", powers, end - interior, powers)
    covariance[len(y) - reach :] += at_end[::-1]
    forced = update @ _powers(F @ update, reach)
    G = np.stack([_backwards(C, F, forced[:, :, i]) for i in range(4)], axis=2)
    covariance[:reach] += np.einsum("kij,jl,kil->ki", G, cov_mu, G)

    units = (h / step) ** np.arange(3)
    sigma = math.sqrt(variance)
    states = states[:, :3] * units + [mean, 0, 0]
    return states, sigma * np.sqrt(np.maximum(covariance[:, :3], 0)) * units, sigma


def _stationary(h: float) -> tuple[Array, Array, Array]:
    """F, stationary covariance of the predictions P (4, 4), and filter gain K (4,).

    P = F P (1 + H^T H P)^-1 F^T + Q by doubling, from which on it takes 2^i steps at once (Chu,
    Fan, Lin, Wang 2004). The general solver of scipy takes as long as all the rest.
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


def _likelihood(y: Array, h: float) -> tuple[float, Array, Array, float]:
    """-2 log L, mu (4,), cov(mu) / sigma^2 (4, 4) and sigma^2, as derived at `_smooth`.

    From y to e(0) the filter is (1 - 1/z)^4 / det(1 - Phi/z).
    """
    from scipy.signal import sosfilt, zpk2sos

    F, P, K = _stationary(h)
    values, V = np.linalg.eig(F - np.outer(F @ K, [1, 0, 0, 0]))
    free = sosfilt(zpk2sos(np.ones(4), values, 1.0), y)
    reach = _reach(values, len(y))
    U, R = np.linalg.qr(np.real((V[0] * _geometric(values, reach)) @ np.linalg.inv(V)))
    mu = np.linalg.solve(R, U.T @ free[:reach])
    free[:reach] -= U @ (R @ mu)
    squares = max(float(free @ free), float(np.finfo(float).tiny))
    freedom = len(y) - 4
    cost = freedom * math.log(squares) + 2 * np.linalg.slogdet(R)[1] - 12 * math.log(h)
    inverse = np.linalg.inv(R)
    innovation = P[0, 0] + 1
    return cost, mu, innovation * inverse @ inverse.T, squares / freedom / innovation


def _reach(values: np.ndarray, count: int) -> int:
    """Samples, at most `count`, until modes of these eigenvalues have decayed by e^-40."""
    return min(count, math.ceil(-40 / math.log(np.abs(values).max())))


def _geometric(values: np.ndarray, count: int) -> Array:
    """values^k (count, n) for k = 0, 1, ..."""
    return np.exp(np.arange(count)[:, None] * np.log(values.astype(complex)))


def _powers(A: Array, count: int) -> Array:
    """A^0, ..., A^(count - 1), (count, n, n)."""
    values, V = np.linalg.eig(A)
    return np.real((V * _geometric(values, count)[:, None]) @ np.linalg.inv(V))


def _recursion(A: Array, u: Array, start: Array) -> Array:
    """x_0 = start, x_k+1 = A x_k + u_k as (N + 1, n), mode by mode."""
    from scipy.signal import lfilter

    values, V = np.linalg.eig(A)
    modes = np.linalg.inv(V) @ np.column_stack([start, u.T])
    for mode, value in zip(modes, values, strict=True):
        mode[:] = lfilter([1.0], [1.0, -value], mode)
    return np.real(V @ modes).T


def _backwards(C: Array, F: Array, filtered: Array) -> Array:
    """x_k = filtered_k + C (x_k+1 - F filtered_k), from the last sample to the first."""
    inputs = filtered[:-1] @ (np.eye(4) - C @ F).T
    return _recursion(C, inputs[::-1], filtered[-1])[::-1]


def _stein(A: Array, B: Array) -> Array:
    """Solution X of X = A X A^T + B."""
    from scipy.linalg import solve_discrete_lyapunov

    return np.asarray(solve_discrete_lyapunov(A, B))


def sampling(time: Array) -> float:
    """Step [s] of equidistant instants (N,).

    Raises:
        RecordingError: They are not equidistant, or fewer than 50.
    """
    if len(time) < _FEWEST:
        raise RecordingError(f"{len(time)} samples are too few, record at least {_FEWEST}")
    step = (time[-1] - time[0]) / (len(time) - 1)
    off = np.abs(time - (time[0] + step * np.arange(len(time))))
    if not off.max() <= _JITTER * step:
        at = int(off.argmax())
        raise RecordingError(
            f"time is {off[at]:.3g} s off equidistant samples at {time[at]:g} s, resample first"
        )
    return float(step)


def resample(time: Array, columns: Array, step: float) -> tuple[Array, Array]:
    """Instants every `step` [s] and the columns (N, ...) there, by a cubic spline.

    The step should not exceed the recorded one: nothing is filtered out before.

    Raises:
        RecordingError: Between two samples lie more than five times the usual.
    """
    from scipy.interpolate import CubicSpline

    as_number(step, "the step", "s", above=0)
    _check_gaps(time)
    count = math.floor((time[-1] - time[0]) / step * (1 + 1e-9)) + 1
    instants = time[0] + step * np.arange(count)
    return instants, CubicSpline(time, columns)(instants)


def low_pass(time: Array, x: Array, cutoff: float, order: int = 4) -> Array:
    """Zero-phase Butterworth low-pass of x (N, ...), forwards and backwards.

    The amplitude at the frequency f is 1 / (1 + (f/cutoff)^(2 order)), 1/2 at the cutoff [Hz].

    Raises:
        InputError: The cutoff is not below half of the sampling frequency.
    """
    from scipy.signal import butter, sosfiltfilt

    step = sampling(time)
    if not 0 < cutoff < 0.5 / step:
        raise InputError(f"cutoff is {cutoff:g} Hz, give one between 0 and {0.5 / step:g} Hz")
    return np.asarray(sosfiltfilt(butter(order, cutoff, output="sos", fs=1 / step), x, axis=0))


def central_differences(time: Array, x: Array) -> Array:
    """(x_k+1 - x_k-1) / (2 dt) of x (N, ...), at the ends one-sided of second order."""
    return np.gradient(x, sampling(time), axis=0, edge_order=2)


def average_periods(time: Array, x: Array, period: float) -> tuple[Array, Array, Array]:
    """Mean over the whole periods of a recording; an incomplete last one is left out.

    Args:
        time: Equidistant instants (N,) [s].
        x: Columns (N, ...).
        period: [s], a multiple of the step.

    Returns:
        Instants (M,) of the first period, mean (M, ...), and its standard error (M, ...), the
        scatter between the K periods over sqrt(K).

    Raises:
        RecordingError: Fewer than two periods, or no multiple of the step.
    """
    step = sampling(time)
    count = round(period / step)
    if count < 1 or abs(count * step - period) > _JITTER * step:
        raise RecordingError(
            f"the period {period:g} s is no multiple of the step {step:g} s, "
            f"resample with the step {period / max(count, 1):.9g} s"
        )
    periods = len(time) // count
    if periods < 2:
        raise RecordingError(
            f"{len(time) * step:g} s hold fewer than two periods of {period:g} s, record longer"
        )
    stacked = x[: periods * count].reshape(periods, count, *x.shape[1:])
    error = stacked.std(axis=0, ddof=1) / math.sqrt(periods)
    return time[:count], stacked.mean(axis=0), error


def filter_rows(
    regressor: Array, forces: Array, step: float, cutoff: float, decimation: int
) -> tuple[Array, Array]:
    """Both sides of forces = regressor parameters through one filter, then every n-th sample.

    The filter is `low_pass`: linear, so the parameters stay what they are. The cutoff may be at
    most a quarter of the new sampling frequency; what decimation folds to below the cutoff then
    comes from above three times the cutoff, where less than 1.6e-4 of it is left.

    Args:
        regressor: (N, n, p).
        forces: (N, n).
        step: [s].
        cutoff: [Hz].
        decimation: One of so many samples is kept, the first of all among them.

    Returns:
        Regressor (M, n, p) and forces (M, n).

    Raises:
        InputError: Something is not finite, or the cutoff too high.
    """
    for name, array in (("regressor", regressor), ("forces", forces)):
        if not np.isfinite(array).all():
            sample = int(np.argwhere(~np.isfinite(array))[0, 0])
            raise InputError(f"{name} is not finite at sample {sample}, cut the recording there")
    highest = 0.25 / (step * decimation)
    if cutoff > highest * (1 + 1e-9):
        raise InputError(
            f"cutoff is {cutoff:g} Hz, give at most {highest:g} Hz for every {decimation}th sample"
        )
    time = step * np.arange(float(len(forces)))
    thinned = np.stack(  # joint by joint, to hold no second whole regressor
        [low_pass(time, regressor[:, i], cutoff)[::decimation] for i in range(forces.shape[1])],
        axis=1,
    )
    return thinned, low_pass(time, forces, cutoff)[::decimation]


def moving(v: Array, threshold: ArrayLike) -> np.ndarray:
    """Where |v| (N, n) exceeds the threshold, one for all or (n,): a mask (N, n).

    Near zero velocity friction is none of the functions that are identified.
    """
    return np.abs(v) > np.asarray(threshold)


def delay(time: Array, one: Array, other: Array) -> float:
    """By how many seconds the second signal (N,) comes after the first, at most 1 s.

    Where the correlation of what overlaps has its maximum, refined by a parabola.
    """
    from scipy.signal import correlate

    step = sampling(time)
    one, other = one - one.mean(), other - other.mean()
    shifts = np.arange(-(reach := min(round(_SEARCHED / step), len(time) // 4)), reach + 1)
    products = correlate(other, one, method="fft")[shifts + len(time) - 1]
    first, second = (np.append(0, np.cumsum(x**2)) for x in (one, other))
    low, high = np.maximum(shifts, 0), len(time) + np.minimum(shifts, 0)
    energy = (first[high - shifts] - first[low - shifts]) * (second[high] - second[low])
    near = products / np.sqrt(energy)
    # of equal ones, as of periodic signals, the shortest
    best = np.flatnonzero(near >= near.max() - _EQUAL)
    at = int(np.clip(best[np.abs(shifts[best]).argmin()], 1, 2 * reach - 1))
    if near[at - 1 : at + 2].argmax() != 1:  # on the slope of the shortest
        up = 1 if near[at + 1] > near[at] else -1
        while 1 < at < 2 * reach - 1 and near[at + up] > near[at]:
            at += up
    before, here, after = near[at - 1 : at + 2]
    bend = before - 2 * here + after
    shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return float((at - reach + shift) * step)


def check(
    time: Array,
    q: Array,
    tau: Array,
    joints: Sequence[str],
    units: Mapping[str, str],
    v: Array | None = None,
    limits: Array | None = None,
    longest_delay: float = 0.05,
) -> None:
    """Refuse a recording that cannot serve an identification.

    Args:
        time: Instants (N,) [s].
        q: Coordinates (N, n).
        tau: Generalized forces (N, n).
        joints: Names (n,).
        units: "rad" or "m" of each coordinate.
        v: Recorded velocities (N, n), compared with those of q.
        limits: Lowest and highest coordinate (n, 2).
        longest_delay: [s] between recorded velocity and q; a filter in the sensor makes some.

    Raises:
        RecordingError: Too few samples, gaps, numbers missing, no motion, wrong units, or
            columns that do not belong together; the message names the column.
    """
    if len(time) < _FEWEST:
        raise RecordingError(f"{len(time)} samples are too few, record at least {_FEWEST}")
    columns = [("", q), ("_force", tau)] + ([] if v is None else [("_velocity", v)])
    for suffix, values in columns:
        for joint, column in zip(joints, values.T, strict=True):
            _check_finite(time, column, joint + suffix)
    _check_gaps(time)
    # Of noise alone, steps between samples have twice its variance.
    if all(np.ptp(x) == 0 or np.var(np.diff(x)) >= np.var(x) for x in q.T):
        raise RecordingError("no joint moves, record a motion")
    for i, joint in enumerate(joints):
        if np.ptp(tau[:, i]) == 0 and np.ptp(q[:, i]) > 0:
            raise RecordingError(f"'{joint}_force' is constant while '{joint}' moves, check it")
        if limits is not None:
            _check_range(q[:, i], limits[i], joint, units[joint])
        if v is not None and np.var(np.diff(q[:, i])) < np.var(q[:, i]):
            _check_velocity(time, q[:, i], v[:, i], joint, units[joint], longest_delay)


def check_forces(
    time: Array, tau: Array, modelled: Array, joints: Sequence[str], longest_delay: float = 0.05
) -> None:
    """Compare recorded forces (N, n) with those of a model, of rough parameters even.

    Raises:
        RecordingError: They differ by more than a factor of thirty, or come late or early.
    """
    for i, joint in enumerate(joints):
        measured, expected = tau[:, i], modelled[:, i]
        if np.ptp(expected) == 0 or np.ptp(measured) == 0:
            continue
        scale = math.sqrt(np.mean(measured**2) / np.mean(expected**2))
        power = math.log10(max(scale, 1e-300))
        if abs(power) > 1.5:
            looks = "look at its unit"
            if 2.3 < abs(power) < 3.7:
                looks = f"it looks {'1000-fold' if power > 0 else 'like kN'}, give SI units"
            raise RecordingError(f"'{joint}_force' is {scale:.3g} times the model's, {looks}")
        late = delay(time, expected, measured)
        # a rough model is believed on a delay only if that explains nearly everything: a force
        # that friction makes looks like inertia's a quarter period later
        if not 0.5 < scale < 2.0:
            continue
        near = _alike(expected, measured, round(late / sampling(time)))
        if abs(late) > longest_delay and near > max(0.9, _alike(expected, measured, 0) + 0.05):
            raise RecordingError(_shifted(f"{joint}_force", late, "its model"))


def _alike(one: Array, other: Array, shift: int) -> float:
    """Correlation of one signal with another that comes so many samples later."""
    count = len(one) - abs(shift)
    late = max(shift, 0), max(-shift, 0)
    return float(np.corrcoef(one[late[1] :][:count], other[late[0] :][:count])[0, 1])


def _check_finite(time: Array, column: Array, name: str) -> None:
    bad = ~np.isfinite(column)
    if bad.any():
        first = int(bad.argmax())
        last = first + int(np.append(~bad[first:], True).argmax()) - 1
        raise RecordingError(
            f"'{name}' holds no number from {time[first]:g} to {time[last]:g} s "
            f"({bad.sum()} samples in all), cut the recording there"
        )


def _check_gaps(time: Array) -> None:
    steps = np.diff(time)
    usual = float(np.median(steps))
    if steps.max() > _LONGEST_GAP * usual:
        at = int(steps.argmax())
        raise RecordingError(
            f"no sample between {time[at]:g} and {time[at + 1]:g} s where the usual step is "
            f"{usual:g} s, cut the recording there"
        )


def _check_range(x: Array, limits: Array, joint: str, unit: str) -> None:
    low, high = limits
    slack = 0.1 * (high - low)

    def inside(values: Array) -> bool:
        return low - slack <= values.min() and values.max() <= high + slack

    if not inside(x):
        other, factor = _OTHER[unit]
        taken = inside(x / factor) and np.ptp(x) > 0.02 * factor * (high - low)
        looks = f"it looks like {other}" if taken else "check its zero and unit"
        raise RecordingError(
            f"'{joint}' goes from {x.min():.4g} to {x.max():.4g} {unit}, its limits are "
            f"{low:.4g} and {high:.4g} {unit}, {looks}"
        )


def _check_velocity(
    time: Array, x: Array, v: Array, joint: str, unit: str, longest_delay: float
) -> None:
    """Compare a velocity with the derivative of its coordinate, both up to 10 Hz."""
    time, columns = resample(time, np.column_stack([x, v]), float(np.median(np.diff(time))))
    step = sampling(time)
    if 0.4 / step > _COMPARED:
        columns = low_pass(time, columns, _COMPARED)
    derivative, v = central_differences(time, columns[:, 0]), columns[:, 1]
    # what is less than a micrometre in the sampled time is noise or rounding, not motion
    if np.std(columns[:, 0]) < 1e-6:
        return
    ratio = math.sqrt(np.mean(v**2) / np.mean(derivative**2))
    other, factor = _OTHER[unit]
    for wrong, scale in ((f"{joint}_velocity", factor), (joint, 1 / factor)):
        if 0.8 < ratio / scale < 1.25:
            raise RecordingError(
                f"'{joint}_velocity' is {ratio:.3g} times the derivative of '{joint}', "
                f"'{wrong}' looks like {other}, give {unit}"
            )
    late = delay(time, derivative, v)
    shift = round(late / step)
    first, second = (derivative, v) if shift >= 0 else (v, derivative)
    overlap = len(v) - abs(shift)
    first, second = first[:overlap], second[abs(shift) :]
    correlation = float(np.corrcoef(first, second)[0, 1]) if np.ptp(v) > 0 else 0.0
    if correlation < 0.7 or not 0.5 < ratio < 2:
        raise RecordingError(
            f"'{joint}_velocity' is not the derivative of '{joint}' (correlation "
            f"{correlation:.2f}, ratio {ratio:.3g}), check the columns"
        )
    if abs(late) > longest_delay:
        raise RecordingError(_shifted(f"{joint}_velocity", late, f"'{joint}'"))


def _shifted(name: str, late: float, reference: str) -> str:
    side = "behind" if late > 0 else "ahead of"
    return f"'{name}' is {abs(late) * 1e3:.0f} ms {side} {reference}, record them with one clock"
