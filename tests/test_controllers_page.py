"""The program of docs/controllers.md works as the page describes."""

import re
import warnings
from pathlib import Path

import numpy as np
import pytest

import crane
from crane.common.errors import CraneWarning, InputError
from crane.control import ControlLaw
from crane.simulation.integration.machine_code_stepper import RungeKuttaStepper
from crane.simulation.integration.python_stepper import PythonStepper

PAGE = Path(__file__).parents[1] / "docs" / "controllers.md"

pytestmark = pytest.mark.filterwarnings("ignore::crane.common.errors.CraneWarning")


@pytest.fixture(scope="module")
def page():
    """What is defined after the page's blocks."""
    blocks = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    assert len(blocks) == 6
    names: dict = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        exec(compile("\n".join(blocks), str(PAGE), "exec"), names)
    return names


def test_the_page_does_what_it_says(page):
    assert page["recording"].time[-1] == pytest.approx(0.1)
    assert page["slow"].channels["reference_q1"].shape == page["slow"].time.shape
    # the drives do come to their limits, and the law waits as the class does
    at_limit = np.abs(page["slow"].tau) == page["most"]
    assert at_limit.any() and not at_limit.all()
    for name in ("q", "v", "tau"):
        slow, fast = getattr(page["slow"], name), getattr(page["fast"], name)
        np.testing.assert_allclose(fast, slow, rtol=0, atol=1e-9 * np.abs(slow).max())
    assert np.ptp(page["swinging"].q, axis=0).min() > 1e-6


def test_the_program_of_a_control_unit_holds_its_signals(page):
    """A period's signal is what the program says of the recorded state at its first instant."""
    run, crane_, lift = page["raised"], page["log_crane"], page["lift"]
    assert run["X_lift"][0] < 0.15 and run["X_lift"][-1] == pytest.approx(0.2, abs=2e-3)
    assert run.controller == "SampledCommand" and run.time[1] == pytest.approx(1e-3)
    rows = range(0, len(run.time) - 1, 10)
    pressures = np.stack(
        [
            np.column_stack([run[f"pressure_{joint}_{side}"][rows] for side in "ab"])
            for joint in crane_.hydraulics.joints
        ],
        axis=1,
    )
    wanted = [
        page["control_unit"](run.time[k], run.q[k], run.v[k], p)
        for k, p in zip(rows, pressures, strict=True)
    ]
    for i, name in enumerate(page["spools"]):
        held = np.repeat(np.array(wanted)[:, i], 10)
        np.testing.assert_allclose(run[f"voltage_{name}"][:-1], held, rtol=0, atol=1e-6)
    assert (pressures[:, lift, 0] > 80e5).any()


def test_errors_of_three_controllers_are_the_page_s(page):
    machine, trajectory = page["machine"], page["trajectory"]
    controllers = {
        "`Held`": page["Held"](machine, trajectory, 50.0),
        "`crane.PI`": crane.PI(machine, trajectory),
        "`crane.ComputedTorque`": crane.ComputedTorque(machine, trajectory, 20.0),
    }
    for name, control in controllers.items():
        run = crane.simulate(machine, control, step=0.01)
        error = 1e3 * np.abs(run.q - trajectory.position(run.time))[:, 1:]
        (row,) = [line for line in PAGE.read_text().splitlines() if line.startswith(f"| {name}")]
        told = [float(cell) for cell in row.strip("|").split("|")[1:]]
        np.testing.assert_allclose(told, [*error.max(axis=0), *error[-1]], atol=0.006)


def test_held_knows_its_gains_by_what_friction_leaves(page):
    """At rest kp e is the friction that sticks at most, which four times the kp shows."""
    machine, trajectory, w = page["machine"], page["trajectory"], 50.0
    ends = []
    for fast in (w, 2 * w):
        run = crane.simulate(machine, page["Held"](machine, trajectory, fast), step=0.01)
        ends.append(run.q[-1] - trajectory.position(run.time[-1]))
    np.testing.assert_allclose(ends[0][1:], 4.0 * np.array(ends[1][1:]), rtol=0.02)


def test_a_law_sees_the_weight_alone_in_numbers_and_traced(page):
    """Whatever moves: the forces that a run records are `gravity` of the postures it passed."""

    machine, start = page["machine"], page["trajectory"].position(0.0)
    push = np.array([0.5, 40.0, -60.0])  # more than its friction

    class Weight(ControlLaw):
        def initial_state(self, at):
            return at.gravity()

        def law(self, at):
            return np.array(at.gravity()) + push, np.zeros(3)

    dynamics, law = crane.Dynamics(machine), Weight(machine)
    weight, moving = dynamics.gravity(start), np.array([0.5, 0.05, -0.05])
    np.testing.assert_allclose(law.start(start), weight, rtol=0, atol=1e-12)
    seen = law(0.0, start, moving, np.zeros(3))[0]
    np.testing.assert_allclose(seen, weight + push, rtol=0, atol=1e-12)
    coriolis = dynamics.inverse(start, moving, np.zeros(3)) - weight
    assert np.abs(coriolis).max() > 1e-2
    run = crane.simulate(machine, law, start, duration=0.1)
    assert np.ptp(run.q, axis=0).min() > 1e-3
    np.testing.assert_allclose(run.tau - push, dynamics.gravity(run.q), rtol=0, atol=1e-9)


def test_laws_of_the_page_run_without_python(page, monkeypatch):
    monkeypatch.setattr(PythonStepper, "observe", None)
    monkeypatch.setattr(PythonStepper, "advance", None)
    for name in ("law", "shaken"):
        start = page["trajectory"].position(0.0)
        crane.simulate(page["machine"], page[name], start, duration=0.02)


@pytest.mark.parametrize("name", ["law", "shaken"])
def test_one_law_gives_the_same_in_numbers_and_traced(page, name):
    law, machine = page[name], page["machine"]
    start = page["trajectory"].position(0.0) + [0.05, 1e-3, -5e-4]

    class Called:
        def start(self, q_a):
            return law.start(q_a)

        def __call__(self, *seen):
            return law(*seen)

    runs = [
        crane.simulate(machine, one, start, duration=0.05, method="rk4") for one in (law, Called())
    ]
    assert np.abs(runs[0].q - runs[1].q).max() < 1e-12
    scale = np.abs(runs[0].tau).max(axis=0)
    assert (np.abs(runs[0].tau - runs[1].tau).max(axis=0) < 1e-9 * scale).all()


def test_settings_reuse_machine_code_and_other_numbers_do_not(page, monkeypatch):
    machine, trajectory, most = page["machine"], page["trajectory"], page["most"]
    made = []
    build = RungeKuttaStepper._build
    monkeypatch.setattr(
        RungeKuttaStepper, "_build", lambda x, program: made.append(x) or build(x, program)
    )
    tighter = crane.simulate(
        machine, page["Fast"](machine, trajectory, 0.5 * most), duration=0.2, method="rk4"
    )
    assert not made
    assert (np.abs(tighter.tau).max(axis=0) == 0.5 * most).any()
    start, damping = trajectory.position(0.0), np.diag([0.05, 500.0, 500.0])
    stronger = page["Shaken"](machine, np.array([0.8, 40.0, 40.0]), damping)
    one, two = (
        crane.simulate(machine, law, start, duration=0.1, method="rk4")
        for law in (page["shaken"], stronger)
    )
    assert len(made) == 1
    swing = [r.tau[:, 0] + damping[0, 0] * r.v[:, 0] - page["weight"][0] for r in (one, two)]
    np.testing.assert_allclose(swing[1], 2 * swing[0], atol=1e-12)


def test_states_begin_where_the_machine_stands(page):
    """`begin` receives the inverse dynamics at the start."""

    class Held(ControlLaw):
        def initial_state(self, at):
            return at.inverse([0.0, 0.0, 0.0], friction=False)

        def law(self, at):
            return at.state, [0.0, 0.0, 0.0]

    machine, q_a = page["machine"], page["trajectory"].position(0.0)
    weight = crane.Dynamics(machine).inverse(q_a, np.zeros(3), np.zeros(3))
    np.testing.assert_allclose(Held(machine).start(q_a), weight, rtol=1e-12, atol=1e-12)
    recording = crane.simulate(machine, Held(machine), q_a, duration=0.01)
    np.testing.assert_array_equal(recording.tau[0], Held(machine).start(q_a))


def test_wrong_numbers_of_forces_and_rates_are_told(page):
    machine, start = page["machine"], page["trajectory"].position(0.0)

    class Short(ControlLaw):
        def law(self, at):
            return at.v_a[:2], at.v_a

    with pytest.raises(InputError, match="law of Short gives 2 forces and 3 rates, give 3 and 0"):
        crane.simulate(machine, Short(machine), start, duration=0.01)

    class Wide:
        def start(self, q_a):
            return np.zeros(1)

        def __call__(self, time, q_a, v_a, state):
            return np.zeros(4), state

    told = r"Wide gives forces of the shape \(4,\) and rates of the shape \(1,\), give \(3,\) and"
    with pytest.raises(InputError, match=told):
        crane.simulate(machine, Wide(), start, duration=0.01)


def test_a_branch_in_a_law_is_an_error(page):
    class Branching(ControlLaw):
        def law(self, at):
            return [1.0 if x > 0 else -1.0 for x in at.q_a], ()

    with pytest.raises(TypeError, match="'>' not supported"):
        crane.simulate(page["machine"], Branching(page["machine"]), duration=0.01)
