"""Equality constraints of MJCF as loops and couplings."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin

from crane.common.errors import DescriptionError
from crane.description.specification import Coupling, LoopSpec
from crane.formats.mjcf.joint_effects import fixed_tendon_factors
from crane.formats.mjcf.mujoco_file import MujocoFile

_DISTANCE_TOLERANCE = 1e-9  # relative difference of two distances that counts as none
_TORQUE_SCALE_INDEX = 10  # its place among the numbers of a weld
_Z = (0.0, 0.0, 1.0)


@dataclass
class MjcfFrames:
    """Frames that sites and equality constraints put on bodies.

    Attributes:
        used_names: Names of links.
        placements: Body and placement of each frame.
        source_locations: Where it was written.
        link_of_site: Link of each site.
    """

    used_names: set[str]
    placements: dict[str, tuple[int, pin.SE3]] = field(default_factory=dict)
    source_locations: dict[str, str] = field(default_factory=dict)
    link_of_site: dict[int, str] = field(default_factory=dict)

    def add(self, name: str, body: int, placement: pin.SE3, source_location: str) -> str:
        """A frame, under a name that no link has yet."""
        while name in self.used_names:
            name += "_"
        self.used_names.add(name)
        self.placements[name], self.source_locations[name] = (body, placement), source_location
        return name

    def remove_axis_site(self, link: str | None) -> None:
        """Forget a site that only shows the direction of a hinge, as a written file has it."""
        if link is not None and link.endswith("_axis"):
            self.placements.pop(link, None)


@dataclass(frozen=True)
class _ConstraintEnd:
    """One end of a constraint: body and placement on it, and the site if it is one."""

    body: int
    placement: pin.SE3
    link: str | None


def read_equality_constraints(
    mjcf: MujocoFile, frames: MjcfFrames, series_joints: Mapping[int, list[str]]
) -> tuple[tuple[LoopSpec, ...], tuple[Coupling, ...]]:
    """Loops and couplings of the equality constraints that are switched on.

    `connect` is a spherical loop, `weld` a fixed one, or a spherical one if its `torquescale` is
    zero. Two `connect` of the same two bodies, at points with the same distance on both, are a
    hinge about the line through them: they become one revolute loop, whose five equations say the
    same as their six. What a program moves (mocap) is no part of a machine, so constraints to it
    are left out, and those within one body.

    Args:
        mjcf: The file.
        frames: To which the ends of the loops are added.
        series_joints: Joints that each joint of MuJoCo became.

    Raises:
        DescriptionError: A constraint is not linear in joints, or of another type.
    """
    model = mjcf.model
    loops: list[LoopSpec] = []
    couplings: list[Coupling] = []
    names: set[str] = set()
    pending_connects: list[tuple[str, str, _ConstraintEnd, _ConstraintEnd]] = []
    for index in range(model.neq):
        kind = mjcf.enumeration_name("Eq", model.eq_type[index])
        source_location = mjcf.equality_location(index)
        name = mjcf.element_name("EQUALITY", index).strip() or f"{kind.lower()}{index + 1}"
        if not model.eq_active0[index]:
            mjcf.note_unsupported("constraints that are switched off", name)
            continue
        if kind in ("CONNECT", "WELD") and _is_without_effect(mjcf, index, name):
            continue
        while name in names:
            name += "_"
        names.add(name)
        if kind == "CONNECT":
            pending_connects.append(
                (name, source_location, *_constraint_ends(mjcf, frames, index, kind))
            )
        elif kind == "WELD":
            first, second = _constraint_ends(mjcf, frames, index, kind)
            fixes_rotation = model.eq_data[index, _TORQUE_SCALE_INDEX] != 0
            loop_type = "fixed" if fixes_rotation else "spherical"
            loops.append(_create_loop(name, loop_type, first, second, frames, source_location))
        elif kind == "JOINT":
            sums = [[(i, 1.0)] if i >= 0 else [] for i in _constrained_objects(model, index)]
            couplings.append(
                _create_coupling(mjcf, name, source_location, sums, index, series_joints)
            )
        elif kind == "TENDON":
            sums = [
                _tendon_terms(mjcf, i, name, source_location)
                for i in _constrained_objects(model, index)
            ]
            couplings.append(
                _create_coupling(mjcf, name, source_location, sums, index, series_joints)
            )
        else:
            raise DescriptionError(
                f"{source_location}: the constraint '{name}' is a {kind.lower()}, which no "
                f"machine has, use "
                "connect, weld, joint or tendon"
            )
    return tuple(_combine_connects(pending_connects, frames) + loops), tuple(couplings)


def _constrained_objects(model: Any, index: int) -> tuple[int, int]:
    return int(model.eq_obj1id[index]), int(model.eq_obj2id[index])


def _constrained_bodies(model: Any, kind: str, objects: tuple[int, int]) -> list[int]:
    """The bodies that a connect or weld joins."""
    return [int(model.site_bodyid[x]) if kind == "SITE" else x for x in objects]


def _is_without_effect(mjcf: MujocoFile, index: int, name: str) -> bool:
    """Whether a connect or weld binds nothing of the machine, which is noted."""
    model = mjcf.model
    kind = mjcf.enumeration_name("Obj", model.eq_objtype[index])
    bodies = _constrained_bodies(model, kind, _constrained_objects(model, index))
    if any(model.body_mocapid[body] >= 0 for body in bodies):
        mjcf.note_unsupported("constraints to what a program moves (mocap)", name)
        return True
    if len({int(model.body_weldid[body]) for body in bodies}) == 1:
        mjcf.note_unsupported("constraints within one body", name)
        return True
    return False


def _constraint_ends(
    mjcf: MujocoFile, frames: MjcfFrames, index: int, kind: str
) -> tuple[_ConstraintEnd, _ConstraintEnd]:
    """Both ends of a connect or weld, as MuJoCo compares them."""
    model, data = mjcf.model, mjcf.model.eq_data[index]
    objects = _constrained_objects(model, index)
    if mjcf.enumeration_name("Obj", model.eq_objtype[index]) == "SITE":
        first, second = (
            _ConstraintEnd(
                int(model.site_bodyid[site]),
                pin.SE3(_rotation_matrix(model.site_quat[site]), model.site_pos[site].copy()),
                frames.link_of_site[site],
            )
            for site in objects
        )
        return first, second
    if kind == "CONNECT":
        placements = [pin.SE3(np.eye(3), data[i : i + 3].copy()) for i in (0, 3)]
    else:
        placements = [
            pin.SE3(_rotation_matrix(data[6:10]), data[3:6].copy()),
            pin.SE3(np.eye(3), data[:3].copy()),
        ]
    first, second = (
        _ConstraintEnd(body, place, None) for body, place in zip(objects, placements, strict=True)
    )
    return first, second


def _rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    w, x, y, z = (float(value) for value in quaternion / np.linalg.norm(quaternion))
    return np.asarray(pin.Quaternion(w, x, y, z).toRotationMatrix())


def _create_loop(
    name: str,
    kind: str,
    first: _ConstraintEnd,
    second: _ConstraintEnd,
    frames: MjcfFrames,
    source_location: str,
) -> LoopSpec:
    links = [
        end.link or frames.add(f"{name}_{side}", end.body, end.placement, source_location)
        for side, end in (("predecessor", first), ("successor", second))
    ]
    return LoopSpec(name, kind, links[0], links[1], _Z, source_location)


def _combine_connects(
    connects: list[tuple[str, str, _ConstraintEnd, _ConstraintEnd]], frames: MjcfFrames
) -> list[LoopSpec]:
    """Spherical loops, and revolute ones where two say so."""
    pairs: dict[tuple[int, int], list[int]] = {}
    for i, (_, _, one, two) in enumerate(connects):
        pairs.setdefault((one.body, two.body), []).append(i)
    found: dict[int, LoopSpec] = {}
    for indices in pairs.values():
        if (
            len(indices) == 2
            and (hinge := _combine_two_connects(connects, indices, frames)) is not None
        ):
            found[indices[0]] = hinge
            continue
        for i in indices:
            name, where, one, two = connects[i]
            found[i] = _create_loop(name, "spherical", one, two, frames, where)
    return [found[i] for i in sorted(found)]


def _combine_two_connects(
    connects: list[tuple[str, str, _ConstraintEnd, _ConstraintEnd]],
    indices: list[int],
    frames: MjcfFrames,
) -> LoopSpec | None:
    """The revolute loop of two connected points, if it is one."""
    (name, where, *first_ends), (other, _, *second_ends) = (connects[i] for i in indices)
    lines = [
        second.placement.translation - first.placement.translation
        for first, second in zip(first_ends, second_ends, strict=True)
    ]
    length = [float(np.linalg.norm(line)) for line in lines]
    if not min(length) > 0 or abs(length[1] - length[0]) > _DISTANCE_TOLERANCE * length[0]:
        return None
    shared = os.path.commonprefix([name, other]).rstrip("_") or name
    axes = [
        first.placement.rotation.T @ line for first, line in zip(first_ends, lines, strict=True)
    ]
    if (
        all(first.link for first in first_ends)
        and np.abs(axes[1] - axes[0]).max() < _DISTANCE_TOLERANCE * length[0]
    ):
        for second in second_ends:
            frames.remove_axis_site(second.link)
        x, y, z = (float(value) for value in _round_to_frame_axis(axes[0] / length[0]))
        links = [str(first.link) for first in first_ends]
        return LoopSpec(shared, "revolute", links[0], links[1], (x, y, z), where)
    ends = [
        _ConstraintEnd(
            first.body, pin.SE3(_rotation_along(line), first.placement.translation), None
        )
        for first, line in zip(first_ends, lines, strict=True)
    ]
    return _create_loop(shared, "revolute", ends[0], ends[1], frames, where)


def _round_to_frame_axis(axis: np.ndarray) -> np.ndarray:
    """An axis along a direction of its frame, where it is one to rounding."""
    nearest = np.round(axis)
    return nearest + 0.0 if np.abs(axis - nearest).max() < 1e-12 else axis


def _rotation_along(direction: np.ndarray) -> np.ndarray:
    """A rotation whose third column points along a line."""
    third = direction / np.linalg.norm(direction)
    first = np.cross(np.eye(3)[np.argmin(np.abs(third))], third)
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(third, first), third])


def _tendon_terms(
    mjcf: MujocoFile, tendon: int, name: str, source_location: str
) -> list[tuple[int, float]]:
    """Joints of a fixed tendon and their factors; none for the tendon that is not there."""
    if tendon < 0:
        return []
    factors = fixed_tendon_factors(mjcf, tendon)
    if factors is None:
        raise DescriptionError(
            f"{source_location}: the constraint '{name}' is about a tendon in space, use a "
            f"fixed one"
        )
    return list(factors.items())


def _create_coupling(
    mjcf: MujocoFile,
    name: str,
    source_location: str,
    joint_sums: list[list[tuple[int, float]]],
    index: int,
    series_joints: Mapping[int, list[str]],
) -> Coupling:
    """The coupling y - y_0 = a_0 + a_1 (x - x_0), x and y sums of factor times joint."""
    model = mjcf.model
    constant_coefficient, linear_coefficient, *higher_coefficients = (
        float(x) for x in model.eq_data[index, :5]
    )
    if any(higher_coefficients) and joint_sums[1]:
        raise DescriptionError(
            f"{source_location}: the constraint '{name}' is not linear, leave the higher powers "
            f"of its "
            "polycoef away"
        )
    factors: dict[str, float] = {}
    offset = constant_coefficient
    for joints, sign in zip(joint_sums, (1.0, -linear_coefficient), strict=True):
        for joint, factor in joints:
            (part,) = series_joints[joint]
            factors[part] = factors.get(part, 0.0) + sign * factor
            offset += sign * factor * float(model.qpos0[model.jnt_qposadr[joint]])
    factors = {part: factor for part, factor in factors.items() if factor}
    if not factors:
        raise DescriptionError(
            f"{source_location}: the constraint '{name}' binds no joint, remove it"
        )
    return Coupling(name, factors, offset, source_location)
