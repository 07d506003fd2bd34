"""The tip (or any other frame) as a function of the active coordinates, and back."""

import math
from functools import cached_property

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from crane.closure.traced import Bodies, Constants, Loops, MovingBodies, folded
from crane.codegen import Number, Program, Tape, TooLongError
from crane.codegen.scalar import add, cross, dot, scale, subtract, times
from crane.common.errors import ClosureError, InputError, UnreachableTipError, known
from crane.common.samples import Array, as_sample, as_samples, per_sample
from crane.common.shown import Brief
from crane.common.threads import PerThread
from crane.machine import Machine
from crane.motion.attitude import INCLINATION, Attitude, Inclination, Rotation, roll_pitch_yaw

# in shares of the machine's size, or of the distance of what is sought if that is farther
_ACCURACY = 1e-11
_ROUNDING = 1e-15
_RANK = 1e-6  # of the machine's size, by which a stroke moves the frame
_ORTHOGONAL = 1e-6
_GRID = 243  # postures all over the strokes
_STARTS = 40  # postures to start from, where an attitude is sought
_STRIDE = 16  # samples of a path between those that are searched for one by one
_CHUNK = 1000  # samples of a stack at once
_BESIDE = 0.02  # share of the strokes by which a sample may miss the curve through those


ATTITUDES = (INCLINATION, "rotation")


def norm(vector: Array) -> float:
    """Its length."""
    return float(np.linalg.norm(vector))


class Kinematics(Brief):
    """Position of one frame as a function of q_A.

        x = p(f(q_A)),    x' = J gamma v_A,    x'' = J gamma a_A + bias.

    Where an attitude is asked for, its coordinates come after those of the position: the
    "inclination" of the frame, or its whole "rotation", whose rates are the angular velocity; see
    `crane.motion.attitude`.

    Args:
        machine: The machine.
        frame: A link; the machine's tip if not given.

    Raises:
        InputError: Unknown frame, or the machine has no tip.
    """

    def __init__(self, machine: Machine, frame: str | None = None):
        if frame is None:
            if machine.tip is None:
                raise InputError(
                    f"machine '{machine.name}' has no tip, name a frame: a link here, or as 'tip' "
                    "in the machine file"
                )
            frame = machine.tip
        self.machine, self.frame = machine, frame
        self._model = machine.model
        self._frame = machine.frame(frame)
        span = machine.upper - machine.lower
        # free joints stay where they are
        units = machine.closure.units[machine.closure.active]
        self._scale = np.where(np.isfinite(span), span, units) * machine.driven
        self._size = machine.closure.size
        self._turned: dict[str, Attitude] = {}
        self._memory = PerThread(self._model.createData)

    def _line(self) -> str:
        """What moves, of what."""
        return f"Kinematics of '{self.frame}' of '{self.machine.name}'"

    def position(self, q_a: ArrayLike) -> Array:
        """Position in the world.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            (3,) or (N, 3) [m].
        """
        return self._positions(self.machine.closure.solve(q_a))

    def positions(self, q: ArrayLike) -> Array:
        """Position in the world at postures that are closed already.

        Args:
            q: (nq,) or (N, nq) [m], [rad].

        Returns:
            (3,) or (N, 3) [m].
        """
        return self._positions(as_samples(q, self._model.nv, "q", self.machine.joints))

    def _positions(self, q: Array) -> Array:
        if q.ndim == 2 and self._points is not None:
            return self._points.rows(q)
        return per_sample(self.position_at, q)

    def position_at(self, q: Array) -> Array:
        """Position (3,) [m] of one posture (nq,)."""
        pin.forwardKinematics(self._model, self._data, self.machine.coordinates.configuration(q))
        placement = pin.updateFramePlacement(self._model, self._data, self._frame)
        return np.array(placement.translation)

    def rotation(self, q_a: ArrayLike) -> Array:
        """Rotation matrix of the frame, seen from the world.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            (3, 3) or (N, 3, 3).
        """
        q = self.machine.closure.solve(q_a)
        return per_sample(lambda one: self._pose(one)[1], q)

    def inclination(self, q_a: ArrayLike) -> Array:
        """By how much the frame's x axis points above the horizontal, in the plane it turns in.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            () or (N,) [rad], within -pi to pi.

        Raises:
            InputError: The frame has none, see `crane.motion.attitude.Inclination`.
        """
        return Inclination(self.machine, self.frame).value(self.rotation(q_a))

    def jacobian(self, q_a: ArrayLike, attitude: str | None = None) -> Array:
        """Reduced Jacobian dx/dq_A = J gamma.

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            attitude: Whose rates come after those of the position; see the class.

        Returns:
            (3, n) or (N, 3, n); with the k coordinates of an attitude 3 + k in place of 3.
        """
        q = self.machine.closure.solve(q_a)
        if attitude is not None:
            turned = self._attitude(attitude)
            return per_sample(lambda one: self._rows(one, turned), q)
        if q.ndim == 2 and self._fast is not None:
            return self._fast.rows(q)[:, 3:-3].reshape(len(q), 3, -1)
        return per_sample(self._jacobian, q)

    def bias(self, q_a: ArrayLike, v_a: ArrayLike, attitude: str | None = None) -> Array:
        """Acceleration of the frame at a_A = 0.

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            v_a: The same shape [m/s], [rad/s].
            attitude: Whose second rates come after those of the position; see the class.

        Returns:
            (3,) or (N, 3) [m/s2]; with the k coordinates of an attitude 3 + k in place of 3.
        """
        names = self.machine.active
        turned = None if attitude is None else self._attitude(attitude)

        def one(q: Array, v_a: Array) -> Array:
            v = self.machine.closure.gamma(q) @ v_a
            drift = self.machine.closure.drift(q, v)
            at = self.machine.coordinates.configuration(q)
            pin.forwardKinematics(self._model, self._data, at, v, drift)
            axes = pin.LOCAL_WORLD_ALIGNED
            second = pin.getFrameClassicalAcceleration(self._model, self._data, self._frame, axes)
            if turned is None:
                return np.array(second.linear)
            rate = pin.getFrameVelocity(self._model, self._data, self._frame, axes)
            rotation = pin.updateFramePlacement(self._model, self._data, self._frame).rotation
            bend = turned.bend(rotation, rate.angular, second.angular)
            return np.concatenate([second.linear, bend])

        v_a = as_samples(v_a, len(names), "v_a", names)
        q = self.machine.closure.solve(q_a)
        whole = q.ndim == 2 and q.shape[:1] == v_a.shape[:-1]
        if whole and turned is None and self._fast is not None:
            return self._fast.rows(q, v_a)[:, -3:]
        return per_sample(one, q, v_a)

    def inverse(
        self,
        position: ArrayLike,
        guess: ArrayLike | None = None,
        attitude: ArrayLike | None = None,
    ) -> Array:
        """Active coordinates within their limits that put the frame at a position.

        With an attitude, which is met as exactly: a radian counts as much as the machine's size.

        Levenberg-Marquardt on the reduced Jacobian with the limits as bounds, from the guess or
        the nearest of a grid of postures. A stack is tracked like a path: where its samples are
        near each other, some of them, and Newton's method from the curve through these for all.
        Where there are more active joints than directions, each step of the descent is the
        shortest.

        Args:
            position: (3,) or (N, 3) in the world [m].
            guess: (n,) active coordinates to start from.
            attitude: Of the frame, inclination () or (N,) [rad] or roll, pitch and yaw (3,) or
                (N, 3) [rad] (R_z(yaw) R_y(pitch) R_x(roll), as URDF has it) or rotation matrices
                (3, 3) or (N, 3, 3).

        Returns:
            q_A, (n,) or (N, n) [m], [rad].

        Raises:
            InputError: Wrong shape or not finite, or the machine has no drives for the attitude.
            UnreachableTipError: The position is out of reach, or cannot be had in this attitude.
        """
        return self.tracked(position, guess, attitude)

    def tracked(
        self,
        position: ArrayLike,
        guess: ArrayLike | None = None,
        attitude: ArrayLike | None = None,
        time: Array | None = None,
    ) -> Array:
        """`inverse`, whose errors tell the time of a sample (N,) [s] as well."""
        targets = as_samples(position, 3, "position", ("x", "y", "z"))
        turned = None
        if attitude is not None:
            turned, goals = self._goals(attitude, targets)
            targets = np.concatenate([targets, goals], axis=-1)
        start = None
        if guess is not None:
            names = self.machine.active
            start = self.machine.check_limits(
                as_sample(guess, len(names), "guess", names), "guess"
            )
        if targets.ndim == 1:
            return self._inverse(targets, start, "", turned)
        if len(targets) == 0:
            raise InputError("position is an empty stack, give at least one sample")
        places = [
            f" (sample {i})" if time is None else f" at t = {time[i]:.4g} s (sample {i})"
            for i in range(len(targets))
        ]
        if turned is None and (tracked := self._track(targets, start, places)) is not None:
            return tracked
        out = np.empty((len(targets), len(self.machine.active)))
        for i, target in enumerate(targets):
            start = out[i] = self._inverse(target, start, places[i], turned)
        return out

    def _goals(self, attitude: ArrayLike, positions: Array) -> tuple[Attitude, Array]:
        """What an attitude is one of, and flat targets of it beside positions."""
        given = np.asarray(attitude)
        beside, shape = positions.shape[:-1], np.shape(attitude)
        if shape not in (beside, (*beside, 3), (*beside, 3, 3)):
            wanted = ", ".join(str((*beside, *more)) for more in ((), (3,), (3, 3)))
            raise InputError(f"attitude has the shape {shape}, give one of {wanted}")
        flat = as_samples(given.ravel(), given.size, "attitude")
        if shape == beside:
            return self._attitude(INCLINATION), flat.reshape(*beside, 1)
        turned = flat.reshape(shape)
        if shape[-2:] != (3, 3) or shape == (*beside, 3):
            turned = roll_pitch_yaw(turned)
        elif np.abs(turned @ np.swapaxes(turned, -1, -2) - np.eye(3)).max() > _ORTHOGONAL:
            raise InputError("attitude is no rotation matrix, give one")
        return self._attitude("rotation"), turned.reshape(*beside, 9)

    def _attitude(self, name: str) -> Attitude:
        """Coordinates of the attitude, which the machine can choose beside its position.

        Raises:
            InputError: It cannot.
        """
        if name not in ATTITUDES:
            raise InputError(f"attitude '{name}' is unknown, {known(ATTITUDES, name)}")
        if name not in self._turned:
            machine = self.machine
            found: Attitude
            found = Rotation() if name == "rotation" else Inclination(machine, self.frame)
            rows = [self._rows(q, found) * self._scale for q in self._some]
            moved, turned = (
                max(int(np.linalg.matrix_rank(row, tol=_RANK * self._size)) for row in some)
                for some in ([row[:3] for row in rows], rows)
            )
            if turned < moved + len(found.names):
                raise InputError(
                    f"'{machine.name}' has too few drives for {', '.join(found.names)} of "
                    f"'{self.frame}': they move it in {moved} directions, and turn it in "
                    f"{turned - moved} beside"
                )
            self._turned[name] = found
        return self._turned[name]

    @property
    def _data(self) -> pin.Data:
        return self._memory.own

    @cached_property
    def _fast(self) -> "_FastFrame | None":
        """Machine code for stacks; None where the machine is too large for it."""
        try:
            return _FastFrame(self.machine, self._frame)
        except TooLongError:
            return None

    @cached_property
    def _points(self) -> "_FastPoint | None":
        """The same of the position alone."""
        try:
            return _FastPoint(self.machine, self._frame)
        except TooLongError:
            return None

    def _track(self, targets: Array, start: Array | None, places: list[str]) -> Array | None:
        """Strokes along a dense path (N, 3), or None where that takes a closer look.

        Every sample is as exact as those searched for one by one, or None is returned.

        Raises:
            UnreachableTipError: The path leaves the reach.
        """
        machine, n = self.machine, len(self.machine.active)
        if n > targets.shape[1] or len(targets) < 4 * _STRIDE or self._fast is None:
            return None
        knots = np.unique(np.r_[0 : len(targets) : _STRIDE, len(targets) - 1])
        searched = np.empty((len(knots), n))
        for i, knot in enumerate(knots):
            try:
                start = searched[i] = self._inverse(targets[knot], start, "", None)
            except UnreachableTipError:
                # say which sample is the first one, or see that it can be reached after all
                for k in range(knots[max(i - 1, 0)], knot + 1):
                    start = self._inverse(targets[k], start, places[k], None)
                return None
        from scipy.interpolate import make_interp_spline  # slow to import

        try:
            curve = make_interp_spline(knots, searched)(np.arange(len(targets)))
            q_a = curve = np.clip(curve, machine.lower, machine.upper)
            best, before = q_a, np.full(len(targets), np.inf)
            far = self._far(targets)
            for _ in range(10):
                rows = self._fast.rows(machine.closure.solve(q_a))
                error = targets - rows[:, :3]
                distance = np.linalg.norm(error, axis=1)
                closer = distance < before
                best = np.where(closer[:, None], q_a, best)
                before = np.minimum(distance, before)
                if not (closer & (distance > _ROUNDING * far)).any():
                    break
                step = np.linalg.pinv(rows[:, 3:-3].reshape(-1, 3, n)) @ error[:, :, None]
                q_a = np.clip(q_a + step[:, :, 0], machine.lower, machine.upper)
        except (ClosureError, np.linalg.LinAlgError):
            return None
        beside = np.abs(best - curve) <= _BESIDE * self._scale
        tolerance = 1e-2 * _ACCURACY * far
        return best if beside.all() and before.max() <= tolerance else None

    def _far(self, targets: Array) -> float:
        """What distances to targets compare with [m]."""
        return max(self.machine.closure.size, float(np.abs(targets).max()))

    def tree_jacobian(self, q: Array) -> Array:
        """Jacobian dx/dq (3, nv) of the spanning tree at one posture (nq,)."""
        return self._tree(q)[:3]

    def _tree(self, q: Array) -> Array:
        """The same, and the angular one below it (6, nv)."""
        at = self.machine.coordinates.configuration(q)
        tree: Array = pin.computeFrameJacobian(
            self._model, self._data, at, self._frame, pin.LOCAL_WORLD_ALIGNED
        )
        return tree.reshape(6, -1)  # of a single joint it comes as a vector

    def _jacobian(self, q: Array) -> Array:
        reduced: Array = self.tree_jacobian(q) @ self.machine.closure.gamma(q)
        return reduced

    def _rows(self, q: Array, attitude: Attitude) -> Array:
        """The reduced Jacobian (3 + k, n) with an attitude."""
        reduced = self._tree(q) @ self.machine.closure.gamma(q)
        return np.vstack([reduced[:3], attitude.rows(self._pose(q)[1], reduced[3:])])

    def _pose(self, q: Array) -> tuple[Array, Array]:
        """Position (3,) and rotation (3, 3) at one posture (nq,)."""
        pin.forwardKinematics(self._model, self._data, self.machine.coordinates.configuration(q))
        placement = pin.updateFramePlacement(self._model, self._data, self._frame)
        return np.array(placement.translation), np.array(placement.rotation)

    def _slopes(self, q: Array, attitude: Attitude | None) -> Array:
        """How what is missed changes: of attitudes in lengths, a radian the machine's size."""
        if attitude is None:
            return self._jacobian(q)
        rows = self._rows(q, attitude)
        rows[3:] *= self._size
        return rows

    def _miss(self, target: Array, q: Array, attitude: Attitude | None) -> Array:
        """From a posture to a target (3,), and of attitudes likewise."""
        if attitude is None:
            return np.asarray(target - self.position_at(q))
        position, rotation = self._pose(q)
        turn = self._size * attitude.miss(target[3:], rotation)
        return np.concatenate([target[:3] - position, turn])

    @cached_property
    def _some(self) -> list[Array]:
        """A few postures (nq,) all over the strokes."""
        return [q for q, _ in self._grid[:: max(1, len(self._grid) // 6)]]

    @cached_property
    def _grid(self) -> list[tuple[Array, Array]]:
        """Postures (q, tip) all over the strokes to start from."""
        machine = self.machine
        home = machine.home[machine.closure.active]
        axes = [
            (low + span * np.array([0.2, 0.5, 0.8]) if driven and np.isfinite(span) else [at])
            for low, span, at, driven in zip(
                machine.lower, machine.upper - machine.lower, home, machine.driven, strict=True
            )
        ]
        found = [(np.array(machine.home), self.position_at(machine.home))]
        shape = tuple(len(axis) for axis in axes)
        if math.prod(shape) <= _GRID:
            cells = np.stack(np.unravel_index(np.arange(math.prod(shape)), shape), axis=1)
        else:  # of many joints some, wherever
            cells = np.random.default_rng(0).integers(shape, size=(_GRID, len(shape)))
        for cell in cells:
            q_a = np.array([axis[i] for axis, i in zip(axes, cell, strict=True)])
            try:
                q = machine.closure.solve(q_a)
            except ClosureError:
                continue
            found.append((q, self.position_at(q)))
        return found

    def _inverse(
        self, target: Array, start: Array | None, sample: str, attitude: Attitude | None
    ) -> Array:
        closure = self.machine.closure
        best = (np.inf, self.machine.home)
        if start is not None:
            best = self._descend(target, closure.solve(start), attitude)
        tolerance = _ACCURACY * self._far(target[:3])
        if best[0] > tolerance:
            if attitude is None:
                misses = [float(np.sum((tip - target) ** 2)) for _, tip in self._grid]
            else:
                misses = [norm(self._miss(target, q, attitude)) for q, _ in self._grid]
            for i in np.argsort(misses, kind="stable")[: 5 if attitude is None else _STARTS]:
                found = self._descend(target, self._grid[i][0], attitude)
                best = min(best, found, key=lambda item: item[0])
                if best[0] <= tolerance:
                    break
        distance, q = best
        q_a: Array = q[closure.active]
        if distance > tolerance:
            at = ", ".join(f"{value:.4g}" for value in target[:3]) + ") m"
            left = self._miss(target, q, attitude)
            away = f"{norm(left[:3]):.3g} m"
            if attitude is not None:
                at += f" with {attitude.words(target[3:])}"
                away += f" and {norm(left[3:]) / self._size:.3g} rad"
            where = ", ".join(
                f"{name} = {value:.4g}"
                for name, value in zip(self.machine.active, q_a, strict=True)
            )
            raise UnreachableTipError(
                f"'{self.frame}' cannot reach ({at}{sample}: it stays {away} away, "
                f"nearest at {where}; choose a point within reach"
            )
        return q_a

    def _descend(self, target: Array, q: Array, attitude: Attitude | None) -> tuple[float, Array]:
        """Bounded Levenberg-Marquardt; the distance reached and the posture."""
        closure, machine = self.machine.closure, self.machine
        error = self._miss(target, q, attitude)
        distance = norm(error)
        damping, far = 1e-6, self._far(target[:3])
        for _ in range(100):
            if distance < _ROUNDING * far:
                break
            q_a = q[closure.active]
            jacobian = self._slopes(q, attitude) * self._scale
            pull = jacobian.T @ error
            blocked = ((q_a <= machine.lower) & (pull < 0)) | ((q_a >= machine.upper) & (pull > 0))
            free = np.flatnonzero(~blocked)
            gram = jacobian[:, free].T @ jacobian[:, free]
            weight = damping * max(float(np.trace(gram)), 1e-300)
            move = np.zeros(len(q_a))
            move[free] = np.linalg.solve(gram + weight * np.eye(len(free)), pull[free])
            trial = np.clip(q_a + self._scale * move, machine.lower, machine.upper)
            try:
                q_new = closure.solve(trial, guess=q)
            except ClosureError:
                damping = max(10 * damping, 1e-4)
                continue
            error_new = self._miss(target, q_new, attitude)
            closer = norm(error_new)
            if closer < distance:
                stalled = closer > 0.999 * distance and damping < 1e-9
                q, error, distance = q_new, error_new, closer
                damping = max(damping / 10, 1e-15)
                if stalled:
                    break
            else:
                if distance < 100 * _ROUNDING * far or damping > 1e6:
                    break
                damping = max(10 * damping, 1e-9)
        return distance, q


class _FastPoint:
    """Position of a frame as machine code.

    Args:
        machine: The machine.
        frame: Pinocchio's index of the frame.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(self, machine: Machine, frame: int):
        fast = self._closure = machine.closure.fast
        placed = machine.model.frames[frame]
        self._body = machine.coordinates.bodies[placed.parentJoint]
        self._place = fast.geometry.turns[self._body].T @ placed.placement.translation
        self._nq, self._n = machine.model.nv, len(machine.active)
        key = (type(self), self._body, folded(self._place))
        if key not in fast.programs:
            said = ("frame", type(self).__name__, *key[1:])
            fast.programs[key] = fast.kept(said, self._build)
        self._program = fast.programs[key]

    def rows(self, q: Array, v_a: Array | None = None) -> Array:
        """Rows of `_outputs` at postures (N, nq) and velocities (N, n), zero if not given."""
        v_a = np.zeros((len(q), self._n)) if v_a is None else v_a
        out = np.empty((len(q), self._program.outputs("formula").size))
        constants = self._closure.geometry.numbers, self._place
        for i in range(0, len(q), _CHUNK):  # what has to be copied stays in the cache
            few = (np.ascontiguousarray(x[i : i + _CHUNK]) for x in (q, v_a, out))
            self._program.call("rows", min(_CHUNK, len(q) - i), *constants, *few)
        return out

    def _outputs(self, tape: Tape) -> list[Number]:
        """What a row holds: x (3)."""
        posture, _, point = self._placed(tape)
        return self._in_world(posture, subtract(point, posture.origin[0]))

    def _placed(self, tape: Tape) -> tuple[Bodies, Loops, list[Number]]:
        """Bodies, loops and the frame's place, seen from the trunk."""
        _, posture, loops = self._closure.trace(tape, 0, 2)
        place = Constants(tape, 1, self._place).vector(0)
        point = add(posture.origin[self._body], times(posture.rotation[self._body], place))
        return posture, loops, point

    def _in_world(self, posture: Bodies, vector: list[Number]) -> list[Number]:
        """A vector seen from the trunk, in the world's directions."""
        return times([list(axis) for axis in zip(*posture.rotation[0], strict=True)], vector)

    def _build(self, program: Program) -> None:
        nq, n = self._nq, self._n
        size = program.add("formula", 4, self._outputs(Tape())).size
        arrays = ("geometry", "place", "q", "v", "out")
        with program.routine("rows", counts=("count",), arrays=arrays) as r:
            with r.loop(r.count) as i:
                rows = r.q.row(i, nq), r.v.row(i, n), r.out.row(i, size)
                r.call("formula", r.geometry, r.place, *rows)
            r.give(r.count)


class _FastFrame(_FastPoint):
    """Position, reduced Jacobian and bias of a frame as machine code."""

    def _outputs(self, tape: Tape) -> list[Number]:
        """What a row holds: x (3), J gamma (3 n), bias (3)."""
        n, body = self._n, self._body
        posture, loops, point = self._placed(tape)
        v_a, parents = tape.loads(3, 0, n), posture.geometry.parents
        rates: list[Number] = [0.0]
        rates += [dot(loops.gamma[i], v_a) for i in range(1, len(parents))]
        motion = MovingBodies(posture, loops, rates, [0.0] * 3, parents)
        columns: list[list[Number]] = [[0.0] * 3 for _ in range(n)]
        (v, w), (a, e) = motion.velocity[body], motion.acceleration[body]
        i = body
        while i > 0:  # what the joints that carry it do to the point
            linear, angular = posture.columns[i]
            moved = add(linear, cross(angular, point))
            columns = [
                add(column, scale(factor, moved))
                for column, factor in zip(columns, loops.gamma[i], strict=True)
            ]
            a = add(a, scale(motion.drift[i], linear))
            e = add(e, scale(motion.drift[i], angular))
            i = parents[i]
        bend = add(a, cross(e, point), cross(w, add(v, cross(w, point))))
        jacobian = [self._in_world(posture, column) for column in columns]
        outputs = self._in_world(posture, subtract(point, posture.origin[0]))
        outputs += [column[row] for row in range(3) for column in jacobian]
        return [*outputs, *self._in_world(posture, bend)]
