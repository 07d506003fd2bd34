"""Identification of base parameters from recordings."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import CraneWarning, InputError, RecordingError, check_name
from crane.common.optional_libraries import is_installed
from crane.common.progress import Progress, ignore_progress, progress_reporter
from crane.common.samples import Array, as_number
from crane.common.threads import with_single_threaded_blas
from crane.description.estimation_settings import ParameterPrior
from crane.identification.estimation.estimators import (
    Prior,
    condition_numbers,
    huber,
    least_squares,
    weighted_least_squares,
)
from crane.identification.mechanics.base_parameters import BaseParameters, base_parameters
from crane.identification.mechanics.feasible_parameters import (
    feasible_estimate,
    load_convex_solver,
)
from crane.identification.mechanics.force_comparison import (
    ForceComparison,
    check_forces,
    check_shared_samples,
    warn_validation,
)
from crane.identification.mechanics.force_delays import ForceDelays, force_delays
from crane.identification.mechanics.identifiability import (
    check_identifiable,
    check_prior,
    motion_advice,
    parameter_magnitudes,
    prior_from_names,
)
from crane.identification.mechanics.identification_model import IdentificationModel, TermChanges
from crane.identification.mechanics.identification_result import Identification
from crane.identification.mechanics.model_terms import ModelTerm, body_names
from crane.identification.mechanics.regression_equations import (
    CombinedRegressor,
    RegressionEquations,
    is_long_enough,
)
from crane.identification.mechanics.settings_selection import (
    default_bandwidth,
    has_open_prior,
    merge_priors,
    select_settings,
    standstill_velocities,
)
from crane.identification.mechanics.smoothed_motion import smoothed_motion
from crane.identification.signals.signal_processing import Motion
from crane.identification.signals.signal_quality import reject_unless_trusted
from crane.machine.machine import Machine
from crane.recordings.recording import Recording

METHODS = {"ols": least_squares, "wls": weighted_least_squares, "huber": huber}
_MIN_COMPARED_ROWS = 50  # least number of rows for a comparison of forces with the model
RecordingOrMotion = Recording | Motion
_PASS_SHARE = 0.3  # of the remaining progress, per pass over a recording


@with_single_threaded_blas
def identify(
    machine: Machine,
    recording: RecordingOrMotion | Sequence[RecordingOrMotion],
    validation: RecordingOrMotion | Sequence[RecordingOrMotion] | None = None,
    method: str = "wls",
    prior: float | Mapping[str, object] | Prior | None = None,
    feasible: bool | None = None,
    *,
    terms: Sequence[ModelTerm] | TermChanges | None = None,
    bandwidth: float | None = None,
    min_speed: Mapping[str, float] | ArrayLike | None = None,
    trust: bool = False,
    progress: Progress | None = None,
) -> Identification:
    """Identify the base parameters of a machine from recorded strokes and forces.

    Both sides of tau_A + gamma^T f = W(q_A, v_A, a_A) beta pass a zero-phase low-pass and are
    decimated; rows of a joint near standstill are omitted. The settings of the machine file under
    `identification` (terms, prior, bandwidth, min_speed) are used; arguments add to them or
    replace them.

    Args:
        machine: The machine, whose geometry is taken as known.
        recording: Training data, one or several recordings; a `Motion` if velocities and
            accelerations are known.
        validation: Held-out data, likewise; a warning is given if it is too short for the low-pass
            or has no motion.
        method: "ols", "wls" (rows of each joint weighted by its noise) or "huber" (robust).
        prior: Prior that regularizes the estimate: by name, such as {"bodies": "10 %",
            "q1.viscous": "200 +- 50"}, see `prior_from_names`; "auto" as the width of some selects
            it, and the bandwidth and standstill velocities that are not given, by
            cross-validation within the training data, see `select_settings`; a relative standard
            deviation of the whole description; or means and standard deviations (p,) of all
            parameters. With a prior all parameters are estimated, not only the base parameters.
        feasible: Whether to constrain bodies to be physically feasible and friction to be
            nonnegative; all parameters are estimated then. Default with a prior of the width
            "auto", if CVXPY is installed.
        terms: Terms of the model; or changes of the default terms by name, such as
            {"q*.rotor_inertia": (), "q1.coulomb": None}, see `select_terms`.
        bandwidth: Bandwidth of the low-pass [Hz]; default far above the frequencies of the motion,
            but at most the passband of the smoothing of noisy coordinates.
        min_speed: Standstill velocities below which rows are omitted, (n,) or by joint or pattern.
            Default 4 times the smoothing or Stribeck velocity of the description (0.01 rad/s and 1
            mm/s for stiction without them), or 2 % of a joint's largest velocity.
        trust: Whether to accept a recording that is probably wrong: reasons become warnings, and
            outliers are not removed.
        progress: Takes the finished share.

    Returns:
        Parameters with covariance, and prediction errors on training and held-out data.

    Raises:
        InputError: Arguments are not valid, or CVXPY is missing for feasible bodies.
        RecordingError: A recording is not suitable, or does not determine any parameter.
    """
    progress = progress_reporter(progress)
    check_name(method, METHODS, f"method '{method}' is unknown")
    model, priors = IdentificationModel(machine, terms), merge_priors(machine, prior)
    feasible = _requires_feasible_bodies(model, feasible, has_open_prior(priors))
    final_progress, progress = progress, multi_pass_progress(progress)
    check_shared_samples(as_list(recording), as_list(validation), trust)
    motions = prepare_motions(machine, recording, trust, progress)
    settings = None
    if has_open_prior(priors):
        settings = select_settings(model, motions, priors, bandwidth, min_speed, progress)
        bandwidth, priors = settings.best.bandwidth, settings.priors
        min_speed = settings.min_speed
    equations, identifiable = build_equations(model, motions, bandwidth, min_speed, progress)
    delays = _check_forces(model, motions, equations, trust) if model.bodies else ()
    selection = equations.column_selection(identifiable)
    columns = CombinedRegressor(equations, selection)
    factors = columns.triangular_factors(equations.y, equations.groups)
    parameter_sizes = parameter_magnitudes(model, identifiable, factors)
    known_prior = _build_prior(model, priors, equations, parameter_sizes, feasible)
    estimator_prior, T = (None, selection) if feasible else (known_prior, selection)
    if known_prior is not None and not feasible:
        T = equations.base.grouping
        check_identifiable(model.names, equations.stacked_factors(T), known_prior)
    equations, estimate = equations.estimate(
        T, METHODS[method], estimator_prior, equations.base.values(model.nominal)
    )
    values, covariance, parameters = estimate.values, estimate.covariance, None
    if feasible:
        estimate = feasible_estimate(
            model, identifiable, equations, selection, estimate, known_prior
        )
    if feasible or known_prior is not None:
        plain, scaled = condition_numbers(equations.stacked_factors(selection))
        estimate = replace(estimate, condition=plain, scaled_condition=scaled)
        parameters = estimate.values
        values = identifiable.values(parameters)
        covariance = identifiable.grouping @ estimate.covariance @ identifiable.grouping.T
    # an estimate of all parameters predicts other motions better
    predicting_values = (
        selection @ values if parameters is None else equations.base.values(parameters)
    )
    training, validation_comparison = equations.compare(predicting_values), None
    base, bandwidth, min_speeds = equations.base, equations.bandwidth, equations.min_speed
    advice = motion_advice(machine, motions)
    del equations, motions
    if validation is not None:
        validation_motions = prepare_motions(machine, validation, trust, progress, "validation")
        validation_comparison = _compare_held_out(
            model, base, validation_motions, bandwidth, min_speeds, progress, predicting_values
        )
        if validation_comparison is not None:
            warn_validation(training, validation_comparison)
    final_progress(1.0)
    magnitudes = np.sqrt(identifiable.grouping**2 @ parameter_sizes**2)
    identification = Identification(
        model, identifiable, values, covariance, parameters, estimate, method, feasible, training,
        magnitudes, advice, bandwidth, min_speeds, validation_comparison, delays, settings,
    )  # fmt: skip
    if all(mark == "not determined" for mark in identification.marks):
        reject_unless_trusted(identification.warning, trust)
    elif identification.warning:
        warnings.warn(identification.warning, CraneWarning, stacklevel=3)
    return identification


def _requires_feasible_bodies(
    model: IdentificationModel, given: bool | None, is_open: bool
) -> bool:
    """Whether bodies have to be feasible: as given, or where settings are selected.

    Raises:
        InputError: There are no bodies, or the solver is missing.
    """
    if given is None:
        return is_open and bool(model.bodies) and is_installed("cvxpy")
    if given and not model.bodies:
        raise InputError("the model has no bodies, so nothing has to be feasible")
    if given:
        load_convex_solver()  # fail early
    return given


def _compare_held_out(
    model: IdentificationModel,
    base: BaseParameters,
    motions: Sequence[Motion],
    bandwidth: float,
    min_speeds: Array,
    progress: Progress,
    values: Array,
) -> ForceComparison | None:
    """Compare held-out motions with the forces of base parameters; None if none is usable."""
    long_motions = [motion for motion in motions if is_long_enough(motion, bandwidth)]
    comparison = None
    if long_motions:
        held_out = RegressionEquations(model, base, long_motions, bandwidth, min_speeds, progress)
        if held_out.is_moving.any():
            comparison = held_out.compare(values)
    short_count = len(motions) - len(long_motions)
    if short_count:
        text = (
            f"{short_count} of {len(motions)} held-out recordings are too short for a low-pass of "
            f"{bandwidth:g} Hz and are not used"
        )
    else:
        text = "no held-out recording moves faster than standstill, none is used"
    if short_count or comparison is None:
        warnings.warn(f"{text}, give longer ones that move", CraneWarning, stacklevel=4)
    return comparison


def _build_prior(
    model: IdentificationModel,
    known: Mapping[str, ParameterPrior] | Prior,
    equations: RegressionEquations,
    parameter_sizes: Array,
    feasible: bool,
) -> Prior | None:
    """Prior means and standard deviations (p,) of all parameters; None without a prior.

    Raises:
        InputError: The prior is not valid.
        RecordingError: Without a prior nothing determines the scale of masses, as all forces are
            zero.
    """
    if not isinstance(known, Mapping):
        return check_prior(model, equations.base, known, feasible)
    if known:
        return prior_from_names(model, known, parameter_sizes)
    if model.machine.free and not equations.y.any():
        body = body_names(model.machine)[-1]
        raise RecordingError(
            "nothing drives what moves in this recording: it determines ratios of masses only; "
            f"give a prior of one mass, as prior={{'{body}.m': '100 +- 1'}} "
            f"(--prior {body}.m=100+-1)"
        )
    return None


def _check_forces(
    model: IdentificationModel,
    motions: Sequence[Motion],
    equations: RegressionEquations,
    trust: bool,
) -> tuple[ForceDelays, ...]:
    """Check the forces of motions; returns their delays, with warnings about significant ones."""
    modelled, first = equations.compare(equations.base.values(model.nominal)).modelled, 0
    delays = []
    for motion, thinned in zip(motions, equations.thinned_motions(), strict=True):
        here = modelled[first : first + len(thinned.time)]
        if len(here) >= _MIN_COMPARED_ROWS:
            check_forces(thinned, here, model.machine.active, trust=trust)
        delays.append(force_delays(model, equations.base, motion, equations.min_speed))
        if delays[-1].warning:
            warnings.warn(delays[-1].warning, CraneWarning, stacklevel=3)
        first += len(here)
    return tuple(delays)


def build_equations(
    model: IdentificationModel,
    motions: Sequence[Motion],
    bandwidth: float | None = None,
    min_speed: Mapping[str, float] | ArrayLike | None = None,
    progress: Progress = ignore_progress,
) -> tuple[RegressionEquations, BaseParameters]:
    """Regression equations of motions, and the identifiable part of the base parameters.

    Arguments and errors as for `identify`.
    """
    if bandwidth is None:
        bandwidth = model.machine.estimation.bandwidth or min(map(default_bandwidth, motions))
    bandwidth = as_number(bandwidth, "the bandwidth", "Hz", greater_than=0)
    fastest = np.max([np.abs(motion.v).max(axis=0) for motion in motions], axis=0)
    min_speeds = standstill_velocities(model.machine, min_speed, fastest)
    equations = RegressionEquations(
        model, base_parameters(model), motions, bandwidth, min_speeds, progress
    )
    if not equations.is_moving.any():
        raise RecordingError("no joint moves faster than what counts as standstill, move it more")
    for joint, count in zip(model.machine.active, equations.is_moving.sum(axis=0), strict=True):
        if count == 1:  # one row does not determine the noise
            raise RecordingError(
                f"'{joint}' is in one sample only faster than what counts as standstill, move it "
                "more, or raise its min_speed"
            )
    # the triangular factors have the column dependences of all rows
    return equations, equations.base.identifiable_part(
        np.vstack(list(equations.triangular_factors[:, :, :-1]))
    )


def prepare_motions(
    machine: Machine,
    recordings: RecordingOrMotion | Sequence[RecordingOrMotion],
    trust: bool,
    progress: Progress = ignore_progress,
    role: str = "",
) -> list[Motion]:
    """Motions of recordings, with velocities and accelerations.

    Raises:
        InputError: There are no recordings.
        RecordingError: A recording is not suitable; the message names it if there are several.
    """
    sources = as_list(recordings)
    if not sources:
        raise InputError("no recording is given, give at least one")
    motions = []
    for number, one in enumerate(sources, start=1):
        which = f"{role or 'recording'} {number} of {len(sources)}: "
        if isinstance(one, Motion):
            motions.append(one)
            continue
        try:
            motions.append(smoothed_motion(machine, one, trust=trust, progress=progress))
        except RecordingError as error:
            is_only = not role and len(sources) == 1
            raise RecordingError(str(error) if is_only else f"{which}{error}") from None
    return motions


def as_list(
    recordings: RecordingOrMotion | Sequence[RecordingOrMotion] | None,
) -> list[RecordingOrMotion]:
    """List of one or several recordings; empty for None."""
    if recordings is None:
        return []
    return [recordings] if isinstance(recordings, Recording | Motion) else list(recordings)


def multi_pass_progress(progress: Progress) -> Progress:
    """Progress over an unknown number of passes: each takes a share of the remainder."""
    done = 0.0

    def report(share: float) -> None:
        nonlocal done
        now = done + _PASS_SHARE * (1 - done) * share
        progress(now)
        if share >= 1:
            done = now

    return report
