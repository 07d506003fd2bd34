"""The section `hydraulics` of a machine file."""

import itertools
import math
import string
from collections.abc import Callable, Container
from functools import partial
from typing import Any

from crane.common.errors import DescriptionError, check_name, warn
from crane.common.plausible_ranges import implausible_value_text
from crane.description.circuit_schema import AREA_KEYS, BORE_KEYS, ORIFICE_KEYS, PUMP
from crane.description.findings import (
    FollowUpError,
    UnknownNames,
    error_recovery,
    raise_errors,
    report_error,
)
from crane.formats.machine_file.edge_curves import read_edge_curve
from crane.formats.machine_file.structure_sections import TreeBuilder
from crane.formats.machine_file.yaml_section import YamlSection
from crane.hydraulics.circuit_elements import MAIN_PUMP, Supply
from crane.hydraulics.components import (
    COUNTERBALANCE_KEYS,
    Cylinder,
    Valve,
)
from crane.hydraulics.hydraulic_circuit import (
    Hydraulics,
    Oil,
    check_relief_pressure,
    check_tank_pressure,
    connected_nodes,
    nodes_draining_to_tank,
)

_NAME_CHARACTERS = set(string.ascii_letters + string.digits + "_")
_COMPENSATED_KEYS = ("flow", "margin", "meter_out")  # of compensated valves alone
_NODE_SECTIONS = {"supplies": "supply", "lines": "line", "accumulators": "accumulator"}


def read_hydraulics(
    top: YamlSection, tree: TreeBuilder, active: tuple[str, ...]
) -> Hydraulics | None:
    """The circuit of a machine file, None where it has none.

    Raises:
        DescriptionError: With file, line, and what is wrong.
    """
    section = top.section("hydraulics")
    if section is None:
        return None
    supply, oil = None, Oil()
    with error_recovery():
        if (oil_section := section.section("oil")) is not None:
            oil = read_component(oil_section, oil_section.values())
    with error_recovery():
        supply_section = section.section("supply")
        if supply_section is None:
            raise section.error_at(None, "'hydraulics' has no 'supply', give its pressure")
        supply = read_component(
            supply_section,
            _pump_values(section, supply_section),
            check=lambda x: check_tank_pressure(x, oil),
        )
    for key in ("cylinders", "motors"):
        section.apply_common_item(key, section.item_names(key))
    for key in ("valves", "control"):
        section.apply_common_item(
            key, [*section.item_names("cylinders"), *section.item_names("motors")]
        )
    driving_joints = section.known_item_names("cylinders") + section.known_item_names("motors")
    check_joint = partial(check_active_joint, active)

    cylinders = section.read_map("cylinders", partial(_read_cylinder, tree, supply), check_joint)
    cylinders |= section.read_map("motors", partial(_read_motor, cylinders, supply), check_joint)
    valves = section.read_map("valves", _read_valve, check_joint)
    joints_by_component = {"cylinder": driving_joints, "valve": section.known_item_names("valves")}
    named_joints = (*driving_joints, *joints_by_component["valve"])
    for joint, component in itertools.product(named_joints, ("cylinder", "valve")):
        if joint not in joints_by_component[component]:
            report_error(
                section.error_at(f"{component}s", f"'{joint}' has no {component}, add it")
            )
    control = section.read_map(
        "control", lambda _, item: read_component(item, item.values()), check_joint
    )
    gains = section.known_item_names("control")
    are_names_known = not isinstance(gains + driving_joints, UnknownNames)
    if are_names_known and gains and driving_joints and {*gains} != {*driving_joints}:
        listed = ", ".join(driving_joints)
        report_error(section.error_at("control", f"give gains of all of {listed}, or none"))
    if not driving_joints:
        report_error(
            section.error_at(None, "'hydraulics' drives nothing, give cylinders and valves")
        )
    network = _read_network(section)
    lacks_gains = control and not cylinders.keys() <= control.keys()
    if supply is None or lacks_gains or not cylinders.keys() == valves.keys() <= set(active):
        raise FollowUpError("the circuit is not complete")
    order = [joint for joint in active if joint in cylinders]
    circuit = section.create(
        Hydraulics,
        supply,
        oil,
        {joint: cylinders[joint] for joint in order},
        {joint: valves[joint] for joint in order},
        {joint: control[joint] for joint in order if control},
        **network,
    )
    _check_connections(section, circuit)
    return circuit


def circuit_locations(top: YamlSection) -> dict[str, str]:
    """File and line of each pump, line and accumulator, as "supply NAME" and so on."""
    section = top.section("hydraulics")
    if section is None:
        return {}
    return {f"supply {MAIN_PUMP}": section.source_location("supply")} | {
        f"{kind} {name}": location
        for key, kind in _NODE_SECTIONS.items()
        for name, location in section.item_locations(key).items()
    }


def _check_connections(section: YamlSection, circuit: Hydraulics) -> None:
    """Report nodes that nothing is connected to, and returns without a way to the tank."""
    problems = []
    connected, drained_nodes = connected_nodes(circuit), nodes_draining_to_tank(circuit)
    for key, kind in _NODE_SECTIONS.items():
        hint = "'supply' of a valve or 'from'" if key == "supplies" else "'from' or 'to'"
        problems += [
            f"{location}: nothing is joined to the {kind} '{name}', name it as {hint} of an "
            "element, or remove it"
            for name, location in section.item_locations(key).items()
            if name not in connected
        ]
    for name, location in section.item_locations("lines").items():
        returning = [x for x, y in circuit.valves.items() if name in (y.return_a, y.return_b)]
        if returning and name not in drained_nodes:
            problems.append(
                f"{location}: what {' and '.join(returning)} give into the line '{name}' never "
                f"gets to the tank, add an element from '{name}' to 'tank'"
            )
    for problem in problems:
        report_error(DescriptionError(problem), harmless=True)


def check_active_joint(active: tuple[str, ...], joint: str, location: str) -> None:
    """Raise for a joint that is not active.

    Raises:
        DescriptionError: With file and line, and the joints that are.
    """
    check_name(joint, active, f"{location}: '{joint}' is not an active joint", DescriptionError)


def read_component(
    section: YamlSection,
    values: dict[str, Any],
    is_rotary: bool = False,
    check: Callable[[Any], None] = lambda _: None,
    **constants: Any,
) -> Any:
    """The component that a section describes, with warnings about values in other units.

    Args:
        section: The section; its schema names the class.
        values: What has been read of it.
        is_rotary: Whether its joint turns.
        check: Checks the component together with others.
        constants: Further arguments of the class.
    """
    assert section.schema.content is not None
    component = section.create(section.schema.content, **values, **constants)
    section.create(check, component)
    for name, value in values.items():
        if name in section and isinstance(value, float):
            _warn_about_unit(section, name, value, is_rotary)
    return component


def _warn_about_unit(
    section: YamlSection, key: str, value: float, is_rotary: bool = False
) -> None:
    text = implausible_value_text(key, value, is_rotary, section.schema.component)
    if text and math.isfinite(value):
        warn(f"{section.source_location(key)}: '{key}' of {section.title} {text}")


def _check_relief(supply: Supply | None, cylinder: Cylinder) -> None:
    if supply is not None:
        check_relief_pressure(supply, cylinder)


def _warn_about_relief(section: YamlSection, supply: Supply | None, cylinder: Cylinder) -> None:
    if supply is None or implausible_value_text("relief", cylinder.relief):
        return
    if 0 < cylinder.relief <= supply.pressure:
        warn(
            f"{section.source_location('relief')}: 'relief' of {section.title} is "
            f"{cylinder.relief:g} Pa, not above the supply's {supply.pressure:g} Pa: what the "
            "pump gives flows off there before it can press, give a higher one"
        )


def _read_cylinder(
    tree: TreeBuilder, supply: Supply | None, joint: str, item: YamlSection
) -> Cylinder:
    if missing_limit := tree.missing_limit_text(joint):
        report_error(
            item.error_at(
                None, f"joint '{joint}' {missing_limit}, a cylinder needs the limits of its stroke"
            )
        )
    is_rotary = joint in tree.joints and tree.joints[joint].kind == "revolute"
    for key in (*BORE_KEYS, "count", "tube"):
        if is_rotary and key in item and (key != "tube" or item.number(key)):
            raise item.error_at(
                key, f"{item.title} turns its joint, give area_a and area_b [m3/rad]"
            )
    if "rod" in item and "bore" not in item:
        raise item.error_at("rod", f"'rod' of {item.title} goes with 'bore', give it")
    values = item.values()
    count = values.pop("count", 1.0)
    if not count.is_integer() or count < 1:
        raise item.error_at("count", f"'count' of {item.title} is {count:g}, give a whole number")
    holding_valves = {}
    for key in COUNTERBALANCE_KEYS:
        section = item.section(key)
        if section is not None:
            holding_valves[key] = read_component(section, section.values())
    areas = {}
    if "bore" in item:
        bore, rod = values.pop("bore"), values.pop("rod", 0.0)
        if not bore > rod:
            raise item.error_at(
                "bore", f"'bore' of {item.title} is {bore:g} m, give more than the rod"
            )
        for key, value in (("bore", bore), ("rod", rod)):
            _warn_about_unit(item, key, value)
        areas = dict(zip(AREA_KEYS, piston_areas(bore, rod, int(count)), strict=True))
    constants = {"joint": joint, "count": int(count), **areas, **holding_valves}
    check = partial(_check_relief, supply)
    cylinder: Cylinder = read_component(item, values, is_rotary, check, **constants)
    _warn_about_relief(item, supply, cylinder)
    return cylinder


def piston_areas(bore: float, rod: float, count: int) -> tuple[float, float]:
    """Areas of the chambers A and B of equal cylinders in parallel [m2]."""
    area = count * math.pi / 4.0
    return area * bore**2, area * (bore**2 - rod**2)


def _read_motor(
    cylinders: Container[str], supply: Supply | None, joint: str, item: YamlSection
) -> Cylinder:
    """A motor as a cylinder with equal areas; its joint turns slower by the gear."""
    if joint in cylinders:
        raise item.error_at(None, f"'{joint}' has a cylinder and a motor, keep one of them")
    values = item.values()
    size = {key: values.pop(key, 1.0) for key in ("displacement", "gear", "volume")}
    for key, value in size.items():
        _warn_about_unit(item, key, value)
    constants: dict[str, Any] = dict.fromkeys(AREA_KEYS, size["displacement"] * size["gear"])
    constants |= dict.fromkeys(("hose_a", "hose_b"), size["volume"])
    constants |= {"joint": joint, "motor": True}
    motor: Cylinder = read_component(
        item, values, check=partial(_check_relief, supply), **constants
    )
    _warn_about_relief(item, supply, motor)
    return motor


def _pump_values(circuit: YamlSection, item: YamlSection) -> dict[str, Any]:
    """Values of a pump, its maximum flow from displacement and speed, that of the engine."""
    values = item.values()
    displacement, speed = values.pop("displacement", None), values.pop("speed", None)
    if speed is not None and displacement is None:
        raise item.error_at("speed", f"'speed' of {item.title} goes with 'displacement', give it")
    if displacement is None:
        return values
    _warn_about_unit(item, "displacement", displacement)
    if speed is None and (engine := circuit.section("engine")) is not None:
        try:
            with raise_errors():
                speed = engine.number("speed")
        except DescriptionError as error:  # which the section of the engine reports
            raise FollowUpError(str(error)) from None
    if speed is None:
        raise item.error_at(
            "displacement",
            f"{item.title} has a displacement and no speed, give its speed or an engine",
        )
    return values | {"flow": displacement * speed}


def _read_network(section: YamlSection) -> dict[str, Any]:
    """Pumps beside the first one, further nodes and elements, by fields of `Hydraulics`."""

    def read_named(name: str, item: YamlSection) -> Any:
        if not name or not set(name) <= _NAME_CHARACTERS:
            raise item.error_at(
                None, f"a {item.schema.title} is called '{name}', use letters, digits, _"
            )
        values = _pump_values(section, item) if item.schema is PUMP else item.values()
        return read_component(item, values)

    network: dict[str, Any] = {
        key: section.read_map(key, read_named) for key in (*_NODE_SECTIONS, "elements")
    }
    engine = section.section("engine")
    if engine is not None:
        with error_recovery():
            network["engine"] = read_component(engine, engine.values())
    return network


def _read_valve(joint: str, item: YamlSection) -> Valve:
    kind = item.text("type")
    for name in _COMPENSATED_KEYS:
        if kind != "compensated" and name in item:
            raise item.error_at(name, f"'{name}' is for valves of type 'compensated', remove it")
    if kind == "compensated" and "margin" not in item:
        raise item.error_at(None, f"{item.title} has no 'margin', add it")
    values = item.values("type")
    constants: dict[str, Any] = {"joint": joint, "sharing": kind == "sharing", "curves": {}}
    flow, outlet = values.pop("flow", None), values.pop("meter_out", None)
    edge_keys = [*ORIFICE_KEYS, *["centre"] * ("centre" in item)]
    if kind == "compensated" and not any(name in item for name in ORIFICE_KEYS):
        flow = item.number("flow") if flow is None else flow
        inlet = flow / math.sqrt(values["margin"])
        edges = {"flow": flow} if outlet is None else {"flow": flow, "meter_out": outlet}
        for key, value in edges.items():
            _warn_about_unit(item, key, value)
        outlet = inlet if outlet is None else outlet
        constants |= {"c1": inlet, "c2": outlet, "c3": outlet, "c4": inlet}
        edge_keys = edge_keys[len(ORIFICE_KEYS) :]
    for name in edge_keys:
        curve = read_edge_curve(item, name)
        if curve is None:
            values[name] = item.number(name)
        else:
            constants[name], constants["curves"][name] = curve
    if (second_section := item.section("spool_b", f"'spool_b' of {item.title}")) is not None:
        shared: dict[str, Any] = {
            key: item.number(key)
            for key in second_section.schema.keys
            if key not in second_section
        }
        constants["spool_b"] = read_component(
            second_section, second_section.values(), joint=joint, **shared
        )
    return read_component(item, values, **constants)
