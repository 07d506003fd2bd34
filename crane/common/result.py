"""Base class of results that can be written into a folder."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from crane.common.one_line_repr import OneLineRepr

UNFINISHED = "unfinished.csv"  # checkpoint in the folder of a result that is not complete
# Writes a result into a folder: `crane.view.result_files.write_result`. The package sets it,
# because results are defined in rooms that may not import `view` (see CONTRIBUTING.md).
write_result: Callable[..., str]


class Result(OneLineRepr):
    """A result: one line at a prompt, HTML in a notebook, and a folder of files."""

    def write(self, folder: str | Path, overwrite: bool = False, **options: Any) -> str:
        """Write the summary, tables, figures and pages of the result into a folder.

        The files are those that the command line writes; the page on files of results lists them
        and the options of each class.

        Args:
            folder: The folder; created if it does not exist.
            overwrite: Replace files of an earlier result. Files that this class may write and that
                do not belong to this result are removed, others stay. If False, the folder has to
                be new or empty.
            options: Options of the class.

        Returns:
            The summary, as Markdown or plain text.

        Raises:
            OutputError: The folder cannot be written, or holds files and `overwrite` is False.
        """
        return write_result(self, folder, overwrite, **options)  # noqa: F821 - set by the package
