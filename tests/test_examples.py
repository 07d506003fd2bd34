"""Every program of examples/ ends without a warning and prints what the index says."""

import ast
import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "examples"
INDEX = {
    program: (question, line)
    for question, program, line in re.findall(
        r"^\| (.+?) \| \[(\w+\.py)\]\(\2\) \| `(.+)` \|$",
        (FOLDER / "README.md").read_text(),
        re.MULTILINE,
    )
}
NEEDS = {
    "live_view.py": "viser", "optimal_control.py": "casadi",
    "study_on_a_cluster.py": "distributed",
}  # fmt: skip
SHORT = "close_a_loop.py", "first_machine.py", "load_urdf.py"


def test_the_index_has_every_program_with_its_question():
    programs = {path.name: path.read_text() for path in FOLDER.glob("*.py")}
    asked = {name: ast.get_docstring(ast.parse(text)) for name, text in programs.items()}
    assert asked == {name: question for name, (question, _) in INDEX.items()}
    assert all(question.endswith("?") for question in asked.values())


@pytest.mark.slow
@pytest.mark.parametrize(
    "program",
    [pytest.param(x, marks=() if x in SHORT else pytest.mark.long) for x in sorted(INDEX)],
)
def test_programs_print_what_the_index_says(program, tmp_path):
    needed = NEEDS.get(program)
    if needed and not find_spec(needed):
        pytest.skip(f"{needed} is not installed")
    if program.startswith("ros2_") and find_spec("rclpy"):
        pytest.skip("a node of ROS runs until it is stopped")
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    run = subprocess.run(
        [sys.executable, FOLDER / program],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert (run.returncode, run.stderr) == (0, "")
    assert INDEX[program][1] in run.stdout
