"""Damaged visuals, meshes and recordings are accepted, or refused in one line.

What counts as well is in fuzz_inputs.py: nothing that is drawn refuses a machine; a recording is
plotted, shown, identified from and replayed, or refused by an error of the package; each within
20 s of computing and 2 GB.
"""

import pytest
from fuzz_process import judge

COUNTS = {"visuals": 120, "meshes": 10, "npz": 50, "csv": 90}  # meshes: 20 files each


def run(kind, first, count):
    pytest.importorskip("resource")  # not on Windows
    assert judge("fuzz_inputs.py", kind, first, count) == count


@pytest.mark.slow
@pytest.mark.parametrize("part", [16, pytest.param(1, marks=pytest.mark.long)])
@pytest.mark.parametrize("kind", COUNTS)
def test_damaged_inputs(kind, part):
    run(kind, 0, COUNTS[kind] // part)
