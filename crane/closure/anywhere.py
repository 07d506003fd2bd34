"""Closing the loops from anywhere: for machines whose files say little of their home posture.

The residual of a loop is what it locks of log(M_1^-1 M_2), M_i the placements of its frames:
rotations [rad], and translations in shares of the machine's size; where it locks no rotation, the
distance of the origins. Unlike the loop equations it is zero only where axes point the same way,
and grows all the way to half a turn. Damped least squares go downhill from any start (Levenberg
1944; a damping that falls with the square of the residual keeps the convergence quadratic,
Yamashita and Fukushima 2001), with a line search along the path that limits bend. Starts lie
around the guess, farther and farther off.
"""

import itertools
from collections.abc import Callable, Iterator

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from crane.closure.choice import Indices
from crane.closure.equations import LoopEquations
from crane.common.samples import Array
from crane.description import LOOP_TYPES

_ZERO = 1e-11  # in shares
_ITERATIONS = 80
_STEP = 1.0  # [rad], or share of the machine's size: of an iteration at most
_HALVINGS = 12
_DAMPING = 1e-3
_SLOW, _PATIENCE = 0.99, 6  # ratio of residuals that is no progress, and how often it is borne
_STARTS, _MORE = 24, (5, 24)  # until one closes, and at least and at most from then on
_WORK, _SPARE = 2000, 120  # starts times joints at most: in all, and after one closes
_RADII = (0.3, 1.0, 2.0, np.pi)  # of the starts [rad], or shares of the machine's size
_SAME = 1e-3  # difference of postures that is none, likewise


class Residual:
    """How far loops and couplings are from closed.

    Args:
        equations: The loops.
    """

    def __init__(self, equations: LoopEquations):
        self._equations = equations
        self._shares = np.where(np.arange(6) < 3, equations.size, 1.0)
        self._locked = [np.flatnonzero(LOOP_TYPES[loop.type]) for loop in equations.loops]
        own = equations.loop_of_row >= len(equations.loops)
        self._coupled = equations.row_units[own]

    def evaluate(self, q: Array) -> tuple[Array, Array]:
        """Residuals (m,) and their slopes (m, nv)."""
        equations = self._equations
        model, data = equations.model, equations.data
        at = equations.coordinates.configuration(q)
        world = pin.computeJointJacobians(model, data, at).reshape(6, -1)
        gaps = [(equations.factors @ q - equations.offsets) / self._coupled]
        slopes = [equations.factors / self._coupled[:, None]]
        for index, locked in enumerate(self._locked):
            one, two = (
                data.oMi[joint] * place for joint, place in equations.frames[2 * index :][:2]
            )
            apart = one.actInv(two)
            moves = two.toActionMatrixInverse() @ (equations.sign[index] * world)  # as 2 sees them
            if locked.max() < 3:
                gap, slope = apart.translation, apart.rotation @ moves[:3]
            else:
                gap, slope = pin.log6(apart).vector, pin.Jlog6(apart) @ moves
            gaps.append(gap[locked] / self._shares[locked])
            slopes.append(slope[locked] / self._shares[locked, None])
        return np.concatenate(gaps), np.vstack(slopes)


def winding(equations: LoopEquations) -> NDArray[np.bool_]:
    """(nv,) joints that a whole turn leaves where they are: no slides, couplings and flyers."""
    coordinates = equations.coordinates
    winds = ~coordinates.slides & ~(equations.factors != 0).any(axis=0)
    for column in coordinates.floating:
        winds[column : column + 6] = False
    return np.asarray(winds)


def unwound(q: Array, near: Array, winds: NDArray[np.bool_], lower: Array, upper: Array) -> Array:
    """The same posture with whole turns so that joints are in limits, and near another one.

    Args:
        q: (nq,).
        near: (nq,) the other one.
        winds: (nq,) joints that may wind, see `winding`.
        lower: (nq,) limits.
        upper: (nq,) likewise.

    Returns:
        (nq,), joints within half a turn of the other posture; where limits do not allow that, by
        whole turns nearer to them, and where they allow none as it was.
    """
    turn = 2 * np.pi
    turned = np.where(winds, near + np.remainder(q - near + np.pi, turn) - np.pi, q)
    slack = 1e-12
    turned += np.where(
        winds & (turned < lower), turn * np.ceil((lower - slack - turned) / turn), 0
    )
    turned -= np.where(
        winds & (turned > upper), turn * np.ceil((turned - upper - slack) / turn), 0
    )
    kept = (turned >= lower - slack) & (turned <= upper + slack)
    return np.where(winds & kept, turned, q)


class Search:
    """Closed postures of a machine, from anywhere.

    Args:
        equations: The loops.
        guess: (nq,) what is said of the posture.
        said: Columns for which it is the file that says so.
        more: Starts from the first closed posture on; if not given, more for smaller machines.
    """

    def __init__(
        self, equations: LoopEquations, guess: Array, said: Indices, more: int | None = None
    ):
        more = min(max(_SPARE // max(len(guess), 1), _MORE[0]), _MORE[1]) if more is None else more
        self._residual, self.guess = Residual(equations), guess
        self._unit = equations.units
        self._lower, self._upper = equations.coordinates.lower, equations.coordinates.upper
        self.said, self._more = said, more
        self._rates = equations.coordinates.rates
        self._in_loops = (equations.sign != 0).any(axis=0)
        self._turns = ~equations.coordinates.slides
        self._winds = winding(equations)
        self._endless = self._winds & np.isinf(self._upper) & np.isinf(self._lower)

    def postures(self, free: Indices, beyond: Indices, enough: float) -> list[Array]:
        """Closed postures, the nearest to the guess first.

        Nearest where the farthest of the joints that are said is nearest [rad], [machine's size];
        if that is equal, by their sum of squares, then by all joints.

        Args:
            free: Columns of the joints that may move.
            beyond: Columns of those that may leave their limits.
            enough: Residual that counts as closed.
        """
        found: list[Array] = []
        most = max(2, _WORK // len(self.guess))
        last = min(_STARTS, most)
        for count, start in enumerate(self._starts(free)):
            if count >= last:
                break
            q = self._within(start, free, beyond, enough)
            if q is None:
                continue
            if not found:
                last = min(most, count + 1 + self._more)
            if all(self.apart(q, other).max() > _SAME for other in found):
                found.append(q)
        return sorted(found, key=self.away)

    def _within(self, start: Array, free: Indices, beyond: Indices, enough: float) -> Array | None:
        """Along the limits from one start; else across them, where whole turns lead back."""
        for loose in (beyond, free):
            q, gap = self.descend(start, free, loose)
            held = np.setdiff1d(free, beyond)
            slack = _ZERO * self._unit
            kept = (q >= self._lower - slack) & (q <= self._upper + slack)
            if gap <= enough and kept[held].all():
                return q
            if not np.isfinite([self._lower[held], self._upper[held]]).any():
                return None
        return None

    def away(self, q: Array) -> tuple[float, float, float]:
        """How far a posture is from the guess: what is said, its sum of squares, all joints."""
        apart = self.apart(q, self.guess)
        said = apart[self.said]
        return (
            round(float(said.max(initial=0.0)), 3),
            round(float(np.linalg.norm(said)), 3),
            float(apart.max(initial=0.0)),
        )

    def off_said(self, q: Array) -> tuple[int, float]:
        """The joint whose link is farthest from where it is said to be on what carries it.

        Whole turns leave it there. Links that no loop goes through, rotors on gears for one, are
        where couplings put them, and are no matter of how loops are assembled.

        Args:
            q: (nq,).

        Returns:
            Its column, and by how much [rad], [machine's size].
        """
        joints = self.said[self._in_loops[self.said]]
        if not len(joints):
            return 0, 0.0
        off = (q - self.guess) / self._unit
        turned = np.remainder(off + np.pi, 2 * np.pi) - np.pi
        apart = np.abs(np.where(self._turns, turned, off))[joints]
        return int(joints[apart.argmax()]), float(apart.max())

    def farthest(self, q: Array) -> tuple[int, float]:
        """The joint that is farthest from the guess, and by how much [m], [rad]."""
        apart = self.apart(q, self.guess)
        return int(apart.argmax()), float((apart * self._unit)[apart.argmax()])

    def apart(self, one: Array, two: Array) -> Array:
        """(nq,) how far apart the joints of two postures are [rad], [machine's size]."""
        turned = np.abs(np.remainder(one - two + np.pi, 2 * np.pi) - np.pi)
        return np.asarray(np.where(self._endless, turned, np.abs(one - two) / self._unit))

    def _starts(self, free: Indices) -> Iterator[Array]:
        """The guess, and low-discrepancy points of boxes around it that grow.

        Multiples of the powers of 1 / phi, phi^(k + 1) = phi + 1 for k unknowns (Roberts 2018).
        """
        yield self.guess.copy()
        phi = 2.0
        for _ in range(40):
            phi = (1 + phi) ** (1 / (len(free) + 1))
        steps = phi ** -np.arange(1.0, len(free) + 1)
        for count in itertools.count(1):
            share = 2 * np.remainder(0.5 + count * steps, 1.0) - 1
            start = self.guess.copy()
            start[free] += _RADII[count % len(_RADII)] * self._unit[free] * share
            yield start

    def descend(self, q: Array, free: Indices, beyond: Indices) -> tuple[Array, float]:
        """Least squares from one start.

        Args:
            q: (nq,) the start.
            free: Columns of the joints that may move.
            beyond: Columns of those that may leave their limits.

        Returns:
            The posture, whole turns as `unwound` has them, and its largest residual.
        """
        lower, upper = self._lower.copy(), self._upper.copy()
        lower[beyond], upper[beyond] = -np.inf, np.inf
        q = q.copy()
        q[free] = np.clip(q, lower, upper)[free]
        gap, slope = self._residual.evaluate(q)
        slow = 0
        for _ in range(_ITERATIONS):
            cost = float(gap @ gap)
            if np.abs(gap).max(initial=0.0) < _ZERO or slow >= _PATIENCE:
                break
            down = -slope.T @ gap
            stuck = ((q <= lower) & (down < 0)) | ((q >= upper) & (down > 0))
            able = free[~stuck[free]]
            if not len(able):
                break
            step = np.zeros(len(q))
            step[able] = self._step(slope[:, able] * self._unit[able], gap) * self._unit[able]
            step = self._rates(q, step)
            moved = self._line_search(q, step, cost, lambda way: np.clip(way, lower, upper))
            if moved is None:
                break
            q, gap, slope = moved
            slow += int(gap @ gap > _SLOW * cost)
        winds = self._winds.copy()
        winds[np.setdiff1d(np.arange(len(q)), free)] = False
        q = unwound(q, self.guess, winds, self._lower, self._upper)
        return q, float(np.abs(gap).max(initial=0.0))

    @staticmethod
    def _step(slope: Array, gap: Array) -> Array:
        gram = slope.T @ slope
        rounding = 1e-14 + 1e-15 * float(gram.diagonal().max(initial=0.0))
        damping = _DAMPING * min(1.0, float(gap @ gap)) + rounding
        step = np.linalg.solve(gram + damping * np.eye(len(gram)), -slope.T @ gap)
        return np.asarray(step * min(1.0, _STEP / max(np.abs(step).max(initial=0.0), 1e-300)))

    def _line_search(
        self, q: Array, step: Array, cost: float, bend: Callable[[Array], Array]
    ) -> tuple[Array, Array, Array] | None:
        """The longest of halved steps that gets downhill, None where none does."""
        for halvings in range(_HALVINGS):
            way = bend(q + step / 2**halvings)
            gap, slope = self._residual.evaluate(way)
            if gap @ gap < cost * (1 - 1e-4 / 2**halvings):
                return way, gap, slope
        return None
