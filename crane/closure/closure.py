"""Closing the loops: q = f(q_A), v = gamma v_A, a = gamma a_A + drift."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from crane.closure.equations import LoopEquations
from crane.closure.structure import Structure, analyse, least_squares_step
from crane.description import LoopSpec
from crane.errors import (
    BranchEdgeError,
    InputError,
    MechanismError,
    OutOfReachError,
    WrongBranchError,
)
from crane.samples import Array, as_samples, per_sample

_TOLERANCE = 1e-12  # of a closed loop, per metre of machine
_OPEN = 1e-6  # a guess with a larger residual is closed first
_EDGE = 1e-6  # ratio of singular values of a block at which the passive joints get undetermined
_SHORTEST = 2.0**-24  # step of the continuation at which it gives up


class _Posture:
    """A closed posture with what the next step from it needs."""

    __slots__ = ("gamma_passive", "jacobian", "q", "q_a")

    def __init__(self, q: Array, q_a: Array, jacobian: Array, gamma_passive: Array):
        self.q, self.q_a, self.jacobian, self.gamma_passive = q, q_a, jacobian, gamma_passive


class Closure:
    """The loops of a machine as functions of its active coordinates.

    Park, Choi, Ploen (1999); equations (3) and (4) of the reduced-scale forwarder paper, for any
    machine. With J = dphi/dq split into active and passive columns and independent rows,

        q = f(q_A)                 phi(q) = 0, on the assembly branch of the home posture
        gamma = df/dq_A            rows of active joints: identity; passive: -J_P^-1 J_A
        drift = gammadot v_A       rows of active joints: zero; passive: -J_P^-1 (Jdot v)

    Not safe to share between threads: give each its own.

    Args:
        model: The spanning tree.
        loops: The loops that close it.
        active: Names of the active joints, in the order of q_A.
        guess: (nq,) active coordinates of the home posture, and a first guess of the others.

    Raises:
        MechanismError: The loops cannot be closed from the guess, or the active joints do not
            fit the degrees of freedom.

    Attributes:
        home: (nq,) the closed home posture.
        active: Columns of the active joints.
        passive: Columns of the passive joints.
        structure: Independent equations and the order in which they solve.
    """

    home: Array

    def __init__(
        self, model: pin.Model, loops: Sequence[LoopSpec], active: Sequence[str], guess: Array
    ):
        self.model = model
        self.equations = LoopEquations(model, loops)
        self.active_names = tuple(active)
        ids = [model.getJointId(name) for name in active]
        self.active = np.array([model.joints[i].idx_v for i in ids], dtype=np.intp)
        self.passive = np.setdiff1d(np.arange(model.nv), self.active)
        self._names = tuple(model.names)[1:]
        self._size = max(1.0, *(float(np.abs(p.translation).max()) for p in model.jointPlacements))
        self.structure: Structure = analyse(self.equations, self.active, self.passive, guess)
        self._by_size = self.structure.by_size()
        home_q_a = guess[self.active]
        solved = self._newton(self.structure.home, home_q_a, 30)
        if solved is None:
            raise MechanismError("the home posture does not close, change 'home'")
        self._sign = self._signs(solved.jacobian)
        self._home = solved
        self.home = solved.q.copy()
        self.home.flags.writeable = False
        span = model.upperPositionLimit[self.active] - model.lowerPositionLimit[self.active]
        self._span = np.where(np.isfinite(span) & (span > 0), span, 1.0)

    @property
    def degrees_of_freedom(self) -> int:
        """Number of active joints n."""
        return len(self.active)

    def solve(self, q_a: ArrayLike, guess: ArrayLike | None = None) -> Array:
        """Close the loops: q = f(q_A), equation (3) of the reduced-scale forwarder paper.

        Newton's method from the nearest known posture, in steps along the straight line of
        q_A that are halved whenever Newton hesitates or would change the assembly branch. A
        stack is tracked like a path, each sample from the one before it or from the home
        posture, whichever is nearer. The result is closed to rounding or an error is raised.

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
        if targets.ndim == 1 and guess is not None and (near := self._step(targets, guess)):
            return near.q
        known = self._home if guess is None else self._posture_of(guess)
        if targets.ndim == 1:
            return self._reach(targets, known, "").q
        if len(targets) == 0:
            raise InputError("q_a is an empty stack, give at least one sample")
        out = np.empty((len(targets), self.model.nq))
        for i, target in enumerate(targets):
            known = self._reach(target, known, f" (sample {i})")
            out[i] = known.q
        return out

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
        return per_sample(self._gamma, as_samples(q, self.model.nq, "q", self._names))

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
        q = as_samples(q, self.model.nq, "q", self._names)
        v = as_samples(v, self.model.nv, "v", self._names)
        return per_sample(self._drift, q, v)

    def residual(self, q: ArrayLike) -> Array:
        """Largest absolute residual of all loop equations, redundant ones too.

        Args:
            q: (nq,) or (N, nq).

        Returns:
            () or (N,) [m] for translations, [rad] for small rotations.
        """
        q = as_samples(q, self.model.nq, "q", self._names)
        return per_sample(lambda one: np.abs(self.equations.evaluate(one)[0]).max(initial=0.0), q)

    def motion(self, q: Array, v_a: Array) -> tuple[Array, Array, Array]:
        """gamma, v = gamma v_A and drift of one sample, at less cost than one by one.

        Args:
            q: (nq,) closed posture.
            v_a: (n,) [m/s], [rad/s].

        Returns:
            (nv, n), (nv,), (nv,).
        """
        jacobian = self.equations.evaluate(q)[1][self.structure.rows]
        gamma = self._fill(self._passive(jacobian, jacobian[:, self.active], q))
        v = gamma @ v_a
        return gamma, v, self._bend(jacobian, q, v)

    def _gamma(self, q: Array) -> Array:
        jacobian = self.equations.evaluate(q)[1][self.structure.rows]
        return self._fill(self._passive(jacobian, jacobian[:, self.active], q))

    def _drift(self, q: Array, v: Array) -> Array:
        return self._bend(self.equations.evaluate(q)[1][self.structure.rows], q, v)

    def _fill(self, passive: Array) -> Array:
        gamma = np.zeros((self.model.nv, len(self.active)))
        gamma[self.active] = np.eye(len(self.active))
        gamma[self.passive] = passive
        return gamma

    def _bend(self, jacobian: Array, q: Array, v: Array) -> Array:
        drift = np.zeros(self.model.nv)
        second = self.equations.curvature(q, v)[self.structure.rows]
        drift[self.passive] = self._passive(jacobian, second, q)
        return drift

    def _passive(self, jacobian: Array, right: Array, q: Array) -> Array:
        """-J_P^-1 right."""
        try:
            solved = np.linalg.solve(jacobian[:, self.passive], -right)
        except np.linalg.LinAlgError:
            raise self._edge(jacobian, q, "") from None
        self._check_edge(jacobian, solved, q, "")
        return solved

    def _check_edge(self, jacobian: Array, solved: Array, q: Array, sample: str) -> None:
        """Raise where J_P is singular; it is looked at closely only where it made something large."""
        if np.abs(solved).max(initial=0.0) > 1e-3 / _EDGE and self._weakest(jacobian)[0] < _EDGE:
            raise self._edge(jacobian, q, sample)

    def _weakest(self, jacobian: Array) -> tuple[float, Array]:
        """Ratio of singular values of the most singular block, and that block's rows."""
        worst, rows = 1.0, np.zeros(0, dtype=np.intp)
        for block_rows, block_columns in self.structure.blocks:
            values = np.linalg.svd(
                jacobian[np.ix_(block_rows, self.passive[block_columns])], compute_uv=False
            )
            ratio = values[-1] / values[0] if values[0] > 0 else 0.0
            if ratio <= worst:
                worst, rows = float(ratio), block_rows
        return worst, rows

    def _edge(self, jacobian: Array, q: Array, sample: str) -> BranchEdgeError:
        _, rows = self._weakest(jacobian)
        return BranchEdgeError(
            f"{self._loops_of(rows)} is at the edge of its assembly branch at "
            f"{self._at(q[self.active])}{sample}, where the passive joints are undetermined: "
            "stay away from it"
        )

    def _loops_of(self, rows: Array) -> str:
        kept = self.structure.rows[rows]
        loops = sorted({int(i) for i in self.equations.loop_of_row[kept]})
        names = " and ".join(f"'{self.equations.loops[i].name}'" for i in loops)
        return ("loop " if len(loops) == 1 else "the group of loops ") + names

    def _at(self, q_a: Array) -> str:
        pairs = zip(self.active_names, q_a, strict=True)
        return ", ".join(f"{name} = {value:.6g}" for name, value in pairs)

    def _signs(self, jacobian: Array) -> Array:
        """Sign of every block's determinant: constant on an assembly branch."""
        signs = [
            np.linalg.slogdet(jacobian[rows, self.passive[columns]])[0]
            for rows, columns in self._by_size
        ]
        return np.concatenate(signs) if signs else np.zeros(0)

    def _newton(self, q: Array, q_a: Array, iterations: int) -> _Posture | None:
        """Close the loops at q_A from a near posture; None where that does not work."""
        q = q.copy()
        q[self.active] = q_a
        before = np.inf
        for _ in range(iterations):
            phi, jacobian = self.equations.evaluate(q)
            phi, jacobian = phi[self.structure.rows], jacobian[self.structure.rows]
            residual = np.abs(phi).max(initial=0.0)
            rounded = residual <= 4e-15 * self._size
            stalled = residual <= 0.1 * _TOLERANCE * self._size and residual > 0.25 * before
            try:
                if rounded or stalled:
                    gamma = np.linalg.solve(
                        jacobian[:, self.passive], -jacobian[:, self.active]
                    )
                    return _Posture(q, q_a, jacobian, gamma)
                change = np.linalg.solve(jacobian[:, self.passive], -phi)
            except np.linalg.LinAlgError:
                return None
            if not np.abs(change).max() < 1.0:  # also NaN
                return None
            before = residual
            q[self.passive] += change
        return None

    def _step(self, target: Array, guess: ArrayLike) -> _Posture | None:
        """The posture at a target right beside a guess on the branch; None where in doubt."""
        q = as_samples(guess, self.model.nq, "guess", self._names)
        if q.ndim != 1 or not (np.abs(target - q[self.active]) < 0.01 * self._span).all():
            return None
        posture = self._newton(q, target, 5)
        if posture is None or not self._follows(q, posture, np.zeros(0)):
            return None
        self._check(posture, "")
        return posture

    def _posture_of(self, guess: ArrayLike) -> _Posture:
        q = as_samples(guess, self.model.nq, "guess", self._names)
        if q.ndim != 1:
            raise InputError(f"guess has the shape {q.shape}, give one posture ({self.model.nq},)")
        posture = self._newton(q, q[self.active], 10)
        if posture is None:
            return self._home
        if (self._signs(posture.jacobian) * self._sign < 0).any():
            raise self._wrong_branch(posture)
        return posture

    def _wrong_branch(self, posture: _Posture) -> WrongBranchError:
        order = [rows for group, _ in self._by_size for rows in group]
        flipped = np.flatnonzero(self._signs(posture.jacobian) * self._sign < 0)
        return WrongBranchError(
            f"{self._loops_of(order[flipped[0]])} is assembled the other way at "
            f"{self._at(posture.q_a)}: start from the home posture's branch"
        )

    def _reach(self, target: Array, known: _Posture, sample: str) -> _Posture:
        """The closed posture at a target, from a known one or else from home."""
        distance = np.abs((target - known.q_a) / self._span).max()
        if known is not self._home and distance > np.abs((target - self._home.q_a) / self._span).max():
            starts = [self._home, known]
        else:
            starts = [known] if known is self._home else [known, self._home]
        last = known
        for start in starts:
            posture, last = self._track(start, target)
            if posture is not None:
                self._check(posture, sample)
                return posture
        raise self._out_of_reach(target, last, sample)

    def _track(self, start: _Posture, target: Array) -> tuple[_Posture | None, _Posture]:
        """Follow the branch along the straight line from a posture to a target.

        Returns:
            The posture at the target, or None, and the last posture on the way.
        """
        at, done, step = start, 0.0, 1.0
        while done < 1.0:
            goal = min(1.0, done + step)
            q_a = target if goal == 1.0 else start.q_a + goal * (target - start.q_a)
            predicted = at.q.copy()
            move = at.gamma_passive @ (q_a - at.q_a)
            large = np.abs(move).max(initial=0.0) > 1.0
            posture = None
            if not large:
                predicted[self.passive] += move
                posture = self._newton(predicted, q_a, 8 if step > _SHORTEST * 16 else 40)
            if posture is not None and not self._follows(predicted, posture, move):
                posture = None
            if posture is None:
                step /= 2
                if step < _SHORTEST:
                    return None, at
                continue
            at, done = posture, goal
            step *= 2
        return at, at

    def _follows(self, predicted: Array, posture: _Posture, move: Array) -> bool:
        """Whether a posture continues the branch it was predicted on."""
        if (self._signs(posture.jacobian) * self._sign < 0).any():
            return False
        off = np.abs(posture.q - predicted)[self.passive].max(initial=0.0)
        return bool(off <= 0.02 + 0.5 * np.abs(move).max(initial=0.0))

    def _check(self, posture: _Posture, sample: str) -> None:
        """Raise unless every equation holds and the passive joints are determined."""
        self._check_edge(posture.jacobian, posture.gamma_passive, posture.q, sample)
        if len(self.structure.redundant):
            phi, _ = self.equations.evaluate(posture.q)
            extra = np.abs(phi[self.structure.redundant])
            if extra.max() > 1e3 * _TOLERANCE * self._size:
                row = self.structure.redundant[extra.argmax()]
                loop = self.equations.loops[self.equations.loop_of_row[row]].name
                raise OutOfReachError(
                    f"loop '{loop}' stays {extra.max():.3g} open at {self._at(posture.q_a)}{sample}"
                    ", its surplus equations hold only near the home posture: the mechanism is "
                    "overconstrained, use a looser loop type"
                )

    def _out_of_reach(self, target: Array, last: _Posture, sample: str) -> OutOfReachError:
        q = last.q.copy()
        q[self.active] = target
        for _ in range(50):
            phi, jacobian = self.equations.evaluate(q)
            q[self.passive] += least_squares_step(jacobian[:, self.passive], phi)
        phi, _ = self.equations.evaluate(q)
        worst = int(np.abs(phi).argmax())
        loop = self.equations.loops[self.equations.loop_of_row[worst]].name
        span = np.abs(target - last.q_a).max()
        closable = self._at(last.q_a) if span > 0 else "nowhere"
        return OutOfReachError(
            f"loop '{loop}' cannot be closed at {self._at(target)}{sample}: it stays "
            f"{np.abs(phi[worst]):.3g} m open; the last posture on the way that closes is at {closable}"
        )
