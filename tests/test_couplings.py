"""Linear constraints between joints: gears and mimic joints."""

import re
import warnings

import numpy as np
import pinocchio as pin
import pytest
from broken_machines import DATA

import crane
from crane.common.errors import CraneWarning

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


ROTOR = """<robot name="rotor"><link name="base"/>
  <joint name="rotor" type="continuous"><parent link="base"/><child link="disc"/>
    <axis xyz="0 0 1"/></joint>
  <link name="disc"><inertial><mass value="0.5"/>
    <inertia ixx="3e-3" iyy="3e-3" izz="5e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>"""


@pytest.mark.parametrize(
    ("leader", "ratio", "active"),
    [("crank", -2.0, "crank"), ("crank", 26.9, "rotor"), ("crank", 300.0, "crank"),
     ("crank", 300.0, "rotor"), ("rocker", 300.0, "crank"), ("coupler", -1000.0, "crank")],
)  # fmt: skip
def test_a_geared_rotor_does_not_disturb_home(tmp_path, edited, leader, ratio, active):
    """It follows a joint that the file gives or the loop moves by many turns, without a search."""
    (tmp_path / "rotor.urdf").write_text(ROTOR)
    chain = f"\n  - {{name: gear, urdf: {tmp_path}/rotor.urdf, parent: pin_B}}\n\nloops:"
    gear = f"couplings: [{{name: gear, joints: {{rotor: 1, {leader}: {-ratio}}}}}]"
    end = re.search("tasks:.*", (DATA / "four_bar.yaml").read_text(), re.DOTALL)[0]
    plain = crane.load(DATA / "four_bar.yaml")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        machine = edited(
            "four_bar.yaml", "\n\nloops:", chain, end, "", "tip: coupler_pin",
            f"{gear}\ntip: coupler_pin", "active: [crank]", f"active: [{active}]",
        )  # fmt: skip
    assert machine.closure.home_search is None
    home = dict(zip(machine.joints, machine.home, strict=True))
    assert home["rotor"] == pytest.approx(ratio * home[leader], rel=1e-10)
    for joint, value in zip(plain.joints, plain.home, strict=True):
        assert home[joint] == pytest.approx(value, abs=1e-10)


@pytest.mark.parametrize("ratio", [50.0, 300.0])
def test_a_search_of_home_looks_past_the_rotor(tmp_path, edited, ratio):
    """The crank is not in the file: the rotor neither hinders the search nor is it named."""
    (tmp_path / "rotor.urdf").write_text(ROTOR)
    chain = f"\n  - {{name: gear, urdf: {tmp_path}/rotor.urdf, parent: pin_B}}\n\nloops:"
    gear = f"couplings: [{{name: gear, joints: {{rotor: 1, crank: {-ratio}}}}}]"
    with pytest.warns(CraneWarning, match=r"home was searched for, .* has crank [\d.]+ rad off"):
        machine = edited(
            "four_bar.yaml", "\n\nloops:", chain, "  crank: 1.2\n", "", "tip: coupler_pin",
            f"{gear}\ntip: coupler_pin",
        )  # fmt: skip
    home = dict(zip(machine.joints, machine.home, strict=True))
    assert home["rotor"] == pytest.approx(ratio * home["crank"], rel=1e-12)
    # nearest to what the file says, as without the rotor
    assert abs(home["coupler"] + 1.0) < 0.5 and abs(home["rocker"] - 1.5) < 0.5
