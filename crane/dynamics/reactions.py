"""Reactions: the wrenches that joints transmit, at rest and in motion."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from crane.closure.loop_equations import rotation_with_z_axis
from crane.common.errors import InputError
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array, as_samples
from crane.description.external_forces import WRENCH_COMPONENTS
from crane.dynamics.frame_jacobians import MIN_LENGTH, frame_placement
from crane.dynamics.joint_forces import JointForces
from crane.machine.machine import Machine

# relative pivot below which the closure checks for a singular configuration
_SINGULAR_TOLERANCE = 1e-10
_ZERO_STRESS_FACTOR = 10.0  # factor on the redundancy tolerance: a stress below counts as zero


class _StackKinematics(NamedTuple):
    """Kinematics of N configurations.

    Attributes:
        rotations: (N, nj + 1, 3, 3) of all bodies in the world, that of the world first.
        origins: (N, nj + 1, 3) of all bodies [m].
        columns: (N, 6, nv) of the joints, at the world's origin.
        loop_frames: (N, 2 l, 3, 3) and (N, 2 l, 3), the loops' frames.
        loop_wrenches: (N, r, 6) the loops' equations as wrenches at the world's origin.
        scaled_jacobian: (N, m, nv) of all equations, see `LoopEquations.evaluate_scaled`.
    """

    rotations: Array
    origins: Array
    columns: Array
    loop_frames: tuple[Array, Array]
    loop_wrenches: Array
    scaled_jacobian: Array

    def position(self, body: int, point: Array) -> Array:
        """(N, 3) positions of a point of a body in the world."""
        return np.asarray(self.origins[:, body] + self.rotations[:, body] @ point)


class Reactions(OneLineRepr):
    """Wrenches in the joints of a machine with closed loops.

    With tau the inverse dynamics of the tree (rnea) minus external wrenches and force elements
    between frames, f the passive forces along single joints, tau_F friction, I_r rotor inertias
    and the loop Jacobian Phi, the Lagrange multipliers lambda of the loops follow from the passive
    rows P of the balance along the joints, and the drive forces u from the active rows A:

        Phi_P^T lambda = (tau - f + tau_F + I_r a)_P,
        u = (tau - f + tau_F + I_r a)_A - Phi_A^T lambda.

    A loop acts on its successor with the wrench sum lambda_r w_r, on its predecessor with the
    opposite; the reaction of a joint of the tree is the balance of all bodies that it carries.

    The reaction of a joint includes all forces across it: along its axis also the drive, friction,
    springs and stops of the joint, and forces of couplings (a gear: its teeth act on each joint).
    Force elements between frames besides the joint are not included.

    **Undetermined components.** A loop may have redundant equations: those of a planar linkage in
    space also hold it in its plane, once per redundant loop. Forces along pins and moments across
    them then depend on the stiffness and fit of the bodies, which no file gives; so do all
    components of a part that is prestressed. The least-norm solution is taken, with forces
    multiplied by the characteristic length; `statically_determined` returns the components that do
    not depend on this choice. Drive forces do not depend on it, and equal `Dynamics.inverse` up to
    the closure tolerance.

    Args:
        machine: The machine with its current payload and parameters.

    Attributes:
        names: (k,) of the tree's joints in Pinocchio's order, then of the loops.

    Source: Featherstone 2008, Rigid Body Dynamics Algorithms, 8.2, 8.5 (loop-closure forces).
    """

    def __init__(self, machine: Machine):
        if not isinstance(machine, Machine):
            raise InputError(f"{machine!r} is not a machine, load it with crane.load")
        self.machine, self._joint_forces = machine, JointForces(machine)
        self._model = model = pin.Model(machine.model)
        self._data = model.createData()
        self._equations = equations = machine.closure.equations
        self.names = (*list(model.names)[1:], *(loop.name for loop in equations.loops))
        self._joint_of_column = (
            machine.coordinates.joints - 1
        )  # joint of each column, in the order of the wrenches
        # whether a joint (column) carries a body (row), and a loop's successor but not predecessor
        self._is_carried_by = np.zeros((model.njoints, model.njoints - 1))
        for body in range(1, model.njoints):
            self._is_carried_by[body, [joint - 1 for joint in model.supports[body] if joint]] = 1.0
        self._loop_bodies = [joint for joint, _ in equations.frames]
        ends = self._is_carried_by[self._loop_bodies]
        self._loop_paths = ends[1::2] - ends[::2]
        self._row_joint_signs = equations.sign[
            equations.loop_of_row[: len(equations.axis_of_frame1)]
        ]
        self._loop_of_row = np.eye(len(equations.loops))[
            :, equations.loop_of_row[: len(self._row_joint_signs)]
        ]
        # z along the axis, as in the loops' frames
        of = machine.tree.joints
        self._local_axes = np.array(
            [
                rotation_with_z_axis(of[x].axis) if x in of else np.eye(3)
                for x in list(model.names)[1:]
            ]
        ).reshape(-1, 3, 3)

    def joint_wrenches(
        self,
        q: ArrayLike,
        v: ArrayLike | None = None,
        a: ArrayLike | None = None,
        wrenches: Mapping[str, ArrayLike] | None = None,
        friction: bool = False,
    ) -> Array:
        """Wrenches that the carrier of a joint exerts on the body that the joint moves.

        For a loop: that its predecessor exerts on its successor.

        Args:
            q: (nq,) or (N, nq) closed configurations [m], [rad].
            v: The same shape, velocities gamma v_A; at rest if not given [m/s], [rad/s].
            a: The same shape, accelerations gamma a_A + drift; those at a_A = 0 if not given
                [m/s2], [rad/s2].
            wrenches: External wrenches by link (6,) or (N, 6), force [N] and moment about the
                origin of its frame [N m], in the world's axes.
            friction: Whether friction is included; see `Dynamics.inverse` for friction at rest.

        Returns:
            (k, 6) or (N, k, 6) in the order of `names`: force [N] and moment about the joint's
            origin, for a loop that of its successor's frame [N m], in the world's axes.

        Raises:
            InputError: Unknown link, or shapes that do not match.
            SingularConfigurationError: The passive joints are not determined there.
        """
        return self._solve_wrenches_and_drives(q, v, a, wrenches, friction)[0]

    def drive_forces(
        self,
        q: ArrayLike,
        v: ArrayLike | None = None,
        a: ArrayLike | None = None,
        wrenches: Mapping[str, ArrayLike] | None = None,
        friction: bool = False,
    ) -> Array:
        """Forces u of the active joints that go with `joint_wrenches`, (n,) or (N, n) [N], [N m].

        Args:
            q: See `joint_wrenches`.
            v: See `joint_wrenches`.
            a: See `joint_wrenches`.
            wrenches: See `joint_wrenches`.
            friction: See `joint_wrenches`.
        """
        return self._solve_wrenches_and_drives(q, v, a, wrenches, friction)[1]

    def unit_load_wrenches(self, q: ArrayLike, link: str) -> Array:
        """Derivatives of the joint wrenches by a force at the origin of a link.

        Args:
            q: (nq,) or (N, nq) closed configurations [m], [rad].
            link: Link on which the force acts.

        Returns:
            (k, 6, 3) or (N, k, 6, 3): `joint_wrenches` of a unit force in the world's x, y, z,
            minus those without.
        """
        body, placement = frame_placement(self.machine, link)
        rows, stacked = self._as_stack(q, "q")
        kinematics = self._evaluate_kinematics(rows)
        point = kinematics.position(body, placement.translation)
        push = np.broadcast_to(np.eye(3), (len(rows), 3, 3))
        carried = (
            -self._is_carried_by[body][None, :, None, None]
            * np.concatenate([push, np.cross(point[:, :, None], push, axis=1)], axis=1)[:, None]
        )
        out = self._solve_loop_forces(
            kinematics, rows, carried, np.zeros((len(rows), self._model.nv, 3))
        )[0]
        return out if stacked else out[0]

    def joint_axes(self, q: ArrayLike) -> Array:
        """Axes of the joints in the world, (k, 3, 3) or (N, k, 3, 3) with x, y, z as columns.

        z is the axis of the joint, for a loop its free axis; x and y are perpendicular to it and
        fixed to the moved body. axes^T force gives the components of a force (3,): x, y across the
        pin, z along it.

        Args:
            q: (nq,) or (N, nq) closed configurations [m], [rad].
        """
        rows, stacked = self._as_stack(q, "q")
        out = self._axes_in_world(self._evaluate_kinematics(rows))
        return out if stacked else out[0]

    def statically_determined(self, q: ArrayLike) -> NDArray[np.bool_]:
        """Which components of the wrenches statics determines, in the axes of `joint_axes`.

        Those that are zero for every self-stress, that is for every lambda with Phi_P^T lambda =
        0.

        Args:
            q: (nq,) or (N, nq) closed configurations [m], [rad].

        Returns:
            (k, 6) or (N, k, 6), three forces and three moments.
        """
        rows, stacked = self._as_stack(q, "q")
        kinematics = self._evaluate_kinematics(rows)
        passive = self.machine.closure.passive
        basis = np.linalg.qr(kinematics.scaled_jacobian[:, :, passive], mode="complete")[0]
        stress = basis[:, :, len(passive) :]
        none = np.zeros((len(rows), len(self._local_axes), 6, stress.shape[2]))
        wrenches = self._wrenches_with_loop_forces(
            kinematics, none, stress / self._equations.residual_units[:, None]
        )
        own = np.einsum(
            "nkab,nkhac->nkhbc",
            self._axes_in_world(kinematics),
            wrenches.reshape(*wrenches.shape[:2], 2, 3, -1),
        )
        own[:, :, 0] *= self._equations.characteristic_length
        tolerance = _ZERO_STRESS_FACTOR * self.machine.closure.structure.redundancy.tolerance
        out = np.abs(own).max(axis=-1, initial=0.0).reshape(len(rows), -1, 6) < tolerance
        return out if stacked else out[0]

    def _solve_wrenches_and_drives(
        self,
        q: ArrayLike,
        v: ArrayLike | None,
        a: ArrayLike | None,
        wrenches: Mapping[str, ArrayLike] | None,
        friction: bool,
    ) -> tuple[Array, Array]:
        rows, stacked = self._as_stack(q, "q")
        velocities = np.zeros_like(rows) if v is None else self._as_stack(v, "v", rows)[0]
        if a is not None:
            accelerations = self._as_stack(a, "a", rows)[0]
        else:
            accelerations = (
                np.zeros_like(rows) if v is None else self.machine.closure.drift(rows, velocities)
            )
        nv, forces = self._model.nv, self._joint_forces
        carried = np.empty((len(rows), len(self._local_axes), 6))
        kinematics = self._evaluate_kinematics(rows, carried, velocities, accelerations)
        element_forces, _ = forces.passive_forces_by_element(rows, velocities)
        for ends, force in zip(forces.lengths.end_points, element_forces[:, nv:].T, strict=True):
            one, two = (kinematics.position(*end) for end in ends)
            way = two - one
            push = (
                force[:, None] * way / np.maximum(np.linalg.norm(way, axis=1), MIN_LENGTH)[:, None]
            )
            for end, sign in zip(ends, (-1.0, 1.0), strict=True):
                self._subtract_wrench(kinematics, carried, end, sign * np.hstack([push, 0 * push]))
        for link, given in (wrenches or {}).items():
            wrench = as_samples(given, 6, f"the wrench on '{link}'", WRENCH_COMPONENTS)
            if wrench.ndim == 2 and (not stacked or len(wrench) != len(rows)):
                raise InputError(
                    f"the wrench on '{link}' has {len(wrench)} samples and q "
                    f"{len(rows) if stacked else 'is one'}, give as many"
                )
            body, placement = frame_placement(self.machine, link)
            self._subtract_wrench(kinematics, carried, (body, placement.translation), wrench)
        joint_forces = element_forces[:, :nv] - self._model.armature * accelerations
        if friction:
            joint_forces -= forces.friction_forces(velocities) + forces.breakaway_forces(
                velocities, accelerations
            )
        found, drives = self._solve_loop_forces(
            kinematics, rows, carried[..., None], joint_forces[..., None]
        )
        wrench, drive = found[..., 0], drives[..., 0]
        return (wrench, drive) if stacked else (wrench[0], drive[0])

    def _subtract_wrench(
        self, kinematics: _StackKinematics, carried: Array, point: tuple[int, Array], wrench: Array
    ) -> None:
        """Subtract a wrench (6,) or (N, 6) about a point of a body from `carried`."""
        about = np.array(np.broadcast_to(wrench, (len(carried), 6)))
        about[:, 3:] += np.cross(kinematics.position(*point), about[:, :3])
        carried -= self._is_carried_by[point[0]][:, None] * about[:, None]

    def _solve_loop_forces(
        self, kinematics: _StackKinematics, q: Array, carried: Array, joint_forces: Array
    ) -> tuple[Array, Array]:
        """Wrenches about the joints' origins and drive forces, for c load cases.

        Args:
            kinematics: Kinematics of the configurations.
            q: (N, nq) configurations.
            carried: (N, nj, 6, c) wrench that each joint carries without loops, at the world's
                origin.
            joint_forces: (N, nv, c) forces along the joints besides the drives.

        Returns:
            (N, k, 6, c) and (N, n, c).
        """
        closure, equations = self.machine.closure, self._equations
        required_forces = (
            np.einsum("nsi,nisc->nic", kinematics.columns, carried[:, self._joint_of_column])
            - joint_forces
        )
        turn, pivots = np.linalg.qr(kinematics.scaled_jacobian[:, :, closure.passive])
        size = np.abs(np.diagonal(pivots, axis1=1, axis2=2))
        if (
            edge := size.min(axis=1, initial=1.0)
            < _SINGULAR_TOLERANCE * size.max(axis=1, initial=0.0)
        ).any():
            closure.gamma(q[edge])
        right = (
            equations.coordinate_units[closure.passive, None] * required_forces[:, closure.passive]
        )
        # least squares of scaled values
        shares = turn @ np.linalg.solve(np.swapaxes(pivots, 1, 2), right)
        lambdas = shares / equations.residual_units[:, None]
        pull = np.einsum("nmi,nmc->nic", kinematics.scaled_jacobian[:, :, closure.active], shares)
        drives = (
            required_forces[:, closure.active]
            - pull / equations.coordinate_units[closure.active, None]
        )
        return self._wrenches_with_loop_forces(kinematics, carried, lambdas), drives

    def _wrenches_with_loop_forces(
        self, kinematics: _StackKinematics, carried: Array, multipliers: Array
    ) -> Array:
        """Wrenches (N, k, 6, c) about the joints' origins, with multipliers (N, m, c)."""
        loaded = (
            kinematics.loop_wrenches[..., None]
            * multipliers[:, : kinematics.loop_wrenches.shape[1], None, :]
        )
        loops = np.einsum("lr,nrsc->nlsc", self._loop_of_row, loaded)
        out = np.concatenate(
            [carried - np.einsum("lj,nlsc->njsc", self._loop_paths, loops), loops], axis=1
        )
        at = np.concatenate(
            [kinematics.origins[:, 1:], kinematics.loop_frames[1][:, 1::2]], axis=1
        )
        out[:, :, 3:] -= np.cross(at[..., None], out[:, :, :3], axis=2)
        return out

    def _evaluate_kinematics(
        self,
        q: Array,
        carried: Array | None = None,
        v: Array | None = None,
        a: Array | None = None,
    ) -> _StackKinematics:
        """Kinematics of configurations (N, nq); writes wrenches (N, nj, 6) into `carried`."""
        model, data, equations = self._model, self._data, self._equations
        columns = np.empty((len(q), 6, model.nv))
        bodies = np.empty((len(q), model.njoints, 4, 4))
        joint_placements, joint_forces = (
            list(data.oMi),
            list(data.f)[1:],
        )  # references, updated by Pinocchio
        for i, at in enumerate(self.machine.coordinates.configuration(q)):
            columns[i] = pin.computeJointJacobians(model, data, at).reshape(6, -1)
            bodies[i] = [placement.homogeneous for placement in joint_placements]
            if carried is not None and v is not None and a is not None:
                pin.rnea(model, data, at, v[i], a[i])
                carried[i] = [force.vector for force in joint_forces]
        rotations, origins = bodies[..., :3, :3], bodies[..., :3, 3]
        if carried is not None:
            carried[..., :3] = (rotations[:, 1:] @ carried[..., :3, None])[..., 0]
            carried[..., 3:] = (rotations[:, 1:] @ carried[..., 3:, None])[..., 0]
            carried[..., 3:] += np.cross(origins[:, 1:], carried[..., :3])
        local = [placement for _, placement in equations.frames]
        rotated = np.array([x.rotation for x in local]).reshape(-1, 3, 3)
        moved = np.array([x.translation for x in local]).reshape(-1, 3)
        of = rotations[:, self._loop_bodies]
        ends = of @ rotated, (of @ moved[..., None])[..., 0] + origins[:, self._loop_bodies]
        rows = equations.constraint_wrenches(*ends)
        scaled_jacobian = np.empty((len(q), len(equations.residual_units), model.nv))
        scaled_jacobian[:, : rows.shape[1]] = self._row_joint_signs * (rows @ columns)
        for i, one in enumerate(q if equations.couplings else ()):
            scaled_jacobian[i, rows.shape[1] :] = equations.evaluate_couplings(one)[1]
        scaled_jacobian *= equations.coordinate_units / equations.residual_units[:, None]
        return _StackKinematics(rotations, origins, columns, ends, rows, scaled_jacobian)

    def _axes_in_world(self, kinematics: _StackKinematics) -> Array:
        return np.concatenate(
            [kinematics.rotations[:, 1:] @ self._local_axes, kinematics.loop_frames[0][:, 1::2]],
            axis=1,
        )

    def _as_stack(self, value: ArrayLike, what: str, q: Array | None = None) -> tuple[Array, bool]:
        """A value as stack (N, nq), as many as configurations q, and whether it is one."""
        given = as_samples(value, self._model.nv, what, self.machine.joints)
        if not given.size:
            raise InputError(f"{what} is an empty stack, give at least one sample")
        rows = np.atleast_2d(given)
        if q is not None and rows.shape != q.shape:
            raise InputError(f"{what} has {len(rows)} samples and q {len(q)}, give as many")
        return rows, given.ndim == 2
