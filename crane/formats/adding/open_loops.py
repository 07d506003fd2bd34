"""Loops that a description seems to leave open, with the gap that each has to close.

Three things tell one: frames that are named as the two ends of a loop (see
`crane.formats.machine_file.open_loops`), ends of bodies that meet at home, and a barrel and a rod
that hang on two bodies and point at each other.
"""

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from crane.closure.coordinates import Coordinates
from crane.closure.equations import frame_id
from crane.common.samples import Array
from crane.description import LoopSpec, MachineSpec
from crane.description.rigid import vector
from crane.description.tree import Joint, Vector
from crane.formats.machine_file.open_loops import named_pairs

_NEAR = 0.05  # share of the machine's size within which two ends meet
_MEETING = 0.01  # the same where no plane tells that they belong together
_AWAY = 1e-6  # share of the size away from a body's origin where a frame is a place of its own
_DUMMY = (
    1e-6  # [kg] that CAD exporters give frames; of a light machine a share of its heaviest link
)
_PARALLEL = 1e-6  # sine of an angle that counts as none
_RING = 3  # joints of the tree below which a loop would lock what it closes
_BARREL = re.compile(r"barrel|tube|housing|cylinder|cyl", re.IGNORECASE)
_ROD = re.compile(r"piston_?rod|rod|piston|ram|plunger", re.IGNORECASE)


@dataclass(frozen=True)
class Proposal:
    """A loop that may be missing.

    Attributes:
        loop: It.
        gap: Between its frames at home, without what their slides can cover [m].
        by_name: Whether names say so, else places.
    """

    loop: LoopSpec
    gap: float
    by_name: bool

    def __str__(self) -> str:
        """An entry of `loops` in a machine file, with its gap as a comment."""
        loop = self.loop
        axis = ", ".join(f"{value:.9g}" for value in loop.axis)
        said = "" if loop.type in ("fixed", "spherical") else f", axis: [{axis}]"
        return (
            f"- {{name: {loop.name}, type: {loop.type}, predecessor: {loop.predecessor}, "
            f"successor: {loop.successor}{said}}}  # {1e3 * self.gap:.3g} mm apart at home"
        )


def proposals(spec: MachineSpec, model: pin.Model, q: Array) -> tuple[Proposal, ...]:
    """Loops that nothing closes, those that are named first, then the narrowest.

    Args:
        spec: The machine as read.
        model: Its tree.
        q: (nv,) its home, closed or as the file guesses it.
    """
    return tuple(_Search(spec, model, q).found())


class _Search:
    """Places and axes of a tree at home.

    Args:
        spec: The machine as read.
        model: Its tree.
        q: (nv,) posture.
    """

    def __init__(self, spec: MachineSpec, model: pin.Model, q: Array):
        self.spec, self.joints = spec, spec.tree.joints
        self.above = {joint.child: joint for joint in self.joints.values()}
        self.below = spec.tree.below()
        self.ways, self.bodies = self._traced()
        data = model.createData()
        pin.forwardKinematics(model, data, Coordinates(model).configuration(q))
        self.places = {
            link: pin.updateFramePlacement(model, data, frame_id(model, link)).copy()
            for link in spec.tree.links
        }
        points = np.array([place.translation for place in self.places.values()])
        self.size = float(np.linalg.norm(np.ptp(points, axis=0)))
        given = (link.inertial for link in spec.tree.links.values())
        self.heaviest = max((one.mass for one in given if one is not None), default=0.0)
        self.joined = {frozenset((loop.predecessor, loop.successor)) for loop in spec.loops}

    def _traced(self) -> tuple[dict[str, frozenset[str]], dict[str, str]]:
        """By link the moving joints down to the root, and the link that its body begins with."""
        root = self.spec.tree.root
        ways, bodies, waiting = {root: frozenset[str]()}, {root: root}, [root]
        while waiting:
            link = waiting.pop()
            for joint in self.below.get(link, ()):
                moved = {joint.name} if joint.moves else set()
                ways[joint.child] = ways[link] | moved
                bodies[joint.child] = joint.child if joint.moves else bodies[link]
                waiting.append(joint.child)
        return ways, bodies

    def found(self) -> list[Proposal]:
        """All proposals; two bodies are joined once."""
        proposed: list[Proposal] = []
        closed = {self._bodies(pair) for pair in self.joined}
        used = {frame for pair in self.joined for frame in pair}
        for group in (self._named(), self._slides(), self._meeting()):
            for proposal in sorted(group, key=self._apart):
                ends = {proposal.loop.predecessor, proposal.loop.successor}
                if self._bodies(ends) in closed or ends & used:
                    continue
                proposed.append(self._renamed(proposal, proposed))
                closed.add(self._bodies(ends))
                used |= ends
        return proposed

    def _named(self) -> Iterator[Proposal]:
        for name, one, two in named_pairs(self.spec.tree):
            if len(self._bodies((one, two))) == 2:
                kind, axis = _said(name) or self._type(one, two)
                yield self._proposal(name, kind, (one, two), axis, by_name=True)

    def _slides(self) -> Iterator[Proposal]:
        """A barrel and a rod, each on a pin of its own, whose loop slides from pin to pin."""
        links = [link for link in self._ends() if self._is_hung(link)]
        rods = {_ROD.sub("", link): link for link in links if _ROD.search(link)}
        for barrel in links:
            rod = rods.get(_BARREL.sub("", barrel)) if _BARREL.search(barrel) else None
            if rod is None or rod == barrel or len(self._ring(barrel, rod)) < _RING:
                continue
            one, two = self.places[barrel], self.places[rod]
            way = two.translation - one.translation
            length = float(np.linalg.norm(way))
            axes = [place.rotation.T @ way / max(length, 1e-300) for place in (one, two)]
            if length > 0 and np.linalg.norm(axes[0] - axes[1]) < _NEAR:
                yield Proposal(
                    LoopSpec(barrel, "prismatic", barrel, rod, _rounded(axes[0]), ""), 0.0, True
                )

    def _meeting(self) -> Iterator[Proposal]:
        """Ends of two bodies that meet at home, or by what the slides above them may do."""
        for one, two in self._near():
            if self.below.get(one) and self.below.get(two):
                continue
            gap = self._gap(one, two)
            if gap > _NEAR * self.size or len(self._ring(one, two)) < _RING:
                continue
            kind, axis = self._type(one, two)
            beside = gap <= _MEETING * self.size and self._is_beside(one) and self._is_beside(two)
            if kind != "spherical" or beside:
                yield self._proposal(two, kind, (one, two), axis, by_name=False)

    def _near(self) -> Iterator[tuple[str, str]]:
        """Pairs of frames that are near enough, or may be by their slides."""
        frames = self._frames()
        points = np.array([self.places[link].translation for link in frames]).reshape(-1, 3)
        reach = np.array([self._reach(link) for link in frames])
        for i, one in enumerate(frames[:-1]):
            far = np.linalg.norm(points[i + 1 :] - points[i], axis=1)
            near = far <= _NEAR * self.size + reach[i] + reach[i + 1 :]
            yield from ((one, frames[i + 1 + int(k)]) for k in np.flatnonzero(near))

    def _reach(self, link: str) -> float:
        """How far a slide that ends in a link can move it [m]."""
        joint = self.above.get(self.bodies[link])
        if joint is None or joint.kind != "prismatic":
            return 0.0
        return joint.limits.upper - joint.limits.lower

    def _ends(self) -> list[str]:
        """Links that carry nothing: frames, and what the last joints move."""
        return [link for link in self.spec.tree.links if not self.below.get(link)]

    def _frames(self) -> list[str]:
        """Frames without mass, and what slides at an end."""
        return [link for link in self.spec.tree.links if self._is_frame(link)]

    def _is_frame(self, link: str) -> bool:
        if link in (self.spec.tip, self.spec.tree.root):
            return False
        if self.above[link].moves:
            return self.above[link].kind == "prismatic" and not self.below.get(link)
        inertial = self.spec.tree.links[link].inertial
        return inertial is None or inertial.mass <= _DUMMY * min(1.0, self.heaviest)

    def _is_beside(self, link: str) -> bool:
        """Whether a frame is not just the origin of its body."""
        away = self.places[link].translation - self.places[self.bodies[link]].translation
        return bool(np.abs(away).max() > _AWAY * self.size)

    def _is_hung(self, link: str) -> bool:
        body = self.bodies[link]
        return body in self.above and self.above[body].kind == "revolute"

    def _bodies(self, pair: Collection[str]) -> frozenset[str]:
        return frozenset(self.bodies[link] for link in pair)

    def _ring(self, one: str, two: str) -> list[Joint]:
        """Moving joints of the tree between two links."""
        return [self.joints[name] for name in sorted(self.ways[one] ^ self.ways[two])]

    def _gap(self, one: str, two: str) -> float:
        """Between two links, moved towards each other by a slide that ends in one of them."""
        way = self.places[two].translation - self.places[one].translation
        gaps = [float(np.linalg.norm(way))]
        for link, sign in ((one, 1.0), (two, -1.0)):
            if reach := self._reach(link):
                axis = sign * self._axis(self.above[self.bodies[link]])
                along = float(np.clip(way @ axis, -reach, reach))
                gaps.append(float(np.linalg.norm(way - along * axis)))
        return min(gaps)

    def _apart(self, proposal: Proposal) -> float:
        ends = proposal.loop.predecessor, proposal.loop.successor
        one, two = (self.places[end].translation for end in ends)
        return float(np.linalg.norm(two - one))

    def _axis(self, joint: Joint) -> Array:
        return np.asarray(self.places[joint.child].rotation @ np.array(joint.axis))

    def _type(self, one: str, two: str) -> tuple[str, Vector]:
        """A pin where the ring moves in a plane and both frames say the same of its normal.

        Else a ball, which leaves a planar ring the same freedoms.
        """
        ring = self._ring(one, two)
        turning = [self._axis(joint) for joint in ring if joint.kind == "revolute"]
        sliding = [self._axis(joint) for joint in ring if joint.kind == "prismatic"]
        if not turning:
            return "spherical", (0.0, 0.0, 1.0)
        normal = turning[0]
        off = np.linalg.norm(np.cross(turning, normal), axis=1).max()
        off = max(off, np.abs(np.reshape(sliding, (-1, 3)) @ normal).max(initial=0.0))
        axes = [self.places[link].rotation.T @ normal for link in (one, two)]
        planar = off < _PARALLEL and np.linalg.norm(axes[0] - axes[1]) < _PARALLEL
        return ("revolute", _rounded(axes[0])) if planar else ("spherical", (0.0, 0.0, 1.0))

    def _proposal(
        self, name: str, kind: str, ends: tuple[str, str], axis: Vector, by_name: bool
    ) -> Proposal:
        return Proposal(LoopSpec(name, kind, *ends, axis, ""), self._gap(*ends), by_name)

    def _renamed(self, proposal: Proposal, before: Sequence[Proposal]) -> Proposal:
        """The proposal under a name that no loop has."""
        names = {loop.name for loop in self.spec.loops} | {one.loop.name for one in before}
        name, number = proposal.loop.name, 2
        while name in names:
            name, number = f"{proposal.loop.name}_{number}", number + 1
        return replace(proposal, loop=replace(proposal.loop, name=name))


def _said(name: str) -> tuple[str, Vector] | None:
    """The type that a name says: example-parallel-robots joins frames unless it writes 3D."""
    if not re.match(r"closed?_?loop", name, re.IGNORECASE):
        return None
    return "spherical" if "3d" in name.lower() else "fixed", (0.0, 0.0, 1.0)


def _rounded(axis: Array) -> Vector:
    """A direction without the rounding of zeros and ones, its largest number positive."""
    axis = np.round(axis, 9)
    if axis[np.abs(axis).argmax()] < 0:
        axis = -axis
    return vector(axis / np.linalg.norm(axis))
