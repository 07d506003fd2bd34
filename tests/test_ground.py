"""Ground contact: statics, falls, wheels, energy, and the equilibrium at the start."""

import numpy as np
import pytest
from warned import quiet

import crane
from crane.common.errors import CraneError

MASS, WIDE, HIGH = 40.0, 0.6, 0.5  # of a block, half its width along x, and its centre's height


@pytest.fixture
def block(tmp_path):
    """A block that floats, with links at its lower corners."""
    corners = "".join(
        f"""<link name="c{i}"/><joint name="j{i}" type="fixed"><parent link="block"/>
        <child link="c{i}"/><origin xyz="{x} {y} {-HIGH}"/></joint>"""
        for i, (x, y) in enumerate(((WIDE, 0.8), (WIDE, -0.8), (-WIDE, 0.8), (-WIDE, -0.8)))
    )
    path = tmp_path / "block.urdf"
    path.write_text(
        f"""<robot name="block"><link name="world"/><joint name="fly" type="floating">
        <parent link="world"/><child link="block"/></joint><link name="block"><inertial>
        <mass value="{MASS}"/>
        <inertia ixx="6" iyy="5" izz="8" ixy="0" ixz="0" iyz="0"/></inertial></link>
        {corners}</robot>"""
    )
    return crane.load(path)


def feet(slope=0.0, **options):
    ground = crane.description.Ground(normal=(-np.sin(slope), 0.0, np.cos(slope)))
    return [
        crane.description.Contact(f"c{i}", ground, name=f"foot{i}", **options) for i in range(4)
    ]


def start(machine, slope, above=0.0):
    """Coordinates of the block above a slope that rises with x, and still."""
    q = np.zeros(6)
    q[:3] = (HIGH + above) * np.array([-np.sin(slope), 0.0, np.cos(slope)])
    q[4] = -slope
    return q


def run(machine, loads, initial, duration, **options):
    return quiet(crane.simulate, machine, None, initial, duration, loads=loads, **options)


def balance(found, loads):
    """The gap of energies over what went through [1]."""
    seen = found.channels
    works = [seen[f"work_{load.name}"] for load in loads]
    stored = seen["kinetic"] + seen["potential"]
    gap = sum(works) - (stored - stored[0]) - seen["dissipated"]
    return np.abs(gap).max() / max(np.ptp(x) for x in (*works, stored, seen["kinetic"]))


def forces(found, loads):
    """(k, 3) at the end."""
    return np.array([
        [found.channels[f"load_{load.name}_force_{x}"][-1] for x in "xyz"] for load in loads
    ])  # fmt: skip


def test_a_block_that_rests_presses_with_its_weight(block):
    loads = feet(stiffness=1e5, damping=2.0)
    found = run(block, loads, start(block, 0.0), 3.0, step=0.01)
    assert balance(found, loads) < 1e-6
    assert forces(found, loads)[:, 2] == pytest.approx(MASS * 9.81 / 4, rel=1e-6)
    assert found.q[-1, 2] == pytest.approx(HIGH - MASS * 9.81 / 4 / 1e5, abs=1e-8)


@pytest.mark.parametrize("smoothing", [1e-2, 1e-3])
def test_below_the_angle_of_friction_it_creeps_as_smoothing_says(block, smoothing):
    slope, friction = 0.3, 0.5
    loads = feet(slope, stiffness=1e5, damping=2.0, friction=friction, smoothing=smoothing)
    found = run(block, loads, start(block, slope), 4.0, step=0.01)
    assert balance(found, loads) < 1e-6
    speed = np.linalg.norm(np.diff(found.q[-2:, :3], axis=0)) / 0.01
    k = np.tan(slope)
    assert speed == pytest.approx(smoothing * k / np.sqrt(friction**2 - k**2), rel=1e-3)


def test_above_it_slides_as_coulomb_says(block):
    slope, friction = 0.5, 0.4
    loads = feet(slope, stiffness=1e5, damping=2.0, friction=friction, smoothing=1e-3)
    found = run(block, loads, start(block, slope), 3.0, step=0.01)
    assert balance(found, loads) < 1e-6
    way = np.linalg.norm(found.q[:, :3] - found.q[0, :3], axis=1)
    gained = np.diff(way, 2)[-50:].mean() / 0.01**2
    assert gained == pytest.approx(9.81 * (np.sin(slope) - friction * np.cos(slope)), rel=1e-3)


@pytest.mark.parametrize("method", ["DOP853", "rosenbrock"])
def test_what_gives_way_along_the_ground_stands_still(block, method):
    slope, stiffness = 0.3, 2e5
    tyre = {"lateral_stiffness": stiffness, "lateral_damping": 2e3, "friction": 0.4}
    loads = feet(slope, stiffness=1e5, damping=2.0, **tyre)
    q = start(block, slope)
    found = run(block, loads, q, 3.0, step=1e-3, method=method)
    assert balance(found, loads) < 1e-6
    assert np.abs(found.v[-1]).max() < 1e-8
    assert np.linalg.norm(found.q[-1, :3] - found.q[0, :3]) < 0.02
    along = forces(found, loads).sum(axis=0) @ [np.cos(slope), 0.0, np.sin(slope)]
    assert along == pytest.approx(MASS * 9.81 * np.sin(slope), rel=1e-7)
    # pulled across the slope it gives way by as much as the spring says, and comes back
    pull = crane.Wrench(
        "block", [[0, 0, 0], [0, 40, 0], [0, 40, 0], [0, 0, 0]], times=[3, 4, 6, 7]
    )
    found = run(block, [*loads, pull], q, 9.0, step=5e-3, method=method)
    still, pulled, back = (found.q[int(t / 5e-3)] for t in (2.9, 5.9, 8.9))
    lower = loads[0].stiffness * 4 * 0.8**2  # of rolling: the pull acts HIGH above the feet
    given = 40 / (4 * stiffness) + 40 * HIGH**2 / lower
    assert pulled[1] - still[1] == pytest.approx(given, rel=2e-2)
    assert back == pytest.approx(still, abs=1e-6)


def test_a_tyre_slides_as_coulomb_says(block):
    slope, friction = 0.5, 0.4
    tyre = {"lateral_stiffness": 2e5, "lateral_damping": 2e3, "friction": friction}
    loads = feet(slope, stiffness=1e5, damping=2.0, **tyre)
    found = run(block, loads, start(block, slope), 3.0, step=0.01)
    assert balance(found, loads) < 1e-6
    way = np.linalg.norm(found.q[:, :3] - found.q[0, :3], axis=1)
    gained = np.diff(way, 2)[-50:].mean() / 0.01**2
    assert gained == pytest.approx(9.81 * (np.sin(slope) - friction * np.cos(slope)), rel=1e-4)


def test_python_follows_tyres_as_machine_code_does(block):
    tyre = {"lateral_stiffness": 2e5, "lateral_damping": 2e3, "friction": 0.4}
    loads = feet(0.3, stiffness=1e5, damping=2.0, **tyre)
    both = [
        run(block, loads, start(block, 0.3, above=1e-3), 0.1, method="rk4", backend=backend).q
        for backend in ("compiled", "pinocchio")  # where it just touches, rounding decides
    ]
    assert both[1] == pytest.approx(both[0], abs=1e-13)


def test_it_tips_where_its_weight_leaves_its_feet(block):
    """tan(slope) = WIDE / HIGH, to 1 % of the angle, on rough and stiff ground."""
    angle = np.arctan(WIDE / HIGH)
    turned = []
    for share in (0.99, 1.01):
        slope = share * angle
        loads = feet(slope, stiffness=1e8, damping=100.0, friction=1.6, smoothing=1e-4)
        found = run(block, loads, start(block, slope), 3.0, step=0.01, tolerance=1e-8)
        turned.append(abs(found.q[-1, 4] - found.q[0, 4]))
        if share < 1:
            upper = forces(found, loads)[:2]
            assert (upper[:, 2] > 0).all()
    assert turned[0] < 1e-3 and turned[1] > 0.02


def test_what_falls_bounces_lower_and_comes_to_rest_without_energy_from_nowhere(block):
    loads = feet(stiffness=2e5, damping=0.5, friction=0.4)
    turned = start(block, 0.0, above=0.5)
    turned[3:] = 0.3, 0.2, 0.4
    found = run(block, loads, turned, 8.0, step=5e-3)
    assert balance(found, loads) < 1e-6
    stored = found.channels["kinetic"] + found.channels["potential"]
    total = sum(found.channels[f"work_{load.name}"] for load in loads)
    # what springs hold is given back: above them the energy only falls
    free = np.flatnonzero(
        sum(np.abs(found.channels[f"load_{x.name}_force_z"]) for x in loads) == 0
    )
    assert (np.diff(stored[free]) < 1e-6 * np.ptp(stored)).all() and total[-1] < 0
    assert forces(found, loads)[:, 2].sum() == pytest.approx(MASS * 9.81, rel=1e-3)


def test_a_ball_rolls_down_a_profile(tmp_path):
    """A solid ball rolls with 5/7 g sin(slope); behind the slope it goes on at its speed."""
    mass, radius, slope = 3.0, 0.2, 0.2
    path = tmp_path / "ball.urdf"
    inertia = 0.4 * mass * radius**2
    path.write_text(
        f"""<robot name="ball"><link name="world"/><joint name="fly" type="floating">
        <parent link="world"/><child link="ball"/></joint><link name="ball"><inertial>
        <mass value="{mass}"/>
        <inertia ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"/>
        </inertial></link></robot>"""
    )
    machine = crane.load(path)
    fall = 10.0 * np.tan(slope)
    ground = crane.description.Ground(profile=((0.0, fall), (10.0, 0.0)))
    ball = crane.description.Contact(
        "ball", ground, radius=radius, stiffness=1e5, damping=2.0, friction=0.8, smoothing=1e-4
    )
    q = np.zeros(6)
    q[0] = 2.0 + radius * np.sin(slope)
    q[2] = fall * 0.8 + radius * np.cos(slope)
    found = run(machine, [ball], q, 4.0, step=0.01)
    assert balance(found, [ball]) < 1e-6
    t, way = found.time, (found.q[:, 0] - q[0]) / np.cos(slope)
    down = found.q[:, 0] < 9.0
    true = 0.5 * 5 / 7 * 9.81 * np.sin(slope) * t**2
    assert way[down] == pytest.approx(true[down], abs=2e-3 * true[down].max())
    level = found.q[:, 0] > 10.5
    assert level.sum() > 20
    assert np.diff(found.q[level, 0]) == pytest.approx(np.diff(found.q[level, 0]).mean(), rel=2e-3)


STANDING = """
name: standing
chains: [{name: block, urdf: block.urdf}]
home: {fly_z: 0.5}
ground: {normal: [0, 0, 1], stiffness: 1.0e+5, damping: 2}
contacts:
  - {frame: c0}
  - {frame: c1, friction: 0.3, area: 0.2}
  - {frame: c2}
  - {frame: c3, radius: 0.0, name: rear}
"""


def test_machine_files_stand_on_the_ground(block, tmp_path):
    path = tmp_path / "standing.yaml"
    path.write_text(STANDING)
    machine = crane.load(path)
    found = crane.simulate(machine, None, None, 3.0, 0.01)
    names = ("c0", "c1", "c2", "rear")
    pressed = [found.channels[f"load_{name}_force_z"][-1] for name in names]
    assert pressed == pytest.approx([MASS * 9.81 / 4] * 4, rel=1e-6)
    assert found.channels["pressure_c1"][-1] == pytest.approx(pressed[1] / 0.2)
    written = crane.load(crane.write_machine(machine, tmp_path / "written"))
    again = crane.simulate(written, None, None, 3.0, 0.01)
    assert again.q == pytest.approx(found.q, abs=1e-12)
    path.write_text(
        STANDING.replace("{frame: c0}", "{frame: c0, lateral_stiffness: 1e5, lateral_damping: 9}")
    )
    (tyre, *_) = crane.load(
        crane.write_machine(crane.load(path), tmp_path / "tyre")
    ).external_forces
    assert (tyre.lateral_stiffness, tyre.lateral_damping, tyre.state_count) == (1e5, 9.0, 2)
    for old, new, text in (
        ("ground:", "#", "yaml:7: contacts without a ground"),
        ("{frame: c0}", "{frame: nix}", "yaml:7: .*'nix'"),
        ("{frame: c0}", "{frame: world}", "yaml:7: .*does not move"),
        ("{frame: c0}", "{frame: c0, stiffness: 0}", "yaml:7: .*stiffness"),
        ("normal: [0, 0, 1]", "normal: [0, 1]", "yaml:5: .*normal"),
        ("normal: [0, 0, 1]", "profile: [[0, 1], [0, 2]]", "yaml:5: .*goes back"),
    ):
        path.write_text(STANDING.replace(old, new))
        with pytest.raises(CraneError, match=text):
            crane.load(path)
    path.write_text(STANDING.replace("fly_z: 0.5", "fly_z: 0.4"))
    with pytest.raises(CraneError, match="'c0' is 0.1 m inside the ground"):
        crane.simulate(crane.load(path), None, None, 0.1)


ROCKING = STANDING.replace("fly_z: 0.5", "base_z: 0.5, base_ry: 0.3") + "floating: [ry, z]\n"


def test_a_root_has_the_freedoms_that_are_named(block, tmp_path):
    """A planar root moves as a floating one in its plane."""
    urdf = (tmp_path / "block.urdf").read_text()
    fixed = urdf[: urdf.index('<link name="world"/>')] + urdf[urdf.index('<link name="block">') :]
    (tmp_path / "root.urdf").write_text(fixed)
    path = tmp_path / "rocking.yaml"
    text = ROCKING.replace("block.urdf", "root.urdf").replace("base_z: 0.5", "base_z: 0.8")
    text = text.replace("friction: 0.3, ", "")
    text = text.replace("ground: {", "ground: {friction: 0, ")
    path.write_text(text)
    machine = crane.load(path)
    assert (machine.free, machine.driven_joints) == (("base_z", "base_ry"), ())
    rocks = crane.simulate(machine, None, None, 1.5)
    floats = crane.load(block.path).with_external_forces(*machine.external_forces)
    q = np.array([0.0, 0.0, 0.8, 0.0, 0.3, 0.0])
    whole = crane.simulate(floats, None, q, 1.5)
    assert rocks.q == pytest.approx(whole.q[:, [2, 4]], abs=1e-7)
    assert rocks.channels["support_c0"].max() > 2 * MASS * 9.81 and np.ptp(rocks.q[:, 1]) > 0.3
    again = crane.load(crane.write_machine(machine, tmp_path / "written"))
    assert crane.simulate(again, None, None, 0.2).q == pytest.approx(rocks.q[:201], abs=1e-10)
    named = crane.load(tmp_path / "root.urdf", floating=("ry", "z"))
    assert named.joints == ("base_z", "base_ry") and "floating" in named.load_expression
    assert crane.formats.load_from_expression(named.load_expression).joints == named.joints
    locks = dict.fromkeys(("base_x", "base_y", "base_rx", "base_rz"), 0.0)
    held = crane.load(tmp_path / "root.urdf", floating=True, lock=locks)
    assert held.free == machine.free
    with pytest.raises(CraneError, match="floating is 'z', give True or some of x, y, z"):
        crane.load(tmp_path / "root.urdf", floating="z")
    path.write_text(text.replace("[ry, z]", "[ry, zz]"))
    with pytest.raises(
        CraneError, match=r"rocking.yaml:\d+: 'floating' of the machine file: 'zz' is unknown"
    ):
        crane.load(path)


def test_what_is_no_ground_is_refused(block):
    for make, text in (
        (lambda: crane.description.Ground(normal=(0, 0, -1)), "upwards"),
        (lambda: crane.description.Ground(profile=((0, 0), (0, 1))), "goes back"),
        (lambda: crane.description.Ground(profile=((0, 0, 1),)), "no list"),
        (lambda: crane.description.Contact("c0", stiffness=0.0), "stiffness"),
        (lambda: crane.description.Contact("c0", friction=-1.0), "must not be negative"),
        (
            lambda: crane.description.Contact("c0", lateral_damping=1.0),
            "no lateral stiffness, give both",
        ),
        (
            lambda: run(
                block, feet(lateral_stiffness=1e5), start(block, 0.0), 0.1, method="Radau"
            ),
            "take DOP853",
        ),
        (lambda: run(block, [crane.description.Contact("c9")], None, 0.1), "'c9'"),
    ):
        with pytest.raises(CraneError, match=text):
            make()


# --- the start on contacts ----------------------------------------------------------------------


BODY = '<mass value="{}"/><inertia ixx="9" iyy="9" izz="9" ixy="0" ixz="0" iyz="0"/>'
URDF = f"""<robot name="sledge">
  <link name="frame"><inertial><origin xyz="0 0 0.5"/>{BODY.format(400)}</inertial></link>
  <joint name="fore" type="fixed"><origin xyz="1 0 0"/><parent link="frame"/>
    <child link="foot_fore"/></joint>
  <joint name="aft" type="fixed"><origin xyz="-1 0 0"/><parent link="frame"/>
    <child link="foot_aft"/></joint>
  <link name="foot_fore"/><link name="foot_aft"/>
  <joint name="push" type="prismatic"><origin xyz="0 0 0.5"/><parent link="frame"/>
    <child link="ram"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="1e4" velocity="1"/></joint>
  <link name="ram"><inertial>{BODY.format(100)}</inertial></link>
</robot>"""
YAML = """
name: sledge
chains: [{name: body, urdf: sledge.urdf}]
floating: [x, z, ry]
active: [push]
free: [base_x, base_z, base_ry]
home: {push: 0.5, base_z: 0.0}
ground: {height: 0, stiffness: 2.0e+5, friction: 0.5}
contacts: [{frame: foot_fore}, {frame: foot_aft, stiffness: 1.0e+5}]
tip: ram
"""
G = 9.81


@pytest.fixture
def load(tmp_path):
    (tmp_path / "sledge.urdf").write_text(URDF)

    def made(old="name: sledge", new="name: sledge"):
        assert old in YAML
        (tmp_path / "sledge.yaml").write_text(YAML.replace(old, new))
        free = ["base_x", "base_z", "base_ry"]
        return crane.load(tmp_path / "sledge.yaml", lock={"push": 0.5}, active=[], free=free)

    return made


def held(machine):
    return crane.simulate(machine, duration=1.0, step=0.01)


def test_it_stands_where_hand_statics_has_it_and_stays(load):
    run = held(load())
    aft, fore = (run[f"support_foot_{side}"] for side in ("aft", "fore"))
    # moments about the aft foot; what is 0.5 m above it leans forward
    lean = 0.5 * run["base_ry"][0]
    assert fore == pytest.approx(G * (400 * (1.0 + lean) + 100 * (1.5 + lean)) / 2, rel=1e-4)
    assert fore + aft == pytest.approx(G * 500, rel=1e-9)
    sunk = np.array([aft[0] / 1e5, fore[0] / 2e5])  # of the feet: each into its own ground
    assert run["base_z"][0] == pytest.approx(-sunk.mean(), rel=1e-4)
    assert run["base_ry"][0] == pytest.approx((sunk[1] - sunk[0]) / 2, rel=1e-4)
    assert np.abs(run.v).max() < 1e-8  # dropped from home, it is 0.3 m/s fast
    assert run.start == "in static equilibrium on its contacts, base_z -0.01779 m from home"
    assert f"starts {run.start}" in crane.recordings.recording_summary.summarize(run).to_markdown()


def test_a_run_that_is_told_its_start_starts_there(load):
    machine = load()
    run = crane.simulate(machine, initial=machine.home[machine.closure.active], duration=0.2)
    assert run["base_z"][0] == 0 and not run.start and np.abs(run.v).max() > 0.1


def test_it_comes_down_to_the_ground(load):
    """It is 2 cm above it in the file."""
    machine, above = load(), load("height: 0", "height: -0.02")
    on, run = held(machine), held(above)
    assert run["base_z"][0] == pytest.approx(on["base_z"][0] - 0.02, rel=1e-6)
    assert np.abs(run.v).max() < 1e-8


def test_what_is_far_above_falls_as_it_says(load):
    run = held(load("height: 0", "height: -1.5"))
    assert run["base_z"][0] == 0
    assert run.start == "at home, near which it has no static equilibrium on its contacts"


def test_on_a_slope_only_friction_in_motion_holds_it(load):
    run = held(load("height: 0", "height: -0.02, normal: [-0.02, 0, 1]"))
    assert run.start.endswith("where only friction in motion holds it along the ground")
    aft, fore = (run[f"support_foot_{side}"][0] for side in ("aft", "fore"))
    assert fore + aft == pytest.approx(G * 500 / np.hypot(1, 0.02), rel=1e-3)
    assert np.abs(run.v).max() < 0.05  # it creeps; dropped from home it is 0.3 m/s fast


def test_a_start_survives_a_file(load, tmp_path):
    run = held(load())
    run.to_csv(tmp_path / "run.csv")
    assert crane.Recording.from_csv(tmp_path / "run.csv").start == run.start


def test_what_has_no_contact_starts_at_home(load):
    machine = load("contacts: [{frame: foot_fore}, {frame: foot_aft, stiffness: 1.0e+5}]", "")
    run = crane.simulate(machine, duration=0.1)
    assert not run.start and run["base_z"][0] == 0
