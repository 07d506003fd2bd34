"""Largest values of what depends on the posture, sought from many postures."""

from collections.abc import Sequence

import numpy as np

from crane.common.samples import Array
from crane.motion.kinematics import Kinematics
from crane.motion.workspaces import Workspace
from crane.motion.workspaces.extremes import Demand, Goal, farthest

_STARTS = 3  # postures that an optimum is sought from
_APART = 0.05  # share of their strokes by which these differ
_WEIGHT = 10.0  # of what a start misses of a demand, against the goal
_BETTER = 1e-9  # share of the machine's size by which a later optimum has to be better


class Seeker:
    """Optima over a workspace's postures.

    The best of its postures, as far as they meet what is demanded, are improved by `farthest`.

    Args:
        space: The workspace.
    """

    def __init__(self, space: Workspace):
        self.space, self.machine = space, space.machine
        self.strokes = [space.machine.active.index(joint) for joint in space.strokes]
        self.size = space.machine.closure.size
        self.q = np.concatenate([patch.q[patch.closed] for patch in space.patches])
        self._span = np.where(space.high > space.low, space.high - space.low, 1.0)

    def most(
        self, goal: Goal, rough: Array, demands: Sequence[Demand] = (), missed: Array | None = None
    ) -> tuple[float, Array] | None:
        """The largest value of a goal.

        Args:
            goal: See `farthest`.
            rough: (N,) its value at all of `q`.
            demands: What else has to hold; lengths in shares of the machine's size.
            missed: (N,) by how much all of `q` miss it, 0 where it holds.

        Returns:
            The value and its posture (nq,); None where no start leads to what is demanded.
        """
        score = rough if missed is None else rough - _WEIGHT * self.size * missed
        best: tuple[float, Array] | None = None
        ends = (self.space.low, self.space.high)
        for q in self._starts(score):
            value, found = farthest(self.machine, q, self.strokes, ends, goal, demands)
            margin = _BETTER * self.size
            if np.isfinite(value) and (best is None or value > best[0] + margin):
                best = value, found
        return best

    def _starts(self, score: Array) -> list[Array]:
        """The best postures that are not beside each other."""
        columns = self.machine.closure.active[self.strokes]
        out: list[Array] = []
        for k in np.argsort(-score, kind="stable"):
            q = self.q[k]
            away = [np.abs((q - x)[columns] / self._span[self.strokes]).max() for x in out]
            if not away or min(away) > _APART:
                out.append(q)
            if len(out) == _STARTS:
                break
        return out


class Measured:
    """Coordinates (u, w) of a frame in a workspace's section, with their slopes.

    Args:
        space: The workspace.
        frame: A link.
    """

    def __init__(self, space: Workspace, frame: str):
        self._section, self._kinematics = space.section, Kinematics(space.machine, frame)

    def rough(self, q: Array) -> Array:
        """(N, 2) at postures (N, nq)."""
        return self._section.coordinates(self._kinematics.positions(q))

    def goal(self, axis: int, sign: float = 1.0, less: float = 0.0, size: float = 1.0) -> Goal:
        """The goal sign (coordinate - less) / size, of the first or second coordinate."""

        def value(q: Array) -> tuple[float, Array]:
            place = self._kinematics.position_at(q)[None]
            slopes = self._section.slopes(place, self._kinematics.tree_jacobian(q)[None])
            coordinate = float(self._section.coordinates(place)[0, axis])
            return sign * (coordinate - less) / size, sign * slopes[0, axis] / size

        return value


def difference(one: Goal, two: Goal) -> Goal:
    """The first goal less the second."""

    def value(q: Array) -> tuple[float, Array]:
        (a, up), (b, down) = one(q), two(q)
        return a - b, up - down

    return value
