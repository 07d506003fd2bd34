"""Page of an identification: fit, forces, base parameters, correlations."""

import dataclasses
from html import escape
from pathlib import Path

import numpy as np

from crane.identification.estimation.estimators import essential_parameters
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
    parts = [
        _summary_facts(result, recording, validation),
        "<h2>Fit</h2>", _fit_section(result),
        "<h2>Forces</h2>", _force_section(result),
        "<h2>Base parameters</h2>", _base_parameter_section(result),
        *([] if result.parameters is None else ["<h2>Bodies</h2>", _body_section(result)]),
        "<h2>Correlations</h2>", _correlation_section(result),
        "<h2>Unobservable parameters</h2>", _unobservable_section(result),
    ]  # fmt: skip
    return write_document(
        path, result_title(result.described_machine.name, "identification"), parts
    )


def _summary_facts(result: Identification, recording: str, validation: str) -> str:
    machine, fit = result.described_machine, result.training
    method_texts = {
        "ols": "ordinary least squares",
        "wls": "least squares weighted by each joint's noise",
    }
    method_texts["huber"] = "robust (Huber)"
    method = method_texts.get(result.method, result.method)
    if result.feasible:
        method += ", with physically feasible bodies"
    elif result.parameters is not None:
        method += ", about a prior"
    step = float(np.median(np.diff(fit.time)))
    rows = [
        (
            "machine",
            f"{machine.name} ({len(machine.driven_joints)} drives, {len(machine.joints)} joints)",
        ),
        ("source", machine.source),
        ("recording", recording),
        ("validation", validation),
        ("method", method),
        (
            "equations",
            f"{fit.is_moving.sum()} of {fit.is_moving.size}, without standstill, in "
            f"{fit.time[-1] - fit.time[0]:.4g} s thinned to {1 / step:.4g} per second",
        ),
        ("rank", f"{result.base.rank} base parameters of {len(result.base.names)} parameters"),
        (
            "condition number",
            f"{result.estimate.condition:.3g}; {result.estimate.scaled_condition:.3g} with "
            "columns scaled to one",
        ),
        ("unexplained", _unexplained_text(result)),
    ]
    return definition_list(rows)


def _unexplained_text(result: Identification) -> str:
    if np.isnan(result.training.overall_relative_error):
        return "no drive, no force to compare"
    parts = [f"{100 * result.training.overall_relative_error:.3g} % of the forces"]
    if result.validation is not None:
        parts.append(f"{100 * result.validation.overall_relative_error:.3g} % in validation")
    return ", ".join(parts)


def _force_unit(result: Identification, joint: str) -> str:
    return FORCE_UNITS[result.described_machine.unit(joint)]


def _fit_section(result: Identification) -> str:
    fits = [fit for fit in (result.training, result.validation) if fit is not None]
    rows = []
    for i, joint in enumerate(result.training.joints):
        row = [escape(joint)]
        for fit in fits:
            cells = [
                f"{fit.rmse[i]:.4g} {_force_unit(result, joint)}",
                f"{100 * fit.relative_error[i]:.3g} %",
                f"{fit.percentage_error[i]:.3g} %",
            ]
            if joint in result.described_machine.free:
                cells[1:] = "free", ""
            row += cells if fit.is_moving[:, i].any() else ["-", "-", "-"]
        rows.append(row)
    headings = ["drive*", "RMS error", "relative", "squared"]
    explanation = "Without standstill: root mean square of measured minus modelled force, its "
    explanation += "ratio to that of the measured force, and the square of this ratio."
    if result.validation is not None:
        headings += ["validation: RMS error", "relative", "squared"]
    return f"<p>{explanation}</p>{html_table(headings, rows)}"


def _force_section(result: Identification) -> str:
    parts = [
        "<p>Both forces pass the same low-pass filter. The model has gaps near standstill, which "
        "is left out. Spectra are averaged periodograms of the residuals.</p>"
    ]
    fits = [("training", result.training, RECORDED_COLOUR)]
    if result.validation is not None:
        fits.append(("validation", result.validation, _VALIDATION_COLOUR))
    for i, joint in enumerate(result.training.joints):
        unit = _force_unit(result, joint)
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
    lower, upper = result.interval().T
    for i, (name, group) in enumerate(zip(result.names, result.base.groups, strict=True)):
        value, std = result.values[i], result.std[i]
        contains_zero = lower[i] <= 0 <= upper[i]
        remarks = ["essential"] * (i in essential_indices) + ["zero in interval"] * bool(
            contains_zero
        )
        remarks += [result.marks[i]] * bool(result.marks[i])
        other_members = group.removeprefix(name).strip()
        rows.append(
            [
                f"<code>{escape(name)}</code>",
                f"{value:.5g}",
                f"{lower[i]:.4g}",
                f"{upper[i]:.4g}",
                _format_share(std, value),
                f"{result.nominal[i]:.5g}",
                ", ".join(remarks),
                f'<td class="words">{_format_group(other_members)}</td>',
            ]
        )
        classes.append("weak" if i not in essential_indices else "")
    explanation = (
        f"<p>{len(essential_indices)} of {len(result.names)} are essential: without the others "
        "(grey), the forces are not explained significantly worse. Intervals have a confidence of "
        "95 %. Parameters are not determined if their standard deviation exceeds the values of "
        "such machines. A base parameter combines the parameter in its name with others that have "
        "the same effect.</p>"
    )
    headings = [
        "parameter*", "value", "from", "to", "rel. std", "description", "marks*", "together with*",
    ]  # fmt: skip
    return warning_text + explanation + html_table(headings, rows, classes)


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
    assert result.parameters is not None
    rows = []
    for i, body in enumerate(result.model.bodies):
        row = [f"<code>{escape(body)}</code>"]
        for values in (result.parameters, result.model.nominal):
            mass, *first_moment = values[10 * i : 10 * i + 4]
            row += [f"{mass:.4g}", ", ".join(f"{1e3 * x / mass:z.1f}" for x in first_moment)]
        rows.append(row)
    headings = ["body*", "mass [kg]", "centre [mm]", "described mass", "described centre"]
    explanation = "Values of all parameters. Forces determine the base parameters above, and the "
    return f"<p>{explanation}description the rest.</p>{html_table(headings, rows)}"


def _correlation_section(result: Identification) -> str:
    std = np.where(result.std > 0, result.std, 1.0)
    R = result.covariance / np.outer(std, std)
    pairs = sorted(zip(*np.triu_indices(len(R), 1), strict=True), key=lambda at: -abs(R[at]))
    strong_pairs = [pair for pair in pairs if abs(R[pair]) > _CORRELATION_THRESHOLD]
    rows = [
        [f"<code>{escape(result.names[i])}</code>", f"<code>{escape(result.names[j])}</code>",
         f"{R[i, j]:+.3f}"]
        for i, j in strong_pairs[:_MAX_PAIRS]
    ]  # fmt: skip
    explanation = (
        f"<p>{len(strong_pairs)} pairs of estimates are correlated by more than "
        f"{_CORRELATION_THRESHOLD:g}"
    )
    explanation += ": motions that separate them would improve both." if strong_pairs else "."
    pair_table = html_table(["one*", "other*", "correlation"], rows) if rows else ""
    image = image_tag(correlation_figure(R, result.names), "correlation matrix")
    return (
        f'{explanation}</p>{pair_table}<div class="scroll"><div class="matrix">{image}</div></div>'
    )


def _unobservable_section(result: Identification) -> str:
    base = result.base
    unexcited = [
        name
        for name, column in zip(base.names, base.grouping.T, strict=True)
        if not column.any() and name not in base.unobservable
    ]
    out = []
    for names, explanation in (
        (base.unobservable, "Without effect on the forces in any motion"),
        (unexcited, "Without effect in this recording"),
    ):
        if names:
            listed = ", ".join(f"<code>{escape(name)}</code>" for name in names)
            out.append(f"<p>{explanation}: {listed}.</p>")
    return "".join(out) or "<p>Every parameter has an effect on the forces.</p>"
