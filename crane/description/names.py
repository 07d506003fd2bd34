"""What a machine's joints, frames, columns and parameters are called, and which are meant."""

from difflib import get_close_matches
from fnmatch import fnmatchcase

from crane.common.errors import InputError
from crane.description.changes import parameters
from crane.description.number_units import number_unit
from crane.description.sensors import PRESSURE, SIGNAL, SUPPLY, TANK, quantities, unit_of
from crane.description.spec import MachineSpec

_LISTED, _NEAR = 5, 0.6  # names that are proposed at most, and their likeness at least

Names = dict[str, dict[str, str]]  # what is to be said of a thing by its kind and name


def names_of(spec: MachineSpec) -> Names:
    """Joints, frames (links and what is fixed on them), columns of recordings, parameters.

    Returns:
        Of each kind what is to be said by name: type, where it is, unit, value.
    """
    tree = spec.tree
    cylinders = {} if spec.hydraulics is None else spec.hydraulics.cylinders

    def told(name: str) -> bool:  # of valves and chambers those that are there
        heads = PRESSURE, SIGNAL, "spool_"
        head = next((head for head in heads if name.startswith(head)), "")
        rest = name.removeprefix(head)
        if name in (SUPPLY, TANK):
            return bool(cylinders)
        return not head or not cylinders.keys().isdisjoint((rest, rest[:-2]))

    parents = {joint.child: joint for joint in tree.joints.values()}
    return {
        "joint": {joint.name: joint.kind for joint in tree.moving},
        "frame": {
            link: f"{'moved by' if parents[link].moves else 'on'} "
            f"{parents[link].name if parents[link].moves else parents[link].parent}"
            if link in parents
            else "root"
            for link in tree.links
        },
        "column": {name: unit_of(tree, name) or "" for name in quantities(tree) if told(name)},
        "parameter": {
            name: f"{value:.6g} {number_unit(tree, name)}".rstrip()
            for name, value in parameters(spec).items()
        },
    }


def matching(names: Names, pattern: str) -> Names:
    """Those that a pattern matches: all of a name by `*`, `?` and `[...]`, else a part of it.

    Raises:
        InputError: None does; the message has the nearest.
    """
    wanted = pattern.lower()
    glob = wanted if set(wanted) & set("*?[") else f"*{wanted}*"
    found = {
        kind: {name: text for name, text in values.items() if fnmatchcase(name.lower(), glob)}
        for kind, values in names.items()
    }
    if any(found.values()):
        return found
    words: dict[str, str] = {}  # whole names and their parts, and the first name of each
    for name in [name for values in names.values() for name in values]:
        for word in (name, *name.split("."), *name.replace("_", ".").split(".")):
            words.setdefault(word.lower(), name)
    near = get_close_matches(wanted.strip("*?[]"), words, _LISTED, _NEAR)
    meant = list(dict.fromkeys(repr(words[word]) for word in near))
    hint = f"did you mean {' or '.join(meant)}?" if meant else "leave it out for all parameters"
    raise InputError(f"nothing is called like '{pattern}', {hint}")
