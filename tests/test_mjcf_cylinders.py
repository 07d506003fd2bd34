"""Actuators between sites in MJCF: spatial tendons and slider-cranks as cylinders without mass."""

import warnings

import numpy as np
import pytest

import crane
from crane.common.errors import CraneWarning

mujoco = pytest.importorskip("mujoco")
from mujoco_oracle import Oracle  # noqa: E402

LOADER = """<mujoco model="loader"><compiler angle="radian"/>
<worldbody>
  <site name="foot" pos="0.3 0.05 0.1"/><site name="rail" pos="-0.5 0 0.4" euler="0.2 1.3 0"/>
  <body name="frame" pos="0 0 0.2"><joint name="slew" axis="0 0 1"/><geom size="0.3" mass="90"/>
    <site name="heel" pos="0.3 0 -0.1"/><site name="mast" pos="-0.2 0.1 0.6"/>
    <body name="boom" pos="0 0 0.3">
      <joint name="lift" axis="0 -1 0" range="-0.3 1.2" limited="true"/>
      <geom type="capsule" fromto="0 0 0 2 0 0" size="0.05" mass="40"/>
      <site name="rod" pos="0.8 0 -0.1"/><site name="eyelet" pos="1 0.1 0.1"/>
      <body name="arm" pos="2 0 0"><joint name="fold" axis="0 -1 0.1" range="-2 1"/>
        <geom type="capsule" fromto="0 0 0 1.5 0 -0.2" size="0.04" mass="15"/>
        <site name="hook" pos="0.3 0 -0.2"/><site name="crank" pos="0.25 0.1 0"/>
      </body></body></body>
  <site name="slider" pos="0.5 0 1"/>
</worldbody>
<tendon>
  <spatial name="lifter" limited="true" range="0.4 1.4" damping="20" armature="3" stiffness="700"
    springlength="0.5"><site site="heel"/><site site="rod"/></spatial>
  <spatial name="rope"><site site="mast"/><site site="eyelet"/><site site="hook"/>
    <pulley divisor="2"/><site site="heel"/><site site="rod"/></spatial>
  <spatial name="detour" range="0.2 2.6" limited="true" armature="0.5"><site site="foot"/>
    <site site="rail"/><site site="mast"/><site site="heel"/></spatial>
</tendon>
<actuator>
  <motor name="pump" tendon="lifter" gear="1000"/><position name="hold" tendon="lifter" kp="3"/>
  <cylinder name="winch" tendon="rope" gear="-3"/><general name="guy" tendon="detour"/>
  <general name="knee" cranksite="crank" slidersite="eyelet" cranklength="1.4" gear="2.5"/>
</actuator></mujoco>"""


@pytest.fixture(scope="module")
def loader(tmp_path_factory):
    path = tmp_path_factory.mktemp("mjcf") / "loader.xml"
    path.write_text(LOADER)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        return crane.load(path)


def lengths(machine, q):
    """Lengths of the drives by name, from zero coordinates on."""
    return {
        drive.name: sum(f * q[machine.column(joint)] for joint, f in drive.factors.items())
        for drive in machine.drives
    }


def actuators(oracle, machine):
    """Actuators of MuJoCo by the name of their drive, the first of each."""
    found = {}
    for i in range(oracle.model.nu):
        by_tendon = oracle.model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_TENDON
        part = oracle.model.tendon(oracle.model.actuator_trnid[i, 0]) if by_tendon else None
        found.setdefault(part.name if by_tendon else oracle.model.actuator(i).name, i)
    assert set(found) == {drive.name for drive in machine.drives}
    return found


def test_lengths_moments_and_accelerations_are_mujoco_s(loader):
    """Of one strut, of branches that share one, over fixed sites, and of a slider-crank."""
    oracle, dynamics = Oracle(loader.path, loader), crane.Dynamics(loader)
    of_drive = actuators(oracle, loader)
    home = loader.home[loader.closure.active]
    oracle.place(loader.home, 0 * loader.home)
    first, start = oracle.data.actuator_length.copy(), lengths(loader, loader.home)
    random = np.random.default_rng(2)
    for part in random.uniform(-1, 1, (8, 3, len(home))):
        q_a, v_a = home + 0.02 * part[0], part[1]
        q = loader.closure.solve(q_a)
        gamma = loader.closure.gamma(q)
        oracle.place(q, gamma @ v_a)
        data, found, rates = oracle.data, lengths(loader, q), lengths(loader, gamma @ v_a)
        force = np.zeros(oracle.model.nv)
        u = random.normal(size=len(loader.drives))
        for drive, effort in zip(loader.drives, u, strict=True):
            i = of_drive[drive.name]
            assert found[drive.name] - start[drive.name] == pytest.approx(
                data.actuator_length[i] - first[i], rel=1e-11, abs=1e-13
            )
            assert rates[drive.name] == pytest.approx(
                data.actuator_velocity[i], rel=1e-11, abs=1e-12
            )
            row, count = data.moment_rowadr[i], data.moment_rownnz[i]
            columns = data.moment_colind[row : row + count]
            force[columns] += effort * data.actuator_moment[row : row + count]
        wanted = oracle.accelerations(force)
        a_a = dynamics.forward(q_a, v_a, dynamics.active_forces(q_a, u), friction=True)
        found = oracle.motion(q, gamma @ v_a, gamma @ a_a + loader.closure.drift(q, gamma @ v_a))
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-10 * np.abs(wanted).max())


def test_what_tendons_are(loader):
    """Names, factors, limits less the fixed parts, rotors; hinges with a cylinder are passive."""
    drives = {drive.name: dict(drive.factors) for drive in loader.drives}
    assert drives == {
        "lifter": {"lifter": 1000.0},
        "rope": {"rope_1": -3.0, "rope_2": -3.0, "lifter": -1.5},
        "detour": {"detour": 1.0},
        "knee": {"knee": 2.5},
    }
    joints = loader.tree.joints
    assert (joints["lifter"].limits.lower, joints["lifter"].limits.upper) == (0.4, 1.4)
    fixed = np.linalg.norm([0.8, 0.05, -0.3]) + np.linalg.norm([0.5, -0.1, -0.7])
    assert joints["detour"].limits.upper == pytest.approx(2.6 - fixed, rel=1e-12)
    assert joints["lifter"].rotor_inertia == 3.0
    # without a range of its own that of its hinge, in the plane of the boom
    angle = np.array([1.2, -0.3]) + np.arctan2(0.1, 1.0)
    eyelet = np.hypot(1.0, 0.1) * np.array([np.cos(angle), np.sin(angle)])
    ends = np.linalg.norm(eyelet - np.array([[-0.2], [0.3]]), axis=0)
    assert joints["rope_2"].limits.upper < np.inf  # of another hinge
    limits = joints["rope_1"].limits
    np.testing.assert_allclose((limits.lower, limits.upper), ends, rtol=1e-12)
    assert not {"slew", "lift", "fold"} & set(loader.active)
    assert all(
        np.allclose(loader.home[loader.column(f"{x}_pin_z")], 0) for x in ("lifter", "knee_rod")
    )


@pytest.mark.parametrize("kind", ["mjcf", "machine"])
def test_cylinders_without_mass_are_written_as_they_are_read(kind, loader, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        if kind == "mjcf":
            crane.formats.write_mjcf(loader, tmp_path / "again.xml")
        path = tmp_path / "again.xml" if kind == "mjcf" else crane.write_machine(loader, tmp_path)
        again = crane.load(path)
    assert {x.name: dict(x.factors) for x in again.drives} == {
        x.name: dict(x.factors) for x in loader.drives
    }
    assert set(again.joints) == set(loader.joints) and set(again.active) == set(loader.active)
    order = [loader.active.index(joint) for joint in again.active]
    one, two = crane.Dynamics(loader), crane.Dynamics(again)
    q_a = loader.home[loader.closure.active]
    v_a = np.linspace(0.1, 0.3, len(q_a))
    for found, wanted in (
        (two.mass_matrix(q_a[order]), one.mass_matrix(q_a)[np.ix_(order, order)]),
        (two.bias(q_a[order], v_a[order]), one.bias(q_a, v_a)[order]),
        (two.passive(q_a[order], 0 * q_a), one.passive(q_a, 0 * q_a)[order]),
    ):
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-11 * np.abs(wanted).max())
    for joint in ("lifter", "detour"):
        assert again.tree.joints[joint].limits.upper == pytest.approx(
            loader.tree.joints[joint].limits.upper, rel=1e-12
        )


PENDULUM = """<mujoco><compiler angle="radian"/><worldbody><site name="g" pos="{}"/>
<body name="hand" mocap="true" pos="0 0 2"><site name="hand"/></body>
<body><joint name="h" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 1 0 0" size=".05" mass="2"/>
<site name="s" pos="0.5 0 0"/><site name="t_end" pos="0.2 0 0.1"/></body></worldbody>
<tendon><spatial name="t">{}</spatial></tendon><actuator><motor name="a" tendon="t"/></actuator>
</mujoco>"""


@pytest.mark.parametrize(
    ("ground", "path", "active", "drives"),
    [
        ("0 0 -1", "g s", ["t_"], {"t": {"t_": 1.0}}),  # another link is called t_end
        ("-1 0 0", "g s", ["h"], {"t": {"t_": 1.0}}),  # a dead centre at home
        ("0.3 1 -0.4", "g s g", ["t_"], {"t": {"t_": 2.0}}),
        ("0 0 1", "hand s", ["t_"], {"t": {"t_": 1.0}}),
        ("0 0 1", "g hand", ["h"], {"h": {"h": 1.0}}),  # nothing moves it
        ("0.5 0 0", "g s", ["h"], {"h": {"h": 1.0}}),  # of length zero
        ("0 0 1", "s t_end", ["h"], {"h": {"h": 1.0}}),  # within one body
    ],
)
def test_odd_tendons(ground, path, active, drives, tmp_path):
    """What moves at home is an active joint, what cannot move a machine is left out."""
    sites = "".join(f'<site site="{site}"/>' for site in path.split())
    (tmp_path / "odd.xml").write_text(PENDULUM.format(ground, sites))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        machine = crane.load(tmp_path / "odd.xml")
    assert list(machine.active) == active
    assert {x.name: dict(x.factors) for x in machine.drives} == drives
    told = any("actuators by sites, bodies, tendons around" in str(x.message) for x in caught)
    assert told == ("h" in drives)
