"""Ball joints and floating bases: series of joints that are one joint without singularity.

A joint with three rotations is read as a series of three revolute joints (see
`crane.description.kinematic_tree`), whose Cardan angles are singular where the second is 90
degrees. Unless a spring, an end stop or a coupling acts on one of these angles, the series is one
spherical joint. Its coordinates are the rotation vector r [rad] of the child in the frame of the
joint, R = exp(r x), of length at most pi; its velocities are the relative angular velocity w
[rad/s] in the axes of the child, and its forces moments about these axes [N m]:

    r' = (1 + r x / 2 + c (r x)^2) w,   c = (1 - (t/2) cot(t/2)) / t^2,   t = |r|

(Bullo and Murray 1995), which is regular up to t = 2 pi.

A joint with six degrees of freedom is a series of three translations and three rotations. If it
connects a body to the ground, and nothing acts on its coordinates and no loop contains it, it is
one free-flyer joint: its coordinates are the position p [m] and the rotation vector of the body,
its velocity is the body's twist in the body's axes, V = (linear, angular), with p' = R V_lin.
Forces are a wrench in the same axes.
"""

import dataclasses
from collections.abc import Mapping, Sequence

from crane.common.errors import InputError
from crane.description.kinematic_tree import (
    ROTATIONS,
    Joint,
    Link,
    Tree,
    body_of,
    joint_freedoms,
    joint_series,
    path_to_root,
)
from crane.description.specification import MachineSpec

FLOATING_FREEDOMS = ("x", "y", "z", "rx", "ry", "rz")
ROTATION_COUNT = len(ROTATIONS)
_FIRST_ROTATION = ROTATIONS[0][0]


def composite_joints(spec: MachineSpec) -> dict[str, tuple[str, ...]]:
    """Return the joints of each series that is one joint, in order, by name of that joint.

    Six for a floating base, three for a ball joint.
    """
    found, constrained = floating_bases(spec), _constrained_joints(spec)
    joints, links = spec.tree.joints, spec.tree.links
    for joint in joints.values():
        name = joint.name.removesuffix(f"_{_FIRST_ROTATION}")
        names = tuple(f"{name}_{part}" for part, _, _ in ROTATIONS)
        if joint.name != names[0] or name in found or constrained & set(names):
            continue
        series = [joints[x] for x in names if x in joints]
        between = [part.child for part in series[:-1]]
        if (
            [(x.kind, x.axis) for x in series] == [(kind, axis) for _, kind, axis in ROTATIONS]
            and [(x.parent, *x.xyz, *x.rpy) for x in series[1:]]
            == [(link, *[0.0] * 6) for link in between]
            and all(links[link].composite_joint is not None for link in between)
        ):
            found[name] = names
    return found


def rotation_series(spec: MachineSpec) -> list[tuple[str, ...]]:
    """Return the three rotations of each floating base and ball joint."""
    return [series[-ROTATION_COUNT:] for series in composite_joints(spec).values()]


def floating_bases(spec: MachineSpec) -> dict[str, tuple[str, ...]]:
    """Return the joints of the series of each floating base, in order, by name of its joint."""
    return {
        name: series
        for name, series in floating_series(spec).items()
        if len(series) == len(FLOATING_FREEDOMS)
    }


def floating_series(spec: MachineSpec) -> dict[str, tuple[str, ...]]:
    """Return the same, and the movable joints of series of which some are locked or missing."""
    series_by_joint: dict[str, list[Joint]] = {}
    for joint in spec.tree.joints.values():
        if joint.floating_joint and joint.is_movable:
            series_by_joint.setdefault(joint.floating_joint, []).append(joint)
    return {
        name: tuple(joint.name for joint in series)
        for name, series in series_by_joint.items()
        if _is_unconstrained(spec, series)
    }


def _constrained_joints(spec: MachineSpec) -> set[str]:
    """Joints whose coordinates springs, end stops or couplings act on."""
    joints = {part.joint for part in spec.force_elements if part.between is None}
    joints |= {part.joint for part in spec.end_stops}
    return joints | {joint for coupling in spec.couplings for joint in coupling.joints}


def _is_unconstrained(spec: MachineSpec, series: list[Joint]) -> bool:
    """Whether a series connects a body to the ground and nothing else acts on it."""
    parent_joints = spec.tree.parent_joints
    if body_of(parent_joints, series[0].parent) in parent_joints:
        return False  # another body carries it
    driven_joints = set(spec.active or ()) - set(spec.free)
    driven_joints |= {joint for drive in spec.drives for joint in drive.factors}
    if {joint.name for joint in series} & (_constrained_joints(spec) | driven_joints):
        return False
    return not any(
        _carries_link(parent_joints, loop.predecessor, series[-1].child)
        != _carries_link(parent_joints, loop.successor, series[-1].child)
        for loop in spec.loops
    )


def _carries_link(parent_joints: Mapping[str, Joint], link: str, body: str) -> bool:
    return any(joint.child == body for joint in path_to_root(parent_joints, link))


def with_rotation_vectors(spec: MachineSpec) -> MachineSpec:
    """Return a machine with rotation vectors in place of the Cardan angles R_x R_y R_z of home."""
    from scipy.spatial.transform import Rotation

    home = dict(spec.home)
    for rotations in rotation_series(spec):
        angles = [home.pop(name, 0.0) for name in rotations]
        rotation_vector = Rotation.from_euler("XYZ", angles).as_rotvec().tolist()
        home |= {name: x for name, x in zip(rotations, rotation_vector, strict=True) if x}
    return dataclasses.replace(spec, home=home)


def convert_locked_rotations(
    spec: MachineSpec, lock: Mapping[str, float]
) -> tuple[MachineSpec, Mapping[str, float]]:
    """Convert home and locks of ball joints and floating bases that lose joints by locking.

    Three rotations locked together are a rotation vector, as the coordinates are. Remaining
    rotations, and one or two that are locked alone, become Cardan angles.
    """
    from scipy.spatial.transform import Rotation

    home, locked = dict(spec.home), dict(lock)
    for rotations in rotation_series(spec):
        if not locked.keys() & set(rotations):
            continue
        all_locked = locked.keys() >= set(rotations)
        values = locked if all_locked else home
        rotation_vector = [values.get(name, 0.0) for name in rotations]
        angles = Rotation.from_rotvec(rotation_vector).as_euler("XYZ").tolist()
        values |= dict(zip(rotations, angles, strict=True))
    return dataclasses.replace(spec, home=home), locked


def add_floating_base(spec: MachineSpec, freedoms: bool | Sequence[str] = True) -> MachineSpec:
    """Return a machine whose root floats by joints base_x to base_rz instead of being fixed.

    A machine with a floating base is returned unchanged.

    Args:
        spec: The machine.
        freedoms: Those of `FLOATING_FREEDOMS` that it has; True for all.
    """
    if not freedoms or floating_series(spec):
        return spec
    return dataclasses.replace(
        spec,
        tree=add_base_joints(
            spec.tree, FLOATING_FREEDOMS if freedoms is True else check_freedoms(freedoms)
        ),
    )


def check_freedoms(names: object) -> tuple[str, ...]:
    """Return degrees of freedom of a root in the order of `FLOATING_FREEDOMS`.

    Raises:
        InputError: A name is unknown.
    """
    if (
        isinstance(names, str)
        or not isinstance(names, Sequence)
        or not set(names) <= set(FLOATING_FREEDOMS)
    ):
        raise InputError(
            f"floating is {names!r}, give True or some of {', '.join(FLOATING_FREEDOMS)}"
        )
    return tuple(part for part in FLOATING_FREEDOMS if part in names)


def add_base_joints(tree: Tree, freedoms: Sequence[str]) -> Tree:
    """Return a tree whose root has some of `FLOATING_FREEDOMS`, by joints base_x to base_rz."""
    root = tree.root_link
    used_names = {*tree.links, *tree.joints}
    name = "base"
    while used_names & {
        f"{name}_{part}"
        for part in (*FLOATING_FREEDOMS, *range(1, len(FLOATING_FREEDOMS)), "ground")
    }:
        name += "_"
    ground = f"{name}_ground"
    where = tree.links[root].source_location
    series = joint_series(
        name,
        [freedom for freedom in joint_freedoms("floating", ()) if freedom[0] in freedoms],
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        (ground, root),
        where,
    )
    parts = [
        dataclasses.replace(part, floating_joint=name) if isinstance(part, Joint) else part
        for part in series
    ]
    # the ground first, because it is the new root
    return Tree({ground: Link(ground, where)}, {}).with_parts(*tree, *parts)
