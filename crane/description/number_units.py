"""SI units of a machine's numbers, by their names."""

from crane.common.magnitudes import usual_of
from crane.description.changes import PINS
from crane.description.sensors import FORCE_UNITS, SENSOR, VELOCITY_UNITS, parsed, unit_of
from crane.description.tree import Tree

_SHAPES = {"com": "m", "inertia": "kg m2"}
_PLACES = dict.fromkeys("xyz", "m") | dict.fromkeys(("roll", "pitch", "yaw"), "rad")
_HEADS = ("friction", "spring", "gas_spring", "end_stop", "rope", "cylinder", "valve",
          "valve_control", "supply", "oil", "control", "engine", "line", "accumulator",
          "element")  # fmt: skip


def number_unit(tree: Tree, name: str) -> str:
    """SI unit of a number as `crane.description.parameters` names it, "" of one without.

    Numbers of several, with `*`, are common factors, and have none.
    """
    if "*" in name:
        return ""
    if name.startswith(SENSOR):
        quantity, what = parsed(name)
        return {"scale": "", "delay": "s"}.get(what, unit_of(tree, quantity) or "")
    head, _, rest = name.partition(".")
    part, _, word = name.rpartition(".")
    owner = rest.rpartition(".")[0]
    if name.startswith(PINS):
        return "N"
    if head not in _HEADS:
        return _of_tree(tree, part, word)
    turns = owner in tree.joints and tree.joints[owner].kind == "revolute"
    length = "rad" if turns else "m"
    return _of_element(head, word, length) or _of_circuit(head, word, turns)


def _of_tree(tree: Tree, part: str, word: str) -> str:
    kind = part.rpartition(".")[2]
    if kind in _SHAPES and part not in tree.links:
        return _SHAPES[kind]
    if word == "mass":
        return "kg"
    if part in tree.joints and word in ("lower", "upper", "rotor_inertia"):
        turns = tree.joints[part].kind == "revolute"
        if word == "rotor_inertia":
            return "kg m2" if turns else "kg"
        return "rad" if turns else "m"
    return _PLACES.get(word, "")


def _of_element(head: str, word: str, length: str) -> str:
    """Of friction, springs, ropes, stops, along a length or an angle."""
    force = FORCE_UNITS[length]
    viscous = {"m": "N s/m", "rad": "N m s/rad"}[length]
    stiff = {"m": "N/m", "rad": "N m/rad"}[length]
    units = {
        "friction": dict.fromkeys(("coulomb", "coulomb_offset", "stiction"), force)
        | dict.fromkeys(("viscous", "viscous_offset"), viscous)
        | dict.fromkeys(("smoothing", "stribeck"), VELOCITY_UNITS[length]),
        "spring": {"stiffness": stiff, "rest": length, "damping": viscous, "force": force},
        "gas_spring": {"area": {"m": "m2", "rad": "m3/rad"}[length], "pressure": "Pa",
                       "volume": "m3", "rest": length},
        "rope": {"length": "m", "stiffness": "N/m", "damping": "s/m"},
        "end_stop": {"stiffness": stiff, "damping": f"s/{length}"},
        "cylinder": {"damping": viscous, "brake": force},
        "valve_control": {"kp": f"1/{length}", "kd": f"s/{length}"},
        "valve": dict.fromkeys(("neutral", "full"), "V"),
    }  # fmt: skip
    return units.get(head, {}).get(word, "")


_CIRCUIT = ("cylinder", "valve", "supply", "oil", "engine", "line", "accumulator", "element")


def _of_circuit(head: str, word: str, turns: bool) -> str:
    if head not in _CIRCUIT:
        return ""
    usual = usual_of(word, turns, head)
    return usual.unit if usual is not None else ""
