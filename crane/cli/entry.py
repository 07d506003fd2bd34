"""The program: its commands by group, its help, and what happens to errors."""

import gc
import io
import os
import sys
import warnings
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

import crane
from crane.cli.command import app
from crane.cli.parsing import parse_gravity
from crane.cli.terminal import INTERRUPTED, activity_line, ending_signals, print_message
from crane.common.errors import CraneError, CraneWarning, format_one_line
from crane.common.package_search import use_load_options

_GC_THRESHOLD = 20_000  # objects between collections: nearly all that starting makes stays

GROUPS = {  # modules of this room and their commands, in the order of use
    "describe": "new list info check add",
    "simulate": "demo simulate sway modes sensitivities",
    "identify": "excite identify payload circuit calibrate",
    "rate": "workspace working-range breakout capacity stability settle sections power",
    "design": "study design",
    "show": "view plot sketch live draw",
    "exchange": "convert export import schema",
}
_SIGNAL_STATUS = 128  # exit status of a process that a signal has ended, less its number
_FLAGS = ("--debug", "--strict", "--trust-xacro")  # that all commands take
_HELP = """\
Simulate, identify, rate and design machines with closed kinematic chains:
  crane new excavator --size 20t                write a machine file of your own
  crane simulate mini_forwarder --task lift     simulate a task of a machine
  crane view simulate                           show this run in a browser

{commands}
COMMAND --help shows options. All take --gravity --strict --trust-xacro --debug.
"""


class _CommandGroup(TyperGroup):
    """The commands, with a help of one screen."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help: examples, then all commands by group."""
        lines = []
        for group, names in GROUPS.items():
            title = group
            for name in names.split():
                text = (self.commands[name].help or "").partition("\n")[0].rstrip(".")
                lines.append(f"{title:9} {name:14} {text}")
                title = ""
        formatter.write(_HELP.format(commands="\n".join(lines)))


def program(command: str = "") -> typer.Typer:
    """The program with the command of that name at least, or with all where none has it."""
    homes = [group for group, names in GROUPS.items() if command in names.split()]
    for home in homes or GROUPS:
        import_module(f"crane.cli.{home}")
    return app


def main() -> None:
    """Run the command line: errors are one line, exit status 2."""
    gc.set_threshold(_GC_THRESHOLD)
    arguments = [word for word in sys.argv[1:] if word not in _FLAGS]
    gravity_text = _take_gravity(arguments)
    debug, strict, trust = (word in sys.argv[1:] for word in _FLAGS)
    if isinstance(sys.stdout, io.TextIOWrapper):  # names of files may be no text
        sys.stdout.reconfigure(errors="backslashreplace")
    warnings.showwarning = _show_warning
    warnings.simplefilter("once", CraneWarning)
    with ending_signals() as signals:
        try:
            gravity = None if gravity_text is None else parse_gravity(gravity_text)
            run = program(*arguments[:1])
            with (
                activity_line(" ".join(["crane", *arguments[:1]])),
                use_load_options(strict=strict, trust_xacro=trust, gravity=gravity),
            ):
                status = run(
                    args=arguments or ["--help"], standalone_mode=False, prog_name="crane"
                )
            if signals or status == INTERRUPTED:  # what the parser makes of KeyboardInterrupt
                raise KeyboardInterrupt
            if sys.stdout is not None:  # it is where the shell has closed it
                sys.stdout.flush()
        except SystemExit as end:
            sys.exit(_SIGNAL_STATUS + signals[0] if signals else end.code)
        except (Exception, KeyboardInterrupt) as error:
            # libraries may have made another error of an interruption
            if signals or isinstance(error, KeyboardInterrupt):
                print_message("error: interrupted, no result was written")
                sys.exit(_SIGNAL_STATUS + signals[0] if signals else INTERRUPTED)
            if debug:
                raise
            print_message(f"error: {_error_text(error)}")
            sys.exit(2)
    if not arguments:  # the help was shown, but nothing was done
        sys.exit(2)
    sys.exit(status if isinstance(status, int) else 0)


def _take_gravity(arguments: list[str]) -> str | None:
    """Remove the first --gravity from the arguments, and return its value."""
    for i, word in enumerate(arguments):
        name, equals, value = word.partition("=")
        if name == "--gravity":
            following = [] if equals else arguments[i + 1 : i + 2]
            del arguments[i : i + 1 + len(following)]
            return value if equals else "".join(following)
    return None


def _error_text(error: Exception) -> str:
    """The line about an error that is handled; exits, or raises it, where there is none."""
    if isinstance(error, CraneError):
        return str(error)
    if isinstance(error, OSError):
        if sys.stdout is not None:  # nor may the interpreter's end complain about the output
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):  # the reader has closed the pipe
            sys.exit(1)
        place, reason = error.filename or "output", error.strerror or error
        return f"{format_one_line(f'{place}: {reason}')}, check the place and try again"
    # errors of the command line parser, whose class is not public
    message = getattr(error, "format_message", None)
    if message is None:
        raise
    if not (text := message()):  # the help was shown
        sys.exit(2)
    command = getattr(getattr(error, "ctx", None), "command_path", "crane")
    shows = "the commands" if command == "crane" else "what it takes"
    return f"{format_one_line(' '.join(text.split()))} ({command} --help shows {shows})"


def _show_version(is_given: bool) -> None:
    if is_given:
        print(f"crane {crane.__version__}")
        raise typer.Exit


@app.callback(cls=_CommandGroup)
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", is_eager=True, callback=_show_version, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Machines with closed kinematic chains: simulate, identify and show."""


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    print_message(f"warning: {format_one_line(str(message))}")
