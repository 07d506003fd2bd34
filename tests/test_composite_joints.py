"""Joints with several freedoms as series of joints with one each."""

import numpy as np
import pinocchio as pin
import pytest

import crane

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
