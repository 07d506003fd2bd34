"""The power account of a hydraulic run: what the pumps' shafts give, and where all of it goes."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.codegen import Program, Tape
from crane.common.errors import RecordingError, known
from crane.common.samples import Array
from crane.common.shown import Brief
from crane.common.units import quantity
from crane.control import Signals, ValveDrive
from crane.description import Friction
from crane.description.sensors import VELOCITY
from crane.dynamics import Dynamics
from crane.hydraulics import Circuit, Engine
from crane.hydraulics.powers import ROD, SHAFT, STORED, powers_of
from crane.hydraulics.sources import MAIN
from crane.machine import Machine
from crane.recordings import Recording
from crane.recordings.missing import check_there
from crane.recordings.timeseries import TIME, check_unit, write_columns

DIESEL = 840.0  # [kg/m3]
LOAD, JOINT_FRICTION, _GRIP = "load", "friction", "grip"
# What an owner's power goes into, in the order in which it is told.
PARTS = (
    SHAFT, "friction", "slip", "relief", "bypass", "element", "inlet", "compensator", "outlet",
    "regeneration", "leak", "refill", "damper", "cooling", LOAD, *STORED,
)  # fmt: skip
CLASSES = (  # what belongs together of that
    LOAD, "friction", "outlet", "inlet", "compensator", "leaks and relief", "pump", "elements",
    "stored",
)  # fmt: skip
_CLASSES = {
    "friction": "friction", "damper": "friction", "outlet": "outlet", "float": "outlet",
    "inlet": "inlet", "regeneration": "inlet", "compensator": "compensator",
    "leak": "leaks and relief", "relief": "leaks and relief", "refill": "leaks and relief",
    "element": "elements", "cooling": "elements", LOAD: LOAD, "stored": "stored",
    "spring": "stored",
}  # fmt: skip
_TOLD = 1e-4  # share of the shafts' energy that a table tells
_HEAD = ("item", "energy [kJ]", "share", "back [kJ]", "mean [kW]", "peak [kW]")


@dataclass(frozen=True, eq=False, repr=False)
class PowerAccount(Brief):
    """Power of every part of a circuit over time, and energies over the recording.

    Parts are called OWNER.WHAT, the owner being a pump, joint, line, accumulator, element or the
    tank. `shaft` is what turns a pump (what its line draws, of one that keeps its pressure). All
    others are what that power goes into, so that at every instant

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
        engine: (N,) what it gives [W], that is all shafts where its speed was not recorded; None
            without one.
        fuel: Burnt from the first sample to the last [kg], None where consumption is not known.
        machine: Its name.
        task: What it was doing, "" if not known.
    """

    time: Array
    powers: Mapping[str, Array]
    pumps: tuple[str, ...]
    joints: tuple[str, ...]
    engine: Array | None
    fuel: float | None
    machine: str
    task: str

    def _line(self) -> str:
        """Of what, how long, and what its shafts gave."""
        what = ": ".join(word for word in (self.machine, self.task) if word)
        fuel = "" if self.fuel is None else f", {self.fuel:.4g} kg of fuel"
        return (
            f"PowerAccount of {what or 'a machine'}, {self.time[-1] - self.time[0]:.6g} s: shafts "
            f"{quantity(self.energy(self.shaft), 'J', 4)}{fuel}"
        )

    @property
    def shaft(self) -> Array:
        """(N,) that turns all pumps [W]."""
        return self._sum(name for name in self.powers if what_of(name) == SHAFT)

    @property
    def residual(self) -> Array:
        """(N,) shafts less all others: rounding [W]."""
        return self.shaft - self._sum(name for name in self.powers if what_of(name) != SHAFT)

    @property
    def energies(self) -> dict[str, float]:
        """By part over the recording, by the trapezoidal rule [J]."""
        return {name: self.energy(power) for name, power in self.powers.items()}

    @property
    def totals(self) -> dict[str, float]:
        """Of shafts, losses, loads, and what is stored at the end, over the recording [J]."""
        found = dict.fromkeys((SHAFT, "lost", LOAD, "stored"), 0.0)
        for name, energy in self.energies.items():
            found[kind_of(name)] += energy
        return found

    @property
    def fuel_volume(self) -> float | None:
        """Of the fuel, as diesel of 840 kg/m3 [m3]."""
        return None if self.fuel is None else self.fuel / DIESEL

    def owned(self, owner: str) -> dict[str, Array]:
        """Powers (N,) of one owner by what they are [W]."""
        return {what_of(x): power for x, power in self.powers.items() if owner_of(x) == owner}

    def energy(self, power: Array) -> float:
        """Of a power (N,) over the recording [J]."""
        return float(np.trapezoid(power, self.time))

    def mean(self, power: Array) -> float:
        """Of a power (N,) over the recording [W]."""
        span = float(self.time[-1] - self.time[0])
        return self.energy(power) / span if span else float(power[0])

    def to_csv(self, path: str | Path) -> None:
        """Write all powers over time, whole or not at all.

        Raises:
            OutputError: It cannot be written there.
        """
        columns = dict(self.powers) | ({} if self.engine is None else {"engine": self.engine})
        units = {TIME: "s"} | dict.fromkeys(columns, "W")
        notes = {"crane power account": "", "machine": self.machine, "task": self.task}
        notes = {key: text for key, text in notes.items() if text or key.startswith("crane")}
        write_columns(path, units, [self.time, *columns.values()], notes)

    def to_markdown(self) -> str:
        """Energies, means and peaks by part, totals, and fuel."""
        rows = [_HEAD, ("---",) + ("---:",) * (len(_HEAD) - 1)]
        least = _TOLD * self.energy(np.abs(self.shaft))
        told = [x for x in self.powers if self.energy(np.abs(self.powers[x])) > least]
        rows += [self._row(f"{owner_of(x)}: {what_of(x)}", [x]) for x in told]
        kinds = {SHAFT: "all shafts", "lost": "all losses", LOAD: "all loads",
                 "stored": "all that is stored"}  # fmt: skip
        for kind, words in kinds.items():
            rows.append(self._row(f"**{words}**", [x for x in self.powers if kind_of(x) == kind]))
        if self.engine is not None:
            rows.append(self._cells("**engine**", self.engine))
        text = "".join(f"| {' | '.join(row)} |\n" for row in rows)
        text += (
            f"\n{self.time[-1] - self.time[0]:.6g} s; share of what the shafts give; back is what "
            "of it was negative, as where a load drives its cylinder; peaks are sizes; parts of "
            "less than 0.01 % are left out.\n"
        )
        if self.fuel is not None:
            volume = 1e6 * self.fuel / DIESEL
            text += f"fuel: {self.fuel:.4g} kg, {volume:.4g} ml of diesel ({DIESEL:g} kg/m3)\n"
        return text

    def _sum(self, names: Iterable[str]) -> Array:
        return sum((self.powers[name] for name in names), np.zeros_like(self.time))

    def _row(self, words: str, names: Sequence[str]) -> tuple[str, ...]:
        return self._cells(words, self._sum(names))

    def _cells(self, words: str, power: Array) -> tuple[str, ...]:
        energy, given = self.energy(power), self.energy(self.shaft)
        back = self.energy(np.maximum(-power, 0.0))
        share = f"{100 * energy / given:z.1f} %" if given > 0 else ""
        figures = (back, self.mean(power), float(np.abs(power).max()))
        return (words, f"{1e-3 * energy:z.3f}", share, *(f"{1e-3 * x:z.3f}" for x in figures))


def owner_of(name: str) -> str:
    """Of a part, `X_lift` of `X_lift.inlet`."""
    return name.rpartition(".")[0]


def what_of(name: str) -> str:
    """Of a part, `inlet` of `X_lift.inlet`."""
    return name.rpartition(".")[2]


def kind_of(name: str) -> str:
    """Which total a part belongs to: "shaft", "load", "stored", or "lost"."""
    what = what_of(name)
    return "stored" if what in STORED else what if what in (SHAFT, LOAD) else "lost"


def class_of(account: PowerAccount, name: str) -> str:
    """What a part belongs to that is not a shaft, of `CLASSES`."""
    what = what_of(name)
    if owner_of(name) in account.pumps and what != "stored":
        return "pump"
    return _CLASSES[what]


def power_account(machine: Machine, recording: Recording) -> PowerAccount:
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
    there = recording.columns()
    measured = f"shaft_{MAIN}" not in there and f"pressure_{MAIN}" in there
    given = np.zeros(1)
    drive = ValveDrive(machine, Signals(machine, [0.0], {}, given if measured else None))
    circuit, parts = drive.circuit, drive.circuit.hydraulics
    _check_joints(machine, recording)
    m = len(circuit.joints)
    lower = drive.settings[len(circuit.numbers) :][:m]
    columns = _Columns(recording, circuit, machine)
    columns.check()
    x = np.column_stack([there[joint] for joint in circuit.joints]) - lower
    v = np.column_stack([there[joint + VELOCITY] for joint in circuit.joints])
    state = [columns.state(name) for name in circuit.states]
    around = columns.given() if measured else []
    rows = np.column_stack([x, v, *state, *columns.signals(), *around])
    names, values = _evaluated(circuit, rows)
    powers = dict(zip(names, values.T, strict=True))
    grips = {joint: powers.pop(f"{joint}.{_GRIP}") for joint in circuit.joints}
    friction = _friction(machine, recording, grips)
    for i, joint in enumerate(circuit.joints):
        rod = powers.pop(f"{joint}.{ROD}")
        lost = friction[joint] * v[:, i]
        powers |= {f"{joint}.{JOINT_FRICTION}": lost, f"{joint}.{LOAD}": rod - lost}
    pumps = tuple(parts.sources)
    order = list(dict.fromkeys([*pumps, *circuit.joints, *map(owner_of, powers)]))
    names = sorted(powers, key=lambda x: (order.index(owner_of(x)), PARTS.index(what_of(x))))
    shaft = sum(power for x, power in powers.items() if what_of(x) == SHAFT)
    given_by, fuel = None, None
    if parts.engine is not None:
        speed = there.get("engine_speed") if "engine" in circuit.states else None
        given_by = shaft if speed is None else _engine(parts.engine, speed)
        if parts.engine.fuel:
            burning = parts.engine.idle + parts.engine.fuel * given_by
            fuel = float(np.trapezoid(burning, recording.time))
    return PowerAccount(
        recording.time, {name: powers[name] for name in names}, pumps, circuit.joints, given_by,
        fuel, machine.name, recording.task,
    )  # fmt: skip


def _engine(engine: Engine, speed: Array) -> Array:
    """(N,) power of its governor at speeds (N,) [rad/s]."""
    share = np.clip((engine.speed + engine.speed_droop - speed) / engine.speed_droop, 0.0, 1.0)
    return np.asarray(engine.torque * share * speed)


def _check_joints(machine: Machine, recording: Recording) -> None:
    missing = [joint for joint in machine.active if joint not in recording.joints]
    if missing:
        listed = ", ".join(f"'{joint}'" for joint in missing)
        raise RecordingError(
            f"{listed} of '{machine.name}' not recorded, {known(recording.joints)}"
        )
    for joint in machine.active:
        check_unit(joint, recording.units[joint], [machine.unit(joint)])


def _friction(
    machine: Machine, recording: Recording, grips: Mapping[str, Array]
) -> dict[str, Array]:
    """(N,) of the active joints [N], [N m]; `grips` are of seals and brakes."""
    names = {joint: f"friction_{joint}" for joint in machine.active}
    if all(name in recording.channels for name in names.values()):
        return {joint: recording.channels[name] for joint, name in names.items()}
    order = [recording.joints.index(joint) for joint in machine.active]
    v = recording.v[:, order]
    own = Dynamics(machine).friction(recording.q[:, order], v)
    found = dict(zip(machine.active, own.T, strict=True))
    for joint, grip in grips.items():
        law, rate = machine.friction.get(joint, Friction()), v[:, machine.active.index(joint)]
        sign = np.tanh(rate / law.smoothing) if law.smoothing else np.sign(rate)
        found[joint] = found[joint] + grip * sign
    return found


class _Columns:
    """What a recording has of a circuit's states.

    Args:
        recording: The recording.
        circuit: Its circuit.
        machine: Whose it is.
    """

    def __init__(self, recording: Recording, circuit: Circuit, machine: Machine):
        self._recording, self._circuit, self._machine = recording, circuit, machine
        self._there = recording.channels
        self._spools = circuit.hydraulics.spools

    def check(self) -> None:
        """See that all channels are there, in their units.

        Raises:
            RecordingError: The message names all that are not.
        """
        try:
            check_there(self._needs(), self._there)
        except RecordingError as error:
            raise RecordingError(
                f"{error} (power_account needs what a simulation on valves records)"
            ) from None
        units = self._circuit.states | {"engine_speed": "rad/s", "pressure_tank": "Pa"}
        for name, unit in self._recording.channel_units.items():
            if name in units and unit:
                check_unit(name, unit, [units[name]])

    def _needs(self) -> Iterator[tuple[str, ...]]:
        for name in self._circuit.states:
            if name.startswith(("pressure_", "spring_", "share_", "oil_")):
                yield (name,)
            elif name == "engine":
                yield ("engine_speed",)
        for name, spool in self._spools.items():
            plain = not spool.bandwidth and not spool.hysteresis and not spool.delay
            yield (f"spool_{name}", f"voltage_{name}") if plain else (f"spool_{name}",)

    def state(self, name: str) -> Array:
        """(N,) of one state: s = p - p_vapour of a pressure."""
        word, _, owner = name.partition("_")
        oil = self._circuit.hydraulics.oil
        if name == "engine":
            engine = self._circuit.hydraulics.engine
            assert engine is not None
            return self._there["engine_speed"] / engine.speed
        if word == "pressure":
            return self._there[name] - oil.vapour_pressure
        if name.startswith("spool_rate_") or word == "load":
            return np.zeros_like(self._recording.time)  # no flow depends on it, given the share
        return self._spool(owner) if word in ("play", "spool") else self._there[name]

    def signals(self) -> list[Array]:
        """(N,) of each spool [V], at which it would stand as recorded."""
        return [
            spool.neutral + (spool.full - spool.neutral) * self._spool(name)
            for name, spool in self._spools.items()
        ]

    def _spool(self, name: str) -> Array:
        if (u := self._there.get(f"spool_{name}")) is not None:
            return u
        spool = self._spools[name]
        return (self._there[f"voltage_{name}"] - spool.neutral) / (spool.full - spool.neutral)

    def given(self) -> list[Array]:
        """(N,) pressures of supply and tank [Pa]."""
        usual = np.full_like(self._recording.time, self._circuit.hydraulics.supply.tank)
        return [self._there[f"pressure_{MAIN}"], self._there.get("pressure_tank", usual)]


def _evaluated(circuit: Circuit, rows: Array) -> tuple[list[str], Array]:
    """Names (k,) and values (N, k) of powers and grips at rows (N, .).

    A row has x, v, states, signals and given pressures.
    """

    def build(program: Program) -> None:
        tape, m, taken = Tape(), len(circuit.joints), 0
        given = []
        for count in (m, m, circuit.stiff, len(circuit.spools), 2 if circuit.measured else 0):
            given.append(tape.loads(0, taken, count))
            taken += count
        now = circuit.at(circuit.numbers.tolist(), *given)
        powers = powers_of(circuit, now, given[1])
        for joint, grip in zip(circuit.joints, now.grips, strict=True):
            powers[f"{joint}.{_GRIP}"] = grip
        program.add("powers", 1, {name: [power] for name, power in powers.items()})
        size = program.outputs("powers").size
        with program.routine("along", counts=("count",), arrays=("rows", "out")) as r:
            with r.loop(r.count) as i:
                r.call("powers", r.rows.row(i, taken), r.out.row(i, size))
            r.give(r.count)

    depends = "power account", repr(circuit.hydraulics), circuit.numbers, circuit.measured
    program = Program.kept(depends, build)
    layout = program.outputs("powers")
    out = np.empty((len(rows), layout.size))
    program.call("along", len(rows), np.ascontiguousarray(rows), out)
    return list(layout.parts), out
