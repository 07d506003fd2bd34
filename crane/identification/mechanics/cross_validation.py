"""Settings of an identification chosen by what is left out of the training."""

import itertools
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from crane.common.errors import CraneError, CraneWarning, InputError
from crane.common.progress import progress_reporter
from crane.common.samples import Array, as_number
from crane.common.text_tables import format_table
from crane.identification.mechanics.equation_setup import RecordingOrMotion, prepare_motions
from crane.identification.mechanics.feasible_parameters import load_convex_solver
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.identify import identify
from crane.identification.mechanics.priors import prior_from_names, read_priors
from crane.identification.mechanics.regression_equations import Progress, RegressionEquations
from crane.identification.signals.signal_processing import Motion
from crane.machine import Machine

FOLD_COUNT = 5
_MIN_FOLD_SAMPLES = 50  # samples of a part
_BANDWIDTH = "bandwidth"


@dataclass(frozen=True)
class CrossValidationTrial:
    """Settings, and how well they predict what they were not learned from.

    Attributes:
        settings: By name.
        errors: (k,) norm of the residuals over that of the forces of each part left out; infinite
            where it cannot be identified without it, nan where nothing moves in it.
    """

    settings: Mapping[str, object]
    errors: Array

    @property
    def mean_error(self) -> float:
        """Root mean square of the errors of parts that move."""
        errors = self.errors[~np.isnan(self.errors)]
        return float(np.sqrt(np.mean(errors**2))) if len(errors) else np.inf


def cross_validate(
    machine: Machine,
    recording: RecordingOrMotion | Sequence[RecordingOrMotion],
    candidates: Mapping[str, Sequence[object]],
    progress: Progress | None = None,
    **options: Any,
) -> list[CrossValidationTrial]:
    """Errors of settings on parts of the training that were left out of it, the best first.

    Each recording is cut into five parts of equal length; each part is predicted by what the
    others teach. All are judged by the same rows, through the same low-pass: that of the lowest
    bandwidth tried.

    Args:
        machine: The machine.
        recording: The training, one or several.
        candidates: Values by name: "bandwidth" [Hz], or what is known of parameters by name, such
            as {"bodies": ["1 %", "10 %"]}; all combinations are tried.
        progress: Takes the finished share.
        options: Of `identify`, the same for all.

    Raises:
        InputError: Nothing is tried or what cannot be, or a recording is too short for its parts.
        RecordingError: A recording cannot serve.
    """
    progress = progress_reporter(progress)
    if not candidates or not all(candidates.values()):
        raise InputError("nothing is tried, give values such as bandwidth=2,5,10")
    motions = prepare_motions(machine, recording, options.get("trust", False), None)
    if (shortest := min(len(motion.time) for motion in motions)) < FOLD_COUNT * _MIN_FOLD_SAMPLES:
        raise InputError(
            f"{shortest} samples are too few for {FOLD_COUNT} parts, give at least "
            f"{FOLD_COUNT * _MIN_FOLD_SAMPLES}"
        )
    grid = [
        dict(zip(candidates, values, strict=True))
        for values in itertools.product(*candidates.values())
    ]
    _check_settings(machine, grid, options)
    lowest = _comparison_bandwidth(machine, candidates, options)
    trials, reason = list[CrossValidationTrial](), ""
    for done, settings in enumerate(grid):
        errors = np.full(FOLD_COUNT, np.inf)
        for k in range(FOLD_COUNT):
            try:
                errors[k] = _held_out_error(machine, motions, k, settings, lowest, options)
            except CraneError as error:
                reason = str(error)
        trials.append(CrossValidationTrial(settings, errors))
        if progress is not None:
            progress((done + 1) / len(grid))
    if not np.isfinite(min(trial.mean_error for trial in trials)):
        raise InputError(
            "some part of the training is not told by the others whatever the settings, give a "
            f"prior, higher bandwidths or a longer recording (lastly: {reason})"
        )
    return sorted(trials, key=lambda trial: trial.mean_error)


def identify_options(trial: CrossValidationTrial, options: Mapping[str, Any]) -> dict[str, Any]:
    """What `identify` takes for these settings beside other options."""
    prior_settings = {name: what for name, what in trial.settings.items() if name != _BANDWIDTH}
    out = dict(options)
    if _BANDWIDTH in trial.settings:
        out["bandwidth"] = _read_frequency(trial.settings[_BANDWIDTH])
    if prior_settings:
        given_prior = {} if (given := out.get("prior")) is None else given
        if not isinstance(given_prior, Mapping | int | float):
            raise InputError("the prior is numbers of all parameters, give it by name to try some")
        out["prior"] = read_priors(given_prior) | read_priors(prior_settings)
    return out


def format_trials(trials: Sequence[CrossValidationTrial]) -> str:
    """A table of settings and errors."""
    rows = [["settings", "error", "of the parts left out"]]
    for trial in trials:
        words = ", ".join(f"{name}={value}" for name, value in trial.settings.items())
        each = " ".join("-" if np.isnan(x) else f"{100 * x:.2f}" for x in trial.errors)
        rows.append([words, f"{100 * trial.mean_error:.2f} %", each])
    return "\n".join(["cross-validation within the training", *format_table(rows, (0, 2))])


def _check_settings(
    machine: Machine, grid: Sequence[Mapping[str, object]], options: Mapping[str, Any]
) -> None:
    """Check that settings are such as an identification takes, whatever is recorded.

    Raises:
        InputError: One is not, or what they need is not installed.
    """
    if options.get("feasible"):
        load_convex_solver()
    model = IdentificationModel(machine, options.get("terms"))
    for settings in grid:
        for name, value in settings.items():
            if name == _BANDWIDTH:
                as_number(_read_frequency(value), "the bandwidth", "Hz", greater_than=0)
            else:
                prior_from_names(model, read_priors({name: value}), np.ones(len(model.names)))
        identify_options(CrossValidationTrial(settings, np.empty(0)), options)


def _read_frequency(value: object) -> float:
    try:
        return float(str(value))
    except ValueError:
        raise InputError(f"bandwidth is '{value}', give numbers in Hz") from None


def _comparison_bandwidth(
    machine: Machine, candidates: Mapping[str, Sequence[object]], options: Mapping[str, Any]
) -> float | None:
    """The bandwidth by which all are judged; None: that of the first identification."""
    if _BANDWIDTH in candidates:
        return min(map(_read_frequency, candidates[_BANDWIDTH]))
    return options.get("bandwidth") or machine.estimation.bandwidth


def _held_out_error(
    machine: Machine,
    motions: Sequence[Motion],
    fold: int,
    settings: Mapping[str, object],
    bandwidth: float | None,
    options: Mapping[str, Any],
) -> float:
    """The error of one part of each motion by all the others, nan where nothing moves in it.

    Raises:
        CraneError: They do not tell it.
    """
    training, held_out = [], []
    for motion in motions:
        edges = np.linspace(0, len(motion.time), FOLD_COUNT + 1).astype(int)
        start, stop = edges[fold], edges[fold + 1]
        held_out.append(_slice_motion(motion, slice(start, stop)))
        training += [
            _slice_motion(motion, part)
            for part in (slice(0, start), slice(stop, None))
            if len(motion.time[part]) >= _MIN_FOLD_SAMPLES
        ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        trial = identify_options(CrossValidationTrial(settings, np.empty(0)), options)
        # of parts the checks know too little; the whole has passed, or will not
        identification = identify(machine, training, **trial | {"trust": True})
        held_out_equations = RegressionEquations(
            identification.model,
            identification.base,
            held_out,
            bandwidth or identification.bandwidth,
            identification.slow,
        )
        return (
            held_out_equations.compare(identification.values).overall_relative_error
            if held_out_equations.is_moving.any()
            else np.nan
        )


def _slice_motion(motion: Motion, part: slice) -> Motion:
    return Motion(
        motion.time[part], motion.q[part], motion.v[part], motion.a[part], motion.tau[part],
        motion.passband,
    )  # fmt: skip
