"""Motions beyond joint limits: a warning before the run, an error that names the joint."""

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from rig import Rig
from scipy.optimize import brentq
from warned import quiet

import crane
from crane.common.errors import ClosureError, CraneWarning, InputError, LimitError, SimulationError
from crane.control import SampledCommand, ValvePD
from crane.description.specification import PIGains
from crane.motion.limit_violations import limit_violation_message, passive_limit_violation_message
from crane.motion.trajectory import polynomial

SLIDER = Path(__file__).parent / "data" / "slider_crank.yaml"
# 10 u^3 - 15 u^4 + 6 u^5 = 1 / 31 at u = 0.1609
TOLD = (
    "the reference of 'X1' goes to 0.06 m at t = 0.1 s, beyond its limit 0.03 m "
    "(chain_b1.urdf:57) from t = 0.01609 s on: "
)
NAMED = r"^at t = 0\.0\d+ s[: ].*; 'X1' is at 0\.04\d+ m, beyond its limit 0\.03 m"


@pytest.fixture(scope="module")
def free(mini):
    """Where nothing stops X1: its loops close up to 0.0461 m, its limit is 0.03 m."""
    return mini.replace(end_stops=())


def to(end, duration=0.1):
    return crane.point_to_point([0.0, 0.029, 0.0108], [0.0, end, 0.0108], duration)


class InPython:
    """A controller without formulas."""

    def __init__(self, control):
        self._control, self.reference, self.start = control, control.reference, control.start

    def __call__(self, *arguments):
        return self._control(*arguments)


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"method": "RK45"},
        pytest.param({"backend": "pinocchio"}, marks=pytest.mark.slow),
        pytest.param({"method": "LSODA"}, marks=(pytest.mark.slow, pytest.mark.long)),
    ],
)
@pytest.mark.parametrize("python", [False, True])
def test_a_run_beyond_the_limits_is_told_before_and_named_after(free, how, python):
    """With computed torque, every backend and method raises this error, not one of the closure."""
    control = crane.ComputedTorque(free, to(0.06))
    with warnings.catch_warnings(record=True) as caught, pytest.raises(SimulationError) as error:
        warnings.simplefilter("always", CraneWarning)
        crane.simulate(free, InPython(control) if python else control, step=2e-3, **how)
    assert [str(one.message) for one in caught] == [TOLD + "keep it within, or widen the limits"]
    text = str(error.value)
    assert not isinstance(error.value, ClosureError) and "\n" not in text
    assert "shorten the step" not in text
    with pytest.raises(SimulationError, match=NAMED):
        raise error.value
    assert "within the limits, or give it an end stop" in text
    if "method" not in how:
        since = float(text.split("since t = ")[1].split(" s")[0])
        # the reference passes the limit then
        assert to(0.06).position(since)[1] == pytest.approx(0.03, abs=2e-3)
        assert to(0.06).position(since - 4e-3)[1] < 0.03


def test_pushed_beyond_the_limits_without_a_reference(free):
    """The warning names the limit, and also the dead centre behind it."""
    with pytest.warns(CraneWarning) as caught:
        run = crane.simulate(
            free.replace(friction={}), lambda t, q, v: np.array([0.0, 200.0, 0.0]), duration=0.15
        )
    lines = [str(one.message) for one in caught]
    assert sum("a dead centre at t = 0.0" in line for line in lines) == 1
    (line,) = (line for line in lines if "passes its limit" in line)
    assert re.search(r"'X1' passes its limit 0\.03 m at t = 0\.0\d+ s, by up to 0\.01", line)
    assert 0.046 < run.q[:, 1].max() < 0.0462


@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
def test_a_step_that_is_too_long_is_told_with_one_that_is_not(smooth):
    mini, path = smooth, crane.task_trajectory(smooth, "lift")
    with pytest.raises(SimulationError, match=r"with a step of 0\.0025 s it goes on: shorten"):
        crane.simulate(mini, crane.PI(mini, path), duration=0.5, step=5e-3, method="rk4")
    crane.simulate(mini, crane.PI(mini, path), duration=0.5, step=2.5e-3, method="rk4")


def test_an_end_stop_holds_what_the_reference_asks_for(mini):
    """A warning, then a simulation: pressing against a stop may be intended."""
    with pytest.warns(CraneWarning, match=re.escape(TOLD)):
        recording = crane.simulate(mini, crane.PI(mini, to(0.06)), duration=0.3)
    assert 0.03 < recording.q[:, 1].max() < 0.034


def test_only_what_is_simulated_of_a_path_counts(mini):
    path = to(0.06, 2.0)
    assert not limit_violation_message(mini, path, 0.1) and limit_violation_message(
        mini, path, 2.0
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error", CraneWarning)
        crane.simulate(mini, crane.PI(mini, path), duration=0.1)


def test_short_excursions_are_found(mini):
    """Of 6 ms and 10 um, where the velocity is zero: x = top - (t - 0.1234)^2."""

    def peak(top):
        return polynomial([[0.0], [top - 0.1234**2, 2 * 0.1234, -1.0], [0.0108]], 0.25)

    told = limit_violation_message(mini, peak(0.03001))
    assert "'X1' goes to 0.03001 m at t = 0.1234 s" in told
    half = np.sqrt(1e-5)
    assert f"from t = {0.1234 - half:.4g} to {0.1234 + half:.4g} s" in told
    assert not limit_violation_message(mini, peak(0.03))


def test_passive_joints_are_looked_at_too():
    """The slider of a crank: s = 0.2 cos theta + sqrt(0.3^2 - (0.3 - 0.2 sin theta)^2)."""
    machine = crane.load(SLIDER, changes={"s.upper": 0.39})
    path = crane.point_to_point([1.4], [0.8], 2.0)

    def above(t):
        theta = path.position(t)[0]
        return 0.2 * np.cos(theta) + np.sqrt(0.09 - (0.3 - 0.2 * np.sin(theta)) ** 2) - 0.39

    begins = brentq(above, 0.5, 1.5)
    told = (
        rf"the reference takes 's' to {0.39 + above(2.0):.6g} m at t = 2 s, beyond its limit "
        rf"0\.39 m .*from t = {begins:.4g} s on: keep"
    )
    with pytest.warns(CraneWarning, match=told):
        crane.simulate(machine, crane.PI(machine, path, gains={"theta": PIGains(9, 9)}))


def test_velocities_are_looked_at_too():
    """1.875 times way over time is the fastest of a motion from rest to rest."""
    machine = crane.load(SLIDER)
    path = crane.point_to_point([1.4], [0.6], 0.12)
    told = passive_limit_violation_message(machine, path)
    assert f"moves 'theta' with up to {1.875 * 0.8 / 0.12:.4g} rad/s at t = 0.06 s" in told
    assert "its limit is 10 rad/s (crank.urdf:15), from t = " in told
    assert not passive_limit_violation_message(machine, crane.point_to_point([1.4], [0.6], 0.1501))


def test_a_task_beyond_the_limits_is_an_error(tmp_path):
    (tmp_path / "arm.urdf").write_text(
        '<robot name="arm"><link name="base"/><link name="arm"><inertial><mass value="1"/>'
        '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>'
        '<joint name="q" type="revolute"><parent link="base"/><child link="arm"/>'
        '<limit lower="-1" upper="1.12" effort="9" velocity="9"/></joint></robot>'
    )
    (tmp_path / "arm.yaml").write_text(
        "name: arm\nchains: [{name: arm, urdf: arm.urdf}]\nactive: [q]\n"
        "tasks:\n  far: {duration: 2, active: {q: [0, 0.65]}}\n"
    )
    machine = crane.load(tmp_path / "arm.yaml")
    line = "task 'far': the reference of 'q' goes to 1.3 rad at t = 2 s, beyond its limit 1.12 rad"
    with pytest.raises(LimitError, match=line):
        crane.task_trajectory(machine, "far")
    with pytest.raises(InputError, match="none of 1 variants .* goes to 1.3 rad at t = 2 s"):
        crane.study(tmp_path / "arm.yaml", {"arm.mass": [2.0]}, ["far"], ["peak_q"])


def test_batches_say_it_of_each(mini, free):
    found = crane.simulation.simulate_batch(
        [free, mini], lambda m: crane.PI(m, to(0.06)), duration=0.2, step=1e-3
    )
    assert all(TOLD in text for text in found.warnings.values())
    assert set(found.warnings) | set(found.failures) == {0, 1}
    assert all("beyond its limit 0.03 m" in text for text in found.failures.values())
    inside = crane.simulation.simulate_batch(
        [mini], lambda m: crane.PI(m, to(0.028)), duration=0.05
    )
    assert not inside.failures and TOLD not in inside.warnings.get(0, "")


@pytest.mark.slow
def test_the_rig_says_it_too(free):
    rig = quiet(Rig, free, 1)
    told = "'X1' goes to 0.06 m at t = 1 s"
    with pytest.warns(CraneWarning, match=told), pytest.raises(SimulationError) as error:
        rig.run(to(0.06, 1.0))
    assert "beyond its limit 0.03 m" in str(error.value)


@pytest.fixture(scope="module")
def unstopped():
    machine = crane.load("patu655")
    return machine.replace(end_stops=())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
def test_a_piston_that_leaves_its_cylinder_ends_the_run(unstopped):
    """Valves push X_lift past its end, until its chamber and hose have no volume left."""
    start = unstopped.home[unstopped.closure.active]
    start[1] = 0.5
    end = start.copy()
    end[1] = 0.9
    path = crane.point_to_point(start, end, 2.0)
    command = ValvePD(unstopped, path)
    with pytest.raises(SimulationError) as caught:
        crane.simulate(unstopped, command, duration=8.0)
    told = re.fullmatch(
        r"at t = (\S+) s the piston of 'X_lift' has left its cylinder, whose chamber B has no "
        r"room: give 'X_lift' an end stop \(end_stops\)",
        str(caught.value),
    )
    with pytest.warns(CraneWarning, match=r"'X_lift' passes its limit 0\.535 m at t = \d"):
        before = crane.simulate(unstopped, command, duration=round(float(told[1]) - 2e-3, 3))
    cylinder = unstopped.hydraulics.cylinders["X_lift"]
    room = cylinder.hose_b / cylinder.area_b
    part = caught.value.recording
    assert part.stopped == str(caught.value) and part["X_lift"][-1] - 0.535 < room
    assert part.time[-1] == pytest.approx(float(told[1]) - 1e-3)
    # this near to the event, the last row of a run is rounded otherwise than in a longer one
    last = len(before.time) - 1
    np.testing.assert_array_equal(part.q[:last], before.q[:last])
    np.testing.assert_allclose(part.q[last], before.q[last], rtol=0.0, atol=1e-14)
    assert room - 0.02 < before["X_lift"][-1] - 0.535 < room


@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
def test_programs_that_ask_where_no_posture_is(unstopped):
    """A program of the valves that closes the loops ahead of the machine."""

    def ahead(time, q_a, v_a, pressures):
        unstopped.closure.solve(q_a + [0, 0.5 * (time > 0.05), 0, 0])
        return [5.8] * 4

    with pytest.raises(SimulationError, match=r"at t = 0\.06 s: loop 'lift_eye' cannot be closed"):
        crane.simulate(unstopped, SampledCommand(ahead, unstopped), duration=0.2)


def test_a_start_that_does_not_close_is_a_simulation_error():
    machine = crane.load("mini_forwarder", {"link3_G.x": 0.11, "link3_G.y": -0.01})
    with pytest.raises(SimulationError, match=r"^at t = 0 s, where the motion starts: loop 'A2_"):
        crane.simulate(machine, None, [0.0, 0.015, 0.005], 0.1)
