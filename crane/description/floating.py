"""Bodies that float: which series of six freedoms at the root are one joint without singularity.

A joint with six freedoms is read as a series of three slides and three turns (see
`crane.formats.series`), whose Cardan angles have a singularity at a pitch of 90 degrees. Where
such a series carries a body from the ground, and no loop, coupling, spring or drive acts on it,
its place need not be solved for: the series is one free-flyer then, with coordinates and
velocities of its own.

Its coordinates are the place p [m] and the rotation vector r [rad] of the body, R = exp(r x), of a
length of at most pi; its velocities the body's twist in the body's axes, V = (linear, angular):

    p' = R V_lin,   r' = (1 + r x / 2 + c (r x)^2) V_ang,   c = (1 - (t/2) cot(t/2)) / t^2, t = |r|

(Bullo and Murray 1995), which is regular up to t = 2 pi. Forces are a wrench in the same axes.
"""

import dataclasses
from collections.abc import Mapping, Sequence

from crane.common.errors import InputError
from crane.description.spec import MachineSpec
from crane.description.tree import Joint, Link, Tree

PARTS = ("x", "y", "z", "rx", "ry", "rz")


def flyers(spec: MachineSpec) -> dict[str, tuple[str, ...]]:
    """By name of each joint with six freedoms that floats the joints of its series, in order."""
    return {name: part for name, part in afloat(spec).items() if len(part) == len(PARTS)}


def afloat(spec: MachineSpec) -> dict[str, tuple[str, ...]]:
    """The same, and what moves of series of which some freedoms are locked or not there."""
    groups: dict[str, list[Joint]] = {}
    for joint in spec.tree.joints.values():
        if joint.floats and joint.moves:
            groups.setdefault(joint.floats, []).append(joint)
    found = {}
    for name, series in groups.items():
        if _is_free(spec, series):
            found[name] = tuple(joint.name for joint in series)
    return found


def _is_free(spec: MachineSpec, series: list[Joint]) -> bool:
    """Whether a series carries a body from the ground that nothing else holds."""
    above = {joint.child: joint for joint in spec.tree.joints.values()}
    at = series[0].parent
    while at in above:
        if above[at].moves:
            return False  # it rides on another body
        at = above[at].parent
    names = {joint.name for joint in series}
    forced = {part.joint for part in spec.elements if part.between is None}
    forced |= {part.joint for part in spec.end_stops}
    driven = set(spec.active or ()) - set(spec.free)
    driven |= {joint for drive in spec.drives for joint in drive.factors}
    bound = {joint for coupling in spec.couplings for joint in coupling.factors}
    if names & (forced | driven | bound):
        return False
    return not any(
        _rides(above, loop.predecessor, series[-1].child)
        != _rides(above, loop.successor, series[-1].child)
        for loop in spec.loops
    )


def _rides(above: Mapping[str, Joint], link: str, body: str) -> bool:
    """Whether a body carries a link."""
    seen = set()
    while link != body and link in above and link not in seen:
        seen.add(link)
        link = above[link].parent
    return link == body


def with_rotation_vectors(spec: MachineSpec) -> MachineSpec:
    """A machine whose home has Cardan angles, R_x R_y R_z, of bodies that turn out to float."""
    from scipy.spatial.transform import Rotation

    home = dict(spec.home)
    for series in flyers(spec).values():
        turns = series[3:]
        angles = [home.pop(name, 0.0) for name in turns]
        vector = Rotation.from_euler("XYZ", angles).as_rotvec().tolist()
        home |= {name: x for name, x in zip(turns, vector, strict=True) if x}
    return dataclasses.replace(spec, home=home)


def grounded(
    spec: MachineSpec, lock: Mapping[str, float]
) -> tuple[MachineSpec, Mapping[str, float]]:
    """Home and locks of series that no longer float once some of their joints are locked.

    Three turns locked together are a rotation vector, as the coordinates are; what is left of
    them, and one or two that are locked alone, are Cardan angles.
    """
    from scipy.spatial.transform import Rotation

    home, held = dict(spec.home), dict(lock)
    for series in flyers(spec).values():
        turns = series[3:]
        if not held.keys() & set(series):
            continue
        all_held = held.keys() >= set(turns)
        values = held if all_held else home
        vector = [values.get(name, 0.0) for name in turns]
        angles = Rotation.from_rotvec(vector).as_euler("XYZ").tolist()
        values |= dict(zip(turns, angles, strict=True))
    return dataclasses.replace(spec, home=home), held


def floated(spec: MachineSpec, freedoms: bool | Sequence[str] = True) -> MachineSpec:
    """A machine whose root floats instead of standing on the ground, by base_x to base_rz.

    A machine that floats already stays as it is.

    Args:
        spec: The machine.
        freedoms: Those of `PARTS` that it has; True for all.
    """
    if not freedoms or afloat(spec):
        return spec
    parts = PARTS if freedoms is True else freedoms_of(freedoms)
    return dataclasses.replace(spec, tree=afloat_tree(spec.tree, parts))


def freedoms_of(names: object) -> tuple[str, ...]:
    """Freedoms of a root in the order of `PARTS`.

    Raises:
        InputError: Names that are none of those.
    """
    if isinstance(names, str) or not isinstance(names, Sequence) or not set(names) <= set(PARTS):
        raise InputError(f"floating is {names!r}, give True or some of {', '.join(PARTS)}")
    return tuple(part for part in PARTS if part in names)


def afloat_tree(tree: Tree, parts: Sequence[str]) -> Tree:
    """A tree whose root has some of the `PARTS`, by joints base_x to base_rz."""
    root = tree.root
    taken = {*tree.links, *tree.joints}
    name = "base"
    while taken & {f"{name}_{part}" for part in (*PARTS, *range(1, len(PARTS)), "ground")}:
        name += "_"
    ground = f"{name}_ground"
    where = tree.links[root].where
    links = [Link(ground, where)]
    links += [Link(f"{name}_{i}", where, between=name) for i in range(1, len(parts))]
    ends = [ground, *(link.name for link in links[1:]), root]
    joints = []
    for i, part in enumerate(parts):
        kind = "revolute" if part.startswith("r") else "prismatic"
        axis = [0.0, 0.0, 0.0]
        axis["xyz".index(part[-1])] = 1.0
        joints.append(
            Joint(
                f"{name}_{part}", kind, ends[i], ends[i + 1], where,
                axis=(axis[0], axis[1], axis[2]), floats=name,
            )
        )  # fmt: skip
    # the ground first: it is the root now
    return Tree({links[0].name: links[0]}, {}).replacing(*tree, *links[1:], *joints)
