"""Page on which a machine is driven by its levers, for any browser without network.

The machine is computed in the page by the same routines as in this package, as WebAssembly.
"""

import base64
from collections.abc import Iterator
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from crane.codegen.wasm_emitter import emit_wasm_module
from crane.common.errors import ClosureError, InputError
from crane.common.samples import Array
from crane.control.valve_drive import ValveDrive
from crane.export.instance_program import InstanceProgram
from crane.export.instance_routines import STATUS_TEXTS
from crane.hydraulics.circuit_elements import MAIN_PUMP
from crane.hydraulics.circuit_states import BALANCE_UNITS
from crane.machine.machine import Machine
from crane.recordings.recording import FORCE_UNITS, VELOCITY_UNITS
from crane.recordings.recording_summary import DISPLAY_UNITS, result_title
from crane.view.page.html_document import write_page
from crane.view.page.page_motion import pack_base64
from crane.view.page.report_page import machine_data, scene_commands, script_json, viewer_script
from crane.view.page.scene import build_scene, link_poses, read_visuals, scene_bounds

INTERVAL = 0.01  # of the recording, at whose ends the inputs are given [s]
RAMP = 0.15  # time from neutral to the end of a lever [s]
_SCRIPTS = ("data", "kinematics", "scene", "drive")
# axes of a gamepad by the kind of lever: of excavators the ISO pattern
_AXES = ((0, 1.0), (1, -1.0), (3, -1.0), (2, 1.0))
_RESERVED_NUMBERS = 4096  # of the memory, besides the instance


def drive_page(machine: Machine, path: str | Path) -> Path:
    """Write a page on which a machine is driven by keys, sliders or a gamepad, as one HTML file.

    Its levers move the valves of a machine with a circuit, else the forces of its drives up to
    their efforts. The drive can be saved as a recording, which `simulate --inputs` repeats.

    Args:
        machine: The machine.
        path: The file to write; replaced if it exists.

    Raises:
        InputError: See `crane.export.InstanceProgram`; or no drive has an effort or a valve.
        OutputError: The file's suffix is not .html or .htm, or it cannot be written.
    """
    return write_page(path, lambda: drive_html(machine))


def drive_html(machine: Machine) -> str:
    """Return the page of `drive_page` as HTML."""
    program = InstanceProgram(machine, quantities=())
    scene = build_scene(machine)
    data = machine_data(machine, scene, None) | {"task": "", "drive": _drive_data(program)}
    data["lower"], data["upper"] = (x.tolist() for x in _motion_bounds(machine, scene))
    assets = files("crane.view.page") / "assets"
    commands, style = scene_commands(scene), ("page.css", "drive.css")
    return Template((assets / "drive.html").read_text(encoding="utf-8")).substitute(
        title=escape(result_title(machine.name, "drive")),
        style="\n".join((assets / name).read_text(encoding="utf-8") for name in style),
        viewer=viewer_script(),
        data=script_json(data),
        commands=commands,
        worker=(assets / "drive_worker.js").read_text(encoding="utf-8"),
        script="\n".join((assets / f"{x}.js").read_text(encoding="utf-8") for x in _SCRIPTS),
    )


def _drive_data(program: InstanceProgram) -> dict[str, Any]:
    """What the script needs of the program."""
    machine, start = program.machine, program.layout.start_index
    module = emit_wasm_module(
        program.functions, program.entries, program.layout.size + _RESERVED_NUMBERS
    )
    columns = list(_columns(program))
    levers = list(_levers(program))
    if not levers:
        raise InputError(
            f"no drive of '{machine.name}' has a valve or an effort: give joints an effort limit"
        )
    order = {header: i for i, (header, _) in enumerate(columns)}
    return {
        "wasm": base64.b64encode(module).decode(),
        "defaults": pack_base64(np.nan_to_num(program.defaults, posinf=1e300), "f8"),
        "step": start("step"),
        "interval": INTERVAL,
        "ramp": RAMP,
        "q": start("q"),
        "nq": machine.model.nv,
        "v": start("v_a"),
        "hasTip": machine.tip is not None,
        "levers": levers,
        "axes": [{"index": index, "sign": sign} for index, sign in _AXES][: len(levers)],
        "columns": [index for _, index in columns],
        "headers": [header for header, _ in columns],
        "gauges": list(_gauges(program, order)),
        "statuses": dict(STATUS_TEXTS),
        "notes": [
            "crane recording", f"machine: {machine.name}", "task: drive", "controller: levers",
            "sensors: ideal",
        ],
        "file": f"{machine.name}_drive",
    }  # fmt: skip


def _levers(program: InstanceProgram) -> Iterator[dict[str, Any]]:
    """Each lever: its input, and the signals in the middle and at the end."""
    machine, first = program.machine, program.layout.start_index("inputs")
    if isinstance(program.control, ValveDrive):
        spools = program.control.circuit.hydraulics.spools
        for i, (name, spool) in enumerate(spools.items()):
            yield {
                "name": name, "index": first + i, "neutral": spool.neutral, "full": spool.full,
                "overlap": spool.overlap,
            }  # fmt: skip
        return
    driven = [
        x for x, is_driven in zip(machine.active, machine.is_driven, strict=True) if is_driven
    ]
    limits = dict(zip(machine.joints, machine.model.effortLimit.tolist(), strict=False))
    for i, joint in enumerate(driven):
        effort = limits.get(joint, np.inf)
        if 0.0 < effort < 1e9:
            yield {
                "name": joint, "index": first + i, "neutral": 0.0, "full": effort, "overlap": 0.0,
            }  # fmt: skip


def _columns(program: InstanceProgram) -> Iterator[tuple[str, int]]:
    """Headers of the recording, and elements of the instance."""
    machine, start = program.machine, program.layout.start_index
    yield "time [s]", start("time")
    active = machine.closure.active.tolist()
    for joint, column in zip(machine.active, active, strict=True):
        yield f"{joint} [{machine.unit(joint)}]", start("q") + column
    for part, suffix, units in (
        ("v_a", "velocity", VELOCITY_UNITS), ("tau", "force", FORCE_UNITS),
    ):  # fmt: skip
        for i, joint in enumerate(machine.active):
            yield f"{joint}_{suffix} [{units[machine.unit(joint)]}]", start(part) + i
    for column, joint in enumerate(machine.joints):
        if column not in active:
            yield f"{joint} [{machine.unit(joint)}]", start("q") + column
    for name in ("kinetic", "potential", "work", "dissipated"):
        yield f"{name} [J]", start(name)
    if isinstance(program.control, ValveDrive):
        for i, (name, unit) in enumerate(program.control.channels):
            yield f"{name} [{unit}]" if unit else name, start("channels") + i
        balances = start("controller") + program.control.circuit.state_count - len(BALANCE_UNITS)
        for i, (name, unit) in enumerate(BALANCE_UNITS.items()):
            yield f"{name} [{unit}]", balances + i


def _gauges(program: InstanceProgram, order: dict[str, int]) -> Iterator[dict[str, Any]]:
    """Each gauge: sums of columns with factors, and its range."""
    machine = program.machine
    if machine.tip is not None:
        yield {"name": "tip speed", "unit": "m/s", "kind": "speed", "low": 0.0, "high": 2.0}
    for joint, lower, upper in zip(machine.active, machine.lower, machine.upper, strict=True):
        unit, scale = DISPLAY_UNITS[machine.unit(joint)]
        ends = (lower, upper) if np.isfinite([lower, upper]).all() else (-np.pi, np.pi)
        column = order[f"{joint} [{machine.unit(joint)}]"]
        yield _gauge(joint, unit, column, scale, float(ends[0]), float(ends[1]))
    if not isinstance(program.control, ValveDrive):
        return
    circuit = program.control.circuit.hydraulics
    highest = max(x.pressure for x in (circuit.supply, *circuit.supplies.values()))
    for name in (
        f"pressure_{MAIN_PUMP}",
        *(f"pressure_{x}_{s}" for x in circuit.joints for s in "ab"),
    ):
        title = name.removeprefix("pressure_").replace("_", " ")
        yield _gauge(title, "bar", order[f"{name} [Pa]"], 1e-5, 0.0, highest)
    for name in (x for x in order if x.startswith("shaft_")):
        yield _gauge("shaft power", "kW", order[name], 1e-3, 0.0, 1e5)


def _gauge(
    name: str, unit: str, column: int, scale: float, low: float, high: float
) -> dict[str, Any]:
    return {
        "name": name, "unit": unit, "terms": [(column, scale)], "low": scale * low,
        "high": scale * high,
    }  # fmt: skip


def _motion_bounds(machine: Machine, scene: Any) -> tuple[Array, Array]:
    """Corners of the space that single joints reach from home; slewing is left out."""
    home = machine.home[machine.closure.active]
    configurations = [machine.home]
    for i, (lower, upper) in enumerate(zip(machine.lower, machine.upper, strict=True)):
        turns = machine.unit(machine.active[i]) == "rad" and not upper - lower < np.pi
        for value in () if turns else (lower, upper):
            try:
                q_a = np.where(np.arange(len(home)) == i, value, home)
                configurations.append(machine.closure.solve(q_a, initial_guess=machine.home))
            except ClosureError:
                continue
    visuals = read_visuals(machine)
    links = {visual.link for visual in visuals}
    lower, upper = scene_bounds(visuals, link_poses(machine, np.array(configurations), links), {})
    return np.minimum(lower, scene.lower), np.maximum(upper, scene.upper)
