"""Files with changed bytes and with odd graphs are read, or refused in one line.

`fuzz.py` demands an error of the package or a closed machine within a bound on the executed lines,
and the same machine as before exactly if another parser finds the same words and numbers in the
file. `fuzz_graphs.py` demands that every cycle of a graph that is no tree is reported.
"""

import pytest
from fuzz_process import judge

FORMATS = ("machine", "urdf", "urdf+", "parallel", "mjcf", "sdf", "xacro")
GRAPHS = FORMATS[:-1]


def run(kind, first, count, program="fuzz.py"):
    if kind in ("mjcf", "xacro"):
        pytest.importorskip({"mjcf": "mujoco"}.get(kind, kind))
    if kind == "xacro":  # each in a process of its own
        first, count = first // 10, count // 10
    assert judge(program, kind, first, count) == count


@pytest.mark.slow
@pytest.mark.parametrize("count", [25, pytest.param(200, marks=pytest.mark.long)])
@pytest.mark.parametrize("kind", GRAPHS)
def test_odd_graphs(kind, count):
    run(kind, 0, count, "fuzz_graphs.py")


@pytest.mark.slow
@pytest.mark.parametrize(("first", "count"), [
    (30, 30), pytest.param(0, 700, marks=pytest.mark.long),
    pytest.param(2500, 700, marks=pytest.mark.long),
])  # fmt: skip
@pytest.mark.parametrize("kind", FORMATS)
def test_more_changed_files(kind, first, count):
    """Still more by hand: python tests/fuzz.py KIND FIRST COUNT."""
    run(kind, first, count)


# --- options ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_calls_that_were_reported():
    assert judge("fuzz_options.py", "reported") > 30


@pytest.mark.slow
@pytest.mark.parametrize("part", (0, 1, 2, 3))
@pytest.mark.long
def test_options_at_the_edge(part):
    assert judge("fuzz_options.py", 1000 + 250 * part, 20) == 20
