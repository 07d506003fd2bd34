"""Cross-validation of settings of an identification within the training data."""

import itertools
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from crane.common.errors import CraneError, CraneWarning, InputError
from crane.common.progress import Progress, progress_reporter
from crane.common.samples import Array, as_number, root_mean_square
from crane.common.units import format_table
from crane.identification.mechanics.base_parameters import base_parameters
from crane.identification.mechanics.feasible_parameters import load_convex_solver
from crane.identification.mechanics.identifiability import prior_from_names, read_priors
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.identify import RecordingOrMotion, identify, prepare_motions
from crane.identification.mechanics.regression_equations import RegressionEquations
from crane.identification.signals.signal_processing import Motion
from crane.machine.machine import Machine

FOLD_COUNT = 5
_MIN_FOLD_SAMPLES = 50  # least number of samples of a fold
_BANDWIDTH = "bandwidth"


@dataclass(frozen=True)
class CrossValidationTrial:
    """Settings and their prediction errors on held-out folds.

    Attributes:
        settings: Settings by name.
        errors: (k,) norm of the residuals over that of the forces of each held-out fold; infinite
            if the identification fails without it, nan if nothing moves in it.
    """

    settings: Mapping[str, object]
    errors: Array

    @property
    def mean_error(self) -> float:
        """Root mean square of the errors of folds with motion."""
        errors = self.errors[~np.isnan(self.errors)]
        return root_mean_square(errors) if len(errors) else np.inf


def cross_validate(
    machine: Machine,
    recording: RecordingOrMotion | Sequence[RecordingOrMotion],
    candidates: Mapping[str, Sequence[object]],
    progress: Progress | None = None,
    **options: Any,
) -> list[CrossValidationTrial]:
    """Cross-validate settings on folds of the training data; the best are first.

    Each recording is divided into five folds of equal length; each fold is predicted by an
    identification from the others. All settings are compared by the same rows and the low-pass of
    the lowest bandwidth.

    Args:
        machine: The machine.
        recording: Training data, one or several recordings.
        candidates: Values by name: "bandwidth" [Hz], or priors of parameters, such as {"bodies":
            ["1 %", "10 %"]}; all combinations are evaluated.
        progress: Called with the finished share, 0 to 1.
        options: Options of `identify` for all settings.

    Raises:
        InputError: There are no candidates, one is not valid, or a recording is too short.
        RecordingError: A recording is not suitable.
    """
    progress = progress_reporter(progress)
    if not candidates or not all(candidates.values()):
        raise InputError("there are no candidates, give values such as bandwidth=2,5,10")
    motions = prepare_motions(machine, recording, options.get("trust", False))
    if (shortest := min(len(motion.time) for motion in motions)) < FOLD_COUNT * _MIN_FOLD_SAMPLES:
        raise InputError(
            f"{shortest} samples are too few for {FOLD_COUNT} folds, give at least "
            f"{FOLD_COUNT * _MIN_FOLD_SAMPLES}"
        )
    grid = [
        dict(zip(candidates, values, strict=True))
        for values in itertools.product(*candidates.values())
    ]
    _check_settings(machine, grid, options)
    # all are compared at the lowest one, None for that of the first identification
    lowest = options.get("bandwidth") or machine.estimation.bandwidth
    if _BANDWIDTH in candidates:
        lowest = min(map(_read_frequency, candidates[_BANDWIDTH]))
    trials, reason = list[CrossValidationTrial](), ""
    for done, settings in enumerate(grid):
        errors = np.full(FOLD_COUNT, np.inf)
        for k in range(FOLD_COUNT):
            try:
                errors[k] = _held_out_error(machine, motions, k, settings, lowest, options)
            except CraneError as error:
                reason = str(error)
        trials.append(CrossValidationTrial(settings, errors))
        progress((done + 1) / len(grid))
    if not np.isfinite(min(trial.mean_error for trial in trials)):
        raise InputError(
            "some fold of the training data is not determined by the others for any settings, "
            f"give a prior, higher bandwidths or a longer recording (lastly: {reason})"
        )
    return sorted(trials, key=lambda trial: trial.mean_error)


def identify_options(
    machine: Machine, settings: Mapping[str, object], options: Mapping[str, Any]
) -> dict[str, Any]:
    """Options of `identify` for the settings of a trial and other options."""
    out, prior_settings = dict(options), dict(settings)
    if _BANDWIDTH in prior_settings:
        out["bandwidth"] = _read_frequency(prior_settings.pop(_BANDWIDTH))
    if prior_settings:
        given_prior = {} if (given := out.get("prior")) is None else given
        if not isinstance(given_prior, Mapping | int | float):
            raise InputError(
                "the prior is an array of all parameters, give it by name to vary parts of it"
            )
        out["prior"] = read_priors(given_prior, machine) | read_priors(prior_settings, machine)
    return out


def format_trials(trials: Sequence[CrossValidationTrial]) -> str:
    """Table of settings and errors."""
    rows = [["settings", "held-out error", "of each fold [%]"]]
    for trial in trials:
        words = ", ".join(f"{name}={value}" for name, value in trial.settings.items())
        each = " ".join("-" if np.isnan(x) else f"{100 * x:.2f}" for x in trial.errors)
        rows.append([words, f"{100 * trial.mean_error:.2f} %", each])
    return "\n".join(["cross-validation within the training", *format_table(rows, (0, 2))])


def _check_settings(
    machine: Machine, grid: Sequence[Mapping[str, object]], options: Mapping[str, Any]
) -> None:
    """Check that settings are valid for an identification, independent of the recording.

    Raises:
        InputError: A setting is not valid, or a required library is not installed.
    """
    if options.get("feasible"):
        load_convex_solver()
    model = IdentificationModel(machine, options.get("terms"))
    for settings in grid:
        for name, value in settings.items():
            if name == _BANDWIDTH:
                as_number(_read_frequency(value), "the bandwidth", "Hz", greater_than=0)
            else:
                prior_from_names(
                    model, read_priors({name: value}, machine), np.ones(len(model.names))
                )
        identify_options(machine, settings, options)


def _read_frequency(value: object) -> float:
    try:
        return float(str(value))
    except ValueError:
        raise InputError(f"bandwidth is '{value}', give numbers in Hz") from None


def _held_out_error(
    machine: Machine,
    motions: Sequence[Motion],
    fold: int,
    settings: Mapping[str, object],
    bandwidth: float | None,
    options: Mapping[str, Any],
) -> float:
    """Prediction error of one fold of each motion by the others, nan if nothing moves in it.

    Raises:
        CraneError: The identification fails.
    """
    training, held_out = [], []
    for motion in motions:
        edges = np.linspace(0, len(motion.time), FOLD_COUNT + 1).astype(int)
        start, stop = edges[fold], edges[fold + 1]
        held_out.append(motion[start:stop])
        training += [
            motion[part]
            for part in (slice(0, start), slice(stop, None))
            if len(motion.time[part]) >= _MIN_FOLD_SAMPLES
        ]
    with warnings.catch_warnings(action="ignore", category=CraneWarning):
        trial = identify_options(machine, settings, options)
        # checks are not reliable on folds; the complete recordings were checked
        identification = identify(machine, training, **trial | {"trust": True})
        base, values = identification.base, identification.values
        if identification.parameters is not None:  # they predict better than identifiable ones
            base = base_parameters(identification.model)
            values = base.values(identification.parameters)
        held_out_equations = RegressionEquations(
            identification.model,
            base,
            held_out,
            bandwidth or identification.bandwidth,
            identification.min_speed,
        )
        return (
            held_out_equations.compare(values).overall_relative_error
            if held_out_equations.is_moving.any()
            else np.nan
        )
