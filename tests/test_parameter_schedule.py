"""Runs in which parameters change, and replays of forces: against runs from state to state."""

import numpy as np
import pytest

import crane
from crane.common.errors import CraneWarning, InputError, RecordingError
from crane.control.force_inputs import ForceInputs
from crane.control.reference_samples import interpolate_references
from crane.recordings.measured_recordings import read_measured
from crane.simulation.parameter_schedule import ParameterSchedule

STEP = 0.01
CHANGED = {"payload.mass": 0.2, "gravity.x": 0.5}


@pytest.fixture(scope="module")
def machine():
    return crane.load("mini_forwarder")


@pytest.fixture(scope="module")
def forces(machine):
    """Forces that carry the weight, with one that pulsates."""
    time = np.linspace(0.0, 0.2, 21)
    hold = crane.Dynamics(machine).gravity(machine.home[machine.closure.active])
    ripple = 0.05 * np.sin(40.0 * time)[:, None] * np.abs(hold).max()
    return interpolate_references(ForceInputs(machine), time, hold + ripple * [0.0, 1.0, 1.0])


def test_parameters_that_change_give_the_runs_of_two_machines(machine, forces):
    schedule = ParameterSchedule([(0.1, CHANGED)])
    run = schedule.simulate(machine, forces, None, 20, STEP)
    assert run.changes == '[[0.1, {"payload.mass": 0.2, "gravity.x": 0.5}]]'
    first = crane.simulate(machine, forces, duration=0.1, step=STEP)
    np.testing.assert_array_equal(run.q[:11], first.q)
    times = np.linspace(0.0, 0.1, 11)
    later = interpolate_references(ForceInputs(machine), times, run.tau[10:])
    second = crane.simulate(
        crane.load("mini_forwarder", CHANGED), later, (first.q[-1], first.v[-1]), 0.1, STEP
    )
    np.testing.assert_allclose(run.q[10:], second.q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(run.v[10:], second.v, rtol=0, atol=1e-11)


def test_recorded_forces_are_replayed(machine, forces, tmp_path):
    path = tmp_path / "run.csv"
    run = ParameterSchedule([(0.1, CHANGED)]).simulate(machine, forces, None, 20, STEP)
    run.to_csv(path)
    replayed, comparison = crane.replay(machine, path, STEP)
    np.testing.assert_allclose(replayed.q, run.q, rtol=0, atol=1e-12)
    assert replayed.changes == run.changes
    assert {"X1", "tip_z"} <= {channel.name for channel in comparison.channels}
    with pytest.raises(RecordingError, match="0.1 s, which is no multiple of the step of 0.003 s"):
        crane.replay(machine, path, 0.003)
    with pytest.warns(CraneWarning, match="parameters of the machine change during the recording"):
        read_measured(machine, path)


@pytest.mark.parametrize(
    "text", ["x", "[1]", '[[2, {"a": 1}], [1, {"a": 2}]]', '[[1, {"a": []}]]']
)
def test_a_malformed_schedule_is_refused(text):
    with pytest.raises(RecordingError, match="'# changes:' is no list of increasing times"):
        ParameterSchedule.from_notes({"changes": text})


def test_forces_of_another_shape_are_refused(machine):
    with pytest.raises(InputError, match="the references has the shape"):
        interpolate_references(ForceInputs(machine), [0.0, 1.0], np.zeros((2, 2)))
    with pytest.raises(InputError, match="at times that increase"):
        interpolate_references(ForceInputs(machine), [1.0, 0.0], np.zeros((2, 3)))


def test_a_missing_force_is_told(machine, tmp_path):
    path = tmp_path / "run.csv"
    path.write_text(
        "time [s],q1 [rad],X1 [m],X2 [m],q1_force [N m],X1_force [N]\n"
        "0,0,0.02,0.01,0,0\n1,0,0.02,0.01,0,0\n"
    )
    with pytest.raises(RecordingError, match="columns are missing: 'X2_force'"):
        crane.replay(machine, path)
