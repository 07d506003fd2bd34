"""Recordings that would mislead an identification, and why."""

import math
import warnings
from collections.abc import Mapping, Sequence

import numpy as np

from crane.common.errors import CraneWarning, RecordingError
from crane.common.samples import Array
from crane.identification.mechanics.result import Comparison
from crane.identification.signals.hum import line
from crane.identification.signals.motion import (
    Motion,
    central_differences,
    check_gaps,
    low_pass,
    resample,
    sampling,
)
from crane.identification.signals.outliers import outliers, repaired

_FEWEST = 50  # samples
_COMPARED = 10.0  # [Hz] up to which recorded velocities and positions are compared
_EQUAL = 0.01  # of a correlation
_SEARCHED = 1.0  # [s] longest delay that is looked for
_OUTLIERS = 0.05  # share of a column's samples above which it is refused
_FACTOR = 30.0  # by which a force may be off from what the model says
_SHAPE = 0.9  # correlation from which a model is believed on a factor
_BLOCKS = 10  # of time, whose scatter is the standard error of that factor
_WORSE = 4.0  # times the training's error, from which a validation is remarked on
_CERTAIN = 0.999  # probability of a delay that is told
_OTHER = {"rad": ("deg", 180 / math.pi), "m": ("mm", 1e3)}  # units that are taken for SI


def delay(time: Array, one: Array, other: Array) -> float:
    """By how many seconds the second signal (N,) comes after the first, at most 1 s.

    Where the correlation of what overlaps has its maximum, refined by a parabola.
    """
    from scipy.signal import correlate

    step = sampling(time)
    one, other = one - one.mean(), other - other.mean()
    shifts = np.arange(-(reach := min(round(_SEARCHED / step), len(time) // 4)), reach + 1)
    products = correlate(other, one, method="fft")[shifts + len(time) - 1]
    first, second = (np.append(0, np.cumsum(x**2)) for x in (one, other))
    low, high = np.maximum(shifts, 0), len(time) + np.minimum(shifts, 0)
    energy = (first[high - shifts] - first[low - shifts]) * (second[high] - second[low])
    near = products / np.sqrt(np.maximum(energy, 1e-12 * first[-1] * second[-1] + 1e-300))
    # of equal ones, as of periodic signals, the shortest
    best = np.flatnonzero(near >= near.max() - _EQUAL)
    at = int(np.clip(best[np.abs(shifts[best]).argmin()], 1, 2 * reach - 1))
    if near[at - 1 : at + 2].argmax() != 1:  # on the slope of the shortest
        up = 1 if near[at + 1] > near[at] else -1
        while 1 < at < 2 * reach - 1 and near[at + up] > near[at]:
            at += up
    before, here, after = near[at - 1 : at + 2]
    bend = before - 2 * here + after
    shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return float((at - reach + shift) * step)


def doubt(text: str, trust: bool) -> None:
    """Refuse a recording that is most likely wrong, or only tell why, where it is trusted.

    Raises:
        RecordingError: It is not trusted.
    """
    if not trust:
        raise RecordingError(f"{text}; if the recording is right, trust it (trust=True, --trust)")
    warnings.warn(f"{text}: trusted", CraneWarning, stacklevel=3)


def check_samples(time: Array, columns: Mapping[str, Array]) -> None:
    """Refuse a recording of too few samples, or with gaps or missing numbers in columns (N,).

    Raises:
        RecordingError: The message names column and time.
    """
    if len(time) < _FEWEST:
        raise RecordingError(f"{len(time)} samples are too few, record at least {_FEWEST}")
    for name, column in columns.items():
        _check_finite(time, column, name)
    check_gaps(time)


def without_outliers(
    time: Array, columns: Mapping[str, Array], trust: bool = False
) -> dict[str, Array]:
    """Columns (N,) without samples that stand out: lines between their neighbours instead.

    Before any filter, which would smear them. Columns of a trusted recording stay as they are.

    Raises:
        RecordingError: A column has too many of them.
    """
    found, told = {}, []
    for name, column in columns.items():
        bad = np.zeros(0, dtype=bool) if trust else outliers(column)
        found[name] = repaired(column, bad) if bad.any() else column
        if not bad.any():
            continue
        first = f"the first at {time[bad.argmax()]:.6g} s"
        if bad.mean() > _OUTLIERS:
            doubt(f"'{name}' has {bad.sum()} outliers in {len(bad)} samples, {first}", trust)
        told.append(f"{bad.sum()} in '{name}' ({first})")
    if told:
        text = f"outliers are left out and bridged: {', '.join(told)} of {len(time)} samples"
        warnings.warn(text, CraneWarning, stacklevel=3)
    return found


def tell_hum(time: Array, columns: Mapping[str, Array], lowest: float) -> None:
    """Warn of lines in the spectra of columns (N,), above a frequency [Hz] where nothing moves."""
    step, told = float(np.median(np.diff(time))), []
    for name, column in columns.items():
        if np.ptp(column) > 0 and (found := line(column, step, lowest)) is not None:
            share = 100 * found[1] / float(np.std(column))
            told.append(f"'{name}' of {found[0]:.3g} Hz ({found[1]:.3g}, {share:.2g} % of it)")
    if told:
        text = f"hum in {', '.join(told)}: keep the bandwidth well below it"
        warnings.warn(text, CraneWarning, stacklevel=3)


def tell_delays(
    joints: Sequence[str], late: Array, std: Array, blocks: int, longest_delay: float = 0.05
) -> None:
    """Warn of forces that come late, by what `delays.delays` found (n,) [s].

    Early ones only where friction cannot be the reason: by more than `longest_delay`.
    """
    from scipy.stats import t

    if not blocks:
        return
    limit, told = float(t.ppf(_CERTAIN, blocks - 1)), []
    for joint, seconds, error in zip(joints, late, std, strict=True):
        if seconds > limit * error or seconds < -max(longest_delay, limit * error):
            side = "behind" if seconds > 0 else "ahead of"
            told.append(
                f"'{joint}_force' is {1e3 * abs(seconds):.0f} ms (+- {1e3 * error:.1g}) {side} its"
                " motion"
            )
    if told:
        text = f"{', '.join(told)}: record them with one clock, or shift them"
        warnings.warn(text, CraneWarning, stacklevel=3)


def tell_validation(training: Comparison, validation: Comparison) -> None:
    """Warn where a fit predicts far worse than it fits, both relative and in N or N m."""
    told = []
    pairs = zip(
        training.joints, training.relative, validation.relative, training.rmse, validation.rmse,
        strict=True,
    )  # fmt: skip
    for joint, fitted, judged, rmse, other in pairs:
        if judged > _WORSE * fitted and other > _WORSE * rmse:
            told.append(f"'{joint}' {judged / fitted:.3g} times ({100 * judged:.3g} %)")
    if told:
        text = (
            f"errors on the validation are far above those on the training: {', '.join(told)}: "
            "the recordings do not belong together, or too little is told by the first one"
        )
        warnings.warn(text, CraneWarning, stacklevel=3)


def check(
    time: Array,
    q: Array,
    tau: Array,
    joints: Sequence[str],
    units: Mapping[str, str],
    v: Array | None = None,
    limits: Array | None = None,
    longest_delay: float = 0.05,
    trust: bool = False,
) -> None:
    """Refuse a recording that cannot serve an identification.

    Args:
        time: Instants (N,) [s].
        q: Coordinates (N, n).
        tau: Generalized forces (N, n).
        joints: Names (n,).
        units: "rad" or "m" of each coordinate.
        v: Recorded velocities (N, n), compared with those of q.
        limits: Lowest and highest coordinate (n, 2).
        longest_delay: [s] between recorded velocity and q; a filter in the sensor makes some.
        trust: Whether to tell only what is most likely wrong, and refuse what cannot be used.

    Raises:
        RecordingError: Too few samples, gaps, numbers missing, no motion, wrong units, or
            columns that do not belong together; the message names the column.
    """
    columns = [("", q), ("_force", tau)] + ([] if v is None else [("_velocity", v)])
    named = {
        joint + suffix: column
        for suffix, values in columns
        for joint, column in zip(joints, values.T, strict=True)
    }
    check_samples(time, named)
    # Of noise alone, steps between samples have twice its variance.
    if all(np.ptp(x) == 0 or np.var(np.diff(x)) >= np.var(x) for x in q.T):
        raise RecordingError("no joint moves, record a motion")
    for i, joint in enumerate(joints):
        if np.ptp(tau[:, i]) == 0 and np.ptp(q[:, i]) > 0:
            doubt(f"'{joint}_force' is constant while '{joint}' moves, check it", trust)
        if limits is not None:
            _check_range(q[:, i], limits[i], joint, units[joint], trust)
        if v is not None and np.var(np.diff(q[:, i])) < np.var(q[:, i]):
            _check_velocity(time, q[:, i], v[:, i], joint, units[joint], longest_delay, trust)


def check_forces(
    motion: Motion,
    modelled: Array,
    joints: Sequence[str],
    longest_delay: float = 0.05,
    trust: bool = False,
) -> None:
    """Compare recorded forces with those (N, n) of a model, of rough parameters even.

    What friction and rotors can make counts for nothing: the scale c of a joint is that of the
    regression tau = c modelled + c0 + c1 sign(v) + c2 v + c3 |v| + c4 a, its standard error the
    scatter of ten blocks of time. Where the model has hardly a share in the force besides, c says
    nothing, and a force that is many times the model's is a doubt that is told, not refused.

    Raises:
        RecordingError: It is sure that they differ by more than a factor of thirty, in sign, or
            that they come late or early.
    """
    doubtful = []
    for i, joint in enumerate(joints):
        measured, expected = motion.tau[:, i], modelled[:, i]
        if np.ptp(expected) == 0 or np.ptp(measured) == 0:
            continue
        scale, error, alike = _scale(measured, expected, motion.v[:, i], motion.a[:, i])
        size = abs(scale)
        if alike > _SHAPE and not 1 / _FACTOR < size < _FACTOR and error < size / 4:
            power = math.log10(max(size, 1e-300))
            looks = "look at its unit and its gear ratio"
            if 2.3 < abs(power) < 3.7:
                looks = f"it looks {'1000-fold' if power > 0 else 'like kN'}, give SI units"
            doubt(f"'{joint}_force' is {scale:.3g} times the model's, {looks}", trust)
            continue
        if alike > _SHAPE and scale < -4 * error and size > 1 / _FACTOR:
            text = f"'{joint}_force' is {scale:.2g} times the model's, turn its sign"
            doubt(text, trust)
            continue
        ratio = math.sqrt(np.mean(measured**2) / np.mean(expected**2))
        known = 1 / _FACTOR < size < _FACTOR and error < size / 2
        if not known and not 1 / _FACTOR < ratio < _FACTOR:
            doubtful.append(f"'{joint}_force' is {ratio:.3g} times the model's")
        late = delay(motion.time, expected, measured)
        # a rough model is believed on a delay only if that explains nearly everything: a force
        # that friction makes looks like inertia's a quarter period later
        if not 0.5 < ratio < 2.0:
            continue
        near = _alike(expected, measured, round(late / sampling(motion.time)))
        if abs(late) > longest_delay and near > max(0.9, _alike(expected, measured, 0) + 0.05):
            doubt(_shifted(f"{joint}_force", late, "its model"), trust)
    if doubtful:
        text = (
            f"{', '.join(doubtful)}: friction and rotors may outweigh the bodies there, or the "
            "unit is wrong, this recording cannot say"
        )
        warnings.warn(text, CraneWarning, stacklevel=3)


def _scale(y: Array, x: Array, v: Array, a: Array) -> tuple[float, float, float]:
    """Scale of y against x with friction and rotors beside it, standard error, correlation."""
    others = np.column_stack([np.ones_like(v), np.sign(v), v, np.abs(v), a])
    size = np.linalg.norm(others, axis=0)
    U, values, _ = np.linalg.svd(others / np.where(size > 0, size, 1.0), full_matrices=False)
    U = U[:, values > 1e-9 * values[0]]
    left, energy = [], []
    for column in (y, x):
        rest = column - U @ (U.T @ column)
        left.append(rest)
        energy.append(float(rest @ rest))
        if energy[-1] < 1e-18 * float(column @ column):  # all of it is friction's
            return 0.0, math.inf, 0.0
    scale = float(left[0] @ left[1]) / energy[1]
    off = left[1] * (left[0] - scale * left[1])
    parts = np.array([part.sum() for part in np.array_split(off, _BLOCKS)])
    error = math.sqrt(float(parts @ parts) * _BLOCKS / (_BLOCKS - 1)) / energy[1]
    return scale, error, abs(scale) * math.sqrt(energy[1] / energy[0])


def _alike(one: Array, other: Array, shift: int) -> float:
    """Correlation of one signal with another that comes so many samples later."""
    count = len(one) - abs(shift)
    late = max(shift, 0), max(-shift, 0)
    return float(np.corrcoef(one[late[1] :][:count], other[late[0] :][:count])[0, 1])


def _check_finite(time: Array, column: Array, name: str) -> None:
    bad = ~np.isfinite(column)
    if bad.any():
        first = int(bad.argmax())
        last = first + int(np.append(~bad[first:], True).argmax()) - 1
        raise RecordingError(
            f"'{name}' holds no number from {time[first]:g} to {time[last]:g} s "
            f"({bad.sum()} samples in all), cut the recording there"
        )


def _check_range(x: Array, limits: Array, joint: str, unit: str, trust: bool) -> None:
    low, high = limits
    slack = 0.1 * (high - low)

    def inside(values: Array) -> bool:
        return low - slack <= values.min() and values.max() <= high + slack

    if not inside(x):
        other, factor = _OTHER[unit]
        taken = inside(x / factor) and np.ptp(x) > 0.02 * factor * (high - low)
        looks = f"it looks like {other}" if taken else "check its zero and unit"
        doubt(
            f"'{joint}' goes from {x.min():.4g} to {x.max():.4g} {unit}, its limits are "
            f"{low:.4g} and {high:.4g} {unit}, {looks}",
            trust,
        )


def _check_velocity(
    time: Array, x: Array, v: Array, joint: str, unit: str, longest_delay: float, trust: bool
) -> None:
    """Compare a velocity with the derivative of its coordinate, both up to 10 Hz."""
    time, columns = resample(time, np.column_stack([x, v]), float(np.median(np.diff(time))))
    step = sampling(time)
    if 0.4 / step > _COMPARED:
        columns = low_pass(time, columns, _COMPARED)
    derivative, v = central_differences(time, columns[:, 0]), columns[:, 1]
    # what is less than a micrometre in the sampled time is noise or rounding, not motion
    if np.std(columns[:, 0]) < 1e-6:
        return
    ratio = math.sqrt(np.mean(v**2) / np.mean(derivative**2))
    other, factor = _OTHER[unit]
    for wrong, scale in ((f"{joint}_velocity", factor), (joint, 1 / factor)):
        if 0.8 < ratio / scale < 1.25:
            return doubt(
                f"'{joint}_velocity' is {ratio:.3g} times the derivative of '{joint}', "
                f"'{wrong}' looks like {other}, give {unit}",
                trust,
            )
    late = delay(time, derivative, v)
    shift = round(late / step)
    first, second = (derivative, v) if shift >= 0 else (v, derivative)
    overlap = len(v) - abs(shift)
    first, second = first[:overlap], second[abs(shift) :]
    correlation = float(np.corrcoef(first, second)[0, 1]) if np.ptp(v) > 0 else 0.0
    if correlation < 0.7 or not 0.5 < ratio < 2:
        return doubt(
            f"'{joint}_velocity' is not the derivative of '{joint}' (correlation "
            f"{correlation:.2f}, ratio {ratio:.3g}), check the columns",
            trust,
        )
    if abs(late) > longest_delay:
        doubt(_shifted(f"{joint}_velocity", late, f"'{joint}'"), trust)
    return None


def _shifted(name: str, late: float, reference: str) -> str:
    side = "behind" if late > 0 else "ahead of"
    return f"'{name}' is {abs(late) * 1e3:.0f} ms {side} {reference}, record them with one clock"
