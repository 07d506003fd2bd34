"""`Closure`: solves the loops of a machine, q = f(q_A), v = gamma v_A, a = gamma a_A + drift.

Newton's method for one configuration is `NewtonContinuation.solve_newton` in
`crane.closure.newton_continuation`; in machine code the routine `close` of
`crane.closure.compiled_closure`.
"""

import copy
import dataclasses
import threading
from collections.abc import Collection, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from crane.closure.active_joint_selection import (
    ActiveJointSelection,
    condition_number,
    propose_active_joints,
)
from crane.closure.compiled_closure import CompiledClosure, ContinuationCursor
from crane.closure.constraint_structure import ConstraintStructure
from crane.closure.constraint_tolerances import (
    CLOSED_TOLERANCE,
    ExactConstraints,
    RedundancyGap,
    RoundedConstraints,
)
from crane.closure.home_search import HomeSearchResult, find_home
from crane.closure.kinematics_formulas import tree_geometry
from crane.closure.loop_equations import LoopEquations
from crane.closure.motion_continuation import follow_motion
from crane.closure.newton_continuation import NewtonContinuation
from crane.codegen import FormulaTooLongError, cached_result, run_with_fallback
from crane.common.errors import (
    InputError,
    MechanismError,
    SingularConfigurationError,
    WrongBranchError,
)
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array, apply_per_sample, as_samples, solve_linear
from crane.common.threads import single_threaded_blas
from crane.description import Coupling, LoopSpec

_MIN_SAMPLES_TO_SORT, _FAR_SAMPLE_DISTANCE = (
    100,
    0.1,
)  # samples worth sorting: how many, how far apart as a share of the range
# rad, machine's size, between a posture and what Newton's method makes of it
_SAME_CONFIGURATION_TOLERANCE = 1e-6
# share of the least singular value of all equations that independent ones keep
_MIN_SINGULAR_VALUE_SHARE = 0.1
_CONTINUATION_STEPS = 8  # steps from home to a target far from the previous one


class Closure(OneLineRepr):
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
        couplings: Linear constraints of joints.
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
        characteristic_length: Characteristic length of the machine [m], see
            `crane.closure.active_joint_selection.characteristic_length`.
        units: (nv,) units that make coordinates comparable: 1 rad, and the characteristic length
            [m].
        characteristic_time: Characteristic time [s] of motions under gravity, 1 s for a machine of
            1 m: times of similar machines scale with the square root of the length (Froude).
        home_search: How home was found where it did not follow from the guess, else None.
    """

    home: Array
    initial_guess: Array
    specified_columns: NDArray[np.intp]
    structure: ConstraintStructure
    home_search: HomeSearchResult | None

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
        self.characteristic_length, self.units = (
            self.equations.characteristic_length,
            self.equations.coordinate_units,
        )
        self.characteristic_time = float(np.sqrt(self.characteristic_length))
        self._thread_local = threading.local()
        self.active_names = tuple(active)
        coordinates = self.equations.coordinates
        self.active = np.array([coordinates.column(name) for name in active], dtype=np.intp)
        self.passive = np.delete(np.arange(model.nv), self.active)
        self._names = coordinates.names

        def columns(names: Collection[str]) -> list[int]:
            return [coordinates.column(name) for name in names]

        self.initial_guess = initial_guess
        self.specified_columns = np.array(sorted(columns(specified or ())), dtype=np.intp)
        where = None if specified is None else columns(specified), columns(movable)
        self.structure, self.home_search = self._find_home(*where)
        if keep_revolutions:
            revolutions = np.round((initial_guess - self.structure.home) / (2 * np.pi))
            revolutions[coordinates.is_translation] = 0.0
            home = self.structure.home + 2 * np.pi * revolutions
            self.structure = dataclasses.replace(self.structure, home=home)
        ranges = (coordinates.upper - coordinates.lower)[self.active]
        limited = np.isfinite(ranges) & (ranges > 0)
        self._active_ranges = np.where(
            limited, ranges, self.equations.coordinate_units[self.active]
        )
        self._continuation = NewtonContinuation(
            self.equations,
            self.structure,
            self._names,
            self.active,
            self.passive,
            self._active_ranges,
        )
        self.home = self._continuation.home.q.copy()
        self.home.flags.writeable = False

    def _find_home(
        self, specified: list[int] | None, movable: list[int]
    ) -> tuple[ConstraintStructure, HomeSearchResult | None]:
        def find() -> tuple[ConstraintStructure, HomeSearchResult | None]:
            import scipy.linalg  # noqa: F401 - loads the BLAS library to limit

            with single_threaded_blas(self.model.nv):
                return find_home(
                    self.equations,
                    self.active,
                    self.passive,
                    self.initial_guess,
                    specified,
                    movable,
                )

        if not self.equations.names:
            return find_home(
                self.equations, self.active, self.passive, self.initial_guess, specified, movable
            )
        specified_key = None if specified is None else tuple(specified)
        depends = (self.cache_key, self.active, self.initial_guess, specified_key, tuple(movable))
        return cached_result(
            ("home", depends),
            find,
            "scipy.linalg",
            (ConstraintStructure, RedundancyGap, HomeSearchResult),
        )

    @property
    def cache_key(self) -> tuple[Any, ...]:
        """Everything that the equations depend on, see `crane.codegen.cached_result`."""
        loops = tuple(
            (x.name, x.type, x.predecessor, x.successor, *map(float, x.axis))
            for x in self.equations.loops
        )
        couplings = tuple(
            (x.name, tuple(x.factors.items()), x.offset) for x in self.equations.couplings
        )
        return self.model.saveToString(), loops, couplings

    def _one_line(self) -> str:
        """Loops and active joints."""
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
        other._thread_local = threading.local()  # cursors belong to one closure
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
        other.model, other.equations, other._thread_local = model, equations, threading.local()
        other.characteristic_length, other.units = (
            equations.characteristic_length,
            equations.coordinate_units,
        )
        other.characteristic_time = float(np.sqrt(other.characteristic_length))
        other.__dict__["_optional_compiled_closure"] = None
        other._continuation = NewtonContinuation(
            equations, self.structure, self._names, self.active, self.passive, self._active_ranges
        )
        other.home = other._continuation.home.q.copy()
        other.home.flags.writeable = False
        exact = (
            ExactConstraints
            if self.structure.redundancy.tolerance <= CLOSED_TOLERANCE
            else RoundedConstraints
        )(equations)
        rows = self.structure.independent_rows, self.structure.redundant_rows
        if (
            not exact.is_closed(other.home)
            or exact.assess_redundancy(other.home, *rows, self.active)[0]
        ):
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
        other._thread_local, other.home_search, other.initial_guess = threading.local(), None, q
        other.__dict__.pop("_optional_compiled_closure", None)
        other.structure = dataclasses.replace(self.structure, home=q)
        other._continuation = NewtonContinuation(
            self.equations,
            other.structure,
            self._names,
            self.active,
            self.passive,
            self._active_ranges,
        )
        other.home = other._continuation.home.q.copy()
        other.home.flags.writeable = False
        exact = (
            ExactConstraints
            if self.structure.redundancy.tolerance <= CLOSED_TOLERANCE
            else RoundedConstraints
        )(self.equations)
        if not exact.is_closed(other.home):
            raise MechanismError("the loops do not close there")
        return other

    @cached_property
    def _optional_compiled_closure(self) -> CompiledClosure | None:
        branch = self._continuation
        try:
            return CompiledClosure(
                self.equations,
                self.structure,
                self.active,
                self.passive,
                branch.home,
                branch.rounding_scale(branch.home.q),
            )
        except FormulaTooLongError:
            return None

    @property
    def is_compiled(self) -> bool:
        """Whether the loops are solved by machine code."""
        return self._optional_compiled_closure is not None

    @property
    def compiled_closure(self) -> CompiledClosure:
        """Machine code of the loops, compiled on first use.

        Raises:
            FormulaTooLongError: The machine is too large for it.
        """
        if self._optional_compiled_closure is None:
            raise FormulaTooLongError
        return self._optional_compiled_closure

    @property
    def _cursor(self) -> ContinuationCursor:
        """The cursor of this thread."""
        try:
            return self._thread_local.cursor
        except AttributeError:
            self._thread_local.cursor = self.compiled_closure.new_cursor()
            return self._thread_local.cursor

    @property
    def degrees_of_freedom(self) -> int:
        """Number n of active joints."""
        return len(self.active)

    def solve(self, q_a: ArrayLike, initial_guess: ArrayLike | None = None) -> Array:
        """Close the loops: q = f(q_A), equation (3) of the reduced-scale forwarder paper.

        Newton's method starts from the last configuration that this thread solved (or the guess),
        in one step where that stays on the branch; else from home, along the straight line of q_A,
        in steps that are halved where Newton's method converges slowly or would leave the branch.
        A stack is followed like a path; a stack of distant samples is sorted first. The result is
        closed to rounding and on the branch of home, independently of earlier calls, or an error
        is raised.

        Args:
            q_a: (n,) or (N, n) active coordinates [m], [rad]. Limits are not checked here.
            initial_guess: (nq,) configuration to start from, on the branch of home.

        Returns:
            q, (nq,) or (N, nq).

        Raises:
            InputError: Wrong shape or not finite.
            OutOfReachError: No configuration closes the loops.
            SingularConfigurationError: The passive joints are not determined there.
            WrongBranchError: The guess belongs to another branch.
        """
        targets = as_samples(q_a, len(self.active), "q_a", self.active_names)
        if targets.size == 0:
            raise InputError("q_a is an empty stack, give at least one sample")
        guessed_configuration = None
        if initial_guess is not None:
            guessed_configuration = as_samples(initial_guess, self.model.nv, "guess", self._names)
            if guessed_configuration.ndim != 1:
                raise InputError(
                    f"guess has the shape {guessed_configuration.shape}, give one "
                    f"({self.model.nv},)"
                )
            if self.is_compiled and not self.compiled_closure.start_cursor_at(
                self._cursor, guessed_configuration
            ):
                self._cursor.start_from(
                    self._continuation.nearest_closed_configuration(guessed_configuration)
                )
        out = np.empty((*targets.shape[:-1], self.model.nv))
        if not self.is_compiled:
            known = (
                self._continuation.home
                if guessed_configuration is None
                else self._continuation.nearest_closed_configuration(guessed_configuration)
            )
            for i, target in enumerate(np.atleast_2d(targets)):
                sample = f" (sample {i})" if targets.ndim == 2 else ""
                known = self._continuation.continue_to(target, known, sample)
                out[(i,) if targets.ndim == 2 else ()] = known.q
            return out
        self._solve_stack(np.atleast_2d(targets), np.atleast_2d(out), stacked=targets.ndim == 2)
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
        first = self.solve(targets[0], initial_guess)
        return follow_motion(
            self.equations, self.active, self.equations.motion_scales, targets, first
        )

    def _solve_stack(self, targets: Array, out: Array, stacked: bool) -> None:
        """Close the loops at targets (N, n) into out (N, nq)."""
        order = self._sort_samples(targets) if len(targets) > _MIN_SAMPLES_TO_SORT else None
        sorted_targets = np.ascontiguousarray(targets if order is None else targets[order])
        closed = out if order is None else np.empty_like(out)

        def continue_from_home(i: int) -> None:
            sample = f" (sample {i if order is None else order[i]})" if stacked else ""
            closed[i] = self.continue_from_home(self._cursor, sorted_targets[i], sample)

        run_with_fallback(
            len(targets),
            lambda i, _: self.compiled_closure.follow_targets(
                self._cursor, sorted_targets[i:], closed[i:]
            ),
            continue_from_home,
        )
        if order is not None:
            out[order] = closed

    def _sort_samples(self, targets: Array) -> NDArray[np.intp] | None:
        """An order of distant samples with close neighbours; None for samples along a path.

        Samples are sorted into cells of all coordinates but the last, and by the last one within a
        cell. Coordinates that move no passive joint are ignored.
        """
        moves_passive_joints = (
            np.abs(self._continuation.home.passive_gamma).max(axis=0, initial=0.0) > 0
        )
        scaled = (targets / self._active_ranges)[:, moves_passive_joints]
        if (
            not scaled.size
            or np.abs(np.diff(scaled, axis=0)).max(axis=1).mean() < _FAR_SAMPLE_DISTANCE
        ):
            return None
        cells = np.floor(scaled * len(targets) ** (1 / scaled.shape[1]))
        order: NDArray[np.intp] = np.lexsort((scaled[:, -1], *cells[:, :-1].T))
        return order

    def is_on_branch(self, q: Array) -> bool:
        """Whether a closed configuration (nq,) lies on the branch of home."""
        if self.is_compiled:
            return self.compiled_closure.start_cursor_at(self._cursor, q)
        try:
            solution = self._continuation.nearest_closed_configuration(q)
        except WrongBranchError:
            return False
        return bool(np.abs((solution.q - q) / self.units).max() < _SAME_CONFIGURATION_TOLERANCE)

    def continue_from_home(
        self, cursor: ContinuationCursor, target: Array, sample: str = ""
    ) -> Array:
        """Close the loops at a target that is too far for one step, and move the cursor there.

        In several steps from home, or else by `NewtonContinuation`.

        Args:
            cursor: Cursor to move.
            target: (n,).
            sample: Name of the target in errors.

        Returns:
            q (nq,).
        """
        home = self._continuation.home
        line = home.q_a + np.linspace(0, 1, _CONTINUATION_STEPS + 1)[1:, None] * (
            target - home.q_a
        )
        line[-1] = target
        out = np.empty((_CONTINUATION_STEPS, self.model.nv))
        for waypoints in (line[-1:], line[1::2], line):
            cursor.start_from(home)
            if self.compiled_closure.follow_targets(cursor, waypoints, out) == len(waypoints):
                return out[len(waypoints) - 1]
        solution = self._continuation.continue_to(target, home, sample)
        cursor.start_from(solution)
        return solution.q

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
        q = as_samples(q, self.model.nv, "q", self._names)
        if not self.is_compiled:
            return apply_per_sample(self._gamma_of_sample, q)
        if q.size == 0:
            raise InputError("q is an empty stack, give at least one sample")
        rows = np.atleast_2d(np.ascontiguousarray(q))
        out = np.empty((len(rows), self.model.nv, len(self.active)))

        def pivoted(i: int) -> None:  # at nearly singular configurations
            try:
                out[i] = self._gamma_of_sample(rows[i])
            except SingularConfigurationError as error:
                sample = f" (sample {i})" if q.ndim == 2 else ""
                raise SingularConfigurationError(f"{error}{sample}") from None

        run_with_fallback(
            len(rows),
            lambda i, _: self.compiled_closure.evaluate_gamma(rows[i:], out[i:]),
            pivoted,
        )
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
        q = as_samples(q, self.model.nv, "q", self._names)
        v = as_samples(v, self.model.nv, "v", self._names)
        return apply_per_sample(self._drift_of_sample, q, v)

    def residual(self, q: ArrayLike) -> Array:
        """Largest absolute residual of all loop equations, redundant ones included.

        Args:
            q: (nq,) or (N, nq).

        Returns:
            () or (N,) [m] for translations, [rad] for small rotations.
        """
        q = as_samples(q, self.model.nv, "q", self._names)
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
        coupled = np.flatnonzero((self.equations.coupling_factors != 0).any(axis=0)).tolist()
        rows = self.structure.independent_rows  # the others contradict these by the file precision
        jacobian = self.equations.evaluate(self.home)[1] / self.equations.residual_units[:, None]
        return propose_active_joints(self.model, jacobian[rows], coupled)

    def gamma_velocity_drift(self, q: Array, v_a: Array) -> tuple[Array, Array, Array]:
        """gamma, v = gamma v_A and drift of one sample in one evaluation.

        Args:
            q: (nq,) closed configuration.
            v_a: (n,) [m/s], [rad/s].

        Returns:
            (nv, n), (nv,), (nv,).
        """
        jacobian = self.equations.evaluate_scaled(q)[1][self.structure.independent_rows]
        gamma = self._insert_passive_gamma(self._passive_gamma(jacobian, q))
        v = gamma @ v_a
        return gamma, v, self._drift_from_jacobian(jacobian, q, v)

    def _gamma_of_sample(self, q: Array) -> Array:
        return self._insert_passive_gamma(
            self._passive_gamma(
                self.equations.evaluate_scaled(q)[1][self.structure.independent_rows], q
            )
        )

    def _passive_gamma(self, jacobian: Array, q: Array) -> Array:
        """(passive, n) rows of gamma, from a scaled Jacobian."""
        rows = self._solve_passive(jacobian, jacobian[:, self.active], q)
        coordinate_units = self.equations.coordinate_units
        return rows * coordinate_units[self.passive, None] / coordinate_units[self.active]

    def _drift_of_sample(self, q: Array, v: Array) -> Array:
        return self._drift_from_jacobian(
            self.equations.evaluate_scaled(q)[1][self.structure.independent_rows], q, v
        )

    def _insert_passive_gamma(self, passive: Array) -> Array:
        gamma = np.zeros((self.model.nv, len(self.active)))
        gamma[self.active] = np.eye(len(self.active))
        gamma[self.passive] = passive
        return gamma

    def _drift_from_jacobian(self, jacobian: Array, q: Array, v: Array) -> Array:
        drift = np.zeros(self.model.nv)
        acceleration_bias = (
            self.equations.acceleration_bias(q, v) / self.equations.residual_units
        )[self.structure.independent_rows]
        passive_drift = self._solve_passive(jacobian, acceleration_bias, q)
        drift[self.passive] = passive_drift * self.equations.coordinate_units[self.passive]
        return drift

    def _solve_passive(self, jacobian: Array, right_side: Array, q: Array) -> Array:
        """-J_P^-1 right_side, all scaled."""
        try:
            solution = solve_linear(jacobian[:, self.passive], -right_side)
        except np.linalg.LinAlgError:
            raise self._continuation.singularity_error(jacobian, q[self.active]) from None
        self._continuation.check_singularity(jacobian, solution, q[self.active])
        return solution


def _has_same_geometry(first: LoopEquations, second: LoopEquations) -> bool:
    """Whether two trees of one structure have equal joint frames, limits and loop frames."""
    pairs = [
        [
            x.coupling_factors,
            x.coupling_offsets,
            x.coordinates.lower,
            x.coordinates.upper,
            tree_geometry(x).constants,
        ]
        for x in (first, second)
    ]
    return all(np.array_equal(x, y) for x, y in zip(*pairs, strict=True))
