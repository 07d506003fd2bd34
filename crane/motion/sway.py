"""Sway of a hanging load: equilibrium, modes, and trajectories without residual sway.

The latter are made by input shaping, or flatness-based.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import ClosureError, InputError, LimitError, suggest_names
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.dynamics.dynamics import Dynamics
from crane.machine.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.motion.limit_violations import limit_violation_message
from crane.motion.quintic_splines import quintic_polynomials
from crane.motion.task_trajectories import add_free_joints
from crane.motion.trajectory import Trajectory, retime

_EQUILIBRIUM_TOLERANCE = 1e-12  # of the equilibrium of the free joints
_MAX_ITERATIONS = 30
_DIFFERENCE_STEP = 1e-6  # step of difference quotients [rad], [characteristic length]
SWAY_METHODS = ("none", "zv", "zvd", "flat")
_KNOTS_PER_SECOND = 100
_CONVERGENCE_TOLERANCE = 1e-9  # [rad], [m] of the last correction of a flatness-based motion
_STAGNATION_TOLERANCE = 1e-4  # likewise if it stagnates: the error of the splines
_SMOOTHING_SHARE = 0.1  # of the duration, over which the motion of the load is smoothed
_SPLINES_PER_SECOND = 12.0  # of the sway along a flatness-based motion
_GAUSS_POINTS, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(8)


class Sway(OneLineRepr):
    """Dynamics of a load that hangs on the free joints of a machine.

    With the free joints q_f, the driven joints q_d and the free joints at rest q_h(q_d),
    g_f(q_d, q_h) = 0, the sway is theta = q_f - q_h. With E = dq_h/dq_d = -G^-1 dg_f/dq_d and
    G = dg_f/dq_f, the equations of motion of the free joints are

        M_ff theta'' + (M_fd + M_ff E) q_d'' + G theta + ... = 0.

    Held coordinates of idle motions (`Machine.held`) are none of these joints: they keep their
    values. Changes of ball joints and floating bases are small motions along and about the axes
    of the child.

    Args:
        machine: The machine, with free joints.

    Attributes:
        machine: The machine.
        free_indices: Indices of the free joints f among the active ones.

    Raises:
        InputError: The machine has none.
    """

    def __init__(self, machine: Machine):
        self.free_indices = np.setdiff1d(np.flatnonzero(~machine.is_driven), machine.held)
        if not len(self.free_indices):
            raise InputError(
                f"nothing sways on '{machine.name}': it has no free joints that move an inertia"
            )
        self.machine = machine
        self._names = ", ".join(machine.active[i] for i in self.free_indices)
        self._dynamics = Dynamics(machine)
        units = machine.closure.units[machine.closure.active]
        self._difference_steps = _DIFFERENCE_STEP * units
        laws = (machine.friction.get(machine.active[i]) for i in self.free_indices)
        self._viscous = np.array([0.0 if law is None else law.viscous for law in laws])
        span = machine.upper - machine.lower
        self._stroke_lengths = np.where(np.isfinite(span), span, units)

    def hanging_equilibrium(self, q_a: ArrayLike) -> Array:
        """Configurations with the free joints in static equilibrium.

        The method is Newton's on g_f(q_d, q_f) = 0, from the given free joints.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            (n,) or (N, n) [m], [rad].

        Raises:
            InputError: There is no stable equilibrium nearby.
        """
        q_a = np.array(q_a, dtype=np.float64)
        free = self.free_indices
        for _ in range(_MAX_ITERATIONS):
            gravity_force = self._dynamics.gravity(q_a)[..., free]
            stiffness = self.stiffness(q_a)[..., free]
            determinants = np.abs(np.linalg.det(stiffness))
            if not np.isfinite(determinants).all() or not (determinants > 0).all():
                break
            newton_step = np.linalg.solve(stiffness, gravity_force[..., None])[..., 0]
            directions = self._coordinate_rates(q_a)[..., free]
            q_a -= np.einsum("...ij,...j->...i", directions, np.clip(newton_step, -0.5, 0.5))
            if np.abs(newton_step).max() < _EQUILIBRIUM_TOLERANCE**0.5 * 1e-3:
                return q_a
        raise InputError(
            f"what {self._names} carry has no stable equilibrium nearby: choose "
            "a configuration, and gravity, in which it hangs"
        )

    def stiffness(self, q_a: Array) -> Array:
        """Gravitational stiffness of the free joints, dg_f/dq_A, by small motions of joints.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            (f, n) or (N, f, n) for the f free joints.
        """
        columns, directions = [], self._coordinate_rates(q_a)
        for i, step in enumerate(self._difference_steps):
            perturbation = step * directions[..., i]
            gravity = self._dynamics.gravity
            columns.append(
                (gravity(q_a + perturbation) - gravity(q_a - perturbation)) / (2.0 * step)
            )
        return np.stack(columns, axis=-1)[..., self.free_indices, :]

    def _coordinate_rates(self, q_a: Array) -> Array:
        """Derivatives (n, n) or (N, n, n) of q_A by active velocities; 1 without ball joints."""
        closure, active = self.machine.closure, self.machine.closure.active
        if not self.machine.coordinates.is_rotation_vector[active].any():
            return np.broadcast_to(np.eye(len(active)), (*q_a.shape, len(active)))
        q = closure.solve(np.atleast_2d(q_a))
        rates = np.array([self.machine.coordinates.rate_matrix(one) for one in q])
        found = (rates @ closure.gamma(q))[:, active]
        return np.asarray(found.reshape(*q_a.shape, len(active)))

    def modes(self, q_a: ArrayLike) -> tuple[Array, Array]:
        """Modes of the sway with locked drives: (G - omega^2 M_ff) phi = 0.

        Args:
            q_a: (n,) [m], [rad], an equilibrium.

        Returns:
            Angular frequencies omega (f,) [rad/s] in ascending order, and damping ratios (f,) by
            viscous friction, phi^T C phi / (2 omega phi^T M_ff phi).
        """
        omega, shapes, _ = self._modal_analysis(np.asarray(q_a, dtype=np.float64))
        return omega, np.asarray(
            np.einsum("ik,i,ik->k", shapes, self._viscous, shapes) / (2.0 * omega)
        )

    def frequency_matrix(self, q_a: Array) -> Array:
        """Matrix Omega (f, f) [rad/s] with Omega^2 = M_ff^-1 G, at an equilibrium (n,)."""
        omega, shapes, mass = self._modal_analysis(q_a)
        return shapes @ (omega[:, None] * (shapes.T @ mass))

    def _modal_analysis(self, q_a: Array) -> tuple[Array, Array, Array]:
        """Frequencies (f,), mode shapes (f, f) of unit modal mass, and M_ff."""
        free = self.free_indices
        mass = self._dynamics.mass_matrix(q_a)[np.ix_(free, free)]
        stiffness = self.stiffness(q_a)[:, free]
        from scipy.linalg import eigh  # slow to import

        squares, shapes = eigh((stiffness + stiffness.T) / 2, mass)
        if squares[0] <= 0:
            raise InputError(
                f"what {self._names} carry does not hang, choose another configuration"
            )
        return np.sqrt(squares), shapes, mass

    def pivoting_motions(self, q_a: Array) -> Array:
        """Motions of the drives per sway that leave the load in place while it rotates.

        B solves (M_fd + M_ff E) B = -M_ff: the acceleration B theta'' of the drives cancels the
        effect of theta'' on the free joints. For a pendulum the tip moves by I / (m d) against the
        swing, about the centre of oscillation. The height of the tip is constant, and the motion
        has minimal norm relative to the strokes.

        Args:
            q_a: (N, n) [m], [rad], equilibria.

        Returns:
            (N, k, f) for the k driven joints.

        Raises:
            InputError: The drives cannot move the load in a direction of sway.
        """
        d, f = np.flatnonzero(self.machine.is_driven), self.free_indices
        mass = self._dynamics.mass_matrix(q_a)[:, f]
        stiffness = self.stiffness(q_a)
        hanging_derivatives = -np.linalg.solve(stiffness[:, :, f], stiffness[:, :, d])
        coupled_mass = mass[:, :, d] + mass[:, :, f] @ hanging_derivatives
        # relative to the inertia of the free joints
        free_mass_diagonal = np.einsum("ijj->ij", mass[:, :, f])[:, :, None]
        equations = [coupled_mass / free_mass_diagonal]
        right_sides = [-mass[:, :, f] / free_mass_diagonal]
        if len(d) > len(f):
            suspension = self.machine.tree.joints[self.machine.active[f[0]]].parent
            equations.append(Kinematics(self.machine, suspension).jacobian(q_a)[:, 2:3, d])
            right_sides.append(np.zeros((len(q_a), 1, len(f))))
        stroke_lengths = self._stroke_lengths[d]
        matrix = np.concatenate(equations, axis=1) * stroke_lengths
        if (np.linalg.svd(matrix[:, : len(f)], compute_uv=False)[:, -1] < 1e-3).any():
            raise InputError(
                f"the drives of '{self.machine.name}' cannot move what hangs on "
                f"{self._names} in every direction of sway: use an input shaper"
            )
        return stroke_lengths[:, None] * (
            np.linalg.pinv(matrix) @ np.concatenate(right_sides, axis=1)
        )

    def free_joint_forces(self, q_a: Array, v_a: Array, a_a: Array) -> Array:
        """Forces (N, f) of the free joints for a motion, without dry friction."""
        free = self.free_indices
        return self._dynamics.inverse(q_a, v_a, a_a)[:, free] + self._viscous * v_a[:, free]


def _spline_derivatives(time: Array, q_a: Array) -> tuple[Array, Array]:
    """Velocities and accelerations of the quintic spline from rest to rest."""
    from scipy.interpolate import make_interp_spline  # slow to import

    zero_values = np.zeros(q_a.shape[1])
    ends: Any = [(1, zero_values), (2, zero_values)]  # the stubs of scipy do not accept this
    spline = make_interp_spline(time, q_a, k=5, bc_type=(ends, ends))
    return spline(time, 1), spline(time, 2)


def input_shaper(machine: Machine, q_a: ArrayLike, robust: bool = False) -> tuple[Array, Array]:
    """Input shaper for all modes of the sway (Singer and Seering).

    With K = exp(-zeta pi / sqrt(1 - zeta^2)) and the damped half period h, the impulses of a mode
    are 1, K at 0, h (ZV, zero vibration), or 1, 2 K, K^2 at 0, h, 2 h (ZVD, whose residual also
    has a zero derivative by the frequency), divided by their sum (J. Dyn. Syst. Meas. Control 112
    (1990) 76-82). The shapers of several modes are convolved.

    Args:
        machine: The machine, with free joints.
        q_a: (n,) configuration of the modes [m], [rad].
        robust: ZVD in place of ZV.

    Returns:
        Delays (j,) [s] from 0, and amplitudes (j,) whose sum is 1.
    """
    sway_model = Sway(machine)
    delays, shares = np.zeros(1), np.ones(1)
    for omega, zeta in zip(*sway_model.modes(sway_model.hanging_equilibrium(q_a)), strict=True):
        decay = np.exp(-zeta * np.pi / np.sqrt(1.0 - zeta**2))
        half_period = np.pi / (omega * np.sqrt(1.0 - zeta**2))
        amplitudes = np.array([1.0, 2.0 * decay, decay**2] if robust else [1.0, decay])
        delays = (delays[:, None] + half_period * np.arange(len(amplitudes))).ravel()
        shares = (shares[:, None] * (amplitudes / amplitudes.sum())).ravel()
    order = np.argsort(delays)
    return delays[order], shares[order]


def _shaped_reference(machine: Machine, reference: Trajectory, time: Array, method: str) -> Array:
    """Samples (N, n) of the reference, shortened by the length of the shaper, after the shaper."""
    if method == "none":
        return reference.position(time)
    delays, shares = input_shaper(
        machine, reference.position(0.5 * reference.duration), robust=method == "zvd"
    )
    remaining_duration = reference.duration - delays[-1]
    if remaining_duration <= 0:
        raise InputError(
            f"the shaper takes {delays[-1]:.3g} s, the motion {reference.duration:.3g} s: give it "
            "more time"
        )
    shortened_reference = retime(reference, remaining_duration)
    delayed_references = [
        size * shortened_reference.position(time - at)
        for at, size in zip(delays, shares, strict=True)
    ]
    return np.asarray(np.sum(delayed_references, axis=0))


def _smooth_reference(reference: Trajectory, time: Array, width: float) -> Array:
    """Means (N, n) of a reference over a preceding width [s], weighted by a cubic B-spline."""
    from scipy.interpolate import BSpline  # slow to import

    kernel = BSpline.basis_element(np.linspace(0.0, width, 5), extrapolate=False)
    quarter = width / 4.0
    out: Array = np.zeros(())
    for piece in range(4):
        for x, weight in zip(
            quarter * (piece + 0.5 * (_GAUSS_POINTS + 1.0)), _GAUSS_WEIGHTS, strict=True
        ):
            quadrature_weight = 0.5 * weight * float(kernel(x))  # of the quadrature over `quarter`
            out = out + quadrature_weight * reference.position(time - x)
    return out


def _flatness_based_motion(sway_model: Sway, reference: Trajectory, time: Array) -> Array:
    """Samples (N, n) of a motion for which the load follows the smoothed reference."""
    from scipy.interpolate import BSpline  # slow to import

    duration, smoothing = reference.duration, _SMOOTHING_SHARE * reference.duration
    driven, free = sway_model.machine.is_driven, sway_model.free_indices
    hanging_configurations = sway_model.hanging_equilibrium(
        _smooth_reference(retime(reference, duration - smoothing), time, smoothing)
    )
    pivoting_motions = sway_model.pivoting_motions(hanging_configurations)
    spline_count = max(10, int(np.ceil(_SPLINES_PER_SECOND * duration)))
    knots = np.linspace(0.0, duration, spline_count + 1)
    knots = np.concatenate([np.full(5, 0.0), knots, np.full(5, duration)])
    # without those that have values or derivatives at an end
    splines = BSpline.design_matrix(time, knots, 5).toarray()[:, 3:-3]
    free_stiffness = sway_model.stiffness(hanging_configurations)[:, :, free]
    spline_projection = splines @ np.linalg.pinv(splines)
    theta = np.zeros((len(time), len(free)))
    previous_correction = np.inf
    for _ in range(_MAX_ITERATIONS):
        q_a = hanging_configurations.copy()
        q_a[:, driven] += np.einsum("nkf,nf->nk", pivoting_motions, theta)
        try:
            q_a = sway_model.hanging_equilibrium(q_a)
            q_a[:, free] += theta
            free_joint_forces = sway_model.free_joint_forces(q_a, *_spline_derivatives(time, q_a))
        except ClosureError:  # beyond the reach of the machine
            break
        correction = (
            spline_projection
            @ np.linalg.solve(free_stiffness, free_joint_forces[:, :, None])[:, :, 0]
        )
        correction_size = float(np.abs(correction).max())
        if correction_size < _CONVERGENCE_TOLERANCE or (
            correction_size < _STAGNATION_TOLERANCE and correction_size > 0.5 * previous_correction
        ):
            return q_a
        if correction_size > previous_correction:
            break
        theta, previous_correction = theta - correction, correction_size
    raise InputError(
        f"no motion of {duration:.3g} s without residual sway was found, the last "
        f"correction is {previous_correction:.2g} rad: give it more time"
    )


def suppress_sway(machine: Machine, reference: Trajectory, method: str = "flat") -> Trajectory:
    """Trajectory from rest to rest after which a hanging load does not sway.

    It has the start, the end and the duration of the reference, starts in equilibrium, and
    contains the free joints as they swing. Methods:

    - "flat": the load follows the reference, smoothed over a tenth of its duration, by the
      differential flatness of the pendulum; for a point mass on a string p_tip = p + L (p'' - g) /
      |p'' - g| (Fliess, Levine, Martin and Rouchon, Int. J. Control 61 (1995) 1327-1361). For
      rigid bodies on free joints the motion is iterated: drives q_d = s + B theta with the
      reference s and B of `Sway.pivoting_motions`, and theta corrected by -G^-1 times the forces
      that inverse dynamics gives for the free joints, until these are zero.
    - "zv", "zvd": the reference is shortened and passes the shaper of `input_shaper`, whose modes
      are those in the middle of the motion.
    - "none": the reference, with free joints in equilibrium.

    "flat" neglects friction of the free joints, the shapers all but viscous friction.

    Args:
        machine: The machine, with free joints and its payload.
        reference: Trajectory of the driven joints, from rest to rest.
        method: "flat", "zv", "zvd" or "none".

    Returns:
        Trajectory of all active joints.

    Raises:
        InputError: The method is unknown, the machine has no free joints, or the time is too
            short.
        LimitError: The trajectory leaves the limits of the drives.
    """
    if method not in SWAY_METHODS:
        raise InputError(f"method '{method}' is unknown, {suggest_names(SWAY_METHODS, method)}")
    sway_model, reference = Sway(machine), add_free_joints(machine, reference)
    count = max(12, int(np.ceil(reference.duration * _KNOTS_PER_SECOND)) + 1)
    time = np.linspace(0.0, reference.duration, count)
    if method == "flat":
        q_a = _flatness_based_motion(sway_model, reference, time)
    else:
        q_a = sway_model.hanging_equilibrium(_shaped_reference(machine, reference, time, method))
    trajectory = Trajectory(quintic_polynomials(time, q_a, *_spline_derivatives(time, q_a)))
    if text := limit_violation_message(machine, trajectory):
        raise LimitError(f"method '{method}': {text}")
    return trajectory
