"""How much sway a motion leaves, by method and payload."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.errors import InputError
from crane.common.one_line_repr import OneLineRepr, format_count
from crane.common.progress import progress_reporter
from crane.common.samples import Array, as_number
from crane.common.text_tables import format_table
from crane.control import ValveFeedforward, fastest_trajectory
from crane.formats import load
from crane.machine import Machine
from crane.motion.sway import Sway
from crane.motion.sway_suppression import SWAY_METHODS
from crane.motion.task_trajectories import task_trajectory
from crane.simulation import simulate

_OBSERVATION_TIME = 10.0  # [s] after the motion
_STEP = 1e-2  # [s]
DEFAULT_DAMPING_RATIO = 0.2

Progress = Callable[[float], None]


@dataclass(frozen=True)
class SwayRow:
    """What one motion leaves.

    Attributes:
        payload: [kg].
        method: Of `suppress_sway`.
        damping: Damping ratio that the feedback of sway asks for, 0 without.
        duration: The shortest that the flow allows [s].
        relative_duration: That over the duration without any method.
        residual_sway: The largest sway in 10 s after it, of all free joints together (root of the
            sum of squares) [rad].
        relative_reduction: By which share that is less than without any method.
    """

    payload: float
    method: str
    damping: float
    duration: float
    relative_duration: float
    residual_sway: float
    relative_reduction: float

    @property
    def label(self) -> str:
        """The method in words."""
        return f"{self.method}, damped" if self.damping else self.method


@dataclass(frozen=True, repr=False)
class SwayStudy(OneLineRepr):
    """Sway that a task leaves through the valves.

    Attributes:
        task: Its name.
        rows: By payload, then by method.
    """

    task: str
    rows: tuple[SwayRow, ...]

    def _one_line(self) -> str:
        """Its task, and what leaves the least sway."""
        best_row = min(self.rows, key=lambda row: row.residual_sway)
        return (
            f"SwayStudy of '{self.task}': {format_count(len(self.rows), 'motion')}, the least "
            f"sway "
            f"{np.degrees(best_row.residual_sway):.3g} deg by {best_row.label}"
        )

    def to_text(self) -> str:
        """A table."""
        heading = ("payload", "method", "duration", "against none", "residual sway", "less")
        cells = [heading] + [
            (
                f"{row.payload:g} kg",
                row.label,
                f"{row.duration:.2f} s",
                f"{row.relative_duration:.3f}",
                f"{np.degrees(row.residual_sway):.3f} deg",
                f"{100 * row.relative_reduction:.1f} %",
            )
            for row in self.rows
        ]
        return "\n".join(format_table(cells, left_aligned=(0, 1)))


def sway_study(
    machine: str | Path,
    task: str,
    payloads: Sequence[float] = (0.0, 100.0, 200.0, 300.0, 400.0, 500.0),
    damping: float = DEFAULT_DAMPING_RATIO,
    changes: Mapping[str, float] | None = None,
    progress: Progress | None = None,
) -> SwayStudy:
    """Sway that a task leaves, with and without each method, as fast as the flow allows.

    Every motion is run through the valves by `ValveFeedforward`, in the shortest time that the
    circuit has the flow for (`fastest`). The sway is that of the free joints against where they
    hang still.

    Args:
        machine: What `load` takes; with free joints and a circuit.
        task: From rest to rest.
        payloads: [kg].
        damping: Damping ratio that the feedback of sway asks for; 0 for none.
        changes: Further parameters.
        progress: Is told the share that is done.

    Raises:
        CraneError: As `load`, `fastest` and `simulate`.
    """
    progress = progress_reporter(progress)
    if not payloads:
        raise InputError("no payloads, give some masses [kg]")
    rows: list[SwayRow] = []
    finished_count, total_count = 0, len(payloads) * len(SWAY_METHODS) * (1 + (damping > 0))
    for mass in payloads:
        payload_mass = as_number(mass, "the payload", "kg")
        payload_changes = {
            **(changes or {}),
            **({"payload.mass": payload_mass} if payload_mass else {}),
        }
        loaded_machine = load(machine, changes=payload_changes)
        reference, reference_result = task_trajectory(loaded_machine, task), None
        for method in SWAY_METHODS:
            trajectory = fastest_trajectory(loaded_machine, reference, method)
            for ratio in (0.0, damping)[: 1 + (damping > 0)]:
                control = ValveFeedforward(loaded_machine, trajectory, sway=ratio)
                residual = _residual_sway(loaded_machine, control, trajectory.duration)
                if reference_result is None:
                    reference_result = trajectory.duration, residual
                rows.append(
                    SwayRow(
                        payload_mass,
                        method,
                        ratio,
                        trajectory.duration,
                        trajectory.duration / reference_result[0],
                        residual,
                        1.0 - residual / reference_result[1],
                    )
                )
                finished_count += 1
                if progress is not None:
                    progress(finished_count / total_count)
    return SwayStudy(task, tuple(rows))


def _residual_sway(machine: Machine, control: ValveFeedforward, duration: float) -> float:
    """The largest sway after a motion [rad]."""
    start = control.planned_trajectory.position(0.0)
    end_time = _STEP * np.ceil((duration + _OBSERVATION_TIME) / _STEP)
    run = simulate(
        machine, control, initial=(start, np.zeros_like(start)), duration=end_time, step=_STEP
    )
    configurations_after: Array = run.q[run.time >= duration]
    free = ~machine.is_driven
    sway_angles = (
        configurations_after[:, free]
        - Sway(machine).hanging_equilibrium(configurations_after)[:, free]
    )
    return float(np.linalg.norm(sway_angles, axis=1).max())
