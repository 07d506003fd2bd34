"""The program: options of all commands, and what becomes of errors."""

import gc
import io
import os
import sys
import warnings
from importlib import import_module
from typing import Annotated

import typer

import crane
from crane.cli.shared import INTERRUPTED, app, say
from crane.cli.waiting import watched
from crane.common.errors import CraneError, CraneWarning, format_one_line
from crane.common.package_search import use_load_options

_SPARING = 20_000  # objects between collections: nearly all that starting makes is there to stay

_HOMES = {  # modules of this room, in the order of `crane --help`, and the commands in each
    "add": "add",
    "breakout": "breakout",
    "calibrate": "calibrate",
    "capacity": "capacity",
    "check": "check",
    "circuit": "circuit",
    "commands": "list info view plot demo",
    "convert": "convert import",
    "design": "design",
    "excite": "excite",
    "identify": "identify payload",
    "live": "live",
    "modes": "modes",
    "pictures": "sketch",
    "power": "power",
    "schema": "schema",
    "sensitivities": "sensitivities",
    "simulate": "simulate",
    "stability": "stability",
    "study": "study",
    "sway": "sway",
    "working_range": "working-range",
    "workspace": "workspace",
}


def program(command: str = "") -> typer.Typer:
    """The program with the command of that name at least, or with all where none has it."""
    homes = [home for home, names in _HOMES.items() if command in names.split()]
    for home in homes or _HOMES:
        import_module(f"crane.cli.{home}")
    return app


def main() -> None:
    """Run the command line: errors are one line, exit status 2."""
    gc.set_threshold(_SPARING)
    arguments = [word for word in sys.argv[1:] if word not in ("--debug", "--strict")]
    debug, strict = (word in sys.argv[1:] for word in ("--debug", "--strict"))
    if isinstance(sys.stdout, io.TextIOWrapper):  # names of files may be no text
        sys.stdout.reconfigure(errors="backslashreplace")
    warnings.showwarning = _show_warning
    warnings.simplefilter("once", CraneWarning)
    try:
        run = program(*arguments[:1])
        with watched(" ".join(["crane", *arguments[:1]])), use_load_options(strict=strict):
            status = run(args=arguments, standalone_mode=False, prog_name="crane")
        if status == INTERRUPTED:  # what the parser makes of KeyboardInterrupt
            raise KeyboardInterrupt
        if sys.stdout is not None:  # it is where the shell has closed it
            sys.stdout.flush()
    except CraneError as error:
        if debug:
            raise
        say(f"error: {error}")
        sys.exit(2)
    except KeyboardInterrupt:
        say("error: interrupted, nothing was written")
        sys.exit(INTERRUPTED)
    except OSError as error:
        if debug:
            raise
        _abandon_output()
        if isinstance(error, BrokenPipeError):  # whoever read it has seen enough
            sys.exit(1)
        place = error.filename or "output"
        reason = error.strerror or error
        say(f"error: {format_one_line(f'{place}: {reason}')}, check the place and try again")
        sys.exit(2)
    except Exception as error:
        # the command line parser's own errors, whose class is not public
        message = getattr(error, "format_message", None)
        if debug or message is None:
            raise
        if text := message():
            context = getattr(error, "ctx", None)
            command = getattr(context, "command_path", "crane")
            shows = "the commands" if command == "crane" else "what it takes"
            say(
                f"error: {format_one_line(' '.join(text.split()))} ({command} --help shows "
                f"{shows})"
            )
        sys.exit(2)
    sys.exit(status if isinstance(status, int) else 0)


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"crane {crane.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", is_eager=True, callback=_show_version, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Machines with closed kinematic chains: simulate, identify and show.

    Every command takes --strict, which refuses inertias that no body has, and --debug.
    """


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    say(f"warning: {format_one_line(str(message))}")


def _abandon_output() -> None:
    """Let the interpreter end without a word on what could not be written."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
