"""Valid files with bytes changed, and odd graphs, by the thousand: read, or refused in one line.

What counts as well is in fuzz.py: an error of the package or a closed machine, within a bound on
the work, that is the same as before exactly if another parser finds the same words and numbers in
the file. In graphs.py it is that whatever is no tree is told, ring by ring, within such a bound.
"""

import pytest
from judge import judge

FORMATS = ("machine", "urdf", "urdf+", "parallel", "mjcf", "sdf", "xacro")
GRAPHS = FORMATS[:-1]


def run(kind, first, count, program="fuzz.py"):
    if kind in ("mjcf", "xacro"):
        pytest.importorskip({"mjcf": "mujoco"}.get(kind, kind))
    if kind == "xacro":  # each in a process of its own
        first, count = first // 10, count // 10
    assert judge(program, kind, first, count) == count


@pytest.mark.parametrize("kind", FORMATS)
def test_some_changed_files(kind):
    run(kind, 0, 30)


@pytest.mark.parametrize("kind", GRAPHS)
def test_some_odd_graphs(kind):
    run(kind, 0, 20, "graphs.py")


@pytest.mark.slow
@pytest.mark.parametrize("kind", GRAPHS)
def test_hundreds_of_odd_graphs(kind):
    run(kind, 0, 200, "graphs.py")


@pytest.mark.slow
@pytest.mark.parametrize("part", range(2))
@pytest.mark.parametrize("kind", FORMATS)
def test_hundreds_of_changed_files(kind, part):
    """More by hand: python tests/fuzz.py KIND FIRST COUNT."""
    run(kind, 2500 * part, 700)
