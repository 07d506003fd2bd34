"""Options at the edge of what they take: an answer, or one line that says what is wrong.

What counts as well is in fuzz_options.py: exit status 0 to 2, no traceback, within 20 s of
computing and 2 GB, an error alone on its line and nothing left behind it, and of a call that
succeeds no figure that no machine has.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest


def run(*arguments):
    """Judge calls in a process of its own, which forks one for each of them."""
    program = Path(__file__).with_name("fuzz_options.py")
    done = subprocess.run(
        [sys.executable, str(program), *map(str, arguments)],
        capture_output=True, text=True, timeout=3500,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-1000:]
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    wrong = [line for line in lines if "wrong" in line]
    assert not wrong, wrong[:5]
    return lines[-1]["done"]


def test_some_options_at_the_edge():
    assert run(0, 12) == 12


@pytest.mark.slow
def test_calls_that_were_reported():
    assert run("reported") > 30


@pytest.mark.slow
@pytest.mark.parametrize("part", range(4))
def test_options_at_the_edge(part):
    assert run(1000 + 250 * part, 40) == 40
