"""Runs a fuzzing program as a process and collects its verdicts."""

import json
import os
import subprocess
import sys
from pathlib import Path


def judge(program, *arguments):
    """How many cases a program beside this file has judged, all of them right.

    It prints a line of JSON for each case that it tells of, with "wrong" where that is so, and at
    the end the number of cases as "done".
    """
    done = subprocess.run(
        [sys.executable, str(Path(__file__).with_name(program)), *map(str, arguments)],
        capture_output=True, text=True, timeout=7200,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    wrong = [line for line in lines if "wrong" in line]
    assert not wrong, wrong[:5]
    assert done.returncode == 0, f"ended at {lines[-1:]}: {done.stderr[-1000:]}"
    return lines[-1]["done"]
