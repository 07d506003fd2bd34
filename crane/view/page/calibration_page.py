"""A calibration as one self-contained page: numbers, how well it follows, what it lacks."""

from html import escape
from pathlib import Path

import matplotlib as mpl
import numpy as np

from crane.common.units import display_unit
from crane.identification.calibration.calibration_result import (
    Calibration,
    CalibrationChannel,
    FittedParameter,
    ResidualDependence,
    residual_dependences,
)
from crane.recordings.recording_summary import result_title
from crane.view.page.html_document import definition_list, html_table, write_document
from crane.view.plots.identification_figures import correlation_figure
from crane.view.plots.image_tags import image_tag
from crane.view.plots.recording_figure import FIGURE_STYLE
from crane.view.plots.residual_figures import channel_residual_figure, residual_dependence_figure

_MIN_MATRIX_PARAMETERS = 3  # numbers, whose correlations need no picture


def write_calibration_report(calibration: Calibration, path: str | Path) -> Path:
    """Write what a calibration found as one HTML file that needs no network.

    Numbers with their intervals; each channel before and after, fitted and held out; what is left
    against speed, pressure and direction; what the model lacks; what the recordings cannot tell
    apart; options that make the same machine.

    Args:
        calibration: What was found.
        path: The file to write; replaced if it exists.

    Returns:
        The path.

    Raises:
        OutputError: The file's suffix is not .html or .htm, or it cannot be written.
    """
    dependences = residual_dependences(calibration)
    with mpl.rc_context(FIGURE_STYLE):
        parts = [
            _summary_facts(calibration),
            "<h2>Numbers</h2>", _parameter_table(calibration),
            "<h2>How well it follows</h2>", _channel_section(calibration),
            "<h2>What is left</h2>", _dependence_section(dependences),
            "<h2>What would help</h2>", _score_test_section(calibration),
            "<h2>Not told apart</h2>", _correlation_section(calibration),
            "<h2>The same machine</h2>", _option_text(calibration),
        ]  # fmt: skip
    return write_document(path, result_title(calibration.machine.name, "calibration"), parts)


def _summary_facts(calibration: Calibration) -> str:
    recordings: dict[str, CalibrationChannel] = {x.recording: x for x in calibration.channels}
    fitted_windows = [_fitted_window(x) for x in recordings.values() if x.train_mask.any()]
    held_out = [x.recording for x in recordings.values() if not x.train_mask.any()]
    identifiable = [
        x for x in calibration.parameters if not x.at_bound and not x.is_unidentifiable
    ]
    flagged_names = {
        "on a bound": [x.name for x in calibration.parameters if x.at_bound],
        "not told": [x.name for x in calibration.parameters if x.is_unidentifiable],
    }
    rows = [
        (
            "machine",
            f"{calibration.machine.name} ({len(calibration.machine.driven_joints)} drives)",
        ),
        ("fitted to", "; ".join(fitted_windows)),
        ("held out whole", ", ".join(held_out)),
        ("numbers", f"{len(calibration.parameters)}, of which {len(identifiable)} are told"),
        *((flag, ", ".join(flagged)) for flag, flagged in flagged_names.items()),
        ("simulations", f"{calibration.simulation_count}"),
    ]
    return definition_list(rows)


def _fitted_window(channel: CalibrationChannel) -> str:
    time = channel.time[channel.train_mask]
    suffix = "" if channel.train_mask.all() else ", the rest is held out"
    return f"{channel.recording}, {time[0]:g} to {time[-1]:g} s{suffix}"


def _parameter_table(calibration: Calibration) -> str:
    rows, classes = [], []
    for parameter in calibration.parameters:
        file_value = (
            f"{parameter.initial_value:.5g}" if parameter.initial_value != parameter.start else ""
        )
        rows.append(
            [
                f"<code>{escape(parameter.name)}</code>",
                escape(parameter.unit),
                f"{parameter.start:.5g}",
                f"{parameter.value:.5g}",
                f"&#177; {parameter.interval_half_width:.2g}",
                file_value,
                escape(_parameter_remark(parameter)),
            ]
        )
        classes.append("weak" if parameter.at_bound or parameter.is_unidentifiable else "")
    explanation = (
        "<p>Intervals of 95 %, as if there were no bounds; instants that what is left couples "
        "count as one. Grey are numbers on a bound, and those that the recordings do not tell: "
        "they are no result. An interval holds for a model that is right: a number that does the "
        "work of something that the machine file has not is far off with a narrow one.</p>"
    )
    heading = ["number*", "unit*", "start", "fitted", "95 %", "in the file", "remark*"]
    if not any(row[5] for row in rows):
        heading, rows = heading[:5] + heading[6:], [row[:5] + row[6:] for row in rows]
    caution_text = "".join(f"<p><b>{escape(caution)}</b></p>" for caution in calibration.cautions)
    return caution_text + explanation + html_table(heading, rows, classes)


def _parameter_remark(parameter: FittedParameter) -> str:
    if parameter.changed_significantly and parameter.interval_half_width > 0:
        interval_count = (
            abs(parameter.value - parameter.initial_value) / parameter.interval_half_width
        )
        return ", ".join(
            filter(
                None, (parameter.remark, f"the file's is off by {interval_count:.2g} intervals")
            )
        )
    return parameter.remark


def _channel_name(calibration: Calibration, channel: CalibrationChannel) -> str:
    has_several_recordings = len({x.recording for x in calibration.channels}) > 1
    return f"{channel.recording}: {channel.name}" if has_several_recordings else channel.name


def _channel_section(calibration: Calibration) -> str:
    rows, figures = [], []
    for channel in calibration.channels:
        unit, scale = display_unit(channel.unit, float(np.ptp(channel.measured)))
        values = [
            scale * channel.rms(simulated, training)
            for training in (True, False)
            for simulated in (channel.simulated_before, channel.simulated_after)
        ]
        cells = ["" if np.isnan(x) else f"{x:.3g}" for x in (*values, scale * channel.noise)]
        name = _channel_name(calibration, channel)
        rows.append([f"<code>{escape(name)}</code>", escape(unit), *cells])
        figures.append(image_tag(channel_residual_figure(channel, name), f"{name} over time"))
    heading = ["channel*", "unit*", "before", "fitted", "held out, before", "held out", "noise"]
    explanation = (
        "<p>Root mean square of simulated less measured, over what was fitted and what was held "
        "out; last about what the sensor's noise is, by the differences of its samples.</p>"
    )
    caption = (
        "<p>What was held out stands on a darker ground. Below what the fitted one leaves.</p>"
    )
    figure_row = f'<div class="figures">{"".join(figures)}</div>'
    return f"{explanation}{html_table(heading, rows)}{caption}{figure_row}"


def _dependence_section(dependences: list[ResidualDependence]) -> str:
    if not dependences:
        return "<p>Nothing is driven by valves.</p>"
    rows = [
        [f"<code>{escape(dependence.name)}</code>", escape(dependence.drive),
         *(f"{100 * share:.0f} %" for share in dependence.correlation_ratios.values())]
        for dependence in dependences
    ]  # fmt: skip
    explanation = (
        "<p>How much of what is left (its variance, where it was fitted) goes with the speed, the "
        "pressure and the direction of a drive. What goes with the direction is friction or one "
        "orifice of a valve; with the speed, viscous friction or orifices; with the pressure, "
        "areas, moduli, leakage or a sensor's scale. Of a few strokes some tens of percent are "
        "chance.</p>"
    )
    heading = ["channel*", "against*", "speed", "pressure", "direction"]
    images = "".join(
        image_tag(residual_dependence_figure(one), f"what is left of {one.name}")
        for one in dependences
    )
    return explanation + html_table(heading, rows) + images


def _score_test_section(calibration: Calibration) -> str:
    if not calibration.score_tests:
        return "<p>No other number of the machine or its sensors would take away much of it.</p>"
    explanation = (
        "<p>Numbers that were not fitted, and how much of what is left each would take away, "
        "alone with those that were; by the derivatives where the search ended.</p>"
    )
    rows = [
        [f"<code>{escape(x.name)}</code>", f"{x.value:.3g}", f"{100 * x.cost_reduction:.0f} %"]
        for x in calibration.score_tests
    ]
    return explanation + html_table(["number*", "at about", "takes away"], rows)


def _correlation_section(calibration: Calibration) -> str:
    parts = []
    if calibration.correlated_pairs:
        rows = [
            [f"<code>{escape(a)}</code>", f"<code>{escape(b)}</code>", f"{r:+.3f}"]
            for a, b, r in calibration.correlated_pairs
        ]
        parts += ["<p>Of these a combination alone is known:</p>",
                  html_table(["one*", "other*", "correlation"], rows)]  # fmt: skip
    if calibration.correlated_directions:
        items = "".join(
            f"<li>{escape(calibration.describe_direction(x))}</li>"
            for x in calibration.correlated_directions
        )
        parts.append(
            "<p>These changes, made together, the recordings do not tell; they end where the "
            f"intervals do:</p><ul>{items}</ul>"
        )
    if not parts:
        parts.append("<p>The recordings tell all of them apart.</p>")
    if len(calibration.parameters) > _MIN_MATRIX_PARAMETERS:
        figure = correlation_figure(
            calibration.correlation, [parameter.name for parameter in calibration.parameters]
        )
        image = image_tag(figure, "correlations of the numbers")
        parts.append(f'<div class="scroll"><div class="matrix">{image}</div></div>')
    return "".join(parts)


def _option_text(calibration: Calibration) -> str:
    lines = [f"--set {name}={value:.8g}" for name, value in calibration.changes.items()]
    explanation = (
        "<p>For every command that takes a machine; all digits are in the machine file.</p>"
    )
    command = escape(" ".join(lines)).replace(" --", " \\\n--")
    return f"{explanation}<pre>{command}</pre>"
