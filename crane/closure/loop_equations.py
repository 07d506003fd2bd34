"""The loop equations phi(q) = 0, their Jacobian and its rate, and clusters of joints."""

import threading
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from crane.closure.coordinates import Coordinates, Indices
from crane.common.errors import MechanismError
from crane.common.samples import Array
from crane.description.specification import LOOP_TYPES, Coupling, LoopSpec


def frame_id(model: pin.Model, link: str) -> int:
    """Index of the frame of a URDF link."""
    index: int = model.getFrameId(link, pin.FrameType.BODY)
    if index >= model.nframes:
        raise MechanismError(f"frame '{link}' is not in the assembled model, name a link")
    return index


def rotation_with_z_axis(axis: Sequence[float]) -> Array:
    """A rotation (3, 3) whose third column is the axis."""
    z_axis = np.array([axis])
    x_axis = _cross(np.eye(3)[[np.argmin(np.abs(z_axis))]], z_axis)
    x_axis /= np.linalg.norm(x_axis)
    return np.column_stack([x_axis[0], _cross(z_axis, x_axis)[0], z_axis[0]])


def _cross(a: Array, b: Array) -> Array:
    """Row-wise cross product; several times faster than numpy's for few rows."""
    out = np.empty_like(a)
    out[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    out[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    out[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out


def aligned_axes(loop_type: str) -> list[int]:
    """Axes of the two frames of a loop that point in the same direction when it is closed."""
    locked = LOOP_TYPES[loop_type][3:]
    if all(locked):
        return [0, 1, 2]
    return [k for k in range(3) if any(locked) and not locked[k]]


class LoopEquations:
    """All equations of the loops and couplings of a machine.

    A loop joins frame 1 (predecessor) and frame 2 (successor), both rotated so that z is the axis
    of the loop. With their axes a_i, b_k and origins p_1, p_2 in the world, its equations are

        a_i . (p_2 - p_1) = 0    for every locked translation i,
        a_i . b_k = 0            for locked rotations: two rows with b_k the free axis, or
                                 (x, y), (y, z), (z, x) where all three are locked.

    Each row has a wrench w = [a_i; p_2 x a_i] or [0; b_k x a_i] at the world's origin, so that
    phi' = w . (V_2 - V_1) with the spatial velocities V. Columns of joints that carry both frames
    therefore cancel exactly. Couplings follow, with sum c_j q_j + sum (a_j q_j^2 + b_j q_j^3 + d_j
    q_j^4) - offset = 0 each.

    Args:
        model: The spanning tree.
        loops: The loops.
        couplings: Constraints of joints.

    Attributes:
        coordinates: Coordinates of the tree.
        names: Names of loops, then couplings.
        loop_of_row: (m,) index in `names` of every equation.
        is_translation: (m,) whether the equation is a length.
        characteristic_length: See `Coordinates.characteristic_length` [m].
        coordinate_units: See `Coordinates.units`.
        motion_scales: See `Coordinates.motion_scales`.
        residual_units: (m,) units of the residuals: 1 rad, and the characteristic length [m].
        geared_columns: (row of `coupling_factors`, column) of coordinates in no loop that a
            coupling gives from others, such as rotors; after those that they follow from.
        step_units: (nv,) coordinate units; of geared columns, how far they move with the others.
        step_residual_units: (m,) residual units; of their couplings, those of their motion.
    """

    def __init__(
        self, model: pin.Model, loops: Sequence[LoopSpec], couplings: Sequence[Coupling] = ()
    ):
        self.model = model
        self.coordinates = Coordinates(model)
        self._thread_local = threading.local()  # a machine may be used by several threads
        self.loops = tuple(loops)
        self.frames: list[tuple[int, pin.SE3]] = []  # (joint, placement), two per loop
        joint_signs = np.zeros((len(loops), model.nv))
        rows: list[tuple[int, bool, int, int]] = []  # loop, is translation, axis of 1, axis of 2
        for index, loop in enumerate(loops):
            rotation = pin.SE3(rotation_with_z_axis(loop.axis), np.zeros(3))
            for side, name in ((-1.0, loop.predecessor), (1.0, loop.successor)):
                frame = model.frames[frame_id(model, name)]
                self.frames.append((frame.parentJoint, frame.placement * rotation))
                supports = [model.joints[i] for i in model.supports[frame.parentJoint] if i > 0]
                joint_signs[
                    index, [i for x in supports for i in range(x.idx_v, x.idx_v + x.nv)]
                ] += side
            locked = LOOP_TYPES[loop.type]
            rows += [(index, True, i, 0) for i in range(3) if locked[i]]
            free = [k for k in range(3) if not locked[3 + k]]
            if not free:
                rows += [(index, False, 0, 1), (index, False, 1, 2), (index, False, 2, 0)]
            if len(free) == 1:
                rows += [(index, False, i, free[0]) for i in range(3) if i != free[0]]
        table = np.ascontiguousarray(np.array(rows, dtype=np.intp).reshape(-1, 4).T)
        self._loop_index, is_loop_translation, self.axis_of_frame1, self.axis_of_frame2 = table
        self._is_loop_translation = is_loop_translation.astype(bool)
        self.sign = joint_signs
        self._row_joint_signs = joint_signs[self._loop_index]
        self.couplings = tuple(couplings)
        self.coupling_factors = np.zeros((len(self.couplings), model.nv))
        self.coupling_offsets = np.array([coupling.offset for coupling in self.couplings])
        self.coupling_powers = np.zeros((3, len(self.couplings), model.nv))  # of squares first
        is_length = []
        for i, coupling in enumerate(self.couplings):
            for name, factor in coupling.factors.items():
                column = self.coordinates.column(name)
                self.coupling_factors[i, column] = factor
            is_length.append(bool(self.coordinates.is_translation[column]))
            for name, coefficients in coupling.powers.items():
                self.coupling_powers[:, i, self.coordinates.column(name)] = coefficients
        self._has_powers = bool(self.coupling_powers.any())
        # (c, nv) which joints couplings bind
        self.is_coupled = (self.coupling_factors != 0) | self.coupling_powers.any(axis=0)
        self.names = (*(loop.name for loop in loops), *(item.name for item in couplings))
        self.loop_of_row = np.concatenate(
            [self._loop_index, len(self.loops) + np.arange(len(self.couplings), dtype=np.intp)]
        )
        self.is_translation = np.concatenate(
            [self._is_loop_translation, np.array(is_length, dtype=bool)]
        )
        self.characteristic_length = self.coordinates.characteristic_length
        self.coordinate_units = self.coordinates.units
        self.motion_scales = self.coordinates.motion_scales
        self.residual_units = np.where(self.is_translation, self.characteristic_length, 1.0)
        self.geared_columns = self._find_geared_columns()
        self.step_units = self.coordinate_units.copy()
        self.step_residual_units = self.residual_units.copy()
        for row, column in self.geared_columns:
            factor = abs(self.coupling_factors[row, column])
            moved = np.abs(self.coupling_factors[row]) @ self.step_units
            ratio = moved / factor - self.step_units[column]
            self.step_units[column] = max(self.step_units[column], ratio)
            self.step_residual_units[len(self._loop_index) + row] = factor * ratio

    def _find_geared_columns(self) -> list[tuple[int, int]]:
        """Columns in no loop and one coupling, then those in one of the remaining couplings."""
        found: list[tuple[int, int]] = []
        involved, is_in_loop = self.is_coupled, (self.sign != 0).any(axis=0)
        is_linear = ~self.coupling_powers.any(axis=(0, 2))
        is_left = np.ones(len(involved), dtype=bool)
        while True:
            ends = (involved[is_left].sum(axis=0) == 1) & ~is_in_loop
            rows = np.flatnonzero(is_left & is_linear & (involved & ends).any(axis=1))
            # a row without any other joint fixes its own
            rows = rows[involved[rows].sum(axis=1) > 1]
            if not len(rows):
                return found[::-1]
            column = int(np.flatnonzero(involved[rows[0]] & ends)[-1])
            found.append((int(rows[0]), column))
            is_left[rows[0]] = False

    def coupled_groups(self, columns: Indices) -> tuple[Indices, Indices]:
        """Groups of joints that equations connect, directly or through others.

        Args:
            columns: (k,) the joints.

        Returns:
            Group indices of the joints (k,) and of the rows (m,), -1 for rows without such joints.
        """
        involved = np.vstack([self.sign, self.is_coupled])[:, columns] != 0
        group = np.arange(len(columns), dtype=np.intp)
        for row in involved:
            _merge_groups(group, np.flatnonzero(row))
        group = np.unique(group, return_inverse=True)[1]
        return group, np.array(
            [int(group[tie][0]) if tie.any() else -1 for tie in involved], dtype=np.intp
        )[self.loop_of_row]

    def subset(self, names: Collection[str]) -> "LoopEquations":
        """The equations of some loops and couplings only, in the same coordinates."""
        found = LoopEquations(
            self.model,
            [loop for loop in self.loops if loop.name in names],
            [coupling for coupling in self.couplings if coupling.name in names],
        )
        found._thread_local.data = self.data  # creating data is expensive
        return found

    @property
    def cache_key(self) -> tuple[Any, ...]:
        """Everything that the equations depend on, see `crane.codegen.cached_result`."""
        loops = tuple(
            (x.name, x.type, x.predecessor, x.successor, *map(float, x.axis)) for x in self.loops
        )
        return (
            self.model.saveToString(),
            loops,
            tuple((x.name, tuple(x.factors.items()), x.offset) for x in self.couplings),
            self.coupling_powers,
        )

    @property
    def data(self) -> pin.Data:
        """Pinocchio's data of this thread."""
        try:
            return self._thread_local.data
        except AttributeError:
            self._thread_local.data = self.model.createData()
            return self._thread_local.data

    def _frame_placements(self) -> tuple[Array, Array]:
        """Rotations (2 l, 3, 3) and origins (2 l, 3) of `frames` in the world, from the data."""
        data = self.data
        placements = [data.oMi[joint] * local for joint, local in self.frames]
        rotations = np.array([placement.rotation for placement in placements])
        return rotations, np.array([placement.translation for placement in placements])

    def _row_geometry(self, rotations: Array, origins: Array) -> tuple[Array, Array, Array, Array]:
        """For every row: axis of frame 1, axis of frame 2, origins of both, each (..., m, 3).

        From rotations (..., 2 l, 3, 3) and origins (..., 2 l, 3) of `frames`.
        """
        axes, one = np.swapaxes(rotations, -1, -2), 2 * self._loop_index
        return (
            axes[..., one, self.axis_of_frame1, :],
            axes[..., one + 1, self.axis_of_frame2, :],
            origins[..., one, :],
            origins[..., one + 1, :],
        )

    def constraint_wrenches(self, rotations: Array, origins: Array) -> Array:
        """Rows w of the loops as wrenches on frame 2, at the world's origin.

        Args:
            rotations: (..., 2 l, 3, 3) of `frames`, in the world.
            origins: (..., 2 l, 3) of `frames` [m].

        Returns:
            (..., m, 6) without the rows of couplings.
        """
        a, b, _, p2 = self._row_geometry(rotations, origins)
        return self._assemble_wrenches(a, b, p2)

    def _assemble_wrenches(self, a: Array, b: Array, p2: Array) -> Array:
        wrenches = np.zeros((*a.shape[:-1], 6))
        is_translation = self._is_loop_translation
        wrenches[..., is_translation, :3] = a[..., is_translation, :]
        wrenches[..., 3:] = _cross(np.where(is_translation[:, None], p2, b), a)
        return wrenches

    def evaluate_couplings(self, q: Array) -> tuple[Array, Array, Array]:
        """Residuals (c,) of the couplings, their first and second derivatives (c, nv).

        Args:
            q: (nq,) [m], [rad].
        """
        residuals = self.coupling_factors @ q - self.coupling_offsets
        squares, cubes, fourths = self.coupling_powers
        if not self._has_powers:
            return residuals, self.coupling_factors, squares
        slopes = 2 * squares * q + 3 * cubes * q**2 + 4 * fourths * q**3
        curvatures = 2 * squares + 6 * cubes * q + 12 * fourths * q**2
        residuals = residuals + squares @ q**2 + cubes @ q**3 + fourths @ q**4
        return residuals, self.coupling_factors + slopes, curvatures

    def evaluate(self, q: Array) -> tuple[Array, Array]:
        """Residuals and Jacobian.

        Args:
            q: (nq,) [m], [rad].

        Returns:
            phi (m,) [m] for translations, [1] for rotations, and dphi/dq (m, nv).
        """
        coupling_residuals, coupling_jacobian, _ = self.evaluate_couplings(q)
        if not self.loops:
            return coupling_residuals, coupling_jacobian.copy()
        data, configuration = self.data, self.coordinates.configuration(q)
        # a vector for a single joint
        jacobian = pin.computeJointJacobians(self.model, data, configuration).reshape(6, -1)
        self._thread_local.last = a, b, p1, p2 = self._row_geometry(*self._frame_placements())
        phi = np.einsum("ij,ij->i", a, np.where(self._is_loop_translation[:, None], p2 - p1, b))
        loop_jacobian = self._row_joint_signs * (self._assemble_wrenches(a, b, p2) @ jacobian)
        if not self.couplings:
            return phi, loop_jacobian
        return np.concatenate([phi, coupling_residuals]), np.vstack(
            [loop_jacobian, coupling_jacobian]
        )

    def evaluate_scaled(self, q: Array) -> tuple[Array, Array]:
        """Scaled residuals and Jacobian, which do not depend on the size of the machine.

        Args:
            q: (nq,) [m], [rad].

        Returns:
            E^-1 phi (m,) and E^-1 dphi/dq D (m, nv), E = diag(residual_units),
            D = diag(coordinate_units).
        """
        phi, jacobian = self.evaluate(q)
        return phi / self.residual_units, jacobian / self.residual_units[
            :, None
        ] * self.coordinate_units

    def displace(self, q: Array, columns: NDArray[Any], step: NDArray[Any]) -> Array:
        """Configuration (nq,) after a displacement of some columns, scaled by their units.

        Displacements are integrals of velocities: those of a rotation vector are rotations about
        the axes of the child, see `Coordinates.rate_matrix`.
        """
        displacement = np.zeros(len(q))
        displacement[columns] = step * self.coordinate_units[columns]
        return q + self.coordinates.coordinate_derivatives(q, displacement)

    def name_of_row(self, row: int) -> str:
        """Name of the loop or coupling that an equation belongs to."""
        return self.names[self.loop_of_row[row]]

    def unit_of_row(self, row: int) -> str:
        """Unit of the residual of an equation."""
        return "m" if self.is_translation[row] else "rad"

    def find_opposed_loop(self, q: Array) -> str | None:
        """Name of a loop with antiparallel axes, which also solve its equations, or None."""
        if not self.loops:
            return None
        pin.forwardKinematics(self.model, self.data, self.coordinates.configuration(q))
        rotations, _ = self._frame_placements()
        cosines = np.einsum("lik,lik->lk", rotations[::2], rotations[1::2])
        for loop, cosines_of_loop in zip(self.loops, cosines, strict=True):
            if (cosines_of_loop[aligned_axes(loop.type)] < 0).any():
                return loop.name
        return None

    def acceleration_bias(self, q: Array, v: Array) -> Array:
        """Second derivative of phi at zero joint acceleration, (d/dt dphi/dq) v.

        Args:
            q: (nq,) [m], [rad], the configuration of this thread's last call of `evaluate`.
            v: (nv,) [m/s], [rad/s].

        Returns:
            (m,).
        """
        coupling_bias = self.evaluate_couplings(q)[2] @ v**2
        if not self.loops:
            return coupling_bias
        a, b, _, p2 = self._thread_local.last
        data, configuration = self.data, self.coordinates.configuration(q)
        rate = pin.computeJointJacobiansTimeVariation(self.model, data, configuration, v)
        velocity = np.array([data.ov[joint].vector for joint, _ in self.frames])
        one = 2 * self._loop_index
        v2, w1, w2 = velocity[one + 1, :3], velocity[one, 3:], velocity[one + 1, 3:]
        is_translation = self._is_loop_translation[:, None]
        arm = np.where(is_translation, p2, b)
        arm_rate = _cross(w2, arm) + np.where(is_translation, v2, 0.0)
        a_rate = _cross(w1, a)
        wrench_rate = np.zeros((len(a), 6))
        wrench_rate[self._is_loop_translation, :3] = a_rate[self._is_loop_translation]
        wrench_rate[:, 3:] = _cross(arm_rate, a) + _cross(arm, a_rate)
        split = self._row_joint_signs * v  # (m, nv): v of frame 2 minus v of frame 1
        relative, bias = split @ data.J.reshape(6, -1).T, split @ rate.reshape(6, -1).T
        loop_bias = np.einsum("ij,ij->i", wrench_rate, relative) + np.einsum(
            "ij,ij->i", self._assemble_wrenches(a, b, p2), bias
        )
        return np.concatenate([loop_bias, coupling_bias])


@dataclass(frozen=True)
class Cluster:
    """Joints that only move together, or a single joint.

    The joints form a connected part of the tree. No joint is in two clusters, so that the clusters
    form a tree as well.

    Attributes:
        base: The body that carries the cluster.
        joints: Indices of the joints, parents first; joint i moves body i.
    """

    base: int
    joints: tuple[int, ...]

    def own_coordinates(self, active_joints: Sequence[int]) -> list[int]:
        """Indices k of the active joints that belong to the cluster."""
        return [k for k, joint in enumerate(active_joints) if joint in self.joints]


def find_clusters(equations: LoopEquations) -> list[Cluster]:
    """The clusters of a machine, each after the one that carries it.

    Joints on the path between joints that one equation ties together belong to the cluster, too.
    """
    parents = equations.coordinates.parents
    group = np.arange(len(parents), dtype=np.intp)
    for row in (*equations.sign, *equations.is_coupled):
        tied = (np.flatnonzero(row) + 1).tolist()
        if not tied:
            continue
        paths = [{0, *supporting_bodies(parents, parents[joint])} for joint in tied]
        between = set().union(*paths) - paths[0].intersection(*paths[1:])
        _merge_groups(group, np.array([*tied, *between], dtype=np.intp))
    members: dict[int, list[int]] = {}
    for i in range(1, len(parents)):
        members.setdefault(int(group[i]), []).append(i)
    return [Cluster(parents[joints[0]], tuple(joints)) for joints in members.values()]


def _merge_groups(group: Indices, members: Indices) -> None:
    """Give members, and all others in their groups, the least group index of these."""
    connected = np.isin(group, group[members])
    group[connected] = group[connected].min(initial=len(group))


def supporting_bodies(parents: Sequence[int], body: int) -> list[int]:
    """A body and the bodies that carry it, except the world."""
    found = []
    while body:
        found.append(body)
        body = parents[body]
    return found
