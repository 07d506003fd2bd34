"""Where the power of several runs goes, beside each other: systems, machines, settings."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array, as_number
from crane.common.shown import Brief
from crane.common.units import quantity
from crane.hydraulics.powers import SHAFT
from crane.studies.power import CLASSES, PowerAccount, class_of, what_of

_TOLD = 1e-3  # share of the largest run's energy that a table tells


@dataclass(frozen=True, eq=False, repr=False)
class PowerComparison(Brief):
    """Power accounts of runs that do the same work, in another time or on another system.

    Attributes:
        accounts: By what the runs are called, two at least.
        moved: Mass that each of them moves [kg], as earth; None if not told.

    Raises:
        InputError: There are fewer than two, or the mass is not above 0.
    """

    accounts: Mapping[str, PowerAccount]
    moved: float | None = None

    def __post_init__(self) -> None:
        if len(self.accounts) < 2:
            raise InputError("one run has nothing to be compared with, give two at least")
        if self.moved is not None:
            as_number(self.moved, "the mass that is moved", "kg", above=0)

    def _line(self) -> str:
        """What the shafts gave in each run."""
        works = {run: account.totals[SHAFT] for run, account in self.accounts.items()}
        words = ", ".join(f"{run} {quantity(work, 'J', 4)}" for run, work in works.items())
        return f"PowerComparison of the shafts' work: {words}"

    def classes(self, run: str) -> dict[str, float]:
        """Energy of a run by what it goes into, see `CLASSES` [J]; their sum is the shafts'."""
        found = dict.fromkeys(CLASSES, 0.0)
        for name, energy in self.accounts[run].energies.items():
            if what_of(name) != SHAFT:
                found[class_of(self.accounts[run], name)] += energy
        return found

    def over_time(self, run: str) -> tuple[Array, Array]:
        """Times (N,) from the first sample [s], and power of the shafts (N,) [W]."""
        account = self.accounts[run]
        return account.time - account.time[0], account.shaft

    def to_markdown(self) -> str:
        """Time, energy, peak and fuel of each run, and what its energy goes into."""
        rows = [["", *self.accounts], ["---", *["---:"] * len(self.accounts)]]
        every = self.accounts.values()
        energies = [account.totals[SHAFT] for account in every]
        rows.append(["time [s]", *(f"{x.time[-1] - x.time[0]:.2f}" for x in every)])
        rows.append(["work of the shafts [kJ]", *(f"{1e-3 * x:.1f}" for x in energies)])
        rows.append(["mean of them [kW]", *(f"{1e-3 * x.mean(x.shaft):.1f}" for x in every)])
        rows.append(["peak of them [kW]", *(f"{1e-3 * x.shaft.max():.1f}" for x in every)])
        if any(x.fuel is not None for x in every):
            fuels = [x.fuel for x in every]
            rows.append(["fuel [g]", *("" if x is None else f"{1e3 * x:.1f}" for x in fuels)])
            volumes = [x.fuel_volume for x in every]
            rows.append(["fuel [ml]", *("" if x is None else f"{1e6 * x:.1f}" for x in volumes)])
        if self.moved is not None:
            rows.append(
                [f"work per kg of {self.moved:g} [J/kg]"]
                + [f"{x / self.moved:.0f}" for x in energies]
            )
        by_run = [self.classes(run) for run in self.accounts]
        least = _TOLD * max(np.abs(energies))
        for name in CLASSES:
            values = [one[name] for one in by_run]
            if max(map(abs, values)) > least:
                rows.append([f"{name} [kJ]", *(f"{1e-3 * x:z.1f}" for x in values)])
        text = "".join(f"| {' | '.join(row)} |\n" for row in rows)
        return text + "\nwhat is less than 0.1 % of the largest work is left out\n"
