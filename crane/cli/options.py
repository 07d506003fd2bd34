"""Arguments and options that several commands share, each declared once."""

import os
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Annotated, Any

import typer

import crane
from crane.cli.command import OptionBlock, number_option
from crane.cli.parsing import parse_arguments, parse_changes, parse_names, parse_values
from crane.cli.terminal import status
from crane.common.atomic_output import check_file_is_writable, check_folder_is_writable
from crane.common.errors import OutputError
from crane.common.result import UNFINISHED, Result

# Arguments and options of several commands that are not part of a block.
MachineName = Annotated[
    str,
    typer.Argument(
        metavar="MACHINE",
        help="Name of a bundled machine, or path of a machine file, URDF, SDF or MJCF.",
    ),
]
RecordingFile = Annotated[
    Path,
    typer.Argument(
        metavar="RECORDING",
        help="A recording (CSV or npz) or the folder of a run.",
    ),
]
RecordingFiles = Annotated[
    list[Path],
    typer.Argument(
        metavar="RECORDING...",
        help="Recordings (CSV or npz) or folders of runs.",
    ),
]
Task = Annotated[str | None, typer.Option(metavar="TASK", help="A task of the machine file.")]
Tasks = Annotated[
    list[str] | None,
    typer.Option(
        metavar="TASK",
        help="A task of the machine file that is evaluated; may be repeated; all by default.",
    ),
]
Frame = Annotated[
    str | None,
    typer.Option(
        metavar="LINK",
        help="Link that carries the load or represents the tool; the tip by default.",
    ),
]
Bandwidth = Annotated[
    float | None,
    number_option("Hz", "Cutoff of the low-pass filter; derived from the motion by default."),
]
CentreOfMass = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,Z",
        help="Known centre of mass of the load in the frame, in m; estimated by default.",
    ),
]
Bucket = Annotated[
    str | None, typer.Option(metavar="JOINT", help="The joint whose drive curls the bucket.")
]
Configuration = Annotated[
    str | None,
    typer.Option(
        "--at",
        metavar="JOINT=VALUE,...",
        help="Active coordinates in m or rad; those of the home configuration by default.",
    ),
]
Rule = Annotated[
    str,
    typer.Option(
        metavar="RULE",
        help="Rule: none, iso10567, en12999, sfs4677 or iso14397 (-crawler, -forks, -rough).",
    ),
]
Outputs = Annotated[
    str | None,
    typer.Option(metavar="NAMES", help="Outputs, e.g. X_lift,tip_z; default: joints, pressures."),
]
ComparedColumns = Annotated[
    str | None,
    typer.Option(
        "--sensors",
        metavar="COLUMNS",
        help="Measured columns, e.g. X_lift,pressure_X_lift_a; strokes and pressures by default.",
    ),
]
_FIT_OPTION = typer.Option(
    metavar="NAME[=START,LOW~HIGH]",
    help="A parameter to fit, e.g. payload.mass, friction.*.viscous, sensor.q2.zero; auto: all "
    "parameters that the recordings determine; may be repeated.",
)
Fit = Annotated[list[str], _FIT_OPTION]
OptionalFit = Annotated[list[str] | None, _FIT_OPTION]
_BY_OPTION = typer.Option(
    "--by",
    metavar="NAME",
    help="A parameter by which results are differentiated, e.g. payload.mass, oil.bulk_modulus, "
    "lift_eye.x; may be repeated.",
)
Parameters = Annotated[list[str], _BY_OPTION]
OptionalParameters = Annotated[list[str] | None, _BY_OPTION]
Seed = Annotated[int, typer.Option(help="Seed of the random numbers.")]
Method = Annotated[
    str,
    typer.Option(
        metavar="METHOD",
        help="Estimator: wls (joints weighted by their noise, the default), ols (ordinary least "
        "squares) or huber (robust).",
    ),
]
TrainingWindow = Annotated[
    str | None,
    typer.Option(
        "--train",
        metavar="FROM:TO",
        help="Start and end of the training data in s; the rest validates the estimate.",
    ),
]
Validation = Annotated[
    list[Path] | None,
    typer.Option(
        metavar="FILE", help="Another recording that validates the estimate; may be repeated."
    ),
]
Trust = Annotated[
    bool,
    typer.Option(
        "--trust", help="Use a recording that fails a check, with a warning instead of an error."
    ),
]
Requirements = Annotated[
    list[str] | None,
    typer.Option(
        "--require",
        metavar="A>=B",
        help="A constraint on measures, with >=, <= or ==; may be repeated.",
    ),
]
UserMeasures = Annotated[
    Path | None,
    typer.Option(
        "--measures",
        metavar="FILE.py",
        help="Python file with functions that compute measures of a machine.",
    ),
]
Force = Annotated[bool, typer.Option("--force", help="Replace existing files.")]


@dataclass(frozen=True, kw_only=True)
class ChangeOptions(OptionBlock):
    """Changed parameters of a machine."""

    panel = "Machine options"
    changes: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="New value of a parameter, e.g. payload.mass=200 or supply.pressure=200bar; may "
            "be repeated.",
        ),
    ] = None

    def changed_values(self) -> dict[str, float | str]:
        """Values of the changed parameters, texts of those with units."""
        return parse_changes("--set", self.changes, "NAME=VALUE, as in payload.mass=200")


@dataclass(frozen=True, kw_only=True)
class ParameterOptions(ChangeOptions):
    """Changed parameters and locked joints of a machine."""

    lock: Annotated[
        list[str] | None,
        typer.Option(
            metavar="JOINT=VALUE",
            help="A joint to lock and its coordinate in m or rad or with a unit, e.g. slew=30deg; "
            "may be repeated.",
        ),
    ] = None

    def load(self, name: str) -> "crane.Machine":
        """Load a machine by its name or path."""
        return crane.load(
            name, self.changed_values(), parse_changes("--lock", self.lock), **self.assembly()
        )

    def assembly(self) -> dict[str, Any]:
        """Arguments of `crane.load` about how a description is read and assembled."""
        return {}


@dataclass(frozen=True, kw_only=True)
class PackageOptions(OptionBlock):
    """Where files of a description are found, and arguments of xacro files."""

    panel = "Machine options"
    packages: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FOLDER",
            help="A folder with ROS packages (package:// paths); may be repeated.",
        ),
    ] = None
    argument: Annotated[
        list[str] | None,
        typer.Option(
            "--arg", metavar="NAME:=VALUE", help="An argument of a xacro file; may be repeated."
        ),
    ] = None

    def package_values(self) -> dict[str, Any]:
        """Arguments of `crane.load` by name."""
        return {"packages": self.packages or (), "arguments": parse_arguments(self.argument)}


@dataclass(frozen=True, kw_only=True)
class AssemblyOptions(PackageOptions):
    """How a description is assembled."""

    active: Annotated[
        str | None,
        typer.Option(
            metavar="JOINTS", help="Active joints, e.g. lift,tilt, instead of those of the file."
        ),
    ] = None
    free: Annotated[
        str | None,
        typer.Option(metavar="JOINTS", help="Active joints without an actuator, e.g. swing,sway."),
    ] = None
    floating: Annotated[
        bool,
        typer.Option(
            "--floating",
            help="Connect the root to the world by a 6-DOF joint (vehicle, humanoid).",
        ),
    ] = False

    def assembly(self) -> dict[str, Any]:
        """Arguments of `crane.load` by name."""
        return {
            "active": parse_names(self.active), "free": parse_names(self.free),
            "floating": self.floating, **self.package_values(),
        }  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class MachineOptions(AssemblyOptions, ParameterOptions):
    """All options of a machine."""


@dataclass(frozen=True, kw_only=True)
class TimeOptions(OptionBlock):
    """Which part of a recording is read."""

    panel = "Recording options"
    since: Annotated[
        float | None, number_option("s", "Start of the part to read, in recorded time.", "--from")
    ] = None
    until: Annotated[float | None, number_option("s", "End of the part to read.", "--until")] = (
        None
    )

    @property
    def span(self) -> tuple[float, float]:
        """Start and end [s] of the part to read."""
        start = -inf if self.since is None else self.since
        return start, inf if self.until is None else self.until


@dataclass(frozen=True, kw_only=True)
class RecordingOptions(TimeOptions):
    """Which part and which columns of a recording are read."""

    columns: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="File with a line per column of the recording: name, unit, and formula in the "
            "columns of a log of another program.",
        ),
    ] = None

    def read(
        self, path: Path, machine: "crane.Machine | None" = None, needs: Any = ()
    ) -> "crane.Recording":
        """Read a recording, see `crane.recordings.measured_recordings.read_run`."""
        from crane.recordings.measured_recordings import read_run

        return read_run(path, machine, self.columns, self.span, needs)


@dataclass(frozen=True, kw_only=True)
class ShiftedRecordingOptions(RecordingOptions):
    """Which part and which columns of a recording are read, without their delays."""

    shift: Annotated[
        list[str] | None,
        typer.Option(
            metavar="COLUMN=SECONDS",
            help="Delay of a column, which is corrected; negative if it is ahead of the others, "
            "e.g. *_force=0.03; may be repeated.",
        ),
    ] = None

    def read(
        self, path: Path, machine: "crane.Machine | None" = None, needs: Any = ()
    ) -> "crane.Recording":
        """Read a recording, and shift its columns."""
        recording = super().read(path, machine, needs)
        if not self.shift:
            return recording
        return crane.recordings.shift_columns(
            recording, parse_values("--shift", self.shift, lambda _: ("s",))
        )


@dataclass(frozen=True, kw_only=True)
class ParallelOptions(OptionBlock):
    """Where variants are computed."""

    panel = "Computing options"
    processes: Annotated[
        int | None, typer.Option(help="Number of processes; one per core by default.")
    ] = None
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Address of the scheduler of a Dask cluster."),
    ] = None

    def arguments(self) -> dict[str, Any]:
        """Arguments of `crane.study` and `crane.design` by name."""
        return {
            "processes": (os.cpu_count() or 1) if self.processes is None else self.processes,
            "scheduler": self.scheduler,
        }


def _as_path(text: str | Path) -> Path:
    if not str(text):
        raise OutputError("the name after --out is empty, give one")
    return Path(text)


def _default_folder(context: typer.Context, folder: Path) -> Path:
    source = context.get_parameter_source("out")
    is_given = source is not None and source.name != "DEFAULT"
    return folder if is_given else Path(str(context.info_name).replace("-", "_"))


@dataclass(frozen=True, kw_only=True)
class OptionalOutputFolder(OptionBlock):
    """The folder that a result is written to; none by default."""

    panel = "Output options"
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="FOLDER",
            parser=_as_path,
            help="Folder of the results; none by default.",
        ),
    ] = None
    force: Force = False

    def check(self) -> None:
        """Raise an error if there is a folder and it cannot be written."""
        if self.out is not None:
            check_folder_is_writable(self.out, self.force)

    def write(self, result: Result, note: str = "", **options: Any) -> None:
        """Print the summary of a result, and write it if there is a folder.

        Args:
            result: The result.
            note: Text after the name of the folder.
            options: Options of `Result.write`.
        """
        from crane.view.result_files import result_summary

        if self.out is None:
            print(result_summary(result, **options).rstrip())
            return
        overwrite = self.force or (self.out / UNFINISHED).is_file()  # which the result replaces
        with status("writing the results"):
            text = result.write(self.out, overwrite, **options)
        print(f"{text.rstrip()}\n\nwritten to {self.out}{note}")


@dataclass(frozen=True, kw_only=True)
class OutputFolder(OptionalOutputFolder):
    """The folder that a result is written to; one named like the command by default."""

    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", metavar="FOLDER", parser=_as_path, callback=_default_folder,
            show_default=False, help="Folder of the results; named like the command by default.",
        ),
    ] = Path()  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class OverwriteOptions(OptionBlock):
    """Whether files are replaced."""

    panel = "Output options"
    force: Force = False


_OUT_FILE = typer.Option("--out", "-o", metavar="FILE", parser=_as_path, help="The file to write.")


@dataclass(frozen=True, kw_only=True)
class OutputFile(OptionBlock):
    """The file that a command writes."""

    panel = "Output options"
    out: Annotated[Path | None, _OUT_FILE] = None
    force: Force = False

    def path(self, default: Path) -> Path:
        """The file to write.

        Raises:
            OutputError: It exists and may not be replaced, or it cannot be written.
        """
        file = self.out or default
        check_file_is_writable(file, self.force)
        return file


@dataclass(frozen=True, kw_only=True)
class RequiredOutputFile(OutputFile):
    """The file that a command writes, without a default."""

    out: Annotated[Path, _OUT_FILE] = field()
