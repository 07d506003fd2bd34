"""Figures of an identification: forces, residuals, spectra, correlations."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from crane.common.samples import Array
from crane.identification.mechanics.comparison import ForceComparison
from crane.identification.mechanics.result import Identification
from crane.recordings.recording import FORCE_UNITS
from crane.view.plots.recording import DASHED, INK
from crane.view.plots.text import plain
from crane.view.plots.thinning import envelope

_SEGMENTS = 8  # of a recording, whose periodograms are averaged


def time_figure(fit: ForceComparison, i: int, unit: str, name: str) -> Figure:
    """Measured and modelled force of drive i over time, and their difference below."""
    figure = Figure(figsize=(5.8, 3.3))
    grid = {"height_ratios": (2, 1), "left": 0.14, "right": 0.985, "top": 0.9, "bottom": 0.13}
    upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={**grid, "hspace": 0.12})
    gaps = np.where(fit.moving[:, i], 1.0, np.nan)
    measured = envelope(fit.time, fit.measured[:, i])
    upper.plot(*measured, color="#9db8d6", linewidth=1.6, label="measured")
    upper.plot(fit.time, fit.modelled[:, i] * gaps, **{**DASHED, "linewidth": 0.9}, label="model")
    upper.set_ylabel(f"force [{unit}]")
    upper.set_title(name, loc="left", fontsize=8.5)
    upper.legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=2, borderpad=0, fontsize=8)
    lower.plot(fit.time, fit.residuals[:, i] * gaps, color=INK, linewidth=0.7)
    lower.set_ylabel(f"residual [{unit}]")
    lower.set_xlabel("time [s]")
    upper.margins(x=0.0)
    for axes in (upper, lower):
        axes.yaxis.set_label_coords(-0.125, 0.5)
    return figure


def spectrum_figure(fits: list[tuple[str, ForceComparison, str]], i: int, unit: str) -> Figure:
    """Spectral densities of the residuals of drive i, averaged (Welch 1967).

    Rows that are left out count as zero.

    Args:
        fits: Name, comparison and colour of each curve.
        i: Column of the drive.
        unit: Of its force.
    """
    from scipy.signal import welch

    figure = Figure(figsize=(5.8, 3.3))
    grid = {"left": 0.14, "right": 0.985, "top": 0.9, "bottom": 0.13}
    axes = figure.subplots(gridspec_kw=grid)
    for name, fit, color in fits:
        if not fit.moving[:, i].any():  # its joint stood still
            continue
        kept = np.where(fit.moving[:, i], fit.residuals[:, i], 0.0)
        rate = 1 / float(np.median(np.diff(fit.time)))
        frequency, power = welch(kept, rate, nperseg=-(-len(kept) // _SEGMENTS))
        axes.loglog(frequency[1:], np.sqrt(power[1:]), color=color, linewidth=1.1, label=name)
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel(f"residual [{unit}/√Hz]")
    axes.set_title("spectrum of the residuals", loc="left", fontsize=8.5)
    axes.margins(x=0.0)
    if len(fits) > 1:
        axes.legend(loc="lower left", fontsize=8)
    return figure


def matrix_figure(R: Array, names: Sequence[str]) -> Figure:
    """A correlation matrix (r, r) in colours, columns in the order of the named rows."""
    names = [plain(name) for name in names]
    size = float(np.clip(0.11 * len(names), 4.0, 9.0))
    letters = float(np.clip(60 * size / max(len(names), 1), 3.0, 7.5))
    beside = 0.0095 * letters * max(map(len, names)) + 0.1  # [inch]
    figure = Figure(figsize=(beside + size + 0.8, size + 0.2))
    width, height = figure.get_size_inches()
    axes = figure.add_axes((beside / width, 0.1 / height, size / width, size / height))
    image = axes.imshow(R, cmap="RdBu_r", vmin=-1, vmax=1, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks(range(len(names)), names, fontsize=letters)
    axes.tick_params(length=0)
    axes.grid(False)
    axes.spines[:].set_visible(False)
    bar = ((beside + size + 0.15) / width, 0.35, 0.12 / width, 0.3)
    figure.colorbar(image, cax=figure.add_axes(bar), ticks=(-1, 0, 1))
    return figure


def force_figures(result: Identification) -> list[Figure]:
    """Measured and modelled forces of the training, a figure per drive."""
    return [
        time_figure(result.training, i, FORCE_UNITS[result.described.unit(joint)], joint)
        for i, joint in enumerate(result.training.joints)
    ]
