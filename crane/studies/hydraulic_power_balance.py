"""Power balance of a hydraulic run: power of the pumps' shafts, and what it goes into."""

from collections.abc import Iterator, Mapping

import numpy as np

from crane.codegen import Program, Tape
from crane.common.errors import RecordingError, suggest_names
from crane.common.samples import Array
from crane.control.valve_commands import ValveSignals
from crane.control.valve_drive import ValveDrive
from crane.description.force_elements import Friction
from crane.description.sensors import VELOCITY_SUFFIX
from crane.dynamics.dynamics import Dynamics
from crane.hydraulics.circuit_elements import MAIN_PUMP
from crane.hydraulics.circuit_equations import (
    ROD_POWER,
    SHAFT_POWER,
    CircuitEquations,
    component_powers,
)
from crane.machine.machine import Machine
from crane.recordings.recording import Recording
from crane.recordings.timeseries import check_columns_present, check_unit
from crane.studies.power_balance_result import (
    JOINT_FRICTION,
    LOAD,
    POWER_PARTS,
    PowerBalance,
    part_kind,
    part_owner,
)

_FRICTION_FORCE = "grip"


def power_balance(machine: Machine, recording: Recording) -> PowerBalance:
    """Compute the power balance of a recorded hydraulic run.

    The equations of the circuit are evaluated at every sample. The recording may be simulated or
    measured; it needs the channels of velocities, pressures of all nodes, spools (or voltages of
    valves without inertia and play), compressions of series springs, and for a simulated pump its
    share. If the power of the first pump's shaft is not recorded, the pressure of its line is
    taken as given and the pump delivers the flow that is drawn; the losses of its regulator,
    slip, friction and relief valve are then unknown. The friction of joints is read from the
    channels `friction_X`, or else computed by the laws of the machine.

    Args:
        machine: The recorded machine, with a circuit.
        recording: The recording; `Recording.between` returns a part of one.

    Raises:
        InputError: The machine has no circuit.
        RecordingError: Joints or channels are missing, or in a wrong unit.
    """
    recorded = recording.columns()
    is_measured = f"shaft_{MAIN_PUMP}" not in recorded and f"pressure_{MAIN_PUMP}" in recorded
    drive = ValveDrive(
        machine, ValveSignals(machine, [0.0], {}, np.zeros(1) if is_measured else None)
    )
    circuit, hydraulics = drive.circuit, drive.circuit.hydraulics
    missing = [joint for joint in machine.active if joint not in recording.joints]
    if missing:
        raise RecordingError(
            f"{', '.join(map(repr, missing))} of '{machine.name}' not recorded, "
            f"{suggest_names(recording.joints)}"
        )
    for joint in machine.active:
        check_unit(joint, recording.units[joint], [machine.unit(joint)])
    m = len(circuit.joints)
    lower_limits = drive.settings[len(circuit.constants) :][:m]
    columns = _CircuitColumns(recording, circuit)
    x = np.column_stack([recorded[joint] for joint in circuit.joints]) - lower_limits
    v = np.column_stack([recorded[joint + VELOCITY_SUFFIX] for joint in circuit.joints])
    state_columns = [columns.state_column(name) for name in circuit.state_units]
    signals = [
        spool.neutral + (spool.full - spool.neutral) * columns.spool_position(name)
        for name, spool in hydraulics.spools.items()
    ]
    boundary_pressures = []  # of supply and tank [Pa]
    if is_measured:
        tank_pressure = np.full_like(recording.time, hydraulics.supply.tank)
        boundary_pressures = [
            recorded[f"pressure_{MAIN_PUMP}"], recorded.get("pressure_tank", tank_pressure)
        ]  # fmt: skip
    names, values = _evaluate_powers(
        circuit,
        np.column_stack([x, v, *state_columns, *signals, *boundary_pressures]),
    )
    powers = dict(zip(names, values.T, strict=True))
    friction = _joint_friction(
        machine,
        recording,
        {joint: powers.pop(f"{joint}.{_FRICTION_FORCE}") for joint in circuit.joints},
    )
    for i, joint in enumerate(circuit.joints):
        rod_power = powers.pop(f"{joint}.{ROD_POWER}")
        friction_power = friction[joint] * v[:, i]
        powers |= {
            f"{joint}.{JOINT_FRICTION}": friction_power,
            f"{joint}.{LOAD}": rod_power - friction_power,
        }
    pumps = tuple(hydraulics.pumps)
    owner_order = list(dict.fromkeys([*pumps, *circuit.joints, *map(part_owner, powers)]))
    names = sorted(
        powers, key=lambda x: (owner_order.index(part_owner(x)), POWER_PARTS.index(part_kind(x)))
    )
    shaft = sum(power for x, power in powers.items() if part_kind(x) == SHAFT_POWER)
    engine_power, fuel = None, None
    if hydraulics.engine is not None:
        speed = recorded.get("engine_speed") if "engine" in circuit.state_units else None
        engine, engine_power = hydraulics.engine, shaft
        if speed is not None:  # the governor's torque
            excess = (engine.speed + engine.speed_droop - speed) / engine.speed_droop
            engine_power = np.asarray(engine.torque * np.clip(excess, 0.0, 1.0) * speed)
        if engine.fuel:
            fuel_rate = engine.idle + engine.fuel * engine_power
            fuel = float(np.trapezoid(fuel_rate, recording.time))
    return PowerBalance(
        recording.time,
        {name: powers[name] for name in names},
        pumps,
        circuit.joints,
        engine_power,
        fuel,
        machine.name,
        recording.task,
    )


def _joint_friction(
    machine: Machine, recording: Recording, friction_forces: Mapping[str, Array]
) -> dict[str, Array]:
    """Return the friction (N,) of the active joints [N], [N m].

    Args:
        machine: The machine.
        recording: The recording.
        friction_forces: Coulomb friction (N,) of seals and brakes by joint.
    """
    names = {joint: f"friction_{joint}" for joint in machine.active}
    if all(name in recording.channels for name in names.values()):
        return {joint: recording.channels[name] for joint, name in names.items()}
    order = [recording.joints.index(joint) for joint in machine.active]
    v = recording.v[:, order]
    friction = dict(
        zip(machine.active, Dynamics(machine).friction(recording.q[:, order], v).T, strict=True)
    )
    for joint, friction_force in friction_forces.items():
        law, velocity = machine.friction.get(joint, Friction()), v[:, machine.active.index(joint)]
        sign = np.tanh(velocity / law.smoothing) if law.smoothing else np.sign(velocity)
        friction[joint] = friction[joint] + friction_force * sign
    return friction


class _CircuitColumns:
    """Columns of a recording as states of a circuit.

    Args:
        recording: The recording.
        circuit: The circuit.

    Raises:
        RecordingError: Channels are missing, or in other units.
    """

    def __init__(self, recording: Recording, circuit: CircuitEquations):
        self._circuit, self._channels = circuit, recording.channels
        self._spools, self._none = circuit.hydraulics.spools, np.zeros_like(recording.time)
        try:
            check_columns_present(self._required_columns(), self._channels)
        except RecordingError as error:
            raise RecordingError(
                f"{error} (power_balance needs what a simulation on valves records)"
            ) from None
        units = self._circuit.state_units | {"engine_speed": "rad/s", "pressure_tank": "Pa"}
        for name, unit in recording.channel_units.items():
            if name in units and unit:
                check_unit(name, unit, [units[name]])

    def _required_columns(self) -> Iterator[tuple[str, ...]]:
        for name in self._circuit.state_units:
            if name.startswith(("pressure_", "spring_", "share_", "oil_")):
                yield (name,)
            if name == "engine":
                yield ("engine_speed",)
        for name, spool in self._spools.items():
            is_instantaneous = not spool.bandwidth and not spool.hysteresis and not spool.delay
            yield (f"spool_{name}", f"voltage_{name}") if is_instantaneous else (f"spool_{name}",)

    def state_column(self, name: str) -> Array:
        """Return a state (N,); the state of a pressure is s = p - p_vapour."""
        prefix, _, owner = name.partition("_")
        if name == "engine":
            engine = self._circuit.hydraulics.engine
            assert engine is not None
            return self._channels["engine_speed"] / engine.speed
        if prefix == "pressure":
            return self._channels[name] - self._circuit.hydraulics.oil.vapour_pressure
        if name.startswith("spool_rate_") or prefix == "load":
            return self._none  # no flow depends on it if the share is given
        return self.spool_position(owner) if prefix in ("play", "spool") else self._channels[name]

    def spool_position(self, name: str) -> Array:
        """Return the recorded relative position (N,) of a spool."""
        if (u := self._channels.get(f"spool_{name}")) is not None:
            return u
        spool = self._spools[name]
        return (self._channels[f"voltage_{name}"] - spool.neutral) / (spool.full - spool.neutral)


def _evaluate_powers(circuit: CircuitEquations, rows: Array) -> tuple[list[str], Array]:
    """Return names (k,) and values (N, k) of powers and Coulomb friction at rows (N, .).

    A row has strokes, velocities, states, signals and given pressures.
    """

    def build(program: Program) -> None:
        tape, m, column_count = Tape(), len(circuit.joints), 0
        blocks = []
        for count in (
            m,
            m,
            circuit.stiff_state_count,
            len(circuit.spools),
            2 if circuit.has_measured_pressures else 0,
        ):
            blocks.append(tape.load_vector(0, column_count, count))
            column_count += count
        circuit_values = circuit.evaluate(circuit.constants.tolist(), *blocks)
        powers = component_powers(circuit, circuit_values, blocks[1])
        for joint, friction_force in zip(
            circuit.joints, circuit_values.circuit_friction, strict=True
        ):
            powers[f"{joint}.{_FRICTION_FORCE}"] = friction_force
        program.add_formula("powers", 1, {name: [power] for name, power in powers.items()})
        size = program.formula_outputs("powers").size
        program.add_formula_loop("along", "powers", {"rows": column_count, "out": size})

    dependencies = (
        "power account",
        repr(circuit.hydraulics),
        circuit.constants,
        circuit.has_measured_pressures,
    )
    program = Program.from_cache(dependencies, build)
    layout = program.formula_outputs("powers")
    out = np.empty((len(rows), layout.size))
    program.call("along", len(rows), np.ascontiguousarray(rows), out)
    return list(layout.parts), out
