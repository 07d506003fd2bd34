"""A closed posture as pins, slides, bodies and loops in a plane."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from crane.common.samples import Array
from crane.machine import Machine
from crane.view.sketch.parts import Body, Collar, Mechanism, Pin, Slide
from crane.view.sketch.plane import Plane, joint_axes

SAME = 1e-9  # share of the drawing's size that is none
_NEAR = 0.04  # share of the drawing's size within which a collar would hide beside a pin
_BARREL = 0.82  # length of a barrel, as a share of the cylinder's shortest length
_STEEP = 0.7  # cosine to the plane's normal above which an axis is drawn as a pin


def project(machine: Machine, q: Array, plane: Plane) -> Mechanism:
    """The mechanism of a machine in a closed posture q (nq,), as a plane shows it."""
    return _Projection(machine, q, plane).mechanism()


class _Projection:
    """Collects what a plane shows of a machine in one posture."""

    def __init__(self, machine: Machine, q: Array, plane: Plane):
        self.machine, self.plane, self.q = machine, plane, q
        model = self.model = machine.model
        data = self.data = model.createData()
        pin.framesForwardKinematics(model, data, q)
        self.origins = np.array([plane.project(place.translation) for place in data.oMi])
        axes = joint_axes(machine, data)
        self.axes, self.steep = plane.project(axes), np.abs(axes @ plane.normal)
        self.parents = [int(parent) for parent in model.parents]
        self.turns = [False] + [machine.unit(name) == "rad" for name in machine.joints]
        chain_of = {x: i for i, chain in enumerate(machine.chains) for x in chain.joints}
        self.chains = [-1] + [chain_of.get(name, 0) for name in machine.joints]
        self.tip_body, self.tip = 0, None
        if machine.tip is not None:
            frame = model.frames[machine.frame(machine.tip)]
            self.tip_body = frame.parentJoint
            self.tip = self._placed(self.tip_body, frame.placement)
        self.carrying = set(model.supports[self.tip_body])
        self.frames = [
            (int(joint), self._placed(joint, place))
            for joint, place in machine.closure.equations.frames
        ]
        self.outer = self._outer_points()
        everything = np.concatenate([np.array(points) for points in self.outer if points])
        self.size = float(np.ptp(everything, axis=0).max()) or 1.0
        self.points: list[list[Array]] = [[] for _ in self.parents]

    def mechanism(self) -> Mechanism:
        pins, collars = self._revolute()
        for index, (joint, at) in enumerate(self.frames):
            self.points[joint].append(at)
            if index % 2:
                loop = self.machine.closure.equations.loops[index // 2]
                pins.append(Pin(loop.name, self.frames[index - 1][1], at, index // 2 + 1))
        if self.tip is not None:
            self.points[self.tip_body].append(self.tip)
        slides = [self._slide(i) for i, turns in enumerate(self.turns) if i and not turns]
        bodies = [self._body(i) for i in range(1, len(self.parents))]
        ground = [(at, np.array([0.0, -1.0])) for at in _distinct(self.points[0], self.size)]
        if self._has_base():
            base, collar = self.outer[0][0], collars[0]
            ground = [item for item in ground if np.abs(item[0] - collar.at).max() > 0]
            away = collar.along @ (self._far(1) - base)
            ground.append((base, -np.sign(away or 1.0) * collar.along))
            if len(column := _distinct([base, collar.at], self.size)) > 1:
                bodies.append(Body(column, -1, False, base))
        return Mechanism(
            pins, collars, slides, bodies, ground, self._regions(), self.tip, self.size
        )

    def _placed(self, joint: int, place: pin.SE3) -> Array:
        return self.plane.project((self.data.oMi[joint] * place).translation)

    def _outer_points(self) -> list[list[Array]]:
        """By body, where others hang on it: origins of joints, loops, the tip."""
        outer: list[list[Array]] = [[] for _ in self.parents]
        outer[0].append(self.plane.project(np.zeros(3)) if self._has_base() else self.origins[1])
        for joint, parent in enumerate(self.parents[1:], start=1):
            if self.turns[joint]:
                outer[parent].append(self.origins[joint])
        for joint, at in self.frames:
            outer[joint].append(at)
        if self.tip is not None:
            outer[self.tip_body].append(self.tip)
        return outer

    def _far(self, joint: int) -> Array:
        """The point of a body that lies farthest from its joint."""
        at = self.origins[joint]
        return max(self.outer[joint], key=lambda x: float(np.abs(x - at).max()), default=at)

    def _has_base(self) -> bool:
        """Whether the world's origin is where the machine stands: a turning axis goes through."""
        first = self.origins[1]
        along = self.axes[1]
        across = first - (first @ along) * along
        return bool(
            self.steep[1] < _STEEP and np.linalg.norm(across) < SAME * self.machine.closure.size
        )

    def _revolute(self) -> tuple[list[Pin], list[Collar]]:
        pins, collars = [], []
        for joint in range(1, len(self.parents)):
            if not self.turns[joint]:
                continue
            name, at = self.model.names[joint], self.origins[joint]
            if self.steep[joint] >= _STEEP:
                pins.append(Pin(name, at, at))
            else:
                along = self.axes[joint] / np.linalg.norm(self.axes[joint])
                at = self._beside_pins(joint, along)
                collars.append(Collar(name, at, along))
            self.points[self.parents[joint]].append(at)
            self.points[joint].append(at)
        return pins, collars

    def _beside_pins(self, joint: int, along: Array) -> Array:
        """The origin of a joint, or halfway along its axis where that hides beside a pin."""
        at, parent = self.origins[joint], self.parents[joint]
        pins = [*self.outer[joint], *([self.origins[parent]] if parent else [])]
        before = self.origins[parent] if parent else self.outer[0][0]
        ends = [float((point - before) @ along) for point in self.outer[joint]]
        length = max(ends, key=abs, default=0.0)
        free = _NEAR * self.size
        alone = parent == 0 and not (joint == 1 and self._has_base())
        if alone or abs(length) < free or all(np.linalg.norm(point - at) > free for point in pins):
            return at
        return at + (float((before - at) @ along) + length / 2) * along

    def _slide(self, joint: int) -> Slide:
        """A prismatic joint between the inner end of its parent and the far end of its body."""
        parent, at = self.parents[joint], self.origins[joint]
        along = self.axes[joint] / max(float(np.linalg.norm(self.axes[joint])), 1e-9)
        outer = self.outer[joint] or [at]
        column = self.model.joints[joint].idx_v
        low = float(self.machine.coordinates.lower[column])
        high = float(self.machine.coordinates.upper[column])
        value = float(self.q[column])
        chains = (self.chains[parent], self.chains[joint])
        boom, name = joint in self.carrying, self.model.names[joint]
        if self.steep[joint] > _STEEP:  # it moves towards whoever looks
            self.points[parent].append(at)
            self.points[joint].append(at)
            return Slide(name, at, at, at, at, *chains, boom, rail=False)
        if parent == 0:
            reach = 0.15 * self.size
            ways = [low - value, high - value] if np.isfinite(high - low) else [-reach, reach]
            start, mouth = (at + way * along for way in ways)
            self.points[joint] += [at]
            return Slide(name, start, mouth, at, at, chains[1], chains[1], boom, rail=True)
        foot = float((self.origins[parent] - at) @ along)
        end = max((float((x - at) @ along) for x in outer), key=lambda s: abs(s - foot))
        sign, length = (1.0 if end >= foot else -1.0), abs(end - foot)
        ways = [sign * (limit - value) for limit in (low, high) if np.isfinite(limit)]
        shortest = length + min(ways) if ways else 0.6 * length
        longest = length + max(ways) if ways else 1.4 * length
        barrel = _BARREL * shortest if shortest > 0.25 * longest else 0.5 * length
        inner = max(length - 0.9 * shortest, 0.0) + 0.05 * barrel
        inner = min(inner, 0.94 * barrel)
        start = at + foot * along
        self.points[parent].append(start)
        self.points[joint].append(at + end * along)
        return Slide(
            name,
            start,
            start + sign * barrel * along,
            start + sign * inner * along,
            at + end * along,
            *chains,
            boom,
            rail=False,
        )

    def _body(self, joint: int) -> Body:
        lever = self.data.oMi[joint].act(self.model.inertias[joint].lever)
        return Body(
            _distinct(self.points[joint], self.size),
            self.chains[joint],
            joint in self.carrying,
            self.plane.project(lever),
        )

    def _regions(self) -> dict[int, Array]:
        """Corners of what each loop encloses: its pin, then the pins on both ways back."""
        regions = {}
        for number in range(1, len(self.frames) // 2 + 1):
            (first, at), (second, _) = self.frames[2 * number - 2 : 2 * number]
            ways = []
            shared = set(self.model.supports[first]) & set(self.model.supports[second])
            planar = True
            for body in (second, first):
                path = [j for j in reversed(list(self.model.supports[body])) if j not in shared]
                planar &= all(self.steep[j] > 0.99 for j in path if self.turns[j])
                ways.append([self.origins[j] for j in path if self.turns[j]])
            corners = _distinct([at, *ways[0], *reversed(ways[1])], self.size)
            if planar and len(corners) > 2:
                regions[number] = corners
        return regions


def _distinct(points: Sequence[Array], size: float) -> Array:
    """Points (k, 2) of a mechanism of some size without those that repeat an earlier one."""
    kept: list[Array] = []
    for point in points:
        if not any(np.abs(point - other).max() < SAME * size for other in kept):
            kept.append(point)
    return np.array(kept).reshape(-1, 2)
