"""Report page of a machine and its run, for any browser without network."""

import base64
import webbrowser
from collections.abc import Sequence
from importlib.resources import files
from math import cos, sin
from pathlib import Path
from typing import Any

import numpy as np

from crane.common.errors import RecordingError
from crane.common.samples import Array
from crane.common.scratch_arrays import compute_in_blocks
from crane.common.units import format_number, format_quantity
from crane.machine.machine import Machine
from crane.recordings.recording import FORCE_UNITS, Recording
from crane.recordings.recording_summary import (
    DISPLAY_UNITS,
    clock_shift,
    joint_differences,
    label,
    point_channel,
    result_title,
    summarize,
)
from crane.view.page.force_markers import actuator_markers, load_markers, spring_markers
from crane.view.page.html_document import filled_template, script_json, write_page
from crane.view.page.page_channels import ThinningGrid, plot_groups
from crane.view.page.page_motion import (
    check_joints,
    frame_data,
    frame_rows,
    joint_tree,
    motion_data,
    pack_base64,
    payload_frame_data,
    recorded_configurations,
)
from crane.view.page.scene import Scene, build_scene

# Directions from the machine to the camera; x forward (see `Scene.heading`), z up.
CAMERA_DIRECTIONS = {
    "iso": (1.0, -1.6, 0.75), "side": (0.0, -1.0, 0.0), "front": (1.0, 0.0, 0.0),
    "top": (0.0, -1e-3, 1.0),
}  # fmt: skip
# In the order in which they use each other.
SCRIPT_NAMES = ("data", "kinematics", "timeline", "scene", "marks", "plots", "channels", "main")


def report(
    machine: Machine,
    recording: Recording | None,
    path: str | Path,
    second_recording: Recording | None = None,
) -> Path:
    """Write a report of a machine at home or in a recorded run, as one HTML file.

    The page contains the viewer, the motion and all columns of the recording and needs no network.
    The space key plays, and the arrow keys step.

    Args:
        machine: The machine.
        recording: Recording of its run; None for the home configuration.
        path: The file to write; replaced if it exists.
        second_recording: Second recording of the machine, shown as a ghost and as second lines. If
            its times do not overlap with those of the first, both start together.

    Returns:
        The path.

    Raises:
        RecordingError: A recording is of a machine with other joints.
        ClosureError: The loops cannot be closed at a recorded sample.
        InputError: A configuration is not finite.
        OutputError: The file's suffix is not .html or .htm, or it cannot be written.
    """
    return write_page(path, lambda: report_html(machine, recording, second_recording))


def report_html(
    machine: Machine,
    recording: Recording | None,
    second_recording: Recording | None = None,
    frame_share: float = 1.0,
) -> str:
    """Return the page of `report` as HTML.

    Args:
        machine: See `report`.
        recording: See `report`.
        second_recording: See `report`.
        frame_share: Share of the largest number of frames and time spans of a page.
    """
    scene = build_scene(machine, recording, frame_share)
    page_data = machine_data(machine, scene, recording)
    if recording is not None:
        page_data |= _run_data(machine, scene, recording, second_recording, frame_share)
    return _render_page(page_data, scene)


def open_in_browser(page: Path | str) -> bool:
    """Open a page, a file or an address, in the user's browser; return False if there is none."""
    return webbrowser.open(page.resolve().as_uri() if isinstance(page, Path) else page)


def machine_data(machine: Machine, scene: Scene, recording: Recording | None) -> dict[str, Any]:
    """Return what the scripts of a page need of a machine."""
    return {
        "machine": machine.name,
        "task": "home configuration" if recording is None else label(recording),
        "tree": joint_tree(machine),
        "tip": None if machine.tip is None else frame_data(machine, machine.tip),
        "payload": payload_frame_data(machine),
        "pins": [
            frame_data(machine, loop.predecessor) for loop in machine.closure.equations.loops
        ],
        "actuators": [],
        "loads": [],
        "springs": spring_markers(machine, scene.configurations),
        "lower": scene.lower.tolist(),
        "upper": scene.upper.tolist(),
        "ground": scene.ground_height,
        "views": {
            name: _rotate_view(view, scene.heading) for name, view in CAMERA_DIRECTIONS.items()
        },
        "summary": summarize_run(machine, recording),
        "runs": [{"motion": motion_data(scene.time, scene.configurations)}],
        "groups": [],
        "differences": [],
        "reference": "",
    }


def _run_data(
    machine: Machine,
    scene: Scene,
    recording: Recording,
    second_recording: Recording | None,
    frame_share: float,
) -> dict[str, Any]:
    """Return the data of one or two recordings."""
    span_share = frame_share * (1.0 if second_recording is None else 0.5)
    grid = ThinningGrid.from_recording(recording, scene.frame_rows, span_share)
    runs: list[dict[str, Any]] = [
        {
            "motion": motion_data(scene.time, scene.configurations),
            "axis": grid.time_axis(),
            "label": label(recording),
        }
    ]
    second_run, difference_rows = None, []
    if second_recording is not None:
        try:
            check_joints(machine, second_recording)
        except RecordingError as error:
            raise RecordingError(f"the second recording: {error}") from None
        rows = frame_rows(second_recording.time, frame_share)
        second_grid = ThinningGrid.from_recording(second_recording, rows, span_share)
        runs.append(
            {
                "motion": motion_data(
                    second_recording.time[rows],
                    recorded_configurations(machine, second_recording, rows),
                ),
                "axis": second_grid.time_axis(),
                "label": label(second_recording),
                "shift": clock_shift(recording, second_recording),
            }
        )
        second_run = (second_recording, second_grid)
        difference_rows = [
            (difference.joint, *difference.formatted)
            for difference in joint_differences(recording, second_recording)
        ]
    reference_tip = point_channel(recording, "reference_tip")
    return {
        "actuators": actuator_markers(machine, recording, scene.frame_rows),
        "loads": load_markers(machine, recording, scene.frame_rows),
        "runs": runs,
        "groups": plot_groups(machine, recording, grid, second_run),
        "differences": difference_rows,
        "reference": ""
        if reference_tip is None
        else pack_base64(reference_tip[scene.frame_rows], "f4"),
    }


def _render_page(page_data: dict[str, Any], scene: Scene) -> str:
    title = result_title(page_data["machine"], page_data["task"])
    texts = {"viewer": viewer_script(), "commands": scene_commands(scene)}
    return filled_template("page", ["page"], SCRIPT_NAMES, title, page_data, **texts)


def viewer_script() -> str:
    """Return the script of meshcat's viewer."""
    import meshcat

    return (files(meshcat) / "viewer" / "dist" / "main.min.js").read_text(encoding="utf-8")


def scene_commands(scene: Scene) -> str:
    """Return the commands of a scene for the viewer as JSON."""
    import umsgpack  # type: ignore[import-untyped]

    return script_json([base64.b64encode(umsgpack.packb(c)).decode() for c in scene.commands])


def _rotate_view(direction: tuple[float, float, float], heading: float) -> list[float]:
    x, y, z = direction
    return [
        x * cos(heading) - y * sin(heading),
        x * sin(heading) + y * cos(heading),
        z,
    ]


_MAX_LIMIT_SENTENCES = 6  # on limits, at most
_LIMIT_TOLERANCE = 1e-4  # share of a range that counts as at its end


def summarize_run(machine: Machine, recording: Recording | None) -> dict[str, Any]:
    """Return the content of the summary panel.

    Returns:
        facts: pairs of name and text; forces: rows (joint, range, peak and RMS force); limits:
            sentences.
    """
    mass = sum(inertia.mass for inertia in list(machine.model.inertias)[1:])
    changed = (f"{name} = {value:g}" for name, value in machine.parameter_changes.items())
    held = (f"{joint} at {value:g}" for joint, value in machine.locked_joints.items())
    machine_facts = [
        ("moving mass", format_quantity(mass, "kg", 4)),
        ("changed", ", ".join(changed)),
        ("held", ", ".join(held)),
    ]
    if recording is None:
        return {"facts": _without_empty(machine_facts), "forces": [], "limits": []}
    summary, count, start = summarize(recording), len(recording.time), recording.time[0]
    rate = f", {(count - 1) / summary.duration:.4g} per second" if count > 1 else ""
    # the page shows a late time from there
    late_start = f"{np.floor(start):.0f} s" if abs(start) > 1e5 else ""
    facts = [
        ("stopped", recording.stopped),
        ("time 0 is", late_start),
        ("samples", f"{count}{rate}"),
        ("controller", recording.controller),
        *machine_facts,
    ]
    if count > 1:
        facts.insert(0, ("duration", f"{summary.duration:.4g} s"))
        facts += [
            ("work of the actuators", _work_text(recording)),
            ("friction losses", _energy_change_text(recording, "dissipated")),
            ("work of the pump", _energy_change_text(recording, "pump_work")),
            ("maximum energy imbalance", summary.balance_text.replace("-", "\u2212")),
        ]
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
        "facts": _without_empty(facts),
        "forces": forces,
        "limits": reached_limit_sentences(machine, recording),
    }


def _without_empty(facts: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    return [fact for fact in facts if fact[1]]


def _work_text(recording: Recording) -> str:
    delivered, returned = mechanical_work(recording)
    text = f"{_format_quantity(delivered, 'J')} delivered"
    if returned > 1e-3 * delivered:
        text += f", {_format_quantity(returned, 'J')} returned"
    return text


def _energy_change_text(recording: Recording, name: str) -> str:
    if recording.channel_units.get(name) != "J":
        return ""
    change = float(recording.channels[name][-1] - recording.channels[name][0])
    return "" if _format_number(change) == "0" else _format_quantity(change, "J")


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
            first_time, share = recording.time[int(np.argmax(is_reached))], is_reached.mean()
            sentences.append(
                f"{joint} reaches its {limit_name} limit of {_format_number(scale * limit)} "
                f"{unit} at {first_time:.4g} s "
                f"({100 * share:{'.0f' if share >= 0.1 else '.2g'}}\u00a0% of the samples)"
            )
    if len(sentences) > _MAX_LIMIT_SENTENCES:
        sentences[_MAX_LIMIT_SENTENCES:] = [
            f"and {len(sentences) - _MAX_LIMIT_SENTENCES} more limits are reached"
        ]
    return sentences


def _format_quantity(value: float, unit: str) -> str:
    return format_quantity(value, unit).replace("-", "\u2212")


def _format_number(value: float) -> str:
    return format_number(value).replace("-", "\u2212")
