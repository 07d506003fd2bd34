"""Forward dynamics over the number of joints, compared with pin.constraintDynamics.

Every machine of `families.py` is loaded twice, in separate processes that share a new cache
folder: the first compiles, the second finds machine code in the cache. Times are CPU times; calls
of crane and of Pinocchio alternate in one process.

    python scripts/large_machines.py                               # all, printed
    python scripts/large_machines.py --only chain --joints 30      # one of them
    python scripts/large_machines.py --write docs/performance.md   # also into the page
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import families
import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from measuring import conditions, put, table

from crane.view.plots.figure_style import FIGURE_STYLE, INK_COLOUR

SIZES = {
    "chain": (10, 19, 28, 40, 61, 100, 151, 199),
    "tree": (10, 19, 28, 40, 61, 100, 151, 199),
    "ring": (4, 7, 10, 20, 30, 45, 60),
    "spatial ring": (6, 8, 10, 20, 30, 45, 60),
}
MARKS = "<!-- large machines: written by scripts/large_machines.py -->", "<!-- end of them -->"
PICTURE = "images/large_machines.png"
HEAD = (
    "machine", "joints", "loops", "degrees of freedom", "load [s]", "first call [s]", "kept [s]",
    "one call [us], ratio", "of a stack", "of closed configurations",
    "`pin.constraintDynamics` [us]", "difference", "iterations, mu",
)  # fmt: skip


def measured(family: str, joints: int, rounds: int, limit: float) -> dict:
    """What `one_machine.py` tells of a machine, `kept` the first call of a later process [s].

    `failed` says why there is none, in a line.
    """
    with tempfile.TemporaryDirectory() as name:
        path = families.write(family, joints, Path(name))
        environment = dict(os.environ, XDG_CACHE_HOME=name, OMP_NUM_THREADS="1")
        found: dict = {"family": family, "joints": joints}
        try:
            found |= _process(path, rounds, limit, environment)
            found["kept"] = _process(path, 0, limit, environment)["first"]
        except subprocess.TimeoutExpired:
            found["failed"] = f"longer than {limit:g} s"
        except subprocess.CalledProcessError as error:
            found["failed"] = (error.stderr.strip().splitlines() or ["killed"])[-1]
    return found


def _process(path: Path, rounds: int, limit: float, environment: dict[str, str]) -> dict:
    script = Path(__file__).parent / "one_machine.py"
    command = [sys.executable, str(script), str(path), "--rounds", str(rounds)]
    done = subprocess.run(
        command, check=True, capture_output=True, text=True, env=environment, timeout=limit
    )
    return json.loads(done.stdout)


def row(found: dict) -> tuple[str, ...]:
    """Of the table."""
    begin = found["family"], str(found["joints"])
    if "failed" in found:
        return *begin, *["-"] * (len(HEAD) - 3), found["failed"]
    note = "" if found["backend"] == "compiled" else f" ({found['backend']})"
    counts = (str(found[name]) for name in ("loops", "freedoms"))
    times = [
        f"{1e6 * found[name]:.1f}, {found[f'{name} ratio']:.2g}"
        for name in ("one", "stack", "given")
    ]
    times.append(f"{1e6 * found['theirs']:.1f}")
    settings = f"{found['iterations']}, {found['mu']:.0e}"
    spent = f"{found['load']:.2f}", f"{found['first']:.2f}{note}", f"{found['kept']:.3f}"
    return *begin, *counts, *spent, *times, f"{found['gap']:.0e}", settings


def machines(options: argparse.Namespace) -> Iterator[tuple[str, int]]:
    """Families and sizes that were asked for."""
    for family in options.only or families.FAMILIES:
        for joints in options.joints or SIZES[family]:
            if joints >= families.FAMILIES[family]:
                yield family, joints


def main() -> None:
    """Measure, print, draw and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", action="append", choices=families.FAMILIES, help="families")
    parser.add_argument("--joints", action="append", type=int, help="sizes")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--limit", type=float, default=240, help="of a process [s]")
    parser.add_argument("--picture", type=Path, help="file for it")
    parser.add_argument("--write", type=Path, help="page to put the results into")
    options = parser.parse_args()
    results = []
    for line in table(HEAD, []).splitlines():
        print(line)
    for family, joints in machines(options):
        results.append(measured(family, joints, options.rounds, options.limit))
        print(table(row(results[-1]), []).splitlines()[0], flush=True)
    if options.picture:
        draw(results, options.picture)
    if options.write:
        draw(results, options.write.parent / PICTURE)
        parts = [conditions(), table(HEAD, [row(found) for found in results])]
        put(options.write, MARKS, parts)


if __name__ == "__main__":
    main()


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
