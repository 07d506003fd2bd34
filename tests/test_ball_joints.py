"""Ball joints and floating bodies turn without a pole: rotation vectors and body rates."""

import re
import warnings

import numpy as np
import pinocchio as pin
import pytest
from linkages import multipliers
from oracles import BASE_POINTS, PLATFORM_POINTS, REST_LENGTHS
from scipy.spatial.transform import Rotation

import crane
from crane import CraneWarning
from crane.identification.mechanics.smoothed_motion import smoothed_motion

ROD = """<robot name="r"><link name="ground"/>
<link name="arm"><inertial><origin xyz="0.5 0 0"/><mass value="4"/>
  <inertia ixx="0.01" iyy="0.3" izz="0.3" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="rod"><inertial><origin xyz="0.3 0 0"/><mass value="1"/>
  <inertia ixx="0.002" iyy="0.03" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="h" type="continuous"><parent link="ground"/><child link="arm"/>
  <axis xyz="0 -1 0"/></joint>
<joint name="b" type="spherical"><parent link="arm"/><child link="rod"/>
  <origin xyz="1 0 0"/></joint></robot>"""
ROD_MJCF = """<mujoco><option timestep="{step}" integrator="RK4"/><compiler angle="radian"/>
<worldbody><body name="arm"><joint name="h" type="hinge" axis="0 -1 0"/>
<inertial pos="0.5 0 0" mass="4" diaginertia="0.01 0.3 0.3"/>
<body name="rod" pos="1 0 0"><joint name="b" type="ball"/>
<inertial pos="0.3 0 0" mass="1" diaginertia="0.002 0.03 0.03"/></body></body></worldbody>
</mujoco>"""
RSSR = """<robot name="rssr"><link name="ground"/>
<link name="crank"><inertial><origin xyz="0.1 0 0"/><mass value="2"/>
  <inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="rod"><inertial><origin xyz="0.4 0 0"/><mass value="1"/>
  <inertia ixx="0.002" iyy="0.05" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="rocker"><inertial><origin xyz="0 0 0.3"/><mass value="3"/>
  <inertia ixx="0.1" iyy="0.1" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="rod_end"/><link name="rocker_eye"/>
<joint name="c" type="continuous"><parent link="ground"/><child link="crank"/>
  <axis xyz="0 0 1"/></joint>
<joint name="b" type="spherical"><parent link="crank"/><child link="rod"/>
  <origin xyz="0.2 0 0"/></joint>
<joint name="re" type="fixed"><parent link="rod"/><child link="rod_end"/>
  <origin xyz="0.8 0 0"/></joint>
<joint name="k" type="continuous"><parent link="ground"/><child link="rocker"/>
  <origin xyz="0.7 0.3 -0.3"/><axis xyz="0 1 0"/></joint>
<joint name="ke" type="fixed"><parent link="rocker"/><child link="rocker_eye"/>
  <origin xyz="0 0 0.5"/></joint></robot>"""
RSSR_FILE = """
name: rssr
chains: [{name: all, urdf: rssr.urdf}]
loops: [{name: s, type: spherical, predecessor: rod_end, successor: rocker_eye}]
active: [c, b_rx]
home: {c: 0.3}
"""
BODY = """<robot name="body"><link name="ground"/>
<link name="body"><inertial><mass value="3"/>
  <inertia ixx="0.05" iyy="0.11" izz="0.14" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{name}" type="{kind}"><parent link="ground"/><child link="body"/></joint></robot>"""
GROUND = """<link name="ground"><inertial><origin xyz="0 0.1 0"/><mass value="7"/>
  <inertia ixx="0.3" iyy="0.4" izz="0.5" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
# the starts whose rod came to the pole of the second of three angles
STARTS = [(x, 2.0, 0.0) for x in (0.0, 1e-12, 1e-9, 1e-4, 1e-3)]


def load(folder, text, name="machine.urdf", **options):
    (folder / name).write_text(text)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        return crane.load(folder / name, **options)


@pytest.fixture
def rssr(tmp_path):
    (tmp_path / "rssr.urdf").write_text(RSSR)
    return load(tmp_path, RSSR_FILE, "rssr.yaml")


def angle_between(one, two):
    """Angle (N,) [rad] between rotation vectors (N, 3)."""
    return (Rotation.from_rotvec(one).inv() * Rotation.from_rotvec(two)).magnitude()


def energy_error(run):
    energy = run.channels["kinetic"] + run.channels["potential"]
    return np.abs(energy - energy[0]).max() / max(np.abs(run.channels["kinetic"]).max(), 1.0)


def all_coordinates(machine, run):
    return np.column_stack([run[name] for name in machine.joints])


def mujoco_rod(start, duration, step):
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(ROD_MJCF.format(step=step))
    data = mujoco.MjData(model)
    x, y, z, w = Rotation.from_rotvec(start).as_quat()
    data.qpos[1:] = w, x, y, z
    steps = round(duration / step)
    mujoco.mj_step(model, data, nstep=steps)
    return data.qpos[0], Rotation.from_quat(data.qpos[[2, 3, 4, 1]]).as_rotvec()


@pytest.mark.parametrize("backend", ["compiled", "pinocchio"])
def test_inverse_and_forward_dynamics_are_those_of_a_spherical_joint(backend, tmp_path):
    machine = load(tmp_path, ROD)
    assert machine.joints == machine.active == ("h", "b_rx", "b_ry", "b_rz")
    dynamics, data = crane.Dynamics(machine, backend=backend), machine.model.createData()
    rng = np.random.default_rng(0)
    for length in (0.0, 1e-9, 0.5, np.pi / 2, 3.0):
        q, v, a = rng.normal(size=(3, 4))
        q[1:] *= length / np.linalg.norm(q[1:])
        at = machine.coordinates.configuration(q)
        tau = dynamics.inverse(q, v, a)
        np.testing.assert_allclose(tau, pin.rnea(machine.model, data, at, v, a), atol=1e-13)
        np.testing.assert_allclose(dynamics.forward(q, v, tau), a, atol=1e-12)
        assert np.linalg.eigvalsh(dynamics.mass_matrix(q)).min() > 1e-3


@pytest.mark.parametrize("start", STARTS)
def test_a_falling_rod_passes_the_former_pole(start, tmp_path):
    machine = load(tmp_path, ROD)
    run = crane.simulate(machine, None, [0.0, *start], 1.0, 0.5, tolerance=1e-11)
    h, rotation = mujoco_rod(start, 1.0, 2e-4)
    assert run.q[-1, 0] == pytest.approx(h, abs=1e-7)
    assert angle_between(run.q[-1:, 1:], rotation)[0] < 1e-6
    assert energy_error(run) < 1e-10


@pytest.mark.slow
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(1, 10))]
)
def test_falling_rods_agree_with_mujoco_for_ten_seconds(seed, tmp_path):
    """Where two runs of MuJoCo show that the motion itself is predictable to 1e-6 rad."""
    machine, rng = load(tmp_path, ROD), np.random.default_rng(seed)
    compared = 0
    for _ in range(5):
        start = Rotation.random(random_state=rng).as_rotvec()
        run = crane.simulate(machine, None, [0.0, *start], 10.0, 1.0, tolerance=1e-12)
        assert energy_error(run) < 1e-10
        (h, rotation), (coarse, _) = (mujoco_rod(start, 10.0, step) for step in (1e-4, 2e-4))
        error = abs(h - coarse) / 15  # of the finer one, of order 4
        assert run.q[-1, 0] == pytest.approx(h, abs=max(1e-6, 10 * error))
        assert angle_between(run.q[-1:, 1:], rotation)[0] < max(1e-6, 100 * error)
        compared += error < 1e-7
    assert compared


@pytest.mark.parametrize("kind", ["floating", "spherical"])
def test_a_tumbling_body_keeps_energy_and_angular_momentum(kind, tmp_path):
    """About its middle axis, where it turns over again and again."""
    machine = load(tmp_path, BODY.format(name="b", kind=kind))
    count = len(machine.active)
    v = np.zeros(count)
    v[-3:] = 1e-3, 5.0, 1e-3
    run = crane.simulate(
        machine, None, (np.zeros(count), v), 60.0, 0.05, method="DOP853", tolerance=1e-13
    )
    rotations, rates = Rotation.from_rotvec(run.q[:, -3:]), run.v[:, -3:]
    momentum = rotations.apply(rates * [0.05, 0.11, 0.14])
    np.testing.assert_allclose(momentum - momentum[0], 0.0, atol=1e-10 * 0.55)
    spin = 0.5 * (rates**2 * [0.05, 0.11, 0.14]).sum(axis=1)
    np.testing.assert_allclose(spin, spin[0], rtol=1e-10)
    assert (rates[:, 1] < -4.9).any() and (rates[:, 1] > 4.9).any()  # turned over
    assert np.linalg.norm(run.q[:, -3:], axis=1).max() <= np.pi + 1e-12


@pytest.mark.parametrize("axis", range(3))
def test_a_machine_that_is_turned_over_comes_back(axis, tmp_path):
    """A floating arm by 360 degrees about each axis: forces are those of the turned gravity."""
    carried = ROD.replace('<link name="ground"/>', GROUND)
    machine = load(tmp_path, carried, floating=True)
    dynamics, rng = crane.Dynamics(machine), np.random.default_rng(axis)
    at = rng.normal(size=len(machine.active))
    turn = [machine.column(f"base_r{x}") for x in "xyz"]
    forces = []
    for angle in np.linspace(0.0, 2 * np.pi, 9):
        q = at.copy()
        q[turn] = pin.log3(pin.exp3(angle * np.eye(3)[axis]) @ pin.exp3(at[turn]))
        forces.append(dynamics.gravity(q))
        free = np.linalg.norm(forces[-1][:3])
        assert free == pytest.approx(9.81 * machine.tree.total_mass, rel=1e-12)
        assert np.linalg.eigvalsh(dynamics.mass_matrix(q)).min() > 1e-4
    np.testing.assert_allclose(forces[0], forces[-1], atol=1e-12 * 50)


def test_a_linkage_with_a_rod_that_spins(rssr):
    """Newton's method, gamma and accelerations against multipliers of Pinocchio's frames."""
    closure, dynamics, rng = rssr.closure, crane.Dynamics(rssr), np.random.default_rng(0)
    home = rssr.home[closure.active]
    path = home + np.cumsum(rng.normal(size=(60, 2)) * 0.08, axis=0)
    q = closure.solve(path)
    np.testing.assert_array_equal(q[:, closure.active], path)
    assert closure.residual(q).max() < 1e-14
    for at in q[::12]:
        v_a, tau_a = rng.normal(size=(2, 2))
        tau = np.zeros(rssr.model.nv)
        tau[closure.active] = tau_a
        expected = multipliers(rssr, at, closure.gamma(at) @ v_a, tau)[closure.active]
        found = dynamics.forward(at[closure.active], v_a, tau_a)
        np.testing.assert_allclose(found, expected, atol=1e-10 * np.abs(expected).max())


def test_a_linkage_with_a_rod_that_spins_turns_on_and_on(rssr):
    """Past rotations of half a turn, by two methods: energy, loops, and one motion."""
    start = rssr.home[rssr.closure.active], [9.0, 4.0]
    runs = [
        crane.simulate(rssr, None, start, 4.0, step, method=method, tolerance=tolerance)
        for step, method, tolerance in ((1e-3, None, None), (0.01, "DOP853", 1e-11))
    ]
    for run in runs:
        q = all_coordinates(rssr, run)
        assert energy_error(run) < 1e-9
        assert rssr.closure.residual(q).max() < 1e-13
        assert np.linalg.norm(q[:, 1:4], axis=1).max() > 0.99 * np.pi
    assert runs[0].q[-1, 0] - runs[0].q[0, 0] > 4 * np.pi
    assert runs[1].q[-1, 0] == pytest.approx(runs[0].q[-1, 0], abs=1e-8)


@pytest.mark.parametrize(("name", "method"), [("rod", "RK45"), ("rod", "BDF"), ("rssr", "DOP853")])
def test_methods_of_scipy_turn_past_half_a_turn(name, method, rssr, tmp_path):
    """The rod in active coordinates, the linkage in active and passive ones: as compiled."""
    machine = rssr if name == "rssr" else load(tmp_path, ROD)
    start = ([0.1, 0.3, 2.9, 1.0], [0.0, 1.0, 6.0, 5.0]), 0.3, 1e-2
    if name == "rssr":
        start = (rssr.home[rssr.closure.active] + [0.0, 2.8], [2.0, 9.0]), 0.5, 1e-2
    found = crane.simulate(
        machine, None, *start, method=method, tolerance=1e-8, backend="pinocchio"
    )
    expected = crane.simulate(machine, None, *start, tolerance=1e-12)
    assert np.abs(np.diff(expected.q, axis=0)).max() > 1.0
    np.testing.assert_allclose(found.q, expected.q, atol=2e-7)
    np.testing.assert_allclose(found.v, expected.v, atol=2e-6)


@pytest.mark.parametrize("name", ["rod", "rssr"])
def test_derivatives_through_the_former_poles(name, rssr, tmp_path):
    """Of forward dynamics along the velocities, against differences along the same motions."""
    machine = rssr if name == "rssr" else load(tmp_path, ROD)
    closure, dynamics, rng = machine.closure, crane.Dynamics(machine), np.random.default_rng(1)
    n = len(machine.active)
    if name == "rod":
        q = np.array([0.3, 0.0, np.pi / 2, 0.0])
    else:
        q = closure.solve(machine.home[closure.active] + [0.4, -0.6])
    q_a, (v_a, tau) = q[closure.active], rng.normal(size=(2, n))
    derivatives = dynamics.derivatives("forward", q_a, v_a, tau)

    def moved(k, size):
        step = machine.coordinates.coordinate_derivatives(q, closure.gamma(q)[:, k] * size)
        return closure.continuation.solve_newton(q + step, None, 20).q

    def accelerations(at):
        forces = np.zeros(machine.model.nv)
        forces[closure.active] = tau
        if not closure.equations.loops:
            data = machine.model.createData()
            return pin.aba(machine.model, data, machine.coordinates.configuration(at), v_a, tau)
        v = closure.gamma(at) @ v_a
        return multipliers(machine, at, v, forces)[closure.active]

    h = 2e-3
    weights = {-3: -1, -2: 9, -1: -45, 1: 45, 2: -9, 3: 1}
    for k in range(n):
        change = sum(w * accelerations(moved(k, j * h)) for j, w in weights.items()) / (60 * h)
        scale = np.abs(derivatives["q_a"]).max()
        np.testing.assert_allclose(derivatives["q_a"][:, k], change, atol=1e-8 * scale)


def test_angles_are_a_view(tmp_path):
    """Joint states of a tree with three joints in place of the ball: R_x R_y R_z."""
    machine = load(tmp_path, ROD)
    rng = np.random.default_rng(3)
    for _ in range(5):
        q, v = rng.normal(size=(2, 4))
        angles, rates = machine.coordinates.cardan_angles(q)
        expected = Rotation.from_euler("XYZ", angles[1:])
        assert angle_between(expected.as_rotvec(), q[1:]) < 1e-14
        step = 1e-6 * v
        other, _ = machine.coordinates.cardan_angles(
            q + machine.coordinates.coordinate_derivatives(q, step)
        )
        np.testing.assert_allclose((other - angles) / 1e-6, rates @ v, atol=1e-4)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_balls_with_springs_have_angles(axis, tmp_path):
    """A spring along one of them acts on an angle; the others stay what they were."""
    (tmp_path / "rod.urdf").write_text(ROD)
    spring = f"forces: [{{joint: b_r{axis}, stiffness: 3.0}}]"
    text = f"name: sprung\nchains: [{{name: all, urdf: rod.urdf}}]\n{spring}\n"
    machine = load(tmp_path, text, "sprung.yaml")
    assert machine.coordinates.rotation_columns == () and machine.model.nq == 4


def test_locked_balls_keep_their_rotation(tmp_path):
    machine = load(tmp_path, ROD, lock={"b_rx": 0.3, "b_ry": -0.8, "b_rz": 0.5})
    data = machine.model.createData()
    pin.framesForwardKinematics(machine.model, data, np.zeros(1))
    turn = data.oMf[machine.frame("rod")].rotation
    np.testing.assert_allclose(turn, pin.exp3(np.array([0.3, -0.8, 0.5])), atol=1e-14)


def test_mujoco_reads_and_writes_quaternions(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    text = ROD_MJCF.format(step=1e-3).replace('type="ball"', 'type="ball" damping="0.2"')
    key = '<keyframe><key name="home" qpos="0.1 0.5 -0.5 0.7 0.1"/></keyframe></mujoco>'
    machine = load(tmp_path, text.replace("</mujoco>", key), "rod.xml")
    assert machine.friction["b_ry"].viscous == 0.2
    crane.formats.write_mjcf(machine, tmp_path / "written.xml")
    models = [
        mujoco.MjModel.from_xml_path(str(tmp_path / name)) for name in ("rod.xml", "written.xml")
    ]
    quaternion = np.array([0.5, -0.5, 0.7, 0.1])
    np.testing.assert_allclose(
        models[1].key_qpos[0], [0.1, *quaternion / np.linalg.norm(quaternion)], atol=1e-14
    )
    states = []
    for model in models:
        model.opt.integrator, model.opt.timestep = mujoco.mjtIntegrator.mjINT_RK4, 1e-3
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        mujoco.mj_step(model, data, nstep=300)
        states.append(data.qpos.copy())
    np.testing.assert_allclose(states[1], states[0], atol=1e-12)
    assert re.search('type="ball"', (tmp_path / "written.xml").read_text())


def stewart(folder):
    """A platform on six struts on ball joints, which spin about themselves."""
    lines = ['<robot name="stewart">', '<link name="base"/>']

    def link(name, mass, com, moments):
        place, (xx, yy, zz) = " ".join(map(str, com)), moments
        lines.append(
            f'<link name="{name}"><inertial><origin xyz="{place}"/><mass value="{mass}"/><inertia '
            f'ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )

    def joint(name, kind, parent, child, xyz, rpy=(0, 0, 0)):
        place, turn = (" ".join(map(repr, map(float, x))) for x in (xyz, rpy))
        limit = '<limit lower="-0.3" upper="0.3" effort="1e4" velocity="2"/>'
        lines.append(
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{place}" rpy="{turn}"/><axis xyz="1 0 0"/>'
            f"{limit * (kind == 'prismatic')}</joint>"
        )

    loops = []
    arms = PLATFORM_POINTS - PLATFORM_POINTS[0]
    for i, (foot, head, length) in enumerate(
        zip(BASE_POINTS, PLATFORM_POINTS, REST_LENGTHS, strict=True), start=1
    ):
        x, y, z = head - foot
        rpy = np.array([0.0, -np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x)])
        link(f"barrel{i}", 0.9, (0.15, 0, 0), (0.0004, 0.007, 0.007))
        link(f"rod{i}", 0.4, (-0.18, 0, 0), (0.0001, 0.004, 0.004))
        joint(f"f{i}", "spherical", "base", f"barrel{i}", foot, rpy)
        joint(f"s{i}", "prismatic", f"barrel{i}", f"rod{i}", (length, 0, 0))
        if i == 1:
            link("platform", 6.0, arms.mean(axis=0), (0.11, 0.12, 0.2))
            turned_back = pin.rpy.matrixToRpy(pin.rpy.rpyToMatrix(rpy).T)
            joint("p", "spherical", "rod1", "platform", (0, 0, 0), turned_back)
        else:
            lines.append(f'<link name="eye{i}"/>')
            joint(f"e{i}", "fixed", "platform", f"eye{i}", arms[i - 1])
            loops.append(
                f"{{name: l{i}, type: spherical, predecessor: eye{i}, successor: rod{i}}}"
            )
    (folder / "stewart.urdf").write_text("\n".join([*lines, "</robot>"]))
    active = [*(f"s{i}" for i in range(1, 7)), *(f"f{i}_rx" for i in range(1, 7))]
    text = (
        f"name: stewart\nchains: [{{name: all, urdf: stewart.urdf}}]\nactive: {active}\n"
        f"loops: [{', '.join(loops)}]\n"
    )
    return load(folder, text, "stewart.yaml")


@pytest.mark.slow
def test_a_platform_on_struts_that_spin(tmp_path):
    machine = stewart(tmp_path)
    closure, rng = machine.closure, np.random.default_rng(5)
    home = machine.home[closure.active]
    dynamics = crane.Dynamics(machine)
    for q_a in home + rng.normal(size=(3, 12)) * np.repeat([0.02, 0.5], 6):
        q = closure.solve(q_a)
        assert closure.residual(q) < 1e-14
        v_a, tau_a = rng.normal(size=(2, 12))
        tau = np.zeros(machine.model.nv)
        tau[closure.active] = tau_a
        expected = multipliers(machine, q, closure.gamma(q) @ v_a, tau)[closure.active]
        found = dynamics.forward(q_a, v_a, tau_a)
        np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())
    run = crane.simulate(
        machine, None, (home, np.repeat([0.0, 40.0], 6)), 0.15, 0.01, method="DOP853",
        tolerance=1e-11,
    )  # fmt: skip
    q = all_coordinates(machine, run)
    assert closure.residual(q).max() < 1e-13
    for i in range(1, 7):  # most of a turn
        columns = [machine.column(f"f{i}_r{x}") for x in "xyz"]
        assert np.linalg.norm(q[:, columns], axis=1).max() > 0.9 * np.pi
    assert energy_error(run) < 1e-10


def test_recordings_have_quaternions_or_rotation_vectors(tmp_path):
    """A recording by quaternions alone, of either sign, is the one by rotation vectors."""
    machine = load(tmp_path, ROD)
    run = crane.simulate(machine, None, [0.0, 1.0, 2.0, 0.3], 1.0, 1e-3)
    quaternions = run.rotations("b").as_quat(scalar_first=True)
    quaternions[::2] *= -1.0  # the same rotations
    names = ["h_force", "b_rx_force", "b_ry_force", "b_rz_force"]
    header = ["time [s]", "h [rad]", *(f"b_q{x}" for x in "wxyz"), *(f"{x} [N m]" for x in names)]
    values = np.column_stack([run.time, run.q[:, 0], quaternions, 0 * run.tau])
    rows = [",".join(header), *(",".join(map(repr, map(float, row))) for row in values)]
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    found = crane.recordings.read_measured(machine, tmp_path / "log.csv")
    order = [found.joints.index(x) for x in run.joints]
    assert angle_between(found.q[:, order][:, 1:], run.q[:, 1:]).max() < 1e-7
    # central differences, off by h^2 / 6 times the second derivative
    bend = np.abs(np.diff(run.v, 2, axis=0)).max()
    np.testing.assert_allclose(found.v[:, order][1:-1], run.v[1:-1], atol=0.2 * bend)
    angles = found.rotations("b").as_euler("XYZ")
    again = Rotation.from_euler("XYZ", angles).as_rotvec()
    assert angle_between(again, run.q[:, 1:]).max() < 1e-7
    short = [rows[0], rows[1], rows[2].replace(repr(float(quaternions[1, 0])), "7.0")]
    (tmp_path / "short.csv").write_text("\n".join(short) + "\n")
    with pytest.raises(crane.CraneError, match="'b_qw' to 'b_qz' have the length .* at sample 1"):
        crane.recordings.read_measured(machine, tmp_path / "short.csv")


@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
def test_a_rod_on_a_ball_is_identified_from_rotations(tmp_path):
    """Angular accelerations from recorded rotations explain the forces of the falling rod."""
    machine = load(tmp_path, ROD)
    run = crane.simulate(machine, None, ([0.0, 1.0, 2.0, 0.3], [0.0, 1.0, -2.0, 5.0]), 3.0, 1e-3)
    assert np.linalg.norm(run.q[:, 1:], axis=1).max() > 0.98 * np.pi
    motion = smoothed_motion(machine, run, derivatives="lowpass", cutoff=60.0, trust=True)
    middle = slice(300, -300)
    np.testing.assert_allclose(motion.v[middle], run.v[middle], atol=2e-3 * np.abs(run.v).max())
    forces = crane.Dynamics(machine).inverse(run.q[middle], motion.v[middle], motion.a[middle])
    weight = np.abs(crane.Dynamics(machine).gravity(run.q)).max()
    assert np.abs(forces).max() < 0.02 * weight  # nothing drives it
