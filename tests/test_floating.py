"""Floating bases and joints with several freedoms: backends, Pinocchio, closed forms."""

import shutil
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import crane
from crane.common.errors import InputError

DATA = Path(__file__).parent / "data"
QUANTITIES = {
    "inverse": 3, "forward": 3, "mass_matrix": 1, "bias": 2, "gravity": 1, "energy": 2,
    "regressor": 3,
}  # fmt: skip


def box(name, mass, at="0 0 0"):
    return (
        f'<link name="{name}"><inertial><origin xyz="{at}"/><mass value="{mass}"/>'
        '<inertia ixx="0.02" ixy="0.001" ixz="0.002" iyy="0.05" iyz="-0.001" izz="0.06"/>'
        "</inertial></link>"
    )


def hinge(name, parent, child, at, rpy="0 0 0", kind="continuous"):
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{at}" rpy="{rpy}"/>'
        f'<parent link="{parent}"/><child link="{child}"/><axis xyz="0 0 1"/></joint>'
    )


ARM = (
    '<robot name="arm">' + box("hull", 8.0, "0.02 -0.01 0.05") + box("upper", 2.0, "0.2 0 0")
    + box("lower", 1.0, "0.1 0.02 0") + hinge("one", "hull", "upper", "0.1 0.2 0.3", "0.3 0.2 0.1")
    + hinge("two", "upper", "lower", "0.4 0 0", "1.2 0 0") + "</robot>"
)  # fmt: skip


@pytest.fixture
def arm(tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM)
    return crane.load(tmp_path / "arm.urdf", floating=True)


def walker():
    pytest.importorskip("mujoco")
    return crane.load(DATA / "mjcf" / "walker.xml")


def states(machine, count, seed=0):
    """Active coordinates whose base has any attitude, velocities and forces."""
    random = np.random.default_rng(seed)
    n = len(machine.active)
    for _ in range(count):
        q_a = machine.home[machine.closure.active] + random.uniform(-0.2, 0.2, n)
        turn = random.normal(size=3)
        turn *= random.uniform(0, np.pi) / np.linalg.norm(turn)
        for part, value in zip(("rx", "ry", "rz"), turn, strict=True):
            (name,) = (joint for joint in machine.active if joint.endswith(f"_{part}"))
            q_a[machine.active.index(name)] = value
        yield q_a, *random.normal(size=(2, n))


@pytest.mark.parametrize("which", ["arm", "walker"])
@pytest.mark.parametrize("quantity", QUANTITIES)
def test_machine_code_agrees_with_pinocchio(which, quantity, arm):
    machine = arm if which == "arm" else walker()
    fast, tree = crane.Dynamics(machine), crane.Dynamics(machine, backend="pinocchio")
    assert fast.backend == "compiled"
    for state in states(machine, 5):
        arguments = state[: QUANTITIES[quantity]]
        found = np.asarray(getattr(fast, quantity)(*arguments))
        wanted = np.asarray(getattr(tree, quantity)(*arguments))
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12 * np.abs(wanted).max())


def test_an_open_tree_is_pinocchios(arm):
    """Accelerations of `pin.aba`, wrenches of `pin.rnea`: same coordinates, same axes."""
    dynamics, data = crane.Dynamics(arm), arm.model.createData()
    for q, v, x in states(arm, 10, seed=1):
        at = arm.coordinates.configuration(arm.closure.solve(q))
        wanted = pin.aba(arm.model, data, at, v, x)
        np.testing.assert_allclose(dynamics.forward(q, v, x), wanted, atol=1e-11)
        wanted = pin.rnea(arm.model, data, at, v, x)
        np.testing.assert_allclose(dynamics.inverse(q, v, x), wanted, atol=1e-11)


def coordinates_of(machine, configuration):
    """Coordinates (nv,) from Pinocchio's configuration with one floating base."""
    coordinates, first = machine.coordinates, machine.coordinates.floating_base_columns[0]
    at = machine.model.joints[int(coordinates.joints[first])].idx_q
    out = configuration[coordinates._configuration_indices]
    out[first + 3 : first + 6] = pin.log3(pin.Quaternion(configuration[at + 3 : at + 7]).matrix())
    return out


def test_the_tip_moves_as_its_jacobian_says(arm):
    kinematics = crane.Kinematics(arm, "lower")
    for q, v, _ in states(arm, 3, seed=2):
        h = 1e-6
        ends = []
        for sign in (1, -1):
            at = pin.integrate(arm.model, arm.coordinates.configuration(q), sign * h * v)
            ends.append(kinematics.position(coordinates_of(arm, at)))
        slope = (ends[0] - ends[1]) / (2 * h)
        np.testing.assert_allclose(kinematics.jacobian(q) @ v, slope, atol=1e-8)


@pytest.mark.parametrize("which", ["arm", "walker"])
def test_steps_of_machine_code_are_those_of_python(which, arm, monkeypatch):
    machine = arm if which == "arm" else walker()
    q, v, _ = next(states(machine, 1, seed=3))
    start = {"initial": (q, 2 * v), "duration": 0.2, "step": 1e-3}
    one = crane.simulate(machine, **start)
    two = crane.simulate(machine, **start, backend="pinocchio")
    np.testing.assert_allclose(one.q, two.q, rtol=0, atol=1e-9)
    np.testing.assert_allclose(one.v, two.v, rtol=0, atol=1e-8 * np.abs(two.v).max())


def test_momentum_and_energy_in_free_flight(arm):
    """A rotation through all attitudes meets no singularity."""
    upright = np.array([0, 0, 0, 0, np.pi / 2, 0, 0, 0])  # where Cardan angles are not defined
    start = upright, np.array([0.3, 0.2, 4.0, 0.1, 9.0, 0.1, 0.3, -0.4])
    recording = crane.simulate(arm, initial=start, duration=2.0, step=5e-4)
    turns = recording.q[:, 3:6]
    assert np.linalg.norm(turns, axis=1).max() <= np.pi + 1e-12
    energy = recording.channels["kinetic"] + recording.channels["potential"]
    assert np.ptp(energy) < 1e-7 * recording.channels["kinetic"].max()
    model, data = arm.model, arm.model.createData()
    pitches, spins, places = [], [], []
    for q, v in zip(recording.q, recording.v, strict=True):
        at = arm.coordinates.configuration(q)
        momentum = pin.computeCentroidalMomentum(model, data, at, v)
        spins.append(momentum.angular.copy())
        places.append(data.com[0].copy())
        pitches.append(np.arcsin(-data.oMi[1].rotation[2, 0]))
    assert np.ptp(pitches) > 2.5
    assert np.ptp(spins, axis=0).max() < 1e-7 * np.abs(spins).max()
    t, places = recording.time, np.array(places)
    speed = (places[-1] - places[0]) / t[-1] + [0, 0, 9.81 * t[-1] / 2]
    fall = places[0] + np.outer(t, speed) - np.outer(t**2, [0, 0, 9.81 / 2])
    np.testing.assert_allclose(places, fall, atol=1e-8)


def test_a_spin_about_one_axis_goes_round_and_round(tmp_path):
    """Closed form: R = exp(w t) about an axis of inertia, for ten turns."""
    (tmp_path / "top.urdf").write_text(
        '<robot name="top"><link name="ground"/><link name="top"><inertial><mass value="1"/>'
        '<inertia ixx="1" ixy="0" ixz="0" iyy="2" iyz="0" izz="3"/></inertial></link>'
        '<joint name="fly" type="floating"><parent link="ground"/><child link="top"/></joint>'
        "</robot>"
    )
    top = crane.load(tmp_path / "top.urdf")
    recording = crane.simulate(
        top, initial=(np.zeros(6), [0, 0, 0, 0, 0, 20 * np.pi]), duration=1.0
    )
    angle = recording.q[:, 5]
    assert np.abs(angle).max() <= np.pi + 1e-12
    wanted = 20 * np.pi * recording.time
    np.testing.assert_allclose(np.exp(1j * angle), np.exp(1j * wanted), atol=1e-9)


@pytest.mark.slow
def test_a_crane_on_its_valves_in_free_fall_keeps_its_momentum(tmp_path):
    """Internal forces of a circuit change neither the fall nor the attitude of the whole."""
    models = Path(__file__).parents[1] / "models"
    shutil.copytree(models, tmp_path / "models")
    urdf = tmp_path / "models" / "urdf" / "patu655" / "boom.urdf"
    text = urdf.read_text()
    inertial = (
        '<link name="base"><inertial><origin xyz="0 0 -0.5"/><mass value="5000"/><inertia '
        'ixx="3000" ixy="0" ixz="0" iyy="4000" iyz="0" izz="5000"/></inertial>'
    )
    assert text.count('<link name="base">') == 1
    urdf.write_text(text.replace('<link name="base">', inertial))
    machine = crane.load(tmp_path / "models" / "patu655.yaml", floating=True)
    assert machine.free == machine.active[4:]
    run = crane.simulate(machine, crane.joystick(machine, "stir"), duration=1.0)
    assert np.ptp(run.q[:, machine.active.index("X_lift")]) > 1e-4  # the levers do something
    model, data = machine.model, machine.model.createData()
    weight = 9.81 * sum(inertia.mass for inertia in model.inertias)
    for i in range(0, len(run.time), 200):
        q = machine.closure.solve(run.q[i])
        v = machine.closure.gamma(q) @ run.v[i]
        at = machine.coordinates.configuration(q)
        momentum = pin.computeCentroidalMomentum(model, data, at, v)
        fall = [0, 0, -weight * run.time[i]]
        np.testing.assert_allclose(momentum.linear, fall, rtol=0, atol=1e-9 * weight)
        np.testing.assert_allclose(momentum.angular, 0, atol=1e-8 * weight)


def test_a_body_that_is_held_is_where_it_floated_to(arm):
    """Six locks are the coordinates, the three turns a rotation vector; then nothing floats."""
    q, v, x = next(states(arm, 1, seed=4))
    v[:6], x[:6] = 0, 0  # at rest, accelerations of the arm only
    names = [arm.joints[i] for i in range(6)]
    held = crane.load(arm.path, floating=True, lock=dict(zip(names, q[:6].tolist(), strict=True)))
    assert held.active == arm.active[6:] and not held.coordinates.floating_base_columns
    wanted = crane.Dynamics(arm).inverse(q, v, x)[6:]
    np.testing.assert_allclose(
        crane.Dynamics(held).inverse(q[6:], v[6:], x[6:]), wanted, atol=1e-12
    )
    place = crane.Kinematics(arm, "lower").position(q)
    np.testing.assert_allclose(crane.Kinematics(held, "lower").position(q[6:]), place, atol=1e-12)


def test_one_coordinate_held_leaves_cardan_angles(arm):
    sliding = crane.load(arm.path, floating=True, lock={"base_z": 0.3})
    assert len(sliding.active) == 7 and not sliding.coordinates.floating_base_columns


def test_a_sketch_asks_where_the_body_is_held(arm, tmp_path):
    with pytest.raises(InputError, match="'arm' floats, sketch it where it is held: --lock base_"):
        crane.sketch(arm, tmp_path / "arm.png")


# --- joints with several freedoms ---------------------------------------------------------------


BODY = (
    '<link name="arm"><inertial><origin xyz="0.3 -0.1 0.1" rpy="0.2 0 0.1"/><mass value="2"/>'
    '<inertia ixx="0.1" ixy="0.01" ixz="0" iyy="0.12" iyz="0.02" izz="0.11"/></inertial></link>'
)


def machine(folder, kind, extra=""):
    path = folder / f"{kind}.urdf"
    path.write_text(
        f'<robot name="{kind}"><link name="base"/>{BODY}<joint name="J" type="{kind}">'
        '<parent link="base"/><child link="arm"/><origin xyz="0 0.2 1" rpy="0.3 0.1 0"/>'
        f'<axis xyz="0 1 0"/>{extra}</joint></robot>'
    )
    return crane.load(path)


def inertia():
    turn = pin.rpy.rpyToMatrix(0.2, 0.0, 0.1)
    tensor = np.array([[0.1, 0.01, 0], [0.01, 0.12, 0.02], [0, 0.02, 0.11]])
    return pin.Inertia(2.0, np.array([0.3, -0.1, 0.1]), turn @ tensor @ turn.T)


def place():
    return pin.SE3(pin.rpy.rpyToMatrix(0.3, 0.1, 0.0), np.array([0.0, 0.2, 1.0]))


@pytest.mark.parametrize(("kind", "count"), [("spherical", 3), ("floating", 6), ("planar", 3)])
def test_energies_are_those_of_the_body(tmp_path, kind, count):
    """From the body's pose and twist alone; and it stays where such a joint leaves it."""
    ours = machine(tmp_path, kind)
    assert len(ours.active) == count
    dynamics = crane.Dynamics(ours)
    rng = np.random.default_rng(count)
    for _ in range(10):
        q, v = rng.uniform(-0.6, 0.6, (2, count))
        data = ours.model.createData()
        at = ours.coordinates.configuration(ours.closure.solve(q))
        pin.forwardKinematics(ours.model, data, at, v)
        body = ours.model.getFrameId("arm")
        pin.updateFramePlacements(ours.model, data)
        pose, twist = data.oMf[body], pin.getFrameVelocity(ours.model, data, body)
        expected = 0.5 * twist.vector @ inertia().matrix() @ twist.vector
        centre = pose.act(np.array([0.3, -0.1, 0.1]))
        kinetic, potential = dynamics.energy(q, v)
        assert kinetic == pytest.approx(expected, rel=1e-12)
        assert potential == pytest.approx(2.0 * 9.81 * centre[2], rel=1e-12)
        inner = place().actInv(pose)
        if kind == "spherical":
            assert np.abs(inner.translation).max() < 1e-14  # stays at its centre
        if kind == "planar":
            assert abs(inner.translation[1]) < 1e-14  # stays in its plane
            assert inner.rotation[1, 1] == pytest.approx(1.0, abs=1e-14)


def test_a_body_in_free_fall_tumbles_with_its_energy_and_momentum(tmp_path):
    """Closed form of the centre of mass; kinetic energy of the rotation is kept."""
    ours = machine(tmp_path, "floating")
    start = [0.1, 0.2, 0.3, 0.2, -0.3, 0.4], [0.5, 1.0, 2.0, 1.5, -1.0, 0.7]
    recording = crane.simulate(ours, initial=start, duration=0.5)
    energy = recording.channels["kinetic"] + recording.channels["potential"]
    assert np.ptp(energy) < 1e-8 * np.abs(energy).max()
    data = ours.model.createData()
    heights = []
    for q in recording.q:
        pin.centerOfMass(ours.model, data, ours.coordinates.configuration(q))
        heights.append(data.com[0].copy())
    heights, t = np.array(heights), recording.time
    speed = (heights[1] - heights[0]) / t[1] + [0, 0, 9.81 * t[1] / 2]
    fall = heights[0] + np.outer(t, speed) - np.outer(t**2, [0, 0, 9.81 / 2])
    assert np.abs(heights - fall).max() < 1e-9


def test_a_ball_joint_carries_a_spherical_pendulum(tmp_path):
    """Small oscillation about the lowest posture, against the eigenvalues of M and K."""
    ours = machine(tmp_path, "spherical")
    dynamics = crane.Dynamics(ours)
    from scipy.optimize import minimize

    low = minimize(lambda q: dynamics.energy(q, np.zeros(3))[1], [0.1, 1.0, 0.1], tol=1e-12).x
    assert np.abs(dynamics.gravity(low)).max() < 1e-4
    mass = dynamics.mass_matrix(low)
    h = 1e-5
    stiffness = np.column_stack(
        [
            (dynamics.gravity(low + h * e) - dynamics.gravity(low - h * e)) / (2 * h)
            for e in np.eye(3)
        ]
    )
    values = np.sort(np.linalg.eigvals(np.linalg.solve(mass, stiffness)).real)
    assert abs(values[0]) < 1e-5  # it may turn about the vertical
    assert (values[1:] > 1.0).all()


def test_ends_are_told(tmp_path):
    with pytest.raises(crane.CraneError, match=r"planar.urdf:1: joint 'J' is planar, for which"):
        machine(tmp_path, "planar", '<mimic joint="J"/>')
