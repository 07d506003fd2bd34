"""Folders of results that are computed for long: an unfinished one goes on with --resume."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from crane.cli.command import refuse_options
from crane.cli.options import OptionalOutputFolder, OutputFolder
from crane.cli.terminal import print_message
from crane.common.atomic_output import check_folder_is_writable
from crane.common.errors import InputError, OutputError
from crane.common.result import UNFINISHED


@dataclass(frozen=True, kw_only=True)
class OptionalResumableFolder(OptionalOutputFolder):
    """The folder of a result, none by default, with what is finished until it is complete."""

    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the unfinished result in the folder.")
    ] = False

    def check(self) -> None:
        """Raise an error if the folder cannot be written, or holds an unfinished result."""
        if self.out is None:
            refuse_options({"--resume": self.resume}, "needs the folder, add --out FOLDER")
        elif not (self.out / UNFINISHED).is_file():
            super().check()
        elif self.resume or self.force:
            check_folder_is_writable(self.out)
        else:
            raise OutputError(
                f"{self.out}: holds an unfinished result, add --resume to go on with it, or "
                "--force to begin anew"
            )

    @contextmanager
    def checkpoint(self) -> Iterator[Path | None]:
        """Context of the file of what is finished; says that it is kept if the block is ended."""
        if self.out is None:
            yield None
            return
        file = self.out / UNFINISHED
        if not self.resume:
            file.unlink(missing_ok=True)
        try:
            yield file
        except (Exception, KeyboardInterrupt) as error:
            # not of another computation
            if file.is_file() and not isinstance(error, InputError):
                print_message(f"what is finished is kept in {file}: add --resume to go on")
            raise


@dataclass(frozen=True, kw_only=True)
class ResumableFolder(OptionalResumableFolder, OutputFolder):
    """The folder of a result, with what is finished until it is complete."""
