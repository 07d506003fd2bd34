"""The tip (or any other frame) as a function of the active coordinates, and back."""

import itertools
from functools import cached_property

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from crane.errors import ClosureError, InputError, UnreachableTipError
from crane.machine import Machine
from crane.samples import Array, as_sample, as_samples, per_sample

_ACCURACY = 1e-11  # [m] per metre of machine


class Kinematics:
    """Position of one frame as a function of q_A.

        x = p(f(q_A)),    x' = J gamma v_A,    x'' = J gamma a_A + bias.

    Args:
        machine: The machine.
        frame: A link; the machine's tip if not given.

    Raises:
        InputError: Unknown frame, or the machine has no tip.
    """

    def __init__(self, machine: Machine, frame: str | None = None):
        if frame is None:
            if machine.tip is None:
                raise InputError(f"machine '{machine.name}' has no tip, name a frame")
            frame = machine.tip
        self.machine, self.frame = machine, frame
        self._model, self._data = machine.model, machine.model.createData()
        self._frame = machine.frame(frame)
        span = machine.upper - machine.lower
        self._scale = np.where(np.isfinite(span), span, 1.0)

    def position(self, q_a: ArrayLike) -> Array:
        """Position in the world.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            (3,) or (N, 3) [m].
        """
        return per_sample(self.position_at, self.machine.closure.solve(q_a))

    def position_at(self, q: Array) -> Array:
        """Position (3,) [m] of one posture (nq,)."""
        pin.forwardKinematics(self._model, self._data, q)
        placement = pin.updateFramePlacement(self._model, self._data, self._frame)
        return np.array(placement.translation)

    def jacobian(self, q_a: ArrayLike) -> Array:
        """Reduced Jacobian dx/dq_A = J gamma.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            (3, n) or (N, 3, n).
        """
        return per_sample(self._jacobian, self.machine.closure.solve(q_a))

    def bias(self, q_a: ArrayLike, v_a: ArrayLike) -> Array:
        """Acceleration of the frame at a_A = 0.

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            v_a: The same shape [m/s], [rad/s].

        Returns:
            (3,) or (N, 3) [m/s2].
        """
        names = self.machine.active

        def one(q: Array, v_a: Array) -> Array:
            v = self.machine.closure.gamma(q) @ v_a
            drift = self.machine.closure.drift(q, v)
            pin.forwardKinematics(self._model, self._data, q, v, drift)
            acceleration = pin.getFrameClassicalAcceleration(
                self._model, self._data, self._frame, pin.LOCAL_WORLD_ALIGNED
            )
            return np.array(acceleration.linear)

        v_a = as_samples(v_a, len(names), "v_a", names)
        return per_sample(one, self.machine.closure.solve(q_a), v_a)

    def inverse(self, position: ArrayLike, guess: ArrayLike | None = None) -> Array:
        """Active coordinates within their limits that put the frame at a position.

        Levenberg-Marquardt on the reduced Jacobian with the limits as bounds, from the guess or
        the nearest of a grid of postures. A stack is tracked like a path. Where there are
        more active joints than directions, each step of the descent is the shortest.

        Args:
            position: (3,) or (N, 3) in the world [m].
            guess: (n,) active coordinates to start from.

        Returns:
            q_A, (n,) or (N, n) [m], [rad].

        Raises:
            InputError: Wrong shape or not finite.
            UnreachableTipError: The position is out of reach.
        """
        targets = as_samples(position, 3, "position", ("x", "y", "z"))
        start = None
        if guess is not None:
            names = self.machine.active
            start = self.machine.check_limits(
                as_sample(guess, len(names), "guess", names), "guess"
            )
        if targets.ndim == 1:
            return self._inverse(targets, start, "")
        if len(targets) == 0:
            raise InputError("position is an empty stack, give at least one sample")
        out = np.empty((len(targets), len(self.machine.active)))
        for i, target in enumerate(targets):
            start = out[i] = self._inverse(target, start, f" (sample {i})")
        return out

    def _jacobian(self, q: Array) -> Array:
        tree = pin.computeFrameJacobian(
            self._model, self._data, q, self._frame, pin.LOCAL_WORLD_ALIGNED
        )
        reduced: Array = tree[:3] @ self.machine.closure.gamma(q)
        return reduced

    @cached_property
    def _grid(self) -> list[tuple[Array, Array]]:
        """Postures (q, tip) all over the strokes to start from."""
        machine = self.machine
        home = machine.home[machine.closure.active]
        axes = [
            (low + span * np.array([0.2, 0.5, 0.8]) if np.isfinite(span) else [at])
            for low, span, at in zip(
                machine.lower, machine.upper - machine.lower, home, strict=True
            )
        ]
        found = [(np.array(machine.home), self.position_at(machine.home))]
        for q_a in itertools.islice(itertools.product(*axes), 243):
            try:
                q = machine.closure.solve(np.array(q_a))
            except ClosureError:
                continue
            found.append((q, self.position_at(q)))
        return found

    def _inverse(self, target: Array, start: Array | None, sample: str) -> Array:
        closure = self.machine.closure
        best = (np.inf, self.machine.home)
        if start is not None:
            best = self._descend(target, closure.solve(start))
        tolerance = _ACCURACY * max(1.0, float(np.abs(target).max()))
        if best[0] > tolerance:
            near = sorted(self._grid, key=lambda item: float(np.sum((item[1] - target) ** 2)))
            for q, _ in near[:5]:
                best = min(best, self._descend(target, q), key=lambda item: item[0])
                if best[0] <= tolerance:
                    break
        distance, q = best
        q_a: Array = q[closure.active]
        if distance > tolerance:
            at = ", ".join(f"{value:.4g}" for value in target)
            where = ", ".join(
                f"{name} = {value:.4g}"
                for name, value in zip(self.machine.active, q_a, strict=True)
            )
            raise UnreachableTipError(
                f"'{self.frame}' cannot reach ({at}) m{sample}: it stays {distance:.3g} m away, "
                f"nearest at {where}; choose a point within reach"
            )
        return q_a

    def _descend(self, target: Array, q: Array) -> tuple[float, Array]:
        """Bounded Levenberg-Marquardt; the distance reached and the posture."""
        closure, machine = self.machine.closure, self.machine
        error = target - self.position_at(q)
        distance = float(np.linalg.norm(error))
        damping = 1e-6
        for _ in range(100):
            if distance < 1e-15:  # [m] rounding
                break
            q_a = q[closure.active]
            jacobian = self._jacobian(q) * self._scale
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
            error_new = target - self.position_at(q_new)
            closer = float(np.linalg.norm(error_new))
            if closer < distance:
                stalled = closer > 0.999 * distance and damping < 1e-9
                q, error, distance = q_new, error_new, closer
                damping = max(damping / 10, 1e-15)
                if stalled:
                    break
            else:
                if distance < 1e-13 or damping > 1e6:
                    break
                damping = max(10 * damping, 1e-9)
        return distance, q
