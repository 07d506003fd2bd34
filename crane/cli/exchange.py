"""Commands on files: convert for machines, import for recordings, schema for editors."""

import tempfile
import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

import crane
from crane.cli.command import command, refuse_options
from crane.cli.options import (
    MachineName,
    MachineOptions,
    OutputFolder,
    OverwriteOptions,
    RecordingOptions,
    RequiredOutputFile,
)
from crane.cli.simulate import ExportedController
from crane.cli.terminal import status
from crane.common.atomic_output import (
    check_file_is_writable,
    check_folder_is_writable,
    replace_file,
)
from crane.common.errors import CraneError, CraneWarning, InputError, check_name


@dataclass(frozen=True, kw_only=True)
class OutputPath(OutputFolder):
    """The folder or file that a machine is written to; the command checks it."""

    def check(self) -> None:
        """Check nothing."""


_FORMATS = ("urdf+", "urdf", "mjcf", "machine")
_TARGETS = ("c", "fmu", "ros2_control")
_SUFFIXES = {".urdf": "urdf+", ".xml": "mjcf", ".mjcf": "mjcf"}


@command()
def convert(
    machine: MachineName,
    out: Annotated[
        Path,
        typer.Argument(
            metavar="OUT", help="A .urdf or .xml file, or the folder of a machine file."
        ),
    ],
    options: MachineOptions,
    output: OverwriteOptions,
    to: Annotated[
        str | None,
        typer.Option(
            metavar="FORMAT",
            help="Format: urdf+ (one URDF with its loops), urdf (loops cut), mjcf or machine "
            "(machine file); derived from the suffix of OUT by default.",
        ),
    ] = None,
) -> None:
    """Convert a machine to URDF, MJCF or a machine file."""
    kind = _output_format(out, to)
    check = check_folder_is_writable if kind == "machine" else check_file_is_writable
    check(out, output.force)
    loaded, written = options.load(machine), out
    if kind == "urdf":
        with replace_file(out) as temporary_file:
            temporary_file.write_text(crane.formats.robot_description(loaded), encoding="utf-8")
    elif kind == "machine":
        written = crane.write_machine(loaded, out, overwrite=output.force)
    else:
        write = crane.formats.write_urdf_plus if kind == "urdf+" else crane.formats.write_mjcf
        write(loaded, out)
    print(f"written to {written}")


@command()
def export(
    machine: MachineName,
    options: MachineOptions,
    output: OutputPath,
    to: Annotated[
        str,
        typer.Option(
            metavar="TARGET",
            help="c: C99 sources; fmu: a file for FMI; ros2_control: a transmission.",
        ),
    ] = "c",
    controller: ExportedController = None,
    name: Annotated[
        str,
        typer.Option(metavar="NAME", help="Prefix of all names; that of the machine by default."),
    ] = "",
    fmi: Annotated[int, typer.Option(metavar="VERSION", help="Version of FMI, 3 or 2.")] = 3,
) -> None:
    """Write a machine as a program for another environment."""
    check_name(to, _TARGETS, f"--to is '{to}'")
    if to == "fmu":
        refuse_options({"--name": name or None}, "is not for --to fmu, leave it out")
    else:
        refuse_options({"--fmi": fmi != 3 or None}, "is for --to fmu, leave it out")
        check_folder_is_writable(output.out, output.force)
    if to == "ros2_control":
        refuse_options({"--controller": controller}, "is for --to c or fmu, leave it out")
    loaded, law = options.load(machine), None
    if controller is not None:
        law = crane.control.make_controller(controller, loaded)
    if to == "fmu":
        _write_fmu(loaded, output, fmi, law)
    elif to == "c":
        written = crane.export.write_c(
            loaded, output.out, controller=law, name=name, overwrite=output.force
        )
        print(f"written to {written}: see its header, or cmake -B build -S {written}")
    else:
        write = crane.export.write_ros2_control
        written = write(loaded, output.out, name=name, overwrite=output.force)
        print(f"written to {written}: a package for colcon build")


def _write_fmu(machine: "crane.Machine", output: OutputPath, fmi: int, law: Any) -> None:
    """Write a machine as an FMU, with its sketch as icon and its facts as documentation."""
    from crane.view.notebook import to_html

    out = output.out
    path = out if out.suffix == ".fmu" else out.with_name(f"{out.name}.fmu")
    check_file_is_writable(path, output.force)
    icon = b""
    with tempfile.TemporaryDirectory() as folder, suppress(CraneError):
        crane.sketch(machine, Path(folder) / "icon.png")
        icon = (Path(folder) / "icon.png").read_bytes()
    about = to_html(machine) or ""
    with status("compiling the machine"):
        crane.export.write_fmu(machine, path, fmi, controller=law, icon=icon, about=about)
    print(f"written to {path}: an FMU of FMI {fmi}")


def _output_format(out: Path, to: str | None) -> str:
    """The format of --to, or of the suffix of a path.

    Raises:
        InputError: It is unknown, or does not go with the path.
    """
    suffix = out.suffix.lower()
    kind = to or _SUFFIXES.get(suffix, "machine")
    check_name(kind, _FORMATS, f"--to is '{kind}'")
    if kind == "machine" and suffix in {*_SUFFIXES, ".yaml", ".yml"}:
        raise InputError(f"{out}: a machine file comes with its URDFs, give the name of a folder")
    if to is None and suffix and suffix not in _SUFFIXES:
        raise InputError(
            f"{out}: {suffix} is not written, give a .urdf or .xml file, or a folder; where the "
            "folder shall have this name, --to machine"
        )
    return kind


@command("import")
def import_log(
    log: Annotated[
        Path, typer.Argument(metavar="LOG", help="A CSV or npz file of another program.")
    ],
    reading: RecordingOptions,
    output: RequiredOutputFile,
) -> None:
    """Convert a log of another program to a recording."""
    from crane.recordings import timeseries
    from crane.recordings.logs import read_log_columns
    from crane.recordings.recording_reader import read_sensor_readings, select_time_span

    if output.out.suffix.lower() != ".csv":
        raise InputError(f"{output.out}: a recording is written as .csv, name it so")
    if (columns := reading.columns) is None:
        raise InputError(
            "nothing says what the columns of the log are, give a file with a line per column of "
            "the recording (--columns FILE)"
        )
    check_file_is_writable(output.out, output.force)
    machine, name = None, read_log_columns(columns)[0].get("machine", "")
    try:
        machine = crane.formats.load_from_expression(name) if name else None
    except CraneError as error:
        warnings.warn(
            f"{columns}: names of columns are not checked, its machine cannot be read: {error}",
            CraneWarning,
            stacklevel=2,
        )
    table = select_time_span(read_sensor_readings(log, machine, columns), reading.span, log)
    timeseries.write_table(output.out, table)
    print(f"{len(table.values)} samples of {len(table.units)} columns written to {output.out}")


@command()
def schema() -> None:
    """Print the JSON Schema of machine files."""
    from crane.formats.machine_file.json_schema import schema_text

    print(schema_text(), end="")
