"""Measure times, format tables, and write them into a section of a page."""

import importlib.metadata
import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

Call = Callable[[], object]
Clock = Callable[[], float]


def measure(
    calls: dict[str, Call], rounds: int, clock: Clock = time.process_time
) -> dict[str, float]:
    """Median time of each call [s] over `turns`."""
    return {name: statistics.median(t) for name, t in turns(calls, rounds, clock).items()}


def turns(
    calls: dict[str, Call], rounds: int, clock: Clock = time.process_time
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


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """As Markdown, numbers to the right."""
    marks = ["---", *["---:"] * (len(head) - 1)]
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, tuple(marks), *rows))


def microseconds(what: str, times: dict[str, float]) -> str:
    """A table of times, with their ratios to the first."""
    unit = next(iter(times.values()))
    rows = [(name, f"{1e6 * t:.2f}", f"{t / unit:.1f}") for name, t in times.items()]
    return table((what, "time [us]", "ratio"), rows)


def conditions() -> str:
    """What it was measured on."""
    names = ("pin", "mujoco", "numpy", "scipy", "llvmlite")
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in names)
    return (
        f"Measured with Python {platform.python_version()}, {versions} on "
        f"{platform.system()}, {platform.machine()}, {os.cpu_count()} cores, at a load "
        f"average of {os.getloadavg()[0]:.1f} due to other programs, which affects wall times "
        "but hardly CPU times."
    )


def put(page: Path, marks: tuple[str, str], parts: list[str]) -> None:
    """Put paragraphs between two marks of a page, in place of what is there."""
    begin, end = marks
    before, rest = page.read_text(encoding="utf-8").split(begin)
    _, after = rest.split(end)
    page.write_text("\n\n".join([before + begin, *parts, end + after]), encoding="utf-8")
