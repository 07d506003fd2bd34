"""Equations of motion in the active coordinates."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError, suggest_names
from crane.common.samples import (
    Array,
    as_number,
    as_samples,
    solve_linear,
    stack_length,
)
from crane.description.external_forces import WRENCH_COMPONENTS
from crane.dynamics.compiled_dynamics import DERIVATIVES_OF, WITH_FRICTION
from crane.dynamics.frame_jacobians import FrameJacobians
from crane.dynamics.quantity_evaluator import QUANTITY_ARGUMENTS, QuantityEvaluator
from crane.machine.massless_motions import hold_coordinates

_IDLE_FORCE_SHARE = 1e-9  # of the largest force, that counts as rounding


class Dynamics(QuantityEvaluator):
    """Dynamics of a machine in its active coordinates, without Lagrange multipliers.

    The tree's dynamics projected by gamma (Park, Choi, Ploen 1999), equations (4) and (6) of the
    reduced-scale forwarder paper:

        tau_A = gamma^T (rnea(q, v, a) - f(q, v)) [+ gamma^T tau_F(v)]
              = M_A(q_A) a_A + bias(q_A, v_A) [+ friction(q_A, v_A)],

    with f the passive forces and tau_F the friction of all joints. Friction is only included on
    request; passive forces belong to the machine and are always included. Every method takes
    single samples (n,) or stacks (N, n) and returns the same kind. Not safe to share between
    threads.

    Two backends compute the same to rounding: "compiled" turns each quantity, on first use, into
    machine code of straight-line formulas of this machine; "pinocchio" projects the results of
    Pinocchio's algorithms. Formulas of very large machines take too long to compile and are left
    to the second.

    Args:
        machine: The machine with its current payload and parameters.
        formulation: "exact", or "decoupled": every sub-chain on a base held still, as published.
            It lacks the forces of a chain on the chain that carries it, so that it does not
            conserve energy; `docs/validation/mini_forwarder.md` shows by how much.
        backend: "compiled" or "pinocchio".

    Raises:
        InputError: Unknown formulation or backend.
        MechanismError: No moving body has a mass.
    """

    def _one_line(self) -> str:
        return f"Dynamics of '{self.machine.name}', {self.backend}"

    @property
    def parameters(self) -> Array:
        """(10 nb + nr,) inertial parameters of the bodies, in the order of the tree's joints.

        Ten per body about the origin of its joint frame: m, m c_x, m c_y, m c_z, I_xx, I_xy, I_yy,
        I_xz, I_yz, I_zz [kg, kg m, kg m2]. After them the nr rotor inertias that are not zero, in
        the same order [kg m2], [kg].
        """
        return self.tree_dynamics.inertial_parameters

    def inverse(
        self,
        q_a: ArrayLike,
        v_a: ArrayLike,
        a_a: ArrayLike,
        friction: bool = False,
        step: float | None = None,
    ) -> Array:
        """Inverse dynamics: tau_A = gamma^T (rnea(q, v, a) - f) [+ friction].

        Friction with presliding or memory depends on the history of the motion: with a step the
        samples are those of a motion, which begins without history, else each is of a steady one.

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            v_a: The same shape [m/s], [rad/s].
            a_a: The same shape [m/s2], [rad/s2].
            friction: Whether the drives overcome friction. At rest, under stiction, it opposes the
                acceleration of the joint; without acceleration it is the friction offset.
            step: Step of the samples (N, n) of a motion [s], with friction; where its velocity is
                exactly zero, only presliding and the offset act.

        Returns:
            tau_A, (n,) or (N, n) [N], [N m].

        Raises:
            InputError: The step is not positive, or given for a single sample or no friction.
        """
        if step is None:
            quantity = "inverse with friction" if friction else "inverse"
            return self._evaluate(quantity, q_a, v_a, a_a)
        as_number(step, "step", "s", greater_than=0)
        if not friction or np.ndim(v_a) != 2:
            raise InputError("a step is that of a motion (N, n) with friction, leave it out")
        tau, closure = self._evaluate("inverse", q_a, v_a, a_a), self.machine.closure
        q = closure.solve(q_a)
        gamma = closure.gamma(q)
        v = (gamma @ np.asarray(v_a)[:, :, None])[:, :, 0]
        force = self.forces.friction_along_motion(q, v, step)
        return tau + np.einsum("kij,ki->kj", gamma, force)

    def forward(
        self, q_a: ArrayLike, v_a: ArrayLike, tau_a: ArrayLike, friction: bool = False
    ) -> Array:
        """Forward dynamics: M_A a_A = tau_A - bias [- friction].

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            v_a: The same shape [m/s], [rad/s].
            tau_a: The same shape [N], [N m].
            friction: Whether friction brakes. At rest, under stiction, only its offset acts:
                `simulate` determines which joints are held.

        Returns:
            a_A, (n,) or (N, n) [m/s2], [rad/s2], 0 for held coordinates (`Machine.held`).

        Raises:
            SingularMassMatrixError: Some motion moves no inertia there.
            InputError: A force acts on an idle motion; otherwise as for other quantities.
        """
        a_a = self._evaluate("forward with friction" if friction else "forward", q_a, v_a, tau_a)
        if self.machine.held:
            self._check_idle_forces(q_a, v_a, tau_a, a_a, friction)
        return a_a

    def hybrid(
        self, q_a: ArrayLike, v_a: ArrayLike, a_d: ArrayLike, friction: bool = False
    ) -> tuple[Array, Array]:
        """Inverse dynamics of the driven joints d, forward dynamics of the free ones f.

        No drive acts on free joints. With c = inverse(q_A, v_A, (a_d, 0)),

            a_f = -M_ff^-1 c_f,    tau_d = c_d + M_df a_f.

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            v_a: The same shape [m/s], [rad/s].
            a_d: Accelerations of the k driven joints in their order, (k,) or (N, k) [m/s2],
                [rad/s2].
            friction: As in `inverse` for driven joints, as in `forward` for free ones.

        Returns:
            tau_d, (k,) or (N, k) [N], [N m], and a_f, (n - k,) or (N, n - k) [m/s2], [rad/s2].

        Source: Featherstone 2008, Rigid Body Dynamics Algorithms, 9.2 (hybrid dynamics); Spong
        1994, Partial feedback linearization of underactuated mechanical systems (collocated).
        """
        c = self.inverse(q_a, v_a, self.machine.expand_driven(a_d, "a_d"), friction)
        driven, held = self.machine.is_driven, list(self.machine.held)
        mass = hold_coordinates(self.mass_matrix(q_a), self.machine.held)
        coupling_block, free_block = (
            mass[..., driven, :][..., ~driven],
            mass[..., ~driven, :][..., ~driven],
        )
        unbalanced = c.copy()
        unbalanced[..., held] = 0.0
        self.check_free_block(q_a, free_block)
        a_f = -solve_linear(free_block, unbalanced[..., ~driven, None])
        return c[..., driven] + (coupling_block @ a_f)[..., 0], a_f[..., 0]

    def _check_idle_forces(
        self, q_a: ArrayLike, v_a: ArrayLike, tau_a: ArrayLike, a_a: Array, friction: bool
    ) -> None:
        """Check that forces do not act on idle motions, which nothing would limit.

        Raises:
            InputError: One does.
        """
        held = list(self.machine.held)
        needed = self.inverse(q_a, v_a, a_a) + (self.friction(q_a, v_a) if friction else 0.0)
        scale = np.maximum(np.abs(tau_a), np.abs(self.bias(q_a, v_a))).max(axis=-1, initial=0.0)
        excess = np.abs(np.subtract(tau_a, needed))[..., held]
        if not (excess <= _IDLE_FORCE_SHARE * scale[..., None]).all():
            name = self.machine.active[held[int(excess.reshape(-1, len(held)).max(0).argmax())]]
            raise InputError(
                f"a force of {excess.max():.3g} acts on the idle motion of '{name}', which has no "
                "inertia: give it 0, or its link an inertia"
            )

    def mass_matrix(self, q_a: ArrayLike) -> Array:
        """M_A = gamma^T M gamma.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            (n, n) or (N, n, n) [kg], [kg m], [kg m2].
        """
        return self._evaluate("mass matrix", q_a)

    def bias(self, q_a: ArrayLike, v_a: ArrayLike) -> Array:
        """Active forces at zero acceleration: gamma^T (rnea(q, v, drift) - f).

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            v_a: The same shape [m/s], [rad/s].

        Returns:
            (n,) or (N, n) [N], [N m].
        """
        return self._evaluate("bias", q_a, v_a)

    def gravity(self, q_a: ArrayLike) -> Array:
        """Active forces that balance gravity: gamma^T g(q), without passive forces.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            (n,) or (N, n) [N], [N m].
        """
        return self._evaluate("gravity", q_a)

    def friction(self, q_a: ArrayLike, v_a: ArrayLike) -> Array:
        """Active forces that overcome friction of all joints: gamma^T tau_F(gamma v_A).

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            v_a: The same shape [m/s], [rad/s].

        Returns:
            (n,) or (N, n) [N], [N m].
        """
        return self._evaluate("friction", q_a, v_a)

    def passive(self, q_a: ArrayLike, v_a: ArrayLike) -> Array:
        """Passive forces at the active joints: gamma^T f(q, gamma v_A).

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            v_a: The same shape [m/s], [rad/s].

        Returns:
            (n,) or (N, n) [N], [N m].
        """
        return self._evaluate("passive", q_a, v_a)

    def project_wrenches(self, q_a: ArrayLike, wrenches: Mapping[str, ArrayLike]) -> Array:
        """External wrenches at the active joints: gamma^T sum J^T w.

        M_A a_A + bias = tau_A + applied: subtract them from `inverse` or `gravity`, and add them
        to tau_A for `forward`. These methods do not include the machine's `external_forces`.

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            wrenches: By link (6,) or (N, 6), force [N] and moment about the origin of its frame
                [N m], in the world's axes.

        Returns:
            (n,) or (N, n) [N], [N m].

        Raises:
            InputError: Unknown link, or shapes that do not match.
        """
        q_a = as_samples(q_a, self._mobility, "q_a", self.machine.active)
        given = {
            link: as_samples(wrench, 6, f"the wrench on '{link}'", WRENCH_COMPONENTS)
            for link, wrench in wrenches.items()
        }
        for link in given:
            self.machine.frame(link)
        length = stack_length((q_a, *given.values()))
        count = 1 if length is None else length
        q = self.machine.closure.solve(np.broadcast_to(q_a, (count, self._mobility)))
        out = np.zeros((count, self._mobility))
        jacobians = FrameJacobians(self.machine)
        rows = {link: np.broadcast_to(wrench, (count, 6)) for link, wrench in given.items()}
        for i, gamma in enumerate(self.machine.closure.gamma(q)):
            jacobians.set_configuration(q[i])
            for link, wrench in rows.items():
                out[i] += gamma.T @ (jacobians.jacobian(link).T @ wrench[i])
        return out[0] if length is None else out

    def energy(self, q_a: ArrayLike, v_a: ArrayLike) -> tuple[Array, Array]:
        """Kinetic and potential energy; the potential includes springs and constant forces.

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            v_a: The same shape [m/s], [rad/s].

        Returns:
            Two arrays, () or (N,) [J].
        """
        both = self._evaluate("energy", q_a, v_a)
        return both[..., 0], both[..., 1]

    def regressor(self, q_a: ArrayLike, v_a: ArrayLike, a_a: ArrayLike) -> Array:
        """Regressor Y_A = gamma^T Y(q, v, a): inverse = Y_A parameters - passive.

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            v_a: The same shape [m/s], [rad/s].
            a_a: The same shape [m/s2], [rad/s2].

        Returns:
            (n, 10 nb + nr) or (N, n, 10 nb + nr), columns in the order of `parameters`.
        """
        return self._evaluate("regressor", q_a, v_a, a_a)

    def derivatives(
        self,
        quantity: str,
        q_a: ArrayLike,
        v_a: ArrayLike | None = None,
        x: ArrayLike | None = None,
        *,
        friction: bool = False,
        by: Sequence[str] | None = None,
    ) -> dict[str, Array]:
        """Exact derivatives of a quantity through the closed loops.

        By the state and the second argument, along the motions of the active joints: dq = gamma
        dq_A (for a floating base along its twist). By parameters of the machine at the same q_A,
        v_A and second argument: J_P dq_P = -(dphi/dp) dp. Inverse and forward dynamics without
        floating bases have analytic formulas (`crane.dynamics.dynamics_derivatives`), which cost a
        few evaluations; other quantities are differentiated operation by operation. Under stiction
        at rest the derivatives are those of the friction offset alone; at an end stop those of the
        current side.

        Args:
            quantity: "inverse", "forward", "mass_matrix", "bias", "gravity", "friction",
                "passive", "energy" (kinetic, then potential), "regressor" or "statics" (see
                `crane.dynamics.statics`).
            q_a: (n,) or (N, n) [m], [rad].
            v_a: The same shape [m/s], [rad/s], where the quantity depends on it.
            x: The second argument of inverse and regressor (a_A) and of forward (tau_A), the same
                shape.
            friction: Whether inverse and forward dynamics include friction.
            by: Names among "q_a", "v_a", "a_a", "tau_a" and `crane.description.parameters` such as
                "boom.mass", "lift_eye.x", "friction.lift.viscous". All arguments if not given.

        Returns:
            By name, arrays of the quantity's shape, with one more axis (n,) for the arguments.

        Raises:
            InputError: An unknown quantity or name, a missing argument, or a machine whose
                formulas take too long to compile.
            SingularMassMatrixError: See `forward`.
        """
        if quantity not in QUANTITY_ARGUMENTS:
            raise InputError(
                f"quantity '{quantity}' is unknown, {suggest_names(QUANTITY_ARGUMENTS, quantity)}"
            )
        n, arguments = self._mobility, QUANTITY_ARGUMENTS[quantity]
        if friction and quantity not in ("inverse", "forward"):
            raise InputError(
                f"'{quantity}' is without friction or with its own, leave friction out"
            )
        given: dict[str, ArrayLike] = {}
        for name, value in zip(arguments, (q_a, v_a, x), strict=False):
            if value is None:
                raise InputError(f"derivatives of '{quantity}' need {name}, give it")
            given[name] = value
        by = arguments if by is None else by
        parameters = [name for name in by if name not in ("q_a", "v_a", "a_a", "tau_a")]
        for name in by:
            if name not in (*arguments, *parameters):
                hint = suggest_names(arguments, name)
                raise InputError(f"'{quantity}' does not depend on '{name}', {hint}")
        targets, inputs, length = self._stack_arguments(given)
        q, count = self.machine.closure.solve(targets), len(targets)
        key = quantity.replace("_", " ") + (WITH_FRICTION if friction else "")
        shape, found = self.result_shape(quantity), dict[str, Array]()
        if len(parameters) < len(by):
            formula = self._required_formula(DERIVATIVES_OF + key)
            parts = formula.evaluate_closed(q, inputs).reshape(count, 3, *shape, n)
            found = {name: parts[:, i].copy() for i, name in enumerate(arguments) if name in by}
        if parameters:
            every = self._parameter_derivatives_at(key, parameters, q, inputs)
            every = every.reshape(count, *shape, len(parameters))
            found |= {name: every[..., i].copy() for i, name in enumerate(parameters)}
        if quantity == "forward" and not all(np.isfinite(x).all() for x in found.values()):
            self.check_mass_matrices(q)
        return {name: found[name][0] if length is None else found[name] for name in by}

    def drive_forces(
        self, q_a: ArrayLike, tau_a: ArrayLike, sharing: Mapping[str, float] | None = None
    ) -> Array:
        """Forces of the drives that produce active forces, also for redundant drives.

        With the drives' lengths L = S q + const and B = (S gamma)^T, tau_A = B u. Where there are
        more drives than degrees of freedom the forces share the load by weights W,

            u = W B^T (B W B^T)^+ tau_A,

        the least sum of u_i^2 / W_i. Active forces of joints that no drive moves are dropped;
        `active_forces` shows the result.

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            tau_a: The same shape [N], [N m].
            sharing: Weights W by drive, above 0; all 1 if not given.

        Returns:
            u (m,) or (N, m) [N], [N m], in the order of `Machine.drives`.

        Raises:
            InputError: Unknown drive, or a weight that is not above 0.
        """
        n, drives = self._mobility, self.machine.drives
        names = [drive.name for drive in drives]
        weights = np.ones(len(drives))
        for name, given in (sharing or {}).items():
            if name not in names:
                raise InputError(f"sharing names the drive '{name}', {suggest_names(names, name)}")
            weights[names.index(name)] = as_number(
                given, f"the share of '{name}'", "", greater_than=0
            )
        drive_jacobian = self._drive_jacobian(q_a)
        tau_a = as_samples(tau_a, n, "tau_a", self.machine.active)
        units = self.machine.closure.units[self.machine.closure.active]
        drive_jacobian = (
            drive_jacobian * units[:, None]
        )  # comparable: virtual work per 1 rad or characteristic length
        weighted_jacobian = weights[:, None] * np.swapaxes(drive_jacobian, -1, -2)
        inverse = np.linalg.pinv(drive_jacobian @ weighted_jacobian, rcond=1e-12, hermitian=True)
        return np.asarray(
            np.einsum("...ij,...jk,...k->...i", weighted_jacobian, inverse, tau_a * units)
        )

    def active_forces(self, q_a: ArrayLike, forces: ArrayLike) -> Array:
        """Active forces from forces of the drives: tau_A = (S gamma)^T u, see `drive_forces`.

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            forces: u (m,) or (N, m) [N], [N m], in the order of `Machine.drives`.

        Returns:
            (n,) or (N, n) [N], [N m].
        """
        names = [drive.name for drive in self.machine.drives]
        u = as_samples(forces, len(names), "forces", names)
        return np.asarray(np.einsum("...ij,...j->...i", self._drive_jacobian(q_a), u))

    def _drive_jacobian(self, q_a: ArrayLike) -> Array:
        """B = (S gamma)^T, (n, m) or (N, n, m), of the drives."""
        machine = self.machine
        lengths = np.zeros((len(machine.drives), machine.model.nv))  # S
        for row, drive in zip(lengths, machine.drives, strict=True):
            for joint, factor in drive.factors.items():
                row[machine.column(joint)] += factor
        return np.swapaxes(lengths @ machine.closure.gamma(machine.closure.solve(q_a)), -1, -2)
