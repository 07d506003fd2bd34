"""Constraints between joints: gears, mimic joints, cams."""

import re
import warnings

import numpy as np
import pinocchio as pin
import pytest

import crane
from crane.common.errors import CraneError, CraneWarning

LINK = (
    '<link name="{name}"><inertial><origin xyz="{com} 0 0"/><mass value="{mass}"/>'
    '<inertia ixx="{i}" ixy="0" ixz="0" iyy="{i}" iyz="0" izz="{i}"/></inertial></link>'
)
JOINT = (
    '<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
    '<origin xyz="{xyz}"/><axis xyz="{axis}"/>'
    '<limit lower="-3" upper="3" effort="1" velocity="1"/>{more}</joint>'
)


def train(folder, mimic=True, gravity_axis="0 1 0"):
    """A driven arm, a wheel geared to it, and a rack that the wheel drives."""
    links = ['<link name="base"/>']
    for name, com, mass, i in (
        ("arm", 0.3, 2.0, 0.05),
        ("wheel", 0.0, 1.5, 0.02),
        ("rack", 0.1, 0.8, 0.01),
    ):
        links.append(LINK.format(name=name, com=com, mass=mass, i=i))
    gear = '<mimic joint="q1" multiplier="-2.5" offset="0.2"/>' if mimic else ""
    rack = '<mimic joint="q2" multiplier="0.07"/>' if mimic else ""
    turning, sliding = "revolute", "prismatic"
    rows = (
        ("q1", turning, "base", "arm", "0 0 0", gravity_axis, ""),
        ("q2", turning, "base", "wheel", "0.4 0 0", gravity_axis, gear),
        ("x", sliding, "arm", "rack", "0.1 0 0", "1 0 0", rack),
    )
    keys = ("name", "kind", "parent", "child", "xyz", "axis", "more")
    joints = [JOINT.format(**dict(zip(keys, row, strict=True))) for row in rows]
    path = folder / "train.urdf"
    path.write_text(f'<robot name="train">{"".join(links)}{"".join(joints)}</robot>')
    return path


def full(path):
    """Pinocchio's tree without the constraints."""
    return pin.buildModelFromXML(re.sub(r"<mimic[^>]*/>", "", path.read_text()))


GAMMA = np.array([[1.0], [-2.5], [-0.175]])
REST = np.array([0.0, 0.2, 0.014])


def test_mimics_are_linear_and_exact(tmp_path):
    machine = crane.load(train(tmp_path))
    assert machine.active == ("q1",)
    q1 = np.linspace(-1.1, 1.1, 23)[:, None]
    q = machine.closure.solve(q1)
    columns = [machine.column(name) for name in ("q1", "q2", "x")]
    np.testing.assert_allclose(q[:, columns], q1 @ GAMMA.T + REST, atol=1e-14)
    gamma = machine.closure.gamma(q)[:, columns]
    np.testing.assert_allclose(gamma, np.tile(GAMMA, (23, 1, 1)), atol=1e-14)
    assert np.abs(machine.closure.drift(q, gamma[:, :, 0] * 0.7)).max() == 0.0


def test_dynamics_are_those_of_the_projected_tree(tmp_path):
    """gamma^T rnea(q, gamma v, gamma a) of the free tree, and gamma^T M gamma."""
    path = train(tmp_path)
    machine, model = crane.load(path), full(path)
    data, dynamics = model.createData(), crane.Dynamics(machine)
    order = [model.joints[model.getJointId(name)].idx_v for name in ("q1", "q2", "x")]
    gamma, rest = np.zeros((3, 1)), np.zeros(3)
    gamma[order], rest[order] = GAMMA, REST
    rng = np.random.default_rng(5)
    for q1, v1, a1 in rng.uniform(-1, 1, (20, 3)):
        q = gamma[:, 0] * q1 + rest
        v, a = gamma[:, 0] * v1, gamma[:, 0] * a1
        tau = gamma[:, 0] @ pin.rnea(model, data, q, v, a)
        assert dynamics.inverse([q1], [v1], [a1])[0] == pytest.approx(tau, rel=1e-12)
        mass = pin.crba(model, data, q)
        mass = np.triu(mass) + np.triu(mass, 1).T
        assert dynamics.mass_matrix([q1])[0, 0] == pytest.approx(
            (gamma.T @ mass @ gamma)[0, 0], rel=1e-12
        )
        assert dynamics.forward([q1], [v1], [tau])[0] == pytest.approx(a1, rel=1e-10)
        regressor = dynamics.regressor([q1], [v1], [a1])
        assert (regressor @ dynamics.parameters)[0] == pytest.approx(tau, rel=1e-12)
    other = crane.Dynamics(machine, backend="pinocchio")
    assert other.inverse([0.3], [0.5], [0.2]) == pytest.approx(
        dynamics.inverse([0.3], [0.5], [0.2]), rel=1e-12
    )


def test_two_geared_flywheels(tmp_path):
    """M = I_1 + n^2 I_2, and a free motion that keeps its energy."""
    path = train(tmp_path, gravity_axis="0 0 1")
    machine = crane.load(path)
    dynamics = crane.Dynamics(machine)
    q1 = 0.4
    slide = 0.1 + 0.1 + GAMMA[2, 0] * q1 + REST[2]
    expected = 0.05 + 2.0 * 0.3**2 + 2.5**2 * 0.02 + 0.01 + 0.8 * (slide**2 + 0.175**2)
    assert dynamics.mass_matrix([q1])[0, 0] == pytest.approx(expected, rel=1e-12)
    recording = crane.simulate(machine, initial=([0.1], [1.5]), duration=1.0)
    energy = recording.channels["kinetic"] + recording.channels["potential"]
    assert np.ptp(energy) < 1e-9 * energy[0]


def test_a_machine_file_couples_joints(tmp_path):
    train(tmp_path, mimic=False)
    (tmp_path / "train.yaml").write_text(
        "name: train\n"
        "chains: [{name: a, urdf: train.urdf}]\n"
        "active: [q2]\n"
        "couplings:\n"
        "  - {name: gear, joints: {q1: 2.5, q2: 1.0}, offset: 0.2}\n"
        "  - {name: rack, joints: {x: 1.0, q2: -0.07}}\n"
    )
    machine = crane.load(tmp_path / "train.yaml")
    same = crane.load(train(tmp_path)).with_active_joints(["q2"])
    force = [crane.Dynamics(m).inverse([0.3], [0.2], [0.1])[0] for m in (machine, same)]
    assert force[0] == pytest.approx(force[1], rel=1e-12)


def test_locking_one_locks_what_follows(tmp_path):
    path = train(tmp_path)
    with pytest.raises(crane.CraneError, match="nothing drives the machine"):
        crane.load(path, lock={"x": 0.05})
    panda = crane.load("panda")
    assert len(panda.active) == 8
    assert "panda_finger_joint2" not in panda.active
    gamma = panda.closure.gamma(panda.home)
    column = panda.active.index("panda_finger_joint1")
    assert gamma[panda.column("panda_finger_joint2"), column] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("coupling", "line"),
    [
        ("{name: g, joints: {q1: 1.0}}", "coupling 'g' joins less than two joints"),
        ("{name: g, joints: {q1: 1.0, q9: 2.0}}", "'q9'"),
        ("{name: g, joints: {q1: 0.0, q2: 2.0}}", "the factor of 'q1' is 0"),
        ("{name: g, joints: {q1: 1.0, q2: 2.0}, ofset: 1}", "did you mean 'offset'"),
    ],
)
def test_bad_couplings_are_refused(tmp_path, coupling, line):
    train(tmp_path, mimic=False)
    (tmp_path / "train.yaml").write_text(
        f"name: train\nchains: [{{name: a, urdf: train.urdf}}]\nactive: [q1, x]\n"
        f"couplings:\n  - {coupling}\n"
    )
    with pytest.raises(crane.CraneError) as caught:
        crane.load(tmp_path / "train.yaml")
    assert line in str(caught.value)
    assert "train.yaml:" in str(caught.value)


CAM = """<mujoco model="cam"><compiler angle="radian"/><worldbody>
 <body><joint name="leader" axis="0 1 0" ref="0.2" damping="0.3"/>
  <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" mass="2"/>
  <body pos="0.4 0 0"><joint name="follower" axis="0 1 0" ref="-0.1"/>
   <geom type="capsule" fromto="0 0 0 0.3 0 0.1" size="0.02" mass="1"/>
   <body name="tool" pos="0.3 0 0"><joint name="slide" type="slide" axis="1 0 0.2"/>
    <geom size="0.05" mass="0.7"/></body></body></body>
 <body pos="0.9 0 0.4"><joint name="a" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 -0.4 0 -0.2" size="0.02" mass="1.5"/>
  <body pos="-0.4 0 -0.2"><joint name="b" axis="0 1 0"/>
   <geom type="capsule" fromto="0 0 0 0.4 0 -0.3" size="0.02" mass="0.8"/>
   <body name="end" pos="0.4 0 -0.3"/></body></body></worldbody>
<tendon><fixed name="double"><joint joint="leader" coef="2"/></fixed>
 <fixed name="one"><joint joint="slide" coef="1"/></fixed></tendon>
<equality><joint name="cam" joint1="follower" joint2="leader" polycoef="0 0.3 -0.4 0.2 0.15"/>
 <tendon name="hump" tendon1="one" tendon2="double" polycoef="0.02 0 0.05 -0.01 0.03"/>
 <connect name="eye" body1="tool" body2="end" anchor="0.05 0 0"/></equality>
<actuator><motor joint="leader"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def cam(tmp_path_factory):
    pytest.importorskip("mujoco")
    path = tmp_path_factory.mktemp("cam") / "cam.xml"
    path.write_text(CAM)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        return crane.load(path)


def cam_states(cam, count=6):
    random = np.random.default_rng(4)
    for part in random.uniform(-1, 1, (count, 3)):
        yield cam.home[cam.closure.active] + 0.3 * part[:1], 2 * part[1:2], 5 * part[2:]


def test_polynomial_couplings_move_as_in_mujoco(cam):
    """Of joints and of tendons of one joint, about their references; by both backends."""
    from mujoco_oracle import Oracle

    oracle, dynamics = Oracle(cam.path, cam), crane.Dynamics(cam)
    plain = crane.Dynamics(cam, backend="pinocchio")
    for q_a, v_a, tau in cam_states(cam):
        q = cam.closure.solve(q_a)
        gamma = cam.closure.gamma(q)
        oracle.place(q, gamma @ v_a)
        assert oracle.gap < 1e-14
        along = np.zeros(len(cam.joints))
        along[cam.closure.active] = tau
        wanted = oracle.accelerations(oracle.forces(q, along))
        drift = cam.closure.drift(q, gamma @ v_a)
        for backend in (dynamics, plain):
            a_a = backend.forward(q_a, v_a, tau, friction=True)
            found = oracle.motion(q, gamma @ v_a, gamma @ a_a + drift)
            np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12 * np.abs(wanted).max())


def test_derivatives_with_polynomial_couplings(cam):
    """Of inverse dynamics by coordinates, against central differences of sixth order."""
    dynamics = crane.Dynamics(cam)
    for q_a, v_a, a_a in cam_states(cam, 3):
        h, wanted = 2e-3, 0.0
        for count, weight in ((1, 45.0), (2, -9.0), (3, 1.0)):
            ahead, back = (dynamics.inverse(q_a + x * count * h, v_a, a_a) for x in (1, -1))
            wanted = wanted + weight / (60 * h) * (ahead - back)
        found = dynamics.derivatives("inverse", q_a, v_a, a_a)["q_a"]
        np.testing.assert_allclose(found[:, 0], wanted, rtol=1e-9)


def test_files_and_locks_of_polynomial_couplings(cam, tmp_path):
    crane.formats.write_mjcf(cam, tmp_path / "again.xml")
    file = crane.write_machine(cam, tmp_path / "folder")
    q_a = cam.home[cam.closure.active] + [[-0.2], [0.3]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        for path in (tmp_path / "again.xml", file):
            again = crane.load(path)
            order = [again.column(joint) for joint in cam.joints]
            found, wanted = again.closure.solve(q_a)[:, order], cam.closure.solve(q_a)
            np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-14)
        text = file.read_text()
        for old, new, line in (
            ("leader: [0.48", "leder: [0.48", "joint 'leder' is unknown, did you mean 'leader'"),
            (", -0.15", "", r"'leader' has 2 coefficients, give 3: \[a, b, c\]"),
        ):
            assert old in text
            file.write_text(text.replace(old, new))
            with pytest.raises(CraneError, match=line):
                crane.load(file)
        with pytest.raises(CraneError, match="'cam' has powers, for which URDF. has no place"):
            crane.formats.write_urdf_plus(cam, tmp_path / "cam.urdf")
        with pytest.raises(CraneError, match="'cam' has powers of leader, lock that joint"):
            crane.load(cam.path, lock={"follower": 0.1})
