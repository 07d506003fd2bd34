"""Page on which a machine is driven by its levers, for any browser without network.

The machine is computed in the page by the same routines as in this package, as WebAssembly.
"""

import base64
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from crane.codegen.llvm.wasm_emitter import emit_wasm_module
from crane.common.atomic_output import portable_file_name
from crane.common.errors import ClosureError
from crane.common.samples import Array
from crane.control.controller_registry import make_controller
from crane.control.valve_drive import ValveDrive
from crane.description.external_forces import TIP_WRENCH_NAME, WRENCH_COMPONENTS
from crane.dynamics.tipping_stability import has_supports
from crane.export.instance_program import InstanceProgram
from crane.export.instance_routines import STATUS_TEXTS
from crane.hydraulics.circuit_elements import MAIN_PUMP
from crane.hydraulics.circuit_states import BALANCE_UNITS
from crane.machine.machine import Machine
from crane.recordings.recording import FORCE_UNITS, REFERENCE_PREFIX, VELOCITY_UNITS
from crane.recordings.recording_summary import DISPLAY_UNITS, result_title
from crane.simulation.integration.charts import KEPT_CHART_RELAXATION
from crane.simulation.parameter_schedule import COORDINATES_NOTE, KEPT_COORDINATES
from crane.view.page.drive_conditions import DriveConditions
from crane.view.page.drive_goals import goal_data
from crane.view.page.drive_hand import pull_data, target_data
from crane.view.page.drive_levers import INTERVAL, lever_data
from crane.view.page.html_document import asset_text, filled_template, write_page
from crane.view.page.page_motion import frame_data, joint_tree, pack_base64
from crane.view.page.report_page import machine_data, scene_commands, viewer_script
from crane.view.page.scene import build_scene, link_poses, read_visuals, scene_bounds

RAMP = 0.15  # time from neutral to the end of a lever [s]
_SCRIPTS = (
    "data", "kinematics", "scene", "drive_scene", "drive_levers", "drive_gauges", "drive_pull",
    "drive_recording", "drive",
)  # fmt: skip
_WORKER_SCRIPTS = ("kinematics", "drive_stability", "drive_goals", "drive_hand", "drive_worker")
_RESERVED_NUMBERS = 4096  # of the memory, besides the instance


def drive_page(machine: Machine, path: str | Path, controller: str | None = None) -> Path:
    """Write a page on which a machine is driven by keys, sliders or a gamepad, as one HTML file.

    Its levers move the valves of a machine with a circuit, else the forces of its drives up to
    their efforts, or the targets of a controller. A spring pulls the tip to the pointer. Payload
    and slope change between steps. The drive can be saved as a recording, which `simulate
    --inputs` repeats.

    Args:
        machine: The machine.
        path: The file to write; replaced if it exists.
        controller: Name of a controller, see `crane.control.make_controller`.

    Raises:
        InputError: See `crane.export.InstanceProgram`; or nothing drives the machine.
        OutputError: The file's suffix is not .html or .htm, or it cannot be written.
    """
    return write_page(path, lambda: drive_html(machine, controller))


def drive_html(machine: Machine, controller: str | None = None) -> str:
    """Return the page of `drive_page` as HTML."""
    law = None if controller is None else make_controller(controller, machine)
    quantities = ("gravity",) if machine.hydraulics is None and law is None else ()
    conditions = DriveConditions(machine, quantities, law)
    scene = build_scene(machine)
    data = machine_data(machine, scene, None) | {"task": ""}
    data["drive"] = _drive_data(conditions, controller) | {
        "goals": goal_data(machine, conditions.masses, scene.ground_height)
    }
    data["lower"], data["upper"] = (x.tolist() for x in _motion_bounds(machine, scene))
    return filled_template(
        "drive",
        ("page", "dark", "drive"),
        _SCRIPTS,
        result_title(machine.name, "drive"),
        data,
        viewer=viewer_script(),
        commands=scene_commands(scene),
        worker=asset_text(*(f"{x}.js" for x in _WORKER_SCRIPTS)),
    )


def _drive_data(conditions: DriveConditions, controller: str | None) -> dict[str, Any]:
    """What the scripts need of the program."""
    program = conditions.program
    machine, start = program.machine, program.layout.start_index
    levers = lever_data(program)
    nq, n = machine.model.nv, len(machine.active)
    hand = program.layout.size + _RESERVED_NUMBERS + nq * n
    module = emit_wasm_module(program.functions, program.entries, hand + nq + 4 * n + 64 + 6)
    defaults = np.nan_to_num(program.defaults, posinf=1e300)
    program.layout.view(defaults).bounds[3:5] *= KEPT_CHART_RELAXATION
    columns = list(_columns(program))
    order = {header: i for i, (header, _) in enumerate(columns)}
    inputs = range(start("inputs"), start("inputs") + program.layout.parts["inputs"])
    return {
        "wasm": base64.b64encode(module).decode(),
        "defaults": pack_base64(defaults, "f8"),
        "interval": INTERVAL,
        "ramp": RAMP,
        "parts": {
            part: [start(part), program.layout.parts[part]]
            for part in ("step", "q", "v_a", "dynamics")
        },
        "inputs": {program.names[i]: i for i in inputs},
        "holdsWeight": "gravity" in program.entries,
        "hasTip": machine.tip is not None,
        "tree": joint_tree(machine),
        "levers": levers,
        "pull": pull_data(program),
        "targets": target_data(program),
        "handMemory": hand,
        "columns": [index for _, index in columns],
        "headers": [header for header, _ in columns],
        "dials": list(_dials(program, order)),
        "joints": list(_joints(program, order)),
        "energy": _energy(program, order),
        "loads": [
            {"name": x.name, "frame": frame_data(machine, x.frame), "column": order[header]}
            for x in machine.external_forces
            if (header := f"load_{x.name}_force_x [N]") in order and x.name != TIP_WRENCH_NAME
        ],
        "statuses": dict(STATUS_TEXTS),
        "notes": [
            "crane recording", f"machine name: {machine.name}", "task: drive",
            f"controller: {controller or 'levers'}", "sensors: ideal",
            f"{COORDINATES_NOTE}: {KEPT_COORDINATES}",
            *([f"free: {', '.join(machine.free)}"] if machine.free else []),
        ],
        "expression": [machine.load_name, machine.load_options],
        "command": f"crane simulate {machine.command_line_arguments}"
        + (f" --controller {controller}" if controller else ""),
        "file": portable_file_name(f"{machine.name}_drive"),
    } | conditions.data()  # fmt: skip


def _columns(program: InstanceProgram) -> Iterator[tuple[str, int]]:
    """Headers of the recording, and elements of the instance."""
    machine, start = program.machine, program.layout.start_index
    yield "time [s]", start("time")
    active = machine.closure.active.tolist()
    for joint, column in zip(machine.active, active, strict=True):
        yield f"{joint} [{machine.unit(joint)}]", start("q") + column
    for part, suffix, units, joints in (
        ("v_a", "velocity", VELOCITY_UNITS, machine.active),
        ("tau", "force", FORCE_UNITS, machine.driven_joints),
    ):
        for joint in joints:
            index = start(part) + machine.active.index(joint)
            yield f"{joint}_{suffix} [{units[machine.unit(joint)]}]", index
    for column, joint in enumerate(machine.joints):
        if column not in active:
            yield f"{joint} [{machine.unit(joint)}]", start("q") + column
    for name in ("kinetic", "potential", "work", "dissipated"):
        yield f"{name} [J]", start(name)
    references = program.control.reference_units
    if any(name.startswith(REFERENCE_PREFIX) for name in references):
        for i, (name, unit) in enumerate(references.items()):
            yield f"{name} [{unit}]" if unit else name, start("inputs") + i
    first = start("external")
    for k, force in enumerate(machine.external_forces):
        for i, axis in enumerate("xyz"):
            yield f"load_{force.name}_force_{axis} [N]", first + i
        yield f"work_{force.name} [J]", start("work") + 1 + k
        first += len(WRENCH_COMPONENTS)
        for name, unit in force.channels:
            yield f"{name} [{unit}]" if unit else name, first
            first += 1
    if isinstance(program.control, ValveDrive):
        spools = list(program.control.circuit.hydraulics.spools)[: program.layout.parts["delays"]]
        commanded = {f"voltage_{name}": start("inputs") + i for i, name in enumerate(spools)}
        for i, (name, unit) in enumerate(program.control.channels):  # signals before dead times
            index = commanded.get(name, start("channels") + i)
            yield f"{name} [{unit}]" if unit else name, index
        balances = start("controller") + program.control.circuit.state_count - len(BALANCE_UNITS)
        for i, (name, unit) in enumerate(BALANCE_UNITS.items()):
            yield f"{name} [{unit}]", balances + i


def _dials(program: InstanceProgram, order: dict[str, int]) -> Iterator[dict[str, Any]]:
    """Dials: sums of columns with factors, and their ranges."""
    machine = program.machine
    if machine.tip is not None:
        yield _dial("tip speed", "m/s", [], 0.0, 0.5 * _reach(machine)) | {"kind": "speed"}
    if has_supports(machine):
        yield _dial("tipping margin", "%", [], 0.0, 100.0) | {"kind": "stability"}
    if not isinstance(program.control, ValveDrive):
        return
    circuit = program.control.circuit.hydraulics
    pumps = [MAIN_PUMP, *circuit.supplies]
    for name, pump in zip(pumps, (circuit.supply, *circuit.supplies.values()), strict=True):
        if (header := f"pressure_{name} [Pa]") in order:
            title = "pressure" if name == MAIN_PUMP else f"pressure {name}"
            yield _dial(title, "bar", [(order[header], 1e-5)], 0.0, pump.pressure)
    shafts = [(order[x], 1e-3) for x in order if x.startswith("shaft_")]
    flows = [
        x.flow * 6e4 for x in (circuit.supply, *circuit.supplies.values()) if np.isfinite(x.flow)
    ]
    yield _dial("flow", "l/min", [], 0.0, sum(flows) / 6e4 or 1e-3) | {"kind": "flow"}
    if shafts:
        highest = 1e3 * sum(flows) / 6e4 * circuit.supply.pressure / 1e3
        yield _dial("power", "kW", shafts, 0.0, highest)
    if circuit.engine is not None and (header := "engine_speed [rad/s]") in order:
        highest = 1.2 * circuit.engine.speed
        yield _dial("engine", "rpm", [(order[header], 30.0 / np.pi)], 0.0, highest)


def _dial(
    name: str, unit: str, terms: list[tuple[int, float]], low: float, high: float
) -> dict[str, Any]:
    scale = {"bar": 1e-5, "kW": 1e-3, "l/min": 6e4, "rpm": 30.0 / np.pi}.get(unit, 1.0)
    return {"name": name, "unit": unit, "terms": terms, "low": scale * low, "high": scale * high}


def _joints(program: InstanceProgram, order: dict[str, int]) -> Iterator[dict[str, Any]]:
    """Each active joint: its position, and pressures and flow, or force."""
    machine = program.machine
    for joint, lower, upper in zip(machine.active, machine.lower, machine.upper, strict=True):
        kind = machine.unit(joint)
        unit, scale = DISPLAY_UNITS[kind]
        ends = (lower, upper) if np.isfinite([lower, upper]).all() else (-np.pi, np.pi)
        row: dict[str, Any] = {
            "name": joint, "unit": unit, "scale": scale, "column": order[f"{joint} [{kind}]"],
            "low": scale * float(ends[0]), "high": scale * float(ends[1]),
            "force": order.get(f"{joint}_force [{FORCE_UNITS[kind]}]"),
            "forceUnit": FORCE_UNITS[kind], "pressures": [], "flow": None,
        }  # fmt: skip
        sides = [order.get(f"pressure_{joint}_{side} [Pa]") for side in "ab"]
        if None not in sides and isinstance(program.control, ValveDrive):
            circuit = program.control.circuit.hydraulics
            row |= {"pressures": sides, "flow": order[f"flow_{joint}_a [m3/s]"]}
            row["highest"] = circuit.cylinders[joint].relief or circuit.supply.pressure
        yield row


def _energy(program: InstanceProgram, order: dict[str, int]) -> dict[str, Any]:
    """What counts as spent: work of the pumps and fuel, or work of the drives."""
    columns: dict[str, Any] = {"pump": order.get("pump_work [J]"), "engine": None}
    columns["shafts"] = [order[x] for x in order if x.startswith("shaft_")]
    columns["oil"] = order.get("oil_pumped [m3]")
    hydraulics = program.machine.hydraulics
    if hydraulics is not None and hydraulics.engine is not None and hydraulics.engine.fuel:
        engine = hydraulics.engine
        columns["engine"] = {
            "speed": engine.speed, "torque": engine.torque, "droop": engine.speed_droop,
            "fuel": engine.fuel, "idle": engine.idle, "column": order.get("engine_speed [rad/s]"),
        }  # fmt: skip
    return columns


def _reach(machine: Machine) -> float:
    """Distance of the tip at home from the first joint that moves it, 1 without a tip [m]."""
    lower, upper = _motion_bounds(machine, build_scene(machine))
    return float(np.linalg.norm(upper - lower)) / 2


def _motion_bounds(machine: Machine, scene: Any) -> tuple[Array, Array]:
    """Corners of the space that single joints reach from home; slewing is left out."""
    home = machine.home[machine.closure.active]
    configurations = [machine.home]
    for i, (lower, upper) in enumerate(zip(machine.lower, machine.upper, strict=True)):
        turns = machine.unit(machine.active[i]) == "rad" and not upper - lower < np.pi
        for value in () if turns else filter(np.isfinite, (lower, upper)):
            try:
                q_a = np.where(np.arange(len(home)) == i, value, home)
                configurations.append(machine.closure.solve(q_a, initial_guess=machine.home))
            except ClosureError:
                continue
    visuals = read_visuals(machine)
    links = {visual.link for visual in visuals}
    lower, upper = scene_bounds(visuals, link_poses(machine, np.array(configurations), links), {})
    return np.minimum(lower, scene.lower), np.maximum(upper, scene.upper)
