"""A hydraulic circuit and what commands its valves, as the controller of a machine's forces."""

from collections.abc import Mapping, Sequence

import numpy as np

from crane.codegen import Number
from crane.common.errors import InputError, known
from crane.common.samples import Array, as_sample
from crane.control.base import At, Law
from crane.control.valves import Command, circuit_of
from crane.hydraulics import Circuit
from crane.hydraulics.circuit import Instant
from crane.machine import Machine

_OWN = ("spring_", "oil_")  # states of the circuit that are recorded: compressions, oil under gas


class ValveDrive(Law):
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
        super().__init__(machine)
        self.command, self.reference, self.period = command, command.reference, command.period
        hydraulics = circuit_of(machine)
        self._which = [machine.active.index(joint) for joint in hydraulics.joints]
        turns = [cylinder.motor for cylinder in hydraulics.cylinders.values()]
        self._lower = np.where(turns, 0.0, machine.lower[self._which])
        strokes = np.where(turns, 0.0, machine.upper[self._which] - self._lower)
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
        self.scales = self.circuit.scales
        self.channels = self._channels()

    def on(self, machine: Machine) -> "ValveDrive":
        """The same commands and starting pressures at another machine."""
        return ValveDrive(machine, self.command, self._pressures)

    def update(self, time: float, q: Array, v_a: Array, state: Array) -> None:
        """Let the command look at the machine."""
        vapour = self.circuit.hydraulics.oil.vapour_pressure
        pairs = np.array([state[start : start + 2] for start in self.circuit.starts])
        self.command.update(time, q, v_a, vapour + np.maximum(pairs, 0.0))

    def begin(self, at: At) -> Sequence[Number]:
        """See `Law`."""
        weight = np.array(at.inverse([0.0] * len(at.q_a), friction=False))[self._which]
        x = np.array(at.q_a)[self._which] - self._lower
        hydraulics = self.circuit.hydraulics
        # a program has not been asked yet, and may remember an earlier simulation
        signals: Sequence[Number] = [valve.neutral for valve in hydraulics.valves.values()]
        if not self.period:
            signals = self.command.signals(at._replace(settings=self.command.settings.tolist()))
        tank = hydraulics.supply.tank
        if self.command.measured:
            tank = float(np.array(at.reference[-1], dtype=np.float64))
        levels = np.array(signals, dtype=np.float64)
        return list(self.circuit.start(x, weight, self._pressures, levels, tank))

    def references(self, times: Array) -> Array:
        """See `TracedController`."""
        return self.command.references(times)

    def law(self, at: At) -> tuple[Sequence[Number], Sequence[Number]]:
        """See `Law`."""
        instant, _ = self._at(at)
        return self._forces(instant), instant.rates

    def grip(self, at: At) -> list[Number]:
        """Coulomb friction that is added to that of the joints `Hydraulics.gripped` [N], [N m]."""
        gripped = self.circuit.hydraulics.gripped
        if not gripped:
            return []
        instant, _ = self._at(at)
        found = zip(self.circuit.joints, instant.grips, strict=True)
        return [grip for joint, grip in found if joint in gripped]

    def look(self, at: At) -> list[Number]:
        """What is recorded in `channels`."""
        instant, signals = self._at(at)
        out: list[Number] = []
        for signal, spool, sides in zip(signals, instant.spools, instant.chambers, strict=True):
            out += [signal, spool, *(side.pressure for side in sides)]
            out += [side.valve for side in sides]
        out += [instant.supply, instant.tank]
        own = dict(zip(self.circuit.states, at.state, strict=False))
        out += [own[name] for name in own if name.startswith(_OWN)]
        out += [instant.pressures[name] for name in self._others]
        for pump in instant.pumps.values():
            out += [pump.share, pump.shaft]
        if self.circuit.hydraulics.engine is not None and instant.pumps:
            out.append(instant.speed * self.circuit.hydraulics.engine.speed)
        m = len(self._which)
        return [*out, *at.reference[m : m + len(self.command.channels)]]

    def _at(self, at: At) -> tuple[Instant, Sequence[Number]]:
        """The circuit, and the signals of its valves."""
        m, size = len(self._which), len(self.circuit.numbers)
        lower = at.settings[size : size + m]
        signals = self.command.signals(at._replace(settings=at.settings[size + m :]))
        instant = self.circuit.at(
            at.settings[:size],
            [at.q_a[i] - lower[k] for k, i in enumerate(self._which)],
            [at.v_a[i] for i in self._which],
            at.state,
            signals,
            at.reference[-2:] if self.command.measured else [],
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
        found += [("pressure_supply", "Pa"), ("pressure_tank", "Pa")]
        units = self.circuit.states
        found += [(name, units[name]) for name in units if name.startswith(_OWN)]
        found += [(f"pressure_{name}", "Pa") for name in self._others]
        for name in self.circuit.pumps:
            found += [(f"share_{name}", ""), (f"shaft_{name}", "W")]
        if self.circuit.hydraulics.engine is not None and self.circuit.pumps:
            found.append(("engine_speed", "rad/s"))
        return (*found, *self.command.channels)

    @property
    def _others(self) -> list[str]:
        """Nodes beside tank, first pump and chambers."""
        circuit = self.circuit.hydraulics
        return [*circuit.supplies, *circuit.lines, *circuit.accumulators]
