"""SI units of a machine's numbers, by their names."""

from crane.description.circuit_schema import (
    ACCUMULATOR,
    CYLINDER,
    ELEMENT,
    ENGINE,
    FIRST_PUMP,
    LINE,
    OIL,
    VALVE,
    VALVE_CONTROL,
)
from crane.description.key_types import NumberKey
from crane.description.kinematic_tree import Tree
from crane.description.machine_schema import END_STOP, FORCE, FRICTION, GAS_SPRING, ROPE
from crane.description.parameter_changes import PINS_PREFIX
from crane.description.sensors import (
    SENSOR_PREFIX,
    parse_sensor_parameter,
    quantity_unit,
)

_INERTIAL_UNITS = {"com": "m", "inertia": "kg m2"}
_PLACEMENT_UNITS = dict.fromkeys("xyz", "m") | dict.fromkeys(("roll", "pitch", "yaw"), "rad")
_SECTIONS = {
    "friction": FRICTION, "spring": FORCE, "gas_spring": GAS_SPRING, "end_stop": END_STOP,
    "rope": ROPE, "cylinder": CYLINDER, "valve": VALVE, "valve_control": VALVE_CONTROL,
    "supply": FIRST_PUMP, "oil": OIL, "engine": ENGINE, "line": LINE, "accumulator": ACCUMULATOR,
    "element": ELEMENT,
}  # fmt: skip


def parameter_unit(tree: Tree, name: str) -> str:
    """SI unit of a number as `crane.description.parameters` names it, "" of one without.

    Numbers of several, with `*`, are common factors, and have none.
    """
    if "*" in name:
        return ""
    if name.startswith(SENSOR_PREFIX):
        quantity, sensor_parameter = parse_sensor_parameter(name)
        return {"scale": "", "delay": "s"}.get(
            sensor_parameter, quantity_unit(tree, quantity) or ""
        )
    prefix, _, rest = name.partition(".")
    part, _, key = name.rpartition(".")
    owner = rest.rpartition(".")[0]
    if name.startswith(PINS_PREFIX):
        return "N"
    if prefix == "control":  # gains of two kinds of controllers
        return ""
    if prefix not in _SECTIONS:
        return _tree_parameter_unit(tree, part, key)
    is_rotary = owner in tree.joints and tree.joints[owner].kind == "revolute"
    value = _SECTIONS[prefix].keys.get(key)
    value = next(iter(getattr(value, "types", ())), value)  # an edge, which may be a curve
    if not isinstance(value, NumberKey):
        return ""
    return value.rotary_unit or value.unit if is_rotary else value.unit


def _tree_parameter_unit(tree: Tree, part: str, key: str) -> str:
    kind = part.rpartition(".")[2]
    if kind in _INERTIAL_UNITS and part not in tree.links:
        return _INERTIAL_UNITS[kind]
    if key == "mass":
        return "kg"
    if part in tree.joints and key in ("lower", "upper", "rotor_inertia"):
        is_rotary = tree.joints[part].kind == "revolute"
        if key == "rotor_inertia":
            return "kg m2" if is_rotary else "kg"
        return "rad" if is_rotary else "m"
    return _PLACEMENT_UNITS.get(key, "")
