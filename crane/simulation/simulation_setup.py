"""Set-up of a simulation: controller, number of steps, initial state, static equilibrium."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import (
    ClosureError,
    InputError,
)
from crane.common.samples import Array, as_number, as_sample
from crane.control.control_law import (
    ControlLaw,
    Controller,
    FunctionController,
    ZeroForce,
    controller_reference,
)
from crane.control.force_inputs import ForceInputs
from crane.control.valve_commands import SampledCommand, ValveCommand, ValveSignals
from crane.control.valve_drive import ValveDrive
from crane.description.ground_contact import Contact
from crane.dynamics.dynamics import Dynamics
from crane.dynamics.external_forces import static_active_forces
from crane.dynamics.frame_jacobians import FrameJacobians
from crane.machine.machine import Machine
from crane.motion.limit_violations import limit_violation_message, passive_limit_violation_message

_MAX_STEPS, _MAX_DURATION = 4_000_000, 1e6  # steps of one recording, and its duration [s]
# accelerations at equilibrium [characteristic lengths per characteristic time^2]
_ACCELERATION_TOLERANCE = 1e-10
_MAX_FALL_PER_ITERATION = 2e-3  # largest displacement of an iteration [characteristic lengths]
_MAX_ITERATIONS, _POLISHING_ITERATIONS = 300, 5
_RANK_TOLERANCE = 1e-6  # share of the largest stiffness below which a direction is singular
_DIFFERENCE_STEP = 1e-7  # [rad], [characteristic lengths]
_MAX_DISTANCE_FROM_HOME = (
    0.1  # [rad], [characteristic lengths]; beyond it a machine is meant to fall
)

Force = Callable[[float, Array, Array], Array]
"""(t, q_a, v_a) -> tau_a."""


def resolve_controller(
    controller: Controller | ValveCommand | Force | None, machine: Machine
) -> Controller:
    """The controller of a machine, from the argument `controller` of `simulate`.

    Raises:
        InputError: The controller or the machine has a wrong type.
    """
    if not isinstance(machine, Machine):
        raise InputError(f"{machine!r} is not a machine, load it with crane.load")
    if isinstance(controller, ControlLaw):
        return controller
    if controller is None:
        if machine.hydraulics is not None:
            neutral = ValveSignals(machine, [0.0], {})
            neutral.title = "neutral valves"
            return ValveDrive(machine, neutral)
        return ZeroForce(machine)
    if isinstance(controller, SampledCommand) and machine.hydraulics is None:
        return ForceInputs(machine, controller)
    if isinstance(controller, ValveCommand):
        return ValveDrive(machine, controller)
    if hasattr(controller, "start"):
        return controller  # type: ignore[return-value]
    if not callable(controller) or isinstance(controller, type):
        raise InputError(
            f"the controller is a {type(controller).__name__}, give a function (t, q_a, v_a) -> "
            "tau_a or a controller object"
        )
    return FunctionController(controller, machine)


def machine_under_control(machine: Machine, control: Controller) -> Machine:
    """The machine with loads that follow the clock of the controller.

    Without a simulated circuit, the friction of seals and brakes is removed.

    Raises:
        InputError: A load depends on phases, and the controller has none.
    """
    machine = machine.with_phase_function(
        control.command.clock if isinstance(control, ValveDrive) else None
    )
    hydraulics = machine.hydraulics
    if (
        hydraulics is None
        or not hydraulics.circuit_friction_joints
        or isinstance(control, ValveDrive)
    ):
        return machine
    without_friction = {
        joint: replace(cylinder, seal_friction=0.0, brake=0.0)
        for joint, cylinder in hydraulics.cylinders.items()
    }
    return machine.replace(hydraulics=replace(hydraulics, cylinders=without_friction))


def count_steps(control: Controller, duration: float | None, step: float) -> int:
    """Number of steps of a run.

    Args:
        control: The controller; its reference or levers give the default duration.
        duration: Duration [s]. That of levers is rounded up to a whole step.
        step: Step size [s].

    Raises:
        InputError: There is no duration, there are too many steps, or no whole number of them.
    """
    levers = False
    if duration is None:
        duration_source = getattr(control, "reference", None)
        if (
            duration_source is None
            and isinstance(control, ValveDrive)
            and control.command.duration
        ):
            duration_source, levers = control.command, True
        if duration_source is None:
            raise InputError("no duration and no reference to take it from, give a duration")
        duration = duration_source.duration
    duration = as_number(duration, "the duration", "s", greater_than=0)
    step = as_number(step, "the step", "s", greater_than=0)
    if duration > min(_MAX_DURATION, _MAX_STEPS * step):
        raise InputError(
            f"{duration:g} s are {duration / step:.3g} steps of {step:g} s, at most {_MAX_STEPS} "
            f"and {_MAX_DURATION:g} s: simulate less, or go on from the last sample of a first "
            "part"
        )
    steps = int(np.ceil(duration / step - 1e-9)) if levers else round(duration / step)
    if steps < 1 or not levers and abs(steps * step - duration) > 1e-9 * duration:
        raise InputError(
            f"the duration {duration:g} s is no whole number of steps of {step:g} s, change one"
        )
    return steps


def reference_limits_text(machine: Machine, control: Controller, end_time: float) -> str:
    """Warning about a reference outside of the limits before a time [s]; empty if inside."""
    reference = controller_reference(control, machine)
    if reference is None:
        return ""
    return limit_violation_message(
        machine, reference, end_time
    ) or passive_limit_violation_message(machine, reference, end_time)


def initial_motion(
    machine: Machine,
    initial: ArrayLike | tuple[ArrayLike, ArrayLike] | None,
    control: Controller | None = None,
) -> tuple[Array, Array]:
    """Initial active coordinates and velocities (n,), see `simulate`."""
    size, rest = len(machine.active), np.zeros(len(machine.active))
    if initial is None:
        reference = None if control is None else controller_reference(control, machine)
        if isinstance(control, ValveDrive) and control.command.initial_coordinates is not None:
            return np.array(control.command.initial_coordinates), rest
        if reference is not None:
            return machine.check_limits(
                reference.position(0.0), "the start of the reference"
            ), rest
        return np.array(machine.home[machine.closure.active]), rest
    if isinstance(initial, tuple) and len(initial) == 2 and np.ndim(initial[0]) == 1:
        q_a = machine.check_limits(initial[0], "initial q_a")
        v_a = as_sample(initial[1], size, "initial v_a", machine.active)
    else:
        q_a, v_a = machine.check_limits(initial, "initial"), rest  # type: ignore[arg-type]
    if q_a.ndim != 1:
        raise InputError(
            f"initial is a stack, give one sample ({size},) or a pair as a tuple (q_a, v_a)"
        )
    return q_a, v_a


def equilibrium_on_contacts(dynamics: Dynamics, q_a: Array) -> tuple[Array, str]:
    """Initial coordinates in static equilibrium on the contacts.

    Args:
        dynamics: Dynamics of the machine.
        q_a: (n,) initial coordinates; free coordinates are changed only if all are those of home.

    Returns:
        Coordinates (n,), and a note; "" for a machine without free joints or contacts.
    """
    machine = dynamics.machine
    if not machine.free or not any(
        isinstance(force, Contact) for force in machine.external_forces
    ):
        return q_a, ""
    equilibrium = StaticEquilibrium(dynamics, q_a)
    columns = equilibrium.columns
    if not len(columns) or not np.array_equal(
        q_a[columns], machine.home[machine.closure.active][columns]
    ):
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
    """Static equilibrium of the free coordinates that move contacts.

    With r the unbalanced generalized forces at rest, K = dr/dq and M the mass matrix,

        (K + lambda M) dq = -r

    is iterated with lambda proportional to |r| (pseudo-transient continuation, Kelley and Keyes
    1998): a machine above the ground falls until it touches it, then Newton's method converges.
    Meanwhile contacts have a stiffness along the ground equal to the normal one, so that nothing
    slides down a slope.

    Args:
        dynamics: Dynamics of the machine.
        q_a: (n,) home coordinates.

    Attributes:
        columns: Indices of the free coordinates that move contacts.
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
        self.columns = np.flatnonzero(
            np.array([name in machine.free for name in machine.active], dtype=bool) & (moves > 0)
        )
        self.columns = np.setdiff1d(self.columns, machine.held)
        closure = machine.closure
        self._units = closure.units[closure.active][self.columns]
        self._inverse_time_squared = 1.0 / closure.characteristic_time**2

    def _contact_jacobians(self, q: Array) -> Iterator[tuple[Contact, Array, Array]]:
        """Contacts with the Jacobian (3, n) and the position of the origin of their frame."""
        self._jacobians.set_configuration(q)
        gamma = self._machine.closure.gamma(q)
        for contact in self._contacts:
            jacobian = self._jacobians.jacobian(contact.frame)[:3] @ gamma
            yield contact, jacobian, self._jacobians.frame_pose(contact.frame).translation.copy()

    def _unbalanced_forces(self, x: Array, with_tangential_stiffness: bool = True) -> Array:
        """Unbalanced generalized forces (k,) at coordinates (k,)."""
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
        """Find the equilibrium.

        Returns:
            Coordinates (n,), and whether it needs no friction along the ground. None without an
            equilibrium near home.
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
            # release the tangential stiffness, by least-norm steps
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
        """Derivatives (k, k) of the unbalanced forces, by central differences."""
        steps = np.diag(_DIFFERENCE_STEP * self._units)
        columns = [
            self._unbalanced_forces(x + h, with_tangential_stiffness)
            - self._unbalanced_forces(x - h, with_tangential_stiffness)
            for h in steps
        ]
        return np.column_stack(columns) / (2 * steps.diagonal())
