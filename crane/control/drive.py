"""A hydraulic circuit and what commands its valves, as the controller of a machine's forces."""

from collections.abc import Hashable, Mapping, Sequence

import numpy as np

from crane.codegen import Number
from crane.common.errors import InputError, known
from crane.common.samples import Array, as_sample
from crane.control.base import Traced
from crane.control.valves import Command, circuit_of
from crane.dynamics import Dynamics
from crane.hydraulics import Circuit
from crane.hydraulics.circuit import Instant
from crane.machine import Machine
from crane.motion.trajectories import Path


class ValveDrive:
    """The circuit between the valves' signals and the active forces.

    Its states are those of `Circuit`. Active joints without a cylinder are free.

    Args:
        machine: The machine.
        command: Where the signals come from.
        pressures: Of A and B at the start [Pa] by joint, where they are known; else what holds
            the machine still, the unloaded side at the tank's pressure.

    Raises:
        InputError: The machine has no circuit, a joint no cylinder, or a pressure cannot be.
    """

    def __init__(
        self,
        machine: Machine,
        command: Command,
        pressures: Mapping[str, tuple[float, float]] | None = None,
    ):
        self.machine, self.command = machine, command
        self.path: Path | None = command.path
        self.period = command.period
        hydraulics = circuit_of(machine)
        self._which = [machine.active.index(joint) for joint in hydraulics.joints]
        self._lower = machine.lower[self._which]
        strokes = machine.upper[self._which] - self._lower
        self.circuit = Circuit(hydraulics, strokes.tolist(), command.measured)
        self._pressures: dict[str, tuple[float, float]] = {}
        for joint, pair in (pressures or {}).items():
            if joint not in hydraulics.joints:
                raise InputError(f"no cylinder at '{joint}', {known(hydraulics.joints, joint)}")
            a, b = as_sample(pair, 2, f"pressures of '{joint}'", ("A", "B"))
            if min(a, b) < 0:
                raise InputError(
                    f"pressures of '{joint}' are {a:g} and {b:g} Pa, they count from a vacuum and "
                    "cannot be negative: add 1e5 to gauge pressures"
                )
            self._pressures[joint] = float(a), float(b)
        self.settings = np.concatenate([self.circuit.numbers, self._lower, command.settings])
        self.columns = command.columns
        self.scales = self.circuit.scales
        self.channels = self._channels()
        self.form: Hashable = (type(command), self.circuit.form, tuple(self._which))

    def update(self, time: float, q: Array, v_a: Array, state: Array) -> None:
        """Let the command look at the machine."""
        vapour = self.circuit.hydraulics.oil.vapour_pressure
        pairs = np.array([state[start : start + 2] for start in self.circuit.starts])
        self.command.update(time, q, v_a, vapour + np.maximum(pairs, 0.0))

    def start(self, q_a: Array) -> Array:
        """See `Controller`."""
        rest = np.zeros_like(q_a)
        once = Dynamics(self.machine, path="pinocchio")
        weight = once.inverse(q_a, rest, rest)[self._which]
        x = q_a[self._which] - self._lower
        hydraulics = self.circuit.hydraulics
        # a program has not been asked yet, and may remember an earlier simulation
        signals: list[Number] = [valve.neutral for valve in hydraulics.valves.values()]
        if not self.period:
            reference = self.command.references(np.zeros(1))[0].tolist()
            signals = self.command.signals(
                q_a.tolist(), rest.tolist(), self.command.settings.tolist(), reference
            )
        supply, tank = hydraulics.supply.pressure, hydraulics.supply.tank
        if self.command.measured:
            supply, tank = self.command.references(np.zeros(1))[0, -2:].tolist()
        levels = np.array(signals, dtype=np.float64)
        return self.circuit.start(x, weight, self._pressures, levels, supply, tank)

    def __call__(self, time: float, q_a: Array, v_a: Array, state: Array) -> tuple[Array, Array]:
        """See `Controller`."""
        instant, _ = self._in_numbers(time, q_a, v_a, state)
        return np.array(self._forces(instant), dtype=np.float64), np.array(
            instant.rates, dtype=np.float64
        )

    def references(self, times: Array) -> Array:
        """See `TracedController`."""
        return self.command.references(times)

    def trace(self, at: Traced) -> tuple[list[Number], list[Number]]:
        """See `TracedController`."""
        instant, _ = self._traced(at)
        return self._forces(instant), instant.rates

    def look(self, at: Traced) -> list[Number]:
        """What is recorded, in the order of `channels`."""
        return self._seen(*self._traced(at))

    def observe(self, time: float, q_a: Array, v_a: Array, state: Array) -> Array:
        """The same in numbers."""
        return np.array(self._seen(*self._in_numbers(time, q_a, v_a, state)), dtype=np.float64)

    def _in_numbers(
        self, time: float, q_a: Array, v_a: Array, state: Array
    ) -> tuple[Instant, list[Number]]:
        reference = self.references(np.array([time]))[0]
        vectors = (q_a, v_a, state, self.settings, reference)
        return self._at(*(vector.tolist() for vector in vectors))

    def _traced(self, at: Traced) -> tuple[Instant, list[Number]]:
        q_a = [at.q[i] for i in self.machine.closure.active]
        return self._at(q_a, at.v_a, at.state, at.settings, at.reference)

    def _at(
        self,
        q_a: Sequence[Number],
        v_a: Sequence[Number],
        state: Sequence[Number],
        settings: Sequence[Number],
        reference: Sequence[Number],
    ) -> tuple[Instant, list[Number]]:
        m, size = len(self._which), len(self.circuit.numbers)
        lower, own = settings[size : size + m], settings[size + m :]
        signals = self.command.signals(q_a, v_a, own, reference)
        instant = self.circuit.at(
            settings[:size],
            [q_a[i] - lower[k] for k, i in enumerate(self._which)],
            [v_a[i] for i in self._which],
            state,
            signals,
            reference[-2:] if self.command.measured else [],
        )
        return instant, signals

    def _forces(self, instant: Instant) -> list[Number]:
        out: list[Number] = [0.0] * len(self.machine.active)
        for i, force in zip(self._which, instant.forces, strict=True):
            out[i] = force
        return out

    def _channels(self) -> tuple[tuple[str, str], ...]:
        found: list[tuple[str, str]] = []
        for joint in self.circuit.joints:
            found += [(f"voltage_{joint}", "V"), (f"spool_{joint}", "")]
            found += [(f"pressure_{joint}_{side}", "Pa") for side in "ab"]
            found += [(f"flow_{joint}_{side}", "m3/s") for side in "ab"]
        return (*found, ("pressure_supply", "Pa"), ("pressure_tank", "Pa"))

    def _seen(self, instant: Instant, signals: Sequence[Number]) -> list[Number]:
        out: list[Number] = []
        for signal, spool, sides in zip(signals, instant.spools, instant.chambers, strict=True):
            out += [signal, spool, *(side.pressure for side in sides)]
            out += [side.valve for side in sides]
        return [*out, instant.supply, instant.tank]
