"""A calibration as one self-contained page: numbers, how well it follows, what it lacks."""

from html import escape
from pathlib import Path

import matplotlib as mpl
import numpy as np

from crane.common.units import reading
from crane.identification.calibration.dependence import Left, left_over
from crane.identification.calibration.result import Calibration, Channel, Fitted
from crane.recordings.summary import title
from crane.view.page.document import facts, table, write_document
from crane.view.plots.identification import matrix_figure
from crane.view.plots.recording import STYLE
from crane.view.plots.residuals import channel_figure, left_figure
from crane.view.plots.tags import image_tag

_FEW = 3  # numbers, whose correlations need no picture


def write_calibration_report(found: Calibration, path: str | Path) -> Path:
    """Write what a calibration found as one HTML file that needs no network.

    Numbers with their intervals; each channel before and after, fitted and held out; what is left
    against speed, pressure and direction; what the model lacks; what the recordings cannot tell
    apart; options that make the same machine.

    Args:
        found: What was found.
        path: The file to write; replaced if it exists.

    Returns:
        The path.

    Raises:
        OutputError: The file's suffix is not .html or .htm, or it cannot be written.
    """
    left = left_over(found)
    with mpl.rc_context(STYLE):
        parts = [
            _summary(found),
            "<h2>Numbers</h2>", _numbers(found),
            "<h2>How well it follows</h2>", _channels(found),
            "<h2>What is left</h2>", _left(left),
            "<h2>What would help</h2>", _lacking(found),
            "<h2>Not told apart</h2>", _coupled(found),
            "<h2>The same machine</h2>", _options(found),
        ]  # fmt: skip
    return write_document(path, title(found.machine.name, "calibration"), parts)


def _summary(found: Calibration) -> str:
    recordings: dict[str, Channel] = {x.recording: x for x in found.sensors}
    fitted = [_window(x) for x in recordings.values() if x.train.any()]
    held = [x.recording for x in recordings.values() if not x.train.any()]
    told = [x for x in found.fitted if not x.bound and not x.vague]
    names = {"on a bound": [x.name for x in found.fitted if x.bound],
             "not told": [x.name for x in found.fitted if x.vague]}  # fmt: skip
    rows = [
        ("machine", f"{found.machine.name} ({len(found.machine.driven_joints)} drives)"),
        ("fitted to", "; ".join(fitted)),
        ("held out whole", ", ".join(held)),
        ("numbers", f"{len(found.fitted)}, of which {len(told)} are told"),
        *((what, ", ".join(some)) for what, some in names.items()),
        ("simulations", f"{found.runs}"),
    ]
    return facts(rows)


def _window(channel: Channel) -> str:
    time = channel.time[channel.train]
    rest = "" if channel.train.all() else ", the rest is held out"
    return f"{channel.recording}, {time[0]:g} to {time[-1]:g} s{rest}"


def _numbers(found: Calibration) -> str:
    rows, classes = [], []
    for one in found.fitted:
        off = f"{one.before:.5g}" if one.before != one.start else ""
        rows.append([
            f"<code>{escape(one.name)}</code>", escape(one.unit), f"{one.start:.5g}",
            f"{one.value:.5g}", f"&#177; {one.interval:.2g}", off, escape(_remark(one)),
        ])  # fmt: skip
        classes.append("weak" if one.bound or one.vague else "")
    words = (
        "<p>Intervals of 95 %, as if there were no bounds; instants that what is left couples "
        "count as one. Grey are numbers on a bound, and those that the recordings do not tell: "
        "they are no result. An interval holds for a model that is right: a number that does the "
        "work of something that the machine file has not is far off with a narrow one.</p>"
    )
    head = ["number*", "unit*", "start", "fitted", "95 %", "in the file", "remark*"]
    if not any(row[5] for row in rows):
        head, rows = head[:5] + head[6:], [row[:5] + row[6:] for row in rows]
    doubt = "".join(f"<p><b>{escape(caution)}</b></p>" for caution in found.cautions)
    return doubt + words + table(head, rows, classes)


def _remark(one: Fitted) -> str:
    if one.moved and one.interval > 0:
        times = abs(one.value - one.before) / one.interval
        return ", ".join(filter(None, (one.remark, f"the file's is off by {times:.2g} intervals")))
    return one.remark


def _name(found: Calibration, channel: Channel) -> str:
    several = len({x.recording for x in found.sensors}) > 1
    return f"{channel.recording}: {channel.name}" if several else channel.name


def _channels(found: Calibration) -> str:
    rows, figures = [], []
    for channel in found.sensors:
        unit, scale = reading(channel.unit, float(np.ptp(channel.measured)))
        values = [
            scale * channel.rms(simulated, train)
            for train in (True, False)
            for simulated in (channel.before, channel.after)
        ]
        cells = ["" if np.isnan(x) else f"{x:.3g}" for x in (*values, scale * channel.noise)]
        name = _name(found, channel)
        rows.append([f"<code>{escape(name)}</code>", escape(unit), *cells])
        figures.append(image_tag(channel_figure(channel, name), f"{name} over time"))
    head = ["channel*", "unit*", "before", "fitted", "held out, before", "held out", "noise"]
    words = (
        "<p>Root mean square of simulated less measured, over what was fitted and what was held "
        "out; last about what the sensor's noise is, by the differences of its samples.</p>"
    )
    below = "<p>What was held out stands on a darker ground. Below what the fitted one leaves.</p>"
    return f'{words}{table(head, rows)}{below}<div class="figures">{"".join(figures)}</div>'


def _left(left: list[Left]) -> str:
    if not left:
        return "<p>Nothing is driven by valves.</p>"
    rows = [
        [f"<code>{escape(one.name)}</code>", escape(one.drive),
         *(f"{100 * share:.0f} %" for share in one.shares.values())]
        for one in left
    ]  # fmt: skip
    words = (
        "<p>How much of what is left (its variance, where it was fitted) goes with the speed, the "
        "pressure and the direction of a drive. What goes with the direction is friction or one "
        "orifice of a valve; with the speed, viscous friction or orifices; with the pressure, "
        "areas, moduli, leakage or a sensor's scale. Of a few strokes some tens of percent are "
        "chance.</p>"
    )
    head = ["channel*", "against*", "speed", "pressure", "direction"]
    images = "".join(image_tag(left_figure(one), f"what is left of {one.name}") for one in left)
    return words + table(head, rows) + images


def _lacking(found: Calibration) -> str:
    if not found.lacking:
        return "<p>No other number of the machine or its sensors would take away much of it.</p>"
    words = (
        "<p>Numbers that were not fitted, and how much of what is left each would take away, "
        "alone with those that were; by the derivatives where the search ended.</p>"
    )
    rows = [
        [f"<code>{escape(x.name)}</code>", f"{x.value:.3g}", f"{100 * x.share:.0f} %"]
        for x in found.lacking
    ]
    return words + table(["number*", "at about", "takes away"], rows)


def _coupled(found: Calibration) -> str:
    parts = []
    if found.coupled:
        rows = [
            [f"<code>{escape(a)}</code>", f"<code>{escape(b)}</code>", f"{r:+.3f}"]
            for a, b, r in found.coupled
        ]
        parts += ["<p>Of these a combination alone is known:</p>",
                  table(["one*", "other*", "correlation"], rows)]  # fmt: skip
    if found.directions:
        items = "".join(f"<li>{escape(found.words(x))}</li>" for x in found.directions)
        parts.append(
            "<p>These changes, made together, the recordings do not tell; they end where the "
            f"intervals do:</p><ul>{items}</ul>"
        )
    if not parts:
        parts.append("<p>The recordings tell all of them apart.</p>")
    if len(found.fitted) > _FEW:
        figure = matrix_figure(found.correlation, [one.name for one in found.fitted])
        image = image_tag(figure, "correlations of the numbers")
        parts.append(f'<div class="scroll"><div class="matrix">{image}</div></div>')
    return "".join(parts)


def _options(found: Calibration) -> str:
    lines = [f"--set {name}={value:.8g}" for name, value in found.changes.items()]
    words = "<p>For every command that takes a machine; all digits are in the machine file.</p>"
    return f"{words}<pre>{escape(' '.join(lines)).replace(' --', f' {chr(92)}{chr(10)}--')}</pre>"
