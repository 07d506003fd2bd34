"""Residual sway of a motion, by sway suppression method and payload."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.errors import InputError
from crane.common.one_line_repr import OneLineRepr, format_count
from crane.common.progress import Progress, progress_reporter
from crane.common.samples import Array, as_number
from crane.common.units import format_table
from crane.control.valve_feedforward import ValveFeedforward, fastest_trajectory
from crane.formats.machine_loading import load
from crane.machine.machine import Machine
from crane.motion.sway import SWAY_METHODS, Sway
from crane.motion.task_trajectories import task_trajectory
from crane.simulation.simulation_run import simulate

_OBSERVATION_TIME = 10.0  # after the motion [s]
_STEP = 1e-2  # [s]
DEFAULT_DAMPING_RATIO = 0.2


@dataclass(frozen=True)
class SwayRow:
    """Residual sway of one motion.

    Attributes:
        payload: Mass of the payload [kg].
        method: Method of `suppress_sway`.
        damping: Damping ratio of the sway feedback; 0 without feedback.
        duration: Shortest duration that the flow allows [s].
        relative_duration: Duration over that without any method.
        residual_sway: Largest sway in the 10 s after the motion, root of the sum of squares over
            all free joints [rad].
        relative_reduction: Reduction of the sway, as a share of that without any method.
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
        """Description of the method."""
        return f"{self.method}, damped" if self.damping else self.method


@dataclass(frozen=True, repr=False)
class SwayStudy(OneLineRepr):
    """Residual sway of a task that is driven through the valves.

    Attributes:
        task: Name of the task.
        rows: Results, by payload, then by method.
    """

    task: str
    rows: tuple[SwayRow, ...]

    def _one_line(self) -> str:
        best_row = min(self.rows, key=lambda row: row.residual_sway)
        return (
            f"SwayStudy of '{self.task}': {format_count(len(self.rows), 'motion')}, the least "
            f"sway {np.degrees(best_row.residual_sway):.3g} deg by {best_row.label}"
        )

    def to_text(self) -> str:
        """Return a table of the results."""
        cells = [(("payload", "method", "duration", "against none", "residual sway", "less"))] + [
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
    changes: Mapping[str, float | str] | None = None,
    progress: Progress | None = None,
) -> SwayStudy:
    """Compute the residual sway of a task, with and without each sway suppression method.

    Every motion is driven through the valves by `ValveFeedforward`, in the shortest time that the
    flow of the circuit allows (`fastest_trajectory`). The sway is the deviation of the free joints
    from their hanging equilibrium.

    Args:
        machine: Argument of `load`: a machine with free joints and a circuit.
        task: Name of a task from rest to rest.
        payloads: Masses [kg].
        damping: Damping ratio of the sway feedback; 0 for no feedback.
        changes: Further parameter changes.
        progress: Function that is called with the finished share, 0 to 1.

    Raises:
        CraneError: See `load`, `fastest_trajectory` and `simulate`.
    """
    progress = progress_reporter(progress)
    if not payloads:
        raise InputError("no payloads, give some masses [kg]")
    rows: list[SwayRow] = []
    total_count = len(payloads) * len(SWAY_METHODS) * (1 + (damping > 0))
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
                residual = _residual_sway(
                    loaded_machine,
                    ValveFeedforward(loaded_machine, trajectory, sway=ratio),
                    trajectory.duration,
                )
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
                progress(len(rows) / total_count)
    return SwayStudy(task, tuple(rows))


def _residual_sway(machine: Machine, control: ValveFeedforward, duration: float) -> float:
    start = control.planned_trajectory.position(0.0)
    end_time = _STEP * np.ceil((duration + _OBSERVATION_TIME) / _STEP)
    run = simulate(
        machine, control, initial=(start, np.zeros_like(start)), duration=end_time, step=_STEP
    )
    configurations_after: Array = run.q[run.time >= duration]
    sway = Sway(machine)
    sway_angles = (configurations_after - sway.hanging_equilibrium(configurations_after))[
        :, sway.free_indices
    ]
    return float(np.linalg.norm(sway_angles, axis=1).max())
