"""Summary of a run for its page: facts, forces, limits that were reached."""

from typing import Any

import numpy as np

from crane.common.samples import Array
from crane.common.scratch_arrays import compute_in_blocks
from crane.common.units import format_number, format_quantity
from crane.machine.machine import Machine
from crane.recordings.recording import FORCE_UNITS, Recording
from crane.recordings.recording_summary import DISPLAY_UNITS, summarize

_MAX_LIMIT_SENTENCES = 6  # on limits, at most
_LIMIT_TOLERANCE = 1e-4  # share of a range that counts as at its end


def summarize_run(machine: Machine, recording: Recording | None) -> dict[str, Any]:
    """Return the content of the summary panel.

    Returns:
        facts: pairs of name and text; forces: rows (joint, range, peak and RMS force); limits:
            sentences.
    """
    facts = [
        (
            "moving mass",
            format_quantity(
                sum([inertia.mass for inertia in list(machine.model.inertias)[1:]]), "kg", 4
            ),
        )
    ]
    if machine.parameter_changes:
        changed_text = ", ".join(
            f"{name} = {value:g}" for name, value in machine.parameter_changes.items()
        )
        facts.append(("changed", changed_text))
    if machine.locked_joints:
        locked_text = ", ".join(
            f"{joint} at {value:g}" for joint, value in machine.locked_joints.items()
        )
        facts.append(("held", locked_text))
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
        delivered_work, returned_work = mechanical_work(recording)
        text = f"{_format_quantity(delivered_work, 'J')} delivered"
        if returned_work > 1e-3 * delivered_work:
            text += f", {_format_quantity(returned_work, 'J')} returned"
        facts.append(("work of the actuators", text))
    channels = recording.channels
    for name, label in (("dissipated", "friction losses"), ("pump_work", "work of the pump")):
        if count < 2 or recording.channel_units.get(name) != "J":
            continue
        change = float(channels[name][-1] - channels[name][0])
        if _format_number(change) != "0":
            facts.append((label, _format_quantity(change, "J")))
    if count > 1 and summary.balance_text:
        facts.append(("energy balance", summary.balance_text.replace("-", "\u2212")))
    if summary.tip_rms_error is not None and summary.tip_peak_error is not None:
        peak, rms = 1e3 * summary.tip_peak_error, 1e3 * summary.tip_rms_error
        facts.append(("tip to reference", f"{rms:.3g} mm RMS, {peak:.3g} mm peak"))
    forces = []
    for joint in summary.joints:
        unit, scale = DISPLAY_UNITS[joint.unit]
        forces.append(
            (
                joint.name,
                f"{_format_number(scale * joint.lowest)} to "
                f"{_format_number(scale * joint.highest)} {unit}",
                *(
                    "free" if x is None else _format_quantity(x, FORCE_UNITS[joint.unit])
                    for x in (joint.peak_force, joint.rms_force)
                ),
            )
        )
    return {
        "facts": facts,
        "forces": forces,
        "limits": reached_limit_sentences(machine, recording),
    }


def mechanical_work(recording: Recording) -> tuple[float, float]:
    """Return the work of the active joints on the machine, and of the machine on them [J].

    These are the integrals of the positive and the negative part of sum tau v (trapezoidal rule).
    """
    power = compute_in_blocks(
        lambda part: (recording.tau[part] * recording.v[part]).sum(axis=1, keepdims=True),
        len(recording.time),
    )[:, 0]
    delivered = np.trapezoid(np.maximum(power, 0), recording.time)
    returned = np.trapezoid(np.maximum(-power, 0), recording.time)
    return float(delivered), float(returned)


def reached_limit_sentences(machine: Machine, recording: Recording) -> list[str]:
    """Return sentences about active joints that reached their limits."""
    sentences = []
    for i, joint in enumerate(machine.active):
        q: Array = recording.q[:, recording.joints.index(joint)]
        lower, upper = machine.lower[i], machine.upper[i]
        tolerance = _LIMIT_TOLERANCE * (upper - lower) if np.isfinite(upper - lower) else 0.0
        unit, scale = DISPLAY_UNITS[machine.unit(joint)]
        limit_checks = (
            (q <= lower + tolerance, "lower", lower),
            (q >= upper - tolerance, "upper", upper),
        )
        for is_reached, limit_name, limit in [x for x in limit_checks if x[0].any()]:
            first_time = recording.time[int(np.argmax(is_reached))]
            sentences.append(
                f"{joint} reaches its {limit_name} limit of {_format_number(scale * limit)} "
                f"{unit} at {first_time:.4g} s ({_format_percent(is_reached.mean())} of the "
                "samples)"
            )
    if len(sentences) > _MAX_LIMIT_SENTENCES:
        sentences[_MAX_LIMIT_SENTENCES:] = [
            f"and {len(sentences) - _MAX_LIMIT_SENTENCES} more limits are reached"
        ]
    return sentences


def _format_percent(share: float) -> str:
    return f"{100 * share:{'.0f' if share >= 0.1 else '.2g'}}\u00a0%"


def _format_quantity(value: float, unit: str) -> str:
    return format_quantity(value, unit).replace("-", "\u2212")


def _format_number(value: float) -> str:
    return format_number(value).replace("-", "\u2212")
