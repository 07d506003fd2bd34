"""The numbers of a posture as a panel reads them."""

from collections.abc import Sequence
from html import escape

from crane.common.samples import Array
from crane.common.units import format_quantity
from crane.machine import Machine
from crane.recordings.recording import FORCE_UNITS
from crane.recordings.recording_summary import DISPLAY_UNITS
from crane.view.live.live_session import Readout

_TABLE_TAG = '<table style="width:100%;font-size:0.8em;border-spacing:0 0.15em">'
_HEADING_ROW_TAG = '<tr style="opacity:0.6">'
_WARNING_BOX_TAG = (
    '<div style="margin:0.3em 1em;padding:0.5em 0.7em;border-left:4px solid #d0401c;'
    'background:#d0401c22;font-size:0.8em">'
)


def format_coordinate(machine: Machine, joint: str, value: float) -> str:
    """A joint's coordinate [m], [rad] in the unit to read it in."""
    unit, scale = DISPLAY_UNITS[machine.unit(joint)]
    return f"{round(scale * value, 2) + 0.0:.2f} {unit}"


def readout_html(
    machine: Machine, readout: Readout, payload_mass: float, recorded_forces: Array | None = None
) -> str:
    """Forces, tip, passive joints and the state of the loops as HTML.

    Args:
        machine: The machine.
        readout: Where it is.
        payload_mass: Mass at the tip [kg].
        recorded_forces: (n,) forces of a recording at this moment [N], [N m].
    """
    headings = [
        "joint",
        "holds the weight with" if not payload_mass else "holds weight and payload with",
    ]
    headings += ["recorded"] if recorded_forces is not None else []
    rows = []
    for i, joint in enumerate(machine.active):
        unit = FORCE_UNITS[machine.unit(joint)]
        forces = [readout.gravity[i], *([] if recorded_forces is None else [recorded_forces[i]])]
        is_free = joint in machine.free
        rows.append([joint, *("free" if is_free else format_quantity(x, unit) for x in forces)])
    parts = [_html_table(headings, rows)]
    if readout.tip is not None:
        x, y, z = (f"{round(1e3 * value, 1) + 0.0:.1f}" for value in readout.tip)
        parts.append(_html_table(["tip x [mm]", "y [mm]", "z [mm]"], [[x, y, z]]))
    if passive := [joint for joint in machine.joints if joint not in machine.active]:
        rows = [
            [x, format_coordinate(machine, x, readout.configuration[machine.column(x)])]
            for x in passive
        ]
        parts.append(_html_table(["passive joint", "coordinate"], rows))
    if readout.gain_joints:
        passive_joint, active_joint = readout.gain_joints
        unit = f"{machine.unit(passive_joint)}/{machine.unit(active_joint)}"
        rows = [
            [
                "largest of gamma",
                f"{readout.largest_gain:.3g} {unit}",
                f"{passive_joint} per {active_joint}",
            ],
            [
                "condition of J_P",
                f"{readout.condition_number:.3g}",
                f"loop {readout.weakest_loop}",
            ],
            ["loops closed to", f"{readout.residual:.0e} m", ""],
        ]
        parts.append(_html_table([], rows))
    return "".join(f'<div style="margin:0 1em 0.6em">{part}</div>' for part in parts)


def warning_html(text: str) -> str:
    """A message in a box as HTML, nothing for an empty one."""
    return f"{_WARNING_BOX_TAG}{escape(text)}</div>" if text else ""


def _html_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    def cells(words: Sequence[str], kind: str) -> str:
        aligned = ["left"] + ["right"] * (len(words) - 1)
        return "".join(
            f'<{kind} style="text-align:{side};font-weight:normal">{escape(text)}</{kind}>'
            for side, text in zip(aligned, words, strict=True)
        )

    lines = [f"{_HEADING_ROW_TAG}{cells(headings, 'th')}</tr>"] if headings else []
    lines += [f"<tr>{cells(row, 'td')}</tr>" for row in rows]
    return f"{_TABLE_TAG}{''.join(lines)}</table>"
