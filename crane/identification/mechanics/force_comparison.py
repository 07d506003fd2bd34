"""Comparison of measured and modelled forces: errors, checks of recordings."""

import itertools
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from crane.common.errors import CraneWarning
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.identification.signals.signal_processing import Motion, sampling_step
from crane.identification.signals.signal_quality import (
    reject_delay,
    reject_unless_trusted,
    shifted_correlation,
    signal_delay,
)
from crane.recordings.recording import Recording

STANDSTILL_SHARE = 0.05  # of a joint's largest velocity, below which rows are omitted
_MAX_FORCE_FACTOR = 30.0  # largest ratio of a force to that of the model
_MIN_CORRELATION = 0.9  # least correlation for a significant factor
_BLOCK_COUNT = 10  # of time, for the standard error of that factor
_VALIDATION_FACTOR = 4.0  # times the error on training data, above which a warning is given
_NEGLIGIBLE_ERROR = 1e-6  # negligible error relative to the forces
_MAX_SHARED_SHARE = 0.2  # of the samples of a recording that another one may contain
_COMPARED_SAMPLES = 2000  # compared samples


@dataclass(frozen=True, eq=False, repr=False)
class ForceComparison(OneLineRepr):
    """Measured and modelled forces of one recording after the same filter.

    Attributes:
        time: (M,) [s].
        measured: (M, n) measured forces [N], [N m].
        modelled: (M, n) modelled forces.
        is_moving: (M, n) mask of the rows away from standstill.
        joints: (n,) names.
        in_motion: (M, n) mask of all rows with a speed above the least, also within the reach of
            the filter from standstill; None: those of `is_moving`.
    """

    time: Array
    measured: Array
    modelled: Array
    is_moving: np.ndarray
    joints: tuple[str, ...]
    in_motion: np.ndarray | None = None

    @property
    def motion_error(self) -> Array:
        """Relative error (n,) of all rows in motion, nan of a free joint."""
        if self.in_motion is None:
            return self.relative_error
        return replace(self, is_moving=self.in_motion, in_motion=None).relative_error

    @property
    def residuals(self) -> Array:
        """Residuals (M, n): measured minus modelled forces."""
        return self.measured - self.modelled

    def _rms(self, values: Array) -> Array:
        squares = (np.where(self.is_moving, values, 0.0) ** 2).sum(axis=0)
        count = self.is_moving.sum(axis=0)
        return np.sqrt(
            np.divide(squares, count, out=np.full_like(squares, np.nan), where=count > 0)
        )

    @property
    def rmse(self) -> Array:
        """Root mean square (n,) of the residuals [N], [N m], nan for joints without motion."""
        return self._rms(self.residuals)

    @property
    def relative_error(self) -> Array:
        """RMS of the residuals over that of the measured force (n,), nan of a free joint."""
        size = self._rms(self.measured)
        return np.divide(self.rmse, size, out=np.full_like(size, np.nan), where=size > 0)

    @property
    def percentage_error(self) -> Array:
        """Error (n,) of equation (9) of the reduced-scale forwarder paper [%]: 100 relative^2."""
        return 100 * self.relative_error**2

    @property
    def overall_relative_error(self) -> float:
        """Norm of all residuals over that of all measured forces, nan if these are zero."""
        residual_norm, force_norm = (
            np.linalg.norm(x[self.is_moving]) for x in (self.residuals, self.measured)
        )
        return float(residual_norm / force_norm) if force_norm else math.nan


def check_forces(
    motion: Motion,
    modelled: Array,
    joints: Sequence[str],
    longest_delay: float = 0.05,
    trust: bool = False,
) -> None:
    """Check recorded forces against those (N, n) of a model with rough parameters.

    Effects of friction and rotors are excluded: the scale c of a joint is that of the regression
    tau = c modelled + c0 + c1 sign(v) + c2 v + c3 |v| + c4 a, with the standard error by ten
    blocks of time. If the model explains little of the remaining force, c is not significant, and
    a force of many times the model's causes a warning only.

    Raises:
        RecordingError: The forces differ significantly by more than a factor of thirty, in sign,
            or by a delay.
    """
    messages = []
    for i, joint in enumerate(joints):
        measured, expected = motion.tau[:, i], modelled[:, i]
        if np.ptp(expected) == 0 or np.ptp(measured) == 0:
            continue
        scale, error, correlation = _force_scale(
            measured, expected, motion.v[:, i], motion.a[:, i]
        )
        size = abs(scale)
        if (
            correlation > _MIN_CORRELATION
            and not 1 / _MAX_FORCE_FACTOR < size < _MAX_FORCE_FACTOR
            and error < size / 4
        ):
            power = math.log10(max(size, 1e-300))
            looks = "look at its unit and its gear ratio"
            if 2.3 < abs(power) < 3.7:
                looks = f"it looks {'1000-fold' if power > 0 else 'like kN'}, give SI units"
            reject_unless_trusted(
                f"'{joint}_force' is {scale:.3g} times the model's, {looks}", trust
            )
            continue
        if correlation > _MIN_CORRELATION and scale < -4 * error and size > 1 / _MAX_FORCE_FACTOR:
            reject_unless_trusted(
                f"'{joint}_force' is {scale:.2g} times the model's, turn its sign", trust
            )
            continue
        ratio = math.sqrt(np.mean(measured**2) / np.mean(expected**2))
        is_known = 1 / _MAX_FORCE_FACTOR < size < _MAX_FORCE_FACTOR and error < size / 2
        if not is_known and not 1 / _MAX_FORCE_FACTOR < ratio < _MAX_FORCE_FACTOR:
            messages.append(f"'{joint}_force' is {ratio:.3g} times the model's")
        lag = signal_delay(motion.time, expected, measured)
        # a rough model gives a delay only if the shift explains nearly everything: friction looks
        # like inertia a quarter of a period later
        if not 0.5 < ratio < 2.0:
            continue
        # static friction balances whatever acts: rows in motion have to confirm it
        speed = np.abs(motion.v[:, i])
        moving = np.flatnonzero(speed >= STANDSTILL_SHARE * speed.max())
        shift = round(lag / sampling_step(motion.time))
        if abs(lag) > longest_delay and all(
            shifted_correlation(expected, measured, shift, rows)
            > max(0.9, shifted_correlation(expected, measured, 0, rows) + 0.05)
            for rows in (None, moving)
        ):
            reject_delay(f"{joint}_force", lag, "its model", trust)
    if messages:
        warnings.warn(
            f"{', '.join(messages)}: friction and rotors may outweigh the bodies there, or the "
            "unit is wrong, this recording cannot say",
            CraneWarning,
            stacklevel=3,
        )


def warn_validation(training: ForceComparison, validation: ForceComparison) -> None:
    """Warn if errors on held-out data are far above those on training data."""
    messages = []
    pairs = zip(
        training.joints,
        training.relative_error,
        validation.relative_error,
        training.rmse,
        validation.rmse,
        strict=True,
    )
    for joint, training_error, validation_error, rmse, validation_rmse in pairs:
        if (
            validation_error > max(_VALIDATION_FACTOR * training_error, _NEGLIGIBLE_ERROR)
            and validation_rmse > _VALIDATION_FACTOR * rmse
        ):
            messages.append(
                f"'{joint}' {validation_error / training_error:.3g} times "
                f"({100 * validation_error:.3g} %)"
            )
    if messages:
        warnings.warn(
            "errors on the validation are far above those on the training: "
            f"{', '.join(messages)}: the recordings do not belong together, or the training data "
            "determine too little",
            CraneWarning,
            stacklevel=3,
        )


def check_shared_samples(
    recordings: Sequence[Recording | Motion],
    validation: Sequence[Recording | Motion],
    trust: bool = False,
) -> None:
    """Reject repeated training data, and warn of held-out data that are training data.

    Raises:
        RecordingError: Two of the recordings share instants and forces.
    """
    for (i, one), (j, other) in itertools.combinations(enumerate(recordings, start=1), 2):
        if (share := _shared_share(one, other)) > _MAX_SHARED_SHARE:
            reject_unless_trusted(
                f"{share:.0%} of recording {j}'s samples are in recording {i} as well: used "
                "twice they make intervals too narrow, give each once",
                trust,
            )
    share = max(
        (_shared_share(*pair) for pair in itertools.product(recordings, validation)), default=0
    )
    if share > _MAX_SHARED_SHARE:
        warnings.warn(
            f"{share:.0%} of the held-out samples are training data: their errors do not apply to "
            "other motions, give other data",
            CraneWarning,
            stacklevel=3,
        )


def _shared_share(one: Recording | Motion, other: Recording | Motion) -> float:
    """Share of the other's samples that one contains at the same time with the same forces.

    Only samples with changing forces are used, as simulations from rest begin alike.
    """
    some = slice(None, None, max(1, len(other.time) // _COMPARED_SAMPLES))
    time, tau = other.time[some], other.tau[some]
    if one.tau.shape[1] != tau.shape[1]:
        return 0.0
    at = np.minimum(np.searchsorted(one.time, time), len(one.time) - 1)
    same = (one.time[at] == time) & (one.tau[at] == tau).all(axis=1)
    changing = (tau[1:] != tau[:-1]).any(axis=1)
    return float(np.mean(same[1:][changing])) if changing.any() else 0.0


def _force_scale(y: Array, x: Array, v: Array, a: Array) -> tuple[float, float, float]:
    """Scale of y against x beside friction and rotors, its standard error, and correlation."""
    others = np.column_stack([np.ones_like(v), np.sign(v), v, np.abs(v), a])
    size = np.linalg.norm(others, axis=0)
    U, values, _ = np.linalg.svd(others / np.where(size > 0, size, 1.0), full_matrices=False)
    U = U[:, values > 1e-9 * values[0]]
    residuals, energy = [], []
    for column in (y, x):
        rest = column - U @ (U.T @ column)
        residuals.append(rest)
        energy.append(float(rest @ rest))
        if energy[-1] < 1e-18 * float(column @ column):  # explained by friction alone
            return 0.0, math.inf, 0.0
    scale = float(residuals[0] @ residuals[1]) / energy[1]
    products = residuals[1] * (residuals[0] - scale * residuals[1])
    parts = np.array([part.sum() for part in np.array_split(products, _BLOCK_COUNT)])
    error = math.sqrt(float(parts @ parts) * _BLOCK_COUNT / (_BLOCK_COUNT - 1)) / energy[1]
    return scale, error, abs(scale) * math.sqrt(energy[1] / energy[0])
