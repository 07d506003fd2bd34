"""The pages of the referee: conditions, a summary, and the tables of all parts."""

import importlib.metadata
import os
import platform
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import calls_over_size
from engines import ENGINES
from parts import PARTS
from pictures import (
    draw_calls,
    draw_time_at_error,
    draw_work_precision,
    family,
    times_to_error,
    title,
)
from report import paragraph, sentence, table
from trajectories import Point

BEGIN, END = "<!-- referee: written by `make referee` -->", "<!-- end of referee -->"
SUMMARY_ERRORS = (1e-3, 1e-6)  # [m]
CAPTION = (
    "*Ratio* is the time of the best other engine over that of crane: in red, crane is slower. "
    "An engine without a disc does not reach the error."
)
REQUIRED_ERROR = 1e-6  # that crane has to reach on each problem [m]
REQUIRED_AGREEMENT = 1e-8  # of accelerations of machines of the families, relative
RACES = "trajectories", "hydraulics"  # parts with errors of all engines over time
SIZES = "forward_dynamics", "inverse_dynamics"  # parts with calls over the number of joints
Results = dict[str, dict[str, Any]]  # by part: conditions, rows, tables


def conditions() -> str:
    """Computer and versions of a run."""
    packages = sorted({(engine.package, engine.version()) for engine in ENGINES})
    packages += [(name, importlib.metadata.version(name)) for name in ("numpy", "llvmlite")]
    versions = ", ".join(f"{name} {version}" for name, version in packages if version)
    return (
        f"Python {platform.python_version()}, {versions} on {platform.system()} "
        f"{platform.machine()}, {processor()}, {os.cpu_count()} cores, load average "
        f"{os.getloadavg()[0]:.1f} at the start. CPU times of one thread."
    )


def processor() -> str:
    """Name of the processor."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown processor"


def points(results: Results, *parts: str) -> list[Point]:
    """Points of parts that measure errors against times; one without problems is one problem."""
    kept = ("problem", "engine", "error", "time", "failure")
    return [
        Point(**({"problem": PARTS[part].title} | {key: row[key] for key in kept if key in row}))
        for part in parts
        for row in results.get(part, {"rows": []})["rows"]
    ]


def faults(results: Results) -> list[str]:
    """What crane should have reached and did not, one line each."""
    found = points(results, *RACES)
    lines = [
        f"crane does not reach {REQUIRED_ERROR:g} m on {name}"
        for name in dict.fromkeys(point.problem for point in found)
        if own_and_peers(found, name, REQUIRED_ERROR)[0] is None
    ]
    for row in results.get("forward_dynamics", {"rows": []})["rows"]:
        difference = row.get("settings", {}).get("crane difference", 0.0)
        if "failure" in row:
            lines.append(f"no forward dynamics of {row['machine']}: {row['failure']}")
        elif not difference < REQUIRED_AGREEMENT:
            lines.append(f"accelerations of {row['machine']} differ by {difference:.0e}")
    return lines


def own_and_peers(
    found: Sequence[Point], problem: str, error: float
) -> tuple[float | None, dict[str, float]]:
    """Least times [s] to an error: of crane's methods, and of each other engine's."""
    times = times_to_error(found, problem, error)
    own_times = [times.pop(name) for name in list(times) if family(name) == "crane"]
    return min(own_times, default=None), times


def trajectory_summary(found: Sequence[Point]) -> str:
    """Per problem: crane, the best other engine and their ratio, at two errors."""
    head = ["problem"]
    for error in SUMMARY_ERRORS:
        head += [f"crane, {error:.0e} m [ms]", "best other [ms]", "ratio"]
    rows = []
    for problem in dict.fromkeys(point.problem for point in found):
        cells = [title(problem)]
        for error in SUMMARY_ERRORS:
            own, peers = own_and_peers(found, problem, error)
            best = min(peers, key=lambda name: peers[name], default=None)
            cells += [
                "not reached" if own is None else f"{1e3 * own:.3g}",
                "not reached" if best is None else f"{best} {1e3 * peers[best]:.3g}",
                "" if own is None or best is None else ratio(peers[best] / own),
            ]
        rows.append(cells)
    return table(head, rows)


def ratio(value: float) -> str:
    """A ratio of times, bold where crane is the slower one."""
    text = f"{value:.2g}" if value < 10 else f"{value:.0f}"
    return f"**{text}**" if value < 1 else text


def families_summary(rows: Sequence[dict[str, Any]]) -> str:
    """Per family of machines: times of a call and ratio, from the fewest to the most joints."""
    lines = []
    for name, own in machine_families(rows).items():
        pairs = [(row, calls_over_size.best_peer(row["times"])) for row in own]
        pairs = [(row, peer) for row, peer in pairs if peer]
        ratios = [peer[1] / row["times"][calls_over_size.OWN[0]] for row, peer in pairs if peer]
        (first, fast), (last, slow) = pairs[0], pairs[-1]
        assert fast and slow
        lines.append([
            name, f"{first['joints']} to {last['joints']}",
            *(f"{1e6 * one:.2g} to {1e6 * other:.2g}" for one, other in (
                (first["times"][calls_over_size.OWN[0]], last["times"][calls_over_size.OWN[0]]),
                (fast[1], slow[1]),
            )),
            f"{ratio(min(ratios))} to {ratio(max(ratios))}",
        ])  # fmt: skip
    head = ["family", "joints", "crane, one call [us]", "best other engine [us]", "ratio"]
    return table(head, lines)


def machine_families(rows: Sequence[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Results of machines without failure by family, machines of files aside."""
    found: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        name = row["machine"].rpartition(" ")[0]
        if name and "failure" not in row:
            found.setdefault(sentence(name), []).append(row)
    return found


def write_pages(page: Path, results: Results) -> None:
    """Write pictures and summary between the marks of a page, and its tables beside it."""
    parts = [BEGIN, *pictures(page.parent / "images", results), *summary(results), END]
    text = page.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN)
    after = rest.split(END)[1]
    page.write_text(before + "\n\n".join(parts) + after, encoding="utf-8")
    tables = page.with_name(f"{page.stem}-tables.md")
    tables.write_text("\n\n".join(tables_page(results)) + "\n", encoding="utf-8")


def pictures(images: Path, results: Results) -> Iterator[str]:
    """Draw all pictures; their paragraphs in the page."""
    for part in RACES:
        found = points(results, part)
        if found:
            draw_time_at_error(found, SUMMARY_ERRORS, images / f"times_{part}.png")
            yield f"![{PARTS[part].title}: CPU times to two errors](images/times_{part}.png)"
            if part == RACES[0]:
                yield paragraph(CAPTION)
            draw_work_precision(found, images / f"work_precision_{part}.png")
            yield f"![{PARTS[part].title}: all settings](images/work_precision_{part}.png)"
    for part in SIZES:
        if part in results:
            draw_calls(machine_families(results[part]["rows"]), images / f"{part}.png")
            yield f"![{PARTS[part].title}](images/{part}.png)"
    if "stiff" in results:
        stiff = points(results, "stiff")
        draw_work_precision(stiff, images / "stiff_precision.png", "error")


def summary(results: Results) -> Iterator[str]:
    """Paragraphs of the summary."""
    yield "## Summary"
    yield paragraph(results[RACES[0]]["conditions"])
    yield trajectory_summary(points(results, *RACES))
    for part in SIZES:
        if part in results:
            yield f"{PARTS[part].title}, closed configurations given to the other engines:"
            yield families_summary(results[part]["rows"])


def tables_page(results: Results) -> Iterator[str]:
    """Paragraphs of the page with the tables of all parts."""
    yield "# Tables of the referee"
    yield paragraph(
        "All that `make referee` measures; [performance.md](performance.md) has the summary, and "
        "says where crane loses. Written by the run."
    )
    told = ""
    for name, part in PARTS.items():
        if name not in results:
            continue
        yield f"## {part.title}"
        yield paragraph(part.about)
        if results[name]["conditions"] != told:
            told = results[name]["conditions"]
            yield paragraph(told)
        for text in results[name]["tables"]:
            yield re.sub(r"^#+ ", "### ", text, flags=re.MULTILINE)
