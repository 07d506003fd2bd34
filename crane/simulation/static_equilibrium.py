"""Static equilibrium of free coordinates: contacts, tyres, springs and hanging loads at rest."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from crane.common.errors import ClosureError, SimulationError
from crane.common.samples import Array
from crane.description.ground_contact import Contact
from crane.dynamics.dynamics import Dynamics
from crane.dynamics.external_forces import state_count, static_active_forces
from crane.dynamics.frame_jacobians import FrameJacobians

# accelerations at equilibrium [characteristic lengths per characteristic time^2]
_ACCELERATION_TOLERANCE = 1e-10
_MAX_FALL_PER_ITERATION = 2e-3  # largest displacement of an iteration [characteristic lengths]
_MAX_ITERATIONS, _POLISHING_ITERATIONS = 2000, 5
_RANK_TOLERANCE = 1e-6  # share of the largest stiffness below which a direction is singular
_DIFFERENCE_STEP = 1e-7  # [rad], [characteristic lengths]
# [rad], [characteristic lengths] from home, beyond which a machine is meant to fall; those of a
# requested equilibrium, of coordinates that move contacts, where it tips, and of others
_MAX_DISTANCE, _TIPPING_DISTANCE, _SWAY_DISTANCE = 0.1, 0.5, 2.0
_NAMED_SHARE = 0.1  # share of a direction from which on a coordinate is named


class RestState(NamedTuple):
    """Coordinates at which a machine starts, and states of its contacts.

    Attributes:
        q_a: (n,) [m], [rad].
        contact_states: Deflections of all tyres along the ground [m].
        text: What differs from home; "" if nothing does.
        equilibrium: The equilibrium of the free coordinates; None if there is none.
    """

    q_a: Array
    contact_states: Array
    text: str = ""
    equilibrium: "StaticEquilibrium | None" = None


def rest_state(dynamics: Dynamics, q_a: Array) -> RestState:
    """Initial coordinates as `Machine.start` says.

    Args:
        dynamics: Dynamics of the machine.
        q_a: (n,) initial coordinates; without `start: equilibrium`, free coordinates are changed
            only if all are those of home.

    Raises:
        SimulationError: `start: equilibrium`, and there is none near home.
    """
    machine = dynamics.machine
    contact_states = np.zeros(state_count(machine.external_forces))
    requested = machine.start == "equilibrium"
    if machine.start == "home" or not machine.free:
        return RestState(q_a, contact_states)
    equilibrium = StaticEquilibrium(dynamics, q_a, requested)
    columns = equilibrium.columns
    home = machine.home[machine.closure.active]
    if not len(columns) or not (requested or np.array_equal(q_a[columns], home[columns])):
        return RestState(q_a, contact_states)
    if not equilibrium.find() or (requested and not equilibrium.is_held):
        if requested:
            raise SimulationError(
                f"'{machine.name}' has no static equilibrium near home: {equilibrium.failure}, "
                "change home or what holds it"
            )
        return RestState(
            q_a, contact_states, "at home, near which it has no static equilibrium on its contacts"
        )
    x = equilibrium.q_a
    moved = columns[np.abs(x - q_a)[columns].argmax()]
    joint, where = machine.active[int(moved)], " on its contacts" * bool(equilibrium.contacts)
    text = (
        f"in static equilibrium{where}, {joint} {x[moved] - q_a[moved]:+.4g} "
        f"{machine.unit(joint)} from home"
    )
    if not equilibrium.is_held:
        text += ", where only friction in motion holds it along the ground"
    return RestState(x, equilibrium.contact_states(x[columns]), text, equilibrium)


class StaticEquilibrium:
    """Static equilibrium of the free coordinates.

    With r the unbalanced generalized forces at rest, K = dr/dq and M the mass matrix,

        (K + lambda M) dq = -r

    is iterated with lambda proportional to |r| (pseudo-transient continuation, Kelley and Keyes
    1998): a machine above the ground falls until it touches it, then Newton's method converges.
    Tyres deflect along the ground by as much as they move along it, from home on: friction would
    hold other deflections, too. Contacts without a lateral stiffness have meanwhile one equal to
    the normal one, so that nothing slides down a slope.

    Args:
        dynamics: Dynamics of the machine.
        q_a: (n,) home coordinates.
        moves_all: Whether all free coordinates move, and farther, or only those that move
            contacts.

    Attributes:
        contacts: The contacts.
        columns: Indices of the free coordinates that move.
        q_a: (n,) coordinates at equilibrium, after `find`.
        is_held: Whether it needs no friction in motion along the ground.
        failure: Why there is no equilibrium.
    """

    def __init__(self, dynamics: Dynamics, q_a: Array, moves_all: bool = False):
        self._dynamics, self.q_a, self.is_held, self.failure = dynamics, q_a.copy(), False, ""
        self._machine = machine = dynamics.machine
        self.contacts = [x for x in machine.external_forces if isinstance(x, Contact)]
        self._home_coordinates, self._jacobians = q_a, FrameJacobians(machine)
        is_free = np.array([name in machine.free for name in machine.active], dtype=bool)
        moves = np.zeros(len(q_a))
        q = self._configuration(q_a)
        gamma = machine.closure.gamma(q)
        self._home_poses = []
        for contact, pose in self._contact_poses(q):
            self._home_poses.append(pose)
            jacobian = self._jacobians.jacobian(contact.frame)[: 6 if contact.state_count else 3]
            moves = np.maximum(moves, np.abs(jacobian @ gamma).max(axis=0))
        is_moving = is_free & ((moves > 0) | moves_all)
        self.columns = np.setdiff1d(np.flatnonzero(is_moving), machine.held)
        requested = np.where(moves > 0, _TIPPING_DISTANCE, _SWAY_DISTANCE)[self.columns]
        self._max_distances = requested if moves_all else np.full_like(requested, _MAX_DISTANCE)
        closure = machine.closure
        self._units = closure.units[closure.active][self.columns]
        self._inverse_time_squared = 1.0 / closure.characteristic_time**2

    def _configuration(self, q_a: Array) -> Array:
        return self._machine.closure.solve(q_a, initial_guess=self._machine.home)

    def _contact_poses(self, q: Array) -> Iterator[tuple[Contact, tuple[Array, Array]]]:
        """Contacts with the position and rotation of their frames."""
        self._jacobians.set_configuration(q)
        for contact in self.contacts:
            pose = self._jacobians.frame_pose(contact.frame)
            yield contact, (pose.translation.copy(), pose.rotation.copy())

    def _displacements(self, q: Array) -> list[tuple[Contact, float, Array, Array]]:
        """Contacts with depth, (3, 2) axes of the ground, displacement (2,) from home along it."""
        out = []
        for (contact, (place, turn)), home in zip(
            self._contact_poses(q), self._home_poses, strict=True
        ):
            height, normal = contact.ground.distance_and_normal(place.tolist())
            axes = np.array(contact.ground.tangents(normal), dtype=np.float64).T
            arm = -contact.radius * np.array(normal, dtype=np.float64)
            moved = place - home[0] + turn @ home[1].T @ arm - arm
            depth = contact.radius - float(height)  # type: ignore[arg-type]
            out.append((contact, depth, axes, axes.T @ moved))
        return out

    def contact_states(self, x: Array) -> Array:
        """States of all external forces at coordinates (k,): deflections of the tyres."""
        displacements = self._displacements(self._configuration(self._with_free(x)))
        states = iter(s * (d > 0) for contact, d, _, s in displacements if contact.state_count)
        zeros = [np.zeros(force.state_count) for force in self._machine.external_forces]
        return np.concatenate(
            [next(states) if isinstance(force, Contact) and len(z) else z
             for force, z in zip(self._machine.external_forces, zeros, strict=True)]
        ) if zeros else np.zeros(0)  # fmt: skip

    def _with_free(self, x: Array) -> Array:
        q_a = self._home_coordinates.copy()
        q_a[self.columns] = x
        return q_a

    def _unbalanced_forces(self, x: Array, with_tangential_stiffness: bool = True) -> Array:
        """Unbalanced generalized forces (k,) at coordinates (k,)."""
        q_a, rest = self._with_free(x), np.zeros(len(self.q_a))
        q = self._configuration(q_a)
        force = self._dynamics.inverse(q_a, rest, rest) - static_active_forces(
            self._machine, q, self.contact_states(x)
        )
        gamma = self._machine.closure.gamma(q)
        for contact, depth, axes, moved in self._displacements(q):
            if with_tangential_stiffness and depth > 0 and not contact.state_count:
                jacobian = self._jacobians.jacobian(contact.frame)[:3] @ gamma
                force = force + contact.stiffness * (jacobian.T @ axes @ moved)
        return np.asarray(force[self.columns])

    def find(self) -> bool:
        """Find the equilibrium, and whether there is one near home."""
        x = self._home_coordinates[self.columns].copy()
        mass = self._dynamics.mass_matrix(self._home_coordinates)[
            np.ix_(self.columns, self.columns)
        ]
        inertia = np.diag(mass) * self._units * self._inverse_time_squared
        try:
            unbalanced = self._unbalanced_forces(x)
            first = largest = float(np.abs(unbalanced / inertia).max(initial=0.0))
            for _ in range(_MAX_ITERATIONS):
                if largest < _ACCELERATION_TOLERANCE:
                    break
                damping = (
                    self._inverse_time_squared
                    / _MAX_FALL_PER_ITERATION
                    * min(1.0, largest / first)
                )
                x = x - np.linalg.solve(self._stiffness(x, True) + damping * mass, unbalanced)
                if self._is_far(x):
                    return False
                unbalanced = self._unbalanced_forces(x)
                largest = float(np.abs(unbalanced / inertia).max())
            # release the tangential stiffness, by least-norm steps
            for _ in range(_POLISHING_ITERATIONS):
                stiffness, slip = self._stiffness(x, False), self._unbalanced_forces(x, False)
                x = x - np.linalg.lstsq(stiffness, slip, rcond=_RANK_TOLERANCE)[0]
            slip = np.abs(self._unbalanced_forces(x, False) / inertia)
        except (ClosureError, np.linalg.LinAlgError) as error:
            self.failure = str(error)
            return False
        self.q_a = self._with_free(x)
        worst = self._machine.active[int(self.columns[int(slip.argmax())])] if len(x) else ""
        self.failure = f"only friction in motion holds '{worst}', as of contacts without tyres"
        self.is_held = float(slip.max(initial=0.0)) < np.sqrt(_ACCELERATION_TOLERANCE)
        return largest < np.sqrt(_ACCELERATION_TOLERANCE)

    def _is_far(self, x: Array) -> bool:
        """Whether coordinates (k,) are too far from home; sets `failure`."""
        distances = np.abs((x - self._home_coordinates[self.columns]) / self._units)
        if (distances <= self._max_distances).all():
            return False
        name = self._machine.active[int(self.columns[int(distances.argmax())])]
        q = self._configuration(self._with_free(x))
        touching = [f"'{one.name}'" for one, depth, *_ in self._displacements(q) if depth > 0]
        self.failure = f"'{name}' leaves it without a hold"
        if self.contacts and not touching:
            self.failure = f"no contact reaches the ground where '{name}' falls"
        elif touching and len(touching) < len(self.contacts):
            self.failure = f"it tips over {', '.join(touching)} along '{name}'"
        return True

    def undetermined_directions(self) -> list[str]:
        """Coordinates that no force holds at the equilibrium, by independent direction."""
        stiffness = self._stiffness(self.q_a[self.columns], False)
        _, sizes, directions = np.linalg.svd(stiffness * self._units * self._units[:, None])
        names = np.array(self._machine.active)[self.columns]
        return [
            ", ".join(names[np.abs(row) > _NAMED_SHARE * np.abs(row).max()].tolist())
            for row in directions[sizes < _RANK_TOLERANCE * sizes.max(initial=0.0)]
        ]

    def _stiffness(self, x: Array, with_tangential_stiffness: bool) -> Array:
        """Derivatives (k, k) of the unbalanced forces, by central differences."""
        steps = np.diag(_DIFFERENCE_STEP * self._units)
        columns = [
            self._unbalanced_forces(x + h, with_tangential_stiffness)
            - self._unbalanced_forces(x - h, with_tangential_stiffness)
            for h in steps
        ]
        return np.column_stack(columns) / (2 * steps.diagonal())
