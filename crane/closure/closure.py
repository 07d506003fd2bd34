"""`Closure`: solves the loops of a machine, q = f(q_A), v = gamma v_A, a = gamma a_A + drift.

A loop is closed by Newton's method in `NewtonContinuation.solve_newton`
(`crane.closure.newton_continuation`), and in machine code by the routine "close" of
`crane.closure.closure_routines`.
"""

import copy
import dataclasses
from collections.abc import Collection, Sequence
from functools import cached_property

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from crane.closure.active_joint_selection import (
    ActiveJointSelection,
    condition_number,
    propose_active_joints,
)
from crane.closure.branch_solver import BranchSolver, follow_motion
from crane.closure.constraint_tolerances import (
    CLOSED_TOLERANCE,
    ExactConstraints,
    RoundedConstraints,
)
from crane.closure.home_search import find_cached_home
from crane.closure.kinematics_formulas import tree_geometry
from crane.closure.loop_equations import LoopEquations
from crane.common.errors import InputError, MechanismError
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array, apply_per_sample, as_sample, as_samples
from crane.description.specification import Coupling, LoopSpec

# least singular value of the independent equations over that of all, for the same coordinates
_MIN_SINGULAR_VALUE_SHARE = 0.1


class Closure(BranchSolver, OneLineRepr):
    """The loops of a machine as functions of its active coordinates.

    Park, Choi, Ploen (1999); equations (3) and (4) of the reduced-scale forwarder paper, for any
    machine. With J = dphi/dq split into active and passive columns and independent rows,

        q = f(q_A)                 phi(q) = 0, on the branch of the home configuration
        gamma = df/dq_A            rows of active joints: identity; passive: -J_P^-1 J_A
        drift = gammadot v_A       rows of active joints: zero; passive: -J_P^-1 (Jdot v)

    Args:
        model: The spanning tree.
        loops: The loops that close it.
        active: Names of the active joints, in the order of q_A.
        initial_guess: (nq,) active coordinates of the home configuration, and an initial guess of
            the others.
        couplings: Constraints of joints.
        specified: Names of joints whose home coordinate the file specifies. Where the loops do not
            close from the guess, home is searched for with the other joints. None: no search.
        movable: Names of active joints that may move during this search.
        keep_revolutions: Whether the full revolutions of the guess are kept; removed if not.

    Raises:
        MechanismError: The loops cannot be closed, or the active joints do not fit the degrees of
            freedom.

    Attributes:
        home: (nq,) closed home configuration.
        initial_guess: (nq,) configuration from which it was closed.
        specified_columns: Columns whose home coordinate the file specifies.
        active: Columns of the active joints.
        passive: Columns of the passive joints.
        structure: Independent equations and the order in which they are solved.
        home_search: How home was found where it did not follow from the guess, else None.
    """

    def __init__(
        self,
        model: pin.Model,
        loops: Sequence[LoopSpec],
        active: Sequence[str],
        initial_guess: Array,
        couplings: Sequence[Coupling] = (),
        specified: Collection[str] | None = None,
        movable: Collection[str] = (),
        keep_revolutions: bool = False,
    ):
        self.model = model
        self.equations = LoopEquations(model, loops, couplings)
        self.active_names = tuple(active)
        coordinates = self.equations.coordinates
        self.active = np.array([coordinates.column(name) for name in active], dtype=np.intp)
        self.passive = np.delete(np.arange(model.nv), self.active)

        def columns(names: Collection[str]) -> list[int]:
            return [coordinates.column(name) for name in names]

        self.initial_guess = initial_guess
        self.specified_columns = np.array(sorted(columns(specified or ())), dtype=np.intp)
        self.structure, self.home_search = find_cached_home(
            self.equations,
            self.active,
            self.passive,
            initial_guess,
            None if specified is None else columns(specified),
            columns(movable),
        )
        if keep_revolutions:
            revolutions = np.round((initial_guess - self.structure.home) / (2 * np.pi))
            revolutions[coordinates.is_translation] = 0.0
            self.structure = dataclasses.replace(
                self.structure, home=self.structure.home + 2 * np.pi * revolutions
            )
        self._start_solver()

    @property
    def characteristic_length(self) -> float:
        """Characteristic length of the machine [m]."""
        return self.equations.characteristic_length

    @property
    def characteristic_time(self) -> float:
        """Characteristic time [s] of motions under gravity, 1 s for a machine of 1 m.

        Times of similar machines scale with the square root of the length (Froude).
        """
        return float(np.sqrt(self.characteristic_length))

    @property
    def units(self) -> Array:
        """(nv,) units that make coordinates comparable: 1 rad, and the characteristic length."""
        return self.equations.coordinate_units

    def _one_line(self) -> str:
        loops = ", ".join(loop.name for loop in self.equations.loops) or "no loops"
        return (
            f"Closure of {loops}: {len(self.passive)} passive joints from "
            f"{', '.join(self.active_names)}"
        )

    def with_other_masses(
        self, model: pin.Model, loops: Sequence[LoopSpec], couplings: Sequence[Coupling]
    ) -> "Closure | None":
        """This closure for a tree that differs in masses only; None if it differs in more.

        Args:
            model: The tree, of the same structure.
            loops: Its loops.
            couplings: Its couplings.
        """
        if not _has_same_geometry(LoopEquations(model, loops, couplings), self.equations):
            return None
        other = copy.copy(self)
        other.__dict__.pop("_solvers", None)
        other.__dict__.pop("_beyond", None)
        return other

    def with_perturbed_model(
        self, model: pin.Model, loops: Sequence[LoopSpec], couplings: Sequence[Coupling]
    ) -> "Closure":
        """The closure of a slightly different tree, with this structure and on this branch.

        It is used for finite differences and has no machine code.

        Args:
            model: The tree.
            loops: Its loops.
            couplings: Its couplings.

        Raises:
            MechanismError: The loops do not close there, or lock.
        """
        equations = LoopEquations(model, loops, couplings)
        if _has_same_geometry(equations, self.equations):
            return self
        other = copy.copy(self)
        other.model, other.equations = model, equations
        other._start_solver(with_machine_code=False)
        constraints = other._constraints
        lock, _ = constraints.assess_redundancy(
            other.home, self.structure.independent_rows, self.structure.redundant_rows, self.active
        )
        if not constraints.is_closed(other.home) or lock:
            raise MechanismError("the loops do not close there, or lock up")
        return other

    def with_home_configuration(self, q: Array) -> "Closure | None":
        """The same coordinates on the branch of another closed configuration.

        Args:
            q: (nq,) the other home configuration, whose full revolutions are kept.

        Returns:
            None where other independent equations determine the passive joints much better.

        Raises:
            MechanismError: The loops do not close there.
        """
        jacobian = self.equations.evaluate_scaled(q)[1][:, self.passive]
        least, best = (
            np.linalg.svd(rows, compute_uv=False).min(initial=1.0)
            for rows in (jacobian[self.structure.independent_rows], jacobian)
        )
        if not least > _MIN_SINGULAR_VALUE_SHARE * best:
            return None
        other = copy.copy(self)
        other.home_search, other.initial_guess = None, q
        other.structure = dataclasses.replace(self.structure, home=q)
        other._start_solver()
        if not other._constraints.is_closed(other.home):
            raise MechanismError("the loops do not close there")
        return other

    @property
    def _constraints(self) -> ExactConstraints:
        is_exact = self.structure.redundancy.tolerance <= CLOSED_TOLERANCE
        return (ExactConstraints if is_exact else RoundedConstraints)(self.equations)

    @property
    def degrees_of_freedom(self) -> int:
        """Number n of active joints."""
        return len(self.active)

    def solve(self, q_a: ArrayLike, initial_guess: ArrayLike | None = None) -> Array:
        """Close the loops: q = f(q_A), equation (3) of the reduced-scale forwarder paper.

        Newton's method starts from the last configuration that this thread solved (or the guess),
        in one step where that stays on the branch; else from home, along the straight line of q_A,
        in steps that are halved where Newton's method converges slowly or would leave the branch.
        A stack is followed like a path; a stack of distant samples is sorted first. Change points,
        where several branches meet, are passed in the direction of the motion, with a warning at
        the first one. The result is closed to rounding and on the branch of home, independently of
        earlier calls, or an error is raised.

        Args:
            q_a: (n,) or (N, n) active coordinates [m], [rad]. Limits are not checked here.
            initial_guess: (nq,) configuration to start from, on the branch of home.

        Returns:
            q, (nq,) or (N, nq).

        Raises:
            InputError: Wrong shape or not finite.
            OutOfReachError: No configuration closes the loops.
            SingularConfigurationError: The branch ends there, at a dead centre.
            WrongBranchError: The guess belongs to another branch.
        """
        if (
            initial_guess is None
            and self.is_compiled
            and (q := self._solvers.value.evaluate_sample(q_a)) is not None
        ):
            return q
        targets = as_samples(q_a, len(self.active), "q_a", self.active_names)
        if targets.size == 0:
            raise InputError("q_a is an empty stack, give at least one sample")
        guess, names = None, self.equations.coordinates.names
        if initial_guess is not None:
            guess = as_sample(initial_guess, self.model.nv, "guess", names)
        out = np.empty((*targets.shape[:-1], self.model.nv))
        self._solve_stack(np.atleast_2d(targets), guess, targets.ndim == 2, np.atleast_2d(out))
        return out

    def follow_motion(self, q_a: ArrayLike, initial_guess: ArrayLike | None = None) -> Array:
        """Closed configurations along a recorded motion, also beyond dead centres.

        `solve` keeps to the branch of home. A motion through a dead centre of its active joints
        leaves this branch, while q_A turns back; here the configurations continue with the motion.

        Args:
            q_a: (N, n) active coordinates, sampled densely enough to extrapolate.
            initial_guess: (nq,) near the first configuration; home if not given.

        Returns:
            (N, nq).

        Raises:
            InputError: Wrong shape or not finite.
            ClosureError: The loops do not close, or the motion does not continue to a sample.
        """
        targets = as_samples(q_a, len(self.active), "q_a", self.active_names)
        if targets.ndim != 2 or not len(targets):
            raise InputError("q_a is no motion, give (N, n) samples")
        return follow_motion(
            self.equations,
            self.active,
            self.equations.motion_scales,
            targets,
            self.solve(targets[0], initial_guess),
        )

    def gamma(self, q: ArrayLike) -> Array:
        """Derivative of f, equation (4) of the reduced-scale forwarder paper.

        Args:
            q: (nq,) or (N, nq) closed configurations.

        Returns:
            gamma, (nv, n) or (N, nv, n): v = gamma v_A.

        Raises:
            InputError: Wrong shape or not finite.
            SingularConfigurationError: The passive joints are not determined there.
        """
        code = self._machine_code
        if code is not None and (gamma := code.gamma_function(q)) is not None:
            return gamma
        q = as_samples(q, self.model.nv, "q", self.equations.coordinates.names)
        if q.size == 0:
            raise InputError("q is an empty stack, give at least one sample")
        out = self._gamma_stack(np.atleast_2d(np.ascontiguousarray(q)), q.ndim == 2)
        return out if q.ndim == 2 else out[0]

    def drift(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Accelerations of the joints at a_A = 0: drift = gammadot v_A, a = gamma a_A + drift.

        Args:
            q: (nq,) or (N, nq) closed configurations.
            v: (nv,) or (N, nv) velocities v = gamma v_A.

        Returns:
            (nv,) or (N, nv) [m/s2], [rad/s2], zero at the active joints.

        Raises:
            InputError: Wrong shape or not finite.
            SingularConfigurationError: The passive joints are not determined there.
        """
        q = as_samples(q, self.model.nv, "q", self.equations.coordinates.names)
        v = as_samples(v, self.model.nv, "v", self.equations.coordinates.names)
        return apply_per_sample(self.continuation.drift, q, v)

    def residual(self, q: ArrayLike) -> Array:
        """Largest absolute residual of all loop equations, redundant ones included.

        Args:
            q: (nq,) or (N, nq).

        Returns:
            () or (N,) [m] for translations, [rad] for small rotations.
        """
        q = as_samples(q, self.model.nv, "q", self.equations.coordinates.names)
        return apply_per_sample(
            lambda one: np.abs(self.equations.evaluate(one)[0]).max(initial=0.0), q
        )

    def condition_number(self, q: ArrayLike) -> Array:
        """Condition number of the active joints: ||D^-1 gamma D_A||_2, D = diag(scales).

        1 where no other joint moves, infinite at the end of the branch; see
        `crane.closure.active_joint_selection`.

        Args:
            q: (nq,) or (N, nq) closed configurations.

        Returns:
            () or (N,).
        """
        return condition_number(self.gamma(q), self.equations.motion_scales, self.active)

    @cached_property
    def proposed_active_joints(self) -> list[ActiveJointSelection]:
        """Possible selections of active joints at home, see `active_joint_selection`."""
        rows = self.structure.independent_rows  # the others contradict these by the file precision
        jacobian = self.equations.evaluate(self.home)[1] / self.equations.residual_units[:, None]
        return propose_active_joints(self.equations, jacobian[rows])

    def gamma_velocity_drift(self, q: Array, v_a: Array) -> tuple[Array, Array, Array]:
        """gamma, v = gamma v_A and drift of one sample in one evaluation.

        Args:
            q: (nq,) closed configuration.
            v_a: (n,) [m/s], [rad/s].

        Returns:
            (nv, n), (nv,), (nv,).
        """
        return self.continuation.gamma_velocity_drift(q, v_a)


def _has_same_geometry(first: LoopEquations, second: LoopEquations) -> bool:
    """Whether two trees of one structure have equal joint frames, limits and loop frames."""
    pairs = [
        [
            x.coupling_factors,
            x.coupling_offsets,
            x.coupling_powers,
            x.coordinates.lower,
            x.coordinates.upper,
            tree_geometry(x).constants,
        ]
        for x in (first, second)
    ]
    return all(np.array_equal(x, y) for x, y in zip(*pairs, strict=True))
