"""Damaged visuals, meshes and recordings by the hundred: taken, or refused in one line.

What counts as well is in fuzz_inputs.py: nothing that is drawn refuses a machine; a recording is
plotted, shown, identified from and replayed, or refused by an error of the package; each within
20 s of computing and 2 GB.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SOME = {"visuals": 8, "meshes": 1, "npz": 10, "csv": 12}
MANY = {"visuals": 300, "meshes": 20, "npz": 120, "csv": 180}  # meshes: 20 files each


def run(kind, first, count):
    """Judge cases in a process of its own, whose memory is limited."""
    pytest.importorskip("resource")  # not on Windows
    program = Path(__file__).with_name("fuzz_inputs.py")
    done = subprocess.run(
        [sys.executable, str(program), kind, str(first), str(count)],
        capture_output=True, text=True, timeout=7200,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    wrong = [line for line in lines if "wrong" in line]
    assert not wrong, wrong[:5]
    assert done.returncode == 0, f"ended at {lines[-1:]}: {done.stderr[-600:]}"
    assert lines[-1] == {"done": count}


@pytest.mark.parametrize("kind", SOME)
def test_some_damaged_inputs(kind):
    run(kind, 0, SOME[kind])


@pytest.mark.slow
@pytest.mark.parametrize("kind", MANY)
def test_hundreds_of_damaged_inputs(kind):
    run(kind, 0, MANY[kind])
