"""Page of a calibration: parameters, fit, residuals, score tests, correlations."""

from html import escape
from pathlib import Path

import numpy as np

from crane.common.units import display_unit
from crane.identification.calibration.calibration_result import (
    Calibration,
    CalibrationChannel,
    FittedParameter,
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
    return write_document(
        path,
        result_title(calibration.machine.name, "calibration"),
        [
            _summary_facts(calibration),
            "<h2>Parameters</h2>",
            _parameter_table(calibration),
            "<h2>Fit</h2>",
            _channel_section(calibration),
            "<h2>Residuals</h2>",
            _dependence_section(calibration),
            "<h2>Score tests</h2>",
            _score_test_section(calibration),
            "<h2>Correlated parameters</h2>",
            _correlation_section(calibration),
            "<h2>Options for this machine</h2>",
            _option_text(calibration),
        ],
    )


def _summary_facts(calibration: Calibration) -> str:
    recordings: dict[str, CalibrationChannel] = {x.recording: x for x in calibration.channels}
    fitted_windows = []
    for x in recordings.values():
        if x.train_mask.any():
            time = x.time[x.train_mask]
            suffix = "" if x.train_mask.all() else ", the rest held out"
            fitted_windows.append(f"{x.recording}, {time[0]:g} to {time[-1]:g} s{suffix}")
    held_out = [x.recording for x in recordings.values() if not x.train_mask.any()]
    parameters = calibration.parameters
    count = sum(not x.at_bound and not x.is_unidentifiable for x in parameters)
    machine = calibration.machine
    return definition_list(
        [
            ("machine", f"{machine.name} ({len(machine.driven_joints)} drives)"),
            ("fitted to", "; ".join(fitted_windows)),
            ("held out completely", ", ".join(held_out)),
            ("parameters", f"{len(parameters)}, {count} identifiable"),
            ("on a bound", ", ".join(x.name for x in parameters if x.at_bound)),
            ("not identifiable", ", ".join(x.name for x in parameters if x.is_unidentifiable)),
            ("simulations", f"{calibration.simulation_count}"),
        ]
    )


def _parameter_table(calibration: Calibration) -> str:
    parameters = calibration.parameters
    columns = {
        "parameter*": [f"<code>{escape(x.name)}</code>" for x in parameters],
        "unit*": [escape(x.unit) for x in parameters],
        "start": [f"{x.start:.5g}" for x in parameters],
        "fitted": [f"{x.value:.5g}" for x in parameters],
        "95 %": [f"&#177; {x.interval_half_width:.2g}" for x in parameters],
        "in the file": [
            f"{x.initial_value:.5g}" if x.initial_value != x.start else "" for x in parameters
        ],
        "remark*": [f'<td class="words">{escape(_parameter_remark(x))}</td>' for x in parameters],
    }
    if not any(columns["in the file"]):
        del columns["in the file"]
    quality_warnings = "".join(
        f"<p><b>{escape(text)}</b></p>" for text in calibration.quality_warnings
    )
    return (
        f"{quality_warnings}<p>Confidence intervals of 95 %, computed without bounds; correlated "
        "residuals reduce the number of independent samples. Grey rows are parameters on a bound "
        "and parameters that the recordings do not determine: they are no result. Intervals hold "
        "for a correct model. A parameter that compensates an effect which is missing in the "
        "machine file may be far off with a narrow interval."
        + " With all candidates: with those free, too, that the selection left out, within their "
        "priors." * bool(calibration.selection) + "</p>"
    ) + html_table(
        list(columns),
        zip(*columns.values(), strict=True),
        ["weak" if x.at_bound or x.is_unidentifiable else "" for x in parameters],
    )


def _parameter_remark(parameter: FittedParameter) -> str:
    remarks = [parameter.remark] if parameter.remark else []
    if parameter.changed_significantly and parameter.interval_half_width > 0:
        change = abs(parameter.value - parameter.initial_value)
        count = change / parameter.interval_half_width
        remarks.append(f"file value off by {count:.2g} intervals")
    return ", ".join(remarks)


def _channel_section(calibration: Calibration) -> str:
    rows, figures = [], []
    has_several_recordings = len({x.recording for x in calibration.channels}) > 1
    for channel in calibration.channels:
        unit, scale = display_unit(channel.unit, float(np.ptp(channel.measured)))
        values = [
            scale * channel.rms(simulated, training)
            for training in (True, False)
            for simulated in (channel.simulated_before, channel.simulated_after)
        ]
        name = f"{channel.recording}: {channel.name}" if has_several_recordings else channel.name
        rows.append(
            [
                f"<code>{escape(name)}</code>",
                escape(unit),
                *("" if np.isnan(x) else f"{x:.3g}" for x in (*values, scale * channel.noise)),
            ]
        )
        figures.append(image_tag(channel_residual_figure(channel, name), f"{name} over time"))
    table = html_table(
        ["channel*", "unit*", "before", "fitted", "held out, before", "held out", "noise"], rows
    )
    return (
        "<p>Root mean square of simulated minus measured values, for training data and held-out "
        "data. The last column estimates the sensor noise from differences of samples.</p>"
        f"{table}<p>Held-out data have a darker background. The lower plots show the residuals of "
        f'the fit.</p><div class="figures">{"".join(figures)}</div>'
    )


def _dependence_section(calibration: Calibration) -> str:
    dependences = residual_dependences(calibration)
    if not dependences:
        return "<p>No drive has a valve.</p>"
    table = html_table(
        ["channel*", "against*", "speed", "pressure", "direction"],
        [
            [f"<code>{escape(x.name)}</code>", escape(x.drive),
             *(f"{100 * share:.0f} %" for share in x.correlation_ratios.values())]
            for x in dependences
        ],
    )  # fmt: skip
    figures = (
        image_tag(residual_dependence_figure(x), f"residual of {x.name}") for x in dependences
    )
    return (
        "<p>Correlation ratios: shares of the variance of the residual (of training data) that "
        "depend on speed, pressure and direction of a drive. Dependence on the direction points "
        "to friction or one orifice of a valve; on the speed, to viscous friction or orifices; "
        "on the pressure, to areas, moduli, leakage or the scale of a sensor. With few strokes, "
        f"some tens of percent may be random.</p>{table}{''.join(figures)}"
    )


def _score_test_section(calibration: Calibration) -> str:
    if not calibration.score_tests:
        return (
            "<p>No other parameter of the machine or its sensors would reduce the cost much.</p>"
        )
    return (
        "<p>Parameters that were not fitted, and the cost reduction by each if it were fitted, "
        "too (score test at the solution).</p>"
    ) + html_table(
        ["parameter*", "value about", "cost reduction"],
        [
            [f"<code>{escape(x.name)}</code>", f"{x.value:.3g}", f"{100 * x.cost_reduction:.0f} %"]
            for x in calibration.score_tests
        ],
    )


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
        items = [
            f"<li>{escape(calibration.describe_direction(x))}</li>"
            for x in calibration.correlated_directions
        ]
        parts.append(
            "<p>The recordings do not determine these simultaneous changes, up to the given "
            f"sizes:</p><ul>{''.join(items)}</ul>"
        )
    if not parts:
        parts.append("<p>All parameters are separately identifiable.</p>")
    if len(calibration.parameters) > _MIN_MATRIX_PARAMETERS:
        names = [parameter.name for parameter in calibration.parameters]
        figure = correlation_figure(calibration.correlation, names)
        image = image_tag(figure, "correlations of the parameters")
        parts.append(f'<div class="scroll"><div class="matrix">{image}</div></div>')
    return "".join(parts)


def _option_text(calibration: Calibration) -> str:
    return (
        "<p>For every command that takes a machine. The machine file has all digits.</p><pre>"
        + escape(calibration.command_line_options).replace(" --", " \\\n--")
        + "</pre>"
    )
