"""Figures of an identification: forces, residuals, spectra, correlations."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from crane.common.samples import Array
from crane.identification.mechanics.force_comparison import ForceComparison
from crane.identification.mechanics.identification_result import Identification
from crane.recordings.recording import FORCE_UNITS
from crane.view.plots.curve_thinning import envelope
from crane.view.plots.figure_text import escape_label
from crane.view.plots.recording_figure import DASHED_STYLE, INK_COLOUR

_SEGMENT_COUNT = 8  # of a recording, whose periodograms are averaged


def force_time_figure(
    comparison: ForceComparison, drive_index: int, unit: str, name: str
) -> Figure:
    """Measured and modelled force of drive i over time, and their difference below."""
    figure = Figure(figsize=(5.8, 3.3))
    grid = {"height_ratios": (2, 1), "left": 0.14, "right": 0.985, "top": 0.9, "bottom": 0.13}
    upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={**grid, "hspace": 0.12})
    moving_mask = np.where(comparison.is_moving[:, drive_index], 1.0, np.nan)
    measured = envelope(comparison.time, comparison.measured[:, drive_index])
    upper.plot(*measured, color="#9db8d6", linewidth=1.6, label="measured")
    upper.plot(
        comparison.time,
        comparison.modelled[:, drive_index] * moving_mask,
        **{**DASHED_STYLE, "linewidth": 0.9},
        label="model",
    )
    upper.set_ylabel(f"force [{unit}]")
    upper.set_title(name, loc="left", fontsize=8.5)
    upper.legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=2, borderpad=0, fontsize=8)
    lower.plot(
        comparison.time,
        comparison.residuals[:, drive_index] * moving_mask,
        color=INK_COLOUR,
        linewidth=0.7,
    )
    lower.set_ylabel(f"residual [{unit}]")
    lower.set_xlabel("time [s]")
    upper.margins(x=0.0)
    for axes in (upper, lower):
        axes.yaxis.set_label_coords(-0.125, 0.5)
    return figure


def residual_spectrum_figure(
    fits: list[tuple[str, ForceComparison, str]], drive_index: int, unit: str
) -> Figure:
    """Spectral densities of the residuals of drive i, averaged (Welch 1967).

    Rows that are left out count as zero.

    Args:
        fits: Name, comparison and colour of each curve.
        drive_index: Column of the drive.
        unit: Of its force.
    """
    from scipy.signal import welch

    figure = Figure(figsize=(5.8, 3.3))
    grid = {"left": 0.14, "right": 0.985, "top": 0.9, "bottom": 0.13}
    axes = figure.subplots(gridspec_kw=grid)
    for name, fit, color in fits:
        if not fit.is_moving[:, drive_index].any():  # its joint stood still
            continue
        moving_residuals = np.where(
            fit.is_moving[:, drive_index], fit.residuals[:, drive_index], 0.0
        )
        rate = 1 / float(np.median(np.diff(fit.time)))
        frequency, power = welch(
            moving_residuals, rate, nperseg=-(-len(moving_residuals) // _SEGMENT_COUNT)
        )
        axes.loglog(frequency[1:], np.sqrt(power[1:]), color=color, linewidth=1.1, label=name)
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel(f"residual [{unit}/√Hz]")
    axes.set_title("spectrum of the residuals", loc="left", fontsize=8.5)
    axes.margins(x=0.0)
    if len(fits) > 1:
        axes.legend(loc="lower left", fontsize=8)
    return figure


def correlation_figure(R: Array, names: Sequence[str]) -> Figure:
    """A correlation matrix (r, r) in colours, columns in the order of the named rows."""
    names = [escape_label(name) for name in names]
    size = float(np.clip(0.11 * len(names), 4.0, 9.0))
    letter_size = float(np.clip(60 * size / max(len(names), 1), 3.0, 7.5))
    label_width = 0.0095 * letter_size * max(map(len, names)) + 0.1  # [inch]
    figure = Figure(figsize=(label_width + size + 0.8, size + 0.2))
    width, height = figure.get_size_inches()
    axes = figure.add_axes((label_width / width, 0.1 / height, size / width, size / height))
    image = axes.imshow(R, cmap="RdBu_r", vmin=-1, vmax=1, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks(range(len(names)), names, fontsize=letter_size)
    axes.tick_params(length=0)
    axes.grid(False)
    axes.spines[:].set_visible(False)
    colour_bar_box = ((label_width + size + 0.15) / width, 0.35, 0.12 / width, 0.3)
    figure.colorbar(image, cax=figure.add_axes(colour_bar_box), ticks=(-1, 0, 1))
    return figure


def force_figures(result: Identification) -> list[Figure]:
    """Measured and modelled forces of the training, a figure per drive."""
    return [
        force_time_figure(
            result.training, i, FORCE_UNITS[result.described_machine.unit(joint)], joint
        )
        for i, joint in enumerate(result.training.joints)
    ]
