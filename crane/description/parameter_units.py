"""SI units of a machine's numbers, by their names."""

from crane.common.plausible_ranges import plausible_range
from crane.description.kinematic_tree import Tree
from crane.description.parameter_changes import PINS_PREFIX
from crane.description.sensors import (
    FORCE_UNITS,
    SENSOR_PREFIX,
    VELOCITY_UNITS,
    parse_sensor_parameter,
    quantity_unit,
)

_INERTIAL_UNITS = {"com": "m", "inertia": "kg m2"}
_PLACEMENT_UNITS = dict.fromkeys("xyz", "m") | dict.fromkeys(("roll", "pitch", "yaw"), "rad")
_COMPONENT_PREFIXES = ("friction", "spring", "gas_spring", "end_stop", "rope", "cylinder", "valve",
          "valve_control", "supply", "oil", "control", "engine", "line", "accumulator",
          "element")  # fmt: skip


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
    if prefix not in _COMPONENT_PREFIXES:
        return _tree_parameter_unit(tree, part, key)
    is_rotary = owner in tree.joints and tree.joints[owner].kind == "revolute"
    coordinate_unit = "rad" if is_rotary else "m"
    return _element_parameter_unit(prefix, key, coordinate_unit) or _circuit_parameter_unit(
        prefix, key, is_rotary
    )


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


def _element_parameter_unit(prefix: str, key: str, coordinate_unit: str) -> str:
    """Of friction, springs, ropes, stops, along a length or an angle."""
    force_unit = FORCE_UNITS[coordinate_unit]
    damping_unit = {"m": "N s/m", "rad": "N m s/rad"}[coordinate_unit]
    stiffness_unit = {"m": "N/m", "rad": "N m/rad"}[coordinate_unit]
    units = {
        "friction": dict.fromkeys(("coulomb", "coulomb_offset", "stiction"), force_unit)
        | dict.fromkeys(("viscous", "viscous_offset"), damping_unit)
        | dict.fromkeys(("smoothing", "stribeck"), VELOCITY_UNITS[coordinate_unit]),
        "spring": {
            "stiffness": stiffness_unit,
            "rest": coordinate_unit,
            "damping": damping_unit,
            "force": force_unit,
        },
        "gas_spring": {
            "area": {"m": "m2", "rad": "m3/rad"}[coordinate_unit],
            "pressure": "Pa",
            "volume": "m3",
            "rest": coordinate_unit,
        },
        "rope": {"length": "m", "stiffness": "N/m", "damping": "s/m"},
        "end_stop": {"stiffness": stiffness_unit, "damping": f"s/{coordinate_unit}"},
        "cylinder": {"damping": damping_unit, "brake": force_unit},
        "valve_control": {"kp": f"1/{coordinate_unit}", "kd": f"s/{coordinate_unit}"},
        "valve": dict.fromkeys(("neutral", "full"), "V"),
    }
    return units.get(prefix, {}).get(key, "")


_CIRCUIT_PREFIXES = (
    "cylinder",
    "valve",
    "supply",
    "oil",
    "engine",
    "line",
    "accumulator",
    "element",
)


def _circuit_parameter_unit(prefix: str, key: str, is_rotary: bool) -> str:
    if prefix not in _CIRCUIT_PREFIXES:
        return ""
    plausible = plausible_range(key, is_rotary, prefix)
    return plausible.unit if plausible is not None else ""
