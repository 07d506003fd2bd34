"""The loop equations phi(q) = 0, their Jacobian and its time derivative."""

import threading
from collections.abc import Collection, Sequence
from functools import cached_property

import numpy as np
import pinocchio as pin

from crane.closure.choice import Indices, scales, size
from crane.closure.coordinates import Coordinates
from crane.common.errors import MechanismError
from crane.common.samples import Array
from crane.description import LOOP_TYPES, Coupling, LoopSpec


def frame_id(model: pin.Model, link: str) -> int:
    """Index of the frame of a URDF link."""
    index: int = model.getFrameId(link, pin.FrameType.BODY)
    if index >= model.nframes:
        raise MechanismError(f"frame '{link}' is not in the assembled model, name a link")
    return index


def turned(axis: Sequence[float]) -> Array:
    """A rotation (3, 3) whose third column is the axis."""
    third = np.array([axis])
    first = _cross(np.eye(3)[[np.argmin(np.abs(third))]], third)
    first /= np.linalg.norm(first)
    return np.column_stack([first[0], _cross(third, first)[0], third[0]])


def _columns(jacobian: Array) -> Array:
    """(6, nv) also of one joint, for which Pinocchio gives (6,)."""
    return jacobian.reshape(6, -1)


def _cross(a: Array, b: Array) -> Array:
    """Row-wise cross product; numpy's own costs several times more on a few rows."""
    out = np.empty_like(a)
    out[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    out[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    out[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out


def _columns_to(model: pin.Model, joint: int) -> list[int]:
    """Columns of the joints that move a joint's body."""
    supports = [model.joints[i] for i in model.supports[joint] if i > 0]
    return [column for x in supports for column in range(x.idx_v, x.idx_v + x.nv)]


def aligned_axes(loop_type: str) -> list[int]:
    """Axes of the two frames of a loop that point the same way when it is closed."""
    locked = LOOP_TYPES[loop_type][3:]
    if all(locked):
        return [0, 1, 2]
    return [k for k in range(3) if any(locked) and not locked[k]]


class LoopEquations:
    """All equations of all loops and couplings of a machine.

    A loop joins frame 1 (predecessor) and frame 2 (successor), both turned so that the loop's
    axis is their z. With their axes a_i, b_k and origins p_1, p_2 in the world, its equations are

        a_i . (p_2 - p_1) = 0    for every locked translation i,
        a_i . b_k = 0            for locked rotations: two rows with b_k the free axis, or
                                 (x, y), (y, z), (z, x) where all three are locked.

    Row by row there is a wrench w = [a_i; p_2 x a_i] or [0; b_k x a_i] at the world's origin, so
    that phi' = w . (V_2 - V_1) with the spatial velocities V. Columns of joints that carry both
    frames therefore cancel exactly. Couplings of joints follow, sum c_j q_j - offset = 0 each.

    Args:
        model: The spanning tree.
        loops: The loops.
        couplings: Linear constraints of joints.

    Attributes:
        coordinates: Of the tree.
        names: Of what the equations belong to: loops, then couplings.
        loop_of_row: (m,) index in `names` of every equation.
        is_translation: (m,) whether it is about a length.
        size: Of the machine [m], see `crane.closure.choice.size`.
        units: (nv,) of the coordinates, to compare them: 1 rad, and the machine's size [m].
        row_units: (m,) of the equations, likewise.
    """

    def __init__(
        self, model: pin.Model, loops: Sequence[LoopSpec], couplings: Sequence[Coupling] = ()
    ):
        self.model = model
        self.coordinates = Coordinates(model)
        self._local = threading.local()  # a machine may be used by several threads
        self.loops = tuple(loops)
        self.frames: list[tuple[int, pin.SE3]] = []  # (joint, placement), two per loop
        sign = np.zeros((len(loops), model.nv))
        rows: list[tuple[int, bool, int, int]] = []  # loop, is translation, axis of 1, axis of 2
        for index, loop in enumerate(loops):
            turn = pin.SE3(turned(loop.axis), np.zeros(3))
            for side, name in ((-1.0, loop.predecessor), (1.0, loop.successor)):
                frame = model.frames[frame_id(model, name)]
                self.frames.append((frame.parentJoint, frame.placement * turn))
                sign[index, _columns_to(model, frame.parentJoint)] += side
            locked = LOOP_TYPES[loop.type]
            rows += [(index, True, i, 0) for i in range(3) if locked[i]]
            free = [k for k in range(3) if not locked[3 + k]]
            if not free:
                rows += [(index, False, 0, 1), (index, False, 1, 2), (index, False, 2, 0)]
            elif len(free) == 1:
                rows += [(index, False, i, free[0]) for i in range(3) if i != free[0]]
        self._loop = np.array([row[0] for row in rows], dtype=np.intp)
        self._moves = np.array([row[1] for row in rows], dtype=bool)
        self.axis1 = np.array([row[2] for row in rows], dtype=np.intp)
        self.axis2 = np.array([row[3] for row in rows], dtype=np.intp)
        self.sign = sign
        self._row_sign = sign[self._loop]
        self.couplings = tuple(couplings)
        self.factors = np.zeros((len(self.couplings), model.nv))
        self.offsets = np.array([coupling.offset for coupling in self.couplings])
        lengths = []
        for row, coupling in zip(self.factors, self.couplings, strict=True):
            for name, factor in coupling.factors.items():
                column = self.coordinates.column(name)
                row[column] = factor
            lengths.append(bool(self.coordinates.slides[column]))
        self.names = (*(loop.name for loop in loops), *(item.name for item in couplings))
        own = len(self.loops) + np.arange(len(self.couplings), dtype=np.intp)
        self.loop_of_row = np.concatenate([self._loop, own])
        self.is_translation = np.concatenate([self._moves, np.array(lengths, dtype=bool)])
        self.size = size(model)
        self.units = np.where(self.coordinates.slides, self.size, 1.0)
        self.row_units = np.where(self.is_translation, self.size, 1.0)

    def groups(self, columns: Indices) -> tuple[Indices, Indices]:
        """Joints that equations tie together, directly or through others, as groups by number.

        Args:
            columns: (k,) the joints.

        Returns:
            The groups of the joints (k,) and of the rows (m,), -1 of a row without such joints.
        """
        ties = np.vstack([self.sign, self.factors])[:, columns] != 0
        group = np.arange(len(columns), dtype=np.intp)
        for tie in ties:
            tied = np.isin(group, group[tie])
            group[tied] = group[tied].min(initial=len(group))
        group = np.unique(group, return_inverse=True)[1]
        of_name = [int(group[tie][0]) if tie.any() else -1 for tie in ties]
        return group, np.array(of_name, dtype=np.intp)[self.loop_of_row]

    def part(self, names: Collection[str]) -> "LoopEquations":
        """The equations of some loops and couplings alone, in the same coordinates."""
        found = LoopEquations(
            self.model,
            [loop for loop in self.loops if loop.name in names],
            [coupling for coupling in self.couplings if coupling.name in names],
        )
        found._local.data = self.data  # which takes longer to make than all else
        return found

    @cached_property
    def scales(self) -> Array:
        """(nv,) ways of the joints that compare, see `crane.closure.choice.scales`."""
        return scales(self.model)

    @property
    def data(self) -> pin.Data:
        """Pinocchio's memory of this thread."""
        try:
            return self._local.data
        except AttributeError:
            self._local.data = self.model.createData()
            return self._local.data

    def _geometry(self) -> tuple[Array, Array, Array, Array]:
        """Of every row: axis of frame 1, axis of frame 2, origins of both frames, each (m, 3)."""
        bodies = self.data.oMi
        placements = [bodies[joint] * local for joint, local in self.frames]
        turns = np.array([placement.rotation for placement in placements])
        origins = np.array([placement.translation for placement in placements])
        return self._placed(turns, origins)

    def _placed(self, turns: Array, origins: Array) -> tuple[Array, Array, Array, Array]:
        """The same (..., m, 3) of frames with turns (..., 2 l, 3, 3), origins (..., 2 l, 3)."""
        axes, one = np.swapaxes(turns, -1, -2), 2 * self._loop
        return (
            axes[..., one, self.axis1, :],
            axes[..., one + 1, self.axis2, :],
            origins[..., one, :],
            origins[..., one + 1, :],
        )

    def wrenches(self, turns: Array, origins: Array) -> Array:
        """The loops' rows w as wrenches, by which frame 2 is held, at the world's origin.

        Args:
            turns: (..., 2 l, 3, 3) of `frames`, in the world.
            origins: (..., 2 l, 3) likewise [m].

        Returns:
            (..., m, 6) without the couplings' rows.
        """
        a, b, _, p2 = self._placed(turns, origins)
        return self._wrenches(a, b, p2)

    def _wrenches(self, a: Array, b: Array, p2: Array) -> Array:
        wrenches = np.zeros((*a.shape[:-1], 6))
        moved = self._moves
        wrenches[..., moved, :3] = a[..., moved, :]
        wrenches[..., 3:] = _cross(np.where(moved[:, None], p2, b), a)
        return wrenches

    def evaluate(self, q: Array) -> tuple[Array, Array]:
        """Residuals and Jacobian.

        Args:
            q: (nq,) [m], [rad].

        Returns:
            phi (m,) [m] for translations, [1] for rotations, and dphi/dq (m, nv).
        """
        coupled = self.factors @ q - self.offsets
        if not self.loops:
            return coupled, self.factors.copy()
        at = self.coordinates.configuration(q)
        jacobian = _columns(pin.computeJointJacobians(self.model, self.data, at))
        self._local.last = a, b, p1, p2 = self._geometry()
        phi = np.einsum("ij,ij->i", a, np.where(self._moves[:, None], p2 - p1, b))
        slopes = self._row_sign * (self._wrenches(a, b, p2) @ jacobian)
        if not self.couplings:
            return phi, slopes
        return np.concatenate([phi, coupled]), np.vstack([slopes, self.factors])

    def scaled(self, q: Array) -> tuple[Array, Array]:
        """`evaluate` in shares of the machine's size: the same whatever its scale.

        Args:
            q: (nq,) [m], [rad].

        Returns:
            E^-1 phi (m,) and E^-1 dphi/dq D (m, nv), E = diag(row_units), D = diag(units).
        """
        phi, jacobian = self.evaluate(q)
        return phi / self.row_units, jacobian / self.row_units[:, None] * self.units

    def turned_over(self, q: Array) -> str | None:
        """Name of a loop whose axes are antiparallel, which also solves its equations."""
        if not self.loops:
            return None
        pin.forwardKinematics(self.model, self.data, self.coordinates.configuration(q))
        for index, loop in enumerate(self.loops):
            checked = aligned_axes(loop.type)
            if not checked:
                continue
            (j1, local1), (j2, local2) = self.frames[2 * index : 2 * index + 2]
            turn1 = (self.data.oMi[j1] * local1).rotation
            turn2 = (self.data.oMi[j2] * local2).rotation
            aligned = np.einsum("ik,ik->k", turn1, turn2)
            if any(aligned[k] < 0 for k in checked):
                return loop.name
        return None

    def curvature(self, q: Array, v: Array) -> Array:
        """Second derivative of phi at zero joint acceleration, (d/dt dphi/dq) v.

        Args:
            q: (nq,) [m], [rad], the posture this thread last called `evaluate` with.
            v: (nv,) [m/s], [rad/s].

        Returns:
            (m,).
        """
        if not self.loops:
            return np.zeros(len(self.couplings))
        a, b, _, p2 = self._local.last
        at = self.coordinates.configuration(q)
        rate = _columns(pin.computeJointJacobiansTimeVariation(self.model, self.data, at, v))
        velocity = np.array([self.data.ov[joint].vector for joint, _ in self.frames])
        one = 2 * self._loop
        v2, w1, w2 = velocity[one + 1, :3], velocity[one, 3:], velocity[one + 1, 3:]
        moved = self._moves[:, None]
        arm = np.where(moved, p2, b)
        arm_rate = _cross(w2, arm) + np.where(moved, v2, 0.0)
        a_rate = _cross(w1, a)
        wrench_rate = np.zeros((len(a), 6))
        wrench_rate[self._moves, :3] = a_rate[self._moves]
        wrench_rate[:, 3:] = _cross(arm_rate, a) + _cross(arm, a_rate)
        split = self._row_sign * v  # (m, nv): v of frame 2 minus v of frame 1
        relative, bias = split @ _columns(self.data.J).T, split @ rate.T
        bent = np.einsum("ij,ij->i", wrench_rate, relative) + np.einsum(
            "ij,ij->i", self._wrenches(a, b, p2), bias
        )
        return np.concatenate([bent, np.zeros(len(self.couplings))])
