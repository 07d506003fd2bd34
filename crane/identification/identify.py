"""From a recording to parameters."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from crane.errors import InputError, RecordingError, known
from crane.identification.base import Base, base_parameters
from crane.identification.checks import (
    check,
    check_forces,
    check_samples,
    doubt,
    tell_delays,
    tell_hum,
    tell_validation,
    without_outliers,
)
from crane.identification.delays import delays, motion_frequency
from crane.identification.estimators import Prior, conditions, huber, least_squares, weighted
from crane.identification.feasible import feasible as feasible_estimate
from crane.identification.feasible import pseudo_inertia
from crane.identification.model import Model, Samples, Term
from crane.identification.outliers import outliers, repaired
from crane.identification.priors import check_told, checked
from crane.identification.result import Comparison, Identification
from crane.identification.signals import (
    Motion,
    differentiate,
    filter_rows,
    moving,
    resample,
)
from crane.machine import Machine
from crane.measured import moved_locks
from crane.recording import FORCE, Recording
from crane.samples import Array, as_number

METHODS = {"ols": least_squares, "wls": weighted, "huber": huber}
_SLOW = 0.02  # of a joint's largest velocity, below which its rows are left out
_FAST = 40.0  # times the frequency below which 99 % of the accelerations are
_FEWEST = 5.0  # periods of the filter's cutoff in a recording
_MOVES = 10.0  # times the frequency of the motion, above which a line in a spectrum is hum
_EXACT = 1e-4  # of the forces, noise that a feasible estimate counts with at least
_PRIORS = 1e-7, 1e6  # above and up to which a relative standard deviation lies
_PRIOR = 0.3  # relative standard deviation of a body towards which a feasible estimate is drawn
_THICKNESS = 0.05  # of a body's size, added to what is thinner in a prior


@dataclass(frozen=True, eq=False)
class _Rows:
    """Equations of a recording, filtered and thinned: y = W beta.

    Attributes:
        time: (M,) [s].
        W: (M, n, r).
        y: (M, n).
        offset: (M, n) forces that no parameter changes, to be added to W beta.
        moving: (M, n).
    """

    time: Array
    W: Array
    y: Array
    offset: Array
    moving: np.ndarray

    def stacked(self) -> tuple[Array, Array, np.ndarray, np.ndarray]:
        """Rows that count, joint after joint: W (m, r), y (m,), joint and instant of each."""
        joint, instant = np.nonzero(self.moving.T)
        _, group = np.unique(joint, return_inverse=True)
        return self.W[instant, joint], self.y[instant, joint], group, instant


def motion_of(
    machine: Machine,
    recording: Recording,
    derivatives: str = "kalman",
    cutoff: float | None = None,
    trust: bool = False,
) -> Motion:
    """Velocities and accelerations of a recording, which is checked first.

    Outliers are bridged by lines between their neighbours, before anything is filtered.

    Args:
        machine: What was recorded.
        recording: With all active joints of the machine.
        derivatives: "kalman" or "lowpass", see `signals.differentiate`.
        cutoff: [Hz] of "lowpass".
        trust: Whether what is most likely wrong with the recording is only told, and outliers
            are left in.

    Raises:
        RecordingError: What is recorded cannot serve; the message names column and time.
    """
    missing = [joint for joint in machine.active if joint not in recording.joints]
    if missing:
        listed = ", ".join(f"'{joint}'" for joint in missing)
        held = " ".join(f"--lock {joint}=VALUE" for joint in missing)
        raise RecordingError(
            f"{listed} of '{machine.name}' not recorded, {known(recording.joints)}; lock what was "
            f"held ({held})"
        )
    order = [recording.joints.index(joint) for joint in machine.active]
    q, v, tau = (x[:, order] for x in (recording.q, recording.v, recording.tau))
    for joint in machine.active:
        if recording.units[joint] != machine.unit(joint):
            raise RecordingError(
                f"'{joint}' is recorded in {recording.units[joint]}, give {machine.unit(joint)}"
            )
    limits = np.column_stack([machine.lower, machine.upper])
    bounded = limits if np.isfinite(limits).all() else None
    units = {joint: machine.unit(joint) for joint in machine.active}
    time = recording.time
    every = {x: column for x, column in recording.columns().items() if x in machine.locks}
    for text in moved_locks(machine, every, recording.units | recording.channel_units):
        doubt(f"{text}, do not lock it, or lock it where it is", trust)
    names = [x + suffix for suffix in ("", FORCE) for x in machine.active]
    raw = dict(zip(names, np.column_stack([q, tau]).T, strict=True))
    check_samples(time, raw)
    raw = without_outliers(time, raw, trust)
    q, tau = np.split(np.column_stack(list(raw.values())), 2, axis=1)
    if np.any(v):  # only compared; where no velocities were recorded, derivatives of outliers
        v = np.column_stack([repaired(x, outliers(x)) for x in v.T])
    check(time, q, tau, machine.active, units, v if np.any(v) else None, bounded, trust=trust)
    step = float(np.median(np.diff(time)))
    columns = np.column_stack([q, tau])
    if np.abs(np.diff(time) - step).max() > 1e-3 * step:
        time, columns = resample(time, columns, step)
    q, tau = np.split(columns, 2, axis=1)
    lowest = _MOVES * motion_frequency(q, step)
    tell_hum(time, dict(zip(names, columns.T, strict=True)), lowest)
    found = differentiate(time, q, derivatives, cutoff)
    return Motion(time, found.q, found.v, found.a, tau)


def identify(
    machine: Machine,
    recording: Recording | Motion,
    validation: Recording | Motion | None = None,
    method: str = "wls",
    prior: float | Prior | None = None,
    feasible: bool = False,
    *,
    terms: Sequence[Term] | None = None,
    bandwidth: float | None = None,
    slow: Mapping[str, float] | ArrayLike | None = None,
    trust: bool = False,
) -> Identification:
    """Base parameters of a machine from recorded strokes and forces.

    tau_A + gamma^T f = W(q_A, v_A, a_A) beta on both sides of a zero-phase low-pass, thinned;
    rows of a joint near standstill left out.

    Args:
        machine: The machine, whose geometry is taken as known.
        recording: What to learn from; a `Motion` if velocities and accelerations are known.
        validation: What to be judged by, not learned from.
        method: "ols", "wls" (rows of each joint by its noise) or "huber" (robust).
        prior: Relative standard deviation of the bodies of the machine's description, about
            which the estimate is regularised; or means and standard deviations (p,) of all
            parameters. All parameters come out then, not only the base parameters.
        feasible: Whether the bodies have to be able to exist and friction must not be negative;
            all parameters come out.
        terms: Of the model; bodies and friction if not given, see `model.default_terms`.
        bandwidth: [Hz] of the low-pass; far above the frequencies of the motion if not given.
            Lower where the motion is measured badly, as by a coarse potentiometer.
        slow: Velocities below which rows are left out, (n,) or by joint; a share of a joint's
            largest if not given. A few times that over which friction at rest fades.
        trust: Whether a recording that is most likely wrong is taken nevertheless: why it is so
            is told as a warning, and outliers are left in.

    Returns:
        Parameters, their confidence, and how well they predict both recordings.

    Raises:
        InputError: Arguments that do not fit.
        RecordingError: A recording that cannot serve, and why.
    """
    if method not in METHODS:
        raise InputError(f"method '{method}' is unknown, {known(METHODS, method)}")
    model = Model(machine, terms)
    motion = _motion(machine, recording, trust)
    base = base_parameters(model)
    if bandwidth is None:
        bandwidth = _bandwidth(motion)
    bandwidth = as_number(bandwidth, "the bandwidth", "Hz", above=0)
    fastest = np.abs(motion.v).max(axis=0)
    limits = _slow(machine, slow, fastest)
    rows = _equations(model, base, motion, bandwidth, limits)
    if model.bodies:
        _check_forces(model, base, motion, rows, limits, trust)
    W, y, groups, instants = rows.stacked()
    if not len(y):
        raise RecordingError("no joint moves faster than what counts as standstill, move it more")
    told = base.narrowed(W)
    picked = np.searchsorted(base.independent, told.independent)
    if isinstance(prior, int | float):
        prior = prior_of_bodies(model, prior)
    elif prior is not None:
        prior = checked(model, base, prior, feasible)
    parameters = None
    if feasible:
        estimate = METHODS[method](W[:, picked], y, groups, instants)
        parameters = _possible(model, told, W[:, picked], y, estimate.noise[groups], prior)
        values, covariance = told.values(parameters), estimate.covariance
    elif prior is not None:
        check_told(model.names, W[:, picked] @ told.grouping, prior)
        estimate = METHODS[method](W[:, picked] @ told.grouping, y, groups, instants, prior)
        plain, scaled = conditions(W[:, picked])
        estimate = replace(estimate, condition=plain, scaled_condition=scaled)
        parameters = estimate.values
        values = told.values(parameters)
        covariance = told.grouping @ estimate.covariance @ told.grouping.T
    else:
        estimate = METHODS[method](W[:, picked], y, groups, instants)
        values, covariance = estimate.values, estimate.covariance

    def compare(rows: _Rows) -> Comparison:
        modelled = rows.W[:, :, picked] @ values + rows.offset
        return Comparison(rows.time, rows.y + rows.offset, modelled, rows.moving, machine.active)

    judged = None
    if validation is not None:
        other = _motion(machine, validation, trust)
        judged = compare(_equations(model, base, other, bandwidth, limits))
        tell_validation(compare(rows), judged)
    return Identification(
        model, told, values, covariance, parameters, estimate, method, feasible,
        compare(rows), judged,
    )  # fmt: skip


def _motion(machine: Machine, recording: Recording | Motion, trust: bool) -> Motion:
    if isinstance(recording, Motion):
        return recording
    return motion_of(machine, recording, trust=trust)


def _check_forces(
    model: Model, base: Base, motion: Motion, rows: _Rows, slow: Array, trust: bool
) -> None:
    """Doubts about the forces of a recording, by what the model can say."""
    every = max(1, round((rows.time[1] - rows.time[0]) / (motion.time[1] - motion.time[0])))
    thinned = Motion(
        rows.time, motion.q[::every], motion.v[::every], motion.a[::every], rows.y + rows.offset
    )
    modelled = rows.W @ base.values(model.nominal) + rows.offset
    check_forces(thinned, modelled, model.machine.active, trust=trust)
    tell_delays(model.machine.active, *delays(model, base, motion, slow))


def _equations(
    model: Model, base: Base, motion: Motion, bandwidth: float, slow: ArrayLike
) -> _Rows:
    """Both sides at the samples of a motion, filtered and thinned."""
    from scipy.ndimage import binary_dilation

    at: Samples = model.samples(motion.q, motion.v, motion.a)
    W = model.regressor(at)[:, :, base.independent]
    offset = model.known(at)
    step = float(motion.time[1] - motion.time[0])
    duration = float(motion.time[-1] - motion.time[0])
    if bandwidth * duration < _FEWEST:
        raise InputError(
            f"a bandwidth of {bandwidth:g} Hz leaves nothing of {duration:g} s, give at least "
            f"{_FEWEST / duration:.2g} Hz"
        )
    thinning = max(1, int(0.25 / (step * bandwidth)))
    both = np.concatenate([W, offset[:, :, None]], axis=2)
    if bandwidth * step < 0.25:
        both, tau = filter_rows(both, motion.tau, step, bandwidth, thinning)
    else:
        tau, thinning = motion.tau, 1
    W, offset = both[:, :, :-1], both[:, :, -1]
    # near standstill friction is none of its shapes, as far as the filter carries it
    stuck = ~moving(motion.v, slow)
    reach = round(0.5 / (step * bandwidth))
    window = np.ones((2 * reach + 1, 1), dtype=bool)
    kept = ~binary_dilation(stuck, window)[::thinning]
    return _Rows(motion.time[::thinning], W, tau - offset, offset, kept)


def _slow(machine: Machine, slow: Mapping[str, float] | ArrayLike | None, fastest: Array) -> Array:
    """Velocities (n,) below which rows are left out."""
    out = _SLOW * fastest
    if isinstance(slow, Mapping):
        for joint, value in slow.items():
            if joint not in machine.active:
                raise InputError(f"slow is for '{joint}', {known(machine.active, joint)}")
            if (limit := as_number(value, f"slow of '{joint}'", "")) < 0:
                raise InputError(f"slow of '{joint}' is {limit:g}, it must not be negative")
            out[machine.active.index(joint)] = limit
        return out
    return out if slow is None else np.broadcast_to(np.asarray(slow, np.float64), out.shape)


def _bandwidth(motion: Motion) -> float:
    """Far above the frequency below which 99 % of the accelerations' power is [Hz].

    What is modelled lies below it; above it is noise, which has to be seen to be known.
    """
    from scipy.signal import periodogram

    step = float(motion.time[1] - motion.time[0])
    size = np.maximum(motion.a.std(axis=0), 1e-300)
    frequency, power = periodogram(motion.a / size, 1 / step, axis=0, window="hann")
    share = np.cumsum(power, axis=0)
    last = max(
        float(frequency[np.searchsorted(column, 0.99 * column[-1])])
        for column, a in zip(share.T, motion.a.T, strict=True)
        if np.ptp(a) > 0
    )
    return min(_FAST * max(last, frequency[1]), 0.24 / step)


def prior_of_bodies(model: Model, relative: float) -> Prior:
    """Bodies as described, each known to a share of its mass and size; of others nothing.

    Returns:
        Means (p,) and standard deviations (p,), infinite for what is no body.

    Raises:
        InputError: The share is not from 1e-7 to 1e6.
    """
    relative = as_number(relative, "the prior's relative standard deviation", "", *_PRIORS)
    std = np.full(len(model.names), np.inf)
    for i in range(len(model.bodies)):
        mass, length = _size(model.nominal[10 * i : 10 * i + 10])
        units = np.array([1.0, *[length] * 3, *[length**2] * 6])
        std[10 * i : 10 * i + 10] = relative * mass * units
    mean = np.where(np.isfinite(std), model.nominal, 0.0)
    return mean, std


def _size(body: Array) -> tuple[float, float]:
    """Mass, and the root of the mean square distance of the mass from the joint's origin."""
    P = pseudo_inertia(body)
    return float(body[0]), float(np.sqrt(max(np.trace(P[:3, :3]), 0.0) / body[0]))


def _possible(
    model: Model, base: Base, W: Array, y: Array, noise: Array, prior: Prior | None
) -> Array:
    """All parameters, with bodies that can exist."""
    if not model.bodies:
        raise InputError("the model has no bodies, so nothing has to be feasible")
    count = 10 * len(model.bodies)
    mean, weight = model.nominal.copy(), _PRIOR**-2
    spread = np.full(len(mean) - count, np.inf)
    if prior is not None:
        mean = prior[0].copy()
        spread = prior[1][count:]
        sizes = [_size(mean[i : i + 10])[0] for i in range(0, count, 10)]
        weight = float(np.median(prior[1][:count:10] / sizes)) ** -2
    for i in range(0, count, 10):
        mean[i : i + 10] = _thick(mean[i : i + 10])
    signs = [i for i, sign in enumerate(model.signs) if sign and i >= count]
    size = np.sqrt(np.mean(y**2))
    noise = np.maximum(noise, _EXACT * size)
    # none of the others makes more than all of the force; without that, two that do the same in
    # this motion may grow without end
    alone = np.sqrt(np.mean((W @ base.grouping[:, count:]) ** 2, axis=0))
    spread = np.minimum(spread, size / np.where(alone > 0, alone, size))
    found = feasible_estimate(
        W @ base.grouping, y, 1 / noise, model.bodies, mean, weight, spread, signs
    )
    return found.values


def _thick(body: Array) -> Array:
    """A body at least a share of its size thick in every direction.

    Rods and plates without thickness lie on the edge of what can exist.
    """
    from crane.identification.feasible import body_parameters

    P = pseudo_inertia(body)
    mass, length = _size(body)
    com = P[:3, 3] / mass
    second = P[:3, :3] - mass * np.outer(com, com)
    values, axes = np.linalg.eigh(second)
    least = mass * (_THICKNESS * length) ** 2
    P[:3, :3] = axes @ np.diag(np.maximum(values, least)) @ axes.T + mass * np.outer(com, com)
    return body_parameters(P)
