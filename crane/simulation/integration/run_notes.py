"""Notes for the user about a run: what happens several times is one note."""

from collections.abc import Iterator

_MAX_LISTED = 4  # times in a note


class RunNotes:
    """Notes about a run; those of equal words are one, with their times and their number."""

    def __init__(self) -> None:
        self._times: dict[tuple[str, str], list[float]] = {}

    def add(self, time: float, before: str, after: str) -> None:
        """Note what happens at a time [s], which stands between two parts of the text."""
        self._times.setdefault((before, after), []).append(time)

    def __iter__(self) -> Iterator[str]:
        """The texts, in the order in which they were first noted."""
        for (before, after), times in self._times.items():
            yield f"{before}{_format_times(times)}{after}"


def _format_times(times: list[float]) -> str:
    """Text such as "at t = 1.2 s", or "at t = 1.2, 2.4, ..., 9.6 s (8 times)"."""
    listed = [f"{time:.4g}" for time in times]
    if len(listed) > _MAX_LISTED:
        listed = [*listed[: _MAX_LISTED - 1], "...", listed[-1]]
    count = f" ({len(times)} times)" if len(times) > 1 else ""
    return f"at t = {', '.join(listed)} s{count}"
