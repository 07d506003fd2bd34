"""The files of a result and the figures that a notebook shows of it, by class.

Results know their text (`to_markdown` or `to_text`) and their tables (`to_csv`). Their figures and
pages are drawn in this room; the table `RESULT_FILES` says which belong to a class.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from crane.common.atomic_output import check_folder_is_writable, replace_folder
from crane.common.errors import CraneWarning, InputError
from crane.common.result import UNFINISHED, Result
from crane.formats.machine_file.machine_writer import write_machine
from crane.formats.machine_loading import load_from_expression
from crane.machine.machine import Machine
from crane.recordings.limit_cycle_detection import limit_cycle_message
from crane.recordings.measured_recordings import RECORDING, RECORDING_NPZ
from crane.recordings.recording import Recording
from crane.recordings.recording_summary import heading, result_title, summarize

SUMMARY, FIGURE, PAGE = "summary.md", "figure.png", "view.html"
REPORT, MACHINE_FOLDER = "report.html", "machine"
_MACHINE = f"{MACHINE_FOLDER}/"


def _text(result: Any, **_: object) -> str:
    if hasattr(result, "to_markdown"):
        return str(result.to_markdown())
    return result.to_text().rstrip("\n") + "\n"


@dataclass(frozen=True)
class ResultFiles:
    """What belongs to the results of a class.

    Attributes:
        summary: File of the summary; "" if the summary is only returned.
        tables: Methods of the result that write a table, by file.
        figures: Functions of `crane.view` that draw a figure, as "module.function", by file.
        documents: Functions of `crane.view` that write a document, likewise.
        text: The summary of a result, with the options that concern it.
        more: Writes files that depend on options or on the result into a folder.
        more_files: Names of those files. Those of an earlier result are removed.
        options: Names of the options of `text` and `more`.
        stale: Patterns of further files of an earlier result, which are removed.
        motion: Machine and recording that a page plays; None as recording if nothing moves.
        notebook_figures: Functions whose figures a notebook shows instead of `figures`.
    """

    summary: str = ""
    tables: Mapping[str, str] = field(default_factory=dict)
    figures: Mapping[str, str] = field(default_factory=dict)
    documents: Mapping[str, str] = field(default_factory=dict)
    text: Callable[..., str] = _text
    more: Callable[..., None] | None = None
    more_files: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    stale: Callable[[Any, Path], Sequence[str]] | None = None
    motion: Callable[[Any], tuple[Machine, Recording | None]] | None = None
    notebook_figures: tuple[str, ...] = ()


def result_files(value: Any) -> ResultFiles | None:
    """The files of an object's class, or of the nearest class that it inherits from."""
    return next(
        (RESULT_FILES[x.__name__] for x in type(value).__mro__ if x.__name__ in RESULT_FILES), None
    )


def write_result(
    result: Result, folder: str | Path, overwrite: bool = False, **options: Any
) -> str:
    """Write a result into a folder, see `Result.write`."""
    files, folder = _checked_files(result, options), Path(folder)
    check_folder_is_writable(folder, overwrite)
    with replace_folder(
        folder,
        overwrite,
        [*files.more_files, *(files.stale(result, folder) if files.stale else ())],
    ) as part:
        text = files.text(result, **options)
        if files.summary:
            (part / files.summary).write_text(text, encoding="utf-8", errors="backslashreplace")
        for name, method in files.tables.items():
            getattr(result, method)(part / name)
        for name, function in files.figures.items():
            _write_figure(part / name, function, result)
        for name, function in files.documents.items():
            view_function(function)(result, part / name)
        if files.more is not None:
            files.more(result, part, **options)
    return text


def result_summary(result: Result, **options: Any) -> str:
    """The summary that `Result.write` returns, without writing anything."""
    return _checked_files(result, options).text(result, **options)


def plot_result(result: Any, path: str | Path) -> None:
    """Write the figure of a result, the first if its class has several.

    Args:
        result: A recording or another result with a figure.
        path: Where to write; its suffix .png, .svg or .pdf chooses the format.

    Raises:
        OutputError: The suffix is another one, or the file cannot be written.
    """
    _write_figure(Path(path), notebook_figures(result)[0], result)


def notebook_figures(value: Any) -> tuple[str, ...]:
    """Functions of `crane.view` that draw an object, as "module.function"."""
    files = result_files(value) or ResultFiles()
    return files.notebook_figures or tuple(files.figures.values())


def _checked_files(result: Result, options: Mapping[str, Any]) -> ResultFiles:
    files = result_files(result)
    if files is None:
        raise TypeError(f"{type(result).__name__} has no files")
    for name in options:
        if name not in files.options:
            known = ", ".join(files.options) or "none"
            raise TypeError(f"{type(result).__name__}.write has no option {name}, only {known}")
    return files


def view_function(name: str) -> Callable[..., Any]:
    """A function of `crane.view` by its name "module.function"."""
    module, _, function = name.rpartition(".")
    return getattr(import_module(f"crane.view.{module}"), function)


def _write_figure(path: Path, function: str, *arguments: Any) -> None:
    from crane.view.plots.figure_style import write_figure

    write_figure(path, lambda: view_function(function)(*arguments))


def _recording_text(recording: Recording, **_: object) -> str:
    return f"# {heading(recording)}\n\n{summarize(recording).to_markdown()}"


def _write_recording(
    recording: Recording, folder: Path, npz: bool = False, views: bool = False
) -> None:
    if npz:
        recording.to_npz(folder / RECORDING_NPZ)
    else:
        recording.to_csv(folder / RECORDING)
    if views:
        plot_result(recording, folder / FIGURE)
        _write_page(recording, folder)


def _write_page(result: Any, folder: Path) -> None:
    from crane.view.page.report_page import report

    files = result_files(result)
    assert files is not None and files.motion is not None, "the page plays a motion"
    machine, recording = files.motion(result)
    if recording is not None:
        report(machine, recording, folder / PAGE)


def _comparison_text(comparison: Any, **_: object) -> str:
    run, text = comparison.recording, str(comparison.to_markdown())
    if run is None:
        return text
    ringing = limit_cycle_message(run)
    return f"# {heading(run)}\n\n{text}" + (f"\n{ringing}\n" if ringing else "")


def _write_comparison(comparison: Any, folder: Path, npz: bool = False) -> None:
    if (run := comparison.recording) is not None:
        (folder / SUMMARY).write_text(
            _recording_text(run), encoding="utf-8", errors="backslashreplace"
        )
        _write_recording(run, folder, npz)
    if comparison.channels:
        _write_figure(
            folder / "comparison.png", "plots.calibration_figure.comparison_figure", comparison
        )


def _capacity_text(chart: Any, torques: Any = None, **_: object) -> str:
    return str(chart.to_markdown() + (torques.to_markdown() if torques is not None else ""))


def _write_capacity_derivatives(
    chart: Any, folder: Path, torques: Any = None, parameters: Sequence[str] = ()
) -> None:
    if parameters:
        chart.derivatives_to_csv(folder / "slopes.csv", parameters)


def _write_modes(model: Any, folder: Path, models: Sequence[Any] = ()) -> None:
    if models:
        _write_figure(folder / "over.png", "plots.modes_figure.parameter_modes_figure", models)
    _write_page(model, folder)


def _power_text(balance: Any, **_: object) -> str:
    title = result_title(balance.machine_name, f"{balance.task_name} power".strip())
    return f"# {title}\n\n{balance.to_markdown()}"


def _power_comparison_text(comparison: Any, **_: object) -> str:
    return f"# power of {', '.join(comparison.balances)}\n\n{comparison.to_markdown()}"


def _write_design(result: Any, folder: Path) -> None:
    for name, chart in zip(("before", "after"), result.capacity_charts() or (), strict=False):
        _write_figure(folder / f"{name}.png", "plots.rating_figures.capacity_figure", chart)
    _write_machine(
        lambda: write_machine(result.variant(), folder / MACHINE_FOLDER),
        "the machine is not written, take its numbers from design.md",
    )


def _write_calibrated_machine(result: Any, folder: Path) -> None:
    _write_machine(
        lambda: write_machine(result.machine, folder / MACHINE_FOLDER, result.notes),
        "the machine is not written, take the --set options of the report",
    )


def _write_identification(
    result: Any, folder: Path, recordings: str = "", validation: str = ""
) -> None:
    from crane.identification.mechanics.write_identified import write_identified
    from crane.view.page.identification_page import identification_report

    identification_report(result, folder / REPORT, recordings, validation)
    if result.parameters is not None:
        _write_machine(
            lambda: write_identified(result, folder / MACHINE_FOLDER),
            "no machine files are written",
        )


def _write_machine(write: Callable[[], object], consequence: str) -> None:
    """Write a machine, or warn that no machine file can describe it."""
    try:
        write()
    except InputError as error:
        hint = " (on the command line --feasible)" if str(error).endswith("feasible=True") else ""
        warnings.warn(f"{consequence}: {error}{hint}", CraneWarning, stacklevel=2)


def _machine_files(machine: Machine, folder: Path) -> Sequence[str]:
    """Machine files of an earlier result in a folder, unless the machine was read from them."""
    target = (folder / MACHINE_FOLDER).resolve()
    is_read = any(
        file.resolve().is_relative_to(target)
        for file in (machine.path, *(chain.urdf for chain in machine.chains))
    )
    if is_read or not (folder / REPORT).is_file():
        return ()
    return [f"{MACHINE_FOLDER}/**/*.{suffix}" for suffix in ("yaml", "urdf")]


def _orifices_text(result: Any, unit: str = "m", validation: Sequence[Any] = ()) -> str:
    lines = [
        f"validation: relative error of (29) {100 * sides.relative_error:.3g} %\n"
        for sides in validation
    ]
    return "".join([result.to_text(), *lines])


def _write_orifices(
    result: Any, folder: Path, unit: str = "m", validation: Sequence[Any] = ()
) -> None:
    sides = {f"recording {i + 1}": x for i, x in enumerate(result.training_sides)}
    sides |= {f"validation {i + 1}" if i else "validation": x for i, x in enumerate(validation)}
    _write_figure(
        folder / "orifices.png", "plots.identification_figures.equation_sides_figure", sides, unit
    )


def _text_with_unit(result: Any, unit: str = "m") -> str:
    return str(result.to_text(unit))


def _write_valve(result: Any, folder: Path, unit: str = "m") -> None:
    _write_figure(
        folder / "valve.png", "plots.identification_figures.valve_curve_figure", result, unit
    )


def _write_friction(result: Any, folder: Path, unit: str = "m") -> None:
    _write_figure(
        folder / "friction.png", "plots.identification_figures.friction_figure", result, unit
    )


RESULT_FILES: Mapping[str, ResultFiles] = {  # by class
    "Breakout": ResultFiles(summary="breakout.md"),
    "Calibration": ResultFiles(
        summary="calibration.md",
        figures={"calibration.png": "plots.calibration_figure.calibration_figure"},
        documents={REPORT: "page.calibration_page.write_calibration_report"},
        more=_write_calibrated_machine,
        more_files=(_MACHINE,),
        stale=lambda result, folder: (*_machine_files(result.machine, folder), UNFINISHED),
    ),
    "Capacity": ResultFiles(
        summary="capacity.md",
        tables={"capacity.csv": "to_csv"},
        figures={
            "capacity.png": "plots.rating_figures.capacity_figure",
            "sheet.pdf": "plots.capacity_sheet.capacity_sheet_figure",
        },
        documents={"capacity.html": "page.capacity_page.write_capacity_page"},
        text=_capacity_text,
        more=_write_capacity_derivatives,
        more_files=("slopes.csv",),
        options=("torques", "parameters"),
        notebook_figures=("plots.rating_figures.capacity_figure",),
    ),
    "Comparison": ResultFiles(
        summary="comparison.md",
        text=_comparison_text,
        more=_write_comparison,
        more_files=(RECORDING, RECORDING_NPZ, SUMMARY, "comparison.png"),
        stale=lambda *_: (FIGURE, PAGE),
        options=("npz",),
        notebook_figures=("plots.calibration_figure.comparison_figure",),
    ),
    "CylinderFriction": ResultFiles(
        summary="friction.txt",
        text=_text_with_unit,
        more=_write_friction,
        more_files=("friction.png",),
        options=("unit",),
    ),
    "Design": ResultFiles(
        summary="design.md",
        tables={"solutions.csv": "to_csv"},
        figures={"design.png": "plots.study_figures.design_figure"},
        more=_write_design,
        more_files=("before.png", "after.png", _MACHINE),
        stale=lambda *_: (UNFINISHED,),
    ),
    "Excitation": ResultFiles(
        tables={"reference.csv": "to_csv", "coefficients.yaml": "to_yaml"},
        figures={"reference.png": "plots.identification_figures.excitation_figure"},
    ),
    "Identification": ResultFiles(
        tables={"parameters.csv": "to_csv"},
        more=_write_identification,
        more_files=(REPORT, _MACHINE),
        options=("recordings", "validation"),
        stale=lambda result, folder: _machine_files(result.described_machine, folder),
        notebook_figures=("plots.identification_figures.force_figures",),
    ),
    "LinearModel": ResultFiles(
        summary="modes.md",
        tables={"model.mat": "save", "model.npz": "save"},
        figures={"modes.png": "plots.modes_figure.modes_figure"},
        more=_write_modes,
        more_files=("over.png", PAGE),
        options=("models",),
        motion=lambda model: (model.machine, model.mode_animation()),
    ),
    "OrificeCoefficients": ResultFiles(
        summary="orifices.txt",
        text=_orifices_text,
        more=_write_orifices,
        more_files=("orifices.png",),
        options=("unit", "validation"),
    ),
    "PowerBalance": ResultFiles(
        summary="power.md",
        tables={"power.csv": "to_csv"},
        figures={
            "sankey.png": "plots.sankey_diagram.sankey_figure",
            "power.png": "plots.power_figure.power_figure",
        },
        text=_power_text,
    ),
    "PowerComparison": ResultFiles(
        summary="comparison.md",
        figures={"comparison.png": "plots.power_figure.power_comparison_figure"},
        text=_power_comparison_text,
    ),
    "Recording": ResultFiles(
        summary=SUMMARY,
        text=_recording_text,
        more=_write_recording,
        more_files=(RECORDING, RECORDING_NPZ, FIGURE, PAGE),
        stale=lambda *_: ("comparison.md", "comparison.png"),
        options=("npz", "views"),
        motion=lambda run: (load_from_expression(run.machine), run),
        notebook_figures=("plots.recording_figure.recording_figure",),
    ),
    "SectionChart": ResultFiles(
        summary="sections.md",
        tables={"sections.csv": "to_csv"},
        figures={"sections.png": "plots.rating_figures.section_figure"},
    ),
    "Sensitivities": ResultFiles(
        summary="sensitivities.md",
        tables={"sensitivities.csv": "to_csv"},
        figures={"sensitivities.png": "plots.modes_figure.sensitivities_figure"},
    ),
    "SignalExcitation": ResultFiles(
        tables={"signals.csv": "to_csv"},
        figures={"signals.png": "plots.identification_figures.signals_figure"},
    ),
    "Study": ResultFiles(
        tables={"study.csv": "to_csv"},
        figures={"study.png": "plots.study_figures.study_figure"},
        stale=lambda *_: (UNFINISHED,),
    ),
    "LiftChart": ResultFiles(
        summary="lift_chart.md",
        tables={"lift_chart.csv": "to_csv"},
        figures={"lift_chart.png": "plots.rating_figures.lift_figure"},
        documents={"lift_chart.html": "page.capacity_page.write_capacity_page"},
    ),
    "ToolForce": ResultFiles(
        summary="tool_force.md",
        tables={"tool_force.csv": "to_csv"},
        figures={"tool_force.png": "plots.rating_figures.tool_force_figure"},
    ),
    "ValveCurve": ResultFiles(
        summary="valve.txt",
        text=_text_with_unit,
        more=_write_valve,
        more_files=("valve.png",),
        options=("unit",),
    ),
    "WorkingRange": ResultFiles(
        summary="working_range.md",
        tables={"working_range.csv": "to_csv"},
        figures={"working_range.png": "plots.workspace_figures.working_range_figure"},
    ),
    "Workspace": ResultFiles(
        summary="workspace.md",
        tables={"workspace.csv": "to_csv", "curves.csv": "curves_to_csv"},
        figures={"workspace.png": "plots.workspace_figures.workspace_figure"},
    ),
}
