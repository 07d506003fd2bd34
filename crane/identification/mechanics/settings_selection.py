"""Selection of bandwidth, standstill velocities and prior width by blocked cross-validation."""

import fnmatch
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeGuard

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError, RecordingError, suggest_names
from crane.common.progress import Progress
from crane.common.samples import Array, as_number, as_sample
from crane.common.units import format_table
from crane.description.estimation_settings import ParameterPrior
from crane.identification.estimation.estimators import Prior
from crane.identification.mechanics.base_parameters import base_parameters
from crane.identification.mechanics.identifiability import (
    parameter_magnitudes,
    prior_from_names,
    read_priors,
)
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.regression_equations import (
    MIN_PERIODS,
    CombinedRegressor,
    RegressionEquations,
)
from crane.identification.signals.signal_processing import Motion, low_pass
from crane.identification.signals.signal_quality import spectral_edge_frequency
from crane.machine.machine import Machine

FOLD_COUNT = 5
_WIDTHS = (0.003, 0.01, 0.03, 0.1, 0.3)  # of bodies
_BANDWIDTH_COUNT = 5
_BEYOND_DEFAULT = 2.0  # highest candidate of the bandwidth, relative to the default
_SLOW_SHARES = (0.005, 0.05)  # of a joint's largest velocity, beside the default
_SLOW_SHARE = 0.02  # the default, below which rows are omitted
# [rad/s], [m/s] default end of stiction
_DEFAULT_STICTION_SPEED = {"rad": 1e-2, "m": 1e-3}
_SMOOTHING_FACTOR = 4.0  # times the smoothing velocity, tanh 4 = 0.9993
_MAX_SLOW_SHARE = 0.5  # of a joint's largest velocity, above which rows are always used
_PASSBAND_SHARE = 0.75  # of the passband of a smoother: there it passes 91 %
_MIN_BANDWIDTH_FACTOR = 3.0  # least bandwidth, times the spectral edge frequency of the velocities
_POWER_SHARE = 0.99
_MAX_BANDWIDTH_FACTOR = 40.0  # times the spectral edge frequency of the accelerations
_SAMPLES_PER_PERIOD = 8.0  # of the largest bandwidth, to which motions are decimated
_ITERATIONS = 6  # of the noise of the joints
PriorMap = Mapping[str, ParameterPrior]


@dataclass(frozen=True)
class SettingsTrial:
    """Settings and the errors of held-out blocks.

    Attributes:
        bandwidth: Bandwidth of the low-pass [Hz].
        slow_share: Standstill velocities relative to the largest; None: given or default ones.
        width: Relative standard deviation of bodies whose prior is open.
        errors: (n,) relative errors of the forces of each joint over all held-out blocks.
        overall_error: Norm of all their residuals over that of all forces.
    """

    bandwidth: float
    slow_share: float | None
    width: float
    errors: Array
    overall_error: float

    @property
    def mean_error(self) -> float:
        """Mean of the joints that move."""
        return float(np.nanmean(self.errors))

    @property
    def criterion(self) -> float:
        """Geometric mean of the two errors: of joints with small forces, and of large forces."""
        return math.sqrt(self.mean_error * self.overall_error)


@dataclass(frozen=True)
class SettingsSelection:
    """Settings that were tried and the best of them, the last.

    Attributes:
        trials: Trials, each with the best width of the prior.
        score_bandwidth: Bandwidth [Hz] at which all are compared.
        priors: Priors with the selected width.
        min_speed: Given or selected standstill velocities, see `identify`.
    """

    trials: tuple[SettingsTrial, ...]
    score_bandwidth: float
    priors: PriorMap
    min_speed: Mapping[str, float] | ArrayLike | None

    @property
    def best(self) -> SettingsTrial:
        """The trial with the least mean error."""
        return self.trials[-1]

    def to_text(self) -> str:
        """Table of the trials."""
        rows = [
            ["bandwidth", "slow rows", "prior", "mean of joints", "all together", "each joint [%]"]
        ]
        for trial in self.trials:
            slow = "default" if trial.slow_share is None else f"{100 * trial.slow_share:g} %"
            overall = f"{100 * trial.overall_error:.2f} %"
            each = " ".join("-" if np.isnan(x) else f"{100 * x:.2f}" for x in trial.errors)
            width = f"{100 * trial.width:g} %"
            mean = f"{100 * trial.mean_error:.2f} %"
            rows.append([f"{trial.bandwidth:.3g} Hz", slow, width, mean, overall, each])
        title = (
            f"settings by cross-validation within the training: errors of {FOLD_COUNT} blocks of "
            "time that are left out, all rows in motion, both sides below "
            f"{self.score_bandwidth:.3g} Hz; rows below a share of the largest speed are slow; "
            "the last is taken"
        )
        return "\n".join([title, *format_table(rows, (0, 5))])


def select_settings(
    model: IdentificationModel,
    motions: Sequence[Motion],
    priors: PriorMap,
    bandwidth: float | None,
    min_speed: Mapping[str, float] | ArrayLike | None,
    progress: Progress,
) -> SettingsSelection:
    """Select the settings that predict blocks of the training data best that were left out.

    The regression is computed once for each bandwidth and share of slow rows, with the history of
    the whole motion; a block is left out by its triangular factors. All settings are judged by the
    same rows: all that are faster than the default standstill velocities, below the middle
    bandwidth. First the bandwidth is selected, then the share of slow rows, each with the best
    width of the prior.

    Args:
        model: The model.
        motions: Training data.
        priors: Priors, of which some are open.
        bandwidth: Given bandwidth [Hz]; None: selected.
        min_speed: Given standstill velocities, see `identify`; None: selected.
        progress: Called with the finished share of each pass over the motions.

    Raises:
        InputError: A prior, or a standstill velocity is not valid.
        RecordingError: No joint moves.
    """
    machine, base = model.machine, base_parameters(model)
    candidates, bandwidth = (
        _bandwidth_candidates(motions),
        bandwidth or machine.estimation.bandwidth,
    )
    bandwidths = [bandwidth] if bandwidth else candidates
    score_bandwidth = candidates[len(candidates) // 2]
    motions = [_decimated(motion, max(*bandwidths, score_bandwidth)) for motion in motions]
    fastest = np.max([np.abs(motion.v).max(axis=0) for motion in motions], axis=0)
    default_speeds = standstill_velocities(machine, min_speed, fastest)
    nothing = min_speed is None or (isinstance(min_speed, Mapping) and not min_speed)
    is_open = nothing and not machine.estimation.min_speed

    def equations(bandwidth: float, share: float | None, near_rest: bool) -> RegressionEquations:
        speeds = default_speeds if share is None else share * fastest
        return RegressionEquations(
            model, base, motions, bandwidth, speeds, progress, near_rest=near_rest
        )

    judge = equations(score_bandwidth, None, True)
    if not judge.is_moving.any():
        raise RecordingError("no joint moves faster than what counts as standstill, move it more")
    score, sizes = _BlockProducts.of(judge), _magnitudes(model, judge)

    def best_width(bandwidth: float, share: float | None) -> SettingsTrial:
        training, trials = _BlockProducts.of(equations(bandwidth, share, False)), []
        for width in _WIDTHS:
            prior = prior_from_names(model, closed_priors(priors, width), sizes)
            errors = training.held_out_errors(prior, score)
            trials.append(SettingsTrial(bandwidth, share, width, *errors))
        return min(trials, key=lambda trial: trial.criterion)

    trials = [best_width(each, None) for each in bandwidths]
    best = min(trials, key=lambda trial: trial.criterion)
    trials += [best_width(best.bandwidth, share) for share in _SLOW_SHARES if is_open]
    best = min(trials, key=lambda trial: trial.criterion)
    ordered = (*(trial for trial in trials if trial is not best), best)
    selected = min_speed if best.slow_share is None else best.slow_share * fastest
    return SettingsSelection(ordered, score_bandwidth, closed_priors(priors, best.width), selected)


def merge_priors(
    machine: Machine, given: float | Mapping[str, object] | Prior | None
) -> PriorMap | Prior:
    """Priors by name, given ones in place of those of the machine file; or a given prior."""
    known = dict(machine.estimation.prior)
    if given is None:
        return known
    if not isinstance(given, Mapping | int | float):
        return given
    given_priors = read_priors(given, machine)
    return {name: what for name, what in known.items() if name not in given_priors} | given_priors


def has_open_prior(priors: PriorMap | Prior) -> TypeGuard[PriorMap]:
    """Whether the width of some prior is to be selected."""
    return isinstance(priors, Mapping) and any(what.is_open for what in priors.values())


def closed_priors(priors: PriorMap, width: float) -> dict[str, ParameterPrior]:
    """Priors with a relative standard deviation in place of open ones."""
    closed = ParameterPrior(width, relative=True)
    return {name: closed if what.is_open else what for name, what in priors.items()}


@dataclass(frozen=True)
class _BlockProducts:
    """Products of the rows of blocks of time, [W T, y]^T [W T, y].

    Attributes:
        products: (K, n, p + 1, p + 1) of each block and joint; those of the residuals for
            parameters b are x^T products x with x = (b, -1).
        counts: (K, n) numbers of rows.
        squares: (K, n) sums of squares of their measured forces.
    """

    products: Array
    counts: Array
    squares: Array

    @classmethod
    def of(cls, equations: RegressionEquations) -> "_BlockProducts":
        """Products of the used rows of equations."""
        mask, grouping = equations.is_moving, equations.base.grouping
        found = equations.segment_factors(FOLD_COUNT)
        factors = np.concatenate([found[..., :-1] @ grouping, found[..., -1:]], axis=-1)
        products = np.zeros((FOLD_COUNT, mask.shape[1], *(2 * factors.shape[-1:])))
        products[:, mask.any(axis=0)] = np.swapaxes(factors, -1, -2) @ factors
        block = np.arange(len(mask)) * FOLD_COUNT // len(mask)
        forces = np.where(mask, equations.forces, 0.0) ** 2
        counts, squares = (
            np.array([rows[block == k].sum(axis=0) for k in range(FOLD_COUNT)])
            for rows in (mask, forces)
        )
        return cls(products, counts, squares)

    def held_out_errors(self, prior: Prior, score: "_BlockProducts") -> tuple[Array, float]:
        """Relative errors (n,) of the rows of another in blocks left out, and that of all rows."""
        whole, rows = self.products.sum(axis=0), self.counts.sum(axis=0)
        noise, floor = np.ones(len(rows)), 1e-12 * whole[:, -1, -1] + np.finfo(float).tiny
        for _ in range(_ITERATIONS):  # the noise is that of all blocks
            x = _weighted_estimate(whole, noise, prior)
            squares = np.maximum(np.einsum("i,jik,k->j", x, whole, x), floor)
            noise = np.sqrt(squares / np.maximum(rows, 1))
        squares = np.zeros(len(rows))
        for mine, held_out in zip(self.products, score.products, strict=True):
            x = _weighted_estimate(whole - mine, noise, prior)
            squares += np.maximum(np.einsum("i,jik,k->j", x, held_out, x), 0.0)
        total = score.squares.sum(axis=0)
        shares = np.divide(squares, total, out=np.full_like(total, np.nan), where=total > 0)
        return np.sqrt(shares), float(np.sqrt(squares.sum() / total.sum()))


def _weighted_estimate(products: Array, noise: Array, prior: Prior) -> Array:
    """Parameters b of weighted least squares with a prior, as (b, -1) (p + 1,)."""
    mean, std = prior
    is_known = np.isfinite(std)
    unit = np.where(is_known, std, 1.0)
    total = np.einsum("j,jik->ik", noise**-2.0, products)
    information = total[:-1, :-1] * np.outer(unit, unit) + np.diag(is_known.astype(float))
    right = unit * (total[:-1, -1] - total[:-1, :-1] @ mean)
    return np.append(mean + unit * np.linalg.lstsq(information, right, rcond=None)[0], -1.0)


def _magnitudes(model: IdentificationModel, equations: RegressionEquations) -> Array:
    """Magnitudes (p,) of the parameters, see `parameter_magnitudes`."""
    factors = equations.triangular_factors
    identifiable = equations.base.identifiable_part(np.vstack(list(factors[:, :, :-1])))
    columns = CombinedRegressor(equations, equations.column_selection(identifiable))
    return parameter_magnitudes(
        model, identifiable, columns.triangular_factors(equations.y, equations.groups)
    )


def _bandwidth_candidates(motions: Sequence[Motion]) -> list[float]:
    """Bandwidths [Hz] from far above the frequencies of the velocities to beyond the default."""
    highest = min(map(default_bandwidth, motions))
    steps = [float(motion.time[1] - motion.time[0]) for motion in motions]
    edges = (
        spectral_edge_frequency(motion.v, step, _POWER_SHARE)
        for motion, step in zip(motions, steps, strict=True)
    )
    shortest = min(float(motion.time[-1] - motion.time[0]) for motion in motions)
    lowest = max(_MIN_BANDWIDTH_FACTOR * max(edges), MIN_PERIODS / shortest)
    lowest = min(lowest, highest)
    ends = lowest, min(_BEYOND_DEFAULT * highest, 0.24 / max(steps))
    return np.geomspace(*ends, _BANDWIDTH_COUNT).tolist()


def _decimated(motion: Motion, bandwidth: float) -> Motion:
    """The motion at fewer samples, enough for a bandwidth [Hz]."""
    step = float(motion.time[1] - motion.time[0])
    every = int(1.0 / (_SAMPLES_PER_PERIOD * bandwidth * step))
    if every < 2:
        return motion
    tau = low_pass(motion.time, motion.tau, 0.4 / (every * step))
    return replace(motion, tau=tau)[::every]


def standstill_velocities(
    machine: Machine, min_speed: Mapping[str, float] | ArrayLike | None, fastest: Array
) -> Array:
    """Standstill velocities (n,), below which rows are omitted.

    The default is a share of the largest velocity, or the velocity at which the described friction
    is fully developed.
    """
    out = _SLOW_SHARE * fastest
    for i, joint in enumerate(machine.active):
        law = machine.friction.get(joint)
        if law is not None:
            smoothing_speed = law.smoothing or (
                _DEFAULT_STICTION_SPEED[machine.unit(joint)] if law.has_stick_slip else 0.0
            )
            stiction_speed = _SMOOTHING_FACTOR * (
                max(law.stribeck, law.smoothing) if law.stiction else smoothing_speed
            )
            out[i] = max(out[i], min(stiction_speed, _MAX_SLOW_SHARE * fastest[i]))
    if min_speed is not None and not isinstance(min_speed, Mapping):
        each = np.full(out.shape, min_speed) if np.ndim(min_speed) == 0 else min_speed
        each = as_sample(each, len(out), "min_speed", machine.active)
        min_speed = dict(zip(machine.active, each.tolist(), strict=True))
    for name, value in (*machine.estimation.min_speed.items(), *(min_speed or {}).items()):
        joints = fnmatch.filter(machine.active, name)
        if not joints and name not in machine.locked_joints:
            raise InputError(f"min_speed is for '{name}', {suggest_names(machine.active, name)}")
        if (limit := as_number(value, f"min_speed of '{name}'", "")) < 0:
            raise InputError(f"min_speed of '{name}' is {limit:g}, it must not be negative")
        out[[machine.active.index(joint) for joint in joints]] = limit
    return out


def default_bandwidth(motion: Motion) -> float:
    """Default bandwidth [Hz] of the low-pass, far above the frequencies of the motion.

    The band above the motion contains the noise to be estimated. But smoothing removes parts of
    the accelerations from the regressor, not from the forces, mostly at reversals, where friction
    jumps: so the bandwidth is at most the passband of smoothing, unless that is close to the
    motion.
    """
    step = float(motion.time[1] - motion.time[0])
    highest = max(
        _PASSBAND_SHARE * motion.passband,
        _MIN_BANDWIDTH_FACTOR * spectral_edge_frequency(motion.v, step, _POWER_SHARE),
    )
    fastest = _MAX_BANDWIDTH_FACTOR * spectral_edge_frequency(motion.a, step, _POWER_SHARE)
    return min(fastest, highest, 0.24 / step)
