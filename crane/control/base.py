"""What a controller is, and the plainest ones."""

from collections.abc import Callable, Hashable
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from crane.codegen import Number
from crane.common.samples import Array, as_sample
from crane.dynamics.traced import Sweep
from crane.machine import Machine
from crane.motion.trajectories import Path


class Controller(Protocol):
    """What `simulate` asks of a controller; a plain function (t, q_a, v_a) -> tau_a serves too.

    Attributes:
        path: The reference motion, or None.
    """

    path: Path | None

    def start(self, q_a: Array) -> Array:
        """The controller's own states (k,) at the start, integrated with the machine's."""

    def __call__(self, time: float, q_a: Array, v_a: Array, state: Array) -> tuple[Array, Array]:
        """Active forces (n,) [N], [N m], and the rate of the controller's states."""


class Traced(NamedTuple):
    """What a controller sees while it becomes part of the machine code.

    Attributes:
        sweep: The machine's dynamics at this instant.
        q: (nq,) coordinates of all joints.
        v_a: (n,) active velocities.
        state: (k,) the controller's own states.
        settings: (s,) its `settings`.
        reference: (c,) its row of references.
    """

    sweep: Sweep
    q: list[Number]
    v_a: list[Number]
    state: list[Number]
    settings: list[Number]
    reference: list[Number]


@runtime_checkable
class TracedController(Controller, Protocol):
    """A controller that can become part of the simulation's machine code.

    Attributes:
        settings: (s,) its numbers.
        columns: Length c of a row of references.
    """

    settings: Array
    columns: int

    def references(self, times: Array) -> Array:
        """What it follows, (N, c) at times (N,) [s]."""

    def trace(self, at: Traced) -> tuple[list[Number], list[Number]]:
        """`__call__` as formulas."""


@runtime_checkable
class StiffController(TracedController, Protocol):
    """A controller whose own states ask for an implicit method.

    Attributes:
        scales: (k,) accuracy that matters in each of its states, infinite for integrals, which
            come last and which nothing depends on.
        channels: Names and units of what else is recorded.
        form: What its formulas depend on beside the zeros and ones of its settings.
        period: Time between calls of `update` [s]; 0 if it wants none.
    """

    scales: Array
    channels: tuple[tuple[str, str], ...]
    form: Hashable
    period: float

    def update(self, time: float, q: Array, v_a: Array, state: Array) -> None:
        """Look at the machine, (nq,), (n,), (k,), before the next period."""

    def look(self, at: Traced) -> list[Number]:
        """What is recorded in `channels`, as formulas."""

    def observe(self, time: float, q_a: Array, v_a: Array, state: Array) -> Array:
        """The same in numbers."""


class Free:
    """No active forces."""

    path: Path | None = None
    settings = np.zeros(0)
    columns = 0

    def __init__(self, machine: Machine):
        self._force = np.zeros(len(machine.active))

    def start(self, q_a: Array) -> Array:
        """See `Controller`."""
        return np.zeros(0)

    def __call__(self, time: float, q_a: Array, v_a: Array, state: Array) -> tuple[Array, Array]:
        """See `Controller`."""
        return self._force, state

    def references(self, times: Array) -> Array:
        """See `TracedController`."""
        return np.zeros((len(times), 0))

    def trace(self, at: Traced) -> tuple[list[Number], list[Number]]:
        """See `TracedController`."""
        return [0.0] * len(at.v_a), at.state


class Feedback:
    """A plain function of the user as a controller.

    Args:
        function: (t, q_a, v_a) -> tau_a.
        machine: The machine, whose number of active joints the answer must have.
    """

    def __init__(self, function: Callable[[float, Array, Array], Array], machine: Machine):
        self.path: Path | None = None
        self._function, self._active = function, machine.active

    def start(self, q_a: Array) -> Array:
        """See `Controller`."""
        return np.zeros(0)

    def __call__(self, time: float, q_a: Array, v_a: Array, state: Array) -> tuple[Array, Array]:
        """See `Controller`."""
        forces = self._function(time, q_a.copy(), v_a.copy())
        what = f"the controller's force at t = {time:g} s"
        return as_sample(forces, len(self._active), what, self._active), state
