"""Settings of an identification chosen by what is left out of the training."""

import itertools
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from crane.common.errors import CraneError, CraneWarning, InputError
from crane.common.samples import Array, as_number
from crane.common.tables import aligned
from crane.common.waiting import telling
from crane.identification.mechanics.equations import Equations, Progress
from crane.identification.mechanics.feasible import convex
from crane.identification.mechanics.identify import Recorded, identify, motions_of
from crane.identification.mechanics.model import Model
from crane.identification.mechanics.priors import by_name, stated
from crane.identification.signals.motion import Motion
from crane.machine import Machine

FOLDS = 5
_FEWEST = 50  # samples of a part
_BANDWIDTH = "bandwidth"


@dataclass(frozen=True)
class Trial:
    """Settings, and how well they predict what they were not learned from.

    Attributes:
        settings: By name.
        errors: (k,) norm of the residuals over that of the forces of each part left out; infinite
            where it cannot be identified without it, nan where nothing moves in it.
    """

    settings: Mapping[str, object]
    errors: Array

    @property
    def mean(self) -> float:
        """Root mean square of the errors of parts that move."""
        told = self.errors[~np.isnan(self.errors)]
        return float(np.sqrt(np.mean(told**2))) if len(told) else np.inf


def cross_validate(
    machine: Machine,
    recording: Recorded | Sequence[Recorded],
    tried: Mapping[str, Sequence[object]],
    progress: Progress | None = None,
    **options: Any,
) -> list[Trial]:
    """Errors of settings on parts of the training that were left out of it, the best first.

    Each recording is cut into five parts of equal length; each part is predicted by what the
    others teach. All are judged by the same rows, through the same low-pass: that of the lowest
    bandwidth tried.

    Args:
        machine: The machine.
        recording: The training, one or several.
        tried: Values by name: "bandwidth" [Hz], or what is known of parameters by name, such as
            {"bodies": ["1 %", "10 %"]}; all combinations are tried.
        progress: Takes the finished share.
        options: Of `identify`, the same for all.

    Raises:
        InputError: Nothing is tried or what cannot be, or a recording is too short for its parts.
        RecordingError: A recording cannot serve.
    """
    progress = telling(progress)
    if not tried or not all(tried.values()):
        raise InputError("nothing is tried, give values such as bandwidth=2,5,10")
    motions = motions_of(machine, recording, options.get("trust", False), None)
    if (shortest := min(len(motion.time) for motion in motions)) < FOLDS * _FEWEST:
        raise InputError(
            f"{shortest} samples are too few for {FOLDS} parts, give at least {FOLDS * _FEWEST}"
        )
    grid = [dict(zip(tried, values, strict=True)) for values in itertools.product(*tried.values())]
    _check(machine, grid, options)
    lowest = _lowest(machine, tried, options)
    trials, reason = list[Trial](), ""
    for done, settings in enumerate(grid):
        errors = np.full(FOLDS, np.inf)
        for k in range(FOLDS):
            try:
                errors[k] = _left_out(machine, motions, k, settings, lowest, options)
            except CraneError as error:
                reason = str(error)
        trials.append(Trial(settings, errors))
        if progress is not None:
            progress((done + 1) / len(grid))
    if not np.isfinite(min(trial.mean for trial in trials)):
        raise InputError(
            "some part of the training is not told by the others whatever the settings, give a "
            f"prior, higher bandwidths or a longer recording (lastly: {reason})"
        )
    return sorted(trials, key=lambda trial: trial.mean)


def settings_of(trial: Trial, options: Mapping[str, Any]) -> dict[str, Any]:
    """What `identify` takes for these settings beside other options."""
    known_before = {name: what for name, what in trial.settings.items() if name != _BANDWIDTH}
    out = dict(options)
    if _BANDWIDTH in trial.settings:
        out["bandwidth"] = _frequency(trial.settings[_BANDWIDTH])
    if known_before:
        before = {} if (given := out.get("prior")) is None else given
        if not isinstance(before, Mapping | int | float):
            raise InputError("the prior is numbers of all parameters, give it by name to try some")
        out["prior"] = by_name(before) | by_name(known_before)
    return out


def trials_text(trials: Sequence[Trial]) -> str:
    """A table of settings and errors."""
    rows = [["settings", "error", "of the parts left out"]]
    for trial in trials:
        words = ", ".join(f"{name}={value}" for name, value in trial.settings.items())
        each = " ".join("-" if np.isnan(x) else f"{100 * x:.2f}" for x in trial.errors)
        rows.append([words, f"{100 * trial.mean:.2f} %", each])
    return "\n".join(["cross-validation within the training", *aligned(rows, (0, 2))])


def _check(
    machine: Machine, grid: Sequence[Mapping[str, object]], options: Mapping[str, Any]
) -> None:
    """See that settings are such as an identification takes, whatever is recorded.

    Raises:
        InputError: One is not, or what they need is not installed.
    """
    if options.get("feasible"):
        convex()
    model = Model(machine, options.get("terms"))
    for settings in grid:
        for name, value in settings.items():
            if name == _BANDWIDTH:
                as_number(_frequency(value), "the bandwidth", "Hz", above=0)
            else:
                stated(model, by_name({name: value}), np.ones(len(model.names)))
        settings_of(Trial(settings, np.empty(0)), options)


def _frequency(value: object) -> float:
    try:
        return float(str(value))
    except ValueError:
        raise InputError(f"bandwidth is '{value}', give numbers in Hz") from None


def _lowest(
    machine: Machine, tried: Mapping[str, Sequence[object]], options: Mapping[str, Any]
) -> float | None:
    """The bandwidth by which all are judged; None: that of the first identification."""
    if _BANDWIDTH in tried:
        return min(map(_frequency, tried[_BANDWIDTH]))
    return options.get("bandwidth") or machine.estimation.bandwidth


def _left_out(
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
    inside, outside = [], []
    for motion in motions:
        edges = np.linspace(0, len(motion.time), FOLDS + 1).astype(int)
        start, stop = edges[fold], edges[fold + 1]
        outside.append(_part(motion, slice(start, stop)))
        inside += [
            _part(motion, part)
            for part in (slice(0, start), slice(stop, None))
            if len(motion.time[part]) >= _FEWEST
        ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        trial = settings_of(Trial(settings, np.empty(0)), options)
        # of parts the checks know too little; the whole has passed, or will not
        found = identify(machine, inside, **trial | {"trust": True})
        judge = Equations(
            found.model, found.base, outside, bandwidth or found.bandwidth, found.slow
        )
        return judge.compare(found.values).stacked if judge.moving.any() else np.nan


def _part(motion: Motion, part: slice) -> Motion:
    return Motion(
        motion.time[part], motion.q[part], motion.v[part], motion.a[part], motion.tau[part],
        motion.passed,
    )  # fmt: skip
