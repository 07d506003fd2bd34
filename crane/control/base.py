"""What a controller is: a function, a class with states, or a law that becomes machine code."""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from crane.codegen import Number
from crane.common.samples import Array, as_sample
from crane.common.shown import Brief
from crane.dynamics import Dynamics
from crane.dynamics.external import at_rest
from crane.machine import Machine
from crane.motion.curves import Trajectory
from crane.motion.trajectories import with_free


class Controller(Protocol):
    """What `simulate` asks of a controller; a plain function (t, q_a, v_a) -> tau_a serves too.

    It may have a `reference`, the reference motion, which gives `simulate` start and duration.
    """

    def start(self, q_a: Array) -> Array:
        """The controller's own states (k,) at the start, integrated with the machine's."""

    def __call__(self, time: float, q_a: Array, v_a: Array, state: Array) -> tuple[Array, Array]:
        """Active forces (n,) [N], [N m], and the rate (k,) of the controller's states."""


class Inverse(Protocol):
    """Inverse dynamics at an instant."""

    def __call__(self, a_a: Sequence[Number], friction: bool) -> list[Number]:
        """Active forces (n,) [N], [N m] of accelerations (n,), see `Dynamics.inverse`."""


class Gravity(Protocol):
    """Weight at an instant."""

    def __call__(self) -> list[Number]:
        """Active forces (n,) [N], [N m] that hold the weight alone, see `Dynamics.gravity`."""


class At(NamedTuple):
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

    q_a: list[Number]
    v_a: list[Number]
    state: list[Number]
    settings: list[Number]
    reference: list[Number]
    inverse: Inverse
    gravity: Gravity


@runtime_checkable
class TracedController(Controller, Protocol):
    """A controller that can become part of the simulation's machine code; `Law` makes one.

    Attributes:
        settings: (s,) its numbers.
    """

    settings: Array

    def references(self, times: Array) -> Array:
        """All that depends on time alone, (N, c) at times (N,) [s]."""

    def trace(self, at: At) -> tuple[Sequence[Number], Sequence[Number]]:
        """`__call__` as formulas."""


class Law(Brief):
    """A controller whose law is written once, and called in numbers as well as traced.

    A law writes `law`, and `begin`, `references`, `settings`, `reference` where it has states,
    depends on time, has numbers that change from one to the next, follows a motion. The rest
    follows.

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

    def law(self, at: At) -> tuple[Sequence[Number], Sequence[Number]]:
        """Active forces (n,) [N], [N m], 0.0 of free joints, and rates (k,) of the states.

        Args:
            at: What it sees, floats or formulas: `q_a`, `v_a` (n,), `state` (k,), `settings` (s,),
                `reference` (c,), and, as `Dynamics` has them, `inverse(a_a, friction)` and
                `gravity()`.
        """
        raise NotImplementedError

    def of_driven(self, x: Sequence[Number]) -> list[Number]:
        """Those of all active joints (n,) that belong to the driven ones."""
        return [value for value, moved in zip(x, self.machine.driven, strict=True) if moved]

    def spread(self, forces: Sequence[Number]) -> list[Number]:
        """Forces (n,) of all active joints from those of the driven ones."""
        given = iter(forces)
        return [next(given) if moved else 0.0 for moved in self.machine.driven]

    def begin(self, at: At) -> Sequence[Number]:
        """The law's own states (k,) at the start, seen in numbers and at rest; none yet.

        What the drives have to give then, `at.inverse`, is less by what forces from outside do at
        time 0: a machine that carries a load hangs as still as one with a payload.
        """
        return ()

    def references(self, times: Array) -> Array:
        """All that depends on time alone, (N, c) at times (N,) [s]; none yet."""
        return np.zeros((len(times), 0))

    def start(self, q_a: Array) -> Array:
        """See `Controller`."""
        # nothing is worth compiling for one posture
        dynamics = Dynamics(self.machine, backend="pinocchio")
        return self.start_at(dynamics, self.machine.closure.solve(q_a))

    def start_at(self, dynamics: Dynamics, q: Array) -> Array:
        """`start` at a posture (nq,) that is closed already, of an exact `Dynamics`."""
        q_a = q[self.machine.closure.active]
        rest = np.zeros_like(q_a)
        outside = at_rest(dynamics.machine, q)  # a run's may carry more than the law's

        def inverse(a_a: Sequence[Number], friction: bool) -> list[Number]:
            quantity = "inverse with friction" if friction else "inverse"
            needed = dynamics.tree.at(quantity, q, rest, np.array(a_a)) - outside
            found: list[Number] = needed.tolist()
            return found

        def gravity() -> list[Number]:
            found: list[Number] = dynamics.tree.at("gravity", q, rest, rest).tolist()
            return found

        at = self._numbers(0.0, q_a, rest, np.zeros(0), inverse, gravity)
        return np.array(self.begin(at), dtype=np.float64)

    def __call__(self, time: float, q_a: Array, v_a: Array, state: Array) -> tuple[Array, Array]:
        """See `Controller`."""
        tau, rate = self.law(self.at(time, q_a, v_a, state))
        return np.array(tau, dtype=np.float64), np.array(rate, dtype=np.float64)

    def trace(self, at: At) -> tuple[Sequence[Number], Sequence[Number]]:
        """What `law` gives, as formulas."""
        return self.law(at)

    def at(self, time: float, q_a: Array, v_a: Array, state: Array) -> At:
        """What the law sees at a time [s] with (n,), (n,), (k,), in numbers."""

        def inverse(a_a: Sequence[Number], friction: bool) -> list[Number]:
            wanted = np.array(a_a, dtype=np.float64)
            found: list[Number] = self._dynamics.inverse(q_a, v_a, wanted, friction).tolist()
            return found

        def gravity() -> list[Number]:
            found: list[Number] = self._dynamics.gravity(q_a).tolist()
            return found

        return self._numbers(time, q_a, v_a, state, inverse, gravity)

    def _numbers(
        self,
        time: float,
        q_a: Array,
        v_a: Array,
        state: Array,
        inverse: Inverse,
        gravity: Gravity,
    ) -> At:
        reference = self.references(np.array([time]))[0]
        vectors = (q_a, v_a, state, self.settings, reference)
        own: list[list[Number]] = [vector.tolist() for vector in vectors]
        return At(own[0], own[1], own[2], own[3], own[4], inverse, gravity)

    @cached_property
    def _dynamics(self) -> Dynamics:
        return Dynamics(self.machine)


class Free(Law):
    """No active forces."""

    def law(self, at: At) -> tuple[Sequence[Number], Sequence[Number]]:
        """See `Law`."""
        return [0.0] * len(at.v_a), ()


class Feedback:
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
        what, machine = f"the controller's force at t = {time:g} s", self._machine
        if machine.free and np.shape(forces) == (machine.driven.sum(),):
            return machine.spread(forces, what), state
        return as_sample(forces, len(machine.active), what, machine.active), state


def reference_of(controller: Controller, machine: Machine) -> Trajectory | None:
    """The reference motion of a controller, if it has one, of all active joints."""
    reference = getattr(controller, "reference", None)
    return None if reference is None else with_free(machine, reference)
