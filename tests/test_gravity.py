"""Gravity is a number of the world: dynamics, files, ratings and runs under other gravity."""

import warnings

import numpy as np
import pytest
from broken_machines import DATA
from command_line import typed
from linkages import multipliers
from test_couplings import BARE

import crane
from crane.common.errors import CraneError, CraneWarning

GRAVITIES = {
    "earth": (0.0, 0.0, -9.81),
    "none": (0.0, 0.0, 0.0),
    "moon": (0.0, 0.0, -1.62),
    "drawn in x and y": (0.0, -9.81, 0.0),
    "oblique": (3.0, -4.0, -7.5),
}
WRITERS = {
    "urdf+": lambda machine, folder: crane.formats.write_urdf_plus(machine, folder / "one.urdf"),
    "mjcf": lambda machine, folder: crane.formats.write_mjcf(machine, folder / "one.xml"),
    "machine": crane.write_machine,
}
MACHINES = ("mini_forwarder", "excavator", "stewart", "six_bar")


def loaded(name, gravity):
    path = DATA / f"{name}.urdf"
    return crane.load(path if path.exists() else name, gravity=gravity).replace(**BARE)


def moving_states(machine, count=4):
    """Active coordinates near home, velocities and accelerations, in strokes per second."""
    span = np.minimum(machine.upper - machine.lower, 1.0)
    home = machine.home[machine.closure.active]
    random = np.random.default_rng(3)
    for part in random.uniform(-1, 1, (count, 3, len(home))):
        yield np.clip(home + 0.05 * span * part[0], machine.lower, machine.upper), *span * part[1:]


@pytest.mark.parametrize("gravity", GRAVITIES.values(), ids=GRAVITIES)
@pytest.mark.parametrize("name", MACHINES)
def test_inverse_dynamics_under_any_gravity(name, gravity, tmp_path):
    """What multipliers of Pinocchio and of MuJoCo make of the forces are the accelerations."""
    pytest.importorskip("mujoco")
    from mujoco_oracle import Oracle

    machine = loaded(name, gravity)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        crane.formats.write_mjcf(machine, tmp_path / "machine.xml")
    oracle, dynamics = Oracle(tmp_path / "machine.xml", machine), crane.Dynamics(machine)
    np.testing.assert_array_equal(oracle.model.opt.gravity, gravity)
    on_earth = loaded(name, None)
    on_earth.model.gravity.linear = np.array(gravity)  # for Pinocchio
    for q_a, v_a, a_a in moving_states(machine):
        q = machine.closure.solve(q_a)
        v = machine.closure.gamma(q) @ v_a
        wanted = machine.closure.gamma(q) @ a_a + machine.closure.drift(q, v)
        along = np.zeros(len(machine.joints))
        along[machine.closure.active] = dynamics.inverse(q_a, v_a, a_a)
        found = multipliers(on_earth, q, v, along)
        scale = np.abs(wanted).max() + np.linalg.norm(gravity)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-10 * scale)
        oracle.place(q, v)
        found, wanted = oracle.accelerations(along), oracle.motion(q, v, wanted)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-10 * scale)


def test_forces_are_linear_in_gravity():
    """The regressor, and derivatives by gravity.x, .y and .z, of which one step is exact."""
    mini = crane.load("mini_forwarder", gravity=GRAVITIES["oblique"])
    weightless = crane.Dynamics(crane.load("mini_forwarder", gravity=(0, 0, 0)))
    dynamics = crane.Dynamics(mini)
    ((q_a, v_a, a_a),) = moving_states(mini, 1)
    force = dynamics.inverse(q_a, v_a, a_a)
    scale = np.abs(force)
    parts = dynamics.derivatives("inverse", q_a, v_a, a_a, by=[f"gravity.{x}" for x in "xyz"])
    total = weightless.inverse(q_a, v_a, a_a) + np.array(mini.gravity) @ list(parts.values())
    np.testing.assert_array_less(np.abs(total - force), 1e-10 * scale)
    regressed = dynamics.regressor(q_a, v_a, a_a) @ dynamics.parameters
    np.testing.assert_array_less(np.abs(regressed - force), 1e-12 * scale)


BODY = (
    '<robot name="stone"{}><link name="stone"><inertial><mass value="2"/><inertia ixx="1" ixy="0" '
    'ixz="0" iyy="2" iyz="0" izz="3"/></inertial></link></robot>'
)


def test_a_thrown_body_follows_its_parabola(tmp_path):
    (tmp_path / "stone.urdf").write_text(BODY.format(' gravity="3 -4 -7.5"'))
    for gravity in (None, (0.0, 0.0, 0.0)):
        stone = crane.load(tmp_path / "stone.urdf", floating=True, gravity=gravity)
        start = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]), np.array([0.5, 0, -1, 0, 0, 0])
        run = crane.simulate(stone, initial=start, duration=1.0)
        g = np.array([3.0, -4.0, -7.5] if gravity is None else gravity)
        first = crane.Kinematics(stone, "stone").jacobian(start[0]) @ start[1]
        wanted = start[0][:3] + np.outer(run.time, first) + np.outer(run.time**2 / 2, g)
        np.testing.assert_allclose(run.q[:, :3], wanted, rtol=0, atol=1e-9)


def test_files_keep_gravity(tmp_path):
    """Each format writes it and reads it; what stands on earth says nothing of it."""
    pytest.importorskip("mujoco")
    for number, gravity in enumerate([*GRAVITIES.values(), (0.1, 1 / 3, -1e-7)]):
        machine = crane.load(DATA / "four_bar.yaml", gravity=gravity)
        for kind, write in WRITERS.items():
            folder = tmp_path / f"{number}{kind}"
            folder.mkdir()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", CraneWarning)
                path = write(machine, folder) or next(folder.iterdir())
                again = crane.load(path)
            assert again.gravity == gravity and not again.parameter_changes
            texts = "".join(x.read_text() for x in folder.rglob("*") if x.is_file())
            assert ("gravity" in texts) == (kind == "mjcf" or gravity != GRAVITIES["earth"])
        assert crane.formats.load_from_expression(machine.load_expression).gravity == gravity
        variant = crane.formats.machine_loading.MachineVariants(machine).machine(
            {"crank_arm.mass": 2.0}
        )
        assert variant.gravity == gravity


def test_gravity_of_simulators(tmp_path):
    """MJCF's option and flag, and the world of an SDF, give the torque of a pendulum."""
    pytest.importorskip("mujoco")
    arm = (
        "<link name='a'><inertial><pose>0.5 0 0 0 0 0</pose><mass>4</mass></inertial></link>"
        "<joint name='h' type='revolute'><parent>world</parent><child>a</child><axis><xyz>{}</xyz>"
        "</axis></joint>"
    )
    world = (
        "<sdf version='1.9'><world name='w'>{}<model name='m'>" + arm + "</model></world></sdf>"
    )
    body = (
        "<mujoco><option gravity='{}'><flag gravity='{}'/></option><worldbody><body><joint "
        "name='h' axis='{}'/><inertial pos='0.5 0 0' mass='4' diaginertia='1 1 1'/></body>"
        "</worldbody></mujoco>"
    )
    cases = [("0 -9.81 0", "0 0 1", 19.62), ("0 0 -1.62", "0 -1 0", 3.24), ("0 0 0", "0 0 1", 0)]
    for gravity, axis, wanted in cases:
        (tmp_path / "w.sdf").write_text(world.format(f"<gravity>{gravity}</gravity>", axis))
        (tmp_path / "b.xml").write_text(body.format(gravity, "enable", axis))
        (tmp_path / "off.xml").write_text(body.format(gravity, "disable", axis))
        with warnings.catch_warnings():
            warnings.simplefilter("error", CraneWarning)
            for name, expected in (("w.sdf", wanted), ("b.xml", wanted), ("off.xml", 0)):
                found = crane.Dynamics(crane.load(tmp_path / name)).gravity([0.0])
                np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    (tmp_path / "w.sdf").write_text(world.format("", "0 -1 0"))
    assert crane.load(tmp_path / "w.sdf").gravity == GRAVITIES["earth"]


def test_a_machine_file_has_one_gravity(tmp_path):
    """Its own, or that of its chains, which have to agree."""
    text = (DATA / "four_bar.yaml").read_text().replace("urdf: ", f"urdf: {DATA}/")
    first, second = (DATA / "four_bar" / f"{name}.urdf" for name in ("ground", "rocker"))
    for file, gravity in ((first, "0 0 -1.62"), (second, "0 0 -3.7")):
        robot = file.read_text().replace("<robot ", f'<robot gravity="{gravity}" ')
        (tmp_path / file.name).write_text(robot)
    path = tmp_path / "four_bar.yaml"
    one = text.replace(str(first), str(tmp_path / first.name))
    path.write_text(one)
    assert crane.load(path).gravity == (0.0, 0.0, -1.62)
    two = one.replace(str(second), str(tmp_path / second.name))
    path.write_text(two)
    with pytest.raises(CraneError, match=r"chains '\w+' and '\w+' have different gravity, write"):
        crane.load(path)
    path.write_text(f"gravity: [0, 0, 0]\n{two}")
    assert crane.load(path).gravity == (0.0, 0.0, 0.0)
    for wrong, problem in (("[0, 0]", "has 2 numbers, give 3"), ("down", "give a list such as")):
        path.write_text(f"gravity: {wrong}\n{text}")
        with pytest.raises(CraneError, match=f"four_bar.yaml:1: .*gravity.*{problem}"):
            crane.load(path)


def turned(name, folder):
    """A bundled machine on a base that is turned, so that its z axis is the world's y axis."""
    models = crane.load(name).path.parent
    text = (models / f"{name}.yaml").read_text().replace("urdf: urdf/", f"urdf: {models}/urdf/")
    head, _, rest = text.partition("chains:\n")
    first, _, others = rest.partition("}")
    (folder / "base.urdf").write_text(
        '<robot name="base"><link name="soil"/><link name="base_top"/><joint name="turn" '
        'type="fixed"><parent link="soil"/><child link="base_top"/>'
        f'<origin rpy="{-np.pi / 2!r} 0 0"/></joint></robot>'
    )
    path = folder / f"{name}.yaml"
    path.write_text(
        f"{head}gravity: [0, -9.81, 0]\nchains:\n  - {{name: base, urdf: base.urdf}}\n"
        f"{first}, parent: base_top}}{others}"
    )
    return crane.load(path)


def test_up_is_against_gravity(tmp_path):
    """A machine drawn in x and y is judged as the same one drawn in x and z."""
    from crane.recordings.sensor_kinematics import ideal_readings

    upright, lying = crane.load("patu655"), turned("patu655", tmp_path)
    q = upright.closure.solve(upright.home[upright.closure.active] + [[0.3, 0.02, 0.01, 0.1]])
    v = np.array([upright.closure.gamma(q[0]) @ [0.1, 0.02, 0.03, 0.04]])
    names = ["inclination_lift_boom", "inclination_lift_boom_velocity"]
    wanted, found = (ideal_readings(x, q, v, names) for x in (upright, lying))
    for name in names:
        np.testing.assert_allclose(found[name], wanted[name], rtol=0, atol=1e-12)
    angles = [crane.Kinematics(x, "lift_boom").inclination(q[:, x.closure.active])
              for x in (upright, lying)]  # fmt: skip
    np.testing.assert_allclose(angles[1], angles[0], rtol=0, atol=1e-12)
    grid = {"radii": [3.0, 4.5], "heights": [0.0, 1.0], "slope": 0.05}
    wanted, found = (crane.capacity(x, **grid).values for x in (upright, lying))
    np.testing.assert_allclose(found, wanted, rtol=1e-6)


def test_what_needs_gravity_says_so():
    """Ratings of loads, tipping and what hangs end in one line; the rest computes without it."""
    for words, reason in (
        (("capacity", "excavator"), "'excavator' has no gravity, a load has no weight there"),
        (("stability", "excavator"), "gravity does not press 'excavator' down on its supports"),
        (("sway", "patu655_grapple", "--task", "reach"), "configuration, and gravity, in which"),
    ):
        done = typed(*words, "--gravity", "0,0,0")
        assert done.returncode == 2 and reason in done.stderr and done.stderr.count("\n") == 1


def test_gravity_on_the_command_line():
    """In all positions and forms; once, and as three numbers."""
    for words in (("--gravity", "-3,0,-1.62"), ("--gravity=-3,0,-1.62",)):
        for command in (("info", "four_bar.yaml", *words), (*words, "info", "four_bar.yaml")):
            done = typed(*command, cwd=DATA)
            assert "  gravity     -3 0 -1.62 m/s2\n" in done.stdout, done.stderr
    for words in (("--gravity",), ("--gravity", "0,0"), ("--gravity=0,0,nan",)):
        done = typed("info", "four_bar.yaml", *words, cwd=DATA)
        assert done.returncode == 2 and "write X,Y,Z in m/s2, as 0,0,-1.62" in done.stderr
    words = ("--gravity", "0,0,-2", "--set", "gravity.z=-3")
    done = typed("simulate", "four_bar.yaml", *words, cwd=DATA)
    assert done.stderr == "error: gravity.z is -3.0 and -2.0 at once, give one of them\n"
    with pytest.raises(CraneError, match=r"gravity has the shape \(2,\), give \(3,\)"):
        crane.load(DATA / "four_bar.yaml", gravity=(0, -1))


@pytest.mark.parametrize("lateral", [0.0, 2e4])
def test_ground_under_a_machine_drawn_in_x_and_y(lateral, tmp_path):
    """A ball that is thrown on it rolls as on ground below z."""
    (tmp_path / "stone.urdf").write_text(BODY.format(""))
    places = []
    for gravity, normal, place, turn in (
        (GRAVITIES["earth"], (0, 0, 1), (0, 0, 0.5), 0.0),
        (GRAVITIES["drawn in x and y"], (0, 1, 0), (0, 0.5, 0), -np.pi / 2),
    ):
        stone = crane.load(tmp_path / "stone.urdf", floating=True, gravity=gravity)
        contact = crane.description.Contact(
            "stone", crane.description.Ground(0.1, normal), 2e4, 0.5, 0.6, radius=0.3,
            lateral_stiffness=lateral, lateral_damping=lateral / 100,
        )  # fmt: skip
        start = np.array([*place, turn, 0, 0]), np.array([1.0, 0.2, 0.0, 0.1, 0.2, 0.3])
        run = crane.simulate(stone.with_external_forces(contact), initial=start, duration=0.8)
        places.append(run.q[:, :3])
    x, y, z = places[0].T
    assert z.min() < 0.4
    np.testing.assert_allclose(places[1], np.column_stack([x, z, -y]), rtol=0, atol=1e-9)


def test_an_identified_machine_keeps_gravity(tmp_path):
    """That of the machine as it was loaded, as an argument or in its file."""
    import forwarder_motions

    from crane.identification import identify, write_identified

    moon = crane.load("mini_forwarder", gravity=GRAVITIES["oblique"])
    found = identify(moon, forwarder_motions.motion(moon, duration=4.0), prior=0.1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        again = crane.load(write_identified(found, tmp_path / "found"))
    assert again.gravity == GRAVITIES["oblique"]
