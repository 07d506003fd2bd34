"""What a machine's joints, frames, columns and parameters are called, and which are meant."""

from difflib import get_close_matches
from fnmatch import fnmatchcase

from crane.common.errors import InputError
from crane.description.parameter_changes import parameters
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

_MAX_SUGGESTIONS, _MIN_SIMILARITY = (
    5,
    0.6,
)  # names that are proposed at most, and their likeness at least

NameTexts = dict[str, dict[str, str]]  # what is to be said of a thing by its kind and name


def names_by_kind(spec: MachineSpec) -> NameTexts:
    """Joints, frames (links and what is fixed on them), columns of recordings, parameters.

    Returns:
        Of each kind what is to be said by name: type, where it is, unit, value.
    """
    tree = spec.tree
    cylinders = {} if spec.hydraulics is None else spec.hydraulics.cylinders

    def is_available(name: str) -> bool:  # of valves and chambers those that are there
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


def search_names(names: NameTexts, pattern: str) -> NameTexts:
    """Those that a pattern matches: all of a name by `*`, `?` and `[...]`, else a part of it.

    Raises:
        InputError: None does; the message has the nearest.
    """
    lowercase_pattern = pattern.lower()
    glob = lowercase_pattern if set(lowercase_pattern) & set("*?[") else f"*{lowercase_pattern}*"
    found = {
        kind: {name: text for name, text in values.items() if fnmatchcase(name.lower(), glob)}
        for kind, values in names.items()
    }
    if any(found.values()):
        return found
    name_of_word: dict[str, str] = {}  # whole names and their parts, and the first name of each
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
