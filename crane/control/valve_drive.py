"""A hydraulic circuit and what commands its valves, as the controller of a machine's forces."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from crane.codegen import Scalar
from crane.common.errors import InputError, suggest_names
from crane.common.samples import Array, as_sample
from crane.control.control_law import ControlLaw, ControllerInputs
from crane.control.valve_commands import (
    SampledCommand,
    ValveCommand,
    ValveSignals,
    require_circuit,
)
from crane.hydraulics import CircuitEquations
from crane.hydraulics.circuit_equations import CircuitValues
from crane.machine import Machine

_SAMPLING_PERIOD = 1e-3  # [s] between questions of a control unit
_RECORDED_STATE_PREFIXES = (
    "spring_",
    "oil_",
)  # states of the circuit that are recorded: compressions, oil under gas


class ValveDrive(ControlLaw):
    """The circuit between the valves' signals and the active forces.

    Its states are those of `CircuitEquations`. Active joints without a cylinder are free.

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
        command: ValveCommand,
        pressures: Mapping[str, tuple[float, float]] | None = None,
    ):
        super().__init__(machine)
        self.command, self.reference = command, command.reference
        hydraulics = require_circuit(machine)
        self.delays = np.array([spool.delay for spool in hydraulics.spools.values()])
        self._signal_source = command
        if self.delays.any() and not command.is_open_loop:
            if command.has_measured_pressures:
                raise InputError(
                    f"{type(command).__name__} has measured pressures and is no function of time, "
                    "which valves with dead time do not go with: set their delay to 0"
                )
            self._signal_source = SampledCommand(self._sample_signals, machine, _SAMPLING_PERIOD)
        self.period = self._signal_source.period
        self._active_indices = [machine.active.index(joint) for joint in hydraulics.joints]
        are_motors = [cylinder.motor for cylinder in hydraulics.cylinders.values()]
        self._lower_limits = np.where(are_motors, 0.0, machine.lower[self._active_indices])
        strokes = np.where(
            are_motors, 0.0, machine.upper[self._active_indices] - self._lower_limits
        )
        self.circuit = CircuitEquations(
            hydraulics, strokes.tolist(), command.has_measured_pressures
        )
        self._initial_pressures: dict[str, tuple[float, float]] = {}
        for joint, pair in (pressures or {}).items():
            if joint not in hydraulics.joints:
                raise InputError(
                    f"no cylinder at '{joint}', {suggest_names(hydraulics.joints, joint)}"
                )
            a, b = as_sample(pair, 2, f"pressures of '{joint}'", ("A", "B"))
            if min(a, b) < 0:
                raise InputError(
                    f"pressures of '{joint}' are {a:g} and {b:g} Pa, they count from a vacuum and "
                    "cannot be negative: add 1e5 to gauge pressures"
                )
            self._initial_pressures[joint] = float(a), float(b)
        self.settings = np.concatenate(
            [self.circuit.constants, self._lower_limits, self._signal_source.settings]
        )
        self.scales = self.circuit.scales
        self.channels = self._channel_units()

    def for_machine(self, machine: Machine) -> "ValveDrive":
        """The same commands and starting pressures at another machine.

        Raises:
            InputError: Its valves have dead time and a law has not been sampled for that.
        """
        drive = ValveDrive(machine, self.command, self._initial_pressures)
        if drive.period != self.period:
            raise InputError(
                f"{type(self.command).__name__} goes with time, and with dead time of a valve it "
                "is sampled: that has no derivative at a delay of 0"
            )
        return drive

    def update(self, time: float, q: Array, v_a: Array, state: Array) -> None:
        """Let the command look at the machine."""
        vapour_pressure = self.circuit.hydraulics.oil.vapour_pressure
        chamber_pressures = np.array(
            [state[start : start + 2] for start in self.circuit.cylinder_state_starts]
        )
        self._current_state = state
        self._signal_source.update(
            time, q, v_a, vapour_pressure + np.maximum(chamber_pressures, 0.0)
        )

    def initial_state(self, inputs: ControllerInputs) -> Sequence[Scalar]:
        """See `ControlLaw`."""
        holding_forces = np.array(inputs.inverse([0.0] * len(inputs.q_a), friction=False))[
            self._active_indices
        ]
        x = np.array(inputs.q_a)[self._active_indices] - self._lower_limits
        hydraulics = self.circuit.hydraulics
        # a program has not been asked yet, and may remember an earlier simulation
        signals: Sequence[Scalar] = [spool.neutral for spool in hydraulics.spools.values()]
        if not self.command.period:
            signals = self.command.signals(self._command_inputs(inputs))
        tank = hydraulics.supply.tank
        if self.command.has_measured_pressures:
            tank = float(np.array(inputs.reference[-1], dtype=np.float64))
        initial_signals = np.array(signals, dtype=np.float64)
        return list(
            self.circuit.initial_state(
                x, holding_forces, self._initial_pressures, initial_signals, tank
            )
        )

    def _command_inputs(self, inputs: ControllerInputs) -> ControllerInputs:
        """What the command sees at the start."""
        reference = inputs.reference
        if self._signal_source is not self.command:
            reference = self.command.references(np.zeros(1))[0].tolist()
        return inputs._replace(settings=self.command.settings.tolist(), reference=reference)

    def _sample_signals(self, time: float, q_a: Array, v_a: Array, pressures: Array) -> Array:
        """Signals (s,) of a law that is sampled."""
        inputs = self.inputs_at(time, q_a, v_a, self._current_state)
        reference: list[Scalar] = self.command.references(np.array([time]))[0].tolist()
        command_inputs = inputs._replace(
            settings=self.command.settings.tolist(), reference=reference
        )
        return np.array(self.command.signals(command_inputs), dtype=np.float64)

    def references(self, times: Array) -> Array:
        """See `ControlLaw`; signals are those that reach the spools."""
        samples = self._signal_source.references(times)
        for delay in np.unique(self.delays[self.delays > 0]):
            delayed = np.flatnonzero(self.delays == delay)
            samples[:, delayed] = self._signal_source.references(times - delay)[:, delayed]
        return samples

    def commanded_signals(self, times: Array) -> Array:
        """Signals (N, s) [V] as they were commanded at times (N,), of sources that are `given`."""
        if not self.period:
            return self._signal_source.references(times)[:, : len(self.delays)]
        rows = [self._signal_source.references(times[i : i + 1]) for i in range(len(times))]
        return np.vstack(rows)[:, : len(self.delays)]

    def breaks(self) -> Array:
        """Times (k,) [s] at which signals turn, as they are commanded and as they arrive."""
        source: Any = self.command
        if not hasattr(source, "breaks"):
            source = self.reference
        break_lists = [np.asarray(source.breaks())] if hasattr(source, "breaks") else []
        if isinstance(self.command, ValveSignals):
            for i in np.flatnonzero(self.delays):
                break_lists.append(self.command.slope_changes(int(i)) + self.delays[i])
        return np.concatenate([np.zeros(0), *break_lists])

    def next_delayed_jump(self, time: float) -> float:
        """When, behind a time [s], a signal that is held next jumps late."""
        earliest = np.inf
        for delay in np.unique(self.delays[self.delays > 0]) if self.period else ():
            count = max(np.floor((time - delay) / self.period) + 1.0, 1.0)
            jump = count * self.period + delay
            earliest = min(earliest, jump if jump > time else jump + self.period)
        return earliest

    def law(self, inputs: ControllerInputs) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """See `ControlLaw`."""
        circuit_values, _ = self._evaluate_circuit(inputs)
        return self._active_forces(circuit_values), circuit_values.state_rates

    def circuit_friction(self, inputs: ControllerInputs) -> list[Scalar]:
        """Coulomb friction [N], [N m] that the circuit adds to its joints."""
        friction_joints = self.circuit.hydraulics.circuit_friction_joints
        if not friction_joints:
            return []
        circuit_values, _ = self._evaluate_circuit(inputs)
        found = zip(self.circuit.joints, circuit_values.circuit_friction, strict=True)
        return [grip for joint, grip in found if joint in friction_joints]

    def channel_values(self, inputs: ControllerInputs) -> list[Scalar]:
        """What is recorded in `channels`."""
        circuit_values, signals = self._evaluate_circuit(inputs)
        out: list[Scalar] = []
        signals_and_positions = iter(zip(signals, circuit_values.spool_positions, strict=True))
        valves = self.circuit.hydraulics.valves.values()
        for valve, sides in zip(valves, circuit_values.chambers, strict=True):
            out += [*next(signals_and_positions), *(side.pressure for side in sides)]
            out += [side.hose_flow for side in sides]
            if valve.spool_b:
                out += next(signals_and_positions)
        out += [circuit_values.supply_pressure, circuit_values.tank_pressure]
        circuit_states = dict(zip(self.circuit.state_units, inputs.state, strict=False))
        out += [
            circuit_states[name]
            for name in circuit_states
            if name.startswith(_RECORDED_STATE_PREFIXES)
        ]
        out += [circuit_values.pressures[name] for name in self._further_nodes]
        for pump in circuit_values.pumps.values():
            out += [pump.share, pump.shaft_power]
        if self.circuit.hydraulics.engine is not None and circuit_values.pumps:
            out.append(circuit_values.engine_speed_ratio * self.circuit.hydraulics.engine.speed)
        m = len(self.delays)
        return [*out, *inputs.reference[m : m + len(self.command.channels)]]

    def _evaluate_circuit(
        self, inputs: ControllerInputs
    ) -> tuple[CircuitValues, Sequence[Scalar]]:
        """The circuit, and the signals of its valves."""
        m, size = len(self._active_indices), len(self.circuit.constants)
        lower = inputs.settings[size : size + m]
        signals = self._signal_source.signals(
            inputs._replace(settings=inputs.settings[size + m :])
        )
        circuit_values = self.circuit.evaluate(
            inputs.settings[:size],
            [inputs.q_a[i] - lower[k] for k, i in enumerate(self._active_indices)],
            [inputs.v_a[i] for i in self._active_indices],
            inputs.state,
            signals,
            inputs.reference[-2:] if self.command.has_measured_pressures else [],
        )
        return circuit_values, signals

    def _active_forces(self, circuit_values: CircuitValues) -> list[Scalar]:
        out: list[Scalar] = [0.0] * len(self.machine.active)
        for i, force in zip(self._active_indices, circuit_values.forces, strict=True):
            out[i] = force
        return out

    def _channel_units(self) -> tuple[tuple[str, str], ...]:
        channels: list[tuple[str, str]] = []
        for joint in self.circuit.joints:
            channels += [(f"voltage_{joint}", "V"), (f"spool_{joint}", "")]
            channels += [(f"pressure_{joint}_{side}", "Pa") for side in "ab"]
            channels += [(f"flow_{joint}_{side}", "m3/s") for side in "ab"]
            if self.circuit.hydraulics.valves[joint].spool_b:
                channels += [(f"voltage_{joint}_b", "V"), (f"spool_{joint}_b", "")]
        channels += [("pressure_supply", "Pa"), ("pressure_tank", "Pa")]
        units = self.circuit.state_units
        channels += [
            (name, units[name]) for name in units if name.startswith(_RECORDED_STATE_PREFIXES)
        ]
        channels += [(f"pressure_{name}", "Pa") for name in self._further_nodes]
        for name in self.circuit.pumps:
            channels += [(f"share_{name}", ""), (f"shaft_{name}", "W")]
        if self.circuit.hydraulics.engine is not None and self.circuit.pumps:
            channels.append(("engine_speed", "rad/s"))
        return (*channels, *self.command.channels)

    @property
    def _further_nodes(self) -> list[str]:
        """Nodes beside tank, first pump and chambers."""
        circuit = self.circuit.hydraulics
        return [*circuit.supplies, *circuit.lines, *circuit.accumulators]
