"""An identification as one self-contained page: what was found, and how well it predicts."""

import dataclasses
from html import escape
from pathlib import Path

import matplotlib as mpl
import numpy as np

from crane.identification.estimation.estimators import essential
from crane.identification.mechanics.result import Identification
from crane.recordings.recording import FORCE_UNITS
from crane.recordings.summary import title
from crane.view.page.document import facts, table, write_document
from crane.view.plots.identification import matrix_figure, spectrum_figure, time_figure
from crane.view.plots.recording import RECORDED, STYLE
from crane.view.plots.tags import image_tag

_LONG_WORDS = 70  # letters of a group that are shown at once
_MOST_PAIRS = 10
_CORRELATED = 0.9
_VALIDATION = "#2a9d6f"


def identification_report(
    result: Identification, path: str | Path, recording: str = "", validation: str = ""
) -> Path:
    """Write what an identification found as one HTML file that needs no network.

    Summary; fit of every actuator; measured and modelled forces, residuals and their spectra;
    base parameters with intervals; their correlations; what forces cannot tell.

    Args:
        result: What was found.
        path: The file to write; replaced if it exists.
        recording: What it was identified from, in words.
        validation: What it was judged by.

    Returns:
        The path.

    Raises:
        OutputError: The file's suffix is not .html or .htm, or it cannot be written.
    """
    with mpl.rc_context(STYLE):
        parts = [
            _summary(result, recording, validation),
            "<h2>Fit</h2>", _fit(result),
            "<h2>Forces</h2>", _forces(result),
            "<h2>Base parameters</h2>", _parameters(result),
            *([] if result.parameters is None else ["<h2>Bodies</h2>", _bodies(result)]),
            "<h2>Correlations</h2>", _correlations(result),
            "<h2>Not told</h2>", _unobservable(result),
        ]  # fmt: skip
    return write_document(path, title(result.described.name, "identification"), parts)


def _summary(result: Identification, recording: str, validation: str) -> str:
    machine, fit = result.described, result.training
    how = {"ols": "ordinary least squares", "wls": "least squares weighted by each joint's noise"}
    how["huber"] = "robust (Huber)"
    method = how.get(result.method, result.method)
    if result.feasible:
        method += ", with bodies that can exist"
    elif result.parameters is not None:
        method += ", about a prior"
    step = float(np.median(np.diff(fit.time)))
    rows = [
        (
            "machine",
            f"{machine.name} ({len(machine.driven_joints)} drives, {len(machine.joints)} joints)",
        ),
        ("its numbers", machine.source),
        ("recording", recording),
        ("validation", validation),
        ("method", method),
        (
            "equations",
            f"{fit.moving.sum()} of {fit.moving.size}, those away from standstill, in "
            f"{fit.time[-1] - fit.time[0]:.4g} s thinned to {1 / step:.4g} per second",
        ),
        ("rank", f"{result.base.rank} base parameters of {len(result.base.names)} parameters"),
        (
            "condition number",
            f"{result.estimate.condition:.3g}; {result.estimate.scaled_condition:.3g} with "
            "columns scaled to one",
        ),
        ("unexplained", _stacked(result)),
    ]
    return facts(rows)


def _stacked(result: Identification) -> str:
    if np.isnan(result.training.stacked):
        return "nothing drives it: no force to compare with"
    parts = [f"{100 * result.training.stacked:.3g} % of the forces"]
    if result.validation is not None:
        parts.append(f"{100 * result.validation.stacked:.3g} % in validation")
    return ", ".join(parts)


def _unit(result: Identification, joint: str) -> str:
    return FORCE_UNITS[result.described.unit(joint)]


def _fit(result: Identification) -> str:
    fits = [fit for fit in (result.training, result.validation) if fit is not None]
    rows = []
    for i, joint in enumerate(result.training.joints):
        row = [escape(joint)]
        for fit in fits:
            told = [
                f"{fit.rmse[i]:.4g} {_unit(result, joint)}",
                f"{100 * fit.relative[i]:.3g} %",
                f"{fit.percentage_error[i]:.3g} %",
            ]
            if joint in result.described.free:
                told[1:] = "free", ""
            row += told if fit.moving[:, i].any() else ["-", "-", "-"]
        rows.append(row)
    head = ["drive*", "RMS error", "relative", "squared"]
    words = "Of rows away from standstill: root mean square of measured less modelled force, its "
    words += "ratio to that of the measured force, and the square of this ratio."
    if result.validation is not None:
        head += ["validation: RMS error", "relative", "squared"]
    return f"<p>{words}</p>{table(head, rows)}"


def _forces(result: Identification) -> str:
    out = [
        "<p>Both through the same low-pass. The model has gaps where a joint is near standstill, "
        "which is left out. Spectra are averaged periodograms of the residuals.</p>"
    ]
    fits = [("training", result.training, RECORDED)]
    if result.validation is not None:
        fits.append(("validation", result.validation, _VALIDATION))
    for i, joint in enumerate(result.training.joints):
        unit = _unit(result, joint)
        figures = [time_figure(fit, i, unit, name) for name, fit, _ in fits]
        figures.append(spectrum_figure(fits, i, unit))
        images = (image_tag(f, f"{joint}: force") for f in figures)
        out.append(f'<h3>{escape(joint)}</h3><div class="figures">{"".join(images)}</div>')
    return "".join(out)


def _parameters(result: Identification) -> str:
    told = dataclasses.replace(result.estimate, values=result.values, covariance=result.covariance)
    doubt = f"<p><b>{escape(result.doubt)}</b></p>" if result.doubt else ""
    kept = set(essential(told).tolist())
    rows, classes = [], []
    low, high = result.interval().T
    for i, (name, words) in enumerate(zip(result.names, result.base.groups, strict=True)):
        value, std = result.values[i], result.std[i]
        zero = low[i] <= 0 <= high[i]
        marks = ["essential"] * (i in kept) + ["zero in interval"] * bool(zero)
        marks += [result.marks[i]] * bool(result.marks[i])
        rest = words.removeprefix(name).strip()
        rows.append(
            [
                f"<code>{escape(name)}</code>",
                f"{value:.5g}",
                f"{low[i]:.4g}",
                f"{high[i]:.4g}",
                _percent(std, value),
                f"{result.nominal[i]:.5g}",
                ", ".join(marks),
                f'<td class="words">{_words(rest)}</td>',
            ]
        )
        classes.append("weak" if i not in kept else "")
    text = (
        f"<p>{len(kept)} of {len(result.names)} are essential: without the others, which are "
        "grey, the forces are not explained significantly worse. The intervals cover the truth "
        "with 95 % confidence. Not determined are those whose deviation exceeds what such a "
        "machine can have. A base parameter is the one that "
        "it is named after together with others that act alike.</p>"
    )
    head = [
        "parameter*", "value", "from", "to", "rel. std", "description", "marks*", "together with*",
    ]  # fmt: skip
    return doubt + text + table(head, rows, classes)


def _percent(part: float, whole: float) -> str:
    """A share of at most 1000 %."""
    share = abs(part / whole) if whole else np.inf
    return (
        f"{100 * share:.2g} %"
        if share < 1
        else f"{100 * share:.0f} %"
        if share < 10
        else "&gt; 1000 %"
    )


def _words(text: str) -> str:
    """A group in words, the end of long ones to be opened."""
    if len(text) <= _LONG_WORDS:
        return escape(text)
    cut = text.rfind(" ", 0, _LONG_WORDS)
    return f"<details><summary>{escape(text[:cut])} ...</summary>{escape(text[cut:])}</details>"


def _bodies(result: Identification) -> str:
    assert result.parameters is not None
    rows = []
    for i, body in enumerate(result.model.bodies):
        row = [f"<code>{escape(body)}</code>"]
        for values in (result.parameters, result.model.nominal):
            mass, *first = values[10 * i : 10 * i + 4]
            row += [f"{mass:.4g}", ", ".join(f"{1e3 * x / mass:z.1f}" for x in first)]
        rows.append(row)
    head = ["body*", "mass [kg]", "centre [mm]", "described mass", "described centre"]
    words = "Values of all parameters, of which forces tell the base parameters above; the "
    return f"<p>{words}description says the rest.</p>{table(head, rows)}"


def _correlations(result: Identification) -> str:
    std = np.where(result.std > 0, result.std, 1.0)
    R = result.covariance / np.outer(std, std)
    pairs = sorted(zip(*np.triu_indices(len(R), 1), strict=True), key=lambda at: -abs(R[at]))
    strong = [at for at in pairs if abs(R[at]) > _CORRELATED]
    rows = [
        [f"<code>{escape(result.names[i])}</code>", f"<code>{escape(result.names[j])}</code>",
         f"{R[i, j]:+.3f}"]
        for i, j in strong[:_MOST_PAIRS]
    ]  # fmt: skip
    words = f"<p>{len(strong)} pairs of estimates are correlated by more than {_CORRELATED:g}"
    words += ": motions that separate them would tell both better." if strong else "."
    listed = table(["one*", "other*", "correlation"], rows) if rows else ""
    image = image_tag(matrix_figure(R, result.names), "correlation matrix")
    return f'{words}</p>{listed}<div class="scroll"><div class="matrix">{image}</div></div>'


def _unobservable(result: Identification) -> str:
    base = result.base
    unmoved = [
        name
        for name, column in zip(base.names, base.grouping.T, strict=True)
        if not column.any() and name not in base.unobservable
    ]
    out = []
    for names, words in (
        (base.unobservable, "Without any effect on the forces, in whatever motion"),
        (unmoved, "Without effect in this recording"),
    ):
        if names:
            listed = ", ".join(f"<code>{escape(name)}</code>" for name in names)
            out.append(f"<p>{words}: {listed}.</p>")
    return "".join(out) or "<p>Every parameter has an effect on the forces.</p>"
