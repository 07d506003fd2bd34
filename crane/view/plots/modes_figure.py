"""Figures of linear models and sensitivities."""

import itertools
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.optimize import linear_sum_assignment

from crane.common.samples import Array
from crane.common.units import display_unit
from crane.description.machine_lookup import CHANGES_SEPARATOR
from crane.recordings.recording_summary import DISPLAY_UNITS, result_title
from crane.simulation.linear.linear_model import LinearModel, Mode
from crane.simulation.sensitivity.motion_sensitivities import ZERO_TOLERANCE, Sensitivities
from crane.view.plots.figure_style import (
    CURVE_COLOURS,
    INK_COLOUR,
    RECORDED_COLOUR,
    add_heading,
    create_time_panels,
    escape_label,
    figure_style,
)

_FREQUENCY_COUNT = 600  # frequencies of a response
_MAX_INPUT_PANELS = 6  # panels of inputs
_MIN_MODAL_ASSURANCE = 0.2  # modal assurance of a mode that goes on
_MIN_RESPONSE_SHARE = 1e-6  # share of the largest response that is not drawn


@figure_style
def modes_figure(model: LinearModel) -> Figure:
    """Return poles with dominant states, and a panel of frequency responses per input."""
    frequencies = _frequency_grid(model)
    responses = np.abs(model.response(frequencies))
    responding_inputs = [
        j
        for j in range(len(model.inputs))
        if responses[:, _position_outputs(model), j].max(initial=0) > 0
    ][:_MAX_INPUT_PANELS]
    columns = 1 + min(len(responding_inputs), 3)
    rows = max(1, -(-len(responding_inputs) // 3))
    figure = Figure(figsize=(3.6 * columns + 0.4, 3.2 * rows + 0.5), layout="constrained")
    grid = figure.add_gridspec(rows, columns)
    _draw_poles(figure.add_subplot(grid[:, 0]), model)
    for i, j in enumerate(responding_inputs):
        axes = figure.add_subplot(grid[i // 3, 1 + i % 3])
        _draw_response(axes, model, frequencies, responses[:, :, j], j)
    add_heading(figure, escape_label(result_title(model.machine.name, "small motions")))
    return figure


@figure_style
def parameter_modes_figure(models: Sequence[tuple[dict[str, float], LinearModel]]) -> Figure:
    """Return frequency and damping over the first parameter; colours for the others."""
    names = list(models[0][0])
    families: dict[tuple[float, ...], list[tuple[float, LinearModel]]] = {}
    for values, model in models:
        first_value, other_values = next(iter(values.values())), tuple(values.values())[1:]
        families.setdefault(other_values, []).append((first_value, model))
    figure = Figure(figsize=(6.4, 5.6), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    for color, (family_values, family) in zip(
        itertools.cycle(CURVE_COLOURS), families.items(), strict=False
    ):
        label_text = ", ".join(
            f"{name} {value:g}" for name, value in zip(names[1:], family_values, strict=True)
        )
        family.sort(key=lambda pair: pair[0])
        for k, (x, frequency, damping) in enumerate(_track_modes(family)):
            upper.plot(
                x,
                frequency,
                color=color,
                marker="o",
                ms=2.5,
                label=escape_label(label_text) if label_text and not k else "_",
            )
            lower.plot(x, 100 * damping, color=color, marker="o", ms=2.5)
    upper.set(yscale="log", ylabel="frequency [Hz]")
    lower.set_ylabel("damping [%]")
    machine = models[0][1].machine
    unit = machine.unit(names[0]) if names[0] in machine.active else ""
    lower.set_xlabel(escape_label(f"{names[0]} [{unit}]" if unit else names[0]))
    if len(families) > 1:
        figure.legend(loc="outside lower center", ncols=min(len(families), 5))
    add_heading(figure, escape_label(result_title(machine.name, "oscillatory modes")))
    return figure


def _track_modes(family: Sequence[tuple[float, LinearModel]]) -> list[tuple[Array, Array, Array]]:
    """Track oscillatory modes by their shapes; return parameter, frequency, damping of each."""
    branches: list[list[tuple[float, Mode]]] = []
    for x, model in family:
        modes = [mode for mode in model.modes if mode.is_oscillatory]
        unmatched = list(range(len(modes)))
        if branches and modes:
            last_modes = [branch[-1][1] for branch in branches]
            assurances = np.array(
                [
                    [_modal_assurance(model, last_mode, mode) for mode in modes]
                    for last_mode in last_modes
                ]
            )
            for k, i in zip(*linear_sum_assignment(-assurances), strict=True):
                if assurances[k, i] > _MIN_MODAL_ASSURANCE:
                    branches[k].append((x, modes[i]))
                    unmatched.remove(int(i))
        branches += [[(x, modes[i])] for i in unmatched]
    return [
        (
            np.array([x for x, _ in branch]),
            np.array([mode.frequency for _, mode in branch]),
            np.array([mode.damping for _, mode in branch]),
        )
        for branch in branches
    ]


def _modal_assurance(model: LinearModel, first: Mode, second: Mode) -> float:
    """Return the modal assurance criterion of two mode shapes, 1 for equal shapes."""
    units = model.machine.closure.units
    a, b = first.shape / units, second.shape / units
    product = np.linalg.norm(a) * np.linalg.norm(b)
    return float(abs(np.vdot(a, b)) / product) ** 2 if product else 0.0


def _frequency_grid(model: LinearModel) -> Array:
    """Return frequencies [Hz] around all poles, dense around oscillatory modes."""
    oscillating_frequencies = [mode.frequency for mode in model.modes if mode.is_oscillatory]
    used_frequencies = (
        oscillating_frequencies
        or [mode.frequency for mode in model.modes if mode.frequency > 0]
        or [1.0]
    )
    lowest, highest = max(min(used_frequencies) / 30, 1e-3), min(max(used_frequencies) * 5, 1e4)
    refined_frequencies = [f * np.linspace(0.98, 1.02, 41) for f in oscillating_frequencies]
    return np.unique(
        np.concatenate(
            [
                np.geomspace(lowest, max(highest, 10 * lowest), _FREQUENCY_COUNT),
                *refined_frequencies,
            ]
        )
    )


def _draw_poles(axes: Axes, model: LinearModel) -> None:
    """Draw poles over frequency and damping."""
    drawn_modes = [mode for mode in model.modes if mode.frequency > 0]
    axes.axhline(0.0, color=INK_COLOUR, lw=0.6)
    for mode in drawn_modes:
        is_oscillating = mode.is_oscillatory
        axes.plot(
            [mode.frequency], [100 * mode.damping], "o" if is_oscillating else "x", ms=4.5,
            color=RECORDED_COLOUR if is_oscillating else "#909090", clip_on=False, zorder=3,
        )  # fmt: skip
        if is_oscillating:
            axes.annotate(
                escape_label(model.dominant_state(mode)),
                (mode.frequency, 100 * mode.damping),
                fontsize=7,
                xytext=(3, 4),
                textcoords="offset points",
            )
    axes.set_xscale("log")
    powers = np.log10([mode.frequency for mode in drawn_modes] or [1.0])
    axes.set_xlim(10 ** np.floor(powers.min()), 10 ** (np.floor(powers.max()) + 1))
    axes.set_yscale("symlog", linthresh=1.0)
    axes.set(xlabel="frequency [Hz]", ylabel="damping [%]")
    axes.set_ylim(
        min(0.0, 1.5 * min((100 * mode.damping for mode in drawn_modes), default=0.0)), 200.0
    )
    zero_count = sum(mode.frequency == 0 for mode in model.modes)
    axes.set_title("poles" + (f" ({zero_count} more at zero)" if zero_count else ""))


def _position_outputs(model: LinearModel) -> list[int]:
    """Return the outputs that are coordinates of active joints."""
    return [i for i, name in enumerate(model.outputs) if name in model.machine.active]


def _draw_response(
    axes: Axes, model: LinearModel, frequencies: Array, response: Array, input_index: int
) -> None:
    position_outputs = _position_outputs(model)
    for color, i in zip(itertools.cycle(CURVE_COLOURS), position_outputs, strict=False):
        joint = model.outputs[i]
        unit, factor = DISPLAY_UNITS[model.machine.unit(joint)]
        if response[:, i].max() > _MIN_RESPONSE_SHARE * response[:, position_outputs].max():
            axes.loglog(
                frequencies,
                factor * response[:, i],
                color=color,
                lw=1.1,
                label=escape_label(f"{joint} [{unit}/{model.units[model.inputs[input_index]]}]"),
            )
    axes.set(title=escape_label(f"per {model.inputs[input_index]}"), xlabel="frequency [Hz]")
    axes.legend(fontsize=6.5)


_MAX_PANELS = 18  # panels


@figure_style
def sensitivities_figure(sensitivities: Sensitivities) -> Figure:
    """Return a panel per output with nonzero sensitivities, a line per parameter."""
    effects = sensitivities.derivatives * sensitivities.typical_changes
    panels = []
    for k, output in enumerate(sensitivities.outputs):
        largest = float(np.abs(effects[:, k]).max())
        unit, scale = display_unit(sensitivities.unit(output), largest)
        if scale * largest > ZERO_TOLERANCE:
            panels.append((output, unit, scale * effects[:, k]))
    panels = panels[:_MAX_PANELS]
    figure, all_axes = create_time_panels(len(panels), 2, 5.6, 0.9)
    for axes, (output, unit, values) in zip(all_axes, panels, strict=True):
        for i, name in enumerate(sensitivities.parameters):
            axes.plot(
                sensitivities.recording.time,
                values[:, i],
                linewidth=1.0,
                label=escape_label(f"{name} + {sensitivities.typical_changes[i]:.3g}"),
            )
        axes.set_title(escape_label(f"{output} [{unit}]"), fontsize=8.5)
    if panels:
        figure.legend(handles=all_axes[0].get_lines(), loc="outside lower center", ncols=3)
    add_heading(
        figure,
        escape_label(
            result_title(
                sensitivities.recording.machine.partition(CHANGES_SEPARATOR)[0], "sensitivities"
            )
        ),
    )
    return figure
