"""Dynamics of chains, trees and rings with many joints against Pinocchio."""

from functools import cache
from pathlib import Path

import families
import numpy as np
import oracles
import pinocchio as pin
import pytest

import crane
from crane.closure import constraint_tolerances

FREEDOMS = {  # loops and freedoms of so many joints
    "chain": lambda joints: ((joints - 1) // 3, 1 + (joints - 1) // 3),
    "tree": lambda joints: ((joints - 1) // 3, 1 + (joints - 1) // 3),
    "ring": lambda joints: (1, joints - 2),
    "spatial ring": lambda joints: (1, joints - 5),
}
MACHINES = [
    ("chain", 4), ("chain", 13), ("tree", 16), ("ring", 4), ("ring", 12), ("spatial ring", 6),
    ("spatial ring", 10),
    *(
        pytest.param(family, joints, marks=(pytest.mark.slow, *marks))
        for marks, sizes in (
            ((), (("chain", 61), ("spatial ring", 30))),
            ((pytest.mark.long,),
             (("tree", 61), ("ring", 30), ("chain", 100), ("tree", 100), ("ring", 60),
               ("spatial ring", 60))),
        )
        for family, joints in sizes
    ),
]  # fmt: skip
EACH = pytest.mark.parametrize(("family", "joints"), MACHINES)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Dynamics of a machine, each made once."""
    folder = tmp_path_factory.mktemp("large")
    return cache(
        lambda family, joints: crane.Dynamics(crane.load(families.write(family, joints, folder)))
    )


def states(machine, count=2):
    """q_A, v_A and tau_A around home, closer to it the longer the loops are."""
    random, n = np.random.default_rng(3), len(machine.active)
    reach = min(0.3, 2 * len(machine.closure.equations.loops) / machine.model.nv)
    for _ in range(count):
        q_a = machine.home[machine.closure.active] + random.uniform(-reach, reach, n)
        yield q_a, random.normal(size=n), 10 * random.normal(size=n)


@EACH
def test_has_the_joints_loops_and_freedoms_it_should(made, family, joints):
    machine = made(family, joints).machine
    found = len(machine.closure.equations.loops), len(machine.active)
    assert machine.model.nv == joints and found == FREEDOMS[family](joints)
    np.testing.assert_allclose(machine.home, 0, atol=1e-12)  # it is closed as it is written


def test_is_the_same_every_time(tmp_path):
    one, two = (families.write("tree", 40, tmp_path).read_bytes() for _ in range(2))
    assert one == two
    assert one != families.write("chain", 40, tmp_path).read_bytes()


def test_branches_are_branches(tmp_path):
    """40 joints: a trunk of three four-bars, ten more on three branches."""
    machine = crane.load(families.write("tree", 40, tmp_path))
    supports = [len(support) for support in machine.model.supports]
    chain = crane.load(families.write("chain", 40, tmp_path))
    assert max(supports) < max(len(support) for support in chain.model.supports)
    assert sum(len(list(children)) > 2 for children in machine.model.children) > 1


BRANCHES = (
    Path(__file__).parents[2]
    / "shared/data/third_party/grbda/variable_four_bar_urdf_four_bar_branch_4_6.urdf"
)


@pytest.mark.skipif(not BRANCHES.exists(), reason="shared/data is not here")
@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
def test_loops_of_their_own_are_analysed_together(monkeypatch):
    """24 four-bars on a floating root take as many closings as one of them."""
    steps, whole = [], constraint_tolerances.least_squares_step

    def counted(jacobian, phi):
        steps.append(len(phi))
        return whole(jacobian, phi)

    monkeypatch.setattr(constraint_tolerances, "least_squares_step", counted)
    machine = crane.load(BRANCHES)
    assert len(machine.closure.equations.loops) == 24 and machine.model.nv == 78
    assert len(steps) < 250, len(steps)  # 2,485 when each direction was tried by itself


def test_groups_share_no_equation(tmp_path):
    machine = crane.load(families.write("tree", 40, tmp_path))
    equations = machine.closure.equations
    group, of_row = equations.coupled_groups(np.arange(machine.model.nv))
    for row, one in zip(equations.evaluate_scaled(machine.home)[1], of_row, strict=True):
        assert (group[np.abs(row) > 1e-9] == one).all()
    for one in np.unique(of_row):
        names = {equations.names[i] for i in equations.loop_of_row[of_row == one]}
        alone = equations.subset(names)
        phi, jacobian = equations.evaluate(machine.home)
        own, slopes = alone.evaluate(machine.home)
        assert (own == phi[of_row == one]).all() and (slopes == jacobian[of_row == one]).all()


@pytest.mark.parametrize(("family", "least"), families.FAMILIES.items())
def test_too_few_joints(family, least, tmp_path):
    with pytest.raises(ValueError, match=f"a {family} has {least} joints or more"):
        families.write(family, least - 1, tmp_path)


@EACH
def test_accelerations_are_those_of_constraint_dynamics(made, family, joints):
    dynamics = made(family, joints)
    closure = dynamics.machine.closure
    for q_a, v_a, tau_a in states(dynamics.machine):
        q, tau = closure.solve(q_a), np.zeros(joints)
        tau[closure.active] = tau_a
        a = oracles.constraint_dynamics(
            dynamics.machine, q, closure.gamma(q) @ v_a, tau, 1e-6, 100
        )
        found = dynamics.forward(q_a, v_a, tau_a)
        np.testing.assert_allclose(
            found, a[closure.active], rtol=0, atol=1e-9 * np.abs(found).max()
        )


@EACH
def test_inverse_gives_the_forces_back(made, family, joints):
    """To rounding of M a: forward dynamics solves for a, backward stable."""
    dynamics = made(family, joints)
    for q_a, v_a, tau_a in states(dynamics.machine):
        a_a = dynamics.forward(q_a, v_a, tau_a)
        size = np.abs(dynamics.mass_matrix(q_a)).sum(axis=1).max() * np.abs(a_a).max()
        back = dynamics.inverse(q_a, v_a, a_a)
        np.testing.assert_allclose(back, tau_a, rtol=0, atol=1e-13 * size)


@EACH
def test_mass_matrix_is_the_tree_s_projected(made, family, joints):
    dynamics = made(family, joints)
    machine = dynamics.machine
    data = machine.model.createData()
    for q_a, _, _ in states(machine):
        q = machine.closure.solve(q_a)
        gamma, upper = machine.closure.gamma(q), np.triu(pin.crba(machine.model, data, q))
        whole = gamma.T @ (upper + np.triu(upper, 1).T) @ gamma
        mass = dynamics.mass_matrix(q_a)
        size = np.abs(whole).max()
        np.testing.assert_allclose(mass, whole, rtol=0, atol=1e-12 * size)
        np.testing.assert_allclose(mass, mass.T, rtol=0, atol=1e-14 * size)
        assert np.linalg.eigvalsh(mass).min() > 0


@EACH
def test_regressor_times_parameters_is_inverse(made, family, joints):
    dynamics = made(family, joints)
    for q_a, v_a, a_a in states(dynamics.machine):
        forces = dynamics.inverse(q_a, v_a, a_a)
        found = dynamics.regressor(q_a, v_a, a_a) @ dynamics.parameters
        np.testing.assert_allclose(found, forces, rtol=0, atol=1e-12 * np.abs(forces).max())


@EACH
def test_motion_keeps_the_loops_together(made, family, joints):
    """Both ends of every loop, by Pinocchio: in one place, and but a turn about its y apart."""
    machine = made(family, joints).machine
    model, data, world = machine.model, machine.model.createData(), pin.LOCAL_WORLD_ALIGNED
    for q_a, v_a, _ in states(machine):
        q = machine.closure.solve(q_a)
        pin.forwardKinematics(model, data, q, machine.closure.gamma(q) @ v_a)
        for loop in machine.closure.equations.loops:
            ends = [machine.frame(name) for name in (loop.predecessor, loop.successor)]
            one, two = (pin.updateFramePlacement(model, data, end) for end in ends)
            gap = one.actInv(two)
            assert np.abs(gap.translation).max() < 1e-12 and gap.rotation[1, 1] > 1 - 1e-12
            speeds = [pin.getFrameVelocity(model, data, end, world) for end in ends]
            slip, size = speeds[1] - speeds[0], np.abs(speeds[0].vector).max()
            turn = one.rotation.T @ slip.angular
            assert np.abs([*slip.linear, turn[0], turn[2]]).max() < 1e-11 * max(1, size)
