"""The programs of `benchmarks/user_code/`: the same four-bar in all engines."""

import importlib.util
import runpy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from cost_of_use import USER_CODE, call_times, code_lines, first_simulator, tables
from dense_equations import exact_forward
from engines.pinocchio_engine import Pinocchio
from multibody import Multibody
from problem import problems
from reference import DenseMotion
from scipy.integrate import solve_ivp
from warned import quiet

import crane

ACCURACIES = {  # of the position after 1 s with the steps of the program [m]
    "crane": ("crane", 1e-10),
    "pinocchio": ("pinocchio", 1e-9),
    "mujoco": ("mujoco", 1e-7),
    "exudyn": ("exudyn", 1e-5),
    "drake": ("pydrake", 1e-3),
    "mujoco_warp": ("mujoco_warp", 1e-3),
    "newton": ("newton", 1e-3),
}
COMPILING = ("mujoco_warp", "newton")


@pytest.fixture(scope="module")
def expected():
    """Position of the rocker's end after 1 s by the dense equations with multipliers."""
    system = Multibody.from_machine(quiet(crane.load, USER_CODE / "four_bar.urdf"), {})
    motion = DenseMotion(SimpleNamespace(system=system))
    run = solve_ivp(motion.rate, (0, 1), motion.start, "DOP853", rtol=1e-12, atol=1e-12)
    q, v = motion.tree(motion.corrected(run.y[:, -1]))
    return system.point(system.state(q, v), system.loops[0].successor)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.long if name in COMPILING else ())
        for name in ACCURACIES
    ],
)
def test_programs_of_users_end_at_the_same_position(name, expected, capsys):
    module, accuracy = ACCURACIES[name]
    if importlib.util.find_spec(module) is None:
        pytest.skip(f"{module} is not installed")
    runpy.run_path(str(USER_CODE / f"with_{name}.py"))
    printed = capsys.readouterr().out.splitlines()[-1]
    error = np.linalg.norm(np.array(printed.split(), float) - expected)
    assert np.linalg.norm(expected - [0.9, 0, -0.5]) > 0.08  # it moves
    assert error < accuracy


def test_lines_of_code_are_counted_without_comments(tmp_path):
    assert {path.stem for path in USER_CODE.glob("*.py")} == {
        f"with_{name}" for name in ACCURACIES
    }
    path = tmp_path / "program.py"
    path.write_text(
        '"""Two\nlines."""\n\n# a comment\nx = (\n    1\n)\n\n\ndef f():\n    """Text."""\n'
    )
    assert code_lines(path) == 4


def test_costs_are_those_of_a_simulator_with_the_common_step():
    problem = replace(problems(["n_four_bar_2"])[0], duration=0.5)
    setting, simulator, _ = quiet(first_simulator, problem, Pinocchio("constraintDynamics"))
    assert setting[0] == 5e-3
    calls = []
    found = call_times(lambda: calls.append(simulator.single_call()()))
    assert len(calls) == 1100 and found.keys() == {"first", "thousandth"}
    start = (system := problem.system).q, system.v
    expected = exact_forward(system)(*start, system.joint_forces(*start))
    np.testing.assert_allclose(calls[-1], expected, rtol=0, atol=1e-6)


def test_an_engine_that_fails_is_a_line_of_the_table():
    found = {"problem": "bricard", "engine": "E", "failure": "no setting simulates"}
    text = "\n".join(tables([found]))
    assert "| E | - | - | - | - | - | - | no setting simulates |" in text
    assert "| crane | " in text
