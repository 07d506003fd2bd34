"""References of machines with something that hangs, which leave no sway behind.

What hangs is what free joints carry: with q_f the free joints, q_d the driven ones and q_h(q_d)
the free joints where it hangs still, g_f(q_d, q_h) = 0, its sway is theta = q_f - q_h. In q_d and
theta the free joints' equations of motion are, with E = dq_h/dq_d = -G^-1 dg_f/dq_d and
G = dg_f/dq_f,

    M_ff theta'' + (M_fd + M_ff E) q_d'' + G theta + ... = 0.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import ClosureError, InputError, LimitError, known
from crane.common.samples import Array, as_number
from crane.common.shown import Brief
from crane.dynamics import Dynamics
from crane.machine import Machine
from crane.motion.curves import Trajectory
from crane.motion.kinematics import Kinematics
from crane.motion.limits import beyond_limits
from crane.motion.splines import quintics
from crane.motion.trajectories import with_free

_KNOTS_PER_SECOND = 100
_STILL = 1e-12  # of the free joints' weight times lever, what hangs still
_ACCURACY = 1e-9  # [rad], [m] by which the last correction of a flat reference moves what sways
_ENOUGH = 1e-4  # likewise, where it hardly becomes less: what the splines of the sway cannot hold
_ROUNDS = 30
_SMOOTHING = 0.1  # of a task's duration, over which a flat reference is smoothed
_SPLINES_PER_SECOND = 12.0  # of the sway along a flat reference
_DIFFERENCE = 1e-6  # step of difference quotients [rad], [machine's size]
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(8)


class Sway(Brief):
    """What hangs on the free joints of a machine: where it hangs, how it sways, what moves it.

    Args:
        machine: The machine, with free joints.

    Raises:
        InputError: It has none.
    """

    def __init__(self, machine: Machine):
        if not machine.free:
            raise InputError(f"nothing sways on '{machine.name}': it has no free joints")
        self.machine = machine
        self._driven = machine.driven
        self._dynamics = Dynamics(machine)
        self._step = _DIFFERENCE * machine.closure.units[machine.closure.active]

    def hanging(self, q_a: ArrayLike) -> Array:
        """The same postures with all that is free hanging still.

        Newton's method on g_f(q_d, q_f) = 0, from where the free joints are said to be.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            The same shape.

        Raises:
            InputError: It hangs nowhere still near there.
        """
        q_a = np.array(q_a, dtype=np.float64)
        free = ~self._driven
        for _ in range(_ROUNDS):
            weight = self._dynamics.gravity(q_a)[..., free]
            stiffness = self.stiffness(q_a)[..., free]
            size = np.abs(np.linalg.det(stiffness))
            if not np.isfinite(size).all() or not (size > 0).all():
                break
            move = np.linalg.solve(stiffness, weight[..., None])[..., 0]
            q_a[..., free] -= np.clip(move, -0.5, 0.5)
            if np.abs(move).max() < _STILL**0.5 * 1e-3:
                return q_a
        names = ", ".join(self.machine.free)
        raise InputError(f"what {names} carry hangs nowhere still: weight has to pull them back")

    def stiffness(self, q_a: Array) -> Array:
        """What gravity turns the free joints back with, dg_f/dq_A.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            (f, n) or (N, f, n), of the f free joints.
        """
        columns = []
        for i, step in enumerate(self._step):
            beside = np.zeros(len(self._step))
            beside[i] = step
            gravity = self._dynamics.gravity
            columns.append((gravity(q_a + beside) - gravity(q_a - beside)) / (2.0 * step))
        found: Array = np.stack(columns, axis=-1)[..., ~self._driven, :]
        return found

    def modes(self, q_a: ArrayLike) -> tuple[Array, Array]:
        """How it sways with the drives held: (G - omega^2 M_ff) phi = 0.

        Args:
            q_a: (n,) [m], [rad], where it hangs.

        Returns:
            Angular frequencies (f,) omega [rad/s], the slowest first, and damping ratios (f,) of
            viscous friction, phi^T C phi / (2 omega phi^T M_ff phi).
        """
        omega, shapes, _ = self._modes(np.asarray(q_a, dtype=np.float64))
        damped: Array = np.einsum("ik,i,ik->k", shapes, self._viscous, shapes) / (2.0 * omega)
        return omega, damped

    def root(self, q_a: Array) -> Array:
        """Omega (f, f) [rad/s] with Omega^2 = M_ff^-1 G, at a posture (n,) where it hangs."""
        omega, shapes, mass = self._modes(q_a)
        return shapes @ (omega[:, None] * (shapes.T @ mass))

    def _modes(self, q_a: Array) -> tuple[Array, Array, Array]:
        """Frequencies (f,), shapes (f, f) of unit modal mass, and M_ff."""
        free = ~self._driven
        mass = self._dynamics.mass_matrix(q_a)[np.ix_(free, free)]
        stiffness = self.stiffness(q_a)[:, free]
        from scipy.linalg import eigh  # slow to import

        squares, shapes = eigh((stiffness + stiffness.T) / 2, mass)
        if squares[0] <= 0:
            raise InputError(f"what {', '.join(self.machine.free)} carry does not hang")
        return np.sqrt(squares), shapes, mass

    def shifts(self, q_a: Array) -> Array:
        """Motions of the drives that leave the load where it is while it turns about itself.

        B solves (M_fd + M_ff E) B = -M_ff: what the free joints' own acceleration theta'' does
        to them, the drives' acceleration B theta'' takes back. Of a pendulum that is I / (m d) of
        the tip against the swing, the pin drawn about the centre of oscillation. The tip stays at
        its height, and joints share the way by the least norm in shares of their strokes.

        Args:
            q_a: (N, n) [m], [rad], where it hangs.

        Returns:
            (N, k, f) of the k driven joints.

        Raises:
            InputError: The drives do not move what sways in some direction.
        """
        d, f = np.flatnonzero(self._driven), np.flatnonzero(~self._driven)
        mass = self._dynamics.mass_matrix(q_a)[:, f]
        stiffness = self.stiffness(q_a)
        follow = -np.linalg.solve(stiffness[:, :, f], stiffness[:, :, d])
        moved = mass[:, :, d] + mass[:, :, f] @ follow
        # in shares of what the free joints themselves weigh
        own = np.einsum("ijj->ij", mass[:, :, f])[:, :, None]
        rows, wanted = [moved / own], [-mass[:, :, f] / own]
        if len(d) > len(f):
            rise = self._hook.jacobian(q_a)[:, 2:3, d]
            rows.append(rise)
            wanted.append(np.zeros((len(q_a), 1, len(f))))
        weight = self._strokes[d]
        matrix = np.concatenate(rows, axis=1) * weight
        if (np.linalg.svd(matrix[:, : len(f)], compute_uv=False)[:, -1] < 1e-3).any():
            raise InputError(
                f"the drives of '{self.machine.name}' do not move what hangs on "
                f"{', '.join(self.machine.free)} in each direction that it sways in"
            )
        found: Array = weight[:, None] * (np.linalg.pinv(matrix) @ np.concatenate(wanted, axis=1))
        return found

    def excess(self, q_a: Array, v_a: Array, a_a: Array) -> Array:
        """Forces (N, f) that the free joints would need for a motion, but for dry friction."""
        free = ~self._driven
        found: Array = (
            self._dynamics.inverse(q_a, v_a, a_a)[:, free] + self._viscous * v_a[:, free]
        )
        return found

    @cached_property
    def _viscous(self) -> Array:
        """(f,) coefficients of the free joints."""
        laws = (self.machine.friction.get(joint) for joint in self.machine.free)
        return np.array([0.0 if law is None else law.viscous for law in laws])

    @cached_property
    def _strokes(self) -> Array:
        """(n,) lengths of the joints' strokes."""
        span = self.machine.upper - self.machine.lower
        units = self.machine.closure.units[self.machine.closure.active]
        return np.where(np.isfinite(span), span, units)

    @cached_property
    def _hook(self) -> Kinematics:
        """Where it hangs: the frame that the first free joint turns in."""
        joint = self.machine.tree.joints[self.machine.free[0]]
        return Kinematics(self.machine, joint.parent)


class _Retimed(Trajectory):
    """A reference in another time, from its start to its end."""

    def __init__(self, reference: Trajectory, duration: float):
        self.duration = duration
        self._reference, self._rate_of_time = reference, reference.duration / duration

    def position(self, time: ArrayLike) -> Array:
        """See `Trajectory`."""
        return self._reference.position(np.asarray(time) * self._rate_of_time)

    def _rate(self, order: int, time: ArrayLike) -> Array:
        pace = self._rate_of_time
        return pace**order * self._reference._rate(order, np.asarray(time) * pace)

    def bounds(self) -> tuple[Array, Array]:
        """See `Trajectory`."""
        return self._reference.bounds()

    def turns(self) -> Array:
        """See `Trajectory`."""
        return self._reference.turns() / self._rate_of_time

    def breaks(self) -> Array:
        """See `Trajectory`."""
        return self._reference.breaks() / self._rate_of_time


def retimed(reference: Trajectory, duration: float) -> Trajectory:
    """The same path in another time: q(t T / duration).

    Args:
        reference: Of duration T [s].
        duration: [s].

    Raises:
        InputError: No duration.
    """
    return _Retimed(reference, as_number(duration, "the duration", "s", above=0))


def _sampled(machine: Machine, duration: float, motion: Callable[[Array], Array]) -> Trajectory:
    """Quintics between knots of a motion from rest to rest; motion is (N,) to (N, n)."""
    count = max(12, int(np.ceil(duration * _KNOTS_PER_SECOND)) + 1)
    time = np.linspace(0.0, duration, count)
    return _through(time, motion(time))


def _derivatives(time: Array, q_a: Array) -> tuple[Array, Array]:
    """Velocities and accelerations of the quintic spline from rest to rest."""
    from scipy.interpolate import make_interp_spline  # slow to import

    rest = np.zeros(q_a.shape[1])
    ends: Any = [(1, rest), (2, rest)]  # of which scipy's types know less than scipy
    spline = make_interp_spline(time, q_a, k=5, bc_type=(ends, ends))
    return spline(time, 1), spline(time, 2)


def _through(time: Array, q_a: Array) -> Trajectory:
    return Trajectory(quintics(time, q_a, *_derivatives(time, q_a)))


def _hangs(machine: Machine, reference: Trajectory) -> Trajectory:
    """The reference, its free joints hanging still all along."""
    sway = Sway(machine)
    return _sampled(
        machine, reference.duration, lambda time: sway.hanging(reference.position(time))
    )


def _impulses(omega: float, zeta: float, derivative: bool) -> tuple[Array, Array]:
    """Delays [s] and shares of a ZV or ZVD shaper."""
    share = np.exp(-zeta * np.pi / np.sqrt(1.0 - zeta**2))
    half = np.pi / (omega * np.sqrt(1.0 - zeta**2))
    sizes = np.array([1.0, 2.0 * share, share**2] if derivative else [1.0, share])
    return half * np.arange(len(sizes)), sizes / sizes.sum()


def impulses(machine: Machine, q_a: ArrayLike, derivative: bool = False) -> tuple[Array, Array]:
    """The input shaper of all that sways: Singer and Seering's, of each mode, one after the other.

    With K = exp(-zeta pi / sqrt(1 - zeta^2)) and the damped half period h, a mode's impulses are
    1, K at 0, h (ZV, zero vibration), or 1, 2 K, K^2 at 0, h, 2 h (ZVD, whose residual has no
    slope either at the mode's frequency), in shares of their sum (J. Dyn. Syst. Meas. Control 112
    (1990) 76-82). The shapers of several modes are convolved.

    Args:
        machine: The machine, with free joints.
        q_a: (n,) posture that the modes are taken at [m], [rad].
        derivative: ZVD in place of ZV.

    Returns:
        Delays (j,) [s] from 0 on, and shares (j,) that sum to 1.
    """
    sway = Sway(machine)
    delays, shares = np.zeros(1), np.ones(1)
    for omega, zeta in zip(*sway.modes(sway.hanging(q_a)), strict=True):
        more, sizes = _impulses(float(omega), float(zeta), derivative)
        delays = (delays[:, None] + more).ravel()
        shares = (shares[:, None] * sizes).ravel()
    order = np.argsort(delays)
    return delays[order], shares[order]


def _shaped(machine: Machine, reference: Trajectory, derivative: bool) -> Trajectory:
    """The reference in as much less time as the shaper takes, through the shaper."""
    middle = reference.position(0.5 * reference.duration)
    delays, shares = impulses(machine, middle, derivative)
    left = reference.duration - delays[-1]
    if left <= 0:
        raise InputError(
            f"the shaper takes {delays[-1]:.3g} s, the motion {reference.duration:.3g} s: give it "
            "more time"
        )
    base, sway = retimed(reference, left), Sway(machine)

    def motion(time: Array) -> Array:
        parts = [size * base.position(time - at) for at, size in zip(delays, shares, strict=True)]
        return sway.hanging(np.sum(parts, axis=0))

    return _sampled(machine, reference.duration, motion)


def _smoothed(reference: Trajectory, time: Array, width: float) -> Array:
    """Means (N, n) of a reference before a time, weighted by a cubic B-spline of a width [s]."""
    from scipy.interpolate import BSpline  # slow to import

    kernel = BSpline.basis_element(np.linspace(0.0, width, 5), extrapolate=False)
    quarter = width / 4.0
    out: Array = np.zeros(())
    for piece in range(4):
        for x, weight in zip(quarter * (piece + 0.5 * (_POINTS + 1.0)), _WEIGHTS, strict=True):
            share = 0.5 * weight * float(kernel(x))  # of an integral of `quarter`
            out = out + share * reference.position(time - x)
    return out


def _from_rest(time: Array) -> Array:
    """Quintic splines (N, s) that begin and end at rest at zero, wide enough to hold no noise."""
    from scipy.interpolate import BSpline  # slow to import

    count = max(10, int(np.ceil(_SPLINES_PER_SECOND * time[-1])))
    knots = np.linspace(0.0, time[-1], count + 1)
    knots = np.concatenate([np.full(5, 0.0), knots, np.full(5, time[-1])])
    every: Array = BSpline.design_matrix(time, knots, 5).toarray()[:, 3:-3]
    return every


def _flat(machine: Machine, reference: Trajectory) -> Trajectory:
    """The reference as the load's, and the motion of the drives that moves the load so."""
    duration, smoothing = reference.duration, _SMOOTHING * reference.duration
    base, sway, driven = retimed(reference, duration - smoothing), Sway(machine), machine.driven
    count = max(12, int(np.ceil(duration * _KNOTS_PER_SECOND)) + 1)
    time = np.linspace(0.0, duration, count)
    rest = sway.hanging(_smoothed(base, time, smoothing))
    shifts, splines = sway.shifts(rest), _from_rest(time)
    back = sway.stiffness(rest)[:, :, ~driven]
    onto = splines @ np.linalg.pinv(splines)
    theta = np.zeros((count, len(machine.free)))
    before = np.inf
    for _ in range(_ROUNDS):
        q_a = rest.copy()
        q_a[:, driven] += np.einsum("nkf,nf->nk", shifts, theta)
        try:
            q_a = sway.hanging(q_a)
            q_a[:, ~driven] += theta
            excess = sway.excess(q_a, *_derivatives(time, q_a))
        except ClosureError:  # farther off than the machine reaches
            break
        move = onto @ np.linalg.solve(back, excess[:, :, None])[:, :, 0]
        moved = float(np.abs(move).max())
        if moved < _ACCURACY or (moved < _ENOUGH and moved > 0.5 * before):
            return _through(time, q_a)
        if moved > before:
            break
        theta, before = theta - move, moved
    raise InputError(
        f"no motion of {duration:.3g} s was found that leaves what hangs without sway, the last "
        f"correction is {before:.2g} rad: give it more time"
    )


_METHODS: dict[str, Callable[[Machine, Trajectory], Trajectory]] = {
    "none": _hangs,
    "zv": lambda machine, reference: _shaped(machine, reference, derivative=False),
    "zvd": lambda machine, reference: _shaped(machine, reference, derivative=True),
    "flat": _flat,
}
METHODS = tuple(_METHODS)


def without_sway(machine: Machine, reference: Trajectory, method: str = "flat") -> Trajectory:
    """A reference from rest to rest, changed so that what hangs does not sway after it.

    It begins and ends where the given one does, in the same time, and has the free joints as they
    swing along it; where it begins it hangs still. Methods:

    - "flat": the reference, smoothed over a tenth of its duration, is the load's motion; the tip
      moves so that the load follows it, as flatness of the pendulum has it: of a point mass on
      a string p_tip = p + L (p'' - g) / |p'' - g| (Fliess, Levine, Martin and Rouchon, Int. J.
      Control 61 (1995) 1327-1361). Here of rigid bodies on any free joints, by iteration: drives
      q_d = s + B theta with s the reference and B of `Sway.shifts`, and theta corrected by
      -G^-1 times what inverse dynamics ask of the free joints, until they are asked for nothing.
    - "zv", "zvd": the reference is squeezed and sent through the shaper of `impulses`, whose modes
      are those in its middle.
    - "none": the same reference, beside free joints that hang still.

    Friction of the free joints is left out of "flat", and all but viscous friction of the shapers.

    Args:
        machine: The machine, with free joints and its payload.
        reference: Of the driven joints, from rest to rest.
        method: One of these.

    Returns:
        Reference of all active joints.

    Raises:
        InputError: Unknown method, no free joints, or too little time.
        LimitError: What the drives have to do is beyond their limits.
    """
    if method not in _METHODS:
        raise InputError(f"method '{method}' is unknown, {known(METHODS, method)}")
    if not machine.free:
        raise InputError(f"nothing sways on '{machine.name}': it has no free joints")
    found = _METHODS[method](machine, with_free(machine, reference))
    if text := beyond_limits(machine, found):
        raise LimitError(f"method '{method}': {text}")
    return found
