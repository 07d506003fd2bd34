"""Page of an identification: fit, forces, base parameters, correlations."""

import dataclasses
from html import escape
from pathlib import Path

import numpy as np

from crane.identification.mechanics.identifiability import essential_parameters
from crane.identification.mechanics.identification_result import Identification
from crane.recordings.recording import FORCE_UNITS
from crane.recordings.recording_summary import result_title
from crane.view.page.html_document import definition_list, html_table, write_document
from crane.view.plots.figure_style import RECORDED_COLOUR, figure_style, image_tag
from crane.view.plots.identification_figures import (
    correlation_figure,
    force_time_figure,
    residual_spectrum_figure,
)

_MAX_GROUP_LENGTH = 70  # letters of a group that are shown at once
_MAX_PAIRS = 10
_CORRELATION_THRESHOLD = 0.9
_VALIDATION_COLOUR = "#2a9d6f"
_METHOD_TEXTS = {
    "ols": "ordinary least squares",
    "wls": "least squares weighted by each joint's noise",
    "huber": "robust (Huber)",
}


@figure_style
def identification_report(
    result: Identification, path: str | Path, recording: str = "", validation: str = ""
) -> Path:
    """Write an identification as one self-contained HTML file.

    The page has a summary; the fit of every actuator; measured and modelled forces, residuals and
    their spectra; base parameters with intervals; correlations; and unobservable parameters.

    Args:
        result: The identification.
        path: The file to write; replaced if it exists.
        recording: Description of the training data.
        validation: Description of the validation data.

    Returns:
        The path.

    Raises:
        OutputError: The file's suffix is not .html or .htm, or it cannot be written.
    """
    return write_document(
        path,
        result_title(result.described_machine.name, "identification"),
        [
            _summary_facts(result, recording, validation),
            "<h2>Fit</h2>",
            _fit_section(result),
            "<h2>Forces</h2>",
            _force_section(result),
            "<h2>Base parameters</h2>",
            _base_parameter_section(result),
            *([] if result.parameters is None else ["<h2>Bodies</h2>", _body_section(result)]),
            "<h2>Correlations</h2>",
            _correlation_section(result),
            "<h2>Unobservable parameters</h2>",
            _unobservable_section(result),
        ],
    )


def _summary_facts(result: Identification, recording: str, validation: str) -> str:
    machine, fit = result.described_machine, result.training
    method = _METHOD_TEXTS.get(result.method, result.method)
    if result.feasible:
        method += ", with physically feasible bodies"
    elif result.parameters is not None:
        method += ", about a prior"
    residual_text = "no drive, no force to compare"
    if not np.isnan(fit.overall_relative_error):
        residual_text = f"{100 * fit.overall_relative_error:.3g} % of the forces"
        if result.validation is not None:
            error = result.validation.overall_relative_error
            residual_text += f", {100 * error:.3g} % in validation"
    sample_rate = 1 / float(np.median(np.diff(fit.time)))
    drive_count, joint_count = len(machine.driven_joints), len(machine.joints)
    return definition_list(
        [
            ("machine", f"{machine.name} ({drive_count} drives, {joint_count} joints)"),
            ("source", machine.source),
            ("recording", recording),
            ("validation", validation),
            ("method", method),
            (
                "equations",
                f"{fit.is_moving.sum()} of {fit.is_moving.size}, without standstill, in "
                f"{fit.time[-1] - fit.time[0]:.4g} s thinned to {sample_rate:.4g} per second",
            ),
            ("rank", f"{result.base.rank} base parameters of {len(result.base.names)} parameters"),
            (
                "condition number",
                f"{result.estimate.condition:.3g}; {result.estimate.scaled_condition:.3g} with "
                "columns scaled to one",
            ),
            ("residual forces", residual_text),
        ]
    )


def _fit_section(result: Identification) -> str:
    machine, rows = result.described_machine, []
    fits = [fit for fit in (result.training, result.validation) if fit is not None]
    headings = ["drive*", "RMS error", "relative", "squared"]
    if result.validation is not None:
        headings += ["validation: RMS error", "relative", "squared"]
    for i, joint in enumerate(result.training.joints):
        row = [escape(joint)]
        for fit in fits:
            error = f"{fit.rmse[i]:.4g} {FORCE_UNITS[machine.unit(joint)]}"
            shares = [f"{100 * fit.relative_error[i]:.3g} %", f"{fit.percentage_error[i]:.3g} %"]
            cells = [error, *(["free", ""] if joint in machine.free else shares)]
            row += cells if fit.is_moving[:, i].any() else ["-", "-", "-"]
        rows.append(row)
    return (
        "<p>Without standstill: root mean square of measured minus modelled force, its "
        "ratio to that of the measured force, and the square of this ratio.</p>"
    ) + html_table(headings, rows)


def _force_section(result: Identification) -> str:
    parts = [
        "<p>Both forces pass the same low-pass filter. The model has gaps near standstill, which "
        "is left out. Spectra are averaged periodograms of the residuals.</p>"
    ]
    fits = [("training", result.training, RECORDED_COLOUR)]
    if result.validation is not None:
        fits.append(("validation", result.validation, _VALIDATION_COLOUR))
    for i, joint in enumerate(result.training.joints):
        unit = FORCE_UNITS[result.described_machine.unit(joint)]
        figures = [force_time_figure(fit, i, unit, name) for name, fit, _ in fits]
        figures.append(residual_spectrum_figure(fits, i, unit))
        images = (image_tag(f, f"{joint}: force") for f in figures)
        parts.append(f'<h3>{escape(joint)}</h3><div class="figures">{"".join(images)}</div>')
    return "".join(parts)


def _base_parameter_section(result: Identification) -> str:
    estimate = dataclasses.replace(
        result.estimate, values=result.values, covariance=result.covariance
    )
    warning_text = f"<p><b>{escape(result.warning)}</b></p>" if result.warning else ""
    essential_indices = set(essential_parameters(estimate).tolist())
    rows, classes = [], []
    for i, (lower, upper) in enumerate(result.confidence_interval()):
        name, value, is_essential = result.names[i], result.values[i], i in essential_indices
        marks = {
            "essential": is_essential,
            "zero in interval": lower <= 0 <= upper,
            result.marks[i]: bool(result.marks[i]),
        }
        other_members = result.base.groups[i].removeprefix(name).strip()
        rows.append(
            [
                f"<code>{escape(name)}</code>",
                f"{value:.5g}",
                f"{lower:.4g}",
                f"{upper:.4g}",
                _format_share(result.std[i], value),
                f"{result.nominal[i]:.5g}",
                ", ".join(mark for mark, is_set in marks.items() if is_set),
                f'<td class="words">{_format_group(other_members)}</td>',
            ]
        )
        classes.append("" if is_essential else "weak")
    return (
        f"{warning_text}<p>{len(essential_indices)} of {len(result.names)} are essential: without "
        "the others (grey), the forces are not explained significantly worse. Intervals have a "
        "confidence of 95 %. Parameters are not determined if their standard deviation exceeds "
        "the values of such machines. A base parameter combines the parameter in its name with "
        "others that have the same effect.</p>"
    ) + html_table(
        [
            "parameter*",
            "value",
            "from",
            "to",
            "rel. std",
            "description",
            "marks*",
            "together with*",
        ],
        rows,
        classes,
    )


def _format_share(numerator: float, denominator: float) -> str:
    share = abs(numerator / denominator) if denominator else np.inf
    return (
        f"{100 * share:.2g} %"
        if share < 1
        else f"{100 * share:.0f} %"
        if share < 10
        else "&gt; 1000 %"
    )


def _format_group(text: str) -> str:
    """Return a group as HTML; the end of a long one is folded."""
    if len(text) <= _MAX_GROUP_LENGTH:
        return escape(text)
    cut_position = text.rfind(" ", 0, _MAX_GROUP_LENGTH)
    return (
        f"<details><summary>{escape(text[:cut_position])} "
        f"...</summary>{escape(text[cut_position:])}</details>"
    )


def _body_section(result: Identification) -> str:
    rows = []
    for i, body in enumerate(result.model.bodies):
        row = [f"<code>{escape(body)}</code>"]
        for values in (result.parameters, result.model.nominal):
            assert values is not None, "bodies of an identification with all parameters"
            mass, *first_moment = values[10 * i : 10 * i + 4]
            row += [f"{mass:.4g}", ", ".join(f"{1e3 * x / mass:z.1f}" for x in first_moment)]
        rows.append(row)
    return (
        "<p>Values of all parameters. Forces determine the base parameters above, and the "
        "description the rest.</p>"
    ) + html_table(
        ["body*", "mass [kg]", "centre [mm]", "described mass", "described centre"], rows
    )


def _correlation_section(result: Identification) -> str:
    std = np.where(result.std > 0, result.std, 1.0)
    R = result.covariance / np.outer(std, std)
    pairs = [
        pair
        for pair in zip(*np.triu_indices(len(R), 1), strict=True)
        if abs(R[pair]) > _CORRELATION_THRESHOLD
    ]
    pairs.sort(key=lambda pair: -abs(R[pair]))
    rows = [
        [f"<code>{escape(result.names[i])}</code>", f"<code>{escape(result.names[j])}</code>",
         f"{R[i, j]:+.3f}"]
        for i, j in pairs[:_MAX_PAIRS]
    ]  # fmt: skip
    pair_table = html_table(["one*", "other*", "correlation"], rows) if rows else ""
    consequence = ": motions that separate them would improve both." if rows else "."
    image = image_tag(correlation_figure(R, result.names), "correlation matrix")
    return (
        f"<p>{len(pairs)} pairs of estimates are correlated by more than "
        f"{_CORRELATION_THRESHOLD:g}{consequence}</p>{pair_table}"
        f'<div class="scroll"><div class="matrix">{image}</div></div>'
    )


def _unobservable_section(result: Identification) -> str:
    base = result.base
    unexcited = [
        x
        for x, column in zip(base.names, base.grouping.T, strict=True)
        if not column.any() and x not in base.unobservable
    ]
    parts = [
        f"<p>{explanation}: {', '.join(f'<code>{escape(name)}</code>' for name in names)}.</p>"
        for names, explanation in (
            (base.unobservable, "Without effect on the forces in any motion"),
            (unexcited, "Without effect in this recording"),
        )
        if names
    ]
    return "".join(parts) or "<p>Every parameter has an effect on the forces.</p>"
