"""Closing loops on one branch: by machine code where possible, else by `NewtonContinuation`.

Samples of a stack are sorted where they need not be a path. A recorded motion may leave the
branch at dead centres of the recorded coordinates, see `follow_motion`.
"""

from functools import cached_property

import numpy as np

from crane.closure.active_joint_selection import null_space_basis
from crane.closure.compiled_closure import CompiledClosure, ContinuationCursor, ContinuedFunction
from crane.closure.constraint_structure import ConstraintStructure
from crane.closure.continuation_diagnosis import ClosedConfiguration
from crane.closure.coordinates import Indices
from crane.closure.loop_equations import LoopEquations
from crane.closure.newton_continuation import NewtonContinuation
from crane.codegen import FormulaTooLongError, run_with_fallback
from crane.common.errors import ClosureError, SingularConfigurationError, WrongBranchError
from crane.common.samples import Array
from crane.common.threads import ThreadLocal

_SAME_CONFIGURATION_TOLERANCE = 1e-6  # scaled distance of equal configurations
_CONTINUATION_STEPS = 8  # steps from home to a target far from the previous one

_SINGULAR_TOLERANCE = 1e-9  # relative singular value that counts as zero
# least singular value of A below which q_A does not determine q
_WEAK_SINGULAR_VALUE = 0.05
# weight w of the extrapolated motion
_EXTRAPOLATION_WEIGHT = 3e-3
_MAX_ITERATIONS, _STEP_TOLERANCE = 40, 1e-13
_CLOSED_TOLERANCE = 1e-9  # residual of closed loops
# scaled distance to the extrapolation that means another branch
_MAX_EXTRAPOLATION_ERROR = 0.5

# samples worth sorting: number, and mean distance of neighbours as a fraction of the range
_MIN_SAMPLES_TO_SORT, _FAR_SAMPLE_DISTANCE = 100, 0.1


class _ChangePointBranch:
    """A branch beyond change points: the last configuration there, and machine code to go on.

    Args:
        home: (nq,) home configuration.

    Attributes:
        configuration: Configuration from which it goes on, None at first.
        code: Machine code for the signs of its determinants.
        cursor: Cursor of this code; None where the signs are those at home.
        q: (nq,) configuration that `follow` reached last.
    """

    code: CompiledClosure

    def __init__(self, home: Array):
        self.configuration: ClosedConfiguration | None = None
        self.cursor: ContinuationCursor | None = None
        self.q = home.copy()

    def follow(self, target: Array) -> bool:
        """Close the loops at a target (n,) next to the last; returns whether this succeeds."""
        if self.cursor is None:
            return False
        return self.code.follow_targets(self.cursor, target[None], self.q[None]) == 1


class BranchSolver:
    """Closes loops on the branch of a home configuration; base class of `Closure`.

    Each thread has a cursor: the last configuration, from which the next one is continued.

    Attributes:
        equations: All loop equations.
        structure: Independent equations, and home.
        active: Columns of the active joints.
        passive: Columns of the other joints.
        home: (nq,) closed home configuration.
        continuation: Newton's method without machine code.
    """

    equations: LoopEquations
    structure: ConstraintStructure
    active: Indices
    passive: Indices

    def _start_solver(self, with_machine_code: bool = True) -> None:
        """Close home, from which the branch is followed."""
        coordinates, units = self.equations.coordinates, self.equations.coordinate_units
        ranges = (coordinates.upper - coordinates.lower)[self.active]
        limited = np.isfinite(ranges) & (ranges > 0)
        self._active_ranges = np.where(limited, ranges, units[self.active])
        self._parts = self.equations, self.structure, self.active, self.passive
        self.continuation = NewtonContinuation(*self._parts, self._active_ranges)
        self.home = self.continuation.home.q.copy()
        self.home.flags.writeable = False
        self._with_machine_code = with_machine_code
        # of the closure that this one is a copy of
        for name in ("_machine_code", "_solvers", "_beyond", "_codes_beyond"):
            self.__dict__.pop(name, None)

    @cached_property
    def _machine_code(self) -> CompiledClosure | None:
        """Machine code of the loops, None if they are too many for it."""
        if not self._with_machine_code:
            return None
        home = self.continuation.home
        try:
            return CompiledClosure(*self._parts, home, self.continuation.rounding_scale(home.q))
        except FormulaTooLongError:
            return None

    @property
    def is_compiled(self) -> bool:
        """Whether the loops are solved by machine code."""
        return self._machine_code is not None

    @property
    def compiled_closure(self) -> CompiledClosure:
        """Machine code of the loops, compiled on first use.

        Raises:
            FormulaTooLongError: The machine is too large for it.
        """
        if self._machine_code is None:
            raise FormulaTooLongError
        return self._machine_code

    @cached_property
    def _solvers(self) -> ThreadLocal[ContinuedFunction]:
        return ThreadLocal(self.compiled_closure.new_solver)

    @cached_property
    def _beyond(self) -> ThreadLocal["_ChangePointBranch"]:
        return ThreadLocal(lambda: _ChangePointBranch(self.home))

    @cached_property
    def _codes_beyond(self) -> dict[bytes, CompiledClosure]:
        """Machine code beyond change points, by the signs of determinants there."""
        return {}

    def _solve_stack(self, targets: Array, guess: Array | None, stacked: bool, out: Array) -> None:
        """Close the loops at targets (N, n) into out (N, nq).

        Args:
            targets: (N, n) active coordinates.
            guess: (nq,) configuration to start from; the last one if not given.
            stacked: Whether errors contain the number of the sample.
            out: (N, nq).
        """
        nearest = self.continuation.nearest_closed_configuration
        if self.is_compiled:
            cursor = self._solvers.value.cursor
            if guess is not None and not self.compiled_closure.start_cursor_at(cursor, guess):
                cursor.start_from(known := nearest(guess))
                self._go_beyond(known)
            self._follow_stack(cursor, targets, out, stacked)
            return
        solution = self.continuation.home if guess is None else nearest(guess)
        for i, target in enumerate(targets):
            sample = f" (sample {i})" if stacked else ""
            solution = self.continuation.continue_to(target, solution, sample)
            out[i] = solution.q

    def _follow_stack(
        self, cursor: ContinuationCursor, targets: Array, out: Array, stacked: bool
    ) -> None:
        compiled, passive_gamma = self.compiled_closure, self.continuation.home.passive_gamma
        moves_passive_joints = np.abs(passive_gamma).max(axis=0, initial=0.0) > 0
        order = sort_samples((targets / self._active_ranges)[:, moves_passive_joints])
        sorted_targets = np.ascontiguousarray(targets if order is None else targets[order])
        closed = out if order is None else np.empty_like(out)

        def continue_from_home(i: int) -> None:
            sample = f" (sample {i if order is None else order[i]})" if stacked else ""
            closed[i] = self.continue_from_home(cursor, sorted_targets[i], sample)

        run_with_fallback(
            len(targets),
            lambda i: compiled.follow_targets(cursor, sorted_targets[i:], closed[i:]),
            continue_from_home,
        )
        if order is not None:
            out[order] = closed

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
        home, n, beyond = self.continuation.home, _CONTINUATION_STEPS, self._beyond.value
        if beyond.follow(target):
            return beyond.q.copy()
        line = home.q_a + np.linspace(0, 1, n + 1)[1:, None] * (target - home.q_a)
        line[-1] = target
        out = np.empty((n, len(home.q)))
        for waypoints in (line[-1:], line[1::2], line):
            cursor.start_from(home)
            if self.compiled_closure.follow_targets(cursor, waypoints, out) == len(waypoints):
                return out[len(waypoints) - 1]
        solution = self.continuation.continue_to(target, beyond.configuration or home, sample)
        cursor.start_from(solution)
        self._go_beyond(solution)
        return solution.q

    def neighbours(self, q: Array) -> list[Array]:
        """Configurations about one in a change point that `continue_from_home` returned.

        Empty for others. See `crane.closure.change_points.interpolate_limit`.
        """
        last = self._beyond.value.configuration
        return [node.q for node in last.neighbours] if last is not None and last.q is q else []

    def _go_beyond(self, solution: ClosedConfiguration) -> None:
        """Continue from a configuration with machine code for the signs of its determinants."""
        beyond, code = self._beyond.value, self.compiled_closure
        changes = np.sign(self.continuation.determinants(solution))
        # on the branch of home solutions must not depend on earlier ones
        is_beyond = (changes <= 0).any() or bool(solution.neighbours)
        beyond.configuration, beyond.cursor = solution if is_beyond else None, None
        if not (changes < 0).any() or not changes.all():
            return
        key = changes.tobytes()
        if key not in self._codes_beyond:
            home = self.continuation.home
            scale, signs = self.continuation.rounding_scale(home.q), code.signs * changes
            self._codes_beyond[key] = CompiledClosure(*self._parts, home, scale, signs)
        beyond.code = self._codes_beyond[key]
        beyond.cursor = beyond.code.new_cursor()
        beyond.cursor.start_from(solution)

    def is_on_branch(self, q: Array) -> bool:
        """Whether a closed configuration (nq,) lies on the branch of home."""
        if self.is_compiled:
            return self.compiled_closure.start_cursor_at(self._solvers.value.cursor, q)
        try:
            found = self.continuation.nearest_closed_configuration(q)
        except WrongBranchError:
            return False
        difference = (found.q - q) / self.equations.coordinate_units
        return bool(np.abs(difference).max() < _SAME_CONFIGURATION_TOLERANCE)

    def _gamma_stack(self, q: Array, stacked: bool) -> Array:
        """Gamma at closed configurations (N, nq), (N, nv, n)."""
        compiled, out = self._machine_code, np.empty((*q.shape, len(self.active)))

        def check_singularity(i: int) -> None:
            try:
                out[i] = self.continuation.gamma(q[i])
            except SingularConfigurationError as error:
                sample = f" (sample {i})" if stacked else ""
                raise SingularConfigurationError(f"{error}{sample}") from None

        run_with_fallback(
            len(q),
            None if compiled is None else lambda i: compiled.evaluate_gamma(q[i:], out[i:]),
            check_singularity,
        )
        return out


def sort_samples(scaled: Array) -> Indices | None:
    """An order of samples (N, n) with close neighbours; None if they need no sorting.

    Samples are sorted into cells of all coordinates but the last, and by the last one within a
    cell.

    Args:
        scaled: (N, n) coordinates as fractions of their ranges.
    """
    if len(scaled) <= _MIN_SAMPLES_TO_SORT or not scaled.size:
        return None
    if np.abs(np.diff(scaled, axis=0)).max(axis=1).mean() < _FAR_SAMPLE_DISTANCE:
        return None
    cells = np.floor(scaled * len(scaled) ** (1 / scaled.shape[1]))
    return np.asarray(np.lexsort((scaled[:, -1], *cells[:, :-1].T)))


def follow_motion(
    equations: LoopEquations,
    active_columns: Indices,
    motion_scales: Array,
    q_a: Array,
    first_configuration: Array,
) -> Array:
    """Configurations of recorded active coordinates, by continuity of the motion.

    Where an active coordinate turns back at a dead centre, two configurations have the same q_A.
    The one nearest to the extrapolated motion is taken: with N the motions that the loops allow, A
    its rows of the active joints, r the remaining step of the recorded coordinates and p that of
    the extrapolated motion,

        min |A y - r|^2 + w^2 |y - p|^2,

    with a small w near a dead centre, and w = 0 where A is regular, so that the recorded
    coordinates are met exactly.

    Args:
        equations: The loop equations.
        active_columns: (n,) columns of the active joints.
        motion_scales: (nq,) comparable displacements of the joints.
        q_a: (N, n), sampled densely enough to extrapolate.
        first_configuration: (nq,) closed configuration of the first sample.

    Raises:
        ClosureError: The motion does not continue to a sample.
    """
    coordinates = equations.coordinates
    passive_columns = np.setdiff1d(np.arange(len(first_configuration)), active_columns)

    def displaced(q: Array, displacement: Array) -> Array:
        return q + coordinates.coordinate_derivatives(q, displacement)

    out = np.empty((len(q_a), len(first_configuration)))
    for k, target in enumerate(q_a):
        if not k:
            out[0] = first_configuration
            continue
        last, *before = [coordinates.unwrap_rotations(q, out[k - 1]) for q in out[:k][-1:-4:-1]]
        extrapolated = last if k < 2 else 2 * last - before[0]
        if k > 2:
            extrapolated = 3 * last - 3 * before[0] + before[1]
        q, is_weak = extrapolated.copy(), True
        for _ in range(_MAX_ITERATIONS):
            residual, jacobian = equations.evaluate(q)
            null_space = null_space_basis(jacobian, motion_scales, _SINGULAR_TOLERANCE)
            normal_step = -np.linalg.lstsq(
                jacobian * motion_scales, residual, rcond=_SINGULAR_TOLERANCE
            )[0]
            corrected = displaced(q, motion_scales * normal_step)
            active_rows = (coordinates.rate_matrix(q) @ null_space)[active_columns]
            remaining = (target - corrected[active_columns]) / motion_scales[active_columns]
            is_weak = bool(
                np.linalg.svd(active_rows, compute_uv=False).min(initial=1.0)
                < _WEAK_SINGULAR_VALUE
            )
            weight = _EXTRAPOLATION_WEIGHT * is_weak
            system = np.vstack([active_rows, weight * np.eye(active_rows.shape[1])])
            right = np.concatenate(
                [remaining, weight * (null_space.T @ ((extrapolated - corrected) / motion_scales))]
            )
            step = normal_step + null_space @ np.linalg.lstsq(system, right, rcond=None)[0]
            q = displaced(q, motion_scales * step)
            if np.abs(step).max(initial=0.0) < _STEP_TOLERANCE:
                break
        residual, _ = equations.evaluate(q)
        deviation = float(np.abs((q - extrapolated) / motion_scales).max(initial=0.0))
        if not (
            np.abs(residual).max(initial=0.0) < _CLOSED_TOLERANCE
            and deviation < _MAX_EXTRAPOLATION_ERROR
        ):
            raise ClosureError(
                f"sample {k}: the motion does not go on to it, it is {deviation:.2g} of a way "
                "off: record more samples, or see that zeros and signs are the machine's"
            )
        out[k] = coordinates.wrap_rotations(q, passive_columns)
    return out
