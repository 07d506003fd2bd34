"""Postures: strokes at values, a frame at an angle and a height, smallest values over strokes."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import InputError, check_name
from crane.common.samples import Array, as_number
from crane.dynamics.frame_jacobians import FrameJacobians
from crane.motion.workspaces.workspace_patch import last_closed_configuration
from crane.ratings.strokes import Strokes

ANGLE = "angle"
_FRAME_UNITS = {ANGLE: "rad", "height": "m"}  # coordinates of the frame, beside those of joints
_MAX_ITERATIONS = 40
_MAX_STEP_SHARE = 0.2  # largest step of an iteration, as a share of the stroke
_TOLERANCE = 1e-12  # of an angle [rad], and of a height as a share of the characteristic length
_LIMIT_TOLERANCE = 1e-9  # share of a stroke, beyond its limits
_PARTS = 10  # into which the two intervals beside a smallest value are divided


class PostureSearch:
    """Search for configurations with strokes at values, and a frame at an angle and a height.

    The angle of a frame is that of its x axis above the horizontal; the height is the second
    coordinate of its section. As many strokes as there are of these follow by Newton's method,

        (angle, height)(q_A) = given,

    with the exact Jacobian: those that move the frame and are neither swept nor given. All other
    strokes stay at home.

    Args:
        strokes: Strokes of the frame.
        at: Coordinates of active joints, and "angle" [rad] and "height" [m] of the frame.
        over: Active joints whose values are swept.

    Attributes:
        at: What is held.
        over: What is swept.

    Raises:
        InputError: A name is unknown, a joint is given twice or beyond its limits, or there are
            more or fewer strokes to follow than there are angle and height.
    """

    def __init__(self, strokes: Strokes, at: Mapping[str, float], over: Sequence[str] = ()):
        machine, section = strokes.machine, strokes.section
        self.at, self.over = at, tuple(over)
        self._strokes, self._frames = strokes, FrameJacobians(machine)
        values = dict(zip(machine.active, machine.home[machine.closure.active], strict=True)) | {
            **at
        }
        self._targets = np.array([as_number(values.pop(name, 0.0), f"the {name}", unit)
                                  for name, unit in _FRAME_UNITS.items()])  # fmt: skip
        self._rows = [k for k, name in enumerate(_FRAME_UNITS) if name in at]
        named = [*over, *(x for x in at if x not in _FRAME_UNITS)]
        for name in named:
            check_name(name, machine.active, f"'{name}' is no active joint")
            if named.count(name) > 1:
                raise InputError(f"'{name}' is swept or given twice, name it once")
            i, value = machine.active.index(name), values[name]
            beyond = max(strokes.low[i] - value, value - strokes.high[i]) / strokes.span[i]
            if name in at and beyond > _LIMIT_TOLERANCE:
                raise InputError(
                    f"'{name}' goes from {strokes.low[i]:.4g} to {strokes.high[i]:.4g} "
                    f"{machine.unit(name)}, not to {value:.4g}"
                )
        self._swept = [machine.active.index(x) for x in over]
        self._base = np.array([*values.values()])
        free = [i for i in strokes.moving if machine.active[i] not in named]
        self._following = free if self._rows else []
        if len(self._following) != len(self._rows) or (section.is_radial and ANGLE in at):
            raise InputError(
                f"{' and '.join(x for x in _FRAME_UNITS if x in at)} of "
                f"'{strokes.statics.frame}': {len(self._rows)} of the strokes would follow, in an "
                f"upright plane, and {', '.join(machine.active[i] for i in free) or 'none'} may; "
                "name or lock the others"
            )
        if abs(self._targets[0]) > 2 * np.pi:
            raise InputError(
                f"the {ANGLE} is {self._targets[0]:g} rad, more than a turn: "
                "write degrees as 40deg"
            )
        # the x axis points forwards at home, whichever way the section's first axis does
        self._forward = section.first_direction
        ahead = np.cos(self._coordinates(machine.home)[0][0])
        self._forward = self._forward * (-1.0 if ahead < 0 else 1.0)

    def configurations(
        self, values: Array, start: Array | None = None
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Find configurations at values (N, k) of the swept strokes, from one to the next.

        Args:
            values: The values.
            start: (nq,) closed configuration to start from; home by default.

        Returns:
            (N, nq) configurations, and whether each is the posture (N,): closed on the branch of
            home, within the limits of the strokes. NaN where it is not.
        """
        q = self._strokes.machine.home if start is None else start
        out = np.full((len(values), len(q)), np.nan)
        for row, value in zip(out, values, strict=True):
            target = self._base.copy()
            target[self._swept] = value
            posture = self._posture(target, q)
            if posture is not None:
                q = row[:] = posture
        return out, np.isfinite(out[:, 0])

    def configuration(self) -> Array:
        """Return the configuration (nq,) without a swept stroke.

        Raises:
            InputError: There is none within the limits.
        """
        (posture,), (is_found,) = self.configurations(np.empty((1, 0)))
        if not is_found:
            texts = [f"{[*_FRAME_UNITS][k]} {self._targets[k]:.4g}" for k in self._rows]
            raise InputError(
                f"'{self._strokes.statics.frame}' reaches no posture with "
                f"{' and '.join(texts) or 'these strokes'} within its strokes: give others"
            )
        return np.asarray(posture)

    def angles(self, q: Array) -> Array:
        """Return the angles (N,) of the frame at configurations (N, nq) [rad]; NaN where q is."""
        return np.array([np.nan if np.isnan(x[0]) else self._coordinates(x)[0][0]
                         for x in q])  # fmt: skip

    def _coordinates(self, q: Array) -> tuple[Array, Array]:
        # angle and height (2,) of the frame, and their derivatives (2, n)
        frame, section = self._strokes.statics.frame, self._strokes.section
        up, forward = section.second_direction, self._forward
        self._frames.set_configuration(q)
        pose = self._frames.frame_pose(frame)
        rates = self._frames.jacobian(frame) @ self._strokes.machine.closure.gamma(q)
        axis, height = pose.rotation[:, 0], (pose.translation - section.origin) @ up
        return (
            np.array([np.arctan2(axis @ up, axis @ forward), height]),
            np.array([np.cross(forward, up) @ rates[3:], up @ rates[:3]]),
        )

    def _posture(self, target: Array, q: Array) -> Array | None:
        # the configuration at active coordinates, from a closed one; None if there is none
        strokes, following = self._strokes, self._following
        machine, is_reached = strokes.machine, False
        low, high, span = (x[following] for x in (strokes.low, strokes.high, strokes.span))
        scales = np.array([1.0, machine.closure.characteristic_length])[self._rows]
        for _ in range(_MAX_ITERATIONS if following else 1):
            found, rates = self._coordinates(q)
            distances = (self._targets - found)[self._rows] / scales
            if is_reached and np.abs(distances).max() <= _TOLERANCE:
                return q
            jacobian = rates[self._rows][:, following] / scales[:, None] * span
            step = np.linalg.lstsq(jacobian, distances, rcond=None)[0]
            step *= min(1.0, _MAX_STEP_SHARE / np.abs(step).max(initial=1e-300))
            target[following] = np.clip(
                q[machine.closure.active][following] + step * span, low, high
            )
            q, is_reached = last_closed_configuration(machine, q, target)
        return q if is_reached and not following else None


def smallest_value(
    measure: Callable[[Array], Array], values: Array, rounds: int = 10
) -> tuple[float, float]:
    """Find the smallest value of a function near the smallest of a grid.

    Each round divides the interval by five, so that after ten an argument is known to 1e-7 of the
    grid's step, and a value at a smooth minimum to rounding errors.

    Args:
        measure: Function of arguments (N,) that returns values (N,); NaN where it has none.
        values: (N,) the grid, rising.
        rounds: Number of refinements.

    Returns:
        The smallest value, infinite if there is none, and its argument.
    """
    for _ in range(rounds + 1):
        found = np.nan_to_num(measure(values), nan=np.inf, posinf=np.inf)
        i = int(found.argmin())
        smallest = float(found[i]), float(values[i])
        ends = values[max(i - 1, 0)], values[min(i + 1, len(values) - 1)]
        values = np.linspace(*ends, _PARTS + 1)
    return smallest
