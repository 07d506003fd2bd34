"""Closing the loops: q = f(q_A), v = gamma v_A, a = gamma a_A + drift."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from crane.closure.branch import Branch
from crane.closure.equations import LoopEquations
from crane.closure.structure import Structure, analyse
from crane.description import LoopSpec
from crane.errors import InputError
from crane.samples import Array, as_samples, per_sample, solve


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
        self.structure: Structure = analyse(self.equations, self.active, self.passive, guess)
        span = model.upperPositionLimit[self.active] - model.lowerPositionLimit[self.active]
        self._branch = Branch(
            self.equations,
            self.structure,
            self._names,
            self.active,
            self.passive,
            np.where(np.isfinite(span) & (span > 0), span, 1.0),
        )
        self.home = self._branch.home.q.copy()
        self.home.flags.writeable = False

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
        known = self._branch.home
        if guess is not None:
            near = as_samples(guess, self.model.nq, "guess", self._names)
            if near.ndim != 1:
                raise InputError(f"guess has the shape {near.shape}, give one ({self.model.nq},)")
            if targets.ndim == 1 and (posture := self._branch.step(near, targets)):
                return posture.q
            known = self._branch.posture(near)
        if targets.ndim == 1:
            return self._branch.reach(targets, known).q
        if len(targets) == 0:
            raise InputError("q_a is an empty stack, give at least one sample")
        out = np.empty((len(targets), self.model.nq))
        for i, target in enumerate(targets):
            known = self._branch.reach(target, known, f" (sample {i})")
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
            solved = solve(jacobian[:, self.passive], -right)
        except np.linalg.LinAlgError:
            raise self._branch.edge(jacobian, q[self.active]) from None
        self._branch.check_edge(jacobian, solved, q[self.active])
        return solved
