"""Where the power of several runs goes, beside each other: systems, machines, settings."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from crane.common.errors import InputError
from crane.common.result import Result
from crane.common.samples import Array, as_number
from crane.common.units import format_quantity
from crane.hydraulics.power_balance import SHAFT_POWER
from crane.studies.hydraulic_power_balance import (
    POWER_CLASSES,
    PowerBalance,
    part_class,
    part_kind,
)

_MIN_TABLE_SHARE = 1e-3  # share of the largest run's energy that a table tells


@dataclass(frozen=True, eq=False, repr=False)
class PowerComparison(Result):
    """Power accounts of runs that do the same work, in another time or on another system.

    Attributes:
        balances: By what the runs are called, two at least.
        moved_mass: Mass that each of them moves [kg], as earth; None if not told.

    Raises:
        InputError: There are fewer than two, or the mass is not above 0.
    """

    balances: Mapping[str, PowerBalance]
    moved_mass: float | None = None

    def __post_init__(self) -> None:
        if len(self.balances) < 2:
            raise InputError("one run has nothing to be compared with, give two at least")
        if self.moved_mass is not None:
            as_number(self.moved_mass, "the mass that is moved", "kg", greater_than=0)

    def _one_line(self) -> str:
        """What the shafts gave in each run."""
        shaft_works = {run: balance.totals[SHAFT_POWER] for run, balance in self.balances.items()}
        work_texts = ", ".join(
            f"{run} {format_quantity(work, 'J', 4)}" for run, work in shaft_works.items()
        )
        return f"PowerComparison of the shafts' work: {work_texts}"

    def energy_by_class(self, run: str) -> dict[str, float]:
        """Energy of a run by `POWER_CLASSES` [J], whose sum is the energy of the shafts."""
        energies = dict.fromkeys(POWER_CLASSES, 0.0)
        for name, energy in self.balances[run].energies.items():
            if part_kind(name) != SHAFT_POWER:
                energies[part_class(self.balances[run], name)] += energy
        return energies

    def shaft_power_over_time(self, run: str) -> tuple[Array, Array]:
        """Times (N,) from the first sample [s], and power of the shafts (N,) [W]."""
        balance = self.balances[run]
        return balance.time - balance.time[0], balance.shaft_power

    def to_markdown(self) -> str:
        """Time, energy, peak and fuel of each run, and what its energy goes into."""
        rows = [["", *self.balances], ["---", *["---:"] * len(self.balances)]]
        all_balances = self.balances.values()
        energies = [balance.totals[SHAFT_POWER] for balance in all_balances]
        rows.append(["time [s]", *(f"{x.time[-1] - x.time[0]:.2f}" for x in all_balances)])
        rows.append(["work of the shafts [kJ]", *(f"{1e-3 * x:.1f}" for x in energies)])
        rows.append(
            [
                "mean of them [kW]",
                *(f"{1e-3 * x.mean_power(x.shaft_power):.1f}" for x in all_balances),
            ]
        )
        rows.append(
            ["peak of them [kW]", *(f"{1e-3 * x.shaft_power.max():.1f}" for x in all_balances)]
        )
        if any(x.fuel_mass is not None for x in all_balances):
            fuels = [x.fuel_mass for x in all_balances]
            rows.append(["fuel [g]", *("" if x is None else f"{1e3 * x:.1f}" for x in fuels)])
            volumes = [x.fuel_volume for x in all_balances]
            rows.append(["fuel [ml]", *("" if x is None else f"{1e6 * x:.1f}" for x in volumes)])
        if self.moved_mass is not None:
            rows.append(
                [f"work per kg of {self.moved_mass:g} [J/kg]"]
                + [f"{x / self.moved_mass:.0f}" for x in energies]
            )
        energies_by_run = [self.energy_by_class(run) for run in self.balances]
        min_energy = _MIN_TABLE_SHARE * max(np.abs(energies))
        for name in POWER_CLASSES:
            values = [class_energies[name] for class_energies in energies_by_run]
            if max(map(abs, values)) > min_energy:
                rows.append([f"{name} [kJ]", *(f"{1e-3 * x:z.1f}" for x in values)])
        text = "".join(f"| {' | '.join(row)} |\n" for row in rows)
        return text + "\nwhat is less than 0.1 % of the largest work is left out\n"
