"""Linear models as pictures: poles and frequency responses, and modes over strokes and loads."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.optimize import linear_sum_assignment

from crane.common.samples import Array
from crane.recordings.summary import READING_UNITS, title
from crane.simulation.linear import LinearModel, Mode
from crane.view.plots.recording import INK, RECORDED, STYLE, write_figure
from crane.view.plots.text import plain

_COLORS = ("#1f5fa8", "#e0701a", "#2a8c4a", "#8a5fb0", "#c2452d", "#7f7f3f", "#3f8f9f", "#909090")
_POINTS = 600  # frequencies of a response
_MOST = 6  # panels of inputs
_ALIKE = 0.2  # modal assurance of a mode that goes on
_FAINT = 1e-6  # share of the largest response that is not drawn


def plot_modes(model: LinearModel, path: str | Path) -> None:
    """Write poles and frequency responses of a linear model to a file.

    Args:
        model: What to show.
        path: Where to write; its suffix .png, .svg or .pdf chooses the format.

    Raises:
        OutputError: The suffix is another one, or the file cannot be written.
    """
    write_figure(path, lambda: modes_figure(model))


def plot_modes_over(
    models: Sequence[tuple[dict[str, float], LinearModel]], path: str | Path
) -> None:
    """Write frequency and damping of what rings over what was varied, see `linear_models`.

    Raises:
        OutputError: The suffix is not .png, .svg or .pdf, or the file cannot be written.
    """
    write_figure(path, lambda: over_figure(models))


def modes_figure(model: LinearModel) -> Figure:
    """Poles, each with what it moves most, and a panel of responses per input that has any."""
    frequencies = _grid(model)
    responses = np.abs(model.response(frequencies))
    drawn = [
        j
        for j in range(len(model.inputs))
        if responses[:, _positions(model), j].max(initial=0) > 0
    ][:_MOST]
    with mpl.rc_context(STYLE):
        columns = 1 + min(len(drawn), 3)
        rows = max(1, -(-len(drawn) // 3))
        figure = Figure(figsize=(3.6 * columns + 0.4, 3.2 * rows + 0.5), layout="constrained")
        grid = figure.add_gridspec(rows, columns)
        _draw_poles(figure.add_subplot(grid[:, 0]), model)
        for i, j in enumerate(drawn):
            axes = figure.add_subplot(grid[i // 3, 1 + i % 3])
            _draw_response(axes, model, frequencies, responses[:, :, j], j)
        words = title(model.machine.name, "small motions")
        figure.suptitle(plain(words), x=0.01, ha="left", fontsize=11, fontweight="bold")
    return figure


def over_figure(models: Sequence[tuple[dict[str, float], LinearModel]]) -> Figure:
    """Above frequencies, below damping, over the first name; a colour per value of the others."""
    names = list(models[0][0])
    families: dict[tuple[float, ...], list[tuple[float, LinearModel]]] = {}
    for values, model in models:
        first, others = next(iter(values.values())), tuple(values.values())[1:]
        families.setdefault(others, []).append((first, model))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 5.6), layout="constrained")
        upper, lower = figure.subplots(2, 1, sharex=True)
        for color, (rest, row) in zip(_cycle(len(families)), families.items(), strict=True):
            pairs = zip(names[1:], rest, strict=True)
            words = ", ".join(f"{name} {value:g}" for name, value in pairs)
            row.sort(key=lambda pair: pair[0])
            for k, (x, frequency, damping) in enumerate(_branches(row)):
                label = plain(words) if words and not k else "_"
                upper.plot(x, frequency, color=color, marker="o", ms=2.5, label=label)
                lower.plot(x, 100 * damping, color=color, marker="o", ms=2.5)
        upper.set_yscale("log")
        upper.set_ylabel("frequency [Hz]")
        lower.set_ylabel("damping [%]")
        machine = models[0][1].machine
        unit = machine.unit(names[0]) if names[0] in machine.active else ""
        lower.set_xlabel(plain(f"{names[0]} [{unit}]" if unit else names[0]))
        if len(families) > 1:
            figure.legend(loc="outside lower center", ncols=min(len(families), 5))
        words = title(machine.name, "what rings")
        figure.suptitle(plain(words), x=0.01, ha="left", fontsize=11, fontweight="bold")
    return figure


def _cycle(count: int) -> list[str]:
    return [_COLORS[i % len(_COLORS)] for i in range(count)]


def _branches(row: Sequence[tuple[float, LinearModel]]) -> list[tuple[Array, Array, Array]]:
    """Of the modes that ring, each followed by its shape: places, frequencies, damping."""
    branches: list[list[tuple[float, Mode]]] = []
    for x, model in row:
        modes = [mode for mode in model.modes if mode.rings]
        free = list(range(len(modes)))
        if branches and modes:
            ends = [branch[-1][1] for branch in branches]
            alike = np.array([[_alike(model, end, mode) for mode in modes] for end in ends])
            for k, i in zip(*linear_sum_assignment(-alike), strict=True):
                if alike[k, i] > _ALIKE:
                    branches[k].append((x, modes[i]))
                    free.remove(int(i))
        branches += [[(x, modes[i])] for i in free]
    return [
        (
            np.array([x for x, _ in branch]),
            np.array([mode.frequency for _, mode in branch]),
            np.array([mode.damping for _, mode in branch]),
        )
        for branch in branches
    ]


def _alike(model: LinearModel, one: Mode, other: Mode) -> float:
    """The modal assurance criterion of two shapes, 1 where they are the same."""
    units = model.machine.closure.units
    a, b = one.shape / units, other.shape / units
    product = np.linalg.norm(a) * np.linalg.norm(b)
    return float(abs(np.vdot(a, b)) / product) ** 2 if product else 0.0


def _grid(model: LinearModel) -> Array:
    """Frequencies [Hz] around what rings, or all poles, close at the former."""
    rings = [mode.frequency for mode in model.modes if mode.rings]
    found = rings or [mode.frequency for mode in model.modes if mode.frequency > 0] or [1.0]
    low, high = max(min(found) / 30, 1e-3), min(max(found) * 5, 1e4)
    near = [f * np.linspace(0.98, 1.02, 41) for f in rings]
    return np.unique(np.concatenate([np.geomspace(low, max(high, 10 * low), _POINTS), *near]))


def _draw_poles(axes: Axes, model: LinearModel) -> None:
    """Over frequency and damping, which show slow and fast poles alike."""
    shown = [mode for mode in model.modes if mode.frequency > 0]
    axes.axhline(0.0, color=INK, lw=0.6)
    for mode in shown:
        rings = mode.rings
        axes.plot(
            [mode.frequency], [100 * mode.damping], "o" if rings else "x", ms=4.5,
            color=RECORDED if rings else "#909090", clip_on=False, zorder=3,
        )  # fmt: skip
        if rings:
            axes.annotate(
                plain(model.most(mode)), (mode.frequency, 100 * mode.damping), fontsize=7,
                xytext=(3, 4), textcoords="offset points",
            )  # fmt: skip
    axes.set_xscale("log")
    powers = np.log10([mode.frequency for mode in shown] or [1.0])
    axes.set_xlim(10 ** np.floor(powers.min()), 10 ** (np.floor(powers.max()) + 1))
    axes.set_yscale("symlog", linthresh=1.0)
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel("damping [%]")
    lowest = min((100 * mode.damping for mode in shown), default=0.0)
    axes.set_ylim(min(0.0, 1.5 * lowest), 200.0)
    zeros = sum(mode.frequency == 0 for mode in model.modes)
    axes.set_title("poles" + (f" ({zeros} more at zero)" if zeros else ""))


def _positions(model: LinearModel) -> list[int]:
    """Outputs that are coordinates of active joints."""
    return [i for i, name in enumerate(model.outputs) if name in model.machine.active]


def _draw_response(
    axes: Axes, model: LinearModel, frequencies: Array, response: Array, which: int
) -> None:
    shown = _positions(model)
    for color, i in zip(_cycle(len(shown)), shown, strict=True):
        joint = model.outputs[i]
        unit, factor = READING_UNITS[model.machine.unit(joint)]
        if response[:, i].max() > _FAINT * response[:, shown].max():
            label = plain(f"{joint} [{unit}/{model.units[model.inputs[which]]}]")
            axes.loglog(frequencies, factor * response[:, i], color=color, lw=1.1, label=label)
    axes.set_title(plain(f"per {model.inputs[which]}"))
    axes.set_xlabel("frequency [Hz]")
    axes.legend(fontsize=6.5)
