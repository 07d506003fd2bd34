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

from crane.common.errors import ClosureError, InputError, LimitError, suggest_names
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array, as_number
from crane.dynamics import Dynamics
from crane.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.motion.limit_violations import limit_violation_message
from crane.motion.quintic_splines import quintic_polynomials
from crane.motion.task_trajectories import add_free_joints
from crane.motion.trajectory import Trajectory

_KNOTS_PER_SECOND = 100
_EQUILIBRIUM_TOLERANCE = 1e-12  # of the free joints' weight times lever, what hangs still
_CONVERGENCE_TOLERANCE = (
    1e-9  # [rad], [m] by which the last correction of a flat reference moves what sways
)
_STAGNATION_TOLERANCE = (
    1e-4  # likewise, where it hardly becomes less: what the splines of the sway cannot hold
)
_MAX_ITERATIONS = 30
_SMOOTHING_SHARE = 0.1  # of a task's duration, over which a flat reference is smoothed
_SPLINES_PER_SECOND = 12.0  # of the sway along a flat reference
_DIFFERENCE_STEP = 1e-6  # step of difference quotients [rad], [machine's size]
_GAUSS_POINTS, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(8)


class Sway(OneLineRepr):
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
        self._driven = machine.is_driven
        self._dynamics = Dynamics(machine)
        self._difference_steps = _DIFFERENCE_STEP * machine.closure.units[machine.closure.active]

    def hanging_equilibrium(self, q_a: ArrayLike) -> Array:
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
        for _ in range(_MAX_ITERATIONS):
            gravity_force = self._dynamics.gravity(q_a)[..., free]
            stiffness = self.stiffness(q_a)[..., free]
            determinants = np.abs(np.linalg.det(stiffness))
            if not np.isfinite(determinants).all() or not (determinants > 0).all():
                break
            newton_step = np.linalg.solve(stiffness, gravity_force[..., None])[..., 0]
            q_a[..., free] -= np.clip(newton_step, -0.5, 0.5)
            if np.abs(newton_step).max() < _EQUILIBRIUM_TOLERANCE**0.5 * 1e-3:
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
        for i, step in enumerate(self._difference_steps):
            perturbation = np.zeros(len(self._difference_steps))
            perturbation[i] = step
            gravity = self._dynamics.gravity
            columns.append(
                (gravity(q_a + perturbation) - gravity(q_a - perturbation)) / (2.0 * step)
            )
        stiffness: Array = np.stack(columns, axis=-1)[..., ~self._driven, :]
        return stiffness

    def modes(self, q_a: ArrayLike) -> tuple[Array, Array]:
        """How it sways with the drives held: (G - omega^2 M_ff) phi = 0.

        Args:
            q_a: (n,) [m], [rad], where it hangs.

        Returns:
            Angular frequencies (f,) omega [rad/s], the slowest first, and damping ratios (f,) of
            viscous friction, phi^T C phi / (2 omega phi^T M_ff phi).
        """
        omega, shapes, _ = self._modal_analysis(np.asarray(q_a, dtype=np.float64))
        damping_ratios: Array = np.einsum("ik,i,ik->k", shapes, self._viscous, shapes) / (
            2.0 * omega
        )
        return omega, damping_ratios

    def frequency_matrix(self, q_a: Array) -> Array:
        """Omega (f, f) [rad/s] with Omega^2 = M_ff^-1 G, at a posture (n,) where it hangs."""
        omega, shapes, mass = self._modal_analysis(q_a)
        return shapes @ (omega[:, None] * (shapes.T @ mass))

    def _modal_analysis(self, q_a: Array) -> tuple[Array, Array, Array]:
        """Frequencies (f,), shapes (f, f) of unit modal mass, and M_ff."""
        free = ~self._driven
        mass = self._dynamics.mass_matrix(q_a)[np.ix_(free, free)]
        stiffness = self.stiffness(q_a)[:, free]
        from scipy.linalg import eigh  # slow to import

        squares, shapes = eigh((stiffness + stiffness.T) / 2, mass)
        if squares[0] <= 0:
            raise InputError(f"what {', '.join(self.machine.free)} carry does not hang")
        return np.sqrt(squares), shapes, mass

    def pivoting_motions(self, q_a: Array) -> Array:
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
        hanging_derivatives = -np.linalg.solve(stiffness[:, :, f], stiffness[:, :, d])
        coupled_mass = mass[:, :, d] + mass[:, :, f] @ hanging_derivatives
        # in shares of what the free joints themselves weigh
        free_mass_diagonal = np.einsum("ijj->ij", mass[:, :, f])[:, :, None]
        equations, right_sides = (
            [coupled_mass / free_mass_diagonal],
            [-mass[:, :, f] / free_mass_diagonal],
        )
        if len(d) > len(f):
            height_jacobian = self._suspension_kinematics.jacobian(q_a)[:, 2:3, d]
            equations.append(height_jacobian)
            right_sides.append(np.zeros((len(q_a), 1, len(f))))
        stroke_lengths = self._stroke_lengths[d]
        matrix = np.concatenate(equations, axis=1) * stroke_lengths
        if (np.linalg.svd(matrix[:, : len(f)], compute_uv=False)[:, -1] < 1e-3).any():
            raise InputError(
                f"the drives of '{self.machine.name}' do not move what hangs on "
                f"{', '.join(self.machine.free)} in each direction that it sways in"
            )
        motions: Array = stroke_lengths[:, None] * (
            np.linalg.pinv(matrix) @ np.concatenate(right_sides, axis=1)
        )
        return motions

    def free_joint_forces(self, q_a: Array, v_a: Array, a_a: Array) -> Array:
        """Forces (N, f) that the free joints would need for a motion, but for dry friction."""
        free = ~self._driven
        forces: Array = (
            self._dynamics.inverse(q_a, v_a, a_a)[:, free] + self._viscous * v_a[:, free]
        )
        return forces

    @cached_property
    def _viscous(self) -> Array:
        """(f,) coefficients of the free joints."""
        laws = (self.machine.friction.get(joint) for joint in self.machine.free)
        return np.array([0.0 if law is None else law.viscous for law in laws])

    @cached_property
    def _stroke_lengths(self) -> Array:
        """(n,) lengths of the joints' strokes."""
        span = self.machine.upper - self.machine.lower
        units = self.machine.closure.units[self.machine.closure.active]
        return np.where(np.isfinite(span), span, units)

    @cached_property
    def _suspension_kinematics(self) -> Kinematics:
        """Where it hangs: the frame that the first free joint turns in."""
        joint = self.machine.tree.joints[self.machine.free[0]]
        return Kinematics(self.machine, joint.parent)


class _RetimedTrajectory(Trajectory):
    """A reference in another time, from its start to its end."""

    def __init__(self, reference: Trajectory, duration: float):
        self.duration = duration
        self._reference, self._time_scale = reference, reference.duration / duration

    def position(self, time: ArrayLike) -> Array:
        """See `Trajectory`."""
        return self._reference.position(np.asarray(time) * self._time_scale)

    def _derivative(self, order: int, time: ArrayLike) -> Array:
        time_scale = self._time_scale
        return time_scale**order * self._reference._derivative(
            order, np.asarray(time) * time_scale
        )

    def bounds(self) -> tuple[Array, Array]:
        """See `Trajectory`."""
        return self._reference.bounds()

    def extremum_times(self) -> Array:
        """See `Trajectory`."""
        return self._reference.extremum_times() / self._time_scale

    def breaks(self) -> Array:
        """See `Trajectory`."""
        return self._reference.breaks() / self._time_scale


def retime(reference: Trajectory, duration: float) -> Trajectory:
    """The same path in another time: q(t T / duration).

    Args:
        reference: Of duration T [s].
        duration: [s].

    Raises:
        InputError: No duration.
    """
    return _RetimedTrajectory(reference, as_number(duration, "the duration", "s", greater_than=0))


def _sample_motion(
    machine: Machine, duration: float, motion: Callable[[Array], Array]
) -> Trajectory:
    """Quintics between knots of a motion from rest to rest; motion is (N,) to (N, n)."""
    count = max(12, int(np.ceil(duration * _KNOTS_PER_SECOND)) + 1)
    time = np.linspace(0.0, duration, count)
    return _interpolating_trajectory(time, motion(time))


def _spline_derivatives(time: Array, q_a: Array) -> tuple[Array, Array]:
    """Velocities and accelerations of the quintic spline from rest to rest."""
    from scipy.interpolate import make_interp_spline  # slow to import

    zero_values = np.zeros(q_a.shape[1])
    ends: Any = [(1, zero_values), (2, zero_values)]  # of which scipy's types know less than scipy
    spline = make_interp_spline(time, q_a, k=5, bc_type=(ends, ends))
    return spline(time, 1), spline(time, 2)


def _interpolating_trajectory(time: Array, q_a: Array) -> Trajectory:
    return Trajectory(quintic_polynomials(time, q_a, *_spline_derivatives(time, q_a)))


def _with_hanging_joints(machine: Machine, reference: Trajectory) -> Trajectory:
    """The reference, its free joints hanging still all along."""
    sway_model = Sway(machine)
    return _sample_motion(
        machine,
        reference.duration,
        lambda time: sway_model.hanging_equilibrium(reference.position(time)),
    )


def _shaper_impulses(omega: float, zeta: float, robust: bool) -> tuple[Array, Array]:
    """Delays [s] and shares of a ZV or ZVD shaper."""
    decay = np.exp(-zeta * np.pi / np.sqrt(1.0 - zeta**2))
    half_period = np.pi / (omega * np.sqrt(1.0 - zeta**2))
    amplitudes = np.array([1.0, 2.0 * decay, decay**2] if robust else [1.0, decay])
    return half_period * np.arange(len(amplitudes)), amplitudes / amplitudes.sum()


def input_shaper(machine: Machine, q_a: ArrayLike, robust: bool = False) -> tuple[Array, Array]:
    """The input shaper of all that sways: Singer and Seering's, of each mode, one after the other.

    With K = exp(-zeta pi / sqrt(1 - zeta^2)) and the damped half period h, a mode's impulses are
    1, K at 0, h (ZV, zero vibration), or 1, 2 K, K^2 at 0, h, 2 h (ZVD, whose residual has no
    slope either at the mode's frequency), in shares of their sum (J. Dyn. Syst. Meas. Control 112
    (1990) 76-82). The shapers of several modes are convolved.

    Args:
        machine: The machine, with free joints.
        q_a: (n,) posture that the modes are taken at [m], [rad].
        robust: ZVD in place of ZV.

    Returns:
        Delays (j,) [s] from 0 on, and shares (j,) that sum to 1.
    """
    sway_model = Sway(machine)
    delays, shares = np.zeros(1), np.ones(1)
    for omega, zeta in zip(*sway_model.modes(sway_model.hanging_equilibrium(q_a)), strict=True):
        mode_delays, mode_shares = _shaper_impulses(float(omega), float(zeta), robust)
        delays = (delays[:, None] + mode_delays).ravel()
        shares = (shares[:, None] * mode_shares).ravel()
    order = np.argsort(delays)
    return delays[order], shares[order]


def _apply_input_shaper(machine: Machine, reference: Trajectory, robust: bool) -> Trajectory:
    """The reference in as much less time as the shaper takes, through the shaper."""
    middle = reference.position(0.5 * reference.duration)
    delays, shares = input_shaper(machine, middle, robust)
    remaining_duration = reference.duration - delays[-1]
    if remaining_duration <= 0:
        raise InputError(
            f"the shaper takes {delays[-1]:.3g} s, the motion {reference.duration:.3g} s: give it "
            "more time"
        )
    shortened_reference, sway_model = retime(reference, remaining_duration), Sway(machine)

    def motion(time: Array) -> Array:
        delayed_references = [
            size * shortened_reference.position(time - at)
            for at, size in zip(delays, shares, strict=True)
        ]
        return sway_model.hanging_equilibrium(np.sum(delayed_references, axis=0))

    return _sample_motion(machine, reference.duration, motion)


def _smooth_reference(reference: Trajectory, time: Array, width: float) -> Array:
    """Means (N, n) of a reference before a time, weighted by a cubic B-spline of a width [s]."""
    from scipy.interpolate import BSpline  # slow to import

    kernel = BSpline.basis_element(np.linspace(0.0, width, 5), extrapolate=False)
    quarter = width / 4.0
    out: Array = np.zeros(())
    for piece in range(4):
        for x, weight in zip(
            quarter * (piece + 0.5 * (_GAUSS_POINTS + 1.0)), _GAUSS_WEIGHTS, strict=True
        ):
            quadrature_weight = 0.5 * weight * float(kernel(x))  # of an integral of `quarter`
            out = out + quadrature_weight * reference.position(time - x)
    return out


def _rest_to_rest_splines(time: Array) -> Array:
    """Quintic splines (N, s) that begin and end at rest at zero, wide enough to hold no noise."""
    from scipy.interpolate import BSpline  # slow to import

    count = max(10, int(np.ceil(_SPLINES_PER_SECOND * time[-1])))
    knots = np.linspace(0.0, time[-1], count + 1)
    knots = np.concatenate([np.full(5, 0.0), knots, np.full(5, time[-1])])
    splines: Array = BSpline.design_matrix(time, knots, 5).toarray()[:, 3:-3]
    return splines


def _flatness_based_trajectory(machine: Machine, reference: Trajectory) -> Trajectory:
    """The reference as the load's, and the motion of the drives that moves the load so."""
    duration, smoothing = reference.duration, _SMOOTHING_SHARE * reference.duration
    shortened_reference, sway_model, driven = (
        retime(reference, duration - smoothing),
        Sway(machine),
        machine.is_driven,
    )
    count = max(12, int(np.ceil(duration * _KNOTS_PER_SECOND)) + 1)
    time = np.linspace(0.0, duration, count)
    hanging_configurations = sway_model.hanging_equilibrium(
        _smooth_reference(shortened_reference, time, smoothing)
    )
    pivoting_motions, splines = (
        sway_model.pivoting_motions(hanging_configurations),
        _rest_to_rest_splines(time),
    )
    free_stiffness = sway_model.stiffness(hanging_configurations)[:, :, ~driven]
    spline_projection = splines @ np.linalg.pinv(splines)
    theta = np.zeros((count, len(machine.free)))
    previous_correction = np.inf
    for _ in range(_MAX_ITERATIONS):
        q_a = hanging_configurations.copy()
        q_a[:, driven] += np.einsum("nkf,nf->nk", pivoting_motions, theta)
        try:
            q_a = sway_model.hanging_equilibrium(q_a)
            q_a[:, ~driven] += theta
            free_joint_forces = sway_model.free_joint_forces(q_a, *_spline_derivatives(time, q_a))
        except ClosureError:  # farther off than the machine reaches
            break
        correction = (
            spline_projection
            @ np.linalg.solve(free_stiffness, free_joint_forces[:, :, None])[:, :, 0]
        )
        correction_size = float(np.abs(correction).max())
        if correction_size < _CONVERGENCE_TOLERANCE or (
            correction_size < _STAGNATION_TOLERANCE and correction_size > 0.5 * previous_correction
        ):
            return _interpolating_trajectory(time, q_a)
        if correction_size > previous_correction:
            break
        theta, previous_correction = theta - correction, correction_size
    raise InputError(
        f"no motion of {duration:.3g} s was found that leaves what hangs without sway, the last "
        f"correction is {previous_correction:.2g} rad: give it more time"
    )


_SWAY_METHOD_FUNCTIONS: dict[str, Callable[[Machine, Trajectory], Trajectory]] = {
    "none": _with_hanging_joints,
    "zv": lambda machine, reference: _apply_input_shaper(machine, reference, robust=False),
    "zvd": lambda machine, reference: _apply_input_shaper(machine, reference, robust=True),
    "flat": _flatness_based_trajectory,
}
SWAY_METHODS = tuple(_SWAY_METHOD_FUNCTIONS)


def suppress_sway(machine: Machine, reference: Trajectory, method: str = "flat") -> Trajectory:
    """A reference from rest to rest, changed so that what hangs does not sway after it.

    It begins and ends where the given one does, in the same time, and has the free joints as they
    swing along it; where it begins it hangs still. Methods:

    - "flat": the reference, smoothed over a tenth of its duration, is the load's motion; the tip
      moves so that the load follows it, as flatness of the pendulum has it: of a point mass on
      a string p_tip = p + L (p'' - g) / |p'' - g| (Fliess, Levine, Martin and Rouchon, Int. J.
      Control 61 (1995) 1327-1361). Here of rigid bodies on any free joints, by iteration: drives
      q_d = s + B theta with s the reference and B of `Sway.pivoting_motions`, and theta corrected
      by
      -G^-1 times what inverse dynamics ask of the free joints, until they are asked for nothing.
    - "zv", "zvd": the reference is squeezed and sent through the shaper of `input_shaper`, whose
    modes
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
    if method not in _SWAY_METHOD_FUNCTIONS:
        raise InputError(f"method '{method}' is unknown, {suggest_names(SWAY_METHODS, method)}")
    if not machine.free:
        raise InputError(f"nothing sways on '{machine.name}': it has no free joints")
    trajectory = _SWAY_METHOD_FUNCTIONS[method](machine, add_free_joints(machine, reference))
    if text := limit_violation_message(machine, trajectory):
        raise LimitError(f"method '{method}': {text}")
    return trajectory
