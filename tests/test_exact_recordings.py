"""Identification from recordings without noise and with little information."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from threadpoolctl import threadpool_info, threadpool_limits

import crane
from crane.common.threads import with_single_threaded_blas

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
    path = crane.motion.Trajectory(CubicSpline(np.linspace(0, 6, 4), knots, bc_type="clamped"))
    control = crane.ComputedTorque(machine, path)
    return machine, crane.simulate(machine, control, path(0.0)[:2])


@pytest.fixture(scope="module", params=[lift, tremble])
def recorded(request):
    return request.param()


@pytest.mark.parametrize("method", ["ols", "wls", pytest.param("huber", marks=pytest.mark.long)])
def test_intervals_hold_the_truth_where_rounding_is_all_the_noise(recorded, method):
    machine, recording = recorded
    found = crane.identify(machine, recording, method=method)
    off = (found.values - found.base.values(found.model.nominal)) / found.std
    assert np.abs(off).max() < 3
    assert found.estimate.scaled_condition < 1e10  # of columns that count as told


def test_threads_of_the_linear_algebra_change_no_digit(recorded):
    machine, recording = recorded
    found = []
    for threads in (1, 2):
        with threadpool_limits(threads, "blas"):
            assert crane_sees() == 1 and max(one["num_threads"] for one in blas()) == threads
            found.append(crane.identify(machine, recording))
    assert found[0].names == found[1].names
    np.testing.assert_array_equal(found[0].values, found[1].values)
    np.testing.assert_array_equal(found[0].std, found[1].std)


def blas():
    return [library for library in threadpool_info() if library["user_api"] == "blas"]


@with_single_threaded_blas
def crane_sees():
    """Largest number of threads that a decorated function has."""
    return max(library["num_threads"] for library in blas())
