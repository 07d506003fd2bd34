"""Search for loops that a description leaves open.

There are three indications: frames that are named as the two ends of a loop (see
`crane.formats.machine_file.structure_sections`), ends of bodies that coincide at home, and a
barrel and a rod on two bodies that point at each other.
"""

import itertools
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from crane.closure.coordinates import Coordinates
from crane.closure.loop_equations import frame_id
from crane.common.samples import Array
from crane.description.kinematic_tree import Z_AXIS, Joint, Vector, to_vector
from crane.description.specification import LoopSpec, MachineSpec
from crane.formats.additions.cylinder_addition import joints_between
from crane.formats.machine_file.structure_sections import loop_end_pairs

# largest gaps relative to the characteristic length, the second without a common normal
_MAX_GAP_SHARE = 0.05
_MAX_GAP_SHARE_WITHOUT_PLANE = 0.01
_MIN_OFFSET_SHARE = 1e-6  # of a frame from its body's origin, relative to the same length
_MAX_DUMMY_MASS = 1e-6  # [kg] that CAD exporters give frames; relative for light machines
_PARALLEL_TOLERANCE = 1e-6  # sine of an angle
_MIN_LOOP_JOINTS = 3  # with fewer joints of the tree a loop would lock them
_BARREL_PATTERN = re.compile(r"barrel|tube|housing|cylinder|cyl", re.IGNORECASE)
_ROD_PATTERN = re.compile(r"piston_?rod|rod|piston|ram|plunger", re.IGNORECASE)


@dataclass(frozen=True)
class LoopProposal:
    """A loop that may be missing.

    Attributes:
        loop: The proposed loop.
        gap: Distance of its frames at home, less the travel of slides at its ends [m].
    """

    loop: LoopSpec
    gap: float

    def __str__(self) -> str:
        """Return an entry of `loops` in a machine file, with the gap as a comment."""
        loop = self.loop
        axis = ", ".join(f"{value:.9g}" for value in loop.axis)
        axis_text = "" if loop.type in ("fixed", "spherical") else f", axis: [{axis}]"
        return (
            f"- {{name: {loop.name}, type: {loop.type}, predecessor: {loop.predecessor}, "
            f"successor: {loop.successor}{axis_text}}}  # {1e3 * self.gap:.3g} mm apart at home"
        )


def propose_loops(spec: MachineSpec, model: pin.Model, q: Array) -> tuple[LoopProposal, ...]:
    """Return loops that are open, first those indicated by names, then by increasing gap.

    Args:
        spec: The machine as read.
        model: Its tree.
        q: (nv,) its home, closed or the initial guess.
    """
    return tuple(_OpenLoopSearch(spec, model, q).find_proposals())


class _OpenLoopSearch:
    """Poses and axes of a tree at home.

    Args:
        spec: The machine as read.
        model: Its tree.
        q: (nv,) configuration.
    """

    def __init__(self, spec: MachineSpec, model: pin.Model, q: Array):
        self.spec = spec
        self.parent_joints = spec.tree.parent_joints
        self.joints_by_parent = spec.tree.joints_by_parent()
        self.bodies = spec.tree.bodies_by_link()
        data = model.createData()
        pin.forwardKinematics(model, data, Coordinates(model).configuration(q))
        self.placements = {
            link: pin.updateFramePlacement(model, data, frame_id(model, link)).copy()
            for link in spec.tree.links
        }
        points = np.array([place.translation for place in self.placements.values()])
        self.characteristic_length = float(np.linalg.norm(np.ptp(points, axis=0)))
        given = (link.inertial for link in spec.tree.links.values())
        self.largest_mass = max((one.mass for one in given if one is not None), default=0.0)

    def find_proposals(self) -> list[LoopProposal]:
        """Return all proposals, at most one for each pair of bodies."""
        proposed: list[LoopProposal] = []
        names = {loop.name for loop in self.spec.loops}
        loop_frames = [(loop.predecessor, loop.successor) for loop in self.spec.loops]
        closed_bodies = {self._bodies_of(pair) for pair in loop_frames}
        used_frames = {frame for pair in loop_frames for frame in pair}

        def frame_distance(proposal: LoopProposal) -> float:
            ends = proposal.loop.predecessor, proposal.loop.successor
            first, second = (self.placements[end].translation for end in ends)
            return float(np.linalg.norm(second - first))

        groups = self._named_proposals(), self._slide_proposals(), self._meeting_proposals()
        for proposal in [x for group in groups for x in sorted(group, key=frame_distance)]:
            ends = {proposal.loop.predecessor, proposal.loop.successor}
            if self._bodies_of(ends) in closed_bodies or ends & used_frames:
                continue
            stem = proposal.loop.name
            numbered = (f"{stem}_{number}" for number in itertools.count(2))
            name = next(x for x in itertools.chain([stem], numbered) if x not in names)
            names.add(name)
            proposed.append(replace(proposal, loop=replace(proposal.loop, name=name)))
            closed_bodies.add(self._bodies_of(ends))
            used_frames |= ends
        return proposed

    def _named_proposals(self) -> Iterator[LoopProposal]:
        for name, first, second in loop_end_pairs(self.spec.tree):
            if len(self._bodies_of((first, second))) < 2:
                continue
            kind, axis = self._loop_type_and_axis(first, second)
            if re.match(r"closed?_?loop", name, re.IGNORECASE):  # example-parallel-robots
                kind, axis = "spherical" if "3d" in name.lower() else "fixed", Z_AXIS
            yield LoopProposal(
                LoopSpec(name, kind, first, second, axis, ""),
                self._gap(first, second),
            )

    def _slide_proposals(self) -> Iterator[LoopProposal]:
        """Yield loops between a barrel and a rod, each on its own pin."""
        links = [
            link
            for link, body in self.bodies.items()
            if not self.joints_by_parent.get(link)
            and body in self.parent_joints
            and self.parent_joints[body].kind == "revolute"
        ]
        rods = {_ROD_PATTERN.sub("", link): link for link in links if _ROD_PATTERN.search(link)}
        for barrel in links:
            rod = (
                rods.get(_BARREL_PATTERN.sub("", barrel))
                if _BARREL_PATTERN.search(barrel)
                else None
            )
            if (
                rod is None
                or rod == barrel
                or len(self._joints_between(barrel, rod)) < _MIN_LOOP_JOINTS
            ):
                continue
            barrel_placement, rod_placement = self.placements[barrel], self.placements[rod]
            vector = rod_placement.translation - barrel_placement.translation
            length = float(np.linalg.norm(vector))
            axes = [
                place.rotation.T @ vector / max(length, 1e-300)
                for place in (barrel_placement, rod_placement)
            ]
            if length > 0 and np.linalg.norm(axes[0] - axes[1]) < _MAX_GAP_SHARE:
                yield LoopProposal(
                    LoopSpec(barrel, "prismatic", barrel, rod, _round_direction(axes[0]), ""),
                    0.0,
                )

    def _meeting_proposals(self) -> Iterator[LoopProposal]:
        """Yield loops between frames that coincide at home or by the travel of a slide."""
        for first, second in self._nearby_pairs():
            if self.joints_by_parent.get(first) and self.joints_by_parent.get(second):
                continue
            gap = self._gap(first, second)
            if (
                gap > _MAX_GAP_SHARE * self.characteristic_length
                or len(self._joints_between(first, second)) < _MIN_LOOP_JOINTS
            ):
                continue
            kind, axis = self._loop_type_and_axis(first, second)
            are_separate_frames = (
                gap <= _MAX_GAP_SHARE_WITHOUT_PLANE * self.characteristic_length
                and self._is_away_from_origin(first)
                and self._is_away_from_origin(second)
            )
            if kind != "spherical" or are_separate_frames:
                yield LoopProposal(LoopSpec(second, kind, first, second, axis, ""), gap)

    def _nearby_pairs(self) -> Iterator[tuple[str, str]]:
        """Yield pairs of frames that are close or can be moved together by slides."""
        frames = [link for link in self.spec.tree.links if self._is_frame(link)]
        points = np.array([self.placements[link].translation for link in frames]).reshape(-1, 3)
        slide_ranges = np.array([self._slide_range(link) for link in frames])
        for i, first in enumerate(frames[:-1]):
            distances = np.linalg.norm(points[i + 1 :] - points[i], axis=1)
            is_near = (
                distances
                <= _MAX_GAP_SHARE * self.characteristic_length
                + slide_ranges[i]
                + slide_ranges[i + 1 :]
            )
            yield from ((first, frames[i + 1 + int(k)]) for k in np.flatnonzero(is_near))

    def _slide_range(self, link: str) -> float:
        """Return the travel [m] of a slide that ends in a link."""
        joint = self.parent_joints.get(self.bodies[link])
        if joint is None or joint.kind != "prismatic":
            return 0.0
        return joint.limits.upper - joint.limits.lower

    def _is_frame(self, link: str) -> bool:
        """Whether a link is a frame without mass, or a slide without child joints."""
        if link in (self.spec.tip, self.spec.tree.root_link):
            return False
        if self.parent_joints[link].is_movable:
            return self.parent_joints[link].kind == "prismatic" and not self.joints_by_parent.get(
                link
            )
        inertial = self.spec.tree.links[link].inertial
        return inertial is None or inertial.mass <= _MAX_DUMMY_MASS * min(1.0, self.largest_mass)

    def _is_away_from_origin(self, link: str) -> bool:
        return bool(
            np.abs(
                self.placements[link].translation - self.placements[self.bodies[link]].translation
            ).max()
            > _MIN_OFFSET_SHARE * self.characteristic_length
        )

    def _bodies_of(self, pair: Collection[str]) -> frozenset[str]:
        return frozenset(self.bodies[link] for link in pair)

    def _joints_between(self, first: str, second: str) -> list[Joint]:
        return sorted(
            joints_between(self.parent_joints, first, second), key=lambda joint: joint.name
        )

    def _gap(self, first: str, second: str) -> float:
        """Return the distance of two links, less the travel of a slide that ends in one."""
        vector = self.placements[second].translation - self.placements[first].translation
        gaps = [float(np.linalg.norm(vector))]
        for link, sign in ((first, 1.0), (second, -1.0)):
            if slide_range := self._slide_range(link):
                axis = sign * self._axis_in_world(self.parent_joints[self.bodies[link]])
                slide_travel = float(np.clip(vector @ axis, -slide_range, slide_range))
                gaps.append(float(np.linalg.norm(vector - slide_travel * axis)))
        return min(gaps)

    def _axis_in_world(self, joint: Joint) -> Array:
        return np.asarray(self.placements[joint.child].rotation @ np.array(joint.axis))

    def _loop_type_and_axis(self, first: str, second: str) -> tuple[str, Vector]:
        """Return revolute and its axis if the loop is planar with a normal common to both frames.

        Otherwise return spherical, which leaves a planar loop the same degrees of freedom.
        """
        loop_joints = self._joints_between(first, second)
        revolute_axes, prismatic_axes = (
            [self._axis_in_world(joint) for joint in loop_joints if joint.kind == kind]
            for kind in ("revolute", "prismatic")
        )
        if not revolute_axes:
            return "spherical", Z_AXIS
        normal = revolute_axes[0]
        deviation = np.linalg.norm(np.cross(revolute_axes, normal), axis=1).max()
        deviation = max(
            deviation, np.abs(np.reshape(prismatic_axes, (-1, 3)) @ normal).max(initial=0.0)
        )
        axes = [self.placements[link].rotation.T @ normal for link in (first, second)]
        is_planar = (
            deviation < _PARALLEL_TOLERANCE
            and np.linalg.norm(axes[0] - axes[1]) < _PARALLEL_TOLERANCE
        )
        return ("revolute", _round_direction(axes[0])) if is_planar else ("spherical", Z_AXIS)


def _round_direction(axis: Array) -> Vector:
    """Return a direction without rounding errors, its largest component positive."""
    axis = np.round(axis, 9)
    if axis[np.abs(axis).argmax()] < 0:
        axis = -axis
    return to_vector(axis / np.linalg.norm(axis))
