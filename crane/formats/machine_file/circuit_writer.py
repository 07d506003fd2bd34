"""The section `hydraulics` of a machine file as it is written."""

import math
from collections.abc import Mapping
from typing import Any

from crane.common.errors import InputError
from crane.common.unit_conversions import KeyPath, WrittenNumber, shortest_number
from crane.description.circuit_schema import (
    AREA_KEYS,
    BORE_KEYS,
    CYLINDER,
    HYDRAULICS,
    MOTOR,
    ORIFICE_KEYS,
    SPOOL,
    VALVE,
)
from crane.description.key_types import REQUIRED
from crane.formats.machine_file.circuit_section import piston_areas
from crane.hydraulics.components import Cylinder, Valve
from crane.hydraulics.hydraulic_circuit import Hydraulics

_DATA_SHEET_KEYS = {  # keys in place of which others may stand
    AREA_KEYS: BORE_KEYS,
    ORIFICE_KEYS: ("flow", "meter_out"),
    ("flow",): ("displacement", "speed"),
}


def replace_data_sheet_keys(data: dict[str, Any], key: str, component: object) -> None:
    """Write a parameter itself, where it is written as bore, flow or displacement.

    Args:
        data: What the file says of the component.
        key: Name of the parameter.
        component: The component.
    """
    for keys, others in _DATA_SHEET_KEYS.items():
        if key in keys and others[0] in data:
            for other in others:
                data.pop(other, None)
            data.update({name: getattr(component, name) for name in keys})


def circuit_data(
    circuit: Hydraulics, written_numbers: Mapping[KeyPath, WrittenNumber]
) -> dict[str, Any]:
    """The section of a circuit in a machine file, in SI units.

    Args:
        circuit: The circuit.
        written_numbers: Of its machine file: bores, flows and displacements stay where they are.
    """
    drives: dict[str, dict[str, Any]] = {"cylinders": {}, "motors": {}}
    for joint, item in circuit.cylinders.items():
        if item.motor:
            drives["motors"][joint] = _motor_data(item)
        else:
            has_bore = ("hydraulics", "cylinders", joint, "bore") in written_numbers
            drives["cylinders"][joint] = _cylinder_data(item, has_bore)
    data = HYDRAULICS.values_of(circuit, "cylinders", "valves")
    pumps = {("supply",): data["supply"]} | {
        ("supplies", name): pump for name, pump in data.get("supplies", {}).items()
    }
    for path, pump in pumps.items():
        _write_displacement(pump, circuit, ("hydraulics", *path), written_numbers)
    data |= {
        **{key: value for key, value in drives.items() if value},
        "valves": {joint: _valve_data(valve) for joint, valve in circuit.valves.items()},
    }
    return {key: data[key] for key in HYDRAULICS.keys if key in data}


def _cylinder_data(cylinder: Cylinder, has_bore: bool) -> dict[str, Any]:
    """The keys of a cylinder, by bore and rod where its file has them and they do for it."""
    data = CYLINDER.values_of(cylinder, *BORE_KEYS)
    count = cylinder.count
    bore = shortest_number(
        cylinder.bore, lambda x: piston_areas(x, 0.0, count)[0] == cylinder.area_a
    )
    if not has_bore or bore is None:
        return data
    rod = shortest_number(
        cylinder.rod, lambda x: piston_areas(bore, x, count)[1] == cylinder.area_b
    )
    if rod is None:
        return data
    others = {key: value for key, value in data.items() if key not in AREA_KEYS}
    return {"bore": bore, **({"rod": rod} if rod else {}), **others}


def _write_displacement(
    pump: dict[str, Any],
    circuit: Hydraulics,
    path: KeyPath,
    written_numbers: Mapping[KeyPath, WrittenNumber],
) -> None:
    """Write the displacement of a pump in place of its flow, where its file has it."""
    if (*path, "displacement") not in written_numbers or not pump.get("flow"):
        return
    speed = written_numbers.get((*path, "speed"))
    turns = speed.value if speed else circuit.engine.speed if circuit.engine else 0.0
    displacement = turns and shortest_number(
        pump["flow"] / turns, lambda x: x * turns == pump["flow"]
    )
    if displacement:
        del pump["flow"]
        pump |= {"displacement": displacement} | ({"speed": turns} if speed else {})


def _motor_data(motor: Cylinder) -> dict[str, Any]:
    expected = {"area_b": motor.area_a, "hose_b": motor.hose_a}
    expected |= {
        name: key.default
        for name, key in CYLINDER.keys.items()
        if name not in {*MOTOR.keys, *BORE_KEYS} and key.default not in (REQUIRED, None)
    }
    for name, value in expected.items():
        if getattr(motor, name) != value:
            raise InputError(
                f"{name} of the motor of '{motor.joint}' is {getattr(motor, name):g}, which a "
                f"machine file has no motor with, leave it at {value:g}"
            )
    return {"displacement": motor.area_a, "volume": motor.hose_a} | MOTOR.values_of(
        motor, "displacement", "gear", "volume"
    )


def _valve_data(valve: Valve) -> dict[str, Any]:
    values = VALVE.values_of(valve, "margin", "spool_b")
    if valve.spool_b:
        values["spool_b"] = {name: getattr(valve.spool_b, name) for name in SPOOL.keys}
    for name, curve in valve.curves.items():
        values[name] = {
            "coefficient": getattr(valve, name),
            "shape": ([list(point) for point in curve.points]),
        }
    if not valve.margin:
        return {"type": "sharing" if valve.sharing else "orifice"} | values
    size = {"type": "compensated", "margin": valve.margin}
    is_symmetric = (valve.c1, valve.c2) == (valve.c4, valve.c3)
    if not is_symmetric or valve.curves.keys() & {*ORIFICE_KEYS}:
        return size | values
    root = math.sqrt(valve.margin)
    flow = shortest_number(valve.c1 * root, lambda x: x / root == valve.c1)
    if flow is None:
        return size | values
    size |= {"flow": flow, "meter_out": valve.c2}
    return size | {x: value for x, value in values.items() if x not in ORIFICE_KEYS}
