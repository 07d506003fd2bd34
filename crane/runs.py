"""Folders of results: one run is a recording with its summary, figure and page."""

from pathlib import Path

from crane.errors import OutputError, RecordingError
from crane.machine import Machine
from crane.output import replacing
from crane.recording import Recording
from crane.summary import summarize

RECORDING, SUMMARY, FIGURE, PAGE = "recording.csv", "summary.md", "figure.png", "view.html"


def check_folder(folder: Path, force: bool) -> None:
    """See that results may go to a folder, before they are computed.

    Raises:
        OutputError: It holds something already and `force` is off, or it is a file.
    """
    try:
        if folder.is_dir() and any(folder.iterdir()) and not force:
            raise OutputError(f"{folder}: is not empty, choose another folder or add --force")
    except OSError as error:
        raise _no_folder(folder, error) from None
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file, give the name of a folder")


def make_folder(folder: Path) -> None:
    """Create a folder where there is none.

    Raises:
        OutputError: It cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _no_folder(folder, error) from None


def _no_folder(folder: Path, error: OSError) -> OutputError:
    reason = (error.strerror or str(error)).lower()
    return OutputError(f"{folder}: cannot be a folder ({reason}), choose another")


def check_free(file: Path, force: bool) -> None:
    """See that a file may be written.

    Raises:
        OutputError: It exists and `force` is off.
    """
    if file.exists() and not force:
        raise OutputError(f"{file}: exists already, choose another name or add --force")


def write_run(folder: Path, recording: Recording, title: str) -> str:
    """Write a recording and its summary into a folder, created where there is none.

    Returns:
        The summary, Markdown.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    make_folder(folder)
    text = f"# {title}\n\n{summarize(recording).to_markdown()}"
    recording.to_csv(folder / RECORDING)
    with replacing(folder / SUMMARY) as part:
        part.write_text(text, encoding="utf-8")
    return text


def write_views(folder: Path, machine: Machine, recording: Recording) -> None:
    """Write figure and page of a recording into a folder."""
    from crane.view.page import write_page
    from crane.view.plots import plot_recording

    plot_recording(recording, folder / FIGURE)
    write_page(machine, folder / PAGE, recording)


def read_run(path: Path) -> Recording:
    """The recording of a run's folder or of a CSV file.

    Raises:
        RecordingError: There is none, or it is malformed.
    """
    if path.is_dir():
        if not (path / RECORDING).is_file():
            raise RecordingError(f"{path}: no {RECORDING} in this folder, give a run's folder")
        path = path / RECORDING
    return Recording.from_csv(path)
