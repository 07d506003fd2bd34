"""The parts of the referee: what each measures, and its tables."""

from dataclasses import asdict, dataclass
from types import ModuleType
from typing import Any

import bundled_runs
import c_steps
import calls
import calls_over_size
import closing_from_anywhere
import cost_of_use
import derivatives
import drives
import inverse_dynamics
import start_times
import stiff_machines
import valve_crane
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
    "inverse_dynamics": Part(
        "Inverse dynamics over the number of joints", inverse_dynamics,
        "Per sample. No other engine has inverse dynamics of loops: theirs is that of the tree, "
        "projected with the constraint Jacobian. One call and a stack of crane close the loops "
        "first; all others get closed motions.",
    ),
    "hydraulics": Part(
        "Hydraulics, friction and stops", drives,
        "Errors of strokes against equations by hand or closed forms; *by hand* is scipy on the "
        "same equations in Python, which is what one writes without a simulator.",
    ),
    "valve_crane": Part(
        "A crane on its valves", valve_crane,
        "20 s of `patu655` under levers, against crane itself with a tolerance of 1e-11; shares "
        "of the time.",
    ),
    "costs": Part(
        "Set-up, calls, memory and lines of code", cost_of_use,
        "Set-up from the file to the first step, with an empty cache and with what a first "
        "process left; memory at the peak of the process; lines that a user writes.",
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
    "c_steps": Part(
        "Steps in C", c_steps,
        "`crane export --to c` by compilers of this computer, over the package's machine code, in "
        "turns. That uses all instructions of the processor, C only with `-march=native`.",
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
