"""Limit cycles: sustained oscillations that are not commanded, of a circuit or controller."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from crane.common.samples import Array
from crane.common.scratch_arrays import release_pages
from crane.description.sensors import VELOCITY_SUFFIX
from crane.recordings.recording import REFERENCE_PREFIX, Recording

_MIN_PERIODS = 8  # least number of periods
_MIN_DECAY_RATIO = 0.85  # ratio of the last to the first swings: a damping ratio below 0.003
_MAX_PERIOD_SPREAD = 0.15  # standard deviation of the periods over their mean
_MAX_SWING_SPREAD = 0.25  # standard deviation of the half swings over their mean
_MIN_RELATIVE_AMPLITUDE = 0.01  # of the largest value of a channel, least amplitude
_MIN_PRESSURE_AMPLITUDE = 1e5  # least amplitude of a pressure [Pa]
_MIN_PERIOD_SAMPLES = 4  # least number of samples per period
_MAX_LISTED = 3  # channels in a message
_COMMAND_PREFIXES = ("load_", "voltage_")


@dataclass(frozen=True)
class LimitCycle:
    """Sustained oscillation of one channel.

    Attributes:
        channel: Name of the channel.
        start: Start [s].
        end: End of the oscillation, or of the samples [s].
        frequency: Frequency by the median period [Hz].
        amplitude: Half of the median peak-to-peak value, in the unit of the channel.
    """

    channel: str
    start: float
    end: float
    frequency: float
    amplitude: float


def sustained_oscillation(
    time: Array, values: Array, least: float, commands: Iterable[Array] = (), name: str = ""
) -> LimitCycle | None:
    """Largest oscillation of samples that lasts eight even periods without decay.

    Moving means of doubling widths are subtracted from the samples; the difference crosses zero
    twice per period. Widths of one to two and a half periods are used. An oscillation decays if
    the swings of its last quarter of eight periods are below 0.85 of those of the first; it is
    commanded if a command reverses in at least half of the periods.

    Args:
        time: Equidistant instants (N,) [s].
        values: Samples (N,).
        least: Least amplitude.
        commands: Samples (N,) of commands.
        name: Name of the channel.
    """
    least = max(least, _MIN_RELATIVE_AMPLITUDE * float(np.abs(values).max(initial=0.0)))
    found: LimitCycle | None = None
    width = _MIN_PERIOD_SAMPLES
    while width * _MIN_PERIODS <= 2.5 * len(values):
        for first, last, period in _oscillation_spans(
            values - _moving_mean(values, width), width, 0.5 * least
        ):
            amplitude = 0.5 * float(np.median(_peak_to_peak(values, first, last, period)))
            if amplitude < max(least, 0.0 if found is None else found.amplitude):
                continue
            cycles = (last - first) / period
            if any(2 * _reversal_count(command[first:last]) >= cycles for command in commands):
                continue
            length = period * float(time[last - 1] - time[first]) / (last - 1 - first)
            start, end = float(time[first]), float(time[last - 1])
            found = LimitCycle(name, start, end, 1.0 / length, amplitude)
        width *= 2
    return found


def limit_cycles(recording: Recording) -> list[LimitCycle]:
    """Limit cycles of pressures, the largest first.

    Commands are the references, without these the valve signals, and external loads.
    """
    channels, units = recording.channels, recording.channel_units
    names = [x for x in channels if x.startswith("pressure_") and units.get(x) == "Pa"]
    spacing = np.diff(recording.time)
    if not names or not len(spacing) or np.ptp(spacing) > 0.01 * spacing.mean():
        return []
    references = [
        x for x in channels if x.startswith(REFERENCE_PREFIX) and not x.endswith(VELOCITY_SUFFIX)
    ]
    prefixes = _COMMAND_PREFIXES[:1] if references else _COMMAND_PREFIXES
    references += [x for x in channels if x.startswith(prefixes)]
    commands = [channels[x] for x in references]
    found = []
    for name in names:
        release_pages()
        found.append(
            sustained_oscillation(
                recording.time, channels[name], _MIN_PRESSURE_AMPLITUDE, commands, name
            )
        )
    return sorted((x for x in found if x is not None), key=lambda one: -one.amplitude)


def limit_cycle_message(recording: Recording) -> str:
    """Message about pressures that oscillate without decay, else ""."""
    cycles = limit_cycles(recording)
    if not cycles:
        return ""
    words = [
        f"{one.channel} by {1e-5 * one.amplitude:.3g} bar at {one.frequency:.3g} Hz from t = "
        f"{one.start:.4g} to {one.end:.4g} s"
        for one in cycles[:_MAX_LISTED]
    ]
    more = f" and {len(cycles) - _MAX_LISTED} more" if len(cycles) > _MAX_LISTED else ""
    return (
        f"pressures ring without decaying, a limit cycle that the peak forces contain: "
        f"{', '.join(words)}{more}"
    )


def _moving_mean(values: Array, width: int) -> Array:
    """Means (N,) over a width of samples, at the ends over the available part."""
    total = np.concatenate([[0.0], np.cumsum(values - values.mean())])
    at = np.arange(len(values))
    low, high = np.maximum(at - width // 2, 0), np.minimum(at - width // 2 + width, len(values))
    return np.asarray((total[high] - total[low]) / (high - low) + values.mean())


def _oscillation_spans(
    deviation: Array, width: int, least: float
) -> Sequence[tuple[int, int, float]]:
    """Start, end and median period, in samples, of sustained oscillations."""
    up = deviation > 0
    edges = np.flatnonzero(up[1:] != up[:-1]) + 1  # starts of half periods
    count = 2 * _MIN_PERIODS
    if len(edges) <= count:
        return []
    sizes = np.maximum.reduceat(np.abs(deviation), edges)[:-1]  # amplitude of each half period
    # interpolated zero crossings
    exact = edges - deviation[edges] / (deviation[edges] - deviation[edges - 1])
    periods = exact[2:] - exact[:-2]
    rows = np.lib.stride_tricks.sliding_window_view(sizes, count)
    lengths = np.lib.stride_tricks.sliding_window_view(periods, count - 1)[: len(rows)]
    mean = lengths.mean(axis=1)
    quarter = count // 4
    good = rows.min(axis=1) >= least
    good &= rows[:, -quarter:].mean(axis=1) >= _MIN_DECAY_RATIO * rows[:, :quarter].mean(axis=1)
    good &= rows.std(axis=1) <= _MAX_SWING_SPREAD * rows.mean(axis=1)
    good &= lengths.std(axis=1) <= _MAX_PERIOD_SPREAD * mean
    good &= (mean >= _MIN_PERIOD_SAMPLES) & (mean <= width) & (width <= 2.5 * mean)
    marks = np.flatnonzero(np.diff(good.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    return [
        (int(edges[a]), int(edges[b - 1 + count]), float(np.median(periods[a : b + count - 2])))
        for a, b in marks.tolist()
    ]


def _peak_to_peak(values: Array, first: int, last: int, period: float) -> Array:
    """Peak-to-peak value of each period, minus the drift over it."""
    starts = np.round(np.arange(first, last - period + 1, period)).astype(int)
    high, low = (x.reduceat(values[:last], starts) for x in (np.maximum, np.minimum))
    means = np.add.reduceat(values[:last], starts) / np.diff(starts, append=last)
    drift = np.abs(np.gradient(means))
    return np.asarray(np.maximum(high - low - drift, 0.0))


def _reversal_count(command: Array) -> int:
    steps = np.diff(command)
    steps = steps[np.abs(steps) > 1e-9 * max(float(np.ptp(command)), 1e-300)]
    return int(np.count_nonzero(np.signbit(steps[1:]) != np.signbit(steps[:-1])))
