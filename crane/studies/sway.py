"""How much sway a motion leaves, by method and payload."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array, as_number
from crane.common.shown import Brief, counted
from crane.common.tables import aligned
from crane.common.waiting import telling
from crane.control import ValveFeedforward, fastest
from crane.formats import load
from crane.machine import Machine
from crane.motion.sway import METHODS, Sway
from crane.motion.trajectories import task_trajectory
from crane.simulation import simulate

_WATCHED = 10.0  # [s] after the motion
_STEP = 1e-2  # [s]
DAMPING = 0.2

Progress = Callable[[float], None]


@dataclass(frozen=True)
class SwayRow:
    """What one motion leaves.

    Attributes:
        payload: [kg].
        method: Of `without_sway`.
        damping: Damping ratio that the feedback of sway asks for, 0 without.
        duration: The shortest that the flow allows [s].
        share: That over the duration without any method.
        residual: The largest sway in 10 s after it, of all free joints together (root of the sum
            of squares) [rad].
        less: By which share that is less than without any method.
    """

    payload: float
    method: str
    damping: float
    duration: float
    share: float
    residual: float
    less: float

    @property
    def name(self) -> str:
        """The method in words."""
        return f"{self.method}, damped" if self.damping else self.method


@dataclass(frozen=True, repr=False)
class SwayStudy(Brief):
    """Sway that a task leaves through the valves.

    Attributes:
        task: Its name.
        rows: By payload, then by method.
    """

    task: str
    rows: tuple[SwayRow, ...]

    def _line(self) -> str:
        """Its task, and what leaves the least sway."""
        best = min(self.rows, key=lambda row: row.residual)
        return (
            f"SwayStudy of '{self.task}': {counted(len(self.rows), 'motion')}, the least sway "
            f"{np.degrees(best.residual):.3g} deg by {best.name}"
        )

    def to_text(self) -> str:
        """A table."""
        head = ("payload", "method", "duration", "against none", "residual sway", "less")
        cells = [head] + [
            (
                f"{row.payload:g} kg", row.name, f"{row.duration:.2f} s", f"{row.share:.3f}",
                f"{np.degrees(row.residual):.3f} deg", f"{100 * row.less:.1f} %",
            )
            for row in self.rows
        ]  # fmt: skip
        return "\n".join(aligned(cells, left=(0, 1)))


def sway_study(
    machine: str | Path,
    task: str,
    payloads: Sequence[float] = (0.0, 100.0, 200.0, 300.0, 400.0, 500.0),
    damping: float = DAMPING,
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
    progress = telling(progress)
    if not payloads:
        raise InputError("no payloads, give some masses [kg]")
    rows: list[SwayRow] = []
    done, every = 0, len(payloads) * len(METHODS) * (1 + (damping > 0))
    for mass in payloads:
        carried = as_number(mass, "the payload", "kg")
        loaded = {**(changes or {}), **({"payload.mass": carried} if carried else {})}
        moved = load(machine, changes=loaded)
        reference, before = task_trajectory(moved, task), None
        for method in METHODS:
            found = fastest(moved, reference, method)
            for ratio in (0.0, damping)[: 1 + (damping > 0)]:
                control = ValveFeedforward(moved, found, sway=ratio)
                residual = _residual(moved, control, found.duration)
                if before is None:
                    before = found.duration, residual
                rows.append(
                    SwayRow(
                        carried, method, ratio, found.duration, found.duration / before[0],
                        residual, 1.0 - residual / before[1],
                    )
                )  # fmt: skip
                done += 1
                if progress is not None:
                    progress(done / every)
    return SwayStudy(task, tuple(rows))


def _residual(machine: Machine, control: ValveFeedforward, duration: float) -> float:
    """The largest sway after a motion [rad]."""
    start = control.planned.position(0.0)
    until = _STEP * np.ceil((duration + _WATCHED) / _STEP)
    run = simulate(
        machine, control, initial=(start, np.zeros_like(start)), duration=until, step=_STEP
    )
    after: Array = run.q[run.time >= duration]
    free = ~machine.driven
    sway = after[:, free] - Sway(machine).hanging(after)[:, free]
    return float(np.linalg.norm(sway, axis=1).max())
