"""What all commands share: the program, its arguments, loading and progress."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crane.cli.waiting import on_terminal, shown
from crane.common.errors import InputError, OutputError

if TYPE_CHECKING:
    from crane.machine import Machine

# Commands import what they need when they run, so that `crane --help` answers at once.

INTERRUPTED = 130  # exit status
_AT_ONCE = 0.3  # [s] for which nobody needs a bar

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _place(text: str | Path) -> Path:
    if not str(text):
        raise OutputError("the name after --out is empty, give one")
    return Path(text)


def _folder(context: typer.Context, folder: Path) -> Path:
    """The folder that is given, or else that of the command's name."""
    source = context.get_parameter_source("out")
    given = source is not None and source.name != "DEFAULT"
    return folder if given else Path(str(context.info_name).replace("-", "_"))


MachineName = Annotated[
    str,
    typer.Argument(
        metavar="MACHINE", help="A bundled name, a machine file, a URDF, an SDF or a MJCF."
    ),
]
Force = Annotated[bool, typer.Option("--force", help="Overwrite what is there.")]
Out = Annotated[
    Path,
    typer.Option(
        "--out",
        metavar="FOLDER",
        parser=_place,
        callback=_folder,
        show_default=False,
        help="Folder for the results; if not given, one here that is called as the command.",
    ),
]
BY_COMMAND = Path()  # default of `Out`
OutFile = Annotated[
    Path | None,
    typer.Option("--out", metavar="FILE", parser=_place, help="The file to write."),
]
RecordingFile = Annotated[
    Path,
    typer.Argument(metavar="RECORDING", help="A recording (CSV or npz) with forces or pressures."),
]
Columns = Annotated[
    Path | None,
    typer.Option(
        "--columns", metavar="FILE", help="Which columns of a raw log are which, as for import."
    ),
]
Require = Annotated[
    list[str] | None, typer.Option(metavar="A>=B", help="What has to hold, or A<=B, or A==B.")
]
OwnMeasures = Annotated[
    Path | None,
    typer.Option(metavar="FILE.py", help="Measures of your own: functions of a machine."),
]
LoadFrame = Annotated[
    str | None, typer.Option(metavar="LINK", help="Where loads hang; the tip if not given.")
]
LoadRule = Annotated[
    str, typer.Option(help="By which loads are rated: none, iso10567, en12999 or sfs4677.")
]
Processes = Annotated[int | None, typer.Option(help="To compute with; one per core if not given.")]
Scheduler = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="Of a Dask cluster to compute on.")
]
From = Annotated[
    float | None,
    typer.Option("--from", metavar="SECONDS", help="Read from here on, by the recording's clock."),
]
Until = Annotated[
    float | None, typer.Option("--until", metavar="SECONDS", help="Read up to here.")
]
Method = Annotated[
    str, typer.Option(help="wls (joints by their noise), ols, or huber (robust to outliers).")
]
Change = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="NAME=VALUE", help="Another value of a parameter, as payload.mass=200."
    ),
]
Lock = Annotated[
    list[str] | None,
    typer.Option(metavar="JOINT=VALUE", help="A joint that is held, and where, in m or rad."),
]
Active = Annotated[
    str | None,
    typer.Option(metavar="JOINTS", help="Driven joints, as lift,tilt, if not those of the file."),
]
Free = Annotated[
    str | None,
    typer.Option(metavar="JOINTS", help="Coordinates that nothing drives, as swing,sway."),
]
Packages = Annotated[
    list[Path] | None,
    typer.Option(metavar="FOLDER", help="A folder of packages that files name; may be repeated."),
]
Argument = Annotated[
    list[str] | None,
    typer.Option("--arg", metavar="NAME:=VALUE", help="An argument of a xacro file."),
]
Floating = Annotated[
    bool, typer.Option("--floating", help="Let the root float: a vehicle, a humanoid.")
]
Recordings = Annotated[
    list[Path],
    typer.Argument(
        metavar="RECORDING...", help="Recordings (CSV or npz) with forces or pressures."
    ),
]
Validation = Annotated[
    list[Path] | None,
    typer.Option(metavar="FILE", help="A recording that is held out; may be repeated."),
]
Train = Annotated[
    str | None,
    typer.Option(metavar="FROM:TO", help="Seconds that are fitted; the rest is held out."),
]
Trust = Annotated[
    bool,
    typer.Option(
        "--trust", help="Take a recording that looks wrong: tell why, and refuse it not."
    ),
]
NoOpen = Annotated[bool, typer.Option("--no-open", help="Do not open the browser.")]


def span_of(since: float | None, until: float | None) -> tuple[float, float]:
    """From when to when [s], by --from and --until.

    Raises:
        InputError: Nothing lies between them.
    """
    span = -inf if since is None else since, inf if until is None else until
    if not span[0] < span[1]:
        raise InputError(f"nothing lies from {span[0]:g} to {span[1]:g} s, give a later --until")
    return span


def by_joint(
    option: str, words: list[str] | None, form: str = "JOINT=VALUE, as in X1=0.5"
) -> dict[str, float]:
    """Numbers by joint, from JOINT=VALUE.

    Raises:
        InputError: Something else is written, a joint twice, or a number that nothing has.
    """
    from crane.common.samples import as_number

    out: dict[str, float] = {}
    for word in words or ():
        joint, _, text = word.rpartition("=")
        try:
            value = float(text)
        except ValueError:
            joint, value = "", 0.0
        if not joint:
            raise InputError(f"{option} is '{word}', write {form}")
        if joint in out:
            raise InputError(f"{option} names '{joint}' twice, give it once")
        out[joint] = as_number(value, f"{option} {joint}", "")
    return out


def window(text: str | None) -> tuple[float, float]:
    """From when to when --train is [s]; everything if not given.

    Raises:
        InputError: Something else is written.
    """
    first, colon, last = (text or ":").partition(":")
    try:
        start, end = float(first or "-inf"), float(last or "inf")
    except ValueError:
        start, end = 0.0, 0.0
    if not colon or not start < end:
        raise InputError(f"--train is '{text}', write FROM:TO in seconds, as 0:13.5")
    return start, end


def load(
    name: str,
    lock: list[str] | None = None,
    change: list[str] | None = None,
    active: str | None = None,
    free: str | None = None,
    floating: bool = False,
    packages: list[Path] | None = None,
    argument: list[str] | None = None,
) -> "Machine":
    """The machine of that name or path with what options say of it."""
    from crane.formats import load as load_machine

    changes = by_joint("--set", change, "NAME=VALUE, as in payload.mass=200")
    held = by_joint("--lock", lock)
    return load_machine(
        name, changes, held, names(active), names(free), floating, packages or (),
        arguments(argument),
    )  # fmt: skip


def arguments(words: list[str] | None) -> dict[str, str]:
    """Values by name, from NAME:=VALUE.

    Raises:
        InputError: Something else is written.
    """
    found = {}
    for word in words or ():
        name, separator, value = word.partition(":=")
        if not separator or not name.strip():
            raise InputError(f"--arg is '{word}', write NAME:=VALUE")
        found[name.strip()] = value
    return found


def names(words: str | None) -> list[str] | None:
    """Joints of a list with commas."""
    return None if words is None else [word.strip() for word in words.split(",") if word.strip()]


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[float], None]]:
    """What takes the finished share, 0 to 1; a bar on a terminal, where it takes a while."""
    began = time.monotonic()
    with ExitStack() as until_then:
        draw: Callable[[float], None] | None = None

        def report(share: float) -> None:
            nonlocal draw
            if draw is None and on_terminal() and time.monotonic() - began > _AT_ONCE:
                draw = until_then.enter_context(_bar(what))
            if draw is not None:
                draw(share)

        yield report


@contextmanager
def _bar(what: str) -> Iterator[Callable[[float], None]]:
    from rich.console import Console
    from rich.progress import Progress

    with shown(), Progress(console=Console(stderr=True), transient=True) as bar:
        job = bar.add_task(what, total=1.0)
        yield lambda share: bar.update(job, completed=share)


@contextmanager
def status(what: str) -> Iterator[None]:
    """Say what takes a while, where somebody watches."""
    if not on_terminal():
        yield
        return
    from rich.console import Console

    with shown(), Console(stderr=True).status(what):
        yield


def say(text: str) -> None:
    """To whoever watches, beside the results."""
    print(text, file=sys.stderr)
