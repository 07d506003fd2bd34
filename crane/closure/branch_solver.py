"""Closing loops on one branch: by machine code where possible, else by `NewtonContinuation`."""

import copy
import threading
from functools import cached_property

import numpy as np

from crane.closure.compiled_closure import CompiledClosure, ContinuationCursor
from crane.closure.constraint_structure import ConstraintStructure, Indices
from crane.closure.loop_equations import LoopEquations
from crane.closure.motion_continuation import sort_samples
from crane.closure.newton_continuation import ClosedConfiguration, NewtonContinuation
from crane.codegen import FormulaTooLongError, run_with_fallback
from crane.common.errors import SingularConfigurationError, WrongBranchError
from crane.common.samples import Array

_SAME_CONFIGURATION_TOLERANCE = 1e-6  # scaled distance of equal configurations
_CONTINUATION_STEPS = 8  # steps from home to a target far from the previous one


class BranchSolver:
    """Closes loops on the branch of a home configuration.

    Each thread has a cursor: the last configuration, from which the next one is continued.

    Args:
        equations: All loop equations.
        structure: Independent equations, and home.
        active: Columns of the active joints.
        passive: Columns of the other joints.
        with_machine_code: Whether to compile the loops.

    Attributes:
        continuation: Newton's method without machine code.
    """

    def __init__(
        self,
        equations: LoopEquations,
        structure: ConstraintStructure,
        active: Indices,
        passive: Indices,
        with_machine_code: bool = True,
    ):
        self._parts = equations, structure, active, passive
        self._units, self._with_machine_code = equations.coordinate_units, with_machine_code
        coordinates = equations.coordinates
        ranges = (coordinates.upper - coordinates.lower)[active]
        self._active_ranges = np.where(
            np.isfinite(ranges) & (ranges > 0), ranges, self._units[active]
        )
        self.continuation = NewtonContinuation(*self._parts, self._active_ranges)
        self._thread_local = threading.local()

    def with_new_cursors(self) -> "BranchSolver":
        """A copy whose threads begin at home."""
        other = copy.copy(self)
        other._thread_local = threading.local()
        return other

    @cached_property
    def compiled_closure(self) -> CompiledClosure | None:
        """Machine code of the loops, None if they are too many for it."""
        home = self.continuation.home
        try:
            return (
                CompiledClosure(*self._parts, home, self.continuation.rounding_scale(home.q))
                if self._with_machine_code
                else None
            )
        except FormulaTooLongError:
            return None

    def _cursor(self, compiled: CompiledClosure) -> ContinuationCursor:
        try:
            return self._thread_local.cursor
        except AttributeError:
            self._thread_local.cursor = compiled.new_cursor()
            return self._thread_local.cursor

    def solve(self, targets: Array, guess: Array | None, stacked: bool, out: Array) -> None:
        """Close the loops at targets (N, n) into out (N, nq).

        Args:
            targets: (N, n) active coordinates.
            guess: (nq,) configuration to start from; the last one if not given.
            stacked: Whether errors contain the number of the sample.
            out: (N, nq).
        """
        compiled, nearest = self.compiled_closure, self.continuation.nearest_closed_configuration
        if compiled is not None:
            cursor = self._cursor(compiled)
            if guess is not None and not compiled.start_cursor_at(cursor, guess):
                cursor.start_from(nearest(guess))
            self._follow_stack(compiled, targets, out, stacked)
            return
        solution = self.continuation.home if guess is None else nearest(guess)
        for i, target in enumerate(targets):
            solution = self.continuation.continue_to(
                target, solution, f" (sample {i})" if stacked else ""
            )
            out[i] = solution.q

    def _follow_stack(
        self, compiled: CompiledClosure, targets: Array, out: Array, stacked: bool
    ) -> None:
        cursor, passive_gamma = self._cursor(compiled), self.continuation.home.passive_gamma
        moves_passive_joints = np.abs(passive_gamma).max(axis=0, initial=0.0) > 0
        order = sort_samples((targets / self._active_ranges)[:, moves_passive_joints])
        sorted_targets = np.ascontiguousarray(targets if order is None else targets[order])
        closed = out if order is None else np.empty_like(out)

        def continue_from_home(i: int) -> None:
            sample = f" (sample {i if order is None else order[i]})" if stacked else ""
            closed[i] = self.continue_from_home(compiled, cursor, sorted_targets[i], sample)

        run_with_fallback(
            len(targets),
            lambda i, _: compiled.follow_targets(cursor, sorted_targets[i:], closed[i:]),
            continue_from_home,
        )
        if order is not None:
            out[order] = closed

    def continue_from_home(
        self, compiled: CompiledClosure, cursor: ContinuationCursor, target: Array, sample: str
    ) -> Array:
        """See `Closure.continue_from_home`."""
        home, n = self.continuation.home, _CONTINUATION_STEPS
        line = home.q_a + np.linspace(0, 1, n + 1)[1:, None] * (target - home.q_a)
        line[-1] = target
        out = np.empty((n, len(home.q)))
        for waypoints in (line[-1:], line[1::2], line):
            cursor.start_from(home)
            if compiled.follow_targets(cursor, waypoints, out) == len(waypoints):
                return out[len(waypoints) - 1]
        solution = self.continuation.continue_to(target, home, sample)
        cursor.start_from(solution)
        return solution.q

    def is_on_branch(self, q: Array) -> bool:
        """Whether a closed configuration (nq,) lies on the branch of home."""
        if self.compiled_closure is not None:
            return self.compiled_closure.start_cursor_at(self._cursor(self.compiled_closure), q)
        try:
            found: ClosedConfiguration = self.continuation.nearest_closed_configuration(q)
        except WrongBranchError:
            return False
        return bool(np.abs((found.q - q) / self._units).max() < _SAME_CONFIGURATION_TOLERANCE)

    def gamma(self, q: Array, stacked: bool, out: Array) -> None:
        """Evaluate gamma at closed configurations (N, nq) into out (N, nv, n)."""
        compiled = self.compiled_closure

        def check_singularity(i: int) -> None:
            try:
                out[i] = self.continuation.gamma(q[i])
            except SingularConfigurationError as error:
                sample = f" (sample {i})" if stacked else ""
                raise SingularConfigurationError(f"{error}{sample}") from None

        run_with_fallback(
            len(q),
            None if compiled is None else lambda i, _: compiled.evaluate_gamma(q[i:], out[i:]),
            check_singularity,
        )
