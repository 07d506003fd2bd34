"""The section `hydraulics` of a machine file."""

import itertools
import math
import string
import warnings
from collections.abc import Callable
from dataclasses import MISSING, fields
from typing import Any, TypeVar

from crane.common.errors import CraneWarning, InputError, suggest_names
from crane.common.plausible_ranges import implausible_value_text
from crane.description.findings import FollowUpError, UnknownNames, error_recovery, report_error
from crane.formats.machine_file.flow_curves import read_curve
from crane.formats.machine_file.tree_builder import TreeBuilder
from crane.formats.machine_file.yaml_section import YamlSection
from crane.hydraulics.circuit_elements import (
    MAIN_PUMP,
    Accumulator,
    CircuitElement,
    CircuitLine,
    CircuitPathError,
    ComponentParameterError,
    Engine,
    Supply,
    parameter_names,
)
from crane.hydraulics.components import (
    COUNTERBALANCE_KEYS,
    CounterbalanceValve,
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

Component = TypeVar("Component")
ComponentPart = TypeVar("ComponentPart")

_JOINTLY_CHECKED = ("tank", "relief")  # looked at with other parts
_NAME_CHARACTERS = set(string.ascii_letters + string.digits + "_")
_VALVE_TYPES = ("orifice", "compensated", "sharing")
_COMPENSATED_KEYS = ("flow", "margin", "meter_out")  # what only these have
_NODE_SECTIONS = {"supplies": "supply", "lines": "line", "accumulators": "accumulator"}
_ORIFICE_KEYS = ("c1", "c2", "c3", "c4")
_CURVE_KEYS = (*_ORIFICE_KEYS, "centre")
_BORE_KEYS = ("bore", "rod", "count")
_REGULATION_KEYS = ("control", "summed")
MOTOR_KEYS = {  # keys, and what they are of `Cylinder`
    "displacement": None, "gear": None, "volume": None,
    **{name: name for name in ("leakage", "leakage_a", "leakage_b", "relief", "relief_gain",
                               "cross_relief", "refill", "gas_a", "gas_b", "seal_friction",
                               "brake", "brake_release")},
}  # fmt: skip


def read_hydraulics(
    top: YamlSection, tree: TreeBuilder, active: tuple[str, ...]
) -> Hydraulics | None:
    """The circuit of a machine file, None where it has none.

    Raises:
        DescriptionError: With file, line, and what is wrong.
    """
    section = top.section("hydraulics", "'hydraulics'")
    if section is None:
        return None
    section.check_keys(
        "supply", "supplies", "engine", "oil", "lines", "accumulators", "elements", "cylinders",
        "motors", "valves", "control",
    )  # fmt: skip
    supply = None
    with error_recovery():
        supply_section = section.section("supply", "'supply'")
        if supply_section is None:
            raise section.error_at(None, "'hydraulics' has no 'supply', give its pressure")
        supply_section.check_keys(*parameter_names(Supply), *_REGULATION_KEYS)
        supply = _read_supply(supply_section)
    oil = Oil()
    with error_recovery():
        oil_section = section.section("oil", "'oil'")
        if oil_section is not None:
            oil_section.check_keys(*parameter_names(Oil))
            oil = read_component(oil_section, Oil)
    if supply is not None and supply_section is not None:
        with error_recovery():
            create_checked(supply_section, check_tank_pressure, supply, oil)
            warn_about_unit(supply_section, "tank", supply.tank)
    for key in ("cylinders", "motors"):
        section.apply_common_item(key, section.item_names(key))
    for key in ("valves", "control"):
        section.apply_common_item(
            key, [*section.item_names("cylinders"), *section.item_names("motors")]
        )
    driving_joints = section.known_item_names("cylinders") + section.known_item_names("motors")
    gains = section.known_item_names("control")
    joints_by_component = {"cylinder": driving_joints, "valve": section.known_item_names("valves")}
    cylinders: dict[str, Cylinder] = {}
    keys: tuple[str, ...] = (*parameter_names(Cylinder), *COUNTERBALANCE_KEYS, *_BORE_KEYS)
    for joint, item in section.mappings("cylinders", "cylinder of", *keys):
        with error_recovery():
            check_active_joint(joint, item, active)
            cylinders[joint] = _read_cylinder(joint, item, tree)
            _check_relief(item, supply, cylinders[joint])
    keys = tuple(MOTOR_KEYS)
    for joint, item in section.mappings("motors", "motor of", *keys):
        with error_recovery():
            check_active_joint(joint, item, active)
            if joint in cylinders:
                raise item.error_at(
                    None, f"'{joint}' has a cylinder and a motor, keep one of them"
                )
            cylinders[joint] = _read_motor(joint, item)
            _check_relief(item, supply, cylinders[joint])
    valves: dict[str, Valve] = {}
    valve_keys = (
        *parameter_names(Valve),
        "type",
        "flow",
        "meter_out",
        "supply",
        "return_a",
        "return_b",
        "priority",
        "spool_b",
    )
    for joint, item in section.mappings("valves", "valve of", *valve_keys):
        with error_recovery():
            check_active_joint(joint, item, active)
            valves[joint] = _read_valve(item, joint)
    named_joints = (*driving_joints, *joints_by_component["valve"])
    for joint, component in itertools.product(named_joints, ("cylinder", "valve")):
        if joint not in joints_by_component[component]:
            report_error(
                section.error_at(f"{component}s", f"'{joint}' has no {component}, add it")
            )
    control: dict[str, PDGains] = {}
    for joint, item in section.mappings("control", "control of", *parameter_names(PDGains)):
        with error_recovery():
            check_active_joint(joint, item, active)
            control[joint] = read_component(item, PDGains)
    are_names_known = not isinstance(gains + driving_joints, UnknownNames)
    if are_names_known and gains and driving_joints and {*gains} != {*driving_joints}:
        listed = ", ".join(driving_joints)
        report_error(section.error_at("control", f"give gains of all of {listed}, or none"))
    if not driving_joints:
        report_error(
            section.error_at(None, "'hydraulics' drives nothing, give cylinders and valves")
        )
    network = read_network(section)
    lacks_gains = control and not cylinders.keys() <= control.keys()
    if supply is None or lacks_gains or not cylinders.keys() == valves.keys() <= set(active):
        raise FollowUpError("the circuit is not complete")
    order = [joint for joint in active if joint in cylinders]
    circuit = create_checked(
        section,
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
    section = top.section("hydraulics", "'hydraulics'")
    if section is None:
        return {}
    locations = {f"supply {MAIN_PUMP}": section.source_location("supply")}
    for key, kind in _NODE_SECTIONS.items():
        outer = section.section(key, f"'{key}'")
        if outer is not None:
            locations |= {f"{kind} {name}": outer.source_location(name) for name in outer}
    return locations


def _check_connections(section: YamlSection, hydraulics: Hydraulics) -> None:
    """Note nodes that hang on nothing, and returns from which no oil gets to the tank."""
    connected, drained_nodes = connected_nodes(hydraulics), nodes_draining_to_tank(hydraulics)
    for key, kind in _NODE_SECTIONS.items():
        outer = section.section(key, f"'{key}'")
        for name in outer or ():
            assert outer is not None
            if name in connected:
                continue
            hint = "'supply' of a valve or 'from'" if key == "supplies" else "'from' or 'to'"
            problem = f"nothing is joined to the {kind} '{name}', name it as {hint} of an element"
            report_error(outer.error_at(name, f"{problem}, or remove it"), harmless=True)
    outer = section.section("lines", "'lines'")
    for name in outer or ():
        assert outer is not None
        returning_joints = [joint for joint, valve in hydraulics.valves.items()
                 if name in (valve.return_a, valve.return_b)]  # fmt: skip
        if returning_joints and name not in drained_nodes:
            problem = (
                f"what {' and '.join(returning_joints)} give into the line '{name}' never gets "
                f"to the "
            )
            problem += f"tank, add an element from '{name}' to 'tank'"
            report_error(outer.error_at(name, problem), harmless=True)


def check_active_joint(joint: str, item: YamlSection, active: tuple[str, ...]) -> None:
    """Raise for an item of a joint that is not active.

    Raises:
        DescriptionError: With file and line, and the joints that are.
    """
    if joint not in active:
        raise item.error_at(
            None, f"'{joint}' is not an active joint, {suggest_names(active, joint)}"
        )


def _is_rotary(tree: TreeBuilder, joint: str) -> bool:
    return joint in tree.joints and tree.joints[joint].kind == "revolute"


def read_component(
    section: YamlSection,
    component_type: type[ComponentPart],
    is_rotary: bool = False,
    /,
    **values: Any,
) -> ComponentPart:
    """A part whose remaining numbers stand in a section."""
    all_fields: Any = fields(component_type)  # type: ignore[arg-type]
    remaining_fields = [
        x for x in all_fields if x.name in parameter_names(component_type) and x.name not in values
    ]
    for entry in remaining_fields:
        minimum = -math.inf if entry.metadata.get("signed") else 0.0
        if entry.default is MISSING:
            values[entry.name] = section.number(entry.name, minimum=minimum)
        else:
            values[entry.name] = section.number(entry.name, float(entry.default), minimum=minimum)
    part = create_checked(section, component_type, **values)
    for entry in remaining_fields:
        if entry.name in section and entry.name not in _JOINTLY_CHECKED:
            warn_about_unit(
                section,
                entry.name,
                values[entry.name],
                is_rotary,
                component_type.__name__.removeprefix("Circuit").lower(),
            )
    return part


def create_checked(
    section: YamlSection, create: Callable[..., Component], *arguments: object, **values: Any
) -> Component:
    """What is made of a section's numbers, or its error with file and line."""
    try:
        return create(*arguments, **values)
    except ComponentParameterError as error:
        raise section.error_at(error.key, str(error)) from None
    except CircuitPathError as error:
        *path, key = error.path
        for name in path:
            section = section.section(name, name) or section
        raise section.error_at(key, str(error)) from None
    except InputError as error:
        raise section.error_at(None, str(error)) from None


def warn_about_unit(
    section: YamlSection, key: str, value: float, is_rotary: bool = False, component: str = ""
) -> None:
    """Warn of a number that can be, and hardly is in its SI unit."""
    if text := implausible_value_text(key, value, is_rotary, component):
        message = f"{section.source_location(key)}: '{key}' of {section.title} {text}"
        warnings.warn(message, CraneWarning, stacklevel=2)


def _check_relief(section: YamlSection, supply: Supply | None, cylinder: Cylinder) -> None:
    """A cylinder's relief beside the supply, which may have been refused."""
    if supply is None:
        return
    create_checked(section, check_relief_pressure, supply, cylinder)
    warn_about_unit(section, "relief", cylinder.relief)
    if 0 < cylinder.relief <= supply.pressure and not implausible_value_text(
        "relief", cylinder.relief
    ):
        message = (
            f"{section.source_location('relief')}: 'relief' of {section.title} is "
            f"{cylinder.relief:g} Pa, "
            f"not above the supply's {supply.pressure:g} Pa: what the pump gives flows off there "
            "before it can press, give a higher one"
        )
        warnings.warn(message, CraneWarning, stacklevel=2)


def _read_cylinder(joint: str, item: YamlSection, tree: TreeBuilder) -> Cylinder:
    if missing_limit := tree.missing_limit_text(joint):
        problem = f"joint '{joint}' {missing_limit}, a cylinder needs the limits of its stroke"
        report_error(item.error_at(None, problem))
    is_rotary = _is_rotary(tree, joint)
    return read_component(
        item,
        Cylinder,
        is_rotary,
        joint=joint,
        **_count_and_areas(item, is_rotary),
        **_counterbalance_valves(item),
    )


def _count_and_areas(item: YamlSection, is_rotary: bool) -> dict[str, Any]:
    """How many cylinders there are side by side, and their areas if bore and rod are given."""
    count = item.number("count", 1.0)
    if not count.is_integer() or count < 1:
        raise item.error_at("count", f"'count' of {item.title} is {count:g}, give a whole number")
    if is_rotary:
        for key in (*_BORE_KEYS, "tube"):
            if key in item and (key != "tube" or item.number(key)):
                raise item.error_at(
                    key, f"{item.title} turns its joint, give area_a and area_b [m3/rad]"
                )
    values = {"count": int(count)}
    if "bore" not in item:
        if "rod" in item:
            raise item.error_at("rod", f"'rod' of {item.title} goes with 'bore', give it")
        return values
    bore, rod = item.number("bore"), item.number("rod", 0.0, minimum=0.0)
    if not bore > rod:
        raise item.error_at(
            "bore", f"'bore' of {item.title} is {bore:g} m, give more than the rod"
        )
    for key in ("area_a", "area_b"):
        if key in item:
            raise item.error_at(key, f"'{key}' stands beside 'bore', keep one of them")
    for key, value in (("bore", bore), ("rod", rod)):
        warn_about_unit(item, key, value)
    area = count * math.pi / 4.0
    return values | {"area_a": area * bore**2, "area_b": area * (bore**2 - rod**2)}


def _counterbalance_valves(item: YamlSection) -> dict[str, CounterbalanceValve]:
    found = {}
    for name in COUNTERBALANCE_KEYS:
        section = item.section(name, f"'{name}'")
        if section is not None:
            section.check_keys(*parameter_names(CounterbalanceValve))
            found[name] = read_component(section, CounterbalanceValve)
    return found


def _read_supply(section: YamlSection) -> Supply:
    values: dict[str, Any] = {"control": section.text("control", "pressure")}
    if "summed" in section:
        values["summed"] = section.names("summed")
    supply = read_component(section, Supply, **values)
    if "relief" in section:
        warn_about_unit(section, "relief", supply.relief)
    return supply


def _read_motor(joint: str, item: YamlSection) -> Cylinder:
    """A motor by its displacement [m3/rad]; its joint turns slower by the gear."""
    displacement = item.number("displacement", minimum=0.0)
    gear = item.number("gear", 1.0, minimum=0.0)
    volume = item.number("volume", minimum=0.0)
    for key, value in (("displacement", displacement), ("gear", gear), ("volume", volume)):
        if value == 0:
            raise item.error_at(key, f"'{key}' of {item.title} is 0, give it")
        warn_about_unit(item, key, value, component="motor")
    values: dict[str, Any] = dict.fromkeys(("area_a", "area_b"), displacement * gear)
    values |= dict.fromkeys(("hose_a", "hose_b"), volume)
    return read_component(item, Cylinder, joint=joint, motor=True, **values)


def read_network(section: YamlSection) -> dict[str, Any]:
    """What a circuit has beside first pump, cylinders and valves, by fields of `Hydraulics`."""
    found: dict[str, Any] = {}
    for key, title, kind in (
        ("supplies", "supply", Supply), ("lines", "line", CircuitLine),
        ("accumulators", "accumulator", Accumulator), ("elements", "element", CircuitElement),
    ):  # fmt: skip
        parts: dict[str, Any] = {}
        extra_keys = {
            Supply: _REGULATION_KEYS,
            CircuitElement: ("type", "from", "to", "joints", "side"),
        }
        keys = [name for name in parameter_names(kind) if (kind, name) != (Supply, "tank")]
        for name, item in section.mappings(key, title, *keys, *extra_keys.get(kind, ())):
            with error_recovery():
                if not name or not set(name) <= _NAME_CHARACTERS:
                    raise item.error_at(
                        None, f"a {title} is called '{name}', use letters, digits, _"
                    )
                parts[name] = (
                    _read_element(item)
                    if kind is CircuitElement
                    else (_read_supply(item) if kind is Supply else read_component(item, kind))
                )
        found[key] = parts
    engine = section.section("engine", "'engine'")
    if engine is not None:
        with error_recovery():
            engine.check_keys(*parameter_names(Engine))
            found["engine"] = read_component(engine, Engine)
    return found


def _read_element(item: YamlSection) -> CircuitElement:
    values: dict[str, Any] = {
        "kind": item.text("type"), "source": item.text("from"), "target": item.text("to"),
        "side": item.text("side", "both"),
    }  # fmt: skip
    if "joints" in item:
        values["joints"] = item.names("joints")
    return read_component(item, CircuitElement, **values)


def _read_valve(item: YamlSection, joint: str) -> Valve:
    kind = item.text("type")
    if kind not in _VALVE_TYPES:
        raise item.error_at(
            "type", f"valve type '{kind}' is unknown, {suggest_names(_VALVE_TYPES, kind)}"
        )
    for name in _COMPENSATED_KEYS:
        if kind != "compensated" and name in item:
            raise item.error_at(name, f"'{name}' is for valves of type 'compensated', remove it")
    values: dict[str, Any] = {
        key: item.text(key) for key in ("supply", "return_a", "return_b") if key in item
    }
    if "priority" in item:
        values["priority"] = item.raw_value("priority")
        if not isinstance(values["priority"], bool):
            raise item.error_at("priority", f"'priority' of {item.title} is neither yes nor no")
    curves = {}
    for name in _CURVE_KEYS:
        if name in item and (found := read_curve(item, name)) is not None:
            values[name], curves[name] = found
    values["curves"] = curves
    if (second_section := item.section("spool_b", f"'spool_b' of {item.title}")) is not None:
        second_section.check_keys(*parameter_names(Spool))
        values["spool_b"] = _read_second_spool(second_section, item, joint)
    if kind != "compensated":
        return read_component(item, Valve, joint=joint, sharing=kind == "sharing", **values)
    margin = item.number("margin", minimum=0.0)
    if margin == 0:
        raise item.error_at("margin", "'margin' is 0, give the pressure drop that is kept")
    edges = [name for name in _ORIFICE_KEYS if name in item]
    if edges:
        for name in ("flow", "meter_out"):
            if name in item:
                raise item.error_at(name, f"'{name}' stands beside '{edges[0]}', keep one of them")
        return read_component(item, Valve, joint=joint, **values)
    flow = item.number("flow", minimum=0.0)
    if flow == 0:
        raise item.error_at("flow", "'flow' is 0, give the flow at full stroke")
    inlet = flow / math.sqrt(margin)
    outlet = item.number("meter_out", inlet, minimum=0.0)
    warn_about_unit(item, "flow", flow)
    if "meter_out" in item:
        warn_about_unit(item, "meter_out", outlet)
    values |= {"c1": inlet, "c2": outlet, "c3": outlet, "c4": inlet}
    return read_component(item, Valve, joint=joint, **values)


def _read_second_spool(section: YamlSection, valve: YamlSection, joint: str) -> Spool:
    """A second spool, which is moved as the first one where it does not say how itself."""
    numbers, default_spool = {}, Spool(joint)
    for entry in fields(Spool):
        if entry.name != "joint":
            source_section = section if entry.name in section else valve
            minimum = -math.inf if entry.metadata.get("signed") else 0.0
            numbers[entry.name] = source_section.number(
                entry.name, getattr(default_spool, entry.name), minimum=minimum
            )
    spool = create_checked(section, Spool, joint, **numbers)
    for name in parameter_names(Spool):
        if name in section:
            warn_about_unit(section, name, numbers[name], component="spool")
    return spool
