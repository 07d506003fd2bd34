"""Closing the loops: q = f(q_A), v = gamma v_A, a = gamma a_A + drift."""

import copy
import dataclasses
import threading
from collections.abc import Collection, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from crane.closure.branch import Branch
from crane.closure.choice import Choice, condition, proposals
from crane.closure.compiled import Cursor, FastClosure
from crane.closure.equations import LoopEquations
from crane.closure.exactness import CLOSED, Exact, Rounded, Surplus
from crane.closure.following import followed
from crane.closure.home import Sought, settle
from crane.closure.structure import Structure
from crane.closure.traced import geometry_of
from crane.codegen import TooLongError, carefully, kept_result
from crane.common.errors import BranchEdgeError, InputError, MechanismError, WrongBranchError
from crane.common.samples import Array, as_samples, per_sample, solve
from crane.common.shown import Brief
from crane.common.threads import one_thread
from crane.description import Coupling, LoopSpec

_FEW, _FAR = 100, 0.1  # samples worth sorting: how many, how far apart as a share of the range
_SAME = 1e-6  # rad, machine's size, between a posture and what Newton's method makes of it
_AS_GOOD = 0.1  # share of the least singular value of all equations that independent ones keep
_STEPS = 8  # from home to a target that is far from the one before it


class Closure(Brief):
    """The loops of a machine as functions of its active coordinates.

    Park, Choi, Ploen (1999); equations (3) and (4) of the reduced-scale forwarder paper, for any
    machine. With J = dphi/dq split into active and passive columns and independent rows,

        q = f(q_A)                 phi(q) = 0, on the assembly branch of the home posture
        gamma = df/dq_A            rows of active joints: identity; passive: -J_P^-1 J_A
        drift = gammadot v_A       rows of active joints: zero; passive: -J_P^-1 (Jdot v)

    Args:
        model: The spanning tree.
        loops: The loops that close it.
        active: Names of the active joints, in the order of q_A.
        guess: (nq,) active coordinates of the home posture, and a first guess of the others.
        couplings: Linear constraints of joints.
        said: Names of joints whose home is said to be that of the guess; where the loops do not
            close from the guess, the others are sought. None: all are said, and none is sought.
        loose: Names of active joints that nothing holds at the guess while the others are sought.
        wound: Whether pins keep the whole turns of the guess, which else are taken out.

    Raises:
        MechanismError: The loops cannot be closed, or the active joints do not fit the degrees of
            freedom.

    Attributes:
        home: (nq,) the closed home posture.
        guess: (nq,) what it was closed from.
        said: Columns for which it is the file that says so.
        active: Columns of the active joints.
        passive: Columns of the passive joints.
        structure: Independent equations and the order in which they solve.
        size: Of the machine [m], see `crane.closure.choice.size`.
        units: (nv,) of the coordinates, to compare them: 1 rad, and the machine's size [m].
        pace: Unit of time [s] of what moves by its weight, 1 s for a machine of 1 m: motions of
            similar machines in the same gravity take times like the roots of their sizes (Froude).
        sought: How home was found where it did not follow from the guess, else None.
    """

    home: Array
    guess: Array
    said: NDArray[np.intp]
    structure: Structure
    sought: Sought | None

    def __init__(
        self,
        model: pin.Model,
        loops: Sequence[LoopSpec],
        active: Sequence[str],
        guess: Array,
        couplings: Sequence[Coupling] = (),
        said: Collection[str] | None = None,
        loose: Collection[str] = (),
        wound: bool = False,
    ):
        self.model = model
        self.equations = LoopEquations(model, loops, couplings)
        self.size, self.units = self.equations.size, self.equations.units
        self.pace = float(np.sqrt(self.size))
        self._local = threading.local()
        self.active_names = tuple(active)
        coordinates = self.equations.coordinates
        self.active = np.array([coordinates.column(name) for name in active], dtype=np.intp)
        self.passive = np.delete(np.arange(model.nv), self.active)
        self._names = coordinates.names

        def columns(names: Collection[str]) -> list[int]:
            return [coordinates.column(name) for name in names]

        self.guess = guess
        self.said = np.array(sorted(columns(said or ())), dtype=np.intp)
        where = None if said is None else columns(said), columns(loose)
        self.structure, self.sought = self._settled(*where)
        if wound:
            turns = np.round((guess - self.structure.home) / (2 * np.pi))
            turns[coordinates.slides] = 0.0
            home = self.structure.home + 2 * np.pi * turns
            self.structure = dataclasses.replace(self.structure, home=home)
        span = (coordinates.upper - coordinates.lower)[self.active]
        limited = np.isfinite(span) & (span > 0)
        self._span = np.where(limited, span, self.equations.units[self.active])
        self._branch = Branch(
            self.equations, self.structure, self._names, self.active, self.passive, self._span
        )
        self.home = self._branch.home.q.copy()
        self.home.flags.writeable = False

    def _settled(
        self, said: list[int] | None, loose: list[int]
    ) -> tuple[Structure, Sought | None]:
        def find() -> tuple[Structure, Sought | None]:
            import scipy.linalg  # noqa: F401 - which brings a library of its own

            with one_thread(self.model.nv):
                return settle(self.equations, self.active, self.passive, self.guess, said, loose)

        if not self.equations.names:
            return settle(self.equations, self.active, self.passive, self.guess, said, loose)
        told = None if said is None else tuple(said)
        depends = (self.parts, self.active, self.guess, told, tuple(loose))
        return kept_result(("home", depends), find, "scipy.linalg", (Structure, Surplus, Sought))

    @property
    def parts(self) -> tuple[Any, ...]:
        """All that its equations are made of, see `crane.codegen.kept_result`."""
        loops = tuple(
            (x.name, x.type, x.predecessor, x.successor, *map(float, x.axis))
            for x in self.equations.loops
        )
        couplings = tuple(
            (x.name, tuple(x.factors.items()), x.offset) for x in self.equations.couplings
        )
        return self.model.saveToString(), loops, couplings

    def _line(self) -> str:
        """Its loops, and what drives them."""
        loops = ", ".join(loop.name for loop in self.equations.loops) or "no loops"
        return (
            f"Closure of {loops}: {len(self.passive)} passive joints from "
            f"{', '.join(self.active_names)}"
        )

    def of_alike(
        self, model: pin.Model, loops: Sequence[LoopSpec], couplings: Sequence[Coupling]
    ) -> "Closure | None":
        """This closure, of a tree that differs in masses alone; None where more differs.

        Args:
            model: The tree, of the same structure.
            loops: Its loops.
            couplings: Its couplings.
        """
        if not _alike(LoopEquations(model, loops, couplings), self.equations):
            return None
        other = copy.copy(self)
        other._local = threading.local()  # where a thread begins is no one else's
        return other

    def near(
        self, model: pin.Model, loops: Sequence[LoopSpec], couplings: Sequence[Coupling]
    ) -> "Closure":
        """The closure of a tree whose numbers differ little, by its structure and on its branch.

        A look at a machine beside this one: it has no machine code of its own.

        Args:
            model: The tree.
            loops: Its loops.
            couplings: Its couplings.

        Raises:
            MechanismError: The loops do not close there, or lock up.
        """
        equations = LoopEquations(model, loops, couplings)
        if _alike(equations, self.equations):
            return self
        other = copy.copy(self)
        other.model, other.equations, other._local = model, equations, threading.local()
        other.size, other.units = equations.size, equations.units
        other.pace = float(np.sqrt(other.size))
        other.__dict__["_made"] = None
        other._branch = Branch(
            equations, self.structure, self._names, self.active, self.passive, self._span
        )
        other.home = other._branch.home.q.copy()
        other.home.flags.writeable = False
        exact = (Exact if self.structure.surplus.allowed <= CLOSED else Rounded)(equations)
        rows = self.structure.rows, self.structure.redundant
        if not exact.is_closed(other.home) or exact.surplus(other.home, *rows, self.active)[0]:
            raise MechanismError("the loops do not close there, or lock up")
        return other

    def around(self, q: Array) -> "Closure | None":
        """The same coordinates on the branch of another closed posture.

        Args:
            q: (nq,) its home, whose whole turns stay.

        Returns:
            None where other independent equations determine the passive joints better there.

        Raises:
            MechanismError: The loops do not close there.
        """
        jacobian = self.equations.scaled(q)[1][:, self.passive]
        least, best = (
            np.linalg.svd(rows, compute_uv=False).min(initial=1.0)
            for rows in (jacobian[self.structure.rows], jacobian)
        )
        if not least > _AS_GOOD * best:
            return None
        other = copy.copy(self)
        other._local, other.sought, other.guess = threading.local(), None, q
        other.__dict__.pop("_made", None)
        other.structure = dataclasses.replace(self.structure, home=q)
        other._branch = Branch(
            self.equations, other.structure, self._names, self.active, self.passive, self._span
        )
        other.home = other._branch.home.q.copy()
        other.home.flags.writeable = False
        exact = (Exact if self.structure.surplus.allowed <= CLOSED else Rounded)(self.equations)
        if not exact.is_closed(other.home):
            raise MechanismError("the loops do not close there")
        return other

    @cached_property
    def _made(self) -> FastClosure | None:
        branch = self._branch
        try:
            return FastClosure(
                self.equations,
                self.structure,
                self.active,
                self.passive,
                branch.home,
                branch.far(branch.home.q),
            )
        except TooLongError:
            return None

    @property
    def compiled(self) -> bool:
        """Whether there is machine code for these loops."""
        return self._made is not None

    @property
    def fast(self) -> FastClosure:
        """Machine code for these loops, made when it is first needed.

        Raises:
            TooLongError: The machine is too large for it.
        """
        if self._made is None:
            raise TooLongError
        return self._made

    @property
    def _cursor(self) -> Cursor:
        """This thread's cursor."""
        try:
            return self._local.cursor
        except AttributeError:
            self._local.cursor = self.fast.cursor()
            return self._local.cursor

    @property
    def degrees_of_freedom(self) -> int:
        """Number of active joints n."""
        return len(self.active)

    def solve(self, q_a: ArrayLike, guess: ArrayLike | None = None) -> Array:
        """Close the loops: q = f(q_A), equation (3) of the reduced-scale forwarder paper.

        Newton's method from the last posture this thread solved (or the guess), in one step where
        that follows the branch; else from home, along the straight line of q_A, in steps that are
        halved whenever Newton hesitates or would change the assembly branch. A stack is tracked
        like a path; one of far samples is sorted for that. The result is closed to rounding, on
        the home posture's branch whatever was solved before, or an error is raised.

        Args:
            q_a: (n,) or (N, n) active coordinates [m], [rad]. Limits are not checked here.
            guess: (nq,) posture to start from, on the home posture's branch.

        Returns:
            q, (nq,) or (N, nq).

        Raises:
            InputError: Wrong shape or not finite.
            OutOfReachError: No posture closes the loops.
            BranchEdgeError: The passive joints are not determined there.
            WrongBranchError: The guess belongs to another branch.
        """
        targets = as_samples(q_a, len(self.active), "q_a", self.active_names)
        if targets.size == 0:
            raise InputError("q_a is an empty stack, give at least one sample")
        near = None
        if guess is not None:
            near = as_samples(guess, self.model.nv, "guess", self._names)
            if near.ndim != 1:
                raise InputError(f"guess has the shape {near.shape}, give one ({self.model.nv},)")
            if self.compiled and not self.fast.start_near(self._cursor, near):
                self._cursor.start(self._branch.posture(near))
        out = np.empty((*targets.shape[:-1], self.model.nv))
        if not self.compiled:
            known = self._branch.home if near is None else self._branch.posture(near)
            for i, target in enumerate(np.atleast_2d(targets)):
                sample = f" (sample {i})" if targets.ndim == 2 else ""
                known = self._branch.reach(target, known, sample)
                out[(i,) if targets.ndim == 2 else ()] = known.q
            return out
        self._close(np.atleast_2d(targets), np.atleast_2d(out), stacked=targets.ndim == 2)
        return out

    def follow(self, q_a: ArrayLike, guess: ArrayLike | None = None) -> Array:
        """Closed postures along a recorded motion, also behind its dead centres.

        `solve` keeps to the branch of home. A motion that passes a dead centre of its active
        joints leaves it, while q_A turns and comes back; here postures go on as the motion does.

        Args:
            q_a: (N, n) active coordinates, from sample to sample as dense as the motion is smooth.
            guess: (nq,) near the first posture; home if not given.

        Returns:
            (N, nq).

        Raises:
            InputError: Wrong shape or not finite.
            ClosureError: The loops do not close, or the motion does not go on.
        """
        targets = as_samples(q_a, len(self.active), "q_a", self.active_names)
        if targets.ndim != 2 or not len(targets):
            raise InputError("q_a is no motion, give (N, n) samples")
        first = self.solve(targets[0], guess)
        return followed(self.equations, self.active, self.equations.scales, targets, first)

    def _close(self, targets: Array, out: Array, stacked: bool) -> None:
        """Close the loops at targets (N, n) into out (N, nq)."""
        order = self._order(targets) if len(targets) > _FEW else None
        sorted_targets = np.ascontiguousarray(targets if order is None else targets[order])
        closed = out if order is None else np.empty_like(out)

        def reach(i: int) -> None:
            sample = f" (sample {i if order is None else order[i]})" if stacked else ""
            closed[i] = self.reach(self._cursor, sorted_targets[i], sample)

        carefully(
            len(targets),
            lambda i, _: self.fast.follow(self._cursor, sorted_targets[i:], closed[i:]),
            reach,
        )
        if order is not None:
            out[order] = closed

    def _order(self, targets: Array) -> NDArray[np.intp] | None:
        """An order of far samples in which neighbours are near; None for what is a path already.

        Cells of all coordinates but one, along the last one within a cell. Coordinates that move
        no passive joint do not count.
        """
        counts = np.abs(self._branch.home.gamma).max(axis=0, initial=0.0) > 0
        scaled = (targets / self._span)[:, counts]
        if not scaled.size or np.abs(np.diff(scaled, axis=0)).max(axis=1).mean() < _FAR:
            return None
        cells = np.floor(scaled * len(targets) ** (1 / scaled.shape[1]))
        order: NDArray[np.intp] = np.lexsort((scaled[:, -1], *cells[:, :-1].T))
        return order

    def on_branch(self, q: Array) -> bool:
        """Whether a closed posture (nq,) lies on the assembly branch of home."""
        if self.compiled:
            return self.fast.start_near(self._cursor, q)
        try:
            posture = self._branch.posture(q)
        except WrongBranchError:
            return False
        return bool(np.abs((posture.q - q) / self.units).max() < _SAME)

    def reach(self, cursor: Cursor, target: Array, sample: str = "") -> Array:
        """The posture at a target that is too far for one step, where the cursor is left.

        In several steps from home, or as `Branch` can.

        Args:
            cursor: Where to go on from afterwards.
            target: (n,).
            sample: What to call the target in errors.

        Returns:
            q (nq,).
        """
        home = self._branch.home
        way = home.q_a + np.linspace(0, 1, _STEPS + 1)[1:, None] * (target - home.q_a)
        way[-1] = target
        out = np.empty((_STEPS, self.model.nv))
        for some in (way[-1:], way[1::2], way):
            cursor.start(home)
            if self.fast.follow(cursor, some, out) == len(some):
                return out[len(some) - 1]
        posture = self._branch.reach(target, home, sample)
        cursor.start(posture)
        return posture.q

    def gamma(self, q: ArrayLike) -> Array:
        """Derivative of f, equation (4) of the reduced-scale forwarder paper.

        Args:
            q: (nq,) or (N, nq) closed postures.

        Returns:
            gamma, (nv, n) or (N, nv, n): v = gamma v_A.

        Raises:
            InputError: Wrong shape or not finite.
            BranchEdgeError: The passive joints are not determined there.
        """
        q = as_samples(q, self.model.nv, "q", self._names)
        if not self.compiled:
            return per_sample(self._gamma, q)
        if q.size == 0:
            raise InputError("q is an empty stack, give at least one sample")
        rows = np.atleast_2d(np.ascontiguousarray(q))
        out = np.empty((len(rows), self.model.nv, len(self.active)))

        def pivoted(i: int) -> None:  # what looks singular
            try:
                out[i] = self._gamma(rows[i])
            except BranchEdgeError as error:
                sample = f" (sample {i})" if q.ndim == 2 else ""
                raise BranchEdgeError(f"{error}{sample}") from None

        carefully(len(rows), lambda i, _: self.fast.gamma(rows[i:], out[i:]), pivoted)
        return out if q.ndim == 2 else out[0]

    def drift(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Acceleration of the tree at a_A = 0: drift = gammadot v_A, a = gamma a_A + drift.

        Args:
            q: (nq,) or (N, nq) closed postures.
            v: (nv,) or (N, nv) velocities v = gamma v_A.

        Returns:
            (nv,) or (N, nv) [m/s2], [rad/s2], zero at the active joints.

        Raises:
            InputError: Wrong shape or not finite.
            BranchEdgeError: The passive joints are not determined there.
        """
        q = as_samples(q, self.model.nv, "q", self._names)
        v = as_samples(v, self.model.nv, "v", self._names)
        return per_sample(self._drift, q, v)

    def residual(self, q: ArrayLike) -> Array:
        """Largest absolute residual of all loop equations, redundant ones too.

        Args:
            q: (nq,) or (N, nq).

        Returns:
            () or (N,) [m] for translations, [rad] for small rotations.
        """
        q = as_samples(q, self.model.nv, "q", self._names)
        return per_sample(lambda one: np.abs(self.equations.evaluate(one)[0]).max(initial=0.0), q)

    def condition(self, q: ArrayLike) -> Array:
        """How well the active joints drive the machine: ||D^-1 gamma D_A||_2, D = diag(scales).

        1 where no other joint moves, infinite where the branch ends; see `crane.closure.choice`.

        Args:
            q: (nq,) or (N, nq) closed postures.

        Returns:
            () or (N,).
        """
        return condition(self.gamma(q), self.equations.scales, self.active)

    @cached_property
    def proposals(self) -> list[Choice]:
        """Choices of active joints for this machine at home, see `crane.closure.choice`."""
        followers = np.flatnonzero((self.equations.factors != 0).any(axis=0)).tolist()
        rows = self.structure.rows  # the others contradict them by the digits of a file
        jacobian = self.equations.evaluate(self.home)[1] / self.equations.row_units[:, None]
        return proposals(self.model, jacobian[rows], followers)

    def motion(self, q: Array, v_a: Array) -> tuple[Array, Array, Array]:
        """gamma, v = gamma v_A and drift of one sample, at less cost than one by one.

        Args:
            q: (nq,) closed posture.
            v_a: (n,) [m/s], [rad/s].

        Returns:
            (nv, n), (nv,), (nv,).
        """
        jacobian = self.equations.scaled(q)[1][self.structure.rows]
        gamma = self._fill(self._gamma_rows(jacobian, q))
        v = gamma @ v_a
        return gamma, v, self._bend(jacobian, q, v)

    def _gamma(self, q: Array) -> Array:
        return self._fill(self._gamma_rows(self.equations.scaled(q)[1][self.structure.rows], q))

    def _gamma_rows(self, jacobian: Array, q: Array) -> Array:
        """(passive, n) of gamma, from a Jacobian in shares of the machine's size."""
        rows = self._passive(jacobian, jacobian[:, self.active], q)
        units = self.equations.units
        return rows * units[self.passive, None] / units[self.active]

    def _drift(self, q: Array, v: Array) -> Array:
        return self._bend(self.equations.scaled(q)[1][self.structure.rows], q, v)

    def _fill(self, passive: Array) -> Array:
        gamma = np.zeros((self.model.nv, len(self.active)))
        gamma[self.active] = np.eye(len(self.active))
        gamma[self.passive] = passive
        return gamma

    def _bend(self, jacobian: Array, q: Array, v: Array) -> Array:
        drift = np.zeros(self.model.nv)
        second = (self.equations.curvature(q, v) / self.equations.row_units)[self.structure.rows]
        solved = self._passive(jacobian, second, q)
        drift[self.passive] = solved * self.equations.units[self.passive]
        return drift

    def _passive(self, jacobian: Array, right: Array, q: Array) -> Array:
        """-J_P^-1 right, all in shares of the machine's size."""
        try:
            solved = solve(jacobian[:, self.passive], -right)
        except np.linalg.LinAlgError:
            raise self._branch.edge(jacobian, q[self.active]) from None
        self._branch.check_edge(jacobian, solved, q[self.active])
        return solved


def _alike(one: LoopEquations, other: LoopEquations) -> bool:
    """Whether joints, limits and loops of two trees of one structure are at the same places."""
    pairs = [
        [x.factors, x.offsets, x.coordinates.lower, x.coordinates.upper, geometry_of(x).numbers]
        for x in (one, other)
    ]
    return all(np.array_equal(x, y) for x, y in zip(*pairs, strict=True))
