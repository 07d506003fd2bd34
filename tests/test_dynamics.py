"""Equations of motion against Lagrange's on paper, Pinocchio's constraint solver, and balances."""

import dataclasses

import numpy as np
import oracles
import pinocchio as pin
import pytest
import scipy.integrate
from executed_lines import at_most
from lxml import etree
from warned import quiet

import crane
from crane.common.errors import InputError

CRANK = oracles.SliderCrank()
STROKE = 0.030  # [m]

# Everything one machine may carry along its joints, on active and on passive ones.
ELEMENTS = (
    crane.description.ForceElement("q3", stiffness=2.0, rest=1.2),
    crane.description.ForceElement("q3", stiffness=0.5, rest=0.3, force=0.2),
    crane.description.ForceElement("q9", damping=0.7),
    crane.description.ForceElement("X1", stiffness=800.0, rest=0.01, damping=30.0),
    crane.description.ForceElement("q7", force=-0.3),
)
STOPS = (
    crane.description.EndStop("X1", stiffness=2e5, damping=20.0),
    crane.description.EndStop("X2", stiffness=1e5),
)


@pytest.fixture(scope="module")
def bare(mini):
    return mini.replace(friction={}, forces=(), end_stops=())


@pytest.fixture(scope="module")
def dynamics(bare):
    return crane.Dynamics(bare)


@pytest.fixture(scope="module")
def loaded(mini):
    """With friction, springs, dampers and constant forces."""
    return mini.replace(forces=ELEMENTS)


def states(count, seed=0):
    """Coordinates, velocities, accelerations and forces as the mini forwarder sees them."""
    random = np.random.default_rng(seed)
    low, high = np.array([[-3.1, 0.0, 0.0], [3.1, STROKE, STROKE]])
    q_a = random.uniform(low, high, (count, 3))
    v_a = random.uniform(-1, 1, (count, 3)) * [1.0, 0.05, 0.05]
    a_a = random.uniform(-1, 1, (count, 3)) * [5.0, 0.5, 0.5]
    tau = random.uniform(-1, 1, (count, 3)) * [1.8, 80.0, 80.0]
    return q_a, v_a, a_a, tau


def relative(found, expected):
    """Largest difference of any sample, relative to that sample's largest value."""
    found, expected = np.atleast_2d(found), np.atleast_2d(expected)
    scale = np.abs(expected).reshape(len(expected), -1).max(axis=1)
    return (np.abs(found - expected).reshape(len(expected), -1).max(axis=1) / scale).max()


def with_parameters(machine, parameters):
    """A copy of a machine whose bodies have other inertial parameters."""
    model = pin.Model(machine.model)
    for body, ten in enumerate(parameters.reshape(-1, 10), start=1):
        model.inertias[body] = pin.Inertia.FromDynamicParameters(ten)
    return dataclasses.replace(machine, model=model)


def tree_mass(model, q):
    """Mass matrix column by column from recursive Newton-Euler, without gravity."""
    model, zero = pin.Model(model), np.zeros(model.nv)
    model.gravity.setZero()
    data = model.createData()
    return np.column_stack([pin.rnea(model, data, q, zero, unit) for unit in np.eye(model.nv)])


# --- against equations on paper --------------------------------------------------------------


def test_inertia_and_weight_equal_lagrange_with_the_published_numbers(dynamics):
    """Bodies, lengths and masses from tables, positions from circles: no URDF, no gamma."""
    q_a, v_a, _, _ = states(200)
    x1, x2 = q_a.T[1:]
    mass = dynamics.mass_matrix(q_a)
    exact = oracles.mini_forwarder_inertia(x1, x2)
    assert np.abs(mass[:, 0, 1:]).max() < 1e-14  # slewing and luffing do not mix
    assert np.abs(mass / np.where(exact == 0, np.inf, exact) - (exact != 0)).max() < 1e-12
    weight = oracles.by_stroke(oracles.mini_forwarder_potential, x1, x2)
    gravity = dynamics.gravity(q_a)
    assert np.abs(gravity[:, 0]).max() < 1e-14
    assert relative(gravity[:, 1:], weight.T) < 1e-12
    kinetic, potential = dynamics.energy(q_a, v_a)
    assert np.abs(potential - oracles.mini_forwarder_potential(x1, x2)).max() < 1e-12
    by_hand = np.einsum("ni,nij,nj->n", v_a, exact, v_a) / 2
    assert np.abs(kinetic / by_hand - 1).max() < 1e-12


def test_inverse_dynamics_equal_lagrange_with_the_published_numbers(dynamics):
    q_a, v_a, a_a, _ = states(40, seed=1)
    q_a[:, 1:] = np.clip(q_a[:, 1:], 1e-4, STROKE - 1e-4)  # room for differences
    exact = np.array([oracles.mini_forwarder_force(*sample) for sample in zip(q_a, v_a, a_a)])  # noqa: B905
    found = dynamics.inverse(q_a, v_a, a_a)
    scale = np.abs(exact).max(axis=0)  # the torque of slewing is a hundredth of the forces
    assert np.abs((found - exact) / scale).max() < 1e-10  # differences of the oracle's inertia


def test_slider_crank_equals_lagrange(slider_crank):
    dynamics = crane.Dynamics(slider_crank)
    random = np.random.default_rng(2)
    theta, rate, acceleration = random.uniform([0.1, -5, -30], [3.0, 5, 30], (200, 3)).T
    exact = CRANK.torque(theta, rate, acceleration)
    found = dynamics.inverse(theta[:, None], rate[:, None], acceleration[:, None])[:, 0]
    # terms cancel where the rod is nearly upright and M' is large
    size = np.abs(exact) + CRANK.inertia(theta) * 30 + 10
    assert np.abs((found - exact) / size).max() < 1e-13
    mass = dynamics.mass_matrix(theta[:, None])[:, 0, 0]
    assert np.abs(mass / CRANK.inertia(theta) - 1).max() < 1e-12
    kinetic, potential = dynamics.energy(theta[:, None], rate[:, None])
    assert np.abs(kinetic / (CRANK.inertia(theta) * rate**2 / 2) - 1).max() < 1e-12
    assert np.abs(potential - CRANK.potential(theta)).max() < 1e-13
    forward = dynamics.forward(theta[:, None], rate[:, None], exact[:, None])[:, 0]
    assert np.abs(forward - acceleration).max() < 1e-11


# --- against an independent algorithm --------------------------------------------------------


def tree_forces(machine, q, v, tau_a, friction):
    """Joint forces of the tree with friction and passive elements written out once more."""
    force = np.zeros(machine.model.nv)
    force[machine.closure.active] = tau_a
    for element in machine.forces:
        i = machine.column(element.joint)
        force[i] += element.force - element.stiffness * (q[i] - element.rest)
        force[i] -= element.damping * v[i]
    for joint, law in (machine.friction if friction else {}).items():
        i = machine.column(joint)
        sign = np.sign(v[i])
        force[i] -= law.coulomb * sign + law.coulomb_offset
        force[i] -= law.viscous * v[i] + law.viscous_offset * v[i] * sign
    return force


@pytest.mark.parametrize("friction", [False, True])
def test_forward_equals_constraint_dynamics(loaded, friction):
    machine = loaded.replace(end_stops=())
    q_a, v_a, _, tau = states(200, seed=3)
    found = crane.Dynamics(machine).forward(q_a, v_a, tau, friction=friction)
    postures = machine.closure.solve(q_a)
    for i, q in enumerate(postures):
        gamma = machine.closure.gamma(q)
        v = gamma @ v_a[i]
        force = tree_forces(machine, q, v, tau[i], friction)
        exact = oracles.constraint_dynamics(machine, q, v, force)
        assert relative(found[i], exact[machine.closure.active]) < 1e-10
        # passive joints too: a = gamma a_A + drift
        passive = gamma @ found[i] + machine.closure.drift(q, v)
        assert relative(passive, exact) < 1e-10


@pytest.mark.parametrize(("name", "reach"), [("stewart", 0.08), ("five_bar", 0.3)])
def test_forward_of_other_loops_equals_constraint_dynamics(name, reach, request):
    machine = request.getfixturevalue(name)
    dynamics = crane.Dynamics(machine)
    random, n = np.random.default_rng(4), len(machine.active)
    for _ in range(40):
        q_a, v_a = random.uniform(-reach, reach, n), random.uniform(-0.5, 0.5, n)
        tau = random.uniform(-50, 80, n)
        q = machine.closure.solve(q_a)
        force = np.zeros(machine.model.nv)
        force[machine.closure.active] = tau
        exact = oracles.constraint_dynamics(machine, q, machine.closure.gamma(q) @ v_a, force)
        found = dynamics.forward(q_a, v_a, tau)
        assert relative(found, exact[machine.closure.active]) < 1e-11


def test_legs_of_the_stewart_platform_carry_its_weight(stewart):
    """Statics on paper: forces along massless legs balance a platform at rest."""
    model = pin.Model(stewart.model)
    heavy = model.getJointId("e1")
    for body in range(1, model.njoints):
        if body != heavy:
            model.inertias[body] = pin.Inertia.Zero()
    dynamics = crane.Dynamics(dataclasses.replace(stewart, model=model))
    q_a = np.array([0.02, -0.05, 0.03, 0.0, 0.06, -0.01])
    q = stewart.closure.solve(q_a)
    data = stewart.model.createData()
    pin.framesForwardKinematics(stewart.model, data, q)
    pose = data.oMf[stewart.frame("platform")]
    arm = pose.rotation @ model.inertias[heavy].lever
    weight = np.array([0.0, 0.0, -oracles.GRAVITY * model.inertias[heavy].mass])
    rates = oracles.stewart_rates(pose.rotation, pose.translation)
    exact = -np.linalg.solve(rates.T, np.concatenate([weight, np.cross(arm, weight)]))
    assert relative(dynamics.gravity(q_a), exact) < 1e-12
    assert relative(dynamics.inverse(q_a, 0 * q_a, 0 * q_a), exact) < 1e-12


# --- with itself -----------------------------------------------------------------------------


@pytest.mark.parametrize("friction", [False, True])
def test_inverse_of_forward_is_the_force(loaded, friction):
    q_a, v_a, a_a, tau = states(200, seed=5)
    dynamics = crane.Dynamics(loaded)
    acceleration = dynamics.forward(q_a, v_a, tau, friction=friction)
    back = dynamics.inverse(q_a, v_a, acceleration, friction=friction)
    assert relative(back, tau) < 1e-10
    force = dynamics.inverse(q_a, v_a, a_a, friction=friction)
    assert relative(dynamics.forward(q_a, v_a, force, friction=friction), a_a) < 1e-10


def test_parts_add_up_to_the_inverse(loaded):
    q_a, v_a, a_a, _ = states(50, seed=6)
    dynamics = crane.Dynamics(loaded)
    mass = np.einsum("nij,nj->ni", dynamics.mass_matrix(q_a), a_a)
    whole = dynamics.inverse(q_a, v_a, a_a)
    assert relative(mass + dynamics.bias(q_a, v_a), whole) < 1e-11
    with_friction = dynamics.inverse(q_a, v_a, a_a, friction=True)
    assert relative(whole + dynamics.friction(q_a, v_a), with_friction) < 1e-11
    rest = 0 * v_a
    held = dynamics.gravity(q_a) - dynamics.passive(q_a, rest)
    assert relative(dynamics.bias(q_a, rest), held) < 1e-11


def test_regressor_times_parameters_is_the_inverse(dynamics, bare):
    q_a, v_a, a_a, _ = states(100, seed=7)
    regressor = dynamics.regressor(q_a, v_a, a_a)
    assert regressor.shape == (100, 3, 110) and dynamics.parameters.shape == (110,)
    force = dynamics.inverse(q_a, v_a, a_a)
    assert relative(regressor @ dynamics.parameters, force) < 1e-10
    random = np.random.default_rng(7)
    for _ in range(5):  # of no possible body, all the same
        parameters = random.uniform(-1, 1, 110)
        other = crane.Dynamics(with_parameters(bare, parameters))
        assert np.abs(other.parameters - parameters).max() < 1e-12
        found = regressor @ parameters
        assert relative(found, other.inverse(q_a, v_a, a_a)) < 1e-10


def test_regressor_leaves_passive_forces_out(loaded):
    q_a, v_a, a_a, _ = states(20, seed=8)
    dynamics = crane.Dynamics(loaded)
    found = dynamics.regressor(q_a, v_a, a_a) @ dynamics.parameters
    expected = dynamics.inverse(q_a, v_a, a_a) + dynamics.passive(q_a, v_a)
    assert relative(found, expected) < 1e-10


def test_parameters_are_the_published_masses(dynamics, bare):
    mass = dict(zip(bare.joints, dynamics.parameters[::10], strict=True))
    published = {"q1": 0.3181, "q9": 0.1833, "q2": 0.2180, "q6": 0.2010, "q11": 0.0280,
                 "q7": 0.0530, "q3": 0.2180, "q4": 0.81 * 0.034, "X1": 0.19 * 0.034,
                 "q10": 0.81 * 0.034, "X2": 0.19 * 0.034}  # fmt: skip
    assert mass == pytest.approx(published, rel=1e-12)
    # about the joint: inertia of link 3 about its pin, m c^2 added to that about the COM
    link3 = dynamics.parameters[10 * bare.joints.index("q2") :][:10]
    assert link3[1:4] == pytest.approx(0.2180 * np.array([0.1100, 0.0109, 0.0]), rel=1e-12)
    assert link3[9] == pytest.approx(0.419e-3 + 0.2180 * (0.11**2 + 0.0109**2), rel=1e-12)


@pytest.mark.parametrize("name", ["mini", "stewart", "slider_crank", "five_bar"])
def test_tree_is_assembled_depth_first(name, request):
    """Joints have Pinocchio's order, without which its crba is silently wrong."""
    model = request.getfixturevalue(name).model
    random, data = np.random.default_rng(10), model.createData()
    for _ in range(10):
        q = random.uniform(-1, 1, model.nq)
        upper = np.triu(pin.crba(model, data, q))
        assert relative(upper + np.triu(upper, 1).T, tree_mass(model, q)) < 1e-13


# --- energy ----------------------------------------------------------------------------------


def bodies(machine):
    """(link, mass, com, inertia about it) of every link, read from the URDFs once more."""
    for chain in machine.chains:
        for link in etree.parse(str(chain.urdf)).getroot().iterfind("link"):
            inertial = link.find("inertial")
            if inertial is None:
                continue
            origin = inertial.find("origin")
            com = np.array([float(x) for x in origin.get("xyz").split()])
            assert origin.get("rpy") is None
            get = inertial.find("inertia").get
            xx, xy, xz, yy, yz, zz = (
                float(get(key)) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
            )
            tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            yield link.get("name"), float(inertial.find("mass").get("value")), com, tensor


@pytest.mark.parametrize("name", ["mini", "stewart"])
def test_energy_equals_the_sum_over_bodies(name, request):
    """Velocities of all links by differences of their placements."""
    machine = request.getfixturevalue(name).replace(friction={}, forces=(), end_stops=())
    dynamics, data = crane.Dynamics(machine), machine.model.createData()
    random = np.random.default_rng(11)
    middle = (machine.lower + machine.upper) / 2
    span = 0.4 * (machine.upper - machine.lower)
    for _ in range(4):
        q_a = middle + random.uniform(-1, 1, len(middle)) * span
        v_a = random.uniform(-1, 1, len(middle)) * span

        def placements(t, q_a=q_a, v_a=v_a):
            q = machine.closure.solve(q_a + t * v_a)
            pin.framesForwardKinematics(machine.model, data, q)
            return np.array(
                [data.oMf[machine.frame(link)].homogeneous for link, *_ in bodies(machine)]
            )

        here, rate = placements(0.0), oracles.derivative(placements, 2e-3)
        kinetic = potential = 0.0
        for (_, mass, com, tensor), at, speed in zip(bodies(machine), here, rate, strict=True):
            turn = speed[:3, :3] @ at[:3, :3].T  # skew: angular velocity in the world
            angular = at[:3, :3].T @ np.array([turn[2, 1], turn[0, 2], turn[1, 0]])
            velocity = speed[:3, :3] @ com + speed[:3, 3]
            kinetic += (mass * velocity @ velocity + angular @ tensor @ angular) / 2
            potential += oracles.GRAVITY * mass * (at[:3, :3] @ com + at[:3, 3])[2]
        found = dynamics.energy(q_a, v_a)
        assert found[0] == pytest.approx(kinetic, rel=1e-9)
        assert found[1] == pytest.approx(potential, rel=1e-12)


def test_power_of_the_drives_is_the_rate_of_energy_plus_dissipation(loaded):
    dynamics = crane.Dynamics(loaded)
    q_a, v_a, _, tau = states(40, seed=14)
    q_a[:, 1:] = np.clip(q_a[:, 1:], 1e-3, STROKE - 1e-3)  # clear of the end stops
    here = list(dynamics.forces.stick_slip_columns)
    for q, v, force in zip(q_a, v_a, tau, strict=True):
        a = dynamics.forward(q, v, force, friction=True)
        # along q + v t + a t^2 / 2; strokes move by micrometres
        rate = oracles.derivative(
            lambda t: sum(dynamics.energy(q + t * v + t * t * a / 2, v + t * a)),  # noqa: B023
            2e-5,
        )
        slip, none = np.sign(loaded.closure.gamma(loaded.closure.solve(q)) @ v)[here], np.zeros(3)
        dynamics.set_stick_slip_modes(slip, none, none, True)
        *rates, lost, _ = dynamics.evaluate_closed("rates", loaded.closure.solve(q), v, force)
        speed = np.array(rates[: loaded.model.nv])
        # by hand: friction of all joints, and the two dampers among the elements
        by_hand = v @ dynamics.friction(q, v) + 0.7 * speed[loaded.column("q9")] ** 2
        by_hand += 30.0 * speed[loaded.column("X1")] ** 2
        assert lost == pytest.approx(by_hand, rel=1e-12)
        assert force @ v == pytest.approx(rate + lost, abs=1e-8 * (abs(rate) + abs(lost)))


# --- friction --------------------------------------------------------------------------------


def test_published_friction_of_the_active_joints(mini):
    """Table 1 with the sign that brakes, at speeds where the smoothed sign is the sign."""
    only_active = {joint: mini.friction[joint] for joint in mini.active}
    dynamics = crane.Dynamics(mini.replace(friction=only_active))
    q_a = np.array([0.3, 0.02, 0.01])
    fast = np.array([0.4, 0.05, 0.06])
    out = dynamics.friction(q_a, fast)
    # passive viscous friction of 0.4 (0.8) kg m2/s stands in the same place as F_V
    assert out == pytest.approx(
        [0.1010 + 0.0110 + 0.8 * 0.4, 16 - 6 + 600.4 * 0.05, 7.5 + 21.5 + (500.4 - 300) * 0.06],
        rel=1e-12,
    )
    back = dynamics.friction(q_a, -fast)
    assert back == pytest.approx(
        [-0.1010 + 0.0110 - 0.8 * 0.4, -16 - 6 - 600.4 * 0.05, -7.5 + 21.5 - 800.4 * 0.06],
        rel=1e-12,
    )
    # X1 brakes both ways; X2's offset drives its slow retraction, as its table says
    assert out[1] > 0 > back[1]
    assert dynamics.friction(q_a, np.array([0.0, 0.0, -0.005]))[2] > 0


def test_friction_brakes_the_motion_and_is_left_out_unless_asked_for(mini):
    dynamics = crane.Dynamics(mini)
    q_a = np.array([0.3, 0.02, 0.01])
    hold = dynamics.gravity(q_a)
    for v_a in np.vstack([np.eye(3), -np.eye(3)])[[0, 1, 3, 4]] * [0.5, 0.01, 0.01]:
        coasting = dynamics.forward(q_a, v_a, hold)
        braked = dynamics.forward(q_a, v_a, hold, friction=True)
        assert (braked - coasting) @ dynamics.mass_matrix(q_a) @ v_a < 0
    plain = crane.Dynamics(mini.replace(friction={}))
    v_a = np.array([0.5, 0.01, 0.01])
    assert np.array_equal(dynamics.bias(q_a, v_a), plain.bias(q_a, v_a))
    assert np.array_equal(dynamics.inverse(q_a, v_a, v_a), plain.inverse(q_a, v_a, v_a))
    assert np.array_equal(plain.friction(q_a, v_a), np.zeros(3))


def test_viscous_friction_of_passive_joints_acts_through_gamma(mini):
    viscous = {joint: crane.description.Friction(viscous=0.4) for joint in oracles.PASSIVE}
    dynamics = crane.Dynamics(mini.replace(friction=viscous))
    q_a, v_a, _, _ = states(20, seed=15)
    slopes = oracles.mini_forwarder_gamma(*q_a.T[1:])
    for i, found in enumerate(dynamics.friction(q_a, v_a)):
        gamma = np.array([[0.0, *slopes[name][i]] for name in oracles.PASSIVE])
        assert relative(found, 0.4 * gamma.T @ gamma @ v_a[i]) < 1e-12


def test_friction_law_and_its_smoothing(slider_crank):
    law = {"coulomb": 3.0, "coulomb_offset": 0.5, "viscous": 2.0, "viscous_offset": -0.7}
    q_a = np.array([1.1])
    for smoothing in (0.0, 0.05, 1e-3):
        machine = slider_crank.replace(
            friction={"theta": crane.description.Friction(**law, smoothing=smoothing)}
        )
        dynamics = crane.Dynamics(machine)
        for v in (-2.0, -0.03, 0.0, 0.03, 2.0):
            sign = np.tanh(v / smoothing) if smoothing else np.sign(v)
            expected = 3 * sign + 0.5 + 2 * v - 0.7 * v * sign
            assert dynamics.friction(q_a, np.array([v]))[0] == pytest.approx(expected, rel=1e-14)


# --- springs, dampers, constant forces, end stops --------------------------------------------


def test_conservative_elements_do_virtual_work(bare):
    """Force on the drives = - d/dq_A of the stored energy, written out here."""
    machine = bare.replace(forces=ELEMENTS, end_stops=STOPS)
    dynamics = crane.Dynamics(machine)
    plain = crane.Dynamics(bare)
    random = np.random.default_rng(16)

    def stored(q_a):
        q = machine.closure.solve(q_a)
        q3, q7, x1 = (q[machine.column(name)] for name in ("q3", "q7", "X1"))
        springs = 2.0 * (q3 - 1.2) ** 2 + 0.5 * (q3 - 0.3) ** 2 + 800.0 * (x1 - 0.01) ** 2
        depths = np.maximum(0, np.maximum(q_a[1:] - STROKE, -q_a[1:]))
        return springs / 2 - 0.2 * q3 + 0.3 * q7 + np.array([1e5, 5e4]) @ depths**2

    inside = random.uniform([-1, 1e-3, 1e-3], [1, 0.029, 0.029], (15, 3))
    beyond = [[0.1, -1e-3, 0.01], [0.1, 0.031, 0.01], [0.1, 0.01, -5e-4], [0.1, 0.0305, 0.0312]]
    for q_a in np.vstack([inside, beyond]):
        rest = np.zeros(3)
        force = dynamics.passive(q_a, rest)
        slope = [
            oracles.derivative(lambda t: stored(q_a + t * axis), 1e-5)  # noqa: B023
            for axis in np.eye(3)
        ]
        assert np.abs(force + slope).max() < 1e-8 * max(1.0, np.abs(force).max())
        difference = dynamics.energy(q_a, rest)[1] - plain.energy(q_a, rest)[1]
        assert difference == pytest.approx(stored(q_a), abs=1e-12)
        moved = plain.inverse(q_a, rest, rest) - dynamics.inverse(q_a, rest, rest)
        assert relative(moved, force) < 1e-10


@pytest.mark.parametrize("exponent", [1.0, 1.4])
@pytest.mark.parametrize("backend", ["compiled", "pinocchio"])
def test_gas_follows_its_law_and_stores_its_work(bare, exponent, backend):
    """p V^n = const on an active and on a passive joint; force = - d/dq_A of -int p dV."""
    area, pressure, volume, rest = -3e-4, 4e5, 2e-5, 0.01
    gas = (
        crane.description.GasSpring("X1", area, pressure, volume, rest, exponent),
        crane.description.GasSpring("q3", 2e-5, 1e5, 8e-5, 1.3, exponent),
    )
    dynamics, plain = (
        crane.Dynamics(bare.replace(gas_springs=g), backend=backend) for g in (gas, ())
    )
    column = bare.column("q3")

    def released(a, p, v, x):
        """Work of the gas from rest to x."""
        law = lambda s: a * p * (v / (v + a * s)) ** exponent  # noqa: E731
        return scipy.integrate.quad(law, 0.0, x, epsrel=1e-13)[0]

    def stored(q_a):
        joint = bare.closure.solve(q_a)[column]
        one = released(area, pressure, volume, q_a[1] - rest)
        return -one - released(2e-5, 1e5, 8e-5, joint - 1.3)

    random = np.random.default_rng(18)
    for q_a in random.uniform([-1, 1e-3, 1e-3], [1, 0.029, 0.029], (5, 3)):
        rest_v = np.zeros(3)
        force = dynamics.passive(q_a, rest_v)
        slope = [
            oracles.derivative(lambda t: stored(q_a + t * axis), 1e-4)  # noqa: B023
            for axis in np.eye(3)
        ]
        assert np.abs(force + slope).max() < 1e-8 * np.abs(force).max()
        gap = dynamics.energy(q_a, rest_v)[1] - plain.energy(q_a, rest_v)[1]
        assert gap == pytest.approx(stored(q_a), abs=1e-11)


def test_end_stops_push_back_and_never_pull(bare):
    dynamics = crane.Dynamics(bare.replace(end_stops=STOPS))

    def force(x1, v1, x2=0.01, v2=0.0):
        return dynamics.passive(np.array([0.0, x1, x2]), np.array([0.0, v1, v2]))[1:]

    assert np.array_equal(force(0.015, 5.0), [0, 0])
    assert np.array_equal(force(0.030, 5.0), [0, 0])  # at the limit itself
    deep = 1e-4
    assert force(0.030 + deep, 0.0)[0] == pytest.approx(-2e5 * deep, rel=1e-9)
    assert force(-deep, 0.0)[0] == pytest.approx(2e5 * deep, rel=1e-9)
    # Hunt and Crossley: 1 + damping d', harder going in, softer coming out, never sticky
    assert force(0.030 + deep, 0.02)[0] == pytest.approx(-2e5 * deep * 1.4, rel=1e-9)
    assert force(0.030 + deep, -0.02)[0] == pytest.approx(-2e5 * deep * 0.6, rel=1e-9)
    assert force(-deep, -0.02)[0] == pytest.approx(2e5 * deep * 1.4, rel=1e-9)
    assert force(-deep, 0.02)[0] == pytest.approx(2e5 * deep * 0.6, rel=1e-9)
    assert force(0.030 + deep, -1.0)[0] == 0 and force(-deep, 1.0)[0] == 0
    assert force(0.015, 0.0, x2=0.030 + deep, v2=3.0)[1] == pytest.approx(-1e5 * deep, rel=1e-9)


# --- payload ---------------------------------------------------------------------------------

PAYLOAD = crane.Payload(
    "link7_tip", 0.25, com=(0.01, -0.03, 0.004),
    inertia=[[2e-4, 1e-5, -2e-5], [1e-5, 3e-4, 4e-6], [-2e-5, 4e-6, 2.5e-4]],
)  # fmt: skip


def test_payload_equals_a_link_with_that_mass(mini, tmp_path):
    """The same numbers written into the URDF's massless frame."""
    folder = mini.path.parent
    chain = (folder / "urdf/mini_forwarder/chain_a.urdf").read_text()
    link = '<link name="link7_tip"/>'
    assert link in chain
    heavy = (
        '<link name="link7_tip"><inertial><origin xyz="0.01 -0.03 0.004"/><mass value="0.25"/>'
        '<inertia ixx="2e-4" ixy="1e-5" ixz="-2e-5" iyy="3e-4" iyz="4e-6" izz="2.5e-4"/>'
        "</inertial></link>"
    )
    (tmp_path / "chain_a.urdf").write_text(chain.replace(link, heavy))
    text = mini.path.read_text().replace("urdf: urdf", f"urdf: {folder}/urdf")
    text = text.replace(f"{folder}/urdf/mini_forwarder/chain_a.urdf", "chain_a.urdf")
    (tmp_path / "heavy.yaml").write_text(text)
    written = quiet(crane.load, tmp_path / "heavy.yaml")
    carried = mini.with_payload(PAYLOAD)
    q_a, v_a, a_a, _ = states(50, seed=18)
    for machine in (mini, carried):
        found = crane.Dynamics(machine).inverse(q_a, v_a, a_a)
        gap = relative(found, crane.Dynamics(written).inverse(q_a, v_a, a_a))
        assert gap < 1e-12 if machine is carried else gap > 0.1
    a, b = crane.Dynamics(carried), crane.Dynamics(written)
    assert a.parameters == pytest.approx(b.parameters, rel=1e-12, abs=1e-18)
    assert relative(a.mass_matrix(q_a), b.mass_matrix(q_a)) < 1e-12


def test_payloads_add_up_and_leave_the_machine_alone(mini):
    before = crane.Dynamics(mini).parameters
    twice = mini.with_payload(PAYLOAD).with_payload(PAYLOAD)
    once = crane.Dynamics(mini.with_payload(PAYLOAD)).parameters
    assert crane.Dynamics(twice).parameters - once == pytest.approx(once - before, abs=1e-15)
    assert np.array_equal(crane.Dynamics(mini).parameters, before)
    unloaded = mini.with_payload(crane.Payload("link7_tip", 0.0))
    assert np.abs(crane.Dynamics(unloaded).parameters - before).max() < 1e-16
    standing = mini.with_payload(dataclasses.replace(PAYLOAD, frame="base"))
    assert np.array_equal(crane.Dynamics(standing).parameters, before)


# --- stacks, errors, open chains -------------------------------------------------------------


def test_bad_arguments(mini, dynamics):
    q_a, v_a, a_a, _ = states(3)
    for call, text in (
        (lambda: dynamics.inverse(q_a, v_a[:2], a_a), r"2, 3. samples do not go together"),
        (lambda: dynamics.inverse(q_a, v_a[:, :2], a_a), r"v_a has the shape \(3, 2\)"),
        (lambda: dynamics.forward(q_a, v_a, np.full((3, 3), np.nan)), "tau_a is nan at q1 of"),
        (lambda: dynamics.forward(q_a[0], v_a[0], v_a[0] * np.nan), "tau_a is nan at q1, give"),
        (lambda: dynamics.forward(q_a[0], v_a[0], v_a[0, :2]), r"tau_a has the shape \(2,\)"),
        (lambda: dynamics.forward(q_a[0], None, v_a[0]), "v_a is not made of real numbers"),
        (lambda: dynamics.gravity([0.0, np.inf, 0.0]), "q_a is inf at X1"),
        (lambda: dynamics.mass_matrix(np.zeros((0, 3))), "empty"),
        (lambda: crane.Dynamics(mini, "exakt"), "formulation 'exakt' is unknown, .*'exact'"),
    ):
        with pytest.raises(InputError, match=text):
            call()


def test_single_calls_are_those_of_lists(loaded):
    """Lists are checked and evaluated as a stack of one, arrays by machine code alone."""
    q_a, *others = states(40)
    q_a = q_a[0] + 0.05 * (q_a - q_a[0])
    q_a[20] = states(3, 1)[0][2]  # too far for one step, and back
    counts = {
        "inverse": 3, "forward": 3, "mass_matrix": 1, "bias": 2, "gravity": 1, "friction": 2,
        "passive": 2, "energy": 2, "regressor": 3,
    }  # fmt: skip
    direct, checked = crane.Dynamics(loaded), crane.Dynamics(loaded)
    for name, count in counts.items():
        for i, sample in enumerate(zip(*(q_a, *others)[:count], strict=True)):
            with at_most(np.inf if i in (0, 20, 21) else 12):
                found = getattr(direct, name)(*sample)
            wanted = getattr(checked, name)(*map(list, sample))
            assert np.array_equal(found, wanted) and np.shape(found) == np.shape(wanted), name


@pytest.mark.parametrize("name", ["ur5_robot", "xarm7"])
def test_open_arms_equal_pinocchio(name):
    machine = crane.load(name)
    dynamics = crane.Dynamics(machine)
    model = pin.buildModelFromUrdf(str(machine.path))
    assert machine.active == machine.joints == tuple(model.names)[1:]
    data, random = model.createData(), np.random.default_rng(20)
    for _ in range(30):
        q = random.uniform(machine.lower, machine.upper)
        v, a = random.uniform(-2, 2, (2, model.nv))
        assert np.array_equal(machine.closure.solve(q), q)
        assert np.array_equal(machine.closure.gamma(q), np.eye(model.nv))
        assert np.array_equal(machine.closure.drift(q, v), np.zeros(model.nv))
        exact = pin.rnea(model, data, q, v, a)
        assert relative(dynamics.inverse(q, v, a), exact) < 1e-14
        assert relative(dynamics.forward(q, v, exact), pin.aba(model, data, q, v, exact)) < 1e-9
        assert relative(dynamics.forward(q, v, exact), a) < 1e-9
        assert relative(dynamics.regressor(q, v, a) @ dynamics.parameters, exact) < 1e-12
    assert machine.closure.solve(np.zeros((4, model.nv))).shape == (4, model.nv)


# --- MuJoCo ----------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["compiled", "pinocchio"])
def test_from_rest_friction_that_sticks_is_against_the_acceleration(mini, backend):
    """Offsets always act, Coulomb friction only on moving joints, also passive ones."""
    laws = {**mini.friction, "q4": crane.description.Friction(coulomb=0.2, stiction=0.1)}
    machine = mini.replace(friction=laws)
    rough = crane.Dynamics(machine, backend=backend)
    bare = crane.Dynamics(mini.replace(friction={}), backend=backend)
    q_a, rest = np.array([0.3, 0.012, 0.015]), np.zeros(3)
    gamma = machine.closure.gamma(machine.closure.solve(q_a))
    offsets = np.array([laws[joint].coulomb_offset for joint in mini.active])
    assert rough.inverse(q_a, rest, rest, friction=True) == pytest.approx(
        bare.inverse(q_a, rest, rest) + offsets, abs=1e-12
    )
    a_a = np.array([0.5, -0.02, 0.03])
    wanted = bare.inverse(q_a, rest, a_a) + offsets
    for joint, law in laws.items():
        row = gamma[machine.column(joint)]
        wanted += row * law.breakaway_force * np.sign(row @ a_a)
    found = rough.inverse(q_a, rest, a_a, friction=True)
    assert found == pytest.approx(wanted, abs=1e-9)
    assert np.abs(found - bare.inverse(q_a, rest, a_a) - offsets).max() > 1.0
