"""Tables, figures and page of the referee's results."""

import importlib.metadata
import os
import platform
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from engines import ENGINES
from matplotlib.figure import Figure
from problem import Problem
from trajectories import Point, time_at_error

from crane.view.plots.figure_style import FIGURE_STYLE

ERRORS = (1e-2, 1e-3, 1e-4, 1e-6, 1e-8)
STYLES = {
    "crane DOP853": ("#1f5fa8", "o-"),
    "crane Radau": ("#1f5fa8", "o:"),
    "crane rk4": ("#7fb0e0", "s-"),
    "pin.constraintDynamics": ("#3c8c4a", "^-"),
    "pin.lcaba": ("#7cc18a", "v-"),
    "MuJoCo Euler": ("#b9b9b9", "v-"),
    "MuJoCo implicitfast": ("#e0a060", "D-"),
    "MuJoCo RK4": ("#c8501a", "P-"),
    "Exudyn GeneralizedAlpha": ("#8a4fa0", "X-"),
    "Exudyn TrapezoidalIndex2": ("#b98cc9", "X:"),
    "Drake SAP": ("#444444", "*-"),
}
COLUMNS = 3  # of figures


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown, with numbers on the right."""
    marks = ["---", *["---:"] * (len(head) - 1)]
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, marks, *rows))


def conditions() -> str:
    """Machine and versions of a run."""
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


def sentence(text: str) -> str:
    """A text with a capital at its begin."""
    return text[0].upper() + text[1:]


def work_precision_tables(problems: Sequence[Problem], points: Sequence[Point]) -> list[str]:
    """For each problem: times of all engines at equal errors, and their best."""
    parts = []
    for problem in problems:
        own = [point for point in points if point.problem == problem.name]
        engines = [engine.name for engine in ENGINES if any(p.engine == engine.name for p in own)]
        rows = []
        for name in engines:
            of_engine = [point for point in own if point.engine == name]
            reached = [point for point in of_engine if not point.failure]
            if not reached:
                rows.append([name, *["-"] * (len(ERRORS) + 3), of_engine[-1].failure])
                continue
            times = [time_at_error(reached, error) for error in ERRORS]
            best = min(reached, key=lambda point: point.error)
            rows.append([
                name,
                *("-" if time is None else f"{1e3 * time:.3g}" for time in times),
                f"{best.error:.0e}", f"{best.loop_error:.0e}",
                "-" if best.energy_drift != best.energy_drift else f"{best.energy_drift:.0e}",
                f"{best.setting}",
            ])  # fmt: skip
        head = [
            "engine", *(f"{error:.0e} m [ms]" for error in ERRORS), "least error [m]",
            "loops open [m]", "energy [J]", "setting of that",
        ]  # fmt: skip
        title = f"#### {sentence(problem.title)}"
        about = f"{problem.duration:g} s. Source: {problem.source.strip()}."
        parts += [title, about, table(head, rows)]
    return parts


def draw_work_precision(problems: Sequence[Problem], points: Sequence[Point], path: Path) -> None:
    """Error over CPU time, one panel for each problem."""
    rows = -(-len(problems) // COLUMNS)
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(11.0, 3.1 * rows + 0.8), layout="constrained")
        panels = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
        for panel, problem in zip(panels, problems, strict=False):
            for name, (colour, style) in STYLES.items():
                found = sorted(
                    (p for p in points
                     if (p.problem, p.engine) == (problem.name, name) and not p.failure),
                    key=lambda p: p.time,
                )  # fmt: skip
                best = [p for i, p in enumerate(found)
                        if all(p.error < other.error for other in found[:i])]  # fmt: skip
                if best:
                    panel.loglog(
                        [1e3 * p.time for p in best], [max(p.error, 1e-16) for p in best], style,
                        color=colour, ms=4, label=name,
                    )  # fmt: skip
            panel.set(title=sentence(problem.title), xlabel="CPU time [ms]", ylabel="error [m]")
        for panel in panels[len(problems) :]:
            panel.set_axis_off()
        handles = {
            label: handle
            for panel in panels
            for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)
        }
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=150)


CALLS = (
    "crane, one call", "crane, a stack", "crane, closed stack", "pin.constraintDynamics",
    "pin.lcaba", "mj_forward",
)  # fmt: skip


def forward_dynamics_table(results: Sequence[dict[str, Any]]) -> str:
    """Times of forward dynamics over the number of joints."""
    head = [
        "machine", "joints", "loops", "degrees of freedom", *(f"{name} [us]" for name in CALLS),
        "best peer / one call", "best peer / stack", "load [s]", "first call [s]", "cached [s]",
    ]  # fmt: skip
    rows = []
    for found in results:
        if "failure" in found:
            rows.append([found["machine"], *["-"] * (len(head) - 2), found["failure"]])
            continue
        times = found["times"]
        peers = [times[name] for name in CALLS[3:5] if name in times]
        ratios = [
            f"{min(peers) / times[name]:.1f}" if peers else "-"
            for name in ("crane, one call", "crane, a stack")
        ]
        rows.append([
            found["machine"], *(str(found[key]) for key in ("joints", "loops", "freedoms")),
            *(f"{1e6 * times[name]:.2f}" if name in times else "-" for name in CALLS), *ratios,
            *(f"{found[key]:.2f}" for key in ("load", "first", "cached")),
        ])  # fmt: skip
    return table(head, rows)


def draw_forward_dynamics(results: Sequence[dict[str, Any]], path: Path) -> None:
    """Time of a call over the number of joints, one panel for each family."""
    found = [result for result in results if "failure" not in result]
    families = list(dict.fromkeys(result["machine"].rpartition(" ")[0] for result in found))
    families = [family for family in families if family]
    colours = ("#1f5fa8", "#7fb0e0", "#1f5fa8", "#3c8c4a", "#7cc18a", "#c8501a")
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(11.0, 3.6), layout="constrained")
        panels = figure.subplots(1, max(len(families), 1), squeeze=False, sharey=True).ravel()
        for panel, family in zip(panels, families, strict=False):
            own = [result for result in found if result["machine"].startswith(f"{family} ")]
            for name, colour, style in zip(CALLS, colours, ("o-", "s-", "o:", "^-", "v-", "P-"),
                                           strict=True):  # fmt: skip
                pairs = [(result["joints"], 1e6 * result["times"][name]) for result in own
                         if name in result["times"]]  # fmt: skip
                panel.loglog(*zip(*pairs, strict=True), style, color=colour, ms=4, label=name)
            sizes = sorted({result["joints"] for result in own})
            panel.set_xticks(sizes, [str(size) for size in sizes])
            panel.minorticks_off()
            panel.set(title=family.capitalize(), xlabel="joints")
        panels[0].set_ylabel("CPU time of a call [us]")
        figure.legend(
            *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(CALLS)
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=150)


def write_section(page: Path, parts: Sequence[str]) -> None:
    """Put paragraphs between the two marks of a page, in place of what is there."""
    begin, end = "<!-- referee: written by `make referee` -->", "<!-- end of referee -->"
    before, rest = page.read_text(encoding="utf-8").split(begin)
    after = rest.split(end)[1]
    page.write_text("\n\n".join([before + begin, *parts, end + after]), encoding="utf-8")
