"""Motion of linkages and parallel robots from files of several formats."""

import numpy as np
import pinocchio as pin
import pytest
from linkages import LARGE, MACHINES, dynamics_of, loaded, multipliers, postures
from oracles import derivative

import crane


@pytest.fixture(params=MACHINES)
def case(request):
    return request.param, loaded(request.param)


def test_degrees_of_freedom(case):
    name, machine = case
    assert machine.closure.degrees_of_freedom == len(machine.active) == MACHINES[name][1]


def test_gamma_is_the_derivative_of_the_closure(case):
    name, machine = case
    for q_a, v_a, _ in postures(machine, MACHINES[name][2], 4):
        q = machine.closure.solve(q_a)
        gamma = machine.coordinates.rate_matrix(q) @ machine.closure.gamma(q)
        slope = derivative(lambda t, q=q_a, v=v_a: machine.closure.solve(q + t * v), 1e-3)
        np.testing.assert_allclose(gamma @ v_a, slope, atol=2e-9 * np.abs(slope).max())


def test_accelerations_are_those_of_the_tree_with_multipliers(case):
    name, machine = case
    closure, dynamics = machine.closure, dynamics_of(name)
    for q_a, v_a, tau_a in postures(machine, MACHINES[name][2], 5):
        q = closure.solve(q_a)
        tau = np.zeros(machine.model.nv)
        tau[closure.active] = tau_a
        a = multipliers(machine, q, closure.gamma(q) @ v_a, tau)[closure.active]
        ours = dynamics.forward(q_a, v_a, tau_a)
        np.testing.assert_allclose(ours, a, rtol=0, atol=1e-10 * np.abs(a).max())


def energy_is_kept(name):
    """One second on springs that carry the weight at home."""
    machine = loaded(name)
    home = machine.home[machine.closure.active]
    weight = dynamics_of(name).gravity(home)
    mass = np.diag(dynamics_of(name).mass_matrix(home))
    springs = tuple(
        crane.description.ForceElement(joint, stiffness=float(k), rest=float(x + w / k))
        for joint, x, w, k in zip(machine.active, home, weight, 100 * mass, strict=True)
    )
    machine = machine.replace(friction={}, forces=springs, end_stops=())
    v_a = 3 * MACHINES[name][2] * np.linspace(1.0, -1.0, len(home) + 1)[:-1]
    recording = crane.simulate(machine, initial=(home, v_a), duration=1.0)
    energy = recording.channels["kinetic"] + recording.channels["potential"]
    assert np.ptp(recording.q, axis=0).max() > 0.01  # it moves
    assert np.ptp(energy) < 1e-7 * recording.channels["kinetic"].max()


@pytest.mark.parametrize("name", sorted(MACHINES.keys() - LARGE))
def test_energy_is_kept(name):
    energy_is_kept(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(LARGE))
def test_energy_of_large_machines_is_kept(name):
    energy_is_kept(name)


def test_sarrus_plate_goes_straight_up():
    machine = loaded("sarrus")
    closure = machine.closure
    assert len(closure.structure.redundant_rows) == 1
    plate = machine.frame("plate")
    data = machine.model.createData()
    places = []
    for q_a in np.linspace(-0.3, 0.3, 13):
        pin.framesForwardKinematics(
            machine.model, data, machine.coordinates.configuration(closure.solve([q_a]))
        )
        places.append(data.oMf[plate].copy())
    heights = [place.translation[2] for place in places]
    assert np.ptp(heights) > 0.1
    for place in places:
        np.testing.assert_allclose(place.rotation, np.eye(3), atol=1e-9)
        np.testing.assert_allclose(place.translation[:2], places[0].translation[:2], atol=1e-9)


def test_delta_platform_stays_level():
    machine = loaded("delta")
    assert set(machine.joints) > {"wrist_rx", "wrist_ry", "wrist_rz", "elbow2b_X", "elbow2b_Y"}
    model = machine.model
    first, second = (model.getJointId(f"elbow1a_{axis}") for axis in "XY")
    assert model.parents[second] == first  # X stands on the arm, Y on X
    for joint, axis in ((first, [1, 0, 0]), (second, [0, 1, 0])):
        np.testing.assert_allclose(np.ravel(model.joints[joint].createData().S)[3:], axis)
    platform, data = machine.frame("platform"), machine.model.createData()
    for q_a, _, _ in postures(machine, 0.4, 20):
        pin.framesForwardKinematics(
            machine.model, data, machine.coordinates.configuration(machine.closure.solve(q_a))
        )
        np.testing.assert_allclose(data.oMf[platform].rotation, np.eye(3), atol=1e-9)
