"""Result of a design optimization: its solutions, tables and charts."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.one_line_repr import OneLineRepr
from crane.common.result import Result
from crane.common.samples import Array
from crane.formats.machine_loading import MachineVariants
from crane.machine.machine import Machine
from crane.ratings.lifting_capacity import Capacity, capacity
from crane.recordings.timeseries import Table, write_table
from crane.studies.optimization.variant_measures import MeasureOptions


@dataclass(frozen=True, eq=False)
class DesignSolution(OneLineRepr):
    """Solution of one search.

    Attributes:
        initial_values: (k,) parameters at the start.
        values: (k,) parameters at the end.
        objectives: (m,) values of the objectives, with the signs of their expressions.
        slacks: (r,) slack of each requirement, -|A - B| for "A == B"; it fails below 0.
        is_feasible: Whether all requirements hold.
        message: Termination message.
    """

    initial_values: Array
    values: Array
    objectives: Array
    slacks: Array
    is_feasible: bool
    message: str


@dataclass(frozen=True, eq=False, repr=False)
class Design(Result):
    """Result of a design optimization.

    Attributes:
        machine: The machine before the optimization.
        parameter_names: Parameters that vary.
        lower: (k,) lower bounds.
        upper: (k,) upper bounds.
        objectives: Objectives, "minimise ..." or "maximise ...".
        requirements: Requirements as given.
        initial: The machine's own parameters, as a solution.
        solutions: Solutions of all starts, best first; with several objectives those of the
            Pareto front, by the first objective.
        options: Options of the measures.
    """

    machine: Machine
    parameter_names: tuple[str, ...]
    lower: Array
    upper: Array
    objectives: tuple[str, ...]
    requirements: tuple[str, ...]
    initial: DesignSolution
    solutions: tuple[DesignSolution, ...]
    options: MeasureOptions

    def _one_line(self) -> str:
        values = ", ".join(f"{x:.6g}" for x in self.solutions[0].objectives)
        return f"Design of {self.machine.name} for {'; '.join(self.objectives)}: {values}"

    def parameter_changes(self, k: int = 0) -> dict[str, float]:
        """Return the parameters of a solution by name, as `crane.load` takes them."""
        return {
            **self.machine.parameter_changes,
            **dict(zip(self.parameter_names, self.solutions[k].values.tolist(), strict=True)),
        }

    def variant(self, k: int = 0) -> Machine:
        """Return the machine of a solution."""
        return MachineVariants(self.machine).machine(self.parameter_changes(k))

    def capacity_charts(self, k: int = 0) -> tuple[Capacity, Capacity] | None:
        """Return load charts before and with a solution; None if no objective is a load."""
        if not any("load(" in text for text in (*self.objectives, *self.requirements)):
            return None
        initial_chart, optimized_chart = (
            capacity(machine, self.options.frame, rule=self.options.rule)
            for machine in (self.machine, self.variant(k))
        )
        return initial_chart, optimized_chart

    def to_markdown(self) -> str:
        """Return parameters and objectives before and after, and a table of all solutions."""
        best = self.solutions[0]
        labels = [f"`{name}`" for name in self.parameter_names]
        slack_labels = [f"slack of {x}" for x in self.requirements]
        compared = (
            *zip(labels, self.initial.values, best.values, strict=True),
            *zip(self.objectives, self.initial.objectives, best.objectives, strict=True),
            *zip(slack_labels, self.initial.slacks, best.slacks, strict=True),
        )
        lines = [
            f"# Design of {self.machine.name}\n",
            *(f"- {objective}" for objective in self.objectives),
            *(f"- require {text}" for text in self.requirements),
            "",
            "| | before | after |",
            "| --- | ---: | ---: |",
            *(f"| {title} | {before:.6g} | {after:.6g} |" for title, before, after in compared),
        ]
        ends = zip(self.parameter_names, best.values, self.lower, self.upper, strict=True)
        at_bounds = [name for name, x, a, b in ends if min(x - a, b - x) < 1e-6 * (b - a)]
        if at_bounds:
            lines.append(f"\nAt a bound of their range: {', '.join(at_bounds)}.")
        order = "Pareto front" if len(self.objectives) > 1 else "best first, by start"
        columns = [*self.objectives, *labels]
        lines += [
            "",
            f"{len(self.solutions)} solutions, {order}:",
            "",
            f"| {' | '.join([*columns, 'requirements', 'termination'])} |",
            f"| {' | '.join(['---:'] * len(columns) + ['---'] * 2)} |",
        ]
        for x in self.solutions:
            cells = [f"{value:.6g}" for value in (*x.objectives, *x.values)]
            cells += ["hold" if x.is_feasible else "fail", x.message]
            lines.append(f"| {' | '.join(cells)} |")
        return "\n".join([*lines, ""])

    def to_csv(self, path: str | Path) -> None:
        """Write one row per solution: parameters, objectives, slacks, feasibility.

        Raises:
            OutputError: The file cannot be written.
        """
        units = {name: "1" for name in self.parameter_names}
        units |= {f"goal_{i}": "1" for i in range(len(self.objectives))}
        units |= {f"slack_{i}": "1" for i in range(len(self.requirements))} | {"fits": "1"}
        rows = [
            [*x.values, *x.objectives, *x.slacks, float(x.is_feasible)] for x in self.solutions
        ]
        notes = {"machine": self.machine.load_expression}
        notes |= {f"goal_{i}": text for i, text in enumerate(self.objectives)}
        notes |= {f"slack_{i}": text for i, text in enumerate(self.requirements)}
        write_table(path, Table(units, np.array(rows), notes))
