"""The power account of a run over time: what goes where, stacked under what the shafts give."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from crane.common.samples import Array
from crane.common.units import reading
from crane.hydraulics.powers import SHAFT
from crane.recordings.summary import title
from crane.studies.power import CLASSES, PowerAccount, class_of, owner_of, what_of
from crane.view.plots.recording import INK, STYLE, write_figure
from crane.view.plots.text import plain

_COLORS = (
    "#2a8c4a", "#9a6b3f", "#1f5fa8", "#6f9bca", "#e0701a", "#b04a7a", "#7a7a7a", "#8a5fb0",
    "#d9b53f",
)  # fmt: skip
COLORS: Mapping[str, str] = dict(zip(CLASSES, _COLORS, strict=True))
_OWNERS = ("#1f5fa8", "#e0701a", "#2a8c4a", "#8a5fb0", "#d9b53f", "#b04a7a", "#3f8f9f", "#9a6b3f")
_MOST = 1500  # points of a stack


def plot_power(account: PowerAccount, path: str | Path) -> None:
    """Write the picture to a file.

    Args:
        account: What to show.
        path: Where to write; its suffix .png, .svg or .pdf chooses the format.

    Raises:
        OutputError: The suffix is another one, or the file cannot be written.
    """
    write_figure(path, lambda: power_figure(account))


def power_figure(account: PowerAccount) -> Figure:
    """Two stacks over time under the power of the shafts: by what it goes into, and by joint.

    What is negative, as a load that drives its cylinder, is stacked below zero.
    """
    by_class = {name: np.zeros_like(account.time) for name in COLORS}
    by_owner: dict[str, Array] = {}
    for name, power in account.powers.items():
        if what_of(name) == SHAFT:
            continue
        owner = owner_of(name)
        owner = owner if owner in account.joints else "circuit"
        by_owner[owner] = by_owner.get(owner, np.zeros_like(power)) + power
        by_class[class_of(account, name)] += power
    unit, scale = reading("W", float(np.abs(account.shaft).max()))
    order = [*account.joints, *(x for x in by_owner if x not in account.joints)]
    colors = dict(zip(order, _OWNERS * (1 + len(order) // len(_OWNERS)), strict=False))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.6, 6.4), layout="constrained")
        top, bottom = figure.subplots(2, 1, sharex=True)
        _stack(top, account, by_class, COLORS, scale)
        _stack(bottom, account, {x: by_owner[x] for x in order}, colors, scale)
        top.set_title("by what it goes into", loc="left", fontsize=9)
        bottom.set_title("by joint", loc="left", fontsize=9)
        bottom.set_xlabel("time [s]")
        for axes in (top, bottom):
            axes.set_ylabel(f"power [{unit}]")
            axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), reverse=True)
        words = title(account.machine, f"{account.task} power".strip())
        figure.suptitle(plain(words), x=0.01, ha="left", fontsize=11, fontweight="bold")
    return figure


def _stack(
    axes: Axes,
    account: PowerAccount,
    layers: Mapping[str, Array],
    colors: Mapping[str, str],
    scale: float,
) -> None:
    """Layers (N,) upwards where they are positive, downwards where negative."""
    time, shaft = _blocks(account.time), scale * _blocks(account.shaft)
    above, below = np.zeros_like(time), np.zeros_like(time)
    least = 1e-3 * max(float(np.abs(account.shaft).max()), 1e-9)
    for name, power in layers.items():
        if np.abs(power).max() < least:
            continue
        values, color = scale * _blocks(power), colors[name]
        up, down = above + np.maximum(values, 0.0), below + np.minimum(values, 0.0)
        axes.fill_between(time, above, up, color=color, linewidth=0, label=plain(name))
        axes.fill_between(time, below, down, color=color, linewidth=0)
        above, below = up, down
    axes.plot(time, shaft, color=INK, linewidth=1.1, label="shafts")
    axes.axhline(0.0, color=INK, linewidth=0.6)
    axes.margins(x=0.0)
    axes.set_ylim(-_reach(-below, -shaft), _reach(above, shaft))


def _reach(edge: Array, shaft: Array) -> float:
    """How far an axis goes: a line that fills or empties within a sample may leave it."""
    long = min(float(edge.max()), 1.5 * float(np.quantile(edge, 0.998)))
    return 1.06 * max(long, float(shaft.max()), 0.02 * float(np.abs(shaft).max()), 1e-3)


def _blocks(values: Array) -> Array:
    """Means of so many neighbours that a picture can show them."""
    size = -(-len(values) // _MOST)
    return np.add.reduceat(values, starts := np.arange(0, len(values), size)) / np.diff(
        [*starts, len(values)]
    )
