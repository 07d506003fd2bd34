"""Recordings in folders of runs, and the machines that they name."""

from collections.abc import Sequence
from pathlib import Path

from crane.common.errors import DescriptionError, InputError, RecordingError
from crane.description.machine_lookup import find_machine_file, without_changes
from crane.formats.machine_loading import load_from_expression
from crane.machine.machine import Machine
from crane.recordings.measured_recordings import complete_recording, is_measured
from crane.recordings.recording import Recording
from crane.recordings.recording_reader import (
    FULL_TIME_SPAN,
    TimeSpan,
    quantities_from_readings,
    read_quantities,
    read_sensor_readings,
)

RECORDING, RECORDING_NPZ = "recording.csv", "recording.npz"


def read_run(
    path: str | Path,
    machine: Machine | None = None,
    columns: str | Path | None = None,
    span: TimeSpan = FULL_TIME_SPAN,
    required_columns: Sequence[Sequence[str]] = (),
) -> Recording:
    """Read the recording of a run's folder, a CSV or npz file, or a log of another program.

    Args:
        path: Folder or file.
        machine: The recorded machine. Coordinates and forces that the file does not have are
            computed with it, see `crane.recordings.measured_recordings`. By default this is done
            with the machine that the file names, if it has pressures or angles instead of forces.
        columns: File that assigns the columns of a log, see `crane.recordings.logs`.
        span: Start and end [s] of the part to read, in recorded time.
        required_columns: Further columns that the file has to have, any one of each group, if a
            machine is given.

    Returns:
        The recording.

    Raises:
        RecordingError: There is no recording, it is malformed, or it does not determine all
            coordinates and forces.
        DescriptionError: The machine that the file names is not found.
    """
    path = recording_file(path)
    if machine is not None:
        table = read_quantities(path, machine, columns, span)
        return complete_recording(machine, table, path, required_columns)
    table = read_sensor_readings(path, columns=columns)
    name = table.notes.get("machine", "")
    if name and is_measured(table):
        machine = recorded_machine(path, name)
        table = quantities_from_readings(table, path, machine, span)
        return complete_recording(machine, table, path)
    return Recording.from_table(quantities_from_readings(table, path, None, span), path)


def recording_file(path: str | Path) -> Path:
    """The file of a recording: the path itself, or the file in the folder of a run.

    Raises:
        RecordingError: The folder has none.
    """
    path = Path(path)
    if not path.is_dir():
        return path
    for file in (path / RECORDING, path / RECORDING_NPZ):
        if file.is_file():
            return file
    raise RecordingError(f"{path}: no {RECORDING} in this folder, give a run's folder")


def recorded_machine(path: str | Path, name: str) -> Machine:
    """Load the machine that a recording names.

    Args:
        path: The recording, for errors.
        name: The machine in the recording, see `Recording.machine`.

    Raises:
        InputError: The name is empty.
        DescriptionError: The machine is not found, or cannot be read.
    """
    if not name:
        raise InputError(
            f"{path}: does not name its machine, add --machine, or write '# machine: NAME' above "
            "its header row"
        )
    try:
        find_machine_file(without_changes(name))
    except DescriptionError as error:
        raise DescriptionError(
            f"{path}: its machine is not found ({error}); add --machine to say where it is"
        ) from None
    return load_from_expression(name)
