"""Sway of a hanging load: its equilibrium, modes and pivoting motions."""

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.dynamics.dynamics import Dynamics
from crane.machine.machine import Machine
from crane.motion.kinematics import Kinematics

_EQUILIBRIUM_TOLERANCE = 1e-12  # of the equilibrium of the free joints
MAX_ITERATIONS = 30
_DIFFERENCE_STEP = 1e-6  # step of difference quotients [rad], [characteristic length]


class Sway(OneLineRepr):
    """Dynamics of a load that hangs on the free joints of a machine.

    With the free joints q_f, the driven joints q_d and the free joints at rest q_h(q_d),
    g_f(q_d, q_h) = 0, the sway is theta = q_f - q_h. With E = dq_h/dq_d = -G^-1 dg_f/dq_d and
    G = dg_f/dq_f, the equations of motion of the free joints are

        M_ff theta'' + (M_fd + M_ff E) q_d'' + G theta + ... = 0.

    Args:
        machine: The machine, with free joints.

    Raises:
        InputError: The machine has none.
    """

    def __init__(self, machine: Machine):
        if not machine.free:
            raise InputError(f"nothing sways on '{machine.name}': it has no free joints")
        self.machine = machine
        self._driven = machine.is_driven
        self._dynamics = Dynamics(machine)
        units = machine.closure.units[machine.closure.active]
        self._difference_steps = _DIFFERENCE_STEP * units
        laws = (machine.friction.get(joint) for joint in machine.free)
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
        free = ~self._driven
        for _ in range(MAX_ITERATIONS):
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
        raise InputError(
            f"what {names} carry has no stable equilibrium nearby: choose a configuration in "
            "which it hangs"
        )

    def stiffness(self, q_a: Array) -> Array:
        """Gravitational stiffness of the free joints, dg_f/dq_A.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            (f, n) or (N, f, n) for the f free joints.
        """
        columns = []
        for i, step in enumerate(self._difference_steps):
            perturbation = np.zeros(len(self._difference_steps))
            perturbation[i] = step
            gravity = self._dynamics.gravity
            columns.append(
                (gravity(q_a + perturbation) - gravity(q_a - perturbation)) / (2.0 * step)
            )
        return np.stack(columns, axis=-1)[..., ~self._driven, :]

    def modes(self, q_a: ArrayLike) -> tuple[Array, Array]:
        """Modes of the sway with locked drives: (G - omega^2 M_ff) phi = 0.

        Args:
            q_a: (n,) [m], [rad], an equilibrium.

        Returns:
            Angular frequencies omega (f,) [rad/s] in ascending order, and damping ratios (f,) by
            viscous friction, phi^T C phi / (2 omega phi^T M_ff phi).
        """
        omega, shapes, _ = self._modal_analysis(np.asarray(q_a, dtype=np.float64))
        modal_damping = np.einsum("ik,i,ik->k", shapes, self._viscous, shapes)
        return omega, np.asarray(modal_damping / (2.0 * omega))

    def frequency_matrix(self, q_a: Array) -> Array:
        """Matrix Omega (f, f) [rad/s] with Omega^2 = M_ff^-1 G, at an equilibrium (n,)."""
        omega, shapes, mass = self._modal_analysis(q_a)
        return shapes @ (omega[:, None] * (shapes.T @ mass))

    def _modal_analysis(self, q_a: Array) -> tuple[Array, Array, Array]:
        """Frequencies (f,), mode shapes (f, f) of unit modal mass, and M_ff."""
        free = ~self._driven
        mass = self._dynamics.mass_matrix(q_a)[np.ix_(free, free)]
        stiffness = self.stiffness(q_a)[:, free]
        from scipy.linalg import eigh  # slow to import

        squares, shapes = eigh((stiffness + stiffness.T) / 2, mass)
        if squares[0] <= 0:
            raise InputError(
                f"what {', '.join(self.machine.free)} carry does not hang, choose another "
                "configuration"
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
        d, f = np.flatnonzero(self._driven), np.flatnonzero(~self._driven)
        mass = self._dynamics.mass_matrix(q_a)[:, f]
        stiffness = self.stiffness(q_a)
        hanging_derivatives = -np.linalg.solve(stiffness[:, :, f], stiffness[:, :, d])
        coupled_mass = mass[:, :, d] + mass[:, :, f] @ hanging_derivatives
        # relative to the inertia of the free joints
        free_mass_diagonal = np.einsum("ijj->ij", mass[:, :, f])[:, :, None]
        equations = [coupled_mass / free_mass_diagonal]
        right_sides = [-mass[:, :, f] / free_mass_diagonal]
        if len(d) > len(f):
            equations.append(self._suspension_kinematics.jacobian(q_a)[:, 2:3, d])
            right_sides.append(np.zeros((len(q_a), 1, len(f))))
        stroke_lengths = self._stroke_lengths[d]
        matrix = np.concatenate(equations, axis=1) * stroke_lengths
        if (np.linalg.svd(matrix[:, : len(f)], compute_uv=False)[:, -1] < 1e-3).any():
            raise InputError(
                f"the drives of '{self.machine.name}' cannot move what hangs on "
                f"{', '.join(self.machine.free)} in every direction of sway: use an input shaper"
            )
        return stroke_lengths[:, None] * (
            np.linalg.pinv(matrix) @ np.concatenate(right_sides, axis=1)
        )

    def free_joint_forces(self, q_a: Array, v_a: Array, a_a: Array) -> Array:
        """Forces (N, f) of the free joints for a motion, without dry friction."""
        free = ~self._driven
        return self._dynamics.inverse(q_a, v_a, a_a)[:, free] + self._viscous * v_a[:, free]

    @cached_property
    def _suspension_kinematics(self) -> Kinematics:
        """Kinematics of the suspension, the link that carries the first free joint."""
        joint = self.machine.tree.joints[self.machine.free[0]]
        return Kinematics(self.machine, joint.parent)
