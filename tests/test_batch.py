"""Batches of simulations equal single simulations."""

import numpy as np
import pytest

import crane
from crane.common.errors import InputError

STARTS = [[0.1 * i, 0.012 + 0.001 * i, 0.011] for i in range(6)]


def test_a_batch_is_its_simulations(mini):
    target = crane.point_to_point([0, 0.015, 0.012], [0.5, 0.02, 0.014], 0.2)
    machines = [
        mini.with_payload(crane.Payload("link7_tip", 0.02 * i)) for i in range(len(STARTS))
    ]
    shares = []
    batch = crane.simulation.simulate_batch(
        machines, lambda m: crane.PI(m, target), STARTS, threads=3, progress=shares.append
    )
    assert batch.failures == {} and shares[-1] == 1.0
    assert batch.q.shape == batch.v.shape == batch.tau.shape == (6, 201, 3)
    for i, (machine, start) in enumerate(zip(machines, STARTS, strict=True)):
        alone = crane.simulate(machine, crane.PI(machine, target), start)
        np.testing.assert_array_equal(batch.time, alone.time)
        np.testing.assert_allclose(batch.q[i], alone.q, rtol=0, atol=1e-14)
        np.testing.assert_allclose(batch.tau[i], alone.tau, rtol=0, atol=1e-9)
        for k, name in enumerate(("kinetic", "potential", "work", "dissipated")):
            np.testing.assert_allclose(batch.energy[i, :, k], alone.channels[name], atol=1e-12)
    assert np.ptp(batch.tau[:, 0, 1]) > 1  # [N], the payloads differ


def test_one_machine_many_starts(mini):
    batch = crane.simulation.simulate_batch(mini, initial=STARTS, duration=0.05)
    np.testing.assert_array_equal(batch.q[:, 0], STARTS)


def test_a_variant_that_fails_loses_nothing_of_the_others(mini):
    starts = [*STARTS[:2], [0.0, 0.04, 0.01], *STARTS[2:]]
    batch = crane.simulation.simulate_batch(mini, initial=starts, duration=0.05)
    assert list(batch.failures) == [2]
    assert "X1 = 0.04 is outside of its limits" in batch.failures[2]
    assert np.isnan(batch.q[2]).all() and np.isfinite(np.delete(batch.q, 2, axis=0)).all()


def test_wrong_batches(mini):
    arm = crane.load("ur5_robot")
    for call, text in (
        (lambda: crane.simulation.simulate_batch([], duration=1.0), "there are no machines"),
        (
            lambda: crane.simulation.simulate_batch([mini] * 2, initial=STARTS, duration=1.0),
            "2 machines and 6 initial states",
        ),
        (
            lambda: crane.simulation.simulate_batch([mini, arm], duration=1.0),
            "machine 1 is driven at",
        ),
        (
            lambda: crane.simulation.simulate_batch(mini, initial=[[0, 1, 0]], duration=1.0),
            "all 1 simulations failed, the first: initial: X1 = 1",
        ),
    ):
        with pytest.raises(InputError, match=text):
            call()


@pytest.mark.parametrize("backend", ["compiled", "pinocchio"])
def test_dynamics_keep_the_parameters_of_their_moment(backend):
    machine = crane.load("ur5_robot")
    dynamics = crane.Dynamics(machine, backend=backend)
    before = dynamics.gravity(np.ones(6))
    machine.model.inertias[3].mass *= 2
    np.testing.assert_array_equal(dynamics.gravity(np.ones(6)), before)
    assert np.abs(crane.Dynamics(machine, backend=backend).gravity(np.ones(6)) - before).max() > 1


@pytest.mark.parametrize(
    "make",
    [
        lambda: crane.description.Friction(coulomb=-1),
        lambda: crane.description.Friction(viscous=np.nan),
        lambda: crane.description.ForceElement("X1", stiffness=-1),
        lambda: crane.description.EndStop("X1", -5.0),
        lambda: crane.description.PIGains(np.nan, 1),
        lambda: crane.description.PIGains("1", 1),
    ],
)
def test_impossible_parameters(make):
    with pytest.raises(InputError):
        make()
