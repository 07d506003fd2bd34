"""Results of power balances: powers of one run by part, and a comparison of several runs."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.errors import InputError
from crane.common.result import Result
from crane.common.samples import Array, as_number
from crane.common.units import format_quantity
from crane.hydraulics.circuit_equations import SHAFT_POWER, STORED_POWERS
from crane.recordings.timeseries import TIME, write_columns

DIESEL_DENSITY = 840.0  # [kg/m3]
LOAD, JOINT_FRICTION = "load", "friction"
# Parts of an owner's power, in the order of tables.
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
POWER_CLASSES = (  # groups of parts
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
_MIN_TABLE_SHARE = 1e-4  # share of the shafts' energy that a table lists
_MIN_COMPARED_SHARE = 1e-3  # share of the largest run's energy that a comparison lists
_TABLE_HEADING = ("item", "energy [kJ]", "share", "back [kJ]", "mean [kW]", "peak [kW]")


@dataclass(frozen=True, eq=False, repr=False)
class PowerBalance(Result):
    """Power of every part of a circuit over time, and energies over the recording.

    Parts are named OWNER.KIND; the owner is a pump, joint, line, accumulator, element or the tank.
    The kind "shaft" is the power that turns a pump (for a pump with constant pressure, the power
    of the flow that is drawn from its line). The power of the shafts goes into all other parts,
    so that at every instant

        sum of the shafts = sum of all others.

    | kind | owner | power |
    |---|---|---|
    | friction | pump | its torque losses and drag |
    | slip, relief, bypass | pump | Q (p - p_tank) of leak, relief valve, open centres |
    | inlet | joint | Q times the drop at the metering edge, or from pump to chamber |
    | compensator | joint | Q times the rest of the drop from pump to chamber |
    | outlet, refill | joint | Q times the drop, load-holding valves and cushions included |
    | regeneration | joint | from B to A |
    | leak, relief | joint | to the tank, and from one chamber to the other |
    | damper | joint | heat in the damper of a series spring |
    | friction | joint | its friction times its velocity |
    | load | joint | F v minus friction: motion and lifting; negative if it drives the cylinder |
    | element | element | Q times the drop |
    | cooling | accumulator | heat flow from its gas |
    | stored, spring | chambers, lines, gas, tank | p times the net inflow; power of springs |

    The oil of the tank counts at the tank's pressure, as for any node.

    Attributes:
        time: (N,) [s].
        powers: Power (N,) by part [W].
        pumps: Names of the pumps.
        joints: Joints with a cylinder.
        engine_power: (N,) power of the engine [W], the sum of the shafts if its speed was not
            recorded; None without an engine.
        fuel_mass: Fuel burnt during the recording [kg]; None if the consumption is not known.
        machine_name: Name of the machine.
        task_name: Name of the task; "" if not known.
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
        subject = ": ".join(text for text in (self.machine_name, self.task_name) if text)
        fuel = "" if self.fuel_mass is None else f", {self.fuel_mass:.4g} kg of fuel"
        return (
            f"PowerBalance of {subject or 'a machine'}, {self.time[-1] - self.time[0]:.6g} s: "
            f"shafts {format_quantity(self.integrate_energy(self.shaft_power), 'J', 4)}{fuel}"
        )

    @property
    def shaft_power(self) -> Array:
        """(N,) power of all shafts [W]."""
        return self._total_power(SHAFT_POWER)

    @property
    def residual(self) -> Array:
        """(N,) power of the shafts minus all others [W]: rounding errors."""
        return self.shaft_power - sum(map(self._total_power, ("lost", LOAD, "stored")))

    @property
    def energies(self) -> dict[str, float]:
        """Energy by part over the recording, by the trapezoidal rule [J]."""
        return {name: self.integrate_energy(power) for name, power in self.powers.items()}

    @property
    def totals(self) -> dict[str, float]:
        """Energy of shafts, losses, loads and storage over the recording [J]."""
        return {
            total: self.integrate_energy(self._total_power(total))
            for total in (SHAFT_POWER, "lost", LOAD, "stored")
        }

    @property
    def fuel_volume(self) -> float | None:
        """Volume of the fuel as diesel of 840 kg/m3 [m3]."""
        return None if self.fuel_mass is None else self.fuel_mass / DIESEL_DENSITY

    def integrate_energy(self, power: Array) -> float:
        """Return the energy of a power (N,) over the recording [J]."""
        return float(np.trapezoid(power, self.time))

    def mean_power(self, power: Array) -> float:
        """Return the mean of a power (N,) over the recording [W]."""
        duration = float(self.time[-1] - self.time[0])
        return self.integrate_energy(power) / duration if duration else float(power[0])

    def to_csv(self, path: str | Path) -> None:
        """Write all powers over time.

        Raises:
            OutputError: The file cannot be written.
        """
        columns = dict(self.powers) | (
            {} if self.engine_power is None else {"engine": self.engine_power}
        )
        units = {TIME: "s"} | dict.fromkeys(columns, "W")
        notes = {"crane power account": "", "machine": self.machine_name, "task": self.task_name}
        notes = {key: text for key, text in notes.items() if text or key.startswith("crane")}
        write_columns(path, units, [self.time, *columns.values()], notes)

    def to_markdown(self) -> str:
        """Return a table of energies, means and peaks by part, totals, and fuel."""
        rows = [_TABLE_HEADING, ("---",) + ("---:",) * (len(_TABLE_HEADING) - 1)]
        min_energy = _MIN_TABLE_SHARE * self.integrate_energy(np.abs(self.shaft_power))
        listed_parts = [
            x for x in self.powers if self.integrate_energy(np.abs(self.powers[x])) > min_energy
        ]
        rows += [
            self._table_cells(f"{part_owner(x)}: {part_kind(x)}", self.powers[x])
            for x in listed_parts
        ]
        for total, label in {
            SHAFT_POWER: "all shafts",
            "lost": "all losses",
            LOAD: "all loads",
            "stored": "all that is stored",
        }.items():
            rows.append(self._table_cells(f"**{label}**", self._total_power(total)))
        if self.engine_power is not None:
            rows.append(self._table_cells("**engine**", self.engine_power))
        text = "".join(f"| {' | '.join(row)} |\n" for row in rows)
        text += (
            f"\n{self.time[-1] - self.time[0]:.6g} s; shares of the energy of the shafts; back is "
            "the negative part of an energy, for example of a load that drives its cylinder; "
            "peaks are magnitudes; parts of less than 0.01 % are left out.\n"
        )
        if self.fuel_mass is not None:
            volume = 1e6 * self.fuel_mass / DIESEL_DENSITY
            text += (
                f"fuel: {self.fuel_mass:.4g} kg, {volume:.4g} ml of diesel ({DIESEL_DENSITY:g} "
                f"kg/m3)\n"
            )
        return text

    def _total_power(self, total: str) -> Array:
        """Return the power (N,) of all parts of a total, see `part_total`."""
        parts = (power for name, power in self.powers.items() if part_total(name) == total)
        return sum(parts, np.zeros_like(self.time))

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
    """Return the owner of a part: `X_lift` for `X_lift.inlet`."""
    return name.rpartition(".")[0]


def part_kind(name: str) -> str:
    """Return the kind of a part: `inlet` for `X_lift.inlet`."""
    return name.rpartition(".")[2]


def part_total(name: str) -> str:
    """Return the total that a part belongs to: "shaft", "load", "stored" or "lost"."""
    kind = part_kind(name)
    return "stored" if kind in STORED_POWERS else kind if kind in (SHAFT_POWER, LOAD) else "lost"


def part_class(balance: PowerBalance, name: str) -> str:
    """Return the class of a part that is not a shaft, one of `POWER_CLASSES`."""
    kind = part_kind(name)
    if part_owner(name) in balance.pumps and kind != "stored":
        return "pump"
    return _CLASS_OF_PART[kind]


@dataclass(frozen=True, eq=False, repr=False)
class PowerComparison(Result):
    """Power balances of runs that do the same work in different times or on different systems.

    Attributes:
        balances: At least two power balances by name of the run.
        moved_mass: Mass that each run moves, such as earth [kg]; None if not known.

    Raises:
        InputError: There are fewer than two runs, or the mass is not positive.
    """

    balances: Mapping[str, PowerBalance]
    moved_mass: float | None = None

    def __post_init__(self) -> None:
        if len(self.balances) < 2:
            raise InputError("one run has nothing to be compared with, give two at least")
        if self.moved_mass is not None:
            as_number(self.moved_mass, "the moved mass", "kg", greater_than=0)

    def _one_line(self) -> str:
        shaft_works = {run: balance.totals[SHAFT_POWER] for run, balance in self.balances.items()}
        work_texts = ", ".join(
            f"{run} {format_quantity(work, 'J', 4)}" for run, work in shaft_works.items()
        )
        return f"PowerComparison of the shafts' work: {work_texts}"

    def energy_by_class(self, run: str) -> dict[str, float]:
        """Return the energy of a run by `POWER_CLASSES` [J]; the sum is that of the shafts."""
        energies = dict.fromkeys(POWER_CLASSES, 0.0)
        for name, energy in self.balances[run].energies.items():
            if part_kind(name) != SHAFT_POWER:
                energies[part_class(self.balances[run], name)] += energy
        return energies

    def shaft_power_over_time(self, run: str) -> tuple[Array, Array]:
        """Return times (N,) from the first sample [s] and power of the shafts (N,) [W]."""
        balance = self.balances[run]
        return balance.time - balance.time[0], balance.shaft_power

    def to_markdown(self) -> str:
        """Return a table of time, energy, peak and fuel of each run, and its energy by class."""
        runs = self.balances.values()
        energies = [run.totals[SHAFT_POWER] for run in runs]
        rows = [
            ["", *self.balances],
            ["---", *["---:"] * len(runs)],
            ["time [s]", *(f"{run.time[-1] - run.time[0]:.2f}" for run in runs)],
            ["work of the shafts [kJ]", *(f"{1e-3 * x:.1f}" for x in energies)],
            ["mean of them [kW]", *(f"{1e-3 * x.mean_power(x.shaft_power):.1f}" for x in runs)],
            ["peak of them [kW]", *(f"{1e-3 * run.shaft_power.max():.1f}" for run in runs)],
        ]
        if any(run.fuel_mass is not None for run in runs):
            masses, volumes = [x.fuel_mass for x in runs], [x.fuel_volume for x in runs]
            rows += [
                ["fuel [g]", *("" if x is None else f"{1e3 * x:.1f}" for x in masses)],
                ["fuel [ml]", *("" if x is None else f"{1e6 * x:.1f}" for x in volumes)],
            ]
        if self.moved_mass is not None:
            rows.append(
                [f"work per kg of {self.moved_mass:g} [J/kg]"]
                + [f"{x / self.moved_mass:.0f}" for x in energies]
            )
        energies_by_run = [self.energy_by_class(run) for run in self.balances]
        min_energy = _MIN_COMPARED_SHARE * max(np.abs(energies))
        for name in POWER_CLASSES:
            values = [class_energies[name] for class_energies in energies_by_run]
            if max(map(abs, values)) > min_energy:
                rows.append([f"{name} [kJ]", *(f"{1e-3 * x:z.1f}" for x in values)])
        text = "".join(f"| {' | '.join(row)} |\n" for row in rows)
        return text + "\nClasses of less than 0.1 % of the largest work are left out.\n"
