"""From a recording to parameters."""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import CraneWarning, InputError, RecordingError, known
from crane.common.samples import Array, as_number
from crane.identification.estimation.estimators import (
    Prior,
    conditions,
    huber,
    least_squares,
    weighted,
)
from crane.identification.mechanics.base import Base, base_parameters
from crane.identification.mechanics.checks import (
    check,
    check_forces,
    check_samples,
    doubt,
    tell_delays,
    tell_hum,
    tell_validation,
    without_outliers,
)
from crane.identification.mechanics.delays import delays, motion_frequency
from crane.identification.mechanics.determined import advice, magnitudes
from crane.identification.mechanics.equations import Equations, Progress
from crane.identification.mechanics.model import Model, Term
from crane.identification.mechanics.possible import possible, prior_of_bodies
from crane.identification.mechanics.priors import check_told, checked
from crane.identification.mechanics.result import Identification
from crane.identification.signals.motion import Derivatives, Motion, differentiate, resample
from crane.identification.signals.outliers import outliers, repaired
from crane.machine import Machine
from crane.recordings.measured import moved_locks
from crane.recordings.recording import FORCE, Recording

METHODS = {"ols": least_squares, "wls": weighted, "huber": huber}
_SLOW = 0.02  # of a joint's largest velocity, below which its rows are left out
_SETTLED = 4.0  # of the velocity over which friction's sign changes, tanh 4 = 0.9993
_MOVING = 0.5  # of a joint's largest velocity, above which rows count always
_MOVES = 3.0  # standard deviations of a joint's velocity, above which it moves
_KNOWN = 0.75  # of the frequency where a smoother passes half: there it passes 91 %
_TIMES = 3.0  # times the frequency below which 99 % of the velocities are, the filter's least
_FAST = 40.0  # times the frequency below which 99 % of the accelerations are
_HUM = 10.0  # times the frequency of the motion, above which a line in a spectrum is hum
_PART = 0.3  # of what is left to do that one pass over a recording is taken for


def motion_of(
    machine: Machine,
    recording: Recording,
    derivatives: str = "kalman",
    cutoff: float | None = None,
    trust: bool = False,
    progress: Progress | None = None,
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
        progress: Takes the finished share.

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
    del v, raw
    step = float(np.median(np.diff(time)))
    columns = np.column_stack([q, tau])
    if np.abs(np.diff(time) - step).max() > 1e-3 * step:
        time, columns = resample(time, columns, step)
    q, tau = np.split(columns, 2, axis=1)
    lowest = _HUM * motion_frequency(q, step)
    tell_hum(time, dict(zip(names, columns.T, strict=True)), lowest)
    found = differentiate(time, q, derivatives, cutoff, progress)
    return Motion(time, found.q, found.v, found.a, tau, _passed(found))


def _passed(found: Derivatives) -> float:
    """Least of the frequencies [Hz] of which half is left, of the joints that move."""
    if found.passed is None:
        return math.inf
    if found.std_v is None:
        return float(found.passed.min())
    moves = found.v.std(axis=0) > _MOVES * np.sqrt(np.mean(found.std_v**2, axis=0))
    return float(found.passed[moves].min(initial=math.inf))


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
    progress: Progress | None = None,
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
        bandwidth: [Hz] of the low-pass; if not given, far above the frequencies of the motion,
            but no higher than the motion is known where noise asked for smoothing, as of a coarse
            potentiometer.
        slow: Velocities below which rows are left out, (n,) or by joint: a few times that over
            which friction at rest fades. If not given, 4 times the description's smoothing and
            Stribeck velocity, or 2 % of a joint's largest.
        trust: Whether a recording that is most likely wrong is taken nevertheless: why it is so
            is told as a warning, and outliers are left in.
        progress: Takes the finished share.

    Returns:
        Parameters, their confidence, and how well they predict both recordings.

    Raises:
        InputError: Arguments that do not fit.
        RecordingError: A recording that cannot serve, and why.
    """
    if method not in METHODS:
        raise InputError(f"method '{method}' is unknown, {known(METHODS, method)}")
    model = Model(machine, terms)
    if feasible and not model.bodies:
        raise InputError("the model has no bodies, so nothing has to be feasible")
    finished, progress = progress, in_parts(progress)
    motion = _motion(machine, recording, trust, progress)
    rows, told = equations_of(model, motion, bandwidth, slow, progress)
    if model.bodies:
        _check_forces(model, motion, rows, trust)
    selection = rows.selection(told)
    if isinstance(prior, int | float):
        prior = prior_of_bodies(model, prior)
    elif prior is not None:
        prior = checked(model, rows.base, prior, feasible)
    parameters = None
    columns = rows.columns(selection)
    if prior is None or feasible:
        estimate = METHODS[method](columns, rows.y, rows.groups, rows.samples)
    else:
        every = rows.columns(selection @ told.grouping)
        told_by = np.vstack(list(rows.factors[:, :, :-1] @ selection @ told.grouping))
        check_told(model.names, told_by, prior)
        estimate = METHODS[method](every, rows.y, rows.groups, rows.samples, prior)
    values, covariance = estimate.values, estimate.covariance
    if feasible:
        estimate = possible(model, told, rows, selection, estimate, prior)
    if feasible or prior is not None:
        plain, scaled = conditions(np.vstack(list(rows.factors[:, :, :-1] @ selection)))
        estimate = replace(estimate, condition=plain, scaled_condition=scaled)
        parameters = estimate.values
        values = told.values(parameters)
        covariance = told.grouping @ estimate.covariance @ told.grouping.T
    training, judged = rows.compare(selection @ values), None
    size = magnitudes(model, told, columns.factors(rows.y, rows.groups))
    base, bandwidth, limits = rows.base, rows.bandwidth, rows.slow
    del rows, columns
    if validation is not None:
        other = _motion(machine, validation, trust, progress)
        judge = Equations(model, base, other, bandwidth, limits, progress)
        judged = judge.compare(selection @ values)
        tell_validation(training, judged)
    if finished is not None:
        finished(1.0)
    found = Identification(
        model, told, values, covariance, parameters, estimate, method, feasible, training, size,
        advice(machine, motion), judged,
    )  # fmt: skip
    if found.doubt:
        warnings.warn(found.doubt, CraneWarning, stacklevel=2)
    return found


def equations_of(
    model: Model,
    motion: Motion,
    bandwidth: float | None = None,
    slow: Mapping[str, float] | ArrayLike | None = None,
    progress: Progress | None = None,
) -> tuple[Equations, Base]:
    """Equations of a motion, and what of the base parameters it tells.

    Arguments and errors as for `identify`.
    """
    if bandwidth is None:
        bandwidth = _bandwidth(motion)
    bandwidth = as_number(bandwidth, "the bandwidth", "Hz", above=0)
    limits = _slow(model.machine, slow, np.abs(motion.v).max(axis=0))
    rows = Equations(model, base_parameters(model), motion, bandwidth, limits, progress)
    if not rows.moving.any():
        raise RecordingError("no joint moves faster than what counts as standstill, move it more")
    # of columns, the triangular factors tell what all rows tell
    return rows, rows.base.narrowed(np.vstack(list(rows.factors[:, :, :-1])))


def _motion(
    machine: Machine, recording: Recording | Motion, trust: bool, progress: Progress | None
) -> Motion:
    if isinstance(recording, Motion):
        return recording
    return motion_of(machine, recording, trust=trust, progress=progress)


def _check_forces(model: Model, motion: Motion, rows: Equations, trust: bool) -> None:
    """Doubts about the forces of a recording, by what the model can say."""
    modelled = rows.compare(rows.base.values(model.nominal)).modelled
    check_forces(rows.thinned(), modelled, model.machine.active, trust=trust)
    tell_delays(model.machine.active, *delays(model, rows.base, motion, rows.slow))


def in_parts(progress: Progress | None) -> Progress | None:
    """One bar for passes whose number is not known: each takes a share of what is left."""
    if progress is None:
        return None
    done = 0.0

    def report(share: float) -> None:
        nonlocal done
        now = done + _PART * (1 - done) * share
        progress(now)
        if share >= 1:
            done = now

    return report


def _slow(machine: Machine, slow: Mapping[str, float] | ArrayLike | None, fastest: Array) -> Array:
    """Velocities (n,) below which rows are left out.

    If not given, a share of the largest, or where the described friction comes from rest to what
    it is in motion, which it does in reality at velocities that nobody knows better.
    """
    out = _SLOW * fastest
    for i, joint in enumerate(machine.active):
        law = machine.friction.get(joint)
        if law is not None:
            near = max(_SETTLED * law.smoothing, _SETTLED * law.stribeck * (law.stiction > 0))
            out[i] = max(out[i], min(near, _MOVING * fastest[i]))
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
    """[Hz] of the low-pass, far above the frequencies of the motion where it is measured well.

    What is modelled lies below it; above it is noise, which has to be seen to be known. But what
    smoothing takes from the accelerations is missing in the regressor and not in the forces, most
    at reversals, where friction jumps: so no higher than smoothing lets through, unless that is
    hardly above the motion.
    """
    step = float(motion.time[1] - motion.time[0])
    highest = max(_KNOWN * motion.passed, _TIMES * _fastest(motion.v, step))
    return min(_FAST * _fastest(motion.a, step), highest, 0.24 / step)


def _fastest(x: Array, step: float) -> float:
    """Frequency [Hz] below which 99 % of the power of each of the signals (N, n) is."""
    from scipy.signal import periodogram

    size = np.maximum(x.std(axis=0), 1e-300)
    frequency, power = periodogram(x / size, 1 / step, axis=0, window="hann")
    share = np.cumsum(power, axis=0)
    last = [
        float(frequency[np.searchsorted(column, 0.99 * column[-1])])
        for column, moved in zip(share.T, np.ptp(x, axis=0), strict=True)
        if moved > 0
    ]
    return max([*last, float(frequency[1])])
