"""The dimensions of a working range, one by one."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from crane.common.samples import Array
from crane.description.soil import Cutting
from crane.dynamics.frames import FrameJacobians
from crane.machine import Machine
from crane.motion.workspaces import Workspace
from crane.motion.workspaces.extremes import Goal
from crane.motion.workspaces.section import slewing
from crane.ratings.seeking import Measured, Seeker, difference

_BELOW = 1e-6  # [m] that is no depth
_TRIED = 13  # radii between which a level bottom is sought to begin
_ALONG = 9  # places of a wall or a bottom at which it is looked whether the lip gets there
_SAME = 1e-9  # [m]
_DIGITS = 12  # behind the point: what is below is rounding


class Dimension(NamedTuple):
    """One number of a working range.

    Attributes:
        name: Such as "digging depth".
        value: [m].
        place: (2,) in the section, at which it is measured.
        q_a: (n,) active coordinates there.
        says: How it is defined.
    """

    name: str
    value: float
    place: Array
    q_a: Array
    says: str


class Dimensions:
    """The dimensions of a working range, one by one.

    Args:
        space: What the lip reaches.
        ground: Its height.
        pin: The bucket's pivot, None where there is none.
    """

    def __init__(self, space: Workspace, ground: float, pin: str | None):
        self.space, self.ground, self.machine = space, ground, space.machine
        self._seeker, self._lip = Seeker(space), Measured(space, space.frame)
        self._size, self._rough = space.machine.closure.size, self._lip.rough(self._seeker.q)
        self._pin = None if pin is None else Measured(space, self.machine.tree.joints[pin].child)

    def all(self, level: float) -> Iterator[Dimension]:
        """Those that there are, in the order of brochures.

        Args:
            level: Length of the level bottom [m].
        """
        lip, ground, digs = self._lip, self.ground, self._pin is not None
        slews = self.space.slew is not None
        found: list[Dimension | None] = [
            self._far(
                "reach", lip.goal(0), 0, 1.0,
                "largest distance from the slewing axis" if slews else "largest first coordinate",
            ),
            self._on_ground(),
        ]  # fmt: skip
        depth = self._far(
            "digging depth" if digs else "depth", lip.goal(1, -1.0, ground), 1, -1.0,
            "lowest below the ground",
        )  # fmt: skip
        if depth is not None and depth.value > _BELOW:
            found.append(depth)
            if self._pin is not None:
                found += [self._level(level), self._wall(self._pin)]
        found.append(
            self._far(
                "cutting height" if digs else "height", lip.goal(1, 1.0, ground), 1, 1.0,
                "highest above the ground",
            )
        )  # fmt: skip
        if self._pin is not None:
            found.append(self._dump(self._pin))
            found.append(self._front() if slews else None)
        yield from (one for one in found if one is not None)

    def _far(self, name: str, goal: Goal, axis: int, sign: float, says: str) -> Dimension | None:
        return self._dimension(name, self._seeker.most(goal, sign * self._rough[:, axis]), says)

    def _dimension(
        self, name: str, found: tuple[float, Array] | None, says: str
    ) -> Dimension | None:
        if found is None:
            return None
        value, q = found
        q_a = np.round(q[self.machine.closure.active], _DIGITS) + 0.0
        return Dimension(name, value, self._place(self._lip, q), q_a, says)

    def _place(self, frame: Measured, q: Array) -> Array:
        return np.asarray(np.round(frame.rough(q[None])[0], _DIGITS) + 0.0)

    def _on_ground(self) -> Dimension | None:
        found = self._seeker.most(
            self._lip.goal(0), self._rough[:, 0],
            [("eq", self._lip.goal(1, 1.0, self.ground, self._size))],
            np.abs(self._rough[:, 1] - self.ground) / self._size,
        )  # fmt: skip
        return self._dimension("reach at ground level", found, "with the lip on the ground")

    def _bottom(self, radius: float) -> tuple[float, Array] | None:
        """The lowest height that the lip reaches at a radius, below 0, and its posture."""
        return self._seeker.most(
            self._lip.goal(1, -1.0), -self._rough[:, 1],
            [("eq", self._lip.goal(0, 1.0, radius, self._size))],
            np.abs(self._rough[:, 0] - radius) / self._size,
        )  # fmt: skip

    def _level(self, level: float) -> Dimension | None:
        """The deepest level line: its ends are where the reach is equally deep."""
        deepest = float(self._rough[self._rough[:, 1].argmin(), 0])
        low, high = max(deepest - level, float(self._rough[:, 0].min())), deepest

        def steeper(radius: float) -> float:
            one, two = self._bottom(radius), self._bottom(radius + level)
            return np.nan if one is None or two is None else one[0] - two[0]

        tried = np.linspace(low, high, _TRIED)
        ends = [steeper(x) for x in tried.tolist()]
        turn = next((k for k in range(_TRIED - 1) if ends[k] <= 0 <= ends[k + 1]), None)
        if turn is None:
            return None
        radius = float(brentq(steeper, tried[turn], tried[turn + 1], xtol=_SAME))
        found = self._bottom(radius)
        between = np.linspace(radius, radius + level, _ALONG)[1:-1]
        lower = [self._bottom(x) for x in between.tolist()]
        if found is None or any(x is None or x[0] < found[0] - 1e-6 for x in lower):
            return None
        return self._dimension(
            f"depth of a {level:g} m level bottom", (found[0] + self.ground, found[1]),
            "deepest level line of that length that the lip follows",
        )  # fmt: skip

    def _wall(self, pin: Measured) -> Dimension | None:
        """The deepest point of an upright wall: the lip follows it, the floor keeps off it."""
        blade = next(
            (x.blade for x in self.machine.external
             if isinstance(x, Cutting) and x.frame == self.space.frame), None,
        )  # fmt: skip
        if blade is None or self.space.section.around:
            return None
        frames, section, size = FrameJacobians(self.machine), self.space.section, self._size

        def floor(way: Array) -> Goal:
            """How far the floor points along a direction, from the lip on."""

            def value(q: Array) -> tuple[float, Array]:
                frames.place(q)
                along = frames.pose(self.space.frame).rotation @ np.array(blade)
                turns = frames.of(self.space.frame)[3:]
                return float(way @ along), np.asarray(np.cross(along, way) @ turns)

            return value

        inwards, rises = floor(-section.first), floor(section.second)
        before = difference(self._lip.goal(0, size=size), pin.goal(0, size=size))
        q, rough = self._seeker.q, self._rough
        away = np.array([[inwards(x)[0], rises(x)[0]] for x in q])
        missed = np.maximum(-away, 0.0).sum(axis=1)
        missed += np.maximum(pin.rough(q) - rough, 0.0)[:, 0] / size
        found = self._seeker.most(
            self._lip.goal(1, -1.0, self.ground), -rough[:, 1],
            [("ineq", inwards), ("ineq", rises), ("ineq", before)], missed,
        )  # fmt: skip
        if found is None or found[0] <= _BELOW or not self._follows(found[1]):
            return None
        return self._dimension(
            "vertical wall digging depth", found,
            "deepest lip with neither the bucket's floor nor its pivot beyond an upright line, "
            "that the lip follows to the ground",
        )  # fmt: skip

    def _follows(self, q: Array) -> bool:
        """Whether the lip gets from a posture straight up to the ground."""
        radius, low = self._lip.rough(q[None])[0].tolist()
        for height in np.linspace(low, self.ground, _ALONG)[1:].tolist():
            there = self._seeker.most(
                self._lip.goal(1), np.zeros(len(self._rough)),
                [("eq", self._lip.goal(0, 1.0, radius, self._size)),
                 ("eq", self._lip.goal(1, 1.0, height, self._size))],
                np.abs(self._rough - [radius, height]).sum(axis=1) / self._size,
            )  # fmt: skip
            if there is None:
                return False
        return True

    def _dump(self, pin: Measured) -> Dimension | None:
        lip, size = self._lip, self._size
        rough, above = self._rough, pin.rough(self._seeker.q)
        aside = difference(lip.goal(0, size=size), pin.goal(0, size=size))
        below = difference(pin.goal(1, size=size), lip.goal(1, size=size))
        found = self._seeker.most(
            lip.goal(1, 1.0, self.ground), rough[:, 1], [("eq", aside), ("ineq", below)],
            (np.abs(rough - above)[:, 0] + np.maximum(rough - above, 0.0)[:, 1]) / size,
        )  # fmt: skip
        return self._dimension(
            "dump height", found, "highest lip straight under the bucket's pivot"
        )

    def _front(self) -> Dimension | None:
        """The least radius that holds all pins of the front: of each that may be the outermost."""
        q, size = self._seeker.q, self._size
        pins = [Measured(self.space, link) for link in _pins(self.machine, self.space.frame)]
        sides = [(pin, sign) for pin in pins for sign in (1.0, -1.0)]
        rough = np.column_stack([sign * pin.rough(q)[:, 0] for pin, sign in sides])
        goals = [pin.goal(0, sign, size=size) for pin, sign in sides]
        best: tuple[Measured, float, Array] | None = None
        for k in np.unique(rough.argmax(axis=1)).tolist():
            pin, sign = sides[k]
            demands = [
                ("ineq", difference(goals[k], other)) for j, other in enumerate(goals) if j != k
            ]
            missed = (rough.max(axis=1) - rough[:, k]) / size
            found = self._seeker.most(pin.goal(0, -sign), -rough[:, k], demands, missed)
            if found is not None and (best is None or -found[0] < best[1]):
                best = pin, -found[0], found[1]
        if best is None:
            return None
        pin, radius, posture = best
        one = self._dimension(
            "smallest front slewing radius", (radius, posture),
            "least radius that holds the lip and all pins of the front",
        )  # fmt: skip
        return one and one._replace(place=self._place(pin, posture))


def _pins(machine: Machine, frame: str) -> list[str]:
    """Links whose origins are the pins of what slews, and the frame itself."""
    found = slewing(machine, frame)
    assert found is not None, "it slews"
    model = machine.model
    slew = model.getJointId(machine.active[found[0]])
    out = [frame]
    for joint in machine.tree.moving:
        if joint.kind == "revolute" and model.existJointName(joint.name):
            here = model.getJointId(joint.name)
            if here != slew and slew in list(model.supports[here]):
                out.append(joint.child)
    for loop in machine.closure.equations.loops:
        out.append(loop.successor)
    return out
