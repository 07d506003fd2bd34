"""The table that a study results in."""

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.errors import InputError, known
from crane.common.output import replacing
from crane.common.samples import Array
from crane.common.shown import Brief

_MORE_IS_BETTER = ("reach", "range", "highest")


@dataclass(frozen=True, eq=False, repr=False)
class Study(Brief):
    """Measures of V variants of a machine.

    Attributes:
        machine: What `crane.load` takes.
        parameters: Names of the parameters that vary.
        measures: Names of the measures, those over all tasks.
        tasks: Names of the tasks.
        units: Unit of every column but the last, empty for a share.
        columns: By name (V,): parameters, measures, and where there are several tasks "MEASURE
            TASK" for each of them. NaN where a variant could not be measured. SI units.
        reasons: Why a variant could not be measured, or "".
        grid: Numbers of values of the parameters, whose last one varies fastest; () if drawn.
        notes: How fine measures are that are not exact.
    """

    machine: str
    parameters: tuple[str, ...]
    measures: tuple[str, ...]
    tasks: tuple[str, ...]
    units: Mapping[str, str]
    columns: Mapping[str, Array]
    reasons: tuple[str, ...]
    grid: tuple[int, ...]
    notes: tuple[str, ...] = ()

    def _line(self) -> str:
        """What varies, and what is measured."""
        failed = sum(map(bool, self.reasons))
        return (
            f"Study of {self.machine}: {len(self)} variants of {', '.join(self.parameters)}, "
            f"{failed} not measured; {', '.join(self.measures)}"
        )

    @property
    def rows(self) -> list[dict[str, float | str]]:
        """One dictionary per variant, with its "reason"."""
        return [
            {**{name: float(values[i]) for name, values in self.columns.items()}, "reason": reason}
            for i, reason in enumerate(self.reasons)
        ]

    def __len__(self) -> int:
        return len(self.reasons)

    def order(self, measure: str) -> list[int]:
        """Variants from best to worst, without those that could not be measured.

        The least is best, of reach, range, highest and upper strokes the largest; of expressions
        the least comes first.

        Raises:
            InputError: There is no such measure.
        """
        if measure not in self.columns or measure in self.parameters:
            names = [name for name in self.columns if name not in self.parameters]
            raise InputError(f"measure '{measure}' is not in the study, {known(names, measure)}")
        values = self.columns[measure]
        more = measure in _MORE_IS_BETTER or (
            measure.isidentifier() and measure.startswith("upper_")
        )
        keys = -values if more else values
        able = [i for i in range(len(self)) if np.isfinite(values[i])]
        return sorted(able, key=lambda i: keys[i])

    def best(self, measure: str) -> dict[str, float | str]:
        """The best row, see `order`.

        Raises:
            InputError: There is no such measure, or no variant has it.
        """
        order = self.order(measure)
        if not order:
            raise InputError(f"no variant has '{measure}', the first: {self.reasons[0]}")
        return self.rows[order[0]]

    def to_csv(self, path: str | Path) -> None:
        """Write the table: a column each with its unit, the reason last, empty cells for NaN.

        Raises:
            OutputError: The file cannot be written.
        """
        header = [f"{name} [{self.units[name] or '1'}]" for name in self.columns]
        with replacing(path) as part, part.open("w", newline="", encoding="utf-8") as file:
            file.write(f"# machine: {self.machine}\n")
            file.writelines(f"# note: {note}\n" for note in self.notes)
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow([*header, "reason"])
            for row in self.rows:
                writer.writerow(["" if value != value else value for value in row.values()])

    def to_text(self, most: int = 10) -> str:
        """The best rows by the first measure, for reading; the best one is marked.

        Of an expression the least comes first, unmarked: nobody knows which is best.
        """
        shown = [*self.parameters, *self.measures[:5]]
        titles = [f"{name} [{unit}]" if (unit := self.units[name]) else name for name in shown]
        order, known = self.order(self.measures[0]), self.measures[0].isidentifier()
        lines = [titles]
        for i in order[:most]:
            lines.append([f"{self.columns[name][i]:.6g}" for name in shown])
        widths = [max(len(line[k]) for line in lines) for k in range(len(shown))]
        text = [
            ("* " if row == 1 and known else "  ")
            + "  ".join(word.rjust(width) for word, width in zip(line, widths, strict=True))
            for row, line in enumerate(lines)
        ]
        failed = [reason for reason in self.reasons if reason]
        summary = f"{len(self)} variants, {'best' if known else 'least'} {self.measures[0]} first"
        if failed:
            summary += f"; {len(failed)} cannot be measured, the first: {failed[0]}"
        return "\n".join([*(text if order else []), summary, *self.notes])
