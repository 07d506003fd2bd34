"""Static equilibrium of a machine on its contacts, its actuators held."""

from collections.abc import Iterator

import numpy as np

from crane.common.errors import ClosureError
from crane.common.samples import Array
from crane.description.ground_contact import Contact
from crane.dynamics import Dynamics
from crane.dynamics.external_forces import static_active_forces
from crane.dynamics.frame_jacobians import FrameJacobians

_ACCELERATION_TOLERANCE = (
    1e-10  # acceleration that is left, in characteristic lengths per characteristic time^2
)
_MAX_FALL_PER_ITERATION = (
    2e-3  # of the characteristic length: a tenth of what a free fall moves in an iteration
)
_MAX_ITERATIONS, _POLISHING_ITERATIONS = 300, 5
_RANK_TOLERANCE = 1e-6  # share of the largest stiffness below which a direction has none
_DIFFERENCE_STEP = 1e-7  # rad, or share of the characteristic length
_MAX_DISTANCE_FROM_HOME = 0.1  # likewise: what is farther from standing is meant to fall


def equilibrium_on_contacts(dynamics: Dynamics, q_a: Array) -> tuple[Array, str]:
    """Coordinates of static equilibrium on the contacts, from which a run starts.

    Args:
        dynamics: Of the machine.
        q_a: (n,) where it would start; free coordinates that are not as at home stay so.

    Returns:
        Coordinates (n,), and a text, "" where nothing stands on contacts.
    """
    machine = dynamics.machine
    if not machine.free or not any(
        isinstance(force, Contact) for force in machine.external_forces
    ):
        return q_a, ""
    equilibrium = StaticEquilibrium(dynamics, q_a)
    columns = equilibrium.columns
    home = machine.home[machine.closure.active]
    if not len(columns) or not np.array_equal(q_a[columns], home[columns]):
        return q_a, ""
    found = equilibrium.find()
    if found is None:
        return q_a, "at home, near which it has no static equilibrium on its contacts"
    x, is_held = found
    moved = columns[np.abs(x - q_a)[columns].argmax()]
    joint = machine.active[int(moved)]
    text = (
        f"in static equilibrium on its contacts, {joint} {x[moved] - q_a[moved]:+.4g} "
        f"{machine.unit(joint)} from home"
    )
    return (
        x,
        text if is_held else f"{text}, where only friction in motion holds it along the ground",
    )


class StaticEquilibrium:
    """The free coordinates that move contacts, where all forces along them balance.

    With r the generalized forces that are missing at rest, K = dr/dq and M the mass matrix,

        (K + lambda M) dq = -r

    is iterated, lambda in proportion to |r| (pseudo-transient continuation, Kelley and Keyes
    1998): a machine that does not touch the ground falls until it does, then Newton's method ends
    it. Contacts stick where they touch, by a stiffness along the ground equal to that into it, so
    that nothing slides down a slope meanwhile.

    Args:
        dynamics: Of the machine.
        q_a: (n,) where it is at home.
    """

    def __init__(self, dynamics: Dynamics, q_a: Array):
        self._dynamics, self._home_coordinates = dynamics, q_a
        self._machine = machine = dynamics.machine
        self._contacts = [force for force in machine.external_forces if isinstance(force, Contact)]
        self._jacobians = FrameJacobians(machine)
        self._home_positions = []
        q = machine.closure.solve(q_a, initial_guess=machine.home)
        moves = np.zeros(len(q_a))
        for _, jacobian, place in self._contact_jacobians(q):
            self._home_positions.append(place)
            moves = np.maximum(moves, np.abs(jacobian).max(axis=0))
        free = np.array([name in machine.free for name in machine.active], dtype=bool)
        self.columns = np.flatnonzero(free & (moves > 0))
        closure = machine.closure
        self._units = closure.units[closure.active][self.columns]
        self._inverse_time_squared = 1.0 / closure.characteristic_time**2

    def _contact_jacobians(self, q: Array) -> Iterator[tuple[Contact, Array, Array]]:
        """Contacts with the Jacobian (3, n) of their frame's origin, and where that is."""
        self._jacobians.set_configuration(q)
        gamma = self._machine.closure.gamma(q)
        for contact in self._contacts:
            jacobian = self._jacobians.jacobian(contact.frame)[:3] @ gamma
            yield contact, jacobian, self._jacobians.frame_pose(contact.frame).translation.copy()

    def _unbalanced_forces(self, x: Array, with_tangential_stiffness: bool = True) -> Array:
        """Generalized forces (k,) that are missing at coordinates (k,)."""
        q_a, rest = self._home_coordinates.copy(), np.zeros(len(self._home_coordinates))
        q_a[self.columns] = x
        q = self._machine.closure.solve(q_a, initial_guess=self._machine.home)
        force = self._dynamics.inverse(q_a, rest, rest) - static_active_forces(self._machine, q)
        for (contact, jacobian, place), home in zip(
            self._contact_jacobians(q), self._home_positions, strict=True
        ):
            above, normal = contact.ground.distance_and_normal(place.tolist())
            if with_tangential_stiffness and float(above) < contact.radius:  # type: ignore[arg-type]
                axis = np.array(normal, dtype=np.float64)
                slid = place - home
                slid -= (slid @ axis) * axis
                force = force + contact.stiffness * (jacobian.T @ slid)
        return np.asarray(force[self.columns])

    def find(self) -> tuple[Array, bool] | None:
        """Coordinates (n,), and whether friction need not hold it along the ground.

        Returns:
            None where there is no equilibrium near home.
        """
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
                if (
                    np.abs((x - self._home_coordinates[self.columns]) / self._units).max()
                    > _MAX_DISTANCE_FROM_HOME
                ):
                    return None
                unbalanced = self._unbalanced_forces(x)
                largest = float(np.abs(unbalanced / inertia).max())
            # what stuck lets go, the shortest way
            for _ in range(_POLISHING_ITERATIONS):
                stiffness = self._stiffness(x, False)
                x = (
                    x
                    - np.linalg.lstsq(
                        stiffness, self._unbalanced_forces(x, False), rcond=_RANK_TOLERANCE
                    )[0]
                )
            slip_residual = float(np.abs(self._unbalanced_forces(x, False) / inertia).max())
        except (ClosureError, np.linalg.LinAlgError):
            return None
        if not largest < np.sqrt(_ACCELERATION_TOLERANCE):
            return None
        q_a = self._home_coordinates.copy()
        q_a[self.columns] = x
        return q_a, slip_residual < np.sqrt(_ACCELERATION_TOLERANCE)

    def _stiffness(self, x: Array, with_tangential_stiffness: bool) -> Array:
        """(k, k) derivatives of what is missing, by differences."""
        steps = np.diag(_DIFFERENCE_STEP * self._units)
        columns = [
            self._unbalanced_forces(x + h, with_tangential_stiffness)
            - self._unbalanced_forces(x - h, with_tangential_stiffness)
            for h in steps
        ]
        return np.column_stack(columns) / (2 * steps.diagonal())
