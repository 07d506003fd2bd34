"""Limit cycles: sustained oscillations that are not commanded, of a circuit or controller."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from crane.common.samples import Array, true_runs
from crane.common.scratch_arrays import release_pages
from crane.description.sensors import VELOCITY_SUFFIX
from crane.recordings.recording import REFERENCE_PREFIX, Recording

_MIN_PERIODS = 8  # least number of periods
_MIN_DECAY_RATIO = 0.85  # of swings eight periods apart: a damping ratio below 0.0032
_MIN_TIME_SHARE = 0.5  # of the time without a change of command, least duration
_MAX_WIDTH = 2.5  # periods, width of moving means
_ORDERS = (1, 2, 3)  # periods after which a cycle repeats: some double or triple their period
_MANY_PERIODS = 60  # number of periods that counts as sustained in any case
_MIN_EVEN_SHARE = 0.75  # of the swings of a side and of the periods, which are even
_MAX_PERIOD_RANGE = 0.33  # range of the even periods over their median
_MAX_SWING_RANGE = 0.5  # range of the even half swings of one side over their median
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
    time: Array, values: Array, least: float, commands: Sequence[Array] = (), name: str = ""
) -> LimitCycle | None:
    """Largest oscillation of samples that lasts eight even periods without decay.

    Moving means of doubling widths are subtracted from the samples; the difference crosses zero
    twice per period. Widths of one to two and a half periods are used. An oscillation decays if
    its swings fall below 0.85 in eight periods, by their largest and their last quarter. One that
    begins and ends while commands do not change is a transient, or noise, unless it lasts half of
    that time or sixty periods. It is commanded if a command reverses in at least half of the
    periods.

    Args:
        time: Equidistant instants (N,) [s].
        values: Samples (N,).
        least: Least amplitude.
        commands: Samples (N,) of commands.
        name: Name of the channel.
    """
    least = max(least, _MIN_RELATIVE_AMPLITUDE * float(np.abs(values).max(initial=0.0)))
    found: LimitCycle | None = None
    # samples where a command starts, stops or reverses
    changes = np.concatenate([
        [0, len(values)], *(np.flatnonzero(np.diff(_directions(x))) + 1 for x in commands)
    ])  # fmt: skip
    width = _MIN_PERIOD_SAMPLES
    while width * _MIN_PERIODS <= _MAX_WIDTH * len(values):
        deviation = values - _moving_mean(values, width)
        spans = [_oscillation_spans(deviation, width, 0.5 * least, x) for x in _ORDERS]
        for first, last, period in itertools.chain(*spans):
            amplitude = 0.5 * float(np.median(_peak_to_peak(values, first, last, period)))
            if amplitude < max(least, 0.0 if found is None else found.amplitude):
                continue
            cycles = (last - first) / period
            since = changes[changes <= first + period].max()
            until = changes[changes >= last - period].min()
            if cycles < _MANY_PERIODS and last - first < _MIN_TIME_SHARE * (until - since):
                continue
            if any(2 * _reversal_count(command[first:last]) >= cycles for command in commands):
                continue
            length = period * float(time[last - 1] - time[first]) / (last - 1 - first)
            start, end = float(time[first]), float(time[last - 1])
            found = LimitCycle(name, start, end, 1.0 / length, amplitude)
        width *= 2
    return found


def limit_cycles(recording: Recording) -> list[LimitCycle]:
    """Limit cycles of pressures, the largest first.

    Commands are the references, without these the valve signals, external loads, and revolutions
    of joints that turn on.
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
    commands = [
        *(channels[x] for x in references),
        *_revolutions(recording),
        *(  # steps from 1 to 0 where a joint arrives at the end of its motion, as at an end stop
            np.maximum.accumulate(np.abs(x - x[-1])[::-1] > _MIN_RELATIVE_AMPLITUDE * np.ptp(x))[
                ::-1
            ].astype(float)
            for x in recording.q.T
        ),
    ]
    found = []
    for name in names:
        release_pages()
        found.append(
            sustained_oscillation(
                recording.time, channels[name], _MIN_PRESSURE_AMPLITUDE, commands, name
            )
        )
    return sorted((x for x in found if x is not None), key=lambda one: -one.amplitude)


def _revolutions(recording: Recording) -> list[Array]:
    """Cosines (N,) of how far joints have turned, of those that turn by more than a revolution."""
    units, columns = recording.units | recording.channel_units, recording.columns()
    turned = [columns[x] - columns[x][0] for x, unit in units.items() if unit == "rad"]
    return [
        np.cos(np.maximum.accumulate(np.sign(angle[-1]) * angle))
        for angle in turned
        if abs(angle[-1]) > 2 * np.pi
    ]


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
        "sustained pressure oscillation (limit cycle), included in the peak forces: "
        f"{', '.join(words)}{more}"
    )


def _moving_mean(values: Array, width: int) -> Array:
    """Means (N,) over a width of samples, at the ends over the available part."""
    total = np.concatenate([[0.0], np.cumsum(values - values.mean())])
    at = np.arange(len(values))
    low, high = np.maximum(at - width // 2, 0), np.minimum(at - width // 2 + width, len(values))
    return (total[high] - total[low]) / (high - low) + values.mean()


def _oscillation_spans(
    deviation: Array, width: int, least: float, order: int
) -> Sequence[tuple[int, int, float]]:
    """Start, end and median period, in samples, of what repeats after `order` periods."""
    from scipy.ndimage import binary_closing

    up = deviation > 0
    edges = np.flatnonzero(up[1:] != up[:-1]) + 1  # starts of half periods
    count = 2 * _MIN_PERIODS * order
    if len(edges) <= count:
        return []
    sizes = np.maximum.reduceat(np.abs(deviation), edges)[:-1]  # amplitude of each half period
    # interpolated zero crossings
    exact = edges - deviation[edges] / (deviation[edges] - deviation[edges - 1])
    periods = (exact[2 * order :] - exact[: -2 * order]) / order
    rows = np.lib.stride_tricks.sliding_window_view(sizes, count)
    size = count + 1 - 2 * order
    lengths = np.lib.stride_tricks.sliding_window_view(periods, size)
    # from here on only windows that may pass; outliers shorten the mean by less than this share
    total = np.append(0.0, np.cumsum(periods))
    least_total = 0.5 * _MIN_EVEN_SHARE * size * width / _MAX_WIDTH
    at = np.flatnonzero(total[size:] - total[:-size] >= least_total)
    length, is_even = _evenness(lengths[at], _MAX_PERIOD_RANGE)
    is_even &= (length >= _MIN_PERIOD_SAMPLES) & (length <= width) & (width <= _MAX_WIDTH * length)
    at = at[is_even]
    for half in range(2 * order):  # above and below, which may differ
        at = at[_evenness(rows[at, half :: 2 * order], _MAX_SWING_RANGE)[1]]
    quarters = np.median(rows[at].reshape(len(at), 4, count // 4), axis=2)
    at = at[quarters[:, -1] >= np.maximum(_MIN_DECAY_RATIO**0.75 * quarters.max(axis=1), least)]
    if not len(at):
        return []
    good = np.zeros(len(rows), dtype=bool)
    good[at] = True
    good = binary_closing(np.pad(good, count), np.ones(count + 1, dtype=bool))[
        count:-count
    ]  # single jolts
    last_period = count - 2 * order
    return [
        (int(edges[a]), int(edges[b - 1 + count]), float(np.median(periods[a : b + last_period])))
        for a, b in true_runs(good).tolist()
    ]


def _evenness(values: Array, max_range: float) -> tuple[Array, np.ndarray]:
    """Medians (n,) of rows (n, k), and a mask of those of which most values are close together."""
    values, count = np.sort(values, axis=1), values.shape[1]
    even = int(_MIN_EVEN_SHARE * count)
    ranges = values[:, even - 1 :] - values[:, : count - even + 1]
    median = values[:, count // 2]
    return median, ranges.min(axis=1) <= max_range * median


def _peak_to_peak(values: Array, first: int, last: int, period: float) -> Array:
    """Peak-to-peak value of each period, minus the drift over it."""
    starts = np.round(np.arange(first, last - period + 1, period)).astype(int)
    high, low = (x.reduceat(values[:last], starts) for x in (np.maximum, np.minimum))
    means = np.add.reduceat(values[:last], starts) / np.diff(starts, append=last)
    drift = np.abs(np.gradient(means))
    return np.maximum(high - low - drift, 0.0)


def _reversal_count(command: Array) -> int:
    directions = _directions(command)
    return int(np.count_nonzero(np.diff(directions[directions != 0])))


def _directions(command: Array) -> Array:
    """Signs (N - 1,) of the steps of a command, 0 without a step."""
    steps = np.diff(command)
    return np.sign(np.where(np.abs(steps) > 1e-9 * max(float(np.ptp(command)), 1e-300), steps, 0))
