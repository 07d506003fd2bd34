"""From a recording to parameters."""

import fnmatch
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import CraneWarning, InputError, RecordingError, known
from crane.common.samples import Array, as_number, as_sample
from crane.common.threads import on_one_thread
from crane.common.waiting import telling
from crane.identification.estimation.estimators import (
    Estimate,
    Prior,
    conditions,
    huber,
    least_squares,
    weighted,
)
from crane.identification.mechanics.against import (
    check_forces,
    tell_delays,
    tell_shared,
    tell_validation,
)
from crane.identification.mechanics.base import Base, base_parameters
from crane.identification.mechanics.checks import doubt
from crane.identification.mechanics.delays import delays
from crane.identification.mechanics.determined import advice, magnitudes, sizes_of
from crane.identification.mechanics.equations import Equations, Progress, long_enough
from crane.identification.mechanics.feasible import convex
from crane.identification.mechanics.inertias import body_names
from crane.identification.mechanics.laws import Frictional
from crane.identification.mechanics.model import Model
from crane.identification.mechanics.possible import possible
from crane.identification.mechanics.priors import by_name, check_told, checked, stated
from crane.identification.mechanics.reading import smoothed_motion
from crane.identification.mechanics.result import Identification
from crane.identification.mechanics.term import Term
from crane.identification.mechanics.terms import Changes
from crane.identification.mechanics.undriven import settled
from crane.identification.signals.motion import Motion
from crane.identification.signals.spectrum import below
from crane.machine import Machine
from crane.recordings.recording import Recording

Recorded = Recording | Motion
METHODS = {"ols": least_squares, "wls": weighted, "huber": huber}
_SLOW = 0.02  # of a joint's largest velocity, below which its rows are left out
_RESTING = {"rad": 1e-2, "m": 1e-3}  # [rad/s], [m/s] where stiction ends that nobody described
_SETTLED = 4.0  # of the velocity over which friction's sign changes, tanh 4 = 0.9993
_MOVING = 0.5  # of a joint's largest velocity, above which rows count always
_KNOWN = 0.75  # of the frequency where a smoother passes half: there it passes 91 %
_TIMES = 3.0  # times the frequency below which 99 % of the velocities are, the filter's least
_POWER = 0.99
_FAST = 40.0  # times the frequency below which 99 % of the accelerations are
_COMPARED = 50  # rows from which on forces are compared with the model's
_SAMPLES = 500  # at which the speeds of joints are looked at
_PART = 0.3  # of what is left to do that one pass over a recording is taken for


@on_one_thread
def identify(
    machine: Machine,
    recording: Recorded | Sequence[Recorded],
    validation: Recorded | Sequence[Recorded] | None = None,
    method: str = "wls",
    prior: float | Mapping[str, object] | Prior | None = None,
    feasible: bool = False,
    *,
    terms: Sequence[Term] | Changes | None = None,
    bandwidth: float | None = None,
    slow: Mapping[str, float] | ArrayLike | None = None,
    trust: bool = False,
    progress: Progress | None = None,
) -> Identification:
    """Base parameters of a machine from recorded strokes and forces.

    tau_A + gamma^T f = W(q_A, v_A, a_A) beta on both sides of a zero-phase low-pass, thinned;
    rows of a joint near standstill left out. What the machine file says under `identification`
    (terms, prior, bandwidth, slow) counts, with what is given here beside it, or in its place.

    Args:
        machine: The machine, whose geometry is taken as known.
        recording: What to learn from, one or several; a `Motion` if velocities and accelerations
            are known.
        validation: What to be judged by, not learned from, likewise; told where it is too short
            for the low-pass or stands still.
        method: "ols", "wls" (rows of each joint by its noise) or "huber" (robust).
        prior: What is known before, about which the estimate is regularised: by name, such as
            {"bodies": "10 %", "q1.viscous": "200 +- 50"}, see `priors.stated`; the share to which
            all of the description holds; or means and standard deviations (p,) of all
            parameters. All parameters come out then, not only the base parameters.
        feasible: Whether the bodies have to be able to exist and friction must not be negative;
            all parameters come out.
        terms: Of the model; or by name what changes of the usual ones, such as
            {"q*.rotor_inertia": (), "q1.coulomb": None}, see `terms.terms_of`.
        bandwidth: [Hz] of the low-pass; if not given, far above the frequencies of the motion,
            but no higher than the motion is known where noise asked for smoothing, as of a coarse
            potentiometer.
        slow: Velocities below which rows are left out, (n,) or by joint or pattern: a few times
            that over which friction at rest fades. If not given, 4 times the description's
            smoothing and Stribeck velocity, of friction that sticks with neither 0.01 rad/s and
            1 mm/s, or 2 % of a joint's largest.
        trust: Whether a recording that is most likely wrong is taken nevertheless: why it is so
            is told as a warning, and outliers are left in.
        progress: Takes the finished share.

    Returns:
        Parameters, their confidence, and how well they predict both recordings.

    Raises:
        InputError: Arguments that do not fit, or no CVXPY for feasible bodies.
        RecordingError: A recording that cannot serve, and why; one that determines nothing.
    """
    progress = telling(progress)
    if method not in METHODS:
        raise InputError(f"method '{method}' is unknown, {known(METHODS, method)}")
    model = Model(machine, terms)
    if feasible and not model.bodies:
        raise InputError("the model has no bodies, so nothing has to be feasible")
    if feasible:
        convex()  # before all the work
    finished, progress = progress, in_parts(progress)
    tell_shared(_several(recording), _several(validation), trust)
    motions = motions_of(machine, recording, trust, progress)
    rows, told = equations_of(model, motions, bandwidth, slow, progress)
    if model.bodies:
        _check_forces(model, motions, rows, trust)
    selection = rows.selection(told)
    columns = rows.columns(selection)
    sizes = sizes_of(model, told, columns.factors(rows.y, rows.groups))
    before = _prior(model, prior, rows.base, sizes, feasible)
    parameters = None
    pull, T = (None, selection) if feasible else (before, selection)
    if before is None:
        _check_scale(machine, rows)
    elif not feasible:
        T = rows.base.grouping
        check_told(model.names, np.vstack(list(rows.factors[:, :, :-1] @ T)), before)

    def estimated(values: Array) -> tuple[Estimate, Array]:
        nonlocal rows
        rows = rows.at(values) if machine.free else rows
        found = METHODS[method](rows.columns(T), rows.y, rows.groups, rows.samples, pull)
        return found, T @ found.values

    start = rows.base.values(model.nominal)
    estimate = settled(estimated, start) if machine.free else estimated(start)[0]
    values, covariance = estimate.values, estimate.covariance
    if feasible:
        estimate = possible(model, told, rows, selection, estimate, before)
    if feasible or before is not None:
        plain, scaled = conditions(np.vstack(list(rows.factors[:, :, :-1] @ selection)))
        estimate = replace(estimate, condition=plain, scaled_condition=scaled)
        parameters = estimate.values
        values = told.values(parameters)
        covariance = told.grouping @ estimate.covariance @ told.grouping.T
    # what is known of all parameters predicts another motion better than what this one tells
    predicting = selection @ values if parameters is None else rows.base.values(parameters)
    training, judged = rows.compare(predicting), None
    base, bandwidth, limits, remedy = (
        rows.base,
        rows.bandwidth,
        rows.slow,
        advice(machine, motions),
    )
    speeds = _speeds(model, motions, limits)
    del rows, motions
    if validation is not None:
        others = motions_of(machine, validation, trust, progress, "validation")
        judging = [motion for motion in others if long_enough(motion, bandwidth)]
        if judging:
            judge = Equations(model, base, judging, bandwidth, limits, progress)
            judged = judge.compare(predicting) if judge.moving.any() else None
        if judged is None or len(judging) < len(others):
            _tell_short(others, judging, bandwidth)
        if judged is not None:
            tell_validation(training, judged)
    if finished is not None:
        finished(1.0)
    found = Identification(
        model, told, values, covariance, parameters, estimate, method, feasible, training,
        magnitudes(told, sizes), remedy, speeds, bandwidth, limits, judged,
    )  # fmt: skip
    if all(mark == "not determined" for mark in found.marks):
        doubt(found.doubt, trust)
    elif found.doubt:
        warnings.warn(found.doubt, CraneWarning, stacklevel=3)
    return found


def _check_scale(machine: Machine, rows: Equations) -> None:
    """See that not all forces are known to be zero.

    Raises:
        RecordingError: They are.
    """
    if machine.free and not rows.y.any():
        body = body_names(machine)[-1]
        raise RecordingError(
            "nothing drives what moves in this recording: it tells ratios of masses, not masses; "
            f"say what one is known to be, as prior={{'{body}.m': '100 +- 1'}} "
            f"(--prior {body}.m=100+-1)"
        )


def _tell_short(others: Sequence[Motion], judging: Sequence[Motion], bandwidth: float) -> None:
    """Warn of validations that judge nothing."""
    short = len(others) - len(judging)
    text = (
        f"{short} of {len(others)} validations are too short for a low-pass of {bandwidth:g} Hz "
        "and judge nothing"
        if short
        else "no validation moves faster than what counts as standstill, nothing is judged"
    )
    warnings.warn(f"{text}, give longer ones that move", CraneWarning, stacklevel=4)


def equations_of(
    model: Model,
    motions: Sequence[Motion],
    bandwidth: float | None = None,
    slow: Mapping[str, float] | ArrayLike | None = None,
    progress: Progress | None = None,
) -> tuple[Equations, Base]:
    """Equations of motions, and what of the base parameters they tell.

    Arguments and errors as for `identify`.
    """
    if bandwidth is None:
        bandwidth = model.machine.estimation.bandwidth or min(map(_bandwidth, motions))
    bandwidth = as_number(bandwidth, "the bandwidth", "Hz", above=0)
    fastest = np.max([np.abs(motion.v).max(axis=0) for motion in motions], axis=0)
    limits = _slow(model.machine, slow, fastest)
    rows = Equations(model, base_parameters(model), motions, bandwidth, limits, progress)
    if not rows.moving.any():
        raise RecordingError("no joint moves faster than what counts as standstill, move it more")
    for joint, count in zip(model.machine.active, rows.moving.sum(axis=0), strict=True):
        if count == 1:  # which tells nothing of its noise
            raise RecordingError(
                f"'{joint}' is in one sample only faster than what counts as standstill, move it "
                "more, or raise its slow"
            )
    # of columns, the triangular factors tell what all rows tell
    return rows, rows.base.narrowed(np.vstack(list(rows.factors[:, :, :-1])))


def _prior(
    model: Model,
    given: float | Mapping[str, object] | Prior | None,
    base: Base,
    sizes: Array,
    feasible: bool,
) -> Prior | None:
    """Means and standard deviations (p,) of all parameters; None where nothing is known."""
    known = dict(model.machine.estimation.prior)
    if given is not None:
        if not isinstance(given, Mapping | int | float):
            return checked(model, base, given, feasible)
        told = by_name(given)  # after what the machine file says, also of the same name
        known = {name: what for name, what in known.items() if name not in told} | told
    return stated(model, known, sizes) if known else None


def motions_of(
    machine: Machine,
    recorded: Recorded | Sequence[Recorded],
    trust: bool,
    progress: Progress | None,
    what: str = "",
) -> list[Motion]:
    """Recordings with velocities and accelerations; motions as they are.

    Raises:
        InputError: There are none.
        RecordingError: One cannot serve; the message says which, if there are several.
    """
    several = _several(recorded)
    if not several:
        raise InputError("no recording is given, give at least one")
    found = []
    for number, one in enumerate(several, start=1):
        try:
            if not isinstance(one, Motion):
                one = smoothed_motion(machine, one, trust=trust, progress=progress)
        except RecordingError as error:
            if not what and len(several) == 1:
                raise
            which = f"{what or 'recording'} {number} of {len(several)}"
            raise RecordingError(f"{which}: {error}") from None
        found.append(one)
    return found


def _several(recorded: Recorded | Sequence[Recorded] | None) -> list[Recorded]:
    if recorded is None:
        return []
    return [recorded] if isinstance(recorded, Recording | Motion) else list(recorded)


def _check_forces(model: Model, motions: Sequence[Motion], rows: Equations, trust: bool) -> None:
    """Doubts about the forces of recordings, by what the model can say."""
    modelled, first = rows.compare(rows.base.values(model.nominal)).modelled, 0
    for motion, thinned in zip(motions, rows.thinned(), strict=True):
        here = modelled[first : first + len(thinned.time)]
        if len(here) >= _COMPARED:
            check_forces(thinned, here, model.machine.active, trust=trust)
        tell_delays(model.machine.active, *delays(model, rows.base, motion, rows.slow))
        first += len(here)


def _speeds(
    model: Model, motions: Sequence[Motion], slow: Array
) -> dict[str, tuple[float, float]]:
    """Least and largest speed along each direction of friction, of so many samples."""
    directions = {x.direction.name: x.direction for x in model.terms if isinstance(x, Frictional)}
    fastest = dict.fromkeys(directions, 0.0)
    for motion in motions:
        some = slice(None, None, max(1, len(motion.time) // _SAMPLES))
        at = model.samples(motion.q[some], motion.v[some], motion.a[some])
        for name, direction in directions.items():
            speed = np.einsum("ij,ij->i", direction.rows(model.machine, at), at.v_a)
            fastest[name] = max(fastest[name], float(np.abs(speed).max()))
    least = dict(zip(model.machine.active, slow.tolist(), strict=True))
    return {name: (least.get(name, _SLOW * most), most) for name, most in fastest.items()}


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
    if slow is not None and not isinstance(slow, Mapping):
        each = np.full(out.shape, slow) if np.ndim(slow) == 0 else slow
        each = as_sample(each, len(out), "slow", machine.active)
        slow = dict(zip(machine.active, each.tolist(), strict=True))
    for name, value in (*machine.estimation.slow.items(), *(slow or {}).items()):
        joints = fnmatch.filter(machine.active, name)
        if not joints and name not in machine.locks:
            raise InputError(f"slow is for '{name}', {known(machine.active, name)}")
        if (limit := as_number(value, f"slow of '{name}'", "")) < 0:
            raise InputError(f"slow of '{name}' is {limit:g}, it must not be negative")
        out[[machine.active.index(joint) for joint in joints]] = limit
    return out


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
