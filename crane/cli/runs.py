"""Folders of results: one run is a recording with its summary, figure and page."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from crane.common import output
from crane.common.errors import (
    CraneWarning,
    DescriptionError,
    InputError,
    OutputError,
    RecordingError,
)
from crane.common.output import staging
from crane.description.sources import find, unchanged
from crane.formats import recalled
from crane.machine import Machine
from crane.recordings.measured import completed, is_measured
from crane.recordings.reading import ALWAYS, Span, quantities, read, readings
from crane.recordings.recording import Recording
from crane.recordings.summary import subject, summarize, title
from crane.simulation.replays import Comparison
from crane.studies.table import Study

if TYPE_CHECKING:
    from crane.identification.calibration.result import Calibration
    from crane.identification.mechanics.result import Identification
    from crane.motion.workspaces import Workspace
    from crane.simulation.linear import LinearModel
    from crane.simulation.sensitivity import Sensitivities
    from crane.studies.power import PowerAccount

RECORDING, RECORDING_NPZ = "recording.csv", "recording.npz"
SUMMARY, FIGURE, PAGE = "summary.md", "figure.png", "view.html"
COMPARISON = "comparison.md"


def check_folder(folder: Path, force: bool) -> None:
    """See that results may go to a folder, before they are computed.

    Raises:
        OutputError: It holds something already and `force` is off, it cannot be written, or a
            file is in the way.
    """
    output.check_folder(folder)
    if folder.is_dir() and not force:
        try:
            empty = not any(folder.iterdir())
        except OSError as error:
            reason = error.strerror or str(error)
            raise OutputError(f"{folder}: cannot be read ({reason}), choose another") from None
        if not empty:
            raise OutputError(f"{folder}: is not empty, choose another folder or add --force")


def check_free(file: Path, force: bool) -> None:
    """See that a file may be written, before it is computed.

    Raises:
        OutputError: It exists and `force` is off, or it cannot be written.
    """
    output.check_file(file)
    if file.exists() and not force:
        raise OutputError(f"{file}: exists already, choose another name or add --force")


def write_run(folder: Path, recording: Recording, npz: bool = False) -> str:
    """Write a recording, as CSV or npz, and its summary into a folder, created if there is none.

    What else there is of an earlier run in the same folder is removed: it shows something else.

    Returns:
        The summary, Markdown.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    heading = title(subject(recording), recording.task)
    text = f"# {heading}\n\n{summarize(recording).to_markdown()}"
    with staging(folder) as part:
        if npz:
            recording.to_npz(part / RECORDING_NPZ)
        else:
            recording.to_csv(part / RECORDING)
        (part / SUMMARY).write_text(text, encoding="utf-8")
        for name in (FIGURE, PAGE, RECORDING if npz else RECORDING_NPZ):
            (folder / name).unlink(missing_ok=True)
    return text


def write_comparison(
    folder: Path, recording: Recording, comparison: Comparison, npz: bool = False
) -> str:
    """Write a replay into a folder: its recording, and how it compares with what was measured.

    Returns:
        The comparison, Markdown.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.view.plots.comparison import plot_comparison

    write_run(folder, recording, npz)
    heading = title(subject(recording), recording.task)
    text = f"# {heading}\n\n{comparison.to_markdown()}"
    with staging(folder) as part:
        (part / COMPARISON).write_text(text, encoding="utf-8")
        if comparison.channels:
            plot_comparison(comparison, part / "comparison.png")
    return text


def write_views(folder: Path, machine: Machine, recording: Recording) -> None:
    """Write figure and page of a recording into a folder."""
    from crane.view.page.build import report
    from crane.view.plots.recording import plot_recording

    plot_recording(recording, folder / FIGURE)
    report(machine, recording, folder / PAGE)


def write_study(folder: Path, study: Study) -> None:
    """Write table and picture of a study into a folder, created where there is none.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.view.plots.study import plot_study

    with staging(folder) as part:
        study.to_csv(part / "study.csv")
        plot_study(study, part / "study.png")


def write_workspace(folder: Path, space: "Workspace") -> str:
    """Write tables, summary and picture of a workspace into a folder, created where there is none.

    Returns:
        The summary, Markdown.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.view.plots.workspace import plot_workspace

    text = space.to_markdown()
    with staging(folder) as part:
        space.to_csv(part / "workspace.csv")
        space.curves_to_csv(part / "curves.csv")
        (part / "workspace.md").write_text(text, encoding="utf-8")
        plot_workspace(space, part / "workspace.png")
    return text


def write_calibration(folder: Path, found: "Calibration") -> None:
    """Write report, page, picture and the fitted machine into a folder.

    The folder is created where there is none. A machine that no machine file can say
    is left out with a warning: the report has its `--set`.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.formats import write_machine
    from crane.view.page.calibration import write_calibration_report
    from crane.view.plots.calibration import plot_calibration

    with staging(folder) as part:
        write_calibration_report(found, part / "report.html")
        (part / "calibration.md").write_text(found.to_text() + "\n", encoding="utf-8")
        plot_calibration(found, part / "calibration.png")
        try:
            write_machine(found.machine, part / "machine", found.notes)
        except InputError as error:
            text = f"the machine is not written, take the --set options of the report: {error}"
            warnings.warn(text, CraneWarning, stacklevel=2)


def write_sensitivities(folder: Path, found: "Sensitivities") -> None:
    """Write table, derivatives and picture into a folder, created where there is none.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.view.plots.sensitivities import plot_sensitivities

    with staging(folder) as part:
        (part / "sensitivities.md").write_text(found.to_text() + "\n", encoding="utf-8")
        found.to_csv(part / "sensitivities.csv")
        plot_sensitivities(found, part / "sensitivities.png")


def write_power(folder: Path, account: "PowerAccount") -> str:
    """Write table, powers over time and pictures into a folder, created where there is none.

    Returns:
        The table, Markdown.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.view.plots.power import plot_power
    from crane.view.plots.sankey import plot_sankey

    heading = title(account.machine, f"{account.task} power".strip())
    text = f"# {heading}\n\n{account.to_markdown()}"
    with staging(folder) as part:
        (part / "power.md").write_text(text, encoding="utf-8")
        account.to_csv(part / "power.csv")
        plot_power(account, part / "power.png")
        plot_sankey(account, part / "sankey.png")
    return text


def write_modes(
    folder: Path, model: "LinearModel", over: "Sequence[tuple[dict[str, float], LinearModel]]"
) -> None:
    """Write a linear model, its table, picture and page into a folder.

    Args:
        folder: Created where there is none.
        model: The model.
        over: Of what was varied, drawn in a picture of their own.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.view.page.build import report
    from crane.view.plots.modes import plot_modes, plot_modes_over

    with staging(folder) as part:
        model.save(part / "model.mat")
        model.save(part / "model.npz")
        (part / "modes.md").write_text(model.to_text() + "\n", encoding="utf-8")
        plot_modes(model, part / "modes.png")
        if over:
            plot_modes_over(over, part / "over.png")
        motion = model.motion()
        if motion is not None:
            report(model.machine, motion, part / PAGE)


def write_identification(
    folder: Path, result: "Identification", recording: str = "", validation: str = ""
) -> None:
    """Write report and parameters into a folder, and the machine where all are known.

    A machine that cannot be, or that no machine file can say, is left out with a warning.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.identification.mechanics.write import write_parameters
    from crane.view.page.identification import write_report

    with staging(folder) as part:
        write_report(result, part / "report.html", recording, validation)
        write_parameters(result, part / "parameters.csv")
        if result.parameters is not None:
            _write_machine(result, part / "machine")


def _write_machine(result: "Identification", folder: Path) -> None:
    from crane.identification.mechanics.write import write_identified

    try:
        write_identified(result, folder)
    except InputError as error:
        hint = "" if result.feasible else " (on the command line --feasible)"
        text = f"no machine files are written: {error}{hint}"
        warnings.warn(text, CraneWarning, stacklevel=3)


def read_run(
    path: Path,
    machine: Machine | None = None,
    columns: Path | None = None,
    span: Span = ALWAYS,
    needs: Sequence[Sequence[str]] = (),
) -> Recording:
    """The recording of a run's folder, of a CSV or npz file, or of a log of another program.

    Args:
        path: Folder or file.
        machine: What was recorded. Coordinates and forces that the file does not have are
            computed with it, see `crane.recordings.measured`; where no machine is given, with the
            one that the file names, if it has pressures or angles instead of forces.
        columns: Which columns of a log are which, see `crane.recordings.logs`.
        span: From when to when [s], by the recording's clock.
        needs: Columns that have to be there besides, of each any one, where a machine is given.

    Raises:
        RecordingError: There is none, it is malformed, or it does not tell enough.
        DescriptionError: The machine that the file names is not found.
    """
    if path.is_dir():
        there = [x for x in (RECORDING, RECORDING_NPZ) if (path / x).is_file()]
        if not there:
            raise RecordingError(f"{path}: no {RECORDING} in this folder, give a run's folder")
        path = path / there[0]
    if machine is not None:
        return completed(machine, read(path, machine, columns, span), path, needs)
    table = readings(path, columns=columns)
    named = table.notes.get("machine", "")
    if named and is_measured(table):
        machine = machine_of(path, named)
        return completed(machine, quantities(table, path, machine, span), path)
    return Recording.from_table(quantities(table, path, None, span), path)


def machine_of(path: str | Path, named: str) -> Machine:
    """The machine that a recording names.

    Raises:
        InputError: It names none.
        DescriptionError: It is not found, or cannot be read.
    """
    if not named:
        raise InputError(
            f"{path}: does not name its machine, add --machine, or write '# machine: NAME' above "
            "its header row"
        )
    try:
        find(unchanged(named))
    except DescriptionError as error:
        raise DescriptionError(
            f"{path}: its machine is not found ({error}); add --machine to say where it is"
        ) from None
    return recalled(named)
