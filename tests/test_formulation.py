"""The decoupled formulation against separate sub-chains."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import crane
from crane.dynamics.compiled_dynamics import QUANTITIES


class Lone:
    """One URDF by itself, on a floating base where the machine carries it."""

    def __init__(self, machine, chain):
        self.model = pin.buildModelFromUrdf(str(chain.urdf), pin.JointModelFreeFlyer())
        self.data = self.model.createData()
        self.names = list(self.model.names)[2:]
        self.columns = [machine.column(name) for name in self.names]
        self.parent = machine.frame(chain.parent) if chain.parent else None

    def coordinates(self, q):
        """Pinocchio's continuous joint has two, cosine and sine."""
        for joint, x in zip(list(self.model.joints)[2:], q, strict=True):
            yield [x] if joint.nq == 1 else [np.cos(x), np.sin(x)]

    def inverse(self, machine, q, v, a, still):
        """Wrench on the base in its frame, and forces along the chain's joints."""
        data = machine.model.createData()
        pin.forwardKinematics(machine.model, data, q, v, a)
        if self.parent is None:
            place, rate, second = pin.SE3.Identity(), pin.Motion.Zero(), pin.Motion.Zero()
        else:
            place = pin.updateFramePlacement(machine.model, data, self.parent)
            rate = pin.getFrameVelocity(machine.model, data, self.parent)
            second = pin.getFrameAcceleration(machine.model, data, self.parent)
        if still:
            rate = second = pin.Motion.Zero()
        full_q = np.concatenate([pin.SE3ToXYZQUAT(place), *self.coordinates(q[self.columns])])
        full_v = np.concatenate([rate.vector, v[self.columns]])
        full_a = np.concatenate([second.vector, a[self.columns]])
        tau = pin.rnea(self.model, self.data, full_q, full_v, full_a)
        return tau[:6], tau[6:]


@pytest.fixture(scope="module")
def bare(mini):
    return mini.replace(friction={}, forces=(), end_stops=())


def draw(machine, count, seed=3):
    rng = np.random.default_rng(seed)
    low, high = machine.lower, machine.upper
    size = np.array([1.0, 0.05, 0.05])
    return (
        rng.uniform(low + 0.02 * (high - low), high - 0.02 * (high - low), (count, 3)),
        *(rng.normal(size=(count, 3)) * size * k for k in (1.0, 5.0)),
    )


@pytest.mark.parametrize("backend", ["compiled", "pinocchio"])
def test_decoupled_is_the_sum_of_lone_chains(bare, backend):
    q_a, v_a, a_a = draw(bare, 40)
    dynamics = crane.Dynamics(bare, formulation="decoupled", backend=backend)
    lone = [Lone(bare, chain) for chain in bare.chains]
    for sample in zip(q_a, v_a, a_a, strict=True):
        gamma, q, v, a = moved(bare, *sample)
        total = np.zeros(3)
        for chain in lone:
            _, tau = chain.inverse(bare, q, v, a, still=True)
            total += gamma[chain.columns].T @ tau
        found = dynamics.inverse(*sample)
        assert np.abs(found - total).max() < 1e-12 * np.abs(total).max()


def test_the_difference_is_what_the_carriers_feel(bare):
    """Exact minus decoupled: moving bases load the chains, and chains load what carries them."""
    q_a, v_a, a_a = draw(bare, 40, seed=4)
    exact = crane.Dynamics(bare).inverse(q_a, v_a, a_a)
    decoupled = crane.Dynamics(bare, formulation="decoupled").inverse(q_a, v_a, a_a)
    lone = [Lone(bare, chain) for chain in bare.chains]
    data = bare.model.createData()
    for i, sample in enumerate(zip(q_a, v_a, a_a, strict=True)):
        gamma, q, v, a = moved(bare, *sample)
        carrying = np.zeros(3)
        for chain in lone:
            wrench, tau = chain.inverse(bare, q, v, a, still=False)
            _, alone = chain.inverse(bare, q, v, a, still=True)
            carrying += gamma[chain.columns].T @ (tau - alone)
            if chain.parent is not None:
                jacobian = pin.computeFrameJacobian(bare.model, data, q, chain.parent)
                carrying += gamma.T @ jacobian.T @ wrench
        scale = np.abs(exact[i]).max()
        assert np.abs(exact[i] - decoupled[i] - carrying).max() < 1e-12 * scale
        assert np.abs(carrying).max() > 1e-3 * scale


def moved(machine, q_a, v_a, a_a):
    q = machine.closure.solve(q_a)
    gamma = machine.closure.gamma(q)
    v = gamma @ v_a
    return gamma, q, v, gamma @ a_a + machine.closure.drift(q, v)


@pytest.mark.slow
def test_both_paths_agree(mini):
    q_a, v_a, x = draw(mini, 30, seed=5)
    fast, slow = (
        crane.Dynamics(mini, formulation="decoupled", backend=backend)
        for backend in ("compiled", "pinocchio")
    )
    for quantity in QUANTITIES:
        q = mini.closure.solve(q_a)
        one, two = (
            np.array([way.evaluate_closed(quantity, *row) for row in zip(q, v_a, x, strict=True)])
            for way in (fast, slow)
        )
        assert np.abs(one - two).max() <= 1e-11 * np.abs(two).max(), quantity


def test_its_parts_fit_together(mini):
    q_a, v_a, a_a = draw(mini, 30, seed=6)
    dynamics = crane.Dynamics(mini, formulation="decoupled")
    tau = dynamics.inverse(q_a, v_a, a_a)
    found = np.einsum("ijk,ik->ij", dynamics.mass_matrix(q_a), a_a) + dynamics.bias(q_a, v_a)
    assert np.abs(found - tau).max() < 1e-12 * np.abs(tau).max()
    assert np.abs(dynamics.forward(q_a, v_a, tau) - a_a).max() < 1e-10 * np.abs(a_a).max()
    bare = mini.replace(friction={}, forces=(), end_stops=())
    alone = crane.Dynamics(bare, formulation="decoupled")
    product = alone.regressor(q_a, v_a, a_a) @ alone.parameters
    assert np.abs(product - alone.inverse(q_a, v_a, a_a)).max() < 1e-12 * np.abs(product).max()
    kinetic, _ = dynamics.energy(q_a, v_a)
    twice = np.einsum("ij,ijk,ik->i", v_a, dynamics.mass_matrix(q_a), v_a)
    assert np.abs(kinetic - 0.5 * twice).max() < 1e-13 * kinetic.max()


def test_a_machine_of_one_chain_has_one_formulation():
    machine = crane.load(Path(__file__).parent / "data" / "five_bar.urdf")
    q_a = machine.home[machine.closure.active]
    v_a, a_a = np.array([0.3, -0.2]), np.array([1.0, 2.0])
    exact, decoupled = (
        crane.Dynamics(machine, formulation=name).inverse(q_a, v_a, a_a)
        for name in ("exact", "decoupled")
    )
    assert np.array_equal(exact, decoupled)


def test_a_simulation_follows_its_formulation(mini):
    """Its inverse dynamics drive its own forward dynamics without tracking error."""
    path = crane.task_trajectory(mini, "lift")
    ideal = crane.Dynamics(mini, formulation="decoupled")

    def drive(time, q_a, v_a):
        wanted = path(time)
        a_a = wanted[2] + 40.0 * (wanted[1] - v_a) + 400.0 * (wanted[0] - q_a)
        return ideal.inverse(q_a, v_a, a_a, friction=True)

    start = path(0.0)[:2]
    run = crane.simulate(mini, drive, start, duration=0.3, formulation="decoupled")
    assert np.abs(run.q - path(run.time)[0]).max() < 1e-9
    other = crane.simulate(mini, drive, start, duration=0.3)
    assert np.abs(other.q - path(other.time)[0]).max() > 1e-5
