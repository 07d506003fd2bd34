"""Forces from outside that were recorded: they are known, and act beside the active ones."""

import numpy as np

from crane.common.errors import RecordingError, suggest_names
from crane.common.samples import Array
from crane.description.external_forces import WRENCH_COMPONENTS
from crane.dynamics import Dynamics
from crane.identification.mechanics.recording_checks import reject_unless_trusted
from crane.machine import Machine
from crane.recordings.recording import Recording

_LOAD_PREFIX, _PART_UNITS = "load_", {"force": "N", "moment": "N m"}


def recorded_load_forces(machine: Machine, recording: Recording, q_a: Array, trust: bool) -> Array:
    """What recorded loads do at the active joints, so that W beta = tau + this.

    Columns `load_NAME_force_x` to `load_NAME_moment_z` are a wrench in the world's axes at the
    frame of the machine's load NAME, or at the link NAME; what has no column is zero.

    Args:
        machine: What was recorded.
        recording: Of N samples.
        q_a: (N, n) [m], [rad].
        trust: See `smoothed_motion`.

    Returns:
        (N, n) [N], [N m].

    Raises:
        RecordingError: A load acts on no link, or one of the machine's is not recorded.
    """
    frames = {force.name: force.frame for force in machine.external_forces}
    wrenches: dict[str, Array] = {}
    for column, values in recording.channels.items():
        part = next(
            (x for x in WRENCH_COMPONENTS if column == f"{_LOAD_PREFIX}{_load_name(column)}_{x}"),
            None,
        )
        if part is None:
            continue
        name, unit = _load_name(column), recording.channel_units[column]
        if unit != _PART_UNITS[part[:-2]]:
            raise RecordingError(
                f"'{column}' is recorded in {unit}, give {_PART_UNITS[part[:-2]]}"
            )
        if name not in frames and name not in machine.tree.links:
            links = suggest_names(machine.tree.links, name)
            raise RecordingError(f"'{column}' acts on no link of '{machine.name}', {links}")
        rows = wrenches.setdefault(name, np.zeros((len(values), len(WRENCH_COMPONENTS))))
        rows[:, WRENCH_COMPONENTS.index(part)] = values
    for name in frames:
        if name not in wrenches:
            reject_unless_trusted(
                f"'{machine.name}' has the load '{name}', and no column tells what it did: add "
                f"{_LOAD_PREFIX}{name}_force_x and so on, or take a machine without it",
                trust,
            )
    dynamics, total = Dynamics(machine), np.zeros_like(q_a)
    for name, rows in wrenches.items():
        total += dynamics.project_wrenches(q_a, {frames.get(name, name): rows})
    return total


def _load_name(column: str) -> str:
    """The load's name in a column's."""
    return column.removeprefix(_LOAD_PREFIX).rsplit("_", 2)[0]
