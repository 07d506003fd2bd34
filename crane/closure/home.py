"""The home posture of a machine: from what its file says of it, or from anywhere.

Where the loops do not close from the guess, they are closed from anywhere
(see `crane.closure.anywhere`):

1. with the driven joints held, all others within their limits;
2. with active joints free, too, whose home the file does not say, within their limits;
3. the same two with passive joints beyond their limits.

So are they where the active joints are too few or too many where it closes, and where home as it
closes from the guess is outside of limits or more than 0.5 rad (or half of the machine's size)
from what the file says. Then home is kept where none that is found is nearer, and told if it is
far off.

The first of these that closes counts, and of the postures that it finds the one that is nearest to
the guess, see `Search.postures`.

Whether a posture is what the file says shows in its links: in how far those that are in loops turn
or slide on what carries them, see `Search.off_said`, and in the orientation of the loops. In a
plane the determinant of the two equations of a loop for its two passive joints is

    det dphi / d(q_1, q_2) = l_1 l_2 sin(angle between the links),

whose sign is the side on which their pin lies: it changes where the loop is assembled the other
way round.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crane.closure.anywhere import Search
from crane.closure.equations import LoopEquations
from crane.closure.exactness import CLOSED, DIGITS, Exact, Rounded
from crane.closure.structure import ActiveError, HomeError, Indices, Structure, analyse
from crane.common.errors import MechanismError
from crane.common.samples import Array

_TRIED = 4  # of the postures that are found
_SAME = 1e-3  # difference of postures that is none [rad], or share of the machine's size
FAR = 0.5  # [rad], or share of the machine's size: a home that is farther off is doubted


@dataclass(frozen=True)
class Sought:
    """How a home posture was found that did not follow from the guess.

    Attributes:
        reason: Why it did not.
        count: How many postures were found.
        moved: Columns of joints that are elsewhere than guessed.
        farthest: The joint that is farthest from the guess, and by how much [m], [rad].
        off_said: The joint that is farthest from what the file says, and by how much [rad], in
            shares of the machine's size; see `Search.off_said`.
        reversed: Names of loops that are the other way round than in the guess.
    """

    reason: str
    count: int
    moved: Indices
    farthest: tuple[int, float]
    off_said: tuple[int, float]
    reversed: tuple[str, ...]

    @property
    def is_far(self) -> bool:
        """Whether home is another posture than what the file says."""
        return self.off_said[1] > FAR


def settle(
    equations: LoopEquations,
    active: Indices,
    passive: Indices,
    guess: Array,
    said: Collection[int] | None,
    loose: Collection[int] = (),
) -> tuple[Structure, Sought | None]:
    """Structure and home of a machine, and how home was found if not from the guess.

    Args:
        equations: All loop equations.
        active: Columns of the active joints.
        passive: Columns of the others.
        guess: (nq,) what is known of the home posture.
        said: Columns for which it is the file that says so; None: home follows from the guess or
            not at all.
        loose: Columns of active joints that move like passive ones while home is sought.

    Raises:
        MechanismError: There is no home posture, or see `analyse`.
    """
    search = Search(equations, guess, np.array(sorted(said or ()), dtype=np.intp))
    first: Structure | None = None
    try:
        first = _analysed(equations, active, passive, guess)
    except HomeError as error:
        refused: MechanismError = error
        reason = error.reason
    except ActiveError as error:  # or it is where the linkage collapses
        refused, reason = error, "the joints have other freedoms where it closes"
        if not len(active) or Exact(equations).is_closed(guess):
            raise
    if first is not None:
        reason = _doubt(search, equations, passive, first.home)
        if said is None or not reason:
            return first, None
    elif said is None:
        raise refused
    others = 0
    for found in _found(search, equations, active, passive, said, loose, first is None):
        if first is not None:
            others += sum(search.apart(q, first.home).max() > _SAME for q in found)
            found = _nearer(search, equations, passive, found, first.home)
        usable = _usable(equations, active, passive, found[:_TRIED])
        if isinstance(usable, Structure):
            count = len(found) if first is None else others + 1
            return usable, _sought(search, equations, reason, count, passive, usable)
        if usable is not None and first is None:
            raise refused if isinstance(refused, ActiveError) else usable
    if first is None:
        raise refused
    if search.off_said(first.home)[1] <= FAR:
        return first, None
    return first, _sought(search, equations, reason, others + 1, passive, first)


def within(equations: LoopEquations, q: Array) -> NDArray[np.bool_]:
    """(nv,) whether the joints of a posture (nq,) are within their limits, but for rounding."""
    coordinates, slack = equations.coordinates, CLOSED * equations.units
    kept: NDArray[np.bool_] = (q >= coordinates.lower - slack) & (q <= coordinates.upper + slack)
    return kept


def _doubt(search: Search, equations: LoopEquations, passive: Indices, home: Array) -> str:
    """What speaks against home as it closes from the guess, nothing where all is well."""
    names = equations.coordinates.names
    columns = passive[~within(equations, home)[passive]]
    if len(columns):
        return f"{names[int(columns[0])]} closes outside of its limits"
    joint, off = search.off_said(home)
    return f"{names[joint]} closes far off" if off > FAR else ""


def _nearer(
    search: Search, equations: LoopEquations, passive: Indices, found: list[Array], home: Array
) -> list[Array]:
    """Of some postures those that are nearer to what is said than home is, if it is in limits."""
    if not within(equations, home)[passive].all():
        return found
    return [q for q in found if search.away(q)[:2] < search.away(home)[:2]]


def _sought(
    search: Search,
    equations: LoopEquations,
    reason: str,
    count: int,
    passive: Indices,
    structure: Structure,
) -> Sought:
    home = structure.home
    moved = np.flatnonzero(search.apart(home, search.guess) > CLOSED)
    return Sought(
        reason,
        count,
        moved,
        search.farthest(home),
        search.off_said(home),
        _reversed(search, equations, passive, structure),
    )


def _reversed(
    search: Search, equations: LoopEquations, passive: Indices, structure: Structure
) -> tuple[str, ...]:
    """Loops that home has the other way round than what the file says, see the module."""
    jacobians = [equations.scaled(q)[1] for q in (structure.home, search.guess)]
    found: list[int] = []
    for rows, columns in structure.blocks:
        block, joints = structure.rows[rows], passive[columns]
        if not np.isin(joints, search.said).all():
            continue
        home, said = (np.linalg.slogdet(slope[np.ix_(block, joints)])[0] for slope in jacobians)
        if home * said < 0:
            found += [int(i) for i in equations.loop_of_row[block]]
    return tuple(equations.names[i] for i in dict.fromkeys(found))


def _usable(
    equations: LoopEquations, active: Indices, passive: Indices, found: list[Array]
) -> Structure | ActiveError | None:
    """The first of some closed postures that can be home; else why it has other freedoms."""
    refused: ActiveError | None = None
    for q in found:
        try:
            return _analysed(equations, active, passive, q)
        except ActiveError as error:
            refused = refused or error
        except MechanismError:
            continue
    return refused


def _analysed(
    equations: LoopEquations, active: Indices, passive: Indices, guess: Array
) -> Structure:
    """See `analyse`; to the digits of the file where equations contradict each other."""
    try:
        return analyse(equations, active, passive, guess, Exact(equations))
    except MechanismError as error:
        refused = error
    rounded = Rounded(equations)
    try:
        return analyse(equations, active, passive, guess, rounded)
    except ActiveError as error:
        if str(error) == str(refused) or not error.choices:
            raise refused from None
        meant = error
    except MechanismError:
        raise refused from None
    # other active joints are told where the machine moves with them
    names = equations.coordinates.names
    others = np.array([names.index(joint) for joint in meant.choices[0].joints], dtype=np.intp)
    rest = np.setdiff1d(np.arange(equations.model.nv), others)
    try:
        analyse(equations, others, rest, guess, rounded)
    except MechanismError:
        raise refused from None
    raise meant


def _found(
    search: Search,
    equations: LoopEquations,
    active: Indices,
    passive: Indices,
    said: Collection[int],
    loose: Collection[int],
    farther: bool,
) -> Iterator[list[Array]]:
    """Closed postures, one list for each of the steps above; the last only where it may go on."""
    held = np.union1d(passive, np.array(list(loose), dtype=np.intp))
    every = np.union1d(held, np.setdiff1d(active, list(said)))
    ways = [held, every] if len(every) > len(held) else [held]
    limited = np.isfinite(equations.coordinates.lower[passive]).any()
    limited |= np.isfinite(equations.coordinates.upper[passive]).any()
    nothing = np.zeros(0, dtype=np.intp)
    for beyond in (nothing, passive) if limited and farther else (nothing,):
        for way in ways:
            yield search.postures(way, beyond, DIGITS)
