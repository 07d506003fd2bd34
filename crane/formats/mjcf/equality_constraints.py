"""Equality constraints of MJCF as loops and couplings."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from crane.common.errors import DescriptionError
from crane.description.kinematic_tree import Z_AXIS, to_vector, unique_name
from crane.description.specification import Coupling, LoopSpec
from crane.formats.mjcf.model_features import fixed_tendon_factors
from crane.formats.mjcf.mujoco_file import MujocoFile, pose

_DISTANCE_TOLERANCE = 1e-9  # relative
_TORQUE_SCALE_INDEX = 10  # of torquescale in the data of a weld


@dataclass
class MjcfFrames:
    """Frames on bodies, at sites and ends of equality constraints.

    Attributes:
        used_names: Names of all links.
        placements: Index of the body, placement on it, and file and line, by frame.
        link_of_site: Name of the link by site.
    """

    used_names: set[str]
    placements: dict[str, tuple[int, pin.SE3, str]] = field(default_factory=dict)
    link_of_site: dict[int, str] = field(default_factory=dict)

    def add(self, name: str, body: int, placement: pin.SE3, source_location: str) -> str:
        """Add a frame under a name that no link has, and return the name."""
        name = unique_name(name, self.used_names)
        self.used_names.add(name)
        self.placements[name] = body, placement, source_location
        return name


@dataclass(frozen=True)
class _ConstraintEnd:
    """One end of a constraint: index of the body, placement on it, and link if it is a site."""

    body: int
    placement: pin.SE3
    link: str | None


def read_equality_constraints(
    mjcf: MujocoFile, frames: MjcfFrames, series_joints: Mapping[int, list[str]]
) -> tuple[tuple[LoopSpec, ...], tuple[Coupling, ...]]:
    """Read the active equality constraints as loops and couplings.

    A `connect` is a spherical loop. A `weld` is a fixed loop, or a spherical one if its
    `torquescale` is zero. Two `connect` of the same two bodies at points with equal distances on
    both are a hinge about the line through the points: they become one revolute loop, whose five
    equations are equivalent to their six. Constraints to mocap bodies, which a program moves, and
    within one body are left out.

    Args:
        mjcf: The file.
        frames: Receives the frames at the ends of the loops.
        series_joints: Names of the joints of the machine by joint of MuJoCo.

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
        ends = _constraint_ends(mjcf, frames, index, kind)
        if any(model.body_mocapid[end.body] >= 0 for end in ends):
            mjcf.note_unsupported("constraints to what a program moves (mocap)", name)
            continue
        if len({int(model.body_weldid[end.body]) for end in ends}) == 1:
            mjcf.note_unsupported("constraints within one body", name)
            continue
        name = unique_name(name, names)
        names.add(name)
        if kind not in ("CONNECT", "WELD", "JOINT", "TENDON"):
            raise DescriptionError(
                f"{source_location}: the constraint '{name}' is a {kind.lower()}, which no "
                "machine has, use connect, weld, joint or tendon"
            )
        if kind == "CONNECT":
            pending_connects.append((name, source_location, ends[0], ends[1]))
        if kind == "WELD":
            loop_type = (
                "fixed" if (model.eq_data[index, _TORQUE_SCALE_INDEX] != 0) else "spherical"
            )
            loops.append(_create_loop(name, loop_type, ends[0], ends[1], frames, source_location))
        if kind in ("JOINT", "TENDON"):
            couplings.append(
                _create_coupling(mjcf, name, source_location, kind, index, series_joints)
            )
    return tuple(_combine_connects(pending_connects, frames) + loops), tuple(couplings)


def _constraint_ends(
    mjcf: MujocoFile, frames: MjcfFrames, index: int, kind: str
) -> list[_ConstraintEnd]:
    """Return both ends of a connect or weld, none of other constraints."""
    model, data = mjcf.model, mjcf.model.eq_data[index]
    objects = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
    if kind not in ("CONNECT", "WELD"):
        return []
    if mjcf.enumeration_name("Obj", model.eq_objtype[index]) == "SITE":
        return [
            _ConstraintEnd(
                int(model.site_bodyid[site]),
                pose(model.site_quat[site], model.site_pos[site]),
                frames.link_of_site[site],
            )
            for site in objects
        ]
    placements = [pose(data[6:10], data[3:6]), pin.SE3(np.eye(3), data[:3].copy())]
    if kind == "CONNECT":
        placements = [pin.SE3(np.eye(3), data[i : i + 3].copy()) for i in (0, 3)]
    return [_ConstraintEnd(*end, None) for end in zip(objects, placements, strict=True)]


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
    return LoopSpec(name, kind, links[0], links[1], Z_AXIS, source_location)


def _combine_connects(
    connects: list[tuple[str, str, _ConstraintEnd, _ConstraintEnd]], frames: MjcfFrames
) -> list[LoopSpec]:
    """Return spherical loops, and revolute loops where two connects define a hinge."""
    pairs: dict[tuple[int, int], list[int]] = {}
    for i, (_, _, one, two) in enumerate(connects):
        pairs.setdefault((one.body, two.body), []).append(i)
    found: dict[int, LoopSpec] = {}
    for indices in pairs.values():
        hinge = _combine_two_connects(connects, indices, frames) if len(indices) == 2 else None
        if hinge is not None:
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
    """Return the revolute loop of two connects, None if they define none."""
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
    is_one_axis = np.abs(axes[1] - axes[0]).max() < _DISTANCE_TOLERANCE * length[0]
    if all(first.link for first in first_ends) and is_one_axis:
        # sites that only define an axis, as written files have them
        for site in [x.link for x in second_ends if x.link and x.link.endswith("_axis")]:
            frames.placements.pop(site, None)
        axis = axes[0] / length[0]
        nearest = np.round(axis)
        if np.abs(axis - nearest).max() < 1e-12:  # along an axis of the frame
            axis = nearest
        links = [str(first.link) for first in first_ends]
        return LoopSpec(shared, "revolute", links[0], links[1], to_vector(axis), where)
    rotations = [pin.Quaternion.FromTwoVectors(np.array(Z_AXIS), line).matrix() for line in lines]
    ends = [
        _ConstraintEnd(first.body, pin.SE3(rotation, first.placement.translation), None)
        for first, rotation in zip(first_ends, rotations, strict=True)
    ]
    return _create_loop(shared, "revolute", ends[0], ends[1], frames, where)


def _create_coupling(
    mjcf: MujocoFile,
    name: str,
    source_location: str,
    kind: str,
    index: int,
    series_joints: Mapping[int, list[str]],
) -> Coupling:
    """Return the coupling y - y_0 = sum a_k (x - x_0)^k, where x and y are joints or tendons."""
    model, label = mjcf.model, f"{source_location}: the constraint '{name}'"
    joint_sums: list[dict[int, float]] = []  # of y and x, none for an absent object
    for i in (int(model.eq_obj1id[index]), int(model.eq_obj2id[index])):
        terms: dict[int, float] | None = {i: 1.0} if i >= 0 else {}
        if kind == "TENDON" and i >= 0:
            terms = fixed_tendon_factors(mjcf, i)
        if terms is None:
            raise DescriptionError(f"{label} is about a tendon in space, use a fixed one")
        joint_sums.append(terms)
    coefficients = [float(x) for x in model.eq_data[index, :5]]
    y, x = joint_sums
    if not x:
        coefficients[1:] = [0.0] * 4
    if any(coefficients[2:]) and len(x) > 1:
        raise DescriptionError(
            f"{label} has higher powers of a tendon of {len(x)} joints, give it one joint"
        )
    y_0, x_0 = (
        sum(
            factor * float(model.qpos0[model.jnt_qposadr[joint]])
            for joint, factor in terms.items()
        )
        for terms in joint_sums
    )
    # in powers of x instead of x - x_0
    shifted = np.polynomial.Polynomial(coefficients)(np.polynomial.Polynomial([-x_0, 1.0])).coef
    shifted = np.append(shifted, np.zeros(5 - len(shifted)))
    offset = float(shifted[0]) + y_0
    factors: dict[str, float] = {}
    for factor_by_joint, sign in ((y, 1.0), (x, -float(shifted[1]))):
        for joint, factor in factor_by_joint.items():
            (part,) = series_joints[joint]
            factors[part] = factors.get(part, 0.0) + sign * factor
    powers = {
        series_joints[joint][0]: tuple(-float(shifted[k]) * factor**k for k in (2, 3, 4))
        for joint, factor in (x.items() if shifted[2:].any() else ())
    }
    factors = {part: factor for part, factor in factors.items() if factor}
    if not factors:
        raise DescriptionError(f"{label} binds no joint, remove it")
    return Coupling(name, factors, offset, source_location, powers)
