"""Runs that stop early, and remarks on runs: chatter, end stops, pistons."""

import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import warned
from broken_machines import DATA
from command_line import typed
from oracles import SliderCrank

import crane
from crane.common.errors import CraneError, SimulationError
from crane.recordings.recording_summary import energy_imbalance

SLIDER_CRANK = Path(__file__).parent / "data" / "slider_crank.yaml"
STOPPED = re.compile(r"at t = (\S+) s: joint 's' at a dead centre, where inverse dynamics is und")

pytestmark = pytest.mark.filterwarnings("ignore::crane.CraneWarning")


def broken(error, *arguments, **options):
    """What is left of a run that stops with an error."""
    with pytest.raises(error) as caught:
        crane.simulate(*arguments, **options)
    return caught.value.recording, str(caught.value)


def same(part, whole):
    """One run is the start of another, to the last bit, in all columns."""
    assert list(part) == list(whole)
    for name in part:
        np.testing.assert_array_equal(part[name], whole[name][: len(part.time)], err_msg=name)


def test_errors_of_controllers_carry_the_run_until_then(mini):
    """Any exception of a Python controller leaves the samples up to its step."""

    def hold(until):
        def law(time, q_a, v_a):
            if time > until:
                raise ZeroDivisionError("a law's own\nfault")
            return [100.0, -300.0, 200.0]

        return law

    found, text = broken(ZeroDivisionError, mini, hold(0.05), duration=0.2, label="push")
    assert text == "a law's own\nfault" and found.task == "push"
    assert found.stopped == "at t = 0.05 s: a law's own fault"
    whole = crane.simulate(mini, hold(1.0), duration=0.2)
    assert len(found.time) == 51
    same(found, whole)


@pytest.mark.parametrize("backend", ["compiled", "pinocchio"])
def test_an_explosion_leaves_finite_numbers(mini, backend):
    free = mini.replace(friction={}, end_stops=())

    def law(time, q_a, v_a):
        return [0.0, -2e4, 0.0]

    found, text = broken(SimulationError, free, law, duration=0.5, backend=backend)
    assert found.stopped == text and "explodes" in text
    until = found.time[-1]
    assert text.startswith("at t = ") and 0.0 < until <= float(text.split()[3]) + 1e-9
    same(found, crane.simulate(free, law, duration=until, backend=backend))


def test_a_stop_that_gains_energy_ends_it_before_the_stop_is_met(mini):
    machine = mini.replace(friction={}, end_stops=(crane.description.EndStop("X1", 1e8),))
    start = np.array([0.0, 0.0295, 0.015]), np.array([0.0, 0.3, 0.0])
    found, text = broken(SimulationError, machine, None, start, 0.01, 1e-3, method="rk4")
    assert found.stopped == text and "gives back" in text
    assert found["X1"][-1] <= machine.upper[1] < found["X1"][-1] + 1e-3 * found["X1_velocity"][-1]


def test_what_cannot_begin_leaves_nothing():
    machine = crane.load("mini_forwarder", {"link3_G.x": 0.11, "link3_G.y": -0.01})
    found, text = broken(SimulationError, machine, None, [0.0, 0.015, 0.005], 0.1)
    assert found is None and text.startswith("at t = 0 s, where the motion starts")


@pytest.mark.parametrize("form", ["csv", "npz"])
def test_files_keep_why_a_run_stopped(slider_crank, tmp_path, form):
    run = crane.simulate(slider_crank, duration=0.02)
    assert run.stopped == "" and "stopped" not in repr(run)
    cut = crane.Recording(**{**vars(run), "stopped": "at t = 0.02 s: it's over"})
    assert repr(cut).endswith("; stopped at t = 0.02 s: it's over")
    path = tmp_path / f"run.{form}"
    getattr(cut, f"to_{form}")(path)
    assert crane.Recording.read(path).stopped == cut.stopped
    with pytest.raises(CraneError, match="stopped .* is not one line of text"):
        crane.Recording(**{**vars(run), "stopped": "two\nlines"})


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A slider that is to go farther than its crank and rod reach, from the command line."""
    folder = tmp_path_factory.mktemp("stopped")
    (folder / "out.csv").write_text("time [s],s [m]\n0,0.37\n0.5,0.39\n1,0.43\n")
    command = ("simulate", SLIDER_CRANK, "--active", "s", "--path", "out.csv", "--out", "run")
    return folder / "run", typed(*command, cwd=folder), command


def test_a_run_that_stops_is_written_and_says_so(stopped):
    folder, result, _ = stopped
    assert (result.returncode, result.stdout) == (2, "")
    assert "Traceback" not in result.stderr
    line = result.stderr.splitlines()[-1]
    assert line.startswith("error: at t = ") and STOPPED.search(line)
    assert line.endswith("; results until t = 0.582 s are written to run")
    assert sorted(path.name for path in folder.iterdir()) == ["recording.csv", "summary.md"]
    recording = crane.Recording.read(folder / "recording.csv")
    assert recording.time[-1] == pytest.approx(0.582)
    told = STOPPED.match(recording.stopped)
    assert told and recording.time[-1] < float(told[1]) < recording.time[-1] + 2e-3
    # it gets as far as crank and rod in line do
    reach = np.sqrt((SliderCrank.r + SliderCrank.rod) ** 2 - SliderCrank.e**2)
    last = recording["s"][-1]
    assert last < reach < last + 2e-3 * recording["s_velocity"][-1]
    header = (folder / "recording.csv").read_text().partition("\ntime")[0].splitlines()
    assert f"# stopped: {recording.stopped}" in header
    summary = (folder / "summary.md").read_text()
    assert summary.startswith("# slider_crank: out (stopped at 0.582 s)\n")
    assert f"**Stopped {recording.stopped}**" in summary


def test_page_and_figure_of_a_stopped_run_say_so(stopped):
    from crane.view.plots.recording_figure import recording_figure

    folder, _, _ = stopped
    result = typed("view", folder, "--no-open")
    assert result.returncode == 0, result.stderr
    page = (folder / "view.html").read_text()
    recording = crane.Recording.read(folder / "recording.csv")
    assert "<title>slider_crank: out (stopped at 0.582 s)</title>" in page
    assert f'["stopped","{recording.stopped}"]' in page
    figure = recording_figure(recording)
    assert figure.get_suptitle() == "slider_crank: out (stopped at 0.582 s)"


def test_an_earlier_run_is_replaced_only_where_that_is_asked(stopped, tmp_path):
    folder, _, command = stopped
    before = (folder / "recording.csv").read_bytes()
    result = typed(*command, cwd=folder.parent)
    assert result.returncode == 2 and "is not empty" in result.stderr
    assert (folder / "recording.csv").read_bytes() == before


# --- remarks ------------------------------------------------------------------------------------


told = partial(warned.told, crane.simulate)


def returning(machine):
    return crane.PI(machine, crane.task_trajectory(machine, "return"))


def test_friction_that_steps_do_not_follow_is_told_as_chatter(smooth):
    """At 2 ms its energies balance to 0.5 %, and friction is wrong by half of itself."""
    coarse, lines = told(smooth, returning(smooth), step=2e-3, method="rk4")
    (line,) = lines
    count = re.match(r"friction of 'q1', 'X1', 'X2' chatters in (\d+) of 5001 samples", line)
    assert count and "leave that out, so that it sticks" in line
    fine, lines = told(smooth, returning(smooth), step=5e-4, method="rk4")
    assert not lines
    law = smooth.friction["X1"]
    one, two = (law.coulomb * np.tanh(v / law.smoothing) for v in (coarse.v[:, 1], fine.v[::4, 1]))
    wrong = np.abs(one - two) > 0.1 * law.coulomb
    assert 0.5 * wrong.sum() < int(count[1]) < 2.0 * wrong.sum()
    assert np.abs(one - two).max() > 0.4 * law.coulomb


def test_friction_that_sticks_and_steps_by_their_error_do_not_chatter(mini, smooth):
    assert not told(mini, returning(mini), step=2e-3, method="rk4")[1]
    assert not told(smooth, returning(smooth), step=2e-3, method="DOP853")[1]


def test_a_stop_that_gains_energy_is_an_error(mini):
    """A block of steel against a stop that four steps go through."""
    machine = mini.replace(friction={}, end_stops=(crane.description.EndStop("X1", 1e8),))
    start = np.array([0.0, 0.0295, 0.015]), np.array([0.0, 0.3, 0.0])
    with pytest.raises(SimulationError) as caught:
        crane.simulate(machine, None, start, 0.01, 1e-3, method="rk4")
    text = str(caught.value)
    assert "the end stop of 'X1' gives back" in text and "\n" not in text
    found, _ = told(machine, None, start, 0.01, 1e-3, method="DOP853")
    assert found.q[:, 1].max() > machine.upper[1]


def test_a_piston_beyond_its_cylinder_is_told():
    machine = crane.load("patu655")
    soft = tuple(
        crane.description.EndStop(stop.joint, 1e-2 * stop.stiffness, stop.damping)
        for stop in machine.end_stops
    )
    lift = machine.active.index("X_lift")

    def against(machine):
        levers = crane.control.ValveSignals(machine, [0.0, 1.0], {"X_lift": [0.0, 4.0]})
        return told(machine, levers, duration=16.0, step=2e-3)

    found, lines = against(machine.replace(end_stops=soft))
    (line,) = (line for line in lines if "beyond its stroke" in line)
    depth = float(re.search(r"is ([\d.e-]+) m beyond its stroke at t = ", line)[1])
    q = found.q[:, lift]
    beyond = np.maximum(machine.lower[lift] - q, q - machine.upper[lift])
    assert depth == pytest.approx(beyond.max(), rel=1e-2)
    assert not [line for line in against(machine)[1] if "beyond its stroke" in line]


@pytest.mark.parametrize("push", [1e-17, 1e-10, 1e-7])
def test_a_machine_that_hardly_moves_has_no_imbalance(push):
    """Rounding and tolerances are no long steps: energies of 1e-17 J in a machine of 0.1 kg m."""
    machine = crane.load(DATA / "four_bar.yaml").replace(forces=(), end_stops=())
    found, lines = told(machine, lambda t, q, v: np.array([push]), duration=0.3, method="RK45")
    assert lines == [] and np.abs(found.v).max() < 1e-6
    gap = np.abs(energy_imbalance(found)).max()
    assert gap > 5e-3 * max(np.ptp(found["work"]), np.ptp(found["kinetic"]))


def test_an_imbalance_of_a_small_motion_is_told():
    """Friction that a step of 1 ms does not follow, at 1e-3 rad/s."""
    machine = crane.load(DATA / "four_bar.yaml").replace(forces=(), end_stops=())
    _, lines = told(machine, lambda t, q, v: np.array([1e-5]), duration=0.3, method="rk4")
    (line,) = [x for x in lines if "so the step of 0.001 s is too long" in x]
    assert re.match(r"work, energy and dissipation differ by \d\S*e-06 J of \d\S*e-06 J", line)
