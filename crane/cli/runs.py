"""Folders of results: one run is a recording with its summary, figure and page."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from crane.common import atomic_output
from crane.common.atomic_output import replace_folder
from crane.common.errors import (
    CraneWarning,
    DescriptionError,
    InputError,
    OutputError,
    RecordingError,
)
from crane.description.machine_lookup import find_machine_file, without_changes
from crane.formats import load_from_expression
from crane.machine import Machine
from crane.recordings.measured_recordings import complete_recording, is_measured
from crane.recordings.recording import Recording
from crane.recordings.recording_reader import (
    FULL_TIME_SPAN,
    TimeSpan,
    quantities_from_readings,
    read_quantities,
    read_sensor_readings,
)
from crane.recordings.recording_summary import heading, result_title, summarize

if TYPE_CHECKING:
    from crane.identification.calibration.calibration_result import Calibration
    from crane.identification.mechanics.identification_result import Identification
    from crane.motion.workspaces import Workspace
    from crane.ratings import Breakout, Capacity, ToolForce, Torques, WorkingRange
    from crane.simulation.linear import LinearModel
    from crane.simulation.recording_replay import Comparison
    from crane.simulation.sensitivity import Sensitivities
    from crane.studies.design import Design
    from crane.studies.power_balance_result import PowerBalance, PowerComparison
    from crane.studies.study_table import Study

RECORDING, RECORDING_NPZ = "recording.csv", "recording.npz"
SUMMARY, FIGURE, PAGE = "summary.md", "figure.png", "view.html"
REPORT, MACHINE = "report.html", "machine"
COMPARISON, CURVES = "comparison.md", "comparison.png"
OF_RUNS = (FIGURE, PAGE, COMPARISON, CURVES)  # beside a recording, of an earlier one


def check_folder(folder: Path, force: bool) -> None:
    """See that results may go to a folder, before they are computed.

    Raises:
        OutputError: It holds something already and `force` is off, it cannot be written, or a
            file is in the way.
    """
    atomic_output.check_folder_is_writable(folder)
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
    atomic_output.check_file_is_writable(file)
    if file.exists() and not force:
        raise OutputError(f"{file}: exists already, choose another name or add --force")


def write_run(folder: Path, recording: Recording, npz: bool = False, force: bool = True) -> str:
    """Write a recording, as CSV or npz, and its summary into a folder, created if there is none.

    What else there is of an earlier run in the same folder is removed: it shows something else.

    Args:
        folder: The folder; of all that follow here, too.
        recording: The recording.
        npz: Whether it is written as npz.
        force: Whether an earlier run is replaced; of all that follow here, too.

    Returns:
        The summary, Markdown.

    Raises:
        OutputError: The folder or a file cannot be written, or it is filled and `force` is off.
    """
    with replace_folder(folder, force, _stale(npz)) as part:
        return _write_run(part, recording, npz)


def _stale(npz: bool) -> tuple[str, ...]:
    """Files of an earlier run that a new one takes away."""
    return (*OF_RUNS, RECORDING if npz else RECORDING_NPZ)


def _write_run(part: Path, recording: Recording, npz: bool) -> str:
    text = f"# {heading(recording)}\n\n{summarize(recording).to_markdown()}"
    if npz:
        recording.to_npz(part / RECORDING_NPZ)
    else:
        recording.to_csv(part / RECORDING)
    (part / SUMMARY).write_text(text, encoding="utf-8")
    return text


def write_comparison(
    folder: Path,
    recording: Recording,
    comparison: "Comparison",
    npz: bool = False,
    force: bool = True,
) -> str:
    """Write a replay into a folder: its recording, and how it compares with what was measured.

    Returns:
        The comparison, Markdown.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.view.plots.calibration_figure import plot_comparison

    text = f"# {heading(recording)}\n\n{comparison.to_markdown()}"
    with replace_folder(folder, force, _stale(npz)) as part:
        _write_run(part, recording, npz)
        (part / COMPARISON).write_text(text, encoding="utf-8")
        if comparison.channels:
            plot_comparison(comparison, part / CURVES)
    return text


def write_views(folder: Path, machine: Machine, recording: Recording) -> None:
    """Write figure and page of a recording into a folder."""
    from crane.view.page.report_page import report
    from crane.view.plots.recording_figure import plot_recording

    plot_recording(recording, folder / FIGURE)
    report(machine, recording, folder / PAGE)


def write_study(folder: Path, study: "Study", force: bool = True) -> None:
    """Write table and picture of a study into a folder, created where there is none.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.view.plots.study_figure import plot_study

    with replace_folder(folder, force) as part:
        study.to_csv(part / "study.csv")
        plot_study(study, part / "study.png")


def write_design(folder: Path, found: "Design", force: bool = True) -> None:
    """Write report, table, picture and the best machine into a folder, created if there is none.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.formats import write_machine
    from crane.view.plots.capacity_figure import plot_capacity
    from crane.view.plots.design_figure import plot_design

    with replace_folder(folder, force, ("before.png", "after.png")) as part:
        for name, chart in zip(("before", "after"), found.capacity_charts() or (), strict=False):
            plot_capacity(chart, part / f"{name}.png")
        (part / "design.md").write_text(found.to_markdown(), encoding="utf-8")
        found.to_csv(part / "solutions.csv")
        plot_design(found, part / "design.png")
        try:
            write_machine(found.variant(), part / "machine")
        except InputError as error:
            text = f"the machine is not written, take its numbers from design.md: {error}"
            warnings.warn(text, CraneWarning, stacklevel=2)


def write_workspace(folder: Path, space: "Workspace", force: bool = True) -> str:
    """Write tables, summary and picture of a workspace into a folder, created where there is none.

    Returns:
        The summary, Markdown.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.view.plots.workspace_figure import plot_workspace

    text = space.to_markdown()
    with replace_folder(folder, force) as part:
        space.to_csv(part / "workspace.csv")
        space.curves_to_csv(part / "curves.csv")
        (part / "workspace.md").write_text(text, encoding="utf-8")
        plot_workspace(space, part / "workspace.png")
    return text


def write_breakout(folder: Path, found: "Breakout", force: bool = True) -> str:
    """Write the table of break-out forces into a folder, created where there is none.

    Returns:
        The table, Markdown.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    text = found.to_markdown()
    with replace_folder(folder, force) as part:
        (part / "breakout.md").write_text(text, encoding="utf-8")
    return text


def write_tool_force(folder: Path, field: "ToolForce", force: bool = True) -> str:
    """Write table, summary and picture of tool forces into a folder, created where there is none.

    Returns:
        The summary, Markdown.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.view.plots.tool_force_figure import plot_tool_force

    text = field.to_markdown()
    with replace_folder(folder, force) as part:
        (part / "tool_force.md").write_text(text, encoding="utf-8")
        field.to_csv(part / "tool_force.csv")
        plot_tool_force(field, part / "tool_force.png")
    return text


def write_working_range(folder: Path, found: "WorkingRange", force: bool = True) -> str:
    """Write tables and picture of a working range into a folder, created where there is none.

    Returns:
        The table, Markdown.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.view.plots.working_range_figure import plot_working_range

    text = found.to_markdown()
    with replace_folder(folder, force) as part:
        (part / "working_range.md").write_text(text, encoding="utf-8")
        found.to_csv(part / "working_range.csv")
        plot_working_range(found, part / "working_range.png")
    return text


def write_capacity(
    folder: Path,
    chart: "Capacity",
    torques: "Torques | None" = None,
    by: "Sequence[str]" = (),
    force: bool = True,
) -> str:
    """Write tables, pictures and page of rated loads into a folder, created where there is none.

    What lifting and slewing torques say stands behind the table, if they are given; how the loads
    change with numbers of the machine in a file of its own.

    Returns:
        The table with what it holds for, Markdown.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.view.page.capacity_page import write_capacity_page
    from crane.view.plots.capacity_figure import plot_capacity
    from crane.view.plots.capacity_sheet import plot_capacity_sheet

    text = chart.to_markdown() + (torques.to_markdown() if torques is not None else "")
    with replace_folder(folder, force, ("slopes.csv",)) as part:
        chart.to_csv(part / "capacity.csv")
        (part / "capacity.md").write_text(text, encoding="utf-8")
        plot_capacity(chart, part / "capacity.png")
        if by:
            chart.derivatives_to_csv(part / "slopes.csv", by)
        plot_capacity_sheet(chart, part / "sheet.pdf")
        write_capacity_page(chart, part / "capacity.html")
    return text


def write_calibration(folder: Path, found: "Calibration", force: bool = True) -> None:
    """Write report, page, picture and the fitted machine into a folder.

    The folder is created where there is none. A machine that no machine file can say
    is left out with a warning: the report has its `--set`.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.formats import write_machine
    from crane.view.page.calibration_page import write_calibration_report
    from crane.view.plots.calibration_figure import plot_calibration

    with replace_folder(folder, force, _machine_files(folder, found.machine)) as part:
        write_calibration_report(found, part / REPORT)
        (part / "calibration.md").write_text(found.to_text() + "\n", encoding="utf-8")
        plot_calibration(found, part / "calibration.png")
        try:
            write_machine(found.machine, part / MACHINE, found.notes)
        except InputError as error:
            text = f"the machine is not written, take the --set options of the report: {error}"
            warnings.warn(text, CraneWarning, stacklevel=2)


def write_sensitivities(folder: Path, found: "Sensitivities", force: bool = True) -> None:
    """Write table, derivatives and picture into a folder, created where there is none.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.view.plots.modes_figure import plot_sensitivities

    with replace_folder(folder, force) as part:
        (part / "sensitivities.md").write_text(found.to_text() + "\n", encoding="utf-8")
        found.to_csv(part / "sensitivities.csv")
        plot_sensitivities(found, part / "sensitivities.png")


def write_power(folder: Path, account: "PowerBalance", force: bool = True) -> str:
    """Write table, powers over time and pictures into a folder, created where there is none.

    Returns:
        The table, Markdown.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.view.plots.power_figure import plot_power
    from crane.view.plots.sankey_diagram import plot_sankey

    of = result_title(account.machine_name, f"{account.task_name} power".strip())
    text = f"# {of}\n\n{account.to_markdown()}"
    with replace_folder(folder, force) as part:
        (part / "power.md").write_text(text, encoding="utf-8")
        account.to_csv(part / "power.csv")
        plot_power(account, part / "power.png")
        plot_sankey(account, part / "sankey.png")
    return text


def write_power_comparison(folder: Path, comparison: "PowerComparison", force: bool = True) -> str:
    """Write table and picture into a folder, created where there is none.

    Returns:
        The table, Markdown.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.view.plots.power_figure import plot_power_comparison

    text = f"# power of {', '.join(comparison.balances)}\n\n{comparison.to_markdown()}"
    with replace_folder(folder, force) as part:
        (part / "comparison.md").write_text(text, encoding="utf-8")
        plot_power_comparison(comparison, part / "comparison.png")
    return text


def write_modes(
    folder: Path,
    model: "LinearModel",
    over: "Sequence[tuple[dict[str, float], LinearModel]]",
    force: bool = True,
) -> None:
    """Write a linear model, its table, picture and page into a folder.

    Args:
        folder: Created where there is none.
        model: The model.
        over: Of what was varied, drawn in a picture of their own.
        force: Whether an earlier one is replaced.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.view.page.report_page import report
    from crane.view.plots.modes_figure import plot_modes, plot_parameter_modes

    with replace_folder(folder, force, ("over.png", PAGE)) as part:
        model.save(part / "model.mat")
        model.save(part / "model.npz")
        (part / "modes.md").write_text(model.to_text() + "\n", encoding="utf-8")
        plot_modes(model, part / "modes.png")
        if over:
            plot_parameter_modes(over, part / "over.png")
        motion = model.mode_animation()
        if motion is not None:
            report(model.machine, motion, part / PAGE)


def write_identification(
    folder: Path,
    result: "Identification",
    recording: str = "",
    validation: str = "",
    force: bool = True,
) -> None:
    """Write report and parameters into a folder, and the machine where all are known.

    A machine that cannot be, or that no machine file can say, is left out with a warning.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    from crane.view.page.identification_page import identification_report

    with replace_folder(folder, force, _machine_files(folder, result.described_machine)) as part:
        identification_report(result, part / REPORT, recording, validation)
        result.to_csv(part / "parameters.csv")
        if result.parameters is not None:
            _write_machine(result, part / MACHINE)


def _machine_files(folder: Path, read: Machine) -> Sequence[str]:
    """Those that an earlier result of the same kind has left in a folder; none that were read."""
    place = folder / MACHINE
    files = (read.path, *(chain.urdf for chain in read.chains))
    if not (folder / REPORT).is_file() or any(
        file.resolve().is_relative_to(place.resolve()) for file in files
    ):
        return ()
    return [f"{MACHINE}/**/*.{kind}" for kind in ("yaml", "urdf")]


def _write_machine(result: "Identification", folder: Path) -> None:
    from crane.identification.mechanics.write_identified import write_identified

    try:
        write_identified(result, folder)
    except InputError as error:
        hint = " (on the command line --feasible)" if str(error).endswith("feasible=True") else ""
        text = f"no machine files are written: {error}{hint}"
        warnings.warn(text, CraneWarning, stacklevel=3)


def read_run(
    path: Path,
    machine: Machine | None = None,
    columns: Path | None = None,
    span: TimeSpan = FULL_TIME_SPAN,
    needs: Sequence[Sequence[str]] = (),
) -> Recording:
    """The recording of a run's folder, of a CSV or npz file, or of a log of another program.

    Args:
        path: Folder or file.
        machine: What was recorded. Coordinates and forces that the file does not have are
            computed with it, see `crane.recordings.measured_recordings`; where no machine is
            given, with the one that the file names, if it has pressures or angles instead of
            forces.
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
        return complete_recording(
            machine, read_quantities(path, machine, columns, span), path, needs
        )
    table = read_sensor_readings(path, columns=columns)
    named = table.notes.get("machine", "")
    if named and is_measured(table):
        machine = machine_of(path, named)
        return complete_recording(
            machine, quantities_from_readings(table, path, machine, span), path
        )
    return Recording.from_table(quantities_from_readings(table, path, None, span), path)


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
        find_machine_file(without_changes(named))
    except DescriptionError as error:
        raise DescriptionError(
            f"{path}: its machine is not found ({error}); add --machine to say where it is"
        ) from None
    return load_from_expression(named)
