"""Couplings of joints, gears and cams, and rotors, in every quantity, format and backend."""

import re
import warnings

import numpy as np
import oracles
import pinocchio as pin
import pytest
from broken_machines import DATA
from warned import quiet

import crane
from crane.common.errors import CraneError, CraneWarning
from crane.dynamics.quantity_evaluator import BACKENDS
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.model_terms import InertialTerm, RotorInertiaTerm

BARE = {"friction": {}, "forces": (), "end_stops": ()}
RATIO, DISC = 2.0, 5e-3  # rotor's speed over the joint's, [kg m2]
FLYWHEEL = f"""<robot name="flywheel"><link name="base"/>
  <joint name="flywheel" type="continuous"><parent link="base"/><child link="disc"/>
    <axis xyz="0 0 1"/></joint>
  <link name="disc"><inertial><mass value="0.5"/>
    <inertia ixx="3e-3" iyy="3e-3" izz="{DISC}" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>"""
ROTORS = {"X1": 150.0, "q3": 0.02, "q4": 0.01, "q1": 0.3}  # active and passive, both kinds


def states(machine, count, seed=0):
    random = np.random.default_rng(seed)
    low, high = np.maximum(machine.lower, -1.0), np.minimum(machine.upper, 1.0)
    shape = (count, len(machine.active))
    return random.uniform(low, high, shape), *random.uniform(-1, 1, (3, *shape))


@pytest.fixture(scope="module")
def rotors(mini):
    changes = {f"{joint}.rotor_inertia": value for joint, value in ROTORS.items()}
    return crane.load("mini_forwarder", changes).replace(**BARE)


@pytest.mark.parametrize("joint", ["crank", "rocker"])
def test_a_rotor_is_a_flywheel_geared_to_the_joint(joint, edited, tmp_path):
    """Of a joint on the ground: the disc of another body, twice as fast, counts four times."""
    (tmp_path / "flywheel.urdf").write_text(FLYWHEEL)
    chain = f"\n  - {{name: wheel, urdf: {tmp_path}/flywheel.urdf, parent: pin_B}}\n\nloops:"
    gear = f"couplings: [{{name: gear, joints: {{flywheel: 1, {joint}: -{RATIO}}}}}]"
    changes = ("\n\nloops:", chain, "tip: coupler_pin", f"{gear}\ntip: coupler_pin")
    geared = edited("four_bar.yaml", *changes).replace(**BARE)
    change = {f"{joint}.rotor_inertia": RATIO**2 * DISC}
    plain = crane.load(DATA / "four_bar.yaml", change).replace(**BARE)
    q_a, v_a, a_a, tau = states(plain, 20)
    for backend in BACKENDS:
        one, two = (crane.Dynamics(x, backend=backend) for x in (geared, plain))
        for name, third in (("inverse", a_a), ("forward", tau)):
            found = getattr(two, name)(q_a, v_a, third)
            np.testing.assert_allclose(found, getattr(one, name)(q_a, v_a, third), rtol=1e-12)
        np.testing.assert_allclose(two.energy(q_a, v_a)[0], one.energy(q_a, v_a)[0], rtol=1e-13)
        np.testing.assert_allclose(two.mass_matrix(q_a), one.mass_matrix(q_a), rtol=1e-13)


@pytest.mark.parametrize("formulation", ["exact", "decoupled"])
def test_both_backends_agree_with_the_regressor(rotors, formulation):
    code, tree = (crane.Dynamics(rotors, formulation, backend) for backend in BACKENDS)
    q_a, v_a, a_a, tau = states(rotors, 10)
    q_a[:, 1:] *= 0.03  # [m] of stroke
    assert np.array_equal(tree.parameters[-4:], [ROTORS[x] for x in rotors.joints if x in ROTORS])
    wanted = tree.inverse(q_a, v_a, a_a)
    for dynamics in (code, tree):
        regressor = dynamics.regressor(q_a, v_a, a_a)
        assert regressor.shape == (10, 3, len(dynamics.parameters)) == (10, 3, 114)
        for found in (dynamics.inverse(q_a, v_a, a_a), regressor @ dynamics.parameters):
            np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-11 * np.abs(wanted).max())
        back = dynamics.forward(q_a, v_a, wanted)
        np.testing.assert_allclose(back, a_a, rtol=0, atol=1e-10)
    for name, args in (("bias", (q_a, v_a)), ("mass_matrix", (q_a,)), ("energy", (q_a, v_a))):
        one, two = (np.array(getattr(x, name)(*args)) for x in (code, tree))
        np.testing.assert_allclose(one, two, rtol=0, atol=1e-12 * np.abs(two).max())


def test_pinocchio_s_multipliers_agree(rotors):
    """On the tree with armature, where nothing is projected."""
    dynamics, active = crane.Dynamics(rotors), rotors.closure.active
    q_a, v_a, _, force = states(rotors, 5, seed=1)
    q_a[:, 1:] *= 0.03
    for one, speed, along in zip(q_a, v_a, force, strict=True):
        q = rotors.closure.solve(one)
        tau = np.zeros(rotors.model.nv)
        tau[active] = along
        v = rotors.closure.gamma(q) @ speed
        wanted = oracles.constraint_dynamics(rotors, q, v, tau)[active]
        found = dynamics.forward(one, speed, along)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-6 * np.abs(wanted).max())


def test_a_run_keeps_its_energy(rotors):
    run = quiet(crane.simulate, rotors, lambda t, q, v: np.array([0.2, 20.0, 10.0]), duration=0.05)
    energy = run.channels["kinetic"] + run.channels["potential"]
    assert np.ptp(run.channels["kinetic"]) > 1e-4
    np.testing.assert_allclose(run.channels["work"], energy - energy[0], rtol=0, atol=1e-9)


def test_machine_files_hold_rotors(rotors, tmp_path, edited):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        again = crane.load(crane.write_machine(rotors, tmp_path / "again"))
        locked = crane.load("mini_forwarder", {"X1.rotor_inertia": 3.0}, {"X1": 0.01})
        with pytest.warns(CraneWarning, match="tasks, gains, rotor inertias, left out"):
            crane.formats.write_urdf_plus(crane.load(again.path), tmp_path / "mini.urdf")
    assert dict(zip(again.joints, again.model.armature, strict=True)) == {
        joint: ROTORS.get(joint, 0.0) for joint in rotors.joints
    }
    assert not locked.model.armature.any()  # a rotor that is held does not turn
    with pytest.raises(CraneError, match="'rotor_inertia' is -1, it must not be negative|least 0"):
        edited("four_bar.yaml", "tip: coupler_pin", "rotor_inertia: {crank: -1}\ntip: coupler_pin")
    with pytest.raises(CraneError, match="'crank.rotor_inertia' is -1, it must not be negative"):
        crane.load(DATA / "four_bar.yaml", {"crank.rotor_inertia": -1.0})
    with pytest.raises(CraneError, match="four_bar.yaml:29: joint 'cranc' is unknown, did you me"):
        edited("four_bar.yaml", "tip: coupler_pin", "rotor_inertia: {cranc: 1}\ntip: coupler_pin")


def test_rotors_are_known_to_identification_unless_a_term_has_them(rotors):
    q_a, v_a, a_a, _ = states(rotors, 20, seed=2)
    q_a[:, 1:] *= 0.03
    wanted = crane.Dynamics(rotors).inverse(q_a, v_a, a_a)
    given = IdentificationModel(rotors, [InertialTerm(rotors)])
    asked = IdentificationModel(
        rotors,
        [InertialTerm(rotors), RotorInertiaTerm(rotors, "X1"), RotorInertiaTerm(rotors, "q3")],
    )
    for model, count in ((given, 110), (asked, 112)):
        at = model.samples(q_a, v_a, a_a)
        found = model.regressor(at) @ model.nominal + model.known_forces(at)
        assert len(model.nominal) == count
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-11 * np.abs(wanted).max())


def test_what_forces_change_by_a_rotor_is_its_regressor(rotors):
    """d tau_A / d I = gamma_j^T (gamma_j a_A + drift_j), of an active and of a passive joint."""
    q_a, v_a, a_a, _ = states(rotors, 10, seed=4)
    q_a[:, 1:] *= 0.03
    names = [f"{joint}.rotor_inertia" for joint in ROTORS]
    found = crane.Dynamics(rotors).derivatives("inverse", q_a, v_a, a_a, by=names)
    q = rotors.closure.solve(q_a)
    gamma = rotors.closure.gamma(q)
    drift = rotors.closure.drift(q, np.einsum("kij,kj->ki", gamma, v_a))
    for joint in ROTORS:
        row, more = gamma[:, rotors.column(joint)], drift[:, rotors.column(joint)]
        wanted = row * (np.einsum("kj,kj->k", row, a_a) + more)[:, None]
        np.testing.assert_allclose(
            found[f"{joint}.rotor_inertia"], wanted, rtol=0, atol=1e-10 * np.abs(wanted).max()
        )


def test_armature_is_mujoco_s_in_closed_loops(rotors, tmp_path):
    """Written as `armature`, and read again: MuJoCo's accelerations of the closed machine."""
    pytest.importorskip("mujoco")
    from mujoco_oracle import Oracle

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        crane.formats.write_mjcf(rotors, tmp_path / "rotors.xml")
        again = crane.load(tmp_path / "rotors.xml").with_active_joints(rotors.active)
    assert {x: again.tree.joints[x].rotor_inertia for x in ROTORS} == ROTORS
    oracle, dynamics = Oracle(tmp_path / "rotors.xml", rotors), crane.Dynamics(rotors)
    for q_a, v_a, _, tau in zip(*states(rotors, 5, seed=5), strict=True):
        q_a[1:], v_a[1:] = 0.03 * q_a[1:], 0.03 * v_a[1:]  # [m] of stroke
        q = rotors.closure.solve(q_a)
        gamma = rotors.closure.gamma(q)
        oracle.place(q, gamma @ v_a)
        along = np.zeros(len(rotors.joints))
        along[rotors.closure.active] = tau
        wanted = oracle.accelerations(oracle.forces(q, along))
        a = gamma @ dynamics.forward(q_a, v_a, tau) + rotors.closure.drift(q, gamma @ v_a)
        found = oracle.motion(q, gamma @ v_a, a)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9 * np.abs(wanted).max())


# --- couplings ----------------------------------------------------------------------------------


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
