"""Search of the names of a machine: joints, frames, columns of recordings, parameters."""

from difflib import get_close_matches
from fnmatch import fnmatchcase

from crane.common.errors import InputError
from crane.description.machine_parameters import parameters
from crane.description.parameter_units import parameter_unit
from crane.description.sensors import (
    PRESSURE_PREFIX,
    SUPPLY_PRESSURE,
    TANK_PRESSURE,
    VALVE_SIGNAL_PREFIX,
    quantity_names,
    quantity_unit,
)
from crane.description.specification import MachineSpec

NamesByKind = dict[str, dict[str, str]]  # kind -> name -> short description
_MAX_SUGGESTIONS, _MIN_SIMILARITY = 5, 0.6


def names_by_kind(spec: MachineSpec) -> NamesByKind:
    """Return the names of joints, frames, columns of recordings and parameters of a machine.

    Returns:
        By kind and name a short description: type of the joint, joint or link that carries the
        frame, unit of the column, value of the parameter with its unit.
    """
    tree = spec.tree
    cylinders = {} if spec.hydraulics is None else spec.hydraulics.cylinders

    def is_available(name: str) -> bool:  # whether the circuit has that valve or chamber
        heads = PRESSURE_PREFIX, VALVE_SIGNAL_PREFIX, "spool_"
        head = next((head for head in heads if name.startswith(head)), "")
        rest = name.removeprefix(head)
        if name in (SUPPLY_PRESSURE, TANK_PRESSURE):
            return bool(cylinders)
        return not head or not cylinders.keys().isdisjoint((rest, rest[:-2]))

    parents = {joint.child: joint for joint in tree.joints.values()}
    return {
        "joint": {joint.name: joint.kind for joint in tree.moving_joints},
        "frame": {
            link: f"{'moved by' if parents[link].is_movable else 'on'} "
            f"{parents[link].name if parents[link].is_movable else parents[link].parent}"
            if link in parents
            else "root"
            for link in tree.links
        },
        "column": {
            name: quantity_unit(tree, name) or ""
            for name in quantity_names(tree)
            if is_available(name)
        },
        "parameter": {
            name: f"{value:.6g} {parameter_unit(tree, name)}".rstrip()
            for name, value in parameters(spec).items()
        },
    }


def search_names(names: NamesByKind, pattern: str) -> NamesByKind:
    """Select the names that a pattern matches.

    Args:
        names: As `names_by_kind` returns them.
        pattern: With `*`, `?` or `[...]` it has to match a whole name, else a part of a name.

    Raises:
        InputError: No name matches; the message lists similar names.
    """
    lowercase_pattern = pattern.lower()
    glob = lowercase_pattern if set(lowercase_pattern) & set("*?[") else f"*{lowercase_pattern}*"
    found = {
        kind: {name: text for name, text in values.items() if fnmatchcase(name.lower(), glob)}
        for kind, values in names.items()
    }
    if any(found.values()):
        return found
    name_of_word: dict[str, str] = {}  # first name that contains a word
    for name in [name for values in names.values() for name in values]:
        for word in (name, *name.split("."), *name.replace("_", ".").split(".")):
            name_of_word.setdefault(word.lower(), name)
    similar_words = get_close_matches(
        lowercase_pattern.strip("*?[]"), name_of_word, _MAX_SUGGESTIONS, _MIN_SIMILARITY
    )
    suggestions = list(dict.fromkeys(repr(name_of_word[word]) for word in similar_words))
    hint = (
        f"did you mean {' or '.join(suggestions)}?"
        if suggestions
        else "leave it out for all parameters"
    )
    raise InputError(f"nothing is called like '{pattern}', {hint}")
