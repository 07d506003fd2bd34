"""The command line called in this process, with its exit status, output and errors."""

import contextlib
import io
import os
import subprocess
import sys
import traceback
import warnings
from unittest import mock

from crane.cli import main

# The same in a process of its own, for what belongs to one: closed outputs, signals, imports.
MAIN = "from crane.cli import main; main()"


class _Output(io.TextIOWrapper):
    """A stream that holds what is written, as bytes like a pipe's."""

    def __init__(self):
        super().__init__(io.BytesIO(), encoding="utf-8", write_through=True)

    @property
    def text(self):
        return self.buffer.getvalue().decode()


def typed(*arguments, cwd=None):
    """`crane ARGUMENTS` in a folder: its exit status, output and errors, a traceback included."""
    words = ["crane", *map(str, arguments)]
    out, err = _Output(), _Output()
    status = 0
    warnings.onceregistry.clear()  # a process tells a warning once; this is a new one
    with (
        mock.patch.object(sys, "argv", words),
        warnings.catch_warnings(),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        contextlib.chdir(cwd or os.curdir),
    ):
        try:
            main()
        except SystemExit as end:
            status = end.code or 0
        except Exception:
            traceback.print_exc()
            status = 1
    return subprocess.CompletedProcess(words, status, out.text, err.text)
