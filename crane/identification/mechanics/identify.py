"""From a recording to parameters."""

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
from crane.identification.mechanics.against import check_forces, tell_delays, tell_validation
from crane.identification.mechanics.base import Base, base_parameters
from crane.identification.mechanics.delays import delays
from crane.identification.mechanics.determined import advice, magnitudes
from crane.identification.mechanics.equations import Equations, Progress
from crane.identification.mechanics.model import Model, Term
from crane.identification.mechanics.possible import possible, prior_of_bodies
from crane.identification.mechanics.priors import check_told, checked
from crane.identification.mechanics.reading import smoothed_motion
from crane.identification.mechanics.result import Identification
from crane.identification.signals.motion import Motion
from crane.identification.signals.spectrum import below
from crane.machine import Machine
from crane.recordings.recording import Recording

METHODS = {"ols": least_squares, "wls": weighted, "huber": huber}
_SLOW = 0.02  # of a joint's largest velocity, below which its rows are left out
_RESTING = {"rad": 1e-2, "m": 1e-3}  # [rad/s], [m/s] where stiction ends that nobody described
_SETTLED = 4.0  # of the velocity over which friction's sign changes, tanh 4 = 0.9993
_MOVING = 0.5  # of a joint's largest velocity, above which rows count always
_KNOWN = 0.75  # of the frequency where a smoother passes half: there it passes 91 %
_TIMES = 3.0  # times the frequency below which 99 % of the velocities are, the filter's least
_POWER = 0.99
_FAST = 40.0  # times the frequency below which 99 % of the accelerations are
_PART = 0.3  # of what is left to do that one pass over a recording is taken for


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
            Stribeck velocity, of friction that sticks with neither 0.01 rad/s and 1 mm/s, or 2 %
            of a joint's largest.
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
    base, bandwidth, limits, remedy = rows.base, rows.bandwidth, rows.slow, advice(machine, motion)
    del rows, columns, motion
    if validation is not None:
        other = _motion(machine, validation, trust, progress)
        judge = Equations(model, base, other, bandwidth, limits, progress)
        judged = judge.compare(selection @ values)
        tell_validation(training, judged)
    if finished is not None:
        finished(1.0)
    found = Identification(
        model, told, values, covariance, parameters, estimate, method, feasible, training, size,
        remedy, judged,
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
    return smoothed_motion(machine, recording, trust=trust, progress=progress)


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
            turns = law.smoothing or (_RESTING[machine.unit(joint)] if law.sticks else 0.0)
            near = _SETTLED * (max(law.stribeck, law.smoothing) if law.stiction else turns)
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
    found = [
        below(_POWER, column / max(column.std(), 1e-300), step)
        for column in x.T
        if np.ptp(column) > 0
    ]
    return max(found, default=1 / (len(x) * step))
