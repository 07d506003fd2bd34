"""Forces of the active joints by external forces that were recorded."""

import numpy as np

from crane.common.errors import RecordingError, check_name
from crane.common.samples import Array
from crane.description.external_forces import WRENCH_COMPONENTS
from crane.dynamics.dynamics import Dynamics
from crane.identification.mechanics.recording_rejection import reject_unless_trusted
from crane.machine.machine import Machine
from crane.recordings.recording import Recording

_LOAD_PREFIX, _PART_UNITS = "load_", {"force": "N", "moment": "N m"}


def recorded_load_forces(machine: Machine, recording: Recording, q_a: Array, trust: bool) -> Array:
    """Forces of recorded loads at the active joints, so that W beta = tau + forces.

    Columns `load_NAME_force_x` to `load_NAME_moment_z` are a wrench in the world frame at the
    frame of the machine's load NAME, or at the link NAME; missing components are zero.

    Args:
        machine: The recorded machine.
        recording: Recording of N samples.
        q_a: (N, n) [m], [rad].
        trust: See `smoothed_motion`.

    Returns:
        (N, n) [N], [N m]; (1, n) zeros without loads.

    Raises:
        RecordingError: A load acts on an unknown link, or a load of the machine is not recorded.
    """
    frames = {force.name: force.frame for force in machine.external_forces}
    wrenches: dict[str, Array] = {}
    for column, values in recording.channels.items():
        pieces = column.removeprefix(_LOAD_PREFIX).rsplit("_", 2)
        part = "_".join(pieces[1:])
        if not column.startswith(_LOAD_PREFIX) or part not in WRENCH_COMPONENTS:
            continue
        name, unit = pieces[0], recording.channel_units[column]
        if unit != _PART_UNITS[part[:-2]]:
            raise RecordingError(
                f"'{column}' is recorded in {unit}, give {_PART_UNITS[part[:-2]]}"
            )
        if name not in frames:
            problem = f"'{column}' acts on no link of '{machine.name}'"
            check_name(name, machine.tree.links, problem, RecordingError)
        rows = wrenches.setdefault(name, np.zeros((len(values), len(WRENCH_COMPONENTS))))
        rows[:, WRENCH_COMPONENTS.index(part)] = values
    for name in frames:
        if name not in wrenches:
            reject_unless_trusted(
                f"'{machine.name}' has the load '{name}', and no column contains it: add "
                f"{_LOAD_PREFIX}{name}_force_x and so on, or take a machine without it",
                trust,
            )
    if not wrenches:
        return np.zeros((1, q_a.shape[1]))
    dynamics, total = Dynamics(machine), np.zeros_like(q_a)
    for name, rows in wrenches.items():
        total += dynamics.project_wrenches(q_a, {frames.get(name, name): rows})
    return total
