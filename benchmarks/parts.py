"""The parts of the referee: what each measures, and its tables."""

from dataclasses import asdict, dataclass
from types import ModuleType
from typing import Any

import bundled_runs
import calls
import calls_over_size
import closing_from_anywhere
import derivatives
import hydraulic_crane
import start_times
import stiff_machines
import work_precision


@dataclass(frozen=True)
class Part:
    """A module with `measure(quick)`, a list of rows, and `tables(rows)`, paragraphs in Markdown.

    Attributes:
        title: Heading of its tables.
        module: Its rows are dictionaries or dataclasses of numbers and texts.
        about: What a reader of its tables has to know.
    """

    title: str
    module: ModuleType
    about: str

    def run(self, quick: bool) -> tuple[list[dict[str, Any]], list[str]]:
        """Measured rows as dictionaries, and the tables."""
        rows = self.module.measure(quick)
        plain = [row if isinstance(row, dict) else asdict(row) for row in rows]
        return plain, self.module.tables(rows)


PARTS = {
    "trajectories": Part(
        "Error against time", work_precision,
        "A time is the least at which an engine has the error of the column, interpolated between "
        "its settings; `-` where it never has. *Loops open* and *energy* are those of the setting "
        "with the least error; energies are given where they are conserved.",
    ),
    "forward_dynamics": Part(
        "Forward dynamics over the number of joints", calls_over_size,
        "Per sample. One call and a stack of crane close the loops first; the closed stack and "
        "the other engines get closed configurations. `mj_forward` gives the accelerations of "
        "soft loops and does not count as best peer.",
    ),
    "hydraulics": Part(
        "Two arms on cylinders", hydraulic_crane,
        "Errors are those of the cylinders' strokes over 6 s against equations by hand.",
    ),
    "stiff": Part(
        "Stiff machines", stiff_machines,
        "Methods of crane and of scipy on crane's equations, 10 s, 10 s and 4 ms of motion. "
        "Errors are in rad and characteristic lengths of the machine.",
    ),
    "runs": Part(
        "Runs of bundled machines", bundled_runs,
        "All with friction; those on valves with pressures, spools and pump.",
    ),
    "calls": Part(
        "Calls from Python", calls,
        "`pin.normalize` shows the overhead of a call in Pinocchio's times.",
    ),
    "derivatives": Part(
        "Derivatives", derivatives,
        "Per sample of a stack, loops closed; Pinocchio's times without the overhead of its calls "
        "from Python. Gradients are exact, of a functional of four outputs.",
    ),
    "starts": Part(
        "Starting", start_times,
        "Wall times depend on what else the computer does.",
    ),
    "closing": Part(
        "Closing random mechanisms", closing_from_anywhere,
        "From random configurations within limits, driven joints held. *One descent* is the "
        "search without a second start; scipy is `least_squares(method=\"trf\")` with bounds, on "
        "the same residual and Jacobian. The search goes on after the first closed configuration, "
        "to find the nearest, and analyses the equations there.",
    ),
}  # fmt: skip
