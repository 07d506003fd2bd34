"""Drive of a machine that is linearized: forces, or a circuit with valves."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from crane.codegen import Program, Scalar, SymbolicExpression, Tape
from crane.codegen.differentiation import differentiate
from crane.codegen.symbolic import subtract_vectors
from crane.common.samples import Array
from crane.control.control_law import ControllerInputs
from crane.control.valve_commands import ValveSignals
from crane.control.valve_drive import ValveDrive
from crane.dynamics.dynamics import Dynamics
from crane.dynamics.joint_force_formulas import friction_sign
from crane.dynamics.joint_forces import JointForces
from crane.hydraulics.circuit_states import BALANCE_UNITS
from crane.machine.machine import Machine
from crane.recordings.recording import FORCE_UNITS
from crane.simulation.integration.machine_formulas import controller_settings, raise_undetermined

_MIN_OPENING = 1e-6  # share of the spool stroke beyond the dead band


class LinearizedDrive:
    """Forces of a linearized machine with their states and inputs: free forces, or a circuit.

    Attributes:
        state_units: Names and units of the states of the drive.
        input_units: Names and units of its inputs.
        output_units: Names and units of further outputs.
        initial_states: (k,) states where the machine stands still.
        vapour_pressure: Pressure of a circuit at which its pressure states are 0 [Pa].
        initial_inputs: (m,) inputs where the machine stands still.
    """

    def __init__(
        self,
        machine: Machine,
        dynamics: Dynamics,
        q: Array,
        valves: bool,
        pressures: Mapping[str, tuple[float, float]] | None,
    ):
        n = self._mobility = len(machine.active)
        self.state_units: dict[str, str] = {}
        self.input_units = {
            f"{joint}_force": FORCE_UNITS[machine.unit(joint)]
            for joint, driven in zip(machine.active, machine.is_driven, strict=True)
            if driven
        }
        self.output_units: dict[str, str] = {}
        self.initial_states, self.initial_inputs = np.zeros(0), np.zeros(len(self.input_units))
        self.scales, self.vapour_pressure, self._engine_droop = np.zeros(0), 0.0, 0.0
        self._valve_drive: Any = None  # a `ValveDrive`
        self._input_matrix = np.eye(n)[:, machine.is_driven]
        if valves:
            control = ValveDrive(machine, ValveSignals(machine, [0.0], {}), pressures)
            self._valve_drive = control
            circuit = control.circuit
            self.state_units = dict(circuit.state_units)
            self._state_count, self.scales = (
                circuit.stiff_state_count,
                circuit.scales[: circuit.stiff_state_count],
            )
            engine = circuit.hydraulics.engine
            self._engine_droop = engine.speed_droop / engine.speed if engine is not None else 0.0
            self.vapour_pressure = circuit.hydraulics.oil.vapour_pressure
            self._joint_of_state = {
                name: joint
                for joint, first, last in zip(
                    circuit.joints,
                    circuit.cylinder_state_starts,
                    circuit.cylinder_state_ends,
                    strict=True,
                )
                for name in list(self.state_units)[first:last]
            }
            self.input_units = {f"voltage_{name}": "V" for name in circuit.spools}
            self.output_units = dict(control.channels) | {
                f"{joint}_force": FORCE_UNITS[machine.unit(joint)] for joint in circuit.joints
            }
            self._active_indices = [machine.active.index(joint) for joint in circuit.joints]
            self.initial_states = control.start_closed(dynamics, q)[: self._state_count]
            self.initial_inputs = control.references(np.zeros(1))[0]
            self._program = self._build_program(machine)

    def moving_mask(self, v_a: Array, include_shared: bool) -> Array:
        """(k + m,) whether states and signals belong to moving joints, or to none if shared.

        An underlapped valve, which is never closed, counts as that of a moving joint.
        """
        circuit = self._valve_drive.circuit
        moving = {
            x
            for x, i in zip(circuit.joints, self._active_indices, strict=True)
            if v_a[i] or circuit.hydraulics.valves[x].is_underlapped
        }
        initial_states = [
            self._joint_of_state[name] in moving
            if name in self._joint_of_state
            else include_shared
            for name in self.state_units
        ]
        spools = self._valve_drive.circuit.hydraulics.spools.values()
        return np.asarray([*initial_states, *(spool.joint in moving for spool in spools)])

    def load_bearing_mask(self, forces: Array) -> Any:
        """(k,) whether states are pressures of the chambers that carry forces (n,)."""
        is_load_bearing = np.zeros(len(self.state_units), dtype=bool)
        for i, first in zip(
            self._active_indices, self._valve_drive.circuit.cylinder_state_starts, strict=True
        ):
            is_load_bearing[first + int(forces[i] < 0)] = True
        return is_load_bearing

    def opened_valves(self, v_a: Array, share: float) -> tuple[Array, Array, Array, Array]:
        """States and signals z with valves open by a share of their stroke.

        Returns:
            z (k + m,); its derivatives (k + m, r) by pressures and openings; lower and upper
            bounds (r,) of these, which keep valves open and pumps within their droop.
        """
        hydraulics, names = self._valve_drive.circuit.hydraulics, list(self.state_units)
        supply, k = hydraulics.supply, len(names)
        z = np.concatenate([self.initial_states, self.initial_inputs])
        directions: list[Array] = []
        bounds: list[tuple[float, float]] = []

        line_pressure_indices: dict[str, int] = {}

        def free(name: str, value: float, least: float, most: float) -> None:
            z[at := names.index(name)] = value
            directions.append(np.eye(len(z))[at])
            bounds.append((least - value, most - value))

        for name, pump in self._valve_drive.circuit.pumps.items():
            top = pump.pressure - self.vapour_pressure
            if pump.control == "pressure":
                free(f"pressure_{name}", top - 0.5 * pump.droop, top - pump.droop, top)
            elif pump.control == "load-sensing":  # above the guessed loads
                base = 0.3 * supply.pressure + pump.margin - 0.5 * pump.droop
                free(f"pressure_{name}", base, base - 0.5 * pump.droop, base + 0.5 * pump.droop)
                line_pressure_indices[name] = names.index(f"pressure_{name}")
            else:
                free(f"pressure_{name}", 0.4 * top, 0.0, np.inf)
            if f"share_{name}" in names:
                free(f"share_{name}", 0.5, 0.0, 1.0)
        for name in (*hydraulics.lines, *hydraulics.accumulators):
            free(f"pressure_{name}", z[names.index(f"pressure_{name}")], 0.0, np.inf)
            if f"oil_{name}" in names:
                free(f"oil_{name}", z[names.index(f"oil_{name}")], -np.inf, np.inf)
        if "engine" in names:
            free("engine", 1.0 + 0.5 * self._engine_droop, 1.0, 1.0 + self._engine_droop)
        for i, (joint, valve) in enumerate(hydraulics.valves.items()):
            if not (side := float(np.sign(v_a[self._active_indices[i]]))):
                continue
            for name in (f"pressure_{joint}_a", f"pressure_{joint}_b"):
                free(name, max(z[names.index(name)], 0.3 * supply.pressure), 0.0, np.inf)
                if valve.supply in line_pressure_indices and name.endswith(
                    "a" if side > 0 else "b"
                ):
                    directions[-1][line_pressure_indices[valve.supply]] = 1.0
            dead_band, open_position = (
                valve.dead_band,
                valve.dead_band + share * (1.0 - valve.dead_band),
            )
            direction = np.zeros(len(z))
            for name, spool in valve.spools.items():  # both spools open equally
                opening_ratio = (1.0 - spool.dead_band) / (1.0 - dead_band)
                at = k + self._valve_drive.circuit.spools.index(name)
                direction[at] = side * opening_ratio * (spool.full - spool.neutral)
                spool_position = spool.dead_band + share * (1.0 - spool.dead_band)
                z[at] = spool.neutral + spool_position * side * (spool.full - spool.neutral)
                if f"spool_{name}" in names:
                    at = names.index(f"spool_{name}")
                    direction[at], z[at] = side * opening_ratio, side * spool_position
            directions.append(direction)
            bounds.append((dead_band + _MIN_OPENING - open_position, 1.0 - open_position))
        lower, upper = np.array(bounds).T
        return z, np.array(directions).T, lower, upper

    def _build_program(self, machine: Machine) -> Program:
        control, n, k, m = (
            self._valve_drive,
            self._mobility,
            self._state_count,
            len(self.input_units),
        )
        tape = Tape()
        q_a, v_a, states = (
            tape.load_vector(0, 0, n),
            tape.load_vector(0, n, n),
            tape.load_vector(0, 2 * n, k),
        )
        settings, initial_inputs = (
            controller_settings(control, tape, 1, fold_settings=True),
            tape.load_vector(0, 2 * n + k, m),
        )
        integrals: list[Scalar] = [0.0] * len(BALANCE_UNITS)
        inputs = ControllerInputs(
            q_a,
            v_a,
            [*states, *integrals],
            settings,
            initial_inputs,
            raise_undetermined,
            raise_undetermined,
        )
        tau, rates = control.law(inputs)
        output_units = [*control.channel_values(inputs), *(tau[i] for i in self._active_indices)]
        if friction := control.circuit_friction(inputs):
            # F_K sign(v); 0 for joints at rest
            forces = JointForces(machine)
            friction_forces: list[Scalar] = [0.0] * n
            for column, force in zip(forces.circuit_friction_columns, friction, strict=True):
                i, law = machine.active.index(machine.joints[column]), forces.table[column]
                sign = friction_sign(
                    law.tolist(), v_a[i], column in forces.stick_slip_columns, False
                )
                friction_forces[i] = force * sign
            tau = subtract_vectors(tau, friction_forces)
        values = [*tau, *rates[:k], *output_units]
        variables = [
            x for x in (*q_a, *v_a, *states, *initial_inputs) if isinstance(x, SymbolicExpression)
        ]
        derivative_values = [entry for row in differentiate(values, variables) for entry in row]
        formula_key = [
            x.index if isinstance(x, SymbolicExpression) else float(x)
            for x in (*values, *derivative_values)
        ]
        compiled_closure, key = (
            machine.closure.compiled_closure,
            ("linear drive", repr((tape.operations, formula_key))),
        )

        def build(program: Program) -> None:
            program.add_formula("formula", 2, {"values": values, "slopes": derivative_values})

        return compiled_closure.cached_program(key, build)

    def evaluate(
        self, q_a: Array, v_a: Array, states: Array, inputs: Array
    ) -> tuple[Array, Array]:
        """Forces (n,), rates (k,) and further outputs, and their derivatives by all arguments."""
        n = self._mobility
        if self._valve_drive is None:
            jacobian = np.zeros((n, 2 * n + len(inputs)))
            jacobian[:, 2 * n :] = self._input_matrix
            return self._input_matrix @ inputs, jacobian
        layout = self._program.formula_outputs("formula")
        out = np.empty(layout.size)
        settings = np.ascontiguousarray(self._valve_drive.settings)
        self._program.call("formula", np.concatenate([q_a, v_a, states, inputs]), settings, out)
        values, jacobian = out[layout["values"]], out[layout["slopes"]]
        return values, jacobian.reshape(len(values), -1)
