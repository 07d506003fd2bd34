"""Equality constraints of MJCF as loops and couplings."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin

from crane.common.errors import DescriptionError
from crane.description.spec import Coupling, LoopSpec
from crane.formats.mjcf.acting import fixed_tendon
from crane.formats.mjcf.file import MujocoFile

_SAME = 1e-9  # relative difference of two distances that counts as none
_TORQUE_SCALE = 10  # its place among the numbers of a weld
_Z = (0.0, 0.0, 1.0)


@dataclass
class Frames:
    """Frames that sites and equality constraints put on bodies.

    Attributes:
        taken: Names of links.
        made: Body and placement of each frame.
        where: Where it was written.
        sites: Link of each site.
    """

    taken: set[str]
    made: dict[str, tuple[int, pin.SE3]] = field(default_factory=dict)
    where: dict[str, str] = field(default_factory=dict)
    sites: dict[int, str] = field(default_factory=dict)

    def add(self, name: str, body: int, place: pin.SE3, where: str) -> str:
        """A frame, under a name that no link has yet."""
        while name in self.taken:
            name += "_"
        self.taken.add(name)
        self.made[name], self.where[name] = (body, place), where
        return name

    def drop_helper(self, link: str | None) -> None:
        """Forget a site that only shows the direction of a hinge, as a written file has it."""
        if link is not None and link.endswith("_axis"):
            self.made.pop(link, None)


@dataclass(frozen=True)
class _Anchor:
    """One end of a constraint: body and placement on it, and the site if it is one."""

    body: int
    place: pin.SE3
    link: str | None


def read_equality(
    mjcf: MujocoFile, frames: Frames, parts: Mapping[int, list[str]]
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
        parts: Joints that each joint of MuJoCo became.

    Raises:
        DescriptionError: A constraint is not linear in joints, or of another type.
    """
    model = mjcf.model
    loops: list[LoopSpec] = []
    couplings: list[Coupling] = []
    names: set[str] = set()
    waiting: list[tuple[str, str, _Anchor, _Anchor]] = []
    for index in range(model.neq):
        kind = mjcf.kind("Eq", model.eq_type[index])
        where = mjcf.where_equality(index)
        name = mjcf.name("EQUALITY", index).strip() or f"{kind.lower()}{index + 1}"
        if not model.eq_active0[index]:
            mjcf.lose("constraints that are switched off", name)
            continue
        if kind in ("CONNECT", "WELD") and _idle(mjcf, index, name):
            continue
        while name in names:
            name += "_"
        names.add(name)
        if kind == "CONNECT":
            waiting.append((name, where, *_ends(mjcf, frames, index, kind)))
        elif kind == "WELD":
            one, two = _ends(mjcf, frames, index, kind)
            turns_too = model.eq_data[index, _TORQUE_SCALE] != 0
            style = "fixed" if turns_too else "spherical"
            loops.append(_loop(name, style, one, two, frames, where))
        elif kind == "JOINT":
            sums = [[(i, 1.0)] if i >= 0 else [] for i in _objects(model, index)]
            couplings.append(_coupling(mjcf, name, where, sums, index, parts))
        elif kind == "TENDON":
            sums = [_tendon(mjcf, i, name, where) for i in _objects(model, index)]
            couplings.append(_coupling(mjcf, name, where, sums, index, parts))
        else:
            raise DescriptionError(
                f"{where}: the constraint '{name}' is a {kind.lower()}, which no machine has, use "
                "connect, weld, joint or tendon"
            )
    return tuple(_hinges(waiting, frames) + loops), tuple(couplings)


def _objects(model: Any, index: int) -> tuple[int, int]:
    return int(model.eq_obj1id[index]), int(model.eq_obj2id[index])


def _bodies(model: Any, kind: str, objects: tuple[int, int]) -> list[int]:
    """The bodies that a connect or weld joins."""
    return [int(model.site_bodyid[x]) if kind == "SITE" else x for x in objects]


def _idle(mjcf: MujocoFile, index: int, name: str) -> bool:
    """Whether a connect or weld binds nothing of the machine, which is noted."""
    model = mjcf.model
    kind = mjcf.kind("Obj", model.eq_objtype[index])
    bodies = _bodies(model, kind, _objects(model, index))
    if any(model.body_mocapid[body] >= 0 for body in bodies):
        mjcf.lose("constraints to what a program moves (mocap)", name)
        return True
    if len({int(model.body_weldid[body]) for body in bodies}) == 1:
        mjcf.lose("constraints within one body", name)
        return True
    return False


def _ends(mjcf: MujocoFile, frames: Frames, index: int, kind: str) -> tuple[_Anchor, _Anchor]:
    """Both ends of a connect or weld, as MuJoCo compares them."""
    model, data = mjcf.model, mjcf.model.eq_data[index]
    objects = _objects(model, index)
    if mjcf.kind("Obj", model.eq_objtype[index]) == "SITE":
        one, two = (
            _Anchor(
                int(model.site_bodyid[site]),
                pin.SE3(_turn(model.site_quat[site]), model.site_pos[site].copy()),
                frames.sites[site],
            )
            for site in objects
        )
        return one, two
    if kind == "CONNECT":
        places = [pin.SE3(np.eye(3), data[i : i + 3].copy()) for i in (0, 3)]
    else:
        places = [
            pin.SE3(_turn(data[6:10]), data[3:6].copy()), pin.SE3(np.eye(3), data[:3].copy()),
        ]  # fmt: skip
    one, two = (_Anchor(body, place, None) for body, place in zip(objects, places, strict=True))
    return one, two


def _turn(quaternion: np.ndarray) -> np.ndarray:
    w, x, y, z = (float(value) for value in quaternion / np.linalg.norm(quaternion))
    return np.asarray(pin.Quaternion(w, x, y, z).toRotationMatrix())


def _loop(
    name: str, kind: str, one: _Anchor, two: _Anchor, frames: Frames, where: str
) -> LoopSpec:
    links = [
        end.link or frames.add(f"{name}_{side}", end.body, end.place, where)
        for side, end in (("predecessor", one), ("successor", two))
    ]
    return LoopSpec(name, kind, links[0], links[1], _Z, where)


def _hinges(connects: list[tuple[str, str, _Anchor, _Anchor]], frames: Frames) -> list[LoopSpec]:
    """Spherical loops, and revolute ones where two say so."""
    pairs: dict[tuple[int, int], list[int]] = {}
    for i, (_, _, one, two) in enumerate(connects):
        pairs.setdefault((one.body, two.body), []).append(i)
    found: dict[int, LoopSpec] = {}
    for indices in pairs.values():
        if len(indices) == 2 and (hinge := _hinge(connects, indices, frames)) is not None:
            found[indices[0]] = hinge
            continue
        for i in indices:
            name, where, one, two = connects[i]
            found[i] = _loop(name, "spherical", one, two, frames, where)
    return [found[i] for i in sorted(found)]


def _hinge(
    connects: list[tuple[str, str, _Anchor, _Anchor]], indices: list[int], frames: Frames
) -> LoopSpec | None:
    """The revolute loop of two connected points, if it is one."""
    (name, where, *firsts), (other, _, *seconds) = (connects[i] for i in indices)
    lines = [
        second.place.translation - first.place.translation
        for first, second in zip(firsts, seconds, strict=True)
    ]
    length = [float(np.linalg.norm(line)) for line in lines]
    if not min(length) > 0 or abs(length[1] - length[0]) > _SAME * length[0]:
        return None
    shared = os.path.commonprefix([name, other]).rstrip("_") or name
    axes = [first.place.rotation.T @ line for first, line in zip(firsts, lines, strict=True)]
    if all(first.link for first in firsts) and np.abs(axes[1] - axes[0]).max() < _SAME * length[0]:
        for second in seconds:
            frames.drop_helper(second.link)
        x, y, z = (float(value) for value in _rounded(axes[0] / length[0]))
        links = [str(first.link) for first in firsts]
        return LoopSpec(shared, "revolute", links[0], links[1], (x, y, z), where)
    ends = [
        _Anchor(first.body, pin.SE3(_along(line), first.place.translation), None)
        for first, line in zip(firsts, lines, strict=True)
    ]
    return _loop(shared, "revolute", ends[0], ends[1], frames, where)


def _rounded(axis: np.ndarray) -> np.ndarray:
    """An axis along a direction of its frame, where it is one to rounding."""
    nearest = np.round(axis)
    return nearest + 0.0 if np.abs(axis - nearest).max() < 1e-12 else axis


def _along(line: np.ndarray) -> np.ndarray:
    """A rotation whose third column points along a line."""
    third = line / np.linalg.norm(line)
    first = np.cross(np.eye(3)[np.argmin(np.abs(third))], third)
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(third, first), third])


def _tendon(mjcf: MujocoFile, tendon: int, name: str, where: str) -> list[tuple[int, float]]:
    """Joints of a fixed tendon and their factors; none for the tendon that is not there."""
    if tendon < 0:
        return []
    factors = fixed_tendon(mjcf, tendon)
    if factors is None:
        raise DescriptionError(
            f"{where}: the constraint '{name}' is about a tendon in space, use a fixed one"
        )
    return list(factors.items())


def _coupling(
    mjcf: MujocoFile,
    name: str,
    where: str,
    sums: list[list[tuple[int, float]]],
    index: int,
    parts: Mapping[int, list[str]],
) -> Coupling:
    """The coupling y - y_0 = a_0 + a_1 (x - x_0), x and y sums of factor times joint."""
    model = mjcf.model
    start, slope, *higher = (float(x) for x in model.eq_data[index, :5])
    if any(higher) and sums[1]:
        raise DescriptionError(
            f"{where}: the constraint '{name}' is not linear, leave the higher powers of its "
            "polycoef away"
        )
    factors: dict[str, float] = {}
    offset = start
    for joints, sign in zip(sums, (1.0, -slope), strict=True):
        for joint, factor in joints:
            (part,) = parts[joint]
            factors[part] = factors.get(part, 0.0) + sign * factor
            offset += sign * factor * float(model.qpos0[model.jnt_qposadr[joint]])
    factors = {part: factor for part, factor in factors.items() if factor}
    if not factors:
        raise DescriptionError(f"{where}: the constraint '{name}' binds no joint, remove it")
    return Coupling(name, factors, offset, where)
