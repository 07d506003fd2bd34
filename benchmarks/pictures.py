"""Pictures of the referee, readable at the width of a telephone.

Engines with several methods are one family: a line is what no other method or setting of the
family beats in both error and time. Discs with the initial of the family mark the lines.
"""

import textwrap
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import yaml
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter
from problem import FOLDER
from report import sentence
from trajectories import Point, time_at_error

from crane.view.plots.figure_style import FIGURE_STYLE

WIDTH, DPI = 5.2, 200  # [inch]
FAMILIES = {  # initial and colour
    "crane": ("c", "#1f5fa8"),
    "Pinocchio": ("P", "#2a8c4a"),
    "MuJoCo": ("M", "#d2601a"),
    "Exudyn": ("E", "#8a4fa0"),
    "Drake": ("D", "#555555"),
    "scipy": ("s", "#a8861c"),
    "Newton": ("N", "#6a9a1f"),
    "Chrono": ("C", "#b03a5b"),
}
STYLE = FIGURE_STYLE | {
    "font.size": 9, "axes.titlesize": 9.5, "axes.labelsize": 9, "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
}  # fmt: skip
SPREAD = 0.19  # of two discs beside each other, in decades
HIGH = 0.25  # of two discs above each other, in decades of the calls
LEAST_ERROR = 1e-15  # of the axes [m]


def family(engine: str) -> str:
    """Family of an engine's name, such as `pin.lcaba` or `MuJoCo RK4`."""
    first = engine.partition(" ")[0].partition(".")[0]
    return "Pinocchio" if first == "pin" else first


@cache
def title(problem: str) -> str:
    """What a problem is called: a title in its file, of whatever kind it is."""
    for path in FOLDER.rglob(f"{problem}.yaml"):
        name = yaml.safe_load(path.read_text(encoding="utf-8")).get("title")
        if name:
            return sentence(name)
    return sentence(problem.replace("_", " "))


def times_to_error(points: Sequence[Point], problem: str, error: float) -> dict[str, float]:
    """Least time [s] of each engine to an error, of those that reach it."""
    own = [point for point in points if point.problem == problem]
    times = {
        name: time_at_error([point for point in own if point.engine == name], error)
        for name in dict.fromkeys(point.engine for point in own)
    }
    return {name: time for name, time in times.items() if time is not None}


def frontier(points: Iterable[Point]) -> list[Point]:
    """Points that no other one beats in both error and time, by time."""
    best: list[Point] = []
    for point in sorted(points, key=lambda point: (point.time, point.error)):
        if not point.failure and (not best or point.error < best[-1].error):
            best.append(point)
    return best


def initial(axes: Axes, x: float, y: float, name: str) -> None:
    """A disc with the initial of a family."""
    letter, colour = FAMILIES.get(name, (name[0], "#888888"))
    axes.plot(x, y, "o", color=colour, ms=9, mec="white", mew=0.8, zorder=5, clip_on=False)
    axes.annotate(
        letter, (x, y), color="white", fontsize=7, weight="bold", ha="center", va="center",
        zorder=6, annotation_clip=False, xytext=(0, -0.3), textcoords="offset points",
    )  # fmt: skip


def legend(figure: Figure, names: Iterable[str]) -> None:
    """What the initials stand for, above all panels."""
    names = [name for name in FAMILIES if name in names]
    colours = [FAMILIES[name][1] for name in names]
    figure.legend(
        [Line2D([], [], marker="o", color=colour, ls="", ms=8) for colour in colours], names,
        loc="outside upper center", ncols=min(len(names), 5), fontsize=9, labelcolor=colours,
        handlelength=1.0, handletextpad=0.3, columnspacing=1.2,
    )  # fmt: skip


def save(figure: Figure, path: Path) -> None:
    """Write a picture."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DPI)


def draw_time_at_error(points: Sequence[Point], errors: Sequence[float], path: Path) -> None:
    """CPU time of each family to an error, a row for each problem, a panel for each error."""
    chosen = list(dict.fromkeys(point.problem for point in points))
    names = {family(point.engine) for point in points}
    labels = [textwrap.fill(title(problem), 22) for problem in chosen]
    lines = max(label.count("\n") + 1 for label in labels)
    height = max(0.31, 0.16 * lines) * len(chosen) + 0.62
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, height * len(errors) + 0.4), layout="constrained")
        panels = figure.subplots(len(errors), 1, sharex=True, squeeze=False).ravel()
        for panel, error in zip(panels, errors, strict=True):
            for row, problem in enumerate(chosen):
                _draw_row(panel, row, times_to_error(points, problem, error))
            panel.set_yticks(range(len(chosen)), labels)
            panel.set(ylim=(len(chosen) - 0.5, -0.5), xscale="log")
            power = round(np.log10(error))
            text = f"CPU time [ms] to an error of $\\mathbf{{10^{{{power}}}}}$ m"
            panel.set_title(text, loc="left", weight="bold")
            _note(panel, -0.85, "ratio", "#333333")
            panel.tick_params(axis="y", length=0)
            panel.tick_params(axis="x", labelbottom=True)
            panel.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
            panel.xaxis.set_minor_formatter(NullFormatter())
            panel.grid(axis="y", visible=False)
        legend(figure, names)
        save(figure, path)


def _draw_row(panel: Axes, row: int, times: dict[str, float]) -> None:
    """Discs of the families at the times of their best engines [s].

    Those that would cover each other move up and down.
    """
    panel.axhline(row, color="#f0f0f0", lw=5, zorder=0)
    found: dict[str, float] = {}
    for engine, time in times.items():
        found[family(engine)] = min(1e3 * time, found.get(family(engine), np.inf))
    placed: list[tuple[float, float]] = []
    for name, time in sorted(found.items(), key=lambda pair: pair[1]):
        near = {other for x, other in placed if abs(np.log10(time / x)) < SPREAD}
        y = next((y for y in (0.0, -0.3, 0.3) if y not in near), 0.0)
        placed.append((time, y))
        initial(panel, time, row + y, name)
    others = [time for name, time in found.items() if name != "crane"]
    if "crane" not in found:
        text, colour = "crane: no", "#b02020"
    elif not others:
        text, colour = "no other", "#1f5fa8"
    else:
        ratio = min(others) / found["crane"]
        text = f"{ratio:.2g}" if ratio < 10 else f"{ratio:.0f}"
        colour = "#1f5fa8" if ratio >= 1 else "#b02020"
    _note(panel, row, text, colour)


def _note(panel: Axes, row: float, text: str, colour: str) -> None:
    """A text on the right of a row."""
    panel.annotate(
        text, (1, row), xycoords=("axes fraction", "data"), xytext=(5, 0), va="center",
        textcoords="offset points", color=colour, weight="bold", annotation_clip=False,
    )  # fmt: skip


def draw_work_precision(points: Sequence[Point], path: Path, label: str = "error [m]") -> None:
    """Error over CPU time, one panel for each problem, one line for each family."""
    chosen = list(dict.fromkeys(point.problem for point in points))
    names = [name for name in FAMILIES if any(family(p.engine) == name for p in points)]
    rows = -(-len(chosen) // 2)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 2.05 * rows + 0.45), layout="constrained")
        panels = figure.subplots(rows, 2, squeeze=False).ravel()
        for panel, problem in zip(panels, chosen, strict=False):
            for name in reversed(names):
                best = frontier(
                    p for p in points if (p.problem, family(p.engine)) == (problem, name)
                )
                if best:
                    x = [1e3 * p.time for p in best]
                    y = [max(p.error, LEAST_ERROR) for p in best]
                    panel.loglog(x, y, ".-", color=FAMILIES[name][1], ms=4)
                    initial(panel, x[-1], y[-1], name)
            panel.set_title(textwrap.fill(title(problem), 24), weight="bold")
            panel.xaxis.set_major_locator(LogLocator(numticks=6))
            panel.yaxis.set_major_locator(LogLocator(numticks=6))
            panel.xaxis.set_minor_formatter(NullFormatter())
            panel.minorticks_off()
            panel.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
        for panel in panels[len(chosen) :]:
            panel.set_axis_off()
        for panel in panels[::2]:
            panel.set_ylabel(label)
        for panel in panels[max(len(chosen) - 2, 0) : len(chosen)]:
            panel.set_xlabel("CPU time [ms]")
        legend(figure, names)
        save(figure, path)


LINES = {  # of the calls: begin of their names, style and text
    "crane, one call": ("crane", "-", "crane, closes the loops first"),
    "crane, closed stack": ("crane", ":", "crane, loops closed before"),
    "pin.": ("Pinocchio", "-", "Pinocchio, its best algorithm"),
    "mj_": ("MuJoCo", "-", "MuJoCo"),
}


def draw_calls(families: dict[str, list[dict[str, Any]]], path: Path) -> None:
    """Time of a call over the number of joints, one panel for each family of machines."""
    rows = -(-len(families) // 2)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 2.2 * rows + 0.6), layout="constrained")
        panels = figure.subplots(rows, 2, squeeze=False, sharey=True).ravel()
        for panel, (name, results) in zip(panels, families.items(), strict=False):
            placed: list[tuple[float, float]] = []
            for begin, (group, style, _) in LINES.items():
                pairs = [(result["joints"], 1e6 * time) for result in results
                         if (time := _time(result["times"], begin))]  # fmt: skip
                if pairs:
                    colour = FAMILIES[group][1]
                    panel.loglog(*zip(*pairs, strict=True), style, marker=".", color=colour, ms=4)
                    place = next(
                        (pair for pair in pairs[::-1] if not is_near(pair, placed)), pairs[-1]
                    )
                    placed.append(place)
                    initial(panel, *place, group)
            sizes = sorted({result["joints"] for result in results})
            panel.set_xticks(sizes, [str(size) for size in sizes])
            panel.minorticks_off()
            panel.set_title(name, weight="bold")
            panel.yaxis.set_major_formatter(lambda x, _: f"{x:g}")
        for panel in panels[len(families) :]:
            panel.set_axis_off()
        for panel in panels[::2]:
            panel.set_ylabel("time of a call [us]")
        for panel in panels[max(len(families) - 2, 0) : len(families)]:
            panel.set_xlabel("joints")
        figure.legend(
            [Line2D([], [], color=FAMILIES[group][1], ls=style) for group, style, _ in
             LINES.values()],
            [text for _, _, text in LINES.values()],
            loc="outside upper center", ncols=2, fontsize=8, columnspacing=1.0, handlelength=1.4,
        )  # fmt: skip
        save(figure, path)


def is_near(pair: tuple[float, float], placed: Iterable[tuple[float, float]]) -> bool:
    """Whether a disc at a number of joints and a time would cover another one."""
    return any(pair[0] == x and abs(np.log10(pair[1] / y)) < HIGH for x, y in placed)


def _time(times: dict[str, float], begin: str) -> float | None:
    return min((time for name, time in times.items() if name.startswith(begin)), default=None)
