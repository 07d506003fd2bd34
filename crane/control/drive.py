"""A hydraulic circuit and what commands its valves, as the controller of a machine's forces."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from crane.codegen import Number
from crane.common.errors import InputError, known
from crane.common.samples import Array, as_sample
from crane.control.base import At, Law
from crane.control.valves import Command, Sampled, Signals, circuit_of
from crane.hydraulics import Circuit
from crane.hydraulics.circuit import Instant
from crane.machine import Machine

_UNIT = 1e-3  # [s] between questions of a control unit
_OWN = ("spring_", "oil_")  # states of the circuit that are recorded: compressions, oil under gas


class ValveDrive(Law):
    """The circuit between the valves' signals and the active forces.

    Its states are those of `Circuit`. Active joints without a cylinder are free.

    A spool with dead time gets the signal of t - delay, and until then the first one. What goes by
    time alone is asked for earlier instants; a law that looks at the machine is asked once per
    millisecond then, and held, as in a control unit.

    Args:
        machine: The machine.
        command: Where the signals come from.
        pressures: Of A and B at the start [Pa] by joint, where they are known; else what holds
            the machine still, the unloaded side at the tank's pressure.

    Attributes:
        delays: (s,) dead times of the spools [s].

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
        self.command, self.reference = command, command.reference
        hydraulics = circuit_of(machine)
        self.delays = np.array([spool.delay for spool in hydraulics.spools.values()])
        self._source = command
        if self.delays.any() and not command.given:
            if command.measured:
                raise InputError(
                    f"{type(command).__name__} has measured pressures and is no function of time, "
                    "which valves with dead time do not go with: set their delay to 0"
                )
            self._source = Sampled(self._asked, machine, _UNIT)
        self.period = self._source.period
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
        self.settings = np.concatenate([self.circuit.numbers, self._lower, self._source.settings])
        self.scales = self.circuit.scales
        self.channels = self._channels()

    def on(self, machine: Machine) -> "ValveDrive":
        """The same commands and starting pressures at another machine.

        Raises:
            InputError: Its valves have dead time and a law has not been sampled for that.
        """
        found = ValveDrive(machine, self.command, self._pressures)
        if found.period != self.period:
            raise InputError(
                f"{type(self.command).__name__} goes with time, and with dead time of a valve it "
                "is sampled: that has no derivative at a delay of 0"
            )
        return found

    def update(self, time: float, q: Array, v_a: Array, state: Array) -> None:
        """Let the command look at the machine."""
        vapour = self.circuit.hydraulics.oil.vapour_pressure
        pairs = np.array([state[start : start + 2] for start in self.circuit.starts])
        self._state = state
        self._source.update(time, q, v_a, vapour + np.maximum(pairs, 0.0))

    def begin(self, at: At) -> Sequence[Number]:
        """See `Law`."""
        weight = np.array(at.inverse([0.0] * len(at.q_a), friction=False))[self._which]
        x = np.array(at.q_a)[self._which] - self._lower
        hydraulics = self.circuit.hydraulics
        # a program has not been asked yet, and may remember an earlier simulation
        signals: Sequence[Number] = [spool.neutral for spool in hydraulics.spools.values()]
        if not self.command.period:
            signals = self.command.signals(self._commanding(at))
        tank = hydraulics.supply.tank
        if self.command.measured:
            tank = float(np.array(at.reference[-1], dtype=np.float64))
        levels = np.array(signals, dtype=np.float64)
        return list(self.circuit.start(x, weight, self._pressures, levels, tank))

    def _commanding(self, at: At) -> At:
        """What the command sees at the start."""
        reference = at.reference
        if self._source is not self.command:
            reference = self.command.references(np.zeros(1))[0].tolist()
        return at._replace(settings=self.command.settings.tolist(), reference=reference)

    def _asked(self, time: float, q_a: Array, v_a: Array, pressures: Array) -> Array:
        """Signals (s,) of a law that is sampled."""
        at = self.at(time, q_a, v_a, self._state)
        reference: list[Number] = self.command.references(np.array([time]))[0].tolist()
        own = at._replace(settings=self.command.settings.tolist(), reference=reference)
        return np.array(self.command.signals(own), dtype=np.float64)

    def references(self, times: Array) -> Array:
        """See `Law`; signals are those that reach the spools."""
        found = self._source.references(times)
        for delay in np.unique(self.delays[self.delays > 0]):
            late = np.flatnonzero(self.delays == delay)
            found[:, late] = self._source.references(times - delay)[:, late]
        return found

    def commanded(self, times: Array) -> Array:
        """Signals (N, s) [V] as they were commanded at times (N,), of sources that are `given`."""
        if not self.period:
            return self._source.references(times)[:, : len(self.delays)]
        every = [self._source.references(times[i : i + 1]) for i in range(len(times))]
        return np.vstack(every)[:, : len(self.delays)]

    def breaks(self) -> Array:
        """Times (k,) [s] at which signals turn, as they are commanded and as they arrive."""
        turns: Any = self.command
        if not hasattr(turns, "breaks"):
            turns = self.reference
        found = [np.asarray(turns.breaks())] if hasattr(turns, "breaks") else []
        if isinstance(self.command, Signals):
            for i in np.flatnonzero(self.delays):
                found.append(self.command.corners(int(i)) + self.delays[i])
        return np.concatenate([np.zeros(0), *found])

    def jumps(self, time: float) -> float:
        """When, behind a time [s], a signal that is held next jumps late."""
        found = np.inf
        for delay in np.unique(self.delays[self.delays > 0]) if self.period else ():
            count = max(np.floor((time - delay) / self.period) + 1.0, 1.0)
            jump = count * self.period + delay
            found = min(found, jump if jump > time else jump + self.period)
        return found

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
        pairs = iter(zip(signals, instant.spools, strict=True))
        valves = self.circuit.hydraulics.valves.values()
        for valve, sides in zip(valves, instant.chambers, strict=True):
            out += [*next(pairs), *(side.pressure for side in sides)]
            out += [side.valve for side in sides]
            if valve.spool_b:
                out += next(pairs)
        out += [instant.supply, instant.tank]
        own = dict(zip(self.circuit.states, at.state, strict=False))
        out += [own[name] for name in own if name.startswith(_OWN)]
        out += [instant.pressures[name] for name in self._others]
        for pump in instant.pumps.values():
            out += [pump.share, pump.shaft]
        if self.circuit.hydraulics.engine is not None and instant.pumps:
            out.append(instant.speed * self.circuit.hydraulics.engine.speed)
        m = len(self.delays)
        return [*out, *at.reference[m : m + len(self.command.channels)]]

    def _at(self, at: At) -> tuple[Instant, Sequence[Number]]:
        """The circuit, and the signals of its valves."""
        m, size = len(self._which), len(self.circuit.numbers)
        lower = at.settings[size : size + m]
        signals = self._source.signals(at._replace(settings=at.settings[size + m :]))
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
            if self.circuit.hydraulics.valves[joint].spool_b:
                found += [(f"voltage_{joint}_b", "V"), (f"spool_{joint}_b", "")]
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
