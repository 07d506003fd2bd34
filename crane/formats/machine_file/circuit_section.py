"""The section `hydraulics` of a machine file."""

import itertools
import math
import string
import warnings
from typing import Any

from crane.common.errors import CraneWarning, DescriptionError, suggest_names
from crane.common.plausible_ranges import implausible_value_text
from crane.description.circuit_schema import AREA_KEYS, BORE_KEYS, ORIFICE_KEYS, VALVE_TYPES
from crane.description.findings import FollowUpError, UnknownNames, error_recovery, report_error
from crane.formats.machine_file.flow_curves import read_curve
from crane.formats.machine_file.tree_builder import TreeBuilder
from crane.formats.machine_file.yaml_section import YamlSection
from crane.hydraulics.circuit_elements import MAIN_PUMP, Supply
from crane.hydraulics.components import (
    COUNTERBALANCE_KEYS,
    Cylinder,
    Spool,
    Valve,
)
from crane.hydraulics.hydraulic_circuit import (
    Hydraulics,
    Oil,
    PDGains,
    check_relief_pressure,
    check_tank_pressure,
    connected_nodes,
    nodes_draining_to_tank,
)

_JOINTLY_CHECKED = ("tank", "relief")  # checked with other components
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
    supply, oil = _read_supply_and_oil(section)
    driving_joints = _driving_joints(section)

    def read_cylinder(joint: str, item: YamlSection) -> Cylinder:
        check_active_joint(joint, item, active)
        cylinder = _read_cylinder(joint, item, tree)
        _check_relief(item, supply, cylinder)
        return cylinder

    def read_motor(joint: str, item: YamlSection) -> Cylinder:
        check_active_joint(joint, item, active)
        if joint in cylinders:
            raise item.error_at(None, f"'{joint}' has a cylinder and a motor, keep one of them")
        motor = _read_motor(joint, item)
        _check_relief(item, supply, motor)
        return motor

    def read_valve(joint: str, item: YamlSection) -> Valve:
        check_active_joint(joint, item, active)
        return _read_valve(joint, item)

    def read_gains(joint: str, item: YamlSection) -> PDGains:
        check_active_joint(joint, item, active)
        return read_component(item, item.values())

    cylinders = section.read_map("cylinders", read_cylinder)
    cylinders |= section.read_map("motors", read_motor)
    valves = section.read_map("valves", read_valve)
    joints_by_component = {"cylinder": driving_joints, "valve": section.known_item_names("valves")}
    named_joints = (*driving_joints, *joints_by_component["valve"])
    for joint, component in itertools.product(named_joints, ("cylinder", "valve")):
        if joint not in joints_by_component[component]:
            problem = f"'{joint}' has no {component}, add it"
            report_error(section.error_at(f"{component}s", problem))
    control = section.read_map("control", read_gains)
    gains = section.known_item_names("control")
    are_names_known = not isinstance(gains + driving_joints, UnknownNames)
    if are_names_known and gains and driving_joints and {*gains} != {*driving_joints}:
        listed = ", ".join(driving_joints)
        report_error(section.error_at("control", f"give gains of all of {listed}, or none"))
    if not driving_joints:
        problem = "'hydraulics' drives nothing, give cylinders and valves"
        report_error(section.error_at(None, problem))
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


def _read_supply_and_oil(section: YamlSection) -> tuple[Supply | None, Oil]:
    """The first pump, None where it is refused, and the oil."""
    supply, oil, supply_section = None, Oil(), None
    with error_recovery():
        supply_section = section.section("supply")
        if supply_section is None:
            raise section.error_at(None, "'hydraulics' has no 'supply', give its pressure")
        supply = read_supply(supply_section)
    with error_recovery():
        oil_section = section.section("oil")
        if oil_section is not None:
            oil = read_component(oil_section, oil_section.values())
    if supply is not None and supply_section is not None:
        with error_recovery():
            supply_section.create(check_tank_pressure, supply, oil)
            _warn_about_unit(supply_section, "tank", supply.tank)
    return supply, oil


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


def check_active_joint(joint: str, item: YamlSection, active: tuple[str, ...]) -> None:
    """Raise for an item of a joint that is not active.

    Raises:
        DescriptionError: With file and line, and the joints that are.
    """
    if joint not in active:
        raise item.error_at(
            None, f"'{joint}' is not an active joint, {suggest_names(active, joint)}"
        )


def read_component(
    section: YamlSection, values: dict[str, Any], is_rotary: bool = False, **constants: Any
) -> Any:
    """The component that a section describes.

    Args:
        section: The section; its schema names the class.
        values: What has been read of it.
        is_rotary: Whether its joint turns.
        constants: Further arguments of the class.
    """
    assert section.schema.content is not None
    component = section.create(section.schema.content, **values, **constants)
    for name, value in values.items():
        if name in section and isinstance(value, float) and name not in _JOINTLY_CHECKED:
            _warn_about_unit(section, name, value, is_rotary)
    return component


def _warn_about_unit(
    section: YamlSection, key: str, value: float, is_rotary: bool = False
) -> None:
    """Warn about a number that is possible and hardly in its SI unit."""
    text = implausible_value_text(key, value, is_rotary, section.schema.component)
    if text and math.isfinite(value):
        message = f"{section.source_location(key)}: '{key}' of {section.title} {text}"
        warnings.warn(message, CraneWarning, stacklevel=2)


def _check_relief(section: YamlSection, supply: Supply | None, cylinder: Cylinder) -> None:
    """A cylinder's relief beside the supply, which may have been refused."""
    if supply is None:
        return
    section.create(check_relief_pressure, supply, cylinder)
    _warn_about_unit(section, "relief", cylinder.relief)
    if 0 < cylinder.relief <= supply.pressure and not implausible_value_text(
        "relief", cylinder.relief
    ):
        message = (
            f"{section.source_location('relief')}: 'relief' of {section.title} is "
            f"{cylinder.relief:g} Pa, not above the supply's {supply.pressure:g} Pa: what the "
            "pump gives flows off there before it can press, give a higher one"
        )
        warnings.warn(message, CraneWarning, stacklevel=2)


def _driving_joints(section: YamlSection) -> tuple[str, ...]:
    """Joints with a cylinder or motor; common items are applied."""
    for key in ("cylinders", "motors"):
        section.apply_common_item(key, section.item_names(key))
    for key in ("valves", "control"):
        section.apply_common_item(
            key, [*section.item_names("cylinders"), *section.item_names("motors")]
        )
    return section.known_item_names("cylinders") + section.known_item_names("motors")


def _read_cylinder(joint: str, item: YamlSection, tree: TreeBuilder) -> Cylinder:
    if missing_limit := tree.missing_limit_text(joint):
        problem = f"joint '{joint}' {missing_limit}, a cylinder needs the limits of its stroke"
        report_error(item.error_at(None, problem))
    is_rotary = joint in tree.joints and tree.joints[joint].kind == "revolute"
    for key in (*BORE_KEYS, "count", "tube"):
        if is_rotary and key in item and (key != "tube" or item.number(key)):
            problem = f"{item.title} turns its joint, give area_a and area_b [m3/rad]"
            raise item.error_at(key, problem)
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
            problem = f"'bore' of {item.title} is {bore:g} m, give more than the rod"
            raise item.error_at("bore", problem)
        for key, value in (("bore", bore), ("rod", rod)):
            _warn_about_unit(item, key, value)
        area = count * math.pi / 4.0
        areas = {"area_a": area * bore**2, "area_b": area * (bore**2 - rod**2)}
    constants = {"joint": joint, "count": int(count), **areas, **holding_valves}
    cylinder: Cylinder = read_component(item, values, is_rotary, **constants)
    return cylinder


def read_supply(section: YamlSection) -> Supply:
    """A pump."""
    supply: Supply = read_component(section, section.values())
    if "relief" in section:
        _warn_about_unit(section, "relief", supply.relief)
    return supply


def _read_motor(joint: str, item: YamlSection) -> Cylinder:
    """A motor as a cylinder with equal areas; its joint turns slower by the gear."""
    values = item.values()
    size = {key: values.pop(key, 1.0) for key in ("displacement", "gear", "volume")}
    for key, value in size.items():
        _warn_about_unit(item, key, value)
    constants: dict[str, Any] = dict.fromkeys(AREA_KEYS, size["displacement"] * size["gear"])
    constants |= dict.fromkeys(("hose_a", "hose_b"), size["volume"])
    motor: Cylinder = read_component(item, values, joint=joint, motor=True, **constants)
    return motor


def _read_network(section: YamlSection) -> dict[str, Any]:
    """Pumps beside the first one, further nodes and elements, by fields of `Hydraulics`."""

    def read_named(name: str, item: YamlSection) -> Any:
        if not name or not set(name) <= _NAME_CHARACTERS:
            kind = item.schema.title
            raise item.error_at(None, f"a {kind} is called '{name}', use letters, digits, _")
        if item.schema.content is Supply:
            return read_supply(item)
        return read_component(item, item.values())

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
    if kind not in VALVE_TYPES:
        raise item.error_at(
            "type", f"valve type '{kind}' is unknown, {suggest_names(VALVE_TYPES, kind)}"
        )
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
        curve = read_curve(item, name)
        if curve is None:
            values[name] = item.number(name)
        else:
            constants[name], constants["curves"][name] = curve
    if (second_section := item.section("spool_b", f"'spool_b' of {item.title}")) is not None:
        constants["spool_b"] = _read_second_spool(joint, second_section, item)
    valve: Valve = read_component(item, values, **constants)
    return valve


def _read_second_spool(joint: str, section: YamlSection, valve: YamlSection) -> Spool:
    """A second spool, whose keys are by default those of the first one."""
    values = section.values()
    shared: dict[str, Any] = {
        key: valve.number(key) for key in section.schema.keys if key not in section
    }
    spool: Spool = read_component(section, values, joint=joint, **shared)
    return spool
