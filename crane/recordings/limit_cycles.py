"""Oscillations that neither decay nor are commanded: limit cycles of a circuit or a controller."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from crane.common.samples import Array
from crane.common.scratch_arrays import release_pages
from crane.description.sensors import VELOCITY_SUFFIX
from crane.recordings.recording import REFERENCE_PREFIX, Recording

_CYCLES = 8  # periods that an oscillation lasts at least
_KEPT = 0.85  # of its swing over these: a damping ratio of less than 0.003
_EVEN = 0.15  # standard deviation of its periods over their mean
_ALIKE = 0.25  # the same of its half swings
_SMALL = 0.01  # of a channel's largest size, below which no swing is told
_LEAST = 1e5  # amplitude of a pressure that is told [Pa]
_SHORTEST = 4  # samples of a period
_SHOWN = 3  # channels that are named
_COMMANDS = ("load_", "voltage_")


@dataclass(frozen=True)
class LimitCycle:
    """A sustained oscillation of one channel.

    Attributes:
        channel: Its name.
        start: When it begins [s].
        end: When it ends, or the samples do [s].
        frequency: One over the median period [Hz].
        amplitude: Half of the median swing of a period, in the channel's unit.
    """

    channel: str
    start: float
    end: float
    frequency: float
    amplitude: float


def sustained(
    time: Array, values: Array, least: float, commands: Iterable[Array] = (), name: str = ""
) -> LimitCycle | None:
    """The largest oscillation of some samples that lasts eight even periods without decaying.

    Moving means of doubling widths w are taken off the samples; what is left crosses zero twice
    per period. Of the widths those count that are one to two and a half periods long. A swing
    whose last quarter of eight periods is below 0.85 of the first one decays; one over which a
    command turns in half of the periods or more is commanded.

    Args:
        time: Instants (N,), evenly spaced [s].
        values: Samples (N,).
        least: Amplitude from which on it is told.
        commands: Samples (N,) of what the motion is told to do.
        name: Of the channel.
    """
    least = max(least, _SMALL * float(np.abs(values).max(initial=0.0)))
    found: LimitCycle | None = None
    width = _SHORTEST
    while width * _CYCLES <= 2.5 * len(values):
        left = values - _moving_mean(values, width)
        for first, last, period in _spans(left, width, 0.5 * least):
            swings = _swings(values, first, last, period)
            amplitude = 0.5 * float(np.median(swings))
            if amplitude < max(least, 0.0 if found is None else found.amplitude):
                continue
            cycles = (last - first) / period
            if any(2 * _turns(command[first:last]) >= cycles for command in commands):
                continue
            length = period * float(time[last - 1] - time[first]) / (last - 1 - first)
            start, end = float(time[first]), float(time[last - 1])
            found = LimitCycle(name, start, end, 1.0 / length, amplitude)
        width *= 2
    return found


def limit_cycles(recording: Recording) -> list[LimitCycle]:
    """Pressures that swing on at one frequency without being told to, the largest first.

    What the motion is told are its references, and without these the valves' voltages, and loads
    from outside.
    """
    seen, units = recording.channels, recording.channel_units
    names = [x for x in seen if x.startswith("pressure_") and units.get(x) == "Pa"]
    spacing = np.diff(recording.time)
    if not names or not len(spacing) or np.ptp(spacing) > 0.01 * spacing.mean():
        return []
    told = [x for x in seen if x.startswith(REFERENCE_PREFIX) and not x.endswith(VELOCITY_SUFFIX)]
    heads = _COMMANDS[:1] if told else _COMMANDS
    told += [x for x in seen if x.startswith(heads)]
    found = []
    for name in names:
        release_pages()
        cycle = sustained(recording.time, seen[name], _LEAST, [seen[x] for x in told], name)
        found += [cycle] if cycle is not None else []
    return sorted(found, key=lambda one: -one.amplitude)


def ringing(recording: Recording) -> str:
    """What to say of pressures that swing without decaying, else nothing."""
    cycles = limit_cycles(recording)
    if not cycles:
        return ""
    words = [
        f"{one.channel} by {1e-5 * one.amplitude:.3g} bar at {one.frequency:.3g} Hz from t = "
        f"{one.start:.4g} to {one.end:.4g} s"
        for one in cycles[:_SHOWN]
    ]
    more = f" and {len(cycles) - _SHOWN} more" if len(cycles) > _SHOWN else ""
    return (
        f"pressures ring without decaying, a limit cycle that the peak forces contain: "
        f"{', '.join(words)}{more}"
    )


def _moving_mean(values: Array, width: int) -> Array:
    """Means (N,) over a width of samples, at the ends over what there is of it."""
    total = np.concatenate([[0.0], np.cumsum(values - values.mean())])
    at = np.arange(len(values))
    low, high = np.maximum(at - width // 2, 0), np.minimum(at - width // 2 + width, len(values))
    return np.asarray((total[high] - total[low]) / (high - low) + values.mean())


def _spans(left: Array, width: int, least: float) -> Sequence[tuple[int, int, float]]:
    """First sample, the one behind the last, and median period in samples of what is sustained."""
    up = left > 0
    edges = np.flatnonzero(up[1:] != up[:-1]) + 1  # where half periods begin
    count = 2 * _CYCLES
    if len(edges) <= count:
        return []
    sizes = np.maximum.reduceat(np.abs(left), edges)[:-1]  # of each half period
    # crossings between the samples, so that periods of a few of these are even
    exact = edges - left[edges] / (left[edges] - left[edges - 1])
    periods = exact[2:] - exact[:-2]
    rows = np.lib.stride_tricks.sliding_window_view(sizes, count)
    lengths = np.lib.stride_tricks.sliding_window_view(periods, count - 1)[: len(rows)]
    mean = lengths.mean(axis=1)
    quarter = count // 4
    good = rows.min(axis=1) >= least
    good &= rows[:, -quarter:].mean(axis=1) >= _KEPT * rows[:, :quarter].mean(axis=1)
    good &= rows.std(axis=1) <= _ALIKE * rows.mean(axis=1)
    good &= lengths.std(axis=1) <= _EVEN * mean
    good &= (mean >= _SHORTEST) & (mean <= width) & (width <= 2.5 * mean)
    marks = np.flatnonzero(np.diff(good.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    return [
        (int(edges[a]), int(edges[b - 1 + count]), float(np.median(periods[a : b + count - 2])))
        for a, b in marks.tolist()
    ]


def _swings(values: Array, first: int, last: int, period: float) -> Array:
    """Largest less smallest sample of each period, less what the samples drift over it."""
    starts = np.round(np.arange(first, last - period + 1, period)).astype(int)
    high, low = (x.reduceat(values[:last], starts) for x in (np.maximum, np.minimum))
    means = np.add.reduceat(values[:last], starts) / np.diff(starts, append=last)
    drift = np.abs(np.gradient(means))
    return np.asarray(np.maximum(high - low - drift, 0.0))


def _turns(command: Array) -> int:
    """How often some samples turn."""
    steps = np.diff(command)
    steps = steps[np.abs(steps) > 1e-9 * max(float(np.ptp(command)), 1e-300)]
    return int(np.count_nonzero(np.signbit(steps[1:]) != np.signbit(steps[:-1])))
