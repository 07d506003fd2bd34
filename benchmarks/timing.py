"""Times of calls that take turns."""

import statistics
import time
from collections.abc import Callable, Mapping

Call = Callable[[], object]
Clock = Callable[[], float]


def in_turns(
    calls: Mapping[str, Call], rounds: int, clock: Clock = time.process_time
) -> dict[str, list[float]]:
    """Times of each call [s]; they take turns, after one turn that does not count."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(rounds + 1):
        for name, call in calls.items():
            start = clock()
            call()
            if turn:
                times[name].append(clock() - start)
    return times


def medians(
    calls: Mapping[str, Call], rounds: int, clock: Clock = time.process_time
) -> dict[str, float]:
    """Median time of each call [s]."""
    return {
        name: statistics.median(times) for name, times in in_turns(calls, rounds, clock).items()
    }
