"""Picture of the times of large machines over their number of joints."""

from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from crane.view.plots.recording_figure import FIGURE_STYLE, INK_COLOUR

COLOURS = {"chain": "#1f5fa8", "tree": "#3c8c4a", "ring": "#c8501a", "spatial ring": "#8a4fa0"}
CALLS = {"one": ("one call of crane", "o-"), "stack": ("crane, of a stack", ":"),
         "theirs": ("pin.constraintDynamics", "^--")}  # fmt: skip
STARTS = {"first": ("first call", "o-"), "kept": ("kept", ":")}


def draw(results: list[dict], path: Path) -> None:
    """Time of a call, and of the first call.

    Args:
        results: As `one_machine.py` prints them, those without times left out.
        path: Where to.
    """
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(9.6, 4.6), layout="constrained")
        left, right = figure.subplots(1, 2)
        _lines(left, results, CALLS, 1e6)
        _lines(right, results, STARTS, 1.0)
        left.set(ylabel="CPU time [us]", title="A call of forward dynamics")
        right.set(ylabel="CPU time [s]", title="Tracing and compiling")
        for goal in (10.0, 0.1):
            right.plot([100], [goal], "_", color=INK_COLOUR, ms=14)
            right.annotate(
                f"goal, {goal:g} s", (100, goal), (0, -9), textcoords="offset points", ha="center",
                color=INK_COLOUR, fontsize=7,
            )  # fmt: skip
        for axes in (left, right):
            axes.set(xlabel="joints", xscale="log", yscale="log")
            ticks = [4, 10, 20, 30, 60, 100, 200]
            axes.set_xticks(ticks, [str(tick) for tick in ticks])
            axes.minorticks_off()
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=160)


def _lines(axes: Axes, results: list[dict], kinds: dict[str, tuple[str, str]], by: float) -> None:
    first = next(iter(kinds))
    for family, colour in COLOURS.items():
        own = [found for found in results if found["family"] == family and "kept" in found]
        joints = [found["joints"] for found in own]
        for name, (_, style) in kinds.items():
            axes.plot(joints, [by * found[name] for found in own], style, color=colour, ms=4)
        left = [found for found in own if found["backend"] != "compiled"]
        points = [found["joints"] for found in left], [by * found[first] for found in left]
        axes.plot(*points, "o", mfc="white", color=colour, ms=4)
    handles = [Line2D([], [], color=colour, label=family) for family, colour in COLOURS.items()]
    handles += [
        Line2D([], [], color=INK_COLOUR, marker=style[0] if style[0] in "o^" else "",
               ls=style.lstrip("o^"), ms=4, label=label)
        for label, style in kinds.values()
    ]  # fmt: skip
    if any(found.get("backend") == "pinocchio" for found in results):
        handles.append(Line2D([], [], color=INK_COLOUR, marker="o", mfc="white", ls="", ms=4,
                              label="not compiled"))  # fmt: skip
    axes.legend(handles=handles, loc="upper left", fontsize=7)
