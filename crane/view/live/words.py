"""The numbers of a posture as a panel reads them."""

from collections.abc import Sequence
from html import escape

from crane.common.samples import Array
from crane.common.units import quantity
from crane.machine import Machine
from crane.recordings.recording import FORCE_UNITS
from crane.recordings.summary import READING_UNITS
from crane.view.live.session import Readout

_TABLE = '<table style="width:100%;font-size:0.8em;border-spacing:0 0.15em">'
_HEAD = '<tr style="opacity:0.6">'
_BOX = (
    '<div style="margin:0.3em 1em;padding:0.5em 0.7em;border-left:4px solid #d0401c;'
    'background:#d0401c22;font-size:0.8em">'
)


def reading(machine: Machine, joint: str, value: float) -> str:
    """A joint's coordinate [m], [rad] in the unit to read it in."""
    unit, scale = READING_UNITS[machine.unit(joint)]
    return f"{round(scale * value, 2) + 0.0:.2f} {unit}"


def numbers(
    machine: Machine, posture: Readout, payload: float, recorded: Array | None = None
) -> str:
    """Forces, tip, passive joints and the state of the loops as HTML.

    Args:
        machine: The machine.
        posture: Where it is.
        payload: Mass at the tip [kg].
        recorded: (n,) forces of a recording at this moment [N], [N m].
    """
    heads = ["joint", "holds the weight with" if not payload else "holds weight and payload with"]
    heads += ["recorded"] if recorded is not None else []
    rows = []
    for i, joint in enumerate(machine.active):
        unit = FORCE_UNITS[machine.unit(joint)]
        told = [posture.gravity[i], *([] if recorded is None else [recorded[i]])]
        free = joint in machine.free
        rows.append([joint, *("free" if free else quantity(x, unit) for x in told)])
    parts = [_table(heads, rows)]
    if posture.tip is not None:
        x, y, z = (f"{round(1e3 * value, 1) + 0.0:.1f}" for value in posture.tip)
        parts.append(_table(["tip x [mm]", "y [mm]", "z [mm]"], [[x, y, z]]))
    if passive := [joint for joint in machine.joints if joint not in machine.active]:
        rows = [[x, reading(machine, x, posture.q[machine.column(x)])] for x in passive]
        parts.append(_table(["passive joint", "coordinate"], rows))
    if posture.gain_of:
        one, other = posture.gain_of
        unit = f"{machine.unit(one)}/{machine.unit(other)}"
        rows = [
            ["largest of gamma", f"{posture.gain:.3g} {unit}", f"{one} per {other}"],
            ["condition of J_P", f"{posture.condition:.3g}", f"loop {posture.weakest}"],
            ["loops closed to", f"{posture.residual:.0e} m", ""],
        ]
        parts.append(_table([], rows))
    return "".join(f'<div style="margin:0 1em 0.6em">{part}</div>' for part in parts)


def warning(text: str) -> str:
    """A message in a box as HTML, nothing for an empty one."""
    return f"{_BOX}{escape(text)}</div>" if text else ""


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    def cells(words: Sequence[str], kind: str) -> str:
        aligned = ["left"] + ["right"] * (len(words) - 1)
        return "".join(
            f'<{kind} style="text-align:{side};font-weight:normal">{escape(word)}</{kind}>'
            for side, word in zip(aligned, words, strict=True)
        )

    lines = [f"{_HEAD}{cells(heads, 'th')}</tr>"] if heads else []
    lines += [f"<tr>{cells(row, 'td')}</tr>" for row in rows]
    return f"{_TABLE}{''.join(lines)}</table>"
