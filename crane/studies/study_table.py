"""Result of a study: a table of measures by variant."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.atomic_output import write_csv
from crane.common.errors import InputError, check_name
from crane.common.result import Result
from crane.common.samples import Array
from crane.common.units import format_table

_MAXIMIZED_MEASURES = ("reach", "range", "highest")


@dataclass(frozen=True, eq=False, repr=False)
class Study(Result):
    """Measures of V variants of a machine.

    Attributes:
        machine_reference: Argument of `crane.load`.
        parameters: Names of the parameters that vary.
        measures: Names of the measures over all tasks.
        tasks: Names of the tasks.
        units: Unit of every column; empty for a share.
        columns: Values (V,) by name, in SI units: parameters, measures, and with several tasks
            "MEASURE TASK" for each of them. NaN where a variant could not be measured.
        failure_reasons: Reason by variant why it could not be measured, or "".
        grid_shape: Number of values of each parameter, the last one varies fastest; () if drawn.
        resolution_notes: Resolution of measures that are not exact.
    """

    machine_reference: str
    parameters: tuple[str, ...]
    measures: tuple[str, ...]
    tasks: tuple[str, ...]
    units: Mapping[str, str]
    columns: Mapping[str, Array]
    failure_reasons: tuple[str, ...]
    grid_shape: tuple[int, ...]
    resolution_notes: tuple[str, ...] = ()

    def _one_line(self) -> str:
        failed = sum(map(bool, self.failure_reasons))
        return (
            f"Study of {self.machine_reference}: {len(self)} variants of "
            f"{', '.join(self.parameters)}, {failed} not measured; {', '.join(self.measures)}"
        )

    @property
    def rows(self) -> list[dict[str, float | str]]:
        """One dictionary per variant, with its "reason" of failure."""
        return [
            {**{name: float(values[i]) for name, values in self.columns.items()}, "reason": reason}
            for i, reason in enumerate(self.failure_reasons)
        ]

    def __len__(self) -> int:
        return len(self.failure_reasons)

    def rank(self, measure: str) -> list[int]:
        """Return the measured variants from best to worst.

        The smallest value is best; of reach, range, highest and upper strokes the largest.
        Expressions are sorted with the smallest value first.

        Raises:
            InputError: The measure is not in the study.
        """
        names = [name for name in self.columns if name not in self.parameters]
        check_name(measure, names, f"measure '{measure}' is not in the study")
        values = self.columns[measure]
        is_maximized = measure in _MAXIMIZED_MEASURES or (
            measure.isidentifier() and measure.startswith("upper_")
        )
        keys = -values if is_maximized else values
        measured_indices = [i for i in range(len(self)) if np.isfinite(values[i])]
        return sorted(measured_indices, key=lambda i: keys[i])

    def best_row(self, measure: str) -> dict[str, float | str]:
        """Return the best row, see `rank`.

        Raises:
            InputError: The measure is not in the study, or no variant has a value.
        """
        ranking = self.rank(measure)
        if not ranking:
            raise InputError(f"no variant has '{measure}', the first: {self.failure_reasons[0]}")
        return self.rows[ranking[0]]

    def to_csv(self, path: str | Path) -> None:
        """Write the table: one column per name with its unit, reason last, empty cells for NaN.

        Raises:
            OutputError: The file cannot be written.
        """
        notes = (f"note: {note}" for note in self.resolution_notes)
        rows = [["" if x != x else x for x in row.values()] for row in self.rows]
        heads = study_headings(self.columns, self.units)
        write_csv(path, [heads, *rows], [f"machine: {self.machine_reference}", *notes])

    def to_text(self, max_rows: int = 10) -> str:
        """Return the best rows by the first measure as text; the best one is marked.

        Rows of an expression are sorted, smallest first, without a mark, because the better
        direction is not known.
        """
        shown_columns = [*self.parameters, *self.measures[:5]]
        titles = [
            f"{name} [{unit}]" if (unit := self.units[name]) else name for name in shown_columns
        ]
        ranking, has_preferred_direction = (
            self.rank(self.measures[0]),
            self.measures[0].isidentifier(),
        )
        cells = [
            [f"{self.columns[name][i]:.6g}" for name in shown_columns] for i in ranking[:max_rows]
        ]
        text = [
            ("* " if row == 1 and has_preferred_direction else "  ") + line
            for row, line in enumerate(format_table([titles, *cells], left_aligned=()))
        ]
        failed = [reason for reason in self.failure_reasons if reason]
        summary = (
            f"{len(self)} variants, {'best' if has_preferred_direction else 'least'} "
            f"{self.measures[0]} first"
        )
        if failed:
            summary += f"; {len(failed)} cannot be measured, the first: {failed[0]}"
        return "\n".join([*(text if ranking else []), summary, *self.resolution_notes])


def study_headings(columns: Iterable[str], units: Mapping[str, str]) -> list[str]:
    """Return the headings of the table of a study."""
    return [*(f"{name} [{units[name] or '1'}]" for name in columns), "reason"]
