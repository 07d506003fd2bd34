"""Names and units of the elements of an instance, in the order of `InstanceProgram.layout`."""

import re
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from crane.codegen import Layout
from crane.control.valve_drive import ValveDrive
from crane.description.external_forces import WRENCH_COMPONENTS
from crane.dynamics.external_forces import reference_counts
from crane.dynamics.joint_forces import LAW_PARAMETER_NAMES
from crane.hydraulics.circuit_states import BALANCE_UNITS
from crane.machine.machine import Machine

if TYPE_CHECKING:
    from crane.export.instance_program import InstanceProgram

_ROTATION = [f"rotation_{i}{j}" for i in "xyz" for j in "xyz"]
_POSITION = ["position_x", "position_y", "position_z"]
_INERTIA = {"mass": "kg"} | {f"com_{x}": "m" for x in "xyz"}
_INERTIA |= {f"inertia_{x}": "kg m2" for x in ("xx", "xy", "xz", "yy", "yz", "zz")}
_SETTING_UNITS = {  # of names of settings that end so, of cylinders
    "area_[ab]": "m2", "hose_[ab]": "m3", "leakage(_[ab])?": "m3/Pa/s", "neutral": "V",
    "relief|margin|vapour|tank|pressure": "Pa", "(?<!per_)(stroke|lower_limit)": "m",
    "flow": "m3/s",
}  # fmt: skip
_MOTOR_UNITS = {"m2": "m3/rad", "m": "rad"}
_LAW_UNITS = {  # by units of the force and of the coordinate
    "{0}": ("coulomb", "coulomb_offset", "stiction", "stiction_2", "memory", "constant",
            "gas_force"),
    "{0} s/{1}": ("viscous", "viscous_offset", "damping", "stop_damping"),
    "{0}/{1}": ("stiffness", "stop_stiffness"),
    "{1}": ("lower_limit", "upper_limit", "gas_rest_position"), "J": ("energy_offset",),
}  # fmt: skip
_WRENCH = [*zip(WRENCH_COMPONENTS, ("N", "N", "N", "N m", "N m", "N m"), strict=True)]


def named_elements(
    layout: Layout, elements: Iterable[tuple[str, str, str]]
) -> tuple[list[str], list[str]]:
    """Names and units of all elements of a layout, from part, name and unit of those with one."""
    found: dict[str, list[tuple[str, str]]] = {name: [] for name in layout.parts}
    for part, name, unit in elements:
        found[part].append((name, unit))
    for part, size in layout.parts.items():
        if not found[part]:
            found[part] = [(f"{part}_{i}" if size > 1 else part, "") for i in range(size)]
        assert len(found[part]) == size, (part, size, len(found[part]))
    pairs = [pair for part in found.values() for pair in part]
    return [name for name, _ in pairs], [unit for _, unit in pairs]


def instance_elements(program: "InstanceProgram") -> Iterator[tuple[str, str, str]]:
    """Part, name and unit of the elements that have a meaning."""
    machine, chart = program.machine, program.chart
    yield from (("time", "time", "s"), ("step", "step", "s"))
    inputs = list(_inputs(program))
    yield from (("inputs_start", f"start_{name}", unit) for name, unit in inputs)
    yield from (("inputs", name, unit) for name, unit in inputs)
    for joint in machine.joints:
        yield "q", f"q_{joint}", machine.unit(joint)
    force_units = {"m": "N", "rad": "N m"}
    for joint in machine.active:
        unit = machine.unit(joint)
        yield "v_a", f"v_{joint}", f"{unit}/s"
        yield "tau", f"tau_{joint}", force_units.get(unit, "")
        yield "friction", f"friction_{joint}", force_units.get(unit, "")
    if isinstance(program.control, ValveDrive):
        circuit = program.control.circuit
        for name, unit in circuit.state_units.items():
            yield "controller", f"state_{name}", unit
        for name, unit in BALANCE_UNITS.items():
            yield "controller", f"integral_{name}", unit
        for name, unit in program.control.channels:
            yield "channels", name, unit
        motors = tuple(f"{x}_" for x in machine.joints if machine.unit(x) == "rad")
        for name in _setting_names(program.control):
            units = (unit for x, unit in _SETTING_UNITS.items() if re.search(f"_({x})$", name))
            unit = next(units, "")
            is_of_motor = name.startswith(motors)
            yield "settings", name, _MOTOR_UNITS.get(unit, unit) if is_of_motor else unit
        command = program.control.command
        yield from (("settings", name, unit) for name, unit in command.setting_units.items())
        if program.layout.parts["delays"]:
            yield from (("delays", f"{name}_delay", "s") for name in circuit.hydraulics.spools)
    else:
        for part, named in (
            ("controller", program.control.state_units),
            ("settings", program.control.setting_units),
        ):
            yield from ((part, name, unit) for name, unit in named.items())
    yield "work", "work", "J"
    loads = [force.name for force in machine.external_forces]
    yield from (("work", f"work_{name}", "J") for name in loads)
    yield from (("dissipated", "dissipated", "J"), ("kinetic", "kinetic", "J"))
    yield "potential", "potential", "J"
    for column in chart.stick_slip.columns:
        yield "friction_at_rest", f"rest_{machine.joints[column]}", ""
    for force in machine.external_forces:
        for x, unit in (*_WRENCH, *force.channels):
            yield "external", f"load_{force.name}_{x}", unit
    if machine.supports:
        for joint in machine.joints:
            yield "a", f"a_{joint}", f"{machine.unit(joint)}/s2"
    yield from geometry_elements(machine)
    yield from (("dynamics", name, unit) for name, unit in _dynamics(program))
    if program.layout.parts["unladen"]:
        yield from (("unladen", f"unladen_{name}", unit) for name, unit in _INERTIA.items())


def _inputs(program: "InstanceProgram") -> Iterator[tuple[str, str]]:
    machine = program.machine
    names = program.control.reference_units
    if not names:
        count = program.control.references(np.zeros(1)).shape[1]
        names = {f"reference_{i}": "" for i in range(count)}
    yield from names.items()
    for force in machine.external_forces:
        count = reference_counts([force])[0]
        components = list(_WRENCH) if count == len(_WRENCH) else []
        components += [(f"reference_{i}", "") for i in range(count - len(components))]
        yield from ((f"{force.name}_{name}", unit) for name, unit in components)


def geometry_elements(machine: Machine) -> Iterator[tuple[str, str, str]]:
    """Part, name and unit of the constants of `TreeGeometry`."""
    frames = [f"{joint}_frame" for joint in machine.joints]
    for loop in machine.closure.equations.loops:
        frames += [f"{loop.name}_predecessor", f"{loop.name}_successor"]
    for frame in frames:
        yield from (("geometry", f"{frame}_{name}", "") for name in _ROTATION)
        yield from (("geometry", f"{frame}_{name}", "m") for name in _POSITION)
    yield "geometry", "inverse_characteristic_length", "1/m"


def _dynamics(program: "InstanceProgram") -> Iterator[tuple[str, str]]:
    """Names and units of `formula_constants`; none where they depend on another parameter."""
    machine, dynamics = program.machine, program.chart.dynamics
    joints, forces = machine.joints, dynamics.forces
    pairs = [f"{a}_{b}" for a, b in forces.lengths.pairs]
    ends = [f"{end}_{x}" for end in ("first", "second") for x in "xyz"]
    parts: dict[str, list[tuple[str, str]]] = {
        "inertias": [(f"{x}_{name}", unit) for x in joints for name, unit in _INERTIA.items()],
        "joint_laws": [law for x in joints for law in _laws(x, machine.unit(x))],
        "gravity": [(f"gravity_{x}", "m/s2") for x in "xyz"],
        "rotor_inertias": [(f"{x}_rotor_inertia", "") for x in joints],
        "distances": [y for x in pairs
                      for y in (*_laws(x, "m"), *((f"{x}_{end}", "m") for end in ends))],
        "moving_factor": [("moving_factor", "")],
        "circuit_friction": [(f"{joints[i]}_circuit_friction", "")
                             for i in forces.circuit_friction_columns],
        "fixed_inertia": [(f"fixed_{x}", "")
                          for x in ("mass", "moment_x", "moment_y", "moment_z")],
        "tip_point": [(f"tip_{x}", "m") for x in "xyz"],
        "least_inertias": [(f"{x}_least_inertia", "") for x in joints],
    }  # fmt: skip
    for part, size in dynamics.formula_structure.constants_layout.parts.items():
        yield from parts[part][:size]


def _laws(owner: str, unit: str) -> list[tuple[str, str]]:
    """Names and units of the parameters of a force law along a coordinate of a unit."""
    force = "N" if unit == "m" else "N m"
    units = {x: text.format(force, unit) for text, names in _LAW_UNITS.items() for x in names}
    return [(f"{owner}_{name}", units.get(name, "")) for name in LAW_PARAMETER_NAMES]


def _setting_names(control: ValveDrive) -> list[str]:
    """Names of the settings of a valve drive."""
    circuit = control.circuit
    names = circuit.constant_names
    names += [f"{joint}_lower_limit" for joint in circuit.hydraulics.joints]
    count = len(control.settings) - len(names) - len(control.command.setting_units)
    return names + [f"signal_setting_{i}" for i in range(count)]
