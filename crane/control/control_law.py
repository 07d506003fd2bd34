"""What a controller is: a function, a class with states, or a law that becomes machine code."""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from crane.codegen import Scalar
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array, as_sample
from crane.dynamics import Dynamics
from crane.dynamics.external_forces import static_active_forces
from crane.machine import Machine
from crane.motion.task_trajectories import add_free_joints
from crane.motion.trajectory import Trajectory


class Controller(Protocol):
    """What `simulate` asks of a controller; a plain function (t, q_a, v_a) -> tau_a serves too.

    It may have a `reference`, the reference motion, which gives `simulate` start and duration.
    """

    def start(self, q_a: Array) -> Array:
        """The controller's own states (k,) at the start, integrated with the machine's."""

    def __call__(self, time: float, q_a: Array, v_a: Array, state: Array) -> tuple[Array, Array]:
        """Active forces (n,) [N], [N m], and the rate (k,) of the controller's states."""


class InverseDynamicsFunction(Protocol):
    """Inverse dynamics at an instant."""

    def __call__(self, a_a: Sequence[Scalar], friction: bool) -> list[Scalar]:
        """Active forces (n,) [N], [N m] of accelerations (n,), see `Dynamics.inverse`."""


class GravityFunction(Protocol):
    """Weight at an instant."""

    def __call__(self) -> list[Scalar]:
        """Active forces (n,) [N], [N m] that hold the weight alone, see `Dynamics.gravity`."""


class ControllerInputs(NamedTuple):
    """What a law sees at an instant: floats, or formulas while it becomes machine code.

    Attributes:
        q_a: (n,) active coordinates [m], [rad].
        v_a: (n,) their velocities [m/s], [rad/s].
        state: (k,) the law's own states.
        settings: (s,) its `settings`.
        reference: (c,) its row of `references`.
        inverse: The machine's inverse dynamics here.
        gravity: What holds its weight here.
    """

    q_a: list[Scalar]
    v_a: list[Scalar]
    state: list[Scalar]
    settings: list[Scalar]
    reference: list[Scalar]
    inverse: InverseDynamicsFunction
    gravity: GravityFunction


@runtime_checkable
class TracedController(Controller, Protocol):
    """A controller that can become part of the simulation's machine code; `ControlLaw` makes one.

    Attributes:
        settings: (s,) its numbers.
    """

    settings: Array

    def references(self, times: Array) -> Array:
        """All that depends on time alone, (N, c) at times (N,) [s]."""

    def trace(self, inputs: ControllerInputs) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """`__call__` as formulas."""


class ControlLaw(OneLineRepr):
    """A controller whose law is written once, and called in numbers as well as traced.

    A law writes `law`, and `initial_state`, `references`, `settings`, `reference` where it has
    states, depends on time, has numbers that change from one to the next, follows a motion. The
    rest follows.

    Args:
        machine: The machine.

    Attributes:
        reference: The reference motion, or None.
        settings: (s,) numbers that machine code is not made anew for when they change. All other
            numbers of a law become part of the code.
    """

    reference: Trajectory | None = None
    settings: Array = np.zeros(0)

    def __init__(self, machine: Machine):
        self.machine = machine

    def law(self, inputs: ControllerInputs) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """Active forces (n,) [N], [N m], 0.0 of free joints, and rates (k,) of the states.

        Args:
            inputs: What it sees, floats or formulas: `q_a`, `v_a` (n,), `state` (k,), `settings`
                (s,), `reference` (c,), and, as `Dynamics` has them, `inverse(a_a, friction)` and
                `gravity()`.
        """
        raise NotImplementedError

    def select_driven(self, values: Sequence[Scalar]) -> list[Scalar]:
        """Those of all active joints (n,) that belong to the driven ones."""
        return [
            value for value, moved in zip(values, self.machine.is_driven, strict=True) if moved
        ]

    def expand_driven(self, forces: Sequence[Scalar]) -> list[Scalar]:
        """Forces (n,) of all active joints from those of the driven ones."""
        given = iter(forces)
        return [next(given) if moved else 0.0 for moved in self.machine.is_driven]

    def initial_state(self, inputs: ControllerInputs) -> Sequence[Scalar]:
        """The law's own states (k,) at the start, seen in numbers and at rest; none yet.

        What the drives have to give then, `inputs.inverse`, is less by what forces from outside do
        at time 0: a machine that carries a load hangs as still as one with a payload.
        """
        return ()

    def references(self, times: Array) -> Array:
        """All that depends on time alone, (N, c) at times (N,) [s]; none yet."""
        return np.zeros((len(times), 0))

    def start(self, q_a: Array) -> Array:
        """See `Controller`."""
        # nothing is worth compiling for one posture
        dynamics = Dynamics(self.machine, backend="pinocchio")
        return self.start_closed(dynamics, self.machine.closure.solve(q_a))

    def start_closed(self, dynamics: Dynamics, q: Array) -> Array:
        """`start` at a posture (nq,) that is closed already, of an exact `Dynamics`."""
        q_a = q[self.machine.closure.active]
        zero_velocity = np.zeros_like(q_a)
        static_forces = static_active_forces(
            dynamics.machine, q
        )  # a run's may carry more than the law's

        def inverse(a_a: Sequence[Scalar], friction: bool) -> list[Scalar]:
            quantity = "inverse with friction" if friction else "inverse"
            needed = (
                dynamics.tree_dynamics.evaluate(quantity, q, zero_velocity, np.array(a_a))
                - static_forces
            )
            found: list[Scalar] = needed.tolist()
            return found

        def gravity() -> list[Scalar]:
            found: list[Scalar] = dynamics.tree_dynamics.evaluate(
                "gravity", q, zero_velocity, zero_velocity
            ).tolist()
            return found

        inputs = self._numeric_inputs(0.0, q_a, zero_velocity, np.zeros(0), inverse, gravity)
        return np.array(self.initial_state(inputs), dtype=np.float64)

    def __call__(self, time: float, q_a: Array, v_a: Array, state: Array) -> tuple[Array, Array]:
        """See `Controller`."""
        tau, rate = self.law(self.inputs_at(time, q_a, v_a, state))
        return np.array(tau, dtype=np.float64), np.array(rate, dtype=np.float64)

    def trace(self, inputs: ControllerInputs) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """What `law` gives, as formulas."""
        return self.law(inputs)

    def inputs_at(self, time: float, q_a: Array, v_a: Array, state: Array) -> ControllerInputs:
        """What the law sees at a time [s] with (n,), (n,), (k,), in numbers."""

        def inverse(a_a: Sequence[Scalar], friction: bool) -> list[Scalar]:
            wanted = np.array(a_a, dtype=np.float64)
            found: list[Scalar] = self._dynamics.inverse(q_a, v_a, wanted, friction).tolist()
            return found

        def gravity() -> list[Scalar]:
            found: list[Scalar] = self._dynamics.gravity(q_a).tolist()
            return found

        return self._numeric_inputs(time, q_a, v_a, state, inverse, gravity)

    def _numeric_inputs(
        self,
        time: float,
        q_a: Array,
        v_a: Array,
        state: Array,
        inverse: InverseDynamicsFunction,
        gravity: GravityFunction,
    ) -> ControllerInputs:
        reference = self.references(np.array([time]))[0]
        vectors = (q_a, v_a, state, self.settings, reference)
        columns: list[list[Scalar]] = [vector.tolist() for vector in vectors]
        return ControllerInputs(
            columns[0], columns[1], columns[2], columns[3], columns[4], inverse, gravity
        )

    @cached_property
    def _dynamics(self) -> Dynamics:
        return Dynamics(self.machine)


class ZeroForce(ControlLaw):
    """No active forces."""

    def law(self, inputs: ControllerInputs) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """See `ControlLaw`."""
        return [0.0] * len(inputs.v_a), ()


class FunctionController:
    """A plain function of the user as a controller.

    Args:
        function: (t, q_a, v_a) -> tau_a, of all active joints or of the driven ones alone.
        machine: The machine.
    """

    def __init__(self, function: Callable[[float, Array, Array], Array], machine: Machine):
        self._function, self._machine = function, machine

    def start(self, q_a: Array) -> Array:
        """See `Controller`."""
        return np.zeros(0)

    def __call__(self, time: float, q_a: Array, v_a: Array, state: Array) -> tuple[Array, Array]:
        """See `Controller`."""
        forces = self._function(time, q_a.copy(), v_a.copy())
        label, machine = f"the controller's force at t = {time:g} s", self._machine
        if machine.free and np.shape(forces) == (machine.is_driven.sum(),):
            return machine.expand_driven(forces, label), state
        return as_sample(forces, len(machine.active), label, machine.active), state


def controller_reference(controller: Controller, machine: Machine) -> Trajectory | None:
    """The reference motion of a controller, if it has one, of all active joints."""
    reference = getattr(controller, "reference", None)
    return None if reference is None else add_free_joints(machine, reference)
