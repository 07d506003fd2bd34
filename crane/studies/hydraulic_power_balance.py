"""The power account of a hydraulic run: what the pumps' shafts give, and where all of it goes."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.codegen import Program, Tape
from crane.common.errors import RecordingError, suggest_names
from crane.common.result import Result
from crane.common.samples import Array
from crane.common.units import format_quantity
from crane.control import ValveDrive, ValveSignals
from crane.description import Friction
from crane.description.sensors import VELOCITY_SUFFIX
from crane.dynamics import Dynamics
from crane.hydraulics import CircuitEquations, Engine
from crane.hydraulics.circuit_elements import MAIN_PUMP
from crane.hydraulics.power_balance import ROD_POWER, SHAFT_POWER, STORED_POWERS, component_powers
from crane.machine import Machine
from crane.recordings import Recording
from crane.recordings.missing_measurements import check_columns_present
from crane.recordings.timeseries import TIME, check_unit, write_columns

DIESEL_DENSITY = 840.0  # [kg/m3]
LOAD, JOINT_FRICTION, _FRICTION_FORCE = "load", "friction", "grip"
# What an owner's power goes into, in the order in which it is told.
POWER_PARTS = (
    SHAFT_POWER,
    "friction",
    "slip",
    "relief",
    "bypass",
    "element",
    "inlet",
    "compensator",
    "outlet",
    "regeneration",
    "leak",
    "refill",
    "damper",
    "cooling",
    LOAD,
    *STORED_POWERS,
)
POWER_CLASSES = (  # what belongs together of that
    LOAD, "friction", "outlet", "inlet", "compensator", "leaks and relief", "pump", "elements",
    "stored",
)  # fmt: skip
_CLASS_OF_PART = {
    "friction": "friction", "damper": "friction", "outlet": "outlet", "float": "outlet",
    "inlet": "inlet", "regeneration": "inlet", "compensator": "compensator",
    "leak": "leaks and relief", "relief": "leaks and relief", "refill": "leaks and relief",
    "element": "elements", "cooling": "elements", LOAD: LOAD, "stored": "stored",
    "spring": "stored",
}  # fmt: skip
_MIN_TABLE_SHARE = 1e-4  # share of the shafts' energy that a table tells
_TABLE_HEADING = ("item", "energy [kJ]", "share", "back [kJ]", "mean [kW]", "peak [kW]")


@dataclass(frozen=True, eq=False, repr=False)
class PowerBalance(Result):
    """Power of every part of a circuit over time, and energies over the recording.

    Parts are called OWNER.WHAT, the owner being a pump, joint, line, accumulator, element or the
    tank. `shaft_power` is what turns a pump (what its line draws, of one that keeps its pressure).
    All others are what that power goes into, so that at every instant

        sum of the shafts = sum of all others.

    | what | of | power |
    |---|---|---|
    | friction | pump | its torque losses and drag |
    | slip, relief, bypass | pump | Q (p - p_tank) of leak, relief valve, open centres |
    | inlet | joint | Q times the drop at the edge that meters, or at all where none follows |
    | compensator | joint | Q times the rest of the drop from pump to chamber |
    | outlet, refill | joint | Q times the drop, with load holding and cushion |
    | regeneration | joint | from B to A |
    | leak, relief | joint | to the tank, and from one chamber to the other |
    | damper | joint | heat in the damper of a series spring |
    | friction | joint | its friction times its velocity |
    | load | joint | F v less that: what moves and lifts; negative where it drives the cylinder |
    | element | element | Q times the drop |
    | cooling | accumulator | heat that leaves its gas |
    | stored, spring | chambers, lines, gas, tank | p times the oil that comes in; springs |

    The tank's oil counts at the tank's pressure like that of any node.

    Attributes:
        time: (N,) [s].
        powers: (N,) [W] by part.
        pumps: Their names.
        joints: Those with a cylinder.
        engine_power: (N,) what it gives [W], that is all shafts where its speed was not recorded;
            None without one.
        fuel_mass: Burnt from the first sample to the last [kg], None where consumption is not
            known.
        machine_name: Its name.
        task_name: What it was doing, "" if not known.
    """

    time: Array
    powers: Mapping[str, Array]
    pumps: tuple[str, ...]
    joints: tuple[str, ...]
    engine_power: Array | None
    fuel_mass: float | None
    machine_name: str
    task_name: str

    def _one_line(self) -> str:
        """Of what, how long, and what its shafts gave."""
        subject = ": ".join(text for text in (self.machine_name, self.task_name) if text)
        fuel = "" if self.fuel_mass is None else f", {self.fuel_mass:.4g} kg of fuel"
        return (
            f"PowerBalance of {subject or 'a machine'}, {self.time[-1] - self.time[0]:.6g} s: "
            f"shafts "
            f"{format_quantity(self.integrate_energy(self.shaft_power), 'J', 4)}{fuel}"
        )

    @property
    def shaft_power(self) -> Array:
        """(N,) that turns all pumps [W]."""
        return self._total_power(name for name in self.powers if part_kind(name) == SHAFT_POWER)

    @property
    def residual(self) -> Array:
        """(N,) shafts less all others: rounding [W]."""
        return self.shaft_power - self._total_power(
            name for name in self.powers if part_kind(name) != SHAFT_POWER
        )

    @property
    def energies(self) -> dict[str, float]:
        """By part over the recording, by the trapezoidal rule [J]."""
        return {name: self.integrate_energy(power) for name, power in self.powers.items()}

    @property
    def totals(self) -> dict[str, float]:
        """Of shafts, losses, loads, and what is stored at the end, over the recording [J]."""
        totals_by_kind = dict.fromkeys((SHAFT_POWER, "lost", LOAD, "stored"), 0.0)
        for name, energy in self.energies.items():
            totals_by_kind[part_total(name)] += energy
        return totals_by_kind

    @property
    def fuel_volume(self) -> float | None:
        """Of the fuel, as diesel of 840 kg/m3 [m3]."""
        return None if self.fuel_mass is None else self.fuel_mass / DIESEL_DENSITY

    def owner_powers(self, owner: str) -> dict[str, Array]:
        """Powers (N,) of one owner by what they are [W]."""
        return {part_kind(x): power for x, power in self.powers.items() if part_owner(x) == owner}

    def integrate_energy(self, power: Array) -> float:
        """Of a power (N,) over the recording [J]."""
        return float(np.trapezoid(power, self.time))

    def mean_power(self, power: Array) -> float:
        """Of a power (N,) over the recording [W]."""
        duration = float(self.time[-1] - self.time[0])
        return self.integrate_energy(power) / duration if duration else float(power[0])

    def to_csv(self, path: str | Path) -> None:
        """Write all powers over time, whole or not at all.

        Raises:
            OutputError: It cannot be written there.
        """
        columns = dict(self.powers) | (
            {} if self.engine_power is None else {"engine": self.engine_power}
        )
        units = {TIME: "s"} | dict.fromkeys(columns, "W")
        notes = {"crane power account": "", "machine": self.machine_name, "task": self.task_name}
        notes = {key: text for key, text in notes.items() if text or key.startswith("crane")}
        write_columns(path, units, [self.time, *columns.values()], notes)

    def to_markdown(self) -> str:
        """Energies, means and peaks by part, totals, and fuel."""
        rows = [_TABLE_HEADING, ("---",) + ("---:",) * (len(_TABLE_HEADING) - 1)]
        min_energy = _MIN_TABLE_SHARE * self.integrate_energy(np.abs(self.shaft_power))
        listed_parts = [
            x for x in self.powers if self.integrate_energy(np.abs(self.powers[x])) > min_energy
        ]
        rows += [self._table_row(f"{part_owner(x)}: {part_kind(x)}", [x]) for x in listed_parts]
        total_labels = {SHAFT_POWER: "all shafts", "lost": "all losses", LOAD: "all loads",
                 "stored": "all that is stored"}  # fmt: skip
        for total_kind, label in total_labels.items():
            rows.append(
                self._table_row(
                    f"**{label}**", [x for x in self.powers if part_total(x) == total_kind]
                )
            )
        if self.engine_power is not None:
            rows.append(self._table_cells("**engine**", self.engine_power))
        text = "".join(f"| {' | '.join(row)} |\n" for row in rows)
        text += (
            f"\n{self.time[-1] - self.time[0]:.6g} s; share of what the shafts give; back is what "
            "of it was negative, as where a load drives its cylinder; peaks are sizes; parts of "
            "less than 0.01 % are left out.\n"
        )
        if self.fuel_mass is not None:
            volume = 1e6 * self.fuel_mass / DIESEL_DENSITY
            text += (
                f"fuel: {self.fuel_mass:.4g} kg, {volume:.4g} ml of diesel ({DIESEL_DENSITY:g} "
                f"kg/m3)\n"
            )
        return text

    def _total_power(self, names: Iterable[str]) -> Array:
        return sum((self.powers[name] for name in names), np.zeros_like(self.time))

    def _table_row(self, label: str, names: Sequence[str]) -> tuple[str, ...]:
        return self._table_cells(label, self._total_power(names))

    def _table_cells(self, label: str, power: Array) -> tuple[str, ...]:
        energy, shaft_energy = (
            self.integrate_energy(power),
            self.integrate_energy(self.shaft_power),
        )
        returned_energy = self.integrate_energy(np.maximum(-power, 0.0))
        share = f"{100 * energy / shaft_energy:z.1f} %" if shaft_energy > 0 else ""
        figures = (returned_energy, self.mean_power(power), float(np.abs(power).max()))
        return (label, f"{1e-3 * energy:z.3f}", share, *(f"{1e-3 * x:z.3f}" for x in figures))


def part_owner(name: str) -> str:
    """Of a part, `X_lift` of `X_lift.inlet`."""
    return name.rpartition(".")[0]


def part_kind(name: str) -> str:
    """Of a part, `inlet` of `X_lift.inlet`."""
    return name.rpartition(".")[2]


def part_total(name: str) -> str:
    """Which total a part belongs to: "shaft", "load", "stored", or "lost"."""
    kind = part_kind(name)
    return "stored" if kind in STORED_POWERS else kind if kind in (SHAFT_POWER, LOAD) else "lost"


def part_class(balance: PowerBalance, name: str) -> str:
    """What a part belongs to that is not a shaft, of `POWER_CLASSES`."""
    kind = part_kind(name)
    if part_owner(name) in balance.pumps and kind != "stored":
        return "pump"
    return _CLASS_OF_PART[kind]


def power_balance(machine: Machine, recording: Recording) -> PowerBalance:
    """Where the power of a hydraulic run goes, from what was recorded.

    The circuit's formulas are evaluated anew at every sample, so it takes simulations as well as
    measurements, as far as they have the channels: velocities, pressures of all nodes, spools (or
    voltages of valves without inertia and play), compressions of series springs, and of a pump
    that was simulated its share. Where the power that turns the first pump is not recorded, its
    line's pressure is taken as it is, and the pump gives what is drawn: what its own regulator,
    slip, friction and relief valve take is not told then. Friction of joints is that of the
    channels `friction_X`, or else the machine's.

    Args:
        machine: What was recorded, with a circuit.
        recording: Of it; `Recording.between` has a part.

    Raises:
        InputError: The machine has no circuit.
        RecordingError: Joints or channels are missing, or in a wrong unit.
    """
    recorded = recording.columns()
    is_measured = f"shaft_{MAIN_PUMP}" not in recorded and f"pressure_{MAIN_PUMP}" in recorded
    given_pressures = np.zeros(1)
    drive = ValveDrive(
        machine, ValveSignals(machine, [0.0], {}, given_pressures if is_measured else None)
    )
    circuit, hydraulics = drive.circuit, drive.circuit.hydraulics
    _check_joints(machine, recording)
    m = len(circuit.joints)
    lower_limits = drive.settings[len(circuit.constants) :][:m]
    columns = _CircuitColumns(recording, circuit, machine)
    columns.check_channels()
    x = np.column_stack([recorded[joint] for joint in circuit.joints]) - lower_limits
    v = np.column_stack([recorded[joint + VELOCITY_SUFFIX] for joint in circuit.joints])
    state_columns = [columns.state_column(name) for name in circuit.state_units]
    boundary_pressures = columns.boundary_pressures() if is_measured else []
    rows = np.column_stack([x, v, *state_columns, *columns.signal_columns(), *boundary_pressures])
    names, values = _evaluate_powers(circuit, rows)
    powers = dict(zip(names, values.T, strict=True))
    friction_forces = {joint: powers.pop(f"{joint}.{_FRICTION_FORCE}") for joint in circuit.joints}
    friction = _joint_friction(machine, recording, friction_forces)
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
        engine_power = shaft if speed is None else _engine_power(hydraulics.engine, speed)
        if hydraulics.engine.fuel:
            fuel_rate = hydraulics.engine.idle + hydraulics.engine.fuel * engine_power
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


def _engine_power(engine: Engine, speed: Array) -> Array:
    """(N,) power of its governor at speeds (N,) [rad/s]."""
    torque_share = np.clip(
        (engine.speed + engine.speed_droop - speed) / engine.speed_droop, 0.0, 1.0
    )
    return np.asarray(engine.torque * torque_share * speed)


def _check_joints(machine: Machine, recording: Recording) -> None:
    missing = [joint for joint in machine.active if joint not in recording.joints]
    if missing:
        listed = ", ".join(f"'{joint}'" for joint in missing)
        raise RecordingError(
            f"{listed} of '{machine.name}' not recorded, {suggest_names(recording.joints)}"
        )
    for joint in machine.active:
        check_unit(joint, recording.units[joint], [machine.unit(joint)])


def _joint_friction(
    machine: Machine, recording: Recording, friction_forces: Mapping[str, Array]
) -> dict[str, Array]:
    """(N,) of the active joints [N], [N m]; `friction_forces` are of seals and brakes."""
    names = {joint: f"friction_{joint}" for joint in machine.active}
    if all(name in recording.channels for name in names.values()):
        return {joint: recording.channels[name] for joint, name in names.items()}
    order = [recording.joints.index(joint) for joint in machine.active]
    v = recording.v[:, order]
    law_friction = Dynamics(machine).friction(recording.q[:, order], v)
    friction = dict(zip(machine.active, law_friction.T, strict=True))
    for joint, friction_force in friction_forces.items():
        law, velocity = machine.friction.get(joint, Friction()), v[:, machine.active.index(joint)]
        sign = np.tanh(velocity / law.smoothing) if law.smoothing else np.sign(velocity)
        friction[joint] = friction[joint] + friction_force * sign
    return friction


class _CircuitColumns:
    """What a recording has of a circuit's states.

    Args:
        recording: The recording.
        circuit: Its circuit.
        machine: Whose it is.
    """

    def __init__(self, recording: Recording, circuit: CircuitEquations, machine: Machine):
        self._recording, self._circuit, self._machine = recording, circuit, machine
        self._channels = recording.channels
        self._spools = circuit.hydraulics.spools

    def check_channels(self) -> None:
        """See that all channels are there, in their units.

        Raises:
            RecordingError: The message names all that are not.
        """
        try:
            check_columns_present(self._required_columns(), self._channels)
        except RecordingError as error:
            raise RecordingError(
                f"{error} (power_balance needs what a simulation on valves records)"
            ) from None
        units = self._circuit.state_units | {"engine_speed": "rad/s", "pressure_tank": "Pa"}
        for name, unit in self._recording.channel_units.items():
            if name in units and unit:
                check_unit(name, unit, [units[name]])

    def _required_columns(self) -> Iterator[tuple[str, ...]]:
        for name in self._circuit.state_units:
            if name.startswith(("pressure_", "spring_", "share_", "oil_")):
                yield (name,)
            elif name == "engine":
                yield ("engine_speed",)
        for name, spool in self._spools.items():
            is_instantaneous = not spool.bandwidth and not spool.hysteresis and not spool.delay
            yield (f"spool_{name}", f"voltage_{name}") if is_instantaneous else (f"spool_{name}",)

    def state_column(self, name: str) -> Array:
        """(N,) of one state: s = p - p_vapour of a pressure."""
        prefix, _, owner = name.partition("_")
        oil = self._circuit.hydraulics.oil
        if name == "engine":
            engine = self._circuit.hydraulics.engine
            assert engine is not None
            return self._channels["engine_speed"] / engine.speed
        if prefix == "pressure":
            return self._channels[name] - oil.vapour_pressure
        if name.startswith("spool_rate_") or prefix == "load":
            return np.zeros_like(self._recording.time)  # no flow depends on it, given the share
        return self._spool_position(owner) if prefix in ("play", "spool") else self._channels[name]

    def signal_columns(self) -> list[Array]:
        """(N,) of each spool [V], at which it would stand as recorded."""
        return [
            spool.neutral + (spool.full - spool.neutral) * self._spool_position(name)
            for name, spool in self._spools.items()
        ]

    def _spool_position(self, name: str) -> Array:
        if (u := self._channels.get(f"spool_{name}")) is not None:
            return u
        spool = self._spools[name]
        return (self._channels[f"voltage_{name}"] - spool.neutral) / (spool.full - spool.neutral)

    def boundary_pressures(self) -> list[Array]:
        """(N,) pressures of supply and tank [Pa]."""
        default_tank_pressure = np.full_like(
            self._recording.time, self._circuit.hydraulics.supply.tank
        )
        return [
            self._channels[f"pressure_{MAIN_PUMP}"],
            self._channels.get("pressure_tank", default_tank_pressure),
        ]


def _evaluate_powers(circuit: CircuitEquations, rows: Array) -> tuple[list[str], Array]:
    """Names (k,) and values (N, k) of powers and grips at rows (N, .).

    A row has x, v, states, signals and given pressures.
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
        with program.add_routine("along", counts=("count",), arrays=("rows", "out")) as r:
            with r.loop(r.count) as i:
                r.call("powers", r.rows.row_pointer(i, column_count), r.out.row_pointer(i, size))
            r.return_value(r.count)

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
