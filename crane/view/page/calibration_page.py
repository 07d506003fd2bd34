"""Page of a calibration: parameters, fit, residuals, score tests, correlations."""

from html import escape
from pathlib import Path

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
from crane.view.plots.calibration_figure import channel_residual_figure, residual_dependence_figure
from crane.view.plots.figure_style import figure_style, image_tag
from crane.view.plots.identification_figures import correlation_figure

_MIN_MATRIX_PARAMETERS = 3  # numbers, whose correlations need no picture


@figure_style
def write_calibration_report(calibration: Calibration, path: str | Path) -> Path:
    """Write a calibration as one self-contained HTML file.

    The page has parameters with intervals; each channel before and after the fit, for training and
    held-out data; residuals against speed, pressure and direction; score tests; correlated
    parameters; and options that reproduce the machine.

    Args:
        calibration: The calibration.
        path: The file to write; replaced if it exists.

    Returns:
        The path.

    Raises:
        OutputError: The file's suffix is not .html or .htm, or it cannot be written.
    """
    dependences = residual_dependences(calibration)
    parts = [
        _summary_facts(calibration),
        "<h2>Parameters</h2>", _parameter_table(calibration),
        "<h2>Fit</h2>", _channel_section(calibration),
        "<h2>Residuals</h2>", _dependence_section(dependences),
        "<h2>Score tests</h2>", _score_test_section(calibration),
        "<h2>Correlated parameters</h2>", _correlation_section(calibration),
        "<h2>Options for this machine</h2>", _option_text(calibration),
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
        "not identifiable": [x.name for x in calibration.parameters if x.is_unidentifiable],
    }
    rows = [
        (
            "machine",
            f"{calibration.machine.name} ({len(calibration.machine.driven_joints)} drives)",
        ),
        ("fitted to", "; ".join(fitted_windows)),
        ("held out completely", ", ".join(held_out)),
        ("parameters", f"{len(calibration.parameters)}, {len(identifiable)} identifiable"),
        *((flag, ", ".join(flagged)) for flag, flagged in flagged_names.items()),
        ("simulations", f"{calibration.simulation_count}"),
    ]
    return definition_list(rows)


def _fitted_window(channel: CalibrationChannel) -> str:
    time = channel.time[channel.train_mask]
    suffix = "" if channel.train_mask.all() else ", the rest held out"
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
        "<p>Confidence intervals of 95 %, computed without bounds; correlated residuals reduce "
        "the number of independent samples. Grey rows are parameters on a bound and parameters "
        "that the recordings do not determine: they are no result. Intervals hold for a correct "
        "model. A parameter that compensates an effect which is missing in the machine file may "
        "be far off with a narrow interval.</p>"
    )
    heading = ["parameter*", "unit*", "start", "fitted", "95 %", "in the file", "remark*"]
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
            filter(None, (parameter.remark, f"file value off by {interval_count:.2g} intervals"))
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
        "<p>Root mean square of simulated minus measured values, for training data and held-out "
        "data. The last column estimates the sensor noise from differences of samples.</p>"
    )
    caption = (
        "<p>Held-out data have a darker background. The lower plots show the residuals of the "
        "fit.</p>"
    )
    figure_row = f'<div class="figures">{"".join(figures)}</div>'
    return f"{explanation}{html_table(heading, rows)}{caption}{figure_row}"


def _dependence_section(dependences: list[ResidualDependence]) -> str:
    if not dependences:
        return "<p>No drive has a valve.</p>"
    rows = [
        [f"<code>{escape(dependence.name)}</code>", escape(dependence.drive),
         *(f"{100 * share:.0f} %" for share in dependence.correlation_ratios.values())]
        for dependence in dependences
    ]  # fmt: skip
    explanation = (
        "<p>Correlation ratios: shares of the variance of the residual (of training data) that "
        "depend on speed, pressure and direction of a drive. Dependence on the direction points "
        "to friction or one orifice of a valve; on the speed, to viscous friction or orifices; "
        "on the pressure, to areas, moduli, leakage or the scale of a sensor. With few strokes, "
        "some tens of percent may be random.</p>"
    )
    heading = ["channel*", "against*", "speed", "pressure", "direction"]
    images = "".join(
        image_tag(residual_dependence_figure(one), f"residual of {one.name}")
        for one in dependences
    )
    return explanation + html_table(heading, rows) + images


def _score_test_section(calibration: Calibration) -> str:
    if not calibration.score_tests:
        return (
            "<p>No other parameter of the machine or its sensors would reduce the cost much.</p>"
        )
    explanation = (
        "<p>Parameters that were not fitted, and the cost reduction by each if it were fitted, "
        "too (score test at the solution).</p>"
    )
    rows = [
        [f"<code>{escape(x.name)}</code>", f"{x.value:.3g}", f"{100 * x.cost_reduction:.0f} %"]
        for x in calibration.score_tests
    ]
    return explanation + html_table(["parameter*", "value about", "cost reduction"], rows)


def _correlation_section(calibration: Calibration) -> str:
    parts = []
    if calibration.correlated_pairs:
        rows = [
            [f"<code>{escape(a)}</code>", f"<code>{escape(b)}</code>", f"{r:+.3f}"]
            for a, b, r in calibration.correlated_pairs
        ]
        parts += ["<p>Of these pairs only a combination is identifiable:</p>",
                  html_table(["one*", "other*", "correlation"], rows)]  # fmt: skip
    if calibration.correlated_directions:
        items = "".join(
            f"<li>{escape(calibration.describe_direction(x))}</li>"
            for x in calibration.correlated_directions
        )
        parts.append(
            "<p>The recordings do not determine these simultaneous changes, up to the given "
            f"sizes:</p><ul>{items}</ul>"
        )
    if not parts:
        parts.append("<p>All parameters are separately identifiable.</p>")
    if len(calibration.parameters) > _MIN_MATRIX_PARAMETERS:
        figure = correlation_figure(
            calibration.correlation, [parameter.name for parameter in calibration.parameters]
        )
        image = image_tag(figure, "correlations of the parameters")
        parts.append(f'<div class="scroll"><div class="matrix">{image}</div></div>')
    return "".join(parts)


def _option_text(calibration: Calibration) -> str:
    lines = [f"--set {name}={value:.8g}" for name, value in calibration.changes.items()]
    explanation = "<p>For every command that takes a machine. The machine file has all digits.</p>"
    command = escape(" ".join(lines)).replace(" --", " \\\n--")
    return f"{explanation}<pre>{command}</pre>"
