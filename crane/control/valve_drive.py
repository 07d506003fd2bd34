"""A hydraulic circuit with its valve commands as a controller of the active forces."""

import itertools
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from crane.codegen import Scalar
from crane.common.errors import InputError, SimulationError, check_name
from crane.common.samples import Array, as_sample
from crane.control.control_law import ControlLaw, ControllerInputs
from crane.control.oil_equilibrium import OilEquilibrium, open_nodes
from crane.control.valve_commands import (
    SampledCommand,
    ValveCommand,
    ValveSignals,
    require_circuit,
)
from crane.dynamics.dynamics import Dynamics
from crane.hydraulics.circuit_equations import CircuitEquations, CircuitValues
from crane.machine.machine import Machine

_VOID_UNIT = 1e7  # unit of the distances from a void [Pa]
_SAMPLING_PERIOD = 1e-3  # sampling period of a law with delayed valves [s]
# states of the circuit that are recorded: compressions of springs, oil in accumulators
_RECORDED_STATE_PREFIXES = ("spring_", "oil_")


class ValveDrive(ControlLaw):
    """Control law whose forces are those of a hydraulic circuit with commanded valves.

    Its states are those of `CircuitStates`. Active joints without a cylinder are free.

    A spool with a dead time gets the signal of the time t - delay, and before that the first
    signal. An open-loop command is evaluated at earlier instants; another command is then sampled
    once per millisecond and held, as in a control unit.

    Args:
        machine: The machine.
        command: Source of the signals.
        pressures: Initial pressures in A and B [Pa] by joint. By default they hold the machine
            still, with the tank pressure in the unloaded chamber.

    Attributes:
        delays: (s,) dead times of the spools [s].
        circuit: The equations of the circuit.
        scales: Required accuracy of the states.

    Raises:
        InputError: The machine has no circuit, a joint no cylinder, or a pressure is negative.
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
        self.reference_units = self._signal_source.reference_units
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
            check_name(joint, hydraulics.joints, f"no cylinder at '{joint}'")
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
        self._last_evaluation: tuple[Any, Any, Any] = None, None, None

    def for_machine(self, machine: Machine) -> "ValveDrive":
        """The same command and initial pressures for another machine.

        Raises:
            InputError: Its valves have a dead time, and the law is not sampled.
        """
        drive = ValveDrive(machine, self.command, self._initial_pressures)
        if drive.period != self.period:
            raise InputError(
                f"{type(self.command).__name__} goes with time, and with dead time of a valve it "
                "is sampled: that has no derivative at a delay of 0"
            )
        return drive

    def update(self, time: float, q: Array, v_a: Array, state: Array) -> None:
        """Sample the command, see `ValveCommand.update`."""
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
        static_forces = inputs.inverse([0.0] * len(inputs.q_a), friction=False)
        holding_forces = [static_forces[i] for i in self._active_indices]
        hydraulics = self.circuit.hydraulics
        # a sampled command has no signal yet, except perhaps those of an earlier run
        signals: Sequence[Scalar] = [spool.neutral for spool in hydraulics.spools.values()]
        if not self.command.period:
            size = len(self.circuit.constants) + len(self._active_indices)
            own = inputs._replace(settings=inputs.settings[size:])
            if self._signal_source is not self.command:
                own = inputs._replace(
                    settings=self.command.settings.tolist(),
                    reference=self.command.references(np.zeros(1))[0].tolist(),
                )
            signals = self.command.signals(own)
        tank = hydraulics.supply.tank
        if self.command.has_measured_pressures:
            tank = float(np.array(inputs.reference[-1], dtype=np.float64))
        return self.circuit.initial_state(holding_forces, self._initial_pressures, signals, tank)

    def start_closed(
        self, dynamics: Dynamics, q: Array, contact_states: Array | None = None
    ) -> Array:
        """See `ControlLaw`; lines and accumulators as `Machine.start` says.

        By default those without a `pressure` that are open to a chamber have that of its load.

        Raises:
            SimulationError: `start: equilibrium`, and oil flows in any case.
        """
        state = super().start_closed(dynamics, q, contact_states)
        hydraulics, start = self.circuit.hydraulics, self.machine.start
        stores = hydraulics.lines | hydraulics.accumulators  # type: ignore[operator]
        nodes = sorted(x for x in open_nodes(hydraulics) if not stores[x].pressure)
        if start == "home" or not (nodes or start):
            return state
        equilibrium = self.oil_equilibrium(q, state)
        motion = equilibrium.find(stores if start else nodes)
        if motion and start:
            raise SimulationError(
                f"the oil has no static equilibrium: {motion}, through a valve, relief valve or "
                "element that is open: close it"
            )
        return state if motion else equilibrium.state

    def oil_equilibrium(self, q: Array, state: Array) -> OilEquilibrium:
        """Equations of the equilibrium of the oil at a configuration (nq,) and state (k,)."""
        q_a = q[self.machine.closure.active][self._active_indices]
        positions = (q_a - self._lower_limits).tolist()
        return OilEquilibrium(self.circuit, state, positions, self._initial_pressures)

    def _sample_signals(self, time: float, q_a: Array, v_a: Array, pressures: Array) -> Array:
        """Signals (s,) of a sampled law."""
        inputs = self.inputs_at(time, q_a, v_a, self._current_state)._replace(
            settings=self.command.settings.tolist(),
            reference=self.command.references(np.array([time]))[0].tolist(),
        )
        return np.array(self.command.signals(inputs), dtype=np.float64)

    def references(self, times: Array) -> Array:
        """See `ControlLaw`; the signals are those at the spools, after their dead times."""
        samples = self._signal_source.references(times)
        for delay in np.unique(self.delays[self.delays > 0]):
            delayed = np.flatnonzero(self.delays == delay)
            samples[:, delayed] = self._signal_source.references(times - delay)[:, delayed]
        return samples

    def commanded_signals(self, times: Array) -> Array:
        """Signals (N, s) [V] of an open-loop command at times (N,), before the dead times."""
        if not self.period:
            return self._signal_source.references(times)[:, : len(self.delays)]
        return np.vstack(
            [self._signal_source.references(times[i : i + 1]) for i in range(len(times))]
        )[:, : len(self.delays)]

    def breaks(self) -> Array:
        """Times (k,) [s] at which slopes of signals change, before and after the dead times."""
        source: Any = self.command
        if not hasattr(source, "breaks"):
            source = self.reference
        break_lists = [np.asarray(source.breaks())] if hasattr(source, "breaks") else []
        if isinstance(self.command, ValveSignals):
            for i in np.flatnonzero(self.delays):
                break_lists.append(self.command.slope_changes(int(i)) + self.delays[i])
        return np.concatenate([np.zeros(0), *break_lists])

    def next_delayed_jump(self, time: float) -> float:
        """Next instant after a time [s] at which a sampled signal jumps after its dead time."""
        earliest = np.inf
        for delay in np.unique(self.delays[self.delays > 0]) if self.period else ():
            jump = max(np.floor((time - delay) / self.period) + 1.0, 1.0) * self.period + delay
            earliest = min(earliest, jump if jump > time else jump + self.period)
        return earliest

    def law(self, inputs: ControllerInputs) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """See `ControlLaw`."""
        circuit_values, _ = self._evaluate_circuit(inputs)
        forces: list[Scalar] = [0.0] * len(self.machine.active)
        for i, force in zip(self._active_indices, circuit_values.forces, strict=True):
            forces[i] = force
        return forces, circuit_values.state_rates

    def circuit_friction(self, inputs: ControllerInputs) -> list[Scalar]:
        """Circuit friction of the joints `Hydraulics.circuit_friction_joints` [N], [N m]."""
        friction_joints = self.circuit.hydraulics.circuit_friction_joints
        if not friction_joints:
            return []
        circuit_values, _ = self._evaluate_circuit(inputs)
        friction = zip(self.circuit.joints, circuit_values.circuit_friction, strict=True)
        return [force for joint, force in friction if joint in friction_joints]

    def void_distances(self, inputs: ControllerInputs) -> list[Scalar]:
        """States of the pressures [`_VOID_UNIT`] that turn negative where a void forms.

        The compliance of these chambers jumps there; that of a floating chamber does not.
        """
        rigid_valves = zip(
            self.circuit.cylinder_state_starts, self.circuit.cylinders_and_valves, strict=True
        )
        return [
            inputs.state[start + side] * (1.0 / _VOID_UNIT)
            for start, (_, valve, _) in rigid_valves
            for side in range(2)
            if not valve.float_from > 0
        ]

    def channel_values(self, inputs: ControllerInputs) -> list[Scalar]:
        """Values of `channels`."""
        return [value for *_, value in self._evaluate_channels(inputs)]

    @cached_property
    def channels(self) -> tuple[tuple[str, str], ...]:
        """Names and units of the recorded channels."""
        home = self.machine.home[self.machine.closure.active]
        inputs = self.inputs_at(0.0, home, 0.0 * home, np.zeros(self.circuit.state_count))
        return tuple((name, unit) for name, unit, _ in self._evaluate_channels(inputs))

    def _evaluate_channels(self, inputs: ControllerInputs) -> list[tuple[str, str, Scalar]]:
        """Names, units and values of the recorded channels."""
        values, signals = self._evaluate_circuit(inputs)
        circuit, out = self.circuit.hydraulics, list[tuple[str, str, Scalar]]()
        pairs = iter(zip(signals, values.spool_positions, strict=True))
        for (joint, valve), chambers in zip(circuit.valves.items(), values.chambers, strict=True):
            first, *second = (
                [(f"voltage_{name}", "V", signal), (f"spool_{name}", "", u)]
                for name, (signal, u) in zip(valve.spools, pairs, strict=False)
            )
            out += first
            sides = list(zip("ab", chambers, strict=True))
            out += [(f"pressure_{joint}_{side}", "Pa", x.pressure) for side, x in sides]
            out += [(f"flow_{joint}_{side}", "m3/s", x.hose_flow) for side, x in sides]
            out += itertools.chain(*second)
        out.append(("pressure_supply", "Pa", values.supply_pressure))
        out.append(("pressure_tank", "Pa", values.tank_pressure))
        out += [
            (name, unit, value)
            for (name, unit), value in zip(
                self.circuit.state_units.items(), inputs.state, strict=False
            )
            if name.startswith(_RECORDED_STATE_PREFIXES)
        ]
        nodes = (*circuit.supplies, *circuit.lines, *circuit.accumulators)
        out += [(f"pressure_{name}", "Pa", values.pressures[name]) for name in nodes]
        for name, pump in values.pumps.items():
            out += [(f"share_{name}", "", pump.share), (f"shaft_{name}", "W", pump.shaft_power)]
        if circuit.engine is not None and values.pumps:
            speed = values.engine_speed_ratio * circuit.engine.speed
            out.append(("engine_speed", "rad/s", speed))
        of_command = zip(self.command.channels, inputs.reference[len(self.delays) :], strict=False)
        return [*out, *((name, unit, value) for (name, unit), value in of_command)]

    def _evaluate_circuit(
        self, inputs: ControllerInputs
    ) -> tuple[CircuitValues, Sequence[Scalar]]:
        """The circuit, and the signals at its valves; kept for the inputs that were last given."""
        known_inputs, *known = self._last_evaluation
        if inputs is known_inputs:
            return known[0], known[1]
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
        self._last_evaluation = inputs, circuit_values, signals
        return circuit_values, signals
