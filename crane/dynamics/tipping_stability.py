"""Stability against tipping: moments about the tipping lines, and forces of the supports."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.common.threads import ThreadLocal
from crane.description.external_forces import WRENCH_COMPONENTS
from crane.description.ground_contact import Contact
from crane.dynamics.frame_jacobians import FrameJacobians
from crane.machine.machine import Machine

_NEGATIVE_LOAD_TOLERANCE = -1e-9  # force over weight of an unloaded support
_LEVEL_TOLERANCE = 1e-9  # vertical rate of a support that stays on the ground [m/m], [m/rad]
_OUTLINE_TOLERANCE = 1e-9  # share of the largest area by which a support may be outside of a line


class TippingMargins(NamedTuple):
    """Stability margins at N configurations with k tipping lines.

    Attributes:
        moments: (N, k) stabilizing moment about each line [N m]; the machine tips below 0.
        weight_ratios: (N, k) the moment divided by the weight and by the distance of the line from
            the support that is farthest from it.
    """

    moments: Array
    weight_ratios: Array

    @property
    def smallest_ratio(self) -> Array:
        """(N,) the smallest weight ratio."""
        return np.asarray(self.weight_ratios.min(axis=1))


class TippingStability:
    """The tipping lines of a machine: edges of the convex hull of its supports, seen from above.

    With G, M the force and the moment about the world's origin that the ground exerts, and a line
    from support i to the next one anticlockwise, j,

        moment = (p_j - p_i) / |p_j - p_i| . (M - p_i x G),

    which turns the machine about the line onto its supports. The static part is that of ISO 10567
    and EN 13000; inertial forces are included (Ghasempoor and Sepehri, A measure of machine
    stability for moving base manipulators, ICRA 1995). For a machine that is fixed to the world G
    and M follow from its motion,

        G = d(momentum)/dt - m g - sum F,
        M = d(angular momentum)/dt - sum r x m g - sum (r x F + M_F),

    with external wrenches F, M_F. For a machine on contacts they are the contact forces.

    Supports may be on bodies that joints move along the ground, as the front wheels of a loader
    with an articulated frame: the lines then go through the places where they stand.

    Args:
        machine: With `supports`, or at least three contacts.

    Attributes:
        support_names: Names of the supports.
        line_names: Names of the two supports of each line.
        line_indices: Indices of the two supports of each line.
        is_stationary: Whether its base is fixed to the world; otherwise it stands on contacts.
        mass: Mass of the machine [kg].

    Raises:
        InputError: It has fewer than three supports, or all on one line, or gravity does not press
            it down on them, along -z.
    """

    def __init__(self, machine: Machine):
        self.machine, self._frame_jacobians = machine, FrameJacobians(machine)
        support_list = find_supports(machine)
        self.support_names, self._support_links = (
            [name for name, _ in support_list],
            [link for _, link in support_list],
        )
        # indices of the external forces that are supports
        self._support_contacts = [
            k
            for k, force in enumerate(machine.external_forces)
            if isinstance(force, Contact)
            and (not machine.supports or force.frame in self._support_links)
        ]
        self._moves = bool(self.support_rates().any())
        contacts = {machine.external_forces[k].frame for k in self._support_contacts}
        self.is_stationary = not self._moves or not contacts
        leaves_ground = np.abs(self.support_rates()[:, 2]).max(initial=0.0) > _LEVEL_TOLERANCE
        if (leaves_ground or not self.is_stationary) and len(self._support_contacts) < len(
            self._support_links
        ):
            raise InputError(f"'{machine.name}' has supports that move without being contacts")
        from scipy.spatial import ConvexHull, QhullError  # slow to import

        try:
            hull = ConvexHull(self.support_positions(machine.home[None])[0, :, :2])
        except (QhullError, ValueError):
            raise InputError(
                f"'{machine.name}' has {len(support_list)} supports and no area between them, "
                "name three that are not in one line"
            ) from None
        if not machine.gravity[2] < 0:
            raise InputError(
                f"gravity does not press '{machine.name}' down on its supports, along -z: give "
                "gravity with z below 0"
            )
        around = [int(i) for i in hull.vertices]
        self.line_indices = list(zip(around, around[1:] + around[:1], strict=True))
        self.line_names = [
            (self.support_names[i], self.support_names[j]) for i, j in self.line_indices
        ]
        self._model = pin.Model(machine.model)
        self._workspace = ThreadLocal(self._model.createData)
        self.mass = float(sum(inertia.mass for inertia in self._model.inertias))
        self._gravity = self._model.gravity.linear.copy()

    def static_margins(self, q_a: ArrayLike) -> TippingMargins:
        """Margins at rest, without external forces.

        Args:
            q_a: (n,) or (N, n) [m], [rad].
        """
        q = np.atleast_2d(self.machine.closure.solve(q_a))
        return self.tipping_margins(q, self.ground_wrench(q))

    def tipping_load(self, q_a: ArrayLike, frame: str | None = None) -> tuple[Array, list[str]]:
        """The mass at a frame that tips the machine at rest: moment = -lever m g about a line.

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            frame: Frame that carries the mass; the tip if not given.

        Returns:
            (N,) [kg], infinite for a frame between the supports, below 0 where the machine tips
            without it; and the tipping line, "A to B", "" if there is none.
        """
        machine = self.machine
        link = machine.tip if frame is None else frame
        if link is None:
            raise InputError(f"'{machine.name}' has no tip, name the frame that a load hangs from")
        q = np.atleast_2d(machine.closure.solve(q_a))
        moments = self.static_margins(q_a).moments
        hanging = self._frame_jacobians.frame_origins(q, [link])[:, 0]
        levers = self._moments_about_lines(
            self.support_positions(q),
            np.hstack([-self._gravity + 0 * hanging, np.cross(hanging, -self._gravity)]),
        )
        with np.errstate(divide="ignore"):
            loads_by_line = np.where(levers < 0, moments / -levers, np.inf)
        first = loads_by_line.argmin(axis=1)
        loads = loads_by_line[np.arange(len(q)), first]
        return loads, [
            " to ".join(self.line_names[k]) if np.isfinite(load) else ""
            for k, load in zip(first.tolist(), loads, strict=True)
        ]

    def ground_wrench(
        self,
        q: Array,
        v: Array | None = None,
        a: Array | None = None,
        external_wrenches: Array | None = None,
    ) -> Array:
        """The wrench that the ground exerts (N, 6), about the world's origin.

        Args:
            q: (N, nv) closed configurations.
            v: (N, nv) velocities; at rest if not given.
            a: (N, nv) accelerations; 0 if not given.
            external_wrenches: (N, .) wrench and channels of each external force as in a recording;
                none if not given. Those of contacts that are supports are left out.
        """
        rates, centres = np.zeros((len(q), 6)), np.empty((len(q), 3))
        data = self._workspace.value
        still = np.zeros(self._model.nv)
        moves = v is not None or a is not None
        for i, one in enumerate(q):
            at = self.machine.coordinates.configuration(one)
            if moves:
                rates[i] = pin.computeCentroidalMomentumTimeVariation(
                    self._model, data, at,
                    still if v is None else v[i], still if a is None else a[i],
                ).vector  # fmt: skip
            else:
                pin.centerOfMass(self._model, data, at, False)
            centres[i] = data.com[0]
        own = self._model.inertias[0]  # fixed bodies have no momentum
        out = rates - self.mass * np.append(self._gravity, np.zeros(3))
        # the rate of momentum acts at the centre of mass of the moving bodies
        moved = rates[:, :3] - (self.mass - own.mass) * self._gravity
        out[:, 3:] += np.cross(centres, moved) - np.cross(own.mass * own.lever, self._gravity)
        if external_wrenches is None:
            return out
        for k in range(len(self.machine.external_forces)):
            if k not in self._support_contacts:
                out -= self._external_wrench_about_origin(q, k, external_wrenches)
        return out

    def contact_wrench(self, q: Array, external_wrenches: Array) -> Array:
        """The wrench (N, 6) that its contacts exert, about the world's origin."""
        out = np.zeros((len(q), 6))
        for k in self._support_contacts:
            out += self._external_wrench_about_origin(q, k, external_wrenches)
        return out

    def tipping_margins(self, q: Array, ground_wrench: Array) -> TippingMargins:
        """Margins about all lines.

        Args:
            q: (N, nv) closed configurations.
            ground_wrench: (N, 6) see `ground_wrench`.

        Raises:
            InputError: Supports moved so far that their outline has other corners than at home.
        """
        points = self.support_positions(q)
        weight = self.mass * float(np.linalg.norm(self._gravity))
        moments = self._moments_about_lines(points, ground_wrench)
        first, second = np.array(self.line_indices).T
        lines = (points[:, second] - points[:, first])[..., None, :2]  # (N, k, 1, 2)
        across = points[:, None, :, :2] - points[:, first, None, :2]  # (N, k, s, 2)
        area = lines[..., 0] * across[..., 1] - lines[..., 1] * across[..., 0]
        distances = np.abs(area).max(axis=2) / np.linalg.norm(lines[:, :, 0], axis=2)
        if self._moves and self.is_stationary and area.min() < -_OUTLINE_TOLERANCE * area.max():
            raise InputError(
                f"the outline of the supports of '{self.machine.name}' has other corners here "
                "than at home: name under 'supports' those that are its corners in both"
            )
        return TippingMargins(moments, moments / (weight * distances))

    def support_forces(self, q: Array, ground_wrench: Array) -> Array:
        """Force of each support (N, s) [N], for supports of equal stiffness under a rigid frame.

        Of all nonnegative forces that balance the ground wrench, those with the least sum of
        squares; where the machine tips, those nearest to balance.
        """
        x, y, z = np.moveaxis(self.support_positions(q), 2, 0)
        force, moment = ground_wrench[:, :3], ground_wrench[:, 3:]
        level = np.zeros_like(force)
        level[:, 2] = z.mean(axis=1)
        moment = moment - np.cross(level, force)
        required = np.stack([force[:, 2], moment[:, 0], moment[:, 1]], axis=1)
        balance = np.stack([np.ones_like(x), y, -x], axis=1)
        out: Array = np.einsum("nsk,nk->ns", np.linalg.pinv(balance), required)
        for i in np.flatnonzero(out.min(axis=1) < 0):
            out[i] = _nonnegative_support_forces(balance[i], required[i])
        return out

    def support_positions(self, q: Array) -> Array:
        """(N, s, 3) positions of the supports."""
        found = self._frame_jacobians.frame_origins(
            q if self._moves else q[:1], self._support_links
        )
        return np.broadcast_to(found, (len(q), *found.shape[1:]))

    def support_rates(self) -> Array:
        """(s, 3, n) derivatives of the supports' positions by the active joints, at home."""
        machine, frames = self.machine, self._frame_jacobians
        frames.set_configuration(machine.home)
        gamma = machine.closure.gamma(machine.home)
        rates = [frames.jacobian(link)[:3] @ gamma for link in self._support_links]
        return np.array(rates).reshape(-1, 3, gamma.shape[1])

    def _moments_about_lines(self, points: Array, wrench: Array) -> Array:
        """(N, k) moments of wrenches (N, 6) about the lines."""
        first, second = np.array(self.line_indices).T
        lines = points[:, second] - points[:, first]
        moments = wrench[:, None, 3:] - np.cross(points[:, first], wrench[:, None, :3])
        return np.asarray((lines * moments).sum(axis=2) / np.linalg.norm(lines, axis=2))

    def _external_wrench_about_origin(self, q: Array, k: int, external_wrenches: Array) -> Array:
        """(N, 6) wrench of external force k about the world's origin."""
        first = sum(
            len(WRENCH_COMPONENTS) + len(x.channels) for x in self.machine.external_forces[:k]
        )
        wrench = external_wrenches[:, first : first + len(WRENCH_COMPONENTS)].copy()
        acts = wrench.any(axis=1)
        places = self._frame_jacobians.frame_origins(
            q[acts], [self.machine.external_forces[k].frame]
        )[:, 0]
        wrench[acts, 3:] += np.cross(places, wrench[acts, :3])
        return wrench


def find_supports(machine: Machine) -> list[tuple[str, str]]:
    """Names and links of a machine's supports: `Machine.supports`, or its contacts."""
    if machine.supports:
        return [(link, link) for link in machine.supports]
    return [(x.name, x.frame) for x in machine.external_forces if isinstance(x, Contact)]


def has_supports(machine: Machine) -> bool:
    """Whether `TippingStability` is available for a machine."""
    try:
        return len(find_supports(machine)) > 2 and bool(TippingStability(machine).line_names)
    except InputError:
        return False


def _nonnegative_support_forces(balance: Array, required: Array) -> Array:
    """Least-squares nonnegative forces with balance (3, s) @ forces = required (3,)."""
    loaded: Sequence[int] = range(balance.shape[1])
    out = np.zeros(balance.shape[1])
    while len(loaded) > 2:
        part = np.linalg.lstsq(balance[:, loaded], required, rcond=None)[0]
        if part.min() >= _NEGATIVE_LOAD_TOLERANCE * np.abs(part).max():
            out[loaded] = np.maximum(part, 0.0)
            return out
        loaded = [i for i, force in zip(loaded, part, strict=True) if force > 0]
    from scipy.optimize import nnls  # slow to import

    return np.asarray(nnls(balance, required)[0])
