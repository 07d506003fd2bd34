"""Recordings that would mislead an identification, and why."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from crane.errors import RecordingError
from crane.identification.signals import (
    central_differences,
    check_gaps,
    low_pass,
    resample,
    sampling,
)
from crane.samples import Array

_FEWEST = 50  # samples
_COMPARED = 10.0  # [Hz] up to which recorded velocities and positions are compared
_EQUAL = 0.01  # of a correlation
_SEARCHED = 1.0  # [s] longest delay that is looked for
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
    near = products / np.sqrt(energy)
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


def check(
    time: Array,
    q: Array,
    tau: Array,
    joints: Sequence[str],
    units: Mapping[str, str],
    v: Array | None = None,
    limits: Array | None = None,
    longest_delay: float = 0.05,
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

    Raises:
        RecordingError: Too few samples, gaps, numbers missing, no motion, wrong units, or
            columns that do not belong together; the message names the column.
    """
    if len(time) < _FEWEST:
        raise RecordingError(f"{len(time)} samples are too few, record at least {_FEWEST}")
    columns = [("", q), ("_force", tau)] + ([] if v is None else [("_velocity", v)])
    for suffix, values in columns:
        for joint, column in zip(joints, values.T, strict=True):
            _check_finite(time, column, joint + suffix)
    check_gaps(time)
    # Of noise alone, steps between samples have twice its variance.
    if all(np.ptp(x) == 0 or np.var(np.diff(x)) >= np.var(x) for x in q.T):
        raise RecordingError("no joint moves, record a motion")
    for i, joint in enumerate(joints):
        if np.ptp(tau[:, i]) == 0 and np.ptp(q[:, i]) > 0:
            raise RecordingError(f"'{joint}_force' is constant while '{joint}' moves, check it")
        if limits is not None:
            _check_range(q[:, i], limits[i], joint, units[joint])
        if v is not None and np.var(np.diff(q[:, i])) < np.var(q[:, i]):
            _check_velocity(time, q[:, i], v[:, i], joint, units[joint], longest_delay)


def check_forces(
    time: Array, tau: Array, modelled: Array, joints: Sequence[str], longest_delay: float = 0.05
) -> None:
    """Compare recorded forces (N, n) with those of a model, of rough parameters even.

    Raises:
        RecordingError: They differ by more than a factor of thirty, or come late or early.
    """
    for i, joint in enumerate(joints):
        measured, expected = tau[:, i], modelled[:, i]
        if np.ptp(expected) == 0 or np.ptp(measured) == 0:
            continue
        scale = math.sqrt(np.mean(measured**2) / np.mean(expected**2))
        power = math.log10(max(scale, 1e-300))
        if abs(power) > 1.5:
            looks = "look at its unit"
            if 2.3 < abs(power) < 3.7:
                looks = f"it looks {'1000-fold' if power > 0 else 'like kN'}, give SI units"
            raise RecordingError(f"'{joint}_force' is {scale:.3g} times the model's, {looks}")
        late = delay(time, expected, measured)
        # a rough model is believed on a delay only if that explains nearly everything: a force
        # that friction makes looks like inertia's a quarter period later
        if not 0.5 < scale < 2.0:
            continue
        near = _alike(expected, measured, round(late / sampling(time)))
        if abs(late) > longest_delay and near > max(0.9, _alike(expected, measured, 0) + 0.05):
            raise RecordingError(_shifted(f"{joint}_force", late, "its model"))


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


def _check_range(x: Array, limits: Array, joint: str, unit: str) -> None:
    low, high = limits
    slack = 0.1 * (high - low)

    def inside(values: Array) -> bool:
        return low - slack <= values.min() and values.max() <= high + slack

    if not inside(x):
        other, factor = _OTHER[unit]
        taken = inside(x / factor) and np.ptp(x) > 0.02 * factor * (high - low)
        looks = f"it looks like {other}" if taken else "check its zero and unit"
        raise RecordingError(
            f"'{joint}' goes from {x.min():.4g} to {x.max():.4g} {unit}, its limits are "
            f"{low:.4g} and {high:.4g} {unit}, {looks}"
        )


def _check_velocity(
    time: Array, x: Array, v: Array, joint: str, unit: str, longest_delay: float
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
            raise RecordingError(
                f"'{joint}_velocity' is {ratio:.3g} times the derivative of '{joint}', "
                f"'{wrong}' looks like {other}, give {unit}"
            )
    late = delay(time, derivative, v)
    shift = round(late / step)
    first, second = (derivative, v) if shift >= 0 else (v, derivative)
    overlap = len(v) - abs(shift)
    first, second = first[:overlap], second[abs(shift) :]
    correlation = float(np.corrcoef(first, second)[0, 1]) if np.ptp(v) > 0 else 0.0
    if correlation < 0.7 or not 0.5 < ratio < 2:
        raise RecordingError(
            f"'{joint}_velocity' is not the derivative of '{joint}' (correlation "
            f"{correlation:.2f}, ratio {ratio:.3g}), check the columns"
        )
    if abs(late) > longest_delay:
        raise RecordingError(_shifted(f"{joint}_velocity", late, f"'{joint}'"))


def _shifted(name: str, late: float, reference: str) -> str:
    side = "behind" if late > 0 else "ahead of"
    return f"'{name}' is {abs(late) * 1e3:.0f} ms {side} {reference}, record them with one clock"
