"""The few facts and numbers that a page tells of a run in words."""

from typing import TYPE_CHECKING, Any

import numpy as np

from crane.common.samples import Array
from crane.common.scratch import in_blocks
from crane.common.units import number, quantity
from crane.machine import Machine
from crane.recordings.recording import FORCE_UNITS
from crane.recordings.summary import READING_UNITS, summarize

if TYPE_CHECKING:
    from crane.recordings.recording import Recording

_SENTENCES = 6  # on limits, at most
_REACHED = 1e-4  # share of a range that counts as at its end


def run_summary(machine: Machine, recording: "Recording | None") -> dict[str, Any]:
    """What the page's panel says.

    Returns:
        facts: Pairs of words; forces: rows (joint, range, peak and RMS force); limits: sentences.
    """
    moving = [inertia.mass for inertia in list(machine.model.inertias)[1:]]
    facts = [("moving mass", quantity(sum(moving), "kg", 4))]
    if machine.changes:
        changed = ", ".join(f"{name} = {value:g}" for name, value in machine.changes.items())
        facts.append(("changed", changed))
    if machine.locks:
        held = ", ".join(f"{joint} at {value:g}" for joint, value in machine.locks.items())
        facts.append(("held", held))
    if recording is None:
        return {"facts": facts, "forces": [], "limits": []}
    summary = summarize(recording)
    if recording.controller:
        facts.insert(0, ("controller", recording.controller))
    count = len(recording.time)
    rate = f", {(count - 1) / summary.duration:.4g} per second" if count > 1 else ""
    facts.insert(0, ("samples", f"{count}{rate}"))
    if abs(recording.time[0]) > 1e5:  # the page shows the time from there
        facts.insert(0, ("time 0 is", f"{np.floor(recording.time[0]):.0f} s"))
    if recording.stopped:
        facts.insert(0, ("stopped", recording.stopped))
    if count > 1:
        facts.insert(0, ("duration", f"{summary.duration:.4g} s"))
        given, taken = mechanical_work(recording)
        text = f"{_quantity(given, 'J')} given"
        if taken > 1e-3 * given:
            text += f", {_quantity(taken, 'J')} taken back"
        facts.append(("actuators' work", text))
    channels = recording.channels
    for name, words in (("dissipated", "lost to friction"), ("pump_work", "pump's work")):
        if count < 2 or recording.channel_units.get(name) != "J":
            continue
        change = float(channels[name][-1] - channels[name][0])
        if _number(change) != "0":
            facts.append((words, _quantity(change, "J")))
    if count > 1 and summary.balance:
        facts.append(("energy balance", summary.balance.replace("-", "\u2212")))
    if summary.tip_rms_error is not None and summary.tip_peak_error is not None:
        peak, rms = 1e3 * summary.tip_peak_error, 1e3 * summary.tip_rms_error
        facts.append(("tip to reference", f"{rms:.3g} mm RMS, {peak:.3g} mm peak"))
    forces = []
    for joint in summary.joints:
        unit, scale = READING_UNITS[joint.unit]
        forces.append(
            (
                joint.name,
                f"{_number(scale * joint.lowest)} to {_number(scale * joint.highest)} {unit}",
                *(
                    "free" if x is None else _quantity(x, FORCE_UNITS[joint.unit])
                    for x in (joint.peak_force, joint.rms_force)
                ),
            )
        )
    return {"facts": facts, "forces": forces, "limits": limits_hit(machine, recording)}


def mechanical_work(recording: "Recording") -> tuple[float, float]:
    """Work [J] that the active joints gave to the machine, and that it gave back to them.

    The integrals of the positive and of the negative part of sum tau v, by the trapezoidal rule.
    """
    power = in_blocks(
        lambda part: (recording.tau[part] * recording.v[part]).sum(axis=1, keepdims=True),
        len(recording.time),
    )[:, 0]
    given = np.trapezoid(np.maximum(power, 0), recording.time)
    taken = np.trapezoid(np.maximum(-power, 0), recording.time)
    return float(given), float(taken)


def limits_hit(machine: Machine, recording: "Recording") -> list[str]:
    """Sentences on active joints that were at or beyond the ends of their ranges."""
    found = []
    for i, joint in enumerate(machine.active):
        q: Array = recording.q[:, recording.joints.index(joint)]
        low, high = machine.lower[i], machine.upper[i]
        slack = _REACHED * (high - low) if np.isfinite(high - low) else 0.0
        unit, scale = READING_UNITS[machine.unit(joint)]
        ends = ((q <= low + slack, "lower", low), (q >= high - slack, "upper", high))
        for there, end, limit in [x for x in ends if x[0].any()]:
            first = recording.time[int(np.argmax(there))]
            found.append(
                f"{joint} reaches its {end} limit of {_number(scale * limit)} {unit} "
                f"at {first:.4g} s ({_percent(there.mean())} of the samples)"
            )
    if len(found) > _SENTENCES:
        found[_SENTENCES:] = [f"and {len(found) - _SENTENCES} more limits are reached"]
    return found


def _percent(share: float) -> str:
    return f"{100 * share:{'.0f' if share >= 0.1 else '.2g'}}\u00a0%"


def _quantity(value: float, unit: str) -> str:
    return quantity(value, unit).replace("-", "\u2212")


def _number(value: float) -> str:
    return number(value).replace("-", "\u2212")
