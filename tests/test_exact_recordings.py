"""Recordings without noise, of motions that tell little: what is found, how far to trust it."""

import csv
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import crane

CRANE = Path(sys.executable).with_name("crane")
pytestmark = pytest.mark.filterwarnings("ignore::crane.CraneWarning")


def lift():
    """Of three drives one rests and one moves by an eighth of its stroke."""
    machine = crane.load("mini_forwarder")
    control = crane.PI(machine, crane.task_trajectory(machine, "lift"))
    return machine, crane.simulate(machine, control)


def tremble():
    """Of a robot whose joints move by a hundredth of their range."""
    machine = crane.load("tx40")
    small = 0.01 * np.random.default_rng(3).uniform(-1, 1, (4, 6))
    knots = small * (machine.upper - machine.lower)
    knots[[0, -1]] = 0
    knots += machine.home[machine.closure.active]
    path = crane.Trajectory(CubicSpline(np.linspace(0, 6, 4), knots, bc_type="clamped"))
    control = crane.ComputedTorque(machine, path)
    return machine, crane.simulate(machine, control, path(0.0)[:2])


@pytest.fixture(scope="module", params=[lift, tremble])
def recorded(request):
    return request.param()


@pytest.mark.parametrize("method", ["ols", "wls", "huber"])
def test_intervals_hold_the_truth_where_rounding_is_all_the_noise(recorded, method):
    machine, recording = recorded
    found = crane.identify(machine, recording, method=method)
    off = (found.values - found.base.values(found.model.nominal)) / found.std
    assert np.abs(off).max() < 3
    assert found.estimate.scaled_condition < 1e10  # of columns that count as told


@pytest.mark.slow
def test_threads_of_the_linear_algebra_move_nothing_that_is_told(tmp_path):
    machine, recording = lift()
    recording.to_csv(tmp_path / "lift.csv")
    command = [CRANE, "identify", "mini_forwarder", "lift.csv", "--out", "two"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "2"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    one = crane.identify(machine, crane.Recording.from_csv(tmp_path / "lift.csv"))
    with (tmp_path / "two" / "parameters.csv").open() as file:
        two = list(csv.DictReader(file))
    assert [row["parameter"] for row in two] == list(one.names)
    assert os.environ["OPENBLAS_NUM_THREADS"] == "1"  # here
    off = (one.values - [float(row["value"]) for row in two]) / one.std
    assert np.abs(off).max() < 0.05
