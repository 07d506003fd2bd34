"""Other assemblies: postures that close the loops at the same active coordinates.

Equations that solve one after the other (see `crane.closure.blocks`) have their alternatives one
after the other, too: a triangle or a four-bar linkage has two, mirror images of each other. So
each block is solved anew from starts all over its unknowns, with what was solved before it as at
home; what comes after it follows, from where the guess has it.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from crane.closure.anywhere import Search
from crane.closure.closure import Closure
from crane.closure.equations import LoopEquations
from crane.closure.exactness import DIGITS
from crane.closure.home import within
from crane.closure.structure import Indices
from crane.common.samples import Array, solve
from crane.common.threads import one_thread

_CLOSED = 1e-9  # residual, in shares of the machine's size
_SAME = 1e-3  # [rad], or share of the machine's size: postures that are not different
_STEP = 1.0  # the same, of an iteration at most
_ITERATIONS = 15
_CERTAIN = 0.05  # the same, off the guess: other assemblies are farther
_FAR = 0.5  # the same: a guess that is farther says little
_RATIO, _LOOSE = 2.0, 5.0  # of distances from the guess, up to which it does not decide
_STARTS = 8  # for each unknown of a block


@dataclass(frozen=True)
class Assembly:
    """Another way to assemble a machine, which the guess does not rule out.

    Attributes:
        q: (nq,) the posture.
        loops: Names of the loops that are assembled the other way.
        columns: Joints that are elsewhere than at home.
        off: The joint that is farthest from the guess, and by how much [m], [rad].
        home_off: The same of the home posture.
        outside: Whether the home posture is outside of limits that this one keeps.
    """

    q: Array
    loops: tuple[str, ...]
    columns: Indices
    off: tuple[int, float]
    home_off: tuple[int, float]
    outside: bool


def ambiguities(closure: Closure, guess: Array, named: Indices, most: int) -> list[Assembly]:
    """Assemblies that a guess leaves open, at most one for each block of equations.

    Distances from the guess are compared at the joints that differ from home, at those that the
    file names if it names one of them. An assembly is told where it is less than twice as far as
    home; five times where none is named, or home is 0.5 rad off; or where it keeps limits that
    home does not.

    Args:
        closure: The loops, closed at home.
        guess: (nq,) what they were closed from.
        named: Columns for which it is the file that says so.
        most: Starts in one block, which bounds the work; an assembly that is not found from there
            is not told.
    """
    with one_thread(closure.model.nv):
        return _ambiguities(_Search(closure, guess, named), most)


def _ambiguities(search: "_Search", most: int) -> list[Assembly]:
    closure = search.closure
    found: list[Assembly] = []
    for index, (_, columns) in enumerate(closure.structure.blocks):
        block = closure.passive[columns]
        kept = search.within_limits(closure.home, block)
        if kept and search.away(closure.home, search.said(block)) < _CERTAIN:
            continue
        others = sorted(search.others(index, most), key=lambda q: search.away(q, block))
        told = (one for q in others if (one := search.judged(q, index)) is not None)
        found += itertools.islice(told, 1)
    for columns in search.groups() if closure.sought is not None else ():
        together = (
            one
            for q in search.together(columns, most)
            if (one := search.assessed(q, search.rows_of(columns))) is not None
            and not any(search.looks_the_same(q, other.q) for other in found)
        )
        found += itertools.islice(together, 1)
    return found


class _Search:
    """Solutions of the blocks of one machine."""

    def __init__(self, closure: Closure, guess: Array, named: Indices):
        self.closure, self.guess, self.named = closure, guess, named
        self.model, self.equations = closure.model, closure.equations
        self.home, self.blocks = closure.home, closure.structure.blocks
        self._unit = self.equations.units
        self._turns = ~self.equations.coordinates.slides
        self._parts: dict[tuple[int, ...], LoopEquations] = {}
        self._places: dict[bytes, Array] = {}
        self._massless = not any(inertia.mass > 0 for inertia in list(self.model.inertias)[1:])

    def difference(self, one: Array, two: Array) -> Array:
        """(nq,) how far apart two postures are, in units of 1 rad or the machine's size."""
        apart = one - two
        turns = np.remainder(apart + np.pi, 2 * np.pi) - np.pi
        return np.asarray(np.where(self._turns, np.abs(turns), np.abs(apart) / self._unit))

    def away(self, q: Array, columns: Indices) -> float:
        """How far some joints are from the guess."""
        return float(self.difference(q, self.guess)[columns].max(initial=0.0))

    def said(self, columns: Indices) -> Indices:
        """Those of some joints that the file names; all where it names none."""
        among = columns[np.isin(columns, self.named)]
        return among if len(among) else columns

    def within_limits(self, q: Array, columns: Indices) -> bool:
        """Whether some joints are."""
        return bool(within(self.equations, q)[columns].all())

    def others(self, index: int, most: int) -> list[Array]:
        """Solutions of a block with what is before it as at home, without that of home."""
        rows, columns = self._block(index)
        found = [self.home]
        sign = self._sign(self.home, rows, columns)
        pair = len(columns) <= 2 and self._is_dyad(index)
        starts = [*self._across(rows, columns), *self._starts(columns, _STARTS * len(columns))]
        for start in starts[:most]:
            q = self._solved(start, rows, columns, found)
            if q is None or any(self.difference(q, x)[columns].max() < _SAME for x in found):
                continue
            found.append(q)
            if pair and self._sign(q, rows, columns) != sign:
                break  # mirror images, of which there are two
        return found[1:]

    def groups(self) -> list[Indices]:
        """Columns of passive joints that loops tie together, directly or through others."""
        passive = self.closure.passive
        group, group_of_row = self.equations.groups(passive)
        return [passive[group == i] for i in np.unique(group_of_row[group_of_row >= 0])]

    def rows_of(self, columns: Indices) -> Indices:
        """Independent rows of the loops that some joints are in."""
        tied = (np.vstack([self.equations.sign, self.equations.factors])[:, columns] != 0).any(1)
        rows = self.closure.structure.rows
        return rows[tied[self.equations.loop_of_row[rows]]]

    def together(self, columns: Indices, most: int) -> list[Array]:
        """Closed postures with all joints but some as at home, the nearest to the guess first."""
        guess = self.home.copy()
        guess[columns] = self.guess[columns]
        rows = self.rows_of(columns)
        search = Search(self._part(rows)[0], guess, self.named, most)
        ways = search.postures(columns, np.zeros(0, dtype=np.intp), DIGITS)
        closed = (self._solved(q, rows, columns) for q in ways)
        return [q for q in closed if q is not None]

    def _part(self, rows: Indices) -> tuple[LoopEquations, Indices]:
        """The equations of the loops that some rows belong to alone, and these rows in them."""
        of_row = self.equations.loop_of_row
        chosen = tuple(np.unique(of_row[rows]).tolist())
        if chosen not in self._parts:
            names = self.equations.names
            self._parts[chosen] = self.equations.part([names[i] for i in chosen])
        every = np.flatnonzero(np.isin(of_row, chosen))
        return self._parts[chosen], np.searchsorted(every, rows)

    def _block(self, index: int) -> tuple[Indices, Indices]:
        rows, columns = self.blocks[index]
        return self.closure.structure.rows[rows], self.closure.passive[columns]

    def _is_dyad(self, index: int) -> bool:
        """Whether a block is about translations of one loop: two circles or lines that cross."""
        rows, _ = self._block(index)
        loops = set(self.equations.loop_of_row[rows].tolist())
        return len(loops) == 1 and bool(self.equations.is_translation[rows].all())

    def _across(self, rows: Indices, columns: Indices) -> Array:
        """(4, nq) postures on both sides of home, where its equations determine least."""
        jacobian = self.equations.scaled(self.home)[1][np.ix_(rows, columns)]
        weakest = np.linalg.svd(jacobian)[2][-1]
        out = np.tile(self.home, (4, 1))
        out[:, columns] += np.outer([0.5, -0.5, 1.5, -1.5], weakest * self._unit[columns])
        return out

    def _starts(self, columns: Indices, count: int) -> Array:
        """(count, nq) postures all over the unknowns: a low-discrepancy sequence about the guess.

        Multiples of the powers of 1 / phi, phi^(k + 1) = phi + 1 for k unknowns (Roberts 2018),
        over a turn, the limits of a slide, or the machine's size.
        """
        size = len(columns)
        phi = 2.0
        for _ in range(40):
            phi = (1 + phi) ** (1 / (size + 1))
        share = np.outer(np.arange(count), phi ** -np.arange(1.0, size + 1)) + 0.5
        share = np.remainder(share, 1.0) - 0.5
        coordinates = self.equations.coordinates
        lower, upper = coordinates.lower, coordinates.upper
        span = np.where(self._turns, 2 * np.pi, 2 * self._unit)
        middle = self.guess.copy()
        limited = ~self._turns & np.isfinite(lower) & np.isfinite(upper)
        middle[limited] = (lower[limited] + upper[limited]) / 2
        span[limited] = upper[limited] - lower[limited]
        out = np.tile(self.home, (count, 1))
        out[:, columns] = middle[columns] + share * span[columns]
        return out

    def _solved(
        self, q: Array, rows: Indices, columns: Indices, known: Sequence[Array] = ()
    ) -> Array | None:
        """Newton's method on some rows for some columns, None where it does not converge.

        Solutions that are known are deflated (Farrell, Birkisson, Funke 2015): for m phi instead
        of phi, m = prod 1 / r^2 + 1 with r the distance from one of them, it is the Newton step d
        divided by 1 - (grad m . d) / m, which turns round near them.
        """
        q = q.copy()
        equations, rows = self._part(rows)
        for _ in range(_ITERATIONS):
            phi, jacobian = equations.scaled(q)
            residual = np.abs(phi[rows]).max(initial=0.0)
            if residual < 1e-13:
                break
            try:
                step = solve(jacobian[np.ix_(rows, columns)], -phi[rows])
            except np.linalg.LinAlgError:
                return None
            pushed = 0.0
            for other in known:
                apart = (q - other)[columns] / self._unit[columns]
                turning = self._turns[columns]
                square = np.where(turning, 2 - 2 * np.cos(apart), apart**2).sum()
                slope = np.where(turning, 2 * np.sin(apart), 2 * apart)
                pushed -= float(slope @ step) / max(square * (1 + square), 1e-12)
            step = step / (1 - pushed if abs(1 - pushed) > 1e-6 else 1e-6)
            largest = float(np.abs(step).max())
            if not largest < np.inf:
                return None
            q[columns] += self._unit[columns] * step * min(1.0, _STEP / max(largest, 1e-300))
        if not np.abs(equations.scaled(q)[0][rows]).max(initial=0.0) < _CLOSED:
            return None
        angles = columns[self._turns[columns]]
        q[angles] = np.remainder(q[angles] + np.pi, 2 * np.pi) - np.pi
        return q

    def _sign(self, q: Array, rows: Indices, columns: Indices) -> float:
        jacobian = self.equations.evaluate(q)[1][np.ix_(rows, columns)]
        return float(np.linalg.slogdet(jacobian)[0])

    def _ways(self, q: Array, index: int) -> list[Array]:
        """Solutions of a block with all else as it is, from where it was guessed and at home."""
        rows, columns = self._block(index)
        found = []
        for start in (self.guess, self.home):
            begun = q.copy()
            begun[columns] = start[columns]
            if (way := self._solved(begun, rows, columns)) is not None:
                found.append(way)
        return found

    def judged(self, q: Array, index: int) -> Assembly | None:
        """An assembly with a block elsewhere, None where it is none or the guess rules it out."""
        for later in range(index + 1, len(self.blocks)):
            ways, (_, columns) = self._ways(q, later), self._block(later)
            if not ways:
                return None
            q = min(ways, key=lambda way: self.away(way, columns))
        return self.assessed(q, self._block(index)[0])

    def assessed(self, q: Array, rows: Indices) -> Assembly | None:
        """Likewise of a whole posture, in which some rows are solved another way."""
        passive = self.closure.passive
        if np.abs(self.equations.scaled(q)[0]).max() > self.closure.structure.surplus.allowed:
            return None
        if self.equations.turned_over(q) is not None or not self.within_limits(q, passive):
            return None
        columns = np.flatnonzero(self.difference(q, self.home) > _SAME)
        if not len(columns) or self.looks_the_same(q, self.home):
            return None
        said = self.said(columns)
        away, home_away = self.away(q, said), self.away(self.home, said)
        outside = not self.within_limits(self.home, passive)
        told = home_away < _FAR and np.isin(said, self.named).all()
        ratio = _RATIO if told else _LOOSE
        if away > ratio * home_away and not outside:
            return None
        loops = sorted(set(self.equations.loop_of_row[rows].tolist()))
        names = tuple(self.equations.names[i] for i in loops)
        off, home_off = self._farthest(q, said), self._farthest(self.home, said)
        return Assembly(q, names, columns, off, home_off, outside)

    def _farthest(self, q: Array, columns: Indices) -> tuple[int, float]:
        apart = self.difference(q, self.guess)[columns]
        column = int(columns[apart.argmax()])
        return column, float(apart.max() * self._unit[column])

    def looks_the_same(self, one: Array, two: Array) -> bool:
        """Whether all that has a mass is in one place in both: other angles of a ball, say."""
        apart = np.abs(self._placed(one) - self._placed(two))
        return bool(apart.max(initial=0.0) < _SAME)

    def _placed(self, q: Array) -> Array:
        """Rotations and origins (b, 3, 4) of the bodies that have a mass."""
        key = q.tobytes()
        if key not in self._places:
            data = self.equations.data
            pin.forwardKinematics(self.model, data, self.equations.coordinates.configuration(q))
            self._places[key] = np.array([
                np.column_stack([place.rotation, place.translation / self.equations.size])
                for place, inertia in zip(data.oMi, self.model.inertias, strict=True)
                if inertia.mass > 0 or self._massless
            ])  # fmt: skip
        return self._places[key]
