"""How named numbers of a machine, and its start, change all numbers of a simulation."""

from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np

from crane.common.errors import InputError, known
from crane.common.samples import Array
from crane.control import TracedController, ValveDrive
from crane.description.sensors import VELOCITY
from crane.dynamics import Dynamics
from crane.dynamics.named import SMALL, Named
from crane.machine import Machine
from crane.simulation.sensitivity.setup import Setup, setup_of

START = "start."
_NUDGE = 1e-4  # rad, machine's size, per `Closure.pace`, of starts
_CENTRAL = ((1, 8.0 / 12.0), (-1, -8.0 / 12.0), (2, -1.0 / 12.0), (-2, 1.0 / 12.0))


class Directions:
    """A simulation's numbers, and their derivatives by named ones.

    Args:
        dynamics: Of the machine.
        control: Its controller.
        start: q_A and v_A at first.
        frames: Links that are observed.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        control: TracedController,
        start: tuple[Array, Array],
        frames: Sequence[str],
    ):
        self._dynamics, self._control = dynamics, control
        self._start, self._frames = start, frames

    @cached_property
    def _named(self) -> Named:
        return Named(self._dynamics.machine)

    def base(self, times: Array) -> Setup:
        """The numbers, given the times (2 N + 1,) at which references are asked [s]."""
        return self._at(self._dynamics.machine, self._start, times)

    def by(self, names: Sequence[str], times: Array) -> dict[str, Setup]:
        """Derivatives by some numbers; see `base`.

        Raises:
            InputError: An unknown name, or a number that no machine can be made with beside it.
        """
        return dict(self._each(names, times, skip=False))

    def by_all(self, times: Array) -> dict[str, Setup]:
        """Derivatives by all numbers of the machine that change something and can be varied."""
        every = self._each(self._named.names, times, skip=True)
        return {name: found for name, found in every if any(part.any() for part in found)}

    def _each(self, names: Sequence[str], times: Array, skip: bool) -> Iterator[tuple[str, Setup]]:
        base = self.base(times)
        ends = np.cumsum([part.size for part in base])[:-1]

        def flat(machine: Machine) -> Array:
            return np.concatenate([x.ravel() for x in self._at(machine, self._start, times)])

        here = None
        for name in names:
            if name.startswith(START):
                yield name, self._started(name, times)
                continue
            here = self._named.here(flat) if here is None else here
            try:
                slope = self._named.slope(name, flat, here)
            except InputError:
                if not skip:
                    raise
                continue
            parts = zip(np.split(slope, ends), base, strict=True)
            found = Setup(*(part.reshape(like.shape) for part, like in parts))
            if not found.references.any():  # which are long
                found = Setup(*map(np.copy, found))._replace(
                    references=np.broadcast_to(0.0, found.references.shape)
                )
            yield name, found

    def value(self, name: str) -> float:
        """A number, or a coordinate or velocity at the start."""
        if name.startswith(START):
            part, i = _begins(name, self._dynamics.machine)
            return float(self._start[part][i])
        return self._named.value(name)

    def size(self, name: str) -> float:
        """By how much a number changes that changes much."""
        value = self.value(name)
        return abs(value) if value and not name.startswith(START) else SMALL

    def _at(self, machine: Machine, start: tuple[Array, Array], times: Array) -> Setup:
        """The numbers of a machine like this one, from a start."""
        control = self._control
        own = control.on(machine) if isinstance(control, ValveDrive) else control
        return setup_of(self._dynamics, own, start, self._frames, times, machine)

    def _started(self, name: str, times: Array) -> Setup:
        """How the numbers change with a coordinate or velocity at the start."""
        machine = self._dynamics.machine
        part, i = _begins(name, machine)
        closure = machine.closure
        nudge = _NUDGE * closure.units[closure.active][i] / (closure.pace if part else 1.0)
        start = np.zeros(0)
        for side, weight in _CENTRAL:
            moved = self._start[0].copy(), self._start[1].copy()
            moved[part][i] += side * nudge
            more = weight / nudge * self._at(machine, moved, times).start
            start = start + more if start.size else more
        base = self.base(times)  # nothing else of it depends on where a motion starts
        return Setup(*(np.broadcast_to(0.0, x.shape) for x in base))._replace(start=start)


def _begins(name: str, machine: Machine) -> tuple[int, int]:
    """Which part of the start a name is of, and which joint.

    Raises:
        InputError: It is of none.
    """
    joint = name.removeprefix(START)
    part = int(joint.endswith(VELOCITY) and joint not in machine.active)
    joint = joint.removesuffix(VELOCITY) if part else joint
    if joint not in machine.active:
        raise InputError(
            f"'{name}' is no start of an active joint, {known(machine.active, joint)}"
        )
    return part, machine.active.index(joint)
